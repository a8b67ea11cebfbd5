"""Where the waterline was, how far it moved, and how much ground lies below given levels.

The later heights are those after co-registration, so that levels are in the earlier survey's heights. What is wrong
with a level is worth as much horizontally as the ground is flat: an error of 2 cm is 2 m on a slope of 1%. So areas
come with the interval that they have when the later heights are moved by the standard error of the mean dz of the
cells near the level, which has the random, the correlated and the systematic part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float32
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter
from scipy.spatial import KDTree

from tidefield.change.cover import Area, small_patches
from tidefield.change.measure import Change
from tidefield.change.statistics import Z95
from tidefield.change.surfaces import Grid
from tidefield.maps.smoothing import smoothed

_SMOOTH = 5
"""Cells along each side of the window whose mean height is compared with a level."""
_LEAST_M2 = 10.0
"""Smaller pools and islands are left out of the waterlines."""
_SCATTER = 2.0
"""Deviations of a cell's error above its level up to which ground is wet; chosen on built-in pairs 5 to 8, 100 and 101
of vegetation, tidal_trees and river_mouths."""
_BAND = 3.0
"""Deviations of a cell's error: cells so near a level, at either date, decide where its line is."""
_STEP_M = 1.0
"""Between the points of the later waterline that distances are measured from."""
_ROUNDED = 4.0
"""Deviation in cells of the Gaussian that rounds waterlines: the steps of cells would make them too long."""
_MOST_CELLS = 16_000_000
"""Of the grid that lines are drawn on."""
Lines = list[shapely.LineString]


@dataclass(frozen=True)
class Below:
    """Ground below a level, square metres.

    Attributes:
        change_m2: later minus earlier, and its 95% interval.
    """

    level_m: float
    earlier_m2: float
    later_m2: float
    change_m2: float
    low_m2: float
    high_m2: float


@dataclass(frozen=True)
class Waterline:
    """The edge of the water at two dates.

    Attributes:
        levels_m: of the water, in the earlier survey's heights.
        lines: of both dates, in map coordinates.
        wet: cells under water at one date or both.
        land_gained, land_lost: dry at one date only, with 95% intervals of the later heights near the level.
        move_m: mean move towards the water (positive: the land grew), and its 95% interval; NaN where one date has no
            line.
        quantiles_m: 5, 50 and 95% of the distances of the later line's points from the earlier line, with that sign;
            likewise.
    """

    levels_m: tuple[float, float]
    lines: tuple[Lines, Lines]
    wet: Bool[np.ndarray, "rows columns"]
    land_gained: Area
    land_lost: Area
    move_m: tuple[float, float, float]
    quantiles_m: tuple[float, float, float]


@dataclass(frozen=True)
class Water:
    """What was asked about levels."""

    waterline: Waterline | None
    below: list[Below]

    def to_json(self) -> dict[str, Any]:
        line = self.waterline
        return {
            "waterline": None
            if line is None
            else {
                "levels_m": list(line.levels_m),
                "lengths_m": [sum(part.length for part in lines) for lines in line.lines],
                **_ends("land_gained", line.land_gained),
                **_ends("land_lost", line.land_lost),
                **dict(zip(("move_m", "move_low_m", "move_high_m"), map(_known, line.move_m), strict=True)),
                "quantiles_m": [_known(value) for value in line.quantiles_m],
            },
            "below": [vars(of) for of in self.below],
        }


def _ends(name: str, area: Area) -> dict[str, float]:
    return {f"{name}_m2": area.value_m2, f"{name}_low_m2": area.low_m2, f"{name}_high_m2": area.high_m2}


def _known(value: float) -> float | None:
    """A number for JSON, which has none that is not finite."""
    return value if math.isfinite(value) else None


def measure_water(change: Change, water: tuple[float, float] | None, levels: tuple[float, ...]) -> Water:
    """Compare the ground at both dates with levels.

    Args:
        water: heights of the water at both dates, in the earlier survey's unit; None where they are not known.
        levels: that areas are asked of, in that unit.
    """
    metres = change.earlier.metres
    earlier, later = _heights(change)
    below = []
    for level in (metres * level for level in levels):
        error = _level_error(change, earlier, later, (level, level))
        below.append(_below(earlier, later, level, Z95 * error, change.grid.cell_area_m2))
    line = None if water is None else _waterline(change, earlier, later, (metres * water[0], metres * water[1]))
    return Water(line, below)


def _heights(change: Change) -> tuple[Float32[np.ndarray, "rows columns"], Float32[np.ndarray, "rows columns"]]:
    """Mean heights of both dates in small windows, NaN where there are none."""
    heights = np.empty(change.grid.shape, np.float32)
    with change.earlier.on_grid(change.grid) as read:
        for rows in change.grid.strips():
            heights[rows] = read(rows.start, rows.stop)
    dz = change.with_water
    known = np.isfinite(dz) & np.isfinite(heights)
    weight = np.maximum(uniform_filter(known.astype(np.float32), _SMOOTH, mode="constant"), np.float32(1e-6))
    found = []
    for values in (heights, heights + dz):
        mean = uniform_filter(np.where(known, values, np.float32(0)), _SMOOTH, mode="constant") / weight
        mean[~known] = np.nan
        found.append(mean)
    return found[0], found[1]


def _level_error(change: Change, earlier: np.ndarray, later: np.ndarray, levels: tuple[float, float]) -> float:
    """One sigma of the mean dz of the cells near a level, metres."""
    near = np.zeros(change.grid.shape, bool)
    for rows in change.grid.strips():
        reach = _BAND * change.errors.cell_sigma(rows)
        for heights, level in ((earlier, levels[0]), (later, levels[1])):
            near[rows] |= np.abs(heights[rows] - level) < reach
    dz = change.with_water
    near &= np.isfinite(dz)
    if not near.any():
        return 0.0
    volume = change.errors.volume(dz, near)
    return volume.factor / Z95 * volume.sigma_m3 / volume.area_m2


def _below(earlier: np.ndarray, later: np.ndarray, level: float, half_m: float, cell_m2: float) -> Below:
    before = float((earlier < level).sum()) * cell_m2
    ends = [float((later < level + move).sum()) * cell_m2 - before for move in (-half_m, 0.0, half_m)]
    return Below(level, before, before + ends[1], ends[1], ends[0], ends[2])


def _waterline(change: Change, earlier: np.ndarray, later: np.ndarray, levels: tuple[float, float]) -> Waterline:
    grid = change.grid
    step = 1 + math.isqrt(grid.rows * grid.columns // _MOST_CELLS)
    thin = grid.thinned(step)
    known = np.isfinite(earlier)
    # Heights of water scatter around its level: what is above by no more than this is wet, too.
    margin = _SCATTER * change.detection_m[1] / Z95 / math.sqrt(2)
    half = Z95 * _level_error(change, earlier, later, levels)
    before, *after = (
        _without_specks((heights < level + margin) & known, known, grid)
        for heights, level in ((earlier, levels[0]), *((later, levels[1] + by) for by in (0.0, -half, half)))
    )
    wet = (before, after[0])
    lines = [_edges(w[::step, ::step], known[::step, ::step], thin) for w in wet]
    gained = [float((before & ~w).sum()) * grid.cell_area_m2 for w in after]
    lost = [float((w & ~before).sum()) * grid.cell_area_m2 for w in after]
    moves = (math.nan, math.nan, math.nan)
    if all(lines):
        length = float(np.mean([sum(part.length for part in part_of) for part_of in lines]))
        move, high, low = ((more - less) / length for more, less in zip(gained, lost, strict=True))
        moves = move, low, high
    return Waterline(
        levels,
        (lines[0], lines[1]),
        before | after[0],
        Area(gained[0], min(gained), max(gained)),
        Area(lost[0], min(lost), max(lost)),
        moves,
        _distances(lines[0], lines[1], before, grid),
    )


def _without_specks(
    wet: Bool[np.ndarray, "rows columns"], known: Bool[np.ndarray, "rows columns"], grid: Grid
) -> Bool[np.ndarray, "rows columns"]:
    """Water without small pools, and without small islands in it."""
    for region in (True, False):
        specks = small_patches(wet if region else known & ~wet, grid, _LEAST_M2)
        wet = wet & ~specks if region else wet | specks
    return wet


def _edges(wet: Bool[np.ndarray, "rows columns"], known: Bool[np.ndarray, "rows columns"], grid: Grid) -> Lines:
    """Lines between wet and dry cells; the edge of what is known is none."""
    from contourpy import LineType, contour_generator

    if not (wet.any() and (known & ~wet).any()):
        return []
    # A line that unknown cells touch follows these, not the water.
    sure = np.asarray(minimum_filter(known.astype(np.uint8), 3, mode="nearest"), np.uint8).view(bool)
    masked = np.ma.masked_array(smoothed(wet, known, _ROUNDED), ~sure)
    east = grid.west_m + (np.arange(wet.shape[1]) + 0.5) * grid.cell_m
    north = grid.north_m - (np.arange(wet.shape[0]) + 0.5) * grid.cell_m
    generator = contour_generator(east, north, masked, line_type=LineType.Separate)
    parts = [np.asarray(line) for line in generator.lines(0.5)]
    lines = [shapely.LineString(shapely.LineString(part).simplify(0.5 * grid.cell_m).coords) for part in parts]
    return [line for line in lines if line.length > 4 * grid.cell_m]


def _distances(
    earlier: Lines, later: Lines, wet: Bool[np.ndarray, "rows columns"], grid: Grid
) -> tuple[float, float, float]:
    """Quantiles of the later line's distances from the earlier one; positive where the earlier date was wet."""
    if not earlier or not later:
        return math.nan, math.nan, math.nan
    here, there = (_points(lines) for lines in (later, earlier))
    distance, _ = KDTree(there).query(here)
    # Half a cell beside the line both are as good.
    column = np.clip(((here[:, 0] - grid.west_m) / grid.cell_m).astype(int), 0, grid.columns - 1)
    row = np.clip(((grid.north_m - here[:, 1]) / grid.cell_m).astype(int), 0, grid.rows - 1)
    signed = np.where(_spread(wet)[row, column], distance, -distance)
    low, middle, high = np.quantile(signed, (0.05, 0.5, 0.95)).tolist()
    return low, middle, high


def _spread(wet: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    return np.asarray(maximum_filter(wet.view(np.uint8), 3, mode="nearest"), np.uint8).view(bool)


def _points(lines: Lines) -> np.ndarray:
    return np.concatenate(
        [
            shapely.get_coordinates(line.interpolate(np.arange(0, line.length, _STEP_M)))
            if line.length > _STEP_M
            else shapely.get_coordinates(line.centroid)
            for line in lines
        ]
    )
