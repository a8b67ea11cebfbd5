"""Views of a scene without any training on it: how soon the first, how fast the others.

What is measured:
- The first: a `tidefield render` in a process of its own, from the scene on disk with nothing decoded before, to the
  written file.
- The others: one after the other along a flight, in one process.
- The same view of a survey alone, and among more and more copies of itself, in turns, so that a machine that becomes
  slower or faster affects all of them alike.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import torch
from tyro.conf import Positional

from benchmarks.records import HiddenRunner, show
from tidefield.compare.run import Runner, run_measured, tidefield
from tidefield.compare.tables import Table
from tidefield.config import PRESETS
from tidefield.data.images import Photographs
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.device import choose_device
from tidefield.files import write_json
from tidefield.geometry.cameras import Cameras
from tidefield.machine import describe
from tidefield.methods import zero_shot
from tidefield.model.renderer import in_turn
from tidefield.model.rendering import Render
from tidefield.render.camera_paths import make_trajectory
from tidefield.train.checkpoint import given_or_shipped

FRAMES_FILE = "frames.json"
FURTHER = 5
"""Views after the first, of whose times the median is taken."""
COUNTS, TURNS = (200, 2000), 7
"""Numbers of photographs with copies of the survey, and repetitions."""
FLIGHT_FRAMES = 240
"""Of a flight past all photographs, ten seconds long."""


def frames(
    scene: Positional[Path],
    runs: Path,
    preset: Literal["swift", "paper"] = "swift",
    weights: Path | None = None,
    width: int = 800,
    height: int | None = None,
    device: str = "cpu",
    run: HiddenRunner = run_measured,
) -> dict[str, Any]:
    """Measure all of it for a scene, print, store and return it.

    Args:
        scene: The scene, a survey.
        runs: Store the figures in this folder's frames.json.
        preset: Which network.
        weights: Its weights, of `tidefield pretrain`; those that came with Tidefield if not given.
        width: Of the views, in pixels.
        height: Of the views; in proportion to the width, as photographs are, if not given.
        device: auto, cpu, cuda, cuda:N or mps.
        run: Runs a command.
    """
    loaded, file, where = load_scene(scene), given_or_shipped(weights, preset), choose_device(device)
    index = (loaded.test or loaded.train)[0]
    name, own = loaded.names[index], loaded.cameras[index]
    height = height or round(width * own.height / own.width)
    first = _first(scene, name, preset, file, str(where), (width, height), runs, run)
    named = "" if weights is None else " --weights WEIGHTS"

    def view_of(other: Scene) -> Render:
        return zero_shot(PRESETS[preset], file, other, where)[0]

    flight = make_trajectory("cameras", loaded, frames=FLIGHT_FRAMES, width=width, height=height).cameras
    middle = len(flight) // 2
    shown = flight[middle : middle + 1]
    record = {
        "preset": preset,
        "device": str(where),
        "size_px": [width, height],
        "photographs": len(loaded.names),
        "first": first,
        "further_seconds": _further(view_of(loaded), flight[middle : middle + FURTHER + 1]),
        "by_photographs": _by_photographs(view_of, loaded, shown),
        "command": f"python -m benchmarks frames SCENE --runs RUNS --preset {preset}{named} --width {width} "
        f"--height {height} --device {where}",
        **describe(),
    }
    write_json(runs / FRAMES_FILE, record)
    show(frame_tables(record))
    return record


def frame_tables(frames: Mapping[str, Any]) -> list[Table]:
    """Seconds of views."""
    (width, height), first = frames["size_px"], frames["first"]
    rows = [
        ("the first, from the scene on disk, start of the program included", f"{first['seconds']:.1f}"),
        ("each further view along a flight, median", f"{frames['further_seconds']:.2f}"),
        *(
            (f"the same view repeatedly, of a survey of {count} photographs", f"{seconds:.2f}")
            for count, seconds in frames["by_photographs"].items()
        ),
    ]
    title = f"Zero-shot views of {width} x {height} px, {frames['preset']}, {frames['device']}"
    return [Table(title, ["view", "seconds"], rows)]


def _first(
    folder: Path,
    name: str,
    preset: str,
    weights: Path,
    device: str,
    size_px: tuple[int, int],
    runs: Path,
    run: Runner,
) -> dict[str, Any]:
    runs.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=runs, prefix=".frames-") as work:
        words = ["--zero-shot", "--preset", preset, "--weights", weights, "--camera", name, "--device", device]
        size = ["--width", size_px[0], "--height", size_px[1]]
        command = tidefield("render", folder, Path(work) / "frame.png", *words, *size, "--quiet")
        return asdict(run(command, {"XDG_CACHE_HOME": str(Path(work) / "cache")}))


def _further(view: Render, cameras: Cameras) -> float:
    ends = [time.perf_counter() for _ in in_turn(view, cameras)]
    return statistics.median(end - start for start, end in pairwise(ends))


def _by_photographs(view_of: Callable[[Scene], Render], scene: Scene, camera: Cameras) -> dict[str, float]:
    """Median seconds of a frame whose photographs have been encoded, by how many photographs there are."""
    views = {count: view_of(among_copies(scene, count)) for count in (len(scene.names), *COUNTS)}
    for view in views.values():
        view(camera)
    turns = [{count: _seconds(view, camera) for count, view in views.items()} for _ in range(TURNS)]
    return {str(count): statistics.median(turn[count] for turn in turns) for count in views}


def _seconds(view: Render, camera: Cameras) -> float:
    start = time.perf_counter()
    view(camera)
    return time.perf_counter() - start


def among_copies(scene: Scene, count: int) -> Scene:
    """The scene's survey in a grid of copies of itself, side by side, that has `count` photographs."""
    own, points = len(scene.names), scene.points
    copies = -(-count // own)
    side = math.isqrt(copies - 1) + 1
    spread = scene.cameras.position_world - scene.cameras.position_world.mean(0)
    across = torch.linalg.svd(spread, full_matrices=False).Vh[:2]  # the plane that was flown in
    steps = torch.tensor([[k % side, k // side] for k in range(copies)]).float()
    shifts = 6 * spread.norm(dim=1).max() * steps @ across
    which = torch.arange(count)
    pose = scene.cameras.T_world_camera[which % own].clone()
    pose[:, :, 3] += shifts[which // own]
    if points is not None:
        total = len(points.xyz_world)
        camera = torch.cat([points.camera_index + k * own for k in range(copies)])
        kept = camera < count
        points = replace(
            points,
            xyz_world=(points.xyz_world + shifts[:, None]).reshape(-1, 3),
            error_px=points.error_px.repeat(copies),
            point_index=torch.cat([points.point_index + k * total for k in range(copies)])[kept],
            camera_index=camera[kept],
            uv_px=points.uv_px.repeat(copies, 1)[kept],
        )
    return replace(
        scene,
        names=tuple(f"{k // own}/{scene.names[k % own]}" for k in range(count)),
        cameras=replace(scene.cameras[which % own], T_world_camera=pose),
        photographs=Photographs(tuple(scene.photographs[k % own] for k in range(count))),
        points=points,
        train=tuple(k * own + i for k in range(copies) for i in scene.train if k * own + i < count),
        test=(),
    )
