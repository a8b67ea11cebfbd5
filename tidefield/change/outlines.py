"""Outlines of change: regions where the mean of a small window is significant.

Windows of cells average what is independent between them, so that a change of a few centimetres is found that no cell
shows alone: small windows find narrow changes, large ones faint changes. The smallest p-value of a cell's windows,
times their number (Bonferroni), is tested with the false discovery rate held at 0.1% (Benjamini and Hochberg 1995): of
all ground that is found, at most that share is expected to be unchanged. Where nothing changed, nothing is outlined.
Outlines are what is connected with it beyond 2.3 deviations, and a margin for the edges of the change, which are below
any threshold; what is unchanged there adds no more than its errors, which cancel out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32
from scipy.ndimage import find_objects, label, maximum_filter, median_filter, uniform_filter
from scipy.special import ndtr

from tidefield.change.variogram import Variogram, mean_correlation

FALSE_DISCOVERIES = 0.001
WINDOWS = (5, 11, 21)
_BIN = 0.02
"""Of the histogram of |z|."""
_LARGEST_Z = 40.0
_SHOWS = 1.0
"""z of the smallest window where a larger one is believed."""
_CONNECTED = 2.3
"""z of what is outlined when it is connected with what is found."""
_LIMIT = np.float32(3)
_STRIP = 512
_EIGHT = np.ones((3, 3), bool)


@dataclass(frozen=True)
class Outlines:
    """Regions of significant change.

    Attributes:
        labels: number of each cell's region with its margin, from 1; 0 outside.
        signs: of each region: -1 lower, +1 higher.
        boxes: rows and columns of each region.
        windows: cells along each side of the windows.
        margin: cells that were added around what is significant.
        threshold: z of a window's mean that is significant; infinite where nothing is.
    """

    labels: Int32[np.ndarray, "rows columns"]
    signs: np.ndarray
    boxes: list[tuple[slice, slice]]
    windows: tuple[int, ...]
    margin: int
    threshold: float

    def cells(self, sign: int) -> Bool[np.ndarray, "rows columns"]:
        """Cells of all regions of one sign."""
        lookup = np.concatenate([[False], self.signs == sign])
        return lookup[self.labels]


def find_outlines(
    dz: Float32[np.ndarray, "rows columns"],
    sigma: Float32[np.ndarray, "rows columns"] | float,
    systematic_m: Float32[np.ndarray, "rows columns"] | float,
    variogram: Variogram,
    cell_m: float,
    windows: tuple[int, ...] = WINDOWS,
) -> Outlines:
    """Outline significant change. Regions smaller than the smallest window are left out.

    Args:
        dz: difference, NaN where unknown.
        sigma: one sigma of each cell's own error.
        systematic_m: one sigma of the error that a cell shares with all around it.
        windows: cells along each side of the windows; odd.
    """
    z = _largest_z(dz, sigma, systematic_m, variogram, cell_m, windows)
    threshold = _threshold(z, len(windows))
    margin = sorted(windows)[len(windows) // 2] // 2 + 1
    labels = np.zeros(dz.shape, np.int32)
    if math.isinf(threshold):
        return Outlines(labels, np.zeros(0, np.int8), [], windows, margin, threshold)
    signs: list[int] = []
    for sign in (-1, 1):
        numbered = np.zeros(dz.shape, np.int32)
        # False where z is NaN.
        count = int(label(z * sign > min(_CONNECTED, threshold), _EIGHT, output=numbered))  # type: ignore[arg-type]
        sizes, found = np.zeros(count + 1, np.int64), np.zeros(count + 1, bool)
        for rows in _strips(len(z)):
            sizes += np.bincount(numbered[rows].ravel(), minlength=count + 1)
            found[numbered[rows][z[rows] * sign > threshold]] = True
        kept = np.flatnonzero(found & (sizes >= min(windows) ** 2) & (np.arange(count + 1) > 0))
        lookup = np.zeros(count + 1, np.int32)
        lookup[kept] = np.arange(1, len(kept) + 1) + len(signs)
        signs += [sign] * len(kept)
        for rows in _strips(len(z)):
            labels[rows] += lookup[numbered[rows]]
        del numbered
    del z
    _add_margin(labels, margin)
    labels[~np.isfinite(dz)] = 0
    boxes = [box for box in find_objects(labels) if box is not None]
    assert len(boxes) == len(signs)
    return Outlines(labels, np.array(signs, np.int8), boxes, windows, margin, threshold)


def _limited(
    dz: Float32[np.ndarray, "rows columns"], sigma: Float32[np.ndarray, "rows columns"] | float
) -> Float32[np.ndarray, "rows columns"]:
    """Limit single cells to three deviations from the median of their neighbours: a mismatch is no change."""
    out = np.empty_like(dz)
    for rows in _strips(len(dz)):
        low, high = max(0, rows.start - 1), min(len(dz), rows.stop + 1)
        part = np.where(np.isfinite(dz[low:high]), dz[low:high], np.float32(0))
        middle = median_filter(part, 3)[rows.start - low : rows.stop - low]
        own = sigma[rows] if isinstance(sigma, np.ndarray) else np.float32(sigma)
        out[rows] = np.clip(dz[rows], middle - _LIMIT * own, middle + _LIMIT * own)
    return out


def _largest_z(
    dz: Float32[np.ndarray, "rows columns"],
    sigma: Float32[np.ndarray, "rows columns"] | float,
    systematic_m: Float32[np.ndarray, "rows columns"] | float,
    variogram: Variogram,
    cell_m: float,
    windows: tuple[int, ...],
) -> Float32[np.ndarray, "rows columns"]:
    """For each cell the z of that window which is most significant."""
    z = np.empty(dz.shape, np.float32)
    smallest, *larger_ones = sorted(windows)
    halo = max(windows) // 2
    for rows in _strips(len(dz)):
        low, high = max(0, rows.start - halo), min(len(dz), rows.stop + halo)
        inner = slice(rows.start - low, rows.stop - low)
        own, near = (of[low:high] if isinstance(of, np.ndarray) else of for of in (sigma, systematic_m))
        limited = _limited(dz[low:high], own)
        first = window_z(limited, own, near, variogram, cell_m, smallest)[inner]
        z[rows] = first
        for window in larger_ones:
            other = window_z(limited, own, near, variogram, cell_m, window)[inner]
            # A large window reaches beyond the edge of a change; the smallest one has to show a little of it, too.
            larger = (np.abs(other) > np.abs(z[rows])) & (first * np.sign(other) > _SHOWS)
            np.copyto(z[rows], other, where=larger)
    return z


def _add_margin(labels: Int32[np.ndarray, "rows columns"], margin: int) -> None:
    """Grow all regions into what is free around them, one cell at a time."""
    for _ in range(margin):
        before = labels.copy()
        for rows in _strips(len(labels)):
            low = max(0, rows.start - 1)
            around = maximum_filter(before[low : rows.stop + 1], 3)[rows.start - low :][: rows.stop - rows.start]
            np.copyto(labels[rows], around, where=labels[rows] == 0)


def _strips(rows: int) -> list[slice]:
    return [slice(first, min(first + _STRIP, rows)) for first in range(0, rows, _STRIP)]


def window_z(
    dz: Float32[np.ndarray, "rows columns"],
    sigma: Float32[np.ndarray, "rows columns"] | float,
    systematic_m: Float32[np.ndarray, "rows columns"] | float,
    variogram: Variogram,
    cell_m: float,
    window: int,
) -> Float32[np.ndarray, "rows columns"]:
    """Mean of dz in a window around each cell over its deviation; NaN where the cell itself is unknown."""
    z = np.empty(dz.shape, np.float32)
    correlated = mean_correlation(variogram, window, cell_m)
    half = window // 2
    for first in range(0, dz.shape[0], _STRIP):
        last = min(first + _STRIP, dz.shape[0])
        low, high = max(0, first - half), min(dz.shape[0], last + half)
        part = dz[low:high]
        known = np.isfinite(part)
        share = uniform_filter(known.astype(np.float32), window, mode="constant")
        mean = uniform_filter(np.where(known, part, 0), window, mode="constant") / np.maximum(share, 1e-6)
        inner = slice(first - low, first - low + last - first)
        own, near = (of[first:last] if isinstance(of, np.ndarray) else of for of in (sigma, systematic_m))
        count = np.maximum(share[inner] * window**2, 1)
        deviation = np.sqrt(np.square(own) * (variogram.nugget / count + correlated) + np.square(near))
        z[first:last] = np.where(known[inner], mean[inner] / np.maximum(deviation, 1e-9), np.nan)
    return z


def _threshold(z: Float32[np.ndarray, "rows columns"], tests: int) -> float:
    """The smallest |z| at which the expected share of unchanged cells beyond it is at most 0.1%; else inf."""
    bins = round(_LARGEST_Z / _BIN)
    counts = np.zeros(bins, np.int64)
    for first in range(0, len(z), _STRIP):
        size = np.abs(z[first : first + _STRIP])
        size = size[np.isfinite(size)]
        counts += np.bincount(np.minimum(size / _BIN, bins - 1).astype(np.int64), minlength=bins)
    beyond = counts[::-1].cumsum()[::-1]
    edges = np.arange(bins) * _BIN
    passing = (2 * tests * ndtr(-edges) * counts.sum() <= FALSE_DISCOVERIES * beyond) & (beyond > 0)
    return float(edges[np.argmax(passing)]) if passing.any() else math.inf
