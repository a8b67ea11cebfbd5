"""Volumes of change with 95% intervals: from the random, the correlated and the systematic part of the error."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32
from scipy.special import stdtrit

from tidefield.change.errors import region_error
from tidefield.change.registration import Registration
from tidefield.change.statistics import Z95
from tidefield.change.surfaces import Grid
from tidefield.change.variogram import Variogram


@dataclass(frozen=True)
class Volume:
    """A volume and one sigma of the parts of its error, cubic metres.

    Attributes:
        value_m3: positive where ground was gained; cut and fill are both given as positive numbers.
        random_m3: of the part of the error that is independent from cell to cell.
        correlated_m3: of the part that neighbours share.
        systematic_m3: of the part that all cells share.
        choice_m3: of the choice of the outlines; 0 for regions that were not chosen by the heights.
        area_m2: of the cells that were summed.
        bias_m3: of the choice of the outlines, which was subtracted.
        degrees_of_freedom: of the errors but the random one: how many independent pieces of stable ground they were
            measured on.
        datum_m3: of the systematic part, what the user stated, which was measured nowhere.
    """

    value_m3: float
    random_m3: float
    correlated_m3: float
    systematic_m3: float
    area_m2: float
    choice_m3: float = 0.0
    bias_m3: float = 0.0
    degrees_of_freedom: float = math.inf
    datum_m3: float = 0.0

    @property
    def sigma_m3(self) -> float:
        return math.sqrt(self.random_m3**2 + self.correlated_m3**2 + self.systematic_m3**2 + self.choice_m3**2)

    @property
    def interval_m3(self) -> tuple[float, float]:
        """Ends of the 95% interval."""
        half = self.factor * self.sigma_m3
        return self.value_m3 - half, self.value_m3 + half

    @property
    def factor(self) -> float:
        """Half of the interval over one sigma: 1.96 where errors are well known, more where stable ground is small."""
        measured = self.sigma_m3**2 - self.random_m3**2 - self.datum_m3**2
        if measured <= 0 or math.isinf(self.degrees_of_freedom):
            return Z95
        # Satterthwaite: only a part of the variance is uncertain.
        return float(stdtrit(self.degrees_of_freedom * (self.sigma_m3**2 / measured) ** 2, 0.975))

    def chosen(self, bias_m3: float, deviation_m3: float) -> Volume:
        """The volume of outlines that were chosen by the heights themselves (`tidefield.change.choice`); not below 0.

        Args:
            bias_m3: what the choice adds.
            deviation_m3: one sigma with outlines chosen anew, without the systematic part.
        """
        own = math.hypot(self.random_m3, self.correlated_m3)
        choice = math.sqrt(max(0.0, deviation_m3**2 - own**2))
        value = max(0.0, self.value_m3 - bias_m3)
        return replace(self, value_m3=value, choice_m3=choice, bias_m3=self.value_m3 - value)

    @property
    def significant(self) -> bool:
        low, high = self.interval_m3
        return low > 0 or high < 0

    def to_json(self) -> dict[str, Any]:
        low, high = self.interval_m3
        known = asdict(self)
        if math.isinf(self.degrees_of_freedom):
            known["degrees_of_freedom"] = None
        return {**known, "low_m3": low, "high_m3": high, "significant": self.significant}


@dataclass(frozen=True)
class ErrorModel:
    """All that is known of the error of a difference.

    Attributes:
        sigma: one sigma of each cell's own error (random and correlated), metres.
        variogram: how that is correlated.
        registration: the systematic error.
        degrees_of_freedom: of the correlated and the systematic part, without the datum's.
        slopes: of the ground to the east and north, beyond what the vertical registration takes out of an error of the
            horizontal shift; None where that has no error.
        datum_error_m: one sigma of what the user stated of the systematic error, metres.
    """

    sigma: Float32[np.ndarray, "rows columns"] | float
    variogram: Variogram
    registration: Registration
    grid: Grid
    degrees_of_freedom: float = math.inf
    slopes: Float32[np.ndarray, "2 rows columns"] | None = None
    datum_error_m: float = 0.0

    def cell_sigma(self, rows: slice) -> Float32[np.ndarray, "rows columns"]:
        """One sigma of a cell's whole error, for some rows."""
        return self.cell_sigmas(rows)[0]

    def cell_sigmas(
        self, rows: slice
    ) -> tuple[Float32[np.ndarray, "rows columns"], Float32[np.ndarray, "rows columns"]]:
        """One sigma of a cell's whole error, and of its systematic part, for some rows."""
        own = self.sigma[rows] if isinstance(self.sigma, np.ndarray) else np.float32(self.sigma)
        shared = self._shared(self.registration.deviation(self.grid, rows), rows).astype(np.float32)
        return np.hypot(own, shared).astype(np.float32), shared

    def near_sigma(self) -> Float32[np.ndarray, "rows columns"] | float:
        """One sigma of the error that a cell shares with all around it."""
        near = self.registration.near(self.grid)
        return near if self.slopes is None else self._shared(np.float32(near), slice(0, self.grid.rows))

    def _shared(self, deviation: Any, rows: slice) -> Any:
        """What all cells share, with what an error of the shift does on slopes."""
        if self.slopes is None:
            return deviation
        steepness = np.hypot(*self.slopes[:, rows])
        return np.hypot(deviation, np.float32(self.registration.shift_error_m) * steepness)

    def systematic_of_sum(
        self, region: Bool[np.ndarray, "rows columns"], box: tuple[slice, slice] | None = None
    ) -> float:
        """One sigma of the systematic error of a sum of dz over a region, metres times cells.

        One shift moves all cells, so that its error adds up over a slope and cancels out over a hill.

        Args:
            box: the rows and columns of the grid that the region covers; all if None.
        """
        return math.hypot(self.registration.deviation_of_sum(self.grid, region, box), self._shift_of_sum(region, box))

    def stated_of_sum(self, region: Bool[np.ndarray, "rows columns"], box: tuple[slice, slice] | None = None) -> float:
        """One sigma of what the user stated of a sum's systematic error, metres times cells.

        Args:
            box: the rows and columns of the grid that the region covers; all if None.
        """
        shift = self._shift_of_sum(region, box) if self.registration.shift_stated else 0.0
        return math.hypot(self.datum_error_m * int(region.sum()), shift)

    def _shift_of_sum(self, region: np.ndarray, box: tuple[slice, slice] | None) -> float:
        if self.slopes is None:
            return 0.0
        parts = self.slopes if box is None else self.slopes[:, *box]
        east, north = (float(part.sum(where=region, dtype=np.float64)) for part in parts)
        return self.registration.shift_error_m * math.hypot(east, north)

    def volume(
        self,
        dz: Float32[np.ndarray, "rows columns"],
        region: Bool[np.ndarray, "rows columns"],
        scale: float = 1.0,
        box: tuple[slice, slice] | None = None,
    ) -> Volume:
        """Sum dz over a region.

        Args:
            region: cells that are summed; dz is known in all of them.
            scale: -1 for cut, which is given as a positive number.
            box: the rows and columns of the grid that dz and the region cover; all if None.
        """
        area = self.grid.cell_area_m2
        total = float(dz.sum(where=region, dtype=np.float64))
        sigma = self.sigma[box] if box is not None and isinstance(self.sigma, np.ndarray) else self.sigma
        own = region_error(sigma, region, self.variogram, self.grid.cell_m)
        return Volume(
            scale * total * area + 0.0,  # no minus before a cut of nothing
            own.random * area,
            own.correlated * area,
            self.systematic_of_sum(region, box) * area,
            int(region.sum()) * area,
            degrees_of_freedom=self.degrees_of_freedom,
            datum_m3=self.stated_of_sum(region, box) * area,
        )
