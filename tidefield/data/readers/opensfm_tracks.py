"""`tracks.csv` of OpenSfM: in which photographs the points of a reconstruction were seen, and where.

A line has a photograph's name, a track's (a point's) name, a feature's number and a position, separated by tabs, and
then things that are not needed, of which later versions have more. The first line names the version; the oldest has
no such line.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int

from tidefield.data.readers.posed import bounded_lines
from tidefield.errors import SceneError

_MEGABYTES = 8_000
_HEADER = "OPENSFM_TRACKS_VERSION_v"
_COLUMNS = {"0": 8, "1": 9, "2": 11}


@dataclass(frozen=True)
class Tracks:
    """Observations in OpenSfM's coordinates.

    Attributes:
        photograph_index: for each observation, the photograph.
        point_index: for each observation, the point.
        xy: for each observation, where: from the photograph's middle, in units of its longer side.
    """

    photograph_index: Int[np.ndarray, " O"]
    point_index: Int[np.ndarray, " O"]
    xy: Float64[np.ndarray, "O 2"]


def read_tracks(file: Path, names: Sequence[str], points: Sequence[str]) -> Tracks:
    """The observations of these points in these photographs; a track that became no point has none.

    Raises:
        SceneError: when the file is not of a known version, or damaged.
    """
    photograph_of = {name: i for i, name in enumerate(names)}
    point_of = {name: i for i, name in enumerate(points)}
    photograph_index, point_index, xy = array("q"), array("q"), array("d")
    try:
        for photograph, point, _, x, y, *_ in _records(file):
            if photograph in photograph_of and point in point_of:
                photograph_index.append(photograph_of[photograph])
                point_index.append(point_of[point])
                xy.extend((float(x), float(y)))
    except ValueError as error:
        raise SceneError(
            f"{file} is damaged after {len(point_index)} observations ({error}): expected whole lines of OpenSfM's "
            "tracks; copy it again, or remove it to go on without observations"
        ) from error
    return Tracks(
        np.array(photograph_index, dtype=np.int64),
        np.array(point_index, dtype=np.int64),
        np.array(xy, dtype=np.float64).reshape(-1, 2),
    )


def _records(file: Path) -> Iterator[list[str]]:
    """The columns of each line; ValueError where their number is not the version's."""
    columns = _COLUMNS["0"]
    for number, line in enumerate(bounded_lines(file, _MEGABYTES)):
        if number == 0 and line.startswith(_HEADER):
            version = line.removeprefix(_HEADER).strip()
            if version not in _COLUMNS:
                raise SceneError(
                    f"{file} has the version {version!r} of OpenSfM's tracks: expected {', '.join(_COLUMNS)}; remove "
                    "the file to go on without observations"
                )
            columns = _COLUMNS[version]
            continue
        record = line.rstrip("\r\n").split("\t")
        if len(record) != columns:
            raise ValueError(f"a line has {len(record)} columns, not {columns}")
        yield record
