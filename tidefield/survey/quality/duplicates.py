"""Photographs that show what another shows from the same place: a drone that hovers, a file that was copied."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, Int8

from tidefield.survey.io.positions import metres_around
from tidefield.survey.quality.measures import agreement
from tidefield.survey.survey import Photograph

SHIFT = 0.03
"""Two pictures that are shifted less, in longer sides, have no base line to see heights by."""
AGREE = 0.6
"""Different pictures agree by 0.3 at most, those of a hovering drone by 0.6 and more, turned by three degrees even."""

_NEAR_M = 3.0  # or this part of the height of flight; receivers are no better
_NEAR_OF_HEIGHT = 0.05
_FAR_M = 20.0  # positions are not so wrong that farther photographs could be from one place
_IN_SEQUENCE = 3
_COARSE = 16, 12
_ALIKE = 0.5  # correlation of the coarse pictures that makes it worth looking


def duplicates(
    photographs: Sequence[Photograph], outlines: Sequence[Int8[np.ndarray, "_ _"] | None], sharpness: Sequence[float]
) -> dict[int, str]:
    """Index and reason of each photograph that a sharper one makes superfluous.

    Compared are photographs that were taken within 3 m (or 5% of the height of flight) of each other; and, if their
    positions are unknown or within 20 m, those that were taken within three of each other or look alike from afar.
    """
    outlines = [np.zeros((16, 16), np.int8) if outline is None else outline for outline in outlines]
    coarse = np.array([_coarse(outline) for outline in outlines], np.float32).reshape(-1, _COARSE[0] * _COARSE[1])
    order = sorted(range(len(photographs)), key=lambda i: (-(sharpness[i] if sharpness[i] > 0 else 0.0), i))
    by_time = sorted(range(len(photographs)), key=lambda i: (_time(photographs[i]), photographs[i].name))
    rank = np.argsort(np.array(by_time, dtype=np.int64))
    xy_m = np.full((len(photographs), 2), math.nan)
    located = [i for i, photograph in enumerate(photographs) if photograph.position is not None]
    if located:
        xy_m[located] = metres_around([p.position for p in photographs if p.position is not None])
    kept: list[int] = []
    reasons = {}
    for index in order:
        others = np.array(kept, dtype=np.int64)
        height_m = photographs[index].relative_altitude_m
        near_m = max(_NEAR_M, _NEAR_OF_HEIGHT * height_m if height_m > 0 else 0.0)
        away_m = np.linalg.norm(xy_m[others] - xy_m[index], axis=1)  # NaN where a position is unknown
        likely = (np.abs(rank[others] - rank[index]) <= _IN_SEQUENCE) | (coarse[others] @ coarse[index] > _ALIKE)
        close = (away_m < near_m) | (likely & ~(away_m > _FAR_M))
        twin = _twin(index, others[close].tolist(), outlines)
        if twin is None:
            kept.append(index)
        else:
            other, away, agree = twin
            reasons[index] = (
                f"duplicate: it shows what {photographs[other].name} shows, shifted by {away:.1%} of its longer side "
                f"(agreement {agree:.2f}); {SHIFT:.0%} (and {AGREE}) is the limit."
            )
    return reasons


def _twin(index: int, others: Sequence[int], outlines: Sequence[np.ndarray]) -> tuple[int, float, float] | None:
    for other in others:
        if outlines[other].shape == outlines[index].shape:
            away, agree = agreement(outlines[index], outlines[other])
            if away < SHIFT and agree > AGREE:
                return other, away, agree
    return None


def _coarse(outline: Int8[np.ndarray, "h w"]) -> Float32[np.ndarray, " 192"]:
    """A picture so small that a shift by a fiftieth does not matter, of unit length."""
    small = cv2.resize(outline.astype(np.float32), _COARSE, interpolation=cv2.INTER_AREA).ravel()
    small = small - small.mean()
    return small / max(float(np.linalg.norm(small)), 1e-6)  # a flat one is like none


def _time(photograph: Photograph) -> float:
    return photograph.time_s if math.isfinite(photograph.time_s) else 0.0
