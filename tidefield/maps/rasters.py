"""Write the rasters of a map: strip by strip, then as cloud-optimised GeoTIFFs with overviews."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from tidefield import SOFTWARE
from tidefield.errors import RunError, need
from tidefield.files import completed_file
from tidefield.maps.styles import Style, write_style

if TYPE_CHECKING:  # it needs PyTorch, which `change` does without
    from tidefield.maps.grid import Grid

NODATA = -9999.0
BLOCK = 512


@dataclass(frozen=True)
class Raster:
    """What a raster holds.

    Attributes:
        path: of the file.
        bands: description of each band.
        kind: NumPy's name of the values' type.
        nodata: value of cells without any; None with an alpha band.
        unit: of the values.
        tags: texts of the file.
        average: overviews are means; otherwise the nearest cell, for numbers that name something.
        style: how QGIS shows it.
    """

    path: Path
    bands: tuple[str, ...]
    kind: str = "float32"
    nodata: float | None = NODATA
    unit: str = ""
    tags: Mapping[str, str] = field(default_factory=dict)
    average: bool = True
    style: Style | None = None

    @property
    def colour(self) -> bool:
        return self.bands[-1] == "alpha"


class RasterWriter:
    """Writes one raster by rows."""

    def __init__(self, dataset: Any, raster: Raster) -> None:
        self._dataset, self.raster = dataset, raster

    def write(self, row: int, values: np.ndarray) -> None:
        """Write some whole rows: values of the bands x rows x columns."""
        from rasterio.errors import RasterioError

        height = values.shape[1]
        window = ((row, row + height), (0, values.shape[2]))
        try:
            self._dataset.write(values.astype(self.raster.kind, copy=False), window=window)
        except RasterioError as error:
            reason = error.__cause__ or error
            raise OSError(28, f"writing failed: {reason}", str(self.raster.path)) from error


@contextmanager
def raster_writer(raster: Raster, grid: Grid) -> Iterator[RasterWriter]:
    """Write a raster of a map with `cog_writer`; its tags name the map's coordinates.

    Raises:
        RunError: its folder cannot be written to, or is full.
    """
    tags = {"VERTICAL_DATUM": grid.frame.heights, "COORDINATES": grid.frame.name, **raster.tags}
    with cog_writer(replace(raster, tags=tags), grid.columns, grid.rows, grid.frame.wkt, grid.transform) as writer:
        yield writer


@contextmanager
def cog_writer(
    raster: Raster, columns: int, rows: int, wkt: str | None, transform: Sequence[float], fast: bool = False
) -> Iterator[RasterWriter]:
    """Write a raster by rows; it is there, as a cloud-optimised GeoTIFF, when the block ends.

    Args:
        columns, rows: of cells.
        wkt: its coordinate system; None for none.
        transform: affine coefficients from column and row to its coordinates, in rasterio's order.
        fast: on all processors, and with a file in between that is not compressed, as large as the raster.

    Raises:
        RunError: its folder cannot be written to, or is full.
    """
    rasterio = need("rasterio")
    shutil = need("rasterio.shutil")
    from rasterio.enums import ColorInterp
    from rasterio.transform import Affine

    kind = np.dtype(raster.kind)
    profile: dict[str, Any] = {
        "driver": "GTiff", "width": columns, "height": rows, "count": len(raster.bands), "dtype": raster.kind,
        "crs": None if wkt is None else rasterio.crs.CRS.from_wkt(wkt), "transform": Affine(*transform), "tiled": True,
        "blockxsize": BLOCK, "blockysize": BLOCK, "bigtiff": "IF_SAFER",
    }  # fmt: skip
    profile |= {"interleave": "band"} if fast else {"compress": "DEFLATE", "zlevel": 1}
    if raster.nodata is not None:
        profile["nodata"] = raster.nodata
    with completed_file(raster.path, overwrite=True) as partial:
        rough = partial.with_name(partial.name.replace(".partial", ".rough.partial"))
        try:
            with rasterio.open(rough, "w", **profile) as dataset:
                dataset.update_tags(TIFFTAG_SOFTWARE=SOFTWARE, **raster.tags)
                for band, name in enumerate(raster.bands, start=1):
                    dataset.set_band_description(band, name)
                    if raster.unit:
                        dataset.set_band_unit(band, raster.unit)
                if raster.colour:
                    dataset.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
                yield RasterWriter(dataset, raster)
            shutil.copy(
                str(rough), str(partial), driver="COG", COMPRESS="DEFLATE", PREDICTOR="YES", BLOCKSIZE=BLOCK,
                OVERVIEW_RESAMPLING="AVERAGE" if raster.average and kind.kind != "i" else "NEAREST",
                BIGTIFF="IF_SAFER", NUM_THREADS="ALL_CPUS" if fast else "1",
            )  # fmt: skip
        except rasterio.errors.RasterioError as error:
            raise OSError(None, str(error), str(raster.path)) from error
        finally:
            rough.unlink(missing_ok=True)
    if raster.style is not None:
        write_style(raster.style, raster.path)


def read_values(dataset: Any, band: int | None = None, **how: Any) -> np.ndarray:
    """Read a band of an open raster, or all of them, as floats, NaN where it has no data.

    Args:
        how: rasterio's options, such as the window.
    """
    values = dataset.read(band, **how).astype(np.float32, copy=False)
    if dataset.nodata is not None:
        values[values == np.float32(dataset.nodata)] = np.nan
    return values


def read_raster(path: Path, band: int = 1) -> tuple[np.ndarray, Any]:
    """Read a band of a raster as floats, NaN where it has no data, and its profile.

    Raises:
        RunError: it is missing or no raster.
    """
    rasterio = need("rasterio")
    try:
        with rasterio.open(path) as dataset:
            return read_values(dataset, band), dict(dataset.profile)
    except rasterio.errors.RasterioError as error:
        raise RunError(f"{path} is no raster ({error}): expected a GeoTIFF") from error


def sample(paths: Sequence[Path], place: Float64[np.ndarray, "N 2"], grid: Grid) -> Float64[np.ndarray, "N K"]:
    """Interpolate rasters of a grid bilinearly at places; NaN where one of the four cells has no value.

    Args:
        paths: of K rasters.
        place: easting and northing.
        grid: of the rasters.
    """
    rasterio = need("rasterio")
    u, v = (place[:, 0] - grid.west) / grid.cell - 0.5, (grid.north - place[:, 1]) / grid.cell - 0.5
    left, top = np.floor(u).astype(int), np.floor(v).astype(int)
    inside = (left >= 0) & (top >= 0) & (left < grid.columns - 1) & (top < grid.rows - 1)
    result = np.full((len(place), len(paths)), np.nan)
    a, b = u - left, v - top
    for k, path in enumerate(paths):
        with rasterio.open(path) as dataset:
            block: dict[tuple[int, int], np.ndarray] = {}
            for i in np.flatnonzero(inside):
                row, column = int(top[i]), int(left[i])
                key = row // BLOCK, column // BLOCK
                if key not in block:  # the block with the next one's first row and column
                    first, west = key[0] * BLOCK, key[1] * BLOCK
                    last, east = min(first + BLOCK + 1, grid.rows), min(west + BLOCK + 1, grid.columns)
                    values = read_values(dataset, 1, window=((first, last), (west, east)))
                    block = {key: values.astype(np.float64)}
                row, column = row % BLOCK, column % BLOCK
                four = block[key][row : row + 2, column : column + 2]
                result[i, k] = np.array([1 - b[i], b[i]]) @ four @ np.array([1 - a[i], a[i]])
    return result
