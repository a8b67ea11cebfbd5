"""The files of a report: the page, its numbers and the map for a GIS."""

import json
import math
import re
import sqlite3
import time
from contextlib import closing
from dataclasses import replace
from html.parser import HTMLParser
from importlib import import_module

import numpy as np
import pytest
import shapely
from flat_surveys import (
    AHEAD,
    ASIDE,
    FRAME,
    GSD,
    findings,
    flat_ground,
    flight,
    located,
    photograph,
    reconstruction,
    residuals,
    surveyed,
)

from tidefield.data.georeference import LeftOut, Residuals
from tidefield.errors import RunError
from tidefield.geometry.geodesy import LocalFrame
from tidefield.survey.colour import ExposureCorrection
from tidefield.survey.report import UnusedPhotograph, write_report
from tidefield.survey.report.figures import draw_map, spaced
from tidefield.survey.report.findings import MOST_THUMBNAILS
from tidefield.survey.report.numbers import duration, numbers, plain
from tidefield.survey.report.statistics import measure
from tidefield.survey.survey import Control, Survey

NASTY = '<script>alert(1)</script> & "O\'Brien" ümlaut.JPG'
VOID = {"meta", "img", "br", "link", "input", "hr"}
LOADING = {"src", "href", "data", "action", "poster", "srcset", "xlink:href"}


class Reader(HTMLParser):
    """Checks that tags balance, and keeps what a test asks for."""

    def __init__(self, text):
        super().__init__()
        self.open, self.seen, self.loads, self.values, self.text, self.ids = [], [], [], [], [], []
        self.titles, self.markers = [], {}
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.seen.append((tag, attrs))
        self.loads += [value for name, value in attrs.items() if name in LOADING]
        self.ids += [attrs["id"]] if "id" in attrs else []
        if tag == "data":
            self.values.append(float(attrs["value"]))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)
        if self.open[-1:] == ["title"]:
            self.titles.append(data)
            shape = next(attrs for tag, attrs in reversed(self.seen) if tag != "title")
            if "x" in shape:
                self.markers.setdefault(data, (float(shape["x"]), float(shape["y"])))

    def count(self, tag):
        return sum(seen == tag for seen, _ in self.seen)


def full():
    """Findings with something of everything, and untrusted names."""
    position = flight()
    picture = np.full((90, 120, 3), 128, np.uint8)
    survey = findings(position).survey
    lost = [photograph(100 + i, place) for i, place in enumerate(position[:3] + np.array([20.0, -20, 0]))]
    lost[0] = replace(lost[0], name=NASTY)
    far = replace(lost[2].position, latitude_deg=-lost[2].position.latitude_deg)
    lost[2] = replace(lost[2], position=far)
    control, check = residuals("control", 4, 1), residuals("check", 3, 2)
    control.error_m[3] = np.nan
    everyone = tuple(sorted((*survey.photographs, *lost), key=lambda p: p.name))
    return findings(
        position,
        title="Flats <b>& sons</b>",
        survey=Survey(survey.folder, everyone, surveyed(control, check)),
        georeference=located(
            gps=residuals("gps", 18),
            control=control,
            check=check,
            left_out=(LeftOut("mark", NASTY, "it moved"), LeftOut("GPS", "gps 7", "it is wrong")),
        ),
        left_out=(
            UnusedPhotograph(NASTY, "quality", "blurred <i>", {"sharpness": 0.1}, picture),
            UnusedPhotograph(lost[1].name, "poses", "too few matches", {"matches": math.nan}, None),
            UnusedPhotograph(lost[2].name, "quality", "cut short"),
        ),
        models=(18, 4),
        colour=ExposureCorrection(np.ones((18, 3)), np.zeros((18, 3)), 0.21, 0.07, 0.06, True, False),
        examples=((NASTY, picture, picture),),
        seconds={"features": 75.0, "mapping": 3700.0},
        options={"control": NASTY},
        versions={"tidefield": "1"},
        remarks=("Mind the <gap>.",),
    )


def report(found, folder):
    """Write a report; return the text of its page, and its numbers."""
    page = write_report(found, folder)
    return page.read_text(encoding="utf-8"), json.loads((folder / "report.json").read_text(encoding="utf-8"))


def drawn(found):
    """The map alone."""
    return Reader(str(draw_map(found, measure(found))))


def counted(found):
    """The numbers of a report alone."""
    return numbers(found, measure(found))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="module")
def written(folder):
    return report(full(), folder)


@pytest.fixture(scope="module")
def html(written):
    return written[0]


@pytest.fixture(scope="module")
def table(written):
    return written[1]


def test_the_page_is_well_formed_and_every_id_is_its_own(html):
    page = Reader(html)
    assert html.lstrip().lower().startswith("<!doctype html>")
    assert len(page.ids) == len(set(page.ids))
    named = {attrs["aria-labelledby"] for _, attrs in page.seen if "aria-labelledby" in attrs}
    assert {part for name in named for part in name.split()} <= set(page.ids)


def test_the_page_loads_nothing_and_runs_nothing(html):
    page = Reader(html)
    assert page.count("script") == page.count("link") == page.count("iframe") == 0
    assert all(load.startswith(("data:image/", "#")) for load in page.loads)
    assert "@import" not in html
    inside = {target.removeprefix("#") for target in re.findall(r"url\(([^)]*)\)", html)}
    inside |= {load.removeprefix("#") for load in page.loads if load.startswith("#")}
    assert inside
    assert inside <= set(page.ids)
    assert not any(name.startswith("on") for _, attrs in page.seen for name in attrs)
    assert "http://" not in html
    assert "https://" not in html


def test_names_are_shown_as_they_are_and_never_run(html):
    page = Reader(html)
    assert "<script" not in html.lower()
    assert page.count("b") == page.count("gap") == 0
    shown = "".join(page.text)
    assert NASTY in shown
    assert "Flats <b>& sons</b>" in shown
    assert "blurred <i>" in shown
    assert any(attrs.get("alt") == f"Thumbnail of {NASTY}" for _, attrs in page.seen)


def test_the_map_labels_points_as_text_and_names_cameras_in_tooltips(html):
    page = Reader(html)
    assert {"control 0", "check 2", "first", "last", "50 m"} <= set(page.text)
    assert {f"DJI_{i:04d}.JPG" for i in range(18)} <= set(page.titles)
    assert f"{NASTY}: not in the model" in page.titles
    assert "gps 7: not used" in page.titles
    assert "10: 13" in page.titles  # 13 points are seen by 10 photographs


def test_control_points_are_drawn_at_their_given_positions():
    """Two points: the first at the westernmost camera, so that their markers share x."""
    position = flight(2, 3)
    check = residuals("check", 2)
    given = FRAME.to_crs(np.array([[0.0, 0, 0], [2 * AHEAD, ASIDE, 0]]))
    control = Control(FRAME.crs, dict(zip(check.names, map(tuple, given.tolist()), strict=True)), ())
    found = findings(position, georeference=located(check=check))
    page = drawn(replace(found, survey=replace(found.survey, control=control)))
    cameras, points = page.markers["DJI_0000.JPG"], page.markers["check 0"]
    np.testing.assert_allclose(cameras, points, atol=0.05)
    np.testing.assert_allclose(page.markers["DJI_0003.JPG"], page.markers["check 1"], atol=0.05)


def test_the_same_findings_give_the_same_page(html, tmp_path):
    assert report(full(), tmp_path)[0] == html


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["$x$ $", "点.JPG", "a\x01b"])
def test_any_name_of_a_point_can_be_drawn(tmp_path, name):
    check = Residuals((name,), np.array([[0.01, 0.02, 0.03]]))
    found = findings(georeference=located(check=check))
    found = replace(found, survey=replace(found.survey, control=surveyed(check)))
    page = Reader(report(found, tmp_path)[0])
    assert name.replace("\x01", "\ufffd") in page.text


def test_pictures_have_words_and_tables_have_captions_and_heads(html):
    page = Reader(html)
    assert all(attrs.get("alt") for tag, attrs in page.seen if tag == "img")
    for tag, attrs in page.seen:
        if tag == "svg":
            assert attrs.get("aria-hidden") or (
                attrs["role"] == "img" and ("aria-label" in attrs or "aria-labelledby" in attrs)
            )
        if tag == "th":
            assert attrs["scope"] in ("row", "col")
    assert page.count("table") == page.count("caption")


def test_every_number_of_the_page_is_in_the_json(table, html):
    def numbers_in(value):
        if isinstance(value, dict):
            value = list(value.values())
        return [n for item in value for n in numbers_in(item)] if isinstance(value, list) else [value]

    known = {float(n) for n in numbers_in(table) if isinstance(n, int | float)}
    shown = Reader(html).values
    assert len(shown) > 40
    assert set(shown) <= known


def test_the_page_states_the_known_values_of_the_survey(html):
    text = " ".join("".join(Reader(html).text).split()).replace("\u00a0", " ")
    assert "18 of 21 photographs are in the model" in text
    assert f"{100 * GSD:.1f} cm/px" in text
    assert "80% forward and 50% side overlap" in text
    assert "reprojection error is 0.50 px" in text
    assert "Mind the <gap>." in text
    assert f"{NASTY}: it moved" in text
    assert "2, of 18 and 4 photographs" in text


def test_the_json_has_the_names_and_meanings_of_opensfm(table):
    shots = table["reconstruction_statistics"]
    assert shots["reconstructed_shots_count"] == 18
    assert shots["initial_shots_count"] == 21
    assert shots["components"] == 2
    assert shots["has_gps"]
    assert shots["has_gcp"]
    assert shots["reprojection_error_pixels"] == pytest.approx(0.5)
    assert sum(shots["histogram_track_length"].values()) == shots["reconstructed_points_count"]
    total = sum(int(length) * count for length, count in shots["histogram_track_length"].items())
    assert shots["observations_count"] == total
    assert shots["average_track_length"] == pytest.approx(total / shots["reconstructed_points_count"])
    assert table["odm_processing_statistics"] == {
        "total_time": 3775.0,
        "total_time_human": "1 h 2 min",
        "average_gsd": pytest.approx(100 * GSD),
    }
    assert table["processing_statistics"]["area"] == table["tidefield"]["coverage"]["area"]
    assert table["processing_statistics"]["date"] == "04/05/2026 at 12:30:00"
    assert table["processing_statistics"]["steps_times"]["Total Time"] == 3775.0
    lens = table["camera_errors"]["Maker Drone"]
    assert lens["initial_values"]["focal_x"] == lens["optimized_values"]["focal_x"] == pytest.approx(0.75)
    assert lens["optimized_values"]["c_x"] == 0


def test_errors_count_only_what_was_used():
    errors = np.array([[3.0, 4, 0], [-3, -4, 2], [100, 100, 100]])
    wrong = (LeftOut("GPS", "gps 2", "it is 170 m away"),)
    found = findings(georeference=located(gps=residuals("gps", error_m=errors), left_out=wrong))
    table = counted(found)
    gps = table["gps_errors"]
    assert gps["mean"] == {"x": 0, "y": 0, "z": 1}
    assert gps["error"] == pytest.approx({"x": 3, "y": 4, "z": math.sqrt(2)})
    assert gps["rms_horizontal"] == pytest.approx(5)
    assert gps["largest_vertical"] == 2
    assert (gps["count"], gps["not_used"]) == (2, 1)
    assert table["tidefield"]["residuals"][0]["remarks"] == ["gps 2: it is 170 m away"]
    assert table["tidefield"]["georeference"]["placed_by"] == "GPS of 2 photographs"


@pytest.mark.parametrize(("count", "words"), [(1, "1 control point"), (8, "8 control points")])
def test_control_points_of_one_mark_are_counted_that_have_no_residuals(count, words):
    found = replace(located(), source="ground control", control_world=np.zeros((count, 3)))
    assert findings(georeference=found).placed_by == words


@pytest.mark.parametrize("has_part", [True, False])
def test_positions_are_named_only_where_they_placed_the_survey(has_part):
    gps = Residuals(tuple(p.name for p in findings().survey.photographs), np.zeros((18, 3)))
    found = replace(located(gps=gps), source="ground control", control_world=np.zeros((2, 3)), gps_has_part=has_part)
    assert findings(georeference=found).placed_by == "2 control points" + (
        ", GPS of 18 photographs" if has_part else ""
    )


def test_a_comparison_of_which_nothing_could_be_used_is_reported(tmp_path):
    unknown = residuals("check", error_m=np.full((2, 3), np.nan))
    found = findings(georeference=located(check=unknown))
    found = replace(found, survey=replace(found.survey, control=surveyed(unknown)))
    text, table = report(found, tmp_path)
    assert "none could be used" in "".join(Reader(text).text)
    assert (table["check_errors"]["count"], table["check_errors"]["not_used"]) == (0, 2)


def test_the_map_continues_across_the_date_line():
    frame = LocalFrame.at("EPSG:4326", (180.0, -16.8, 0.0))
    lost = photograph(100, np.array([40.0, 30, 60]))
    longitude, latitude, _ = frame.to_geographic(np.array([[40.0, 30, 60]]))[0].tolist()
    assert longitude < 0
    lost = replace(lost, position=replace(lost.position, longitude_deg=longitude, latitude_deg=latitude))
    found = findings(georeference=located(frame), left_out=(UnusedPhotograph(lost.name, "quality", "blurred"),))
    found = replace(found, survey=replace(found.survey, photographs=(*found.survey.photographs, lost)))
    page = drawn(found)
    east, west = ([text for text in page.text if text.endswith(f"° {side}")] for side in "EW")
    assert east
    assert west
    assert all(text.startswith("179.99") for text in west)
    cameras, there = page.markers["DJI_0002.JPG"], page.markers[f"{lost.name}: not in the model"]
    np.testing.assert_allclose(np.subtract(there, cameras), np.array([8.0, -30]) * scale(page), atol=0.1)


def scale(page: Reader) -> float:
    """Units of a map for a metre, by two cameras of a line."""
    return (page.markers["DJI_0005.JPG"][0] - page.markers["DJI_0000.JPG"][0]) / (5 * AHEAD)


@pytest.mark.parametrize(
    ("crs", "origin", "titles"),
    [
        ("EPSG:2048", (52000.0, 3700000.0, 0.0), ["Westing (m), ", "Southing (m)"]),
        ("EPSG:5513", (1043000.0, 742000.0, 200.0), ["Westing (m), ", "Southing (m)"]),
        ("EPSG:27700", (351139.0, 512875.0, 0.0), ["Easting (m), ", "Northing (m)"]),
    ],
)
def test_axes_are_called_by_the_directions_in_which_they_count(crs, origin, titles):
    frame = LocalFrame.at(crs, origin)
    found = findings(georeference=located(frame))
    texts = drawn(found).text
    assert all(any(text.startswith(title) for text in texts) for title in titles)
    x, y = (spaced(round(value, -2)) for value in sorted(frame.to_crs(np.array([[40.0, 30, 0]]))[0, :2].tolist()))
    assert {x, y} <= set(texts)


@pytest.mark.parametrize(("sees_falloff", "after"), [(True, 6.0), (False, 7.0)])
def test_the_difference_that_was_reached_is_reported_not_that_of_a_falloff_that_was_not_removed(sees_falloff, after):
    colour = ExposureCorrection(np.ones((18, 3)), np.zeros((18, 3)), 0.21, 0.07, 0.06, True, sees_falloff)
    (change,) = counted(findings(flight(), colour=colour))["tidefield"]["colour"]["changes"]
    assert (change["before"], change["after"]) == (pytest.approx(21), pytest.approx(after))


def test_a_point_without_an_estimate_is_listed_but_not_drawn(tmp_path):
    errors = np.array([[0.01, 0.02, 0.03], [np.nan] * 3])
    check = residuals("check", error_m=errors)
    found = findings(georeference=located(check=check))
    found = replace(found, survey=replace(found.survey, control=surveyed(check)))
    html = report(found, tmp_path)[0]
    shapes = [value for _, attrs in Reader(html).seen for value in attrs.values() if value]
    assert not any("nan" in value.lower() for value in shapes)
    assert "check 1" in "".join(Reader(html).text)


def test_the_map_for_a_gis_follows_rfc_7946_and_is_at_the_place_of_the_world(written, folder):
    collection = json.loads((folder / "survey.geojson").read_text(encoding="utf-8"))
    assert collection["type"] == "FeatureCollection"
    kinds: dict[str, list] = {}
    for feature in collection["features"]:
        assert feature["type"] == "Feature"
        kinds.setdefault(feature["properties"]["kind"], []).append(feature)
    assert {kind: len(features) for kind, features in kinds.items()} == {
        "area covered": 1,
        "footprint": 18,
        "camera": 18,
        "control point": 4,
        "check point": 3,
    }
    cameras = np.array([feature["geometry"]["coordinates"] for feature in kinds["camera"]])
    there = FRAME.from_geographic(np.c_[cameras, [f["properties"]["height_m"] for f in kinds["camera"]]])
    np.testing.assert_allclose(there, flight(), atol=2e-3)
    assert [f["properties"]["flight_order"] for f in kinds["camera"]] == list(range(1, 19))
    rings = [feature["geometry"]["coordinates"][0] for feature in kinds["footprint"]]
    outer = kinds["area covered"][0]["geometry"]["coordinates"]
    assert len(outer) == 1
    for ring in (*rings, outer[0][0]):
        assert ring[0] == ring[-1]
        assert shapely.LinearRing(ring).is_ccw
    world = FRAME.from_geographic(np.c_[np.array(rings[0]), np.zeros(len(rings[0]))])
    assert shapely.Polygon(world[:, :2]).area == pytest.approx(80 * 60, rel=1e-3)
    area = kinds["area covered"][0]["properties"]["area_m2"]
    assert area == pytest.approx((5 * AHEAD + 80) * (2 * ASIDE + 60), rel=0.01)


def test_without_a_georeference_there_is_no_map_and_an_earlier_one_is_deleted(tmp_path):
    for name in ("survey.geojson", "survey.gpkg"):
        (tmp_path / name).touch()
    text, table = report(findings(georeference=located(None)), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "report.json"]
    Reader(text)
    assert "in its own unit" in text
    assert "cm/px" not in text
    assert table["odm_processing_statistics"]["average_gsd"] is None


def test_the_report_warns_of_low_overlap_and_of_a_changed_focal_length():
    thin = flight(2, 4) * (3, 1.5, 1)
    found = findings(thin)
    read = found.survey.photographs
    lens = replace(read[0].lens, focal_px=500.0)
    survey = replace(found.survey, photographs=tuple(replace(p, lens=lens) for p in read))
    remarks = " ".join(counted(replace(found, survey=survey))["tidefield"]["remarks"])
    assert "seen by three photographs or more" in remarks
    assert "forward overlap, 40%" in remarks
    assert "side overlap, 25%" in remarks
    assert "focal length came out +20%" in remarks
    assert "No surveyed points" in remarks


def test_the_report_of_a_good_survey_with_check_points_has_no_warnings():
    control, check = residuals("control"), residuals("check")
    checked = findings(flight(5, 12), georeference=located(control=control, check=check))
    checked = replace(checked, survey=replace(checked.survey, control=surveyed(control, check)))
    assert counted(checked)["tidefield"]["remarks"] == []


def test_residuals_without_heights_are_reported_in_plan(tmp_path):
    given = residuals("GPS")
    level = Residuals(given.names, given.error_m * (1, 1, math.nan))
    text, table = report(findings(georeference=located(gps=level)), tmp_path)
    Reader(text)
    (found,) = [each for each in table["tidefield"]["residuals"] if each["kind"] == "gps"]
    assert found["rms_horizontal"] > 0
    assert found["rms_vertical"] is None
    assert "Residuals in plan" in text


def test_the_report_says_what_its_geojson_loses(monkeypatch):
    module = import_module("tidefield.survey.report.numbers")
    monkeypatch.setattr(module, "lost_in_conversion", lambda crs, target: f"in {crs.name} are 2 m off")
    remarks = counted(findings())["tidefield"]["remarks"]
    assert any(remark.startswith("survey.geojson: coordinates in WGS 84 / UTM zone") for remark in remarks)


def test_a_photograph_100_km_away_does_not_shrink_the_map():
    position = flight()
    stray = photograph(200, np.array([100_000.0, 0, 60]))
    found = findings(position)
    survey = replace(found.survey, photographs=(*found.survey.photographs, stray))
    near = drawn(found)
    left_out = (UnusedPhotograph(stray.name, "quality", "its GPS lies 100 km away"),)
    far = drawn(replace(found, survey=survey, left_out=left_out))
    near, far = (next(attrs for _, attrs in page.seen if attrs.get("class") == "map") for page in (near, far))
    assert near["viewbox"] == far["viewbox"]


def test_a_folder_that_cannot_be_written_to_is_an_error_of_the_run(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="cannot be written"):
        write_report(findings(flight(2, 3)), tmp_path / "file")


@pytest.mark.thorough
def test_two_thousand_photographs_make_a_page_that_can_be_sent(tmp_path):
    position = flight(40, 50)
    picture = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    lost = tuple(
        UnusedPhotograph(f"lost {i}.JPG", "quality", "blurred", {}, picture if i < MOST_THUMBNAILS else None)
        for i in range(500)
    )
    model = reconstruction(position, flat_ground(position, a_photograph=8))
    found = findings(position, left_out=lost, reconstruction=model)
    start = time.process_time()
    page = write_report(found, tmp_path)
    assert time.process_time() - start < 20  # a few seconds without the checks of types
    assert page.stat().st_size < 5e6
    assert Reader(page.read_text(encoding="utf-8")).count("figure") < 60


def test_numbers_become_plain_python_and_durations_are_formatted():
    assert plain({"a": np.float64(2), 3: [np.nan, np.int64(1)], "b": np.array([1.0, np.inf]), "c": np.bool_(True)}) == {
        "a": 2.0,
        "3": [None, 1],
        "b": [1.0, None],
        "c": True,
    }
    assert [duration(s) for s in (0.04, 59.4, 60.0, 3599.7, 7384.0)] == [
        "0.0 s",
        "59 s",
        "1 min 0 s",
        "1 h 0 min",
        "2 h 3 min",
    ]


@pytest.mark.parametrize(("behind_m", "text"), [(0.8, "0.80 m behind"), (-0.8, "0.80 m ahead of"), (0.02, None)])
def test_residuals_in_two_clusters_are_remarked_with_the_lag_of_the_clocks(behind_m, text):
    position = flight(4, 6)
    direction = np.repeat([1.0, -1.0, 1.0, -1.0], 6)
    error = np.random.default_rng(0).normal((0.3, 0.2, 1.0), 0.05, (24, 3))
    error[:, 0] += behind_m * direction
    names = tuple(p.name for p in findings(position).survey.photographs)
    table = counted(findings(position, georeference=located(gps=Residuals(names, error))))
    remarks = [remark for remark in table["tidefield"]["remarks"] if "two clusters" in remark]
    assert len(remarks) == (text is not None)
    assert text is None or (text in remarks[0] and "0.1 s" in remarks[0])


def test_the_geopackage_has_the_same_features_in_layers_in_the_surveys_own_system(written, folder):
    features = json.loads((folder / "survey.geojson").read_text(encoding="utf-8"))["features"]
    with closing(sqlite3.connect(folder / "survey.gpkg")) as db:
        db.row_factory = sqlite3.Row
        assert db.execute("PRAGMA application_id").fetchone()[0] == int.from_bytes(b"GPKG", "big")
        assert db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
        assert not db.execute("PRAGMA foreign_key_check").fetchall()
        layers = {row["identifier"]: row for row in db.execute("SELECT * FROM gpkg_contents")}
        assert set(layers) == {feature["properties"]["kind"] for feature in features}
        for name, contents in layers.items():
            assert contents["srs_id"] == FRAME.epsg
            rows = db.execute(f"SELECT * FROM {contents['table_name']}").fetchall()
            places = [shapely.from_wkb(row["geom"][8:]) for row in rows]
            assert {row["geom"][:8] for row in rows} == {b"GP\0\x01" + FRAME.epsg.to_bytes(4, "little")}
            np.testing.assert_allclose(shapely.total_bounds(places), list(contents)[5:9])
            mine = [feature for feature in features if feature["properties"]["kind"] == name]
            assert [{"kind": name, **dict(zip(row.keys()[2:], row[2:], strict=True))} for row in rows] == [
                feature["properties"] for feature in mine
            ]
            for place, feature in zip(places, mine, strict=True):
                xy = shapely.get_coordinates(place)
                degrees = shapely.get_coordinates(shapely.geometry.shape(feature["geometry"]))
                world = FRAME.from_geographic(np.c_[degrees, np.zeros(len(degrees))])
                np.testing.assert_allclose(FRAME.from_crs(np.c_[xy, np.zeros(len(xy))])[:, :2], world[:, :2], atol=2e-3)
