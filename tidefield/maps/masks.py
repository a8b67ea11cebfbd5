"""Find plants and water on a map: a raster of classes, polygons, and the waterline with its height; level the water.

Plants are green: their excess green (Woebbecke and others, Color indices for weed identification under various soil,
residue, and lighting conditions, 1995) is above a threshold. Water is where photographs do not agree, for its surface
mirrors and has no marks of its own, and where the surface is level. From such places a body of water reaches as far as
the heights are its level. It is none if its heights are spread, or if lower ground begins at its shore.

The threshold of plants was found on built-in flats of other seeds than those of `python -m benchmarks maps`, those of
water on both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float, Float32, Int, Shaped, UInt8
from scipy import ndimage
from shapely.geometry.base import BaseGeometry

from tidefield.errors import need
from tidefield.maps.classes import GROUND, VEGETATION, WATER
from tidefield.maps.contours import read_reduced
from tidefield.maps.grid import Grid
from tidefield.maps.rasters import NODATA, Raster, raster_writer
from tidefield.maps.smoothing import smoothed
from tidefield.maps.terrain import blocks
from tidefield.maps.vectors import Layer, write_geojson, write_geopackage

GREEN = 0.13
"""Excess green, of colours that sum to 1, from which a cell shows a plant."""
LEAST_AGREEMENT, SHORE_AGREEMENT = 0.15, 0.3
"""Mean correlation of the photographs below which a cell may begin a body of water, and may belong to one."""
LEVEL_M, AGREEMENT_M = 0.15, 0.2
"""Standard deviations of the windows in which the surface is level, and in which the agreement is a mean, metres."""
SLOPE, ROUGHNESS_M = 0.02, 0.02
"""Slope of, and deviation of heights in, windows of level water, at most."""
TOLERANCE_M = 0.03
"""Smoothed heights of water differ from its level by so much, or twice their spread, at most, ..."""
OUTLIERS = 3
"""... and those of single cells by so many times that."""
SPREAD_M, SPREAD_CELLS = 0.01, 0.15
"""Largest spread of the smoothed heights of a body of water, in metres or in cells of the map."""
LOWER_M, LOWER_SHARE = 0.01, 0.15
"""A body is none if more than such a share of its shore is lower by so much, ..."""
LEAST_SHORE = 0.05
"""... and the shore is more than this share of what surrounds a disc: less is a blotch of the matching."""
SMALLEST_M2 = 1.0
"""Smallest body of water."""
BLOCK_M = 2.0
"""Side of the squares whose medians give the standard error of a level."""
SMALLEST_CELLS = 12
"""Smaller polygons are left out."""
SIMPLIFIED_CELLS = 0.7
END_CELLS = 3
"""An edge of water within so many cells of where nothing is known is no shore."""


@dataclass(frozen=True)
class Body:
    """A body of water.

    Attributes:
        level: its height, vertical units.
        sigma: standard error of the level, without that of the map's datum.
        tolerance: by which smoothed heights of its cells may differ.
        area: square horizontal units.
    """

    level: float
    sigma: float
    tolerance: float
    area: float


Water = tuple[np.ndarray, Sequence[Body], Grid]
"""The number of the body in each cell, from 1, 0 for none; the bodies; and the cells, larger than a large map's."""


def excess_green(colour: UInt8[np.ndarray, "3 h w"]) -> Float[np.ndarray, "h w"]:
    """Excess green 2 g - r - b of colours that sum to 1, of slightly blurred colours; 0 for black."""
    red, green, blue = (cv2.GaussianBlur(band.astype(np.float32), (0, 0), 1.0) for band in colour)
    return (2 * green - red - blue) / np.maximum(red + green + blue, 1.0)


def find_water(
    height: Float[np.ndarray, "h w"], agreement: Float[np.ndarray, "h w"], plants: Bool[np.ndarray, "h w"], grid: Grid
) -> tuple[Int[np.ndarray, "h w"], list[Body]]:
    """Find bodies of water.

    Args:
        height: of cells, NaN where there are none.
        agreement: mean correlation of the photographs there; NaN where fewer than two show a cell, which is no water.
        plants: cells that show plants.
        grid: the cells.

    Returns:
        The number of the body in each cell, from 1, 0 for none; and the bodies.
    """
    cell, up = grid.cell / grid.frame.metre, grid.frame.metre_up
    known = np.isfinite(height) & np.isfinite(agreement) & ~plants
    labels, bodies = np.zeros(height.shape, np.int32), []
    if not known.any():
        return labels, bodies
    base = float(np.median(height[known]))
    signs = _signs((np.where(known, height - base, 0) / up).astype(np.float32), known, agreement, cell)
    areas = np.bincount(signs.seeds.ravel()) * cell**2
    places = ndimage.find_objects(signs.seeds)
    for k in sorted(range(1, len(areas)), key=lambda k: -areas[k]):
        place = places[k - 1]
        if areas[k] < SMALLEST_M2:
            break
        inside = signs.seeds[place] == k
        if (labels[place][inside] > 0).mean() > 0.5:
            continue
        heights = signs.height[place][inside & known[place]]
        level = float(np.median(heights))
        tolerance = max(TOLERANCE_M, 2 * _spread(heights - level))
        window, body = _grown(signs, place, k, level, tolerance)
        body &= labels[window] == 0
        if not signs.is_water(window, body, level):
            continue
        wet = body & known[window]
        error = _level_error(signs.height[window], wet, level, max(1, round(BLOCK_M / cell)))
        labels[window][body] = len(bodies) + 1
        bodies.append(Body(base + level * up, error * up, tolerance * up, float(body.sum()) * grid.cell**2))
    return labels, bodies


Window = tuple[slice, slice]


@dataclass(frozen=True)
class _Signs:
    """What tells a map's water from its ground, in its cells.

    Attributes:
        height: metres above some base.
        mean: of the heights in Gaussian windows of `LEVEL_M`.
        agreement: mean correlation of the photographs, in windows of `AGREEMENT_M`.
        known: cells with a height and without plants.
        seeds: the place where a body may begin that a cell is of, from 1, 0 for none.
        cell: its side, metres.
    """

    height: Float32[np.ndarray, "h w"]
    mean: Float32[np.ndarray, "h w"]
    agreement: Float32[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"]
    seeds: Int[np.ndarray, "h w"]
    cell: float

    @property
    def reach(self) -> int:
        """Side of the square within which a shore lies around a body, cells."""
        return 2 * math.ceil(LEVEL_M / self.cell) + 1

    def body(self, window: Window, seed: int, level: float, tolerance: float) -> Bool[np.ndarray, "h w"]:
        """The cells of a window to which water reaches from a seed, level as they are."""
        mean = self.mean[window]
        mine = self.known[window] & (np.abs(mean - level) <= tolerance) & (self.agreement[window] < SHORE_AGREEMENT)
        mine &= np.abs(self.height[window] - level) <= OUTLIERS * tolerance
        start = self.seeds[window] == seed
        parts = _components(mine | start)
        body = _opened(_closed(np.isin(parts, np.unique(parts[start]))))
        # Small places that water surrounds are not lower: those are blotches of the matching.
        holes = _components(ndimage.binary_fill_holes(body) & ~body & (mean < level))
        return body | ((holes > 0) & (np.bincount(holes.ravel())[holes] * self.cell**2 < SMALLEST_M2))

    def is_water(self, window: Window, body: Bool[np.ndarray, "h w"], level: float) -> bool:
        """Whether the heights of a body are level, and hardly any lower ground is at its shore."""
        known, mean = self.known[window], self.mean[window]
        wet = body & known
        if not wet.any() or _spread(mean[wet] - level) > max(SPREAD_M, SPREAD_CELLS * self.cell):
            return False
        shore = cv2.dilate(body.astype(np.uint8), np.ones((self.reach, self.reach), np.uint8)) > 0
        shore &= known & ~body
        ring = 2 * math.sqrt(math.pi * wet.sum()) * LEVEL_M / self.cell  # around a disc of the same area, cells
        if shore.sum() <= LEAST_SHORE * ring:
            return True
        return float((mean[shore] < level - LOWER_M).mean()) <= LOWER_SHARE


def _signs(
    height: Float32[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], agreement: np.ndarray, cell: float
) -> _Signs:
    def mean_of(values: np.ndarray, sigma_m: float) -> np.ndarray:
        # Holes of a body are judged where nothing is known, too.
        return smoothed(values, known, max(sigma_m / cell, 1.0), least=1e-6)

    mean = mean_of(height, LEVEL_M)
    rough = np.sqrt(np.maximum(mean_of(height**2, LEVEL_M) - mean**2, 0))
    south, east = np.gradient(mean, cell)
    agree = mean_of(np.nan_to_num(agreement), AGREEMENT_M)
    seed = known & (agree < LEAST_AGREEMENT) & (np.hypot(south, east) < SLOPE) & (rough < ROUGHNESS_M)
    return _Signs(height, mean, agree, known, _components(_closed(seed)), cell)


def _grown(
    signs: _Signs, place: Window, seed: int, level: float, tolerance: float
) -> tuple[Window, Bool[np.ndarray, "h w"]]:
    """Find a body in windows that grow until it keeps away from their edges, but for those of the map.

    A large map has hundreds of ponds: to look for each on all of it would take hours.
    """
    shape, reach = signs.seeds.shape, signs.reach
    pad = 4 * reach
    while True:
        rows, columns = (
            slice(max(0, side.start - pad), min(most, side.stop + pad)) for side, most in zip(place, shape, strict=True)
        )
        body = signs.body((rows, columns), seed, level, tolerance)
        beyond = (rows.start > 0 and body[:reach].any()) or (rows.stop < shape[0] and body[-reach:].any())
        beyond |= (columns.start > 0 and body[:, :reach].any()) or (columns.stop < shape[1] and body[:, -reach:].any())
        if not beyond:
            return (rows, columns), body
        pad *= 3


def _closed(mask: np.ndarray) -> np.ndarray:
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0


def _opened(mask: np.ndarray) -> np.ndarray:
    """Without what is narrower than five cells; what OpenCV does not see beyond the map's edge takes nothing off."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, cross, iterations=2) > 0


def _components(mask: np.ndarray) -> np.ndarray:
    """The connected part that each cell is of, from 1, 0 for none."""
    return np.asarray(cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[1])


def _spread(values: np.ndarray) -> float:
    return float(1.4826 * np.median(np.abs(values)))


def _level_error(height: np.ndarray, wet: np.ndarray, level: float, side: int) -> float:
    """Standard error of a level: the standard deviation of squares' medians, or of cells with fewer than four.

    It is not divided by the root of their number: the pairs of photographs share errors over all of a body.
    """
    medians = []
    for row in range(0, height.shape[0], side):
        for column in range(0, height.shape[1], side):
            square = slice(row, row + side), slice(column, column + side)
            if wet[square].sum() > side * side / 8:
                medians.append(np.median(height[square][wet[square]]))
    if len(medians) < 4:
        return _spread(height[wet] - level)
    return float(np.std(medians, ddof=1))


def read_water(dsm: Path, agreement: Path, orthophoto: Path, grid: Grid) -> Water:
    """Find water on a map's rasters, in cells that are as much larger as memory asks.

    Args:
        dsm, agreement, orthophoto: of the map; agreement in per cent.
        grid: of the map.
    """
    height, coarse = read_reduced(dsm, grid)
    colour = np.stack([np.nan_to_num(read_reduced(orthophoto, grid, band)[0]) for band in (1, 2, 3)])
    plants = excess_green(colour.round().astype(np.uint8)) > GREEN
    labels, bodies = find_water(height, read_reduced(agreement, grid)[0] / 100, plants, coarse)
    return labels, bodies, coarse


def write_classes(out: Raster, dsm: Path, orthophoto: Path, water: Water, grid: Grid) -> None:
    """Write the class of each cell: ground, vegetation or water, as LAS numbers them; 0 where there is no surface.

    Args:
        out: what to write.
        dsm, orthophoto: of the map.
        water: see `read_water`.
        grid: of the map.
    """
    level, tolerance = (_of_bodies(name, water[1]) for name in ("level", "tolerance"))
    with raster_writer(out, grid) as writer:
        for (row, count, height), colour in zip(blocks(dsm), _colours(orthophoto, around=4), strict=True):
            body = _body_of_cells(water, grid, row, count)
            wet = body > 0
            if water[2].cell > grid.cell:  # the shore within a coarse cell is found by its height
                wet &= height <= level[body] + tolerance[body]
            green = excess_green(colour)[4 : 4 + count] > GREEN
            classes = np.where(green, VEGETATION, np.where(wet, WATER, GROUND))
            writer.write(row, np.where(np.isfinite(height), classes, 0)[None])


def level_water(dsm: Raster, sigma: Raster, classes: Path, water: Water, grid: Grid) -> None:
    """Give the water of a surface its level and the level's standard error ("hydro-flattening"), in place.

    Matching has little to hold on to on water: its cells are much less certain than the level that they share. What
    rises from the water, or is far from its level for another reason, stays as it was measured.

    Args:
        dsm, sigma: heights of the surface and their standard errors, which are there, and are written again.
        classes: of the cells.
        water: see `read_water`.
        grid: of the map.
    """
    if not water[1]:
        return
    level, tolerance, error = (_of_bodies(name, water[1]) for name in ("level", "tolerance", "sigma"))
    with raster_writer(dsm, grid) as heights, raster_writer(sigma, grid) as errors:
        parts = zip(blocks(dsm.path), blocks(sigma.path), blocks(classes), strict=True)
        for (row, count, height), (_, _, own), (_, _, kind) in parts:
            body = _body_of_cells(water, grid, row, count)
            wet = (kind == WATER) & (np.abs(height - level[body]) <= OUTLIERS * tolerance[body])
            heights.write(row, np.nan_to_num(np.where(wet, level[body], height), nan=NODATA)[None])
            errors.write(row, np.nan_to_num(np.where(wet, error[body], own), nan=NODATA)[None])


def _of_bodies(attribute: str, bodies: Sequence[Body]) -> Float32[np.ndarray, " bodies"]:
    """An attribute of the body of each number, NaN for 0."""
    return np.array([np.nan, *(getattr(body, attribute) for body in bodies)], np.float32)


def _body_of_cells(water: Water, grid: Grid, row: int, count: int) -> Int[np.ndarray, "h w"]:
    """Number of the body of water in some whole rows of cells, 0 for none; coarse cells reach one further."""
    labels, _, coarse = water
    factor = round(coarse.cell / grid.cell)
    rows = np.minimum(np.arange(row, row + count) // factor, labels.shape[0] - 1)
    columns = np.minimum(np.arange(grid.columns) // factor, labels.shape[1] - 1)
    if factor > 1:
        first, last = max(rows[0] - 1, 0), rows[-1] + 2
        labels = cv2.dilate(labels[first:last].astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32)
        rows = rows - first
    return labels[np.ix_(rows, columns)]


def _colours(path: Path, around: int) -> Iterator[UInt8[np.ndarray, "3 h w"]]:
    bands = [blocks(path, around, band) for band in (1, 2, 3)]
    for red, green, blue in zip(*bands, strict=True):
        yield np.stack([np.nan_to_num(band[2]).astype(np.uint8) for band in (red, green, blue)])


def write_masks(classes: Path, agreement: Path, water: Water, grid: Grid, folder: Path) -> None:
    """Write masks.gpkg with the layers vegetation, water and waterline, and a GeoJSON of each, into a folder.

    Plants are outlined in cells that are as much larger as memory asks.
    """
    labels, bodies, coarse = water
    values, reduced = read_reduced(classes, grid, resampling="mode")
    plants = [shape for shape, _ in _outlines(values == VEGETATION, reduced)]
    wet = [(shape, bodies[number - 1]) for shape, number in _outlines(labels, coarse)]
    fields = {
        "height": [body.level for _, body in wet],
        "sigma": [body.sigma for _, body in wet],
        "area": [shape.area for shape, _ in wet],
    }
    layers = [
        Layer("vegetation", "Polygon", plants, {"area": [shape.area for shape in plants]}),
        Layer("water", "Polygon", [shape for shape, _ in wet], fields),
        _waterline(wet, ~np.isfinite(read_reduced(agreement, grid)[0]), reduced),
    ]
    write_geopackage(folder / "masks.gpkg", layers, grid.frame.horizontal_wkt)
    for layer in layers:
        write_geojson(folder / f"{layer.name}.geojson", layer, grid.frame)


def _outlines(numbers: Shaped[np.ndarray, "h w"], grid: Grid) -> list[tuple[BaseGeometry, int]]:
    """Polygons of the cells of each number above 0, or of a mask, in map coordinates, by number."""
    from rasterio.transform import Affine

    features = need("rasterio.features")
    found = features.shapes(numbers.astype(np.int32), mask=numbers > 0, transform=Affine(*grid.transform))
    shapes = [(shapely.geometry.shape(shape).simplify(SIMPLIFIED_CELLS * grid.cell), int(of)) for shape, of in found]
    return sorted((one for one in shapes if one[0].area >= SMALLEST_CELLS * grid.cell**2), key=itemgetter(1))


def _waterline(wet: Sequence[tuple[BaseGeometry, Body]], unknown: Bool[np.ndarray, "h w"], grid: Grid) -> Layer:
    """The shores of water, without those stretches where the map ends.

    Args:
        unknown: cells that fewer than two photographs show.
        grid: of these.
    """
    ends = np.pad(unknown, 1, constant_values=True)
    ends = cv2.dilate(ends.astype(np.uint8), np.ones((2 * END_CELLS + 1, 2 * END_CELLS + 1), np.uint8)) > 0
    around = replace(grid, west=grid.west - grid.cell, north=grid.north + grid.cell)
    beyond = shapely.union_all([shape for shape, _ in _outlines(ends, around)])
    lines, bodies = [], []
    for shape, body in wet:
        cut = shape.boundary.difference(beyond)
        merged = shapely.line_merge(cut) if cut.geom_type == "MultiLineString" else cut
        for line in getattr(merged, "geoms", [merged]):
            if line.geom_type == "LineString" and line.length > 0:
                lines.append(line)
                bodies.append(body)
    fields = {"height": [body.level for body in bodies], "sigma": [body.sigma for body in bodies]}
    return Layer("waterline", "LineString", lines, fields)
