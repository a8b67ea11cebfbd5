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

from tidefield.change.errors import Variogram
from tidefield.change.outlines import Outlines, find_outlines

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

    Large surveys are looked at in four tiles of a million cells, those with most outlined ground, and the rest is taken
    to behave alike.
    """
    tiles, share = _tiles(outlines.labels)
    sums = np.zeros((2, _REPEATS))
    for number, box in enumerate(tiles):
        random = np.random.default_rng([0, number])
        part, labels = dz[box], outlines.labels[box]
        known = np.isfinite(part)
        own, near = (of[box] if isinstance(of, np.ndarray) else of for of in (sigma, systematic_m))
        found = np.where(known, _smoothed(part, labels), np.float32(np.nan))
        for k in range(_REPEATS):
            noise = simulate_noise(part.shape, variogram, cell_m, random) * np.asarray(own, np.float32)
            again = find_outlines(found + noise, own, near, variogram, cell_m, outlines.windows)
            for side, sign in enumerate((-1, 1)):
                sums[side, k] += float(noise.sum(where=again.cells(sign), dtype=np.float64))
    lower, higher = (Choice(float(s.mean()) * share, float(s.std(ddof=1)) * math.sqrt(share)) for s in sums)
    return lower, higher


def _tiles(labels: np.ndarray) -> tuple[list[tuple[slice, slice]], float]:
    """Tiles to look at, and how much more outlined ground there is than in these."""
    rows, columns = labels.shape
    if rows * columns <= 2 * _TILE**2:
        return [(slice(0, rows), slice(0, columns))], 1.0
    boxes = [
        (slice(r, min(r + _TILE, rows)), slice(c, min(c + _TILE, columns)))
        for r in range(0, rows, _TILE)
        for c in range(0, columns, _TILE)
    ]
    counts = [int(np.count_nonzero(labels[box])) for box in boxes]
    chosen = np.argsort(counts)[::-1][:_MOST_TILES]
    inside = sum(counts[k] for k in chosen)
    return [boxes[k] for k in chosen], sum(counts) / inside if inside else 1.0


def _smoothed(dz: np.ndarray, labels: np.ndarray) -> Float32[np.ndarray, "rows columns"]:
    """The change in outlines, smoothed within them, and none outside."""
    inside = labels > 0
    share = uniform_filter(inside.astype(np.float32), _SMOOTH, mode="constant")
    mean = uniform_filter(np.where(inside, dz, np.float32(0)), _SMOOTH, mode="constant")
    return np.where(inside, mean / np.maximum(share, np.float32(1e-6)), np.float32(0))
