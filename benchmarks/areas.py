"""Training by areas: memory against the number of photographs, quality, and seams between areas.

The flights are built-in ones over mud (`tidefield.synthetic.large`), whose scenes have the true poses, so that nothing
but training is measured. Memory is that of `tidefield train`. For quality and seams the same network is trained for the
same steps on all photographs at once and by areas. Rendering knows no areas; a seam could only be one that the weights
have learned, which are the same everywhere. It is looked for straight above the middle of borders between areas: by how
much the mean error of the picture changes from one side to the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.records import MEASURED, NETWORK, HiddenRunner, network_of, require_same, say, show, store
from tidefield.compare.run import run_measured, tidefield
from tidefield.compare.tables import Table
from tidefield.config import PRESETS, Budget
from tidefield.data.areas import cut
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.evaluation.metrics import psnr_from_mse
from tidefield.files import read_json
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Render
from tidefield.synthetic.flat import TidalFlat
from tidefield.synthetic.large import LargeFlight, make_large_flight, planned_flight, write_large_scene
from tidefield.train.checkpoint import given_or_shipped
from tidefield.train.loop import SceneTrainer

AREAS_FILE = "areas.json"
EACH = 50
"""Photographs of a strip."""
BAND_PX = 12
"""Width of the bands on both sides of a border whose mean errors are compared."""
BORDER_VIEWS = 24
"""Views over borders."""


def areas(
    work: Path,
    runs: Path = MEASURED,
    counts: tuple[int, ...] = (500, 1000, 2000),
    width: int = 160,
    steps: int = 600,
    compared_steps: int = 1600,
    run: HiddenRunner = run_measured,
) -> dict[str, Any]:
    """Measure memory on flights of several sizes, then quality and seams on the smallest; what is stored is kept.

    Args:
        work: Folder for flights, scenes and runs; what is there is not made again.
        runs: Store the figures in this folder's areas.json; what it holds is not measured again.
        counts: Photographs of the flights, multiples of 50.
        width: Of a photograph, in pixels.
        steps: Of the trainings whose memory is measured.
        compared_steps: Of the trainings at once and by areas that are compared.
        run: Runs a command.

    Raises:
        RunError: figures of quality and seams that are kept are of other weights.
    """
    record = read_json(runs / AREAS_FILE)
    about = {"width": width, "steps": steps, "compared_steps": compared_steps}
    if record is None or record["about"] != about:
        record = {"about": about, "memory": {}, "compared": {}}
    record["compared"] = _by_count(record)
    plans = {count: LargeFlight(strips=count // EACH, each=EACH, width=width) for count in counts}
    for count, plan in plans.items():
        if str(count) in record["memory"]:
            continue
        say(f"{count} photographs: flight")
        scene = _scene(plan, work)
        say(f"{count} photographs: training")
        folder = work / f"run_{count}_{width}"
        words = ["train", scene, folder, "--steps", steps, "--device", "cpu", "--overwrite", "--quiet"]
        usage = run(tidefield(*words), {})
        new = record["memory"][str(count)] = {"seconds": usage.seconds, "peak_memory_bytes": usage.peak_memory_bytes}
        _store(record, new, runs)
    fewest, network = min(plans), {NETWORK: network_of(work)}
    compared = record["compared"].setdefault(str(fewest), {})
    for way in ("at once", "by areas"):
        name = f"{fewest} photographs: {way}"
        if way in compared:
            require_same(runs / AREAS_FILE, name, compared[way], network)
            continue
        say(name)
        new = compare(_scene(plans[fewest], work), plans[fewest], way == "by areas", compared_steps)
        compared[way] = {**new, **network}
        _store(record, compared[way], runs)
    show(tables(record))
    return record


def _by_count(record: Mapping[str, Any]) -> dict[str, Any]:
    """Comparisons by the number of photographs, which earlier versions did not store: it was that of the smallest."""
    compared = record["compared"]
    return {min(record["memory"], key=int): compared} if "at once" in compared else compared


def _store(record: dict[str, Any], new: dict[str, Any], runs: Path) -> None:
    compared = [one for of in record["compared"].values() for one in of.values()]
    figures = [*record["memory"].values(), *compared]
    store(runs / AREAS_FILE, record, new, figures, "python -m benchmarks areas")


def _scene(plan: LargeFlight, work: Path) -> Path:
    name = f"{plan.strips * plan.each}_{plan.width}"
    flight, scene = work / f"flight_{name}", work / f"scene_{name}"
    if not scene.exists():
        make_large_flight(plan, flight)
        write_large_scene(plan, flight, scene)
    return scene


def compare(folder: Path, plan: LargeFlight, by_areas: bool, steps: int) -> dict[str, Any]:
    """Train on a flight's scene; returns the PSNR of its held-out views, and how the error changes at borders.

    Args:
        folder: of the scene.
        plan: of the flight.
        by_areas: train by the areas of `data.areas.cut`; otherwise on all photographs at once.
        steps: of the training.
    """
    scene = load_scene(folder)
    areas, budget = cut(scene), Budget(steps=steps)
    config, weights = PRESETS["swift"], given_or_shipped(None, "swift")
    own = areas if by_areas else [scene.train]
    trainer = SceneTrainer(config, scene, 0, torch.device("cpu"), weights, own)
    for _ in range(steps):
        trainer.step(budget)
    trainer.network.eval()
    render = trainer.renderer()
    errors = []
    for index in scene.test:
        difference = render(scene.cameras[index]).colour - scene.photographs[index].float() / 255
        errors.append(float(difference.square().mean()))
    _, _, _, make = planned_flight(plan)
    steps_at_borders = border_steps(scene, areas, render, make())
    return {
        "areas": len(own),
        "seconds": trainer.progress.seconds,
        "psnr": float(np.mean([psnr_from_mse(error) for error in errors])),
        "borders": steps_at_borders,
    }


def border_steps(
    scene: Scene, areas: Sequence[tuple[int, ...]], render: Render, flat: TidalFlat, views: int = BORDER_VIEWS
) -> dict[str, float]:
    """Change of the mean error of views straight down across borders between areas, in 255ths.

    Returns:
        Mean and largest absolute change in the middle of the views, where the border is, of their mean over the views,
        and of the same a quarter of the width to both sides, where there is none.
    """
    places = {"border": 0.5, "left": 0.25, "right": 0.75}
    found: dict[str, list[float]] = {name: [] for name in places}
    for camera in border_cameras(scene, areas, views):
        truth, _ = flat.photograph(replace(camera, T_world_camera=_in_world(camera, scene)), 2)
        error = 255 * (render(camera).colour - truth).mean(-1)
        for name, share in places.items():
            middle = round(share * camera.width)
            after, before = error[:, middle : middle + BAND_PX], error[:, middle - BAND_PX : middle]
            found[name].append(float(after.mean() - before.mean()))
    inside = np.array([found["left"], found["right"]])
    return {
        "views": len(found["border"]),
        "border_mean": float(np.mean(found["border"])),
        "border_mean_absolute": float(np.mean(np.abs(found["border"]))),
        "border_largest": float(np.max(np.abs(found["border"]))),
        "inside_mean_absolute": float(np.abs(inside).mean()),
        "inside_largest": float(np.abs(inside).max()),
    }


def border_cameras(scene: Scene, areas: Sequence[tuple[int, ...]], count: int) -> list[Cameras]:
    """Cameras straight down, with the border between two areas upright in their middle."""
    position = scene.cameras.position_world.double().numpy()
    of = {index: number for number, area in enumerate(areas) for index in area}
    pairs = []
    for first in scene.train:
        others = [index for index in scene.train if of[index] > of[first]]
        if others:
            distance = np.linalg.norm(position[others] - position[first], axis=1)
            pairs.append((float(distance.min()), first, others[int(distance.argmin())]))
    # Those that lie closest to each other are neighbours across a border; spread over all borders.
    nearest = sorted(pairs)[: max(count, len(pairs) // 2)]
    by_border = sorted(nearest, key=lambda pair: (of[pair[1]], of[pair[2]], pair))
    cameras = []
    for _, first, second in by_border[:: max(1, len(nearest) // count)][:count]:
        across = position[second] - position[first]
        turn = math.atan2(across[1], across[0])
        right, down = [math.cos(turn), math.sin(turn), 0.0], [math.sin(turn), -math.cos(turn), 0.0]
        middle = (position[first] + position[second]) / 2
        pose = torch.tensor(np.column_stack([right, down, [0.0, 0.0, -1.0], middle]), dtype=torch.float32)
        own = scene.cameras[first]
        cameras.append(
            replace(own, T_world_camera=pose[None], names=(), residual=None, shading=None, gain=torch.ones(1, 3))
        )
    return cameras


def _in_world(camera: Cameras, scene: Scene) -> torch.Tensor:
    pose = camera.T_world_camera.clone()
    pose[:, :, 3] += scene.origin_world.to(pose)
    return pose


def slope_bytes(record: Mapping[str, Any]) -> float:
    """Memory for each further photograph, from the smallest to the largest flight."""
    sizes = sorted((int(count), of["peak_memory_bytes"]) for count, of in record["memory"].items())
    (few, little), (many, much) = sizes[0], sizes[-1]
    return (much - little) / max(many - few, 1)


def tables(record: Mapping[str, Any]) -> list[Table]:
    """Memory, quality and seams."""
    about = record["about"]
    memory = [(f"{int(count):,}", f"{of['peak_memory_bytes'] / 1e9:.2f}") for count, of in record["memory"].items()]
    title = f"Memory of `tidefield train`, {about['steps']} steps, photographs of {about['width']} px"
    if len(memory) > 1:
        memory.append(("each further one", f"{slope_bytes(record) / 1e9:.6f}"))
    result = [Table(title, ["photographs", "peak, GB"], memory)]
    for count, ways in _by_count(record).items():
        rows = []
        for name, of in ways.items():
            at = of["borders"]
            border = [f"{at[key]:.2f}" for key in ("border_mean", "border_mean_absolute", "border_largest")]
            inside = [f"{at[key]:.2f}" for key in ("inside_mean_absolute", "inside_largest")]
            rows.append((f"{name} ({of['areas']})", f"{of['psnr']:.2f}", *border, *inside))
        columns = ["training (areas)", "PSNR, dB", "at borders: mean", "mean size", "largest", "elsewhere: mean size"]
        title = (
            f"{int(count):,} photographs, {about['compared_steps']:,} steps: quality of held-out views, and change of "
            "the mean error across a line, in 255ths"
        )
        result.append(Table(title, [*columns, "largest"], rows))
    return result
