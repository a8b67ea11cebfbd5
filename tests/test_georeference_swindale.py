"""Ground control of a real survey, over a model of its photographs at half their size: what a surveyor is told.

The surveyors' list holds one point whose height and place contradict its own three marks and all other points.
"""

import csv
import math
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from tidefield.ingest.control import read_control
from tidefield.ingest.georeference import georeference
from tidefield.ingest.survey import Photograph, Position, Survey

DATA = Path(__file__).parents[1] / ".." / "shared" / "data"
PHOTOGRAPHS, MODEL = DATA / "photographs" / "swindale", DATA / "scenes" / "swindale" / "sparse" / "0"
POINTS = 4000  # of 12,000, to be quick

pytestmark = pytest.mark.skipif(
    not (PHOTOGRAPHS / "gcp_list.txt").exists() or not MODEL.exists(), reason=f"needs swindale in {DATA}"
)


def photographs() -> tuple[Photograph, ...]:
    with (PHOTOGRAPHS / "gps.csv").open() as file:
        rows = {row["image_name"]: row for row in csv.DictReader(file)}
    nan, found = math.nan, []
    for path in sorted(PHOTOGRAPHS.glob("*.jpg")):
        row = rows[path.stem]
        place = float(row["lat"]), float(row["lon"]), float(row["gps_height"])
        position = Position(*place, nan, nan, "unknown", "gps.csv")
        found.append(Photograph(path, path.name, 1600, 1200, 1, "", "", nan, None, nan, nan, position, nan, None))
    return tuple(found)


def thinned() -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction(MODEL)
    for number in np.random.default_rng(0).permutation(sorted(model.point3D_ids()))[POINTS:]:
        model.delete_point3D(int(number))
    return model


def test_gps_alone_is_good_to_its_own_noise():
    found = georeference(thinned(), Survey(PHOTOGRAPHS, photographs(), None), lambda done, whole: None)
    assert found.source == "GPS"
    assert found.frame is not None
    assert found.frame.epsg == 32630
    assert found.gps_used.horizontal_rms_m == pytest.approx(1.9, abs=0.2)
    assert found.gps_used.vertical_rms_m == pytest.approx(2.2, abs=0.2)


def test_control_brings_decimetres_and_finds_the_point_that_is_wrong():
    control, remarks = read_control(PHOTOGRAPHS / "gcp_list.txt", photographs())
    assert remarks == []
    model = thinned()
    found = georeference(model, Survey(PHOTOGRAPHS, photographs(), control), lambda done, whole: None)
    assert found.source == "ground control"
    assert [(item.kind, item.name) for item in found.left_out] == [("control point", "StkdT_12379")]
    assert len(found.check.names) == 7
    assert found.check.horizontal_rms_m < 0.25
    assert found.check.vertical_rms_m < 0.25
    assert found.control.horizontal_rms_m < found.check.horizontal_rms_m
    assert any("12303, StkdT_12372" in note for note in found.notes)
