"""Point clouds (LAS, LAZ): read, made surfaces of, compared by M3C2, and written."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError
from scipy.ndimage import maximum_filter

from tidefield.change.m3c2 import Distances, fit_normals, m3c2
from tidefield.change.registration import Registration
from tidefield.change.surfaces import ChangeError, Grid, system_of_ground, unstated_unit, values_at
from tidefield.errors import need
from tidefield.files import reading_from
from tidefield.geometry.geodesy import (
    FOOT_M,
    US_SURVEY_FOOT_M,
    has_unstated_unit,
    horizontal,
    is_local,
    metres_per_height,
    same_system,
    vertical_datum_of,
)
from tidefield.maps.classes import NOISE, WATER

_MOST_POINTS = 200_000_000
_POINTS_PER_CELL = 10.0
"""With fewer, cells without points are holes in the surface, and are missing in volumes."""
_CHUNK = 2_000_000
_PROJECTED, _PLAN_UNIT, _VERTICAL, _HEIGHT_UNIT = 3072, 3076, 4096, 4099
"""GeoKeys of the plan's and the heights' system and unit (OGC GeoTIFF 1.1)."""
_USER_DEFINED = 32767
_UNITS_M = {9001: 1.0, 9002: FOOT_M, 9003: US_SURVEY_FOOT_M}
"""Lengths of EPSG's units of length."""
_ASSIGN = "pdal translate --writers.las.a_srs"
_EXPECTED = "expected a LAS or LAZ file with points; name another"
SIGMAS = ("sigma_z", "sigma")
"""Names of a dimension with the points' standard errors."""


@dataclass(frozen=True)
class Cloud:
    """Points in metres.

    Attributes:
        crs: a system of true metres; None where the file states none, or a local one.
        xyz: east, north, up.
        sigma: standard errors of their heights, if the file has them.
        vertical_datum: of the heights, if the file states one.
        remarks: what a user should know of how it was read.
    """

    path: Path
    crs: CRS | None
    xyz: Float64[np.ndarray, "N 3"]
    sigma: Float64[np.ndarray, " N"] | None
    vertical_datum: str | None = None
    remarks: tuple[str, ...] = ()


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, CRS | None, dict[int, int]]]:
    """The reader of a LAS or LAZ file, its system, and its GeoTIFF keys."""
    laspy = need("laspy")
    with reading_from(path):
        size = path.stat().st_size
        path.open("rb").close()
    try:
        with laspy.open(path) as reader:
            header = reader.header
            if not 0 < header.point_count <= _MOST_POINTS or header.point_count > 100 * size:
                raise ChangeError(f"{path} has {header.point_count} points: {_EXPECTED}, or a part of it")
            crs, keys = _system(header)
            if crs is not None and (crs.is_geographic or crs.is_geocentric):
                found = "in degrees" if crs.is_geographic else "geocentric, without heights"
                raise ChangeError(
                    f"{path} is {found} ({crs.name}): expected a projected system in metres; convert it first"
                )
            yield reader, crs, keys
    except ChangeError:
        raise
    except Exception as error:  # laspy and lazrs raise whatever a damaged file makes them
        raise ChangeError(f"{path} cannot be read as a point cloud ({error}): {_EXPECTED}") from error


def look_at_cloud(path: Path) -> Cloud:
    """Read the header of a LAS or LAZ file alone: a cloud without points, in the file's own system.

    Raises:
        ChangeError: as `read_cloud`, as far as the header tells.
    """
    with _opened(path) as (_, crs, _):
        own = None if crs is None or is_local(crs) else crs
        return Cloud(path, own, np.empty((0, 3)), None, None if own is None else vertical_datum_of(own))


def read_cloud(path: Path) -> Cloud:
    """Read the points of a LAS or LAZ file without those that are withheld or classified as noise or water.

    Those of systems in feet, or of Web Mercator, are converted to the UTM zone of their middle.

    Raises:
        ChangeError: the file is damaged, empty or too large, in degrees, geocentric, or outside of its system.
    """
    with _opened(path) as (reader, crs, keys):
        header = reader.header
        extra = next((name for name in SIGMAS if name in header.point_format.extra_dimension_names), None)
        # As large as all points: parts that are joined would take as much again.
        xyz, read = np.empty((header.point_count, 3)), 0
        sigmas = None if extra is None else np.empty(header.point_count)
        for points in reader.chunk_iterator(_CHUNK):
            kept = ~np.isin(np.asarray(points.classification), (*NOISE, WATER))
            kept &= ~np.asarray(points.withheld, bool)
            part = np.stack([np.asarray(axis, np.float64) for axis in (points.x, points.y, points.z)], axis=1)
            kept &= np.isfinite(part).all(axis=1)
            rows = slice(read, read + int(np.count_nonzero(kept)))
            xyz[rows], read = part[kept], rows.stop
            if sigmas is not None:
                sigmas[rows] = np.asarray(points[extra], np.float64)[kept]
    xyz, sigma = xyz[:read], None if sigmas is None else sigmas[:read]
    if len(xyz) == 0:
        raise ChangeError(f"{path} has no points but noise, water and withheld ones: {_EXPECTED}")
    up = _UNITS_M.get(keys.get(_HEIGHT_UNIT, 0), 1.0 if crs is None else metres_per_height(crs))
    xyz[:, 2] *= up
    sigma = None if sigma is None else sigma * up
    if crs is None or is_local(crs):
        unit_m = _UNITS_M.get(keys.get(_PLAN_UNIT, 0), 1.0)
        xyz[:, :2] *= unit_m
        own_system = (
            f"{path.name} has a projected system of its own, which is not read: that both surveys have the same one is "
            f"taken for granted; assign one with an EPSG code ({_ASSIGN})"
        )
        converted = (
            f"eastings and northings of {path.name} are multiplied by {unit_m:.6g} to be metres; heights without a "
            "unit are taken as metres"
        )
        own = crs is None and keys.get(_PROJECTED) == _USER_DEFINED
        remarks = (*((own_system,) if own else ()), *((converted,) if unit_m != 1 else ()))
        return Cloud(path, None, xyz, sigma, remarks=remarks)
    east, north = xyz[:, :2].mean(axis=0).tolist()
    metric = system_of_ground(crs, (east, north), path, _ASSIGN)
    unstated = has_unstated_unit(crs) and keys.get(_HEIGHT_UNIT) not in _UNITS_M
    remarks = (unstated_unit(path, crs, _ASSIGN),) if unstated else ()
    own = crs if metres_per_height(crs) == 1 else horizontal(crs)
    return in_system(Cloud(path, own, xyz, sigma, vertical_datum_of(crs), remarks), metric)


def _system(header: Any) -> tuple[CRS | None, dict[int, int]]:
    """The system of a LAS file, and its GeoTIFF keys, of which laspy reads those of the plan alone."""
    vlrs = header.vlrs.get("GeoKeyDirectoryVlr")
    keys = {key.id: key.value_offset for vlr in vlrs for key in vlr.geo_keys if key.tiff_tag_location == 0}
    crs = header.parse_crs()
    if crs is None or (crs.is_geographic and keys.get(_PROJECTED) == _USER_DEFINED):
        return None, keys
    if _VERTICAL in keys and not crs.is_compound and len(crs.axis_info) < 3:
        try:
            vertical = CRS.from_epsg(keys[_VERTICAL])
        except CRSError:  # of GeoTIFF 1.0, which had numbers of its own, or of the user
            return crs, keys
        if vertical.is_vertical:
            crs = CRS(CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical]).to_wkt())
    return crs, keys


def require_system(cloud: Cloud, crs: CRS | None) -> None:
    """Raises: ChangeError when only one of a cloud and what it is compared with has a system."""
    if (cloud.crs is None) != (crs is None):
        lacks = cloud.path.name if cloud.crs is None else f"what {cloud.path.name} is compared with"
        raise ChangeError(
            f"{lacks} has no coordinate system: expected it in both surveys or in none; assign it ({_ASSIGN})"
        )


def in_system(cloud: Cloud, crs: CRS | None) -> Cloud:
    """Convert the eastings and northings of a cloud to another system of metres.

    Raises:
        ChangeError: only one of them has a system, or there is no way between them.
    """
    require_system(cloud, crs)
    if cloud.crs is None or crs is None or same_system(cloud.crs, crs):
        return cloud
    xy = Transformer.from_crs(horizontal(cloud.crs), horizontal(crs), always_xy=True).transform(*cloud.xyz[:, :2].T)
    xyz = np.column_stack([*xy, cloud.xyz[:, 2]])
    if not np.isfinite(xyz).all():
        raise ChangeError(f"{cloud.path} cannot be converted to {crs.name}: expected a system that fits its place")
    return replace(cloud, crs=crs, xyz=xyz)


def default_cell(cloud: Cloud) -> float:
    """Side of cells that have ten points on average where there are points, to half a unit of the first digit."""
    low, high = cloud.xyz[:, :2].min(axis=0), cloud.xyz[:, :2].max(axis=0)
    area = float(np.prod(np.maximum(high - low, 1e-3)))
    side = math.sqrt(_POINTS_PER_CELL * area / len(cloud.xyz))
    for _ in range(2):  # where there are points at all
        column, row = (np.floor((cloud.xyz[:, k] - low[k]) / side).astype(np.int64) for k in (0, 1))
        cells = np.unique(column + (row << 31))
        side = math.sqrt(_POINTS_PER_CELL * len(cells) * side**2 / len(cloud.xyz))
    step = 10.0 ** math.floor(math.log10(side)) / 2
    return max(0.001, math.ceil(side / step) * step)


def write_surface(cloud: Cloud, cell_m: float, path: Path) -> None:
    """Write the mean height of the points of each cell as a GeoTIFF; cells without points have none."""
    import rasterio

    low, high = cloud.xyz[:, :2].min(axis=0), cloud.xyz[:, :2].max(axis=0)
    # On whole multiples of the cell, so that clouds of one place share their cells.
    west, north = math.floor(low[0] / cell_m) * cell_m, math.ceil(high[1] / cell_m) * cell_m
    columns, rows = math.floor((high[0] - west) / cell_m) + 1, math.floor((north - low[1]) / cell_m) + 1
    if columns * rows > _MOST_POINTS:
        raise ChangeError(
            f"{cloud.path} has {columns} x {rows} cells of {cell_m} m: expected fewer; give a larger --cell"
        )
    grid = Grid(None, west, north, cell_m, columns, rows)
    at = np.floor((north - cloud.xyz[:, 1]) / cell_m).astype(np.int64).clip(0, rows - 1) * columns
    at += np.floor((cloud.xyz[:, 0] - west) / cell_m).astype(np.int64).clip(0, columns - 1)
    count = np.bincount(at, minlength=rows * columns)
    total = np.bincount(at, cloud.xyz[:, 2], rows * columns)
    heights = np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32).reshape(rows, columns)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=columns,
        height=rows,
        count=1,
        dtype="float32",
        nodata=math.nan,
        crs=horizontal(cloud.crs).to_wkt() if cloud.crs is not None else None,
        transform=grid.transform,
    ) as file:
        file.write(heights, 1)


def compare_clouds(
    earlier: Cloud,
    later: Cloud,
    spacing_m: float,
    registration: Registration,
    tick: Callable[[int, int], Any] | None = None,
    difference: tuple[Grid, Float32[np.ndarray, "rows columns"]] | None = None,
) -> Distances:
    """M3C2 at core points that are one point of the earlier cloud in each cell of a grid.

    Normals are of points within 3 spacings. Cylinders have a radius of 2 spacings and reach 10 spacings to either side,
    1 m at least, or half of that further than heights differ there.

    Args:
        difference: of the surfaces, with its grid of this spacing in the system of both clouds, metres.
        registration: moves the later cloud, in the system of both; the level of detection counts its error.
    """
    cells = np.floor(earlier.xyz[:, :2] / spacing_m).astype(np.int64)
    _, first = np.unique(cells - cells.min(axis=0), axis=0, return_index=True)
    cores = earlier.xyz[np.sort(first)]
    moved = registration.moved(later.xyz)
    # About the middle, so that large coordinates cost no digits.
    middle = cores.mean(axis=0).round()
    normals = fit_normals(earlier.xyz - middle, cores - middle, 3 * spacing_m)
    across = np.hypot(normals[:, 0], normals[:, 1])
    least = max(10 * spacing_m, 1.0)
    reach = np.full(len(cores), least)
    if difference is not None:
        grid, dz = difference
        # Of each place, so that a single mismatch on a slope does not make all cylinders long; they are 5 cells wide.
        sizes = maximum_filter(np.nan_to_num(np.abs(dz)), 5)
        reach = np.maximum(reach, values_at(sizes, grid, cores[:, :2], 0) + least / 2)
    found = m3c2(
        earlier.xyz - middle,
        moved - middle,
        cores - middle,
        normals,
        2 * spacing_m,
        reach,
        np.hypot(registration.deviation_at(cores), registration.shift_error_m * across),
        (earlier.sigma, later.sigma),
        tick,
    )
    return Distances(cores, normals, found.distance_m, found.detection_m, found.counts, found.deviations_m)


def write_distances(found: Distances, crs: CRS | None, path: Path) -> None:
    """Write distances as a LAZ file with the names that CloudCompare gives them."""
    laspy = need("laspy")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = found.cores.mean(axis=0).round(), np.full(3, 0.001)
    if crs is not None:
        header.add_crs(crs)
    values = {
        "M3C2_distance": found.distance_m,
        "uncertainty": found.detection_m,
        "significant": found.significant,
        "Npoints_cloud1": found.counts[:, 0],
        "Npoints_cloud2": found.counts[:, 1],
        "NormalX": found.normals[:, 0],
        "NormalY": found.normals[:, 1],
        "NormalZ": found.normals[:, 2],
    }
    for name in values:
        header.add_extra_dim(laspy.ExtraBytesParams(name, np.float32))
    las = laspy.LasData(header)
    las.x, las.y, las.z = found.cores.T
    for name, value in values.items():
        las[name] = value.astype(np.float32)
    las.write(str(path))
