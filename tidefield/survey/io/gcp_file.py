"""Read ground control points (GCPs) and their marks in photographs from ODM's gcp_list.txt, and check their location.

The file begins with a coordinate reference system; then each line is `x y z px py image [point]`, separated by spaces
or tabs (https://docs.opendronemap.org/gcp/). Pixels count from the top left corner of the image as stored,
before the EXIF orientation is applied, with the first pixel's centre at (0.5, 0.5), as in the tools for marking.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS, Geod, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError, ProjError

from tidefield.errors import SurveyError, list_names
from tidefield.geometry.geodesy import WGS84, metres_per_degree, parse_crs
from tidefield.survey.io.image_decoding import upright_size, upright_uv
from tidefield.survey.io.text_files import PhotographNames, read_crs, read_text
from tidefield.survey.survey import Control, Mark, Photograph

CONTROL_FILES = ("gcp_list.txt",)
"""Looked for in the folder of the photographs."""

MAX_DISTANCE_M = 3_000.0
"""Control points farther away belong to another survey: shifts between datums and flights are smaller."""

_EXPECTED_LINE = "expected `x y z px py image [point]`"
_SAME_POINT_M = 0.001
_MAX_OUTSIDE = 0.5  # share of the marks; more means that the photographs were resized
_FITTING_M = 1_000.0
_MAX_SUGGESTIONS = 4


@dataclass(frozen=True)
class _Line:
    """One line: a point at `xyz`, at pixel `uv_px` of the stored image; `rest` holds the image and point names."""

    where: str
    xyz: tuple[float, float, float]
    uv_px: tuple[float, float]
    rest: str


def read_control(path: Path, photographs: Sequence[Photograph]) -> tuple[Control, list[str]]:
    """Read a ground control file.

    Left out are marks in photographs that are missing, marks outside of their photograph, and points without marks.

    Returns:
        The ground control, and remarks on what was left out.

    Raises:
        SurveyError: a line cannot be parsed, the coordinate reference system is unknown or puts the points far from the
            photographs, a point has two positions, or none of the photographs exists.
    """
    text = read_text(path)
    header = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    crs = read_crs(header, str(path))
    lines = list(_lines(path, text, header))
    if not lines:
        raise SurveyError(f"{path} has no ground control points: {_EXPECTED_LINE} after its first line; add them")
    by_name = {photograph.name: photograph for photograph in photographs}
    named, missing = _in_photographs(path, lines, PhotographNames(by_name), _tolerance(crs))
    marks, outside = _upright_marks(path, named, by_name)
    used = {mark.point for mark in marks}
    points: dict[str, tuple[float, float, float]] = {}
    for point, _, line in named:
        if point in used:
            points.setdefault(point, line.xyz)
    control = Control(crs, points, tuple(marks))
    positions = [photograph.position for photograph in photographs if photograph.position is not None]
    if positions:
        middle = np.median([(position.longitude_deg, position.latitude_deg) for position in positions], axis=0)
        refuse_elsewhere(control, *middle.tolist())
    remarks = []
    if missing:
        remarks.append(f"{path.name} marks points in photographs that do not exist (left out): {list_names(missing)}.")
    remarks += [f"{path.name}: {reason} and is left out." for reason in outside]
    return control, remarks


def _lines(path: Path, text: str, header: str) -> Iterator[_Line]:
    for number, line in enumerate(text.splitlines(), start=1):
        if line == header or not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{path}, line {number}"
        *cells, rest = line.strip().split(maxsplit=5)
        try:
            x, y, z, u, v = (float(cell) for cell in cells)
            if not all(map(math.isfinite, (x, y, z, u, v))):
                raise ValueError("not a number")
        except ValueError as error:
            raise SurveyError(f"{where} is {line.strip()[:80]!r}: {_EXPECTED_LINE}; correct it") from error
        yield _Line(where, (x, y, z), (u, v), rest)


def _tolerance(crs: str) -> tuple[float, float, float]:
    """Largest difference between two positions of one point, as left by rounding when a list is printed."""
    across = _SAME_POINT_M / (metres_per_degree(0.0)[1] if parse_crs(crs).is_geographic else 1.0)
    return across, across, _SAME_POINT_M


def _in_photographs(
    path: Path, lines: Sequence[_Line], names: PhotographNames, tolerance: tuple[float, float, float]
) -> tuple[list[tuple[str, str, _Line]], list[str]]:
    """Point, photograph and line of every mark whose photograph exists, and the names of missing photographs."""
    first_lines: dict[str, _Line] = {}
    unnamed: dict[tuple[float, float, float], str] = {}
    found, missing = [], {}
    for line in lines:
        photograph, rest = names.split(line.rest)
        if photograph is None:
            image, rest = _unknown_name(line.rest)
            missing[image] = None
        point = rest[0].strip() if rest else unnamed.setdefault(line.xyz, f"point {len(unnamed) + 1}")
        first = first_lines.setdefault(point, line)
        if (np.abs(np.subtract(first.xyz, line.xyz)) > tolerance).any():
            raise SurveyError(
                f"{line.where} puts the point {point} at {line.xyz}, {first.where.rpartition(', ')[2]} at {first.xyz}: "
                "expected one position per point; correct one, or give them different names"
            )
        if photograph is not None:
            found.append((point, photograph, line))
    if not found:
        raise SurveyError(
            f"{path} marks points in {len(missing)} photographs ({list_names(list(missing))}), none of which exists: "
            "expected names of this survey's photographs; correct them, or give the control file of this survey"
        )
    return found, list(missing)


def _unknown_name(rest: str) -> tuple[str, list[str]]:
    """Split off the name, which may have spaces, of an image that does not exist."""
    if "\t" in rest:
        return rest.split("\t")[0], rest.split("\t")[1:]
    words = rest.split()
    end = next((i for i, word in enumerate(words) if "." in word[1:]), 0)
    return " ".join(words[: end + 1]), words[end + 1 :]


def _upright_marks(
    path: Path, named: Sequence[tuple[str, str, _Line]], by_name: dict[str, Photograph]
) -> tuple[list[Mark], list[str]]:
    """Transform marks to upright photographs; the second list describes the marks outside of their photograph."""
    marks: dict[tuple[str, str], Mark] = {}
    outside: list[str] = []
    for point, name, line in named:
        photograph = by_name[name]
        width, height = upright_size(photograph.width, photograph.height, photograph.orientation)  # as stored
        u, v = line.uv_px
        if not (0 <= u <= width and 0 <= v <= height):
            outside.append(f"the mark of {point} at ({u:g}, {v:g}) is outside of {name} ({width} x {height} pixels)")
            continue
        mark = Mark(point, name, upright_uv(line.uv_px, width, height, photograph.orientation))
        if marks.setdefault((point, name), mark) != mark:
            raise SurveyError(
                f"{line.where} marks {point} in {name} a second time, at another pixel: expected one mark of a point "
                "per photograph; remove one"
            )
    if len(outside) > _MAX_OUTSIDE * len(named):
        raise SurveyError(
            f"{path}: {len(outside)} of {len(named)} marks are outside of their photographs (first, {outside[0]}): "
            "expected pixels of these files; if the photographs were resized, scale the marks by the same factor"
        )
    return list(marks.values()), outside


def refuse_elsewhere(control: Control, longitude_deg: float, latitude_deg: float) -> None:
    """Refuse ground control that is far from the photographs, and suggest the systems in which it would not be.

    Args:
        control: the ground control.
        longitude_deg, latitude_deg: median position of the photographs.

    Raises:
        SurveyError: the median control point is `MAX_DISTANCE_M` or more away.
    """
    points = np.array(list(control.points.values()), dtype=np.float64)
    x, y = np.median(points[:, 0]), np.median(points[:, 1])
    site = longitude_deg, latitude_deg
    away = _distance_m(parse_crs(control.crs), x, y, site)
    if away < MAX_DISTANCE_M:
        return
    name = parse_crs(control.crs).name
    found = _fitting(control.crs, x, y, site)
    advice = f"they would fit in {' or '.join(found)}" if found else "no system that is used at this site fits them"
    where = f"{away / 1000:,.0f} km from" if np.isfinite(away) else "nowhere near"
    raise SurveyError(
        f"the {len(points)} points of ground control, about ({x:.1f}, {y:.1f}) in {name}, lie {where} the photographs "
        f"(longitude {longitude_deg:.5f}, latitude {latitude_deg:.5f}): expected the same site; {advice}; correct the "
        "control file"
    )


def _fitting(crs: str, x: float, y: float, site: tuple[float, float]) -> list[str]:
    """Names of the systems, of those in use at a site and WGS 84, in which the coordinates are at it; nearest first."""
    area = AreaOfInterest(*site, *site)
    used = query_crs_info(auth_name="EPSG", pj_types=PJType.PROJECTED_CRS, area_of_interest=area, contains=True)
    # Systems with northing first are duplicates here, because x is always easting.
    systems = {f"EPSG:{i.code} ({i.name})": f"EPSG:{i.code}" for i in used if "(N-E)" not in i.name}
    systems[f"{WGS84} (longitude and latitude)"] = WGS84
    if f"EPSG:{parse_crs(crs).to_epsg()}" not in systems.values():
        systems[parse_crs(crs).name] = crs
    for first, second, order in ((x, y, ""), (y, x, ", with the two coordinates swapped")):
        away = {name + order: _distance_m(parse_crs(text), first, second, site) for name, text in systems.items()}
        near = sorted((name for name in away if away[name] < _FITTING_M), key=lambda name: away[name])
        if near:
            return near[:_MAX_SUGGESTIONS]
    return []


def _distance_m(crs: CRS, x: float, y: float, site: tuple[float, float]) -> float:
    """Metres on the ellipsoid; infinite where the coordinates are outside of the system's domain."""
    try:
        there = Transformer.from_crs(crs.to_2d(), WGS84, always_xy=True).transform(x, y, errcheck=True)
    except (ProjError, CRSError):
        return float("inf")
    if not np.isfinite(there).all() or abs(there[1]) > 90:
        return float("inf")
    return abs(Geod(ellps="WGS84").inv(*site, *there)[2])
