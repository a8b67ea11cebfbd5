"""Rasters as pages of maps read them: small pictures, tiles, cells at places and in polygons."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64

from tidefield.change.surfaces import Surface, opened
from tidefield.errors import RunError
from tidefield.geometry.geodesy import same_system

TILE_PX = 256
MOST_CELLS = 16_000_000
"""Of the box around a polygon."""
STRIP_CELLS = 1 << 18
"""Of a map's box around a polygon that are read at once."""


def opened_source(source: Path | Surface) -> AbstractContextManager[Any]:
    """Open a raster while a block lasts; of a surface, its heights in metres."""
    return source.in_metres() if isinstance(source, Surface) else opened(source)


def overview(source: Path | Surface, band: int) -> Float64[np.ndarray, " N"]:
    """The values of a raster, from a small picture of it."""
    with opened_source(source) as file:
        step = max(1.0, max(file.shape) / 512)
        shape = tuple(max(1, round(side / step)) for side in file.shape)
        values = file.read(band, out_shape=shape, masked=True).astype(np.float64).filled(np.nan)
    return values[np.isfinite(values)]


def usual_ends(source: Path | Surface, band: int) -> tuple[float, float]:
    """The 2nd and 98th percentile of a raster's values, from a small picture of it; NaN where it has none."""
    known = overview(source, band)
    if not len(known):
        return math.nan, math.nan
    low, high = np.percentile(known, [2, 98]).tolist()
    return low, max(high, low + 1e-3)


def picture_bands(file: Any) -> list[int]:
    """The bands of a picture: red, green and blue, or grey."""
    return [1, 2, 3] if sum(kind.name != "alpha" for kind in file.colorinterp) >= 3 else [1]


def black_and_white(path: Path) -> tuple[float, float]:
    """The values of a picture that are shown black and white: of bytes the ends, otherwise the ends of most values.

    Cameras fill a part of 16 bits, and reflectance lies in [0, 1]. All bands have the same ends, to keep colours.
    """
    with opened_source(path) as file:
        bands = picture_bands(file)
        if file.dtypes[0] == "uint8":
            return 0.0, 255.0
    return common_ends([usual_ends(path, band) for band in bands])


def common_ends(ends: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The lowest and the highest of the ends of several rasters, of which some may have no values."""
    low, high = zip(*([own for own in ends if math.isfinite(own[0])] or [(0.0, 1.0)]), strict=True)
    return min(low), max(high)


def read_tile(
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


def sample(file: Any, place: Float64[np.ndarray, "N 2"], band: int) -> Float64[np.ndarray, " N"]:
    """A raster's cells at places; NaN outside and where nothing is known."""
    rows, columns = np.floor(_cells(file, place)).astype(np.int64)[:, ::-1].T
    inside = (rows >= 0) & (rows < file.height) & (columns >= 0) & (columns < file.width)
    found = np.full(len(place), np.nan)
    if inside.any():
        r, c = rows[inside], columns[inside]
        from rasterio.windows import Window

        box = Window(c.min(), r.min(), c.max() - c.min() + 1, r.max() - r.min() + 1)  # type: ignore[call-arg]
        if box.width * box.height <= MOST_CELLS:
            found[inside] = read_band(file, band, box)[r - r.min(), c - c.min()]
        else:
            found[inside] = [float(read_band(file, band, Window(x, y, 1, 1))[0, 0]) for y, x in zip(r, c, strict=True)]  # type: ignore[call-arg]
    return found


def _cells(file: Any, place: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
    """Columns and rows of places, counted from the raster's corner."""
    inverse = ~file.transform
    matrix = np.array([[inverse.a, inverse.b], [inverse.d, inverse.e]])
    return place @ matrix.T + (inverse.c, inverse.f)


def corner_at(transform: Any, window: Any) -> Any:
    """The transform of a window."""
    a, b, c, d, e, f = transform[:6]
    x, y = window.col_off, window.row_off
    return type(transform)(a, b, c + a * x + b * y, d, e, f + d * x + e * y)


def read_band(file: Any, band: int, window: Any, kind: type = np.float64) -> Float[np.ndarray, "h w"]:
    """A band of a window as numbers of a kind; NaN where nothing is known."""
    return file.read(band, window=window, masked=True).astype(kind, copy=False).filled(np.nan)


def cells_in(file: Any, polygon: Any) -> tuple[Any, Bool[np.ndarray, "h w"]]:
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
    transform = corner_at(file.transform, window)
    return window, geometry_mask([polygon], (height, width), transform, invert=True)


def strips(box: Any, inside: Bool[np.ndarray, "h w"]) -> Iterator[tuple[Any, Bool[np.ndarray, "rows w"]]]:
    """The rows of a window, a few at a time, and which of their cells are inside."""
    from rasterio.windows import Window

    step = max(1, STRIP_CELLS // max(1, inside.shape[1]))
    for first in range(0, len(inside), step):
        within = inside[first : first + step]
        yield Window(box.col_off, box.row_off + first, box.width, len(within)), within  # type: ignore[call-arg]


@cache
def same_plan(one: str, other: str) -> bool:
    """Whether two systems, as WKT, differ in nothing but their heights."""
    from pyproj import CRS

    return one == other or same_system(CRS.from_wkt(one), CRS.from_wkt(other))


def empty_around(file: Any, heights: bool) -> dict[str, Any]:
    """Options of a warp that leave what is around a turned raster empty, which is 0 otherwise, a height or black."""
    from rasterio.enums import MaskFlags

    if any(MaskFlags.alpha in flags for flags in file.mask_flag_enums):
        return {}
    if heights or file.dtypes[0].startswith("float"):
        return {"nodata": math.nan, "dtype": "float32"}
    return {"add_alpha": True} if file.nodata is None else {}
