"""Training and runs on disk: resuming, refusing, saving, and one small scene end to end."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import textured_wall as wall
import torch
from networks import SMALL
from rich.console import Console
from scenes_on_disk import PINHOLE, survey, write_colmap

from tidefield.commands import training
from tidefield.config import PAPER, SWIFT, Config, EncoderConfig, FieldConfig, config_from_json, config_to_json
from tidefield.data.scene import Scene
from tidefield.errors import DeviceError, RunError
from tidefield.model.network import Network
from tidefield.options import Length, Train
from tidefield.train.checkpoint import CHECKPOINT_FILE, Run, load_network, read_run, write_run
from tidefield.train.display import Display
from tidefield.train.loop import Budget, SceneTrainer, train
from tidefield.train.weights import sha256, write_weights

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return wall.scene(wall.cameras(6))


def weights(trainer: SceneTrainer) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in trainer.network.state_dict().items()}


def test_a_resumed_training_ends_bit_for_bit_where_an_unbroken_one_does(scene: Scene, tmp_path: Path) -> None:
    budget = Budget(steps=6)
    unbroken = SceneTrainer(SMALL, scene, seed=3, device=CPU)
    for _ in range(6):
        unbroken.step(budget)
    first = SceneTrainer(SMALL, scene, seed=3, device=CPU)
    for _ in range(3):
        first.step(budget)
    first.save(tmp_path)
    second = SceneTrainer(SMALL, scene, seed=99, device=CPU)
    second.resume(tmp_path)
    for _ in range(3):
        second.step(budget)
    for name, value in weights(unbroken).items():
        assert torch.equal(value, weights(second)[name]), name
    assert second.progress.step == 6
    assert second.progress.losses == unbroken.progress.losses


def test_training_goes_on_from_the_shipped_weights_gently(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(training, "PRESETS", {"swift": SMALL})
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    torch.manual_seed(5)
    shipped = Network(SMALL.network).half().float()
    write_weights(tmp_path / "swift.safetensors", shipped, SMALL, {})
    monkeypatch.setattr(training, "shipped", lambda preset: tmp_path / f"{preset}.safetensors")

    def moved(name: str, **options: Any) -> tuple[Run, float]:
        """The run, and how far two steps took the widest-moving number from what was shipped."""
        one = Train(tmp_path / "flats", tmp_path / name, width=48, length=Length(steps=2), device="cpu", **options)
        training.train(one, Console(quiet=True))
        network = Network(SMALL.network)
        load_network(tmp_path / name, network)
        pairs = zip(network.parameters(), shipped.parameters(), strict=True)
        return read_run(tmp_path / name), max((a - b).abs().max().item() for a, b in pairs)

    begun, far = moved("begun")
    assert begun.weights == sha256(tmp_path / "swift.safetensors")
    assert isinstance(begun.config, Config)
    assert begun.config.train.warm_up == 200
    assert far < 1e-4, "two steps of a two-hundred-step rise"
    fresh, far = moved("fresh", from_scratch=True)
    assert (fresh.weights, fresh.config) == (None, SMALL)
    assert far > 1e-2
    given, _ = moved("given", weights=tmp_path / "swift.safetensors")
    assert given.weights == begun.weights
    with pytest.raises(RunError, match="begins without them"):
        moved("both", weights=tmp_path / "swift.safetensors", from_scratch=True)


def test_training_lowers_the_loss_and_leaves_a_checkpoint(scene: Scene, tmp_path: Path) -> None:
    trainer = SceneTrainer(SMALL, scene, seed=0, device=CPU)
    assert train(trainer, tmp_path, Budget(steps=30), Display(Console(quiet=True)))
    losses = trainer.progress.losses
    assert sum(losses[-10:]) < sum(losses[:10])
    again = SceneTrainer(SMALL, scene, seed=1, device=CPU)
    assert load_network(tmp_path, again.network).step == 30
    assert all(torch.equal(v, weights(again)[n]) for n, v in weights(trainer).items())


def test_an_interruption_saves_before_it_stops(scene: Scene, tmp_path: Path) -> None:
    trainer = SceneTrainer(SMALL, scene, seed=0, device=CPU)
    step = trainer.step

    def interrupted_step(budget: Budget) -> float:
        if trainer.progress.step == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return step(budget)

    trainer.step = interrupted_step  # type: ignore[method-assign]
    assert not train(trainer, tmp_path, Budget(steps=50), Display(Console(quiet=True)))
    assert 3 <= trainer.progress.step < 50
    other = SceneTrainer(SMALL, scene, seed=1, device=CPU)
    other.resume(tmp_path)
    assert other.progress.step == trainer.progress.step


@pytest.mark.parametrize("config", [PAPER, SWIFT, replace(SWIFT, network=replace(SWIFT.network, field=FieldConfig()))])
def test_a_run_file_keeps_the_whole_configuration(config: Config, tmp_path: Path) -> None:
    run = Run(tmp_path / "scene", 400, 7, config)
    write_run(tmp_path, run)
    assert read_run(tmp_path) == run


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


def test_without_neighbours_the_same_code_trains_a_field(scene: Scene) -> None:
    config = replace(SMALL, network=replace(SMALL.network, views=0, field=FieldConfig(levels=4, log2_entries=12)))
    trainer = SceneTrainer(config, scene, seed=0, device=CPU)
    errors = [trainer.step(Budget(steps=150)) for _ in range(150)]
    assert sum(errors[-10:]) < 0.7 * sum(errors[:10])


def test_a_device_that_is_not_there_is_named() -> None:
    from tidefield.device import choose_device

    with pytest.raises(DeviceError, match="cuda:99"):
        choose_device("cuda:99")
    assert choose_device("cpu") == CPU
