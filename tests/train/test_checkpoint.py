"""Checkpoints, weights and run.json that are damaged, incomplete, or of another run, are never taken for right ones."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import textured_wall as wall
import torch
from networks import SMALL
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from tidefield.config import SWIFT, Budget
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.model.network import make_network
from tidefield.train.checkpoint import (
    CHECKPOINT_FILE,
    RUN_FILE,
    Run,
    load_network,
    read_run,
    read_weights,
    write_run,
    write_weights,
)
from tidefield.train.loop import SceneTrainer

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return wall.scene(wall.cameras(5))


@pytest.fixture(scope="module")
def trained(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The checkpoint of one step, of no run."""
    folder, trainer = tmp_path_factory.mktemp("trained"), SceneTrainer(SMALL, scene, seed=0, device=CPU)
    trainer.step(Budget(steps=3))
    trainer.save(folder)
    return (folder / CHECKPOINT_FILE).read_bytes()


def rewrite(path: Path, change: Callable[[dict[str, Tensor], dict[str, Any]], object]) -> None:
    """Change what a file holds, as version 0.1 would have written it: without a checksum."""
    with safe_open(path, framework="pt") as file:
        header, tensors = json.loads(file.metadata()["tidefield"]), {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
    header["version"] = "0.1.0"
    header.pop("sha256", None)
    change(tensors, header)
    save_file(tensors, path, metadata={"tidefield": json.dumps(header)})


NAME = "encoder.stem.0.weight"


def lack(tensors: dict[str, Tensor], name: str) -> None:
    del tensors[name]


def poison(tensors: dict[str, Tensor], name: str) -> None:
    tensors[name].view(-1)[3] = torch.nan


WRONG: list[tuple[Callable[[dict[str, Tensor], str], object], str]] = [
    (lack, "is missing"),
    (poison, "is not finite"),
    (lambda tensors, name: tensors.update({name: tensors[name].long()}), "has the type torch.int64"),
    (lambda tensors, name: tensors.update({name: tensors[name].double() + 1e300}), "is not finite"),
    (lambda tensors, name: tensors.update({name: tensors[name][1:].clone()}), "has the shape"),
    (lambda tensors, name: tensors.update(nothing=torch.zeros(1)), "nothing is not known"),
]


@pytest.mark.parametrize(("change", "message"), WRONG)
def test_weights_are_exactly_the_finite_tensors_of_the_network(
    change: Callable[[dict[str, Tensor], str], object], message: str, tmp_path: Path
) -> None:
    file, network = tmp_path / "w.safetensors", make_network(SMALL.network)
    write_weights(file, network, SMALL, {})
    rewrite(file, lambda tensors, header: None)
    read_weights(file, network)
    rewrite_again(file, lambda tensors: change(tensors, NAME))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    with pytest.raises(RunError, match=message):
        read_weights(file, network)
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def rewrite_again(path: Path, change: Callable[[dict[str, Tensor]], object]) -> None:
    with safe_open(path, framework="pt") as file:
        metadata, tensors = file.metadata(), {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
    change(tensors)
    save_file(tensors, path, metadata=metadata)


@pytest.mark.parametrize(("change", "message"), WRONG)
@pytest.mark.parametrize("name", [f"network.{NAME}", "optimizer.0.exp_avg"])
def test_a_checkpoint_is_exactly_the_finite_tensors_of_its_training(
    change: Callable[[dict[str, Tensor], str], object],
    message: str,
    name: str,
    scene: Scene,
    trained: bytes,
    tmp_path: Path,
) -> None:
    (tmp_path / CHECKPOINT_FILE).write_bytes(trained)
    rewrite(tmp_path / CHECKPOINT_FILE, lambda tensors, header: change(tensors, name))
    with pytest.raises(RunError, match=message):
        SceneTrainer(SMALL, scene, seed=1, device=CPU).resume(tmp_path)


def test_one_flipped_bit_anywhere_is_noticed(trained: bytes, tmp_path: Path) -> None:
    file, weights, network = tmp_path / CHECKPOINT_FILE, tmp_path / "w.safetensors", make_network(SMALL.network)
    write_weights(weights, network, SMALL, {"steps": 5})
    generator = torch.Generator().manual_seed(0)
    for path, content in ((file, trained), (weights, weights.read_bytes())):
        read: Callable[[], object] = (
            (lambda: load_network(tmp_path, network)) if path == file else (lambda: read_weights(weights, network))
        )
        path.write_bytes(content)
        read()
        for place in torch.randint(len(content), (24,), generator=generator).tolist() + list(range(8, 1000, 40)):
            damaged = bytearray(content)
            damaged[place] ^= 1
            path.write_bytes(damaged)
            with pytest.raises(RunError, match=r"damaged|fit|another network"):
                read()


@pytest.mark.parametrize(
    "change",
    [
        lambda tensors, header: lack(tensors, "generator"),
        lambda tensors, header: tensors.update(generator=tensors["generator"][:100].clone()),
        lambda tensors, header: tensors.update(generator=tensors["generator"].float()),
        lambda tensors, header: tensors["generator"].zero_(),
        lambda tensors, header: tensors.update({"optimizer.x.y": torch.zeros(1)}),
        lambda tensors, header: tensors.update({"optimizer.": torch.zeros(1)}),
        lambda tensors, header: header.pop("step"),
        *[
            lambda tensors, header, name=name, value=value: header.update({name: value})
            for name, values in {
                "step": [10**400, -1, 1.5, None, 1 << 63],
                "seconds": [-1, float("inf"), 10**400, "x"],
                "losses": [None, [None], [float("nan")], {}],
                "cpu_precision": ["float8"],
            }.items()
            for value in values
        ],
    ],
)
def test_a_damaged_header_or_state_of_training_is_one_clear_error(
    change: Callable[[dict[str, Tensor], dict[str, Any]], object], scene: Scene, trained: bytes, tmp_path: Path
) -> None:
    (tmp_path / CHECKPOINT_FILE).write_bytes(trained)
    rewrite(tmp_path / CHECKPOINT_FILE, change)
    with pytest.raises(RunError, match=CHECKPOINT_FILE):
        SceneTrainer(SMALL, scene, seed=1, device=CPU).resume(tmp_path)


def test_a_checkpoint_is_no_weights_file(trained: bytes, tmp_path: Path) -> None:
    (tmp_path / CHECKPOINT_FILE).write_bytes(trained)
    with pytest.raises(RunError, match="is not a weights file"):
        read_weights(tmp_path / CHECKPOINT_FILE, make_network(SMALL.network))


def test_a_header_nested_too_deeply_is_one_clear_error(tmp_path: Path) -> None:
    save_file({}, tmp_path / CHECKPOINT_FILE, metadata={"tidefield": "[" * 100_000})
    with pytest.raises(RunError, match="damaged"):
        load_network(tmp_path, make_network(SMALL.network))


def test_a_file_of_today_without_its_checksum_is_damaged(trained: bytes, tmp_path: Path) -> None:
    (tmp_path / CHECKPOINT_FILE).write_bytes(trained.replace(b"sha256", b"sha257", 1))
    with pytest.raises(RunError, match="without a SHA-256"):
        load_network(tmp_path, make_network(SMALL.network))


def test_a_checkpoint_of_another_run_is_not_taken_for_this_ones(scene: Scene, tmp_path: Path) -> None:
    trainer, network = SceneTrainer(SMALL, scene, seed=0, device=CPU), make_network(SMALL.network)
    write_run(tmp_path, Run(tmp_path / "scene", None, 0, SMALL))
    trainer.save(tmp_path)
    load_network(tmp_path, network)
    write_run(tmp_path, Run(tmp_path / "scene", None, 0, SMALL))
    with pytest.raises(RunError, match="of another run"):
        load_network(tmp_path, network)


def test_others_may_read_a_run_where_the_umask_allows_it(trained: bytes, scene: Scene, tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        SceneTrainer(SMALL, scene, seed=0, device=CPU).save(tmp_path)
        write_run(tmp_path, Run(tmp_path, None, 0, SMALL))
    finally:
        os.umask(before)
    assert {(tmp_path / name).stat().st_mode & 0o777 for name in (CHECKPOINT_FILE, RUN_FILE)} == {0o644}


@pytest.mark.parametrize(
    ("name", "values"),
    {
        "width": ["abc", 50.5, [], 10**400],
        "seed": ["x", None, 1 << 80, 1.0],
        "scene": [None, 5],
        "id": [5],
        "budget": [5, {"steps": 1}, {"minutes": "x", "steps": None}],
        "config": [None, [], {}, {"method": []}, {"network": {"as_printed": 1, "views": 5}, "train": 5}],
        "weights": [5],
        "new": [5],
    }.items(),
)
def test_a_damaged_run_file_is_one_clear_error(name: str, values: list[Any], tmp_path: Path) -> None:
    write_run(tmp_path, Run(tmp_path / "scene", None, 0, SWIFT))
    data = json.loads((tmp_path / RUN_FILE).read_text())
    for value in values:
        (tmp_path / RUN_FILE).write_text(json.dumps({**data, name: value}))
        with pytest.raises(RunError, match=RUN_FILE):
            read_run(tmp_path)
    for content in ("[" * 100_000, "[1]", "{}", "{", '{"seed": 1' + "0" * 5000 + "}"):
        (tmp_path / RUN_FILE).write_text(content)
        with pytest.raises(RunError, match=RUN_FILE):
            read_run(tmp_path)


def test_a_run_of_version_0_1_has_no_id_and_neither_has_its_checkpoint(trained: bytes, tmp_path: Path) -> None:
    write_run(tmp_path, Run(tmp_path / "scene", None, 0, SMALL))
    data = json.loads((tmp_path / RUN_FILE).read_text())
    del data["id"], data["budget"]
    (tmp_path / RUN_FILE).write_text(json.dumps(data))
    (tmp_path / CHECKPOINT_FILE).write_bytes(trained)
    assert read_run(tmp_path).id is None
    assert read_run(tmp_path).budget is None
    assert load_network(tmp_path, make_network(SMALL.network)).step == 1


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_run_of_somebody_else_is_one_clear_error(trained: bytes, tmp_path: Path) -> None:
    (tmp_path / CHECKPOINT_FILE).write_bytes(trained)
    (tmp_path / CHECKPOINT_FILE).chmod(0)
    with pytest.raises(RunError, match="cannot be read"):
        load_network(tmp_path, make_network(SMALL.network))


@pytest.mark.thorough
def test_what_a_cpu_computed_in_is_kept_on_resume(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def steps(trainer: SceneTrainer) -> None:
        for _ in range(2):
            trainer.step(Budget(steps=4))

    monkeypatch.setattr("tidefield.train.loop.choose_precision", lambda device: torch.float32)
    unbroken, first = (SceneTrainer(SMALL, scene, seed=3, device=CPU) for _ in range(2))
    steps(unbroken)
    steps(unbroken)
    steps(first)
    first.save(tmp_path)
    monkeypatch.setattr("tidefield.train.loop.choose_precision", lambda device: torch.bfloat16)
    second, other = (SceneTrainer(SMALL, scene, seed=3, device=CPU) for _ in range(2))
    second.resume(tmp_path)
    steps(second)
    steps(other)
    for name, value in unbroken.network.state_dict().items():
        assert torch.equal(value, second.network.state_dict()[name]), name
    assert first.progress.losses != other.progress.losses[:2], "the precision makes a difference"
