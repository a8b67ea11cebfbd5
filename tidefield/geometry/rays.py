"""Directions and optical axes: angles between them, and the point where axes meet."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from torch import Tensor

_PARALLEL = 0.02
"""Smallest eigenvalue of the mean projection across the axes (the mean squared sine of their angle to one direction)
below which they count as parallel: they lie within 8 degrees of it, and where they meet is ill-determined."""


def angle_between(first: Float[Tensor, "*#B 3"], second: Float[Tensor, "*#B 3"]) -> Float[Tensor, "*B"]:
    """Compute angles between unit vectors, radians.

    They are computed from the chord: the arc cosine of the dot product loses small angles to rounding.
    """
    return 2 * ((second - first).norm(dim=-1) / 2).clamp(max=1).asin()


def intersect_axes(
    position: Float64[np.ndarray, "V 3"], forward: Float64[np.ndarray, "V 3"]
) -> Float64[np.ndarray, " 3"] | None:
    """Find the least-squares point nearest to all optical axes; None where these are nearly parallel.

    Args:
        forward: unit vectors along the axes.
    """
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] <= _PARALLEL:
        return None
    return np.linalg.solve(across.sum(axis=0), (across @ position[:, :, None]).sum(axis=0))[:, 0]
