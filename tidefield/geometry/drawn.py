"""Polygons and lines that users draw: GeoJSON, GeoPackages or shapefiles."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pyproj import CRS
from pyproj.exceptions import ProjError
from shapely.geometry.base import BaseGeometry, BaseMultipartGeometry

from tidefield.errors import RunError, need
from tidefield.files import reading_from
from tidefield.geometry.geodesy import is_local, lost_in_conversion, transformer

_log = logging.getLogger(__name__)

_MOST = 10_000
_LARGEST = 1 << 28
_EXPECTED = "expected polygons or lines as GeoJSON, GeoPackage or shapefile; name another file"
_NAMES = ("name", "id", "label", "title", "location", "tr_id")
_REFERENCES = (b"<OGR", b"gdal_streamed_alg")
"""Of GDAL's files that refer to other files, or addresses."""


@dataclass(frozen=True)
class Drawn:
    """The geometries of a file.

    Attributes:
        path: of the file.
        geometries: in two dimensions, none of them empty.
        names: of each, by a column such as `name` or `id`; "" where there is none.
        crs: None where the file has no place on Earth.
    """

    path: Path
    geometries: list[BaseGeometry]
    names: list[str]
    crs: CRS | None

    def of_kind(self, kind: str) -> Drawn:
        """Select the geometries of a kind, "Polygon" or "LineString", and those in collections, with their names.

        Raises:
            RunError: there is none.
        """
        parts = [
            (part, name)
            for shape, name in zip(self.geometries, self.names, strict=True)
            for part in _parts(shape)
            if part.geom_type == kind and not part.is_empty
        ]
        if not parts:
            raise RunError(f"{self.path} has no {kind}: expected at least one; draw it in a GIS")
        return replace(self, geometries=[part for part, _ in parts], names=[name for _, name in parts])

    def placed(self, to: CRS | None) -> Drawn:
        """Return the geometries in another system, valid; as they are where either has no place on Earth.

        An outline that crosses itself, as drawn by hand, has an inside all the same.

        Raises:
            RunError: some have no place there.
        """
        found = self.geometries
        if self.crs is not None and to is not None and not is_local(to):
            try:
                there = transformer(self.crs, to)
            except ProjError as error:
                raise RunError(
                    f"{self.path} cannot be converted to {to.name} ({error}): expected a system that fits its place; "
                    "assign it (ogr2ogr -a_srs)"
                ) from error
            if lost := lost_in_conversion(self.crs, to):
                _log.warning(f"{self.path.name}: coordinates {lost}")

            def converted(xy: np.ndarray) -> np.ndarray:
                return np.column_stack(there.transform(*xy.T))

            found = [shapely.transform(shape, converted) for shape in found]
        if not all(np.isfinite(shapely.get_coordinates(shape)).all() for shape in found):
            name = "any system" if to is None else to.name
            raise RunError(f"{self.path} has coordinates outside of {name}: expected places there; correct them")
        return replace(self, geometries=[shapely.make_valid(shape) for shape in found], crs=to)


def read_drawn(path: Path) -> Drawn:
    """Read all geometries of a file's layer.

    Args:
        path: the file; "file.gpkg:layer" where it has several layers.

    Raises:
        RunError: it cannot be read, is too large, or has several layers, or no geometry.
    """
    need("pyogrio")
    from pyogrio import list_layers, raw
    from pyogrio.errors import DataLayerError, DataSourceError

    asked = None
    with reading_from(path):
        if not path.is_file() and ":" in path.name:
            name, asked = path.name.rsplit(":", 1)
            path = path.with_name(name)
        if not path.is_file():
            raise RunError(f"{path} is not a file: {_EXPECTED}")
        if path.stat().st_size > _LARGEST:
            raise RunError(
                f"{path} has {path.stat().st_size / 1e6:.0f} MB, more than {_LARGEST / 1e6:.0f}: {_EXPECTED}"
            )
        with path.open("rb") as file:
            start = file.read(1 << 16)
            whole = start + file.read() if start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{") else b""
    if any(words in start for words in _REFERENCES) or start.startswith(b"PK"):  # an archive may hold such a file
        raise RunError(f"{path} refers to other data: {_EXPECTED}")
    try:
        layer = _layer(path, [str(name) for name, kind in list_layers(path) if kind is not None], asked)
        meta, _, shapes, columns = raw.read(path, layer=layer, max_features=_MOST + 1, force_2d=True)
        with np.errstate(invalid="ignore"):  # `Drawn.placed` refuses what is not finite
            geometries = shapely.from_wkb(shapes)
        crs = CRS(meta["crs"]) if meta["crs"] else None
        _require_system(path, whole, crs)
    except (DataSourceError, DataLayerError, ValueError, ProjError, shapely.errors.ShapelyError) as error:
        raise RunError(f"{path} is no GeoJSON, GeoPackage or shapefile ({error}): {_EXPECTED}") from error
    if len(geometries) > _MOST:
        raise RunError(f"{path} has more than {_MOST} features: {_EXPECTED}")
    fields = [str(name) for name in meta["fields"]]
    column = next((k for name in _NAMES for k, field in enumerate(fields) if field.lower() == name), None)
    given = [k for k, shape in enumerate(geometries) if shape is not None and not shape.is_empty]
    if not given:
        raise RunError(f"{path} has no geometries: {_EXPECTED}")
    return Drawn(
        path,
        [geometries[k] for k in given],
        ["" if column is None else _name(columns[column][k]) for k in given],
        # GeoPackages call a system without a place on Earth undefined.
        None if crs is None or is_local(crs) else crs,
    )


def _require_system(path: Path, text: bytes, crs: CRS | None) -> None:
    """Refuse GeoJSON in a system that nobody knows: GDAL takes longitude and latitude instead."""
    if b'"crs"' not in text or crs is None or crs.to_epsg() != 4326:
        return
    name: Any = json.loads(text)
    for key in ("crs", "properties", "name"):
        name = name.get(key) if isinstance(name, dict) else None
    if isinstance(name, str) and not re.search(r"84$|4326$", name):
        try:
            CRS.from_user_input(name)
        except ProjError as error:
            raise RunError(
                f"{path} names the coordinate system {name!r}, which nobody knows ({error}): expected one of EPSG's; "
                "correct the member crs"
            ) from error


def _parts(shape: BaseGeometry) -> Iterator[BaseGeometry]:
    """The single geometries in a collection of collections."""
    if isinstance(shape, BaseMultipartGeometry):
        for part in shape.geoms:
            yield from _parts(part)
    else:
        yield shape


def _layer(path: Path, layers: list[str], asked: str | None) -> str:
    """The layer that is read of those with geometries."""
    if asked is None and len(layers) == 1:
        return layers[0]
    if asked in layers:
        return asked
    if not layers:
        raise RunError(f"{path} has no geometries: {_EXPECTED}")
    raise RunError(
        f"{path} has {', '.join(layers)}: expected the name of one of these layers; write {path.name}:{layers[0]}"
    )


def _name(value: Any) -> str:
    """A name in a column; empty where there is none. Whole numbers next to missing ones are read as floats."""
    if isinstance(value, np.ndarray | list | tuple):
        return ", ".join(filter(None, map(_name, value)))
    if value is None or value != value:  # NaN and NaT differ from themselves
        return ""
    return str(int(value)) if isinstance(value, float | np.floating) and value.is_integer() else str(value)
