"""Read polygons and lines of GeoJSON files in a map's coordinates."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError
from shapely.geometry.base import BaseGeometry, BaseMultipartGeometry

from tidefield.errors import RunError
from tidefield.files import reading_from
from tidefield.geometry.geodesy import WGS84, lost_in_conversion
from tidefield.maps.grid import MapFrame, Tile

LARGEST = 1 << 25
_NONE = "{path} has no {wanted}: expected at least one; draw it in a GIS and export it as GeoJSON"
_log = logging.getLogger(__name__)


def read_shapes(path: Path, frame: MapFrame, kinds: tuple[str, ...]) -> list[tuple[BaseGeometry, dict[str, Any]]]:
    """Read the geometries of a GeoJSON file and their properties, in map coordinates.

    Coordinates are longitude and latitude (RFC 7946), or those of the file's member `crs`, as GDAL writes it; with a
    local frame, local ones.

    Args:
        path: the file.
        frame: map coordinates.
        kinds: of geometries that are wanted, such as "Polygon".

    Raises:
        RunError: as `parse`, or coordinates outside of the map's system.
    """
    shapes, crs = parse(path, kinds)
    shapes = [(part, about) for shape, about in shapes for part in _parts(shape, kinds)]
    if frame.frame is not None:
        target = CRS.from_wkt(frame.horizontal_wkt)
        to_map = Transformer.from_crs(crs, target, always_xy=True)
        if lost := lost_in_conversion(crs, target):
            _log.warning(f"{path.name}: coordinates {lost}")

        def converted(xy: np.ndarray) -> np.ndarray:
            return np.column_stack(to_map.transform(*xy.T))

        shapes = [(shapely.transform(shapely.force_2d(shape), converted), about) for shape, about in shapes]
    if not all(np.isfinite(shapely.get_coordinates(shape)).all() for shape, _ in shapes):
        expected = "local coordinates" if frame.frame is None else "longitude and latitude"
        raise RunError(f"{path} has coordinates outside of {frame.name}: expected {expected} of the survey")
    # An outline that crosses itself, as drawn by hand, has an inside all the same.
    shapes = [(part, about) for shape, about in shapes for part in _parts(shapely.make_valid(shape), kinds)]
    if not shapes:
        raise RunError(_NONE.format(path=path, wanted=" or ".join(kinds)))
    return shapes


def parse(path: Path, kinds: tuple[str, ...]) -> tuple[list[tuple[BaseGeometry, dict[str, Any]]], CRS]:
    """The geometries of a GeoJSON file, of any kind, with their properties, and the system of their coordinates.

    Args:
        path: the file.
        kinds: of geometries that are wanted.

    Raises:
        RunError: the file is missing, too large, no GeoJSON, or has none of these geometries.
    """
    wanted = " or ".join(kinds)
    with reading_from(path):
        if not path.is_file() or path.stat().st_size > LARGEST:
            raise RunError(f"{path} is no file of at most {LARGEST >> 20} MB: expected a GeoJSON file with a {wanted}")
        text = path.read_bytes()
    try:
        data = json.loads(text)
        features = data["features"] if data.get("type") == "FeatureCollection" else [data]
        with np.errstate(invalid="ignore"):  # `read_shapes` refuses what is not finite
            shapes = [
                (shapely.geometry.shape(geometry), dict(feature.get("properties") or {}))
                for feature in features
                if (geometry := feature.get("geometry", feature)) is not None  # RFC 7946, 3.2: it has no place
            ]
        named = (data.get("crs") or {}).get("properties", {}).get("name")
        crs = CRS.from_user_input(named) if named else CRS.from_user_input(WGS84)
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
        OverflowError,
        CRSError,
        shapely.errors.ShapelyError,
    ) as error:
        raise RunError(f"{path} is no GeoJSON ({error}): expected a file with a {wanted}; export it again") from error
    if not any(True for shape, _ in shapes for _ in _parts(shape, kinds)):
        raise RunError(_NONE.format(path=path, wanted=wanted))
    return shapes, crs


def _parts(shape: BaseGeometry, kinds: tuple[str, ...]) -> Iterator[BaseGeometry]:
    """The geometries of these kinds in a collection of collections."""
    if isinstance(shape, BaseMultipartGeometry):
        for part in shape.geoms:
            yield from _parts(part, kinds)
    elif shape.geom_type in kinds and not shape.is_empty:
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
