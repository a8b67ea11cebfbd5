"""Read surfaces: GeoTIFFs with whatever grid, extent, nodata and coordinate system they have, on one common grid."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, Float64
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from tidefield.change.nodata import IMPOSSIBLE_M, STRIP_CELLS, cleared, is_masked, undeclared
from tidefield.errors import TidefieldError, need
from tidefield.files import reading_from
from tidefield.geometry.geodesy import (
    FOOT_M,
    US_SURVEY_FOOT_M,
    has_unstated_unit,
    horizontal,
    is_local,
    metres_per_height,
    metric_system,
    same_system,
    vertical_datum_of,
)

if TYPE_CHECKING:
    from affine import Affine

MOST_CELLS = 400_000_000
"""Of a common grid: what fits into 16 GB."""
PLAIN = 'LOCAL_CS["metres",UNIT["metre",1]]'
"""A system for files that need one, where surfaces have none."""
_ELLIPSOID = "the ellipsoid"
"""How vertical datums of ellipsoidal heights are named."""
_RESULTS = ("dz:", "hillshade", "photograph", "mean correlation", "significant", "plants:", "class")
"""How this program describes what is no height, nor an error of heights, in its rasters."""
_REFERRING = ("EEDAI", "GTI", "PLMOSAIC", "STACIT", "STACTA", "VRT", "WCS", "WMS", "WMTS")
"""GDAL's formats whose files refer to others, or to addresses; they are read only if their names say so."""
_UNITS_M = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), FOOT_M),
    **dict.fromkeys(("us survey foot", "us survey feet", "us-ft", "ftus"), US_SURVEY_FOOT_M),
    **dict.fromkeys(("cm", "centimetre", "centimeter"), 0.01),
    **dict.fromkeys(("mm", "millimetre", "millimeter"), 0.001),
    "units": 1.0,  # of a map without a georeference
}
"""Lengths of the units that bands state."""
Read = Callable[[int, int], Float32[np.ndarray, "rows columns"]]


class ChangeError(TidefieldError):
    """Surveys cannot be compared, or not as asked."""


@dataclass(frozen=True)
class Grid:
    """Square cells of a map, row 0 in the north.

    Attributes:
        crs: as WKT; None where surfaces have none and lengths are taken as metres.
        west_m, north_m: the outer corner of the first cell.
    """

    crs: str | None
    west_m: float
    north_m: float
    cell_m: float
    columns: int
    rows: int

    @property
    def transform(self) -> Affine:
        from affine import Affine

        return Affine(self.cell_m, 0, self.west_m, 0, -self.cell_m, self.north_m)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north."""
        east, south = self.west_m + self.columns * self.cell_m, self.north_m - self.rows * self.cell_m
        return self.west_m, south, east, self.north_m

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    @property
    def cell_area_m2(self) -> float:
        return self.cell_m**2

    def thinned(self, step: int) -> Grid:
        """The grid of every `step`-th cell of it, whose middles stay where they are."""
        offset = (0.5 - 0.5 * step) * self.cell_m
        columns, rows = -(-self.columns // step), -(-self.rows // step)
        return Grid(self.crs, self.west_m + offset, self.north_m - offset, self.cell_m * step, columns, rows)

    def box_of(self, bounds: tuple[float, float, float, float]) -> tuple[slice, slice]:
        """Rows and columns around bounds (west, south, east, north), as far as they are on the grid; one at least."""

        def cells(low: float, high: float, count: int) -> slice:
            first = min(max(0, math.floor(low / self.cell_m) - 1), count - 1)
            return slice(first, max(first + 1, min(count, math.floor(high / self.cell_m) + 2)))

        west, south, east, north = bounds
        return (
            cells(self.north_m - north, self.north_m - south, self.rows),
            cells(west - self.west_m, east - self.west_m, self.columns),
        )

    def part(self, box: tuple[slice, slice]) -> Grid:
        """The grid of some rows and columns."""
        rows, columns = box
        west, north = self.west_m + columns.start * self.cell_m, self.north_m - rows.start * self.cell_m
        return Grid(self.crs, west, north, self.cell_m, columns.stop - columns.start, rows.stop - rows.start)

    def strips(self) -> Iterator[slice]:
        """The rows, a few megabytes at a time."""
        step = max(1, STRIP_CELLS // self.columns)
        return (slice(first, min(first + step, self.rows)) for first in range(0, self.rows, step))


@dataclass(frozen=True)
class Surface:
    """A raster of heights on disk.

    Attributes:
        crs: None where the file states none.
        transform: from column and row to the file's own coordinates; whole numbers are corners of pixels.
        nodata: value of pixels without a height, as declared; None if there is none.
        unknown: further values that stand for no height, whatever the file declares.
        metres: length of one unit of the heights.
        scale, offset: heights are the file's values times scale plus offset.
        sigma: raster of their standard errors, if there is one.
        filled: raster that is 1 where heights were filled in, which are no measurements.
        classes: raster of what the cells show, as LAS numbers it.
        orthophoto, cloud: of the same survey, if there are any.
        source: name of the cloud that the surface was made of, or of the folder.
        date: YYYY-MM-DD of the photographs, if the file or its name tells.
        datum: vertical one of the heights in words, where the file (of `tidefield map`) or the cloud states it.
        remarks: what a user should know of how it was read.
    """

    path: Path
    crs: CRS | None
    transform: Affine
    columns: int
    rows: int
    nodata: float | None
    metres: float = 1.0
    scale: float = 1.0
    offset: float = 0.0
    sigma: Path | None = None
    filled: Path | None = None
    classes: Path | None = None
    orthophoto: Path | None = None
    cloud: Path | None = None
    source: str | None = None
    date: str | None = None
    datum: str | None = None
    remarks: list[str] = field(default_factory=list)
    unknown: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        """Date, or the file's name."""
        return self.date or self.source or self.path.stem

    @property
    def file(self) -> str:
        """What the user named: the folder, the cloud, or the raster."""
        return self.source or self.path.name

    @property
    def vertical_datum(self) -> str | None:
        """Of the heights, by the coordinate system; None where that defines none."""
        return None if self.crs is None else vertical_datum_of(self.crs)

    @contextmanager
    def on_grid(self, grid: Grid, shift_m: tuple[float, float] = (0.0, 0.0)) -> Iterator[Read]:
        """Read strips of rows of a grid, bilinearly between the centres of the file's pixels.

        Args:
            shift_m: the surface is moved by this to the east and north first.

        Yields:
            a function of first and last row that returns heights in metres, NaN where there are none.
        """
        with warped(self.path, self.crs, grid, shift_m, nodata=self.nodata, unknown=self.unknown) as read:

            def heights(first: int, last: int) -> Float32[np.ndarray, "rows columns"]:
                values = read(first, last)[0]
                if (self.scale, self.offset, self.metres) != (1, 0, 1):
                    values = (values * np.float32(self.scale) + np.float32(self.offset)) * np.float32(self.metres)
                values[np.abs(values) > IMPOSSIBLE_M] = np.nan
                return values

            yield heights

    @contextmanager
    def in_metres(self) -> Iterator[Any]:
        """The heights in metres on the file's own grid, as rasterio's data set; masked or NaN where there are none."""
        scale, offset = self.metres * self.scale, self.metres * self.offset
        with opened(self.path) as dataset, cleared(dataset, self.unknown, scale, offset) as heights:
            yield heights


@contextmanager
def warped(
    path: Path,
    crs: CRS | None,
    grid: Grid,
    shift_m: tuple[float, float] = (0.0, 0.0),
    *,
    nodata: float | None = None,
    unknown: tuple[float, ...] = (),
    bands: tuple[int, ...] = (1,),
    nearest: bool = False,
) -> Iterator[Callable[[int, int], Float32[np.ndarray, "bands rows columns"]]]:
    """Read rows of any raster on a grid as float32, NaN where it has no value.

    Args:
        unknown: further values of the first band that are none; the other bands are not read then.
        nearest: of classes, between which there is nothing.

    Raises:
        ChangeError: the file cannot be read to its end.
    """
    rasterio = need("rasterio")
    from rasterio.enums import MaskFlags, Resampling
    from rasterio.vrt import WarpedVRT
    from rasterio.windows import Window

    # Without a system on either side GDAL needs one all the same: any that is the same on both sides changes nothing.
    source = PLAIN if crs is None or grid.crs is None else crs.to_wkt()
    target = PLAIN if crs is None or grid.crs is None else grid.crs
    moved = replace(grid, west_m=grid.west_m - shift_m[0], north_m=grid.north_m - shift_m[1]).transform
    with opened(path) as dataset:
        own = dataset.transform
        # Cells on the file's own pixels are copied, not interpolated.
        offset = (moved.c - own.c) / own.a, (moved.f - own.f) / own.e
        same = (
            source == target or (crs is not None and grid.crs is not None and same_system(crs, CRS.from_wkt(grid.crs)))
        ) and own.b == own.d == 0
        size = max(dataset.width, dataset.height)
        same = same and max(abs(own.a / moved.a - 1), abs(own.e / moved.e - 1)) * size < 0.01
        aligned = same and max(abs(o - round(o)) for o in offset) < 0.01
        resampling = Resampling.nearest if aligned or nearest else Resampling.bilinear
        alpha = MaskFlags.alpha in dataset.mask_flag_enums[0] and not unknown
        options: dict[str, Any] = {} if alpha else {"nodata": math.nan}
        if nodata is not None and not alpha and not unknown:
            options["src_nodata"] = nodata
        if crs is not None or grid.crs is None:
            options["src_crs"] = source
        with (
            cleared(dataset, unknown) as known,
            WarpedVRT(
                known,
                crs=target,
                transform=moved,
                width=grid.columns,
                height=grid.rows,
                resampling=resampling,
                dtype="float32",
                warp_mem_limit=64,
                **options,
            ) as vrt,
        ):

            def read(first: int, last: int) -> Float32[np.ndarray, "bands rows columns"]:
                window = Window(0, first, grid.columns, last - first)  # type: ignore[call-arg]
                try:
                    values = vrt.read(list(bands), window=window).astype(np.float32, copy=False)
                    if alpha:
                        values[:, vrt.dataset_mask(window=window) == 0] = np.nan
                except rasterio.errors.RasterioError as error:
                    raise ChangeError(
                        f"{path} cannot be read to its end ({error}): expected a whole GeoTIFF; copy or make it again"
                    ) from error
                return values

            yield read


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """A raster file, opened."""
    rasterio = need("rasterio")
    with reading_from(path), path.open("rb") as file:
        start = file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")
    of_services = {*_REFERRING} - {"VRT"}
    if start[:1] in (b"<", b"{") and b"<VRTDataset" not in start and path.suffix[1:].upper() not in of_services:
        raise _refers(path, "text")  # GDAL asks the address as it opens such a file
    try:
        with rasterio.Env(GDAL_CACHEMAX=128), rasterio.open(path) as dataset:
            if dataset.driver in _REFERRING and dataset.driver.lower() != path.suffix[1:].lower():
                raise _refers(path, dataset.driver)
            yield dataset
    except rasterio.errors.RasterioIOError as error:
        raise ChangeError(
            f"{path} is not a raster that can be read ({error}): expected a GeoTIFF of heights; name another"
        ) from error


def _refers(path: Path, what: str) -> ChangeError:
    return ChangeError(
        f"{path} refers to other files or addresses ({what}): expected a GeoTIFF, or a mosaic whose name ends in .vrt; "
        "name another, or rename it"
    )


def open_surface(path: Path, date: str | None = None) -> Surface:
    """Look at a raster of heights: its place, its nodata and its units; what is odd is told in the remarks.

    Args:
        path: a GeoTIFF.
        date: of the survey; None takes it from the file or its name.

    Raises:
        ChangeError: it is no raster of heights on a north-up grid.
    """
    remarks: list[str] = []
    with opened(path) as dataset:
        if what := _other_than_heights(dataset):
            raise ChangeError(f"{path} {what}: expected one band of heights; name the surface model (dsm.tif)")
        if dataset.count > 2:
            remarks.append(f"{path.name} has {dataset.count} bands: the first is taken for heights")
        transform = dataset.transform
        if tuple(transform)[:6] == (1, 0, 0, 0, 1, 0) or abs(transform.b) + abs(transform.d) > 1e-9 * abs(transform.a):
            raise ChangeError(
                f"{path} has no place on a map, or a turned one: expected a georeferenced GeoTIFF with north up; "
                "warp it first (gdalwarp)"
            )
        crs, metres, heights = None, 1.0, False
        if dataset.crs is not None:
            try:
                crs = CRS.from_wkt(dataset.crs.to_wkt())
            except CRSError as error:
                raise ChangeError(
                    f"the coordinate system of {path} is not known ({error}): expected one with an EPSG code; assign "
                    "it with gdal_edit.py -a_srs"
                ) from error
            metres, heights = metres_per_height(crs), crs.is_compound or len(crs.axis_info) == 3
            if is_local(crs):
                crs = None
                remarks.append(
                    f"{path.name} lies in a local frame: that both surveys have the same one is taken for granted"
                )
        else:
            remarks.append(f"{path.name} states no coordinate system; its lengths are taken as metres")
        unit = (dataset.units[0] or "").strip()
        if unit and not heights:
            metres = _UNITS_M.get(unit.lower(), 1.0)
            if unit.lower() not in _UNITS_M:
                remarks.append(f"{path.name} states heights in {unit}, which is not known: they are taken as metres")
        elif crs is not None and has_unstated_unit(crs):
            remarks.append(unstated_unit(path, crs, "gdal_edit.py -a_srs"))
        nodata = dataset.nodata
        found, share, doubtful = undeclared(dataset, metres)
        if found:
            declared = "no nodata" if nodata is None else f"nodata {nodata:g}"
            remarks.append(
                f"{path.name} declares {declared}, but has {' and '.join(f'{value:g}' for value in found)} where no "
                f"height can be, in {100 * share:.1f}% of its cells: read as such"
            )
        if doubtful:
            remarks.append(
                f"{path.name} has 0 next to heights far from it, in {100 * doubtful:.1f}% of its cells: as it declares "
                f"nodata {nodata:g}, that is taken for levelled water; if it is none, leave it out with gdalwarp "
                "-srcnodata 0"
            )
        # Where a file has a mask, GDAL reads that or the declared value, not both.
        if is_masked(dataset) and nodata is not None and math.isfinite(nodata):
            found.append(nodata)
        tags = dataset.tags()
        named, stated = date_in(path.stem), date_in(tags.get("TIFFTAG_DATETIME", ""))
        if date is None and named and stated and named != stated:
            remarks.append(f"{path.name} is of {named} by its name, of {stated} by its tags: its name is believed")
        date = date or named or stated
        return Surface(
            path,
            crs,
            transform,
            dataset.width,
            dataset.height,
            nodata,
            metres,
            dataset.scales[0],
            dataset.offsets[0],
            sigma_of(path),
            date=date,
            datum=tags.get("VERTICAL_DATUM"),
            remarks=remarks,
            unknown=tuple(found),
        )


def _other_than_heights(dataset: Any) -> str | None:
    """What a raster holds instead of heights, as far as it says so."""
    from rasterio.enums import ColorInterp

    plain = (dataset.scales[0], dataset.offsets[0]) == (1, 0)
    if ColorInterp.red in dataset.colorinterp or (dataset.dtypes[0] == "uint8" and plain):
        return "has colours or bytes, which is a picture"
    described = dataset.descriptions[0] or ""
    if described.startswith(_RESULTS):
        return f"has {described!r}, a result of change or map"
    return None


def unstated_unit(path: Path, crs: CRS, tool: str) -> str:
    """A remark on heights in a system whose plan is in feet, which states no unit of heights."""
    return (
        f"the system of {path.name} counts in {horizontal(crs).axis_info[0].unit_name} and states no unit of heights, "
        f"which are taken as metres: where they are not, assign a compound system ({tool})"
    )


def sigma_of(path: Path) -> Path | None:
    """The raster of standard errors next to a surface, by its name."""
    names = [path.with_name(f"{path.stem}_{ending}{path.suffix}") for ending in ("sigma", "standard_error", "error")]
    return next((name for name in names if name.is_file()), None)


def date_in(text: str) -> str | None:
    """A date in a text, as YYYY-MM-DD, or None."""
    found = re.search(r"(?<!\d)(19|20)(\d\d)[-_:.]?(0[1-9]|1[0-2])[-_:.]?(0[1-9]|[12]\d|3[01])(?!\d)", text)
    return "{}{}-{}-{}".format(*found.groups()) if found else None


def other_datums(earlier: Surface, later: Surface) -> str | None:
    """Name the vertical datums of two surfaces, by their systems or else in words, if they state different ones."""
    by_system = earlier.vertical_datum, later.vertical_datum
    one, other = by_system if None not in by_system else (earlier.datum, later.datum)
    if one is None or other is None or one == other:
        return None
    apart = ", up to two metres apart" if one.startswith(_ELLIPSOID) and other.startswith(_ELLIPSOID) else ""
    return f"heights are over different vertical datums{apart}: {one} and {other}"


def values_at(values: np.ndarray, grid: Grid, place: Float64[np.ndarray, "P 2"], outside: int) -> np.ndarray:
    """Values of the cells that points (easting and northing) are in; outside of the grid, and at NaN, another one."""
    known = np.isfinite(place).all(axis=1)
    column, row = np.full(len(place), -1), np.full(len(place), -1)
    column[known] = np.floor((place[known, 0] - grid.west_m) / grid.cell_m).astype(int)
    row[known] = np.floor((grid.north_m - place[known, 1]) / grid.cell_m).astype(int)
    inside = (column >= 0) & (row >= 0) & (column < grid.columns) & (row < grid.rows)
    found = np.full(len(place), outside, values.dtype)
    found[inside] = values[row[inside], column[inside]]
    return found


def compared_grid(earlier: Surface, later: Surface, cell_m: float | None, registered: bool) -> Grid:
    """The grid that two surveys are compared on.

    Args:
        cell_m: as `common_grid` has it.
        registered: whether stable ground takes out what heights over other datums differ by.

    Raises:
        ChangeError: they have none in common, or state different vertical datums and are not registered.
    """
    grid = common_grid([earlier, later], cell_m)
    if not registered and (datums := other_datums(earlier, later)):
        raise ChangeError(
            f"{earlier.file} and {later.file} cannot be compared without registration: {datums}; expected "
            "one; convert one of them first (gdalwarp), leave --register none out, or, if they are the same one, "
            "state it in the same words (gdal_edit.py -mo VERTICAL_DATUM=...)"
        )
    return grid


def common_grid(surfaces: list[Surface], cell_m: float | None = None) -> Grid:
    """The grid that surfaces are compared on: where all of them are, at the coarsest of their pixels.

    It lies on the first surface's pixels where these are square, have the grid's size and a projected system in metres.

    Args:
        cell_m: another size of cells, in metres.

    Raises:
        ChangeError: the surfaces do not overlap, their systems do not fit together, or the grid would be too large.
    """
    first = surfaces[0]
    _require_same_heights(surfaces)
    crs = _metric(first)
    boxes, pixels = [], []
    for surface in surfaces:
        box, pixel = _box(surface, crs)
        boxes.append(box)
        pixels.append(pixel)
    west, south = (max(box[k] for box in boxes) for k in (0, 1))
    east, north = (min(box[k] for box in boxes) for k in (2, 3))
    if west >= east or south >= north:
        places = "; ".join(f"{s.file}: {_place(box)}" for s, box in zip(surfaces, boxes, strict=True))
        raise ChangeError(
            f"the surveys do not overlap ({places}): expected the same ground; check the files and their coordinate "
            "systems"
        )
    cell = cell_m or max(pixels)
    if cell_m is not None and not 0 < cell_m < min(east - west, north - south):
        shared = min(east - west, north - south)
        raise ChangeError(
            f"--cell {cell_m} was asked for: expected more than 0 and less than the {shared:.1f} m that both surveys "
            "share; choose another"
        )
    own = first.transform
    on_first = crs is not None and first.crs is not None and same_system(crs, first.crs)
    exact = abs(own.a + own.e) * max(first.columns, first.rows) < 0.01 * own.a
    if (on_first or crs is None) and exact and abs(cell / own.a - 1) * max(first.columns, first.rows) < 0.01:
        cell = own.a
        west = own.c + math.ceil((west - own.c) / cell - 1e-3) * cell
        north = own.f - math.ceil((own.f - north) / cell - 1e-3) * cell
    columns, rows = math.floor((east - west) / cell + 1e-3), math.floor((north - south) / cell + 1e-3)
    if columns < 2 or rows < 2:
        raise ChangeError(
            f"the surveys share {columns} x {rows} cells of {cell:g} m: expected at least 2 x 2; give a smaller --cell"
        )
    if columns * rows > MOST_CELLS:
        raise ChangeError(
            f"the surveys share {columns * rows / 1e6:.0f} million cells of {cell:g} m: expected at most "
            f"{MOST_CELLS / 1e6:.0f} million; give a larger --cell"
        )
    return Grid(crs.to_wkt() if crs is not None else None, west, north, cell, columns, rows)


def _metric(surface: Surface) -> CRS | None:
    """The horizontal system of a grid of true metres at a surface's middle; None where the surface has no system."""
    if surface.crs is None:
        return None
    middle = _at(surface.transform, surface.columns / 2, surface.rows / 2)
    return system_of_ground(surface.crs, middle, surface.path, "gdal_edit.py -a_srs")


def system_of_ground(crs: CRS, place: tuple[float, float], path: Path, tool: str) -> CRS:
    """The system of `metric_system` at a place.

    Args:
        path, tool: of what has that system, and what assigns another one, for the message.

    Raises:
        ChangeError: the place is outside of the system.
    """
    try:
        return metric_system(crs, *place)
    except ProjError as error:
        raise ChangeError(
            f"{path} lies outside of {crs.name} ({error}): expected coordinates of its system; assign the right one "
            f"({tool})"
        ) from error


def _box(surface: Surface, crs: CRS | None) -> tuple[tuple[float, float, float, float], float]:
    """West, south, east and north of a surface in a system, and the side of its pixels there."""
    corners = [_at(surface.transform, c, r) for c in (0.0, float(surface.columns)) for r in (0.0, float(surface.rows))]
    xs, ys = zip(*corners, strict=True)
    box = (min(xs), min(ys), max(xs), max(ys))
    pixel = max(abs(surface.transform.a), abs(surface.transform.e))
    if surface.crs is None or crs is None or same_system(surface.crs, crs):
        return box, pixel
    try:
        to = Transformer.from_crs(horizontal(surface.crs), crs, always_xy=True)
        side = longer_side(surface.transform, surface.columns, surface.rows, to)
        return to.transform_bounds(*box, errcheck=True), side
    except ProjError as error:
        raise ChangeError(
            f"{surface.path} cannot be converted from {surface.crs.name} to {crs.name} ({error}): expected a system "
            "that both can be converted to; warp one of them first (gdalwarp)"
        ) from error


def longer_side(transform: Affine, columns: int, rows: int, to: Transformer) -> float:
    """The longer side of a raster's middle pixel, in the system that its coordinates are converted to.

    Raises:
        ProjError: they cannot be converted.
    """
    x, y = zip(*(_at(transform, columns / 2 + i, rows / 2 + j) for i, j in ((0, 0), (1, 0), (0, 1))), strict=True)
    east, north = to.transform(x, y, errcheck=True)
    return max(math.hypot(east[k] - east[0], north[k] - north[0]) for k in (1, 2))


def _at(transform: Affine, column: float, row: float) -> tuple[float, float]:
    """Coordinates of a position in a raster."""
    return transform.c + transform.a * column, transform.f + transform.e * row


def _place(box: tuple[float, float, float, float]) -> str:
    return f"{box[0]:.0f} to {box[2]:.0f} east, {box[1]:.0f} to {box[3]:.0f} north"


def _require_same_heights(surfaces: list[Surface]) -> None:
    """Raises: ChangeError when only some have a coordinate system, or heights are over different vertical datums."""
    named = [surface for surface in surfaces if surface.crs is not None]
    if named and len(named) < len(surfaces):
        bare = next(surface for surface in surfaces if surface.crs is None)
        raise ChangeError(
            f"{named[0].file} has a coordinate system, {bare.file} has none: expected it in all files or in "
            "none; assign it with gdal_edit.py -a_srs"
        )
    require_one_datum([(Path(surface.file), surface.vertical_datum) for surface in named])


def require_one_datum(datums: Sequence[tuple[Path, str | None]], registered: bool = True) -> None:
    """Check that files state heights over one vertical datum; None states none.

    Args:
        registered: whether stable ground takes out what ellipsoids of modern datums differ by, up to two metres.

    Raises:
        ChangeError: they do not.
    """
    stated = [(datum, path) for path, datum in datums if datum is not None]
    alike = {
        _ELLIPSOID if registered and datum.startswith(_ELLIPSOID) else datum: (datum, path) for datum, path in stated
    }
    heights = dict(alike.values())
    if len(heights) > 1:
        (one, first), (other, second), *_ = heights.items()
        both = one.startswith(_ELLIPSOID) and other.startswith(_ELLIPSOID)
        raise ChangeError(
            f"heights of {first.name} are over {one}, those of {second.name} over {other}: expected one vertical datum "
            f"for both; convert one of them first (gdalwarp -t_srs with a {'3D' if both else 'compound'} system)"
            f"{', or leave --register none out' if both else ''}"
        )
