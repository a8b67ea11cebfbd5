from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import textured_wall as wall
import torch
from networks import SMALL, network
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from tidefield.config import SWIFT, Budget, Config
from tidefield.data.load import at_twice_the_size, load_scene
from tidefield.data.scene import Scene
from tidefield.evaluation.metrics import prepare_torchvision
from tidefield.recording import WARM_UPS, Recorder, map_tensors, moved, recording_lock
from tidefield.synthetic import make_survey, write_survey
from tidefield.train.loop import SceneTrainer

CPU, GPU = torch.device("cpu"), torch.device("cuda:0")
TILES = replace(SWIFT.train, tile_px=16, tiles=3, crop_px=32)


class OnOneDevice(TorchDispatchMode):
    """Fails where an operation reads from or writes to the processor, as none that is recorded may."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for value in (*args, *(kwargs or {}).values(), result):
            for tensor in value if isinstance(value, (list, tuple)) else [value]:
                where = tensor.device.type if isinstance(tensor, Tensor) else "meta"
                assert where == "meta", f"{func} with a tensor on the {where}"
        return result


def detailed_scene(folder: Path) -> Scene:
    """One whose photographs are read at twice the size, too."""
    write_survey(make_survey("ground_textures", seed=1, views=6, width=128), folder)
    scene = load_scene(folder, width=64)
    assert at_twice_the_size(scene) is not None
    count = len(scene.names)
    cameras = replace(scene.cameras, residual=torch.zeros(count, 6, 2), shading=torch.zeros(count, 15, 3))
    return replace(scene, cameras=cameras)


@pytest.mark.thorough
def test_what_a_loss_computes_can_be_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare_torchvision()
    import torchmetrics.functional.image  # noqa: F401 - makes constants on the processor when it is imported

    scene = wall.with_left_halves_masked(detailed_scene(tmp_path), (0, 1))
    trainer = SceneTrainer(replace(SWIFT, train=TILES), scene, 0, CPU)
    trainer.progress.cpu_precision = "float32"
    inputs = trainer.draw()
    assert inputs.batch.image_doubled
    assert inputs.batch.image_used
    trainer.network.to("meta")
    inputs = map_tensors(inputs, lambda tensor: tensor.to("meta"))
    # They read numbers from the processor, which on this device is no operation.
    for name in ("tensor", "as_tensor"):
        monkeypatch.delattr(torch, name)
    with OnOneDevice():
        loss, _ = trainer.loss(inputs)
        loss.backward()


def test_values_that_decide_are_found() -> None:
    with OnOneDevice(), pytest.raises(RuntimeError, match="meta"):
        torch.ones(3, device="meta").max().item()
    with OnOneDevice(), pytest.raises(AssertionError, match="on the cpu"):
        torch.ones(3).to("meta")


@pytest.fixture(scope="module")
def scene() -> Scene:
    cameras = wall.cameras(7, 96, 72, step=0.25)
    # A little of all that cameras may have: what is computed from it is recorded, too.
    cameras = replace(cameras, residual=torch.full((7, 6, 2), 1e-4), shading=torch.full((7, 15, 3), 1e-2))
    return wall.scene(cameras, (3,))


def steps(config: Config, scene: Scene, recorded: bool, count: int) -> tuple[list[float], Tensor]:
    trainer = SceneTrainer(config, scene, seed=3, device=GPU)
    trainer.network.load_state_dict(network(config.network, stir=0.1).state_dict())
    if not recorded:
        trainer._recorder = None
    errors = [trainer.step(Budget(steps=100)) for _ in range(count)]
    return errors, torch.cat([parameter.detach().flatten() for parameter in trainer.network.parameters()])


@pytest.mark.gpu
@pytest.mark.parametrize("config", [SMALL, replace(SWIFT, train=TILES)])
def test_recorded_steps_are_those_that_were_not(config: Config, scene: Scene) -> None:
    (errors, weights), (others, theirs) = (steps(config, scene, recorded, 12) for recorded in (True, False))
    torch.testing.assert_close(torch.tensor(errors), torch.tensor(others), rtol=0.02, atol=0)
    assert (weights - theirs).norm() < 0.02 * theirs.norm()


def test_nothing_new_is_recorded_while_another_thread_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    class Recording:
        def __init__(self, *_: Any) -> None:
            assert recording_lock.locked()

        def replay(self, inputs: Tensor) -> str:
            return "replayed"

    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: None)
    monkeypatch.setattr(torch.cuda, "device", nullcontext)
    monkeypatch.setattr("tidefield.recording._Recording", Recording)
    recorder = Recorder(lambda _: "computed", CPU)
    with recording_lock:
        assert recorder(torch.ones(3)) == "computed"
    assert recorder(torch.ones(3)) == "replayed"
    with recording_lock:
        assert recorder(torch.ones(3)) == "replayed", "only what is new has to wait"
        assert recorder(torch.ones(4)) == "computed"
    assert not recording_lock.locked()


@pytest.mark.parametrize(("device", "waits"), [("mps", True), ("cuda:0", False)])
def test_only_cuda_reads_the_memory_of_the_processor_later(
    device: str, waits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def to(tensor: Tensor, to: torch.device, non_blocking: bool = False) -> Tensor:
        asked.append((str(to), non_blocking))
        return tensor

    monkeypatch.setattr(Tensor, "to", to)
    moved((torch.ones(3), torch.ones(4)), torch.device(device))
    assert asked == [(device, not waits)] * 2


@pytest.mark.gpu
def test_inputs_of_other_shapes_are_recorded_anew() -> None:
    computed = []

    def total(inputs: tuple[Tensor, ...]) -> Tensor:
        computed.append(len(inputs[0]))
        return 2 * inputs[0].sum()

    recorder = Recorder(total, GPU, after=1)
    for given in ([1.0, 2.0], [3.0, 4.0], [5.0], [1.0, 7.0], [6.0, 2.0]):
        assert float(recorder((torch.tensor(given),))) == 2 * sum(given)
    assert computed == [2] * (WARM_UPS + 2) + [1], "what comes once is not recorded"
