"""What `tidefield export` loses: Gaussians against held-out photographs, chosen in several ways, and the method itself.

The files that are written are rendered with `baselines.splats`, on black, at the photographs' own gains. A pixel is
covered where the Gaussians stop at least half of the light; all other pixels count as black.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from rich.console import Console
from torch import Tensor
from tyro.conf import Positional

from benchmarks.records import MEASURED, NETWORK, network_of, require_same, say, show, store
from tidefield.baselines.splats import read_splats, render_splats
from tidefield.commands.common import ZeroShot, open_source
from tidefield.compare.run import named
from tidefield.compare.tables import Table
from tidefield.config import Sampling
from tidefield.data.load import at_width
from tidefield.data.scene import Scene
from tidefield.device import choose_device
from tidefield.errors import RunError
from tidefield.evaluation.metrics import Image8, flip_map, psnr, ssim_map
from tidefield.files import read_json
from tidefield.model.rendering import Render, to_8_bit
from tidefield.render.consistency import PASSES, choose_points
from tidefield.render.gaussians import SurfaceView, fuse, render_surfaces, write_gaussians
from tidefield.render.stills import MIN_OPACITY
from tidefield.train.checkpoint import RUN_FILE

GAUSSIANS_FILE = "gaussians.json"
METHOD = "the method itself"
BLACK = (0.0, 0.0, 0.0)
METRICS = {"psnr": "{:.2f}", "ssim": "{:.3f}", "flip": "{:.3f}"}
Choice = Callable[[Sequence[SurfaceView]], "list[Bool[np.ndarray, ' P']]"]
WAYS: Mapping[str, Choice] = {
    "every point": lambda views: [view.points.shown for view in views],
    "uncontradicted": lambda views: choose_points([view.points for view in views], PASSES[:1]),
    "uncontradicted, then filled": lambda views: choose_points([view.points for view in views]),
}
"""Ways to choose points; the last one is that of `tidefield export`."""


def gaussians(
    sources: Positional[tuple[Path, ...]],
    runs: Path = MEASURED,
    widths: tuple[int, ...] = (400,),
    device: str = "auto",
) -> dict[str, Any]:
    """Export runs, or scenes with the trained weights, and measure their Gaussians; what was measured is kept.

    Args:
        sources: Runs, or scenes for the trained weights.
        runs: Store the figures in this folder's gaussians.json, after each; what it holds is not measured again.
        widths: Of the views that are exported and of the photographs, in pixels.
        device: auto, cpu, cuda, cuda:N or mps.

    Raises:
        SceneError: two sources have one name.
        RunError: a source holds no photograph out, or a figure that is kept is of other weights.
    """
    where = choose_device(device)
    record = read_json(runs / GAUSSIANS_FILE) or {"figures": {}}
    for name, source in named(sources).items():
        network, missing = {NETWORK: network_of(source)}, []
        for width in widths:
            kept = record["figures"].get(f"{name}, {width} px")
            if kept is None:
                missing.append(width)
                continue
            # Earlier versions stored the weights of scenes only, and those that a run had started from.
            is_scene = kept["method"].get("run") is None
            method = {NETWORK: kept["method"]["weights"]} if is_scene else {}
            require_same(runs / GAUSSIANS_FILE, f"{name}, {width} px", method | kept["method"], network)
        if not missing:
            continue
        zero = ZeroShot(zero_shot=not (source / RUN_FILE).exists())
        opened = open_source(source, zero, where, False, Console(quiet=True), Sampling(rays_per_side=1))
        with opened as (scene, render, about):
            if not scene.test:
                raise RunError(f"{source} holds no photograph out: expected at least one to compare with; add some")
            for width in missing:
                say(f"{name}, {width} px")
                found = compare_ways(scene, render, width, where)
                method = {key: about.get(key) for key in ("preset", "weights", "run")} | network
                new = record["figures"][f"{name}, {width} px"] = {"ways": found, "method": method}
                command = "python -m benchmarks gaussians SCENE|RUN..."
                store(runs / GAUSSIANS_FILE, record, new, record["figures"].values(), command)
    show(tables(record))
    return record


def compare_ways(scene: Scene, render: Render, width: int, device: torch.device) -> dict[str, dict[str, Any]]:
    """Export the training photographs' views in every way, and compare with the held-out photographs.

    Returns:
        Of each way and of the method itself the means over the photographs: the metrics over all and over the covered
        pixels (`_covered`), the share that is covered, the number of Gaussians, and the seconds of rendering the views
        and of making Gaussians of them; of the method, the seconds of rendering the held-out views.
    """
    truth = at_width(scene, width)
    start = time.perf_counter()
    with torch.no_grad():
        views = render_surfaces(render, scene.cameras[list(scene.train)], width)
    rendering_seconds = time.perf_counter() - start
    result = {}
    for way, choose in WAYS.items():
        start = time.perf_counter()
        found = fuse(views, choose(views))
        seconds = time.perf_counter() - start
        with TemporaryDirectory() as folder:
            write_gaussians(found, Path(folder) / "scene.ply", scene.origin_world.tolist())
            splats = read_splats(Path(folder) / "scene.ply")
        result[way] = {
            **compare_views(truth, lambda camera, splats=splats: render_splats(splats, camera, BLACK, device), True),
            "gaussians": len(found.mean_world),
            "rendering_seconds": rendering_seconds,
            "making_seconds": seconds,
        }
    start = time.perf_counter()
    result[METHOD] = compare_views(truth, render, False)
    result[METHOD]["rendering_seconds"] = time.perf_counter() - start
    return result


def compare_views(scene: Scene, render: Render, common_light: bool) -> dict[str, float | None]:
    """Compare the views of the held-out photographs with these; means over the photographs.

    Args:
        scene: at the width of the views.
        render: the method.
        common_light: its views have no gain, and get those of the photographs.
    """
    rows = []
    for index in scene.test:
        camera = scene.cameras[index]
        with torch.no_grad():
            view = render(camera)
        if common_light:
            view = replace(view, colour=(view.colour * camera.gain_of_rows()).clamp(0, 1))
        used = scene.photographs.used(index)
        covered = (view.opacity.cpu() >= MIN_OPACITY) & used
        row = scores(to_8_bit(view.colour).cpu(), scene.photographs[index], {"": used, "_covered": covered})
        rows.append({**row, "covered": float(covered.sum() / used.sum())})
    known = {key: [row[key] for row in rows if row[key] is not None] for key in rows[0]}
    return {key: fmean(values) if values else None for key, values in known.items()}


def scores(image: Image8, truth: Image8, masks: Mapping[str, Bool[Tensor, "H W"]]) -> dict[str, float | None]:
    """Measure an image over each mask, by metric and the mask's suffix; None over an empty one."""
    maps = {"ssim": ssim_map(image, truth), "flip": flip_map(image, truth)}
    result: dict[str, float | None] = {}
    for suffix, mask in masks.items():
        some = bool(mask.any())
        result[f"psnr{suffix}"] = psnr(image, truth, mask) if some else None
        result |= {f"{name}{suffix}": float(of[mask].mean()) if some else None for name, of in maps.items()}
    return result


def tables(record: Mapping[str, Any]) -> list[Table]:
    """One table per source and width: a row per way."""
    columns = ["points", *(name.upper() for name in METRICS), *(f"{name.upper()}, covered" for name in METRICS)]
    columns += ["covered", "Gaussians", "views, s", "Gaussians, s"]
    result = []
    for name, found in record["figures"].items():
        rows = []
        for way, of in found["ways"].items():
            cells = [(style, of[key + suffix]) for suffix in ("", "_covered") for key, style in METRICS.items()]
            cells += [("{:.1%}", of["covered"]), ("{:,}", of.get("gaussians"))]
            cells += [("{:.0f}", of["rendering_seconds"]), ("{:.0f}", of.get("making_seconds"))]
            rows.append((way, *("-" if value is None else style.format(value) for style, value in cells)))
        result.append(Table(name, columns, rows))
    return result
