"""What several commands begin with: a budget, a scene, a run or trained weights as a method."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from tidefield.config import PRESETS, config_to_json
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.device import choose_device
from tidefield.errors import RunError
from tidefield.methods import trained, zero_shot
from tidefield.model.rendering import Render as RenderMethod
from tidefield.options import Evaluate, Length, Render
from tidefield.progress import ProgressBar
from tidefield.train.checkpoint import read_run
from tidefield.train.loop import Budget
from tidefield.train.weights import given_or_shipped

DEFAULT_MINUTES = 10.0


def budget_of(length: Length) -> Budget:
    """What is asked for; ten minutes if nothing is.

    Raises:
        RunError: both minutes and steps are.
    """
    if length.minutes is not None and length.steps is not None:
        raise RunError("both --minutes and --steps are given: expected one of them; leave one out")
    if length.minutes is None and length.steps is None:
        return Budget(minutes=DEFAULT_MINUTES)
    return Budget(length.steps, length.minutes)


def load(scene: Path, width: int | None, allow_missing: bool, console: Console) -> Scene:
    """Read a scene, with progress while photographs are decoded."""
    with ProgressBar(console, "Reading photographs") as meter:
        return load_scene(scene, width=width, allow_missing=allow_missing, progress=meter)


@contextmanager
def opened(options: Evaluate | Render, console: Console) -> Iterator[tuple[Scene, RenderMethod, dict[str, Any]]]:
    """The scene and the method that are asked for, while the block lasts, and what made it, for the record."""
    where, source = choose_device(options.device), options.source
    if options.zero.zero_shot:
        width = options.width if isinstance(options, Evaluate) else None
        scene, config = load(source, width, options.allow_missing, console), PRESETS[options.zero.preset]
        view, digest = zero_shot(config, given_or_shipped(options.zero.weights, options.zero.preset), scene, where)
        yield scene, view, {**config_to_json(config), "weights": digest}
        return
    if isinstance(options, Evaluate) and options.width is not None:
        raise RunError("--width belongs to --method and --zero-shot: a run has its own width; leave it out")
    run = read_run(source)
    scene = load(run.scene, run.width, options.allow_missing, console)
    with trained(source, run, scene, where) as (view, progress):
        done = {"steps": progress.step, "seconds": progress.seconds}
        yield scene, view, {**config_to_json(run.config), "seed": run.seed, "weights": run.weights, "trained": done}
