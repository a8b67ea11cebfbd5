"""Point clouds of whatever system, in true metres, and moved as the registration says."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import CRS, Transformer

from tidefield.change.clouds import (
    Cloud,
    compare_clouds,
    default_cell,
    in_system,
    read_cloud,
    write_distances,
    write_surface,
)
from tidefield.change.inputs import open_pair
from tidefield.change.registration import Registration
from tidefield.change.surfaces import ChangeError, Grid, open_surface, other_datums

US_FOOT = 1200 / 3937
EAST, NORTH = 1_830_000.0, 646_000.0
"""A place in California, zone 3 of the state's plane coordinates, in metres."""


def write_cloud(path: Path, crs: str, xyz: np.ndarray, sigma: np.ndarray | None = None) -> Path:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_crs(CRS(crs))
    header.offsets, header.scales = xyz.mean(axis=0).round(), np.full(3, 0.001)
    if sigma is not None:
        header.add_extra_dim(laspy.ExtraBytesParams("sigma_z", np.float32))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    if sigma is not None:
        las["sigma_z"] = sigma.astype(np.float32)
    las.write(str(path))
    return path


def write_old_cloud(path: Path, xyz: np.ndarray, keys: dict[int, int]) -> Path:
    """A LAS 1.2 file with these GeoTIFF keys."""
    laspy = pytest.importorskip("laspy")
    from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct

    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = xyz.mean(axis=0).round(), np.full(3, 0.001)
    directory = GeoKeyDirectoryVlr()
    directory.geo_keys = [GeoKeyEntryStruct(key, 0, 1, value) for key, value in keys.items()]
    directory.geo_keys_header.number_of_keys = len(keys)
    header.vlrs.append(directory)
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.write(str(path))
    return path


def square(rng: np.random.Generator, size_m: float, count: int = 2000) -> np.ndarray:
    """Points of a level square, the first four at its corners."""
    xy = np.concatenate([size_m * np.array([[0, 0], [0, 1], [1, 0], [1, 1]]), rng.uniform(0, size_m, (count, 2))])
    return np.column_stack([xy, np.zeros(len(xy))])


def registration(**changes: Any) -> Registration:
    """One that moves nothing, with changes."""
    none = (0.0, 0.0, 0.0)
    plain = {"model": "none", "coefficients": none, "covariance": np.zeros((3, 3)), "centre_m": (0.0, 0.0)}
    return Registration(**{**plain, "stable_cells": 100, "before": none, "after": none, **changes})


def test_feet_become_metres_of_the_utm_zone(tmp_path: Path):
    xyz = square(np.random.default_rng(0), 100.0) + np.array([EAST, NORTH, 30.0])
    path = write_cloud(tmp_path / "a.laz", "EPSG:2227+6360", xyz / US_FOOT, np.full(len(xyz), 0.1))
    cloud = read_cloud(path)
    assert cloud.crs is not None
    assert cloud.crs.to_epsg() == 26910
    expected = Transformer.from_crs("EPSG:2227", "EPSG:26910", always_xy=True).transform(*(xyz[:, :2] / US_FOOT).T)
    assert np.abs(cloud.xyz[:, :2] - np.stack(expected, axis=1)).max() < 0.001
    assert cloud.xyz[:, 2] == pytest.approx(30, abs=0.001)
    assert cloud.sigma == pytest.approx(0.1 * US_FOOT)
    write_surface(cloud, 10.0, tmp_path / "a.tif")
    written = open_surface(tmp_path / "a.tif")
    assert written.crs is not None
    assert written.crs.to_epsg() == 26910


@pytest.mark.parametrize(
    ("keys", "unit", "datum", "remarked"),
    [
        ({4096: 6360}, US_FOOT, "North American Vertical Datum 1988", False),
        ({4096: 5703, 4099: 9003}, US_FOOT, "North American Vertical Datum 1988", False),
        ({4096: 5103, 4099: 9002}, 0.3048, None, False),
        ({4099: 9001}, 1.0, None, False),
        ({}, 1.0, None, True),
    ],
)
def test_old_files_state_the_unit_of_their_heights_in_keys(
    tmp_path: Path, keys: dict[int, int], unit: float, datum: str | None, remarked: bool
):
    xyz = square(np.random.default_rng(0), 100.0) + np.array([980_000.0, 200_000.0, 10.0])
    paths = [write_old_cloud(tmp_path / name, xyz, {1024: 1, 3072: 2263, **keys}) for name in ("a.las", "b.las")]
    cloud = read_cloud(paths[0])
    assert cloud.xyz[:, 2] == pytest.approx(10 * unit, abs=1e-3)
    assert cloud.vertical_datum == datum
    found = open_pair(paths[0], paths[1], tmp_path)
    for name, survey in (("a.las", found.earlier), ("b.las", found.later)):
        assert any(name in remark and "US survey foot" in remark for remark in survey.remarks) == remarked


def test_a_projection_of_its_own_is_not_taken_for_degrees(tmp_path: Path):
    xyz = square(np.random.default_rng(0), 100.0) + np.array([980_000.0, 200_000.0, 10.0])
    keys = {1024: 1, 2048: 4269, 3072: 32767, 3076: 9003, 4099: 9003}
    cloud = read_cloud(write_old_cloud(tmp_path / "a.las", xyz, keys))
    assert cloud.crs is None
    assert np.abs(cloud.xyz - US_FOOT * xyz).max() < 0.001
    assert "projected system of its own" in cloud.remarks[0]
    assert "multiplied by 0.304801 to be metres" in cloud.remarks[1]
    with pytest.raises(ChangeError, match="degrees"):
        read_cloud(write_old_cloud(tmp_path / "b.las", xyz * [1e-4, 1e-4, 1], {1024: 2, 2048: 4269}))


@pytest.mark.parametrize("keys", [{3076: 9003}, {1024: 1, 3076: 9003}])
def test_a_plan_in_feet_without_a_system_is_remarked(tmp_path: Path, keys: dict[int, int]):
    xyz = square(np.random.default_rng(0), 100.0) + np.array([980_000.0, 200_000.0, 10.0])
    cloud = read_cloud(write_old_cloud(tmp_path / "a.las", xyz, keys))
    assert np.abs(cloud.xyz - [US_FOOT, US_FOOT, 1] * xyz).max() < 0.001
    assert len(cloud.remarks) == 1
    assert "a.las are multiplied by 0.304801 to be metres; heights without a unit are taken as" in cloud.remarks[0]


def test_a_geocentric_cloud_is_refused(tmp_path: Path):
    xyz = square(np.random.default_rng(0), 100.0) + np.array([3_871_000.0, 400_000.0, 5_035_000.0])
    with pytest.raises(ChangeError, match=r"is geocentric, without heights \(WGS 84\): expected a projected system"):
        read_cloud(write_cloud(tmp_path / "a.laz", "EPSG:4978", xyz))


def test_withheld_points_are_not_used(tmp_path: Path):
    laspy = pytest.importorskip("laspy")
    xyz = square(np.random.default_rng(0), 100.0) + np.array([450_000.0, 5_930_000.0, 2.0])
    xyz[:100, 2] = 900
    las = laspy.read(write_cloud(tmp_path / "a.laz", "EPSG:25832", xyz))
    las.withheld = np.arange(len(xyz)) < 100
    las.write(tmp_path / "b.laz")
    assert read_cloud(tmp_path / "b.laz").xyz[:, 2].max() == pytest.approx(2, abs=0.001)


def test_points_of_noise_and_of_water_are_not_used(tmp_path: Path):
    laspy = pytest.importorskip("laspy")
    heights = {2: 1.0, 1: 2.0, 7: 50.0, 18: 60.0, 9: 0.0}
    xyz = np.array([[400_000.0 + k, 5_700_000.0, height] for k, height in enumerate(heights.values())])
    las = laspy.read(write_cloud(tmp_path / "a.laz", "EPSG:32630", xyz))
    las.classification = np.array(list(heights), np.uint8)
    las.write(tmp_path / "b.laz")
    assert read_cloud(tmp_path / "b.laz").xyz[:, 2] == pytest.approx([1, 2], abs=0.002)


def test_the_surface_of_a_cloud_lies_where_its_points_do(tmp_path: Path):
    rasterio = pytest.importorskip("rasterio")
    xyz = np.array([[0.5, 0.5, 1.0], [0.7, 0.4, 3.0], [3.5, 2.5, 7.0]])
    write_surface(Cloud(Path("a.laz"), None, xyz, None), 1.0, tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as file:
        heights = file.read(1)
        assert heights[file.index(0.5, 0.5)] == 2.0, "the mean of the two points in one cell"
        assert heights[file.index(3.5, 2.5)] == 7.0
    assert np.isfinite(heights).sum() == 2


@pytest.mark.parametrize(("size_m", "count", "cell_m"), [(40, 12_000, 1.5), (30, 17_000, 0.75), (60, 4_000, 3.5)])
def test_a_cell_has_ten_points_or_little_more(size_m: float, count: int, cell_m: float):
    xyz = square(np.random.default_rng(0), float(size_m), count)
    assert default_cell(Cloud(Path("a.laz"), None, xyz, None)) == pytest.approx(cell_m)


def test_distances_of_clouds_in_feet_are_written_where_the_clouds_are(tmp_path: Path):
    laspy = pytest.importorskip("laspy")
    rng = np.random.default_rng(0)
    place = np.array([EAST, NORTH, 30.0])
    early, late = (square(rng, 20.0) + place for _ in range(2))
    clouds = [
        read_cloud(write_cloud(tmp_path / f"{name}.laz", "EPSG:2227+6360", (xyz + np.array([0, 0, up])) / US_FOOT))
        for name, xyz, up in (("early", early, 0.0), ("late", late, 0.5))
    ]
    found = compare_clouds(clouds[0], clouds[1], 1.0, registration())
    write_distances(found, clouds[0].crs, tmp_path / "m3c2.laz")
    written = laspy.read(tmp_path / "m3c2.laz")
    assert written.header.parse_crs().to_epsg() == 26910
    place = Transformer.from_crs("EPSG:26910", "EPSG:2227", always_xy=True)
    x, y = place.transform(np.asarray(written.x), np.asarray(written.y))
    assert [x.min() * US_FOOT - EAST, y.min() * US_FOOT - NORTH] == pytest.approx([0, 0], abs=1.0)
    assert np.nanmedian(written["M3C2_distance"]) == pytest.approx(0.5, abs=0.001)


def test_a_square_of_web_mercator_has_the_area_of_the_ground(tmp_path: Path):
    x, y = Transformer.from_crs("EPSG:25832", "EPSG:3857", always_xy=True).transform(450_000.0, 5_930_000.0)
    xyz = square(np.random.default_rng(0), 100.0) + np.array([x, y, 2.0])
    cloud = read_cloud(write_cloud(tmp_path / "a.laz", "EPSG:3857", xyz))
    assert np.ptp(cloud.xyz[:, 0]) == pytest.approx(100 / 1.68, rel=0.02)


def test_clouds_over_different_zeros_are_refused(tmp_path: Path):
    xyz = square(np.random.default_rng(0), 20.0) + np.array([450_000.0, 5_930_000.0, 2.0])
    one = write_cloud(tmp_path / "a.laz", "EPSG:25832+7837", xyz)
    other = write_cloud(tmp_path / "b.laz", "EPSG:25832+5783", xyz)
    with pytest.raises(ChangeError, match=r"a\.laz.*b\.laz.*one vertical datum"):
        open_pair(one, other, tmp_path)


def test_clouds_over_two_ellipsoids_are_remarked_and_refused_without_registration(tmp_path: Path):
    xyz = square(np.random.default_rng(0), 20.0) + np.array([450_000.0, 5_930_000.0, 2.0])
    one, other = (
        write_cloud(tmp_path / f"{name}.laz", CRS(system).to_3d().to_wkt(), xyz)
        for name, system in (("a", "EPSG:32632"), ("b", "EPSG:25832"))
    )
    found = open_pair(one, other, tmp_path)
    assert "the ellipsoid of WGS 84 and the ellipsoid of ETRS89" in (other_datums(found.earlier, found.later) or "")
    with pytest.raises(ChangeError, match=r"a\.laz.*b\.laz.*one vertical datum"):
        open_pair(one, other, tmp_path, registered=False)


def test_one_cloud_without_a_system_is_refused():
    bare = Cloud(Path("a.laz"), None, np.zeros((3, 3)), None)
    with pytest.raises(ChangeError, match=r"a\.laz has no coordinate system"):
        in_system(bare, CRS("EPSG:25832"))


def test_distances_larger_than_ten_cells_are_measured():
    """The planes are 1.5 m apart, where ten cells and the least reach are 1 m."""
    rng, grid = np.random.default_rng(0), Grid(None, 0.0, 4.0, 0.1, 40, 40)
    early, late = (
        Cloud(Path("a.laz"), None, square(rng, 4.0, 8000) + np.array([0, 0, up]), None) for up in (0.0, -1.5)
    )
    early.xyz[:, 2] += rng.normal(0, 0.05, len(early.xyz))
    dz = np.full(grid.shape, -1.5, np.float32)
    dz[20:, 20:] = np.nan
    found = compare_clouds(early, late, 0.1, registration(), difference=(grid, dz))
    inner = (np.abs(found.cores[:, :2] - 2) < 1.5).all(axis=1)
    unknown = inner & (found.cores[:, 0] > 2.3) & (found.cores[:, 1] < 1.7)
    differs = inner & ~((found.cores[:, 0] > 2.1) & (found.cores[:, 1] < 1.9))
    assert np.isfinite(found.distance_m[differs]).mean() > 0.99
    assert np.nanmedian(found.distance_m[differs]) == pytest.approx(-1.5, abs=0.02)
    assert np.isnan(found.distance_m[unknown]).all(), "nothing differs there by the surfaces"


def test_the_later_cloud_is_moved_by_the_whole_registration():
    rng, slope = np.random.default_rng(0), np.array([0.3, 0.0])
    early, late = square(rng, 40.0, 8000), square(rng, 40.0, 8000)
    # What the later survey shows: the same slope, shifted to the west, raised and tilted.
    early[:, 2] = early[:, :2] @ slope
    late[:, 2] = (late[:, :2] + np.array([0.4, 0.0])) @ slope + 0.2 + 0.01 * (late[:, 0] + 0.4 - 20)
    covariance = np.diag([0.03**2, 0.002**2, 0.0])
    moves = registration(
        coefficients=(0.2, 0.01, 0.0),
        covariance=covariance,
        centre_m=(20.0, 20.0),
        shift_m=(0.4, 0.0),
        shift_error_m=0.05,
    )
    clouds = [Cloud(Path("a.laz"), None, xyz, None) for xyz in (early, late)]
    found = compare_clouds(clouds[0], clouds[1], 1.0, moves)
    inner = (np.abs(found.cores[:, :2] - 20) < 15).all(axis=1)
    assert np.abs(found.distance_m[inner]).max() < 0.01
    exact = replace(moves, covariance=np.zeros((3, 3)), shift_error_m=0.0)
    alone = compare_clouds(clouds[0], clouds[1], 1.0, exact)
    added = (found.detection_m - alone.detection_m)[inner]
    across = np.hypot(found.normals[inner, 0], found.normals[inner, 1])
    vertical = np.hypot(0.03, 0.002 * (found.cores[inner, 0] - 20))
    assert added == pytest.approx(1.96 * np.hypot(vertical, 0.05 * across))
