"""Ground control: surveyed points and where photographs show them, from ODM's gcp_list.txt.

The file begins with a coordinate reference system; then each line is `x y z px py image [point]`, separated by spaces
or tabs (https://docs.opendronemap.org/gcp/). Pixels count from the top left corner of the picture as its file stores
it, before EXIF's orientation is applied, with the first pixel's centre at (0.5, 0.5), as tools for marking have it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tidefield.errors import SurveyError, list_names
from tidefield.geometry.geodesy import metres_per_degree, parse_crs
from tidefield.survey.io.crs import read_crs
from tidefield.survey.io.gps_files import split_name
from tidefield.survey.io.names import Names, read_text
from tidefield.survey.io.pictures import upright_size, upright_uv
from tidefield.survey.io.which_crs import refuse_elsewhere
from tidefield.survey.survey import Control, Mark, Photograph

CONTROL_FILES = ("gcp_list.txt",)
"""Found beside the photographs by themselves."""

_EXPECTED_LINE = "expected `x y z px py image [point]`"
_SAME_POINT_M = 0.001
_OUTSIDE_AT_MOST = 0.5


@dataclass(frozen=True)
class _Line:
    """One mark: of a point at `xyz` at the stored picture's pixel `uv_px`; `rest` names the picture and the point."""

    where: str
    xyz: tuple[float, float, float]
    uv_px: tuple[float, float]
    rest: str


def read_control(path: Path, photographs: Sequence[Photograph]) -> tuple[Control, list[str]]:
    """Ground control, and remarks on what of it was left out.

    Marks in photographs that are not there, or outside of them, are left out; points that no mark is left of, too.

    Raises:
        SurveyError: a line cannot be read, the coordinate reference system is unknown or puts the points far from the
            photographs, a point has two places, or none of the photographs is there.
    """
    text = read_text(path)
    header = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    crs = read_crs(header, str(path))
    lines = list(_lines(path, text, header))
    if not lines:
        raise SurveyError(f"{path} has no ground control points: {_EXPECTED_LINE} after its first line; add them")
    by_name = {photograph.name: photograph for photograph in photographs}
    named, missing = _in_photographs(path, lines, Names(by_name), _same_place(crs))
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
        remarks.append(f"{path.name} marks points in photographs that are not there (left out): {list_names(missing)}.")
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
                raise ValueError("no number")
        except ValueError as error:
            raise SurveyError(f"{where} is {line.strip()[:80]!r}: {_EXPECTED_LINE}; correct it") from error
        yield _Line(where, (x, y, z), (u, v), rest)


def _same_place(crs: str) -> tuple[float, float, float]:
    """How much two places of one point may differ: what is lost when a list is printed."""
    across = _SAME_POINT_M / (metres_per_degree(0.0)[1] if parse_crs(crs).is_geographic else 1.0)
    return across, across, _SAME_POINT_M


def _in_photographs(
    path: Path, lines: Sequence[_Line], names: Names, tolerance: tuple[float, float, float]
) -> tuple[list[tuple[str, str, _Line]], list[str]]:
    """Point, photograph and line of every mark whose photograph is there, and the names of those that are not."""
    places: dict[str, _Line] = {}
    unnamed: dict[tuple[float, float, float], str] = {}
    found, missing = [], {}
    for line in lines:
        photograph, rest = split_name(line.rest, names)
        if photograph is None:
            image, rest = _unknown_name(line.rest)
            missing[image] = None
        point = rest[0].strip() if rest else unnamed.setdefault(line.xyz, f"point {len(unnamed) + 1}")
        first = places.setdefault(point, line)
        if (np.abs(np.subtract(first.xyz, line.xyz)) > tolerance).any():
            raise SurveyError(
                f"{line.where} puts the point {point} at {line.xyz}, {first.where.rpartition(', ')[2]} at {first.xyz}: "
                "expected one place per point; correct one, or give them different names"
            )
        if photograph is not None:
            found.append((point, photograph, line))
    if not found:
        raise SurveyError(
            f"{path} marks points in {len(missing)} photographs ({list_names(list(missing))}), none of which is there: "
            "expected names of this survey's photographs; correct them, or give the control file of this survey"
        )
    return found, list(missing)


def _unknown_name(rest: str) -> tuple[str, list[str]]:
    """The name, which may have spaces, of a picture that is not there, and what follows it."""
    if "\t" in rest:
        return rest.split("\t")[0], rest.split("\t")[1:]
    words = rest.split()
    end = next((i for i, word in enumerate(words) if "." in word[1:]), 0)
    return " ".join(words[: end + 1]), words[end + 1 :]


def _upright_marks(
    path: Path, named: Sequence[tuple[str, str, _Line]], by_name: dict[str, Photograph]
) -> tuple[list[Mark], list[str]]:
    """The marks in upright photographs, and what is wrong with those outside."""
    marks: dict[tuple[str, str], Mark] = {}
    outside: list[str] = []
    for point, name, line in named:
        photograph = by_name[name]
        width, height = upright_size(photograph.width, photograph.height, photograph.orientation)  # as it is stored
        u, v = line.uv_px
        if not (0 <= u <= width and 0 <= v <= height):
            outside.append(f"the mark of {point} at ({u:g}, {v:g}) is outside of {name} ({width} x {height} pixels)")
            continue
        mark = Mark(point, name, upright_uv(line.uv_px, width, height, photograph.orientation))
        if marks.setdefault((point, name), mark) != mark:
            raise SurveyError(
                f"{line.where} marks {point} in {name} a second time, at another place: expected one mark of a point "
                "in a photograph; take one away"
            )
    if len(outside) > _OUTSIDE_AT_MOST * len(named):
        raise SurveyError(
            f"{path}: {len(outside)} of {len(named)} marks are outside of their photographs (first, {outside[0]}): "
            "expected pixels of these files; if the photographs were reduced since, divide the marks by as much"
        )
    return list(marks.values()), outside
