"""`tidefield change` from the command line, and the files it writes."""

import csv
import json
import re
import weakref
from pathlib import Path

import numpy as np
import pytest
from markupsafe import Markup
from pyproj import CRS
from scenes_on_disk import PINHOLE, write_colmap
from scenes_on_disk import survey as posed_photographs
from surveys_of_two_dates import pair

from tidefield import cli
from tidefield.addresses import copy_of
from tidefield.change.surfaces import ChangeError
from tidefield.commands.change import _check_scenes, _view_folders
from tidefield.config import PRESETS
from tidefield.data.georeference import Georeference, Residuals
from tidefield.errors import RunError
from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.similarity import Similarity
from tidefield.train.checkpoint import CHECKPOINT_FILE, Run, write_run


def call(*words: object) -> None:
    cli._run([str(word) for word in words])


def fails(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: object) -> str:
    monkeypatch.setattr("sys.argv", ["tidefield", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    return capsys.readouterr().err


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    folder = tmp_path_factory.mktemp("change")
    earlier, later, truth = pair(folder, 0, 0.1)
    call("change", earlier, later, folder / "out", "-q", "--dates", "2023-05-01", "2024-05-03")
    return folder / "out", truth


def test_levels_are_heights_on_the_earth_in_the_unit_of_the_survey(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    import rasterio

    earlier, later, _ = pair(tmp_path, 0, 0.1)
    message = fails(capsys, monkeypatch, "change", earlier, later, tmp_path / "out", "--levels", 9500)
    assert "a level of 9500 was asked for, 9,500 m: expected a height on the Earth" in message
    for path in (earlier, later):
        with rasterio.open(path, "r+") as file:
            file.write(1000 * file.read())
            file.units = ("mm",)
    monkeypatch.setattr("tidefield.change.measure.measure", lambda *_, **__: pytest.fail("measured"))
    with pytest.raises(pytest.fail.Exception, match="measured"):
        call("change", earlier, later, tmp_path / "out", "--levels", 9500)


def test_the_rasters_are_cloud_optimized_and_have_what_their_bands_say(compared: tuple[Path, np.ndarray]):
    import rasterio
    from rio_cogeo.cogeo import cog_validate

    out, truth = compared
    for name in ("change.tif", "significant.tif"):
        assert cog_validate(str(out / name))[0]
    with rasterio.open(out / "change.tif") as file:
        dz, sigma, p, shared = file.read()
        assert file.crs.to_epsg() == 32630
        assert file.tags()["EARLIER"] == "2023-05-01"
    with rasterio.open(out / "significant.tif") as file:
        alone, outlined = file.read()
        assert file.dtypes == ("int16", "int16")  # before GDAL 3.7, signed bytes are read as unsigned ones
    limit = re.search(r'classificationMax="([^"]+)"', (out / "change.qml").read_text())
    assert limit is not None
    assert np.abs(dz).max() / 2 < float(limit[1]) <= np.abs(dz).max()
    assert 'type="paletted"' in (out / "significant.qml").read_text()
    assert np.array_equal(alone != 0, p < 0.05)
    assert np.abs((dz - truth)[truth == 0].mean()) < 0.002
    assert (outlined[truth < 0] == -1).mean() > 0.95
    assert (outlined[truth > 0] == 1).mean() > 0.95
    assert sigma.mean() == pytest.approx(np.hypot(0.015, 0.01) * np.sqrt(2), rel=0.1)
    assert (shared < sigma).all()
    systematic = json.loads((out / "change.json").read_text())["registration"]["systematic_m"]
    assert np.median(shared) == pytest.approx(systematic, rel=0.2)


def test_tables_and_the_geopackage_have_the_same_outlines(compared: tuple[Path, np.ndarray]):
    from pyogrio import raw

    out, truth = compared
    with (out / "outlines.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["change"] for row in rows} == {"lower", "higher"}
    meta, _, shapes, columns = raw.read(out / "change.gpkg", layer="outlines")
    import shapely

    table = dict(zip(meta["fields"], columns, strict=True))
    areas = [shape.area for shape in shapely.from_wkb(shapes)]
    assert areas == pytest.approx(table["area_m2"])
    middles = [shape.centroid for shape in shapely.from_wkb(shapes)]
    assert [middle.x for middle in middles] == pytest.approx(table["east"], abs=1e-3)
    assert [middle.y for middle in middles] == pytest.approx(table["north"], abs=1e-3)
    assert [float(row["volume_m3"]) for row in rows] == pytest.approx(table["volume_m3"], abs=1e-3)
    ground = raw.read(out / "change.gpkg", layer="stable_ground")[2]
    assert sum(shape.area for shape in shapely.from_wkb(ground)) < truth.size * 0.25


def test_the_numbers_tell_volumes_intervals_and_where_they_come_from(compared: tuple[Path, np.ndarray]):
    out, _ = compared
    numbers = json.loads((out / "change.json").read_text())
    cut = numbers["volumes"]["cut"]
    assert cut["low_m3"] < cut["value_m3"] < cut["high_m3"]
    parts = [cut[f"{part}_m3"] for part in ("random", "correlated", "systematic", "choice")]
    half = cut["high_m3"] - cut["value_m3"]
    assert 1.95 * np.linalg.norm(parts) < half < 2.2 * np.linalg.norm(parts)
    assert numbers["registration"]["stable_ground"] == "found"
    with (out / "volumes.csv").open() as file:
        assert [row["volume"] for row in csv.DictReader(file)][:3] == ["net", "cut", "fill"]


def test_the_report_is_one_page_with_the_volumes_and_the_pictures(compared: tuple[Path, np.ndarray]):
    import re

    out, _ = compared
    page = (out / "change.html").read_text()
    assert page.count('src="data:image/png;base64,') >= 5
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "Between 2023-05-01 and 2024-05-03" in page
    cut = json.loads((out / "change.json").read_text())["volumes"]["cut"]
    assert f"{cut['value_m3']:.1f} m³ (95%: {cut['low_m3']:.1f} to {cut['high_m3']:.1f} m³) were cut on" in page
    assert "red is lower, blue is higher" in page
    assert str(out.parent) not in page  # of paths only their last names


def test_clouds_are_compared_as_surfaces_and_by_m3c2(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import laspy

    monkeypatch.setattr("tidefield.change.figures.png", lambda *_: Markup("<img>"))
    rng = np.random.default_rng(0)
    for name, lower in (("early", 0.0), ("late", 0.3)):
        xy = rng.uniform(0, 40, (30_000, 2))
        pit = np.hypot(*(xy - 12).T) < 6
        las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
        las.header.add_crs(CRS.from_epsg(32630))
        las.header.scales, las.header.offsets = np.full(3, 0.001), np.array([400_000.0, 5_700_000.0, 0.0])
        las.x, las.y = 400_000 + xy[:, 0], 5_700_000 + xy[:, 1]
        las.z = 2 - lower * pit + rng.normal(0, 0.03, len(xy))
        las.write(str(tmp_path / f"{name}.laz"))
    call("change", tmp_path / "early.laz", tmp_path / "late.laz", tmp_path / "out", "-q")
    numbers = json.loads((tmp_path / "out" / "change.json").read_text())
    assert numbers["earlier"]["file"] == "early.laz"
    cut = numbers["volumes"]["cut"]
    assert cut["low_m3"] < 0.3 * np.pi * 36 < cut["high_m3"]
    m3c2 = laspy.read(tmp_path / "out" / "m3c2.laz")
    assert m3c2.header.parse_crs().to_epsg() == 32630
    inside = np.hypot(np.asarray(m3c2.x) - 400_012, np.asarray(m3c2.y) - 5_700_012) < 5
    assert np.median(np.asarray(m3c2["M3C2_distance"])[inside]) == pytest.approx(-0.3, abs=0.01)
    assert np.asarray(m3c2["significant"])[inside].mean() > 0.95


def test_a_cloud_and_a_surface_are_not_compared(
    compared: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
):
    early = compared[0].parent / "early_0.tif"
    (tmp_path / "late.laz").write_bytes(b"LASF")
    message = fails(capsys, monkeypatch, "change", early, tmp_path / "late.laz", tmp_path / "new")
    assert "two surfaces or two clouds" in message
    (tmp_path / "early.laz").write_bytes(b"LASF" + bytes(300))
    message = fails(capsys, monkeypatch, "change", tmp_path / "early.laz", tmp_path / "late.laz", tmp_path / "new")
    assert "cannot be read as a point cloud" in message


def test_mistakes_are_told_in_one_message(
    compared: tuple[Path, np.ndarray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    early, late = compared[0].parent / "early_0.tif", compared[0].parent / "late_0.tif"
    new = tmp_path / "new"
    assert "is there already" in fails(capsys, monkeypatch, "change", early, late, compared[0])
    assert "expected one that exists" in fails(capsys, monkeypatch, "change", early, tmp_path / "none.tif", new)
    wrong = ("--dates", "2024-05-03", "2023-05-01")
    assert "earlier survey first" in fails(capsys, monkeypatch, "change", early, late, new, *wrong)
    assert "odd numbers" in fails(capsys, monkeypatch, "change", early, late, new, "--windows", 4)
    for date in ("May", "2024-02-30", "20240501"):
        message = fails(capsys, monkeypatch, "change", early, late, new, "--dates", "2023-05-01", date)
        assert "YYYY-MM-DD" in message
    for cell in (-1, "nan", 0):
        assert "more than 0 metres" in fails(capsys, monkeypatch, "change", early, late, new, "--cell", cell)
    (tmp_path / "file").write_text("")
    with monkeypatch.context() as patch:
        patch.setattr("tidefield.change.measure.measure", lambda *_, **__: pytest.fail("it was measured"))
        message = fails(capsys, patch, "change", early, late, tmp_path / "file" / "new")
        assert "cannot be written" in message
    pictures = ("--orthophotos", early, late, "--shift", "none")
    with monkeypatch.context() as patch:
        patch.setattr("tidefield.change.measure.measure", lambda *_, **__: pytest.fail("it was measured"))
        assert "is no orthophoto" in fails(capsys, patch, "change", early, late, new, *pictures)
    polygons = tmp_path / "polygons.geojson"
    polygons.write_text('{"type": "FeatureCollection", "features": [')
    assert "polygons" in fails(capsys, monkeypatch, "change", early, late, new, "--stable", polygons)
    assert not new.exists()


def test_plants_and_water_are_told_where_orthophotos_and_levels_are_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    import pyogrio
    import rasterio
    from surveys_of_two_dates import write_surface

    monkeypatch.setattr("tidefield.change.figures.png", lambda *_: Markup("<img>"))
    rng = np.random.default_rng(0)
    columns = np.arange(240)
    heights = np.broadcast_to(0.01 * columns, (160, 240))
    for k, (year, covered) in enumerate(((2023, 60), (2024, 100))):
        picture = np.where(columns[None, :, None] > 240 - covered, [95, 110, 60], [125, 112, 92]) * (1 - 0.2 * k)
        picture = picture + rng.normal(0, 2, (160, 240, 3))
        folder = tmp_path / f"{year}-06-01"
        write_surface(folder / "dsm.tif", (heights + rng.normal(0, 0.01, heights.shape)).astype(np.float32))
        write_surface(folder / "orthophoto.tif", picture.clip(0, 255).astype(np.uint8).transpose(2, 0, 1))
    out = tmp_path / "out"
    words = ("--water", 0.6, 0.4, "--levels", 1.0, "--register", "none", "--datum-error", 0.01)
    call("change", tmp_path / "2023-06-01", tmp_path / "2024-06-01", out, "-q", *words)
    numbers = json.loads((out / "change.json").read_text())
    # What was under water at either date is not looked at: 0.6 m are 60 columns, and a margin of a cell's error.
    assert numbers["cover"]["area_m2"] == pytest.approx(178 * 160 * 0.25, rel=0.02)
    gained = numbers["cover"]["regions"]["all"]["gained"]
    assert gained["value_m2"] == pytest.approx(40 * 160 * 0.25, rel=0.05)
    line = numbers["water"]["waterline"]
    assert line["move_m"] == pytest.approx(10, abs=1)
    assert line["move_low_m"] < 10 < line["move_high_m"]
    assert numbers["water"]["below"][0]["earlier_m2"] == pytest.approx(100 * 160 * 0.25, rel=0.02)
    with rasterio.open(out / "cover.tif") as file:
        assert set(np.unique(file.read(1))) == {-128, 0, 1, 2}
        assert file.dtypes == ("int16",)
    assert {name for name, _ in pyogrio.list_layers(out / "change.gpkg")} >= {"cover", "waterlines", "layer_styles"}
    page = (out / "change.html").read_text()
    assert "Plants covered" in page
    assert "seaward on average" in page


@pytest.mark.thorough
def test_the_same_place_then_and_now_is_rendered_from_an_earlier_photograph(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from PIL import Image
    from surveys_of_two_dates import write_surface

    from tidefield.synthetic import write_survey
    from tidefield.synthetic.grids import Extent
    from tidefield.synthetic.two_dates import Difference, SurveyErrors, make_pair, surveyed

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    made = make_pair("ground_textures", 9, Difference(0.4, tide_m=0.0, sun_turn_deg=0.0), views=9, width=128)
    extent = Extent.around([-25.0, -20.0], [25.0, 20.0], 0.5)
    for name, survey in (("early", made.earlier), ("late", made.later)):
        write_survey(survey, tmp_path / name)
        heights = surveyed(survey.flat.bed, extent, np.random.default_rng(0), SurveyErrors(datum_m=0.0))
        west, north = extent.west_m - 0.25, extent.north_m + 0.25
        write_surface(tmp_path / f"{name}.tif", heights, 0.5, west, north, crs=None)
    scenes = ("--scenes", tmp_path / "early", tmp_path / "late", "--view-width", 96, "--device", "cpu")
    surfaces = (tmp_path / "early.tif", tmp_path / "late.tif")
    call("change", *surfaces, tmp_path / "out", "-q", *scenes, "--cameras", "ground_textures_0004")
    views = tmp_path / "out" / "views" / "ground_textures_0004"
    names = {"earlier.png", "later.png", "side_by_side.png", "difference.png", "swipe.html", "fade.mp4"}
    assert {path.name for path in views.iterdir()} == names
    earlier = np.asarray(Image.open(views / "earlier.png")).astype(float)
    later = np.asarray(Image.open(views / "later.png")).astype(float)
    assert earlier.shape == later.shape == (72, 96, 3)
    # The same ground is at the same pixel: a shift of a few pixels fits worse.
    grey = [picture.mean(axis=2) for picture in (earlier, later)]
    errors = [
        np.abs(grey[0] - np.roll(grey[1], shift, axis))[8:-8, 8:-8].mean()
        for shift, axis in ((0, 0), (-3, 0), (3, 0), (-3, 1), (3, 1))
    ]
    assert errors[0] < 0.95 * min(errors[1:])
    assert "The same place then and now" in (tmp_path / "out" / "change.html").read_text()
    message = fails(capsys, monkeypatch, "change", *surfaces, tmp_path / "new", "--cameras", "a")
    assert "--scenes" in message
    # Mistakes about views are found before anything is measured.
    monkeypatch.setattr("tidefield.change.measure.measure", lambda *_, **__: pytest.fail("it was measured"))
    message = fails(capsys, monkeypatch, "change", *surfaces, tmp_path / "new", "-q", *scenes, "--cameras", "none")
    assert "none" in message
    twice = ("--cameras", "ground_textures_0004", "ground_textures_0004.png")
    message = fails(capsys, monkeypatch, "change", *surfaces, tmp_path / "new", "-q", *scenes, *twice)
    assert "twice" in message
    nowhere = ("--scenes", tmp_path / "early", tmp_path / "nowhere")
    message = fails(capsys, monkeypatch, "change", *surfaces, tmp_path / "new", "-q", *nowhere)
    assert "nowhere" in message
    assert not (tmp_path / "new").exists()


def test_views_from_photographs_of_one_name_have_folders_of_their_own(tmp_path: Path):
    for names in (
        ["a/IMG_1.JPG", "a/IMG_1.PNG", "a_IMG_1.JPG", "IMG_2.JPG"],
        ["DJI.JPG", "DJI.png", "DJI (1).JPG", "DJI (2).JPG"],
        ["DJI_1.JPG", "dji_1.jpg"],
    ):
        assert len({str(folder).casefold() for folder in _view_folders(names, tmp_path)}) == len(names)
    assert _view_folders(["a/IMG_1.JPG", "IMG_2.JPG"], tmp_path) == [tmp_path / "a_IMG_1", tmp_path / "IMG_2"]


def test_the_scenes_of_runs_may_be_at_addresses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_colmap(tmp_path / "flats", posed_photographs(PINHOLE))
    (tmp_path / "run").mkdir()
    write_run(tmp_path / "run", Run(copy_of(f"local://{tmp_path}/flats"), None, 0, PRESETS["swift"]))
    with pytest.raises(RunError, match="a run that has trained"):
        _check_scenes((tmp_path / "run", tmp_path / "run"), (), "cpu")
    (tmp_path / "run" / CHECKPOINT_FILE).write_bytes(b"")
    _check_scenes((tmp_path / "run", tmp_path / "run"), (), "cpu")


def test_scenes_of_which_one_has_no_georeference_are_refused_at_once(tmp_path: Path):
    scene = posed_photographs(PINHOLE)
    for name in ("local", "placed"):
        write_colmap(tmp_path / name, scene)
    frame, there = LocalFrame.at("EPSG:32630", (400_000.0, 5_700_000.0, 0.0)), Similarity(1.0, np.eye(3), np.zeros(3))
    Georeference(frame, "GPS", there, Residuals(), Residuals(), Residuals(), (), ()).write(tmp_path / "placed")
    with pytest.raises(ChangeError, match="one of the scenes is georeferenced"):
        _check_scenes((tmp_path / "local", tmp_path / "placed"), (), "cpu")
    _check_scenes((tmp_path / "placed", tmp_path / "placed"), (), "cpu")


def test_mistakes_in_any_survey_of_a_series_are_found_before_the_first_is_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    from surveys_of_two_dates import write_surface

    laspy = pytest.importorskip("laspy")
    heights = np.random.default_rng(0).normal(0, 0.02, (40, 50)).astype(np.float32)
    first, second, far, bare, other, geoid = (
        write_surface(tmp_path / f"{name}_2024-0{k}-01.tif", heights, west=west, crs=crs)
        for name, k, west, crs in (
            ("first", 1, 400_000.0, "EPSG:32630"),
            ("second", 2, 400_000.0, "EPSG:32630+5773"),
            ("far", 3, 500_000.0, "EPSG:32630"),
            ("bare", 3, 400_000.0, None),
            ("other", 3, 400_000.0, "EPSG:32630+3855"),
            ("geoid", 3, 400_000.0, "EPSG:32630+5773"),
        )
    )
    clouds = []
    for k, (date, crs) in enumerate((("2024-01-01", 32630), ("2024-02-01", 32630), ("2023-01-01", 32630))):
        las = laspy.create(point_format=6, file_version="1.4")
        las.header.add_crs(CRS(crs))
        las.x, las.y, las.z = np.arange(10.0), np.arange(10.0), np.zeros(10)
        clouds.append(tmp_path / f"{k}_{date}.laz")
        las.write(str(clouds[-1]))
    las = laspy.create(point_format=6, file_version="1.4")
    las.x, las.y, las.z = np.arange(10.0), np.arange(10.0), np.zeros(10)
    las.write(str(tmp_path / "bare_2024-03-01.laz"))
    monkeypatch.setattr("tidefield.change.inputs.open_pair", lambda *_, **__: pytest.fail("surveys were compared"))
    for surveys, part in (
        ((first, second, clouds[0]), "two surfaces or two clouds"),
        ((first, second, far), "do not overlap"),
        ((first, second, bare), "has a coordinate system"),
        ((first, second, other), "one vertical datum"),
        ((*clouds[:2], tmp_path / "bare_2024-03-01.laz"), "has no coordinate system"),
        (clouds, "expected the order of time"),
    ):
        message = fails(capsys, monkeypatch, "change", *surveys[:2], tmp_path / "out", "--series", surveys[2])
        assert part in message
    with pytest.raises(pytest.fail.Exception, match="compared"):
        call("change", first, second, tmp_path / "out", "--series", geoid)


@pytest.mark.thorough
def test_surveys_of_a_series_have_one_name_in_all_comparisons_and_each_result_is_given_up_before_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from surveys_of_two_dates import write_surface

    from tidefield.change import measure

    rng, compare, names, results = np.random.default_rng(0), measure.measure, [], []
    paths = [
        write_surface(tmp_path / name / "dem.tif", rng.normal(0, 0.02, (30, 40)).astype(np.float32))
        for name in ("spring/north", "autumn/north", "autumn/south")
    ]

    def compared_alone(*surveys: object, **options: object) -> object:
        assert [result() for result in results] == [None] * len(results)
        found = compare(*surveys, **options)  # type: ignore[arg-type]
        names.append((found.earlier.name, found.later.name))
        results.append(weakref.ref(found))
        return found

    monkeypatch.setattr("tidefield.change.measure.measure", compared_alone)
    monkeypatch.setattr("tidefield.commands.change._write", lambda *_: None)
    call("change", *paths[:2], tmp_path / "out", "-q", "--series", paths[2], "--windows", 5)
    spring, autumn, south = "spring/north/dem", "autumn/north/dem", "autumn/south/dem"
    assert names == [(spring, autumn), (spring, south), (autumn, south)]
    assert json.loads((tmp_path / "out" / "series.json").read_text())["surveys"] == [spring, autumn, south]


@pytest.mark.thorough
def test_more_than_two_dates_make_a_series_of_steps_and_of_changes_since_the_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    import rasterio
    from surveys_of_two_dates import NORTH, WEST, noise, write_surface

    rng, shape = np.random.default_rng(3), (80, 100)
    rows, columns = np.indices(shape)
    pit = np.hypot(rows - 30, columns - 30) < 14
    names = []
    for year, depth in ((2021, 0.0), (2022, 0.2), (2023, 0.5)):
        heights = 0.002 * columns - depth * pit + noise(rng, shape, 0.012, 0.008, 4)
        names.append(write_surface(tmp_path / f"dsm_{year}-05-01.tif", heights.astype(np.float32)))
    square = [[WEST + x, NORTH - y] for x, y in ((3, 3), (27, 3), (27, 27), (3, 27), (3, 3))]
    polygons = {"type": "FeatureCollection", "features": []}
    polygons["crs"] = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32630"}}
    geometry = {"type": "Polygon", "coordinates": [square]}
    polygons["features"] = [{"type": "Feature", "properties": {"name": "pit"}, "geometry": geometry}]
    (tmp_path / "pit.geojson").write_text(json.dumps(polygons))
    out = tmp_path / "out"
    words = ("--series", names[2], "-q", "--polygons", tmp_path / "pit.geojson", "--windows", 5, 11)
    call("change", *names[:2], out, *words)
    with (out / "series.csv").open() as file:
        table = list(csv.DictReader(file))
    volume = pit.sum() * 0.25
    expected = {("step", "2021-05-01", "2022-05-01"): 0.2, ("step", "2022-05-01", "2023-05-01"): 0.3}
    expected |= {("first", "2021-05-01", "2022-05-01"): 0.2, ("first", "2021-05-01", "2023-05-01"): 0.5}
    cuts = {(r["since"], r["earlier"], r["later"]): r for r in table if r["region"] == "all" and r["volume"] == "cut"}
    assert set(cuts) == set(expected)
    for key, depth in expected.items():
        assert float(cuts[key]["low_m3"]) < depth * volume < float(cuts[key]["high_m3"])
    assert {row["region"] for row in table} == {"all", "pit"}
    numbers = json.loads((out / "series.json").read_text())
    assert numbers["surveys"] == ["2021-05-01", "2022-05-01", "2023-05-01"]
    last = numbers["closure"]["pit"][-1]
    assert last["steps_m3"] == pytest.approx(last["since_first_m3"], rel=0.1)
    page = (out / "series.html").read_text()
    assert page.count('src="data:image/png;base64,') == 2
    for link in ("step_1/change.html", "step_2/change.html"):
        assert link in page
        assert (out / link).is_file()
    assert numbers["different_ground_m2"] == {}
    assert "different ground" not in page
    with rasterio.open(names[1], "r+") as file:
        heights = file.read(1)
        heights[:, 60:] = np.nan
        file.write(heights, 1)
    with monkeypatch.context() as patch:
        patch.setattr("tidefield.change.measure.measure", lambda *_, **__: pytest.fail("it was measured"))
        for last, part in ((tmp_path / "none.tif", "cannot be read"), (names[0], "expected the order of time")):
            assert part in fails(capsys, patch, "change", *names[1:], tmp_path / "wrong", "--series", last)
    call("change", *names[:2], tmp_path / "gap", *words)
    numbers = json.loads((tmp_path / "gap" / "series.json").read_text())
    (low, high), *others = numbers["different_ground_m2"].values()
    assert (low, high) == pytest.approx((80 * 60 / 4, 80 * 100 / 4))
    assert others == []
    assert "1\u202f200 to 2\u202f000 m²" in (tmp_path / "gap" / "series.html").read_text()
    message = fails(capsys, monkeypatch, "change", names[0], names[2], tmp_path / "new", "--series", names[1], "-q")
    assert "order of time" in message or "earlier survey first" in message
    message = fails(capsys, monkeypatch, "change", *names[:2], tmp_path / "new", "--series", names[2], "--water", 0, 0)
    assert "two surveys" in message
