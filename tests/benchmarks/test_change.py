"""The figures of `python -m benchmarks change`."""

import json
import resource

import numpy as np
import pytest
from shared_data import SHARED

from benchmarks.change import change, published, write_page
from tidefield.change.surfaces import ChangeError
from tidefield.machine import peak_bytes

DATA = SHARED / "change"


@pytest.fixture(scope="module")
def figures():
    if not (DATA / "st_leonards").is_dir():
        pytest.skip(f"needs st_leonards and bmx in {DATA}")
    with pytest.MonkeyPatch.context() as patch:
        # What the choice of outlines adds to cut and fill takes most of the time, and is asked for nowhere here.
        patch.setattr("tidefield.change.measure.repeat_choice", lambda *_: None)
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
        change(tmp_path, 0, tmp_path)
    with pytest.raises(ChangeError, match="benchmarks change"):
        write_page(tmp_path, tmp_path / "page.md")


def test_figures_that_an_earlier_version_stored_are_refused(tmp_path):
    """It kept one date for all parts, which were lists or had their figures at once."""
    former = {"date": "2026-11-01", "pairs": [], "size": {"million_cells": 100.0}}
    (tmp_path / "change.json").write_text(json.dumps(former))
    with pytest.raises(ChangeError, match=r"pairs, size as earlier versions stored it: .* measure again"):
        write_page(tmp_path, tmp_path / "page.md")
    assert not (tmp_path / "page.md").exists()


@pytest.mark.thorough
def test_the_command_is_measured_on_a_small_pair(tmp_path):
    from benchmarks.change_size import change_size

    found = change_size(0.05, tmp_path)
    assert json.loads((tmp_path / "change.json").read_text())["size"]["found"] == found
    assert found["million_cells"] == pytest.approx(0.05, rel=0.02)
    # A process begins with the memory of the one that starts it, here of all tests so far.
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert 50e6 < found["peak_memory_bytes"] < max(4e9, 1.01 * peak_bytes(own))
    assert found["processor_seconds"] > 0.5
    assert found["written_bytes"] > 10_000


def test_a_flight_is_copied_with_its_own_lines_of_the_lists(tmp_path):
    from benchmarks.change_null import copy_flight

    for number in (1413, 1414, 1481, 1548):
        (tmp_path / f"IMG_{number}.jpg").write_bytes(b"jpeg")
    (tmp_path / "gps.csv").write_text("image_name,lat,lon,gps_height\n")
    lines = ["EPSG:27700", "1 2 3 4 5 IMG_1414.jpg A", "1 2 3 4 5 IMG_1548.jpg A"]
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines))
    copy_flight(tmp_path, (1414, 1481), tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").glob("*.jpg")) == ["IMG_1414.jpg", "IMG_1481.jpg"]
    assert (tmp_path / "out" / "gcp_list.txt").read_text().splitlines() == lines[:2]


def test_photographs_of_the_chain_come_with_control_that_fits_them(tmp_path, monkeypatch):
    import torch

    from benchmarks import change_chain
    from tidefield.change.surfaces import Grid
    from tidefield.survey.io.photographs import read_survey
    from tidefield.synthetic import flights
    from tidefield.synthetic.two_dates import Difference, make_pair

    monkeypatch.setattr(flights, "CONTROL_POINTS", 4)
    pair = make_pair("ground_textures", 3, Difference(0.2), views=9, width=96)
    change_chain.write_photographs(pair, tmp_path)
    survey = read_survey(tmp_path / change_chain.DATES[1] / "photographs", None, None)
    assert len(survey.photographs) == 9
    assert survey.control is not None
    grid = Grid(None, 499_990.0, 5_800_010.0, 0.5, 40, 40)
    truth = change_chain.Truth(tmp_path / "truth.npz", grid)
    # The middle cell lies a quarter of a metre beside the origin of the flat.
    xy = torch.tensor([[0.25], [-0.25]])
    assert truth.of["bed1"][20, 20] == pytest.approx(float(pair.later.flat.bed.sample(xy)[0]), abs=0.02)
    assert truth.change[20, 20] == pytest.approx(float(pair.ground_change.sample(xy)[0]), abs=0.02)
    assert truth.bare(0, 1).dtype == bool


def test_parts_that_were_measured_are_on_the_page(tmp_path):
    from benchmarks.change import store

    size = {"million_cells": 100.0, "seconds": 600.0, "processor_seconds": 900.0, "peak_memory_bytes": 3e9}
    store(tmp_path, "size", size | {"written_bytes": 1e9, "cores": 2})
    record = json.loads((tmp_path / "change.json").read_text())
    record["size"]["date"] = "2020-02-02"
    (tmp_path / "change.json").write_text(json.dumps(record))
    area = {"value_m2": 10.0, "low_m2": 8.0, "high_m2": 12.0, "true_m2": 11.0}
    water = {"land_gained_m2": 5.0, "true_gained_m2": 6.0, "land_lost_m2": 0.0, "true_lost_m2": 0.0}
    of = {"category": "vegetation", "seed": 1, "cover": dict.fromkeys(("earlier", "later", "gained", "lost"), area)}
    store(tmp_path, "cover", [of | {"water": water | {"move_m": [1.0, 0.5, 1.5]}}])
    write_page(tmp_path, tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text()
    assert "10 (8 to 12); 11" in page
    assert "+1.00 (+0.50 to +1.50)" in page
    assert "3.00 GB" in page
    assert page.index("Measured on 20") < page.index("3.00 GB") < page.index("Measured on 2020-02-02, version")
