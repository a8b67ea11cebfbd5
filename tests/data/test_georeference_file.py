"""georeference.json: a round trip, its statistics, and errors of damaged files."""

import json
import math

import numpy as np
import pytest

from tidefield.data.georeference import FILE_NAME, Georeference, LeftOut, Residuals, read_georeference
from tidefield.errors import SceneError
from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.similarity import Similarity

GPS = Residuals(("a.jpg", "b.jpg", "c.jpg"), np.array([[3.0, 4, 1], [0.0, 0, math.nan], [1e5, 0, 0]]))
FOUND = Georeference(
    frame=LocalFrame.at("EPSG:27700", (351200.0, 512900.0, 260.0), "Newlyn"),
    source="ground control",
    world_from_model=Similarity(42.0, np.eye(3), np.array([1.0, 2, 3])),
    gps=GPS,
    control=Residuals(("G1",), np.array([[0.01, 0.02, -0.03]])),
    check=Residuals(),
    left_out=(LeftOut("GPS", "c.jpg", "it is 100 km away"),),
    notes=("A note.",),
    gps_has_part=False,
)


def test_a_georeference_reads_back_as_written(tmp_path):
    FOUND.write(tmp_path)
    again = read_georeference(tmp_path)
    assert again is not None
    assert (again.frame, again.source, again.left_out, again.notes) == (
        FOUND.frame,
        FOUND.source,
        FOUND.left_out,
        FOUND.notes,
    )
    for kind in ("gps", "control", "check"):
        assert getattr(again, kind).names == getattr(FOUND, kind).names
        np.testing.assert_array_equal(getattr(again, kind).error_m, getattr(FOUND, kind).error_m)
    np.testing.assert_array_equal(again.world_from_model.translation, [1, 2, 3])
    assert not again.gps_has_part
    values = json.loads((tmp_path / FILE_NAME).read_text())
    del values["gps_has_part"]  # as earlier versions wrote it
    for source, has_part in (("ground control", False), ("GPS", True)):
        (tmp_path / FILE_NAME).write_text(json.dumps(values | {"source": source}))
        assert read_georeference(tmp_path).gps_has_part == has_part


def test_statistics_use_only_known_and_accepted_residuals(tmp_path):
    assert FOUND.gps_used.names == ("a.jpg", "b.jpg")
    assert FOUND.gps_used.horizontal_rms_m == pytest.approx(math.sqrt(12.5))
    assert FOUND.gps_used.vertical_rms_m == pytest.approx(1)
    assert math.isnan(FOUND.check.horizontal_rms_m)
    assert FOUND.gps.known.tolist() == [True, False, True]
    np.testing.assert_array_equal(FOUND.gps_used.median_m, [3, 4, 1])
    FOUND.write(tmp_path)
    written = json.loads((tmp_path / FILE_NAME).read_text())
    assert written["residuals"]["gps_used"]["horizontal_rms_m"] == pytest.approx(math.sqrt(12.5))
    assert written["residuals"]["check"]["horizontal_rms_m"] is None
    assert written["frame"]["epsg"] == 27700


def test_a_scene_without_the_file_has_no_georeference(tmp_path):
    assert read_georeference(tmp_path) is None


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "[]",
        lambda text: "[" * 100_000,
        lambda text: text.replace('"scale": ', '"scale": 1' + 400 * "0"),
        lambda text: text.replace('"translation": [', '"translation": [1' + 400 * "0" + ", "),
        lambda text: text.replace('"version": 1', '"version": 2'),
        lambda text: text.replace('"ground control"', '"hearsay"'),
        lambda text: text.replace("EPSG:27700", "EPSG:1"),
        lambda text: text.replace('"rotation"', '"turn"'),
    ],
)
def test_a_damaged_file_is_an_error(tmp_path, change):
    FOUND.write(tmp_path)
    path = tmp_path / FILE_NAME
    path.write_text(change(path.read_text()))
    with pytest.raises(SceneError, match=r"is damaged|holds a list|has \w+ = "):
        read_georeference(tmp_path)


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("world_from_model", "scale"), math.nan),
        (("world_from_model", "scale"), 0),
        (("world_from_model", "scale"), 10**400),
        (("world_from_model", "translation"), [math.inf, 0, 0]),
        (("frame", "origin", "latitude_deg"), 1e9),
        (("frame", "origin", "height_m"), math.nan),
        (("frame", "crs"), "EPSG:32600"),
    ],
)
def test_impossible_values_are_errors(tmp_path, keys, value):
    FOUND.write(tmp_path)
    values = json.loads((tmp_path / FILE_NAME).read_text())
    place = values
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    (tmp_path / FILE_NAME).write_text(json.dumps(values))
    with pytest.raises(SceneError, match=FILE_NAME):
        read_georeference(tmp_path)


def test_nesting_without_end_is_an_error(tmp_path):
    (tmp_path / FILE_NAME).write_text("[" * 100_000)
    with pytest.raises(SceneError, match="is damaged"):
        read_georeference(tmp_path)
