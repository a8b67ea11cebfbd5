"""Folders of `tidefield map` as inputs, written by the map's own writers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from markupsafe import Markup
from surveys_of_two_dates import pair

from tidefield import cli
from tidefield.change.inputs import open_pair, open_survey
from tidefield.change.measure import Options, measure
from tidefield.change.page import limits
from tidefield.change.surfaces import ChangeError
from tidefield.change.water import measure_water
from tidefield.geometry.geodesy import LocalFrame
from tidefield.maps.classes import GROUND, WATER
from tidefield.maps.cloud import cloud_writer
from tidefield.maps.grid import LOCAL_NAME, LOCAL_WKT, Grid, MapFrame
from tidefield.maps.make import CLASSES, CLOUD, DSM, FILLED, ORTHOPHOTO, SIGMA
from tidefield.maps.rasters import NODATA, Raster, raster_writer

rasterio = pytest.importorskip("rasterio")
SIGMA_M = 0.02


def frame(georeferenced: bool) -> MapFrame:
    if not georeferenced:
        return MapFrame(None, np.zeros(3), np.eye(3), LOCAL_WKT, LOCAL_WKT, "local, without a datum")
    local = LocalFrame.at("EPSG:32630", (400_000.0, 5_700_000.0, 0.0))
    from pyproj import CRS

    wkt = CRS("EPSG:32630").to_wkt()
    return MapFrame(local, np.zeros(3), np.eye(3), wkt, wkt, local.vertical_datum)


def write_map(
    folder: Path,
    heights: np.ndarray,
    georeferenced: bool,
    filled: np.ndarray | None = None,
    classes: np.ndarray | None = None,
) -> Path:
    """The files of a map that change reads, as `tidefield.maps.make.join` writes them."""
    of = frame(georeferenced)
    west, north = (400_000.0, 5_700_000.0) if georeferenced else (-60.0, 50.0)
    grid = Grid(of, west, north, 0.5, heights.shape[1], heights.shape[0], 3.0)
    shown = np.isfinite(heights)
    colour = np.full((3, *heights.shape), 120, np.uint8)
    rasters = [
        (Raster(folder / ORTHOPHOTO, ("red", "green", "blue", "alpha"), "uint8", None), [*colour, shown * 255]),
        (Raster(folder / DSM, ("height of the surface",), unit="m"), [np.where(shown, heights, NODATA)]),
        (Raster(folder / SIGMA, ("standard error of the height",), unit="m"), [np.where(shown, SIGMA_M, NODATA)]),
    ]
    if filled is not None:
        raster = Raster(folder / FILLED, ("1 where the map is filled",), "uint8", 255.0, average=False)
        rasters.append((raster, [filled]))
    if classes is not None:
        rasters.append((Raster(folder / CLASSES, ("class",), "uint8", 0.0, average=False), [classes]))
    for raster, bands in rasters:
        raster.path.parent.mkdir(parents=True, exist_ok=True)
        with raster_writer(raster, grid) as writer:
            writer.write(0, np.stack(bands))
    with cloud_writer(folder / CLOUD, grid) as cloud:
        sigma, count = np.full(heights.shape, SIGMA_M), np.full(heights.shape, 5)
        cloud.write(0, heights, sigma, colour, count, np.full(heights.shape, GROUND))
    return folder


def surfaces(tmp_path: Path, depth: float = 0.2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    paths = pair(tmp_path, 3, depth)
    earlier, later = (rasterio.open(path).read(1) for path in paths[:2])
    earlier[:20, :20] = np.nan
    return earlier, later, paths[2]


def test_two_folders_of_maps_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tidefield.change.figures.png", lambda *_: Markup("<img>"))
    earlier, later, truth = surfaces(tmp_path)
    filled = np.where(np.isfinite(later), np.uint8(0), np.uint8(255))
    filled[100:120, 100:120] = 1
    one = write_map(tmp_path / "map-2023-05-01", earlier, False)
    two = write_map(tmp_path / "map-2024-05-01", later, False, filled)
    cli._run(["change", str(one), str(two), str(tmp_path / "out"), "-q"])
    numbers = json.loads((tmp_path / "out" / "change.json").read_text())
    assert (numbers["earlier"]["date"], numbers["later"]["date"]) == ("2023-05-01", "2024-05-01")
    assert numbers["earlier"]["file"] == "map-2023-05-01"
    assert numbers["earlier"]["sigma"] == numbers["later"]["sigma"] == "dsm_sigma.tif"
    cut = numbers["volumes"]["cut"]
    assert cut["low_m3"] < -truth[truth < 0].sum() * 0.25 < cut["high_m3"]
    assert any("local frame" in remark for remark in numbers["remarks"])
    # Neither what the map left empty nor what it filled in is compared.
    assert numbers["cells"] == truth.size - 400 - 400
    filled_in = "0.8% of the cells, 100 m², were filled in at one date or both and not measured (filled.tif): left out"
    assert filled_in in numbers["remarks"]
    assert not any("no standard error" in remark for remark in numbers["remarks"])
    with rasterio.open(tmp_path / "out" / "change.tif") as file:
        assert np.isnan(file.read(1)[100:120, 100:120]).all()


def test_the_tide_is_no_change_of_the_ground(tmp_path: Path):
    low, high, slope = 2.0, 2.4, 0.02
    maps, grounds = [], []
    for name, heights, level in zip("ab", surfaces(tmp_path, 0.0), (low, high), strict=False):
        away = 0.5 * np.maximum(0, np.arange(heights.shape[1], dtype=np.float32) - 60)
        ground = heights - (slope + 0.004) * away  # on ground that rises by 0.004
        wet = ground < level
        classes = np.where(np.isfinite(heights), np.where(wet, np.uint8(WATER), np.uint8(GROUND)), 0)
        maps.append(write_map(tmp_path / name, np.where(wet, level, ground).astype(np.float32), True, None, classes))
        grounds.append(wet)
    flooded = grounds[0] | grounds[1]
    assert flooded.mean() > 0.2
    one, two = (open_survey(path) for path in maps)
    found = measure(one, two, Options(shift="none"))
    assert not found.outlines.signs.tolist()
    np.testing.assert_array_equal(np.isnan(found.dz), flooded | ~np.isfinite(surfaces(tmp_path, 0.0)[0]))
    low_m3, high_m3 = found.net.interval_m3
    assert low_m3 < 0 < high_m3
    assert any("are water at one date or both" in remark for remark in found.remarks)
    line = measure_water(found, (low, high), ()).waterline
    assert line is not None
    assert line.land_lost.value_m2 == pytest.approx(100 * (high - low) / slope, rel=0.1)
    assert not any(word.startswith("Plants and water") for word in limits(found))
    dry = measure(*(replace(survey, classes=None) for survey in (one, two)), Options(shift="none"))
    assert dry.fill.value_m3 > 0.1 * flooded.sum() * 0.25


def test_maps_in_a_known_system_bring_it_and_their_clouds(tmp_path: Path):
    earlier, later, _ = surfaces(tmp_path)
    one, two = (write_map(tmp_path / name, heights, True) for name, heights in (("a", earlier), ("b", later)))
    found = open_pair(one, two, tmp_path, with_clouds=True)
    assert found.earlier.crs is not None
    assert found.earlier.crs.to_epsg() == 32630
    assert found.clouds is not None
    assert len(found.clouds[0].xyz) == np.isfinite(earlier).sum()
    assert found.clouds[0].sigma is not None
    assert found.clouds[0].sigma.max() == pytest.approx(SIGMA_M)


def test_models_of_one_kind_are_compared(tmp_path: Path):
    from surveys_of_two_dates import write_surface

    flat = np.zeros((20, 20), np.float32)
    for name in ("both/odm_dem/dsm.tif", "both/odm_dem/dtm.tif", "bare/odm_dem/dtm.tif", "top/dsm.tif"):
        write_surface(tmp_path / name, flat)
    both, bare, top = (tmp_path / name for name in ("both", "bare", "top"))

    def kinds(one: Path, other: Path) -> tuple[list[str], bool]:
        found = open_pair(one, other, tmp_path)
        remarks = [*found.earlier.remarks, *found.later.remarks]
        return [found.earlier.path.stem, found.later.path.stem], any("a terrain model" in text for text in remarks)

    assert kinds(both, both) == (["dsm", "dsm"], False)
    assert kinds(both, bare) == (["dtm", "dtm"], False)
    assert kinds(both, bare / "odm_dem" / "dtm.tif") == (["dtm", "dtm"], False)
    assert kinds(top, bare) == (["dsm", "dtm"], True)
    heights = write_surface(tmp_path / "2024.tif", flat)
    assert kinds(both, heights) == (["dsm", "2024"], False)


def test_surveys_that_are_called_the_same_are_told_apart_by_their_folders(tmp_path: Path):
    earlier, later, _ = surfaces(tmp_path)
    one, two = (write_map(tmp_path / name / "out" / "map", earlier, True) for name in ("spring", "autumn"))
    found = open_pair(one, two, tmp_path)
    assert (found.earlier.name, found.later.name) == ("spring/out/map", "autumn/out/map")
    dated = open_pair(one, two, tmp_path, ("2024-01-01", "2024-02-01"))
    assert (dated.earlier.name, dated.later.name) == ("2024-01-01", "2024-02-01")
    other = write_map(tmp_path / "autumn" / "out" / "later", later, True)
    assert open_pair(two, other, tmp_path).later.name == "later"
    assert open_pair(one, one, tmp_path).later.name == "map"


def test_a_map_finds_its_files_and_states_its_frame(tmp_path: Path):
    heights = surfaces(tmp_path)[0]
    found = open_survey(write_map(tmp_path / "map", heights, False))
    assert found.path == tmp_path / "map" / DSM
    assert found.sigma == tmp_path / "map" / SIGMA
    assert found.orthophoto == tmp_path / "map" / ORTHOPHOTO
    assert found.cloud == tmp_path / "map" / CLOUD
    assert found.crs is None
    assert found.nodata == NODATA
    with rasterio.open(found.path) as dataset:
        assert LOCAL_NAME in dataset.crs.to_wkt()


def test_the_surface_of_a_map_brings_its_filled_cells(tmp_path: Path):
    heights = surfaces(tmp_path)[0]
    folder = write_map(tmp_path / "map", heights, False, np.ones(heights.shape, np.uint8))
    assert open_survey(folder / DSM).filled == open_survey(folder).filled == folder / FILLED
    other = (folder / DSM).rename((folder / DSM).with_name("lidar.tif"))
    assert open_survey(other).filled is None


def test_an_orthophoto_without_colours_is_left_out_with_a_remark(tmp_path: Path):
    from surveys_of_two_dates import write_surface

    heights = np.random.default_rng(0).normal(size=(60, 60)).astype(np.float32)
    for picture in (heights, np.stack([heights] * 3)):
        write_surface(tmp_path / "map" / "dsm.tif", heights)
        write_surface(tmp_path / "map" / "orthophoto.tif", picture)
        found = open_survey(tmp_path / "map")
        assert found.orthophoto is None
        assert any("orthophoto.tif" in remark and "float32" in remark for remark in found.remarks)
    write_surface(tmp_path / "map" / "orthophoto.tif", np.zeros((3, 60, 60), np.uint16))
    assert open_survey(tmp_path / "map").orthophoto is not None


def test_clouds_without_the_system_of_their_surfaces_are_refused_before_anything_is_measured(tmp_path: Path):
    import laspy

    heights = surfaces(tmp_path)[0]
    one, two = (write_map(tmp_path / name, heights, True) for name in ("a", "b"))
    for folder in (one, two):
        las = laspy.read(folder / CLOUD)
        las.header.vlrs.clear()
        las.write(folder / CLOUD)
    with pytest.raises(ChangeError, match="has no coordinate system"):
        open_pair(one, two, tmp_path, with_clouds=True)


def test_surfaces_over_two_ellipsoids_are_refused_without_registration(tmp_path: Path):
    from surveys_of_two_dates import write_surface

    heights = np.zeros((20, 20), np.float32)
    one, other = (
        write_surface(tmp_path / f"{name}.tif", heights, 1e-5, -75.0, 40.0, system)
        for name, system in (("a", "EPSG:4979"), ("b", "EPSG:6319"))
    )
    found = open_pair(one, other, tmp_path)
    with pytest.raises(ChangeError, match=r"vertical datums.*WGS 84.*NAD83\(2011\); expected one"):
        measure(found.earlier, found.later, Options(register="none"))
    with pytest.raises(ChangeError, match="different vertical datums"):
        cli._run(["change", str(one), str(other), str(tmp_path / "out"), "--register", "none"])


def test_a_local_map_and_a_georeferenced_one_are_refused(tmp_path: Path):
    heights = surfaces(tmp_path)[0]
    one, two = (open_survey(write_map(tmp_path / str(g), heights, g)) for g in (True, False))
    with pytest.raises(ChangeError, match="True has a coordinate system, False has none"):
        measure(one, two)


def test_a_cloud_of_another_format_is_named_as_one(tmp_path: Path):
    path = tmp_path / "odm.ply"
    path.write_bytes(b"ply\n")
    with pytest.raises(ChangeError, match="is a point cloud of another format: expected LAS or LAZ; convert it"):
        open_survey(path)
