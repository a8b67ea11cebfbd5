"""Gaussian means where not all cells have a value."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Shaped


def smoothed(
    values: Shaped[np.ndarray, "rows columns *bands"],
    known: Bool[np.ndarray, "rows columns"],
    sigma_cells: float,
    least: float = 1e-3,
) -> Float32[np.ndarray, "rows columns *bands"]:
    """Compute Gaussian means of the cells that have a value, at all cells.

    Args:
        values: of two bands or more, or of one without an axis for it.
        known: cells whose value counts.
        sigma_cells: standard deviation of the window.
        least: sum of weights below which means fade to 0, far from all values.
    """
    weight = np.maximum(cv2.GaussianBlur(known.astype(np.float32), (0, 0), sigma_cells), np.float32(least))
    if values.ndim == 3:
        known, weight = known[..., None], weight[..., None]
    return cv2.GaussianBlur(np.where(known, values, 0).astype(np.float32), (0, 0), sigma_cells) / weight
