"""Ground control that lies elsewhere is refused, with the systems in which it would lie here."""

import pytest

from tidefield.errors import SurveyError
from tidefield.survey.io.which_crs import refuse_elsewhere
from tidefield.survey.survey import Control

HERE = -2.752, 54.512


def refusal(crs: str, x: float, y: float, here: tuple[float, float] = HERE) -> str:
    with pytest.raises(SurveyError) as caught:
        refuse_elsewhere(Control(crs, {"G1": (x, y, 260.0), "G2": (x, y, 261.0)}, ()), *here)
    return str(caught.value)


def test_control_of_the_same_place_passes():
    refuse_elsewhere(Control("EPSG:27700", {"G1": (351139.0, 512875.0, 264.0)}, ()), *HERE)


@pytest.mark.parametrize(
    ("crs", "x", "y", "expected"),
    [
        ("EPSG:32630", 351139.0, 512875.0, "EPSG:27700 (OSGB36 / British National Grid)"),
        ("EPSG:27700", 512875.0, 351139.0, "British National Grid), with the two coordinates swapped"),
        ("EPSG:32631", 516100.0, 6040500.0, "EPSG:32630 (WGS 84 / UTM zone 30N)"),
        ("EPSG:27700", -2.752, 54.512, "EPSG:4326 (longitude and latitude)"),
        ("EPSG:4326", 54.512, -2.752, "with the two coordinates swapped"),
        ("EPSG:27700", 356139.0, 518875.0, "no system that is used here"),
    ],
)
def test_the_system_that_fits_is_named(crs, x, y, expected):
    message = refusal(crs, x, y)
    assert expected in message
    assert " km from the photographs" in message or "nowhere near" in message


def test_coordinates_that_a_system_cannot_hold_are_refused_too():
    assert "nowhere near the photographs" in refusal("EPSG:27700", 1e12, 1e12)
