"""Outlines of change: regions whose mean over a small window is significant, and what choosing them by noise does.

A window of neighbouring cells averages what is independent between them, so that a change of a few centimetres is found
that no cell shows alone. Windows are tested with the false discovery rate held at 5% (Benjamini and Hochberg 1995): of
all outlined ground, at most that share is expected to be unchanged. Where nothing changed, nothing is outlined.

Outlines follow the noise at their edges: of two cells that changed alike, the one whose error points the same way is
in. The sum of dz in them is too large by

    sum_i E[e_i 1(s_i > t)] = sum_i Cov(e_i, s_i) f_i(t)

for normal errors (Stein 1981, doi 10.1214/aos/1176345632, for an indicator), with f_i the density of the window mean
s_i at the threshold t. The density is that of the means that were measured: their number close to the threshold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32
from scipy.ndimage import binary_dilation, find_objects, label, uniform_filter
from scipy.special import ndtr

from tidefield.change.errors import Variogram, centre_correlation, mean_correlation

FALSE_DISCOVERIES = 0.05
_WINDOW_LIMITS = (3, 15)
_BIN = 0.02
"""Of the histogram of |z|."""
_LARGEST_Z = 40.0
_NEAR_THRESHOLD = 0.3
"""Means are counted as close to the threshold within this many deviations."""
_STRIP = 512
_EIGHT = np.ones((3, 3), bool)


@dataclass(frozen=True)
class Outlines:
    """Regions of significant change.

    Attributes:
        labels: number of each cell's region, from 1; 0 outside.
        signs: of each region: -1 lower, +1 higher.
        boxes: rows and columns of each region.
        window: cells along each side of the window.
        threshold: z of a window's mean that is significant; infinite where nothing is.
        bias_m: sum over cells of what the choice of outlines adds to dz, for lower and for higher ground (negative and
            positive), metres times cells.
    """

    labels: Int32[np.ndarray, "rows columns"]
    signs: np.ndarray
    boxes: list[tuple[slice, slice]]
    window: int
    threshold: float
    bias_m: tuple[float, float]

    def cells(self, sign: int) -> Bool[np.ndarray, "rows columns"]:
        """Cells of all regions of one sign."""
        lookup = np.concatenate([[False], self.signs == sign])
        return lookup[self.labels]


def default_window(variogram: Variogram, cell_m: float) -> int:
    """As wide as the shortest correlation: what is averaged within it is nearly one measurement, beyond it blurs."""
    reach = min(variogram.ranges_m, default=0.0)
    low, high = _WINDOW_LIMITS
    return min(high, max(low, 2 * round(reach / (2 * cell_m)) + 1))


def find_outlines(
    dz: Float32[np.ndarray, "rows columns"],
    sigma: Float32[np.ndarray, "rows columns"] | float,
    systematic_m: float,
    variogram: Variogram,
    cell_m: float,
    window: int | None = None,
    least_cells: int | None = None,
) -> Outlines:
    """Outline significant change.

    Args:
        dz: difference, NaN where unknown.
        sigma: one sigma of each cell's own error.
        systematic_m: one sigma of the error that all cells share.
        window: cells along each side; odd.
        least_cells: of a region; those of a window if None.
    """
    window = window or default_window(variogram, cell_m)
    least_cells = least_cells or window**2
    z = window_z(dz, sigma, systematic_m, variogram, cell_m, window)
    threshold = _threshold(z)
    empty = np.zeros(0, np.int8)
    if math.isinf(threshold):
        return Outlines(np.zeros(dz.shape, np.int32), empty, [], window, threshold, (0.0, 0.0))
    labels = np.zeros(dz.shape, np.int32)
    signs: list[int] = []
    boxes: list[tuple[slice, slice]] = []
    bias = []
    for sign in (-1, 1):
        beyond = z * sign > threshold  # False where z is NaN
        numbered = np.zeros(dz.shape, np.int32)
        count = int(label(beyond, _EIGHT, output=numbered))  # type: ignore[arg-type]
        sizes = np.bincount(numbered.ravel(), minlength=count + 1)
        sizes[0] = 0
        kept = np.flatnonzero(sizes >= least_cells)
        lookup = np.zeros(count + 1, np.int32)
        lookup[kept] = np.arange(1, len(kept) + 1) + len(signs)
        found = find_objects(numbered)
        boxes += [found[k - 1] for k in kept]
        signs += [sign] * len(kept)
        mine = lookup[numbered]
        labels += mine
        # Means close to the threshold, where the outlines that are kept might run differently.
        near = np.abs(z * sign - threshold) < _NEAR_THRESHOLD
        near &= np.asarray(binary_dilation(mine > 0, _EIGHT, iterations=window), bool)
        bias.append(sign * _edge_bias(near, sigma, systematic_m, variogram, cell_m, window))
    return Outlines(labels, np.array(signs, np.int8), boxes, window, threshold, (bias[0], bias[1]))


def _shares(variogram: Variogram, cell_m: float, window: int) -> tuple[float, float]:
    """Variance of a window's mean, and covariance of its centre with it, over that of a cell."""
    own = variogram.nugget / window**2
    side = window * cell_m
    return own + mean_correlation(variogram, side), own + centre_correlation(variogram, side)


def window_z(
    dz: Float32[np.ndarray, "rows columns"],
    sigma: Float32[np.ndarray, "rows columns"] | float,
    systematic_m: float,
    variogram: Variogram,
    cell_m: float,
    window: int,
) -> Float32[np.ndarray, "rows columns"]:
    """Mean of dz in a window around each cell over its deviation; NaN where the cell itself is unknown."""
    z = np.empty(dz.shape, np.float32)
    correlated = mean_correlation(variogram, window * cell_m)
    half = window // 2
    for first in range(0, dz.shape[0], _STRIP):
        last = min(first + _STRIP, dz.shape[0])
        low, high = max(0, first - half), min(dz.shape[0], last + half)
        part = dz[low:high]
        known = np.isfinite(part)
        share = uniform_filter(known.astype(np.float32), window, mode="constant")
        mean = uniform_filter(np.where(known, part, 0), window, mode="constant") / np.maximum(share, 1e-6)
        inner = slice(first - low, first - low + last - first)
        own = sigma[first:last] if isinstance(sigma, np.ndarray) else sigma
        count = np.maximum(share[inner] * window**2, 1)
        deviation = np.sqrt(np.square(own) * (variogram.nugget / count + correlated) + systematic_m**2)
        z[first:last] = np.where(known[inner], mean[inner] / np.maximum(deviation, 1e-9), np.nan)
    return z


def _threshold(z: Float32[np.ndarray, "rows columns"]) -> float:
    """The smallest |z| at which the expected share of unchanged cells beyond it is at most 5%; inf if there is none."""
    bins = round(_LARGEST_Z / _BIN)
    counts = np.zeros(bins, np.int64)
    for first in range(0, len(z), _STRIP):
        size = np.abs(z[first : first + _STRIP])
        size = size[np.isfinite(size)]
        counts += np.bincount(np.minimum(size / _BIN, bins - 1).astype(np.int64), minlength=bins)
    beyond = counts[::-1].cumsum()[::-1]
    edges = np.arange(bins) * _BIN
    passing = (2 * ndtr(-edges) * counts.sum() <= FALSE_DISCOVERIES * beyond) & (beyond > 0)
    return float(edges[np.argmax(passing)]) if passing.any() else math.inf


def _edge_bias(
    near: Bool[np.ndarray, "rows columns"],
    sigma: Float32[np.ndarray, "rows columns"] | float,
    systematic_m: float,
    variogram: Variogram,
    cell_m: float,
    window: int,
) -> float:
    """Sum of Cov(e, s) / deviation(s) times the density of z at the threshold, over the cells near it."""
    variance, with_centre = _shares(variogram, cell_m, window)
    own = (sigma[near] if isinstance(sigma, np.ndarray) else np.full(int(near.sum()), sigma)).astype(np.float64)
    return float((own**2 * with_centre / np.sqrt(own**2 * variance + systematic_m**2)).sum()) / (2 * _NEAR_THRESHOLD)
