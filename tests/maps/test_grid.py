"""Cells, tiles and their coordinates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
import textured_wall as wall
import torch
from pyproj import CRS

from tidefield.data.georeference import Georeference, Residuals
from tidefield.errors import RunError
from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.similarity import Similarity
from tidefield.maps.grid import Grid, MapFrame, _vertical, feather, ground_sampling_distance, map_frame
from tidefield.maps.make import Job
from tidefield.maps.orthophoto import camera_above
from tidefield.maps.surface import Start

FRAME = LocalFrame.at("EPSG:27700", (351_200.0, 512_900.0, 260.0))


def grid(columns: int = 1000, rows: int = 700, cell: float = 0.05) -> Grid:
    frame = MapFrame(FRAME, np.array([3.0, -4.0, 50.0]), np.eye(3), "", "", "")
    return Grid(frame, 351_180.0, 512_930.0, cell, columns, rows, 255.0)


def test_a_tile_s_affine_function_is_that_of_the_projection():
    own = grid()
    for tile in own.tiles(480, 16):
        east, north = (x.astype(np.float64) for x in tile.offsets())
        cells = np.array([(x, y, h) for x in east[0, ::100] for y in north[::100, 0] for h in (-5.0, 5.0)])
        there = np.column_stack([cells, np.ones(len(cells))]) @ tile.affine.T
        middle = np.array([*tile.centre, own.height])
        np.testing.assert_allclose(there, own.frame.to_scene(middle + cells), atol=5e-5)


def test_cell_centres_lie_where_rasterio_puts_them():
    rasterio = pytest.importorskip("rasterio")
    own = grid()
    tile = own.tiles(480, 16)[3]
    east, north = (x.astype(np.float64) for x in tile.offsets())
    x, y = rasterio.transform.xy(rasterio.transform.Affine(*own.transform), tile.row + 5, tile.column + 9)
    assert (tile.centre[0] + east[0, 9], tile.centre[1] + north[5, 0]) == pytest.approx((x, y), abs=1e-4)


def test_the_camera_above_a_tile_sees_its_cells_at_the_centres_of_its_pixels():
    tile = grid().tiles(96, 16)[3]
    height = np.random.default_rng(0).uniform(-3, 3, (tile.side, tile.side)).astype(np.float32)
    camera, _ = camera_above(tile, height)
    east, north = np.broadcast_arrays(*tile.offsets())
    cells = np.stack([east, north, height, np.ones(height.shape)], axis=-1).reshape(-1, 4) @ tile.affine.T
    uv = camera.project(torch.from_numpy(cells).float())[0][0].numpy().reshape(tile.side, tile.side, 2)
    centres = np.arange(tile.side) + 0.5
    off = uv - np.stack(np.meshgrid(centres, centres), axis=-1)
    assert np.abs(off).max() < 0.2
    assert np.abs(off.mean(axis=(0, 1))).max() < 0.02


@pytest.mark.parametrize(("columns", "rows", "side"), [(1000, 700, 480), (100, 90, 96), (96, 97, 96)])
def test_tiles_fade_into_each_other_and_leave_nothing_out(columns: int, rows: int, side: int):
    own = grid(columns, rows)
    total = np.zeros((rows, columns))
    for tile in own.tiles(side, 16):
        at_rows, at_columns, own_rows, own_columns = tile.window()
        total[at_rows, at_columns] += feather(tile.side, 16)[own_rows, own_columns]
    assert total.min() > 0
    # Where all neighbours exist the weights add up to one.
    np.testing.assert_allclose(total[16 : rows - 16, 16 : columns - 16], 1, atol=1e-5)


@pytest.mark.parametrize(
    ("system", "units"),
    [
        ("EPSG:27700+5701", ("m", "m")),
        ("EPSG:2263", ("US survey foot", "m")),
        ("EPSG:2263+5703", ("US survey foot", "m")),
        ("EPSG:2263+6360", ("US survey foot", "US survey foot")),
    ],
)
def test_lengths_and_heights_have_units_of_their_own(system: str, units: tuple[str, str]):
    origin = (987_000.0, 211_000.0, 30.0) if "2263" in system else (351_200.0, 512_900.0, 260.0)
    crs = CRS(system)
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    up = crs.sub_crs_list[1].axis_info[0].unit_conversion_factor if crs.is_compound else 1.0
    metre = 1 / horizontal.axis_info[0].unit_conversion_factor
    frame = MapFrame(LocalFrame.at(system, origin), np.zeros(3), np.eye(3), "", "", "", metre, 1 / up)
    assert (frame.unit, frame.unit_up) == units


@pytest.mark.parametrize(("system", "up"), [("EPSG:2263+6360", 3937 / 1200), ("EPSG:2263+5703", 1.0)])
def test_a_map_in_feet_has_a_metre_of_as_many_feet(system: str, up: float):
    there = LocalFrame.at(system, (987_000.0, 211_000.0, 30.0))
    similarity = Similarity(1.0, np.eye(3), np.zeros(3))
    given = Georeference(there, "GPS", similarity, Residuals(), Residuals(), Residuals(), (), ())
    own = map_frame(wall.scene(wall.cameras(3)), given)
    assert (own.metre, own.metre_up) == pytest.approx((3937 / 1200, up))
    origin, east, above = own.to_map(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]))
    assert np.linalg.norm((east - origin)[:2]) == pytest.approx(3937 / 1200, rel=1e-3)
    assert (above - origin)[2] == pytest.approx(up)


def test_heights_in_metres_are_not_stated_in_feet():
    with pytest.raises(RunError, match="US survey foot: expected a system in metres"):
        _vertical("unknown", "EPSG:6360")
    assert _vertical("NAVD88 height (ftUS)", None) == CRS("EPSG:5703"), "its twin in metres"
    assert _vertical("NAVD88 height", None) == CRS("EPSG:5703")


@pytest.mark.parametrize(
    ("datum", "stated", "given"),
    [
        ("the WGS 84 ellipsoid", None, "EPSG:5701"),
        ("the place of take-off", None, "EPSG:5701"),
        ("NAVD88 height", None, "EPSG:5701"),
        ("ODN height", "EPSG:5701", "EPSG:5703"),
    ],
)
def test_heights_whose_zero_is_known_get_no_other(datum: str, stated: str | None, given: str):
    with pytest.raises(RunError, match=f"but the scene's heights are over {datum}: expected the option only where"):
        _vertical(datum, given, None if stated is None else CRS(stated))


@pytest.mark.parametrize(
    ("datum", "stated", "expected"),
    [
        ("mean sea level, as the receivers know it", None, "EPSG:5703"),
        ("unknown; heights are as they were given", None, "EPSG:5703"),
        ("NAVD88 height", None, "EPSG:5703"),
        ("NAVD88 height (ftUS)", "EPSG:6360", "EPSG:6360"),
    ],
)
def test_heights_get_the_zero_that_is_given_where_it_may_be_theirs(datum: str, stated: str | None, expected: str):
    assert _vertical(datum, "EPSG:5703", None if stated is None else CRS(stated)) == CRS(expected)


def test_tiles_of_a_coarse_map_are_as_large_on_the_ground(tmp_path: Path):
    sides = {}
    for factor in (1, 3, 20):
        own = wall.scene(wall.cameras(3))
        frame = map_frame(own, None)
        cell = factor * ground_sampling_distance(own)
        sides[factor] = Job(own, Grid(frame, 0.0, 0.0, cell, 4000, 4000, 0.0), None, False, {}).tile_side
    assert sides == {1: 96, 3: 32, 20: 32}


def test_a_map_that_was_placed_anew_is_another_map():
    own = wall.scene(wall.cameras(3))
    there = LocalFrame.at("EPSG:27700", (351_200.0, 512_900.0, 260.0))
    keys = set()
    for height_m in (there.height_m, there.height_m + 48):
        similarity = Similarity(1.0, np.eye(3), np.zeros(3))
        frame = replace(there, height_m=height_m)
        placed = Georeference(frame, "GPS", similarity, Residuals(), Residuals(), Residuals(), (), ())
        grid = Grid(map_frame(own, placed), 351_200.0, 512_900.0, 0.1, 100, 100, 260.0)
        keys.add(Job(own, grid, None, False, {}).key)
    assert len(keys) == 2


def test_a_map_of_another_area_or_with_filled_cells_is_another_map():
    own = wall.scene(wall.cameras(3))
    grid = Grid(map_frame(own, None), 0.0, 0.0, 0.1, 100, 100, 0.0)
    areas = None, shapely.box(0, 0, 1, 1), shapely.box(0, 0, 1, 2)
    assert len({Job(own, grid, area, fill, {}).key for area in areas for fill in (False, True)}) == 6


def test_the_start_of_a_tile_is_read_from_coarse_cells_of_any_number():
    own = grid(40_000 * 8, 200, 0.05)
    coarse = own.coarser(8)
    height = np.broadcast_to(np.arange(coarse.columns, dtype=np.float32), (coarse.rows, coarse.columns))
    start = Start(coarse, np.ascontiguousarray(height))
    assert coarse.columns > 32_767
    for tile in (own.tiles(96, 16)[0], own.tiles(96, 16)[3000]):
        found = start.on(tile, 0)
        expected = (tile.column + np.arange(tile.side) + 0.5) / 8 - 0.5
        np.testing.assert_allclose(found[0], expected.clip(0, coarse.columns - 1), atol=1e-2)
