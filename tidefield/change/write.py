"""Write what changed: Cloud-Optimized GeoTIFFs, a GeoPackage, CSV and JSON."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool
from pyproj import CRS
from shapely.geometry.base import BaseGeometry

from tidefield import __version__
from tidefield.change.cover import LEAST_M2, Cover
from tidefield.change.measure import Change
from tidefield.change.statistics import Z95, colour_limit, p_values
from tidefield.change.surfaces import PLAIN, Grid, Surface, opened
from tidefield.change.volumes import Volume
from tidefield.change.water import Water, Waterline
from tidefield.errors import need
from tidefield.files import plain_cell, write_json, write_text
from tidefield.maps.rasters import Raster, RasterWriter, cog_writer
from tidefield.maps.styles import GAINED, HIGHER, INK, LOST, LOWER, PLANTS, SIGNS, Classes, Lines, Style, change_ramp
from tidefield.maps.vectors import Layer, write_geopackage

MOST_OUTLINES = 5000
"""Polygons that are written, the largest volumes first."""
_MOST_POLYGONS_OF_GROUND = 2000
UNKNOWN = -128.0
"""In significant.tif."""
SIGNED = "int16"
"""Of rasters with signs: before GDAL 3.7, QGIS takes signed bytes for unsigned ones."""
CHANGE_BANDS = (
    "dz: later minus earlier height (m)",
    "sigma: one standard error of dz (m)",
    "p: two-sided p-value of dz",
    "shared: the part of sigma that is systematic, which volumes do not average out (m)",
)
COVER_BANDS = ("plants: 1 gained, -1 lost, 2 at both dates, 0 at none",)
SIGNIFICANT_BANDS = (
    "cell by cell: -1 lower, 1 higher, 0 neither, at 95%",
    "outlined: -1 lower, 1 higher, 0 neither; by windows of cells",
)


OUTLINE_FIELDS: tuple[str, ...] = (
    "id",
    "change",
    "area_m2",
    "volume_m3",
    "low_m3",
    "high_m3",
    "mean_dz_m",
    "largest_dz_m",
    "east",
    "north",
)


@contextmanager
def cog(
    path: Path,
    grid: Grid,
    bands: tuple[str, ...],
    kind: str,
    nodata: float,
    tags: Mapping[str, str] | None = None,
    style: Style | None = None,
) -> Iterator[RasterWriter]:
    """Write a raster of a grid by rows; it is there, as a Cloud-Optimized GeoTIFF, when the block ends."""
    raster = Raster(path, bands, kind, nodata, tags=tags or {}, style=style)
    with (
        need("rasterio").Env(GDAL_CACHEMAX=256),
        cog_writer(raster, grid.columns, grid.rows, grid.crs, grid.transform[:6], fast=True) as writer,
    ):
        yield writer


def write_rasters(change: Change, folder: Path) -> None:
    """Write change.tif (`CHANGE_BANDS`) and significant.tif."""
    tags = {"EARLIER": change.earlier.name, "LATER": change.later.name}
    step = 1 + math.isqrt(change.dz.size // 1_000_000)
    sizes = np.abs(change.dz[::step, ::step])
    ramp = change_ramp(1, colour_limit(sizes[np.isfinite(sizes)], change.detection_m[1]) or 1.0)
    outlined_in = Classes(2, SIGNS)
    lookup = np.concatenate([[0], change.outlines.signs]).astype(np.int8)
    with (
        cog(folder / "change.tif", change.grid, CHANGE_BANDS, "float32", math.nan, tags, ramp) as numbers,
        cog(folder / "significant.tif", change.grid, SIGNIFICANT_BANDS, SIGNED, UNKNOWN, tags, outlined_in) as signs,
    ):
        for rows in change.grid.strips():
            dz = change.dz[rows]
            known = np.isfinite(dz)
            sigma, shared = (np.where(known, each, np.float32(np.nan)) for each in change.errors.cell_sigmas(rows))
            numbers.write(rows.start, np.stack([dz, sigma, p_values(dz / sigma), shared]))
            alone = np.where(np.abs(dz) > Z95 * sigma, np.sign(np.where(known, dz, 0)), 0).astype(np.int8)
            outlined = lookup[change.outlines.labels[rows]]
            signs.write(rows.start, np.where(known, np.stack([alone, outlined]), np.int8(UNKNOWN)))


def polygons_of(
    labels: np.ndarray, grid: Grid, mask: Bool[np.ndarray, "rows columns"]
) -> Iterator[tuple[int, BaseGeometry]]:
    """Outlines of equal labels along the edges of cells."""
    need("rasterio")
    from rasterio.features import shapes

    for shape, value in shapes(labels, mask=mask, connectivity=8, transform=grid.transform):
        rings = shape["coordinates"]
        yield int(value), shapely.make_valid(shapely.Polygon(rings[0], rings[1:]))


def outline_rows(change: Change) -> list[dict[str, Any]]:
    """One row for each outline, the largest volume first."""
    signs = change.outlines.signs
    values = [
        (
            number,
            "lower" if signs[number - 1] < 0 else "higher",
            volume.area_m2,
            volume.value_m3,
            *volume.interval_m3,
            float(signs[number - 1]) * volume.value_m3 / volume.area_m2,
            float(signs[number - 1]) * largest,
            *_middle(change, number),
        )
        for number, volume, largest in change.each
    ]
    rows: list[dict[str, Any]] = [dict(zip(OUTLINE_FIELDS, of, strict=True)) for of in values]
    return sorted(rows, key=lambda row: -row["volume_m3"])


def _middle(change: Change, number: int) -> tuple[float, float]:
    """East and north of the mean of an outline's cells, in the comparison's coordinates."""
    box = change.outlines.boxes[number - 1]
    row, column = np.nonzero(change.outlines.labels[box] == number)
    part = change.grid.part(box)
    return part.west_m + part.cell_m * float(column.mean() + 0.5), part.north_m - part.cell_m * float(row.mean() + 0.5)


def volume_rows(change: Change) -> list[dict[str, Any]]:
    """One row for each volume: of the whole, and of the user's polygons."""
    named: list[tuple[str, str, Volume, float | None]] = [
        ("all", "net", change.net, None),
        ("all", "cut", change.cut, None),
        ("all", "fill", change.fill, None),
        ("all", "net outside of the outlines", change.outside, None),
    ]
    for one in change.per_region:
        named += [(one.region.name, what, volume, one.compared) for what, volume in one.volumes.items()]
    return [
        {"region": region, "volume": what, **volume.to_json(), "compared": compared}
        for region, what, volume, compared in named
    ]


def write_tables(change: Change, folder: Path) -> None:
    """Write volumes.csv and outlines.csv."""
    write_csv(folder / "volumes.csv", volume_rows(change))
    write_csv(folder / "outlines.csv", outline_rows(change), OUTLINE_FIELDS)


def write_csv(path: Path, rows: list[dict[str, Any]], fields: Sequence[str] = ()) -> None:
    """Write rows with one set of keys, or these fields; numbers are rounded to four decimals."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fields or list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: round(v, 4) if isinstance(v, float) else plain_cell(v) for k, v in row.items()})
    write_text(path, text.getvalue())


def write_cover(cover: Cover, folder: Path) -> None:
    """Write cover.tif and cover.csv."""
    with cog(folder / "cover.tif", cover.grid, COVER_BANDS, SIGNED, UNKNOWN, style=Classes(1, PLANTS)) as writer:
        for rows in cover.grid.strips():
            writer.write(rows.start, cover.classes[rows][None])
    table = [
        {"region": region, "cover": what, "area_m2": area.value_m2, "low_m2": area.low_m2, "high_m2": area.high_m2}
        for region, of in cover.areas.items()
        for what, area in of.items()
    ]
    write_csv(folder / "cover.csv", table)


def _layer(name: str, shapes: list[BaseGeometry], rows: list[dict[str, Any]], style: Lines | None = None) -> Layer:
    """A layer with a row of fields for each shape."""
    shapes = _multi(shapes)
    kinds = {shape.geom_type for shape in shapes}
    kind = kinds.pop() if kinds in ({"MultiPolygon"}, {"LineString"}) else "Unknown"
    return Layer(name, kind, shapes, {key: [row[key] for row in rows] for key in rows[0]} if rows else {}, style)


def _cover_layer(cover: Cover) -> Layer:
    moved = (cover.classes == 1) | (cover.classes == -1)
    shapes = [
        (shape, {"cover": "gained" if value > 0 else "lost", "area_m2": shape.area})
        for value, shape in polygons_of(cover.classes.astype(np.int16), cover.grid, moved)
        if shape.area >= LEAST_M2
    ]
    shapes = sorted(shapes, key=lambda pair: -pair[0].area)[:MOST_OUTLINES]
    style = Lines("cover", (("gained", GAINED), ("lost", LOST)))
    return _layer("cover", [shape for shape, _ in shapes], [row for _, row in shapes], style)


def _water_layer(water: Waterline) -> Layer:
    rows = [
        (line, {"date": date, "level_m": level, "length_m": line.length})
        for date, level, lines in zip(("earlier", "later"), water.levels_m, water.lines, strict=True)
        for line in lines
    ]
    style = Lines("date", (("earlier", INK), ("later", HIGHER)))
    return _layer("waterlines", [line for line, _ in rows], [row for _, row in rows], style)


def write_layers(change: Change, folder: Path, cover: Cover | None = None, water: Water | None = None) -> None:
    """Write change.gpkg with the outlines, stable ground, the user's polygons, cover that moved, and waterlines."""
    rows = {row["id"]: row for row in outline_rows(change)[:MOST_OUTLINES]}
    shapes: dict[int, list[BaseGeometry]] = {}
    for number, polygon in polygons_of(change.outlines.labels, change.grid, change.outlines.labels > 0):
        if number in rows:
            shapes.setdefault(number, []).append(polygon)
    style = Lines("change", (("lower", LOWER), ("higher", HIGHER)))
    layers = [_layer("outlines", [shapely.union_all(shapes[k]) for k in rows], list(rows.values()), style)]
    step = 1 + math.isqrt(change.stable.size // 4_000_000)
    thin = change.stable[::step, ::step]
    ground = [shape for _, shape in polygons_of(thin.astype(np.uint8), change.grid.thinned(step), thin)]
    ground = sorted(ground, key=lambda shape: -shape.area)[:_MOST_POLYGONS_OF_GROUND]
    layers.append(_layer("stable_ground", ground, [{"area_m2": shape.area} for shape in ground]))
    layers.append(
        _layer(
            "polygons",
            [one.region.geometry for one in change.per_region],
            [
                {
                    "name": one.region.name,
                    "compared": one.compared,
                    **{
                        f"{what}_{key}": value
                        for what, volume in one.volumes.items()
                        for key, value in (
                            ("m3", volume.value_m3),
                            ("low_m3", volume.interval_m3[0]),
                            ("high_m3", volume.interval_m3[1]),
                        )
                    },
                }
                for one in change.per_region
            ],
        )
    )
    if cover is not None:
        layers.append(_cover_layer(cover))
    if water is not None and water.waterline is not None:
        layers.append(_water_layer(water.waterline))
    write_geopackage(folder / "change.gpkg", [layer for layer in layers if layer.shapes], change.grid.crs or PLAIN)


def _multi(shapes: list[BaseGeometry]) -> list[BaseGeometry]:
    """Lines and points as they are; of everything else the polygons."""
    return [_polygons(shape) if shapely.get_dimensions(shape) == 2 else shape for shape in shapes]


def _polygons(shape: BaseGeometry) -> BaseGeometry:
    parts = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon"]
    if shape.geom_type == "GeometryCollection":
        parts += [p for m in shapely.get_parts(shape) if m.geom_type == "MultiPolygon" for p in shapely.get_parts(m)]
    return shapely.MultiPolygon(parts)


def summary(change: Change, command: str) -> dict[str, Any]:
    """All numbers of a change, for change.json."""
    registration, variogram = change.errors.registration, change.errors.variogram
    low, middle, high = change.detection_m
    return {
        "tidefield": __version__,
        "command": command,
        "earlier": _survey(change.earlier),
        "later": _survey(change.later),
        "grid": {
            "crs": change.grid.crs,
            "bounds_m": list(change.grid.bounds),
            "cell_m": change.grid.cell_m,
            "columns": change.grid.columns,
            "rows": change.grid.rows,
        },
        "cells": round(change.net.area_m2 / change.grid.cell_area_m2),
        "area_m2": change.net.area_m2,
        "registration": {
            "model": registration.model,
            "vertical_m": registration.vertical_m,
            "tilt_m_per_m": list(registration.coefficients[1:]),
            "shift_m": list(registration.shift_m),
            "shift_error_m": registration.shift_error_m,
            "shift_error_stated": registration.shift_stated,
            "systematic_m": registration.systematic_m,
            "datum_error_m": change.errors.datum_error_m,
            "stable_ground": "given" if change.stable_given else "found",
            "stable_cells": registration.stable_cells,
            "before": dict(zip(("median_m", "nmad_m", "deviation95_m"), registration.before, strict=True)),
            "after": dict(zip(("median_m", "nmad_m", "deviation95_m"), registration.after, strict=True)),
            "words": registration.words,
        },
        "variogram": {
            "nugget_share": variogram.nugget,
            "sill_shares": list(variogram.sills),
            "ranges_m": list(variogram.ranges_m),
            "reached": variogram.reached,
            "assumed_m": variogram.assumed_m,
            "lags_m": list(variogram.lags_m),
            "semivariance_shares": list(variogram.semivariances),
            "pairs": list(variogram.pairs),
        },
        "level_of_detection_m": {"q05": low, "median": middle, "q95": high},
        "null_test": {"significant_share_of_stable_cells": change.false_alarms, "expected": 0.05},
        "outlines": {
            "windows_cells": list(change.outlines.windows),
            "margin_cells": change.outlines.margin,
            "threshold_z": change.outlines.threshold if math.isfinite(change.outlines.threshold) else None,
            "number": len(change.each),
        },
        "volumes": {
            "net": change.net.to_json(),
            "cut": change.cut.to_json(),
            "fill": change.fill.to_json(),
            "net_outside_of_outlines": change.outside.to_json(),
            "cells_beyond_level_of_detection": {"cut_m3": change.threshold_cut_m3, "fill_m3": change.threshold_fill_m3},
        },
        "regions": [
            {
                "name": one.region.name,
                **{what: volume.to_json() for what, volume in one.volumes.items()},
                "compared": one.compared,
            }
            for one in change.per_region
        ],
        "remarks": change.remarks,
    }


def _survey(surface: Surface) -> dict[str, Any]:
    return {
        "file": surface.file,
        "date": surface.date,
        "crs": _system_name(surface),
        "pixel": [abs(surface.transform.a), abs(surface.transform.e)],
        "nodata": surface.nodata if surface.nodata is None or math.isfinite(surface.nodata) else str(surface.nodata),
        "unknown": list(surface.unknown),
        "sigma": surface.sigma.name if surface.sigma is not None else None,
    }


def _system_name(surface: Surface) -> str | None:
    """Name of a surface's coordinate system, or of the local frame that it lies in; None where it states none."""
    if surface.crs is not None:
        return surface.crs.name
    with opened(surface.path) as file:
        return None if file.crs is None else CRS.from_wkt(file.crs.to_wkt()).name


def write_all(
    change: Change, folder: Path, command: str, cover: Cover | None = None, water: Water | None = None
) -> dict[str, Any]:
    """Write all files of a change but its page; returns the numbers."""
    write_rasters(change, folder)
    write_tables(change, folder)
    write_layers(change, folder, cover, water)
    numbers = summary(change, command)
    numbers["cover"] = None if cover is None else cover.to_json()
    numbers["water"] = None if water is None else water.to_json()
    if cover is not None:
        write_cover(cover, folder)
    write_json(folder / "change.json", numbers)
    return numbers
