"""Volumes of change with 95% intervals: from the random, the correlated and the systematic part of the error."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from tidefield.change.errors import Z95, Variogram, region_error
from tidefield.change.registration import Registration
from tidefield.change.surfaces import Grid


@dataclass(frozen=True)
class Volume:
    """A volume and one sigma of the parts of its error, cubic metres.

    Attributes:
        value_m3: positive where ground was gained; cut and fill are both given as positive numbers.
        random_m3: of the part of the error that is independent from cell to cell.
        correlated_m3: of the part that neighbours share.
        systematic_m3: of the part that all cells share.
        area_m2: of the cells that were summed.
    """

    value_m3: float
    random_m3: float
    correlated_m3: float
    systematic_m3: float
    area_m2: float

    @property
    def sigma_m3(self) -> float:
        return math.sqrt(self.random_m3**2 + self.correlated_m3**2 + self.systematic_m3**2)

    @property
    def interval_m3(self) -> tuple[float, float]:
        """Ends of the 95% interval."""
        return self.value_m3 - Z95 * self.sigma_m3, self.value_m3 + Z95 * self.sigma_m3

    @property
    def significant(self) -> bool:
        low, high = self.interval_m3
        return low > 0 or high < 0

    def to_json(self) -> dict[str, Any]:
        low, high = self.interval_m3
        return {**asdict(self), "low_m3": low, "high_m3": high, "significant": self.significant}


@dataclass(frozen=True)
class ErrorModel:
    """All that is known of the error of a difference.

    Attributes:
        sigma: one sigma of each cell's own error (random and correlated), metres.
        variogram: how that is correlated.
        registration: the systematic error.
    """

    sigma: Float32[np.ndarray, "rows columns"] | float
    variogram: Variogram
    registration: Registration
    grid: Grid

    def cell_sigma(self, rows: slice) -> Float32[np.ndarray, "rows columns"]:
        """One sigma of a cell's whole error, for some rows."""
        own = self.sigma[rows] if isinstance(self.sigma, np.ndarray) else np.float32(self.sigma)
        return np.hypot(own, self.registration.deviation(self.grid, rows)).astype(np.float32)

    def volume(
        self,
        dz: Float32[np.ndarray, "rows columns"],
        region: Bool[np.ndarray, "rows columns"],
        scale: float = 1.0,
        bias_m: float = 0.0,
    ) -> Volume:
        """Sum dz over a region.

        Args:
            region: cells that are summed; dz is known in all of them.
            scale: -1 for cut, which is given as a positive number.
            bias_m: metres times cells that are subtracted from the sum.
        """
        area = self.grid.cell_area_m2
        cells, total = 0, 0.0
        for rows in self.grid.strips():
            inside = region[rows]
            cells += int(inside.sum())
            total += float(dz[rows].sum(where=inside, dtype=np.float64))
        own = region_error(self.sigma, region, self.variogram, self.grid.cell_m)
        systematic = self.registration.deviation_of_sum(self.grid, region)
        return Volume(
            scale * (total - bias_m) * area, own.random * area, own.correlated * area, systematic * area, cells * area
        )
