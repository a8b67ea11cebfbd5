"""An area that is mapped, on a map's tiles."""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Bool
from shapely.geometry.base import BaseGeometry

from tidefield.maps.grid import Tile


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
