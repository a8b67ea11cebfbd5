"""Maps from straight above: tiles, values, sections and volumes against rasters that are known."""

import io
import json
import math
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("rasterio", reason="needs rasterio, which is not installed")

from map_folders import CELL, SHAPE, corner, write_change, write_map
from surveys_of_two_dates import NORTH, WEST, noise, write_surface

from tidefield.change.measure import measure
from tidefield.change.surfaces import open_surface
from tidefield.change.write import write_all
from tidefield.errors import RunError, TidefieldError
from tidefield.maps.grid import LOCAL_WKT
from tidefield.viewer import rasters
from tidefield.viewer.atlas import STEP, Atlas
from tidefield.viewer.rasters import TILE_PX
from tidefield.viewer.sheets import is_sheet


def box(left: float, top: float, right: float, bottom: float) -> np.ndarray:
    return np.array([corner(left, top), corner(right, top), corner(right, bottom), corner(left, bottom)])


def decoded(content: bytes) -> np.ndarray:
    """The values of a tile, NaN where there are none."""
    raw = np.asarray(Image.open(io.BytesIO(content))).astype(np.int64)
    code = (raw[..., 0] << 16) | (raw[..., 1] << 8) | raw[..., 2]
    return np.where(raw[..., 3] > 0, (code - (1 << 23)) * STEP, np.nan)


def test_a_tile_has_the_cell_below_each_of_its_pixels(tmp_path: Path):
    heights = np.random.default_rng(0).uniform(-3, 40, SHAPE).astype(np.float32)
    atlas = Atlas([write_map(tmp_path / "map", (1, 2, 3), heights)])
    for level, column, row in ((atlas.finest, 0, 0), (atlas.finest, 1, 1)):
        content = atlas.tile(0, "height", level, column, row)
        assert content is not None
        side = atlas.side / 2**level / CELL  # in cells
        at = (np.arange(TILE_PX) + 0.5) / TILE_PX * side
        rows, columns = (at + row * side).astype(int), (at + column * side).astype(int)
        expected = np.full((TILE_PX, TILE_PX), np.nan)
        inside = np.ix_(rows < SHAPE[0], columns < SHAPE[1])
        expected[inside] = heights[np.ix_(rows[rows < SHAPE[0]], columns[columns < SHAPE[1]])]
        assert np.allclose(decoded(content), expected, atol=STEP / 2 + 1e-5, equal_nan=True)


@pytest.mark.parametrize(("kind", "most"), [(np.uint16, 4000), (np.float32, 0.6)])
def test_a_picture_of_other_numbers_than_bytes_is_shown_from_black_to_white(tmp_path: Path, kind: type, most: float):
    ramp = np.linspace(0, most, SHAPE[1]).astype(kind)
    picture = np.stack([np.broadcast_to(band, SHAPE) for band in (ramp, ramp / 2, ramp)]).astype(kind)
    write_surface(tmp_path / "odm_orthophoto" / "odm_orthophoto.tif", picture, CELL)
    content = Atlas([tmp_path]).tile(0, "orthophoto", 0, 0, 0)
    assert content is not None
    shown = np.asarray(Image.open(io.BytesIO(content)))
    red, green, blue, _ = shown[10, shown[10, :, 3] > 0].astype(int).T
    assert (np.diff(red) >= 0).all()
    assert (red[0], red[-1]) == (0, 255)
    assert (red == blue).all()
    assert abs(2 * green - red).max() < 8, "all bands are stretched alike"


def test_bytes_of_a_picture_are_shown_as_they_are(tmp_path: Path):
    content = Atlas([write_map(tmp_path / "map", (200, 1, 128))]).tile(0, "orthophoto", 0, 0, 0)
    assert content is not None
    assert np.asarray(Image.open(io.BytesIO(content)))[10, 10].tolist() == [200, 1, 128, 255]


@pytest.mark.parametrize(
    ("system", "unit", "measures"),
    [
        (LOCAL_WKT, "units", ("units", "square units", "cubic units")),
        ('LOCAL_CS["site",UNIT["metre",1]]', "m", ("m", "m²", "m³")),
        ("EPSG:32630", "m", ("m", "m²", "m³")),
    ],
)
def test_lengths_are_metres_where_a_system_knows_them(
    tmp_path: Path, system: str, unit: str, measures: tuple[str, str, str]
):
    write_surface(tmp_path / "dsm.tif", np.ones(SHAPE, np.float32), CELL, crs=system)
    atlas = Atlas([tmp_path])
    assert atlas.unit == unit
    assert tuple(atlas.describe()[name] for name in ("length", "area", "volume")) == measures


def test_a_change_of_surfaces_without_a_system_is_shown_in_metres(tmp_path: Path):
    change = write_change(tmp_path / "change", np.full(SHAPE, 0.4, np.float32), crs=None)
    atlas = Atlas([change])
    assert (atlas.unit, atlas.name) == ("m", "no coordinate system")
    assert atlas.tile(0, "change", 0, 0, 0) is not None
    (volumes,) = atlas.area(box(10, 10, 20, 20))["sheets"]
    assert volumes["net"]["value_m3"] == pytest.approx(40 * CELL**2, rel=1e-4)
    beside = Atlas([change, write_map(tmp_path / "map", (1, 2, 3))])
    assert beside.crs.to_epsg() == 32630
    assert beside.metre == 1
    write_surface(tmp_path / "feet" / "dsm.tif", np.ones(SHAPE, np.float32), CELL, crs="EPSG:2263")
    with pytest.raises(RunError, match=r"taken as metres, and the maps .* US survey foot: expected one unit"):
        Atlas([change, tmp_path / "feet"])


def test_a_change_between_maps_in_a_local_frame_is_in_units_of_the_scene(tmp_path: Path):
    surfaces = [
        write_surface(tmp_path / name / "dsm.tif", noise(np.random.default_rng(k), SHAPE, 0.02, 0, 1), CELL, crs=system)
        for k, (name, system) in enumerate((("a", LOCAL_WKT), ("b", LOCAL_WKT), ("c", None), ("d", None)))
    ]
    for one, two, unit in ((*surfaces[:2], "units"), (*surfaces[2:], "m")):
        folder = tmp_path / unit
        folder.mkdir()
        write_all(measure(open_surface(one), open_surface(two)), folder, "tidefield change")
        assert Atlas([folder]).unit == unit
    assert Atlas([tmp_path / "units"]).describe()["volume"] == "cubic units"
    assert Atlas([tmp_path / "units", tmp_path / "a"]).unit == "units"


def test_a_map_on_the_earth_and_one_in_a_frame_of_its_own_are_refused(tmp_path: Path):
    placed = write_map(tmp_path / "placed", (1, 2, 3))
    write_surface(tmp_path / "local" / "dsm.tif", np.zeros(SHAPE, np.float32), CELL, crs=LOCAL_WKT)
    with pytest.raises(RunError, match=r"local lies in a local frame, .*placed in WGS 84 / UTM zone 30N"):
        Atlas([placed, tmp_path / "local"])


US_SURVEY_FOOT_M = 1200 / 3937


def in_millimetres(path: Path) -> None:
    import rasterio

    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.001,), (2.0,)


def with_a_unit(path: Path) -> None:
    import rasterio

    with rasterio.open(path, "r+") as file:
        file.units = ("ft",)


@pytest.mark.parametrize(
    ("crs", "kind", "missing", "unit_m", "offset", "state"),
    [
        ("EPSG:32630", np.int16, -32768, 0.001, 2.0, in_millimetres),
        ("EPSG:32630", np.float32, -9999, 0.3048, 0.0, with_a_unit),
        ("EPSG:2263+6360", np.float32, -9999, US_SURVEY_FOOT_M, 0.0, None),
    ],
    ids=["whole numbers with a scale", "a band in feet", "a system in feet"],
)
def test_heights_of_any_unit_are_shown_in_metres_and_what_is_no_height_not_at_all(
    tmp_path: Path, crs: str, kind: type, missing: float, unit_m: float, offset: float, state: Callable | None
):
    rows, columns = np.indices(SHAPE)
    true_m = 5 + 0.01 * columns + 0.02 * rows
    known = columns < 70
    heights = np.where(known, (true_m - offset) / unit_m, missing)
    heights = (np.rint(heights) if kind is np.int16 else heights).astype(kind)
    path = write_surface(tmp_path / "map" / "dsm.tif", heights, CELL, crs=crs)
    if state is not None:
        state(path)
    atlas = Atlas([tmp_path / "map"])
    (layer,) = atlas.sheets[0].layers
    assert 5 < layer.low < layer.high < true_m[known].max()
    for level in (0, atlas.finest):
        content = atlas.tile(0, "height", level, 0, 0)
        assert content is not None
        values = decoded(content)
        assert np.nanmin(values) > 5 - 1e-3
        assert np.nanmax(values) < true_m[known].max() + 1e-3
    (found,) = atlas.at(*corner(20.5, 30.5))
    assert found["height"] == pytest.approx(true_m[30, 20], abs=1e-3)
    (found,) = atlas.at(*corner(80.5, 30.5))
    assert found["height"] is None
    (volumes,) = atlas.area(box(60, 20, 80, 40))["sheets"]
    assert volumes["cells_m2"] == pytest.approx(200 * (CELL * atlas.metre) ** 2)
    assert volumes["above"]["value_m3"] < 1e-2 * volumes["cells_m2"]


def test_two_dates_have_one_scale_of_colours(tmp_path: Path):
    rows, columns = np.indices(SHAPE)
    heights = 5 + 0.01 * columns + 0.02 * rows
    maps = [write_map(tmp_path / f"map 202{k}-01-01", (1, 2, 3), heights - k) for k in range(2)]
    write_surface(maps[1] / "odm_dem" / "dsm_sigma.tif", np.full(SHAPE, 0.05, np.float32), CELL, nodata=-9999.0)
    maps.append(write_map(tmp_path / "map of nothing", (1, 2, 3), np.full(SHAPE, -9999.0)))
    sheets = Atlas([*maps, write_change(tmp_path / "change", np.full(SHAPE, -1, np.float32))]).describe()["sheets"]
    for kind, low, high in (("height", 4.3, 7.3), ("error", 0.02, 0.051)):
        layers = [layer for sheet in sheets for layer in sheet["layers"] if layer["kind"] == kind]
        assert len(layers) >= 2
        assert len({(layer["low"], layer["high"]) for layer in layers}) == 1
        assert (layers[0]["low"], layers[0]["high"]) == pytest.approx((low, high), abs=0.1)


@pytest.mark.parametrize("sentinel", [False, True])
@pytest.mark.parametrize("nodata", [None, math.nan])
def test_cells_that_are_nan_do_not_hide_their_neighbours_when_zoomed_out(
    tmp_path: Path, nodata: float | None, sentinel: bool
):
    heights = np.random.default_rng(0).normal(5, 0.1, (1024, 1024)).astype(np.float32)
    heights[::4, ::4] = np.nan  # some in all that a pixel of level 0 shows
    if sentinel:
        heights[:, :64] = -9999
    write_surface(tmp_path / "dsm.tif", heights, CELL, nodata=nodata)
    write_surface(tmp_path / "dsm_sigma.tif", heights / 100, CELL, nodata=nodata)
    for layer, low, high in (("height", 4, 6), ("error", 0.04, 0.06)):
        content = Atlas([tmp_path]).tile(0, layer, 0, 0, 0)
        assert content is not None
        shown = decoded(content)[:, 20:]
        assert (low < shown).all()
        assert (shown < high).all()


def test_a_tile_of_nothing_and_one_that_is_not_there_are_none(tmp_path: Path):
    heights = np.ones(SHAPE, np.float32)
    heights[40:, 40:] = -9999
    atlas = Atlas([write_map(tmp_path / "map", (1, 2, 3), heights)])
    last = 2**atlas.finest - 1
    assert atlas.tile(0, "height", atlas.finest, last, last) is None
    assert atlas.tile(0, "height", atlas.finest, 0, 0) is not None
    for wrong in ((0, "height", 0, 1, 0), (1, "height", 0, 0, 0), (0, "other", 0, 0, 0), (0, "height", 60, 0, 0)):
        assert atlas.tile(*wrong) is None


def test_values_at_a_place_are_those_of_the_cell_it_lies_in(tmp_path: Path):
    atlas = Atlas([write_map(tmp_path / "map", (1, 2, 3))])
    for column, row in ((0.01, 0.01), (10.99, 7.99), (99.9, 79.9)):
        (found,) = atlas.at(*corner(column, row))
        assert found["height"] == pytest.approx(5 + 0.01 * int(column) + 0.02 * int(row), abs=1e-5)
        assert found["sigma"] == pytest.approx(0.02)
    assert atlas.at(*corner(-0.5, 3)) == [{"height": None, "sigma": None}]


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_errors_on_another_grid_than_the_heights_are_those_of_the_place(tmp_path: Path, scale: float):
    heights = np.full(SHAPE, 5, np.float32)
    heights[24:36, 24:36] = 6
    write_surface(tmp_path / "dsm.tif", heights, CELL)
    rows, columns = (round(2 * side / scale) for side in SHAPE)
    sigma = np.full((rows, columns), 0.02, np.float32)
    sigma[: rows // 2, : columns // 2] = 5  # the quarter in the north-west, where the map is not
    west, north = corner(-SHAPE[1], -SHAPE[0])
    write_surface(tmp_path / "dsm_sigma.tif", sigma, scale * CELL, west, north)
    atlas = Atlas([tmp_path])
    above = atlas.area(box(20, 20, 40, 40))["sheets"][0]["above"]
    assert atlas.at(*corner(30, 30))[0]["sigma"] == pytest.approx(0.02)
    assert above["value_m3"] == pytest.approx(144 * CELL**2)
    # Level ground counts, too, where rounding puts it above the plane.
    assert 0.999 * 1.96 * 0.02 * 144 < (above["high_m3"] - above["value_m3"]) / CELL**2 < 1.001 * 1.96 * 0.02 * 400


def test_errors_that_are_nowhere_in_a_polygon_make_no_interval(tmp_path: Path):
    write_surface(tmp_path / "dsm.tif", 5 + np.eye(*SHAPE, dtype=np.float32), CELL)
    write_surface(tmp_path / "dsm_sigma.tif", np.full((10, 10), 0.02, np.float32), CELL)
    above = Atlas([tmp_path]).area(box(20, 20, 40, 40))["sheets"][0]["above"]
    assert set(above) == {"value_m3"}


@pytest.mark.parametrize("kind", ["map", "change"])
def test_a_large_polygon_takes_little_memory(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch):
    side = 1600
    values = np.random.default_rng(0).normal(5, 0.1, (side, side)).astype(np.float32)
    if kind == "map":
        write_surface(tmp_path / "dsm.tif", values, CELL)
        write_surface(tmp_path / "dsm_sigma.tif", values / 100, CELL)
    else:
        write_change(tmp_path, values, shared=np.full_like(values, 0.01))
    atlas = Atlas([tmp_path])
    corners = box(0, 0, side, side)
    tracemalloc.start()
    (found,) = atlas.area(corners)["sheets"]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found["cells_m2"] == side**2 * CELL**2
    assert peak < 36 * side**2
    monkeypatch.setattr(rasters, "MOST_CELLS", side**2 - 1)
    with pytest.raises(RunError, match=r"covers 1600 x 1600 cells: expected 2,559,999 or fewer; draw a smaller"):
        atlas.area(corners)


def test_a_section_has_heights_and_distances_along_its_line(tmp_path: Path):
    atlas = Atlas([write_map(tmp_path / "map", (1, 2, 3))])
    found = atlas.section(np.array([corner(10, 40.5), corner(50, 40.5), corner(50, 60.5)]))
    assert found["distance"][-1] == pytest.approx(60 * CELL)
    heights = np.array(found["sheets"][0]["height"], dtype=float)
    assert heights[0] == pytest.approx(5 + 0.01 * 10 + 0.02 * 40, abs=1e-5)
    assert heights[-1] == pytest.approx(5 + 0.01 * 50 + 0.02 * 60, abs=1e-5)


def test_the_volume_of_a_change_and_its_interval_are_the_closed_form(tmp_path: Path):
    dz = np.zeros(SHAPE, np.float32)
    dz[10:20, 10:30] = 0.4
    dz[10:20, 30:40] = -0.2
    atlas = Atlas([write_change(tmp_path / "change", dz, sigma=0.03, systematic_m=0.01)])
    found = atlas.area(box(10, 10, 40, 20), detection_m=0.1)
    (volumes,) = found["sheets"]
    assert found["area_m2"] == pytest.approx(300 * CELL**2)
    for name, value in (("net", 200 * 0.4 - 100 * 0.2), ("cut", 100 * 0.2), ("fill", 200 * 0.4)):
        assert volumes[name]["value_m3"] == pytest.approx(value * CELL**2, rel=1e-4)
    half = 1.96 * CELL**2 * math.hypot(0.03 * math.sqrt(300), 0.01 * 300)
    assert volumes["net"]["high_m3"] - volumes["net"]["value_m3"] == pytest.approx(half, rel=1e-3)
    assert "low_m3" not in volumes["cut"] | volumes["fill"], "their cells are chosen by their own errors"
    assert volumes["share"] == 1
    beyond = atlas.area(box(10, 10, 40, 20), detection_m=0.3)["sheets"][0]
    assert beyond["cut"]["value_m3"] == 0
    assert beyond["fill"] == volumes["fill"]


def test_volumes_say_which_share_of_the_polygon_they_are_of(tmp_path: Path):
    heights = np.full(SHAPE, 5, np.float32)
    heights[:, 50:] = -9999
    sigma = np.where(np.arange(SHAPE[1]) < 30, np.float32(0.1), np.float32(-9999)) + np.zeros((SHAPE[0], 1), np.float32)
    folder = write_map(tmp_path / "map", (1, 2, 3), heights)
    write_surface(folder / "odm_dem" / "dsm_sigma.tif", sigma, CELL, nodata=-9999.0)
    dz = np.where(heights > 0, np.float32(0.4), np.float32(np.nan))
    atlas = Atlas([folder, write_change(tmp_path / "change", dz)])
    for volumes in atlas.area(box(40, 10, 60, 20))["sheets"]:
        assert volumes["share"] == pytest.approx(0.5)
    for volumes in atlas.area(box(-20, 10, 20, 20))["sheets"]:
        assert volumes["share"] == pytest.approx(0.5, abs=0.01)
    heap = np.full(SHAPE, 5, np.float32)
    heap[11:19, 21:39] = 4.9
    heap[13:17, 24:36] = 6
    write_surface(folder / "odm_dem" / "dsm.tif", heap, CELL, nodata=-9999.0)
    above = Atlas([folder]).area(box(20, 10, 40, 20))["sheets"][0]["above"]
    half = 1.96 * 0.1 * 48 * CELL**2  # of the heap; of level ground beside it, too, where rounding puts that above
    assert above["high_m3"] - above["value_m3"] > 0.999 * half, "cells without an error have that of the others"


@pytest.mark.parametrize(("crs", "cell"), [("EPSG:3857", 1.0), ("EPSG:4326", 1e-5)])
def test_lengths_are_those_of_the_ground_in_any_system(tmp_path: Path, crs: str, cell: float):
    from pyproj import Transformer

    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(5.0, 53.5)
    write_surface(tmp_path / "map" / "dsm.tif", np.full((200, 200), 3, np.float32), cell, x, y, crs)
    atlas = Atlas([tmp_path / "map"])
    assert (atlas.name, atlas.unit, atlas.metre) == ("WGS 84 / UTM zone 31N", "m", 1.0)
    west, south, east, north = atlas.bounds
    metres = 200 * cell * (0.597 if crs == "EPSG:3857" else 111_300)
    assert north - south == pytest.approx(metres, rel=0.05)
    middle = np.array([(west + east) / 2, (south + north) / 2])
    assert atlas.at(*middle)[0]["height"] == 3
    assert atlas.tile(0, "height", 0, 0, 0) is not None


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857", "EPSG:32631"])
def test_around_a_raster_that_is_turned_into_another_system_there_is_nothing(tmp_path: Path, crs: str):
    import rasterio
    from pyproj import Transformer

    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(-1.0, 51.5)
    cell = 5e-6 if crs == "EPSG:4326" else 0.5
    heights = np.full((100, 200), 30, np.float32)
    masked = write_surface(tmp_path / "masked 2024-01-02" / "dsm.tif", heights, cell, x, y, crs)
    with rasterio.open(masked, "r+") as file:
        file.write_mask(np.repeat([True, False], 50)[:, None] & np.ones(200, bool))
    whole = tmp_path / "whole 2024-01-01"
    write_surface(whole / "dsm.tif", heights, cell, x, y, crs)
    write_surface(whole / "ortho.tif", np.full((3, 100, 200), 90, np.uint8), cell, x, y, crs)
    west, north = Transformer.from_crs("EPSG:4326", "EPSG:32630", always_xy=True).transform(-1.0, 51.5)
    write_surface(tmp_path / "first 2023-01-01" / "dsm.tif", heights, 1.0, west - 50, north + 20)
    atlas = Atlas([masked.parent, whole, tmp_path / "first 2023-01-01"])
    shares = {}
    for sheet, layer in ((1, "height"), (1, "orthophoto"), (2, "height")):
        content = atlas.tile(sheet, layer, 0, 0, 0)
        assert content is not None
        shown = np.asarray(Image.open(io.BytesIO(content)))
        seen = shown[..., 3] > 0
        shares[sheet, layer] = seen.sum()
        if layer == "height":
            assert np.allclose(decoded(content)[seen], 30, atol=STEP)
        else:
            assert (shown[seen] == (90, 90, 90, 255)).all()
    assert shares[2, "height"] == pytest.approx(shares[1, "height"] / 2, rel=0.05)
    assert shares[1, "orthophoto"] == pytest.approx(shares[1, "height"], rel=0.05)


@pytest.mark.parametrize("crs", ["EPSG:32630", None])
def test_orthophotos_that_are_turned_or_have_south_up_are_shown_with_north_up(tmp_path: Path, crs: str | None):
    import rasterio
    from affine import Affine

    picture = np.zeros((3, 100, 100), np.uint8)
    picture[0, :50] = 200  # the first rows are red
    for name, transform, red_at, black_at in (
        ("south up", Affine(0.5, 0, 500_000, 0, 0.5, 2000), (25, 10), (25, 40)),
        ("turned", Affine(0, 0.5, 500_000, 0.5, 0, 2000), (10, 25), (40, 25)),
    ):
        path = write_surface(tmp_path / name / "ortho.tif", picture, crs=crs)
        with rasterio.open(path, "r+") as file:
            file.transform = transform
        atlas = Atlas([tmp_path / name])
        content = atlas.tile(0, "orthophoto", 0, 0, 0)
        assert content is not None
        shown = np.asarray(Image.open(io.BytesIO(content)))
        west, _, _, north = atlas.bounds
        for (east_of, north_of), red in ((red_at, 200), (black_at, 0)):
            x, y = 500_000 + east_of - west, north - (2000 + north_of)
            assert shown[int(y * TILE_PX / atlas.side), int(x * TILE_PX / atlas.side)].tolist() == [red, 0, 0, 255]


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_picture_without_a_place_is_refused(tmp_path: Path):
    write_surface(tmp_path / "ortho.tif", np.zeros((3, 8, 8), np.uint8), size=(1, -1), west=0, north=0, crs=None)
    with pytest.raises(RunError, match=r"ortho\.tif has no place on a map: expected a georeferenced GeoTIFF"):
        Atlas([tmp_path])


def test_maps_over_another_vertical_datum_are_not_warped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name, crs in (("a", "EPSG:32630"), ("b", "EPSG:32630+5773")):
        write_surface(tmp_path / name / "dsm.tif", np.ones(SHAPE, np.float32), CELL, crs=crs)
    monkeypatch.setattr("rasterio.vrt.WarpedVRT", None)
    atlas = Atlas([tmp_path / "a", tmp_path / "b"])
    assert [found["height"] for found in atlas.at(*corner(5, 5))] == [1.0, 1.0]


def test_a_map_without_a_date_does_not_decide_in_which_system_others_are_shown(tmp_path: Path):
    for name, crs in (("undated", "EPSG:32631"), ("flat 2024-05-01", "EPSG:32630")):
        write_surface(tmp_path / name / "dsm.tif", np.ones((8, 8), np.float32), CELL, 5e5, crs=crs)
    atlas = Atlas([tmp_path / "undated", tmp_path / "flat 2024-05-01"])
    assert [sheet.date for sheet in atlas.sheets] == ["2024-05-01", None]
    assert atlas.name == "WGS 84 / UTM zone 30N"


@pytest.mark.parametrize("one", [LOCAL_WKT, 'LOCAL_CS["site",UNIT["foot",0.3048]]'])
def test_two_local_frames_are_refused(tmp_path: Path, one: str):
    for name, crs in (("a", one), ("b", 'LOCAL_CS["site",UNIT["metre",1]]')):
        write_surface(tmp_path / name / "dsm.tif", np.ones((8, 8), np.float32), CELL, crs=crs)
    with pytest.raises(RunError, match=r"a and .*b lie in different local frames: expected maps in one"):
        Atlas([tmp_path / "a", tmp_path / "b"])


def test_a_map_is_of_the_date_that_its_file_states_where_its_folder_states_none(tmp_path: Path):
    import rasterio

    maps = [write_map(tmp_path / name, (1, 2, 3)) for name in ("a", "b", "c 2023-03-01")]
    for folder, date in zip(maps, ("2025:03:01", "2024:03:01", "2022:03:01"), strict=True):
        with rasterio.open(folder / "odm_dem" / "dsm.tif", "r+") as file:
            file.update_tags(TIFFTAG_DATETIME=f"{date} 10:00:00")
    found = [(sheet.title, sheet.date) for sheet in Atlas(maps).sheets]
    assert found == [("c 2023-03-01", "2023-03-01"), ("b", "2024-03-01"), ("a", "2025-03-01")]


def test_the_system_is_that_of_the_first_layer_that_states_one(tmp_path: Path):
    write_surface(tmp_path / "ortho.tif", np.full((3, *SHAPE), 90, np.uint8), 2.0, crs=None)
    write_surface(tmp_path / "dsm.tif", np.ones(SHAPE, np.float32), 2.0, crs="EPSG:2263")
    atlas = Atlas([tmp_path])
    assert atlas.metre == pytest.approx(US_SURVEY_FOOT_M)
    assert "New York Long Island" in atlas.name
    assert atlas.at(WEST + 5, NORTH - 5)[0]["height"] == pytest.approx(1)


@pytest.mark.parametrize(
    "damage",
    [
        *(
            {part: None}
            for part in ("earlier", "later", "level_of_detection_m", "registration", "variogram", "volumes")
        ),
        {"level_of_detection_m": 3},
        {"variogram": {"sill_shares": [0.5], "ranges_m": []}},
        {"variogram": {"sill_shares": [0.5]}},
        {"variogram": {"sill_shares": None, "ranges_m": None}},
    ],
    ids=str,
)
def test_a_change_whose_numbers_are_not_complete_is_refused(tmp_path: Path, damage: dict):
    folder = write_change(tmp_path / "change", np.zeros(SHAPE, np.float32))
    numbers = json.loads((folder / "change.json").read_text())
    (folder / "change.json").write_text(json.dumps(numbers | damage))
    with pytest.raises(RunError, match=r"has no change\.json of a change: expected what `tidefield change` wrote"):
        Atlas([folder])


def test_sheets_of_one_date_have_labels_of_their_own(tmp_path: Path):
    names = ("low 2024-05-01", "high 20240501", "low 2025-05-01", "plain")
    maps = [write_map(tmp_path / name, (1, 2, 3)) for name in names]
    change = write_change(tmp_path / "change", np.zeros(SHAPE, np.float32))  # whose later survey is of 2024-05-03
    labels = [sheet["label"] for sheet in Atlas([*maps, change]).describe()["sheets"]]
    assert labels == ["low 2024-05-01", "2024-05-01 high 20240501", "2024-05-03", "2025-05-01", "plain"]


def test_errors_are_pale_in_the_colours_of_a_change(tmp_path: Path):
    rng = np.random.default_rng(0)
    dz = rng.normal(0, 0.03, SHAPE).astype(np.float32)
    dz[:4, :4] = -0.8  # less than 1% of the cells
    (sheet,) = Atlas([write_change(tmp_path / "change", dz, sigma=0.03)]).describe()["sheets"]
    change = sheet["layers"][0]
    assert change["high"] == -change["low"] == pytest.approx(2 * 1.96 * 0.03)
    assert change["largest"] == pytest.approx(0.8)
    dz[40:] = -0.8
    (sheet,) = Atlas([write_change(tmp_path / "change", dz, sigma=0.03)]).describe()["sheets"]
    assert sheet["layers"][0]["high"] == pytest.approx(0.8)


def test_errors_of_heights_are_those_that_change_uses(tmp_path: Path):
    write_surface(tmp_path / "dtm.tif", np.ones((8, 8), np.float32), CELL)
    write_surface(tmp_path / "dtm_standard_error.tif", np.full((8, 8), 0.04, np.float32), CELL)
    assert Atlas([tmp_path]).at(*corner(2, 2))[0]["sigma"] == pytest.approx(0.04)


def test_a_polygon_without_values_has_no_volume(tmp_path: Path):
    heights = np.full(SHAPE, np.nan, np.float32)
    heights[:, :10] = 1
    plain = write_map(tmp_path / "map", (1, 2, 3), np.nan_to_num(heights, nan=-9999))
    atlas = Atlas([plain, write_change(tmp_path / "change", heights)])
    assert atlas.area(box(20, 10, 40, 20))["sheets"] == [{}, {}]


def test_a_shift_error_that_was_stated_is_not_widened_for_little_stable_ground(tmp_path: Path):
    shared = np.full(SHAPE, math.hypot(0.01, 0.02), np.float32)  # on an even slope
    folder = write_change(tmp_path / "change", np.full(SHAPE, 0.4, np.float32), 0.03, 0.01, shared=shared)
    numbers = json.loads((folder / "change.json").read_text())
    numbers["volumes"] = {"net": {"degrees_of_freedom": 3.0}}
    numbers["registration"]["model"] = "vertical"
    factors = []
    for stated in (False, True):
        numbers["registration"]["shift_error_stated"] = stated
        (folder / "change.json").write_text(json.dumps(numbers))
        net = Atlas([folder]).area(box(10, 10, 40, 20))["sheets"][0]["net"]
        half = CELL**2 * math.hypot(0.03 * math.sqrt(300), float(shared[0, 0]) * 300)
        factors.append((net["high_m3"] - net["value_m3"]) / half)
    assert factors[0] > 3
    # A fifth of the variance was measured: Satterthwaite's degrees of freedom are 25 times as many.
    assert factors[1] == pytest.approx(1.99, abs=0.01)


def test_errors_are_in_the_unit_of_their_heights(tmp_path: Path):
    import rasterio

    folder = write_map(tmp_path / "map", (1, 2, 3))
    with rasterio.open(folder / "odm_dem" / "dsm.tif", "r+") as file:
        file.units = ("ft",)
    (found,) = Atlas([folder]).at(*corner(20.5, 30.5))
    assert found["height"] == pytest.approx(0.3048 * (5 + 0.2 + 0.6), abs=1e-4)
    assert found["sigma"] == pytest.approx(0.3048 * 0.02, abs=1e-5)


def test_what_is_systematic_on_a_slope_adds_up_in_its_volume(tmp_path: Path):
    dz, steep = np.full(SHAPE, 0.4, np.float32), np.linspace(0, 0.05, SHAPE[1], dtype=np.float32)
    shared = np.broadcast_to(steep, SHAPE)
    atlas = Atlas([write_change(tmp_path / "change", dz, sigma=0.03, systematic_m=0.001, shared=shared)])
    net = atlas.area(box(10, 10, 40, 20))["sheets"][0]["net"]
    half = 1.96 * CELL**2 * math.hypot(0.03 * math.sqrt(300), float(shared[10:20, 10:40].sum()))
    assert net["high_m3"] - net["value_m3"] == pytest.approx(half, rel=1e-3)


def test_a_datum_error_that_was_stated_is_not_widened_for_little_stable_ground(tmp_path: Path):
    folder = write_change(tmp_path / "change", np.full(SHAPE, 0.4, np.float32), sigma=0.03, systematic_m=0.01)
    numbers = json.loads((folder / "change.json").read_text())
    numbers["volumes"] = {"net": {"degrees_of_freedom": 1.0}}
    for stated, factor in ((0.0, 5.0), (0.01, 1.96)):
        numbers["registration"]["datum_error_m"] = stated
        (folder / "change.json").write_text(json.dumps(numbers))
        net = Atlas([folder]).area(box(10, 10, 40, 20))["sheets"][0]["net"]
        half = CELL**2 * math.hypot(0.03 * math.sqrt(300), 0.01 * 300)
        found = (net["high_m3"] - net["value_m3"]) / half
        assert found > factor if stated == 0 else found == pytest.approx(factor, rel=1e-3)


def test_a_heap_on_sloping_ground_has_its_volume_above_the_polygons_rim(tmp_path: Path):
    rows, columns = np.indices(SHAPE)
    ground = 5 + 0.01 * columns + 0.02 * rows
    ground[30:40, 40:60] += 1.5
    atlas = Atlas([write_map(tmp_path / "map", (1, 2, 3), ground)])
    (volumes,) = atlas.area(box(30, 20, 70, 50))["sheets"]
    assert volumes["above"]["value_m3"] == pytest.approx(200 * 1.5 * CELL**2, rel=0.05)
    assert volumes["above"]["low_m3"] < 200 * 1.5 * CELL**2 < volumes["above"]["high_m3"]


def test_maps_in_another_system_are_shown_in_the_first_ones(tmp_path: Path):
    from pyproj import Transformer

    first = write_map(tmp_path / "first 2023-05-01", (1, 2, 3))
    second = write_map(tmp_path / "second 2024-05-01", (1, 2, 3))
    to_31 = Transformer.from_crs("EPSG:32630", "EPSG:32631", always_xy=True)
    x, y = to_31.transform(*corner(SHAPE[1] / 2, SHAPE[0] / 2))
    flat = np.full((400, 400), 7.0, np.float32)
    write_surface(second / "odm_dem" / "dsm.tif", flat, CELL, x - 100, y + 100, "EPSG:32631", -9999.0)
    for name in ("odm_dem/dsm_sigma.tif", "odm_orthophoto/odm_orthophoto.tif"):
        (second / name).unlink()
    atlas = Atlas([second, first])
    assert [sheet.date for sheet in atlas.sheets] == ["2023-05-01", "2024-05-01"]
    found = atlas.at(*corner(50.5, 40.5))
    assert found[0]["height"] == pytest.approx(5 + 0.5 + 0.8, abs=1e-5)
    assert found[1]["height"] == pytest.approx(7.0)


def test_what_the_page_is_told_names_no_folders_place(tmp_path: Path):
    atlas = Atlas([write_map(tmp_path / "a" / "map", (1, 2, 3)), write_map(tmp_path / "b" / "map", (4, 5, 6))])
    told = json.dumps(atlas.describe())
    assert [sheet["title"] for sheet in json.loads(told)["sheets"]] == ["a/map", "b/map"]
    assert str(tmp_path) not in told
    assert tmp_path.name not in told


def test_polygons_and_folders_that_cannot_be_used_are_one_clear_error(tmp_path: Path):
    folder = write_map(tmp_path / "map", (1, 2, 3))
    atlas = Atlas([folder])
    with pytest.raises(RunError, match="crosses itself, or has no area: expected one that does not"):
        atlas.area(box(10, 10, 40, 20)[[0, 2, 1, 3]])
    with pytest.raises(RunError, match="the section has no length"):
        atlas.section(np.array([corner(1, 1), corner(1, 1)]))
    assert is_sheet(folder)
    assert not is_sheet(tmp_path)
    far = tmp_path / "far"
    write_surface(far / "odm_dem" / "dsm.tif", np.ones((8, 8), np.float32), 0.01, west=9e6, north=2e6)
    with pytest.raises(RunError, match="apart: expected maps of one place"):
        Atlas([folder, far])
    (folder / "odm_dem" / "dsm.tif").write_bytes(b"II*\0 not a raster")
    with pytest.raises(TidefieldError, match=r"dsm\.tif is not a raster that can be read"):
        Atlas([folder])
