"""`tidefield map` on a built-in flat whose every height and colour is known."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from tidefield.change.inputs import open_survey
from tidefield.commands.common import ZeroShot
from tidefield.commands.map_ import Map, map_
from tidefield.data.georeference import Georeference, Residuals
from tidefield.errors import RunError
from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.similarity import Similarity
from tidefield.maps import figures, make, terrain
from tidefield.maps.make import AGREEMENT, CLASSES, CLOUD, DSM, MAIN, MAP_FILE, ORTHOPHOTO, SIGMA, VIEWS
from tidefield.synthetic import Flight, make_survey, write_survey

rasterio = pytest.importorskip("rasterio")
laspy = pytest.importorskip("laspy")
QUIET = Console(quiet=True)
FRAME = LocalFrame.at("EPSG:27700+5701", (351_200.0, 512_900.0, 260.0))
AREA = 5.0
"""Half the side of the square that is mapped, metres: a few tiles."""


def polygon(folder: Path, half: float = AREA, east: float = 0.0, north: float = 0.0) -> Path:
    corners = [
        [east - half, north - half],
        [east + half, north - half],
        [east + half, north + half],
        [east - half, north + half],
        [east - half, north - half],
    ]
    path = folder / f"area_{half:g}_{east:g}.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [corners]}))
    return path


def mapped(scene: Path, out: Path, **options: Any) -> dict[str, Any]:
    return map_(Map(scene, out, ZeroShot(zero_shot=True), device="cpu", **options), QUIET)


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(make, "LARGEST_TILE", 32)
        patch.setattr(make, "SMALLEST_TILE", 32)
        patch.setattr(make, "CLOUD_ROWS", 8)
        patch.setattr(terrain, "ROWS", 20)
        patch.setattr(figures, "_DPI", 20)
        yield


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine photographs of bare, textured ground, with uneven exposures."""
    folder = tmp_path_factory.mktemp("flat") / "scene"
    flight = Flight(exposure_spread=0.15)
    write_survey(make_survey("ground_textures", seed=4, views=9, width=240, flight=flight, supersample=1), folder)
    return folder


@pytest.fixture(scope="module")
def out(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("map")
    mapped(scene, folder / "map", area=polygon(folder))
    return folder / "map"


def truth(scene: Path, dataset: Any) -> tuple[np.ndarray, np.ndarray]:
    """Heights and colours of the flat at the centres of a raster's cells."""
    import cv2

    about = json.loads((scene / "truth" / "truth.json").read_text())["map"]
    west, north = about["first_pixel_centre_east_north_m"]
    cell = about["pixel_step_east_north_m"][0]
    columns, rows = np.meshgrid(np.arange(dataset.width), np.arange(dataset.height))
    east, up = dataset.xy(rows.ravel(), columns.ravel())
    u = ((np.array(east) - west) / cell).reshape(rows.shape).astype(np.float32)
    v = ((north - np.array(up)) / cell).reshape(rows.shape).astype(np.float32)
    height = cv2.remap(np.load(scene / "truth" / "surface.npy"), u, v, cv2.INTER_LINEAR)
    colour = cv2.cvtColor(cv2.imread(str(scene / "truth" / "orthophoto.png")), cv2.COLOR_BGR2RGB)
    return height, cv2.remap(colour, u, v, cv2.INTER_LINEAR)


def test_heights_are_those_of_the_flat_and_their_errors_are_stated(scene: Path, out: Path):
    with rasterio.open(out / DSM) as dsm, rasterio.open(out / SIGMA) as sigma:
        error = dsm.read(1, masked=True) - truth(scene, dsm)[0]
        stated = sigma.read(1, masked=True)
        cell = dsm.transform.a
    assert error.count() > 0.99 * error.size
    nmad = 1.4826 * np.ma.median(abs(error - np.ma.median(error)))
    assert nmad < 0.35 * cell
    assert abs(np.ma.median(error)) < 0.2 * cell
    assert 0.85 < (abs(error) < 1.96 * stated).mean() <= 1


def test_the_orthophoto_shows_the_flat_in_its_place(scene: Path, out: Path):
    with rasterio.open(out / ORTHOPHOTO) as ortho:
        shown = ortho.read([1, 2, 3]).transpose(1, 2, 0).astype(float)
        colour = truth(scene, ortho)[1].astype(float)
    # The common exposure of photographs differs from the truth by one factor per channel.
    shown *= colour.mean((0, 1)) / shown.mean((0, 1))
    error = np.sqrt(((shown - colour) ** 2).mean())
    shifted = np.sqrt(((shown[:, 2:] - colour[:, :-2]) ** 2).mean())
    assert error < 0.7 * shifted
    assert 20 * np.log10(255 / error) > 27


def test_rasters_are_cloud_optimised_and_say_that_the_frame_is_local(out: Path):
    from rio_cogeo import cog_validate

    for name in (ORTHOPHOTO, DSM, SIGMA, VIEWS, MAIN, AGREEMENT, CLASSES):
        valid, errors, _ = cog_validate(out / name)
        assert valid, errors
        with rasterio.open(out / name) as dataset:
            assert "not georeferenced" in dataset.crs.to_wkt()
            assert dataset.tags()["COORDINATES"].startswith("local frame")
    with rasterio.open(out / VIEWS) as views, rasterio.open(out / MAIN) as main:
        assert views.read(1).min() >= 2
        assert main.read(1).min() >= 1
        assert main.read(1).max() <= len(json.loads(main.tags()["PHOTOGRAPHS"]))


def test_terrain_contours_and_hillshades_lie_on_the_same_cells(out: Path):
    with rasterio.open(out / DSM) as dsm, rasterio.open(out / make.DTM) as dtm:
        surface, ground = dsm.read(1, masked=True), dtm.read(1, masked=True)
    assert (ground <= surface).all() or np.percentile(ground - surface, 99) < 0.1
    with rasterio.open(out / make.DTM_HILLSHADE) as shade:
        assert shade.read(1).min() >= 1
    about = json.loads((out / MAP_FILE).read_text())["contours"]
    assert len(json.loads((out / "contours" / "contours.geojson").read_text())["features"]) == about["lines"] > 0


def test_the_report_shows_the_map_without_the_network(out: Path):
    page = (out / "odm_report" / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 5
    assert "http://" not in page
    assert "not georeferenced" in page
    assert "height (units)" in page
    assert "how far this map is from surveyed points is not known" in page


def test_the_point_cloud_has_a_point_of_every_cell(out: Path):
    cloud = laspy.read(out / CLOUD)
    assert (cloud.header.version.major, cloud.header.version.minor, cloud.header.point_format.id) == (1, 4, 7)
    with rasterio.open(out / DSM) as dsm, rasterio.open(out / SIGMA) as sigma:
        rows, columns = rasterio.transform.rowcol(dsm.transform, np.array(cloud.x), np.array(cloud.y))
        assert len(cloud.points) == dsm.read(1, masked=True).count()
        np.testing.assert_allclose(dsm.read(1)[rows, columns], cloud.z, atol=1e-3)
        np.testing.assert_allclose(sigma.read(1)[rows, columns], cloud.sigma_z)
    assert np.array(cloud.views).min() >= 2
    with rasterio.open(out / CLASSES) as classes:
        np.testing.assert_array_equal(classes.read(1)[rows, columns], cloud.classification)
    assert "not georeferenced" in cloud.header.parse_crs().name


@pytest.mark.thorough
def test_a_map_that_was_killed_continues_and_is_the_same(scene: Path, out: Path, tmp_path: Path):
    rendered, again = make.render_tile, []

    def killed(*arguments: Any) -> Any:
        again.append(1)
        if len(again) == 3:
            raise KeyboardInterrupt
        return rendered(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(make, "render_tile", killed)
        with pytest.raises(KeyboardInterrupt):
            mapped(scene, tmp_path / "map", area=polygon(tmp_path))
        assert len(list((tmp_path / "map" / make.TILES).glob("*.npz"))) == 2
        mapped(scene, tmp_path / "map", area=polygon(tmp_path))
    assert len(again) == 1 + 4  # the one that was killed is rendered again, the two before it are not
    with rasterio.open(out / DSM) as one, rasterio.open(tmp_path / "map" / DSM) as other:
        np.testing.assert_array_equal(one.read(1), other.read(1))
    assert not (tmp_path / "map" / make.TILES).exists()


@pytest.mark.thorough
def test_a_map_does_not_continue_with_other_photographs(scene: Path, tmp_path: Path):
    copy = shutil.copytree(scene, tmp_path / "scene")

    def killed(*_: Any) -> Any:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(make, "render_tile", killed)
        for _ in range(2):  # what was not changed goes on
            with pytest.raises(KeyboardInterrupt):
                mapped(copy, tmp_path / "map", area=polygon(tmp_path))
        photograph = min((copy / "images").iterdir())
        photograph.write_bytes(photograph.read_bytes() + b"0")
        with pytest.raises(RunError, match="another scene or with other options"):
            mapped(copy, tmp_path / "map", area=polygon(tmp_path))


def test_a_finished_or_foreign_folder_is_not_overwritten(scene: Path, out: Path, tmp_path: Path):
    before = (out / MAP_FILE).read_bytes()
    with pytest.raises(RunError, match="holds this map already"):
        mapped(scene, out, area=polygon(tmp_path))
    with pytest.raises(RunError, match="another scene or with other options"):
        mapped(scene, out, area=polygon(tmp_path), gsd=0.5)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("precious")
    with pytest.raises(RunError, match="holds something else"):
        mapped(scene, tmp_path / "mine")
    assert (out / MAP_FILE).read_bytes() == before


@pytest.mark.thorough
def test_a_filled_map_has_no_holes_even_where_no_two_photographs_see_a_tile(
    scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    mapped(scene, tmp_path / "map", area=polygon(tmp_path, 8.0, 32.0, 25.0), gsd=0.25, fill=True)
    assert [record.getMessage() for record in caplog.records if "its unit counts as a metre" in record.getMessage()]
    found = {}
    for name in (DSM, SIGMA, ORTHOPHOTO, VIEWS, CLASSES, make.FILLED):
        with rasterio.open(tmp_path / "map" / name) as dataset:
            found[name] = dataset.read(masked=True)[-1]
    views, filled = found[VIEWS].data, found[make.FILLED].data
    assert (views[:32, -32:] < 2).all()  # more than a tile's own cells
    assert ((filled == 1) == (views < 2)).all()
    assert (found[ORTHOPHOTO].data == 255).all()
    assert not found[DSM].mask.any()
    # What no two photographs show is level, and they do not agree there: it is no water for all that.
    assert not (found[CLASSES] == 9).any()
    assert np.median(found[SIGMA].data[:32, -32:]) > 0.5


@pytest.mark.thorough
def test_a_map_that_replaces_another_has_none_of_its_files(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def files(folder: Path) -> set[str]:
        found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
        return {name for name in found if not name.startswith((make.TILES, ".lock"))}

    def killed(*_: Any) -> Any:
        raise KeyboardInterrupt

    own, lines, small = tmp_path / "map", tmp_path / "lines.geojson", polygon(tmp_path, 2.0)
    lines.write_text(json.dumps({"type": "LineString", "coordinates": [[-1, 0], [1, 0]]}))
    mapped(scene, own, area=small, fill=True, sections=lines)
    assert files(own) == {MAP_FILE, *make.PRODUCTS}
    (own / "odm_dem" / "notes.txt").write_text("mine")
    with monkeypatch.context() as patch:
        patch.setattr(make, "join", killed)
        with pytest.raises(KeyboardInterrupt):
            mapped(scene, own, area=small, overwrite=True)
    assert files(own) == {MAP_FILE, "odm_dem/notes.txt"}
    mapped(scene, own, area=small)
    assert open_survey(own).filled is None
    left = {name for name in make.PRODUCTS if name != make.FILLED and not name.startswith(make.SECTIONS)}
    assert files(own) == {MAP_FILE, "odm_dem/notes.txt", *left}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gsd": 0.001}, "finer cells would show no more"),
        ({"gsd": float("nan")}, "expected at least"),
        ({"heights": "EPSG:5701"}, "not georeferenced"),
        ({"area": (10.0, 5000.0)}, "within the survey"),
    ],
)
def test_what_cannot_be_mapped_is_refused_in_one_sentence(
    scene: Path, tmp_path: Path, options: dict[str, Any], message: str
):
    if "area" in options:
        options = {"area": polygon(tmp_path, *options["area"])}
    with pytest.raises(RunError, match=message):
        mapped(scene, tmp_path / "map", **options)
    assert not (tmp_path / "map").exists()


def test_a_damaged_area_is_refused(scene: Path, tmp_path: Path):
    for text, message in (("{", "no GeoJSON"), ('{"type": "Point", "coordinates": [0, 0]}', "has no Polygon")):
        (tmp_path / "area.geojson").write_text(text)
        with pytest.raises(RunError, match=message):
            mapped(scene, tmp_path / "map", area=tmp_path / "area.geojson")


def test_a_georeferenced_map_has_a_compound_system_and_its_coordinates(scene: Path, tmp_path: Path):
    import shutil

    shutil.copytree(scene, tmp_path / "scene")
    there = Similarity(1.0, np.eye(3), np.zeros(3))
    Georeference(FRAME, "GPS", there, Residuals(), Residuals(), Residuals(), (), ()).write(tmp_path / "scene")
    corners = FRAME.to_geographic(np.array([[x, y, 0.0] for x, y in ((-2, -2), (2, -2), (2, 2), (-2, 2), (-2, -2))]))
    area = {
        "type": "Feature",
        "properties": {},
        "geometry": {"type": "Polygon", "coordinates": [corners[:, :2].tolist()]},
    }
    (tmp_path / "area.geojson").write_text(json.dumps(area))
    mapped(tmp_path / "scene", tmp_path / "map", area=tmp_path / "area.geojson")
    with rasterio.open(tmp_path / "map" / DSM) as dsm:
        assert dsm.crs.to_epsg() == 7405  # British National Grid and ODN height
        values = dsm.read(1, masked=True)
        rows, columns = np.nonzero(~np.ma.getmaskarray(values))
        east, north = dsm.xy(rows, columns)
        world = FRAME.from_crs(np.column_stack([east, north, values[rows, columns]]))
        assert abs(world[:, :2]).max() < 2.2
        assert dsm.transform.c % dsm.transform.a == pytest.approx(0, abs=1e-6)
    cloud = laspy.read(tmp_path / "map" / CLOUD)
    assert cloud.header.parse_crs().to_epsg() == 7405


def test_photographs_leave_no_steps_on_flat_mud(scene: Path, out: Path):
    """Where the photograph that contributes most changes, the map keeps the flat's colours to a grey value or two."""
    with rasterio.open(out / ORTHOPHOTO) as ortho, rasterio.open(out / MAIN) as main:
        shown = ortho.read([1, 2, 3]).transpose(1, 2, 0).astype(float)
        colour = truth(scene, ortho)[1].astype(float)
        photograph = main.read(1)
    gain = colour.mean((0, 1)) / shown.mean((0, 1))
    error = (shown * gain - colour).mean(2)
    about = json.loads((scene / "truth" / "truth.json").read_text())["gain"]
    gains = np.array([np.mean(about[name]) for name in sorted(about)])
    steps: dict[tuple[int, int], list[float]] = {}
    for a, b, left, right in (
        (error[:, :-1], error[:, 1:], photograph[:, :-1], photograph[:, 1:]),
        (error[:-1], error[1:], photograph[:-1], photograph[1:]),
    ):
        for row, column in zip(*np.nonzero(left != right), strict=True):
            one, other = int(left[row, column]), int(right[row, column])
            step = b[row, column] - a[row, column]
            steps.setdefault((min(one, other), max(one, other)), []).append(step if one < other else -step)
    long = {pair: np.array(values) for pair, values in steps.items() if len(values) >= 12}
    assert long, "the photographs that contribute most should change within the map"
    level = colour.mean()
    uneven = [abs(np.log(gains[i - 1] / gains[j - 1])) * level for i, j in long]
    assert max(uneven) > 8  # what the exposures alone would leave, in grey values of 255
    for values in long.values():
        assert abs(values.mean()) < 1 + 3 * values.std() / np.sqrt(len(values))


@pytest.mark.parametrize("strip_cells", [1_000_000, 1_000])
def test_tiles_that_differ_meet_without_a_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strip_cells: int):
    """Even tiles that are 12 grey values and 10 cm apart fade into each other across their margins."""
    from tidefield.maps.grid import LOCAL_WKT, Grid, MapFrame, Tile

    class Flat(make.Job):
        """A job whose tiles are made already."""

        def __init__(self, grid: Grid) -> None:
            object.__setattr__(self, "grid", grid)

        def tiles(self) -> list[Tile]:
            return self.grid.tiles(64, make.MARGIN)

    frame = MapFrame(None, np.zeros(3), np.eye(3), LOCAL_WKT, LOCAL_WKT, "local")
    grid = Grid(frame, 0.0, 0.0, 0.1, 150, 130, 5.0)
    job = Flat(grid)
    (tmp_path / make.TILES).mkdir()
    for number, tile in enumerate(job.tiles()):
        shape = tile.side, tile.side
        odd = number % 2
        every = np.ones(shape, bool)
        np.savez(
            make.tile_file(tmp_path, tile),
            height=np.full(shape, 5.0 + 0.1 * odd, np.float32),
            sigma=np.full(shape, 0.01, np.float32),
            score=np.ones(shape, np.float16),
            count=np.full(shape, 3, np.uint16),
            main=np.full(shape, 1, np.uint16),
            seen=every,
            shown=every,
            colour=np.full((*shape, 3), 0.5 + 12 / 255 * odd, np.float32),
        )
    monkeypatch.setattr(make, "STRIP_CELLS", strip_cells)
    found = list(make.strips(job, tmp_path))
    rows = np.cumsum([0, *(len(strip.height) for strip in found)]).tolist()
    assert [strip.row for strip in found] == rows[:-1]
    colour = np.concatenate([strip.colour for strip in found], axis=1)
    height = np.concatenate([strip.height for strip in found])
    assert colour.shape == (3, 130, 150)
    assert np.ptp(colour) > 11 / 255
    for values, largest in ((colour, 1 / 255), (height, 0.1 / 12)):
        assert abs(np.diff(values, axis=-1)).max() < largest
        assert abs(np.diff(values, axis=-2)).max() < largest


@pytest.mark.thorough
@pytest.mark.parametrize("limit", [pytest.param(6_000, marks=pytest.mark.slow), 30_000])
def test_a_full_disk_is_one_message_and_loses_nothing(scene: Path, out: Path, tmp_path: Path, limit: int):
    """The system refuses every byte of a file beyond a limit, as a full disk does."""
    import resource
    import signal

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handled = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
        with pytest.raises(RunError, match="cannot be written"):
            mapped(scene, tmp_path / "map", area=polygon(tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handled)
    assert not list((tmp_path / "map").rglob("*.tif"))
    assert not [path for path in (tmp_path / "map").rglob("*partial*") if path.stat().st_size]
    mapped(scene, tmp_path / "map", area=polygon(tmp_path))
    with rasterio.open(out / DSM) as one, rasterio.open(tmp_path / "map" / DSM) as other:
        np.testing.assert_array_equal(one.read(1), other.read(1))


@pytest.mark.parametrize("program", ["gdalinfo", "pdal"])
def test_other_programs_read_the_files(out: Path, program: str):
    import shutil
    import subprocess

    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed")
    command = [program, "-json", out / DSM] if program == "gdalinfo" else [program, "info", "--summary", out / CLOUD]
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=True)
    about = json.loads(done.stdout)
    if program == "gdalinfo":
        with rasterio.open(out / DSM) as dsm:
            assert about["size"] == [dsm.width, dsm.height]
        assert "not georeferenced" in about["coordinateSystem"]["wkt"]
    else:
        assert about["summary"]["num_points"] == len(laspy.read(out / CLOUD).points)
        assert "sigma_z" in about["summary"]["dimensions"]


def test_water_without_points_lies_on_the_map(scene: Path, tmp_path: Path):
    from dataclasses import replace

    from tidefield.data.load import load_scene
    from tidefield.maps.grid import make_grid, map_frame

    whole = load_scene(scene, hold_out=False)
    assert whole.points is not None
    north = whole.points.subset(whole.points.xyz_world[:, 1] > 5)
    frame = map_frame(whole, None)
    _, south, _, _ = make_grid(frame, replace(whole, points=north), None).bounds
    assert south < -10
    position = frame.to_map(whole.cameras.position_world.double().numpy())
    # Not beyond what a photograph sees: its lower edge is nearer to the point below it than it flies high.
    assert south > position[:, 1].min() - position[:, 2].max()
    inside = make_grid(frame, replace(whole, points=north), None, (-5.0, -5.0, 5.0, 5.0))
    assert inside.bounds == pytest.approx((-5, -5, 5, 5), abs=inside.cell)
