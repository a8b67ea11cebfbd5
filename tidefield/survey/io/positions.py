"""Positions of photographs: read them from gps.csv tables and ODM's geo.txt, and drop those that cannot be right."""

from __future__ import annotations

import csv
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64
from pyproj import CRS

from tidefield.errors import SurveyError, list_names
from tidefield.geometry.geodesy import (
    EARTH_RADIUS_M,
    FOOT_M,
    US_SURVEY_FOOT_M,
    WGS84,
    horizontal,
    lost_in_conversion,
    metres_per_degree,
    metres_per_height,
    near_longitude,
    parse_crs,
    transformer,
)
from tidefield.survey.io.metadata import gimbal_of_body
from tidefield.survey.io.text_files import (
    PhotographNames,
    find_file,
    first_system,
    leading_numbers,
    names_a_system,
    read_lines,
    read_list,
    unit_remarks,
)
from tidefield.survey.survey import Photograph, Position, VerticalDatum

GPS_FILES = ("geo.txt", "gps.csv")
"""Looked for in the folder of the photographs, in this order."""

# Column titles of tables of receivers, Pix4D and Metashape, in lower case, without punctuation, and without units and
# vertical datums, in brackets or not.
_COLUMNS = {
    "name": ("name", "imagename", "image", "filename", "file", "photo", "photograph", "label", "sourcefile"),
    "latitude": ("latitude", "lat", "y", "gpslatitude", "latitudedeg"),
    "longitude": ("longitude", "lon", "lng", "long", "x", "gpslongitude", "longitudedeg"),
    "height": ("height", "altitude", "alt", "elevation", "ele", "z", "h", "gpsheight", "gpsaltitude", "gpsalt"),
    "horizontal": (
        *("accuracyhorizontal", "horizontalaccuracy", "horzaccuracy", "accuracyhorz", "hacc"),
        *("lateralrms", "horizontalrms"),
        *("accuracyxy", "xyaccuracy", "sigmaxy", "stdxy"),
    ),
    "vertical": (
        *("accuracyvertical", "verticalaccuracy", "vertaccuracy", "accuracyvert", "vacc"),
        *("elevationrms", "verticalrms"),
        *("accuracyz", "zaccuracy", "sigmaz", "stdz"),
    ),
    "yaw": ("yaw",),
    "pitch": ("pitch",),
    "roll": ("roll",),
}
_HEMISPHERES = {"latitude": {"N", "S", "NORTH", "SOUTH"}, "longitude": {"E", "W", "EAST", "WEST"}}
_LENGTHS = ("height", "horizontal", "vertical")
_ANGLES = ("yaw", "pitch", "roll")
_DATUMS: dict[str, VerticalDatum] = {
    **dict.fromkeys(("ellipsoid", "ellipsoidal", "ellips", "ell", "hae"), "ellipsoid"),
    **dict.fromkeys(("sea", "msl", "amsl", "orthometric", "navd", "egm"), "mean sea level"),
}
_BRACKETS = re.compile(r"[\[(](.*?)[\])]")
_METRES = ("m", "metre", "metres", "meter", "meters")
_UNITS_M = {"mm": 0.001, "cm": 0.01, **dict.fromkeys(("ft", "foot", "feet"), FOOT_M), **dict.fromkeys(_METRES, 1.0)}
# Words of a title beside that of the quantity. "Geoid" is none of them: the height of the geoid is another quantity.
_OF_DEGREES = ("deg", "degree", "degrees", "decimal", "dd")
_OF_LENGTHS = (*_DATUMS, *_UNITS_M, "us", "survey", "wgs", "above", "over", "mean", "level")
_BESIDE = {
    "name": ("name",),
    **dict.fromkeys(("latitude", "longitude", *_ANGLES), _OF_DEGREES),
    **dict.fromkeys(_LENGTHS, _OF_LENGTHS),
}
_OF_ACCURACIES = ("accuracy", "rms", "std", "stdev", "stde", "stdn", "stdu", "sigma", "sd", "error", "precision")
_MAX_TITLE = 100  # longer is no title; a search for units in megabytes of brackets would take hours
_REQUIRED = ("name", "latitude", "longitude")
_EXPECTED_TABLE = (
    "expected a header such as image_name,lat,lon,gps_height and one line per photograph, in degrees (WGS 84) and "
    "metres, separated by commas, semicolons or tabs"
)
# geo.txt after the name, of which two numbers must be there
# (https://github.com/OpenDroneMap/docs/blob/publish/source/geo.rst).
_GEO = ("longitude", "latitude", "height", *_ANGLES, "horizontal", "vertical")
# A position this far from the median of the others is wrong: no single flight is so long.
_FAR_M = 10_000.0
_FAR_TIMES_MEDIAN = 20.0
# A larger share of distant photographs is a second site, not an error of the receiver.
_MAX_OUTLIERS = 0.1


_Row: TypeAlias = tuple[str, str, list[float]]
"""A photograph, the place in the file for messages, and the numbers of `_GEO`, NaN where unknown."""


class _Contradiction(SurveyError):
    """A file that is one of this survey's positions gives a photograph two of them."""


@dataclass(frozen=True)
class GpsRecord:
    """Position of a photograph from a file, and the camera's yaw, pitch (-90 looks straight down) and roll, or None."""

    position: Position
    gimbal_deg: tuple[float, float, float] | None = None


def locate_photographs(
    folder: Path, photographs: Sequence[Photograph], gps: Path | None
) -> tuple[list[Photograph], list[str]]:
    """Combine the positions of EXIF with those of a file, and drop those that cannot be right.

    Args:
        folder: of the photographs; where EXIF positions are missing, one of `GPS_FILES` in it is read. If it cannot be
            parsed, it is only remarked.
        photographs: with their positions from EXIF.
        gps: a file of positions, which has priority over EXIF and over the files in the folder.

    Returns:
        The photographs in their order, and remarks on what was dropped and what is missing.

    Raises:
        SurveyError: the given file cannot be parsed, or any gives a photograph two positions.
    """
    located, remarks = _drop_impossible(photographs)
    file = gps
    if file is None and any(photograph.position is None for photograph in located):
        file = find_file(folder, GPS_FILES)
    if file is not None:
        try:
            records, about_file = read_gps_file(file, PhotographNames(photograph.name for photograph in photographs))
        except SurveyError as error:
            if gps or isinstance(error, _Contradiction):
                raise
            remark = f"The file of positions next to the photographs was not used: {error}."
            records, about_file = {}, [f"{remark} If it is no such file, rename it or move it away."]
        others = [p for p in located if p.position and p.name not in records]
        if gps and others:
            about_file.append(
                f"{file.name} has {len(records)} of {len(located)} photographs; {len(others)} others keep the "
                f"positions of EXIF ({list_names([photograph.name for photograph in others])})."
            )
        for index, photograph in enumerate(located):
            record = records.get(photograph.name)
            if record and (gps or photograph.position is None):
                position = _with_height(record.position, photograph.position)
                given = record.gimbal_deg if photograph.gimbal_deg is None else None
                located[index] = replace(
                    photograph,
                    position=position,
                    gimbal_deg=given or photograph.gimbal_deg,
                    gimbal_is_given=given is not None,
                )
        located, impossible_in_file = _drop_impossible(located)
        remarks += [*about_file, *impossible_in_file]
    elif unused := find_file(folder, GPS_FILES):
        remarks.append(
            f"{unused.name} is not used, because all photographs have positions in their EXIF: if its positions are "
            f"better, such as those of PPK, name it: --gps {unused.name}."
        )
    located, outliers = _drop_outliers(located)
    remarks += outliers
    without = [photograph.name for photograph in located if photograph.position is None]
    if without:
        remarks.append(f"{len(without)} of {len(located)} photographs have no position: {list_names(without)}.")
    return located, remarks


def _with_height(position: Position, own: Position | None) -> Position:
    """Complete a position without a height by that of the photograph's own, with its vertical datum and accuracy."""
    if own is None or math.isfinite(position.height_m) or not math.isfinite(own.height_m):
        return position
    height = {"height_m": own.height_m, "vertical_m": own.vertical_m, "datum": own.datum}
    return replace(position, **height, source=f"{own.source}, {position.source}")


def read_gps_file(path: Path, names: PhotographNames) -> tuple[dict[str, GpsRecord], list[str]]:
    """Read positions of photographs from a file; lines for other photographs are skipped.

    Args:
        path: a table of positions, or ODM's geo.txt, which begins with a coordinate reference system.
        names: index of the photographs.

    Returns:
        Records by name of the photograph, and remarks on what is doubtful.

    Raises:
        SurveyError: the file is neither, a line of it cannot be parsed, or it names none of the photographs.
    """
    lines = read_lines(path)
    system = first_system(lines)
    titles = (row for row, line in enumerate(lines) if all(name in _columns(line)[0] for name in _REQUIRED))
    header = next(titles, None)
    if system is not None and header is not None:
        # Titles in a geo.txt may be a comment. A table may name the system of its degrees above them, or have a title.
        is_comment = lines[header].startswith("#")
        if not is_comment and not names_a_system(lines):
            system = None
        elif is_comment or system.is_projected:
            header = None
    is_geo = system is not None and header is None
    if header is None and not is_geo and path.suffix.casefold() == ".csv":
        start = next((line.strip() for line in lines if line.strip()), "nothing")
        raise SurveyError(f"{path} begins with {start[:80]!r}: {_EXPECTED_TABLE}; write one")
    found, remarks = _read_geo(path, names) if header is None else _read_table(path, lines, header, names, system)
    if not found:
        rows = ", in rows separated by spaces or tabs" if header is None else ""
        raise SurveyError(
            f"{path} names none of the photographs: expected their file names, with or without suffix{rows}; correct "
            "them, or remove the file"
        )
    return found, remarks


def _columns(header: str) -> tuple[dict[str, tuple[int, float]], str]:
    """Column of a table by its meaning, with the length of its unit in metres, and the separator of the columns."""
    separator = max(",;\t", key=header.count)
    found: dict[str, tuple[int, float]] = {}
    letters: dict[str, tuple[int, float]] = {}  # x, y and z may be those of a grid, next to latitude and longitude
    for index, title in enumerate(header.casefold().split(separator)):
        title = title[:_MAX_TITLE]
        parts = [_words(part) for part in _BRACKETS.sub("", title).split("/")]  # Metashape has "X/Longitude"
        meaning = next((key for key in _COLUMNS if any(_means(part, key) for part in parts)), None)
        if meaning is not None:
            of = letters if max(len(word) for part in parts for word in part) == 1 else found
            of.setdefault(meaning, (index, _unit_m(title) if meaning in _LENGTHS else 1.0))
    return letters | found, separator


def _words(title: str) -> list[str]:
    return re.findall("[a-z]+", title.replace("us", " us "))  # of "usft" and "ftus", too


def _means(words: Sequence[str], key: str) -> bool:
    """Whether the words of a title name one of the `_COLUMNS`, with or without a unit and a vertical datum."""
    own = "".join(word for word in words if word not in _BESIDE[key])
    return "".join(words) in _COLUMNS[key] or own in _COLUMNS[key]


def _unit_m(title: str) -> float:
    """Length of the unit in a title; metres without one."""
    words = _words(title)
    unit_m = next((_UNITS_M[word] for word in words if word in _UNITS_M), 1.0)
    return US_SURVEY_FOOT_M if unit_m == FOOT_M and {"us", "survey"} & {*words} else unit_m


def _read_table(
    path: Path, lines: Sequence[str], header: int, names: PhotographNames, system: CRS | None
) -> tuple[dict[str, GpsRecord], list[str]]:
    columns, separator = _columns(lines[header])
    if system is None or separator != "\t":  # then it is no geo.txt, and its pitch may count from the horizon
        columns = {key: column for key, column in columns.items() if key not in _ANGLES}
    usual = parse_crs(WGS84)
    other = system is not None and not system.equals(usual, ignore_axis_order=True)
    system = system or usual
    remarks = [f"{path.name}: positions are in {system.name}, as its first line has it."] if other else []
    titles = [title.strip()[:_MAX_TITLE] for title in lines[header].split(separator)]
    above = _words(titles[columns["height"][0]].casefold()) if "height" in columns else []
    datums: list[VerticalDatum] = [*(_DATUMS[word] for word in above if word in _DATUMS), _datum(system)]
    height_unit_m = 1.0 if {*above} & {*_UNITS_M} else metres_per_height(system)
    found_rows: list[tuple[str, str, list[str]]] = []
    for number, row in _rows(path, lines, header, separator):
        if not any(cell.strip() for cell in row) or row[0].startswith("#"):
            continue
        row = [cell.strip() for cell in row] + [""] * (len(titles) - len(row))
        if name := names.find(row[columns["name"][0]]):
            found_rows.append((name, f"{path}, line {number}", row))
    rows = [row for _, _, row in found_rows]
    unread = sorted({*range(len(titles))} - {index for index, _ in columns.values()})
    hemispheres = _hemispheres(rows, unread)
    read: list[_Row] = []
    for name, where, row in found_rows:
        numbers = {}
        for key, (index, unit_m) in columns.items():
            if key == "name":
                continue
            # A table separated by semicolons may have decimal commas. An empty cell is unknown.
            number = leading_numbers([row[index].replace(",", ".") or "nan"])
            if not number:
                raise SurveyError(f"{where} has {row[index][:40]!r}: expected a number; correct it")
            numbers[key] = number[0] * unit_m
        for key, index in hemispheres.items():
            if row[index][:1].upper() in ("S", "W"):
                numbers[key] = -abs(numbers[key])
        degrees = numbers["latitude"], numbers["longitude"]
        if not all(map(math.isfinite, degrees)):
            continue
        if max(map(abs, degrees)) > 360:
            raise SurveyError(
                f"{where} gives {degrees}: {_EXPECTED_TABLE}; metres belong under the EPSG code of a geo.txt"
            )
        values = [numbers.get(key, math.nan) for key in _GEO]
        values[2] *= height_unit_m
        read.append((name, where, values))
    found = _records(path, read, system, datums[0])
    remarks += _conversion_remarks(path, system) if other else []
    numeric = [titles[index] for index in unread if _is_numeric(rows, index)]
    accuracies = [title for title in numeric if {*_words(title.casefold())} & {*_OF_ACCURACIES}]
    if accuracies and not {"horizontal", "vertical"} <= {*columns}:
        remarks.append(
            f"{path.name}: {list_names(accuracies)} are not read. Where they are standard deviations, call them "
            '"accuracy horizontal (m)" and "accuracy vertical (m)": positions of a differential receiver are used as '
            "such only with these."
        )
    if "height" in columns or not numeric:
        return found, remarks
    return found, [
        *remarks,
        f"{path.name} has no column of heights that is understood; its columns {list_names(numeric)} are not read. If "
        'one of them is the height, call it "height (m)".',
    ]


def _hemispheres(rows: Sequence[Sequence[str]], columns: Iterable[int]) -> dict[str, int]:
    """The first columns that have nothing but the hemispheres of latitudes and of longitudes, whatever their titles.

    A column of S alone may state something else, such as a fix.
    """
    found: dict[str, int] = {}
    for index in columns:
        cells = {row[index].upper() for row in rows} - {""}
        for key, names in _HEMISPHERES.items():
            if cells and cells <= names:
                found.setdefault(key, index)
    return found if len(found) == 2 else {}


def _is_numeric(rows: Sequence[Sequence[str]], index: int) -> bool:
    """Whether a column has numbers, and nothing else."""
    cells = [row[index].replace(",", ".") for row in rows]
    return any(cells) and all(leading_numbers([cell]) for cell in cells if cell)


def _rows(path: Path, lines: Sequence[str], header: int, separator: str) -> Iterator[tuple[int, list[str]]]:
    """Rows of a table below its header, each with the number of its last line."""
    rows = csv.reader(lines[header + 1 :], delimiter=separator, skipinitialspace=True)
    while True:
        start = header + 2 + rows.line_num
        try:
            row = next(rows, None)
        except csv.Error as error:
            raise SurveyError(
                f"{path}, line {start} cannot be read ({error}): expected quotation marks in pairs; correct the line"
            ) from error
        if row is None:
            return
        yield header + 1 + rows.line_num, row


def _read_geo(path: Path, names: PhotographNames) -> tuple[dict[str, GpsRecord], list[str]]:
    crs, lines = read_list(path)
    system = parse_crs(crs)
    read: list[_Row] = []
    for where, line in lines:
        name, rest = names.split(line)
        if name is None:
            continue
        values = leading_numbers(rest[: len(_GEO)])
        if len(values) < 2 or not all(map(math.isfinite, values[:2])):
            raise SurveyError(f"{where} is {line[:80]!r}: expected image_name x y [z]; correct it")
        values += [math.nan] * (len(_GEO) - len(values))
        values[2] *= metres_per_height(system)
        read.append((name, where, values))
    found = _records(path, read, system, _datum(system))
    has_heights = any(math.isfinite(record.position.height_m) for record in found.values())
    remarks = unit_remarks(path, system) if has_heights else []
    return found, [*remarks, *(_conversion_remarks(path, system) if found else [])]


def _conversion_remarks(path: Path, system: CRS) -> list[str]:
    lost = lost_in_conversion(system, CRS(WGS84))
    return [f"{path.name}: positions {lost}; or give longitude and latitude in WGS 84."] if lost else []


def _datum(system: CRS) -> VerticalDatum:
    return "mean sea level" if system.is_compound else "ellipsoid" if len(system.axis_info) == 3 else "unknown"


def _records(path: Path, read: Sequence[_Row], system: CRS, datum: VerticalDatum) -> dict[str, GpsRecord]:
    """Records by name of the photograph, of rows in a system, with heights in metres."""
    if not read:
        return {}
    to_degrees = transformer(horizontal(system), parse_crs(WGS84))
    degrees = np.column_stack(to_degrees.transform(*np.array([values[:2] for _, _, values in read]).T))
    given: dict[str, list[float]] = {}
    found: dict[str, GpsRecord] = {}
    for (name, where, values), (longitude, latitude) in zip(read, degrees.tolist(), strict=True):
        if not math.isfinite(latitude):
            raise SurveyError(f"{where} gives {values[:2]}: expected coordinates in {system.srs!r}; correct either")
        longitude = float(near_longitude(longitude, 0.0))
        if not np.array_equal(given.setdefault(name, values), values, equal_nan=True):
            raise _Contradiction(
                f"{where} gives {name} a second position: expected one line per photograph; remove one"
            )
        height, yaw, pitch, roll, across, up = values[2:]
        # ODM's angles are a body's; three zeros stand for angles that are not available.
        is_turned = math.isfinite(yaw + pitch + roll) and any((yaw, pitch, roll))
        gimbal = gimbal_of_body(yaw, pitch, roll) if is_turned else None
        position = Position(latitude, longitude, height, *_positive(across, up), datum, path.name)
        found[name] = GpsRecord(position, gimbal)
    return found


def radius_m(degrees: Float64[np.ndarray, "N 2"], middle: tuple[float, float]) -> float:
    """Distance from a place within which nine tenths of positions (longitude, latitude) are; others may be wrong."""
    apart_m = np.hypot(*((degrees - middle) * metres_per_degree(middle[1])).T)
    return float(np.nanquantile(apart_m, 0.9))


def _positive(horizontal_m: float, vertical_m: float) -> tuple[float, float]:
    return horizontal_m if horizontal_m > 0 else math.nan, vertical_m if vertical_m > 0 else math.nan


def _impossible(position: Position) -> str | None:
    """Check a position by itself: the reason why it cannot be right, or None."""
    latitude, longitude = position.latitude_deg, position.longitude_deg
    # One of the two alone may be zero: on the equator, and in Greenwich.
    if max(abs(latitude), abs(longitude)) < 1e-3:
        return "it is zero: the receiver had no fix"
    if abs(latitude) > 90 and abs(longitude) <= 90:
        return "its latitude is beyond the poles: latitude and longitude are swapped"
    if abs(latitude) > 90 or abs(longitude) > 180:
        return "it is outside of the range of coordinates"
    return None


def _drop_impossible(photographs: Iterable[Photograph]) -> tuple[list[Photograph], list[str]]:
    """Remove impossible positions from photographs, with a remark for each kind of error."""
    kept, dropped = [], defaultdict(list)
    for photograph in photographs:
        position = photograph.position
        reason = _impossible(position) if position else None
        if position and reason:
            dropped[f"from {position.source} is left out, because {reason}"].append(photograph)
        kept.append(replace(photograph, position=None) if reason else photograph)
    return kept, [_remark(those, what) for what, those in dropped.items()]


def _drop_outliers(photographs: Sequence[Photograph]) -> tuple[list[Photograph], list[str]]:
    """Remove positions that are far from all others, with remarks.

    Far is 10 km from the median, or 20 times the median distance to it. Where more than a tenth of the photographs
    (and more than two) are far, they are a second site and keep their positions.
    """
    degrees, kept, remarks = degrees_of(photographs), list(photographs), []
    located = np.flatnonzero(np.isfinite(degrees[:, 0]))
    if len(located) < 3:
        return kept, []
    xyz_m, swapped_m = _geocentric_m(degrees[located]), _geocentric_m(degrees[located][:, ::-1])
    middle = np.median(xyz_m, axis=0)
    away_m = np.linalg.norm(xyz_m - middle, axis=1)
    limit_m = max(_FAR_M, _FAR_TIMES_MEDIAN * float(np.median(away_m)))
    far = np.flatnonzero(away_m > limit_m)
    if len(far) > max(2, _MAX_OUTLIERS * len(located)):
        names = list_names([photographs[index].name for index in located[far]])
        return kept, [
            f"{len(far)} of the {len(located)} positions lie {away_m[far].min() / 1000:.0f} km and more from the "
            f"others ({names}): these may be two sites."
        ]
    for row, index in zip(far, located[far], strict=True):
        position = photographs[index].position
        assert position is not None
        what = f"from {position.source} is left out, because it is {away_m[row] / 1000:.0f} km from the others"
        if np.linalg.norm(swapped_m[row] - middle) < limit_m:
            what += ": latitude and longitude are swapped"
        remarks.append(_remark([photographs[index]], what))
        kept[index] = replace(photographs[index], position=None)
    return kept, remarks


def _remark(photographs: Sequence[Photograph], what: str) -> str:
    longitude, latitude = degrees_of(photographs[:1])[0]
    example = f"latitude {latitude:.6g}, longitude {longitude:.6g}"
    return f"The position of {list_names([p.name for p in photographs])} ({example}) {what}."


def positions_m(photographs: Sequence[Photograph]) -> Float64[np.ndarray, "V 2"]:
    """East and north of the median position, in metres; NaN where a position is unknown.

    On a sphere, exact to some per cent over tens of kilometres.
    """
    degrees = degrees_of(photographs)
    if np.isnan(degrees).all():
        return degrees
    metres = degrees * metres_per_degree(float(np.nanmedian(degrees[:, 1])))
    return metres - np.nanmedian(metres, axis=0)


def degrees_of(photographs: Sequence[Photograph]) -> Float64[np.ndarray, "V 2"]:
    """Longitude and latitude; NaN where a position is unknown.

    Longitudes continue across the date line, within 180 degrees of the first, so that they have a median.
    """
    positions = (photograph.position for photograph in photographs)
    degrees = np.array(
        [(p.longitude_deg, p.latitude_deg) if p else (math.nan, math.nan) for p in positions], dtype=np.float64
    ).reshape(-1, 2)
    known = degrees[np.isfinite(degrees[:, 0]), 0]
    if len(known):
        degrees[:, 0] = near_longitude(degrees[:, 0], known[0])
    return degrees


def _geocentric_m(degrees: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 3"]:
    """Geocentric coordinates on a sphere, for approximate distances that are continuous across the date line."""
    longitude, latitude = np.deg2rad(degrees).T
    around = np.cos(latitude)[:, None] * np.stack([np.cos(longitude), np.sin(longitude)], axis=1)
    return EARTH_RADIUS_M * np.column_stack([around, np.sin(latitude)])
