"""The one table of methods: what can be trained, rendered, evaluated and compared, under which name.

A new method is a line of `METHODS` and, unless it is another preset, its branch in one of the functions below. The
table itself imports nothing heavy, so that `--help` can list it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tidefield.config import (
    PRESETS,
    USUAL_SAMPLING,
    AnyConfig,
    Config,
    NerfConfig,
    NerfstudioConfig,
    OpensplatConfig,
    Sampling,
    vary,
)

if TYPE_CHECKING:
    import torch

    from tidefield.data.scene import Scene
    from tidefield.model.rendering import Render
    from tidefield.train.checkpoint import Run, TrainingProgress
    from tidefield.train.loop import Trainer

log = logging.getLogger(__name__)
Kind = Literal["preset", "zero-shot", "nerf", "nerfstudio", "opensplat", "untrained"]


@dataclass(frozen=True)
class Method:
    """One method.

    Attributes:
        kind: a preset of ours trained on the scene, one with trained weights as they are, classical NeRF, a method of
            nerfstudio, OpenSplat, or a baseline that needs no training.
        preset: of ours; None for the others.
        variant: of the preset; None for the preset itself.
    """

    kind: Kind
    preset: str | None = None
    variant: str | None = None


METHODS = {
    "tidefield": Method("preset", "swift"),
    "zero-shot": Method("zero-shot", "swift"),
    "paper": Method("preset", "paper"),
    "paper-seen": Method("preset", "paper", "neighbours-seen"),
    "paper-zero-shot": Method("zero-shot", "paper"),
    "nerf": Method("nerf"),
    "nerfacto": Method("nerfstudio"),
    "splatfacto": Method("nerfstudio"),
    "opensplat": Method("opensplat"),
    "plane-sweep": Method("untrained"),
    "sparse-depth": Method("untrained"),
    "sparse-depth-as-given": Method("untrained"),
    "nearest": Method("untrained"),
}


UNTRAINED_DEVICE = "cpu"
"""Where methods without training run."""


def names(*kinds: Kind) -> tuple[str, ...]:
    """Names of the methods of some kinds, in the order of the table; of all kinds if none is given."""
    return tuple(name for name, method in METHODS.items() if not kinds or method.kind in kinds)


def configuration(name: str, preset: str = "swift", program: Path | None = None) -> AnyConfig:
    """What a run of a trained method stores; `preset` is what "tidefield" stands for, `program` is OpenSplat.

    Raises:
        RunError: the method is OpenSplat, which is not there.
    """
    method = METHODS[name]
    if method.kind == "nerf":
        return NerfConfig()
    if method.kind == "nerfstudio":
        from tidefield.baselines.nerfstudio.environment import VERSION

        return NerfstudioConfig(name, VERSION)  # type: ignore[arg-type]
    if method.kind == "opensplat":
        from tidefield.baselines import opensplat

        return OpensplatConfig(opensplat.version(opensplat.find(program)))
    assert method.kind == "preset", f"{name} is not trained"
    config = PRESETS[preset if name == "tidefield" else str(method.preset)]
    return config if method.variant is None else vary(config, method.variant)


def untrained(name: str, scene: Scene, sampling: Sampling = USUAL_SAMPLING) -> Render:
    """A baseline that needs no training, with as many rays per pixel as asked for."""
    from tidefield.baselines import untrained
    from tidefield.data.load import at_twice_the_size
    from tidefield.model.rendering import with_rays

    make = {
        "plane-sweep": untrained.plane_sweep,
        "sparse-depth": untrained.sparse_depth,
        "sparse-depth-as-given": untrained.sparse_depth_as_given,
        "nearest": untrained.nearest,
    }[name]
    return with_rays(make(scene, at_twice_the_size(scene) if sampling.cones else None), sampling)


def make_trainer(
    config: Config | NerfConfig, scene: Scene, seed: int, device: torch.device, weights: Path | None = None
) -> Trainer:
    """The trainer of a method that trains in this process; a preset of ours may start from trained weights."""
    if isinstance(config, NerfConfig):
        from tidefield.baselines.nerf import NerfTrainer

        return NerfTrainer(config, scene, seed, device)
    from tidefield.train.loop import SceneTrainer

    return SceneTrainer(config, scene, seed, device, weights)


def zero_shot(
    config: Config, weights: Path, scene: Scene, device: torch.device, sampling: Sampling = USUAL_SAMPLING
) -> tuple[Render, str]:
    """A preset with trained weights on a scene it was not trained on, and the SHA-256 of the weights.

    Raises:
        RunError: the weights are missing, damaged, or another network's.
    """
    from tidefield.model.network import make_network
    from tidefield.model.renderer import Renderer
    from tidefield.train.checkpoint import read_weights, weights_sha256

    network = make_network(config.network).to(device)
    read_weights(weights, network)
    network.eval()
    return Renderer(network, scene, config, device, sampling), weights_sha256(weights)


@contextmanager
def trained(
    folder: Path, run: Run, scene: Scene, device: torch.device, sampling: Sampling = USUAL_SAMPLING
) -> Iterator[tuple[Render, TrainingProgress]]:
    """The method of a run, while the block lasts, and how far it was trained. Warns of a scene that was made anew.

    Raises:
        RunError: the run has not been trained, or is damaged.
    """
    from tidefield.model.rendering import with_rays
    from tidefield.train.checkpoint import is_of, load_network

    if not is_of(run, scene):
        log.warning(
            f"{scene.root} has other photographs or poses than when {folder} was trained, or holds out others: "
            "expected the same; train it again"
        )
    if isinstance(run.config, NerfstudioConfig):
        from tidefield.baselines.nerfstudio import driver

        with driver.renderer(folder, device) as render:
            yield with_rays(render, sampling), driver.progress_of(folder)
        return
    if isinstance(run.config, OpensplatConfig):
        from tidefield.baselines import opensplat

        render = with_rays(opensplat.renderer(folder, device), sampling)
        yield render, opensplat.progress_of(folder)
        return
    trainer = make_trainer(run.config, scene, run.seed, device)
    progress = load_network(folder, trainer.network)
    trainer.network.eval()
    yield trainer.renderer(sampling), progress
