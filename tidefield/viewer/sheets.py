"""Sheets: the folders of maps and changes that a page shows, and their layers."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tidefield.change.inputs import ORTHOPHOTOS, SURFACES, first_of
from tidefield.change.statistics import colour_limit
from tidefield.change.surfaces import Surface, date_in, open_surface, opened, system_of_ground
from tidefield.errors import RunError
from tidefield.files import read_json
from tidefield.geometry.geodesy import in_metres, is_local, same_system
from tidefield.viewer.rasters import black_and_white, common_ends, opened_source, overview, usual_ends

CHANGE_FILE, CHANGE_RASTER, MAP_FILE = "change.json", "change.tif", "map.json"
HILLSHADES = ("odm_dem/dsm_hillshade.tif", "odm_dem/dtm_hillshade.tif")


@dataclass(frozen=True)
class Layer:
    """A raster's band to look at.

    Attributes:
        name: in addresses.
        title: for people.
        source, band: the raster, or the surface that it holds.
        kind: "picture" (colours, or grey), or values that the page colours: "height", "error" or "change".
        low, high: ends of the colours; most values are between them. Of pictures: black and white.
        largest: size of a change, in a small picture of it.
    """

    name: str
    title: str
    source: Path | Surface
    band: int
    kind: str
    low: float = 0.0
    high: float = 1.0
    largest: float = 0.0


@dataclass(frozen=True)
class Sheet:
    """A map, or a change between two.

    Attributes:
        folder: where it is.
        title: the folder's name.
        date: YYYY-MM-DD, if it is known.
        kind: "map" or "change".
        layers: of it.
        heights, sigma: a map's surface and its standard error.
        numbers: what change.json or map.json has.
    """

    folder: Path
    title: str
    date: str | None
    kind: str
    layers: tuple[Layer, ...]
    heights: Surface | None
    sigma: Surface | None
    numbers: dict[str, Any]

    @property
    def detection_m(self) -> float | None:
        """The usual level of detection of a change."""
        return self.numbers["level_of_detection_m"].get("median") if self.kind == "change" else None


def is_sheet(folder: Path) -> bool:
    """Return whether a folder is one of `tidefield map`, ODM or `tidefield change`."""
    return folder.is_dir() and (
        (folder / CHANGE_RASTER).is_file()
        or first_of(folder, SURFACES) is not None
        or first_of(folder, ORTHOPHOTOS) is not None
    )


def open_sheet(folder: Path) -> Sheet:
    """Open a folder of a map or a change.

    Raises:
        RunError: it is neither, or not complete, or damaged.
    """
    name = folder.resolve().name
    if (folder / CHANGE_RASTER).is_file():
        numbers = _numbers_of_change(folder)
        dz = folder / CHANGE_RASTER
        sizes = np.abs(overview(dz, 1))
        largest = float(sizes.max(initial=0.0))
        limit = colour_limit(sizes, numbers["level_of_detection_m"].get("median") or 0.0) or 1.0
        layers = (
            Layer("change", "Change", dz, 1, "change", -limit, limit, largest),
            Layer("error", "Error of change", dz, 2, "error", *usual_ends(dz, 2)),
        )
        return Sheet(folder, name, numbers["later"].get("date"), "change", layers, None, None, numbers)
    surface = first_of(folder, SURFACES)
    heights = surface and _surface(surface)
    sigma = _surface(heights.sigma) if heights is not None and heights.sigma is not None else None
    found: list[Layer] = []
    for kind, title, path in (
        ("orthophoto", "Orthophoto", first_of(folder, ORTHOPHOTOS)),
        ("hillshade", "Hillshade", first_of(folder, HILLSHADES)),
    ):
        if path is not None:
            _require_place(path)
            found.append(Layer(kind, title, path, 1, "picture", *black_and_white(path)))
    if heights is not None and sigma is not None:
        sigma = replace(sigma, metres=heights.metres)  # whatever unit of heights its file states
    if heights is not None:
        found.append(Layer("height", "Height", heights, 1, "height", *usual_ends(heights, 1)))
    if sigma is not None:
        found.append(Layer("error", "Error of height", sigma, 1, "error", *usual_ends(sigma, 1)))
    if not found:
        raise RunError(f"{folder} is no map: expected a folder of `tidefield map`, ODM or `tidefield change`")
    numbers = read_json(folder / MAP_FILE) or {}
    date = date_in(name) or (date_in(str(numbers.get("scene", ""))) if isinstance(numbers, dict) else None)
    date = date or (heights.date if heights is not None else None)
    return Sheet(folder, name, date, "map", tuple(found), heights, sigma, numbers)


def _numbers_of_change(folder: Path) -> dict[str, Any]:
    """What change.json has; raises a RunError where a part of it is missing."""
    numbers = read_json(folder / CHANGE_FILE)
    parts = ("earlier", "later", "level_of_detection_m", "registration", "variogram", "volumes")
    whole = isinstance(numbers, dict) and all(isinstance(numbers.get(part), dict) for part in parts)
    sills, ranges = (numbers["variogram"].get(name) if whole else None for name in ("sill_shares", "ranges_m"))
    if not (isinstance(sills, list) and isinstance(ranges, list) and len(sills) == len(ranges)):
        raise RunError(f"{folder} has no {CHANGE_FILE} of a change: expected what `tidefield change` wrote")
    return numbers


def _surface(path: Path) -> Surface:
    """A surface whose cells that are NaN show nothing, also where the file does not declare that."""
    from rasterio.enums import MaskFlags

    found = open_surface(path)
    with opened(path) as file:
        undeclared = file.dtypes[0].startswith("float") and MaskFlags.all_valid in file.mask_flag_enums[0]
    return replace(found, unknown=(*found.unknown, math.nan)) if undeclared else found


def with_common_ends(sheets: list[Sheet]) -> list[Sheet]:
    """The sheets, with the same colours for all heights, and for all errors: the page has one legend for two dates."""
    layers = [layer for sheet in sheets for layer in sheet.layers]
    ends: dict[str, dict[str, float]] = {}
    for kind in {layer.kind for layer in layers} & {"height", "error"}:
        low, high = common_ends([(layer.low, layer.high) for layer in layers if layer.kind == kind])
        ends[kind] = {"low": low, "high": high}
    return [
        replace(sheet, layers=tuple(replace(layer, **ends.get(layer.kind, {})) for layer in sheet.layers))
        for sheet in sheets
    ]


def with_own_titles(sheets: list[Sheet]) -> list[Sheet]:
    """The sheets, with their folders' folders in the titles where these would be alike."""
    titles = [sheet.title for sheet in sheets]
    return [
        replace(sheet, title=f"{sheet.folder.resolve().parent.name}/{sheet.title}")
        if titles.count(sheet.title) > 1
        else sheet
        for sheet in sheets
    ]


def _require_place(path: Path) -> None:
    """Raises: RunError when a picture has no corners on a map."""
    with opened(path) as file:
        if file.transform.is_identity:
            raise RunError(
                f"{path} has no place on a map: expected a georeferenced GeoTIFF; state its corners (gdal_edit.py "
                "-a_ullr)"
            )


def system_of(sheet: Sheet, crs: Any) -> Any:
    """A sheet's system; a UTM zone where that is in degrees, or in metres that are shorter on the ground."""
    from pyproj import CRS

    own = CRS.from_wkt(crs.to_wkt())
    if is_local(own) or not (own.is_geographic or (own.is_projected and in_metres(own))):
        return crs
    with opened_source(placed(sheet)[0]) as file:
        corner, column, row = file.transform, file.width / 2, file.height / 2
    x = corner.c + corner.a * column + corner.b * row
    y = corner.f + corner.d * column + corner.e * row
    metric = system_of_ground(own, (x, y), sheet.folder, "gdal_edit.py -a_srs")
    return crs if same_system(metric, own) else type(crs).from_wkt(metric.to_wkt())


def placed(sheet: Sheet) -> tuple[Path | Surface, Any]:
    """The first raster of a sheet that states a coordinate system, and that; the first of all where none does."""
    for layer in sheet.layers:
        with opened_source(layer.source) as file:
            if file.crs is not None:
                return layer.source, file.crs
    return sheet.layers[0].source, None


def state_of(sheets: Sequence[Sheet]) -> list[tuple[int, int] | None]:
    """Sizes and times of the files that sheets show."""
    shown = [
        *(layer.source for sheet in sheets for layer in sheet.layers),
        *(sheet.folder / name for sheet in sheets for name in (CHANGE_FILE, MAP_FILE)),
    ]
    state: list[tuple[int, int] | None] = []
    for source in shown:
        try:
            found = os.stat(source.path if isinstance(source, Surface) else source)
            state.append((found.st_size, found.st_mtime_ns))
        except OSError:
            state.append(None)
    return state
