"""Training across scenes, for weights that work on a scene never seen before.

Under `torchrun` every process draws scenes of its own, and all learn from the mean of their gradients
(DistributedDataParallel).
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
import torch.distributed as dist
from rich.console import Console
from torch.nn.parallel import DistributedDataParallel

from tidefield.config import Config
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.evaluation.curves import make_curve
from tidefield.files import completed_file
from tidefield.model.network import Network
from tidefield.model.renderer import Renderer
from tidefield.model.rendering import Render
from tidefield.synthetic import CATEGORIES, Flight
from tidefield.train.loop import Trainer, cosine_rate, groups_of
from tidefield.train.objective import Objective
from tidefield.train.stream import Recipe, Source, make

VIEWS = {4: 0.2, 5: 0.35, 6: 0.2, 8: 0.15, 10: 0.06, 12: 0.04}
"""Neighbours of a step's tiles, and how often: what deployment may have, the cheap ones more often."""
LEAST_ERROR = 1e-5
"""Mean squared error (50 dB) below which a batch counts less and less."""
VALIDATION_FILE = "validation.json"
VALIDATION_STEPS = 500
VALIDATION_WIDTH = 224


def together() -> bool:
    """Whether several processes train together."""
    return dist.is_available() and dist.is_initialized()


def processes() -> int:
    """How many train together; 1 for one alone."""
    return dist.get_world_size() if together() else 1


def leads() -> bool:
    """Whether this process writes and tells what is learned: the first one does."""
    return not together() or dist.get_rank() == 0


def own_seed(seed: int) -> int:
    """A seed of this process's own."""
    return seed + (1_000_003 * dist.get_rank() if together() else 0)


def join(device: torch.device) -> torch.device:
    """Take part in what `torchrun` started, if it did; returns where this process computes."""
    if "LOCAL_RANK" not in os.environ:
        return device
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    dist.barrier()
    return device


def validation_scenes(folder: Path, real: Sequence[Path], console: Console) -> dict[str, Scene]:
    """A procedural scene of each kind, that no stream has, and the real ones, by kind."""
    if not leads():
        dist.barrier()  # the first process makes them
    scenes = {}
    for number, category in enumerate(CATEGORIES):
        path = folder / "validation" / category
        if not path.exists():
            console.print(f"Making a scene to validate on: {category}", highlight=False)
            make(Recipe(category, (1 << 31) + number, 16, 224, Flight(), ()), path)
        scenes[category] = load_scene(path)
    if together() and leads():
        dist.barrier()
    return scenes | {path.resolve().name: load_scene(path, width=VALIDATION_WIDTH) for path in real}


class Pretrainer(Trainer):
    """Trains the paper's network on one scene after the other.

    Args:
        config: network and training.
        stream: of scenes; different ones for every process.
        shown: a scene for pictures; nothing is learned from it.
        seed: of weights and batches.
        device: where to compute.
    """

    network: Network

    def __init__(self, config: Config, stream: Source, shown: Scene, seed: int, device: torch.device) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = Network(config.network).to(device)
        self.config, self.stream, self.seed = config, stream, own_seed(seed)
        super().__init__(network, groups_of(network, config.train), shown, self.seed, device, (0.9, 0.99), 1e-12)
        objective = Objective(network, config.train)
        # Of a network without a field, what only acts between views (eq. 6) has no gradient where one view sees.
        self.objective = DistributedDataParallel(objective, find_unused_parameters=True) if together() else objective

    @property
    def leads(self) -> bool:
        return leads()

    @property
    def rays_per_step(self) -> int:
        return processes() * self.config.train.tiles * self.config.train.tile_px**2

    def rate(self, share: float) -> float:
        return cosine_rate(self.progress.step, share, self.config.train.warm_up)

    def loss(self) -> tuple[torch.Tensor, torch.Tensor]:
        drawn = self.stream.draw(self.progress.step, self.generator)
        shares = torch.tensor(list(VIEWS.values()))
        views = list(VIEWS)[int(torch.multinomial(shares, 1, generator=self.generator))]
        loss, error = self.objective(drawn.scene, drawn.surfaces, drawn.cameras, views, self.generator)
        # Every scene counts alike: the gradient is that of decibels. Otherwise the scenes that can be foretold least
        # (trees, brighton_beach) have a hundred times the weight of bare mud, and nothing is learned from it.
        return loss / (error.detach() + LEAST_ERROR), error

    def renderer(self) -> Render:
        return Renderer(self.network, self.scene, self.config, self.device)

    def agreed(self, stop: bool) -> bool:
        if not together():
            return stop
        asked = torch.tensor([float(stop)], device=self.device)
        dist.all_reduce(asked, dist.ReduceOp.MAX)
        return bool(asked > 0)

    def resume(self, folder: Path) -> None:
        super().resume(folder)
        if together():
            # The checkpoint holds the leader's random state; the others must not draw what it draws.
            self.generator.manual_seed(self.seed + self.progress.step)


class Validation:
    """Quality on scenes that nothing is learned from, by kind, now and then while training.

    Args:
        scenes: by kind.
        folder: of the run; what is in its validation.json is continued.
    """

    def __init__(self, scenes: Mapping[str, Scene], folder: Path) -> None:
        self.scenes, self.file = scenes, folder / VALIDATION_FILE
        self.curves = {kind: make_curve(scene, smaller=1) for kind, scene in scenes.items()}
        self.points: list[dict] = json.loads(self.file.read_text(encoding="utf-8")) if self.file.is_file() else []

    def __call__(self, learner: Trainer, share: float) -> None:
        step = learner.progress.step
        if not learner.leads or (step % VALIDATION_STEPS and share < 1):
            return
        assert isinstance(learner, Pretrainer)
        learner.network.eval()
        psnr = {}
        for kind, curve in self.curves.items():
            render = Renderer(learner.network, self.scenes[kind], learner.config, learner.device)
            curve.add(learner.progress.seconds, [render(camera) for camera in curve.cameras])
            psnr[kind] = curve.points[-1][1]
        learner.network.train()
        self.points = [point for point in self.points if point["step"] < step]
        self.points.append({"step": step, "seconds": learner.progress.seconds, "psnr": psnr})
        with completed_file(self.file, overwrite=True) as partial:
            partial.write_text(json.dumps(self.points), encoding="utf-8")
