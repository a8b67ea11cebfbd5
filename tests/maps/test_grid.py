"""Cells, tiles and their coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from tidefield.geometry.geodesy import LocalFrame
from tidefield.maps.grid import Grid, MapFrame, feather

FRAME = LocalFrame.at("EPSG:27700", (351_200.0, 512_900.0, 260.0))


def grid(columns: int = 1000, rows: int = 700, cell: float = 0.05) -> Grid:
    frame = MapFrame(FRAME, np.array([3.0, -4.0, 50.0]), np.eye(3), "", "", "")
    return Grid(frame, 351_180.0, 512_930.0, cell, columns, rows, 255.0)


def test_a_tile_s_affine_function_is_that_of_the_projection():
    own = grid()
    for tile in own.tiles(480, 16):
        east, north = (x.astype(np.float64) for x in tile.offsets())
        cells = np.array([(x, y, h) for x in east[0, ::100] for y in north[::100, 0] for h in (-5.0, 5.0)])
        there = np.column_stack([cells, np.ones(len(cells))]) @ tile.affine().T
        middle = np.array([*tile.centre, own.height])
        np.testing.assert_allclose(there, own.frame.to_scene(middle + cells), atol=5e-5)


def test_cell_centres_lie_where_rasterio_puts_them():
    rasterio = pytest.importorskip("rasterio")
    own = grid()
    tile = own.tiles(480, 16)[3]
    east, north = (x.astype(np.float64) for x in tile.offsets())
    x, y = rasterio.transform.xy(rasterio.transform.Affine(*own.transform), tile.row + 5, tile.column + 9)
    assert (tile.centre[0] + east[0, 9], tile.centre[1] + north[5, 0]) == pytest.approx((x, y), abs=1e-4)


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
