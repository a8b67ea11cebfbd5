"""Photographs taken away from the survey: on the way to it, at the place of take-off, or somewhere else."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from tidefield.survey.io.positions import metres_around
from tidefield.survey.survey import Photograph

APART = 6.0
"""As many times the median distance between neighbours is a gap in the survey."""
APART_IN_HEIGHTS = 3.0
"""Or as many flight heights, where these are known: about two footprints."""
FEW, FEW_AT_MOST = 0.05, 10
"""A larger share or number of photographs beyond a gap is a part of the survey."""
FEW_IN_ALL = 0.1
"""Where more than this lies beyond gaps, the survey has gaps."""
LOW = 0.35
"""Of the median height above take-off; lower photographs show the take-off or the landing."""
FEW_LOW = 0.1
"""A larger share of low photographs is a part of the survey."""

_SMALLEST_GAP_M = 20.0  # receivers wander while a drone hovers
_CELLS_IN_GAP = 8.0


def off_survey(photographs: Sequence[Photograph]) -> dict[int, str]:
    """Index and reason of each photograph that is far from the others or far below them."""
    return {**_beyond_a_gap(photographs), **_low(photographs)}


def _beyond_a_gap(photographs: Sequence[Photograph]) -> dict[int, str]:
    located = [(index, p.position) for index, p in enumerate(photographs) if p.position is not None]
    if len(located) < 4:
        return {}
    xy_m = metres_around([position for _, position in located])
    nearest_m = float(np.median(KDTree(xy_m).query(xy_m, 2)[0][:, 1]))
    height_m = _flight_height_m(photographs)
    gap_m = max(_SMALLEST_GAP_M, APART * nearest_m, APART_IN_HEIGHTS * height_m if height_m > 0 else 0.0)
    part = _parts(xy_m, gap_m)
    sizes = np.bincount(part)
    bulk = sizes.argmax()
    rest = KDTree(xy_m[part == bulk])
    small = sizes <= max(1.0, min(FEW_AT_MOST, FEW * len(located)))
    small[bulk] = False
    if sizes[small].sum() > max(1.0, FEW_IN_ALL * len(located)):
        return {}
    reasons = {}
    for (index, _), xy, own in zip(located, xy_m, part.tolist(), strict=True):
        if small[own]:
            away_m = float(rest.query(xy)[0])
            reasons[index] = (
                f"off the survey: it was taken {away_m:.0f} m from the nearest of the others; {gap_m:.0f} m is the "
                "limit."
            )
    return reasons


def _parts(xy_m: Float64[np.ndarray, "N 2"], gap_m: float) -> Int[np.ndarray, " N"]:
    """A number for each place, the same for places that steps shorter than a gap connect.

    Places are rounded to an eighth of the gap first, for thousands at one place would be millions of pairs.
    """
    cells, cell_of = np.unique(np.round(xy_m * (_CELLS_IN_GAP / gap_m)), axis=0, return_inverse=True)
    steps = KDTree(cells).query_pairs(_CELLS_IN_GAP, output_type="ndarray")
    graph = coo_array((np.ones(len(steps)), (steps[:, 0], steps[:, 1])), shape=(len(cells), len(cells)))
    _, part = connected_components(graph, directed=False)
    return part[cell_of.reshape(-1)]


def _flight_height_m(photographs: Sequence[Photograph]) -> float:
    heights = [p.relative_altitude_m for p in photographs if p.relative_altitude_m > 0]
    return float(np.median(heights)) if heights else math.nan


def _low(photographs: Sequence[Photograph]) -> dict[int, str]:
    usual_m = _flight_height_m(photographs)
    low = [index for index, p in enumerate(photographs) if p.relative_altitude_m < LOW * usual_m]
    if len(low) > max(1.0, FEW_LOW * len(photographs)):
        return {}
    return {
        index: (
            f"off the survey: it was taken {photographs[index].relative_altitude_m:.0f} m above the place of take-off, "
            f"the others at {usual_m:.0f} m; {LOW * usual_m:.0f} m is the limit."
        )
        for index in low
    }
