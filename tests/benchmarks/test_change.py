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


@pytest.fixture(scope="module")
def pair():
    from tidefield.synthetic.two_dates import Difference, make_pair

    return make_pair("tidal_trees", 3, Difference(0.2), views=9, width=48, supersample=1)


@pytest.fixture(scope="module")
def chain(pair, tmp_path_factory):
    """Photographs and truth as `change_chain` writes them."""
    from benchmarks.change_chain import write_photographs
    from tidefield.synthetic import flights

    folder = tmp_path_factory.mktemp("chain")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flights, "CONTROL_POINTS", 4)
        write_photographs(pair, folder)
    return folder


@pytest.mark.thorough
def test_photographs_of_the_chain_come_with_control_that_fits_them(pair, chain):
    import torch

    from benchmarks import change_chain
    from tidefield.change.surfaces import Grid
    from tidefield.survey.io.photographs import read_survey

    frame = change_chain.frame()
    for made, date in zip((pair.earlier, pair.later), change_chain.DATES, strict=True):
        survey = read_survey(chain / date / "photographs", None, None)
        assert len(survey.photographs) == 9
        control = survey.control
        assert control is not None
        assert len(control.points) == 4
        names = [photograph.name for photograph in survey.photographs]
        points = frame.from_crs(np.array([control.points[mark.point] for mark in control.marks]))
        uv, _ = made.cameras.project(torch.from_numpy(points).float())
        which = [names.index(mark.photograph) for mark in control.marks]
        error = uv[which, range(len(which))].numpy() - [mark.uv_px for mark in control.marks]
        assert len(error) > 12
        assert 0.15 < error.std() < 0.6  # marks are set to 0.3 pixels
        assert np.abs(error.mean(axis=0)).max() < 0.3
        bed = made.flat.bed.sample(torch.from_numpy(points[:, :2].T.copy()).float())[0].numpy()
        assert np.abs(points[:, 2] - bed).max() < 0.1  # surveyed to 1 cm
        stated = [photograph.position for photograph in survey.photographs]
        places = [[at.longitude_deg, at.latitude_deg, at.height_m] for at in stated if at is not None]
        off = frame.from_geographic(np.array(places)) - made.cameras.position_world.double().numpy()
        assert 0.8 < off.std() < 2.5  # a receiver's 1.5 m
    grid = Grid(None, 499_990.0, 5_800_010.0, 0.5, 40, 40)
    truth = change_chain.Truth(chain / "truth.npz", grid)
    # The middle cell lies a quarter of a metre beside the origin of the flat.
    xy = torch.tensor([[0.25], [-0.25]])
    assert truth.of["bed1"][20, 20] == pytest.approx(float(pair.later.flat.bed.sample(xy)[0]), abs=0.02)
    assert truth.change[20, 20] == pytest.approx(float(pair.ground_change.sample(xy)[0]), abs=0.02)
    assert truth.bare(0, 1).dtype == bool


@pytest.mark.thorough
def test_control_stands_under_no_plant_wherever_the_marsh_is(pair, monkeypatch):
    from dataclasses import replace

    import torch

    from tidefield.synthetic import flights
    from tidefield.synthetic.grids import Extent

    monkeypatch.setattr(flights, "CONTROL_POINTS", 4)
    first = flights._control(pair, 11)[0, :2]
    # The highest leaf comes to lie over the first place, and all others are moved with it.
    flat = pair.later.flat
    leaves = flat.plants.leaves
    move = torch.from_numpy(first).float()[:, None] - leaves.centre[:2, [int(leaves.centre[2].argmax())]]
    moved = replace(leaves, centre=torch.cat([leaves.centre[:2] + move, leaves.centre[2:]]))
    flat = replace(flat, plants=replace(flat.plants, leaves=moved))
    places = flights._control(replace(pair, later=replace(pair.later, flat=flat)), 11)[:, :2]
    assert np.hypot(*(places - first).T).min() > 0.1
    for x, y in places.tolist():
        around = Extent(x - 0.1, y - 0.1, 5, 5, 0.05)
        above = flat.seen(around).values.reshape(-1) - flat.bed.sample(around.nodes())[0]
        assert float(above.max()) < flights.BARE_M


@pytest.mark.thorough
def test_bare_ground_of_the_chain_has_no_plants_on_it(pair, chain):
    from benchmarks import change_chain
    from tidefield.change.surfaces import Grid
    from tidefield.synthetic.flights import BARE_M
    from tidefield.synthetic.grids import Extent

    west, south, east, north = change_chain.AREA_M
    cells = Extent.around([west, south], [east, north], 0.15)
    corner = (5e5 + west - 0.075, 5.8e6 + cells.north_m + 0.075)
    bare = change_chain.Truth(chain / "truth.npz", Grid(None, *corner, 0.15, cells.columns, cells.rows)).bare(0, 1)
    assert bare.mean() > 0.3
    for flat in (pair.earlier.flat, pair.later.flat):
        bed = flat.bed.sample(cells.nodes())[0].reshape(cells.rows, cells.columns)
        above = (flat.seen(cells).values[0] - bed).flip(0).numpy()
        assert above[bare].max() < BARE_M
        # Plants that grow outside the marsh are none of it.
        marsh = flat.marsh.sample(cells.nodes())[0].reshape(cells.rows, cells.columns).flip(0).numpy()
        assert ((above > 0.5) & (marsh < 0.02)).sum() > 20


@pytest.mark.thorough
def test_plants_outside_the_marsh_are_true_cover(pair):
    from benchmarks.change_cover import covered
    from tidefield.synthetic.grids import Extent

    flat = pair.earlier.flat
    extent = Extent.around([-30.0, -25.0], [30.0, 25.0], 0.15)
    seen = flat.map(extent)[1]
    ground, marsh = (raster.sample(extent.nodes()).reshape(seen.shape).flip(0) for raster in (flat.surface, flat.marsh))
    trees = ((seen - ground > 1.2) & (marsh < 0.02)).numpy()
    assert trees.sum() * 0.15**2 > 5
    assert covered(flat, seen.numpy(), extent)[trees].all()


def test_a_work_folder_of_other_options_is_refused(tmp_path, monkeypatch):
    from benchmarks import change_chain, change_null
    from tidefield.errors import RunError, SurveyError

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(change_chain, "make_pair", stop)
    for width in (800, 48):  # before anything was made, options may change
        with pytest.raises(KeyboardInterrupt):
            change_chain.change_chain(tmp_path / "chain", 9, width, tmp_path)
    (tmp_path / "chain" / "surveys").mkdir()
    (tmp_path / "chain" / "surveys" / "truth.npz").touch()
    with pytest.raises(SurveyError, match="photographs does not exist"):  # the same options go on with what is there
        change_chain.change_chain(tmp_path / "chain", 9, 48, tmp_path)
    with pytest.raises(RunError, match=r"chain holds files of .*'width_px': 48.*: expected .*'width_px': 800"):
        change_chain.change_chain(tmp_path / "chain", 9, 800, tmp_path)
    (tmp_path / "former").mkdir()
    (tmp_path / "former" / "truth.npz").touch()
    with pytest.raises(RunError, match="former holds files of unknown options"):
        change_chain.change_chain(tmp_path / "former", 9, 48, tmp_path)
    monkeypatch.setattr(change_null, "copy_flight", stop)
    with pytest.raises(KeyboardInterrupt):
        change_null.change_null(tmp_path / "swindale", tmp_path / "null", tmp_path)
    (tmp_path / "null" / "IMG_1414.jpg").touch()
    with pytest.raises(RunError, match=r"null holds files of .*swindale"):
        change_null.change_null(tmp_path / "another", tmp_path / "null", tmp_path)


def test_parts_that_were_measured_are_on_the_page(tmp_path):
    from benchmarks.change import store

    size = {"million_cells": 100.0, "seconds": 600.0, "processor_seconds": 900.0, "peak_memory_bytes": 3e9}
    store(tmp_path, "size", size | {"written_bytes": 1e9, "cores": 2})
    record = json.loads((tmp_path / "change.json").read_text())
    record["size"]["date"] = "2020-02-02"
    (tmp_path / "change.json").write_text(json.dumps(record))
    area = {"value_m2": 10.0, "low_m2": 8.0, "high_m2": 12.0, "true_m2": 11.0}
    water = {"land_gained": area, "true_gained_m2": 6.0, "land_lost": area, "true_lost_m2": 0.0}
    of = {"category": "vegetation", "seed": 1, "cover": dict.fromkeys(("earlier", "later", "gained", "lost"), area)}
    store(tmp_path, "cover", [of | {"water": water | {"move_m": [1.0, 0.5, 1.5]}}])
    write_page(tmp_path, tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text()
    assert "10 (8 to 12); 11" in page
    assert "| 10 (8 to 12); 6 | 10 (8 to 12); 0 |" in page
    assert "+1.00 (+0.50 to +1.50)" in page
    assert "3.00 GB" in page
    assert page.index("Measured on 20") < page.index("3.00 GB") < page.index("Measured on 2020-02-02, version")
