"""Maps and changes to look at from straight above: layers, tiles, values, sections and volumes, in one system.

All is shown in the first coordinate system that a folder states, or a UTM zone where lengths in that are not those of
the ground, and heights in metres. Tiles are squares of `TILE_PX` pixels; those of level z have 2^-z of the side of the
whole area, and are counted from its north-western corner.
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64
from PIL import Image

from tidefield.change.errors import Z95, Variogram, colour_limit, region_error
from tidefield.change.inputs import ORTHOPHOTOS, SURFACES, first_of
from tidefield.change.surfaces import PLAIN, Surface, date_in, open_surface, opened, system_of_ground
from tidefield.change.volumes import Volume
from tidefield.errors import RunError
from tidefield.files import read_json
from tidefield.geometry.geodesy import in_metres, is_local, same_system
from tidefield.maps.grid import LOCAL_NAME

TILE_PX = 256
STEP = 0.0005
"""Of values in tiles, in their unit: 24 bits reach 4,194 to both sides."""
FINEST_LEVEL = 20
SECTION_POINTS = 600
MOST_POINTS = 500
MOST_CELLS = 16_000_000
"""Of the box around a polygon."""
STRIP_CELLS = 1 << 18
"""Of a map's box around a polygon that are read at once."""
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
        sizes = np.abs(_overview(dz, 1))
        largest = float(sizes.max(initial=0.0))
        limit = colour_limit(sizes, numbers["level_of_detection_m"].get("median") or 0.0) or 1.0
        layers = (
            Layer("change", "Change", dz, 1, "change", -limit, limit, largest),
            Layer("error", "Error of change", dz, 2, "error", *_usual(dz, 2)),
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
            found.append(Layer(kind, title, path, 1, "picture", *_black_white(path)))
    if heights is not None and sigma is not None:
        sigma = replace(sigma, metres=heights.metres)  # whatever unit of heights its file states
    if heights is not None:
        found.append(Layer("height", "Height", heights, 1, "height", *_usual(heights, 1)))
    if sigma is not None:
        found.append(Layer("error", "Error of height", sigma, 1, "error", *_usual(sigma, 1)))
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


def _with_common_ends(sheets: list[Sheet]) -> list[Sheet]:
    """The sheets, with the same colours for all heights, and for all errors: the page has one legend for two dates."""
    layers = [layer for sheet in sheets for layer in sheet.layers]
    ends: dict[str, dict[str, float]] = {}
    for kind in {layer.kind for layer in layers} & {"height", "error"}:
        low, high = _common([(layer.low, layer.high) for layer in layers if layer.kind == kind])
        ends[kind] = {"low": low, "high": high}
    return [
        replace(sheet, layers=tuple(replace(layer, **ends.get(layer.kind, {})) for layer in sheet.layers))
        for sheet in sheets
    ]


def _with_own_titles(sheets: list[Sheet]) -> list[Sheet]:
    """The sheets, with their folders' folders in the titles where these would be alike."""
    titles = [sheet.title for sheet in sheets]
    return [
        replace(sheet, title=f"{sheet.folder.resolve().parent.name}/{sheet.title}")
        if titles.count(sheet.title) > 1
        else sheet
        for sheet in sheets
    ]


class Atlas:
    """Sheets in one coordinate system.

    Args:
        folders: of maps and changes.

    Raises:
        RunError: a folder is none, or lies nowhere near the first one.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        self.folders = tuple(folders)
        # Those without a date last: the first one's system is everybody's.
        sheets = sorted(map(open_sheet, folders), key=lambda sheet: (sheet.date is None, sheet.date or ""))
        self.sheets = _with_common_ends(_with_own_titles(sheets))
        self._state = _state(self.sheets)
        self._systems = [_placed(sheet)[1] for sheet in self.sheets]
        stated = ((sheet, crs) for sheet, crs in zip(self.sheets, self._systems, strict=True) if crs is not None)
        self.crs = next((_of_the_ground(sheet, crs) for sheet, crs in stated), None)
        self._require_one_frame()
        boxes, cells = [], []
        for sheet in self.sheets:
            for layer in sheet.layers:
                with self._reader(layer.source) as file:
                    boxes.append(file.bounds)
                    cells.append(min(abs(file.transform.a), abs(file.transform.e)))
        box = np.array(boxes)
        self.bounds = tuple(map(float, (*box[:, :2].min(0), *box[:, 2:].max(0))))
        self.cell = float(min(cells))
        self.side = float(max(self.bounds[2] - self.bounds[0], self.bounds[3] - self.bounds[1]))
        if self.side / self.cell > TILE_PX << FINEST_LEVEL:
            raise RunError(f"the folders lie {self.side:,.0f} apart: expected maps of one place; name others, or fewer")
        self.finest = min(FINEST_LEVEL, max(0, math.ceil(math.log2(self.side / self.cell / TILE_PX))) + 1)
        self.metre, self.unit, self.name = self._units()

    @property
    def is_outdated(self) -> bool:
        """Whether a file that is shown was made again, or is gone."""
        return _state(self.sheets) != self._state

    def describe(self) -> dict[str, Any]:
        """What the page needs to know, without the name of any folder's place."""
        return {
            "crs": self.name,
            "unit": self.unit,
            "metre": self.metre,
            **dict(zip(("length", "area", "volume"), self._measures(), strict=True)),
            "bounds": self.bounds,
            "side": self.side,
            "finest": self.finest,
            "tile": TILE_PX,
            "step": STEP,
            "band": Z95,
            "sheets": [
                {
                    "title": sheet.title,
                    "label": self._label(sheet),
                    "kind": sheet.kind,
                    "detection": sheet.detection_m,
                    "layers": [
                        {name: getattr(one, name) for name in ("name", "title", "kind", "low", "high", "largest")}
                        for one in sheet.layers
                    ],
                }
                for sheet in self.sheets
            ],
        }

    def tile(self, sheet: int, layer: str, level: int, column: int, row: int) -> bytes | None:
        """Return a tile as PNG; None where there is no such tile, or nothing in it."""
        chosen = self._layer(sheet, layer)
        if chosen is None or not 0 <= level <= self.finest or not (0 <= column < 1 << level and 0 <= row < 1 << level):
            return None
        side = self.side / (1 << level)
        west, north = self.bounds[0] + column * side, self.bounds[3] - row * side
        with self._reader(chosen.source) as file:
            bands = _picture_bands(file) if chosen.kind == "picture" else [chosen.band]
            values, seen = _read(file, bands, west, north, side / TILE_PX)
        if not seen.any():
            return None
        picture = np.zeros((TILE_PX, TILE_PX, 4), np.uint8)
        if chosen.kind == "picture":
            shade = (values - np.float32(chosen.low)) * np.float32(255 / (chosen.high - chosen.low))
            picture[..., :3] = np.rint(shade).clip(0, 255).transpose(1, 2, 0)
        else:
            code = np.where(seen, np.rint(np.where(seen, values[0], 0) / STEP) + (1 << 23), 0)
            code = code.clip(0, (1 << 24) - 1).astype(np.uint32)
            for k in range(3):
                picture[..., k] = (code >> (16 - 8 * k)) & 255
        picture[..., 3] = 255 * seen
        content = io.BytesIO()
        Image.fromarray(picture).save(content, "PNG", compress_level=1)
        return content.getvalue()

    def at(self, x: float, y: float) -> list[dict[str, float | None]]:
        """Return the values of every sheet's cell at a place: heights or change, with their standard errors."""
        return [{k: _plain(float(v[0])) for k, v in one.items()} for one in self._along(np.array([[x, y]]))]

    def section(self, points: Float64[np.ndarray, "N 2"]) -> dict[str, Any]:
        """Return values along a line through points, and the distance from its beginning in metres."""
        lengths = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
        if lengths[-1] == 0:
            raise RunError("the section has no length: expected two places apart; draw it again")
        along = np.linspace(0, lengths[-1], SECTION_POINTS)
        place = np.stack([np.interp(along, lengths, points[:, k]) for k in range(2)], axis=1)
        sheets = [{k: [_plain(v) for v in values.tolist()] for k, values in one.items()} for one in self._along(place)]
        return {"distance": (self.metre * along).tolist(), "sheets": sheets}

    def area(self, points: Float64[np.ndarray, "N 2"], detection_m: float = 0.0) -> dict[str, Any]:
        """Return the area of a polygon, and in it the volumes of every sheet in cubic metres.

        Of a change: net of all cells, with its 95% interval from the random, correlated and systematic errors that
        `tidefield change` measured; cut and fill of the cells beyond a level of detection, without: these are chosen by
        their own errors. Of a map: above and below the plane through the surface along the polygon's edge, where
        intervals take the errors of all cells to be alike, which makes them wide. "share" is that of the polygon where
        there are values.
        """
        import shapely

        polygon = shapely.Polygon(points)
        if not polygon.is_valid or polygon.area == 0:
            raise RunError("the polygon crosses itself, or has no area: expected one that does not; draw it again")
        results: list[dict[str, Any]] = []
        for sheet in self.sheets:
            source = sheet.layers[0].source if sheet.kind == "change" else sheet.heights
            if source is None:
                results.append({})
                continue
            with self._reader(source) as file:
                box, inside = _cells_in(file, polygon)
                cell_area = abs(file.transform.a * file.transform.e) * self.metre**2
                on = polygon.intersection(shapely.box(*file.bounds)).area / polygon.area
                cells = np.count_nonzero(inside)
                if sheet.kind == "change":
                    cell = abs(file.transform.a) * self.metre
                    volumes = _change_volumes(file, box, inside, cell, cell_area, sheet.numbers, detection_m)
                else:
                    volumes = self._map_volumes(sheet.sigma, file, polygon, box, inside, cell_area)
            results.append(volumes and volumes | {"share": on * volumes["cells_m2"] / (cells * cell_area)})
        return {"area_m2": polygon.area * self.metre**2, "length_m": polygon.length * self.metre, "sheets": results}

    def _map_volumes(
        self,
        sigma: Surface | None,
        file: Any,
        polygon: Any,
        box: Any,
        inside: Bool[np.ndarray, "h w"],
        cell_area: float,
    ) -> dict[str, Any]:
        """Volumes above and below the plane through a polygon's rim; none where the rim or the cells have no values."""
        rim = np.array([polygon.exterior.interpolate(s, normalized=True).coords[0] for s in np.linspace(0, 1, 200)])
        z = _sample(file, rim, 1)
        known = np.isfinite(z)
        if known.sum() < 3:
            return {}
        centre = rim.mean(0)
        design = np.column_stack([np.ones(known.sum()), rim[known] - centre])
        plane = np.linalg.lstsq(design, z[known], rcond=None)[0]
        cells, sums = 0, {"above": np.zeros(4), "below": np.zeros(4)}
        with self._reader(sigma) if sigma is not None else nullcontext() as errors:
            for window, within in _strips(box, inside):
                heights, corner = _band(file, 1, window), _corner_at(file.transform, window)
                rows, columns = np.nonzero(within & np.isfinite(heights))
                cells += len(rows)
                place = np.stack([corner.c + (columns + 0.5) * corner.a, corner.f + (rows + 0.5) * corner.e], axis=1)
                above = heights[rows, columns] - plane[0] - (place - centre) @ plane[1:]
                error = np.full(len(place), np.nan) if errors is None else _sample(errors, place, 1)
                for name, chosen in (("above", above > 0), ("below", above < 0)):
                    own = error[chosen & np.isfinite(error)]
                    sums[name] += np.array([np.abs(above[chosen]).sum(), chosen.sum(), own.sum(), len(own)])
        result: dict[str, Any] = {"cells_m2": cells * cell_area}
        for name, (height, count, error, with_error) in sums.items():
            value = float(height) * cell_area
            result[name] = {"value_m3": value}
            if with_error or (sigma is not None and not count):
                half = Z95 * float(error / max(with_error, 1) * count) * cell_area
                result[name] |= {"low_m3": value - half, "high_m3": value + half}
        return result if cells else {}

    def _along(self, place: Float64[np.ndarray, "N 2"]) -> list[dict[str, Float64[np.ndarray, " N"]]]:
        """The values of every sheet at places."""
        found = []
        for sheet in self.sheets:
            values: dict[str, Any] = {}
            if sheet.kind == "change":
                with self._reader(sheet.layers[0].source) as file:
                    for k, name in enumerate(("change", "change_sigma", "p"), start=1):
                        values[name] = _sample(file, place, k)
            for name, surface in (("height", sheet.heights), ("sigma", sheet.sigma)):
                if surface is not None:
                    with self._reader(surface) as file:
                        values[name] = _sample(file, place, 1)
            found.append(values)
        return found

    def _require_one_frame(self) -> None:
        """Raises: RunError when some sheets lie on the Earth, and others in the frame of a scene without a place."""
        from pyproj import CRS

        stated = ((sheet, crs) for sheet, crs in zip(self.sheets, self._systems, strict=True) if crs is not None)
        systems = [(sheet, CRS.from_wkt(crs.to_wkt())) for sheet, crs in stated]
        local = [(sheet, crs) for sheet, crs in systems if is_local(crs)]
        placed = [(sheet, crs) for sheet, crs in systems if not is_local(crs)]
        if local and placed:
            raise RunError(
                f"{local[0][0].folder} lies in a local frame, {placed[0][0].folder} in {placed[0][1].name}: expected "
                "maps in one frame; show them apart, or give the scene of the first a georeference and map it again"
            )
        for sheet, crs in local:
            first, frame = local[0]
            if crs.name != frame.name or crs != frame:
                raise RunError(
                    f"{first.folder} and {sheet.folder} lie in different local frames: expected maps in one; show "
                    "them apart"
                )

    def _label(self, sheet: Sheet) -> str:
        """A sheet's date where no other sheet of its kind has it, otherwise with its title."""
        alike = sum((other.kind, other.date) == (sheet.kind, sheet.date) for other in self.sheets)
        if sheet.date is None or (alike > 1 and sheet.date in sheet.title):
            return sheet.title
        return sheet.date if alike == 1 else f"{sheet.date} {sheet.title}"

    def _layer(self, sheet: int, name: str) -> Layer | None:
        if not 0 <= sheet < len(self.sheets):
            return None
        return next((layer for layer in self.sheets[sheet].layers if layer.name == name), None)

    @contextmanager
    def _reader(self, source: Path | Surface) -> Iterator[Any]:
        """A raster in the atlas' system; opened for each use, since a data set belongs to one thread."""
        from rasterio.vrt import WarpedVRT

        with _opened(source) as file:
            own = file.transform
            other = file.crs is not None and self.crs is not None and not _same(file.crs.to_wkt(), self.crs.to_wkt())
            if own.b == own.d == 0 and own.e < 0 and not other:
                yield file
                return
            # Without a system GDAL needs one all the same.
            source_crs, crs = (file.crs, self.crs) if other else (file.crs or PLAIN, file.crs or PLAIN)
            with WarpedVRT(file, src_crs=source_crs, crs=crs, **_around(file, isinstance(source, Surface))) as warped:
                yield warped

    def _units(self) -> tuple[float, str, str]:
        """Metres in a unit of the plan, that unit, and the system's name."""
        from pyproj import CRS

        with_systems = zip(self.sheets, self._systems, strict=True)
        bare = [sheet for sheet, crs in with_systems if sheet.kind == "change" and crs is None]
        if self.crs is None:
            if any(sheet.numbers["later"].get("crs") == LOCAL_NAME for sheet in bare):
                return 1.0, "units", LOCAL_NAME
            # `tidefield change` took lengths of surfaces without a system as metres.
            return 1.0, "m", "no coordinate system"
        crs = CRS.from_wkt(self.crs.to_wkt())
        if crs.name == LOCAL_NAME:  # its axes say metre: GeoTIFFs keep no unknown unit
            return 1.0, "units", crs.name
        plan = crs.axis_info[0]
        if bare and plan.unit_conversion_factor != 1:
            raise RunError(
                f"{bare[0].folder} is between surfaces without a coordinate system, whose lengths were taken as "
                f"metres, and the maps ({crs.name}) count in {plan.unit_name}: expected one unit; show it alone, or "
                "assign the surfaces their system (gdal_edit.py -a_srs) and measure it again"
            )
        unit = "m" if plan.unit_name in ("metre", "meter") else plan.unit_name
        return plan.unit_conversion_factor, unit, crs.name

    def _measures(self) -> tuple[str, str, str]:
        """What lengths, areas and volumes are in: metres in every system that knows how long they are."""
        return ("units", "square units", "cubic units") if self.unit == "units" else ("m", "m²", "m³")


def _of_the_ground(sheet: Sheet, crs: Any) -> Any:
    """A sheet's system; a UTM zone where that is in degrees, or in metres that are shorter on the ground."""
    from pyproj import CRS

    own = CRS.from_wkt(crs.to_wkt())
    if is_local(own) or not (own.is_geographic or (own.is_projected and in_metres(own))):
        return crs
    with _opened(_placed(sheet)[0]) as file:
        corner, column, row = file.transform, file.width / 2, file.height / 2
    x = corner.c + corner.a * column + corner.b * row
    y = corner.f + corner.d * column + corner.e * row
    metric = system_of_ground(own, (x, y), sheet.folder, "gdal_edit.py -a_srs")
    return crs if same_system(metric, own) else type(crs).from_wkt(metric.to_wkt())


def _placed(sheet: Sheet) -> tuple[Path | Surface, Any]:
    """The first raster of a sheet that states a coordinate system, and that; the first of all where none does."""
    for layer in sheet.layers:
        with _opened(layer.source) as file:
            if file.crs is not None:
                return layer.source, file.crs
    return sheet.layers[0].source, None


def _state(sheets: Sequence[Sheet]) -> list[tuple[int, int] | None]:
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


@cache
def _same(one: str, other: str) -> bool:
    """Whether two systems, as WKT, differ in nothing but their heights."""
    from pyproj import CRS

    return one == other or same_system(CRS.from_wkt(one), CRS.from_wkt(other))


def _around(file: Any, heights: bool) -> dict[str, Any]:
    """Options of a warp that leave what is around a turned raster empty, which is 0 otherwise, a height or black."""
    from rasterio.enums import MaskFlags

    if any(MaskFlags.alpha in flags for flags in file.mask_flag_enums):
        return {}
    if heights or file.dtypes[0].startswith("float"):
        return {"nodata": math.nan, "dtype": "float32"}
    return {"add_alpha": True} if file.nodata is None else {}


def _require_place(path: Path) -> None:
    """Raises: RunError when a picture has no corners on a map."""
    with opened(path) as file:
        if file.transform.is_identity:
            raise RunError(
                f"{path} has no place on a map: expected a georeferenced GeoTIFF; state its corners (gdal_edit.py "
                "-a_ullr)"
            )


def _opened(source: Path | Surface) -> AbstractContextManager[Any]:
    return source.in_metres() if isinstance(source, Surface) else opened(source)


def _overview(source: Path | Surface, band: int) -> Float64[np.ndarray, " N"]:
    """The values of a raster, from a small picture of it."""
    with _opened(source) as file:
        step = max(1.0, max(file.shape) / 512)
        shape = tuple(max(1, round(side / step)) for side in file.shape)
        values = file.read(band, out_shape=shape, masked=True).astype(np.float64).filled(np.nan)
    return values[np.isfinite(values)]


def _usual(source: Path | Surface, band: int) -> tuple[float, float]:
    """The 2nd and 98th percentile of a raster's values, from a small picture of it; NaN where it has none."""
    known = _overview(source, band)
    if not len(known):
        return math.nan, math.nan
    low, high = np.percentile(known, [2, 98]).tolist()
    return low, max(high, low + 1e-3)


def _picture_bands(file: Any) -> list[int]:
    """The bands of a picture: red, green and blue, or grey."""
    return [1, 2, 3] if sum(kind.name != "alpha" for kind in file.colorinterp) >= 3 else [1]


def _black_white(path: Path) -> tuple[float, float]:
    """The values of a picture that are shown black and white: of bytes the ends, otherwise the ends of most values.

    Cameras fill a part of 16 bits, and reflectance lies in [0, 1]. All bands have the same ends, to keep colours.
    """
    with _opened(path) as file:
        bands = _picture_bands(file)
        if file.dtypes[0] == "uint8":
            return 0.0, 255.0
    return _common([_usual(path, band) for band in bands])


def _common(ends: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The lowest and the highest of the ends of several rasters, of which some may have no values."""
    low, high = zip(*([own for own in ends if math.isfinite(own[0])] or [(0.0, 1.0)]), strict=True)
    return min(low), max(high)


def _read(
    file: Any, bands: list[int], west: float, north: float, resolution: float
) -> tuple[np.ndarray, Bool[np.ndarray, "P P"]]:
    """Bands of a tile, and where they are known."""
    from rasterio.windows import Window

    values = np.zeros((len(bands), TILE_PX, TILE_PX), np.float32)
    seen = np.zeros((TILE_PX, TILE_PX), bool)
    box = file.bounds
    left, right = ((edge - west) / resolution for edge in (box.left, box.right))
    top, bottom = ((north - edge) / resolution for edge in (box.top, box.bottom))
    c0, c1 = max(0, math.floor(left)), min(TILE_PX, math.ceil(right))
    r0, r1 = max(0, math.floor(top)), min(TILE_PX, math.ceil(bottom))
    if c0 >= c1 or r0 >= r1:
        return values, seen
    across, down = resolution / abs(file.transform.a), resolution / abs(file.transform.e)
    if across <= 1:  # several pixels show one cell
        columns = np.floor((np.arange(c0, c1) + 0.5 - left) * across).astype(int)
        rows = np.floor((np.arange(r0, r1) + 0.5 - top) * down).astype(int)
        columns, rows = (np.clip(x, 0, n - 1) for x, n in ((columns, file.width), (rows, file.height)))
        window = Window(columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1)  # type: ignore[call-arg]
        part, known = _known(file, bands, window, None)
        nearest = np.ix_(rows - rows[0], columns - columns[0])
        values[:, r0:r1, c0:c1] = np.where(known, part, 0)[:, nearest[0], nearest[1]]
        seen[r0:r1, c0:c1] = known[nearest]
        return values, seen
    col, row = max(0.0, (c0 - left) * across), max(0.0, (r0 - top) * down)
    width, height = min(file.width - col, (c1 - c0) * across), min(file.height - row, (r1 - r0) * down)
    window = Window(col, row, width, height)  # type: ignore[call-arg]
    part, known = _known(file, bands, window, (r1 - r0, c1 - c0))
    values[:, r0:r1, c0:c1] = np.where(known, part, 0)
    seen[r0:r1, c0:c1] = known
    return values, seen


def _known(
    file: Any, bands: list[int], window: Any, shape: tuple[int, int] | None
) -> tuple[np.ndarray, Bool[np.ndarray, "h w"]]:
    """Bands of a window, averaged to a shape, and where they are known."""
    from rasterio.enums import Resampling

    out = None if shape is None else (len(bands), *shape)
    part = file.read(bands, window=window, out_shape=out, resampling=Resampling.average, masked=True)
    known = file.dataset_mask(window=window, out_shape=shape or part.shape[1:]) > 0
    known &= ~np.ma.getmaskarray(part).any(axis=0)
    if part.dtype.kind == "f":
        known &= np.isfinite(part.data).all(axis=0)
    return part.data, known


def _sample(file: Any, place: Float64[np.ndarray, "N 2"], band: int) -> Float64[np.ndarray, " N"]:
    """A raster's cells at places; NaN outside and where nothing is known."""
    rows, columns = np.floor(_cells(file, place)).astype(np.int64)[:, ::-1].T
    inside = (rows >= 0) & (rows < file.height) & (columns >= 0) & (columns < file.width)
    found = np.full(len(place), np.nan)
    if inside.any():
        r, c = rows[inside], columns[inside]
        from rasterio.windows import Window

        box = Window(c.min(), r.min(), c.max() - c.min() + 1, r.max() - r.min() + 1)  # type: ignore[call-arg]
        if box.width * box.height <= MOST_CELLS:
            found[inside] = _band(file, band, box)[r - r.min(), c - c.min()]
        else:
            found[inside] = [float(_band(file, band, Window(x, y, 1, 1))[0, 0]) for y, x in zip(r, c, strict=True)]  # type: ignore[call-arg]
    return found


def _cells(file: Any, place: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
    """Columns and rows of places, counted from the raster's corner."""
    inverse = ~file.transform
    matrix = np.array([[inverse.a, inverse.b], [inverse.d, inverse.e]])
    return place @ matrix.T + (inverse.c, inverse.f)


def _corner_at(transform: Any, window: Any) -> Any:
    """The transform of a window."""
    a, b, c, d, e, f = transform[:6]
    x, y = window.col_off, window.row_off
    return type(transform)(a, b, c + a * x + b * y, d, e, f + d * x + e * y)


def _band(file: Any, band: int, window: Any, kind: type = np.float64) -> Float[np.ndarray, "h w"]:
    return file.read(band, window=window, masked=True).astype(kind, copy=False).filled(np.nan)


def _cells_in(file: Any, polygon: Any) -> tuple[Any, Bool[np.ndarray, "h w"]]:
    """The window of a raster around a polygon, and which of its cells have their centres inside."""
    from rasterio.features import geometry_mask
    from rasterio.windows import Window

    west, south, east, north = polygon.bounds
    (c0, r0), (c1, r1) = _cells(file, np.array([[west, north], [east, south]]))
    columns = (max(0, math.floor(c0)), min(file.width, math.ceil(c1)))
    rows = (max(0, math.floor(r0)), min(file.height, math.ceil(r1)))
    width, height = max(0, columns[1] - columns[0]), max(0, rows[1] - rows[0])
    if width * height > MOST_CELLS:
        raise RunError(f"the polygon covers {width} x {height} cells: expected {MOST_CELLS:,} or fewer; draw a smaller")
    window = Window(columns[0], rows[0], width, height)  # type: ignore[call-arg]
    if not width or not height:
        return window, np.zeros((0, 0), bool)
    transform = _corner_at(file.transform, window)
    return window, geometry_mask([polygon], (height, width), transform, invert=True)


def _strips(box: Any, inside: Bool[np.ndarray, "h w"]) -> Iterator[tuple[Any, Bool[np.ndarray, "rows w"]]]:
    """The rows of a window, a few at a time, and which of their cells are inside."""
    from rasterio.windows import Window

    step = max(1, STRIP_CELLS // max(1, inside.shape[1]))
    for first in range(0, len(inside), step):
        within = inside[first : first + step]
        yield Window(box.col_off, box.row_off + first, box.width, len(within)), within  # type: ignore[call-arg]


def _change_volumes(
    file: Any,
    box: Any,
    inside: Bool[np.ndarray, "h w"],
    cell_m: float,
    cell_area: float,
    numbers: dict[str, Any],
    detection_m: float,
) -> dict[str, Any]:
    """Volumes in a polygon, net with its interval; none where no cell has a value.

    The systematic error is taken to have one sign in all cells, so that on a hill, where that of a shift cancels out,
    intervals are wider than those of the report.

    Args:
        file: change, its sigma, p, and the systematic part of sigma, which files of earlier versions lack.
        box, inside: the window around the polygon, and which of its cells lie in it.
    """
    if not inside.any():
        return {}
    dz = _band(file, 1, box, np.float32)
    inside = inside & np.isfinite(dz)
    cells = np.count_nonzero(inside)
    if not cells:
        return {}

    def total(values: Float[np.ndarray, "h w"], region: Bool[np.ndarray, "h w"]) -> float:
        return float(values.sum(where=region, dtype=np.float64))

    registration, variogram = numbers["registration"], numbers["variogram"]
    own = float(registration.get("systematic_m", 0.0))
    sigma = np.nan_to_num(_band(file, 2, box, np.float32), copy=False)
    if file.count >= 4:
        shared = np.nan_to_num(_band(file, 4, box, np.float32), copy=False)
        sigma = np.sqrt(np.maximum(sigma**2 - shared**2, 0))
    else:
        shared = np.full_like(sigma, own)
    stated = float(registration.get("datum_error_m", 0.0)) * cells
    # Beyond a tilt, whose error is another in each cell, the part of the shift is not found.
    if registration.get("shift_error_stated") and registration.get("model") != "tilt":
        stated = math.hypot(stated, total(np.sqrt(np.maximum(shared**2 - own**2, 0)), inside))
    freedom = float((numbers["volumes"].get("net") or {}).get("degrees_of_freedom") or math.inf)
    area = cells * cell_area
    result: dict[str, Any] = {"cells_m2": area}
    correlation = Variogram(tuple(variogram["sill_shares"]), tuple(variogram["ranges_m"]))
    error = region_error(sigma, inside, correlation, cell_m)
    net = Volume(
        total(dz, inside) * cell_area,
        error.random * cell_area,
        error.correlated * cell_area,
        total(shared, inside) * cell_area,
        area,
        degrees_of_freedom=freedom,
        datum_m3=stated * cell_area,
    )
    low, high = net.interval_m3
    result["net"] = {"value_m3": net.value_m3, "low_m3": low, "high_m3": high}
    for name, region in (("cut", inside & (dz < -detection_m)), ("fill", inside & (dz > detection_m))):
        result[name] = {"value_m3": abs(total(dz, region)) * cell_area}
    return result


def _plain(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None
