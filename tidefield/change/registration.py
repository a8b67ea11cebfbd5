"""Co-registration of two surveys over stable ground: the vertical shift and tilt between them, and their error.

The later survey is moved onto the earlier one. What is left of the error is common to all cells, and is the systematic
part of every volume.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64

from tidefield.change.errors import pair_covariance
from tidefield.change.statistics import deviation95, nmad
from tidefield.change.surfaces import ChangeError, Grid
from tidefield.change.variogram import Variogram

LEAST_STABLE = 100
"""Cells of stable ground."""
_TRIM = 3.0
"""Residuals beyond this many deviations are left out of means."""
_SIDES = 4
_MOST_FITTED = 2_000_000
"""Cells of stable ground; of more, every second, third, ... in both directions."""
Model = Literal["none", "vertical", "tilt"]


@dataclass(frozen=True)
class Registration:
    """What was subtracted from the later survey, c + gx x + gy y with x, y from the centre of the grid, and its error.

    Attributes:
        model: what was estimated.
        coefficients: c in metres, gx and gy in metres per metre.
        covariance: of the coefficients; of what is left as a systematic error.
        centre_m: east and north that x and y are counted from.
        shift_m: how far the later survey was moved to the east and north.
        shift_error_m: one sigma of that in each direction; 0 where it was neither measured nor stated.
        shift_stated: whether the user stated that, and nothing was moved.
        stable_cells: on which it was estimated.
        before, after: median, NMAD and 95% deviation of dz over stable ground, metres.
        words: how it was done, for the report.
    """

    model: Model
    coefficients: tuple[float, float, float]
    covariance: Float64[np.ndarray, "3 3"]
    centre_m: tuple[float, float]
    stable_cells: int
    before: tuple[float, float, float]
    after: tuple[float, float, float]
    shift_m: tuple[float, float] = (0.0, 0.0)
    shift_error_m: float = 0.0
    shift_stated: bool = False
    words: list[str] = field(default_factory=list)

    @property
    def vertical_m(self) -> float:
        return self.coefficients[0]

    @property
    def systematic_m(self) -> float:
        """One sigma of the error at the centre."""
        return math.sqrt(self.covariance[0, 0])

    def near(self, grid: Grid) -> Float32[np.ndarray, "rows columns"] | float:
        """One sigma of the error that a cell shares with all around it: of each cell where there is a tilt."""
        return self.deviation(grid, slice(0, grid.rows)) if self.model == "tilt" else self.systematic_m

    def plane(self, grid: Grid, rows: slice) -> Float32[np.ndarray, "rows columns"]:
        """What was subtracted, for some rows of a grid."""
        return _plane(self.coefficients, self.centre_m, grid, rows)

    def deviation(self, grid: Grid, rows: slice) -> Float32[np.ndarray, "rows columns"]:
        """One sigma of the systematic error of each cell, for some rows of a grid."""
        x, y = offsets(grid, self.centre_m, rows)
        return self._deviation(x[None], y[:, None]).astype(np.float32)

    def deviation_at(self, xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """One sigma of the systematic error of heights at points of the grid's system."""
        return self._deviation(*(xyz[:, :2] - self.centre_m).T)

    def moved(self, xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Points of the later survey, in the grid's system, moved onto the earlier one."""
        moved = xyz + np.array([*self.shift_m, 0.0])
        moved[:, 2] -= self.lift_at(moved[:, :2])
        return moved

    def lift_at(self, xy: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, " N"]:
        """What is taken from the later heights at places in the grid's system, metres."""
        c, gx, gy = self.coefficients
        x, y = (xy - self.centre_m).T
        return c + gx * x + gy * y

    def _deviation(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        v = self.covariance
        square = v[0, 0] + 2 * v[0, 1] * x + 2 * v[0, 2] * y + v[1, 1] * x**2 + 2 * v[1, 2] * x * y + v[2, 2] * y**2
        return np.sqrt(np.maximum(square, 0))

    def deviation_of_sum(
        self, grid: Grid, region: Bool[np.ndarray, "rows columns"], box: tuple[slice, slice] | None = None
    ) -> float:
        """One sigma of the systematic error of a sum of dz over a region, metres times cells.

        Args:
            box: the rows and columns of the grid that the region covers; all if None.
        """
        rows, columns = box or (slice(0, grid.rows), slice(0, grid.columns))
        x, y = offsets(grid, self.centre_m, rows)
        x = x[columns]
        down, across = region.sum(axis=1, dtype=np.float64), region.sum(axis=0, dtype=np.float64)
        sums = np.array([down.sum(), across @ x, down @ y])
        return math.sqrt(max(0.0, float(sums @ self.covariance @ sums)))


def offsets(grid: Grid, centre_m: tuple[float, float], rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """East of the columns' centres and north of the rows' from a point, metres."""
    x = grid.west_m - centre_m[0] + (np.arange(grid.columns) + 0.5) * grid.cell_m
    y = grid.north_m - centre_m[1] - (np.arange(rows.start, rows.stop) + 0.5) * grid.cell_m
    return x, y


def centre(grid: Grid) -> tuple[float, float]:
    """East and north of the middle of a grid."""
    west, south, east, north = grid.bounds
    return (west + east) / 2, (south + north) / 2


def fit(
    dz: Float32[np.ndarray, "rows columns"],
    stable: Bool[np.ndarray, "rows columns"],
    grid: Grid,
    model: Model,
    rounding: float = 0.0,
) -> tuple[float, float, float]:
    """The shift or plane of dz over stable ground, by means without outliers.

    Args:
        rounding: one sigma of what the rounding of heights does to dz, metres: of heights that are mostly the same
            after it, the few others tell the shift.

    Raises:
        ChangeError: a tilt is asked for, and stable ground is not on all sides.
    """
    step = 1 + math.isqrt(max(0, int(stable.sum()) - 1) // _MOST_FITTED)
    rows, columns = step * np.array(np.nonzero(stable[::step, ::step]))
    values = dz[rows, columns].astype(np.float64)
    if model == "none":
        return 0.0, 0.0, 0.0
    x, y = offsets(grid, centre(grid), slice(0, grid.rows))
    if model == "tilt":
        _require_all_sides(rows, columns, grid)
        basis = np.stack([np.ones(len(values)), x[columns], y[rows]], axis=1)
    else:
        basis = np.ones((len(values), 1))
    solution = np.zeros(basis.shape[1])
    solution[0] = np.median(values)
    for _ in range(6):
        residual = values - basis @ solution
        residual -= np.median(residual)
        kept = np.abs(residual) <= _TRIM * max(nmad(residual), rounding, 1e-9)
        solution = np.linalg.lstsq(basis[kept], values[kept], rcond=None)[0]
    c, gx, gy = np.pad(solution, (0, 3 - len(solution))).tolist()
    return c, gx, gy


def covariance(
    model: Model,
    stable: Bool[np.ndarray, "rows columns"],
    sigma: Float32[np.ndarray, "rows columns"] | float,
    variogram: Variogram,
    grid: Grid,
    left_m: float,
    datum_error_m: float | None,
) -> Float64[np.ndarray, "3 3"]:
    """Covariance of the systematic error that a registration leaves.

    An estimate over stable ground has the error of a mean over it, with the correlation between its cells. Without an
    estimate, the systematic error is what control leaves, or what stable ground shows, whichever is given.

    Args:
        left_m: mean of dz over stable ground, where nothing is subtracted.
        datum_error_m: one sigma of the systematic error, as the user knows it.
    """
    found = np.zeros((3, 3))
    if model == "none" and datum_error_m is not None:
        found[0, 0] = datum_error_m**2
        return found
    x, y = offsets(grid, centre(grid), slice(0, grid.rows))
    terms = [(np.ones(grid.rows), np.ones(grid.columns))]
    if model == "tilt":
        terms += [(np.ones(grid.rows), x), (y, np.ones(grid.columns))]
    normal, middle = pair_covariance(stable, terms, sigma, variogram, grid.cell_m)
    inverse = np.linalg.inv(normal)
    size = len(terms)
    found[:size, :size] = inverse @ middle @ inverse
    if model == "none":
        found[0, 0] += left_m**2
    if datum_error_m is not None:
        found[0, 0] += datum_error_m**2
    return found


def lowered(
    dz: Float32[np.ndarray, "rows columns"], coefficients: tuple[float, float, float], grid: Grid
) -> Float32[np.ndarray, "rows columns"]:
    """dz without the shift or plane that `fit` found."""
    out = np.empty_like(dz)
    for rows in grid.strips():
        out[rows] = dz[rows] - _plane(coefficients, centre(grid), grid, rows)
    return out


def _plane(
    coefficients: tuple[float, float, float], centre_m: tuple[float, float], grid: Grid, rows: slice
) -> Float32[np.ndarray, "rows columns"]:
    c, gx, gy = coefficients
    x, y = offsets(grid, centre_m, rows)
    return (c + gx * x[None] + gy * y[:, None]).astype(np.float32)


def statistics(values: Float32[np.ndarray, " N"]) -> tuple[float, float, float]:
    """Median, NMAD, and 95% deviation about the median."""
    middle = float(np.median(values))
    return middle, nmad(values), deviation95(values - middle)


def _require_all_sides(rows: np.ndarray, columns: np.ndarray, grid: Grid) -> None:
    """Raises: ChangeError when stable ground leaves out a side of the survey, where a tilt would be a guess."""
    angle = np.arctan2(rows - grid.rows / 2, columns - grid.columns / 2)
    far = np.hypot((rows - grid.rows / 2) / grid.rows, (columns - grid.columns / 2) / grid.columns) > 0.15
    counts = np.histogram(angle[far], bins=_SIDES, range=(-math.pi, math.pi))[0]
    if counts.min() < LEAST_STABLE / _SIDES:
        raise ChangeError(
            f"a tilt was asked for, but {int((counts < LEAST_STABLE / _SIDES).sum())} of {_SIDES} sides of the surveys "
            "have no stable ground: expected some on all sides, else the tilt is a guess; give more stable ground, or "
            "--register vertical"
        )
