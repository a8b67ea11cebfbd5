"""Surveys whose every statistic is known: a lens without distortion, straight down over flat ground, exact points."""

import math
from datetime import datetime
from pathlib import Path

import numpy as np
import pycolmap

from tidefield.data.georeference import Georeference, LeftOut, Residuals
from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.similarity import Similarity
from tidefield.survey.report import Findings
from tidefield.survey.survey import Control, LensPrior, Photograph, Position, Survey

WIDTH, HEIGHT, FOCAL = 400, 300, 300.0
ABOVE = 60.0
GSD = ABOVE / FOCAL  # 0.2
AHEAD, ASIDE = 16.0, 30.0  # between photographs and between lines; footprints are 80 by 60
OFFSET_PX = (0.3, 0.4)  # of every observation: errors of half a pixel
NADIR = np.diag([1.0, -1.0, -1.0])  # camera axes in world: x east, y south, z down
FRAME = LocalFrame.at("EPSG:4326", (-2.75, 54.51, 0.0), "the ellipsoid of WGS 84")


def flight(lines: int = 3, each: int = 6) -> np.ndarray:
    """Camera positions, there and back, along the east."""
    x, y = np.arange(each) * AHEAD, np.arange(lines) * ASIDE
    rows = [np.c_[x if i % 2 == 0 else x[::-1], np.full(each, y[i]), np.full(each, ABOVE)] for i in range(lines)]
    return np.concatenate(rows)


def flat_ground(position: np.ndarray, a_photograph: int = 40, seed: int = 0) -> np.ndarray:
    """Points on z = 0 under the whole survey."""
    half = np.array([WIDTH, HEIGHT]) * GSD / 2
    low, high = position[:, :2].min(0) - half, position[:, :2].max(0) + half
    count = int(a_photograph * np.prod(high - low) / np.prod(2 * half))
    return np.c_[np.random.default_rng(seed).uniform(low, high, (count, 2)), np.zeros(count)]


def reconstruction(
    position: np.ndarray, points: np.ndarray, rotation: np.ndarray = NADIR, names: list[str] | None = None
) -> pycolmap.Reconstruction:
    """Cameras at `position` (N x 3), all with the same attitude (camera to world), that see all points in frame."""
    model = pycolmap.Reconstruction()
    lens = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=lens, camera_id=1)
    )
    tracks = [pycolmap.Track() for _ in points]
    for i, place in enumerate(position):
        in_camera = (points - place) @ rotation
        uv = in_camera[:, :2] / in_camera[:, 2:] * FOCAL + (WIDTH / 2, HEIGHT / 2)
        seen = np.flatnonzero((in_camera[:, 2] > 0) & (uv > 0).all(1) & (uv < (WIDTH, HEIGHT)).all(1))
        image = pycolmap.Image(name_of(i, names), uv[seen] + OFFSET_PX, 1, i + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation.T), -rotation.T @ place)
        model.add_image_with_trivial_frame(image, pose)
        for row, point in enumerate(seen):
            tracks[point].add_element(i + 1, row)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(point, track)
    return model


def name_of(i: int, names: list[str] | None = None) -> str:
    return names[i] if names else f"DJI_{i:04d}.JPG"


def photograph(i: int, place: np.ndarray | None, names: list[str] | None = None) -> Photograph:
    """What was read of one photograph, twice as large as the model's; one every two seconds."""
    lens = LensPrior(2 * FOCAL, None, None, "EXIF 35 mm equivalent", False)
    position = None
    if place is not None:
        longitude, latitude, height = FRAME.to_geographic(place[None])[0].tolist()
        position = Position(latitude, longitude, height, math.nan, math.nan, "ellipsoid", "EXIF")
    name = name_of(i, names)
    size = (2 * WIDTH, 2 * HEIGHT)
    return Photograph(Path(name), name, *size, 1, "Maker Drone", "", 8.8, lens, 1.6e9 + 2 * i, position, math.nan, None)


def residuals(kind: str, count: int = 5, seed: int = 0, error_m: np.ndarray | None = None) -> Residuals:
    """Residuals named after their kind: random ones of centimetres, or the given."""
    drawn = np.random.default_rng(seed).normal(0, 0.02, (count, 3)) if error_m is None else error_m
    return Residuals(tuple(f"{kind} {i}" for i in range(len(drawn))), drawn)


def surveyed(*compared: Residuals) -> Control:
    """A control file of all points that are compared, at random places in the survey."""
    names = [name for item in compared for name in item.names]
    place = np.c_[np.random.default_rng(9).uniform(0, 60, (len(names), 2)), np.zeros(len(names))]
    return Control(FRAME.crs, dict(zip(names, map(tuple, FRAME.to_crs(place).tolist()), strict=True)), ())


def located(
    frame: LocalFrame | None = FRAME,
    gps: Residuals | None = None,
    control: Residuals | None = None,
    check: Residuals | None = None,
    left_out: tuple[LeftOut, ...] = (),
) -> Georeference:
    """A georeference with the given residuals."""
    nothing = Residuals()
    source = "ground control" if control or check else "GPS" if frame else "none"
    there = Similarity(1.0, np.eye(3), np.zeros(3))
    return Georeference(frame, source, there, gps or nothing, control or nothing, check or nothing, left_out, ())


def findings(position: np.ndarray | None = None, names: list[str] | None = None, **more) -> Findings:
    """What a pipeline would find in such a survey; anything else by name."""
    position = flight() if position is None else position
    read = tuple(photograph(i, place, names) for i, place in enumerate(position))
    values = {
        "title": "Flat",
        "date": datetime(2026, 5, 4, 12, 30),
        "survey": Survey(Path("survey"), read, None),
        "georeference": located(),
    }
    if "reconstruction" not in more:
        values["reconstruction"] = reconstruction(position, flat_ground(position), names=names)
    return Findings(**(values | more))
