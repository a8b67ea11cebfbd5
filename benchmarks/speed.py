"""Rays per second of `paper` and of `swift`, where their time goes, and how near they come to the machine's ceilings.

What is counted:
- A ray is a pixel, of a training tile or of a rendering. Networks are fresh: weights change no timing.
- Rates are medians of several runs after a warm-up. Rendering has its features encoded beforehand; encoding is timed
  apart, as the mean over a scene's photographs.
- Arithmetic: matrix products, convolutions and attention, forwards and, in training, backwards. Elementwise work is
  left out, so shares of the ceilings are lower bounds.
- Copies: what encoding, gathering, aggregation, ray transformer, colour and compositing hand on, written once and read
  once, forwards only. A lower bound, too: what lies between, and gradients, come on top.
- Stages are timed in runs of their own, because on a GPU it takes a pause after each.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from benchmarks.ceilings import Ceilings, measure_ceilings, timed
from benchmarks.stages import ENCODING, flops_of, watched
from tidefield.config import Config
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.model.renderer import Renderer
from tidefield.train.loop import Budget, SceneTrainer

SQUARE_PX = 32
"""Renderings are timed on whole squares of so many pixels, as tiles are."""
BUDGET = Budget(steps=1000)


@dataclass(frozen=True)
class Effort:
    """How much is spent on each figure: runs until so many seconds have passed, within limits on their number."""

    seconds: float = 10.0
    least: int = 3
    most: int = 20
    rays: int = 4096
    """Of the smallest part of a photograph that is rendered; a faster machine renders more of it."""


QUICK = Effort(seconds=0.1, least=1, rays=1024)


@dataclass(frozen=True)
class Pace:
    """How fast one kind of work goes.

    Attributes:
        rays_per_second: median of the runs.
        runs: how many.
        rays: of each run.
        flops_per_ray: counted arithmetic.
        bytes_per_ray: counted copies.
        seconds_per_ray: by stage.
    """

    rays_per_second: float
    runs: int
    rays: int
    flops_per_ray: float
    bytes_per_ray: float
    seconds_per_ray: dict[str, float]


@dataclass(frozen=True)
class Speed:
    """Of one preset; encoding is that of a whole photograph, for rendering."""

    training: Pace
    rendering: Pace
    encoding_seconds: float


def measure_speed(
    scene: Scene, configs: Mapping[str, Config], device: torch.device, effort: Effort, say: Callable[[str], object]
) -> dict[str, Any]:
    """Everything, as JSON.

    Args:
        scene: to train on and to render.
        configs: by preset; `paper` and `swift` are compared if both are there.
        device: where to compute.
        effort: spent on each figure.
        say: told what is going on.
    """
    say("ceilings of this machine ...")
    ceilings = measure_ceilings(device, effort.seconds / 8)
    speeds = {}
    for preset, config in configs.items():
        trainer = SceneTrainer(config, scene, 0, device)
        say(f"{preset}: training ...")
        training = measure_training(trainer, effort)
        say(f"{preset}: rendering ...")
        speeds[preset] = Speed(training, *measure_rendering(trainer, effort))
    ratios = {}
    if {"paper", "swift"} <= speeds.keys():
        for kind in ("training", "rendering"):
            paper, swift = (getattr(speeds[preset], kind).rays_per_second for preset in ("paper", "swift"))
            ratios[kind] = swift / paper
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        "threads": torch.get_num_threads(),
        "photographs": {"count": len(scene.names), "width": int(scene.cameras.size_px[:, 0].max())},
        "ceilings": asdict(ceilings),
        "presets": {preset: asdict(speed) | _shares(speed, ceilings) for preset, speed in speeds.items()},
        "ratios": ratios,
    }


def measure_training(trainer: SceneTrainer, effort: Effort) -> Pace:
    """Steps of training, batches included."""
    device, rays = trainer.device, trainer.rays_per_step
    for index in trainer.scene.train:
        trainer.surfaces[index]  # made once in a training
    trainer.step(BUDGET)
    times = _repeated(lambda: trainer.step(BUDGET), device, effort)
    with watched(trainer.network, device, trainer.optimizer) as clock:
        for _ in range(effort.least):
            trainer.step(BUDGET)
    return Pace(
        rays_per_second=rays / statistics.median(times),
        runs=len(times),
        rays=rays,
        flops_per_ray=flops_of(lambda: trainer.step(BUDGET)) / rays,
        bytes_per_ray=2 * sum(clock.bytes.values()) / (rays * effort.least),
        seconds_per_ray={stage: seconds / (rays * effort.least) for stage, seconds in clock.seconds.items()},
    )


def measure_rendering(trainer: SceneTrainer, effort: Effort) -> tuple[Pace, float]:
    """A part of a photograph's camera, and the seconds that encoding one photograph takes."""
    device, scene, network = trainer.device, trainer.scene, trainer.network.eval()
    renderer = Renderer(network, scene, trainer.config, device)
    camera = scene.cameras[(scene.test or scene.train)[0]]
    first = window(camera, effort.rays)
    renderer(first)
    rate = first.width * first.height / timed(lambda: renderer(first), device)
    view = window(camera, max(effort.rays, round(rate * effort.seconds / effort.least)))
    rays = view.width * view.height
    times = _repeated(lambda: renderer(view), device, effort)
    anew = Renderer(network, scene, trainer.config, device)
    with watched(network, device) as clock:
        anew(view)
    encoding = clock.seconds.pop(ENCODING, 0.0)
    clock.bytes.pop(ENCODING, None)
    small = window(camera, SQUARE_PX**2)
    pace = Pace(
        rays_per_second=rays / statistics.median(times),
        runs=len(times),
        rays=rays,
        flops_per_ray=flops_of(lambda: renderer(small)) / (small.width * small.height),
        bytes_per_ray=2 * sum(clock.bytes.values()) / rays,
        seconds_per_ray={stage: seconds / rays for stage, seconds in clock.seconds.items()},
    )
    return pace, encoding / max(clock.photographs, 1)


def window(camera: Cameras, rays: int) -> Cameras:
    """The middle of a camera's image: whole squares, about so many rays, at least one square where there is room."""
    columns = max(1, min(camera.width, rays // SQUARE_PX) // SQUARE_PX)
    width = min(camera.width, columns * SQUARE_PX)
    rows = max(1, min(camera.height, rays // width) // SQUARE_PX)
    size = camera.size_px.new_tensor([[width, min(camera.height, rows * SQUARE_PX)]])
    corner = (camera.size_px - size) // 2
    return replace(camera, principal_px=camera.principal_px - corner, size_px=size)


def _repeated(action: Callable[[], object], device: torch.device, effort: Effort) -> list[float]:
    """Seconds of each run."""
    times: list[float] = []
    while len(times) < effort.least or (sum(times) < effort.seconds and len(times) < effort.most):
        times.append(timed(action, device))
    return times


def _shares(speed: Speed, ceilings: Ceilings) -> dict[str, dict[str, dict[str, float]]]:
    """Which part of each ceiling is reached."""
    shares = {}
    for kind, pace in (("training", speed.training), ("rendering", speed.rendering)):
        flops, copied = (pace.rays_per_second * x for x in (pace.flops_per_ray, pace.bytes_per_ray))
        shares[kind] = {
            "float32": flops / ceilings.float32_flops,
            "bfloat16": flops / ceilings.bfloat16_flops,
            "copy": copied / ceilings.copy_bytes,
        }
    return {"shares": shares}
