"""Runs that are replaced, killed and continued: nothing of another run is taken for theirs, nothing is lost or left."""

from __future__ import annotations

import io
import json
import logging
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import opensplat_program
import pytest
import textured_wall as wall
import torch
from networks import PLAIN
from rich.console import Console
from scenes_on_disk import PINHOLE, survey, write_colmap

from tidefield.commands import demo
from tidefield.commands.common import ZeroShot
from tidefield.commands.evaluate import Evaluate, evaluate
from tidefield.commands.pretrain import PRETRAINING_FILE, Pretrain
from tidefield.commands.pretrain import pretrain as pretrain_command
from tidefield.commands.train import USED_BEFORE, Train, _configuration, _require_its_options, train
from tidefield.compare.run import read_evaluation
from tidefield.config import PRESETS, Budget, Config
from tidefield.errors import RunError, SceneError
from tidefield.evaluation.curves import CURVE_FILE
from tidefield.files import only_writer
from tidefield.model.network import make_network
from tidefield.processes import Ended
from tidefield.progress import ProgressBar
from tidefield.train import checkpoint, loop, pretrain, stream
from tidefield.train.checkpoint import (
    CHECKPOINT_FILE,
    RUN_FILE,
    load_network,
    read_run,
    read_weights_file,
    write_run,
    write_weights,
)
from tidefield.train.loop import SceneTrainer

QUIET = Console(quiet=True)


class Killed(BaseException):
    """Stands in for kill -9, after which nothing is saved."""


@pytest.fixture(scope="module", autouse=True)
def small(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setitem(PRESETS, "swift", PLAIN)
        patch.setattr(checkpoint, "SHIPPED", tmp_path_factory.mktemp("weights"))
        patch.setattr(loop, "PICTURE_PX", 24)
        torch.manual_seed(5)
        write_weights(checkpoint.SHIPPED / "swift.safetensors", make_network(PLAIN.network), PLAIN, {})
        yield


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flat") / "flats"
    write_colmap(folder, survey(PINHOLE))
    return folder


def start(scene: Path, run: Path, steps: int = 1, **options: Any) -> None:
    train(Train(scene, run, width=48, budget=Budget(steps=steps), device="cpu", **options), QUIET)


def start_and_kill(patch: pytest.MonkeyPatch, scene: Path, run: Path, **options: Any) -> None:
    def die(*_: object) -> float:
        raise Killed

    with patch.context() as context:
        context.setattr(SceneTrainer, "step", die)
        with pytest.raises(Killed):
            start(scene, run, **options)


def state(run: Path) -> dict[str, torch.Tensor]:
    network = make_network(PLAIN.network)
    load_network(run, network)
    return network.state_dict()


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.thorough
def test_a_run_that_replaces_another_and_dies_leaves_nothing_of_it(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    start(scene, run, curve=True)
    evaluate(Evaluate(run, device="cpu"), QUIET)
    made = files(run)
    assert len(made) > 5
    (run / "pictures" / "for-my-thesis.png").touch()
    (run / "notes.txt").touch()
    before = read_run(run)
    start_and_kill(monkeypatch, scene, run, overwrite=True, seed=99)
    left = files(run)
    assert left & made == {RUN_FILE}
    assert {"pictures/for-my-thesis.png", "notes.txt"} < left
    assert read_run(run).seed == 99
    assert read_run(run).id != before.id
    with pytest.raises(RunError, match="--resume"):
        evaluate(Evaluate(run, device="cpu"), QUIET)


@pytest.mark.thorough
def test_a_resumed_run_keeps_the_points_of_its_curve_up_to_its_checkpoint(scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    start(scene, run, steps=4, curve=True)
    before = json.loads((run / CURVE_FILE).read_text())
    lost = [before[-1][0] + 1e-9, 20.0]  # a moment after the last save
    (run / CURVE_FILE).write_text(json.dumps([*before, lost]))
    start(scene, run, steps=8, curve=True, resume=True)
    after = json.loads((run / CURVE_FILE).read_text())
    assert after[: len(before)] == before
    assert lost not in after
    assert len(after) == len(before) + 1


def test_an_interrupted_demonstration_continues_its_training(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def step(trainer: SceneTrainer, budget: Budget) -> float:
        made.append(trainer.progress.step)
        os.kill(os.getpid(), signal.SIGINT)
        return take_step(trainer, budget)

    take_step, made = SceneTrainer.step, []
    out, console = tmp_path / "demo", Console(record=True, width=200, file=io.StringIO())
    monkeypatch.setattr("tidefield.synthetic.write_survey", lambda _, folder: write_colmap(folder, survey(PINHOLE)))
    monkeypatch.setattr("tidefield.synthetic.make_survey", lambda *_, **__: None)
    monkeypatch.setattr(demo, "TRAINING_WIDTH", 48)
    monkeypatch.setattr(demo, "render", lambda *_: None)
    monkeypatch.setattr(demo, "evaluate", lambda *_: pytest.fail("it was evaluated half-trained"))
    monkeypatch.setattr(SceneTrainer, "step", step)
    for _ in range(2):
        with pytest.raises(Ended):
            demo.demo(demo.Demo(out, minutes=10.0, device="cpu"), console)
    assert made == [0, 1]
    assert "interrupted; the same command continues" in console.export_text()


@pytest.mark.thorough
@pytest.mark.parametrize("options", [{}, {"from_scratch": True}])
def test_a_run_that_died_before_its_first_save_starts_again_on_resume(
    options: dict[str, Any],
    scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    start(scene, tmp_path / "unbroken", seed=7, **options)
    start_and_kill(monkeypatch, scene, tmp_path / "run", seed=7, **options)
    caplog.set_level(logging.INFO)
    start(scene, tmp_path / "run", resume=True)
    assert [record.message for record in caplog.records if "starts again" in record.message] == [
        f"{tmp_path / 'run'} was ended before it saved anything: it starts again"
    ]
    expected = state(tmp_path / "unbroken")
    assert all(torch.equal(value, expected[name]) for name, value in state(tmp_path / "run").items())


def test_a_run_that_starts_again_needs_the_weights_it_started_from(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "w.safetensors"
    write_weights(other, make_network(PLAIN.network), PLAIN, {})
    start_and_kill(monkeypatch, scene, tmp_path / "run", weights=other)
    with pytest.raises(RunError, match="name them with --weights"):
        start(scene, tmp_path / "run", resume=True)
    start(scene, tmp_path / "run", resume=True, weights=other)


@pytest.mark.parametrize("options", [{"variant": "no-neighbours"}, {"method": "nerf"}, {"from_scratch": True}])
def test_weights_for_a_training_that_starts_without_are_one_clear_error(
    scene: Path, tmp_path: Path, options: dict[str, Any]
) -> None:
    with pytest.raises(RunError, match=r"--weights is given for a training that starts without .*leave one out$"):
        start(scene, tmp_path / "run", weights=checkpoint.SHIPPED / "swift.safetensors", **options)
    assert not (tmp_path / "run" / RUN_FILE).exists()


def test_a_warning_says_at_once_what_memory_whole_photographs_take(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(stream, "WHOLE_WIDTHS", (32, 40))
    monkeypatch.setattr("tidefield.commands.train.load", lambda *_: pytest.fail("photographs were decoded"))
    options = {"preset": "paper", "from_scratch": True, "device": "cpu"}
    for width, found in ((None, 64), (48, 48), (1000, 64)):
        with pytest.raises(pytest.fail.Exception, match="were decoded"):
            train(Train(scene, tmp_path / "run", width=width, **options), QUIET)
        [message] = caplog.messages
        assert f"here of {found} pixels" in message
        assert "--width 40" in message
        caplog.clear()
    with pytest.raises(pytest.fail.Exception, match="were decoded"):
        train(Train(scene, tmp_path / "run", width=40, **options), QUIET)
    with pytest.raises(pytest.fail.Exception, match="were decoded"):
        train(Train(scene, tmp_path / "run", device="cpu"), QUIET)
    assert not caplog.messages


@pytest.mark.thorough
def test_a_run_is_continued_to_the_end_of_its_own_budget_unless_another_is_given(scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    start(scene, run, steps=3)
    assert read_run(run).budget == Budget(steps=3)
    for budget, steps in ((Budget(steps=5), 5), (Budget(), 5), (Budget(steps=6), 6)):
        train(Train(scene, run, budget=budget, device="cpu", resume=True), QUIET)
        assert load_network(run, make_network(PLAIN.network)).step == steps
        assert read_run(run).budget == Budget(steps=steps)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"width": 40}, "--width 40: "),
        ({"seed": 3}, "--seed 3: "),
        ({"preset": "paper"}, "--preset paper: "),
        ({"method": "nerf", "from_scratch": True}, "--method nerf, --from-scratch: "),
        ({"variant": "views-2"}, "--variant views-2: "),
    ],
)
def test_a_run_is_not_continued_with_the_options_of_another(
    scene: Path, tmp_path: Path, other: dict[str, Any], said: str
) -> None:
    run, own = tmp_path / "run", {"width": 48, "budget": Budget(steps=1), "device": "cpu"}
    train(Train(scene, run, **own), QUIET)
    train(Train(scene, run, **own, resume=True), QUIET)
    before = (run / CHECKPOINT_FILE).read_bytes()
    with pytest.raises(RunError, match=rf"was not started with {said}expected its own options with --resume"):
        train(Train(scene, run, **{**own, "budget": Budget(steps=2), **other}, resume=True), QUIET)
    assert (run / CHECKPOINT_FILE).read_bytes() == before


def test_a_run_that_has_saved_is_not_continued_from_other_weights(scene: Path, tmp_path: Path) -> None:
    start(scene, tmp_path / "run")
    other = tmp_path / "w.safetensors"
    write_weights(other, make_network(PLAIN.network), PLAIN, {})
    with pytest.raises(RunError, match=r"was not started with --weights .*w\.safetensors: "):
        start(scene, tmp_path / "run", resume=True, weights=other)
    start(scene, tmp_path / "run", resume=True, weights=checkpoint.SHIPPED / "swift.safetensors")


def test_a_folder_is_trained_into_by_one_process_at_a_time(scene: Path, tmp_path: Path) -> None:
    start(scene, tmp_path / "run")
    for options in ({"resume": True}, {"overwrite": True}):
        with only_writer(tmp_path / "run"), pytest.raises(RunError, match="another process is writing to"):
            start(scene, tmp_path / "run", **options)
    start(scene, tmp_path / "run", steps=2, resume=True)


def test_what_killed_saves_have_left_is_swept_when_a_run_is_continued(scene: Path, tmp_path: Path) -> None:
    start(scene, tmp_path / "run")
    there = files(tmp_path / "run")
    left = [".checkpoint-0123abcd.partial.safetensors", ".run-0123abcd.partial.json"]
    for name in left:
        (tmp_path / "run" / name).touch()
    (tmp_path / "run" / ".flight-0123abcd.partial.mp4").touch()  # a live `render` may be writing it
    start(scene, tmp_path / "run", steps=2, resume=True)
    assert {file for file in files(tmp_path / "run") if "tensorboard" not in file} == {
        *(file for file in there if "tensorboard" not in file),
        ".flight-0123abcd.partial.mp4",
    }


def test_a_run_that_died_before_it_was_described_does_not_block_its_folder(scene: Path, tmp_path: Path) -> None:
    (tmp_path / ".lock").touch()
    (tmp_path / ".run-0123abcd.partial.json").touch()
    start(scene, tmp_path)
    assert (tmp_path / CHECKPOINT_FILE).exists()


def test_a_name_that_no_folder_can_have_is_one_clear_error(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("a" * 300, "a\0b", "loop", "loop/run", "/proc/run"):
        with pytest.raises(RunError, match=r"cannot be written|has a zero byte"):
            start(scene, tmp_path / name)
    assert os.listdir(tmp_path) == ["loop"]


def test_methods_without_training_run_on_the_processor_alone(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"--device cuda is given with --method sparse-depth: .* on the processor"):
        evaluate(Evaluate(scene, tmp_path / "out", method="sparse-depth", device="cuda"), QUIET)


def test_curves_over_steps_of_programs_that_have_none_are_refused(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="--curve was given with --steps: nerfacto has curves over minutes only"):
        start(scene, tmp_path / "run", method="nerfacto", curve=True)
    assert not (tmp_path / "run" / "job.json").exists()


def test_the_picture_of_a_training_is_a_small_one(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shapes: list[tuple[int, ...]] = []

    def add_image(writer: object, tag: str, picture: Any, *_: object, **__: object) -> None:
        shapes.append(picture.shape)

    monkeypatch.setattr(loop.SummaryWriter, "add_image", add_image)
    start(scene, tmp_path / "run")
    assert shapes == [(18, 48, 3)]


def test_photographs_that_an_evaluation_reads_at_another_width_show_progress(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start(scene, tmp_path / "run", steps=1)
    shown: list[str] = []
    show = ProgressBar.__call__

    def noted(bar: ProgressBar, *progress: Any) -> None:
        shown.append(bar._job)
        show(bar, *progress)

    monkeypatch.setattr(ProgressBar, "__call__", noted)
    evaluate(Evaluate(tmp_path / "run", tmp_path / "out", width=36, device="cpu"), QUIET)
    assert shown.count("Reading photographs") == 9
    shown.clear()
    options = {"zero": ZeroShot(zero_shot=True), "width": 28, "opened_width": 48, "device": "cpu"}
    evaluate(Evaluate(scene, tmp_path / "other", **options), QUIET)
    assert shown.count("Reading photographs") == 9
    assert read_evaluation(tmp_path / "other")["configuration"]["opened_width"] == 48


def test_an_evaluation_of_another_run_is_not_compared(scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    start(scene, run)
    evaluate(Evaluate(run, device="cpu"), QUIET)
    assert read_evaluation(run) == json.loads((run / "evaluation.json").read_text())
    assert read_evaluation(run)["configuration"]["run"] == read_run(run).id
    write_run(run, checkpoint.Run(scene, 48, 0, PLAIN))
    with pytest.raises(RunError, match="of another run"):
        read_evaluation(run)


def test_a_run_whose_scene_was_made_anew_does_not_go_on(
    tmp_path: Path, scene: Path, caplog: pytest.LogCaptureFixture
) -> None:
    again, run = tmp_path / "scene", tmp_path / "run"
    shutil.copytree(scene, again)
    start(again, run)
    evaluate(Evaluate(run, device="cpu"), QUIET)
    start(again, run, steps=2, resume=True)
    assert not caplog.messages
    other = survey(PINHOLE)
    other.T_world_camera[:, :, 3] *= 1.01
    write_colmap(again, replace(other, ground=1.01 * other.ground))
    with pytest.raises(RunError, match=r"has other photographs or poses than when .* was started"):
        start(again, run, steps=3, resume=True)
    assert read_run(run).budget == Budget(steps=2)
    evaluate(Evaluate(run, device="cpu", overwrite=True), QUIET)
    assert [text for text in caplog.messages if "other photographs or poses than when" in text]


def test_a_run_whose_scene_was_moved_goes_on_there(scene: Path, tmp_path: Path) -> None:
    old, new, run = tmp_path / "scene", tmp_path / "moved", tmp_path / "run"
    shutil.copytree(scene, old)
    train(Train(old, run, budget=Budget(steps=1), device="cpu"), QUIET)
    old.rename(new)
    with pytest.raises(RunError, match=r"which is missing: .*`tidefield train SCENE"):
        evaluate(Evaluate(run, device="cpu"), QUIET)
    with pytest.raises(SceneError, match="is missing"):
        train(Train(tmp_path / "nothing", run, resume=True, device="cpu"), QUIET)
    train(Train(new, run, budget=Budget(steps=2), resume=True, device="cpu"), QUIET)
    assert read_run(run).scene == Path(os.path.realpath(new))
    assert evaluate(Evaluate(run, device="cpu"), QUIET).path.exists()


@pytest.mark.parametrize("unknown", ["poses", "held_out"])
def test_a_run_that_cannot_recognise_its_scene_is_not_moved(scene: Path, tmp_path: Path, unknown: str) -> None:
    run = tmp_path / "run"
    train(Train(scene, run, budget=Budget(steps=1), device="cpu"), QUIET)
    write_run(run, replace(read_run(run), scene=tmp_path / "gone", **{unknown: None}))
    with pytest.raises(RunError, match=r"which is missing: .*; put it back$"):
        evaluate(Evaluate(run, device="cpu"), QUIET)
    with pytest.raises(RunError, match="expected the same scene"):
        train(Train(scene, run, resume=True, device="cpu"), QUIET)


def test_few_steps_in_minutes_are_remarked(scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    train(Train(scene, tmp_path / "one", budget=Budget(steps=1), device="cpu"), QUIET)
    assert "steps change little" not in caplog.text
    train(Train(scene, tmp_path / "run", budget=Budget(minutes=0.001), device="cpu"), QUIET)
    assert "steps change little" in caplog.text


def test_a_run_does_not_go_on_with_photographs_that_it_held_out(
    tmp_path: Path, scene: Path, caplog: pytest.LogCaptureFixture
) -> None:
    again, run = tmp_path / "scene", tmp_path / "run"
    shutil.copytree(scene, again)
    start(again, run)
    names = survey(PINHOLE).names
    lists = {"train_filenames": names[2:], "test_filenames": names[:2]}
    (again / "transforms.json").write_text(json.dumps({k: [f"images/{n}" for n in v] for k, v in lists.items()}))
    for options in ({}, {"allow_missing": True}):
        with pytest.raises(RunError, match="or holds out others"):
            start(again, run, steps=2, resume=True, **options)
    with pytest.raises(RunError, match=r"was trained when .* not held out: expected photographs that it did not learn"):
        evaluate(Evaluate(run, device="cpu"), QUIET)
    assert [text for text in caplog.messages if "or holds out others" in text]
    assert not (run / "evaluation.json").exists()


@pytest.mark.parametrize(
    "options",
    [{"variant": "no-neighbours"}, {"method": "nerf", "preset": "paper"}, {"variant": "views-2", "overwrite": True}],
)
def test_the_same_command_with_resume_goes_on(tmp_path: Path, scene: Path, options: dict[str, Any]) -> None:
    started = Train(scene, tmp_path / "run", from_scratch=True, **options)
    run = checkpoint.Run(scene, None, 0, _configuration(started), variant=started.variant)
    _require_its_options(replace(started, resume=True), run)
    _require_its_options(replace(started, resume=True), replace(run, variant=None))  # of an older version
    for other, named in (({"method": "nerf"}, "--method nerf"), ({"variant": "views-2"}, "--variant views-2")):
        with pytest.raises(RunError, match=f"was not started with .*{named}"):
            _require_its_options(Train(scene, tmp_path / "run", **other), replace(run, config=PLAIN, variant=None))


def test_a_run_goes_on_with_some_of_its_options_though_its_preset_has_changed_since(
    tmp_path: Path, scene: Path
) -> None:
    options = {"preset": "paper", "variant": "no-target-colour"}
    config = _configuration(Train(scene, tmp_path / "run", **options))
    assert isinstance(config, Config)
    older = replace(config, train=replace(config.train, tiles=config.train.tiles + 1))
    run = checkpoint.Run(scene, None, 0, older, variant="no-target-colour")
    for name, value in options.items():
        _require_its_options(Train(scene, tmp_path / "run", **{name: value}), run)
    with pytest.raises(RunError, match="was not started with --method opensplat: expected"):
        _require_its_options(Train(scene, tmp_path / "run", method="opensplat"), run)


def across_a_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have trainings across scenes learn from one wall alone."""
    at = wall.scene(wall.cameras(5), (1, 3))
    drawn = stream.Drawn(at, stream.DepthPriors(at), at.cameras)
    monkeypatch.setattr(stream.Stream, "draw", lambda *_: drawn)
    monkeypatch.setattr(pretrain, "validation_scenes", lambda *_: {"wall": at})


@pytest.mark.thorough
def test_a_pretraining_that_died_before_its_first_save_starts_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    across_a_wall(monkeypatch)
    options = {"budget": Budget(steps=1), "device": "cpu"}
    with pytest.raises(RunError, match="holds no training"):
        pretrain_command(Pretrain(tmp_path / "out", resume=True, **options), QUIET)
    assert not (tmp_path / "out").exists()
    (tmp_path / "out" / "scenes").mkdir(parents=True)
    started, budget = {"preset": "swift", "variant": None, "seed": 0, "real": []}, {"minutes": None, "steps": 1}
    (tmp_path / "out" / PRETRAINING_FILE).write_text(json.dumps(started))
    (tmp_path / "out" / ".checkpoint-0123abcd.partial.safetensors").touch()
    with only_writer(tmp_path / "out"), pytest.raises(RunError, match="another process"):
        pretrain_command(Pretrain(tmp_path / "out", resume=True, **options), QUIET)
    pretrain_command(Pretrain(tmp_path / "out", resume=True, **options), QUIET)
    assert {name for name in os.listdir(tmp_path / "out") if name.startswith(".")} == set()
    assert (tmp_path / "out" / CHECKPOINT_FILE).exists()
    assert json.loads((tmp_path / "out" / PRETRAINING_FILE).read_text()) == {**started, "budget": budget}
    (tmp_path / "out" / PRETRAINING_FILE).unlink()  # as of an earlier version
    with pytest.raises(RunError, match="does not fit"):
        pretrain_command(Pretrain(tmp_path / "out", resume=True, **options, variant="with-ray-transformer"), QUIET)
    pretrain_command(Pretrain(tmp_path / "out", resume=True, **options), QUIET)
    assert json.loads((tmp_path / "out" / PRETRAINING_FILE).read_text()) == {**started, "budget": budget}
    with pytest.raises(SceneError, match="typo"):
        pretrain_command(Pretrain(tmp_path / "new", real=(tmp_path / "typo",), **options), QUIET)
    assert not (tmp_path / "new" / PRETRAINING_FILE).exists()
    for others, was in (
        ({"seed": 3}, "seed 0, not 3"),
        ({"variant": "no-depth-loss"}, "variant None, not no-depth-loss"),
        ({"real": (tmp_path / "flats",)}, r"real \[\], not \['.*flats'\]"),
    ):
        with pytest.raises(RunError, match=f"was started with {was}: expected the same options"):
            pretrain_command(Pretrain(tmp_path / "out", resume=True, **options, **others), QUIET)


@pytest.mark.thorough
def test_a_pretraining_is_not_continued_with_another_scene_of_the_same_name(
    tmp_path: Path, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    across_a_wall(monkeypatch)
    own, other = tmp_path / "a" / "flats", tmp_path / "b" / "flats"
    for folder in (own, other):
        shutil.copytree(scene, folder)

    def go_on(*real: Path, steps: int, resume: bool = True, out: str = "out") -> None:
        options = {"budget": Budget(steps=steps), "device": "cpu", "resume": resume}
        pretrain_command(Pretrain(tmp_path / out, real=real, **options), QUIET)

    go_on(own, steps=1, resume=False)
    file = tmp_path / "out" / PRETRAINING_FILE
    started = json.loads(file.read_text())
    assert started["real"] == [str(own.resolve())]
    with pytest.raises(RunError, match=r"was started with real \['.*/a/flats'\], not \['.*/b/flats'\]: expected"):
        go_on(other, steps=2)
    file.write_text(json.dumps({**started, "real": ["flats"]}))  # as of an earlier version
    go_on(own, steps=2)
    assert json.loads(file.read_text())["real"] == started["real"]
    go_on(other, own, steps=1, resume=False, out="both")
    with pytest.raises(RunError, match="was started with --real in the order"):  # by which they are drawn
        go_on(own, other, steps=2, out="both")


def test_a_pretraining_is_continued_to_the_end_of_its_own_budget_unless_another_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    across_a_wall(monkeypatch)
    out, said = tmp_path / "out", io.StringIO()

    def steps(console: Console = QUIET, **options: Any) -> int:
        pretrain_command(Pretrain(out, device="cpu", **options), console)
        return int(read_weights_file(out / "weights.safetensors")[0]["steps"])

    step = SceneTrainer.step

    def interrupted(trainer: SceneTrainer, budget: Budget) -> float:
        assert budget == Budget(steps=3)
        os.kill(os.getpid(), signal.SIGINT)
        return step(trainer, budget)

    with monkeypatch.context() as patch:
        patch.setattr(SceneTrainer, "step", interrupted)
        with pytest.raises(Ended):
            steps(budget=Budget(steps=3))
    assert steps(resume=True) == 3
    assert steps(Console(file=said), resume=True) == 3
    assert USED_BEFORE in said.getvalue()
    assert steps(resume=True, budget=Budget(steps=4)) == 4


def test_a_pretraining_does_not_continue_a_run_of_one_scene(scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    start(scene, run)
    before = (run / CHECKPOINT_FILE).read_bytes()
    for folder in (run, scene):
        there = files(folder)
        with pytest.raises(RunError, match="holds no training of `tidefield pretrain`"):
            pretrain_command(Pretrain(folder, budget=Budget(steps=9), device="cpu", resume=True), QUIET)
        assert files(folder) == there
    assert (run / CHECKPOINT_FILE).read_bytes() == before


def test_opensplat_does_not_continue_and_is_replaced_with_all_that_it_left(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    run, program = tmp_path / "run", opensplat_program.install(tmp_path)
    start(scene, run, method="opensplat", opensplat=program)
    with pytest.raises(RunError, match="opensplat cannot continue where it stopped: train it again, with --overwrite"):
        start(scene, run, resume=True)
    (run / "opensplat" / "words").unlink()
    start(scene, run, overwrite=True)
    assert not (run / "opensplat").exists()
    with pytest.raises(RunError, match="none is no program"):
        start(scene, tmp_path / "other", method="opensplat", opensplat=tmp_path / "none")
    assert not (tmp_path / "other").exists(), "before a folder is made"
