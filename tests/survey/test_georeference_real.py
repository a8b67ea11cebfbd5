"""Georeferences of real surveys, from models of their photographs at half size.

The surveyors' list of swindale has one point that contradicts its own three marks and all other points.
"""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from shared_data import SHARED

from tidefield.data.georeference import Georeference
from tidefield.survey.georeference.georeference import georeference
from tidefield.survey.io.photographs import read_survey

POINTS = 3000  # of 12,000, to be quick


def located(name: str, control: bool = True) -> tuple[pycolmap.Reconstruction, Georeference]:
    photographs, scene = SHARED / "photographs" / name, SHARED / "scenes" / name / "sparse" / "0"
    if not photographs.is_dir() or not scene.is_dir():
        pytest.skip(f"needs {name} in {SHARED}")
    survey, model = read_survey(photographs), pycolmap.Reconstruction(scene)
    for number in np.random.default_rng(0).permutation(sorted(model.point3D_ids()))[POINTS:]:
        model.delete_point3D(int(number))
    survey = survey if control else replace(survey, control=None)
    return model, georeference(model, survey, lambda done, whole: None)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "epsg", "horizontal_m", "vertical_m"),
    [("brighton_beach", 32615, 0.56, 0.15), ("swindale", 32630, 1.9, 2.2)],
)
def test_gps_residuals_are_the_receivers_noise(name, epsg, horizontal_m, vertical_m):
    _, found = located(name, control=False)
    assert found.source == "GPS"
    assert found.frame is not None
    assert found.frame.epsg == epsg
    assert found.gps_used.horizontal_rms_m == pytest.approx(horizontal_m, rel=0.1)
    assert found.gps_used.vertical_rms_m == pytest.approx(vertical_m, rel=0.1)
    assert found.left_out == found.notes == ()


@pytest.mark.thorough
def test_differential_gps_removes_the_bend_of_turin_lot():
    model, found = located("turin_lot")
    assert "instead of 11 cm horizontally and 31 cm vertically" in found.notes[0]
    assert found.gps.horizontal_rms_m < 0.03
    assert found.gps.vertical_rms_m < 0.03
    down = [model.image(number).viewing_direction()[2] for number in model.reg_image_ids()]
    assert max(down) < -0.9998, "all gimbals said -89.9 degrees or more"


@pytest.mark.thorough
def test_control_of_swindale_is_met_to_decimetres_without_the_wrong_point():
    _, found = located("swindale")
    assert found.source == "ground control"
    assert [(item.kind, item.name) for item in found.left_out] == [("control point", "StkdT_12379")]
    assert len(found.check.names) == 7
    assert found.check.horizontal_rms_m < 0.25
    assert found.check.vertical_rms_m < 0.25
    assert found.control.horizontal_rms_m < found.check.horizontal_rms_m
    assert any("12303, StkdT_12372" in note for note in found.notes)
