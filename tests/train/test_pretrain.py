"""Training across scenes: the stream, processes that learn together, and weights as a file."""

from __future__ import annotations

import json
import os
import socket
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import textured_wall as wall
import torch
import torch.multiprocessing as processes
from networks import SMALL
from rich.console import Console
from safetensors import safe_open
from scenes_on_disk import PINHOLE, survey, write_colmap
from torch.nn import functional as F

from tidefield.commands.pretrain import Pretrain
from tidefield.commands.pretrain import pretrain as pretrain_command
from tidefield.config import PRESETS, SWIFT, Budget
from tidefield.data.depth_prior import DepthPriors
from tidefield.errors import RunError
from tidefield.model.network import make_network
from tidefield.synthetic import Flight
from tidefield.train import pretrain, stream
from tidefield.train.checkpoint import SHIPPED, read_weights, read_weights_file, weights_sha256, write_weights
from tidefield.train.loop import SceneTrainer
from tidefield.train.losses import Inputs
from tidefield.train.pretrain import Pretrainer, Validation
from tidefield.train.stream import Drawn, Recipe, Stream, recipe

CPU = torch.device("cpu")
QUIET = Console(quiet=True)


class Walls(Stream):
    """Stands in for the stream: a textured wall that others see differently."""

    def __init__(self, rank: int = 0) -> None:
        scene = wall.scene(wall.cameras(6 + rank))
        self.drawn = Drawn(scene, DepthPriors(scene), scene.cameras)
        self.asked: list[int] = []

    def draw(self, step: int, generator: torch.Generator, device: torch.device | str = "cpu") -> Drawn:
        self.asked.append(step)
        return self.drawn


def small_recipe(seed: int, number: int) -> Recipe:
    misposed = (1,) if number == 1 else ()
    return Recipe("ground_textures", 100 * seed + number, 4, 32, Flight(altitude_m=20.0), misposed)


def test_recipes_repeat_and_differ() -> None:
    assert recipe(3, 5) == recipe(3, 5)
    every = [recipe(3, number) for number in range(100)]
    assert len({one.seed for one in every}) == 100
    assert len({one.category for one in every}) == 5
    assert {one.flight.exposure_spread > 0 for one in every} == {True, False}
    assert {one.flight.water_motion > 0 for one in every} == {True, False}
    assert {len(one.misposed) for one in every} == {0, 1}
    assert all(index < one.views for one in every for index in one.misposed)


@pytest.mark.thorough
def test_the_stream_keeps_a_pool_of_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(stream, "recipe", small_recipe)
    monkeypatch.setattr(stream, "POOL_SIZE", 2)
    monkeypatch.setattr(stream, "STEPS_EACH", 4)
    generator = torch.Generator().manual_seed(0)
    monkeypatch.setattr(stream, "cores", lambda: 1)
    with Stream(tmp_path / "scenes", [], 7, SMALL) as scenes:
        names = [[scenes.draw(step, generator).scene.root.name for _ in range(8)] for step in (0, 4)]
    assert set(names[0]) == {"7-000000", "7-000001"}
    assert set(names[1]) == {"7-000001", "7-000002"}
    assert not (tmp_path / "scenes" / "7-000000").exists()
    assert not (tmp_path / "cache").exists(), "the user's cache would grow without end"
    made = (tmp_path / "scenes" / "7-000002").stat().st_mtime_ns
    again = torch.Generator().manual_seed(0)
    with Stream(tmp_path / "scenes", [], 7, SMALL) as scenes:
        for _ in range(8):
            scenes.draw(0, again)  # the first is made once more, ...
        assert [scenes.draw(4, again).scene.root.name for _ in range(8)] == names[1]
        assert (tmp_path / "scenes" / "7-000002").stat().st_mtime_ns == made, "... and what is there is not"
        scenes.draw(16, again)
        left = {path.name for path in (tmp_path / "scenes").iterdir()}
        assert left <= {"7-000004", "7-000005", "7-000006"}, "the fourth was made, and drawn by nobody"


@pytest.mark.thorough
def test_only_processes_that_make_scenes_have_one_core(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "make_survey", lambda *_: None)
    monkeypatch.setattr(stream, "misposed", lambda *_: None)
    monkeypatch.setattr(stream, "write_survey", lambda _, folder, **__: folder.mkdir())
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        stream.make(small_recipe(0, 0), tmp_path / "made")
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(stream, "cores", lambda: 1)
    with Stream(tmp_path / "scenes", [], 7, SMALL) as scenes:
        assert scenes.maker.submit(torch.get_num_threads).result() == 1


@pytest.mark.parametrize(("cores", "processes", "makers"), [(2, 1, 1), (16, 1, 4), (16, 4, 1), (128, 1, 8)])
def test_processes_that_make_scenes_have_some_cores_each(
    cores: int, processes: int, makers: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "cores", lambda: cores)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", str(processes))
    with Stream(tmp_path, [], 7, SMALL) as scenes:
        assert scenes.makers == makers


@pytest.mark.thorough
def test_several_processes_make_the_scenes_that_one_makes_but_a_few_ahead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "recipe", small_recipe)
    monkeypatch.setattr(stream, "POOL_SIZE", 2)
    monkeypatch.setattr(stream, "STEPS_EACH", 2)
    monkeypatch.setattr(stream, "ProcessPoolExecutor", lambda makers, *_: ThreadPoolExecutor(makers))  # start sooner
    found = []
    for cores, last in ((4, 3), (8, 4)):
        monkeypatch.setattr(stream, "cores", lambda cores=cores: cores)
        generator = torch.Generator().manual_seed(0)
        with Stream(tmp_path / str(cores), [], 7, SMALL) as scenes:
            found.append([scenes.draw(step, generator) for step in range(4)])
            assert max(*scenes.pending, *scenes.pool) == last
    for one, other in zip(*found, strict=True):
        assert one.scene.root.name == other.scene.root.name
        assert all(map(torch.equal, one.scene.photographs.colours, other.scene.photographs.colours))
        assert torch.equal(one.cameras.T_world_camera, other.cameras.T_world_camera)


def test_scenes_are_matched_on_the_device_that_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    at, devices = wall.scene(wall.cameras(6)), []
    monkeypatch.setattr(stream, "Matcher", lambda *_, device, **__: devices.append(torch.device(device)))
    monkeypatch.setattr(Stream, "_made", lambda *_: at)
    monkeypatch.setattr(Stream, "_order", lambda *_: None)
    with Stream(tmp_path / "scenes", [], 1, SMALL) as scenes:
        learner = Pretrainer(SMALL, scenes, at, 0, CPU)
        learner.device = torch.device("cuda:1")
        learner.draw()
    assert devices == [torch.device("cuda:1")]


def test_scenes_are_procedural_and_real_augmented_of_their_own() -> None:
    every = [stream.describe_draw(3, number, 0.5) for number in range(100)]
    assert every[5] == stream.describe_draw(3, 5, 0.5)
    assert 30 < sum(own.recipe is None for own in every) < 70
    assert all(own.recipe is not None for own in [stream.describe_draw(3, number, 0.0) for number in range(20)])
    for hard in zip(
        *[(0 < own.points_share < 1, own.shift_px > 0, own.exposure_error > 0) for own in every], strict=True
    ):
        assert 10 < sum(hard) < 40
    assert len({own.points_share for own in every}) > 10
    assert 4 < sum(own.points_share == 0 for own in every) < 25
    assert len({own.shift_px for own in every}) > 10
    assert len({own.exposure_error for own in every}) > 10
    assert 30 < sum(own.channels != (0, 1, 2) for own in every) < 60
    assert len({own.channels for own in every}) == 6


def test_real_scenes_take_part_at_every_width_that_their_files_have(tmp_path: Path) -> None:
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    scenes = stream.at_several_widths(tmp_path / "flats", (32, 48, 256))
    assert [int(one.cameras.size_px[0, 0]) for one in scenes] == [32, 48, 64]
    torch.testing.assert_close(scenes[0].cameras.focal_px * 2, scenes[2].cameras.focal_px)
    (whole,) = stream.at_several_widths(tmp_path / "flats", (400,))
    assert int(whole.cameras.size_px[0, 0]) == 64


def test_pretraining_leaves_the_held_out_photographs_of_real_scenes_out(tmp_path: Path) -> None:
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    for scene in stream.at_several_widths(tmp_path / "flats", (32, 48, 256)):
        assert (scene.test, scene.train) == ((0, 8), tuple(range(1, 8)))


def test_networks_that_encode_whole_photographs_learn_from_smaller_ones(tmp_path: Path, monkeypatch) -> None:
    asked = []
    monkeypatch.setattr(stream, "at_several_widths", lambda path, widths: asked.append(widths) or [])
    for config in (SMALL, PRESETS["paper"]):
        with Stream(tmp_path / config.preset, [tmp_path], 1, config):
            pass
    assert asked == [stream.WIDTHS, stream.WHOLE_WIDTHS]
    assert max(stream.WHOLE_WIDTHS) <= 400
    assert {200, 1600} <= set(stream.WIDTHS)


def test_augmentation_is_few_points_and_photographs_and_exposures_that_are_off(tmp_path: Path) -> None:
    at = wall.scene(wall.cameras(6))
    easy, hard = (
        stream.Draw(None, 0.0, 1.0, 0.0, 0.0, (0, 1, 2), 7),
        stream.Draw(None, 0.0, 0.2, 0.5, 0.05, (2, 0, 1), 7),
    )
    with Stream(tmp_path / "scenes", [], 1, SMALL) as scenes:
        whole, few = scenes._augmented(at, easy), scenes._augmented(at, hard)
        none = scenes._augmented(at, replace(easy, points_share=0.0))
    assert torch.equal(whole.cameras.principal_px, at.cameras.principal_px)
    assert 0.2 < float((few.cameras.principal_px - at.cameras.principal_px).std()) < 1
    assert torch.equal(few.cameras.principal_px, few.scene.cameras.principal_px)
    assert torch.equal(whole.cameras.gain, at.cameras.gain)
    assert torch.equal(few.scene.photographs[1][..., 0], at.photographs[1][..., 2])
    assert torch.equal(whole.scene.photographs[1], at.photographs[1])
    assert 0.02 < float((few.cameras.gain / at.cameras.gain).log()[:, 0].std()) < 0.1
    assert torch.equal(few.cameras.gain, few.scene.cameras.gain)
    assert at.points is not None
    assert few.scene.points is not None
    assert none.scene.points is None
    assert len(none.priors.observed(0).uv_px) == len(whole.priors.observed(0).uv_px)
    assert 0.1 < len(few.scene.points.xyz_world) / len(at.points.xyz_world) < 0.3
    assert len(few.priors.observed(0).uv_px) == len(whole.priors.observed(0).uv_px) > 0
    points = few.scene.points
    assert len(points.error_px) == len(points.xyz_world) == len(points.point_index.unique())
    seen_at = at.cameras.project(points.xyz_world)[0][points.camera_index, points.point_index]
    assert (seen_at - points.uv_px).norm(dim=-1).max() < 1e-3, "every observation is still of its point"


def test_a_turned_scene_has_the_same_views_of_itself() -> None:
    at = wall.scene(wall.cameras(6))
    drawn = stream.Drawn(at, DepthPriors(at), at.cameras)
    turned = stream.rotate(drawn, torch.tensor([0.3, -0.8, 0.1, 0.4]))
    assert turned.scene is at
    one, other = at.cameras.T_world_camera, turned.cameras.T_world_camera
    assert (one - other).abs().max() > 0.5
    torch.testing.assert_close(*(pose[0, :, :3].mT @ (pose - F.pad(pose[0, :, 3:], (3, 0))) for pose in (one, other)))


def test_a_photograph_is_told_a_wrong_attitude(tmp_path: Path) -> None:
    given = small_recipe(0, 1)
    right = stream.make_survey(given.category, given.seed, given.views, given.width, given.flight)
    wrong = stream.misposed(right, given)
    between = right.cameras.T_world_camera[:, :, :3].mT @ wrong.cameras.T_world_camera[:, :, :3]
    angle = torch.rad2deg(torch.acos(((between.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
    torch.testing.assert_close(angle, torch.tensor([0.0, stream.MISPOSED_DEG, 0.0, 0.0]), atol=0.05, rtol=0)
    torch.testing.assert_close(wrong.cameras.T_world_camera[:, :, 3], right.cameras.T_world_camera[:, :, 3])


def test_views_vary_from_step_to_step(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = Pretrainer(SMALL, Walls(), wall.scene(wall.cameras(4)), 0, CPU)
    seen = []
    inputs = learner.draw()

    def drawn(network, config, scene, priors, views, generator, doubled, cameras) -> Inputs:
        seen.append(views)
        return inputs

    monkeypatch.setattr(Inputs, "draw", drawn)
    for _ in range(200):
        learner.draw()
    assert set(seen) == set(pretrain.VIEWS)
    assert seen.count(5) > seen.count(12)


def learn_together(rank: int, folder: str) -> None:
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2", "MASTER_ADDR": "localhost"}
    os.environ["MASTER_PORT"] = Path(folder, "port").read_text()
    torch.set_num_threads(1)
    device = pretrain.join(CPU)
    assert pretrain.world_size() == 2
    pretrain.CATEGORIES = ("ground_textures",)
    pretrain.Recipe = lambda *asked: small_recipe(0, 0)
    made = Path(folder, "validation", "ground_textures")
    assert rank == 1 or not made.exists()
    assert list(pretrain.validation_scenes(Path(folder), [], QUIET)) == ["ground_textures"]
    Path(folder, f"{rank}.seed").write_text(str(pretrain.process_seed(5)))
    learner = Pretrainer(SMALL, Walls(rank), wall.scene(wall.cameras(4)), 0, device)
    assert learner.is_main_process == (rank == 0)
    assert learner.should_stop(rank == 1), "one that is asked to stop stops both"
    for _ in range(3):
        learner.step(Budget(steps=3))
    torch.save(learner.network.state_dict(), Path(folder, f"{rank}.pt"))
    torch.distributed.destroy_process_group()


@pytest.mark.thorough
def test_two_processes_learn_the_same_from_different_scenes(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        (tmp_path / "port").write_text(str(free.getsockname()[1]))
    processes.spawn(learn_together, (str(tmp_path),), nprocs=2)
    assert [(tmp_path / f"{rank}.seed").read_text() for rank in (0, 1)] == ["5", "1000008"]
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in (0, 1))
    alone = Pretrainer(SMALL, Walls(), wall.scene(wall.cameras(4)), 0, CPU)
    for _ in range(3):
        alone.step(Budget(steps=3))
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
    assert any(not torch.equal(value, first[name]) for name, value in alone.network.state_dict().items())


def test_scenes_of_one_name_are_all_validated_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    at = wall.scene(wall.cameras(3))
    monkeypatch.setattr(pretrain, "load_scene", lambda path, **_: replace(at, root=path))
    monkeypatch.setattr(pretrain, "make", lambda *_: None)
    real = [tmp_path / name for name in ("b/scene", "a/scene", "a/river_mouths", "a/other")]
    for order in (real, real[::-1]):
        found = {name: own.root for name, own in pretrain.validation_scenes(tmp_path, order, QUIET).items()}
        assert {name: path for name, path in found.items() if name not in pretrain.CATEGORIES} == {
            "other": real[3],
            "river_mouths-2": real[2],
            "scene": real[1],
            "scene-2": real[0],
        }
        assert found["river_mouths"] == tmp_path / "validation" / "river_mouths"


def test_validation_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pretrain, "VALIDATION_STEPS", 2)
    scene = wall.scene(wall.cameras(5), (1, 3))
    learner = Pretrainer(SMALL, Walls(), scene, 0, CPU)
    validation = Validation({"wall": scene}, tmp_path)
    for step in range(1, 5):
        learner.progress.step = step
        validation(learner, 0.1)
    again = Validation({"wall": scene}, tmp_path)
    learner.progress.step = 4
    again(learner, 0.1)
    learner.progress.step = 5
    again(learner, 1.0)
    points = json.loads((tmp_path / "validation.json").read_text())
    assert [point["step"] for point in points] == [2, 4, 5]
    assert all(5 < point["psnr"]["wall"] < 60 for point in points)
    after_a_kill = Validation({"wall": scene}, tmp_path)
    after_a_kill.resume(3)
    assert [point["step"] for point in after_a_kill.points] == [2]


@pytest.mark.parametrize("text", ["7", "[7]", '[{"step": "x"}]', '{"step": 1}'])
def test_a_damaged_record_of_the_validation_is_named(text: str, tmp_path: Path):
    (tmp_path / "validation.json").write_text(text)
    with pytest.raises(RunError, match=r"validation\.json is damaged"):
        Validation({}, tmp_path)


def test_weights_are_handed_on_in_half_precision(tmp_path: Path) -> None:
    scene = wall.scene(wall.cameras(4))
    trainer, file = SceneTrainer(SMALL, scene, 1, CPU), tmp_path / "w.safetensors"
    write_weights(file, trainer.network, SMALL, {"steps": 5})
    with safe_open(file, framework="pt") as stored:
        assert json.loads(stored.metadata()["tidefield"])["steps"] == 5
        assert {stored.get_tensor(name).dtype for name in stored.keys()} == {torch.float16}  # noqa: SIM118
    started = SceneTrainer(SMALL, scene, 2, CPU, file)
    for name, value in trainer.network.state_dict().items():
        assert torch.equal(started.network.state_dict()[name], value.half().float()), name
    fewer = replace(SMALL, network=replace(SMALL.network, views=2))
    read_weights(file, make_network(fewer.network))
    assert len(weights_sha256(file)) == 64


def test_wrong_weights_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "w.safetensors"
    with pytest.raises(RunError, match="is not a weights file"):
        read_weights(file, make_network(SMALL.network))
    write_weights(file, make_network(SMALL.network), SMALL, {})
    with pytest.raises(RunError, match=r"another network \(encoder differ\)"):
        read_weights(file, make_network(SWIFT.network))
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(RunError, match="damaged"):
        read_weights(file, make_network(SMALL.network))


def test_what_ships_fits_its_preset_and_its_card() -> None:
    paper = Path(__file__).parents[2] / "weights" / "paper" / "tidefield_paper_weights"
    files = {file.stem: file for folder in (SHIPPED, paper) for file in folder.glob("*.safetensors")}
    assert set(files) == set(PRESETS)
    assert not (SHIPPED / "paper.safetensors").exists(), "54 times as large as swift's: a package of its own"
    for preset, file in files.items():
        read_weights(file, make_network(PRESETS[preset].network))
        with safe_open(file, framework="pt") as stored:
            assert "sha256" in json.loads(stored.metadata()["tidefield"])
        card = file.with_suffix(".md").read_text(encoding="utf-8")
        assert card.startswith(f"# Weights of the preset {preset}\n")
        assert weights_sha256(file) in card


@pytest.mark.thorough
def test_the_command_pretrains_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(stream, "recipe", small_recipe)
    monkeypatch.setitem(PRESETS, "swift", SMALL)
    scene = wall.scene(wall.cameras(5), (1, 3))
    monkeypatch.setattr(pretrain, "validation_scenes", lambda *_: {"wall": scene})
    pretrain_command(Pretrain(tmp_path / "out", budget=Budget(steps=2), device="cpu"), QUIET)
    with pytest.raises(RunError, match="--resume"):
        pretrain_command(Pretrain(tmp_path / "out", budget=Budget(steps=2), device="cpu"), QUIET)
    pretrain_command(Pretrain(tmp_path / "out", budget=Budget(steps=3), device="cpu", resume=True), QUIET)
    points = json.loads((tmp_path / "out" / "validation.json").read_text())
    assert [point["step"] for point in points] == [2, 3]
    weights = tmp_path / "out" / "weights.safetensors"
    read_weights(weights, make_network(SMALL.network))
    learned_at = read_weights_file(weights)[0]["config"]["train"]["learning_rate"]
    assert learned_at == pretrain.HIGHEST_RATE < SMALL.train.learning_rate, "less than a single scene takes"
