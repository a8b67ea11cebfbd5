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

from tidefield.config import Config, TrainConfig
from tidefield.data.depth_prior import DepthPriors
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.model.network import Network
from tidefield.model.renderer import Renderer
from tidefield.model.rendering import Render, Rendering
from tidefield.train.checkpoint import TrainingProgress, load_training, save_checkpoint
from tidefield.train.display import Display
from tidefield.train.losses import psnr
from tidefield.train.objective import Objective
from tidefield.train.weights import read_weights

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

    def share(self, progress: TrainingProgress) -> float:
        """How much of the budget is used, 0 to 1."""
        if self.steps is not None:
            return min(1.0, progress.step / max(self.steps, 1))
        assert self.minutes is not None, "a budget is steps or minutes"
        return min(1.0, progress.seconds / max(60 * self.minutes, 1e-9))


Callback = Callable[["Trainer", float], None]
"""Is told of the learner and of the share of the budget that is used."""


class Trainer(ABC):
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
        self.progress = TrainingProgress()
        self.cameras = scene.cameras.to(device)

    @property
    def leads(self) -> bool:
        """Whether it writes what has been learned: one of several processes that train together."""
        return True

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

    def views(self, cameras: Sequence[Cameras]) -> list[Rendering]:
        """What has been learned so far, seen by some cameras."""
        self.network.eval()
        render = self.renderer()
        renderings = [render(camera) for camera in cameras]
        self.network.train()
        return renderings

    def agreed(self, stop: bool) -> bool:
        """Whether to stop: where several processes train together, when one of them is asked to."""
        return stop

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


class SceneTrainer(Trainer):
    """Trains the paper's network on tiles of photographs and their neighbours."""

    network: Network

    def __init__(
        self, config: Config, scene: Scene, seed: int, device: torch.device, weights: Path | None = None
    ) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = Network(config.network).to(device)
        if weights is not None:
            read_weights(weights, network)
        if network.field is not None:
            network.field.cover(*scene_ball(scene))
        # A small epsilon: the field's gradients are tiny, and Adam's default would stop them.
        super().__init__(network, groups_of(network, config.train), scene, seed, device, (0.9, 0.99), 1e-12)
        self.config = config
        self.surfaces = DepthPriors(scene)
        self.objective = Objective(network, config.train)

    @property
    def rays_per_step(self) -> int:
        return self.config.train.tiles * self.config.train.tile_px**2

    def rate(self, share: float) -> float:
        return cosine_rate(self.progress.step, share, self.config.train.warm_up)

    def loss(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.objective(self.scene, self.surfaces, self.cameras, self.config.network.views, self.generator)

    def renderer(self) -> Render:
        return Renderer(self.network, self.scene, self.config, self.device)


def groups_of(network: Network, config: TrainConfig) -> list[dict[str, Any]]:
    """The network's parameters as the optimiser takes them: the per-scene field has a rate of its own."""
    field = [p for name, p in network.named_parameters() if name.startswith("field.")]
    rest = [p for name, p in network.named_parameters() if not name.startswith("field.")]
    return [{"params": rest, "peak": config.learning_rate}, {"params": field, "peak": config.field_learning_rate}]


def cosine_rate(step: int, share: float, warm_up: int) -> float:
    """Learning rate as a share of its peak: up in a line, down half a cosine."""
    warm = min(1.0, (step + 1) / warm_up)
    return warm * (FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * share)))


def train(trainer: Trainer, folder: Path, budget: Budget, display: Display, watch: Callback | None = None) -> bool:
    """Train until the budget is used; save every minute and at the end, and on Ctrl-C or a polite kill.

    Args:
        trainer: what to train.
        folder: the run's.
        budget: steps or minutes.
        display: where progress is shown.
        watch: called after every step; the clock stands still meanwhile.

    Returns:
        Whether the budget was used up; False after an interruption, from which `resume` goes on.
    """
    progress = trainer.progress
    writer = SummaryWriter(str(folder / "tensorboard"), write_to_disk=trainer.leads)
    saved = pictured = time.monotonic()
    with writer, display, _interruption() as interrupted:
        while budget.share(progress) < 1 and not trainer.agreed(interrupted()):
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
            if watch is not None:
                watch(trainer, budget.share(progress))
            now = time.monotonic()
            if not trainer.leads:
                continue
            if now - saved > SAVE_SECONDS:
                trainer.save(folder)
                saved = now
            if now - pictured > PICTURE_SECONDS:
                _picture(trainer, writer)
                pictured = time.monotonic()
        if trainer.leads:
            trainer.save(folder)
        if trainer.leads and not interrupted():
            _picture(trainer, writer)
    return budget.share(progress) >= 1


def _picture(trainer: Trainer, writer: SummaryWriter) -> None:
    """A held-out view, if there is one, as TensorBoard picture."""
    scene = trainer.scene
    index = (scene.test or scene.train)[0]
    (rendering,) = trainer.views([scene.cameras[index]])
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
