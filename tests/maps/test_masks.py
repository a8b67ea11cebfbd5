"""Plants and water of maps whose shapes are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely

from tidefield.maps import contours, masks, terrain
from tidefield.maps.classes import GROUND, VEGETATION, WATER
from tidefield.maps.grid import LOCAL_WKT, Grid, MapFrame
from tidefield.maps.masks import (
    _grown,
    _Signs,
    excess_green,
    find_water,
    level_water,
    read_water,
    write_classes,
    write_masks,
)
from tidefield.maps.rasters import Raster, raster_writer, read_raster

pytest.importorskip("rasterio")
LOCAL = MapFrame(None, np.zeros(3), np.eye(3), LOCAL_WKT, LOCAL_WKT, "local")
GRID = Grid(LOCAL, 10.0, 90.0, 0.05, 300, 240, 2.0)
LEVEL = 2.1
NOISE = 0.006


def flat() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A basin, of which water fills what lies below `LEVEL`: heights, agreement, and where water is."""
    y, x = np.mgrid[: GRID.rows, : GRID.columns] * GRID.cell
    ground = 2.0 + 0.02 * ((x - 7) ** 2 + (y - 6) ** 2)
    random = np.random.default_rng(3)
    wet = ground < LEVEL
    height = np.maximum(ground, LEVEL) + NOISE * random.standard_normal(ground.shape)
    return height.astype(np.float32), np.where(wet, 0.05, 0.4).astype(np.float32), wet


def test_water_and_its_level_are_found():
    height, agreement, wet = flat()
    plants = np.zeros(wet.shape, bool)
    labels, [body] = find_water(height, agreement, plants, GRID)
    assert ((labels > 0) & wet).sum() / ((labels > 0) | wet).sum() > 0.85
    assert abs(body.level - LEVEL) < 0.004
    assert 0 < body.sigma < NOISE
    # Photographs that agree, fewer than two, or no level surface, are no water.
    assert not find_water(height, np.full_like(agreement, 0.4), plants, GRID)[1]
    assert not find_water(height, np.where(wet, np.float32(np.nan), agreement), plants, GRID)[1]
    _, x = np.mgrid[: GRID.rows, : GRID.columns] * GRID.cell
    assert not find_water((height + 0.1 * x).astype(np.float32), agreement, plants, GRID)[1]


def test_level_ground_with_lower_ground_beside_it_is_no_water():
    height, agreement, wet = flat()
    _, x = np.mgrid[: GRID.rows, : GRID.columns] * GRID.cell
    height = np.where(x < 7, height, LEVEL - 0.5 * np.maximum(x - 7, 0)).astype(np.float32)
    assert not find_water(height, agreement, ~wet & (x < 7), GRID)[1]


def test_a_lake_goes_on_to_the_edge_of_the_map_and_a_blotch_is_no_shore():
    random = np.random.default_rng(5)
    height = (LEVEL + NOISE * random.standard_normal((GRID.rows, GRID.columns))).astype(np.float32)
    height[100:112, 288:] -= 0.3
    nowhere, blank = np.zeros(height.shape, bool), np.full_like(height, 0.05)
    labels, [body] = find_water(height, blank, nowhere, GRID)
    assert abs(body.level - LEVEL) < 0.004
    corners = labels[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert (corners == 1).all()
    assert (labels > 0).mean() > 0.97


def test_small_lower_places_that_water_surrounds_are_water_and_large_ones_are_not():
    random = np.random.default_rng(6)
    level = (LEVEL + NOISE * random.standard_normal((GRID.rows, GRID.columns))).astype(np.float32)
    nowhere, blank = np.zeros(level.shape, bool), np.full_like(level, 0.05)
    y, x = np.mgrid[: GRID.rows, : GRID.columns] * GRID.cell
    blotches = (np.hypot(y % 2.4 - 1.2, x % 2.4 - 1.2) < 0.3).astype(np.float32)
    labels, [_] = find_water(level - 0.3 * blotches, blank, nowhere, GRID)
    assert (labels > 0).mean() > 0.97
    pool = (np.hypot(y - GRID.rows * GRID.cell / 2, x - GRID.columns * GRID.cell / 2) < 2).astype(np.float32)
    assert not find_water(level - 0.3 * pool, np.where(pool > 0, 0.4, blank).astype(np.float32), nowhere, GRID)[1]


def test_a_body_is_found_whole_however_far_it_reaches_from_where_it_was_seen():
    lake = np.zeros((500, 600), bool)
    lake[20:420, 100:] = True
    lake[450:460, 300:310] = True
    level, seeds = np.zeros(lake.shape, np.float32), np.zeros(lake.shape, np.int32)
    seeds[200:210, 300:305] = 1
    seeds[450:460, 300:310] = 2
    agreement = np.where(lake, 0.2, 0.9).astype(np.float32)
    signs = _Signs(level, level, agreement, np.ones_like(lake), seeds, 0.05)
    assert signs.reach == 7
    near = slice(172, 238), slice(272, 333)
    assert signs.body(near, 1, 0.0, 0.1).all()
    window, body = _grown(signs, (slice(200, 210), slice(300, 305)), 1, 0.0, 0.1)
    rounded = 2 * 3  # cells at the lake's western corners, which the opening takes off
    assert lake[:430].sum() - body.sum() == rounded
    assert window[1].stop == 600  # it goes on to the edge of the map
    small, _ = _grown(signs, (slice(450, 460), slice(300, 310)), 2, 0.0, 0.1)
    assert small == (slice(422, 488), slice(272, 338))


def test_plants_are_green_and_black_is_not():
    colour = np.zeros((3, 20, 20), np.uint8)
    colour[:, :, 10:] = np.array([70, 110, 50], np.uint8)[:, None, None]
    green = excess_green(colour)
    assert (green[:, :5] == 0).all()
    np.testing.assert_allclose(green[:, 15:], 100 / 230, atol=1e-3)


@pytest.mark.parametrize(("most", "rows"), [(4_000_000, 512), (4_000_000, 50), (5_000, 50)])
def test_classes_polygons_and_waterline_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, rows: int
):
    pyogrio = pytest.importorskip("pyogrio")
    monkeypatch.setattr(contours, "MOST_CELLS", most)
    monkeypatch.setattr(terrain, "ROWS", rows)
    height, agreement, wet = flat()
    height[:20, :30] = np.nan
    height[116:118, 136:138] += 0.5  # a post in the water
    plants = np.zeros(wet.shape, bool)
    plants[200:220, 200:230] = True
    colour = np.where(plants, np.array([70, 110, 50])[:, None, None], np.array([120, 110, 90])[:, None, None])
    known = np.isfinite(height)
    for name, kind, nodata, bands in (
        ("dsm", "float32", -9999.0, np.where(known, height, -9999)[None]),
        ("sigma", "float32", -9999.0, np.where(known, 0.02, -9999)[None]),
        ("agreement", "uint8", 255.0, np.where(known, 100 * agreement, 255)[None]),
        ("colour", "uint8", None, np.concatenate([colour, 255 * known[None]])),
    ):
        names = ("red", "green", "blue", "alpha") if nodata is None else (name,)
        with raster_writer(Raster(tmp_path / f"{name}.tif", names, kind, nodata), GRID) as writer:
            writer.write(0, bands)
    water = read_water(tmp_path / "dsm.tif", tmp_path / "agreement.tif", tmp_path / "colour.tif", GRID)
    out = Raster(tmp_path / "classes.tif", ("class",), "uint8", 0.0, average=False)
    write_classes(out, tmp_path / "dsm.tif", tmp_path / "colour.tif", water, GRID)
    classes = read_raster(tmp_path / "classes.tif")[0]
    assert np.isnan(classes[:20, :30]).all()
    for value, true in ((GROUND, ~wet & ~plants & known), (VEGETATION, plants), (WATER, wet & ~plants)):
        assert ((classes == value) & true).sum() / ((classes == value) | true).sum() > 0.7
    rasters = [Raster(tmp_path / f"{name}.tif", (name,)) for name in ("dsm", "sigma")]
    level_water(*rasters, tmp_path / "classes.tif", water, GRID)
    levelled, errors = (read_raster(raster.path)[0] for raster in rasters)
    lake, post = classes == WATER, np.s_[116:118, 136:138]
    lake[post] = False
    [body] = water[1]
    np.testing.assert_array_equal(levelled[lake], np.float32(body.level))
    np.testing.assert_array_equal(errors[lake], np.float32(body.sigma))
    np.testing.assert_array_equal(levelled[~lake], height[~lake])
    assert (errors[~lake & known] == np.float32(0.02)).all()
    assert np.isnan(errors[~known]).all()
    write_masks(tmp_path / "classes.tif", tmp_path / "agreement.tif", water, GRID, tmp_path / "masks")
    assert {name for name, _ in pyogrio.list_layers(tmp_path / "masks" / "masks.gpkg")} == {
        "vegetation",
        "water",
        "waterline",
    }
    for name, area in (("vegetation", plants.sum()), ("water", (wet & ~plants).sum())):
        features = json.loads((tmp_path / "masks" / f"{name}.geojson").read_text())["features"]
        found = sum(shapely.geometry.shape(f["geometry"]).area for f in features)
        assert found == pytest.approx(area * GRID.cell**2, rel=0.15)
    [line] = json.loads((tmp_path / "masks" / "waterline.geojson").read_text())["features"]
    assert line["properties"]["height"] == pytest.approx(LEVEL, abs=0.005)
    assert 0 < line["properties"]["sigma"] < 0.01
    # A circle of radius sqrt(0.1 / 0.02), the staircase of the cells included.
    assert shapely.geometry.shape(line["geometry"]).length == pytest.approx(2 * np.pi * np.sqrt(5), rel=0.35)


def test_a_waterline_ends_where_the_map_ends():
    grid = replace(GRID, columns=100)
    body = masks.Body(1.0, 0.01, 0.03, 10.0)
    west, south, east, north = grid.bounds
    lake = shapely.box(west, south, (west + east) / 2, north)
    everywhere = np.ones((grid.rows, grid.columns), bool)
    layer = masks._waterline([(lake, body)], ~everywhere, grid)
    [line] = layer.shapes
    assert line.length == pytest.approx(north - south, rel=0.05)
    # Photographs see the lake down to a line across it: below that it has no surface, and no shore there.
    seen = everywhere.copy()
    seen[grid.rows // 2 :] = False
    lake = shapely.box(west, (south + north) / 2, (west + east) / 2, north)
    [line] = masks._waterline([(lake, body)], ~seen, grid).shapes
    assert line.length == pytest.approx((north - south) / 2, rel=0.05)
    assert np.ptp(shapely.get_coordinates(line)[:, 0]) == 0
