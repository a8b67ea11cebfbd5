"""Positions of photographs: read them from gps.csv tables and ODM's geo.txt, and drop those that cannot be right."""

from __future__ import annotations

import csv
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64
from pyproj import Transformer

from tidefield.errors import SurveyError, list_names
from tidefield.geometry.geodesy import EARTH_RADIUS_M, WGS84, metres_per_degree, parse_crs
from tidefield.survey.io.text_files import PhotographNames, find_file, read_crs, read_text
from tidefield.survey.survey import Photograph, Position

GPS_FILES = ("geo.txt", "gps.csv")
"""Looked for in the folder of the photographs, in this order."""

# Column titles of tables of receivers, Pix4D and Metashape, in lower case, without units and punctuation.
_COLUMNS = {
    "name": ("name", "imagename", "image", "filename", "file", "photo", "photograph", "label", "sourcefile"),
    "latitude": ("latitude", "lat", "y", "gpslatitude", "latitudedeg"),
    "longitude": ("longitude", "lon", "lng", "long", "x", "gpslongitude", "longitudedeg"),
    "height": ("height", "altitude", "alt", "elevation", "ele", "z", "h", "gpsheight", "gpsaltitude", "gpsalt"),
    "horizontal": ("accuracyhorizontal", "horizontalaccuracy", "hacc", "accuracyxy", "xyaccuracy", "sigmaxy", "stdxy"),
    "vertical": ("accuracyvertical", "verticalaccuracy", "vacc", "accuracyz", "zaccuracy", "sigmaz", "stdz"),
}
_REQUIRED = ("name", "latitude", "longitude")
_EXPECTED_TABLE = (
    "expected a header such as image_name,lat,lon,gps_height and one line per photograph, in degrees (WGS 84) and "
    "metres, separated by commas, semicolons or tabs"
)
# geo.txt after the name: x y [z [yaw pitch roll [horizontal accuracy, vertical accuracy]]]
# (https://github.com/OpenDroneMap/docs/blob/publish/source/geo.rst)
_GEO_ANGLES, _GEO_ACCURACIES = 3, 6
# A position this far from the median of the others is wrong: no single flight is so long.
_FAR_M = 10_000.0
_FAR_TIMES_MEDIAN = 20.0
# A larger share of distant photographs is a second site, not an error of the receiver.
_MAX_OUTLIERS = 0.1


@dataclass(frozen=True)
class GpsRecord:
    """Position and attitude of one photograph from a file.

    Attributes:
        position: of the camera.
        gimbal_deg: yaw, pitch (-90 looks straight down) and roll of the camera, or None.
    """

    position: Position
    gimbal_deg: tuple[float, float, float] | None = None


def locate_photographs(
    folder: Path, photographs: Sequence[Photograph], gps: Path | None
) -> tuple[list[Photograph], list[str]]:
    """Combine the positions of EXIF with those of a file, and drop those that cannot be right.

    Args:
        folder: of the photographs; where EXIF positions are missing, one of `GPS_FILES` in it is read.
        photographs: with their positions from EXIF.
        gps: a file of positions, which has priority over EXIF and over the files in the folder.

    Returns:
        The photographs in their order, and remarks on what was dropped and what is missing.

    Raises:
        SurveyError: a file of positions cannot be parsed.
    """
    located, remarks = drop_impossible(photographs)
    file = gps
    if file is None and any(photograph.position is None for photograph in located):
        file = find_file(folder, GPS_FILES)
    if file is not None:
        records = read_gps_file(file, PhotographNames(photograph.name for photograph in photographs))
        for index, photograph in enumerate(located):
            record = records.get(photograph.name)
            if record and (gps or photograph.position is None):
                gimbal = photograph.gimbal_deg or record.gimbal_deg
                located[index] = replace(photograph, position=record.position, gimbal_deg=gimbal)
        located, impossible_in_file = drop_impossible(located)
        remarks += impossible_in_file
    located, outliers = drop_outliers(located)
    remarks += outliers
    without = [photograph.name for photograph in located if photograph.position is None]
    if without:
        remarks.append(f"{len(without)} of {len(located)} photographs have no position: {list_names(without)}.")
    return located, remarks


def read_gps_file(path: Path, names: PhotographNames) -> dict[str, GpsRecord]:
    """Read positions of photographs from a file; lines for other photographs are skipped.

    Args:
        path: a table of positions, or ODM's geo.txt, which begins with a coordinate reference system.
        names: index of the photographs.

    Returns:
        Records by name of the photograph.

    Raises:
        SurveyError: the file is neither, a line of it cannot be parsed, or it names none of the photographs.
    """
    lines = read_text(path).splitlines()
    header = next((row for row, line in enumerate(lines) if all(name in _columns(line)[0] for name in _REQUIRED)), None)
    if header is None and path.suffix.casefold() == ".csv":
        start = next((line.strip() for line in lines if line.strip()), "nothing")
        raise SurveyError(f"{path} begins with {start[:80]!r}: {_EXPECTED_TABLE}; write one")
    found = _read_geo(path, lines, names) if header is None else _read_table(path, lines, header, names)
    if not found:
        raise SurveyError(
            f"{path} names none of the photographs: expected their file names, with or without suffix; correct them, "
            "or remove the file"
        )
    return found


def _columns(header: str) -> tuple[dict[str, int], str]:
    """Column of a table by its meaning, and the separator of the columns."""
    separator = max(",;\t", key=header.count)
    found: dict[str, int] = {}
    for index, title in enumerate(header.split(separator)):
        # Metashape has "X/Longitude"; units are in brackets.
        parts = re.sub(r"[\[(].*?[\])]", "", title.casefold()).split("/")
        plain = [re.sub(r"[^a-z]", "", part) for part in parts]
        meaning = next((key for key, titles in _COLUMNS.items() if any(part in titles for part in plain)), None)
        if meaning is not None:
            found.setdefault(meaning, index)
    return found, separator


def _read_table(path: Path, lines: Sequence[str], header: int, names: PhotographNames) -> dict[str, GpsRecord]:
    columns, separator = _columns(lines[header])
    found: dict[str, GpsRecord] = {}
    rows = csv.reader(lines[header + 1 :], delimiter=separator, skipinitialspace=True)
    for row in rows:
        if not any(cell.strip() for cell in row) or row[0].startswith("#"):
            continue
        cells = {key: row[index].strip() if index < len(row) else "" for key, index in columns.items()}
        name = names.find(cells["name"])
        if name is None:
            continue
        where = f"{path}, line {header + 1 + rows.line_num}"
        # A table separated by semicolons may have decimal commas.
        numbers = {key: _number(cell.replace(",", "."), where) for key, cell in cells.items() if key != "name"}
        degrees = numbers["latitude"], numbers["longitude"]
        if not all(map(math.isfinite, degrees)):
            continue
        if max(map(abs, degrees)) > 360:
            raise SurveyError(
                f"{where} gives {degrees}: {_EXPECTED_TABLE}; metres belong under the EPSG code of a geo.txt"
            )
        height, horizontal, vertical = (numbers.get(key, math.nan) for key in ("height", "horizontal", "vertical"))
        position = Position(*degrees, height, *_positive(horizontal, vertical), "unknown", path.name)
        _add(found, name, GpsRecord(position), where)
    return found


def _read_geo(path: Path, lines: Sequence[str], names: PhotographNames) -> dict[str, GpsRecord]:
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    crs = read_crs(first, str(path))
    datum = _datum(crs)
    read: list[tuple[str, str, list[float]]] = []
    for number, line in enumerate(lines, start=1):
        where = f"{path}, line {number}"
        if line == first or not line.strip() or line.startswith("#"):
            continue
        name, rest = names.split(line.strip())
        if name is None:
            continue
        values = [float(cell) for cell in takewhile(_is_number, rest[: _GEO_ACCURACIES + 2])]
        if len(values) < 2 or not all(map(math.isfinite, values[:2])):
            raise SurveyError(f"{where} is {line.strip()[:80]!r}: expected image_name x y [z]; correct it")
        read.append((name, where, values))
    if not read:
        return {}
    degrees = _to_wgs84(crs, np.array([values[:2] for _, _, values in read]))
    found: dict[str, GpsRecord] = {}
    for (name, where, values), (longitude, latitude) in zip(read, degrees.tolist(), strict=True):
        if not math.isfinite(latitude):
            raise SurveyError(f"{where} gives {values[:2]}: expected coordinates in {first.strip()!r}; correct either")
        height = values[2] if len(values) > 2 else math.nan
        gimbal = None
        if len(values) >= _GEO_ACCURACIES and any(values[_GEO_ANGLES:_GEO_ACCURACIES]):
            yaw, pitch, roll = values[_GEO_ANGLES:_GEO_ACCURACIES]
            gimbal = yaw, pitch - 90.0, roll  # ODM counts the pitch from straight down
        accuracies = values[_GEO_ACCURACIES:] if len(values) == _GEO_ACCURACIES + 2 else [math.nan, math.nan]
        position = Position(latitude, longitude, height, *_positive(*accuracies), datum, path.name)
        _add(found, name, GpsRecord(position, gimbal), where)
    return found


def _to_wgs84(crs: str, xy: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
    """Longitude and latitude in degrees of (easting, northing) or (longitude, latitude); infinite where undefined."""
    system = parse_crs(crs)
    horizontal = system.sub_crs_list[0] if system.is_compound else system.to_2d()
    return np.column_stack(Transformer.from_crs(horizontal, WGS84, always_xy=True).transform(*xy.T))


def _add(found: dict[str, GpsRecord], name: str, record: GpsRecord, where: str) -> None:
    if name in found and found[name] != record:
        raise SurveyError(f"{where} gives {name} a second position: expected one line per photograph; remove one")
    found[name] = record


def _datum(crs: str) -> Literal["mean sea level", "ellipsoid", "unknown"]:
    system = parse_crs(crs)
    if system.is_compound:
        return "mean sea level"
    return "ellipsoid" if len(system.axis_info) == 3 else "unknown"


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _number(cell: str, where: str) -> float:
    """A number; NaN for an empty cell."""
    try:
        return float(cell) if cell else math.nan
    except ValueError as error:
        raise SurveyError(f"{where} has {cell[:40]!r}: expected a number; correct it") from error


def _positive(horizontal_m: float, vertical_m: float) -> tuple[float, float]:
    return horizontal_m if horizontal_m > 0 else math.nan, vertical_m if vertical_m > 0 else math.nan


def impossible(position: Position) -> str | None:
    """Check a position by itself: the reason why it cannot be right, or None."""
    latitude, longitude = position.latitude_deg, position.longitude_deg
    if not (np.isfinite(latitude) and np.isfinite(longitude)):
        return "it is not a number"
    # One of the two alone may be zero: on the equator, and in Greenwich.
    if max(abs(latitude), abs(longitude)) < 1e-3:
        return "it is zero: the receiver had no fix"
    if abs(latitude) > 90 and abs(longitude) <= 90:
        return "its latitude is beyond the poles: latitude and longitude are swapped"
    if abs(latitude) > 90 or abs(longitude) > 180:
        return "it is outside of the range of coordinates"
    return None


def drop_impossible(photographs: Iterable[Photograph]) -> tuple[list[Photograph], list[str]]:
    """Remove impossible positions from photographs, with a remark for each kind of error."""
    kept, dropped = [], defaultdict(list)
    for photograph in photographs:
        position = photograph.position
        reason = impossible(position) if position else None
        if position and reason:
            dropped[f"from {position.source} is left out, because {reason}"].append(photograph)
        kept.append(replace(photograph, position=None) if reason else photograph)
    return kept, [_remark(those, what) for what, those in dropped.items()]


def drop_outliers(photographs: Sequence[Photograph]) -> tuple[list[Photograph], list[str]]:
    """Remove positions that are far from all others, with remarks.

    Far is 10 km from the median, or 20 times the median distance to it. Where more than a tenth of the photographs
    (and more than two) are far, they are a second site and keep their positions.
    """
    located = [photograph for photograph in photographs if photograph.position is not None]
    if len(located) < 3:
        return list(photographs), []
    xyz_m = np.concatenate([_geocentric_m(photograph.position) for photograph in located if photograph.position])
    middle = np.median(xyz_m, axis=0)
    away_m = np.linalg.norm(xyz_m - middle, axis=1)
    limit_m = max(_FAR_M, _FAR_TIMES_MEDIAN * float(np.median(away_m)))
    far = [index for index, distance in enumerate(away_m) if distance > limit_m]
    if len(far) > max(2, _MAX_OUTLIERS * len(located)):
        names = list_names([located[index].name for index in far])
        return list(photographs), [
            f"{len(far)} of the {len(located)} positions lie {away_m[far].min() / 1000:.0f} km and more from the "
            f"others ({names}): these may be two sites."
        ]
    remarks = []
    for index in far:
        photograph = located[index]
        assert photograph.position is not None
        away_km = away_m[index] / 1000
        what = f"from {photograph.position.source} is left out, because it is {away_km:.0f} km from the others"
        if np.linalg.norm(_geocentric_m(_swapped(photograph.position))[0] - middle) < limit_m:
            what += ": latitude and longitude are swapped"
        remarks.append(_remark([photograph], what))
    outliers = {located[index].name for index in far}
    return [replace(p, position=None) if p.name in outliers else p for p in photographs], remarks


def metres_around(positions: Sequence[Position]) -> Float64[np.ndarray, "N 2"]:
    """East and north of the median position, in metres; on a sphere, exact to some per cent over tens of kilometres."""
    degrees = np.array([(position.longitude_deg, position.latitude_deg) for position in positions]).reshape(-1, 2)
    east = (degrees[:, 0] - degrees[:1, 0] + 180) % 360 - 180  # continuous across the date line
    metres = np.column_stack([east, degrees[:, 1]]) * metres_per_degree(float(np.median(degrees[:, 1])))
    return metres - np.median(metres, axis=0)


def _swapped(position: Position) -> Position:
    return replace(position, latitude_deg=position.longitude_deg, longitude_deg=position.latitude_deg)


def _geocentric_m(position: Position) -> Float64[np.ndarray, "1 3"]:
    """Geocentric coordinates on a sphere, for approximate distances that are continuous across the date line."""
    latitude, longitude = np.deg2rad([position.latitude_deg, position.longitude_deg])
    around = np.cos(latitude) * np.array([np.cos(longitude), np.sin(longitude)])
    return EARTH_RADIUS_M * np.array([[*around, np.sin(latitude)]])


def _remark(photographs: Sequence[Photograph], what: str) -> str:
    position = photographs[0].position
    assert position is not None
    example = f"latitude {position.latitude_deg:.6g}, longitude {position.longitude_deg:.6g}"
    return f"The position of {list_names([p.name for p in photographs])} ({example}) {what}."
