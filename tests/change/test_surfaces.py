"""Surfaces with all the grids, extents, nodata and systems that programs write."""

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer
from surveys_of_two_dates import NORTH, WEST, write_surface

from tidefield.change.surfaces import ChangeError, common_grid, open_surface


def plane(rows: int, columns: int, cell: float, west: float = WEST, north: float = NORTH) -> np.ndarray:
    """Heights 0.01 east + 0.02 north at the centres of pixels."""
    x = west + (np.arange(columns) + 0.5) * cell - WEST
    y = north - (np.arange(rows) + 0.5) * cell - NORTH
    return (0.01 * x[None] + 0.02 * y[:, None]).astype(np.float32)


def read(path: Path, grid, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    with open_surface(path).on_grid(grid, shift) as rows:
        return rows(0, grid.rows)


def test_other_pixels_are_read_at_the_centres_of_the_cells(tmp_path: Path):
    one = write_surface(tmp_path / "a.tif", plane(80, 100, 0.5))
    two = write_surface(
        tmp_path / "b.tif", plane(230, 310, 0.17, WEST + 1.3, NORTH - 0.7), 0.17, WEST + 1.3, NORTH - 0.7
    )
    grid = common_grid([open_surface(one), open_surface(two)])
    assert grid.cell_m == 0.5
    assert (grid.west_m - WEST) % 0.5 == pytest.approx(0, abs=1e-6)
    difference = (read(two, grid) - read(one, grid))[2:-2, 2:-2]
    assert np.abs(difference).max() < 1e-4


def test_a_surface_that_is_shifted_is_moved_to_the_east_and_north(tmp_path: Path):
    path = write_surface(tmp_path / "a.tif", plane(80, 100, 0.5))
    grid = common_grid([open_surface(path)])
    moved = read(path, grid, (1.0, 0.5)) - read(path, grid)
    assert np.nanmax(np.abs(moved[5:-5, 5:-5] + 0.01 * 1.0 + 0.02 * 0.5)) < 1e-5


def test_the_same_pixels_are_copied_not_interpolated(tmp_path: Path):
    values = np.random.default_rng(0).normal(size=(40, 50)).astype(np.float32)
    one = write_surface(tmp_path / "a.tif", values)
    two = write_surface(tmp_path / "b.tif", values[3:, 7:], west=WEST + 3.5, north=NORTH - 1.5)
    grid = common_grid([open_surface(one), open_surface(two)])
    assert np.array_equal(read(one, grid), values[3:, 7:])
    assert np.array_equal(read(two, grid), values[3:, 7:])


@pytest.mark.parametrize(("nodata", "declared"), [(-10000.0, None), (-9999.0, -9999.0), (0.0, None), (np.nan, None)])
def test_cells_without_heights_are_not_heights(tmp_path: Path, nodata: float, declared: float | None):
    values = plane(40, 40, 0.5) + np.float32(50)
    values[:12] = nodata
    path = write_surface(tmp_path / "a.tif", values, nodata=declared)
    found = read(path, common_grid([open_surface(path)], 0.7))
    assert np.isnan(found[:8]).all()
    assert np.isfinite(found[10:]).all()
    assert np.nanmin(found) > 45  # nothing is mixed with nodata at the border
    said = any("declares no nodata" in remark for remark in open_surface(path).remarks)
    assert said == (declared is None and np.isfinite(nodata))


def test_another_coordinate_system_is_converted(tmp_path: Path):
    to = Transformer.from_crs("EPSG:32630", "EPSG:27700", always_xy=True)
    one = write_surface(tmp_path / "a.tif", plane(80, 100, 0.5))
    x0, y0 = to.transform(WEST + 25, NORTH - 20)
    # The other survey in the British grid, with the heights of the same places.
    cell, rows, columns = 0.25, 120, 140
    x = x0 - 17 + (np.arange(columns) + 0.5) * cell
    y = y0 + 15 - (np.arange(rows) + 0.5) * cell
    e, n = Transformer.from_crs("EPSG:27700", "EPSG:32630", always_xy=True).transform(*np.meshgrid(x, y))
    heights = (0.01 * (e - WEST) + 0.02 * (n - NORTH)).astype(np.float32)
    two = write_surface(tmp_path / "b.tif", heights, cell, x0 - 17, y0 + 15, "EPSG:27700")
    grid = common_grid([open_surface(one), open_surface(two)])
    difference = read(two, grid) - read(one, grid)
    assert np.isfinite(difference).mean() > 0.8
    assert np.nanquantile(np.abs(difference), 0.99) < 2e-3


def test_feet_are_converted_to_metres(tmp_path: Path):
    path = write_surface(tmp_path / "a.tif", np.full((30, 30), 100, np.float32), crs="EPSG:6318+6360")
    assert open_surface(path).metres == pytest.approx(0.3048, abs=1e-5)


def test_feet_without_a_unit_of_heights_are_remarked(tmp_path: Path):
    plain = write_surface(tmp_path / "a.tif", np.full((30, 30), 100, np.float32), crs="EPSG:2263")
    assert any("US survey foot" in remark for remark in open_surface(plain).remarks)
    known = write_surface(tmp_path / "b.tif", np.full((30, 30), 100, np.float32), crs="EPSG:2263+6360")
    assert open_surface(known).remarks == []


@pytest.mark.parametrize("system", ["EPSG:4326", "EPSG:3857", "EPSG:3395"])
def test_cells_are_those_of_the_ground_where_units_of_the_map_are_not(tmp_path: Path, system: str):
    to = Transformer.from_crs("EPSG:32630", system, always_xy=True)
    (west, east), (south, north) = to.transform([WEST, WEST + 100], [NORTH - 100, NORTH])
    size = (east - west) / 200, (north - south) / 200
    surface = open_surface(
        write_surface(tmp_path / "a.tif", np.zeros((200, 200), np.float32), 0, west, north, system, size=size)
    )
    grid = common_grid([surface])
    assert CRS(grid.crs).to_epsg() == 32630
    with surface.on_grid(grid) as rows:
        known = np.isfinite(rows(0, grid.rows)).sum() * grid.cell_area_m2
    assert known == pytest.approx(10_000, rel=0.03)


def test_whole_numbers_with_a_scale_and_an_offset_are_heights(tmp_path: Path):
    import rasterio

    heights = plane(40, 40, 0.5) + np.float32(3)
    path = write_surface(tmp_path / "a.tif", np.round((heights - 1) / 0.001).astype(np.int16), nodata=-9999)
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.001,), (1.0,)
    found = read(path, common_grid([open_surface(path)]))
    assert np.abs(found - heights).max() < 0.001


def test_zeros_are_heights_of_a_scaled_file_whose_other_heights_are_low(tmp_path: Path):
    import rasterio

    values = np.full((40, 40), 20, np.int16)
    values[:10] = 0
    path = write_surface(tmp_path / "a.tif", values)
    with rasterio.open(path, "r+") as file:
        file.scales = (0.01,)
    found = read(path, common_grid([open_surface(path)]))
    assert [found[0, 0], found[-1, 0]] == pytest.approx([0, 0.2])


def test_surveys_of_different_places_are_refused_with_their_places(tmp_path: Path):
    one = write_surface(tmp_path / "a.tif", plane(20, 20, 0.5))
    two = write_surface(tmp_path / "b.tif", plane(20, 20, 0.5), west=WEST + 500)
    with pytest.raises(ChangeError, match="do not overlap"):
        common_grid([open_surface(one), open_surface(two)])


def test_heights_over_different_zeros_are_refused(tmp_path: Path):
    one = write_surface(tmp_path / "a.tif", plane(20, 20, 0.5), crs="EPSG:27700+5701")
    two = write_surface(tmp_path / "b.tif", plane(20, 20, 0.5), crs="EPSG:27700+5703")
    with pytest.raises(ChangeError, match="one zero"):
        common_grid([open_surface(one), open_surface(two)])


def test_a_system_in_one_file_only_is_refused(tmp_path: Path):
    one = write_surface(tmp_path / "a.tif", plane(20, 20, 0.5))
    two = write_surface(tmp_path / "b.tif", plane(20, 20, 0.5), crs=None)
    with pytest.raises(ChangeError, match="has none"):
        common_grid([open_surface(one), open_surface(two)])


def test_a_picture_is_no_surface(tmp_path: Path):
    path = write_surface(tmp_path / "a.tif", np.zeros((3, 20, 20), np.uint8))
    with pytest.raises(ChangeError, match="picture"):
        open_surface(path)


def test_a_damaged_file_is_refused(tmp_path: Path):
    path = tmp_path / "a.tif"
    path.write_bytes(b"II*\0" + bytes(range(200)))
    with pytest.raises(ChangeError, match="not a raster"):
        open_surface(path)


def test_a_file_that_is_cut_short_is_refused_when_it_is_read(tmp_path: Path):
    path = write_surface(tmp_path / "a.tif", np.random.default_rng(0).normal(size=(400, 400)).astype(np.float32))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ChangeError):
        read(path, common_grid([open_surface(path)]))


@pytest.mark.parametrize(
    ("name", "date"), [("leo_20180606_dsm", "2018-06-06"), ("site 2019-07-31", "2019-07-31"), ("dsm_12345678", None)]
)
def test_dates_are_read_from_names(tmp_path: Path, name: str, date: str | None):
    path = write_surface(tmp_path / f"{name}.tif", plane(20, 20, 0.5))
    assert open_surface(path).date == date
