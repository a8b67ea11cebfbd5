"""Frames of a scene that nothing was trained on: how soon the first, how fast the others, how steady they are.

What is measured:
- The first: a `tidefield render` of its own, from the scene on disk with nothing decoded before, to the written file.
- The others: one after the other along a flight, in one process.
- The same view of a survey that lies there once, and among more and more copies of itself, in turns, so that a machine
  that becomes slower or faster counts against none of them.
- How much consecutive frames of a flight differ where they show the same: the second one's colours are read where the
  first one's depths say that its pixels lie, and pixels at which the two frames' depths disagree are left out. The
  flight is so slow that the picture hardly moves from frame to frame: what resampling a moved picture makes different
  is small then, and a jump is as large as in a fast one.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from tidefield.compare.record import Runner, run_measured, tidefield
from tidefield.config import PRESETS
from tidefield.data.images import Photographs
from tidefield.data.load import load_scene
from tidefield.data.neighbours import Neighbours, choose_neighbours
from tidefield.data.scene import Scene
from tidefield.data.surface import surface_points
from tidefield.files import write_json
from tidefield.geometry.cameras import Cameras
from tidefield.machine import describe
from tidefield.methods import zero_shot
from tidefield.model.rendering import Render, Rendering
from tidefield.render.camera_paths import make_trajectory
from tidefield.train.checkpoint import given_or_shipped

FRAMES_FILE = "frames.json"
SIZE_PX = (800, 600)
FURTHER = 5
"""Frames after the first whose median time is told."""
COUNTS, TURNS = (200, 2000), 7
"""Photographs among which the survey's own are looked at again, and how often."""
FLIGHT_FRAMES = 240
"""Of a flight past all photographs, ten seconds long."""
STEADY_FLIGHT_FRAMES, STEADY_FRAMES, STEADY_WIDTH, STEADY_TILE_PX = 9600, 48, 320, 32
"""Of a slow flight, and of its middle, whose steadiness is judged, as a whole and by tiles."""
SAME_DEPTH = 0.02
"""Share of the depth by which two frames may disagree about a point that both show."""


def measure_frames(
    folder: Path,
    runs: Path,
    preset: Literal["swift", "paper"],
    given: Path | None,
    device: str,
    run: Runner = run_measured,
) -> dict[str, Any]:
    """Everything; kept in RUNS/frames.json and returned.

    Args:
        folder: of the scene.
        runs: where the result goes.
        preset: which network.
        given: its weights; those that came with Tidefield if None.
        device: where to render.
        run: runs a command.
    """
    scene, weights = load_scene(folder), given_or_shipped(given, preset)
    name = scene.names[(scene.test or scene.train)[0]]
    first = _first(folder, name, preset, weights, device, runs, run)
    where, named = torch.device(device), "" if given is None else " --weights WEIGHTS"

    def view_of(other: Scene) -> Render:
        return zero_shot(PRESETS[preset], weights, other, where)[0]

    width, height = SIZE_PX
    flight = make_trajectory("cameras", scene, frames=FLIGHT_FRAMES, width=width, height=height).cameras
    middle = len(flight) // 2
    shown = flight[middle : middle + 1]
    record = {
        "preset": preset,
        "device": device,
        "size_px": list(SIZE_PX),
        "photographs": len(scene.names),
        "first": first,
        "further_seconds": _further(view_of(scene), flight[middle : middle + FURTHER + 1]),
        "by_photographs": _by_photographs(view_of, scene, shown),
        "steadiness": _steadiness(view_of, scene),
        "command": f"python -m benchmarks frames SCENE --runs RUNS --preset {preset}{named} --device {device}",
        **describe(),
    }
    write_json(runs / FRAMES_FILE, record)
    return record


def _first(folder: Path, name: str, preset: str, weights: Path, device: str, runs: Path, run: Runner) -> dict[str, Any]:
    runs.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=runs, prefix=".frames-") as work:
        words = ["--zero-shot", "--preset", preset, "--weights", weights, "--camera", name, "--device", device]
        size = ["--width", SIZE_PX[0], "--height", SIZE_PX[1]]
        command = tidefield("render", folder, Path(work) / "frame.png", *words, *size, "--quiet")
        return asdict(run(command, {"XDG_CACHE_HOME": str(Path(work) / "cache")}))


def _further(view: Render, cameras: Cameras) -> float:
    view(cameras[0])
    return statistics.median(_seconds(view, cameras[k]) for k in range(1, len(cameras)))


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
    side = 1
    while side * side < copies:
        side += 1
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


def _steadiness(view_of: Callable[[Scene], Render], scene: Scene) -> dict[str, dict[str, float | None]]:
    own = scene.cameras[scene.train[0]]
    height = max(16, round(STEADY_WIDTH * own.height / own.width))
    flight = make_trajectory("cameras", scene, frames=STEADY_FLIGHT_FRAMES, width=STEADY_WIDTH, height=height).cameras
    first = (len(flight) - STEADY_FRAMES) // 2
    cameras = [flight[k] for k in range(first, first + STEADY_FRAMES)]
    view = view_of(scene)
    result = {"with fading": _summary([view(camera) for camera in cameras], cameras)}
    with _without_fading():
        result["without"] = _summary([view(camera) for camera in cameras], cameras)
    return result


def _summary(frames: Sequence[Rendering], cameras: Sequence[Cameras]) -> dict[str, float | None]:
    """Of the frames that share anything, and of the tiles that they share; None where none do."""
    found = [change for change in changes(frames, cameras) if not change.isnan().all()]
    of_frames = [change.nanmean().item() for change in found]
    return {
        "mean_levels": statistics.mean(of_frames) if of_frames else None,
        "greatest_levels": max(of_frames, default=None),
        "greatest_of_a_tile_levels": max((level for change in found for level in _of_tiles(change)), default=None),
    }


def _of_tiles(change: Float[Tensor, "h w"]) -> list[float]:
    """Means of the tiles at least half of which both frames show."""
    side = min(STEADY_TILE_PX, *change.shape)
    tiles = change.unfold(0, side, side).unfold(1, side, side).flatten(2)
    shown = (~tiles.isnan()).float().mean(-1)
    return tiles.nanmean(-1)[shown >= 0.5].tolist()


def changes(frames: Sequence[Rendering], cameras: Sequence[Cameras]) -> Iterator[Float[Tensor, "h w"]]:
    """How much each two consecutive frames differ in what both show, in levels of 255; nan where they do not."""
    for this, other, camera, next_camera in zip(frames, frames[1:], cameras, cameras[1:], strict=False):
        uv, z = next_camera.project(surface_points(camera, this.depth))
        grid = (uv / next_camera.size_px[:, None] * 2 - 1)[:, :, None]
        maps = torch.cat([other.colour, other.depth[..., None]], -1).permute(2, 0, 1)[None]
        found = F.grid_sample(maps, grid, align_corners=False, padding_mode="border")[0, :, :, 0]
        same = (grid.abs() < 1).all(-1)[0, :, 0] & ((found[3] - z[0]).abs() < SAME_DEPTH * z[0])
        change = 255 * (found[:3].T - this.colour.reshape(-1, 3)).abs().mean(-1)
        yield change.masked_fill(~same, torch.nan).reshape(this.depth.shape)


@contextmanager
def _without_fading() -> Iterator[None]:
    """Neighbours count in full until they are left out."""

    def full(*words: Any) -> Neighbours:
        found = choose_neighbours(*words)
        return replace(found, blend_weight=torch.ones_like(found.blend_weight))

    with patch("tidefield.model.renderer.choose_neighbours", full):
        yield
