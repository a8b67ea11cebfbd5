"""Terrain, hillshade, contours and sections of surfaces whose shapes are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import CRS
from shapely.geometry import LineString

from tidefield.geometry.geodesy import LocalFrame
from tidefield.maps import rasters
from tidefield.maps import terrain as terrain_module
from tidefield.maps.cloud import cloud_writer
from tidefield.maps.contours import contours, interval_of, read_reduced, write_contours
from tidefield.maps.grid import LOCAL_WKT, Grid, MapFrame
from tidefield.maps.rasters import Raster, raster_writer, read_raster
from tidefield.maps.sections import cut, draw, write_sections
from tidefield.maps.terrain import coarse_ground, hillshade, write_hillshade, write_terrain
from tidefield.maps.vectors import lost_in_geojson

rasterio = pytest.importorskip("rasterio")
pytest.importorskip("rasterio.fill")
LOCAL = MapFrame(None, np.zeros(3), np.eye(3), LOCAL_WKT, LOCAL_WKT, "local")
GRID = Grid(LOCAL, 10.0, 90.0, 0.1, 400, 300, 2.0)


def written(path: Path, values: np.ndarray, grid: Grid = GRID, nodata: float = -9999.0) -> Path:
    with raster_writer(Raster(path, ("values",)), grid) as writer:
        writer.write(0, np.where(np.isfinite(values), values, nodata)[None])
    return path


def ground() -> np.ndarray:
    """A slope with ripples."""
    y, x = np.mgrid[: GRID.rows, : GRID.columns] * GRID.cell
    return (2 + 0.03 * x - 0.02 * y + 0.03 * np.sin(x * 6)).astype(np.float32)


def test_what_geojson_loses_where_proj_lacks_a_grid_is_one_sentence(monkeypatch: pytest.MonkeyPatch):
    wkt = CRS("EPSG:27700").to_wkt()
    frame = LocalFrame.at("EPSG:27700", (351_200.0, 512_900.0, 260.0))
    there = MapFrame(frame, np.zeros(3), np.eye(3), wkt, wkt, "ODN")
    monkeypatch.setattr("tidefield.maps.vectors.lost_in_conversion", lambda *_: "are converted to 5 m only")
    assert "coordinates are converted to 5 m only" in str(lost_in_geojson(there))
    assert lost_in_geojson(LOCAL) is None
    monkeypatch.setattr("tidefield.maps.vectors.lost_in_conversion", lambda *_: None)
    assert lost_in_geojson(there) is None


def test_plants_are_taken_off_and_ripples_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    bare = ground()
    surface = bare.copy()
    random = np.random.default_rng(0)
    rows, columns = np.ogrid[: GRID.rows, : GRID.columns]
    plants, rims = np.zeros(bare.shape, bool), np.zeros(bare.shape, bool)
    for _ in range(40):
        row, column, radius = random.integers(20, 280), random.integers(20, 380), random.integers(2, 14)
        inside = (rows - row) ** 2 + (columns - column) ** 2 < radius**2
        surface[inside] = np.maximum(surface[inside], bare[inside] + 0.08 * radius + 0.2)
        plants |= inside
        rims |= (rows - row) ** 2 + (columns - column) ** 2 < (radius + 2) ** 2
    rims &= ~plants
    surface[:10, :50] = np.nan
    dsm = written(tmp_path / "dsm.tif", surface)
    sigma = written(tmp_path / "sigma.tif", np.full(bare.shape, 0.02))
    write_terrain(dsm, sigma, Raster(tmp_path / "dtm.tif", ("terrain",)), GRID)
    terrain = read_raster(tmp_path / "dtm.tif")[0]
    monkeypatch.setattr("tidefield.maps.terrain.ROWS", 64)
    write_terrain(dsm, sigma, Raster(tmp_path / "again.tif", ("terrain",)), GRID)
    np.testing.assert_array_equal(terrain, read_raster(tmp_path / "again.tif")[0])
    np.testing.assert_array_equal(np.isnan(terrain), np.isnan(surface))
    known = ~np.isnan(surface)
    # Ripples of 3 cm are a part of the ground, and lost below plants only.
    assert np.abs(terrain - bare)[known & ~plants & ~rims].max() < 1e-4
    assert np.abs(terrain - bare)[known & plants].mean() < 0.04
    assert np.percentile(np.abs(terrain - bare)[known & plants], 98) < 0.12


def test_rims_that_matching_widens_are_taken_off(tmp_path: Path):
    fine = replace(GRID, cell=0.03)
    rows, columns = np.ogrid[: GRID.rows, : GRID.columns]
    bare = (2 + 0.0006 * columns + 0.0003 * rows).astype(np.float32)
    away = np.hypot(rows - 150, columns - 200)
    # Beside the plant the surface is a little too high, not enough to be a plant itself.
    surface = bare + np.select([away < 30, away < 32], [0.8, 0.08], 0).astype(np.float32)
    dsm = written(tmp_path / "dsm.tif", surface, fine)
    sigma = written(tmp_path / "sigma.tif", np.full(bare.shape, 0.02), fine)
    write_terrain(dsm, sigma, Raster(tmp_path / "dtm.tif", ("terrain",)), fine)
    terrain = read_raster(tmp_path / "dtm.tif")[0]
    assert (terrain - bare)[(away >= 30) & (away < 32)].mean() < 0.03
    np.testing.assert_allclose(terrain[away > 38], bare[away > 38], atol=1e-5)


@pytest.mark.thorough
def test_the_terrain_of_a_long_coast_is_that_of_its_plane(tmp_path: Path):
    coast = replace(GRID, columns=33_000, rows=8)
    rows, columns = np.ogrid[: coast.rows, : coast.columns]
    plane = (2 + 1e-4 * columns + 1e-3 * rows).astype(np.float32)
    surface = plane.copy()
    surface[2:4, 20_000:20_004] += 0.5
    dsm = written(tmp_path / "dsm.tif", surface, coast)
    sigma = written(tmp_path / "sigma.tif", np.full(plane.shape, 0.02), coast)
    write_terrain(dsm, sigma, Raster(tmp_path / "dtm.tif", ("terrain",)), coast)
    np.testing.assert_allclose(read_raster(tmp_path / "dtm.tif")[0], plane, atol=0.01)


@pytest.mark.thorough
def test_the_terrain_of_a_strip_needs_no_search_over_all_of_the_empty_map_around_it(monkeypatch: pytest.MonkeyPatch):
    random = np.random.default_rng(0)
    y, x = np.mgrid[:150, :150]
    low = (5 + 0.01 * x + 0.3 * np.sin(x / 40)).astype(np.float32)
    for _ in range(40):  # plants, some at the strip's edges
        along, across, radius = random.integers(10, 140), random.integers(-20, 20), random.integers(2, 9)
        low[np.hypot(x - along, y - along - across) < radius] += 0.1 * radius
    strip = np.abs(x - y) < 20
    low[~strip] = np.nan
    distances, fillnodata = [], rasterio.fill.fillnodata

    def filled(*arguments: Any, max_search_distance: float) -> Any:
        distances.append(max_search_distance)
        return fillnodata(*arguments, max_search_distance=max_search_distance)

    monkeypatch.setattr(terrain_module, "WIDEST_M", 3.0)
    monkeypatch.setattr(rasterio.fill, "fillnodata", filled)
    found = []
    for searched in (1_000, 30):
        monkeypatch.setattr(terrain_module, "SEARCHED", searched)
        height, ground = coarse_ground(low, 0.25)
        found.append((height[strip], ground))
    assert distances == [1_000.0, 1_000.0, 30.0, 30.0]
    assert 0.3 < found[0][1][strip].mean() < 0.7
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
    # What has no ground within that distance looks for it farther away.
    monkeypatch.setattr(terrain_module, "SEARCHED", 4)
    plant = np.where(np.hypot(x - 75, y - 75) < 10, 6.0, 5.0).astype(np.float32)
    np.testing.assert_allclose(coarse_ground(plant, 0.25)[0], 5.0, atol=1e-5)
    assert distances[4:] == [4.0, 4.0, 8.0, 16.0]


@pytest.mark.parametrize(("cell", "scale"), [(0.05, 0.001), (0.0002, 1e-5)])
def test_points_of_a_local_frame_are_as_fine_as_its_cells(tmp_path: Path, cell: float, scale: float):
    laspy = pytest.importorskip("laspy")
    small = replace(GRID, cell=cell, columns=30, rows=20)
    values = {"height": np.full((20, 30), 2.0), "sigma": np.zeros((20, 30)), "views": np.full((20, 30), 3)}
    with cloud_writer(tmp_path / "cloud.laz", small) as writer:
        writer.write(0, **values, colour=np.zeros((3, 20, 30), np.uint8), classes=np.full((20, 30), 2))
    cloud = laspy.read(tmp_path / "cloud.laz")
    assert cloud.header.scales == pytest.approx(scale)
    assert len(np.unique(np.asarray(cloud.x).round(9))) == 30


def test_points_of_the_cloud_lie_at_the_centres_of_the_cells(tmp_path: Path):
    laspy = pytest.importorskip("laspy")
    small = replace(GRID, columns=3, rows=2)
    values = {"height": np.full((2, 3), 2.0), "sigma": np.zeros((2, 3)), "views": np.full((2, 3), 3)}
    with cloud_writer(tmp_path / "cloud.laz", small) as writer:
        writer.write(0, **values, colour=np.zeros((3, 2, 3), np.uint8), classes=np.full((2, 3), 2))
    cloud = laspy.read(tmp_path / "cloud.laz")
    assert np.asarray(cloud.x) == pytest.approx([10.05, 10.15, 10.25] * 2, abs=1e-6)
    assert np.asarray(cloud.y) == pytest.approx([89.95] * 3 + [89.85] * 3, abs=1e-6)


def test_hillshade_is_that_of_a_plane():
    y, x = np.mgrid[:20, :20].astype(float)
    slope = hillshade(0.5 * x, 1.0)[5:15, 5:15]  # rises to the east
    normal = np.array([-0.5, 0, 1]) / np.sqrt(1.25)
    sun = np.array([-0.5, 0.5, np.sqrt(0.5)])
    np.testing.assert_allclose(slope, normal @ sun, atol=1e-6)
    assert hillshade(0.0 * y, 1.0).mean() == pytest.approx(np.sqrt(0.5))


def test_cells_next_to_holes_are_shaded_as_their_own_slope(tmp_path: Path):
    _, x = np.mgrid[:20, :20].astype(float)
    slope = 0.5 * x
    slope[5:9, 5:9] = np.nan
    shade = hillshade(slope, 1.0)
    rim = shade[4, 5:9], shade[9, 5:9]
    np.testing.assert_allclose(rim, hillshade(0.5 * x, 1.0)[4, 5], atol=1e-6)
    assert np.isfinite(shade[np.isfinite(slope)]).all()


def test_terrain_and_hillshade_of_a_map_in_feet_are_those_of_the_map_in_metres(tmp_path: Path):
    """A plant and a low mound, with all in metres, lengths alone in feet, and heights alone in feet."""
    foot = 1200 / 3937
    lengths = replace(LOCAL, metre=1 / foot, metre_up=1.0)
    in_feet = replace(GRID, frame=lengths, west=GRID.west / foot, north=GRID.north / foot, cell=GRID.cell / foot)
    tall = replace(GRID, frame=replace(LOCAL, metre=1.0, metre_up=1 / foot))
    rows, columns = np.ogrid[: GRID.rows, : GRID.columns]
    plant, mound = (np.hypot(rows - 150, columns - middle) < 10 for middle in (100, 300))
    surface, found = (ground() + 1.0 * plant + 0.2 * mound).astype(np.float32), []
    for number, (grid, scale) in enumerate([(GRID, 1.0), (in_feet, 1.0), (tall, 1 / foot)]):
        folder = tmp_path / str(number)
        folder.mkdir()
        dsm = written(folder / "dsm.tif", surface * scale, grid)
        sigma = written(folder / "sigma.tif", np.full(surface.shape, 0.02 * scale), grid)
        write_terrain(dsm, sigma, Raster(folder / "dtm.tif", ("terrain",)), grid)
        write_hillshade(dsm, Raster(folder / "shade.tif", ("shade",), "uint8", 0.0), grid)
        found.append((read_raster(folder / "dtm.tif")[0] / scale, read_raster(folder / "shade.tif")[0]))
    (terrain, shade), *others = found
    assert (surface - terrain)[plant].mean() > 0.9, "the plant is taken off"
    assert 0.02 < (surface - terrain)[mound].mean() < 0.18, "the mound is partly ground: it shows every limit"
    for other_terrain, other_shade in others:
        np.testing.assert_allclose(other_terrain, terrain, atol=1e-4)
        np.testing.assert_allclose(other_shade, shade, atol=1)


def test_the_hillshade_s_strips_have_no_seams(tmp_path: Path):
    tall = Grid(LOCAL, 0.0, 90.0, 0.1, 64, 1100, 2.0)
    y, x = np.mgrid[:1100, :64] * 0.1
    values = (np.sin(x) + np.cos(0.7 * y)).astype(np.float32)
    dsm = written(tmp_path / "dsm.tif", values, tall)
    write_hillshade(dsm, Raster(tmp_path / "shade.tif", ("shade",), "uint8", 0.0), tall)
    shade = read_raster(tmp_path / "shade.tif")[0]
    np.testing.assert_allclose(shade, np.round(1 + 254 * hillshade(values, 0.1)), atol=1)


def test_contours_of_a_cone_are_circles_at_their_heights():
    y, x = np.mgrid[: GRID.rows, : GRID.columns] * GRID.cell
    cone = np.hypot(x - 20, y - 15).astype(np.float32)
    lines = contours(cone, GRID, 1.0, smooth_cells=0.5)
    assert {height for height, _ in lines} >= {2.0, 5.0, 10.0}
    middle = np.array([GRID.west + 20.05, GRID.north - 15.05])
    for height, line in lines:
        if 2 <= height <= 12:
            radius = np.linalg.norm(np.asarray(line.coords) - middle, axis=1)
            np.testing.assert_allclose(radius, height, atol=0.05)


def test_the_interval_is_round_and_large_maps_are_reduced(tmp_path: Path):
    assert interval_of(np.linspace(0, 10, 100, dtype=np.float32).reshape(10, 10)) == 0.5
    assert interval_of(np.full((10, 10), 2.0, np.float32)) == 0.01
    assert interval_of(np.full((10, 10), 2.0, np.float32), scale=3.28) == pytest.approx(0.05)
    large = Grid(LOCAL, 0.0, 0.0, 0.1, 2002, 2001, 0.0)
    y, x = np.mgrid[: large.rows, : large.columns].astype(np.float32)
    small, grid = read_reduced(written(tmp_path / "large.tif", x + 3 * y, large), large)
    assert small.shape == (grid.rows, grid.columns) == (1000, 1001)
    assert grid.cell == pytest.approx(0.2)
    assert small[0, 0] == pytest.approx(0.5 + 1.5)
    assert small[-1, -1] == pytest.approx(2000.5 + 3 * 1998.5)
    ragged = np.where(np.hypot(x - 1000, y - 1000) < 500 + 300 * np.sin(x / 7), x + 3 * y, np.nan)
    small, _ = read_reduced(written(tmp_path / "ragged.tif", ragged, large), large)
    quarters = ragged[:2000].reshape(1000, 2, 1001, 2).swapaxes(1, 2).reshape(1000, 1001, 4)
    known = np.isfinite(quarters)
    exact = np.where(known, quarters, 0).sum(-1) / known.sum(-1).clip(1)
    assert (np.isfinite(small) == known.any(-1)).all()
    np.testing.assert_allclose(small[known.any(-1)], exact[known.any(-1)], rtol=1e-5)


def test_contours_are_read_again_by_gdal_and_in_longitude_and_latitude(tmp_path: Path):
    pyogrio = pytest.importorskip("pyogrio")
    frame = LocalFrame.at("EPSG:27700", (351_200.0, 512_900.0, 260.0))
    wkt = CRS.from_epsg(27700).to_wkt()
    there = MapFrame(frame, np.zeros(3), np.eye(3), wkt, wkt, "unknown")
    line = LineString([(351_200, 512_900), (351_210, 512_905), (351_220, 512_900)])
    write_contours([(261.5, line)], there, tmp_path)
    paths = [tmp_path / f"contours.{suffix}" for suffix in ("gpkg", "geojson", "dxf")]
    for path, epsg in zip(paths, (27700, 4326, None), strict=True):
        about = pyogrio.read_info(path)
        if epsg is not None:
            assert about["features"] == 1
            assert CRS.from_user_input(about["crs"]).to_epsg() == epsg
    x, y = json.loads(paths[1].read_text())["features"][0]["geometry"]["coordinates"][0]
    assert frame.from_geographic(np.array([[x, y, 260.0]]))[0, :2] == pytest.approx([0, 0], abs=1e-2)
    _, _, shapes, _ = pyogrio.raw.read(paths[2])
    import shapely

    assert shapely.from_wkb(shapes[0]).coords[1] == pytest.approx((351_210, 512_905, 261.5))


def test_sections_interpolate_and_end_where_the_map_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    y, x = np.mgrid[: GRID.rows, : GRID.columns] + 0.5
    plane = (0.1 * (GRID.west + x * GRID.cell) - 0.2 * (GRID.north - y * GRID.cell)).astype(np.float32)
    dsm, sigma = written(tmp_path / "dsm.tif", plane), written(tmp_path / "sigma.tif", np.full(plane.shape, 0.5))
    line = LineString([(20.03, 70.01), (30.0, 80.0), (70.0, 80.0)])
    for block in (512, 64):
        monkeypatch.setattr(rasters, "BLOCK", block)
        [section] = cut([(line, "creek, mouth")], dsm, sigma, GRID)
        known = np.isfinite(section.height)
        truth = 0.1 * section.place[:, 0] - 0.2 * section.place[:, 1]
        np.testing.assert_allclose(section.height[known], truth[known], atol=1e-4)
        assert known[section.place[:, 0] < 49.9].all()
        assert not known[section.place[:, 0] > 50].any()
    write_sections([section], tmp_path, "US survey foot", "m")
    table, plot = tmp_path / "sections.csv", tmp_path / "sections.svg"
    first = table.read_text().splitlines()[1]
    assert first.startswith('"creek, mouth",0.000,20.030,70.010,')
    low, height, high = (float(first.rsplit(",", 4)[k]) for k in (3, 1, 4))
    assert (height - low, high - height) == (pytest.approx(0.98, abs=1e-3), pytest.approx(0.98, abs=1e-3))
    assert plot.read_text().lstrip().startswith("<?xml")
    assert len(draw([section] * 30, "m", "m").axes) == 24
    # Names are texts: no formulas to spreadsheets, no mathematics to the plot.
    write_sections([replace(section, name='=HYPERLINK("a$^$b")')], tmp_path, "m", "m")
    assert table.read_text().splitlines()[1].startswith("\"'=HYPERLINK(")
    assert plot.read_text().lstrip().startswith("<?xml")
