import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from tidefield.data.load import load_scene
from tidefield.errors import SceneError
from tidefield.geometry.geodesy import WGS84, LocalFrame
from tidefield.survey.io.photographs import read_survey
from tidefield.synthetic import Flight, make_survey
from tidefield.synthetic.large import (
    PHOTOGRAPHS,
    TRUTH_FILE,
    LargeFlight,
    make_large_flight,
    planned_flight,
    true_positions,
    write_large_scene,
)

PLAN = LargeFlight("vegetation", seed=3, strips=2, each=4, width=64, gps_m=2.0, flight=Flight(focal_ratio=2.4))


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight") / "flight"
    make_large_flight(PLAN, folder)
    return folder


def test_photographs_are_read_as_a_survey_with_noisy_positions_and_the_true_lens(flight):
    survey = read_survey(flight / PHOTOGRAPHS)
    truth = true_positions(flight)
    assert [p.name for p in survey.photographs] == sorted(truth)
    assert len(truth) == 8
    frame = LocalFrame.at(WGS84, (8.3, 53.7, 0.0))
    errors = []
    for photograph in survey.photographs:
        place = photograph.position
        assert place is not None
        assert photograph.lens is not None
        assert photograph.lens.focal_px == pytest.approx(2.4 * 64, rel=1e-3)
        stated = np.array([[place.longitude_deg, place.latitude_deg, place.height_m]])
        errors.append((frame.from_geographic(stated) - frame.from_geographic(np.array([truth[photograph.name]])))[0])
    assert 0.5 < np.std(np.array(errors)[:, :2]) / 2.0 < 2.0
    times = [photograph.time_s for photograph in survey.photographs]
    assert (np.diff(times) == 3.0).all()


def test_strips_overlap_as_planned():
    cameras = planned_flight(replace(PLAN, flight=Flight(altitude_m=20.0)))[0]
    places = cameras.position_world.double().numpy().reshape(2, 4, 3)
    across, along = 20 / 0.8, 20 / 0.8 * 0.75
    assert np.diff(places[..., 0].mean(1)) == pytest.approx(0.3 * across, abs=0.5)
    assert np.diff(places[0, :, 1]) == pytest.approx(np.full(3, 0.2 * along), abs=1.2)
    assert (np.diff(places[1, :, 1]) < 0).all(), "the second strip is flown back"


@pytest.mark.thorough
def test_photographs_do_not_depend_on_plants_elsewhere():
    made = make_survey("vegetation", seed=3, views=6, width=48, flight=PLAN.flight, supersample=1)
    camera = made.cameras[2]
    corners = torch.tensor([[0.0, 0.0], [48, 0], [0, 36], [48, 36]])
    ground = camera.position_world[0] + camera.directions_world(corners[None])[0] * (camera.position_world[0, 2] + 3)
    low, high = (ground[:, :2].amin(0) - 1).tolist(), (ground[:, :2].amax(0) + 1).tolist()
    part = made.flat.with_plants_within(tuple(low), tuple(high))
    assert len(part.plants.leaves) < 0.9 * len(made.flat.plants.leaves)
    for whole, own in zip(made.flat.photograph(camera, 1), part.photograph(camera, 1), strict=True):
        assert torch.equal(whole, own)


def test_an_interrupted_flight_goes_on_and_makes_the_same_files(flight):
    files = sorted((flight / PHOTOGRAPHS).iterdir())
    before = files[5].read_bytes()
    files[5].unlink()
    times = {file: file.stat().st_mtime_ns for file in files if file.exists()}
    seen = []
    make_large_flight(PLAN, flight, lambda done, whole: seen.append((done, whole)))
    assert seen == [(8, 8)]
    assert files[5].read_bytes() == before
    assert {file: file.stat().st_mtime_ns for file in times} == times
    with Image.open(files[5]) as picture:
        assert picture.size == (64, 48)


def test_a_folder_of_another_flight_or_of_something_else_is_refused(flight, tmp_path):
    with pytest.raises(SceneError, match="another flight"):
        make_large_flight(replace(PLAN, seed=4), flight)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SceneError, match="something else"):
        make_large_flight(PLAN, tmp_path)
    with pytest.raises(SceneError, match=TRUTH_FILE):
        true_positions(tmp_path)
    with pytest.raises(SceneError, match="one or more"):
        make_large_flight(replace(PLAN, strips=0), tmp_path / "new")
    assert json.loads((flight / TRUTH_FILE).read_text())["plan"]["seed"] == 3


@pytest.mark.thorough
def test_the_scene_of_a_flight_has_its_true_poses_and_points_on_the_mud(flight, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_large_scene(PLAN, flight, tmp_path / "scene")
    scene = load_scene(tmp_path / "scene", calibrate=False)
    assert list(scene.names) == sorted(true_positions(flight))
    frame = LocalFrame.at(WGS84, (8.3, 53.7, 0.0), "mean sea level")
    true = frame.from_geographic(np.array([true_positions(flight)[name] for name in scene.names]))
    own = scene.cameras.position_world.double().numpy() + scene.origin_world.numpy()
    np.testing.assert_allclose(own, true, atol=1e-3)
    points = scene.points
    assert points is not None
    assert len(points.xyz_world) > 200
    uv, _ = scene.cameras.project(points.xyz_world)
    off = (uv[points.camera_index.long(), points.point_index.long()] - points.uv_px).norm(dim=1)
    assert 0.1 < off.median() < 0.6
    height = points.xyz_world[:, 2] + scene.origin_world[2]
    assert height.abs().median() < 1
    # Two photographs show the same at the same point.
    both = [set(points.point_index[points.camera_index == i].tolist()) for i in (2, 3)]
    which = sorted(both[0] & both[1])
    assert len(which) > 10
    shown = []
    for i in (2, 3):
        column, row = uv[i, which].long().clamp(min=0).unbind(1)
        shown.append(scene.photographs[i][row.clamp(max=47), column.clamp(max=63)].float())
    assert (shown[0] - shown[1]).abs().mean() < 0.7 * (shown[0] - shown[1].flip(0)).abs().mean()
