"""Training and runs on disk: resuming, refusing, saving, and one small scene end to end."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
import weakref
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import textured_wall as wall
import torch
from networks import PLAIN, SMALL, SMALL_PAPER, network
from rich.console import Console
from safetensors import safe_open
from safetensors.torch import save_file
from scenes_on_disk import PINHOLE, Truth, survey, write_colmap

from tidefield.commands import train as train_command
from tidefield.commands.train import Train
from tidefield.config import (
    PAPER,
    PRESETS,
    SWIFT,
    Budget,
    Config,
    EncoderConfig,
    checked_seed,
    config_from_json,
    config_to_json,
)
from tidefield.data.areas import cut
from tidefield.data.depth_prior import DepthPrior
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.evaluation.evaluate import evaluate
from tidefield.geometry.lenses import Lens
from tidefield.model.network import make_network
from tidefield.train import checkpoint
from tidefield.train.checkpoint import (
    CHECKPOINT_FILE,
    Run,
    load_network,
    read_run,
    weights_sha256,
    write_run,
    write_weights,
)
from tidefield.train.loop import SceneTrainer, train
from tidefield.train.losses import Inputs

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return wall.scene(wall.cameras(6))


def weights(trainer: SceneTrainer) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in trainer.network.state_dict().items()}


def test_a_resumed_training_ends_bit_for_bit_where_an_unbroken_one_does(scene: Scene, tmp_path: Path) -> None:
    budget = Budget(steps=3)
    unbroken = SceneTrainer(SMALL, scene, seed=3, device=CPU)
    for _ in range(3):
        unbroken.step(budget)
    first = SceneTrainer(SMALL, scene, seed=3, device=CPU)
    for _ in range(2):
        first.step(budget)
    first.save(tmp_path)
    second = SceneTrainer(SMALL, scene, seed=99, device=CPU)
    second.resume(tmp_path)
    second.step(budget)
    for name, value in weights(unbroken).items():
        assert torch.equal(value, weights(second)[name]), name
    assert second.progress.step == 3
    assert second.progress.losses == unbroken.progress.losses


@pytest.mark.parametrize(("bounded", "rate", "encoder"), [(False, 1e-2, 0.3), (True, 1e-2, 1.0), (False, 2e-3, 1.0)])
def test_encoders_whose_features_nothing_bounds_learn_more_slowly(
    bounded: bool, rate: float, encoder: float, scene: Scene
) -> None:
    network = replace(PLAIN.network, encoder=replace(PLAIN.network.encoder, instance_norm=bounded))
    config = replace(PLAIN, network=network, train=replace(PLAIN.train, learning_rate=rate))
    trainer = SceneTrainer(config, scene, seed=3, device=CPU)
    trainer.step(Budget(steps=100))
    groups = trainer.optimizer.param_groups
    rates = {parameter: group["lr"] for group in groups for parameter in group["params"]}
    assert list(rates) == list(trainer.network.parameters()), "the order of checkpoints"
    for name, parameter in trainer.network.named_parameters():
        share = encoder if name.startswith("encoder.") else 1.0
        assert rates[parameter] == pytest.approx(share * rate / PLAIN.train.warm_up, rel=0.01), name


@pytest.mark.thorough
def test_photographs_of_two_sizes_are_learned_from_and_evaluated(tmp_path: Path) -> None:
    mixed = wall.mixed_scene()
    trainer = SceneTrainer(replace(SMALL, train=replace(SMALL.train, tiles=4)), mixed, seed=3, device=CPU)
    assert len(trainer.draw().cameras.size_px.unique(dim=0)) == 2
    errors = [trainer.step(Budget(steps=3)) for _ in range(3)]
    assert all(0 < error < 1 for error in errors)
    report = evaluate(trainer.renderer(), mixed, tmp_path, configuration={}, console=Console(quiet=True)).report
    assert math.isfinite(report["mean"]["psnr"])


def in_areas(monkeypatch: pytest.MonkeyPatch, each: int = 2) -> None:
    """Have scenes of more than six photographs trained in areas of at most four, a few steps in each."""
    monkeypatch.setattr("tidefield.train.loop.cut", partial(cut, whole=6, most=4))
    monkeypatch.setattr("tidefield.train.loop.STEPS_EACH", each)


@pytest.mark.thorough
def test_a_large_scene_is_learned_area_by_area_all_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    in_areas(monkeypatch)
    trainer = SceneTrainer(SMALL, wall.scene(wall.cameras(14, step=1.2)), seed=3, device=CPU)
    assert len(trainer.areas) == 4
    visits, first = [], weights(trainer)
    for _ in range(2):
        opened, names = [], set[str]()
        for _ in range(4 * 2):
            own = trainer.open_area()
            opened.append(own.number)
            names |= {own.area.scene.names[i] for i in own.area.targets}
            trainer.step(Budget(steps=16))
        assert opened[::2] == opened[1::2], "two steps in each"
        assert sorted(opened[::2]) == [0, 1, 2, 3]
        assert names == {trainer.scene.names[i] for i in trainer.scene.train}
        visits.append(opened)
    assert visits[0] != visits[1], "another order"
    assert any(not torch.equal(value, weights(trainer)[name]) for name, value in first.items())


@pytest.mark.thorough
def test_a_training_by_areas_is_resumed_bit_for_bit_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    in_areas(monkeypatch)
    scene, budget = wall.scene(wall.cameras(14, step=1.2)), Budget(steps=12)
    unbroken, first, second = (SceneTrainer(SMALL, scene, seed=3, device=CPU) for _ in range(3))
    for _ in range(12):
        unbroken.step(budget)
    for _ in range(5):
        first.step(budget)
    first.save(tmp_path)
    second.resume(tmp_path)
    for _ in range(7):
        second.step(budget)
    for name, value in weights(unbroken).items():
        assert torch.equal(value, weights(second)[name]), name


@pytest.mark.thorough
def test_what_an_area_needed_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    in_areas(monkeypatch, each=1)
    trainer = SceneTrainer(SMALL, wall.scene(wall.cameras(14, step=1.2)), seed=3, device=CPU)
    alive: weakref.WeakSet[Any] = weakref.WeakSet()
    for _ in range(8):
        own = trainer.open_area()
        own.priors[own.area.targets[0]]
        alive.update([own.priors, own.priors[own.area.targets[0]], own.area.scene, own.priors.match])
        del own
        trainer.step(Budget(steps=8))
        assert len(alive) <= 4, "one area's at a time"


@pytest.mark.thorough
@pytest.mark.parametrize("at_once", [True, False])
def test_training_begins_with_few_photographs_and_learns_from_all(
    at_once: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not at_once:
        monkeypatch.setattr("tidefield.train.loop.cut", partial(cut, whole=6, most=9))
    monkeypatch.setattr("tidefield.train.loop.Matcher", lambda *_, **__: lambda camera, cells: DepthPrior(cells))
    many = wall.scene(wall.cameras(20, step=0.3))  # areas of five and seven
    trainer = SceneTrainer(SMALL, many, seed=3, device=CPU)
    assert (len(trainer.areas) == 1) == at_once
    drawn, first = set[int](), trainer.open_area()
    for step in range(200):
        trainer.progress.step = step
        assert trainer.open_area() is first
        drawn.update(trainer.draw().batch.targets.tolist())
        assert len(drawn) <= 4 + step // 2
    assert drawn == set(first.area.targets)
    trainer.progress.step = 200
    assert (trainer.open_area() is first) == at_once
    assert (len(trainer._targets(trainer.open_area().area)) > 4) == at_once


def test_another_seed_begins_with_other_photographs() -> None:
    many = wall.scene(wall.cameras(20, step=0.3))
    first = []
    for seed in (3, 3, 4):
        trainer = SceneTrainer(SMALL, many, seed=seed, device=CPU)
        first.append(trainer._targets(trainer.open_area().area))
    assert first[0] == first[1] != first[2]


HELD = """
import re, sys
import torch
from pathlib import Path
from functools import partial
from networks import SMALL
from tidefield.data.areas import cut
from tidefield.data.depth_prior import DepthPrior
from tidefield.data.load import load_scene
from tidefield.train import loop

torch.set_num_threads(1)
whole = int(sys.argv[2])
loop.cut, loop.STEPS_EACH = partial(cut, whole=whole, most=16), 1


class Match:  # quick, and as large as the real one
    def __init__(self, scene, **options):
        pass

    def __call__(self, camera, cells):
        return DepthPrior(cells, torch.zeros(camera.height, camera.width) + 1e-9)


loop.Matcher = Match
scene = load_scene(Path(sys.argv[1]), calibrate=False)
trainer = loop.SceneTrainer(SMALL, scene, 0, torch.device("cpu"))
for _ in range(len(trainer.areas)):
    own = trainer.open_area()
    for target in own.area.targets:
        own.priors[target]
        own.area.scene.photographs[target].sum()
    trainer.step(loop.Budget(steps=100))
# Not that of `getrusage`, which begins with the memory of the process that started this one.
print(len(trainer.areas), 1024 * int(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]))
"""


def peak_bytes(folder: Path, count: int, whole: int) -> tuple[int, int]:
    """Areas of a training on a flight of so many photographs, and the memory of its process."""
    scene = folder / f"{count}"
    if not scene.exists():
        write_colmap(scene, flight(count))
    code = [sys.executable, "-c", HELD, str(scene), str(whole)]
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": f"{root}{os.pathsep}{root / 'tests'}", "OMP_NUM_THREADS": "1"}
    environment["XDG_CACHE_HOME"] = str(folder / "cache")
    areas, peak = subprocess.run(code, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout.split()
    return int(areas), int(peak)


def flight(count: int) -> Truth:
    """A flight of strips of 16 photographs over flat ground."""
    lens, random = Lens(400, 300, 320.0, 320.0, 200.0, 150.0), np.random.default_rng(5)
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    place = np.array([(3.5 * (i // 16), 2.5 * (i % 16), 10.0) for i in range(count)])
    poses = np.stack([np.column_stack([down, p + random.normal(0, 0.1, 3)]) for p in place])
    ground = np.column_stack([random.uniform(-4, place.max(0)[:2] + 4, (12 * count, 2)), np.zeros(12 * count)])
    picture = random.integers(0, 255, (300, 400, 3), dtype=np.uint8)
    names = tuple(f"{i:04d}.jpg" for i in range(count))
    return Truth(names, (lens,) * count, poses, ground, (picture,) * count)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="measured on Linux only")
def test_memory_of_training_does_not_grow_with_the_photographs(tmp_path: Path) -> None:
    """A photograph of 400 x 300 pixels has 0.36 MB, and its depth prior 0.57 MB."""
    few, many = (peak_bytes(tmp_path, count, whole=20) for count in (192, 320))
    assert (few[0], many[0]) == (16, 32)
    each = (many[1] - few[1]) / (320 - 192)
    assert each < 0.2e6, f"{each / 1e6:.2f} MB more for each photograph"
    together = peak_bytes(tmp_path, 320, whole=1000)
    assert together[0] == 1
    assert (together[1] - few[1]) / (320 - 192) > 0.6e6, "this test would notice"


@pytest.mark.thorough
def test_training_goes_on_from_the_shipped_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setitem(PRESETS, "swift", SMALL)
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    torch.manual_seed(5)
    shipped = make_network(SMALL.network).half().float()
    write_weights(tmp_path / "swift.safetensors", shipped, SMALL, {})
    monkeypatch.setattr(checkpoint, "SHIPPED", tmp_path)

    def moved(name: str, **options: Any) -> tuple[Run, float]:
        """The run, and how far two steps took the widest-moving number from what was shipped."""
        one = Train(tmp_path / "flats", tmp_path / name, width=48, budget=Budget(steps=2), device="cpu", **options)
        train_command.train(one, Console(quiet=True))
        network = make_network(SMALL.network)
        load_network(tmp_path / name, network)
        pairs = zip(network.parameters(), shipped.parameters(), strict=True)
        return read_run(tmp_path / name), max((a - b).abs().max().item() for a, b in pairs)

    started, far = moved("started")
    assert started.weights == weights_sha256(tmp_path / "swift.safetensors")
    assert started.config == SMALL, "as from random weights"
    rise = (1 + 2) / SMALL.train.warm_up
    assert far < 1.01 * rise * SMALL.train.learning_rate, "two steps of Adam, which begin small"
    same, _ = moved("same", variant="neighbours-direction")
    assert same.weights == started.weights, "other neighbours, but the same network"
    assert moved("fewer", variant="views-2")[0].weights is None
    fresh, far = moved("fresh", from_scratch=True)
    assert (fresh.weights, fresh.config) == (None, SMALL)
    assert far > 1e-2
    given, _ = moved("given", weights=tmp_path / "swift.safetensors")
    assert given.weights == started.weights
    with pytest.raises(RunError, match="starts without"):
        moved("both", weights=tmp_path / "swift.safetensors", from_scratch=True)


def test_training_lowers_the_loss_and_leaves_a_checkpoint(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = SceneTrainer(replace(SMALL, train=replace(SMALL.train, warm_up=1)), scene, seed=0, device=CPU)
    trainer.network.load_state_dict(network(SMALL.network, stir=0.02).state_dict())
    batch = trainer.draw()
    monkeypatch.setattr(trainer, "draw", lambda: batch)  # losses of different ones are not to be compared
    assert train(trainer, tmp_path, Budget(steps=10), Console(quiet=True)) is None
    losses = trainer.progress.losses
    assert losses[-1] < losses[0] / 2
    again = SceneTrainer(SMALL, scene, seed=1, device=CPU)
    assert load_network(tmp_path, again.network).step == 10
    assert all(torch.equal(v, weights(again)[n]) for n, v in weights(trainer).items())


def test_no_batch_is_drawn_in_vain_without_a_gpu(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, draw = [], SceneTrainer.draw
    monkeypatch.setattr(SceneTrainer, "draw", lambda trainer: drawn.append(1) or draw(trainer))
    assert train(SceneTrainer(PLAIN, scene, seed=0, device=CPU), tmp_path, Budget(steps=3), Console(quiet=True)) is None
    assert len(drawn) == 3


def test_only_steps_count_as_time_of_training(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step takes 3 seconds and draws the next batch in 1; preparing, pictures and callbacks take far longer."""
    clock = [0.0]

    def pass_time(seconds: float) -> torch.Tensor:
        clock[0] += seconds
        return torch.tensor(0.1)

    def read() -> float:
        return clock[0]

    monkeypatch.setattr("tidefield.train.loop.time", SimpleNamespace(perf_counter=read, monotonic=read))
    monkeypatch.setattr("tidefield.train.loop._write_picture", lambda *_: pass_time(70.0))
    trainer = SceneTrainer(SMALL, scene, seed=0, device=CPU)
    monkeypatch.setattr(trainer, "prepare", lambda progress: pass_time(50.0))
    monkeypatch.setattr(trainer, "backward", lambda: pass_time(3.0))
    monkeypatch.setattr(trainer, "draw_ahead", lambda: pass_time(1.0))
    assert train(trainer, tmp_path, Budget(minutes=0.5), Console(quiet=True), lambda *_: pass_time(100.0)) is None
    assert (trainer.progress.step, trainer.progress.seconds) == (8, 32.0)
    assert clock[0] > 50 + 8 * 104, "this test would notice"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interruption_saves_before_it_stops(number: signal.Signals, scene: Scene, tmp_path: Path) -> None:
    trainer = SceneTrainer(PLAIN, scene, seed=0, device=CPU)
    step = trainer.step

    def interrupted_step(budget: Budget) -> float:
        if trainer.progress.step == 2:
            os.kill(os.getpid(), number)
        return step(budget)

    trainer.step = interrupted_step  # type: ignore[method-assign]
    assert train(trainer, tmp_path, Budget(steps=50), Console(quiet=True)) == number
    assert 3 <= trainer.progress.step < 50
    other = SceneTrainer(PLAIN, scene, seed=1, device=CPU)
    other.resume(tmp_path)
    assert other.progress.step == trainer.progress.step
    trainer.step = interrupted_step  # type: ignore[method-assign]
    trainer.progress.step = 2
    assert train(trainer, tmp_path, Budget(steps=3), Console(quiet=True)) == number, "its command ends, too"


@pytest.mark.parametrize("config", [PAPER, SWIFT])
def test_a_run_file_keeps_the_whole_configuration(config: Config, tmp_path: Path) -> None:
    run = Run(tmp_path / "scene", 400, 7, config)
    write_run(tmp_path, run)
    assert read_run(tmp_path) == run


def change(data: Any, where: str, value: Any) -> Any:
    """JSON, with another value at a place such as network.passes.0.samples."""
    data = json.loads(json.dumps(data))
    *path, last = [int(word) if word.isdigit() else word for word in where.split(".")]
    inner = data
    for word in path:
        inner = inner[word]
    inner[last] = value
    return data


@pytest.mark.parametrize(
    ("where", "value"),
    [
        *[("network.views", value) for value in (-2, 0, 5.5, True, "5", None, 10**400)],
        *[("network.passes.0.samples", value) for value in (0, 10**7)],
        *[("network.passes.1.hidden", value) for value in (10**7, 18, 32)],
        *[("train.learning_rate", value) for value in (10**400, math.nan, math.inf, -1, "fast")],
        *[("network.passes", value) for value in ([], None, [1])],
        *[("network.passes.0.stride", value) for value in (0, 5, 64)],
        *[("network.passes.0.feature_stride", value) for value in (3, 4.0, [])],
        *[("network.harmonics_degree", 5), ("train.tile_px", 30), ("network.kind", "paper"), ("network.kind", {})],
    ],
)
def test_a_configuration_that_no_network_can_have_is_one_clear_error(where: str, value: Any) -> None:
    with pytest.raises(RunError, match="expected") as refused:
        config_from_json(change(config_to_json(SWIFT), where, value))
    assert len(str(refused.value)) < 300


@pytest.mark.parametrize(
    "budget", [{"steps": s} for s in (0, -5)] + [{"minutes": m} for m in (0.0, -1.0, math.nan, math.inf)]
)
def test_a_budget_is_a_time_or_a_number_of_steps_above_0(budget: dict[str, Any]) -> None:
    (name,) = budget
    with pytest.raises(RunError, match=f"--{name} .* was asked for: expected"):
        Budget(**budget).checked()


def test_the_share_of_a_budget_is_that_of_its_minutes_or_of_its_steps() -> None:
    by_time, by_steps = Budget(minutes=10.0), Budget(steps=8)
    assert [by_time.share(5, seconds) for seconds in (0.0, 300.0, 600.0, 900.0)] == [0.0, 0.5, 1.0, 1.0]
    assert [by_steps.share(step, 900.0) for step in (0, 2, 8, 9)] == [0.0, 0.25, 1.0, 1.0]


@pytest.mark.parametrize("seed", [-1, 1 << 63, 1 << 70])
def test_a_seed_is_what_random_generators_take(seed: int) -> None:
    with pytest.raises(RunError, match="--seed"):
        checked_seed(seed)
    assert checked_seed((1 << 63) - 1) == (1 << 63) - 1


def test_a_configuration_with_an_unknown_field_is_refused() -> None:
    data = json.loads(json.dumps(config_to_json(SWIFT)))
    data["network"]["colour_of_the_sea"] = "grey"
    with pytest.raises(RunError, match="colour_of_the_sea"):
        config_from_json(data)


@pytest.mark.parametrize("content", [b"", b"not a checkpoint at all", b'\x10\0\0\0\0\0\0\0{"x":1}        '])
def test_a_damaged_checkpoint_is_one_clear_error(content: bytes, scene: Scene, tmp_path: Path) -> None:
    (tmp_path / CHECKPOINT_FILE).write_bytes(content)
    with pytest.raises(RunError, match="damaged or of another program"):
        load_network(tmp_path, SceneTrainer(SMALL, scene, seed=0, device=CPU).network)


def test_a_checkpoint_of_another_network_is_refused(scene: Scene, tmp_path: Path) -> None:
    SceneTrainer(SMALL, scene, seed=0, device=CPU).save(tmp_path)
    other = replace(SMALL, network=replace(SMALL.network, encoder=EncoderConfig((8, 8, 16, 8), (1, 1, 1), False)))
    with pytest.raises(RunError, match="does not fit"):
        load_network(tmp_path, SceneTrainer(other, scene, seed=0, device=CPU).network)


def test_the_learning_rate_rises_in_a_line_and_falls_along_half_a_cosine(scene: Scene) -> None:
    trainer = SceneTrainer(PLAIN, scene, seed=0, device=CPU)
    budget = Budget(steps=1000)
    rates = []
    for step in (0, 24, 49, 500, 999):
        trainer.progress.step = step
        trainer.step(budget)
        rates.append(trainer.optimizer.param_groups[0]["lr"] / PLAIN.train.learning_rate)
    expected = [warm * (0.02 + 0.98 * (1 + math.cos(math.pi * t)) / 2) for warm, t in WARM_AND_TIME]
    assert rates == pytest.approx(expected, rel=1e-6)


WARM_AND_TIME = [(0.02, 0.0), (0.5, 0.024), (1.0, 0.049), (1.0, 0.5), (1.0, 0.999)]


def test_gradients_are_clipped_to_a_norm_of_one(scene: Scene) -> None:
    trainer = SceneTrainer(PLAIN, scene, seed=0, device=CPU)
    loss = trainer.loss

    def hundredfold(inputs: Inputs) -> tuple[torch.Tensor, torch.Tensor]:
        value, error = loss(inputs)
        return 1e4 * value, error

    trainer.loss = hundredfold  # type: ignore[method-assign]
    trainer.step(Budget(steps=10))
    norms = [p.grad.norm() for p in trainer.network.parameters() if p.grad is not None]
    assert torch.stack(norms).norm().item() == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("at", ["gradient", "loss"])
def test_what_is_not_finite_is_never_saved(
    at: str, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tidefield.train.loop.SAVE_SECONDS", 0.0)
    trainer = SceneTrainer(PLAIN, scene, seed=0, device=CPU)
    backward = trainer.backward

    def overflowing() -> torch.Tensor:
        error = backward()
        if trainer.progress.step < 2:
            return error
        if at == "loss":
            return error * torch.nan
        gradient = next(p.grad for p in trainer.network.parameters() if p.grad is not None)
        gradient[0] = torch.nan
        return error

    trainer.backward = overflowing  # type: ignore[method-assign]
    with pytest.raises(FloatingPointError, match="at step 3; this is a defect of the program"):
        train(trainer, tmp_path, Budget(steps=3), Console(quiet=True))
    again = SceneTrainer(PLAIN, scene, seed=1, device=CPU)
    assert load_network(tmp_path, again.network).step == 2
    assert all(value.isfinite().all() for value in weights(again).values())


def older(config: Config) -> dict[str, Any]:
    """A configuration as version 0.1 wrote it."""
    today = json.loads(json.dumps(config_to_json(config)))
    network = today["network"]
    network = {
        **{name: network[name] for name in ("encoder", "views", "heads", "harmonics_degree", "without")},
        **{"stages": network["passes"], "doubt": network["uniform_fraction"]},
        **{"as_printed": config.network.kind == "paper", "fold": config.network.kind == "swift", "field": None},
    }
    return {**today, "network": network, "train": {**today["train"], "field_learning_rate": 1e-2}}


def test_configurations_of_version_0_1_are_read() -> None:
    old = older(SMALL)
    assert config_from_json(old) == SMALL
    with pytest.raises(RunError, match="per-scene field"):
        config_from_json({**old, "network": {**old["network"], "field": {"levels": 12}}})


def test_runs_of_version_0_1_are_read_if_they_are_of_the_papers_network(scene: Scene, tmp_path: Path) -> None:
    small = replace(PAPER, network=SMALL_PAPER, train=replace(PAPER.train, tiles=1))
    trainer = SceneTrainer(small, scene, seed=0, device=CPU)
    trainer.step(Budget(steps=5))
    trainer.save(tmp_path)
    with safe_open(tmp_path / CHECKPOINT_FILE, framework="pt") as file:
        metadata, tensors = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    renamed = {}
    for name, value in tensors.items():
        name = re.sub(r"^network\.(?!encoder)", "network.stages.0.", name).replace(".view_weight.", ".trust.")
        renamed[name.replace("transformer.position", "transformer.place")] = value
    assert len(set(renamed) - set(tensors)) > 20
    header = {**json.loads(metadata["tidefield"]), "version": "0.1.0"}
    del header["sha256"], header["run"], header["cpu_precision"]
    save_file(renamed, tmp_path / CHECKPOINT_FILE, metadata={"tidefield": json.dumps(header)})
    again = SceneTrainer(small, scene, seed=1, device=CPU)
    again.resume(tmp_path)
    for name, value in weights(trainer).items():
        assert torch.equal(value, weights(again)[name]), name
    assert trainer.step(Budget(steps=5)) == again.step(Budget(steps=5))


def test_runs_of_swift_of_version_0_1_are_refused() -> None:
    with pytest.raises(RunError, match=r"swift of Tidefield 0\.1.*train it again"):
        checkpoint.convert_names_0_1({"sharpen": torch.zeros(1), "stages.0.aggregate.second.bias": torch.zeros(1)})
