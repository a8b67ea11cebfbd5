"""Write shapes of a map as GeoPackage and GeoJSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from pyproj import CRS, Transformer
from shapely.geometry.base import BaseGeometry

from tidefield.errors import need
from tidefield.files import completed_file, write_text
from tidefield.geometry.geodesy import WGS84, lost_in_conversion
from tidefield.maps.styles import Lines, style_of_layer

if TYPE_CHECKING:  # it needs PyTorch, which `change` does without
    from tidefield.maps.grid import MapFrame


@dataclass(frozen=True)
class Layer:
    """Shapes of one kind.

    Attributes:
        name: of the layer.
        kind: of the shapes, such as "Polygon"; "Unknown" of several.
        shapes: in map coordinates.
        fields: numbers or texts of each shape.
        style: how QGIS shows it in a GeoPackage.
    """

    name: str
    kind: str
    shapes: Sequence[BaseGeometry]
    fields: Mapping[str, Sequence[float | int | str]]
    style: Lines | None = None


def write_geopackage(path: Path, layers: Sequence[Layer], wkt: str) -> None:
    """Write layers into one GeoPackage.

    Args:
        wkt: the horizontal coordinate system of all.

    Raises:
        RunError: its folder cannot be written to.
    """
    raw = need("pyogrio").raw
    with completed_file(path, overwrite=True) as partial:
        partial.unlink()  # GDAL makes its own
        for number, layer in enumerate(layers):
            raw.write(
                partial,
                geometry=np.array([shapely.to_wkb(shape) for shape in layer.shapes], dtype=object),
                field_data=[np.array(values) for values in layer.fields.values()],
                fields=list(layer.fields),
                geometry_type=layer.kind,
                crs=wkt,
                driver="GPKG",
                layer=layer.name,
                append=number > 0,
                dataset_options={"VERSION": "1.3"},  # which older programs know whole
            )
        if styles := _styles(layers):
            raw.write(
                partial,
                geometry=None,
                field_data=[np.array(values) for values in styles.values()],
                fields=list(styles),
                driver="GPKG",
                layer="layer_styles",
                append=True,
            )


def _styles(layers: Sequence[Layer]) -> dict[str, Sequence[Any]]:
    """The columns of the table in which QGIS keeps the styles of a GeoPackage's layers; none without styles."""
    styled = [(layer.name, style_of_layer(layer.style, "Polygon" in layer.kind)) for layer in layers if layer.style]
    if not styled:
        return {}
    names, texts = zip(*styled, strict=True)
    count = len(styled)
    return {
        "f_table_catalog": [""] * count,
        "f_table_schema": [""] * count,
        "f_table_name": names,
        "f_geometry_column": ["geom"] * count,
        "styleName": names,
        "styleQML": texts,
        "styleSLD": [""] * count,
        "useAsDefault": [True] * count,
        "description": [""] * count,
        "owner": [""] * count,
        "update_time": [np.datetime64("now", "ms")] * count,
    }


def lost_in_geojson(frame: MapFrame) -> str | None:
    """In a sentence what GeoJSON of a map loses where PROJ lacks the grid of its datum; None if nothing."""
    if frame.frame is None:
        return None
    lost = lost_in_conversion(CRS.from_wkt(frame.horizontal_wkt), CRS(WGS84))
    return f"GeoJSON: coordinates {lost}; GeoPackages have the same shapes in the map's coordinates" if lost else None


def write_geojson(path: Path, layer: Layer, frame: MapFrame) -> None:
    """Write a layer as GeoJSON, in longitude and latitude (RFC 7946); in a local frame as it is."""
    move = None
    if frame.frame is not None:
        move = Transformer.from_crs(CRS.from_wkt(frame.horizontal_wkt), WGS84, always_xy=True)

    def moved(xy: np.ndarray) -> np.ndarray:
        return np.round(xy if move is None else np.column_stack(move.transform(*xy.T)), 9)

    features: list[dict[str, Any]] = [
        {
            "type": "Feature",
            "properties": {name: values[k] for name, values in layer.fields.items()},
            "geometry": shapely.geometry.mapping(shapely.transform(shape, moved)),
        }
        for k, shape in enumerate(layer.shapes)
    ]
    write_text(path, json.dumps({"type": "FeatureCollection", "features": features}) + "\n")
