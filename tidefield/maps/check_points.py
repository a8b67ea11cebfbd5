"""Check points: surveyed points that took no part in placing a scene, and how well a map meets them.

Points whose names begin with CHK in ODM's gcp_list.txt are check points: `tidefield prepare` keeps them out of the
adjustment and writes them to the scene, as `check_points.txt`. Other files are given to `tidefield map --check`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from tidefield.data.georeference import Georeference
from tidefield.data.scene import Scene
from tidefield.errors import RunError, SurveyError, list_names
from tidefield.geometry.geodesy import parse_crs, vertical_datum_of
from tidefield.maps.grid import Grid, MapFrame
from tidefield.maps.rasters import sample
from tidefield.survey.io.gcp_file import split_unknown
from tidefield.survey.io.text_files import PhotographNames, leading_numbers, read_list
from tidefield.survey.survey import CHECK_FILE

log = logging.getLogger(__name__)

ENOUGH = 30
"""Fewest check points for a statement of accuracy (ASPRS, Positional Accuracy Standards, edition 2, 2023)."""
_ELLIPSOID = "ellipsoid"
_LEAST_DEG = 2.0
"""Angle between two rays from which on their intersection is a place: half a pixel is less than a few pixels then."""
_SAME_POINT_M = 0.02
"""Two points are not surveyed nearer to each other, and one that is rounded or converted is not farther off."""
_SAME_NAME_M = 1.0
"""One that has its name, too, is not farther off: some lists count from 1, whatever they are of."""
_EXPECTED = "expected `x y z name` or `x y z px py image [name]`"


@dataclass(frozen=True)
class CheckPoint:
    """A surveyed point.

    Attributes:
        name: of the point; a number where its file has none.
        surveyed: its easting, northing and height in the map's system.
        marks: where photographs show it: index, and pixel of the scene's photograph, without distortion. One for each
            of the photographs.
        named: its file has the name.
    """

    name: str
    surveyed: Float64[np.ndarray, "3"]
    marks: tuple[tuple[int, tuple[float, float]], ...]
    named: bool = True


@dataclass(frozen=True)
class Checked:
    """What a map has at a check point.

    Attributes:
        point: the check point.
        height: of the surface there; NaN outside of the map.
        sigma: its standard error.
        found: easting, northing and height of the intersection of its marks' rays; NaN with fewer than two marks.
    """

    point: CheckPoint
    height: float
    sigma: float
    found: Float64[np.ndarray, "3"]

    @property
    def error(self) -> Float64[np.ndarray, "3"]:
        """East and north of the photographs' marks, and the surface's height, minus the surveyed ones."""
        return np.append((self.found - self.point.surveyed)[:2], self.height - self.point.surveyed[2])


def all_check_points(
    scene: Scene, frame: MapFrame, given: Path | None, georeference: Georeference | None
) -> list[CheckPoint]:
    """Read the check points of the scene's own file and of the one that is given, each of them once.

    Args:
        georeference: of the scene, which knows the points that it was fitted to: these check nothing, whatever they are
            called.

    Raises:
        RunError: as `read_check_points`.
    """
    own = scene.root / CHECK_FILE
    found: list[CheckPoint] = []
    if own.is_file() and frame.frame is None:
        log.warning(
            f"{own.name} of the scene is not used: the scene is not georeferenced, so that nothing can be checked"
        )
    elif own.is_file():
        found = read_check_points(own, scene, frame)
    fitted, names = [], () if georeference is None else georeference.control.names
    control = np.empty((0, 3)) if georeference is None else georeference.control_world
    on_map = frame.to_map(control - frame.origin_world)[:, :2]
    limit = _SAME_POINT_M * np.array([frame.metre, frame.metre, frame.metre_up])
    for point in [] if given is None else read_check_points(given, scene, frame):
        away_m = np.linalg.norm(on_map - point.surveyed[:2], axis=1) / frame.metre
        own = [k for k, name in enumerate(names) if point.named and name == point.name]
        # Earlier versions wrote names without places.
        is_own = bool(own) and (len(away_m) != len(names) or (away_m[own] < _SAME_NAME_M).any())
        if (away_m < _SAME_POINT_M).any() or is_own:
            fitted.append(point.name)
        elif not any((np.abs(point.surveyed - other.surveyed) < limit).all() for other in found):
            found.append(point)
    if fitted:
        log.warning(f"the scene was fitted to {list_names(fitted)}, which are left out: they check nothing")
    return found


def read_check_points(path: Path, scene: Scene, frame: MapFrame) -> list[CheckPoint]:
    """Read check points from a file: a coordinate system, then lines as in gcp_list.txt or `x y z name`.

    Raises:
        RunError: the scene has no coordinates, or the file cannot be read.
    """
    if frame.frame is None:
        raise RunError(
            f"{path} has check points, but the scene is not georeferenced: expected a scene with coordinates; leave "
            "the file out"
        )
    try:
        crs, lines = read_list(path)
        names = PhotographNames(scene.names)
        surveyed: dict[str, tuple[float, ...]] = {}
        unnamed: dict[tuple[float, ...], str] = {}
        marks: dict[str, dict[int, tuple[float, float]]] = {}
        for where, line in lines:
            cells = line.split()
            numbers = leading_numbers(cells[:3])
            if len(numbers) < 3 or not all(map(math.isfinite, numbers)) or len(cells) < 4:
                raise SurveyError(f"{where} is {line[:80]!r}: {_EXPECTED}; correct it")
            pixel = leading_numbers(cells[3:5])
            place, photograph, words = tuple(numbers), None, [" ".join(cells[3:])]
            if len(pixel) == 2 and len(cells) > 5:
                rest = line.split(maxsplit=5)[5]
                photograph, words = names.split(rest)
                if photograph is None:  # one that the scene does not have still marks a point
                    _, words = split_unknown(rest)
            point = words[0].strip() if words else unnamed.setdefault(place, f"point {len(unnamed) + 1}")
            if surveyed.setdefault(point, place) != place:
                raise SurveyError(
                    f"{where} puts the point {point} at {place}, another line at {surveyed[point]}: expected one "
                    "position per point; correct one, or give them different names"
                )
            own = marks.setdefault(point, {})
            if photograph is not None:
                mark = pixel[0], pixel[1]
                if own.setdefault(scene.names.index(photograph), mark) != mark:
                    raise SurveyError(
                        f"{where} marks {point} in {photograph} a second time, at another pixel: expected one mark of "
                        "a point per photograph; remove one"
                    )
        if not surveyed:
            raise SurveyError(f"{path} has no check points: {_EXPECTED} after its first line; add them")
        _require_one_datum(path, crs, frame)
        xyz = np.array(list(surveyed.values()), dtype=np.float64)
        world = frame.frame.from_system(crs, xyz)
    except (SurveyError, ValueError) as error:
        raise RunError(f"{path} cannot be read as check points: {error}") from error
    there = frame.to_map(world - frame.origin_world)
    nameless, points = set(unnamed.values()), []
    for name, at in zip(surveyed, there, strict=True):
        shown = [_undistorted(scene, index, uv) for index, uv in marks[name].items()]
        shown = tuple(mark for mark in shown if all(map(math.isfinite, mark[1])))  # undistorting crops photographs
        points.append(CheckPoint(name, at, shown, name not in nameless))
    return points


def _require_one_datum(path: Path, crs: str, frame: MapFrame) -> None:
    """Raises: SurveyError when a file states heights over another vertical datum than the map's."""
    datum, own = vertical_datum_of(parse_crs(crs)), vertical_datum_of(parse_crs(frame.wkt))
    if datum is None:
        return
    if own is None and _ELLIPSOID in frame.heights:
        own = datum if _ELLIPSOID in datum else frame.heights  # of whichever name
    if own is None:
        log.warning(
            f"heights in {path.name} are over {datum}, those of the map: {frame.heights}; the mean error has both"
        )
    elif datum != own:
        raise SurveyError(
            f"its heights are over {datum}, those of the map over {own}: expected one vertical datum; convert the "
            "points first"
        )


def _undistorted(scene: Scene, index: int, uv_px: tuple[float, float]) -> tuple[int, tuple[float, float]]:
    """A mark in the scene's photograph, which is undistorted and may have another size; NaN outside of it."""
    camera, lens = scene.cameras[index], scene.photographs.files[index].lens
    u, v = lens.to_pinhole(np.array([uv_px], dtype=np.float64), lens.pinhole())[0]
    return index, (float(u) * camera.width / lens.width, float(v) * camera.height / lens.height)


def check(
    points: Sequence[CheckPoint],
    scene: Scene,
    grid: Grid,
    dsm: Path,
    sigma: Path,
) -> list[Checked]:
    """Compare a map with check points.

    Args:
        points: the check points.
        scene: whose cameras show their marks.
        grid: of the map.
        dsm, sigma: rasters of its heights and their standard errors.
    """
    place = np.array([point.surveyed[:2] for point in points])
    values = sample([dsm, sigma], place, grid)
    result = []
    for point, (height, error) in zip(points, values, strict=True):
        found = _intersected(point, scene, grid.frame)
        result.append(Checked(point, float(height), float(error), found))
    return result


def _intersected(point: CheckPoint, scene: Scene, frame: MapFrame) -> Float64[np.ndarray, "3"]:
    """Intersect the rays of a point's marks by least distance in pixels; NaN where no two are `_LEAST_DEG` apart."""
    import torch

    if len(point.marks) < 2:
        return np.full(3, np.nan)
    index = [i for i, _ in point.marks]
    cameras = scene.cameras[index]
    uv = torch.tensor([[xy] for _, xy in point.marks]).float()
    ray = cameras.directions_world(uv)[:, 0].double().numpy()
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    if np.degrees(np.arccos((ray @ ray.T).clip(-1, 1).min())) < _LEAST_DEG:
        return np.full(3, np.nan)
    position = cameras.position_world.double().numpy()
    across = np.eye(3) - ray[:, :, None] * ray[:, None]
    weight = (cameras.focal_px.mean(1).double().numpy()) ** 2
    place = np.zeros(3)
    for _ in range(5):  # distances from rays count as angles
        distance = np.linalg.norm(position - place, axis=1)
        scaled = across * (weight / distance**2)[:, None, None]
        place = np.linalg.solve(scaled.sum(0), (scaled @ position[:, :, None]).sum(0)[:, 0])
    return frame.to_map(place[None])[0]


def summary(checked: Sequence[Checked]) -> dict[str, Any]:
    """Statistics of check points, and each of them: RMSE, mean, NMAD and number, horizontal and vertical."""
    error = np.array([one.error for one in checked]).reshape(-1, 3)
    up, plan = error[np.isfinite(error[:, 2]), 2], error[np.isfinite(error[:, :2]).all(1), :2]
    sigma = np.array([one.sigma for one in checked])[np.isfinite(error[:, 2])]
    return {
        "vertical": {
            **_statistics(up),
            "within_1_96_sigma": float((abs(up) < 1.96 * sigma).mean()) if len(up) else None,
        },
        "east": _statistics(plan[:, 0]),
        "north": _statistics(plan[:, 1]),
        "horizontal_rmse": float(np.sqrt((plan**2).sum(1).mean())) if len(plan) else None,
        "remark": remark(len(up)),
        "each": [
            {
                "name": one.point.name,
                "surveyed": one.point.surveyed.tolist(),
                "east": _finite(one.error[0]),
                "north": _finite(one.error[1]),
                "up": _finite(one.error[2]),
                "sigma": _finite(one.sigma),
                "marks": len(one.point.marks),
            }
            for one in checked
        ],
    }


def remark(count: int) -> str:
    """What a number of check points can show."""
    if count >= ENOUGH:
        return f"{count} check points"
    return f"{count} check points: indicative, under ASPRS' {ENOUGH}"


def _statistics(error: Float64[np.ndarray, " N"]) -> dict[str, Any]:
    if not len(error):
        return {"n": 0, "rmse": None, "mean": None, "nmad": None}
    return {
        "n": len(error),
        "rmse": float(np.sqrt((error**2).mean())),
        "mean": float(error.mean()),
        "nmad": float(1.4826 * np.median(np.abs(error - np.median(error)))),
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
