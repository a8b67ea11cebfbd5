"""Statistics of differences: robust deviations, significance, and the colours' range."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32
from scipy.special import ndtr

Z95 = 1.959963984540054
"""A normal error is larger than this many of its deviations in 5% of cases."""
_NMAD = 1.4826
"""Deviation of a normal distribution over its median absolute deviation."""


def nmad(values: Float[np.ndarray, " N"]) -> float:
    """Robust deviation: 1.4826 times the median absolute deviation from the median (Hoehle and Hoehle 2009)."""
    return _NMAD * float(np.median(np.abs(values - np.median(values))))


def colour_limit(sizes: Float[np.ndarray, " N"], detection_m: float) -> float:
    """Size of change at the ends of a map's colours, metres: all but the largest 1%, and errors are pale.

    Args:
        sizes: of change, metres.
        detection_m: the usual level of detection.
    """
    return max(float(np.quantile(sizes, 0.99)) if len(sizes) else 0.0, 2 * detection_m)


def deviation95(values: Float[np.ndarray, " N"]) -> float:
    """The deviation that makes 5% of values significant: the 95% quantile of their size over 1.96.

    Equal to the standard deviation where errors are normal, larger where they have long tails.
    """
    return float(np.quantile(np.abs(values), 0.95)) / Z95


def p_values(z: Float32[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Two-sided p-values of normal deviates."""
    return (2 * ndtr(-np.abs(z))).astype(np.float32)
