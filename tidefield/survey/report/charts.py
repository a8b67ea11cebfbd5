"""Small charts as numbers in the units of the SVGs that `templates/charts.svg` draws."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tidefield.survey.report.findings import Residuals
from tidefield.survey.report.graticule import round_step, spaced

WIDTH, HEIGHT = 340.0, 190.0
LEFT, RIGHT, TOP, BOTTOM = 44.0, 10.0, 12.0, 40.0
SCATTER = 220.0  # side of the plan of residuals
STRIP = 70.0  # width of the column of heights beside it


@dataclass(frozen=True)
class Mark:
    """A label on an axis: its place along the axis and its text."""

    at: float
    label: str


@dataclass(frozen=True)
class Bar:
    """One bar of a histogram, as a rectangle, and what to read off it."""

    x: float
    y: float
    width: float
    height: float
    label: str


@dataclass(frozen=True)
class Bars:
    """A histogram."""

    title: str
    description: str
    axis: str
    across: list[Mark]
    up: list[Mark]
    bars: list[Bar]
    width: float = WIDTH
    height: float = HEIGHT
    left: float = LEFT
    right: float = WIDTH - RIGHT
    bottom: float = HEIGHT - BOTTOM


@dataclass(frozen=True)
class Scatter:
    """Residuals in plan, and their heights beside.

    Attributes:
        dots: x, y in plan and y in the column of heights, of those that were used; `misses` of the others.
        rings: radii and their labels.
    """

    title: str
    description: str
    dots: list[tuple[float, float, float, str]]
    misses: list[tuple[float, float, float, str]]
    rings: list[Mark]
    side: float = SCATTER
    strip: float = STRIP


def bars(title: str, axis: str, counts: list[int], edges: list[float], digits: int | None = None) -> Bars:
    """A histogram of counts between edges; whole numbers with a bar each if `digits` is None."""
    tallest = max(max(counts, default=0), 1)
    step = max(round_step(tallest / 4), 1.0)
    top = math.ceil(tallest / step) * step
    low, high = edges[0], edges[-1]
    across, up = (WIDTH - LEFT - RIGHT) / (high - low), (HEIGHT - TOP - BOTTOM) / top
    rectangles = []
    for count, start, end in zip(counts, edges[:-1], edges[1:], strict=True):
        x, height = LEFT + (start - low) * across, count * up
        what = f"{(start + end) / 2:g}" if digits is None else f"{start:.{digits}f} to {end:.{digits}f}"
        width = max((end - start) * across - 1, 0.5)
        rectangles.append(Bar(x + 0.5, HEIGHT - BOTTOM - height, width, height, f"{what}: {spaced(count)}"))
    return Bars(
        title=title,
        description=_described(counts, edges, digits),
        axis=axis,
        across=_across(low, high, across, digits),
        up=[Mark(HEIGHT - BOTTOM - i * step * up, spaced(i * step)) for i in range(round(top / step) + 1)],
        bars=rectangles,
    )


def histogram(title: str, axis: str, values: np.ndarray, digits: int) -> Bars | None:
    """The histogram of the known among some values; None if there are fewer than two."""
    known = values[np.isfinite(values)]
    if len(known) < 2:
        return None
    low, high = np.percentile(known, [0.5, 99.5])
    low, high = (low, high) if high - low > 1e-9 else (low - 0.5 * 10**-digits, low + 0.5 * 10**-digits)
    counts, edges = np.histogram(np.clip(known, low, high), min(24, max(6, round(math.sqrt(len(known))))), (low, high))
    return bars(title, axis, counts.tolist(), edges.tolist(), digits)


def scatter(residuals: Residuals, unit: str) -> Scatter | None:
    """The plan of residuals; None if there are none."""
    known = np.all(np.isfinite(residuals.east_north_up_m), axis=1)
    if not (known & residuals.used).any():
        return None
    errors, used = residuals.east_north_up_m[known], residuals.used[known]
    largest = max(float(np.abs(errors[used]).max()), 1e-6)
    step = round_step(largest / 3)
    reach = step * math.ceil(largest / step - 1e-9)
    middle = SCATTER / 2
    scale = (middle - 8) / reach
    places = np.clip(errors * scale, 4 - middle, middle - 4)  # a miss may lie far outside
    dots: dict[bool, list[tuple[float, float, float, str]]] = {True: [], False: []}
    names = [name for name, shown in zip(residuals.names, known, strict=True) if shown]
    for name, (x, y, z), kept in zip(names, places.tolist(), used.tolist(), strict=True):
        dots[kept].append((middle + x, middle - y, middle - z, name))
    horizontal = np.hypot(errors[used, 0], errors[used, 1])
    return Scatter(
        title=residuals.title,
        description=f"Residuals in plan, the largest {horizontal.max():.3f} {unit} long, and their heights beside.",
        dots=dots[True],
        misses=dots[False],
        rings=[Mark(i * step * scale, f"{i * step:g} {unit}") for i in range(1, round(reach / step) + 1)],
    )


def _across(low: float, high: float, scale: float, digits: int | None) -> list[Mark]:
    step = round_step((high - low) / 6)
    if digits is None:
        step = max(step, 1.0)
    values = np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1) * step
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return [Mark(LEFT + (value - low) * scale, f"{value:.{decimals}f}") for value in values.tolist()]


def _described(counts: list[int], edges: list[float], digits: int | None) -> str:
    most = int(np.argmax(counts))
    start, end = edges[most], edges[most + 1]
    where = f"at {(start + end) / 2:g}" if digits is None else f"between {start:.{digits}f} and {end:.{digits}f}"
    return f"{spaced(sum(counts))} values; most, {spaced(counts[most])}, {where}."
