"""Maps and changes to look at from straight above: layers, tiles, values, sections and volumes, in one system.

All is shown in the first coordinate system that a folder states, or a UTM zone where lengths in that are not those of
the ground, and heights in metres. Tiles are squares of `TILE_PX` pixels; those of level z have 2^-z of the side of the
whole area, and are counted from its north-western corner.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64
from PIL import Image

from tidefield.change.errors import region_error
from tidefield.change.statistics import Z95
from tidefield.change.surfaces import PLAIN, Surface
from tidefield.change.variogram import Variogram
from tidefield.change.volumes import Volume
from tidefield.errors import RunError
from tidefield.geometry.geodesy import is_local
from tidefield.maps.grid import LOCAL_NAME
from tidefield.viewer.rasters import (
    TILE_PX,
    cells_in,
    corner_at,
    empty_around,
    opened_source,
    picture_bands,
    read_band,
    read_tile,
    same_plan,
    sample,
    strips,
)
from tidefield.viewer.sheets import (
    Layer,
    Sheet,
    open_sheet,
    placed,
    state_of,
    system_of,
    with_common_ends,
    with_own_titles,
)

STEP = 0.0005
"""Of values in tiles, in their unit: 24 bits reach 4,194 to both sides."""
FINEST_LEVEL = 20
SECTION_POINTS = 600
MOST_POINTS = 500


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
        self.sheets = with_common_ends(with_own_titles(sheets))
        self._state = state_of(self.sheets)
        self._systems = [placed(sheet)[1] for sheet in self.sheets]
        stated = ((sheet, crs) for sheet, crs in zip(self.sheets, self._systems, strict=True) if crs is not None)
        self.crs = next((system_of(sheet, crs) for sheet, crs in stated), None)
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
        return state_of(self.sheets) != self._state

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
            bands = picture_bands(file) if chosen.kind == "picture" else [chosen.band]
            values, seen = read_tile(file, bands, west, north, side / TILE_PX)
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
                box, inside = cells_in(file, polygon)
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
        z = sample(file, rim, 1)
        known = np.isfinite(z)
        if known.sum() < 3:
            return {}
        centre = rim.mean(0)
        design = np.column_stack([np.ones(known.sum()), rim[known] - centre])
        plane = np.linalg.lstsq(design, z[known], rcond=None)[0]
        cells, sums = 0, {"above": np.zeros(4), "below": np.zeros(4)}
        with self._reader(sigma) if sigma is not None else nullcontext() as errors:
            for window, within in strips(box, inside):
                heights, corner = read_band(file, 1, window), corner_at(file.transform, window)
                rows, columns = np.nonzero(within & np.isfinite(heights))
                cells += len(rows)
                place = np.stack([corner.c + (columns + 0.5) * corner.a, corner.f + (rows + 0.5) * corner.e], axis=1)
                above = heights[rows, columns] - plane[0] - (place - centre) @ plane[1:]
                error = np.full(len(place), np.nan) if errors is None else sample(errors, place, 1)
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
                        values[name] = sample(file, place, k)
            for name, surface in (("height", sheet.heights), ("sigma", sheet.sigma)):
                if surface is not None:
                    with self._reader(surface) as file:
                        values[name] = sample(file, place, 1)
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

        with opened_source(source) as file:
            own = file.transform
            other = (
                file.crs is not None and self.crs is not None and not same_plan(file.crs.to_wkt(), self.crs.to_wkt())
            )
            if own.b == own.d == 0 and own.e < 0 and not other:
                yield file
                return
            # Without a system GDAL needs one all the same.
            source_crs, crs = (file.crs, self.crs) if other else (file.crs or PLAIN, file.crs or PLAIN)
            with WarpedVRT(
                file, src_crs=source_crs, crs=crs, **empty_around(file, isinstance(source, Surface))
            ) as warped:
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
    dz = read_band(file, 1, box, np.float32)
    inside = inside & np.isfinite(dz)
    cells = np.count_nonzero(inside)
    if not cells:
        return {}

    def total(values: Float[np.ndarray, "h w"], region: Bool[np.ndarray, "h w"]) -> float:
        return float(values.sum(where=region, dtype=np.float64))

    registration, variogram = numbers["registration"], numbers["variogram"]
    own = float(registration.get("systematic_m", 0.0))
    sigma = np.nan_to_num(read_band(file, 2, box, np.float32), copy=False)
    if file.count >= 4:
        shared = np.nan_to_num(read_band(file, 4, box, np.float32), copy=False)
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
