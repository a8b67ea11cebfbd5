"""Errors of a difference: their size, their correlation over distance, and what both do to a volume.

The error of a cell is sigma times a field of unit variance whose correlation falls with distance h as

    rho(h) = sum_k s_k (1 - 3/2 (h / a_k) + 1/2 (h / a_k)^3)   for h < a_k, h > 0;  rho(0) = 1,

spherical structures with sills s_k and ranges a_k; what is left, 1 - sum_k s_k, is the nugget, independent from cell to
cell. A volume's variance is the sum of the covariances of all pairs of its cells, which is computed here for the region
as it is. For regions much larger than the range that sum is what Anderson gives in closed form (2019, Uncertainty in
quantifying geomorphic change, doi 10.1002/esp.4551), which `anderson_terms` has.
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
from scipy.special import ndtr

Z95 = 1.959963984540054
"""A normal error is larger than this many of its deviations in 5% of cases."""
NMAD = 1.4826
"""Deviation of a normal distribution over its median absolute deviation."""
_WINDOW = 512
"""Rows and columns of the pieces that the variogram is computed from."""
_SPREAD = 3
"""Pieces along each side of a large raster."""
_BLOCKS = 512
"""Rows and columns to which a region is reduced before its covariances are summed."""
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
_AT_ONCE = 1 << 20
"""Cells of a region that are reduced to blocks at once."""
_NEAR = 4
"""Blocks closer than so many of their longer sides have their correlation summed over pairs of cells."""
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

    def degrees_of_freedom(self, stable: Bool[np.ndarray, "rows columns"], cell_m: float) -> float:
        """Of the variance of a large region's sum, if sills and ranges were measured on these cells.

        N cells have N^2 / sum rho independent samples of a structure, summed over all their pairs, less one for the
        mean; on ground much larger than its range a these are one for each pi a^2 / 5. Structures are weighted by what
        they add to the variance of a sum (Satterthwaite 1946).
        """
        if not self.sills:
            return math.inf
        cells, reduced = int(stable.sum()), _reduced(stable, 1.0)
        parts = []
        for sill, reach in self._structures():
            pairs = max(cells, float(reduced.pair_sums(Variogram((1.0,), (reach,)), cell_m)[0, 0]))
            parts.append((sill * reach**2, max(1.0, cells**2 / pairs - 1)))
        return sum(c for c, _ in parts) ** 2 / sum(c**2 / n for c, n in parts)

    def _structures(self) -> list[tuple[float, float]]:
        return list(zip(self.sills, self.ranges_m, strict=True))

    def correlation(self, distance_m: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
        """Correlation at distances above 0; at 0 that of neighbours infinitely close, without the nugget."""
        total = np.zeros(np.shape(distance_m))
        for sill, reach in self._structures():
            h = np.minimum(distance_m / reach, 1)
            total += sill * (1 - 1.5 * h + 0.5 * h**3)
        return total


UNCORRELATED = Variogram((), ())
UNMEASURED = Variogram((), (), reached=False)
"""Of ground that is too small to show a correlation."""


def anderson_terms(
    cells: int, cell_m: float, random_m: float, range_m: float, sill_m: float, systematic_m: float
) -> tuple[float, float, float]:
    """Anderson's three errors of a volume, as the U.S. Geological Survey codes them (jlogan-usgs/dem-differencing).

        random      sqrt(n) L^2 s
        correlated  0.79 a sqrt(n) L s_c
        systematic  n L^2 s_s

    Args:
        cells: their number n.
        cell_m: their side L.
        random_m: deviation s of the part that is independent from cell to cell.
        range_m: range a of a spherical variogram.
        sill_m: deviation s_c of the correlated part, the root of the sill.
        systematic_m: deviation s_s of the part that all cells have in common.

    Returns:
        The three deviations in cubic metres, one sigma each.
    """
    root = math.sqrt(cells)
    return root * cell_m**2 * random_m, 0.79 * range_m * root * cell_m * sill_m, cells * cell_m**2 * systematic_m


def nmad(values: Float[np.ndarray, " N"]) -> float:
    """Robust deviation: 1.4826 times the median absolute deviation from the median (Hoehle and Hoehle 2009)."""
    return NMAD * float(np.median(np.abs(values - np.median(values))))


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
    known_part = _extent(finite)
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


def _padded(rows: int, columns: int) -> tuple[int, int]:
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
    size = _padded(rows, columns)
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
    return float(_near_correlation(variogram, (cells, cells), cell_m, (1, 1))[0, 0])


@lru_cache(maxsize=64)
def _near_correlation(
    variogram: Variogram, size: tuple[int, int], cell_m: float, count: tuple[int, int]
) -> Float64[np.ndarray, "rows columns"]:
    """Mean correlation of the pairs of cells of two blocks, by their offset in blocks along rows and columns.

    Args:
        size: rows and columns of cells in a block.
        count: of the offsets.
    """
    total = np.zeros(count)
    for sill, reach in variogram._structures():
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


@dataclass(frozen=True)
class RegionError:
    """Deviations of a sum over cells, one sigma.

    Attributes:
        random: of the part that is independent from cell to cell.
        correlated: of the part that neighbours share.
    """

    random: float
    correlated: float

    @property
    def total(self) -> float:
        return math.hypot(self.random, self.correlated)


def region_error(
    sigma: Float32[np.ndarray, "rows columns"] | float,
    region: Bool[np.ndarray, "rows columns"],
    variogram: Variogram,
    cell_m: float,
) -> RegionError:
    """Deviation of the sum of errors over a region, from the covariances of all its pairs of cells.

    Args:
        sigma: deviation of each cell, or of all.
        region: the cells that are summed.
    """
    if not region.any():
        return RegionError(0.0, 0.0)
    reduced = _reduced(region, sigma)
    correlated = max(0.0, float(reduced.pair_sums(variogram, cell_m)[0, 0]))
    return RegionError(math.sqrt(variogram.nugget * float(reduced.squares[0, 0])), math.sqrt(correlated))


def _extent(region: Bool[np.ndarray, "rows columns"]) -> tuple[slice, slice]:
    """The rows and columns that a region covers."""
    rows, columns = (np.flatnonzero(region.any(axis)) for axis in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def pair_covariance(
    region: Bool[np.ndarray, "rows columns"],
    terms: Sequence[tuple[np.ndarray, np.ndarray]],
    sigma: Float32[np.ndarray, "rows columns"] | float,
    variogram: Variogram,
    cell_m: float,
) -> tuple[Float64[np.ndarray, "terms terms"], Float64[np.ndarray, "terms terms"]]:
    """X^T X and X^T C X over a region, for C the covariance of the errors and X columns that are a product each.

    (X^T X)^-1 X^T C X (X^T X)^-1 is the covariance of a least-squares fit of the columns.

    Args:
        terms: of each column of X, its factor of the rows and of the columns of the raster.
    """
    reduced = _reduced(region, sigma, terms)
    return reduced.normal, variogram.nugget * reduced.squares + reduced.pair_sums(variogram, cell_m)


@dataclass(frozen=True)
class _Reduced:
    """Columns of values over a region, reduced to sums over blocks of cells.

    Attributes:
        normal: sums of the products of two columns.
        squares: the same of the columns times sigma, as are blocks and within.
        blocks: sums over blocks.
        within: sums of the products of two cells of the same block, by their offset along rows and columns, over the
            blocks that the region covers in part.
        size: rows and columns of cells in a block.
    """

    normal: Float64[np.ndarray, "terms terms"]
    squares: Float64[np.ndarray, "terms terms"]
    blocks: Float64[np.ndarray, "terms rows columns"]
    within: Float64[np.ndarray, "terms terms down across"]
    size: tuple[int, int]

    def pair_sums(self, variogram: Variogram, cell_m: float) -> Float64[np.ndarray, "terms terms"]:
        """Sums over all pairs of cells of their product times their correlation, without the nugget."""
        found = np.array(
            [[_pair_sum(one, variogram, self.size, cell_m, other) for other in self.blocks] for one in self.blocks]
        )
        if self.size == (1, 1):
            return found
        # Cells that fill a block in part, as those of a road do, are closer together than those of a whole one.
        r, c = (cell_m * np.fft.fftfreq(n, 1 / n) for n in self.within.shape[2:])
        missing = variogram.correlation(np.hypot(r[:, None], c[None]))
        missing -= _near_correlation(variogram, self.size, cell_m, (1, 1))[0, 0]
        return found + (self.within * missing).sum(axis=(2, 3))


def _reduced(
    region: Bool[np.ndarray, "rows columns"],
    sigma: Float32[np.ndarray, "rows columns"] | float,
    terms: Sequence[tuple[np.ndarray, np.ndarray]] | None = None,
) -> _Reduced:
    """Reduce columns of values times sigma to blocks.

    Args:
        terms: as in `pair_covariance`; one column of ones if None.
    """
    box = _extent(region)
    if terms is None:
        terms = [(np.ones(region.shape[0]), np.ones(region.shape[1]))]
    terms = [(of_rows[box[0]], of_columns[box[1]]) for of_rows, of_columns in terms]
    region, sigma = region[box], sigma[box] if isinstance(sigma, np.ndarray) else sigma
    down, across = size = _block_size(region.shape)
    normal, squares = np.zeros((2, len(terms), len(terms)))
    blocks = np.zeros((len(terms), -(-region.shape[0] // down), -(-region.shape[1] // across)))
    within = np.zeros((len(terms), len(terms), 2 * down, 2 * across))
    step = max(1, _AT_ONCE // (down * region.shape[1]))
    for k in range(0, blocks.shape[1], step):
        rows = slice(k * down, (k + step) * down)
        inside = region[rows]
        if not inside.any():
            continue
        s = sigma[rows] if isinstance(sigma, np.ndarray) else sigma
        columns = [of_rows[rows, None] * of_columns[None] * inside for of_rows, of_columns in terms]
        scaled = [np.where(inside, column * s, 0) for column in columns]
        for i, column in enumerate(columns):
            blocks[i, k : k + step] = _block_sums(scaled[i], size)
            for j, other in enumerate(columns):
                normal[i, j] += float((column * other).sum())
                squares[i, j] += float((scaled[i] * scaled[j]).sum())
        if size != (1, 1):
            within += _products_within(inside, scaled, size)
    return _Reduced(normal, squares, blocks, within, size)


def _products_within(
    inside: Bool[np.ndarray, "rows columns"], columns: list[np.ndarray], size: tuple[int, int]
) -> Float64[np.ndarray, "terms terms down across"]:
    """Sums of the products of two cells of the same block, as `_Reduced` has them."""
    down, across = size
    counts = _block_sums(inside, size)
    at = np.nonzero((counts > 0) & (counts < down * across))
    padding = [(0, n * step - length) for n, step, length in zip(counts.shape, size, inside.shape, strict=True)]
    cells = np.stack([np.pad(column.astype(np.float32), padding) for column in columns])
    cells = cells.reshape(len(columns), counts.shape[0], down, counts.shape[1], across)[:, at[0], :, at[1]]
    spectra = rfft2(cells, (2 * down, 2 * across))  # of blocks and columns
    products = np.einsum("birc,bjrc->ijrc", spectra.conj(), spectra)
    return irfft2(products.astype(np.complex128), (2 * down, 2 * across))


def _block_size(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of the blocks that a raster is reduced to."""
    rows, columns = shape
    return -(-rows // _BLOCKS), -(-columns // _BLOCKS)


def _block_sums(values: np.ndarray, size: tuple[int, int]) -> Float64[np.ndarray, "rows columns"]:
    """Sums over blocks."""
    if size == (1, 1):
        return values.astype(np.float64)
    rows, columns = (np.arange(0, length, step) for length, step in zip(values.shape, size, strict=True))
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0, dtype=np.float64), columns, axis=1)


def _pair_sum(
    blocks: np.ndarray,
    variogram: Variogram,
    size: tuple[int, int],
    cell_m: float,
    others: np.ndarray | None = None,
) -> float:
    """Sum over all pairs of a block and one of the others, of their product times their mean correlation."""
    if not variogram.sills:
        return 0.0
    padded = _padded(*blocks.shape)
    spectrum = rfft2(blocks, padded)
    products = irfft2(np.conj(spectrum) * (spectrum if others is None else rfft2(others, padded)), padded)
    r, c = (np.abs(np.fft.fftfreq(n, 1 / n)) * step * cell_m for n, step in zip(padded, size, strict=True))
    correlation = variogram.correlation(np.hypot(r[:, None], c[None]))
    near = tuple(min(n, -(-_NEAR * max(size) // step)) for n, step in zip(blocks.shape, size, strict=True))
    by_offset = _near_correlation(variogram, size, cell_m, near)
    rows, columns = (np.arange(1 - n, n) for n in near)
    correlation[np.ix_(rows, columns)] = by_offset[np.ix_(np.abs(rows), np.abs(columns))]
    return float((products * correlation).sum())
