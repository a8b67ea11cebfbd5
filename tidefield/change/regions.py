"""Regions of a user: polygons and lines, on a grid."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Bool
from pyproj import CRS
from scipy.ndimage import maximum_filter
from shapely.geometry.base import BaseGeometry

from tidefield.change.surfaces import ChangeError, Grid
from tidefield.errors import need
from tidefield.geometry.drawn import read_drawn


@dataclass(frozen=True)
class Region:
    """A named geometry in a grid's system."""

    name: str
    geometry: BaseGeometry

    def cells(self, grid: Grid) -> Bool[np.ndarray, "rows columns"]:
        """Cells whose centres are in a polygon, or that a line touches."""
        return rasterised([self], grid)

    def share_on(self, grid: Grid) -> float:
        """Share of a polygon's area, or of a line's length, that lies on a grid; 1 for points."""
        measure = shapely.area if shapely.area(self.geometry) else shapely.length
        whole = float(measure(self.geometry))
        return float(measure(self.geometry & shapely.box(*grid.bounds))) / whole if whole else 1.0


def rasterised(regions: list[Region], grid: Grid) -> Bool[np.ndarray, "rows columns"]:
    """Cells that are in any of the regions."""
    need("rasterio")
    from rasterio.features import rasterize

    shapes = [region.geometry for region in regions]
    lines = [shape for shape in shapes if shape.geom_type.endswith(("LineString", "Point"))]
    areas = [shape for shape in shapes if not shape.geom_type.endswith(("LineString", "Point"))]
    cells = np.zeros(grid.shape, np.uint8)
    for some, touched in ((areas, False), (lines, True)):
        if some:
            rasterize(some, out=cells, transform=grid.transform, default_value=1, all_touched=touched)
    return cells.view(bool)


def read_regions(path: Path, grid: Grid) -> list[Region]:
    """Read all geometries of a file's layer, in the grid's system; no two have one name.

    Args:
        path: the file; "file.gpkg:layer" where it has several layers.
        grid: of the surveys.

    Raises:
        RunError: as `read_drawn` and `Drawn.placed`.
        ChangeError: it has no geometry on the grid.
    """
    drawn = read_drawn(path).placed(None if grid.crs is None else CRS.from_wkt(grid.crs))
    found: list[Region] = []
    taken = {"all"}  # what tables call the whole survey
    for number, (geometry, own) in enumerate(zip(drawn.geometries, drawn.names, strict=True), start=1):
        name = own = own or str(number)
        times = 1
        while name in taken:
            times += 1
            name = f"{own} ({times})"
        taken.add(name)
        found.append(Region(name, geometry))
    frame = shapely.box(*grid.bounds)
    if not any(region.geometry.intersects(frame) for region in found):
        raise ChangeError(
            f"nothing in {path} is where both surveys are: expected polygons there; check its coordinates"
        )
    return found


def dilated(region: Bool[np.ndarray, "rows columns"], cells: int) -> Bool[np.ndarray, "rows columns"]:
    """A region with a margin of this many cells, a square around each."""
    if cells == 0:
        return region
    return np.asarray(maximum_filter(region.view(np.uint8), 2 * cells + 1, mode="constant"), np.uint8).view(bool)
