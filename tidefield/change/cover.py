"""Plants gained and lost, from the orthophotos of both surveys after correcting their exposures.

A place is covered where its mean colour is greener than bare ground's by a margin, and in small gaps between such
places, unless it lies in a patch that is as smooth as bare ground: green films and shallow water have no leaves that
shade each other. Bare ground is the lowest of the common values of greenness, unless that is a plant's, as in a meadow.
Areas come with the range that they have when the margin is moved, also by what greenness scatters from date to date
over ground that is bare at both, and when patches, which are plants or none as a whole, are divided into rough and
smooth ground. Gained and lost are at least what is so with each of the margins, and at most what is so with any. What
changed by less than that scatter did not change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32, Int64, UInt8
from scipy.ndimage import label

from tidefield.change.light import greenness, light_gains, with_light
from tidefield.change.nodata import STRIP_CELLS
from tidefield.change.regions import Region
from tidefield.change.shift import picture_grid, read_picture
from tidefield.change.statistics import nmad
from tidefield.change.surfaces import ChangeError, Grid
from tidefield.maps.smoothing import smoothed

MARGIN = 0.065
"""Greenness of plants above that of bare ground. This, `_SPAN` and `_LEAVES_M` were chosen on built-in pairs 5 to 8,
100 to 102, 300 and 301 of vegetation, tidal_trees and river_mouths, by the areas of the plants that are drawn."""
_SPAN = 1.5
"""Areas have the range of margins that are this many times as large and as small."""
_LEAVES_M = 0.2
"""Deviation of the Gaussian window in which plants' colours are averaged: in wider ones patches grow at their edges."""
GAP_M = 0.4
"""Places that are at most so far from plants on all sides are covered: tufts and the mud between them are one cover."""
_WINDOW_M = 0.4
"""Deviation of the Gaussian window in which the colours of bare ground, and how rough it is, are averaged."""
_BARE_MARGIN = 0.035
"""Greenness in that window above that of bare ground, up to which ground is bare."""
ROUGHER = 1.6
"""Variation of light in a patch of plants, over the lower quartile of bare ground's; chosen on pairs 5, 6, 300, 301."""
ROUGH = 0.08
"""Variation of light that is plants' whatever bare ground has, as of grass beside gravel."""
LEAST_M2 = 1.0
"""Smaller patches that were gained or lost are left out."""
_COUNTED = 1 << 24
"""Cells that are counted at once, which takes 8 bytes of each."""
_BIN = 0.004
"""Of the histogram of greenness."""
_COMMON = 0.4
"""A peak of the histogram as high as this share of the highest is common."""
_GREENEST = 0.05
"""Greenness that bare ground has at most: grey has -0.13, and 0.06 in a picture with 20% more green."""
_LEAST_BARE = 0.01
"""With a smaller share of the ground bare at both dates, light and scatter are those of all ground."""
_FINE_M = 1.01 * _LEAVES_M
"""Larger pixels do not show leaves; those of 20 cm do, which a conversion may make a little larger."""
_UNKNOWN = np.int8(-128)


@dataclass(frozen=True)
class Area:
    """An area in square metres, and its range."""

    value_m2: float
    low_m2: float
    high_m2: float


@dataclass(frozen=True)
class Cover:
    """Where plants are at two dates.

    Attributes:
        classes: 0 bare at both dates, 1 gained, -1 lost, 2 covered at both, -128 unknown.
        gains: what the later picture's red, green and blue were multiplied by.
        bare: greenness of bare ground.
        scatter: one sigma of greenness between the dates over bare ground.
        leaves_out_films: whether smooth green patches are none of plants; they are where no ground is bare to compare
            with, and where pixels are too large to show leaves.
        areas: earlier, later, gained and lost, in all and in each of the user's polygons.
    """

    grid: Grid
    classes: Int8[np.ndarray, "rows columns"]
    gains: tuple[float, float, float]
    bare: float
    scatter: float
    leaves_out_films: bool
    known_m2: float
    areas: dict[str, dict[str, Area]]

    def to_json(self) -> dict[str, Any]:
        return {
            "light_gains": list(self.gains),
            "bare_greenness": self.bare,
            "margin": MARGIN,
            "scatter": self.scatter,
            "green_films_left_out": self.leaves_out_films,
            "area_m2": self.known_m2,
            "regions": {
                region: {
                    what: {"value_m2": a.value_m2, "low_m2": a.low_m2, "high_m2": a.high_m2} for what, a in of.items()
                }
                for region, of in self.areas.items()
            },
        }


def measure_cover(
    earlier: Path,
    later: Path,
    grid: Grid,
    shift_m: tuple[float, float] = (0.0, 0.0),
    regions: list[Region] | None = None,
    known: Bool[np.ndarray, "rows columns"] | None = None,
) -> Cover:
    """Compare the plant cover of two orthophotos.

    Args:
        grid: ground that is looked at; pixels are the orthophotos' own.
        shift_m: of the later survey, as co-registration found it.
        regions: polygons whose areas are given one by one.
        known: cells of the grid that are compared; None for all.

    Raises:
        ChangeError: one of the files is no orthophoto, or they show no ground in common.
    """
    small = picture_grid((earlier, later), grid)
    times, lights = math.ceil(small.cell_m / _FINE_M), None
    if times > 1 and picture_grid((earlier, later), grid, math.inf).cell_m <= _FINE_M:
        lights = [_finer_light(earlier, small, times), _finer_light(later, small, times, shift_m)]
    one, inside = read_picture(earlier, small)
    other, also = read_picture(later, small, shift_m)
    inside &= also
    if not inside.any():
        raise ChangeError(
            f"{earlier} and {later} show no ground in common where the surfaces are: expected orthophotos of the same "
            "place; name others (--orthophotos)"
        )
    if known is not None:
        inside &= _resampled(known, grid, small)
    return compare_cover(one, other, inside, small, regions, lights)


def _finer_light(
    path: Path, grid: Grid, times: int, shift_m: tuple[float, float] = (0.0, 0.0)
) -> Float32[np.ndarray, "rows columns 2"]:
    """Means of an orthophoto's light and of its square over the cells of a grid, from pixels this many times finer."""
    out = np.empty((*grid.shape, 2), np.float32)
    step = max(1, STRIP_CELLS // (grid.columns * times**2))
    for first in range(0, grid.rows, step):
        rows = min(step, grid.rows - first)
        north, cell = grid.north_m - first * grid.cell_m, grid.cell_m / times
        fine = Grid(grid.crs, grid.west_m, north, cell, grid.columns * times, rows * times)
        picture, known = read_picture(path, fine, shift_m)
        values = np.concatenate([_light(picture), known[..., None]], axis=-1)
        means = values.reshape(rows, times, grid.columns, times, 3).mean(axis=(1, 3))
        out[first : first + rows] = means[..., :2] / np.maximum(means[..., 2:], np.float32(1e-3))
    return out


def _light(picture: UInt8[np.ndarray, "rows columns 3"]) -> Float32[np.ndarray, "rows columns 2"]:
    """Light and its square."""
    light = picture.mean(axis=-1, dtype=np.float32)
    return np.stack([light, light**2], axis=-1)


def compare_cover(
    earlier: np.ndarray,
    later: np.ndarray,
    known: Bool[np.ndarray, "rows columns"],
    grid: Grid,
    regions: list[Region] | None = None,
    lights: Sequence[Float32[np.ndarray, "rows columns 2"]] | None = None,
) -> Cover:
    """Compare the plant cover of two pictures (8-bit RGB) on one grid.

    Args:
        lights: means of each picture's light and of its square, where finer pixels show leaves that the grid's do not.
    """
    sigma, fine = (max(0.8, deviation / grid.cell_m) for deviation in (_WINDOW_M, _LEAVES_M))
    first = greenness(smoothed(earlier, known, sigma))
    second = greenness(smoothed(later, known, sigma))
    # Each date has its own white balance at first, so its own bare ground.
    bare_ground = known & (first < _bare(first[known]) + _BARE_MARGIN) & (second < _bare(second[known]) + _BARE_MARGIN)
    gains = light_gains(earlier, later, _enough(bare_ground, known))
    corrected = with_light(later, gains)
    second = greenness(smoothed(corrected, known, sigma))
    bare = _bare(np.concatenate([first[known], second[known]]))
    bare_ground = known & (first < bare + _BARE_MARGIN) & (second < bare + _BARE_MARGIN)
    difference = (second - first)[_enough(bare_ground, known)]
    can_tell = _is_enough(bare_ground, known) and (lights is not None or grid.cell_m <= _FINE_M)
    rough = [np.ones_like(known)] * 2
    if can_tell:
        rough = [
            _rough(_light(picture) if lights is None else lights[k], known, sigma, bare_ground)
            for k, picture in enumerate((earlier, later))
        ]
    scatter = nmad(difference[:: 1 + len(difference) // 1_000_000]) if len(difference) else 0.0
    scatter /= math.sqrt(2)
    cell, areas, least = grid.cell_area_m2, {}, math.sqrt(2) * scatter
    clearly, classes = np.abs(second - first) > least, {}
    first, second = (greenness(smoothed(picture, known, fine)) for picture in (earlier, corrected))
    for k in (-1, 0, 1):
        threshold = bare + MARGIN * _SPAN**k + k * scatter
        before, after = (
            _plants(_closed(known & (green > threshold), GAP_M / grid.cell_m), own, k)
            for green, own in zip((first, second), rough, strict=True)
        )
        classes[k] = _classes(before, np.where(clearly, after, before), known, grid)
    for region in (None, *(regions or [])):
        name, where = ("all", known) if region is None else (region.name, region.cells(grid) & known)
        areas[name] = {}
        here = [classes[k][where] for k in (0, -1, 1)]
        for what, codes in (("earlier", (-1, 2)), ("later", (1, 2)), ("gained", (1,)), ("lost", (-1,))):
            found = [np.isin(one, codes) for one in here]
            whole, every, some = (
                float(cells.sum()) * cell for cells in (found[0], np.all(found, axis=0), np.any(found, axis=0))
            )
            areas[name][what] = Area(whole, every, some)
    red, green, blue = (float(gain) for gain in gains)
    return Cover(grid, classes[0], (red, green, blue), bare, float(scatter), can_tell, float(known.sum()) * cell, areas)


def _classes(
    before: Bool[np.ndarray, "rows columns"],
    after: Bool[np.ndarray, "rows columns"],
    known: Bool[np.ndarray, "rows columns"],
    grid: Grid,
) -> Int8[np.ndarray, "rows columns"]:
    """Classes as `Cover` has them; patches that are too small keep what they were."""
    for moved in (after & ~before, before & ~after):
        after = np.where(small_patches(moved, grid, LEAST_M2), before, after)
    classes = np.where(after, np.where(before, 2, 1), np.where(before, -1, 0)).astype(np.int8)
    return np.where(known, classes, _UNKNOWN)


def _rough(
    light: Float32[np.ndarray, "rows columns 2"],
    known: Bool[np.ndarray, "rows columns"],
    sigma: float,
    bare_ground: Bool[np.ndarray, "rows columns"],
) -> Bool[np.ndarray, "rows columns"]:
    """Where light, given with its square, varies in a Gaussian window as it does in a patch of plants."""
    mean, square = np.moveaxis(smoothed(light, known, sigma), -1, 0)
    variation = np.sqrt(np.maximum(square - mean**2, 0)) / np.maximum(mean, 1)
    return variation > max(min(ROUGHER * float(np.quantile(variation[bare_ground], 0.25)), ROUGH), 1e-6)


def _closed(region: Bool[np.ndarray, "rows columns"], radius: float) -> Bool[np.ndarray, "rows columns"]:
    """Close a region's gaps by a disc of a radius in cells; beyond the edges everything is in the region."""
    if radius < 1:
        return region
    near = _distance(~region) <= radius
    return _distance(near) > radius


def _distance(region: Bool[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "rows columns"]:
    """How far each cell of a region is from those outside of it, in cells."""
    return cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def _plants(
    green: Bool[np.ndarray, "rows columns"], rough: Bool[np.ndarray, "rows columns"], k: int
) -> Bool[np.ndarray, "rows columns"]:
    """The patches of a green region that are rough in more than half of their area.

    Args:
        k: 1 counts of these what is rough alone; -1 counts them whole, and what is rough of the others.
    """
    numbers, sizes = _numbered(green)
    mostly = 2 * np.bincount(numbers[rough], minlength=len(sizes)) > sizes
    mostly[0] = False
    whole = mostly[numbers]
    return whole if k == 0 else whole & rough if k > 0 else whole | (green & rough)


def _numbered(
    region: Bool[np.ndarray, "rows columns"],
) -> tuple[Int32[np.ndarray, "rows columns"], Int64[np.ndarray, " parts"]]:
    """Numbers of the connected parts of a region, 0 outside of it, and their sizes in pixels."""
    numbers = np.empty(region.shape, np.int32)
    count = int(label(region, output=numbers))  # type: ignore[arg-type]
    sizes = np.zeros(count + 1, np.int64)
    for part in np.array_split(numbers, max(1, numbers.size // _COUNTED)):
        sizes += np.bincount(part.ravel(), minlength=count + 1)
    return numbers, sizes


def small_patches(
    region: Bool[np.ndarray, "rows columns"], grid: Grid, least_m2: float
) -> Bool[np.ndarray, "rows columns"]:
    """The connected parts of a region that are smaller than an area."""
    numbers, sizes = _numbered(region)
    small = sizes * grid.cell_area_m2 < least_m2
    small[0] = False
    return small[numbers]


def _bare(values: Float32[np.ndarray, " N"]) -> float:
    """Greenness of bare ground: the lowest of the common values, from a smoothed histogram."""
    if not len(values):
        return 0.0
    low, high = np.quantile(values, (0.001, 0.999))
    edges = np.arange(low - 2 * _BIN, max(high, low + _BIN) + 3 * _BIN, _BIN)
    counts = np.convolve(np.histogram(values, edges)[0], np.ones(5), "same")
    peak = (counts[1:-1] >= counts[:-2]) & (counts[1:-1] >= counts[2:]) & (counts[1:-1] >= _COMMON * counts.max())
    at = int(np.argmax(peak)) + 1
    return min(_GREENEST, float(edges[at] + edges[at + 1]) / 2)


def _is_enough(bare: Bool[np.ndarray, "rows columns"], known: Bool[np.ndarray, "rows columns"]) -> bool:
    return bool(bare.sum() > _LEAST_BARE * known.sum())


def _enough(bare: Bool[np.ndarray, "rows columns"], known: Bool[np.ndarray, "rows columns"]) -> np.ndarray:
    """Ground that is bare at both dates, or all ground if there is hardly any."""
    return bare if _is_enough(bare, known) else known


def _resampled(cells: Bool[np.ndarray, "rows columns"], grid: Grid, to: Grid) -> Bool[np.ndarray, "rows columns"]:
    """Cells of another grid whose centres are in cells of this one."""
    rows = ((grid.north_m - (to.north_m - (np.arange(to.rows) + 0.5) * to.cell_m)) / grid.cell_m).astype(int)
    columns = ((to.west_m + (np.arange(to.columns) + 0.5) * to.cell_m - grid.west_m) / grid.cell_m).astype(int)
    return cells[np.clip(rows, 0, grid.rows - 1)[:, None], np.clip(columns, 0, grid.columns - 1)[None]]
