"""Pretraining across scenes, for weights that work on a scene never seen before.

Under `torchrun` every process draws its own scenes, and all learn from the mean of their gradients
(DistributedDataParallel).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
import torch.distributed as dist
from rich.console import Console
from torch.nn.parallel import DistributedDataParallel

from tidefield.config import Config
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.evaluation.curves import make_curve
from tidefield.files import read_json, write_json
from tidefield.model.renderer import Renderer
from tidefield.synthetic import CATEGORIES, Flight
from tidefield.train.loop import SceneTrainer, Trainer
from tidefield.train.losses import Inputs
from tidefield.train.stream import Recipe, Stream, make

VIEWS = {4: 0.2, 5: 0.35, 6: 0.2, 8: 0.15, 10: 0.06, 12: 0.04}
"""Numbers of neighbouring views of a step, and how often: what users may set, the cheap ones more often."""
HIGHEST_RATE = 3e-3
"""Of learning: less than one scene takes, since scenes change from step to step."""
LEAST_ERROR = 1e-5
"""Mean squared error (50 dB) below which a batch counts less and less."""
VALIDATION_FILE = "validation.json"
VALIDATION_STEPS = 500
VALIDATION_WIDTH = 224


def is_distributed() -> bool:
    """Whether several processes train together."""
    return dist.is_available() and dist.is_initialized()


def world_size() -> int:
    """Number of processes that train together."""
    return dist.get_world_size() if is_distributed() else 1


def is_main_process() -> bool:
    """Whether this process writes results and messages: the first one does."""
    return not is_distributed() or dist.get_rank() == 0


def process_seed(seed: int) -> int:
    """A seed that differs between processes."""
    return seed + (1_000_003 * dist.get_rank() if is_distributed() else 0)


def join(device: torch.device) -> torch.device:
    """Join the process group of `torchrun`, if there is one; returns this process's device."""
    if "LOCAL_RANK" not in os.environ:
        return device
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    dist.barrier()
    return device


def validation_scenes(folder: Path, real: Sequence[Path], console: Console) -> dict[str, Scene]:
    """Scenes to validate on: a procedural one of each category, that no stream draws, and the real ones, by name.

    Where an earlier scene has the name of a real one's folder, a number follows it. Processes that do not validate have
    no real ones.
    """
    if not is_main_process():
        dist.barrier()  # the first process makes them
    scenes = {}
    for number, category in enumerate(CATEGORIES):
        path = folder / "validation" / category
        if not path.exists():
            console.print(f"Making a scene to validate on: {category}", highlight=False)
            make(Recipe(category, (1 << 31) + number, 16, 224, Flight(), ()), path)
        scenes[category] = load_scene(path)
    if not is_main_process():
        return scenes
    if is_distributed():
        dist.barrier()
    for path in sorted(path.resolve() for path in real):  # named alike in whatever order
        name, number = path.name, 1
        while name in scenes:
            number += 1
            name = f"{path.name}-{number}"
        scenes[name] = load_scene(path, width=VALIDATION_WIDTH)
    return scenes


class Pretrainer(SceneTrainer):
    """Trains a network on one scene after the other.

    Args:
        config: network and training.
        stream: of scenes; different ones for every process.
        shown: a scene for TensorBoard pictures; nothing is learned from it.
        seed: of weights and batches.
        device: where to compute.
    """

    def __init__(self, config: Config, stream: Stream, shown: Scene, seed: int, device: torch.device) -> None:
        rate = min(config.train.learning_rate, HIGHEST_RATE)
        super().__init__(replace(config, train=replace(config.train, learning_rate=rate)), shown, seed, device)
        self.stream, self.seed, self.is_main_process = stream, process_seed(seed), is_main_process()
        self.generator.manual_seed(self.seed)
        if is_distributed():
            # What acts between views only (eq. 6) has no gradient where a single view sees.
            self.batch_loss = DistributedDataParallel(self.batch_loss, find_unused_parameters=True)
            self._recorder = None  # what processes send one another is not recorded

    @property
    def rays_per_step(self) -> int:
        return world_size() * super().rays_per_step

    def draw(self) -> Inputs:
        drawn = self.stream.draw(self.progress.step, self.generator, self.device)
        shares = torch.tensor(list(VIEWS.values()))
        views = list(VIEWS)[int(torch.multinomial(shares, 1, generator=self.generator))]
        given = drawn.scene, drawn.priors, views, self.generator
        return Inputs.draw(self.network, self.config.train, *given, doubled=drawn.doubled, cameras=drawn.cameras)

    def loss(self, inputs: Inputs) -> tuple[torch.Tensor, torch.Tensor]:
        loss, error = super().loss(inputs)
        # All scenes count alike: the gradient is that of decibels. Otherwise the least predictable scenes (trees,
        # brighton_beach) would have a hundred times the weight of bare mud, and nothing would be learned from it.
        return loss / (error.detach() + LEAST_ERROR), error

    def should_stop(self, asked: bool) -> bool:
        if not is_distributed():
            return asked
        any_asked = torch.tensor([float(asked)], device=self.device)
        dist.all_reduce(any_asked, dist.ReduceOp.MAX)
        return bool(any_asked > 0)

    def resume(self, folder: Path) -> None:
        super().resume(folder)
        if is_distributed():
            # The checkpoint holds the main process's random state; the others must not draw the same.
            self.generator.manual_seed(self.seed + self.progress.step)


class Validation:
    """Measures quality on scenes that nothing is learned from, every few hundred steps.

    Args:
        scenes: by name.
        folder: of the run; its validation.json is continued.
    """

    def __init__(self, scenes: Mapping[str, Scene], folder: Path) -> None:
        self.scenes, self.file = scenes, folder / VALIDATION_FILE
        self.curves = {name: make_curve(scene, smaller=1) for name, scene in scenes.items()}
        self.points: list[dict] = read_json(self.file) or []
        if not isinstance(self.points, list) or not all(
            isinstance(point, dict) and isinstance(point.get("step"), int) for point in self.points
        ):
            raise RunError(f"{self.file} is damaged: expected what training wrote; delete it to start it again")

    def resume(self, step: int) -> None:
        """Keep the points of the first steps: a training that was killed may have lost later ones."""
        self.points = [point for point in self.points if point["step"] <= step]

    def __call__(self, trainer: Trainer, share: float) -> None:
        step = trainer.progress.step
        if not trainer.is_main_process or (step % VALIDATION_STEPS and share < 1):
            return
        assert isinstance(trainer, Pretrainer)
        trainer.network.eval()
        psnr = {}
        for name, curve in self.curves.items():
            render = Renderer(trainer.network, self.scenes[name], trainer.config, trainer.device)
            curve.add(trainer.progress.seconds, [render(camera) for camera in curve.cameras])
            psnr[name] = curve.points[-1][1]
        trainer.network.train()
        self.resume(step - 1)
        self.points.append({"step": step, "seconds": trainer.progress.seconds, "psnr": psnr})
        write_json(self.file, self.points)
