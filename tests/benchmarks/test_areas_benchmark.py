"""The benchmark of training by areas: a step that is put in comes out, and training leaves none."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from networks import SMALL

from benchmarks.areas import AREAS_FILE, _in_world, areas, border_cameras, border_steps, slope_bytes, tables
from tidefield.compare.run import Usage
from tidefield.config import PRESETS, Budget
from tidefield.data.areas import cut
from tidefield.data.load import load_scene
from tidefield.errors import RunError
from tidefield.files import read_json
from tidefield.model.rendering import Rendering
from tidefield.synthetic import Flight
from tidefield.synthetic.large import LargeFlight, make_large_flight, planned_flight, write_large_scene
from tidefield.train.checkpoint import given_or_shipped
from tidefield.train.loop import SceneTrainer

PLAN = LargeFlight(strips=5, each=8, width=96, flight=Flight(altitude_m=20.0))
AREAS = partial(cut, whole=20, most=12)


@pytest.fixture(scope="module")
def flat():
    return planned_flight(PLAN)[3]()


@pytest.fixture(scope="module")
def scene(flat, tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("flight")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tidefield.synthetic.large.make_flat", lambda *_: flat)  # it takes seconds each time
        make_large_flight(PLAN, folder / "flight")
        write_large_scene(PLAN, folder / "flight", folder / "scene")
    return load_scene(folder / "scene", cache=folder / "cache")


@pytest.mark.thorough
def test_views_over_borders_have_an_area_on_each_side(scene):
    areas = AREAS(scene)
    assert len(areas) == 4
    cameras = border_cameras(scene, areas, 8)
    assert len(cameras) == 8
    for camera in cameras:
        torch.testing.assert_close(camera.forward_world[0], torch.tensor([0.0, 0.0, -1.0]))
        # The nearest photographs on both sides of the upright middle line belong to different areas.
        along = (scene.cameras.position_world - camera.position_world) @ camera.T_world_camera[0, :, 0]
        distance = (scene.cameras.position_world - camera.position_world).norm(dim=1)
        nearest = [
            min((i for i in scene.train if sign * along[i] > 0), key=lambda i: float(distance[i])) for sign in (-1, 1)
        ]
        sides = {next(k for k, area in enumerate(areas) if i in area) for i in nearest}
        assert len(sides) == 2


@pytest.mark.thorough
def test_a_step_at_borders_is_found_and_elsewhere_there_is_none(scene, flat):
    def render(camera):
        truth, depth = flat.photograph(replace(camera, T_world_camera=_in_world(camera, scene)), 2)
        right = (torch.arange(camera.width) >= camera.width // 2).float()[None, :, None]
        return Rendering(truth + right * 3 / 255, depth, torch.ones_like(depth))

    found = border_steps(scene, AREAS(scene), render, flat, views=3)
    assert found["views"] == 3
    assert found["border_mean"] == pytest.approx(3, abs=1e-3)
    assert found["border_largest"] == pytest.approx(3, abs=1e-3)
    assert found["inside_largest"] == pytest.approx(0, abs=1e-3)


@pytest.mark.slow
def test_training_by_areas_leaves_no_seam_on_flat_mud(scene, flat):
    areas, config = AREAS(scene), PRESETS["swift"]
    weights = given_or_shipped(None, "swift")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tidefield.train.loop.STEPS_EACH", 25)
        trainer = SceneTrainer(config, scene, 0, torch.device("cpu"), weights, areas)
        for _ in range(100):
            trainer.step(Budget(steps=100))
    trainer.network.eval()
    found = border_steps(scene, areas, trainer.renderer(), flat, views=8)
    assert abs(found["border_mean"]) < 1
    assert found["border_mean_absolute"] < 1.5 * found["inside_mean_absolute"] + 0.2


STEP = dict.fromkeys(
    ("border_mean", "border_mean_absolute", "border_largest", "inside_mean_absolute", "inside_largest"), 0.25
)
COMPARED = {"areas": 8, "seconds": 9.0, "psnr": 30.0, "borders": {"views": 4, **STEP}}


def test_what_is_stored_is_not_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    calls: list[list[str]] = []

    def run(command, environment):
        calls.append(list(command[3:]))
        return Usage(3.0, 1_000_000_000 + 1000 * int(Path(command[4]).name.split("_")[1]))

    monkeypatch.setattr("benchmarks.areas._scene", lambda plan, work: work / f"scene_{plan.strips * plan.each}_96")
    monkeypatch.setattr("benchmarks.areas.compare", lambda *_: COMPARED)
    for _ in range(2):
        record = areas(tmp_path, tmp_path / "runs", (500, 1000), 96, 5, 7, run)
    assert [words[:2] for words in calls] == [["train", str(tmp_path / f"scene_{n}_96")] for n in (500, 1000)]
    assert slope_bytes(record) == pytest.approx(1000)
    memory, seams = (table.markdown() for table in tables(record))
    assert "| 1,000 | 1.00 |" in memory
    assert "| by areas (8) | 30.00 | 0.25 | 0.25 | 0.25 | 0.25 | 0.25 |" in seams


def test_comparisons_are_of_their_flight_and_of_their_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def compare(scene, plan, by_areas, steps):
        return {**COMPARED, "psnr": plan.strips * plan.each / 100}

    def measure(*counts: int) -> list[str]:
        record = areas(tmp_path, tmp_path, counts, 96, 5, 7, lambda *_: Usage(1.0, 1))
        return [table.markdown() for table in tables(record)[1:]]

    monkeypatch.setattr("benchmarks.areas._scene", lambda plan, work: work)
    monkeypatch.setattr("benchmarks.areas.compare", compare)
    measure(500, 1000)
    for page, title, psnr in zip(measure(100, 500), ("500", "100"), ("5.00", "1.00"), strict=True):
        assert f"{title} photographs, 7 steps" in page
        assert f"| at once (8) | {psnr} |" in page
    monkeypatch.setattr("benchmarks.areas.network_of", lambda _: "other weights")
    with pytest.raises(RunError, match=r"100 photographs: at once with network .* expected other weights"):
        measure(100, 500)


def test_comparisons_of_earlier_versions_are_shown_with_their_flight():
    record = read_json(Path(__file__).parents[2] / "docs" / "measured" / AREAS_FILE)
    _, seams = (table.markdown() for table in tables(record))
    assert "500 photographs, 1,600 steps" in seams
    assert "| by areas (8) | 34.65 |" in seams


@pytest.mark.thorough
def test_a_view_does_not_depend_on_the_area_that_is_open(scene):
    trainer = SceneTrainer(SMALL, scene, 0, torch.device("cpu"), areas=AREAS(scene))
    camera = scene.cameras[scene.test[1]].resized(48, 36)
    views, opened = [], []
    for step in (0, 200, 400):
        trainer.progress.step = step
        opened.append(trainer.open_area().number)
        [view] = trainer.views([camera])
        views.append(view.colour.numpy())
    assert len(set(opened)) == 3
    np.testing.assert_array_equal(views[0], views[1])
    np.testing.assert_array_equal(views[0], views[2])
