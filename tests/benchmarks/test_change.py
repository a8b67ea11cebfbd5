"""The figures of `python -m benchmarks change`."""

import numpy as np
import pytest
from shared_data import SHARED

from benchmarks.change import measure_change, published, write_page
from tidefield.change.surfaces import ChangeError

DATA = SHARED / "change"


@pytest.fixture(scope="module")
def figures():
    if not (DATA / "st_leonards").is_dir():
        pytest.skip(f"needs st_leonards and bmx in {DATA}")
    return published(DATA)


def test_published_deviations_are_reproduced_with_their_pixel_rule(figures):
    """To the six digits that npucino/sandpyper's notebook prints."""
    for step in figures["st_leonards"]:
        assert step["nmad_with_their_pixels_m"] == pytest.approx(step["published_nmad_m"], abs=1e-6)


def test_the_right_pixel_centres_make_a_difference(figures):
    ours = [step["nmad_m"] for step in figures["st_leonards"]]
    assert np.round(ours, 3).tolist() == [0.080, 0.111, 0.048, 0.155, 0.067]


def test_every_volume_has_an_interval(figures):
    for step in figures["st_leonards"]:
        assert step["net"]["low_m3"] < step["net"]["value_m3"] < step["net"]["high_m3"]


def test_cloudcompare_and_anderson_are_met(figures):
    assert figures["m3c2"]["equal_counts"] == figures["m3c2"]["core_points"] == 103
    assert figures["m3c2"]["distance_m"] < 0.002
    assert figures["m3c2"]["detection_m"] < 0.001
    assert figures["anderson_m3"] == pytest.approx([11.725, 63.664, 4448.04], rel=3e-5)


def test_missing_data_are_told_of(tmp_path):
    with pytest.raises(ChangeError, match="bmx"):
        measure_change(tmp_path, tmp_path, 0, print)
    with pytest.raises(ChangeError, match="benchmarks change"):
        write_page(tmp_path, tmp_path / "page.md")
