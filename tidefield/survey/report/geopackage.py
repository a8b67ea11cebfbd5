"""Write the layers of a survey as a GeoPackage, in the survey's own coordinate reference system.

A GeoPackage is an SQLite database with some tables of its own (OGC 12-128r18, https://www.geopackage.org/spec130/), so
that no further library is needed.
"""

from __future__ import annotations

import json
import sqlite3
import struct
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError
from shapely.geometry.base import BaseGeometry

from tidefield.geometry.geodesy import LocalFrame, parse_crs

_APPLICATION, _VERSION = 0x47504B47, 10300  # "GPKG", 1.3.0
_OWN_CRS = 100_000  # of a system without an EPSG code
_TYPES = {bool: "BOOLEAN", int: "INTEGER", float: "REAL", str: "TEXT"}
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
    organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
    description TEXT DEFAULT '', last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
    srs_id INTEGER REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL UNIQUE REFERENCES gpkg_contents(table_name),
    column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL REFERENCES
    gpkg_spatial_ref_sys(srs_id), z TINYINT NOT NULL, m TINYINT NOT NULL, PRIMARY KEY (table_name, column_name));
"""
_NO_CRS = [
    ("Undefined Cartesian SRS", -1, "NONE", -1, "undefined", None),
    ("Undefined geographic SRS", 0, "NONE", 0, "undefined", None),
]


@dataclass(frozen=True)
class Layer:
    """Features of one kind.

    Attributes:
        name: what it is; the table's has underscores for spaces.
        geometry: "POINT", "POLYGON" or "MULTIPOLYGON".
        features: geometries in the projected system, and their properties: numbers, texts or None.
    """

    name: str
    geometry: str
    features: Sequence[tuple[BaseGeometry, Mapping[str, Any]]]


def write_geopackage(path: Path, layers: Sequence[Layer], frame: LocalFrame, date: datetime) -> None:
    """Write layers that have features into a new file."""
    crs = parse_crs(frame.crs)
    number = frame.epsg or _OWN_CRS
    wgs84 = ("WGS 84", 4326, "EPSG", 4326, _wkt(parse_crs("EPSG:4326")), None)
    own = (crs.name, number, "EPSG" if frame.epsg else "NONE", number, _wkt(crs), None)
    with closing(sqlite3.connect(path)) as db, db:
        db.executescript(f"PRAGMA application_id = {_APPLICATION}; PRAGMA user_version = {_VERSION}; {_TABLES}")
        systems = [*_NO_CRS, wgs84, *([own] if number != 4326 else [])]
        db.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", systems)
        for layer in layers:
            if layer.features:
                _write_layer(db, layer, number, f"{date:%Y-%m-%dT%H:%M:%S}.000Z")


def _write_layer(db: sqlite3.Connection, layer: Layer, number: int, date: str) -> None:
    columns, names = "", list(layer.features[0][1])
    for column in names:
        known = (values[column] for _, values in layer.features)
        kind = next((type(value) for value in known if value is not None), float)
        columns += f", {_quoted(column)} {_TYPES[kind]}"
    name = layer.name.replace(" ", "_")
    table = _quoted(name)
    db.execute(f"CREATE TABLE {table} (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom {layer.geometry}{columns})")
    bounds = shapely.total_bounds([geometry for geometry, _ in layer.features]).tolist()
    contents = (name, "features", layer.name, "", date, *bounds, number)
    db.execute(f"INSERT INTO gpkg_contents VALUES ({', '.join('?' * len(contents))})", contents)
    db.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)", (name, layer.geometry, number))
    # "GP", version 0, little-endian without an envelope; then well-known binary.
    header = b"GP\0\x01" + struct.pack("<i", number)
    rows = [
        (header + shapely.to_wkb(place, byte_order=1), *properties.values()) for place, properties in layer.features
    ]
    db.executemany(f"INSERT INTO {table} VALUES (NULL{', ?' * (1 + len(names))})", rows)


def _wkt(crs: CRS) -> str:
    """The text of a system as GeoPackages have it, or in the newer form where the older one has no words for it."""
    try:
        return crs.to_wkt("WKT1_GDAL")
    except CRSError:
        return crs.to_wkt()


def _quoted(name: str) -> str:
    return json.dumps(name)
