"""A sheet of paper over World's x and y, with a grid and geographic coordinates in its margins.

Over so little of the Earth, both are affine in x and y to less than a line's width.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

LABEL_HALF = 32.0
"""Half the length of a label, units of the paper."""

Affine = Float64[np.ndarray, "2 3"]


@dataclass(frozen=True)
class Sheet:
    """Where World's x and y fall on the paper, whose y points down.

    Attributes:
        low, high: World's x and y at the frame's south-western and north-eastern corners.
        scale: units of the paper per unit of World.
        left, top: the frame's north-western corner on the paper.
    """

    low: Float64[np.ndarray, " 2"]
    high: Float64[np.ndarray, " 2"]
    scale: float
    left: float
    top: float

    def at(self, xy: Float64[np.ndarray, "K 2"]) -> Float64[np.ndarray, "K 2"]:
        """Places on the paper."""
        x, y = xy.T
        return np.c_[self.left + (x - self.low[0]) * self.scale, self.top + (self.high[1] - y) * self.scale]

    def holds(self, xy: Float64[np.ndarray, "K 2"]) -> Bool[np.ndarray, " K"]:
        """Whether places lie inside the frame."""
        return np.all((xy >= self.low) & (xy <= self.high), axis=1)


@dataclass(frozen=True)
class Line:
    """A line on the paper with a label at its first end; the label is empty where that end is outside the frame, or so
    close to a corner that labels of two sides would meet."""

    x0: float
    y0: float
    x1: float
    y1: float
    label: str


def affine(sheet: Sheet, transform: Callable[[np.ndarray], np.ndarray]) -> Affine:
    """The matrix that takes (x, y, 1) in World to the first two of `transform`'s coordinates."""
    x, y = np.meshgrid(*np.linspace(sheet.low, sheet.high, 3).T)
    design = np.stack([x.ravel(), y.ravel(), np.ones(9)], 1)
    there = transform(np.c_[design[:, :2], np.zeros(9)])[:, :2]
    return np.linalg.lstsq(design, there, rcond=None)[0].T


def grid_lines(sheet: Sheet, grid: Affine, axis: int) -> list[Line]:
    """Lines of equal easting (axis 0, labelled below) or northing (axis 1, labelled on the left)."""
    step = round_step(float((sheet.high - sheet.low).max() * np.linalg.norm(grid[axis, :2])) / 6.5)
    edge, opposite = float(sheet.low[1 - axis]), float(sheet.high[1 - axis])
    lines = []
    for value in _multiples(sheet, grid, axis, step):
        ends = np.stack([_crossing(grid, axis, value, edge), _crossing(grid, axis, value, opposite)])
        (x0, y0), (x1, y1) = sheet.at(ends).tolist()
        label = spaced(value, _decimals(step))
        lines.append(Line(x0, y0, x1, y1, label if _has_room(sheet, ends[:1], axis) else ""))
    return lines


def degree_ticks(sheet: Sheet, geographic: Affine, axis: int, length: float = 5) -> list[Line]:
    """Ticks of longitude (axis 0, above) or latitude (axis 1, on the right), outside the frame."""
    span = float(np.abs(geographic[axis, :2]) @ (sheet.high - sheet.low))
    step = round_step(span / 4.5)
    ticks = []
    for value in _multiples(sheet, geographic, axis, step):
        place = _crossing(geographic, axis, value, float(sheet.high[1 - axis]))[None]
        if sheet.holds(place)[0]:
            x, y = sheet.at(place)[0].tolist()
            label = f"{abs(value):.{_decimals(step)}f}° {('EW', 'NS')[axis][value < 0]}"
            label = label if _has_room(sheet, place, axis) else ""
            ticks.append(Line(x, y, x, y - length, label) if axis == 0 else Line(x, y, x + length, y, label))
    return ticks


def _has_room(sheet: Sheet, place: Float64[np.ndarray, "1 2"], axis: int) -> bool:
    """Whether a label centred at a place on the frame keeps clear of the corners."""
    gap = place[0, axis] - sheet.low[axis], sheet.high[axis] - place[0, axis]
    return bool(sheet.holds(place)[0] and sheet.scale * min(gap) >= LABEL_HALF)


def round_step(least: float) -> float:
    """1, 2 or 5 times a power of ten, not less than `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= least * (1 - 1e-9))


def spaced(value: float | int, digits: int = 0) -> str:
    """A number with narrow spaces between its thousands and a true minus."""
    return f"{value:,.{digits}f}".replace(",", "\u202f").replace("-", "\u2212")


def _crossing(matrix: Affine, axis: int, value: float, edge: float) -> Float64[np.ndarray, " 2"]:
    """Where a coordinate takes a value on an edge of the frame: a horizontal one for axis 0, an upright one for 1."""
    along, across = matrix[axis, axis], matrix[axis, 1 - axis]
    place = np.array([edge, edge])
    place[axis] = (value - matrix[axis, 2] - across * edge) / along
    return place


def _multiples(sheet: Sheet, matrix: Affine, axis: int, step: float) -> list[float]:
    corners = np.array([(x, y, 1) for x in (sheet.low[0], sheet.high[0]) for y in (sheet.low[1], sheet.high[1])])
    values = corners @ matrix[axis]
    return (np.arange(math.ceil(values.min() / step), math.floor(values.max() / step) + 1) * step).tolist()


def _decimals(step: float) -> int:
    return max(0, -math.floor(math.log10(step) + 1e-9))
