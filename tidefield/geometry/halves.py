"""Halve a set of points until its parts are small: blocks of a survey, areas of a scene."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64


def halves(points: Float64[np.ndarray, "N D"], most: int) -> list[list[int]]:
    """Halve a set of points across its longest side until no part has more than `most`."""

    def parts(members: np.ndarray) -> list[list[int]]:
        if len(members) <= most:
            return [members.tolist()]
        along = points[members, int(np.argmax(np.ptp(points[members], axis=0)))]
        order = members[np.argsort(along, kind="stable")]
        return [*parts(order[: len(order) // 2]), *parts(order[len(order) // 2 :])]

    return parts(np.arange(len(points)))
