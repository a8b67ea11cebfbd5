"""What choosing outlines by noisy heights does to cut and fill: a parametric bootstrap.

Outlines follow the errors: false ones have only the errors that made them, true ones lean towards where errors point
the same way. How much that adds up to is found by repeating the choice: noise with the measured size and correlation is
added to the change that was found, and outlines are made again in the same way. The mean sum of the noise in the new
outlines is the bias, which is subtracted; what that sum scatters beyond the error of a sum over fixed cells is the part
of the error that the choice adds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float32, Float64
from scipy.fft import next_fast_len
from scipy.ndimage import uniform_filter

from tidefield.change.outlines import Outlines, find_outlines
from tidefield.change.variogram import Variogram

_REPEATS = 16
_TILE = 1024
_MOST_TILES = 4
_SMOOTH = 5
"""Cells over which the change that was found is smoothed."""


@dataclass(frozen=True)
class Choice:
    """Of the sums of dz in all outlines of one sign, metres times cells.

    Attributes:
        bias: what the choice adds to the sum; of lower ground usually negative.
        deviation: of the sum with outlines chosen anew, one sigma, without the systematic error.
    """

    bias: float
    deviation: float


def simulate_noise(
    shape: tuple[int, int], variogram: Variogram, cell_m: float, random: np.random.Generator
) -> Float32[np.ndarray, "rows columns"]:
    """Normal noise of unit variance with the correlation of a variogram, by circulant embedding (Dietrich 1997)."""
    pad = math.ceil(variogram.range_m / cell_m)
    rows, columns = (next_fast_len(n + min(n, pad)) or n + pad for n in shape)
    white = np.fft.rfft2(random.standard_normal((rows, columns)))
    smooth = np.fft.irfft2(white * _root_power(rows, columns, variogram, cell_m), (rows, columns))
    own = math.sqrt(variogram.nugget) * random.standard_normal(shape)
    return (smooth[: shape[0], : shape[1]] + own).astype(np.float32)


@lru_cache(maxsize=1)
def _root_power(rows: int, columns: int, variogram: Variogram, cell_m: float) -> Float64[np.ndarray, "rows half"]:
    """Root of the spectrum of a variogram's correlation over a raster whose ends meet."""
    r = np.minimum(np.arange(rows), rows - np.arange(rows))[:, None] * cell_m
    c = np.minimum(np.arange(columns), columns - np.arange(columns))[None] * cell_m
    correlation = variogram.correlation(np.hypot(r, c))
    # Where the range is longer than the embedding, a few eigenvalues are below zero.
    return np.sqrt(np.maximum(np.fft.rfft2(correlation).real, 0))


def repeat_choice(
    dz: Float32[np.ndarray, "rows columns"],
    sigma: Float32[np.ndarray, "rows columns"] | float,
    systematic_m: Float32[np.ndarray, "rows columns"] | float,
    variogram: Variogram,
    cell_m: float,
    outlines: Outlines,
) -> tuple[Choice, Choice]:
    """Bias and deviation of the sums of dz in the outlines of lower and of higher ground.

    Large surveys are looked at in tiles of a million cells, for each sign in the four with most of its outlined ground,
    and the rest is taken to behave alike.
    """
    boxes, signs = _tiles(*dz.shape), np.concatenate([[0], outlines.signs])
    counts = np.array([[np.count_nonzero(signs[outlines.labels[box]] == sign) for box in boxes] for sign in (-1, 1)])
    chosen = np.zeros(counts.shape, bool)
    np.put_along_axis(chosen, np.argsort(-counts, axis=1, kind="stable")[:, :_MOST_TILES], True, axis=1)
    sums = np.zeros((2, _REPEATS))
    for number in np.flatnonzero((chosen & (counts > 0)).any(axis=0)).tolist():
        box, random = boxes[number], np.random.default_rng([0, number])
        part, labels = dz[box], outlines.labels[box]
        known = np.isfinite(part)
        own, near = (of[box] if isinstance(of, np.ndarray) else of for of in (sigma, systematic_m))
        found = np.where(known, _smoothed(part, labels), np.float32(np.nan))
        for k in range(_REPEATS):
            noise = simulate_noise(part.shape, variogram, cell_m, random) * np.asarray(own, np.float32)
            again = find_outlines(found + noise, own, near, variogram, cell_m, outlines.windows)
            for side, sign in enumerate((-1, 1)):
                if chosen[side, number]:
                    sums[side, k] += float(noise.sum(where=again.cells(sign), dtype=np.float64))
    shares = counts.sum(axis=1) / np.maximum(1, counts.sum(axis=1, where=chosen))
    lower, higher = (
        Choice(float(of.mean() * share), float(of.std(ddof=1) * math.sqrt(share)))
        for of, share in zip(sums, shares, strict=True)
    )
    return lower, higher


def _tiles(rows: int, columns: int) -> list[tuple[slice, slice]]:
    """The tiles of a raster; one for all of a small one."""
    if rows * columns <= 2 * _TILE**2:
        return [(slice(0, rows), slice(0, columns))]
    return [
        (slice(r, min(r + _TILE, rows)), slice(c, min(c + _TILE, columns)))
        for r in range(0, rows, _TILE)
        for c in range(0, columns, _TILE)
    ]


def _smoothed(dz: np.ndarray, labels: np.ndarray) -> Float32[np.ndarray, "rows columns"]:
    """The change in outlines, smoothed within them, and none outside."""
    inside = labels > 0
    share = uniform_filter(inside.astype(np.float32), _SMOOTH, mode="constant")
    mean = uniform_filter(np.where(inside, dz, np.float32(0)), _SMOOTH, mode="constant")
    return np.where(inside, mean / np.maximum(share, np.float32(1e-6)), np.float32(0))
