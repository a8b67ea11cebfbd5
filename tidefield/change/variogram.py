"""The correlation of errors over distance: spherical variograms, measured over stable ground.

The errors of two cells at a distance h are correlated as

    rho(h) = sum_k s_k (1 - 3/2 (h / a_k) + 1/2 (h / a_k)^3)   for h < a_k, h > 0;  rho(0) = 1,

spherical structures with sills s_k and ranges a_k; what is left, 1 - sum_k s_k, is the nugget, independent from cell to
cell.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from numpy.fft import irfft2, rfft2
from scipy.fft import next_fast_len
from scipy.optimize import least_squares, nnls

from tidefield.change.statistics import nmad

_WINDOW = 512
"""Rows and columns of the pieces that the variogram is computed from."""
_SPREAD = 3
"""Pieces along each side of a large raster."""
_BINS_PER_OCTAVE = 4
_LEAST_PAIRS = 200
"""In a bin of distances; on little ground half as many as it has cells."""
_LEAST_SHARE = 0.1
"""Of the pairs at a shorter distance in the same piece."""
_LEAST_PATCHES = 12
_RESOLVED_CELLS = 2.0
"""Stable ground whose nearest bin is further away does not show what neighbours share."""
_LEAST_SILL = 1e-3
"""Structures and nuggets of smaller shares are none."""
_SAME_RANGE = 1.01
"""Ranges whose ratio is smaller are one."""
_WORTH = 6.0
"""A second structure is kept unless Akaike's criterion is higher by this: to miss a long correlation costs more."""
_SEARCHED = 8
"""Ranges, of whose combinations as many are refined: the best fits of a variogram may be narrow."""
_CLIP = 4.0
"""Residuals are limited to this many deviations before they are squared: moved objects are no part of the noise."""
_DISTANCES = 128
"""Distances along each side at which correlation is taken for a pair of near blocks; all there are, if fewer."""


@dataclass(frozen=True)
class Variogram:
    """The correlation of errors over distance, as shares of their variance.

    Attributes:
        sills: of the spherical structures; their sum is at most 1.
        ranges_m: of the structures.
        lags_m, semivariances, pairs: what was measured, over the variance.
        reached: whether the semivariance levels off within the distances that were measured.
        assumed_m: distance within which errors are taken to be shared, because stable ground has too few neighbouring
            cells to show it; 0 where it has enough.
    """

    sills: tuple[float, ...]
    ranges_m: tuple[float, ...]
    lags_m: tuple[float, ...] = ()
    semivariances: tuple[float, ...] = ()
    pairs: tuple[float, ...] = ()
    reached: bool = True
    assumed_m: float = 0.0

    @property
    def nugget(self) -> float:
        return max(0.0, 1.0 - sum(self.sills))

    @property
    def range_m(self) -> float:
        """The longest range; 0 without correlation."""
        return max(self.ranges_m, default=0.0)

    def structures(self) -> list[tuple[float, float]]:
        """Sill and range of each."""
        return list(zip(self.sills, self.ranges_m, strict=True))

    def correlation(self, distance_m: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
        """Correlation at distances above 0; at 0 that of neighbours infinitely close, without the nugget."""
        total = np.zeros(np.shape(distance_m))
        for sill, reach in self.structures():
            h = np.minimum(distance_m / reach, 1)
            total += sill * (1 - 1.5 * h + 0.5 * h**3)
        return total


UNCORRELATED = Variogram((), ())
UNMEASURED = Variogram((), (), reached=False)
"""Of ground that is too small to show a correlation."""


def fit_variogram(residuals: Float32[np.ndarray, "rows columns"], cell_m: float) -> Variogram:
    """Measure the variogram of residuals and fit a nugget and one or two spherical structures to it.

    All pairs of cells in a piece of 512 x 512 are used, by Fourier transforms (Marcotte 1996, doi
    10.1016/S0098-3004(96)00026-X); longer distances come from every second, fourth, ... cell.

    Args:
        residuals: over stable ground, without their mean; NaN elsewhere.
    """
    finite = np.isfinite(residuals)
    if finite.sum() < 100:
        return UNMEASURED
    known_part = extent_of(finite)
    residuals, finite = residuals[known_part], finite[known_part]
    # What one number is taken from needs no more than a million cells.
    some = residuals[finite][:: 1 + int(finite.sum()) // 1_000_000]
    scale = nmad(some) or float(some.std())
    if scale == 0:
        return UNCORRELATED
    limit = _CLIP * scale
    sums: dict[int, np.ndarray] = {}
    longest = 0.0
    step = 1
    while True:
        thin = residuals[step // 2 :: step, step // 2 :: step]
        for piece in _pieces(thin):
            known = np.isfinite(piece)
            if known.sum() < 100:
                continue
            values = np.where(known, np.clip(piece, -limit, limit), 0).astype(np.float64)
            distance, gamma, pairs = _semivariances(values, known.astype(np.float64), cell_m * step)
            longest = max(longest, float(distance[pairs > 0].max(initial=0)))
            # Distances of few steps are taken from the finer grids only, where there are more pairs.
            usable = (pairs > 0) & (distance > 0) & ((step == 1) | (distance > 8 * cell_m * step))
            bins = np.floor(_BINS_PER_OCTAVE * np.log2(distance[usable] / cell_m) + 1e-9).astype(int)
            most = 0.0
            for number in np.unique(bins):
                at = bins == number
                n = pairs[usable][at]
                most = max(most, n.sum())
                if n.sum() < _LEAST_SHARE * most:
                    continue  # of the corners of what is known, which are no sample of it
                add = np.array([n.sum(), (n * gamma[usable][at]).sum(), (n * distance[usable][at]).sum()])
                sums[int(number)] = sums.get(int(number), np.zeros(3)) + add
        if max(thin.shape) <= _WINDOW:
            break
        step *= 2
    least = min(_LEAST_PAIRS, int(finite.sum()) / 2)
    table = np.array([sums[key] for key in sorted(sums) if sums[key][0] >= least])
    # Pairs further apart than half of the longest distance are few and all of the same places.
    table = table[table[:, 2] / table[:, 0] <= longest / 2] if len(table) else table
    if len(table) < 4:
        return UNMEASURED
    lags, gammas, pairs = table[:, 2] / table[:, 0], table[:, 1] / table[:, 0], table[:, 0]
    every = 1 + math.isqrt(residuals.size // 1_000_000)
    # Like the shares of the variogram, of what is left of outliers.
    thinned = np.clip(residuals[::every, ::every], -limit, limit) / np.float32(np.clip(some, -limit, limit).std())
    fitted = _fitted(lags, gammas, pairs)
    if lags[0] > _RESOLVED_CELLS * cell_m and fitted.nugget > _LEAST_SILL:
        # What seems random may be shared by all that is nearer than what was measured.
        reach = float(lags[0])
        sills, ranges = _joined((*fitted.sills, fitted.nugget), (*fitted.ranges_m, reach))
        fitted = replace(fitted, sills=sills, ranges_m=ranges, assumed_m=reach)
    return _with_patches(fitted, thinned, every * cell_m)


def _joined(sills: Iterable[float], ranges_m: Iterable[float]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Sills and ranges of structures in the order of their ranges, those of one range as one."""
    structures: list[list[float]] = []
    for reach, sill in sorted(zip(ranges_m, sills, strict=True)):
        if structures and reach < _SAME_RANGE * structures[-1][0]:
            structures[-1][1] += sill
        else:
            structures.append([reach, sill])
    return tuple(sill for _, sill in structures), tuple(reach for reach, _ in structures)


def padded_size(rows: int, columns: int) -> tuple[int, int]:
    """Size of a Fourier transform in which no offset of a raster comes round to another."""
    return next_fast_len(2 * rows) or 2 * rows, next_fast_len(2 * columns) or 2 * columns


def _with_patches(fitted: Variogram, residuals: np.ndarray, cell_m: float) -> Variogram:
    """Add what the means of large patches scatter beyond what a variogram says, as a structure of twice their side.

    A variogram hardly shows what is correlated over a good part of the stable ground, because its mean is taken out; it
    is what the errors of volumes hang on. Means of disjoint patches show it (Rolstad et al. 2009, doi
    10.3189/002214309789470950).
    """
    side = min(residuals.shape) // 3
    while side >= 8:
        rows, columns = residuals.shape[0] // side, residuals.shape[1] // side
        blocks = residuals[: rows * side, : columns * side].reshape(rows, side, columns, side)
        counts = np.isfinite(blocks).sum(axis=(1, 3))
        sums = np.where(np.isfinite(blocks), blocks, 0).sum(axis=(1, 3), dtype=np.float64)
        full = counts > side**2 / 2
        if full.sum() >= _LEAST_PATCHES:
            break
        side = side * 3 // 4
    else:
        return fitted
    means = sums[full] / counts[full]
    predicted = fitted.nugget / float(counts[full].mean()) + mean_correlation(fitted, side, cell_m)
    reach = 2 * side * cell_m
    share = mean_correlation(Variogram((1.0,), (reach,)), side, cell_m)
    sill = (float(np.mean(means**2)) - predicted) / share
    if sill <= 0:
        return fitted
    whole = 1 + sill
    sills, ranges = _joined((*fitted.sills, sill), (*fitted.ranges_m, reach))
    return replace(fitted, sills=tuple(s / whole for s in sills), ranges_m=ranges)


def _pieces(values: np.ndarray) -> list[np.ndarray]:
    """At most nine pieces of 512 x 512: spread over a raster, or where it is known, if that is in few places."""

    def pieces(most: int) -> list[np.ndarray]:
        rows, columns = (
            np.unique(np.linspace(0, max(0, length - _WINDOW), min(most, -(-length // _WINDOW))).astype(int))
            for length in values.shape
        )
        return [values[r : r + _WINDOW, c : c + _WINDOW] for r in rows for c in columns]

    def known(piece: np.ndarray) -> int:
        return int(np.isfinite(piece).sum())

    spread = pieces(_SPREAD)
    if sum(map(known, spread)) >= sum(piece.size for piece in spread) / 2:
        return spread  # no others hold more than twice as much
    fullest = sorted(pieces(max(values.shape)), key=known, reverse=True)[: _SPREAD**2]
    return spread if sum(map(known, spread)) >= sum(map(known, fullest)) / 2 else fullest


def _semivariances(values: np.ndarray, known: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance, semivariance and number of pairs of every offset, half of the plane."""
    rows, columns = values.shape
    size = padded_size(rows, columns)
    z, m, z2 = (rfft2(x, size) for x in (values, known, values**2))
    pairs = irfft2(np.abs(m) ** 2, size)
    square = irfft2(z2 * np.conj(m) + m * np.conj(z2) - 2 * np.abs(z) ** 2, size)
    r = np.fft.fftfreq(size[0], 1 / size[0])[:, None]
    c = np.fft.fftfreq(size[1], 1 / size[1])[None]
    half = (c > 0) | ((c == 0) & (r > 0))
    count = np.rint(pairs[half])
    gamma = np.divide(square[half], 2 * count, out=np.zeros(count.shape), where=count > 0)
    return (cell_m * np.hypot(r, c))[half], np.maximum(gamma, 0), count


def _fitted(lags: np.ndarray, gammas: np.ndarray, pairs: np.ndarray) -> Variogram:
    """Fit one and two structures, and keep the second where it explains more."""
    # Bins at long distances have most pairs, but those at short ones decide: every bin counts alike once it has many.
    weight = np.sqrt(pairs / (pairs + pairs.max() * 1e-3))
    variance = float(np.median(gammas[len(gammas) // 2 :]))
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for structures in (1, 2):
        reaches, shares, left = _least_squares(lags, gammas, weight, structures)
        criterion = len(lags) * math.log(left + 1e-12 * variance**2) + 2 * (len(reaches) + len(shares))  # Akaike
        if best is None or criterion < best[0] + _WORTH:
            best = criterion, reaches, shares
    assert best is not None
    nugget, *found = best[2].tolist()
    sills, ranges = _joined(found, best[1].tolist())
    total = nugget + sum(sills)
    kept = [k for k in range(len(sills)) if sills[k] > _LEAST_SILL * total]
    return Variogram(
        tuple(sills[k] / total for k in kept),
        tuple(ranges[k] for k in kept),
        tuple(lags.tolist()),
        tuple((gammas / total).tolist()),
        tuple(pairs.tolist()),
        reached=bool(not kept or ranges[kept[-1]] < 0.9 * lags[-1]),
    )


def _least_squares(
    lags: np.ndarray, gammas: np.ndarray, weight: np.ndarray, structures: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Ranges of structures; the nugget and their sills; and the squares that are left.

    With given ranges nugget and sills are a linear fit, so that ranges alone are searched (variable projection: Golub
    and Pereyra 1973, doi 10.1137/0710036).
    """
    target = weight * gammas

    def linear(ranges: Sequence[float] | np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Weighted semivariances of a nugget and of structures of sill 1; the best shares of them; what is left."""
        h = np.minimum(lags[:, None] / np.asarray(ranges), 1)
        columns = weight[:, None] * np.column_stack([np.ones(len(lags)), 1.5 * h - 0.5 * h**3])
        shares, left = nnls(columns, target)
        return columns, shares, left

    def residuals(ranges: np.ndarray) -> np.ndarray:
        columns, shares, _ = linear(ranges)
        return (columns @ shares - target) / target.max()

    low, high = float(lags[0]), float(2 * lags[-1])
    starts = sorted(
        combinations(np.geomspace(low, high, _SEARCHED).tolist(), structures), key=lambda ranges: linear(ranges)[2]
    )
    fits = [
        least_squares(residuals, start, bounds=(low, high), x_scale=start, method="dogbox", ftol=1e-4, xtol=1e-3)
        for start in starts[:_SEARCHED]
    ]
    ranges = min(fits, key=lambda fit: fit.cost).x
    _, shares, left = linear(ranges)
    return ranges, shares, left**2


def mean_correlation(variogram: Variogram, cells: int, cell_m: float) -> float:
    """Mean correlation of all pairs of cells in a square of cells x cells, without the nugget."""
    return float(near_correlation(variogram, (cells, cells), cell_m, (1, 1))[0, 0])


@lru_cache(maxsize=64)
def near_correlation(
    variogram: Variogram, size: tuple[int, int], cell_m: float, count: tuple[int, int]
) -> Float64[np.ndarray, "rows columns"]:
    """Mean correlation of the pairs of cells of two blocks, by their offset in blocks along rows and columns.

    Args:
        size: rows and columns of cells in a block.
        count: of the offsets.
    """
    total = np.zeros(count)
    for sill, reach in variogram.structures():
        structure = Variogram((sill,), (reach,))
        down, across = ([_distances(k, n, reach / cell_m) for k in range(m)] for n, m in zip(size, count, strict=True))
        for i, (rows, of_rows) in enumerate(down):
            for j, (columns, of_columns) in enumerate(across):
                far = cell_m * np.hypot(rows[:, None], columns[None])
                total[i, j] += of_rows @ structure.correlation(far) @ of_columns
    return total


def _distances(offset: int, size: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Distances along one side between the cells of two blocks, in cells, and the share of the pairs that have them.

    Args:
        offset: of one block from the other, in blocks.
        size: of a block, in cells.
        reach: cells beyond which distances are left out.
    """
    low, high = max((offset - 1) * size + 1, -math.floor(reach)), min((offset + 1) * size - 1, math.floor(reach))
    count = max(0, min(high - low + 1, _DISTANCES))
    width = (high - low + 1) / max(count, 1)
    at = low - 0.5 + width * (np.arange(count) + 0.5)
    return at, width * (size - np.abs(at - offset * size)) / size**2


def extent_of(region: Bool[np.ndarray, "rows columns"]) -> tuple[slice, slice]:
    """The rows and columns that a region covers."""
    rows, columns = (np.flatnonzero(region.any(axis)) for axis in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
