"""Rays per second of `paper` and of `swift`, where their time goes, and their share of the machine's peak arithmetic.

What is counted:
- A ray is a pixel, of a training tile or of a rendering. Networks are fresh: weights change no timing.
- Rates are medians of several runs after a warm-up. Rendering has its features encoded beforehand; encoding is timed
  separately, as the mean over a scene's photographs.
- Arithmetic: matrix products, convolutions and attention, forwards and, in training, backwards. Elementwise work is
  left out, so shares of the peak are lower bounds.
- Stages are timed in runs of their own, by forward hooks on the network's parts. Everything between them (batches,
  samples, reading features, compositing, the loss) is "rest". What cores otherwise do in parallel is done one after
  another there, by all cores together: a clock can follow only one thing at a time.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.records import say, show
from tidefield.compare.tables import NOTHING, Table
from tidefield.config import PRESETS, Config
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.device import choose_device
from tidefield.errors import RunError
from tidefield.files import write_json
from tidefield.geometry.cameras import Cameras
from tidefield.machine import describe
from tidefield.model.renderer import Renderer
from tidefield.parallel import sequential
from tidefield.synthetic import make_survey, write_survey
from tidefield.train.loop import Budget, SceneTrainer

SPEED_FILE = "speed.json"
SQUARE_PX = 32
"""Renderings are timed on whole squares of so many pixels, as tiles are."""
BUDGET = Budget(steps=1000)
LARGEST_SIDE = 8192
"""Of the matrices whose product measures the peak arithmetic."""
ENCODING, REST = "encoding", "rest"
PARTS = {
    "Encoder": ENCODING,
    "Aggregate": "aggregation",
    "RayTransformer": "ray transformer",
    "ColourBlend": "colour",
}
"""Stages by the class names of the network's parts, or of their bases."""
STAGES = (*PARTS.values(), "backward", "optimiser", REST)


@dataclass(frozen=True)
class Effort:
    """How much is spent on each figure: runs until so many seconds have passed, within limits on their number."""

    seconds: float = 10.0
    least: int = 3
    most: int = 20
    rays: int = 4096
    """Of the smallest part of a photograph that is rendered; a faster machine renders more of it."""


QUICK = Effort(seconds=0.1, least=1, rays=1024)


def speed(
    runs: Path | None = None,
    scene: Path | None = None,
    width: int | None = None,
    device: str = "cpu",
    quick: bool = False,
) -> None:
    """Measure, print and store.

    Args:
        runs: Store the figures in this folder's speed.json.
        scene: Measure on this scene instead of the built-in one.
        width: Width of its photographs in pixels.
        device: auto, cpu, cuda, cuda:N or mps.
        quick: A few seconds, to check that it works; the figures are not meaningful.
    """
    if quick and runs is not None:
        raise RunError("--quick was given with --runs: such figures are not worth storing; leave one of them out")
    where = choose_device(device)
    with tempfile.TemporaryDirectory() as folder:
        loaded = _scene(scene, width, quick, Path(folder))
        configs = {name: PRESETS[name] for name in ("paper", "swift")}
        report = measure_speed(loaded, configs, where, QUICK if quick else Effort())
    options = [] if scene is None else ["--scene SCENE", *([] if width is None else [f"--width {width}"])]
    command = " ".join(["python -m benchmarks speed --runs RUNS", *options, f"--device {device}"])
    report |= {"command": command, **describe()}
    show(speed_tables(report))
    if runs is not None:
        write_json(runs / SPEED_FILE, report)


def _scene(folder: Path | None, width: int | None, quick: bool, work: Path) -> Scene:
    """The scene that is asked for, or the built-in one, made small."""
    if folder is not None:
        return load_scene(folder, width=width)
    if width is not None:
        raise RunError(
            "--width was given without --scene: the built-in scene has its size; name a scene, or leave it out"
        )
    os.environ["XDG_CACHE_HOME"] = str(work / "cache")
    survey = make_survey("river_mouths", seed=7, views=9 if quick else 16, width=64 if quick else 256)
    write_survey(survey, work / "scene")
    return load_scene(work / "scene")


def measure_speed(scene: Scene, configs: Mapping[str, Config], device: torch.device, effort: Effort) -> dict[str, Any]:
    """Everything, as JSON.

    Args:
        scene: to train on and to render.
        configs: of `paper` and `swift`.
        device: where to compute.
        effort: spent on each figure.
    """
    say("peak arithmetic of this machine ...")
    ceilings = {
        f"{name}_flops": product_rate(dtype, device, effort.seconds / 8)
        for name, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16))
    }
    presets: dict[str, dict[str, Any]] = {}
    for preset, config in configs.items():
        trainer = SceneTrainer(config, scene, 0, device)
        say(f"{preset}: training ...")
        training = measure_training(trainer, effort)
        say(f"{preset}: rendering ...")
        rendering, encoding_seconds = measure_rendering(trainer, effort)
        presets[preset] = {"training": training, "rendering": rendering, "encoding_seconds": encoding_seconds}
        presets[preset]["shares"] = {
            kind: {
                number: pace["rays_per_second"] * pace["flops_per_ray"] / ceilings[f"{number}_flops"]
                for number in ("float32", "bfloat16")
            }
            for kind, pace in (("training", training), ("rendering", rendering))
        }
    ratios = {
        kind: presets["swift"][kind]["rays_per_second"] / presets["paper"][kind]["rays_per_second"]
        for kind in ("training", "rendering")
    }
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        "threads": torch.get_num_threads(),
        "photographs": {"count": len(scene.names), "width": int(scene.cameras.size_px[:, 0].max())},
        "ceilings": ceilings,
        "presets": presets,
        "ratios": ratios,
    }


def speed_tables(speed: Mapping[str, Any]) -> list[Table]:
    """Rates and shares, stages, and the machine's peak."""
    presets, ceilings = speed["presets"], speed["ceilings"]
    rates: list[tuple[str, Callable[[Any], float], str]] = [
        ("Training, rays/s", lambda p: p["training"]["rays_per_second"], "{:,.0f}"),
        ("Rendering, rays/s, features encoded beforehand", lambda p: p["rendering"]["rays_per_second"], "{:,.0f}"),
        ("Encoding a photograph for rendering, s", lambda p: p["encoding_seconds"], "{:.3f}"),
    ]
    rows = []
    for title, read, style in rates:
        ratio = read(presets["swift"]) / read(presets["paper"])
        rows.append((title, *(style.format(read(presets[p])) for p in ("paper", "swift")), f"{ratio:.2f}"))
    for kind in ("training", "rendering"):
        for ceiling, title in (("float32", "float32 products"), ("bfloat16", "bfloat16 products")):
            shares = (f"{presets[p]['shares'][kind][ceiling]:.1%}" for p in ("paper", "swift"))
            rows.append((f"{kind.capitalize()}, share of the peak of {title}", *shares, ""))
    photographs = speed["photographs"]
    title = (
        f"{photographs['count']} photographs, {photographs['width']} px, {speed['device']}, {speed['threads']} threads"
    )
    limits = (
        ("float32 products", f"{ceilings['float32_flops'] / 1e9:,.0f} GFLOP/s"),
        ("bfloat16 products", f"{ceilings['bfloat16_flops'] / 1e9:,.0f} GFLOP/s"),
    )
    return [
        Table(title, ["", "paper", "swift", "swift / paper"], rows),
        _stage_table(presets),
        Table("Peak arithmetic of this machine, measured in the same run", ["", "measured"], limits),
    ]


def _stage_table(presets: Mapping[str, Any]) -> Table:
    kinds = [(preset, kind) for kind in ("training", "rendering") for preset in ("paper", "swift")]
    columns = [presets[preset][kind]["seconds_per_ray"] for preset, kind in kinds]
    stages = dict.fromkeys(stage for column in columns for stage in column)
    rows = [(stage, *(f"{1e6 * c[stage]:.1f}" if stage in c else NOTHING for c in columns)) for stage in stages]
    rows.append(("sum", *(f"{sum(column.values()) * 1e6:.1f}" for column in columns)))
    return Table(
        "Where the time goes, microseconds per ray, with all cores on one task after another",
        ["stage", *map(" ".join, kinds)],
        rows,
    )


def measure_training(trainer: SceneTrainer, effort: Effort) -> dict[str, Any]:
    """Steps of training, batches included."""
    device, rays = trainer.device, trainer.rays_per_step
    own = trainer.open_area()
    for index in own.area.targets:
        own.priors[index]  # made once in a training
    trainer.step(BUDGET)
    times = _repeated(lambda: trainer.step(BUDGET), device, effort)
    with stage_clock(trainer.network, device, trainer.optimizer) as clock:
        for _ in range(effort.least):
            trainer.step(BUDGET)
    return _pace(times, rays, flops_of(lambda: trainer.step(BUDGET)) / rays, clock, rays * effort.least)


def measure_rendering(trainer: SceneTrainer, effort: Effort) -> tuple[dict[str, Any], float]:
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
    fresh = Renderer(network, scene, trainer.config, device)
    with stage_clock(network, device) as clock:
        fresh(view)
    encoding = clock.seconds.pop(ENCODING, 0.0)
    small = window(camera, SQUARE_PX**2)
    flops_per_ray = flops_of(lambda: renderer(small)) / (small.width * small.height)
    return _pace(times, rays, flops_per_ray, clock, rays), encoding / max(clock.photographs, 1)


def _pace(times: list[float], rays: int, flops_per_ray: float, clock: Clock, clocked_rays: int) -> dict[str, Any]:
    """How fast runs of so many rays were, of which the clock had others."""
    return {
        "rays_per_second": rays / statistics.median(times),
        "runs": len(times),
        "rays": rays,
        "flops_per_ray": flops_per_ray,
        "seconds_per_ray": {stage: seconds / clocked_rays for stage, seconds in clock.seconds.items()},
    }


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


class Clock:
    """Charges every moment to one stage: of those that are running, the one that started last.

    Attributes:
        seconds: by stage, in the order of `STAGES` in the end.
        photographs: how many photographs, or crops, were encoded.
    """

    def __init__(self, device: torch.device, now: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.photographs = 0
        self._device, self._now = device, now
        self._running = [REST]
        self._since = now()

    def begin(self, stage: str) -> None:
        self._charge()
        self._running.append(stage)

    def end(self) -> None:
        """Stop the stage that started last."""
        self._charge()
        self._running.pop()

    def stop(self) -> None:
        self._charge()
        assert self._running == [REST], f"{self._running} never ended"
        self.seconds = {stage: self.seconds[stage] for stage in STAGES if stage in self.seconds}

    def _charge(self) -> None:
        synchronise(self._device)
        now = self._now()
        self.seconds[self._running[-1]] += now - self._since
        self._since = now


@contextmanager
def stage_clock(
    network: nn.Module, device: torch.device, optimizer: torch.optim.Optimizer | None = None
) -> Iterator[Clock]:
    """A clock that runs, stage by stage, as long as the block."""
    clock, backward = Clock(device), Tensor.backward

    def timed_backward(*args: Any, **kwargs: Any) -> None:
        clock.begin("backward")
        backward(*args, **kwargs)
        clock.end()

    def count(module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        clock.photographs += len(inputs[0])

    with ExitStack() as stack:
        stack.enter_context(sequential())
        stack.enter_context(patch.object(Tensor, "backward", timed_backward))
        for module in network.modules():
            if stage := next((PARTS[kind.__name__] for kind in type(module).__mro__ if kind.__name__ in PARTS), None):
                hooks = [
                    module.register_forward_pre_hook(lambda *_, stage=stage: clock.begin(stage)),
                    module.register_forward_hook(lambda *_: clock.end()),
                    *([module.register_forward_pre_hook(count)] if stage == ENCODING else []),
                ]
                for hook in hooks:
                    stack.callback(hook.remove)
        if optimizer is not None:
            stack.callback(optimizer.register_step_pre_hook(lambda *_: clock.begin("optimiser")).remove)
            stack.callback(optimizer.register_step_post_hook(lambda *_: clock.end()).remove)
        yield clock
        clock.stop()


def flops_of(action: Callable[[], object]) -> int:
    """Count multiplications and additions of an action's matrix products, convolutions and attention."""
    # The counter does not know attention on CPUs; in its plain form it is two matrix products.
    with sequential(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        action()
    return counter.get_total_flops()


def product_rate(dtype: torch.dtype, device: torch.device, seconds: float) -> float:
    """Measure the arithmetic per second in products of matrices as large as the time, about `seconds`, allows."""

    def best(side: int, seconds: float) -> float:
        """The shortest of as many runs as the time allows, at least one, after a warm-up."""
        matrix = torch.rand(side, side, device=device).to(dtype)
        timed(lambda: matrix @ matrix, device)
        times = [timed(lambda: matrix @ matrix, device)]
        while sum(times) < seconds:
            times.append(timed(lambda: matrix @ matrix, device))
        return min(times)

    side = 256
    while side < LARGEST_SIDE and best(side, 0.0) < seconds / 16:
        side *= 2
    return 2 * side**3 / best(side, seconds)


def synchronise(device: torch.device) -> None:
    """Wait until the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()


def timed(action: Callable[[], object], device: torch.device) -> float:
    """Seconds that an action takes."""
    synchronise(device)
    start = time.perf_counter()
    action()
    synchronise(device)
    return time.perf_counter() - start
