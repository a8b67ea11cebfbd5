"""Draw contours of a terrain model, as GeoPackage, GeoJSON and DXF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from shapely.geometry import LineString

from tidefield.errors import need
from tidefield.files import write_text
from tidefield.maps.grid import Grid, MapFrame
from tidefield.maps.rasters import read_values
from tidefield.maps.smoothing import smoothed
from tidefield.maps.vectors import Layer, write_geojson, write_geopackage

ABOUT = 20
"""Contours that a map has about, if no interval is given, ..."""
LEAST_M = 0.01
"""... and the least interval then: a level map has errors, which are no shapes."""
MOST_CELLS = 4_000_000
"""Contours are drawn on cells that are as much larger as this many allow."""
SHORTEST_CELLS = 8.0
"""Contours shorter than so many cells are left out."""
SIMPLIFIED_CELLS = 0.3
"""Largest distance, in cells, by which lines are simplified."""
LAYER = "contours"


def interval_of(height: Float[np.ndarray, "h w"], scale: float = 1.0) -> float:
    """Choose an interval of 1, 2 or 5 times a power of ten for about `ABOUT` contours.

    Args:
        height: of cells, NaN where there are none.
        scale: vertical units per metre.
    """
    known = height[np.isfinite(height)]
    spread = float(np.ptp(np.percentile(known, [1, 99]))) if len(known) else 1.0
    least = max(spread / ABOUT, LEAST_M * scale)
    power = 10.0 ** math.floor(math.log10(least))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= least * (1 - 1e-9))


def contours(
    height: Float[np.ndarray, "h w"], grid: Grid, interval: float, smooth_cells: float = 1.5
) -> list[tuple[float, LineString]]:
    """Trace contours through the centres of cells; returns heights and lines in map coordinates.

    Args:
        height: of cells, NaN where there are none.
        grid: the cells.
        interval: between contours.
        smooth_cells: standard deviation of the smoothing before, in cells.
    """
    from contourpy import LineType, contour_generator

    known = np.isfinite(height)
    if not known.any():
        return []
    base = float(np.median(height[known]))
    masked = np.ma.masked_array(smoothed(height - base, known, smooth_cells).astype(np.float64) + base, ~known)
    east = grid.west + (np.arange(grid.columns) + 0.5) * grid.cell
    north = grid.north - (np.arange(grid.rows) + 0.5) * grid.cell
    generator = contour_generator(east, north, masked, line_type=LineType.Separate)
    low, high = float(masked.min()), float(masked.max())
    found = []
    for k in range(math.ceil(low / interval), math.floor(high / interval) + 1):
        for line in generator.lines(k * interval):
            shape = LineString(np.asarray(line)).simplify(SIMPLIFIED_CELLS * grid.cell)
            if shape.length >= SHORTEST_CELLS * grid.cell:
                found.append((round(k * interval, 9), shape))
    return found


def read_reduced(
    path: Path, grid: Grid, band: int = 1, resampling: str = "average"
) -> tuple[Float[np.ndarray, "h w"], Grid]:
    """Read a raster in at most `MOST_CELLS` cells, each the mean of those that are known; NaN where none is, unless the
    raster has no value for that.

    Args:
        path: of the raster.
        grid: its cells.
        band: number of the band.
        resampling: rasterio's name of what a cell is of those that are known, "average" or "mode".
    """
    from rasterio.enums import Resampling

    factor = max(1, math.ceil(math.sqrt(grid.rows * grid.columns / MOST_CELLS)))
    # Whole blocks only: what is left at the southern and eastern edges would stretch the cells.
    coarse = replace(grid, cell=grid.cell * factor, columns=grid.columns // factor, rows=grid.rows // factor)
    window = ((0, coarse.rows * factor), (0, coarse.columns * factor))
    # Overviews would not lie on these cells where the raster's size is odd.
    with need("rasterio").open(path, OVERVIEW_LEVEL="NONE") as dataset:
        shape = (coarse.rows, coarse.columns)
        # GDAL's mask of larger cells has some more than those of which it knows a value.
        return read_values(dataset, band, window=window, out_shape=shape, resampling=Resampling[resampling]), coarse


def write_contours(lines: Sequence[tuple[float, LineString]], frame: MapFrame, folder: Path) -> None:
    """Write contours.gpkg, contours.geojson (WGS 84; a local frame as it is) and contours.dxf into a folder."""
    layer = Layer(LAYER, "LineString", [line for _, line in lines], {"height": [height for height, _ in lines]})
    write_geopackage(folder / "contours.gpkg", [layer], frame.horizontal_wkt)
    write_geojson(folder / "contours.geojson", layer, frame)
    write_text(folder / "contours.dxf", dxf(lines))


def dxf(lines: Sequence[tuple[float, LineString]]) -> str:
    """Write lines as DXF R12: a POLYLINE of each at its height, which every CAD program opens."""
    parts = ["0", "SECTION", "2", "ENTITIES"]
    for height, line in lines:
        parts += ["0", "POLYLINE", "8", LAYER, "66", "1", "70", "8", "10", "0.0", "20", "0.0", "30", f"{height:.4f}"]
        for x, y in line.coords:
            parts += ["0", "VERTEX", "8", LAYER, "10", f"{x:.4f}", "20", f"{y:.4f}", "30", f"{height:.4f}", "70", "32"]
        parts += ["0", "SEQEND"]
    return "\n".join([*parts, "0", "ENDSEC", "0", "EOF"]) + "\n"
