"""Errors of sums: what the size of errors and their correlation over distance do to a volume.

The error of a cell is sigma times a field of unit variance, whose correlation a variogram has. A volume's variance is
the sum of the covariances of all pairs of its cells, which is computed here for the region as it is. For regions much
larger than the range that sum is what Anderson gives in closed form (2019, Uncertainty in quantifying geomorphic
change, doi 10.1002/esp.4551), which `anderson_terms` has.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy.fft import irfft2, rfft2

from tidefield.change.variogram import Variogram, extent_of, near_correlation, padded_size

_BLOCKS = 512
"""Rows and columns to which a region is reduced before its covariances are summed."""
_AT_ONCE = 1 << 20
"""Cells of a region that are reduced to blocks at once."""
_NEAR = 4
"""Blocks closer than so many of their longer sides have their correlation summed over pairs of cells."""


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


def degrees_of_freedom(variogram: Variogram, stable: Bool[np.ndarray, "rows columns"], cell_m: float) -> float:
    """Of the variance of a large region's sum, if sills and ranges were measured on these cells.

    N cells have N^2 / sum rho independent samples of a structure, summed over all their pairs, less one for the
    mean; on ground much larger than its range a these are one for each pi a^2 / 5. Structures are weighted by what
    they add to the variance of a sum (Satterthwaite 1946).
    """
    if not variogram.sills:
        return math.inf
    cells, reduced = int(stable.sum()), _reduced(stable, 1.0)
    parts = []
    for sill, reach in variogram.structures():
        pairs = max(cells, float(reduced.pair_sums(Variogram((1.0,), (reach,)), cell_m)[0, 0]))
        parts.append((sill * reach**2, max(1.0, cells**2 / pairs - 1)))
    return sum(c for c, _ in parts) ** 2 / sum(c**2 / n for c, n in parts)


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
        missing -= near_correlation(variogram, self.size, cell_m, (1, 1))[0, 0]
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
    box = extent_of(region)
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
    padded = padded_size(*blocks.shape)
    spectrum = rfft2(blocks, padded)
    products = irfft2(np.conj(spectrum) * (spectrum if others is None else rfft2(others, padded)), padded)
    r, c = (np.abs(np.fft.fftfreq(n, 1 / n)) * step * cell_m for n, step in zip(padded, size, strict=True))
    correlation = variogram.correlation(np.hypot(r[:, None], c[None]))
    near = tuple(min(n, -(-_NEAR * max(size) // step)) for n, step in zip(blocks.shape, size, strict=True))
    by_offset = near_correlation(variogram, size, cell_m, near)
    rows, columns = (np.arange(1 - n, n) for n in near)
    correlation[np.ix_(rows, columns)] = by_offset[np.ix_(np.abs(rows), np.abs(columns))]
    return float((products * correlation).sum())
