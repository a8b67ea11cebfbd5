"""What a GPU computes is what a CPU computes: rendering, training, and runs that move from one to the other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import textured_wall as wall
import torch
from networks import NETWORKS, SMALL, network
from torch import Tensor

from tidefield.baselines.nerf import NerfTrainer
from tidefield.config import SWIFT, Budget, Config, NerfConfig, Sampling
from tidefield.data.scene import Scene
from tidefield.device import choose_device, choose_precision
from tidefield.evaluation.metrics import psnr_from_mse
from tidefield.model.renderer import Renderer, in_turn
from tidefield.model.rendering import Rendering
from tidefield.model.views import weighted_rows
from tidefield.train.loop import SceneTrainer

pytestmark = pytest.mark.gpu
CPU, GPU = torch.device("cpu"), torch.device("cuda:0")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return wall.scene(wall.cameras(7, 96, 72), (3,))


def psnr(one: Tensor, other: Tensor) -> float:
    return psnr_from_mse(float((one.cpu() - other.cpu()).square().mean()))


def rendered(config: Config, scene: Scene, device: torch.device, sampling: Sampling) -> Rendering:
    own = network(config.network, stir=0.02).to(device).eval()
    return Renderer(own, scene, config, device, sampling)(scene.cameras[3])


def test_auto_is_the_gpu() -> None:
    assert choose_device("auto") == choose_device("cuda") == GPU


@pytest.mark.parametrize("side", [1, 2])
@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_views_are_those_of_the_cpu(scene: Scene, name: str, side: int) -> None:
    config, sampling = replace(SWIFT, network=NETWORKS[name]), Sampling(rays_per_side=side)
    ours, theirs = (rendered(config, scene, device, sampling) for device in (GPU, CPU))
    assert ours.colour.device == ours.depth.device == CPU
    assert psnr(ours.colour, theirs.colour) > 45
    torch.testing.assert_close(ours.depth, theirs.depth, rtol=0.01, atol=0)


def test_views_in_turn_are_recorded_and_the_same(scene: Scene) -> None:
    own = network(SWIFT.network, stir=0.02).to(GPU).eval()
    flight = scene.cameras[[3, 2, 3, 3, 4]]
    every = list(in_turn(Renderer(own, scene, SWIFT, GPU), flight))
    for k, view in enumerate(every):
        alone = Renderer(own, scene, SWIFT, GPU)(flight[k])
        torch.testing.assert_close(view.colour, alone.colour, rtol=0, atol=1e-4)
        torch.testing.assert_close(view.depth, alone.depth, rtol=1e-4, atol=0)


def test_reads_of_feature_maps_and_their_gradients_are_those_of_the_cpu() -> None:
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(50, 8, generator=generator)
    index = torch.randint(50, (300, 4), generator=generator, dtype=torch.int32)
    share, given = (torch.randn(300, size, generator=generator) for size in (4, 8))
    found = []
    for device in (GPU, CPU):
        own = rows.to(device).requires_grad_()
        values = weighted_rows(own, index.to(device), share.to(device))
        values.backward(given.to(device))
        assert own.grad is not None
        found.append((values.detach().cpu(), own.grad.cpu()))
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def gradients(scene: Scene, device: torch.device) -> Tensor:
    trainer = SceneTrainer(replace(SMALL, train=replace(SMALL.train, tiles=8)), scene, seed=3, device=device)
    trainer.backward()
    found = [p.grad for p in trainer.network.parameters() if p.grad is not None]
    return torch.cat([gradient.reshape(-1).cpu() for gradient in found])


def test_a_batch_has_the_gradients_of_the_cpu(scene: Scene) -> None:
    ours, theirs = gradients(scene, GPU), gradients(scene, CPU)
    assert torch.cosine_similarity(ours, theirs, dim=0) > (0.999 if choose_precision(GPU) == torch.float32 else 0.98)
    assert float(ours.norm() / theirs.norm()) == pytest.approx(1, abs=0.1)


def test_training_learns_and_goes_on_on_the_cpu(scene: Scene, tmp_path: Path) -> None:
    budget, trainer = Budget(steps=60), SceneTrainer(SMALL, scene, seed=0, device=GPU)
    trainer.network.load_state_dict(network(SMALL.network, stir=0.1).state_dict())
    errors = [trainer.step(budget) for _ in range(40)]
    assert sum(errors[-10:]) < 0.5 * sum(errors[:10])
    trainer.save(tmp_path)
    second = SceneTrainer(SMALL, scene, seed=0, device=CPU)
    second.resume(tmp_path)
    assert second.progress.step == 40
    assert second.step(budget) < max(errors[:10])
    assert torch.isfinite(trainer.views([scene.cameras[3]])[0].colour).all()


def test_classical_nerf_trains(scene: Scene) -> None:
    trainer = NerfTrainer(NerfConfig(depth=2, width=64, rays=256), scene, 0, GPU)
    errors = [trainer.step(Budget(steps=60)) for _ in range(30)]
    assert sum(errors[-10:]) < sum(errors[:10])
