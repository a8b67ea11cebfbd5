"""The methods that there are: floors that need no training, our network, classical NeRF, and nerfstudio's own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from tidefield.baselines import nearest, plane_sweep, sparse_depth
from tidefield.baselines.nerf import NerfTrainer
from tidefield.baselines.nerfstudio import driver
from tidefield.config import Config, NerfConfig, NerfstudioConfig
from tidefield.data.scene import Scene
from tidefield.model.network import Network
from tidefield.model.renderer import Renderer
from tidefield.model.rendering import Render
from tidefield.train.checkpoint import Run, TrainingProgress, load_network
from tidefield.train.loop import SceneTrainer, Trainer
from tidefield.train.weights import read_weights, sha256

UNTRAINED = {"plane-sweep": plane_sweep.make, "sparse-depth": sparse_depth.make, "nearest": nearest.make}


def make_trainer(
    config: Config | NerfConfig, scene: Scene, seed: int, device: torch.device, weights: Path | None = None
) -> Trainer:
    """What trains a method that lives in this process; our network may begin with trained weights."""
    if isinstance(config, NerfConfig):
        return NerfTrainer(config, scene, seed, device)
    return SceneTrainer(config, scene, seed, device, weights)


def zero_shot(config: Config, weights: Path, scene: Scene, device: torch.device) -> tuple[Render, str]:
    """A preset with trained weights on a scene that it was not trained on, and the weights' SHA-256.

    Raises:
        RunError: the weights are not there, or not the preset's.
    """
    network = Network(config.network).to(device)
    read_weights(weights, network)
    network.eval()
    return Renderer(network, scene, config, device), sha256(weights)


@contextmanager
def trained(folder: Path, run: Run, scene: Scene, device: torch.device) -> Iterator[tuple[Render, TrainingProgress]]:
    """A run as a method, while the block lasts, and how far it was trained.

    Raises:
        RunError: it has not been trained, or is damaged.
    """
    if isinstance(run.config, NerfstudioConfig):
        with driver.renderer(folder) as render:
            yield render, driver.progress_of(folder)
        return
    learner = make_trainer(run.config, scene, run.seed, device)
    progress = load_network(folder, learner.network)
    learner.network.eval()
    yield learner.renderer(), progress
