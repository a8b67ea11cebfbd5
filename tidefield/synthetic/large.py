"""Fly a survey of thousands of photographs, in pieces, and write the files that a drone's camera would.

The photographs have EXIF of lens, time and position, the latter with errors; `truth.json` has the true positions. One
flat is made for all of them, with nodes as far apart as its size requires, and each piece of the flight sees only the
plants below it. So memory depends on the area and not on the number of photographs, and an interrupted flight goes on
with the photographs that are missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from jaxtyping import Float64
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from scipy.spatial import KDTree

from tidefield.errors import SceneError
from tidefield.files import completed_file, completed_folder, delete_partials, read_json, write_json
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.geodesy import WGS84, LocalFrame
from tidefield.parallel import in_parallel
from tidefield.synthetic.flat import TidalFlat, make_flat
from tidefield.synthetic.grids import Extent
from tidefield.synthetic.settings import settings_for
from tidefield.synthetic.survey import LARGEST_CELL_M, Flight, fly, ground_extent
from tidefield.synthetic.write import add_photograph, model_of_lens

TRUTH_FILE, PHOTOGRAPHS = "truth.json", "photographs"
_MOST_NODES = 4_000_000
"""Of the flat: some 2 GB while it is made. Nodes further apart than creeks allow are not made for less."""
_PIECE = 25
"""Photographs for which the plants are selected together."""
_ORIGIN = (8.3, 53.7, 0.0)
"""Longitude, latitude and height of the middle of the flight: a tidal flat of the Wadden Sea."""
_SECONDS = 3.0
"""Between two photographs."""
_START = datetime(2026, 5, 1, 6, 0, tzinfo=UTC)
_FULL_FRAME_DIAGONAL_MM = 43.2666
_POINTS_EACH, _NOISE_PX = 40, 0.3
"""Of `write_large_scene`: points per photograph, and the standard deviation of an observation per axis."""


@dataclass(frozen=True)
class LargeFlight:
    """A flight of many strips.

    Attributes:
        category: tidal_trees, river_mouths, ground_textures, vegetation or deep_water.
        seed: of everything random.
        strips, each: number of strips, and of photographs in each.
        width: of a photograph, pixels.
        supersample: rays per pixel along each side.
        gps_m: standard deviation of the positions in the files, in each horizontal direction; twice that vertically.
        flight: overlap, height and camera.
    """

    category: str = "ground_textures"
    seed: int = 0
    strips: int = 50
    each: int = 100
    width: int = 400
    supersample: int = 1
    gps_m: float = 1.5
    flight: Flight = field(default_factory=lambda: Flight(altitude_m=60.0))


def make_large_flight(
    plan: LargeFlight, folder: Path, progress: Callable[[int, int], object] = lambda done, whole: None
) -> None:
    """Write `photographs/` and `truth.json` into a folder, or what is missing of them.

    Args:
        plan: of the flight. The same plan gives the same files.
        folder: a new one, or one of the same plan.
        progress: called with the numbers of written and of all photographs.

    Raises:
        SceneError: the folder holds something else, or the plan has no photographs.
    """
    if min(plan.strips, plan.each) < 1:
        raise SceneError(f"{plan.strips} strips of {plan.each} photographs: expected one or more of each")
    _refuse_other(plan, folder)
    cameras, error, names, make = planned_flight(plan)
    true = cameras.position_world.double().numpy()
    files = [folder / PHOTOGRAPHS / name for name in names]
    frame = LocalFrame.at(WGS84, _ORIGIN, "mean sea level")
    stated, exact = frame.to_geographic(true + error), frame.to_geographic(true)
    (folder / PHOTOGRAPHS).mkdir(parents=True, exist_ok=True)
    truth = {name: place for name, place in zip(names, exact.tolist(), strict=True)}
    about = {"plan": asdict(plan), "focal_px": float(cameras.focal_px[0, 0]), "longitude_latitude_height": truth}
    write_json(folder / TRUTH_FILE, about)
    missing = [i for i, file in enumerate(files) if not file.exists()]
    if not missing:
        return
    delete_partials(*(files[i] for i in missing))
    flat, seconds = make(), plan.flight.seconds(len(files))
    for first in range(0, len(missing), _PIECE):
        piece = missing[first : first + _PIECE]
        below = ground_extent(cameras[piece], plan.flight)
        part = flat.with_plants_within((below.west_m, below.south_m), (below.east_m, below.north_m))
        tasks = [partial(_write, part, cameras[i], plan, files[i], stated[i], seconds[i], i) for i in piece]
        in_parallel(tasks, "cpu")
        progress(len(files) - len(missing) + first + len(piece), len(files))


def write_large_scene(plan: LargeFlight, flight: Path, folder: Path) -> None:
    """Write the scene that a perfect `prepare` would make of a flight: links to its photographs, true poses, points.

    The points lie on mud and water, and are seen wherever they are in a frame.

    Args:
        plan: of the flight.
        flight: folder of `make_large_flight`.
        folder: a new one.
    """
    cameras, _, names, make = planned_flight(plan)
    surface, random = make().surface, np.random.default_rng([plan.seed, 20271])
    place = torch.from_numpy(random.uniform(0, 1, (len(cameras), _POINTS_EACH, 2))).float()
    direction = cameras.directions_world(place * cameras.size_px[:, None])
    points = cameras.position_world[:, None] - direction * (cameras.position_world[:, None, 2:] / direction[..., 2:])
    for _ in range(3):  # the mud is flat: the height where a ray meets it hardly depends on where exactly
        height = surface.sample(points.reshape(-1, 3)[:, :2].T)[0].reshape(points.shape[:2])
        away = (height - cameras.position_world[:, None, 2]) / direction[..., 2]
        points = cameras.position_world[:, None] + direction * away[..., None]
    points = points.reshape(-1, 3)
    model = model_of_lens(cameras)
    tracks = [pycolmap.Track() for _ in range(len(points))]
    tree, reach = KDTree(points[:, :2].numpy()), plan.flight.altitude_m / plan.flight.focal_ratio
    for i, name in enumerate(names):
        near = np.array(tree.query_ball_point(cameras.position_world[i, :2].numpy(), reach), dtype=np.int64)
        uv = cameras[i].project(points[near])[0][0].double().numpy() + random.normal(0, _NOISE_PX, (len(near), 2))
        inside = ((uv > 0) & (uv < (cameras.width, cameras.height))).all(1)
        add_photograph(model, cameras, i, name, uv[inside])
        for slot, point in enumerate(near[inside].tolist()):
            tracks[point].add_element(i + 1, slot)
    for xyz, track in zip(points.double().numpy(), tracks, strict=True):
        if track.length() >= 2:
            model.point3D(model.add_point3D(xyz, track)).error = _NOISE_PX
    with completed_folder(folder) as partial_folder:
        (partial_folder / "sparse" / "0").mkdir(parents=True)
        model.write_binary(str(partial_folder / "sparse" / "0"))
        (partial_folder / "images").symlink_to((flight / PHOTOGRAPHS).resolve(), target_is_directory=True)


def planned_flight(plan: LargeFlight) -> tuple[Cameras, Float64[np.ndarray, "V 3"], list[str], Callable[[], TidalFlat]]:
    """Plan a flight: cameras, errors of their stated positions, names, and what makes the flat, to be called once."""
    random = np.random.default_rng([plan.seed, 20270])
    settings = settings_for(plan.category, random)
    cameras = fly(plan.flight, plan.strips * plan.each, plan.width, random, plan.strips)
    error = random.normal(0, plan.gps_m, cameras.position_world.shape) * [1, 1, 2]
    digits = max(4, len(str(len(cameras))))
    names = [f"{plan.category}_{i + 1:0{digits}d}.jpg" for i in range(len(cameras))]

    def make() -> TidalFlat:
        task = partial(make_flat, plan.flight.date(settings, random), _extent(cameras, plan.flight), random)
        [flat] = in_parallel([task], "cpu")
        return flat

    return cameras, error, names, make


def _refuse_other(plan: LargeFlight, folder: Path) -> None:
    if not folder.exists():
        return
    there = read_json(folder / TRUTH_FILE) if folder.is_dir() else None
    if there is None and (not folder.is_dir() or any(folder.iterdir())):
        raise SceneError(f"{folder} holds something else: expected a new folder, or one of a flight; name another")
    if there is not None and there.get("plan") != asdict(plan):
        raise SceneError(f"{folder} holds another flight: expected a new folder, or the same options; name another")


def _extent(cameras: Cameras, flight: Flight) -> Extent:
    """The ground in all photographs, with nodes so far apart that there are not too many."""
    fine = ground_extent(cameras, flight)
    cell = fine.cell_m * max(1.0, math.sqrt(fine.columns * fine.rows / _MOST_NODES))
    corner = [fine.west_m, fine.south_m], [fine.east_m, fine.north_m]
    return Extent.around(*corner, max(fine.cell_m, min(cell, LARGEST_CELL_M)))


def _write(
    flat: TidalFlat,
    camera: Cameras,
    plan: LargeFlight,
    file: Path,
    place: Float64[np.ndarray, "3"],
    seconds: float,
    number: int,
) -> None:
    colour, _ = flat.photograph(camera, plan.supersample, seconds)
    time = _START + timedelta(seconds=_SECONDS * number)
    pixels = (colour * 255).round().to(torch.uint8).numpy()
    with completed_file(file) as partial_file, partial_file.open("wb") as stream:
        Image.fromarray(pixels).save(stream, "JPEG", quality=95, exif=_exif(camera, place, time).tobytes())


def _exif(camera: Cameras, longitude_latitude_height: Float64[np.ndarray, "3"], time: datetime) -> Image.Exif:
    """Metadata as drones write them: camera, time, focal length and position."""
    longitude, latitude, height = longitude_latitude_height.tolist()
    diagonal_px = math.hypot(camera.width, camera.height)
    equivalent_mm = float(camera.focal_px[0, 0]) / diagonal_px * _FULL_FRAME_DIAGONAL_MM
    table = Image.Exif()
    table[Base.Make], table[Base.Model] = "Tidefield", "built-in"
    own: dict[int, Any] = table.get_ifd(IFD.Exif)
    own[Base.DateTimeOriginal] = f"{time:%Y:%m:%d %H:%M:%S}"
    # EXIF has whole millimetres only; the sensor is that of a full frame.
    own[Base.FocalLength] = round(equivalent_mm, 4)
    own[Base.FocalPlaneXResolution] = camera.width / (_FULL_FRAME_DIAGONAL_MM * camera.width / diagonal_px)
    own[Base.FocalPlaneYResolution] = own[Base.FocalPlaneXResolution]
    own[Base.FocalPlaneResolutionUnit] = 4  # millimetres
    here: dict[int, Any] = table.get_ifd(IFD.GPSInfo)
    for tag, value, signs in ((GPS.GPSLatitude, latitude, "NS"), (GPS.GPSLongitude, longitude, "EW")):
        degrees, rest = divmod(abs(value), 1)
        minutes, rest = divmod(rest * 60, 1)
        here[tag - 1], here[tag] = signs[value < 0], (degrees, minutes, round(rest * 60, 6))
    here[GPS.GPSAltitudeRef], here[GPS.GPSAltitude] = bytes([height < 0]), abs(round(height, 3))
    return table


def true_positions(folder: Path) -> dict[str, tuple[float, float, float]]:
    """Read longitude, latitude and height (WGS 84, degrees and metres) of each photograph of a flight.

    Raises:
        SceneError: the folder holds no flight.
    """
    about = read_json(folder / TRUTH_FILE)
    if about is None:
        raise SceneError(f"{folder} has no {TRUTH_FILE}: expected a flight of `python -m benchmarks flight`")
    return {name: (x, y, z) for name, (x, y, z) in about["longitude_latitude_height"].items()}
