"""Where photographs were taken, from files beside them: gps.csv tables and ODM's geo.txt."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Literal

import numpy as np

from tidefield.errors import SurveyError
from tidefield.geometry.geodesy import parse_crs
from tidefield.survey.io.crs import read_crs, to_wgs84
from tidefield.survey.io.names import Names, read_text
from tidefield.survey.survey import Position

GPS_FILES = ("geo.txt", "gps.csv")
"""Found beside the photographs by themselves, in this order."""

# What tables of receivers, Pix4D and Metashape call their columns; lower case, without units and signs.
_COLUMNS = {
    "name": ("name", "imagename", "image", "filename", "file", "photo", "photograph", "label", "sourcefile"),
    "latitude": ("latitude", "lat", "y", "gpslatitude", "latitudedeg"),
    "longitude": ("longitude", "lon", "lng", "long", "x", "gpslongitude", "longitudedeg"),
    "height": ("height", "altitude", "alt", "elevation", "ele", "z", "h", "gpsheight", "gpsaltitude", "gpsalt"),
    "horizontal": ("accuracyhorizontal", "horizontalaccuracy", "hacc", "accuracyxy", "xyaccuracy", "sigmaxy", "stdxy"),
    "vertical": ("accuracyvertical", "verticalaccuracy", "vacc", "accuracyz", "zaccuracy", "sigmaz", "stdz"),
}
_NEEDED = ("name", "latitude", "longitude")
_EXPECTED_TABLE = (
    "expected a header such as image_name,lat,lon,gps_height and one line per photograph, in degrees (WGS 84) and "
    "metres, separated by commas, semicolons or tabs"
)
# geo.txt after the name: x y [z [yaw pitch roll [horizontal accuracy, vertical accuracy]]]
# (https://github.com/OpenDroneMap/docs/blob/publish/source/geo.rst)
_GEO_ANGLES, _GEO_ACCURACIES = 3, 6


@dataclass(frozen=True)
class Located:
    """What a file says of one photograph.

    Attributes:
        position: where it was taken.
        gimbal_deg: its yaw, pitch (-90 looks straight down) and roll, where the file has them.
    """

    position: Position
    gimbal_deg: tuple[float, float, float] | None = None


def read_gps_file(path: Path, names: Names) -> dict[str, Located]:
    """What a file says of the photographs that it names; lines for others are passed over.

    Args:
        path: a table of positions, or ODM's geo.txt, which begins with a coordinate reference system.
        names: the photographs.

    Raises:
        SurveyError: the file is neither, or a line of it cannot be read, or it names none of the photographs.
    """
    lines = read_text(path).splitlines()
    header = next((row for row, line in enumerate(lines) if all(name in _columns(line)[0] for name in _NEEDED)), None)
    if header is None and path.suffix.casefold() == ".csv":
        start = next((line.strip() for line in lines if line.strip()), "nothing")
        raise SurveyError(f"{path} begins with {start[:80]!r}: {_EXPECTED_TABLE}; write one")
    found = _read_geo(path, lines, names) if header is None else _read_table(path, lines, header, names)
    if not found:
        raise SurveyError(
            f"{path} names none of the photographs: expected their file names, with or without suffix; correct them, "
            "or take the file away"
        )
    return found


def _columns(header: str) -> tuple[dict[str, int], str]:
    """Which column of a table holds what, and what separates them."""
    separator = max(",;\t", key=header.count)
    found: dict[str, int] = {}
    for index, title in enumerate(header.split(separator)):
        # Metashape has "X/Longitude"; units stand in brackets.
        parts = re.sub(r"[\[(].*?[\])]", "", title.casefold()).split("/")
        plain = [re.sub(r"[^a-z]", "", part) for part in parts]
        meaning = next((key for key, known in _COLUMNS.items() if any(part in known for part in plain)), None)
        if meaning is not None:
            found.setdefault(meaning, index)
    return found, separator


def _read_table(path: Path, lines: Sequence[str], header: int, names: Names) -> dict[str, Located]:
    columns, separator = _columns(lines[header])
    found: dict[str, Located] = {}
    rows = csv.reader(lines[header + 1 :], delimiter=separator, skipinitialspace=True)
    for row in rows:
        if not any(cell.strip() for cell in row) or row[0].startswith("#"):
            continue
        cells = {key: row[index].strip() if index < len(row) else "" for key, index in columns.items()}
        name = names.find(cells["name"])
        if name is None:
            continue
        where = f"{path}, line {header + 1 + rows.line_num}"
        # A table between semicolons may have decimal commas.
        numbers = {key: _number(cell.replace(",", "."), where) for key, cell in cells.items() if key != "name"}
        place = numbers["latitude"], numbers["longitude"]
        if not all(map(math.isfinite, place)):
            continue
        if max(map(abs, place)) > 360:
            raise SurveyError(
                f"{where} says {place}: {_EXPECTED_TABLE}; metres belong under the EPSG code of a geo.txt"
            )
        height, horizontal, vertical = (numbers.get(key, math.nan) for key in ("height", "horizontal", "vertical"))
        position = Position(*place, height, *_positive(horizontal, vertical), "unknown", path.name)
        _add(found, name, Located(position), where)
    return found


def _read_geo(path: Path, lines: Sequence[str], names: Names) -> dict[str, Located]:
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    crs = read_crs(first, str(path))
    datum = _datum(crs)
    read: list[tuple[str, str, list[float]]] = []
    for number, line in enumerate(lines, start=1):
        where = f"{path}, line {number}"
        if line == first or not line.strip() or line.startswith("#"):
            continue
        name, rest = split_name(line.strip(), names)
        if name is None:
            continue
        values = [float(cell) for cell in takewhile(_is_number, rest[: _GEO_ACCURACIES + 2])]
        if len(values) < 2 or not all(map(math.isfinite, values[:2])):
            raise SurveyError(f"{where} is {line.strip()[:80]!r}: expected image_name x y [z]; correct it")
        read.append((name, where, values))
    if not read:
        return {}
    places = to_wgs84(crs, np.array([values[:2] for _, _, values in read]))
    found: dict[str, Located] = {}
    for (name, where, values), (longitude, latitude) in zip(read, places.tolist(), strict=True):
        if not math.isfinite(latitude):
            raise SurveyError(f"{where} says {values[:2]}: expected coordinates in {first.strip()!r}; correct either")
        height = values[2] if len(values) > 2 else math.nan
        gimbal = None
        if len(values) >= _GEO_ACCURACIES and any(values[_GEO_ANGLES:_GEO_ACCURACIES]):
            yaw, pitch, roll = values[_GEO_ANGLES:_GEO_ACCURACIES]
            gimbal = yaw, pitch - 90.0, roll  # ODM counts the pitch from straight down
        accuracies = values[_GEO_ACCURACIES:] if len(values) == _GEO_ACCURACIES + 2 else [math.nan, math.nan]
        position = Position(latitude, longitude, height, *_positive(*accuracies), datum, path.name)
        _add(found, name, Located(position, gimbal), where)
    return found


def split_name(line: str, names: Names) -> tuple[str | None, list[str]]:
    """A line of a text file that begins with a photograph's name, which may have spaces, and its further cells."""
    cells = line.split("\t") if "\t" in line else line.split()
    joint = "\t" if "\t" in line else " "
    for count in range(len(cells), 0, -1):
        name = names.find(joint.join(cells[:count]))
        if name is not None:
            return name, cells[count:]
    return None, cells[1:]


def _add(found: dict[str, Located], name: str, located: Located, where: str) -> None:
    if name in found and found[name] != located:
        raise SurveyError(f"{where} gives {name} a second position: expected one line per photograph; take one away")
    found[name] = located


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
