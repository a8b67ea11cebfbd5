"""Where the cameras were, as their receivers say, for the photographs that a model has."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tidefield.data.georeference import LeftOut
from tidefield.geometry.geodesy import WGS84, LocalFrame
from tidefield.survey.io.positions import impossible
from tidefield.survey.survey import Photograph, Position

_DATUMS = {
    "mean sea level": "mean sea level, as the receivers know it",
    "ellipsoid": "the WGS 84 ellipsoid",
    "unknown": "unknown; heights are as the receivers gave them",
}


@dataclass(frozen=True)
class GivenPositions:
    """Positions of photographs.

    Attributes:
        names: of the photographs.
        longitude_latitude_height: WGS 84, degrees and metres.
        stated_m: standard deviations (horizontal, vertical) that the receivers state, NaN where they state none.
        vertical_datum: what the heights count from, in words.
        left_out: positions that say nothing.
    """

    names: tuple[str, ...]
    longitude_latitude_height: Float64[np.ndarray, "N 3"]
    stated_m: Float64[np.ndarray, "N 2"]
    vertical_datum: str
    left_out: tuple[LeftOut, ...]

    @property
    def middle(self) -> tuple[float, float]:
        """Longitude and latitude that half of them lie on each side of."""
        longitude, latitude, _ = np.median(self.longitude_latitude_height, axis=0)
        return float(longitude), float(latitude)

    def frame(self) -> LocalFrame:
        """Local metres around them, in their UTM zone, with heights as given."""
        return LocalFrame.at(WGS84, (*self.middle, 0.0), self.vertical_datum)


def given_positions(photographs: Sequence[Photograph]) -> GivenPositions:
    """The positions of those photographs that have one which can be true."""
    told: list[tuple[Photograph, Position]] = []
    left_out = []
    for photograph in photographs:
        if photograph.position is None:
            continue
        reason = impossible(photograph.position)
        if reason is None:
            told.append((photograph, photograph.position))
        else:
            left_out.append(LeftOut("GPS", photograph.name, reason))
    told, heights, datum = _with_heights(told)
    rows = [(position.longitude_deg, position.latitude_deg) for _, position in told]
    stated = [(position.horizontal_m, position.vertical_m) for _, position in told]
    places = np.array(rows, dtype=np.float64).reshape(-1, 2)
    if len(places):  # all on one side of the date line
        places[:, 0] = (places[:, 0] - places[0, 0] + 180) % 360 - 180 + places[0, 0]
    return GivenPositions(
        names=tuple(each.name for each, _ in told),
        longitude_latitude_height=np.column_stack([places, np.array(heights, dtype=np.float64)]),
        stated_m=np.array(stated, dtype=np.float64).reshape(-1, 2),
        vertical_datum=datum,
        left_out=tuple(left_out),
    )


def _with_heights(
    told: list[tuple[Photograph, Position]],
) -> tuple[list[tuple[Photograph, Position]], list[float], str]:
    """Those with heights, and what these count from: as given; else above take-off; else all level, as surveys fly."""
    absolute = [(each, position) for each, position in told if math.isfinite(position.height_m)]
    if len(absolute) >= 3:
        datum = Counter(position.datum for _, position in absolute).most_common(1)[0][0]
        return absolute, [position.height_m for _, position in absolute], _DATUMS[datum]
    relative = [(each, position) for each, position in told if math.isfinite(each.relative_altitude_m)]
    if len(relative) >= 3:
        return relative, [each.relative_altitude_m for each, _ in relative], "the place of take-off"
    return told, [0.0] * len(told), "the mean height of flight, since the photographs have no heights"
