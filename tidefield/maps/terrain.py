"""Take plants and buildings off a surface model, and shade surfaces for people.

Ground is found on coarse cells, from the low part of each, by progressive morphological opening (Pingel, Clarke and
McBride, An improved simple morphological filter for the terrain classification of airborne LIDAR data, 2013): what an
opening of a growing window removes, and is higher than the ground could rise within the window, is no ground. The
ground between is interpolated. Fine cells near it keep their own heights, but around what was taken off.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from tidefield.errors import need
from tidefield.maps.rasters import NODATA, Raster, raster_writer, read_values

COARSE_M = 0.25
"""Coarse cells are about as large, or as the map's own, in metres."""
LOW = 0.2
"""Quantile of the heights in a coarse cell that is taken for its ground."""
WIDEST_M = 9.0
"""Largest radius of an opening: wider plants than twice that are taken for ground."""
SLOPE = 0.15
"""Of the ground, at most (Pingel and others, table 1)."""
LEAST_RISE_M = 0.1
"""What rises less above the ground belongs to it: ripples, and errors."""
GROUND_SIGMAS = 2.0
"""A fine cell belongs to the ground if it is not higher above it than so many standard errors, or `LEAST_RISE_M`."""
RIM_M = 0.15
"""So far around what is taken off, or one cell, higher fine cells are no ground either: matching widens rims."""
MOST_RIM = 100
"""Cells: in a local frame a unit may be a hundred metres."""
SEARCHED = 400
"""Coarse cells, in each direction, in which what lies around a gap is looked for; without a limit terrain takes hours
where most of a map is empty. More than twice the largest radius of an opening: no cell of the map sees beyond."""
SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG = 315.0, 45.0
ROWS = 512
"""Of a raster that are read at once."""


def blocks(path: Path, around: int = 0, band: int = 1) -> Iterator[tuple[int, int, Float32[np.ndarray, "h w"]]]:
    """Read a band by whole rows: the first row, rows without their surroundings, and values with them.

    Args:
        path: of the raster.
        around: rows above and below that are read, too; outside of the raster the nearest row is repeated.
        band: number of the band.
    """
    rasterio = need("rasterio")
    with rasterio.open(path) as dataset:
        for row in range(0, dataset.height, ROWS):
            count = min(ROWS, dataset.height - row)
            first, last = max(0, row - around), min(dataset.height, row + count + around)
            values = read_values(dataset, band, window=((first, last), (0, dataset.width)))
            pad = (around - (row - first), around - (last - row - count))
            yield row, count, np.pad(values, (pad, (0, 0)), mode="edge")


def coarse_ground(
    low: Float32[np.ndarray, "h w"], cell_m: float, scale: float = 1.0
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Find the ground of coarse cells; returns its height everywhere, and which cells are ground themselves.

    Args:
        low: low height of each cell, NaN where there is none.
        cell_m: side of a cell, metres.
        scale: vertical units per metre.
    """
    known = np.isfinite(low)
    if not known.any():
        return low, known
    surface = _filled(low, known, known)
    last = surface
    other = np.zeros(low.shape, bool)
    for radius in range(1, max(1, round(WIDEST_M / cell_m)) + 1):
        disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        opened = cv2.morphologyEx(last, cv2.MORPH_OPEN, disk, borderType=cv2.BORDER_REPLICATE)
        other |= last - opened > max(SLOPE * radius * cell_m, LEAST_RISE_M) * scale
        last = opened
    ground = known & ~other
    if not ground.any():
        return surface, known
    # The blur reaches 4 cells beyond the map's, and what is interpolated between cells 1.
    around = cv2.dilate(known.astype(np.uint8), np.ones((11, 11), np.uint8)) > 0
    smooth = cv2.GaussianBlur(_filled(surface, ground, around), (0, 0), 1.0)
    return np.where(ground, surface, smooth).astype(np.float32), ground


def _filled(
    values: Float32[np.ndarray, "h w"], given: Bool[np.ndarray, "h w"], wanted: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Interpolate between cells whose values are given, at least where they are wanted; 0 far from all elsewhere."""
    from rasterio.fill import fillnodata

    searched = float(SEARCHED)
    while True:
        filled = fillnodata(np.where(given, values, np.nan), given.astype(np.uint8), max_search_distance=searched)
        if np.isfinite(filled[wanted]).all():
            return np.nan_to_num(filled)
        searched *= 2


def write_terrain(dsm: Path, sigma: Path, out: Raster, grid: Any) -> None:
    """Write the terrain model of a surface model.

    Args:
        dsm, sigma: heights and their standard errors.
        out: what to write.
        grid: of all three.
    """
    cell_m = grid.cell / grid.frame.metre
    factor = max(1, round(COARSE_M / cell_m))
    rows, columns = -(-grid.rows // factor), -(-grid.columns // factor)
    low = np.full((rows, columns), np.nan, np.float32)
    held: list[np.ndarray] = []
    first = 0
    for row, count, values in blocks(dsm):
        held.append(values)
        joined = np.concatenate(held)
        whole = len(joined) // factor if row + count < grid.rows else -(-len(joined) // factor)
        for k in range(whole):
            part = joined[k * factor : (k + 1) * factor]
            part = np.pad(part, ((0, 0), (0, columns * factor - grid.columns)), constant_values=np.nan)
            part = part.reshape(len(part), columns, factor).transpose(1, 0, 2).reshape(columns, -1)
            low[first + k] = _quantile(part)
        first += whole
        held = [joined[whole * factor :]]
    ground, _ = coarse_ground(low, factor * cell_m, grid.frame.metre_up)
    rim = int(np.clip(round(RIM_M / cell_m), 1, MOST_RIM))
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * rim + 1, 2 * rim + 1))
    columns_of = (np.arange(grid.columns) + 0.5) / factor - 0.5
    with raster_writer(out, grid) as writer:
        for (row, count, height), (_, _, error) in zip(blocks(dsm, rim), blocks(sigma, rim), strict=True):
            rows_of = (np.arange(row - rim, row + count + rim) + 0.5) / factor - 0.5
            below = _interpolated(_interpolated(ground, rows_of, 0), columns_of, 1)
            error_m = np.minimum(np.nan_to_num(error) / grid.frame.metre_up, LEAST_RISE_M)
            rise_m = np.maximum(GROUND_SIGMAS * error_m, LEAST_RISE_M)
            other = height - below > rise_m * grid.frame.metre_up
            near = cv2.dilate(other.astype(np.uint8), disk) > 0
            terrain = np.where(near, np.minimum(height, below), height)[rim : rim + count]
            writer.write(row, np.nan_to_num(terrain, nan=NODATA)[None])


def _interpolated(values: Float32[np.ndarray, "h w"], at: np.ndarray, axis: int) -> Float32[np.ndarray, "h2 w2"]:
    """Interpolate linearly along an axis at positions in cells, constant beyond the ends.

    OpenCV's remap has no more than 32,766 columns, less than a map of a coast.
    """
    at = at.clip(0, values.shape[axis] - 1)
    low = at.astype(int)
    share = (at - low).astype(np.float32)
    one, other = (np.take(values, k, axis) for k in (low, np.minimum(low + 1, values.shape[axis] - 1)))
    return one + (share[:, None] if axis == 0 else share) * (other - one)


def _quantile(part: np.ndarray) -> np.ndarray:
    """The `LOW` quantile of each row's known values; NaN where there are none."""
    ordered = np.sort(part, axis=1)  # NaN last
    count = np.isfinite(part).sum(1)
    index = np.clip((LOW * (count - 1)).round().astype(int), 0, None)
    return np.where(count > 0, ordered[np.arange(len(part)), index], np.nan)


def hillshade(height: Float[np.ndarray, "h w"], cell: float) -> Float[np.ndarray, "h w"]:
    """Shade a surface by a sun in the north-west, 0 to 1, as GDAL does (Horn, Hill shading and the reflectance map,
    1981).

    Args:
        height: of cells, row 0 in the north.
        cell: side of a cell, in the heights' unit.
    """
    values = height.astype(np.float32)
    padded = np.pad(values, 1, mode="edge")
    rows, columns = values.shape

    def other(down: int, across: int) -> np.ndarray:
        """Neighbours of all cells; what the opposite one makes of those without a height, else the cell's own."""
        found, opposite = (
            padded[1 + k * down : 1 + k * down + rows, 1 + k * across : 1 + k * across + columns] for k in (1, -1)
        )
        found = np.where(np.isfinite(found), found, 2 * values - opposite)
        return np.where(np.isfinite(found), found, values)

    def side(one: tuple[int, int], middle: tuple[int, int], two: tuple[int, int]) -> np.ndarray:
        return other(*one) + 2 * other(*middle) + other(*two)

    east = (side((-1, 1), (0, 1), (1, 1)) - side((-1, -1), (0, -1), (1, -1))) / np.float32(8 * cell)
    north = (side((-1, -1), (-1, 0), (-1, 1)) - side((1, -1), (1, 0), (1, 1))) / np.float32(8 * cell)
    azimuth, elevation = math.radians(SUN_AZIMUTH_DEG), math.radians(SUN_ELEVATION_DEG)
    sun = np.array([math.sin(azimuth), math.cos(azimuth)]) * math.cos(elevation)
    shade = (math.sin(elevation) - sun[0] * east - sun[1] * north) / np.sqrt(1 + east**2 + north**2)
    return np.clip(shade, 0, 1)


def write_hillshade(heights: Path, out: Raster, grid: Any) -> None:
    """Write the hillshade of a raster of heights: 1 to 255, 0 where there is none."""
    cell = grid.cell_up
    with raster_writer(out, grid) as writer:
        for row, count, values in blocks(heights, around=1):
            shade = np.round(1 + 254 * np.nan_to_num(hillshade(values, cell)[1 : count + 1]))
            writer.write(row, np.where(np.isfinite(values[1 : count + 1]), shade, 0)[None])
