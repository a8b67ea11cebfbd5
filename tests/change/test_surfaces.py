"""Surfaces with all the grids, extents, nodata and systems that programs write."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from pyproj import CRS, Transformer
from surveys_of_two_dates import NORTH, WEST, write_surface

from tidefield.change.surfaces import ChangeError, Grid, common_grid, open_surface, other_datums, require_one_datum
from tidefield.change.write import CHANGE_BANDS, _multi


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


def test_a_file_that_refers_to_others_is_opened_only_if_its_name_says_so(tmp_path: Path):
    write_surface(tmp_path / "a.tif", plane(80, 100, 0.5))
    pytest.importorskip("rasterio.shutil").copy(tmp_path / "a.tif", tmp_path / "b.vrt", driver="VRT")
    assert open_surface(tmp_path / "b.vrt").path == tmp_path / "b.vrt"
    (tmp_path / "b.vrt").rename(tmp_path / "b.tif")
    with pytest.raises(ChangeError, match=r"b\.tif refers to other files or addresses \(VRT\)"):
        open_surface(tmp_path / "b.tif")


@pytest.mark.parametrize("name", ["a.tif", "a.vrt"])
def test_a_service_is_not_asked_before_it_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str):
    monkeypatch.setattr("rasterio.open", lambda *_, **__: pytest.fail("it was opened"))
    (tmp_path / name).write_text("\n<WCS_GDAL><ServiceURL>http://127.0.0.1:9/wcs?</ServiceURL></WCS_GDAL>")
    with pytest.raises(ChangeError, match="refers to other files or addresses"):
        open_surface(tmp_path / name)


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


NAN = float("nan")


@pytest.mark.parametrize(
    ("nodata", "declared"),
    [
        ((-10000.0,), None),
        ((-9999.0,), -9999.0),
        ((0.0,), None),
        ((NAN,), None),
        ((-9999.0,), NAN),
        ((-9999.0,), -32767.0),
        ((-9999.0, -10000.0), None),
        ((-32768.0, NAN), -9999.0),
    ],
)
def test_cells_without_heights_are_not_heights(tmp_path: Path, nodata: tuple[float, ...], declared: float | None):
    values = plane(40, 40, 0.5) + np.float32(50)
    values[:12] = nodata[0]
    values[:12, :10] = nodata[-1]
    path = write_surface(tmp_path / "a.tif", values, nodata=declared)
    found = read(path, common_grid([open_surface(path)], 0.7))
    assert np.isnan(found[:8]).all()
    assert np.isfinite(found[10:]).all()
    assert np.nanmin(found) > 45  # nothing is mixed with nodata at the border
    undeclared = [value for value in nodata if np.isfinite(value) and value != declared]
    remarks = [remark for remark in open_surface(path).remarks if "declares" in remark]
    assert len(remarks) == (len(undeclared) > 0)
    assert all(f"{value:g}" in remarks[0] for value in undeclared)


@pytest.mark.parametrize("value", [-9999.0, 0.0])
def test_overviews_do_not_hide_what_is_no_height(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: float):
    """Those of a COG are smooth, so that there are values between the heights and it, and beyond it."""
    from rasterio.shutil import copy

    monkeypatch.setattr("tidefield.change.nodata._SAMPLE", 250)
    values = plane(600, 600, 0.05) + np.float32(50)
    y, x = np.mgrid[:600, :600]
    values[np.hypot(x - 300, y - 300) > 250] = value
    copy(write_surface(tmp_path / "a.tif", values), tmp_path / "cog.tif", driver="COG")
    for name in ("a.tif", "cog.tif"):
        surface = open_surface(tmp_path / name)
        assert any(f"{value:g} where no height can be, in 45" in remark for remark in surface.remarks)
        assert np.nanmin(read(tmp_path / name, common_grid([surface]))) > 45


def test_small_holes_are_found_wherever_they_lie(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tidefield.change.nodata._SAMPLE", 10)
    monkeypatch.setattr("tidefield.change.nodata.STRIP_CELLS", 1000)
    values = plane(100, 100, 0.5) + np.float32(50)
    values[6:9, 41:44] = -9999
    path = write_surface(tmp_path / "a.tif", values)
    surface = open_surface(path)
    assert any("-9999 where no height can be, in 0.1% of its cells" in remark for remark in surface.remarks)
    assert np.isnan(read(path, common_grid([surface]))[6:9, 41:44]).all()


@pytest.mark.parametrize("declared", [None, -9999.0])
def test_a_mask_holds_besides_what_stands_for_no_height(tmp_path: Path, declared: float | None):
    import rasterio

    values = plane(40, 50, 0.5)
    values[:, :20], values[:, 45:] = 50, -9999
    path = write_surface(tmp_path / "a.tif", values, nodata=declared)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as file:
        file.write_mask(np.broadcast_to(np.arange(50) >= 20, values.shape))
    found = read(path, common_grid([open_surface(path)]))
    assert np.array_equal(np.isfinite(found[0]), (np.arange(50) >= 20) & (np.arange(50) < 45))
    assert np.array_equal(found[:, 20:45], values[:, 20:45])


def test_zeros_around_a_survey_are_no_heights_and_zeros_in_it_are(tmp_path: Path):
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 0.6, (100, 100)).astype(np.float32)
    values[40:45, 40:45] = 0
    assert open_surface(write_surface(tmp_path / "a.tif", values)).remarks == []
    values[:, :44] = 0
    surface = open_surface(write_surface(tmp_path / "b.tif", values))
    assert any("has 0 where no height can be" in remark for remark in surface.remarks)
    with surface.on_grid(common_grid([surface], 0.7)) as rows:
        found = rows(0, 71)
    assert np.isnan(found[:, :31]).all()
    assert np.isfinite(found[:, 33:]).all()


@pytest.mark.parametrize("nodata", [None, -9999.0])
def test_a_sea_that_is_levelled_to_zero_has_heights(tmp_path: Path, nodata: float | None):
    shore = np.maximum(0, np.broadcast_to(0.02 * (np.arange(100) - 40.0), (100, 100))).astype(np.float32)
    surface = open_surface(write_surface(tmp_path / "a.tif", shore, nodata=nodata))
    assert surface.unknown == ()
    assert surface.remarks == []
    frame = np.where(shore == 0, shore, shore + 0.5)  # its heights end
    path = write_surface(tmp_path / "b.tif", frame, nodata=nodata)
    assert open_surface(path).unknown == ((0.0,) if nodata is None else ())


def shore(shape: tuple[int, int], cell: float, slope: float) -> np.ndarray:
    """A sea that is levelled to zero, and ground that rises from it to the east."""
    east = cell * (np.arange(shape[1]) - 0.4 * shape[1])
    return np.broadcast_to(np.maximum(0, slope * east), shape).astype(np.float32)


@pytest.mark.parametrize(
    ("shape", "cell", "slope"),
    [((100, 100), 1.0, 0.1), ((100, 100), 5.0, 0.05), ((100, 200), 1.0, 0.25), ((50, 8000), 0.25, 0.1)],
)
def test_a_levelled_sea_has_heights_however_steep_its_shore_and_large_its_raster(
    tmp_path: Path, shape: tuple[int, int], cell: float, slope: float
):
    heights = shore(shape, cell, slope)
    assert open_surface(write_surface(tmp_path / "a.tif", heights, cell)).unknown == ()
    frame = np.where(heights == 0, heights, heights + np.float32(2 * cell))  # its heights end
    assert open_surface(write_surface(tmp_path / "b.tif", frame, cell)).unknown == (0.0,)


def test_a_levelled_sea_has_heights_where_nodata_that_is_not_declared_borders_it(tmp_path: Path):
    heights = shore((200, 200), 1.0, 0.02)
    heights[:80] = heights[120:] = -9999
    assert open_surface(write_surface(tmp_path / "a.tif", heights, 1.0)).unknown == (-9999.0,)
    # Zeros in the corners of a raster that was turned, around nodata that is not declared.
    heights[80:120] += 3
    heights[:20] = 0
    assert open_surface(write_surface(tmp_path / "b.tif", heights, 1.0)).unknown == (-9999.0, 0.0)


@pytest.mark.parametrize("nodata", [None, -9999.0])
def test_levelled_water_in_front_of_a_quay_has_heights_where_nodata_is_declared(tmp_path: Path, nodata: float | None):
    harbour = np.random.default_rng(0).normal(3, 0.2, (100, 100)).astype(np.float32)
    harbour[:, :40] = 0
    surface = open_surface(write_surface(tmp_path / "a.tif", harbour, 1.0, nodata=nodata))
    assert surface.unknown == ((0.0,) if nodata is None else ())
    assert ["that is taken for levelled water" in remark for remark in surface.remarks] == [nodata is not None]


def test_zeros_next_to_high_ground_are_none_where_nodata_is_declared(tmp_path: Path):
    """As gdal_merge.py -a_nodata without -init leaves them; but levelled water may end at declared nodata."""
    ground = np.random.default_rng(0).normal(45, 0.2, (100, 100)).astype(np.float32)
    ground[:, :40] = 0
    assert open_surface(write_surface(tmp_path / "a.tif", ground, 1.0, nodata=-9999)).unknown == (0.0,)
    ground[:, 40:50] = -9999
    assert open_surface(write_surface(tmp_path / "b.tif", ground, 1.0, nodata=-9999)).unknown == (0.0,)
    ground[:, 50:] -= 44
    surface = open_surface(write_surface(tmp_path / "c.tif", ground, 1.0, nodata=-9999))
    assert (surface.unknown, surface.remarks) == ((), [])


@pytest.mark.parametrize(("unit", "metre"), [("mm", 0.001), ("cm", 0.01)])
def test_a_levelled_sea_has_heights_in_small_units(tmp_path: Path, unit: str, metre: float):
    import rasterio

    path = write_surface(tmp_path / "a.tif", shore((100, 100), 1.0, 0.02) / np.float32(metre), 1.0)
    with rasterio.open(path, "r+") as file:
        file.units = (unit,)
    assert open_surface(path).unknown == ()


@pytest.mark.parametrize("nodata", [None, -1.0])
def test_a_height_is_one_though_programs_write_it_for_nodata(tmp_path: Path, nodata: float | None):
    import rasterio

    heights = np.round(np.random.default_rng(0).normal(10_000, 40, (100, 100))).astype(np.float32)
    heights[:10] = -9999
    path = write_surface(tmp_path / "a.tif", heights, 1.0, nodata=nodata)
    with rasterio.open(path, "r+") as file:
        file.units = ("mm",)
    assert (heights == 9999).any()
    assert open_surface(path).unknown == (-9999.0,)


def test_values_that_are_no_heights_do_not_make_one_of_another(tmp_path: Path):
    heights = np.random.default_rng(0).normal(10, 1, (100, 100)).astype(np.float32)
    heights[:10], heights[10:12] = np.finfo(np.float32).min, -9999
    heights[12:14] = -1e30
    assert set(open_surface(write_surface(tmp_path / "a.tif", heights)).unknown) >= {-9999.0}


@pytest.mark.parametrize(("unit", "metre"), [("mm", 0.001), ("cm", 0.01)])
def test_heights_in_small_units_are_heights(tmp_path: Path, unit: str, metre: float):
    import rasterio

    path = write_surface(tmp_path / "a.tif", np.full((20, 20), 252 / metre, np.float32))
    with rasterio.open(path, "r+") as file:
        file.units = (unit,)
    found = read(path, common_grid([open_surface(path)]))
    assert found[5, 5] == pytest.approx(252)


def test_whole_numbers_may_be_zero_around_a_survey_and_reach_what_others_write_for_nodata(tmp_path: Path):
    import rasterio

    values = np.full((40, 40), 50, np.int16)
    values[:, :10], values[0, 20] = 0, 9999
    path = write_surface(tmp_path / "a.tif", values, nodata=-32768)
    with rasterio.open(path, "r+") as file:
        file.scales = (0.01,)
    surface = open_surface(path)
    assert surface.unknown == ()
    assert surface.remarks == []


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


@pytest.mark.parametrize(
    ("unit", "system", "metres", "remark"),
    [
        ("ft", "EPSG:32630", 0.3048, None),
        ("US survey foot", "EPSG:2263", 1200 / 3937, None),
        ("metre", "EPSG:2263", 1.0, None),
        ("cm", None, 0.01, "no coordinate system"),
        ("cubit", "EPSG:32630", 1.0, "heights in cubit, which is not known"),
        ("m", "EPSG:6318+6360", 1200 / 3937, None),
    ],
)
def test_the_unit_of_a_band_is_that_of_heights_whose_system_states_none(
    tmp_path: Path, unit: str, system: str | None, metres: float, remark: str | None
):
    import rasterio

    path = write_surface(tmp_path / "a.tif", np.full((30, 30), 100, np.float32), crs=system)
    with rasterio.open(path, "r+") as file:
        file.units = (unit,)
    surface = open_surface(path)
    assert surface.metres == pytest.approx(metres, rel=1e-9)
    assert surface.remarks == [] if remark is None else remark in surface.remarks[0]


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
    with pytest.raises(ChangeError, match="one vertical datum"):
        common_grid([open_surface(one), open_surface(two)])


def test_ellipsoidal_heights_are_not_compared_with_those_over_a_geoid(tmp_path: Path):
    one = write_surface(tmp_path / "a.tif", plane(20, 20, 1e-5, -4.4, 51.4), 1e-5, -4.4, 51.4, "EPSG:4979")
    two = write_surface(tmp_path / "b.tif", plane(20, 20, 1e-5, -4.4, 51.4), 1e-5, -4.4, 51.4, "EPSG:4326+5773")
    with pytest.raises(ChangeError, match=r"the ellipsoid of WGS 84.*EGM96"):
        common_grid([open_surface(one), open_surface(two)])
    assert common_grid([open_surface(one), open_surface(one)]).rows > 1
    third = write_surface(tmp_path / "c.tif", plane(20, 20, 1e-5, -4.4, 51.4), 1e-5, -4.4, 51.4, "EPSG:4937")  # ETRS89
    assert common_grid([open_surface(one), open_surface(third)]).rows > 1
    surfaces = [open_surface(path) for path in (one, third)]
    assert "up to two metres apart: the ellipsoid of WGS 84 and the ellipsoid of ETRS89" in (
        other_datums(*surfaces) or ""
    )
    assert other_datums(surfaces[0], surfaces[0]) is None
    with pytest.raises(ChangeError, match=r"WGS 84.*ETRS89.*leave --register none out"):
        require_one_datum([(surface.path, surface.vertical_datum) for surface in surfaces], registered=False)


def test_a_vertical_system_without_a_name_is_compared_with_any(tmp_path: Path):
    vertical = 'VERT_CS["unknown",VERT_DATUM["Unknown",2005],UNIT["metre",1],AXIS["Up",UP]]'
    nameless = f'COMPD_CS["both",{CRS("EPSG:27700").to_wkt("WKT1_GDAL")},{vertical}]'
    one = write_surface(tmp_path / "a.tif", plane(20, 20, 0.5), crs="EPSG:27700+5701")
    two = replace(open_surface(one), path=tmp_path / "b.tif", crs=CRS(nameless))
    assert common_grid([open_surface(one), two]).rows == 20


def test_surveys_of_one_datum_meet_in_its_own_zone(tmp_path: Path):
    """GDA94 and GDA2020 are 1.8 m apart; WGS 84 is taken for either by PROJ, which loses the difference."""
    longitude, latitude = 145.0, -38.0
    x, y = Transformer.from_crs("EPSG:7844", "EPSG:7855", always_xy=True).transform(longitude, latitude)
    old = Transformer.from_crs("EPSG:7844", "EPSG:4283", always_xy=True).transform(longitude, latitude)
    heights = np.zeros((100, 100), np.float32)
    one = open_surface(write_surface(tmp_path / "a.tif", heights, 5e-6, *old, "EPSG:4283"))
    grid = common_grid([one, open_surface(write_surface(tmp_path / "b.tif", heights, 0.5, x, y, "EPSG:7855"))])
    system = CRS(grid.crs)
    assert system.name == "GDA94 / UTM zone 55S"
    corners = [
        Transformer.from_crs(of, system, always_xy=True).transform(*at)
        for of, at in (("EPSG:4283", old), ("EPSG:7855", (x, y)))
    ]
    assert corners[0] == pytest.approx(corners[1], abs=0.01)


def test_a_system_in_one_file_only_is_refused(tmp_path: Path):
    one = write_surface(tmp_path / "a.tif", plane(20, 20, 0.5))
    two = write_surface(tmp_path / "b.tif", plane(20, 20, 0.5), crs=None)
    with pytest.raises(ChangeError, match="has none"):
        common_grid([open_surface(one), open_surface(two)])


def test_a_picture_is_no_surface(tmp_path: Path):
    import rasterio
    from rasterio.enums import ColorInterp

    path = write_surface(tmp_path / "a.tif", np.zeros((3, 20, 20), np.uint8))
    with pytest.raises(ChangeError, match="picture"):
        open_surface(path)
    with pytest.raises(ChangeError, match="picture"):  # a hillshade
        open_surface(write_surface(tmp_path / "b.tif", np.zeros((20, 20), np.uint8)))
    deep = write_surface(tmp_path / "c.tif", np.ones((4, 20, 20), np.uint16))
    assert [remark for remark in open_surface(deep).remarks if "has 4 bands" in remark]
    with rasterio.open(deep, "r+") as file:
        file.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
    with pytest.raises(ChangeError, match="picture"):
        open_surface(deep)


def test_a_result_of_change_is_no_surface(tmp_path: Path):
    import rasterio

    path = write_surface(tmp_path / "a.tif", np.zeros((20, 20), np.float32))
    with rasterio.open(path, "r+") as file:
        file.set_band_description(1, CHANGE_BANDS[0])
    with pytest.raises(ChangeError, match="has 'dz: later minus earlier height"):
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


def test_the_date_in_a_name_is_believed_before_that_of_the_processing(tmp_path: Path):
    import rasterio

    path = write_surface(tmp_path / "flight_2023-05-01.tif", plane(20, 20, 0.5))
    with rasterio.open(path, "r+") as file:
        file.update_tags(TIFFTAG_DATETIME="2024:02:03 10:00:00")
    found = open_surface(path)
    assert found.date == "2023-05-01"
    assert any("2024-02-03" in remark for remark in found.remarks)
    assert open_surface(path, "2023-05-02").date == "2023-05-02"
    assert open_surface(path, "2023-05-02").remarks == []
    bare = path.rename(tmp_path / "flight.tif")
    assert open_surface(bare).date == "2024-02-03"


@pytest.mark.parametrize("value", [99999.0, 65535.0, 32767.0, -1e6])
def test_values_beyond_all_heights_are_left_out_before_they_are_interpolated(tmp_path: Path, value: float):
    heights = np.random.default_rng(0).normal(2, 0.5, (300, 300)).astype(np.float32)
    heights[100:140, 80:160] = value
    surface = open_surface(write_surface(tmp_path / "a.tif", heights))
    grid = common_grid([surface])
    with surface.on_grid(grid, (0.05, 0.05)) as read:
        found = read(0, grid.rows)
    assert np.nanmax(np.abs(found)) < 10
    assert any(f"{value:g}" in remark for remark in surface.remarks)


@pytest.mark.parametrize("step", [1, 2, 5])
def test_cells_that_are_left_of_a_grid_stay_where_they_are(step: int):
    grid = Grid(None, WEST, NORTH, 0.5, 23, 17)
    thin = grid.thinned(step)
    assert thin.shape == np.zeros(grid.shape)[::step, ::step].shape
    middles = [
        (g.west_m + (np.arange(g.columns) + 0.5) * g.cell_m, g.north_m - (np.arange(g.rows) + 0.5) * g.cell_m)
        for g in (grid, thin)
    ]
    for every, left in zip(*middles, strict=True):
        np.testing.assert_allclose(left, every[::step])


def test_lines_of_a_layer_stay_lines_and_of_all_else_the_polygons_are_kept():
    line, box = shapely.LineString([(0, 0), (3, 4)]), shapely.box(0, 0, 2, 2)
    lines = shapely.MultiLineString([line, line])
    mixed = shapely.GeometryCollection([line, box])
    found = _multi([line, lines, box, mixed])
    assert found[:2] == [line, lines]
    assert [shape.geom_type for shape in found[2:]] == ["MultiPolygon"] * 2
    assert [shape.area for shape in found[2:]] == [4.0, 4.0]
