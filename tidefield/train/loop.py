"""Training: the loop, and the trainer of one scene."""

from __future__ import annotations

import logging
import math
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from rich.console import Console
from tensorboardX import SummaryWriter
from torch import nn

from tidefield.config import USUAL_SAMPLING, Budget, Config, Sampling
from tidefield.data.areas import Area, cut, select
from tidefield.data.depth_prior import DepthPriors
from tidefield.data.images import Progress
from tidefield.data.load import at_twice_the_size
from tidefield.data.matching import MATCHED_PX, Matcher
from tidefield.data.pyramid import Pyramid
from tidefield.data.scene import Scene
from tidefield.device import choose_precision
from tidefield.evaluation.curves import reduced_photograph
from tidefield.evaluation.metrics import psnr_from_mse
from tidefield.geometry.cameras import Cameras
from tidefield.model.network import Network, make_network
from tidefield.model.renderer import Renderer, as_given
from tidefield.model.rendering import Render, Rendering
from tidefield.processes import STOPPING, handled
from tidefield.progress import ProgressBar
from tidefield.recording import Recorder, moved
from tidefield.train.checkpoint import (
    CHECKPOINT_FILE,
    TrainingProgress,
    load_training,
    read_weights,
    save_checkpoint,
)
from tidefield.train.losses import BatchLoss, Inputs

log = logging.getLogger(__name__)

SAVE_SECONDS = 60.0
PICTURE_SECONDS, PICTURE_PX = 300.0, 400
FINAL_RATE = 0.02
"""Learning rate at the end, as a share of its peak; it falls along half a cosine."""
STEPS_EACH = 200
"""Steps in an area before the next one: each depth prior, which takes as long as a step where photographs are large, is
then used a dozen times."""
FIRST_TARGETS, STEPS_PER_TARGET = 4, 2
"""Photographs that the first step in an area draws from, and steps after which another one is drawn from as well: to
match the surface of one takes as long as some steps, and a minute would go by without any."""
ADAM = {"betas": (0.9, 0.99), "eps": 1e-12}
"""Of our networks. With Adam's usual epsilon of 1e-8, parameters with tiny gradients would hardly move."""
UNBOUNDED_RATE = 3e-3
"""Highest learning rate of encoders without norms: nothing bounds their features, and at a higher one these may grow
until nothing else is seen."""

Callback = Callable[["Trainer", float], None]
"""Called with the trainer and the share of the budget that is used."""


class Trainer(ABC):
    """A network, its optimiser and its position in the sequence of random batches.

    The same seed, scene and budget in steps give the same weights bit for bit on a CPU, however often training is
    stopped and resumed there. `learning_rate` is the peak; `adam` are further options of the optimiser; `share_of_rate`
    gives the share of the learning rate that a parameter has, by its name.
    """

    def __init__(
        self,
        network: nn.Module,
        learning_rate: float,
        scene: Scene,
        seed: int,
        device: torch.device,
        adam: dict[str, Any],
        share_of_rate: Callable[[str], float] = lambda _: 1.0,
    ) -> None:
        self.network, self.learning_rate, self.scene, self.device = network, learning_rate, scene, device
        self.generator = torch.Generator().manual_seed(seed)
        # Fused: a GPU takes all parameters at once.
        fused = True if device.type == "cuda" else None
        groups = [
            {"params": [parameter for _, parameter in members], "share": share}
            for share, members in groupby(network.named_parameters(), lambda named: share_of_rate(named[0]))
        ]
        self.optimizer = torch.optim.Adam(groups, fused=fused, **adam)
        self.progress = TrainingProgress()

    is_main_process = True
    """Whether this process writes what is learned: one of several that train together does."""

    def prepare(self, progress: Progress | None = None) -> None:  # noqa: B027 - there may be nothing to read
        """Read what steps need besides the scene; otherwise the first one does, without showing progress."""

    @property
    @abstractmethod
    def rays_per_step(self) -> int:
        """Rays that a step learns from."""

    @abstractmethod
    def rate(self, share: float) -> float:
        """Learning rate as a share of its peak when this share of the budget is used."""

    @abstractmethod
    def backward(self) -> torch.Tensor:
        """Set the gradients of the next batch's loss; returns the mean squared error of its colours."""

    def draw_ahead(self) -> None:  # noqa: B027 - a batch may be drawn when it is needed
        """Draw the batch of the next step, while a GPU is at work on this one."""

    @property
    def random_state(self) -> torch.Tensor:
        """State of the generator before the batch of the next step was drawn."""
        return self.generator.get_state()

    @abstractmethod
    def renderer(self, sampling: Sampling = USUAL_SAMPLING) -> Render:
        """The trained method so far; the network is in evaluation mode."""

    def views(self, cameras: Sequence[Cameras]) -> list[Rendering]:
        """Render some cameras with what has been learned so far."""
        self.network.eval()
        render = self.renderer()
        renderings = [render(camera) for camera in cameras]
        self.network.train()
        return renderings

    def should_stop(self, asked: bool) -> bool:
        """Whether to stop: where several processes train together, when one of them is asked to."""
        return asked

    @property
    def precision(self) -> torch.dtype:
        """Of convolutions and layers; what was chosen on a CPU stays, since it changes what is learned."""
        if self.device.type != "cpu":
            return choose_precision(self.device)
        if self.progress.cpu_precision is None:
            chosen = choose_precision(self.device)
            self.progress.cpu_precision = "bfloat16" if chosen == torch.bfloat16 else "float32"
        return {"bfloat16": torch.bfloat16, "float32": torch.float32}[self.progress.cpu_precision]

    def resume(self, folder: Path) -> None:
        """Continue with a run's checkpoint; a run that was ended before its first one starts again."""
        if not (folder / CHECKPOINT_FILE).exists():
            log.info(f"{folder} was ended before it saved anything: it starts again")
            return
        self.progress = load_training(folder, self.network, self.optimizer, self.generator)

    def save(self, folder: Path) -> None:
        save_checkpoint(folder, self.network, self.optimizer, self.random_state, self.progress)

    def step(self, budget: Budget) -> float:
        """One step of gradient descent; returns the mean squared error of its colours.

        Raises:
            FloatingPointError: that or the gradient is not finite: the weights are not to be saved.
        """
        start = time.perf_counter()
        rate = self.rate(budget.share(self.progress.step, self.progress.seconds))
        for group in self.optimizer.param_groups:
            group["lr"] = rate * self.learning_rate * group["share"]
        error = self.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        self.progress.step += 1
        self.draw_ahead()
        value, length = torch.stack([error, norm]).tolist()  # together: a GPU is waited for once
        self.progress.seconds += time.perf_counter() - start
        if not (math.isfinite(value) and math.isfinite(length)):
            raise FloatingPointError(
                f"the loss is {value} and the norm of its gradient {length} at step {self.progress.step}; this is a "
                "defect of the program"
            )
        self.progress.losses = [*self.progress.losses[-99:], value]
        return value


@dataclass(frozen=True)
class OpenArea:
    """An area of a scene that is being learned from.

    Attributes:
        number: among the scene's areas.
        area: its part of the scene.
        priors: depth priors of the part.
    """

    number: int
    area: Area
    priors: DepthPriors


class SceneTrainer(Trainer):
    """Trains a network over neighbouring views on tiles of one scene's photographs.

    A large scene is learned area by area, `STEPS_EACH` steps in one; the depth priors of one area are in memory.

    `seed` is that of weights and batches; `weights` is a file to start from, None for random ones; `areas` are those of
    the scene, by `data.areas.cut` if not given.
    """

    network: Network
    _open: OpenArea | None
    _doubled: Scene | None
    _ahead: tuple[torch.Tensor, Inputs] | None
    """The state of the generator before a batch was drawn, and the batch."""

    def __init__(
        self,
        config: Config,
        scene: Scene,
        seed: int,
        device: torch.device,
        weights: Path | None = None,
        areas: Sequence[tuple[int, ...]] | None = None,
    ) -> None:
        scene = as_given(scene, config)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = make_network(config.network).to(device)
        if weights is not None:
            read_weights(weights, network)
        rate, bounded = config.train.learning_rate, config.network.encoder.instance_norm
        encoder = 1.0 if bounded or rate <= UNBOUNDED_RATE else UNBOUNDED_RATE / rate

        def share_of_rate(parameter: str) -> float:
            return encoder if parameter.startswith("encoder.") else 1.0

        super().__init__(network, rate, scene, seed, device, ADAM, share_of_rate)
        self.config, self.areas = config, areas or cut(scene)
        self._seed, self._open = seed, None
        self._prepared, self._doubled, self._ahead = False, None, None
        self.batch_loss: nn.Module = BatchLoss(network, config.train)
        self._recorder: Recorder[Inputs, tuple[torch.Tensor, tuple[torch.Tensor | None, ...]]] | None = None
        # Whole photographs are encoded once for all tiles that read them: their number changes.
        if device.type == "cuda" and config.train.crop_px is not None:
            self._recorder = Recorder(self._gradients, device)

    @property
    def rays_per_step(self) -> int:
        return self.config.train.tiles * self.config.train.tile_px**2

    def rate(self, share: float) -> float:
        """Up in a line, down half a cosine."""
        warm = min(1.0, (self.progress.step + 1) / self.config.train.warm_up)
        return warm * (FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * share)))

    def draw(self) -> Inputs:
        """Draw the next batch, on the CPU."""
        own, views = self.open_area(), self.config.network.views
        part = own.area
        drawn_from = part.scene, own.priors, views, self.generator, self._targets(part), part.doubled
        return Inputs.draw(self.network, self.config.train, *drawn_from)

    def _targets(self, area: Area) -> list[int]:
        """The photographs of an area that the next step draws from: a few at first, then more and more."""
        step = self.progress.step
        turn, within = (0, step) if len(self.areas) == 1 else divmod(step, STEPS_EACH)
        seed = self.generator.initial_seed()  # of a run that is continued, too: its state has it
        order = torch.randperm(len(area.targets), generator=torch.Generator().manual_seed(seed + turn))
        return [area.targets[k] for k in order[: FIRST_TARGETS + within // STEPS_PER_TARGET].tolist()]

    def loss(self, inputs: Inputs) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the loss of a batch on the network's device, and the mean squared error of its colours."""
        return self.batch_loss(inputs, self.precision)

    def backward(self) -> torch.Tensor:
        inputs = self.draw() if self._ahead is None else self._ahead[1]
        self._ahead = None
        if self._recorder is None:
            error, gradients = self._gradients(moved(inputs, self.device))
        else:
            error, gradients = self._recorder(inputs, inputs.behind is None)
        for parameter, gradient in zip(self.network.parameters(), gradients, strict=True):
            parameter.grad = gradient
        return error

    def _gradients(self, inputs: Inputs) -> tuple[torch.Tensor, tuple[torch.Tensor | None, ...]]:
        """Compute the error of a batch's colours, and the gradients of its loss."""
        self.optimizer.zero_grad()
        loss, error = self.loss(inputs)
        loss.backward()
        return error.detach(), tuple(parameter.grad for parameter in self.network.parameters())

    def draw_ahead(self) -> None:
        # A CPU has nothing to overlap it with, and the batch after the last step would be drawn for nothing.
        if self.device.type == "cpu":
            return
        state = self.generator.get_state()
        self._ahead = state, self.draw()

    @property
    def random_state(self) -> torch.Tensor:
        return super().random_state if self._ahead is None else self._ahead[0]

    def prepare(self, progress: Progress | None = None) -> None:
        if not self._prepared and self.network.config.has("doubled photographs"):
            self._doubled = at_twice_the_size(self.scene, progress)
        self._prepared = True

    def open_area(self) -> OpenArea:
        """Open the area that the next step learns from; what the one before needed is given back."""
        turn, place = divmod(self.progress.step // STEPS_EACH, len(self.areas))
        order = torch.randperm(len(self.areas), generator=torch.Generator().manual_seed(self._seed + turn))
        number = int(order[place])
        if self._open is None or self._open.number != number:
            if self._open is not None:
                self._open = None
                self.scene.photographs.release()
                if self._doubled is not None:
                    self._doubled.photographs.release()
            self.prepare()
            whole, targets = len(self.areas) == 1, self.areas[number]
            area = (Area if whole else select)(self.scene, targets, self._doubled)
            match = None
            if self.network.config.has("matched surface"):
                pyramid = Pyramid(area.scene, area.doubled)
                match = Matcher(area.scene, pyramid, most_px=MATCHED_PX, finer=True, device=self.device)
            self._open = OpenArea(number, area, DepthPriors(area.scene, match=match))
        return self._open

    def renderer(self, sampling: Sampling = USUAL_SAMPLING) -> Render:
        return Renderer(self.network, self.scene, self.config, self.device, sampling)


def train(
    trainer: Trainer, folder: Path, budget: Budget, console: Console, callback: Callback | None = None
) -> int | None:
    """Train until the budget is used; save every minute, at the end, and on Ctrl-C, SIGTERM or SIGHUP.

    `callback` is called after every step; its time does not count.

    Returns:
        A signal that came, after which `resume` continues what is left; None if the budget was used up without one.
    """
    progress = trainer.progress

    def used() -> float:
        return budget.share(progress.step, progress.seconds)

    with ProgressBar(console, "Reading photographs at twice the size") as bar:
        trainer.prepare(bar)
    writer = SummaryWriter(str(folder / "tensorboard"), write_to_disk=trainer.is_main_process)
    saved = pictured = time.monotonic()
    with writer, ProgressBar(console, "Training") as bar, _stop_requests() as stopped_by:
        while used() < 1 and not trainer.should_stop(stopped_by() is not None):
            error = trainer.step(budget)
            mean = sum(progress.losses) / len(progress.losses)
            rays, psnr = trainer.rays_per_step * progress.step / max(progress.seconds, 1e-9), psnr_from_mse(mean)
            bar(used(), 1, f"step {progress.step}  loss {mean:.5f}  PSNR {psnr:.2f} dB  {rays:,.0f} rays/s")
            if progress.step % 20 == 0:
                writer.add_scalar("train/psnr", psnr, progress.step)
                writer.add_scalar("train/mean_square_error", error, progress.step)
            if callback is not None:
                callback(trainer, used())
            now = time.monotonic()
            if not trainer.is_main_process:
                continue
            if now - saved > SAVE_SECONDS:
                trainer.save(folder)
                saved = now
            if now - pictured > PICTURE_SECONDS and stopped_by() is None:
                _write_picture(trainer, writer)
                pictured = time.monotonic()
        if trainer.is_main_process:
            trainer.save(folder)
            if stopped_by() is None:
                _write_picture(trainer, writer)
    # Without a signal of its own, a process stops with the others of a distributed training.
    return stopped_by() or (None if used() >= 1 else signal.SIGINT)


def _write_picture(trainer: Trainer, writer: SummaryWriter) -> None:
    """Write a held-out view, if there is one, as TensorBoard picture: a small one, as it takes time from nobody's
    budget."""
    scene = trainer.scene
    index = (scene.test or scene.train)[0]
    camera = scene.cameras[index]
    share = min(1.0, PICTURE_PX / max(camera.width, camera.height))
    small = camera.resized(*(max(1, round(share * side)) for side in (camera.width, camera.height)))
    (rendering,) = trainer.views([small])
    both = torch.cat([reduced_photograph(scene, index, small).float() / 255, rendering.colour], dim=1)
    writer.add_image("truth and rendering", both.numpy(), trainer.progress.step, dataformats="HWC")


@contextmanager
def _stop_requests() -> Iterator[Callable[[], int | None]]:
    """Turn SIGINT, SIGTERM and SIGHUP into a question to ask between steps; a second SIGINT interrupts at once."""
    first: int | None = None

    def handler(number: int, frame: FrameType | None) -> None:
        nonlocal first
        if first is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        first = first or number

    with handled(handler, signal.SIGINT, *STOPPING):
        yield lambda: first
