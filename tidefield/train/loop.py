"""Training on one scene."""

from __future__ import annotations

import logging
import math
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from tensorboardX import SummaryWriter
from torch import nn

from tidefield.config import Config
from tidefield.data.batches import Surfaces, draw_batch
from tidefield.data.scene import Scene
from tidefield.device import mixed_precision
from tidefield.geometry.cameras import Cameras
from tidefield.model.network import Network, Tiles
from tidefield.model.renderer import Renderer, start_intervals
from tidefield.model.rendering import Render, Rendering
from tidefield.model.views import Encoded, Views
from tidefield.train.checkpoint import Progress, load_training, save_checkpoint
from tidefield.train.curve import SHARES, Curve
from tidefield.train.display import Display
from tidefield.train.losses import photometric, psnr, sparse_depth, structural

log = logging.getLogger(__name__)

SAVE_SECONDS = 60.0
PICTURE_SECONDS = 300.0
FINAL_RATE = 0.02
"""Learning rate at the end, as a share of its peak; it falls along half a cosine."""


@dataclass(frozen=True)
class Budget:
    """When training ends: after so many steps or so many minutes of training, whichever is given."""

    steps: int | None = None
    minutes: float | None = None

    def share(self, progress: Progress) -> float:
        """How much of the budget is used, 0 to 1."""
        if self.steps is not None:
            return min(1.0, progress.step / max(self.steps, 1))
        assert self.minutes is not None, "a budget is steps or minutes"
        return min(1.0, progress.seconds / max(60 * self.minutes, 1e-9))


class Learner(ABC):
    """A network, its optimiser and its place in the sequence of random batches: what the loop trains.

    The same seed, scene and budget in steps give the same weights bit for bit on a CPU, however often training is
    stopped and resumed.

    Args:
        network: on `device`.
        groups: of parameters, as torch's optimisers take them, each with its "peak" learning rate.
        scene: to learn from.
        seed: of the batches.
        device: where to compute.
        betas, eps: Adam's.
    """

    def __init__(
        self,
        network: nn.Module,
        groups: list[dict[str, Any]],
        scene: Scene,
        seed: int,
        device: torch.device,
        betas: tuple[float, float],
        eps: float,
    ) -> None:
        self.network, self.scene, self.device = network, scene, device
        self.generator = torch.Generator().manual_seed(seed)
        self.optimizer = torch.optim.Adam([group for group in groups if group["params"]], betas=betas, eps=eps)
        self.progress = Progress()
        self.cameras = scene.cameras.to(device)

    @property
    @abstractmethod
    def rays_per_step(self) -> int:
        """Rays that a step learns from."""

    @abstractmethod
    def rate(self, share: float) -> float:
        """Learning rate as a share of its peak when this share of the budget is used."""

    @abstractmethod
    def loss(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw a batch; returns its loss, and the mean squared error of its colours."""

    @abstractmethod
    def renderer(self) -> Render:
        """What has been learned so far as a method; the network is in evaluation mode."""

    def resume(self, folder: Path) -> None:
        self.progress = load_training(folder, self.network, self.optimizer, self.generator)

    def save(self, folder: Path) -> None:
        save_checkpoint(folder, self.network, self.optimizer, self.generator, self.progress)

    def step(self, budget: Budget) -> float:
        """One step of gradient descent; returns the mean squared error of its colours."""
        start = time.perf_counter()
        rate = self.rate(budget.share(self.progress))
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["peak"]
        loss, error = self.loss()
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        value = error.item()
        self.progress.step += 1
        self.progress.seconds += time.perf_counter() - start
        self.progress.losses = [*self.progress.losses[-99:], value]
        return value


class Trainer(Learner):
    """Trains the paper's network on tiles of photographs and their neighbours."""

    network: Network

    def __init__(self, config: Config, scene: Scene, seed: int, device: torch.device) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = Network(config.network).to(device)
        if network.field is not None:
            network.field.cover(*scene_ball(scene))
        field = [p for name, p in network.named_parameters() if name.startswith("field.")]
        rest = [p for name, p in network.named_parameters() if not name.startswith("field.")]
        train = config.train
        groups = [{"params": rest, "peak": train.learning_rate}, {"params": field, "peak": train.field_learning_rate}]
        # A small epsilon: the field's gradients are tiny, and Adam's default would stop them.
        super().__init__(network, groups, scene, seed, device, betas=(0.9, 0.99), eps=1e-12)
        self.config = config
        self.surfaces = Surfaces(scene)

    @property
    def rays_per_step(self) -> int:
        return self.config.train.tiles * self.config.train.tile_px**2

    def rate(self, share: float) -> float:
        warm = min(1.0, (self.progress.step + 1) / self.config.train.warm_up)
        return warm * (FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * share)))

    def loss(self) -> tuple[torch.Tensor, torch.Tensor]:
        network, config, device, side = self.network, self.config, self.device, self.config.train.tile_px
        batch = draw_batch(self.scene, self.surfaces, config.train, config.network.views, self.generator).to(device)
        views = None
        if batch.images:
            parts = []
            with mixed_precision(device):
                for images, corner in zip(batch.images, batch.image_corner_px, strict=True):
                    parts.append(network.encode(images, corner))
            views = Views(self.cameras[batch.neighbours.reshape(-1)], batch.which, Encoded.joined(parts))
        tiles = Tiles(self.cameras[batch.targets], batch.corner_px, side)
        priors = torch.stack([self.surfaces[i] for i in batch.targets.tolist()]).to(device)
        opaque = self.scene.background_rgb is None
        rendering = network(tiles, views, start_intervals(network, tiles, priors), opaque, self.generator)
        loss, error = photometric(rendering, batch, network, side)
        if config.train.structure_weight:
            loss = loss + config.train.structure_weight * structural(rendering, batch, side)
        if config.train.depth_weight:
            loss = loss + config.train.depth_weight * sparse_depth(rendering, batch, network, side)
        return loss, error

    def renderer(self) -> Render:
        return Renderer(self.network, self.scene, self.config, self.device)


def train(trainer: Learner, folder: Path, budget: Budget, display: Display, curve: Curve | None = None) -> bool:
    """Train until the budget is used; save every minute and at the end, and on Ctrl-C or a polite kill.

    Args:
        trainer: what to train.
        folder: the run's.
        budget: steps or minutes.
        display: where progress is shown.
        curve: what to render now and then, and to judge.

    Returns:
        Whether the budget was used up; False after an interruption, from which `resume` goes on.
    """
    progress = trainer.progress
    writer = SummaryWriter(str(folder / "tensorboard"))
    saved = pictured = time.monotonic()
    due = [share for share in SHARES if share > budget.share(progress)]
    with writer, display, _interruption() as interrupted:
        while budget.share(progress) < 1 and not interrupted():
            error = trainer.step(budget)
            if not math.isfinite(error):
                raise FloatingPointError(
                    f"the loss is {error} at step {progress.step}; this is a defect of the program"
                )
            mean = sum(progress.losses) / len(progress.losses)
            display.update(trainer, budget, mean)
            if progress.step % 20 == 0:
                writer.add_scalar("train/psnr", psnr(mean), progress.step)
                writer.add_scalar("train/mean_square_error", error, progress.step)
            if curve is not None and due and budget.share(progress) >= due[0]:
                due = [share for share in due if share > budget.share(progress)]
                curve.add(progress.seconds, _views(trainer, curve.cameras))
                curve.write(folder)
            now = time.monotonic()
            if now - saved > SAVE_SECONDS:
                trainer.save(folder)
                saved = now
            if now - pictured > PICTURE_SECONDS:
                _picture(trainer, writer)
                pictured = time.monotonic()
        trainer.save(folder)
        if not interrupted():
            _picture(trainer, writer)
    return budget.share(progress) >= 1


def _views(trainer: Learner, cameras: Sequence[Cameras]) -> list[Rendering]:
    """What has been learned so far, seen by some cameras."""
    trainer.network.eval()
    render = trainer.renderer()
    renderings = [render(camera) for camera in cameras]
    trainer.network.train()
    return renderings


def _picture(trainer: Learner, writer: SummaryWriter) -> None:
    """A held-out view, if there is one, as TensorBoard picture."""
    scene = trainer.scene
    index = (scene.test or scene.train)[0]
    (rendering,) = _views(trainer, [scene.cameras[index]])
    both = torch.cat([scene.photographs[index].float() / 255, rendering.colour], dim=1)
    writer.add_image("truth and rendering", both.numpy(), trainer.progress.step, dataformats="HWC")


def scene_ball(scene: Scene) -> tuple[torch.Tensor, float]:
    """Centre and radius of what the training cameras look at, for the per-scene field."""
    cameras = scene.cameras[list(scene.train)]
    if scene.points is not None:
        centre = scene.points.xyz_world.median(0).values
        radius = (scene.points.xyz_world - centre).norm(dim=1).quantile(0.9).item()
        return centre, radius
    middle = 2 / (1 / cameras.near_far).sum(1)
    spots = cameras.position_world + cameras.forward_world * middle[:, None]
    centre = spots.mean(0)
    return centre, 0.75 * (cameras.position_world - centre).norm(dim=1).max().item()


@contextmanager
def _interruption() -> Iterator[Callable[[], bool]]:
    """Turns SIGINT and SIGTERM into a question that can be asked between steps; a second SIGINT interrupts at once."""
    asked = False

    def handler(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked = True

    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, old in before.items():
            signal.signal(number, old)
