"""Polygons and lines of a user, in a map's coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Bool
from pyproj import CRS
from shapely.geometry.base import BaseGeometry, BaseMultipartGeometry

from tidefield.errors import RunError
from tidefield.geometry.drawn import read_drawn
from tidefield.maps.grid import MapFrame, Tile


def read_shapes(path: Path, frame: MapFrame | None, kind: str) -> list[tuple[BaseGeometry, str]]:
    """Read the geometries of a file and their names, in map coordinates; with a local frame, as they are.

    Args:
        path: the file.
        frame: map coordinates; None leaves those of the file.
        kind: of geometries that are wanted: "Polygon" or "LineString".

    Raises:
        RunError: as `read_drawn` and `Drawn.placed`, or the file has no such geometry.
    """
    drawn = read_drawn(path)
    target = None if frame is None or frame.frame is None else CRS.from_wkt(frame.horizontal_wkt)
    placed = zip(drawn.placed(target), drawn.names, strict=True)
    shapes = [(part, name) for shape, name in placed for part in _parts(shape, kind)]
    if not shapes:
        raise RunError(f"{path} has no {kind}: expected at least one; draw it in a GIS")
    return shapes


def _parts(shape: BaseGeometry, kind: str) -> Iterator[BaseGeometry]:
    """The geometries of a kind in a collection of collections."""
    if isinstance(shape, BaseMultipartGeometry):
        for part in shape.geoms:
            yield from _parts(part, kind)
    elif shape.geom_type == kind and not shape.is_empty:
        yield shape


def inside(area: BaseGeometry | None, tile: Tile) -> Bool[np.ndarray, "H W"]:
    """Which centres of a tile's cells lie in an area; all without one."""
    if area is None:
        return np.ones((tile.side, tile.side), dtype=bool)
    east, north = tile.offsets()
    middle = tile.centre
    x, y = np.broadcast_arrays(middle[0] + east.astype(np.float64), middle[1] + north.astype(np.float64))
    return np.asarray(shapely.contains_xy(area, x, y))


def touches(area: BaseGeometry | None, tile: Tile) -> bool:
    """Whether an area has something of a tile."""
    if area is None:
        return True
    half = tile.side * tile.grid.cell / 2
    east, north = tile.centre
    return bool(area.intersects(shapely.box(east - half, north - half, east + half, north + half)))
