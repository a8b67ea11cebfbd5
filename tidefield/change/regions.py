"""Regions of a user: polygons and lines of GeoJSON, GeoPackage or shapefiles, on a grid."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from scipy.ndimage import maximum_filter
from shapely.geometry.base import BaseGeometry

from tidefield.change.surfaces import ChangeError, Grid, is_local
from tidefield.errors import need
from tidefield.geometry.geodesy import lost_in_conversion

_log = logging.getLogger(__name__)

_MOST_REGIONS = 10_000
_LARGEST_FILE = 1 << 28
_NAMES = ("name", "id", "label", "title", "location", "tr_id")


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


def _converted(to: Transformer, points: np.ndarray) -> np.ndarray:
    return np.stack(to.transform(points[:, 0], points[:, 1]), axis=1)


def _name(value: Any) -> str:
    """A name in a column; empty where there is none. Whole numbers beside missing ones are read as floats."""
    if isinstance(value, np.ndarray | list | tuple):
        return ", ".join(filter(None, map(_name, value)))
    if value is None or value != value:  # NaN and NaT differ from themselves
        return ""
    return str(int(value)) if isinstance(value, float | np.floating) and value.is_integer() else str(value)


def _layer(path: Path, layers: list[str], asked: str | None) -> str:
    """The layer that is read of those with geometries."""
    if asked is None and len(layers) == 1:
        return layers[0]
    if asked in layers:
        return asked
    if not layers:
        raise ChangeError(f"{path} has no geometries: expected polygons or lines; name another file")
    raise ChangeError(
        f"{path} has {', '.join(layers)}: expected the name of one of these layers; write {path.name}:{layers[0]}"
    )


def read_regions(path: Path, grid: Grid) -> list[Region]:
    """Read all geometries of a file's layer, in the grid's system; no two have one name.

    Args:
        path: the file; "file.gpkg:layer" where it has several layers.

    Raises:
        ChangeError: it cannot be read, is empty or too large, has several layers, or has no geometry on the grid.
    """
    need("pyogrio")
    from pyogrio import list_layers, raw, read_info
    from pyogrio.errors import DataLayerError, DataSourceError

    expected = "expected polygons as GeoJSON, GeoPackage or shapefile; name another file"
    asked = None
    if not path.is_file() and ":" in path.name:
        name, asked = path.name.rsplit(":", 1)
        path = path.with_name(name)
    if not path.is_file():
        raise ChangeError(f"{path} is not a file: {expected}")
    if path.stat().st_size > _LARGEST_FILE:
        raise ChangeError(
            f"{path} has {path.stat().st_size / 1e6:.0f} MB, more than {_LARGEST_FILE / 1e6:.0f}: {expected}"
        )
    try:
        layer = _layer(path, [str(name) for name, kind in list_layers(path) if kind is not None], asked)
        about = read_info(path, layer=layer)
        meta, _, shapes, columns = raw.read(path, layer=layer, max_features=_MOST_REGIONS + 1, force_2d=True)
        geometries = shapely.from_wkb(shapes)
    except (DataSourceError, DataLayerError, ValueError, shapely.errors.ShapelyError) as error:
        raise ChangeError(f"{path} cannot be read as polygons ({error}): {expected}") from error
    if len(geometries) > _MOST_REGIONS:
        raise ChangeError(f"{path} has more than {_MOST_REGIONS} features: {expected}")
    fields = [str(name) for name in meta["fields"]]
    chosen = next((k for name in _NAMES for k, f in enumerate(fields) if f.lower() == name), None)
    to = None
    if about["crs"] and grid.crs is not None:
        try:
            crs = CRS(about["crs"])
            # A file without a place on Earth, which GeoPackages call undefined, is taken to lie as the surveys do.
            if not is_local(crs):
                own = CRS.from_wkt(grid.crs)
                to = Transformer.from_crs(crs, own, always_xy=True)
                if lost := lost_in_conversion(crs, own):
                    _log.warning(f"{path.name}: coordinates {lost}")
        except ProjError as error:
            raise ChangeError(
                f"{path} cannot be converted to {CRS.from_wkt(grid.crs).name} ({error}): expected a system that fits "
                "its place; assign it (ogr2ogr -a_srs)"
            ) from error
    frame = shapely.box(*grid.bounds)
    found: list[Region] = []
    taken = {"all"}  # what tables call the whole survey
    for k, geometry in enumerate(geometries):
        if geometry is None or geometry.is_empty:
            continue
        if to is not None:
            geometry = shapely.transform(geometry, partial(_converted, to))
        if not np.isfinite(geometry.bounds).all():
            raise ChangeError(f"{path} has a geometry at no place of the surveys' system: {expected}")
        value = columns[chosen][k] if chosen is not None else None
        name = own = _name(value) or str(k + 1)
        times = 1
        while name in taken:
            times += 1
            name = f"{own} ({times})"
        taken.add(name)
        found.append(Region(name, shapely.make_valid(geometry)))
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
