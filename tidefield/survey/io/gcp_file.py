"""Read ground control points (GCPs) and their marks in photographs from ODM's gcp_list.txt, and check their location.

The file begins with a coordinate reference system; then each line is `x y z px py image [point]`, separated by spaces
or tabs (https://docs.opendronemap.org/gcp/). Pixels count from the top left corner of the image as stored,
before the EXIF orientation is applied, with the first pixel's centre at (0.5, 0.5), as in the tools for marking.
Points whose names begin with CHK are check points: no model is fitted to them, and maps are compared with them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from pyproj import CRS, Geod
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError, ProjError

from tidefield.errors import SurveyError, list_names
from tidefield.files import write_text
from tidefield.geometry.geodesy import WGS84, horizontal, metres_per_degree, near_longitude, parse_crs, transformer
from tidefield.survey.io.image_decoding import upright_size, upright_uv
from tidefield.survey.io.positions import degrees_of, radius_m
from tidefield.survey.io.text_files import PhotographNames, leading_numbers, read_list, unit_remarks
from tidefield.survey.survey import CHECK_FILE, Control, Mark, Photograph

CONTROL_FILES = ("gcp_list.txt",)
"""Looked for in the folder of the photographs."""

MAX_DISTANCE_M = 3_000.0
"""Control points farther away belong to another survey: shifts between datums and flights are smaller."""

_EXPECTED_LINE = "expected `x y z px py image [point]`"
_SAME_POINT_M = 0.001  # largest difference between two positions of one point, by rounding when a list is printed
_MAX_OUTSIDE = 0.5  # share of the marks; more means that the photographs were resized
_FITTING_M = 1_000.0
_MAX_SUGGESTIONS = 4


def read_control(path: Path, photographs: Sequence[Photograph]) -> tuple[Control, list[str]]:
    """Read a ground control file.

    Left out are marks in photographs that are missing, marks outside of their photograph, and points without marks.

    Returns:
        The ground control, and remarks on what was left out and is doubtful.

    Raises:
        SurveyError: a line cannot be parsed, the coordinate reference system is unknown or puts the points far from the
            photographs, a point has two positions, or none of the photographs exists.
    """
    crs, lines = read_list(path)
    if not lines:
        raise SurveyError(f"{path} has no ground control points: {_EXPECTED_LINE} after its first line; add them")
    system = parse_crs(crs)
    across = _SAME_POINT_M / (metres_per_degree(0.0)[1] if system.is_geographic else 1.0)
    by_name = {photograph.name: photograph for photograph in photographs}
    names = PhotographNames(by_name)
    first_lines: dict[str, tuple[str, tuple[float, ...]]] = {}
    unnamed = 0
    points: dict[str, tuple[float, float, float]] = {}
    marks: dict[tuple[str, str], Mark] = {}
    found, missing, outside = 0, {}, []
    entries = []
    for where, line in lines:
        numbers, rest = _parse_line(where, line)
        name, words = names.split(rest)
        if name is None:
            image, words = split_unknown(rest)
            missing[image] = None
        entries.append((where, numbers, name, words[0].strip() if words else None))
    # One surveyed point under two names would be its own check.
    of_place: dict[tuple[float, ...], str] = {}
    for _, (*xyz, _, _), _, point in entries:
        if point is not None:
            of_place.setdefault(tuple(xyz), point)
    same: dict[str, str] = {}
    for where, (x, y, z, u, v), name, point in entries:
        if point is None and (x, y, z) not in of_place:
            unnamed += 1
        point = point or of_place.setdefault((x, y, z), f"point {unnamed}")
        first_where, first = first_lines.setdefault(point, (where, (x, y, z)))
        if (np.abs(np.subtract(first, (x, y, z))) > (across, across, _SAME_POINT_M)).any():
            raise SurveyError(
                f"{where} puts the point {point} at {(x, y, z)}, {first_where.rpartition(', ')[2]} at {first}: "
                "expected one position per point; correct one, or give them different names"
            )
        if (first_name := of_place[x, y, z]) != point:
            same[point], point = first_name, first_name
        if name is None:
            continue
        found += 1
        points.setdefault(point, (x, y, z))
        orientation = by_name[name].orientation
        width, height = upright_size(by_name[name].width, by_name[name].height, orientation)  # as stored
        if not (0 <= u <= width and 0 <= v <= height):
            outside.append(f"the mark of {point} at ({u:g}, {v:g}) is outside of {name} ({width} x {height} pixels)")
            continue
        mark = Mark(point, name, upright_uv((u, v), width, height, orientation))
        if marks.setdefault((point, name), mark) != mark:
            raise SurveyError(
                f"{where} marks {point} in {name} a second time, at another pixel: expected one mark of a point "
                "per photograph; remove one"
            )
    if not found:
        raise SurveyError(
            f"{path} marks points in {len(missing)} photographs ({list_names(list(missing))}), none of which exists: "
            "expected names of this survey's photographs; correct them, or give the control file of this survey"
        )
    if len(outside) > _MAX_OUTSIDE * found:
        raise SurveyError(
            f"{path}: {len(outside)} of {found} marks are outside of their photographs (first, {outside[0]}): "
            "expected pixels of these files; if the photographs were resized, scale the marks by the same factor"
        )
    marked = {point for point, _ in marks}
    control = Control(crs, {name: xyz for name, xyz in points.items() if name in marked}, tuple(marks.values()))
    degrees = degrees_of(photographs)
    if np.isfinite(degrees).any():
        longitude, latitude = np.nanmedian(degrees, axis=0).tolist()
        refuse_elsewhere(control, longitude, latitude, radius_m(degrees, (longitude, latitude)))
    xyz = np.array(list(control.points.values()), dtype=np.float64).reshape(-1, 3)
    nowhere = np.isinf(_degrees(system, xyz[:, 0], xyz[:, 1])).any(axis=1)
    if nowhere.any():
        point = list(control.points)[int(nowhere.argmax())]
        x, y, _ = control.points[point]
        raise SurveyError(
            f"{first_lines[point][0]} puts the point {point} at ({x:.10g}, {y:.10g}), which is nowhere in "
            f"{system.name}: expected coordinates of this system, easting or longitude first; correct them"
        )
    remarks = unit_remarks(path, system)
    remarks += [
        f"{path.name}: {one} has the coordinates of {other}, and is taken for it." for one, other in same.items()
    ]
    if missing:
        remarks.append(
            f"{path.name} marks points in photographs that are not among the survey's (left out): "
            f"{list_names(list(missing))}."
        )
    return control, remarks + [f"{path.name}: {reason} and is left out." for reason in outside]


def write_check_points(control: Control | None, folder: Path) -> None:
    """Write the check points of a control file into a scene's folder, for maps; without any, none stays there.

    Raises:
        RunError: the folder cannot be written to.
    """
    path = folder / CHECK_FILE
    checks = control and control.checks()
    if checks is None:
        path.unlink(missing_ok=True)
        return
    lines = [
        "\t".join([*(repr(value) for value in (*checks.points[m.point], *m.uv_px)), m.photograph, m.point])
        for m in checks.marks
    ]
    write_text(path, "\n".join([checks.crs, *lines]) + "\n")


def _parse_line(where: str, line: str) -> tuple[list[float], str]:
    """The five numbers of a line, and the names of its image and point."""
    *cells, rest = line.split(maxsplit=5)
    numbers = leading_numbers(cells)
    if len(numbers) != 5 or not all(map(math.isfinite, numbers)):
        raise SurveyError(f"{where} is {line[:80]!r}: {_EXPECTED_LINE}; correct it")
    return numbers, rest


def split_unknown(rest: str) -> tuple[str, list[str]]:
    """Split the name, which may have spaces, of a photograph that the survey lacks from the words behind it."""
    if "\t" in rest:
        return rest.split("\t")[0], rest.split("\t")[1:]
    words = rest.split()
    end = next((i for i, word in enumerate(words) if "." in word[1:]), 0)
    return " ".join(words[: end + 1]), words[end + 1 :]


def refuse_elsewhere(control: Control, longitude_deg: float, latitude_deg: float, radius_m: float = 0.0) -> None:
    """Refuse ground control that is far from the photographs, and suggest the systems in which it would not be.

    Args:
        control: the ground control.
        longitude_deg, latitude_deg: median position of the photographs; the longitude may be beyond 180.
        radius_m: how far the photographs reach from there.

    Raises:
        SurveyError: the median control point is `MAX_DISTANCE_M` or more away from all photographs.
    """
    points = np.array(list(control.points.values()), dtype=np.float64)
    x, y = np.median(points[:, 0]), np.median(points[:, 1])
    longitude_deg = float(near_longitude(longitude_deg, 0.0))
    site = longitude_deg, latitude_deg
    away = _distance_m(parse_crs(control.crs), x, y, site)
    if away < MAX_DISTANCE_M + radius_m:
        return
    where = f"{away / 1000:,.0f} km from" if np.isfinite(away) else "nowhere near"
    correct = "correct the control file"
    if found := _fitting(control.crs, x, y, site):
        advice = f"they would fit in {' or '.join(found)}"
    elif mistake := _mirrored(control.crs, x, y, site, radius_m):
        advice = f"the photographs would be there if {mistake}"
        correct = "correct their positions, for example in a file for --gps"
    else:
        advice = "no system that is used at this site fits them"
    raise SurveyError(
        f"the {len(points)} points of ground control, about ({x:.1f}, {y:.1f}) in {parse_crs(control.crs).name}, lie "
        f"{where} the photographs (longitude {longitude_deg:.5f}, latitude {latitude_deg:.5f}): expected the same "
        f"site; {advice}; {correct}"
    )


def _mirrored(crs: str, x: float, y: float, site: tuple[float, float], radius_m: float) -> str | None:
    """The mistake in the photographs' positions without which they would be where the coordinates are."""
    longitude, latitude = site
    mistakes = {
        "the sign of their longitudes were the other": (-longitude, latitude),
        "the sign of their latitudes were the other": (longitude, -latitude),
        "the signs of their longitudes and latitudes were the other": (-longitude, -latitude),
    }
    if abs(longitude) <= 90:
        mistakes["their latitudes and longitudes were exchanged"] = (latitude, longitude)
    away = {mistake: _distance_m(parse_crs(crs), x, y, place) for mistake, place in mistakes.items()}
    nearest = min(away, key=lambda mistake: away[mistake])
    return nearest if away[nearest] < MAX_DISTANCE_M + radius_m else None


def _fitting(crs: str, x: float, y: float, site: tuple[float, float]) -> list[str]:
    """Names of the systems, of those in use at a site and WGS 84, in which the coordinates are at it.

    Zones of several datums lie a few hundred metres apart: those of WGS 84 and ETRS89, which receivers use, come first.
    Nobody uses WGS 72 any more.
    """
    area = AreaOfInterest(*site, *site)
    used = query_crs_info(auth_name="EPSG", pj_types=PJType.PROJECTED_CRS, area_of_interest=area, contains=True)
    # Systems with northing first are duplicates here, because x is always easting.
    systems = {
        f"EPSG:{i.code} ({i.name})": f"EPSG:{i.code}" for i in used if not ("(N-E)" in i.name or "WGS 72" in i.name)
    }
    systems[f"{WGS84} (longitude and latitude)"] = WGS84
    if f"EPSG:{parse_crs(crs).to_epsg()}" not in systems.values():
        systems[parse_crs(crs).name] = crs
    for first, second, order in ((x, y, ""), (y, x, ", with the two coordinates swapped")):
        away = {
            name + order: _distance_m(CRS.from_user_input(text), first, second, site) for name, text in systems.items()
        }
        rank = {
            name: (round(metres / 1000), not ("WGS 84" in name or "ETRS89" in name), metres)
            for name, metres in away.items()
            if metres < _FITTING_M
        }
        if rank:
            return sorted(rank, key=rank.__getitem__)[:_MAX_SUGGESTIONS]
    return []


def _distance_m(crs: CRS, x: float, y: float, site: tuple[float, float]) -> float:
    """Metres on the ellipsoid; infinite where the coordinates are outside of the system's domain."""
    longitude, latitude = _degrees(crs, np.array([x]), np.array([y]))[0].tolist()
    if math.isinf(longitude):
        return math.inf
    return abs(Geod(ellps="WGS84").inv(*site, longitude, latitude)[2])


def _degrees(crs: CRS, x: Float64[np.ndarray, " N"], y: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, "N 2"]:
    """Longitudes and latitudes (WGS 84); infinite outside of the system's domain."""
    try:
        there = np.stack(transformer(horizontal(crs), parse_crs(WGS84)).transform(x, y), axis=1)
    except (ProjError, CRSError):
        return np.full((len(x), 2), math.inf)
    there[~(np.isfinite(there).all(axis=1) & (np.abs(there[:, 1]) <= 90))] = math.inf
    return there
