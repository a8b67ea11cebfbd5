"""Simulated surveys with ground truth: nadir photographs of rolling ground, positions and ground control."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from tidefield.data.georeference import Georeference
from tidefield.geometry.geodesy import LocalFrame
from tidefield.survey.georeference.georeference import georeference
from tidefield.survey.survey import Control, Mark, Photograph, Position, Survey

WIDTH, HEIGHT, FOCAL = 800, 600, 570.0  # of the model's images; photographs are twice as large
ZOOM = 2
FRAME = LocalFrame.at("EPSG:27700", (351200.0, 512900.0, 260.0), "Newlyn")
CONTROL = np.array([[-38, -30], [37, -29], [-36, 31], [39, 28], [2, 3], [-20, 12], [22, -10], [3, 33]], dtype=float)


@dataclass(frozen=True)
class Flight:
    """A simulated survey.

    Attributes:
        model: in world metres, with exact points and noisy observations.
        survey: with positions, without control.
        centres_world: true camera positions.
    """

    model: pycolmap.Reconstruction
    survey: Survey
    centres_world: np.ndarray


def ground_m(xy: np.ndarray) -> np.ndarray:
    """Height of the ground, within 4 m."""
    return 2.5 * np.sin(xy[:, 0] / 40) + 1.5 * np.cos(xy[:, 1] / 55)


def fly(
    lines: int = 3,
    each: int = 5,
    noise_px: float = 0.3,
    position_m: float = 0.0,
    camera: pycolmap.Camera | None = None,
    seed: int = 0,
    tilt_deg: float = 3.0,
) -> Flight:
    """Simulate east-west strips 25 m apart, 75 m above the ground, with a photograph every 15 m.

    Args:
        position_m: standard deviation of the receiver, in each direction.
        camera: that took the photographs; without distortion if not given.
        tilt_deg: standard deviation of the camera's, sideways and forwards.
    """
    generator = np.random.default_rng(seed)
    x, y = (np.arange(each) - (each - 1) / 2) * 15.0, (np.arange(lines) - (lines - 1) / 2) * 25.0
    rows = [np.c_[x if i % 2 == 0 else x[::-1], np.full(each, y[i])] for i in range(lines)]
    centres = np.c_[np.concatenate(rows), 75 + generator.normal(0, 1.5, lines * each)]
    yaw = np.where(np.arange(len(centres)) // each % 2 == 0, 0.0, 180.0)
    tilts = generator.normal(0, tilt_deg, (len(centres), 2))
    # Camera axes in the world: x east, y south, z down, then turned.
    rotations = Rotation.from_euler("ZYX", np.c_[yaw, tilts], degrees=True).as_matrix() @ np.diag([1.0, -1, -1])
    half = np.array([each * 7.5 + 45, lines * 12.5 + 35])
    ground = generator.uniform(-half, half, (450, 2))
    if camera is None:
        camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2], camera_id=1
        )
    model = photographed(camera, rotations, centres, np.c_[ground, ground_m(ground)], noise_px, generator)
    places = FRAME.to_geographic(centres + position_m * generator.normal(0, 1, centres.shape))
    return Flight(model, Survey(Path("."), tuple(map(photograph, range(len(places)), places)), None), centres)


def name_of(i: int) -> str:
    return f"flight 1/DJI {i:03}.JPG"


def photograph(i: int, longitude_latitude_height: np.ndarray) -> Photograph:
    """Create one photograph of a survey."""
    longitude, latitude, height = longitude_latitude_height.tolist()
    position = Position(latitude, longitude, height, math.nan, math.nan, "mean sea level", "EXIF")
    size = (ZOOM * WIDTH, ZOOM * HEIGHT)
    nan = math.nan
    return Photograph(Path(name_of(i)), name_of(i), *size, 1, "", "", nan, None, nan, position, nan, None)


def photographed(
    camera: pycolmap.Camera,
    rotations: np.ndarray,
    centres: np.ndarray,
    points: np.ndarray,
    noise_px: float,
    generator: np.random.Generator,
) -> pycolmap.Reconstruction:
    """Create a model of the points visible in two photographs or more."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    poses = [pycolmap.Rigid3d(np.c_[R.T, -R.T @ c]) for R, c in zip(rotations, centres, strict=True)]
    shown = np.array([projected(camera, pose, points) for pose in poses])
    visible = ((shown > 0) & (shown < (WIDTH, HEIGHT))).all(axis=2)
    visible &= visible.sum(axis=0) >= 2
    tracks = [pycolmap.Track() for _ in points]
    for i, pose in enumerate(poses):
        seen = np.flatnonzero(visible[i])
        uv = shown[i, seen] + noise_px * generator.normal(0, 1, (len(seen), 2))
        model.add_image_with_trivial_frame(pycolmap.Image(name_of(i), uv, camera.camera_id, i + 1), pose)
        for row, point in enumerate(seen):
            tracks[point].add_element(i + 1, row)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(point, track)
    return model


def projected(camera: pycolmap.Camera, pose: pycolmap.Rigid3d, points: np.ndarray) -> np.ndarray:
    """Pixels of points; NaN behind the camera."""
    return np.array([np.full(2, np.nan) if uv is None else uv for uv in map(camera.img_from_cam, pose * points)])


def with_control(flight: Flight, places: np.ndarray = CONTROL, marks_each: int = 4, noise_px: float = 0.3) -> Survey:
    """Add control points G1, G2, ..., each marked in the photographs whose centre is nearest to it.

    Args:
        noise_px: of the marks, in pixels of the model's images.
    """
    generator = np.random.default_rng(1)
    points = np.c_[places, ground_m(places)]
    images = [flight.model.image(number) for number in sorted(flight.model.reg_image_ids())]
    marks = []
    for k, point in enumerate(points):
        uv = np.array([projected(flight.model.camera(i.camera_id), i.cam_from_world(), point[None])[0] for i in images])
        inside = ((uv > 10) & (uv < (WIDTH - 10, HEIGHT - 10))).all(axis=1)
        away = np.where(inside, np.linalg.norm(uv - (WIDTH / 2, HEIGHT / 2), axis=1), np.inf)
        for i in np.argsort(away)[:marks_each]:
            if np.isfinite(away[i]):
                pixel = ZOOM * (uv[i] + noise_px * generator.normal(0, 1, 2))
                marks.append(Mark(f"G{k + 1}", images[i].name, (float(pixel[0]), float(pixel[1]))))
    given = {f"G{k + 1}": tuple(place) for k, place in enumerate(FRAME.to_crs(points).tolist())}
    return replace(flight.survey, control=Control(FRAME.crs, given, tuple(marks)))


def in_a_frame_of_its_own(model: pycolmap.Reconstruction, seed: int = 0) -> pycolmap.Reconstruction:
    """Transform a model by an arbitrary similarity, as structure from motion returns it."""
    generator = np.random.default_rng(seed)
    turned = pycolmap.Reconstruction(model)
    rotation = Rotation.random(rng=generator).as_matrix()
    turned.transform(pycolmap.Sim3d(0.04, pycolmap.Rotation3d(rotation), generator.normal(0, 3, 3)))
    return turned


def quiet(done: int, whole: int) -> None:
    """Progress that nobody sees."""
    assert 0 <= done <= whole


def located(flight: Flight, survey: Survey | None = None) -> tuple[pycolmap.Reconstruction, Georeference]:
    """Georeference a copy of the flight's model that starts in an arbitrary frame."""
    model = in_a_frame_of_its_own(flight.model)
    return model, georeference(model, survey or flight.survey, quiet)


def unlocated_photograph(
    k: int, latitude: float | None, longitude: float = 0.0, time_s: float | None = None
) -> Photograph:
    nan = float("nan")
    place = None if latitude is None else Position(latitude, longitude, nan, nan, nan, "unknown", "EXIF")
    return Photograph(
        path=Path(f"{k:04d}.jpg"),
        name=f"{k:04d}.jpg",
        width=400,
        height=300,
        orientation=1,
        camera="",
        serial="",
        focal_mm=nan,
        lens=None,
        time_s=float(k) if time_s is None else time_s,
        position=place,
        relative_altitude_m=nan,
        gimbal_deg=None,
    )
