"""Training on one scene."""

from __future__ import annotations

import logging
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import torch
from tensorboardX import SummaryWriter

from tidefield.config import Config
from tidefield.data.batches import Batch, Surfaces, draw_batch
from tidefield.data.scene import Scene
from tidefield.device import mixed_precision
from tidefield.model.network import Network, Tiles
from tidefield.model.renderer import Renderer, start_intervals
from tidefield.model.views import Encoded, Views
from tidefield.train.checkpoint import Progress, load_training, save_checkpoint
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


class Trainer:
    """A network, its optimiser and its place in the sequence of random batches.

    The same seed, scene and budget in steps give the same weights bit for bit on a CPU, however often training is
    stopped and resumed.
    """

    def __init__(self, config: Config, scene: Scene, seed: int, device: torch.device) -> None:
        self.config, self.scene, self.device = config, scene, device
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = Network(config.network).to(device)
        if self.network.field is not None:
            self.network.field.cover(*scene_ball(scene))
        self.generator = torch.Generator().manual_seed(seed)
        self.surfaces = Surfaces(scene)
        field = [p for name, p in self.network.named_parameters() if name.startswith("field.")]
        rest = [p for name, p in self.network.named_parameters() if not name.startswith("field.")]
        train = config.train
        groups = [{"params": rest, "peak": train.learning_rate}, {"params": field, "peak": train.field_learning_rate}]
        # A small epsilon: the field's gradients are tiny, and Adam's default would stop them.
        self.optimizer = torch.optim.Adam([g for g in groups if g["params"]], betas=(0.9, 0.99), eps=1e-12)
        self.progress = Progress()
        self.cameras = scene.cameras.to(device)

    @property
    def rays_per_step(self) -> int:
        return self.config.train.tiles * self.config.train.tile_px**2

    def resume(self, folder: Path) -> None:
        self.progress = load_training(folder, self.network, self.optimizer, self.generator)

    def save(self, folder: Path) -> None:
        save_checkpoint(folder, self.network, self.optimizer, self.generator, self.progress)

    def step(self, budget: Budget) -> float:
        """One step of gradient descent; returns the mean squared error of its colours."""
        start = time.perf_counter()
        rate = self._rate(budget.share(self.progress))
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["peak"]
        config = self.config
        batch = draw_batch(self.scene, self.surfaces, config.train, config.network.views, self.generator)
        loss, error = self._loss(batch)
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        value = error.item()
        self.progress.step += 1
        self.progress.seconds += time.perf_counter() - start
        self.progress.losses = [*self.progress.losses[-99:], value]
        return value

    def _loss(self, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
        network, device, side = self.network, self.device, self.config.train.tile_px
        batch = batch.to(device)
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
        train = self.config.train
        if train.structure_weight:
            loss = loss + train.structure_weight * structural(rendering, batch, side)
        if train.depth_weight:
            loss = loss + train.depth_weight * sparse_depth(rendering, batch, network, side)
        return loss, error

    def _rate(self, share: float) -> float:
        warm = min(1.0, (self.progress.step + 1) / self.config.train.warm_up)
        return warm * (FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * share)))


def train(trainer: Trainer, folder: Path, budget: Budget, display: Display) -> bool:
    """Train until the budget is used; save every minute and at the end, and on Ctrl-C or a polite kill.

    Returns:
        Whether the budget was used up; False after an interruption, from which `resume` goes on.
    """
    progress = trainer.progress
    writer = SummaryWriter(str(folder / "tensorboard"))
    saved = pictured = time.monotonic()
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


def _picture(trainer: Trainer, writer: SummaryWriter) -> None:
    """A held-out view, if there is one, as TensorBoard picture."""
    scene = trainer.scene
    index = (scene.test or scene.train)[0]
    trainer.network.eval()
    rendering = Renderer(trainer.network, scene, trainer.config, trainer.device)(scene.cameras[index])
    trainer.network.train()
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
