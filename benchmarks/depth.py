"""Rendered depth of held-out views of built-in flats against the exact truth, next to the triangulated points.

The baseline is the surface that interpolates the triangulated points in the view (`surface_depth`), as the method
`sparse-depth` has it. Both are measured where two training photographs or more see the ground.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.maps import errors
from benchmarks.records import MEASURED, say, show, store
from tidefield.compare.run import make_flat
from tidefield.compare.tables import Table
from tidefield.config import PRESETS
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.data.surface import doubly_seen, surface_depth, surface_points
from tidefield.device import choose_device
from tidefield.files import read_json
from tidefield.methods import zero_shot
from tidefield.model.rendering import Render
from tidefield.synthetic import CATEGORIES
from tidefield.synthetic.write import VEGETATION
from tidefield.train.checkpoint import given_or_shipped, weights_sha256

DEPTH_FILE = "depth.json"
STEEP = 0.25
"""Slope of the ground, metres per metre, from which it counts as a channel's edge."""
BASELINE_M = 0.5
"""Distance over which slopes are taken: that of a bank, not of a ripple."""


def depth(
    work: Path = Path("runs/depth"),
    runs: Path = MEASURED,
    categories: tuple[str, ...] = tuple(CATEGORIES),
    width: int = 800,
    views: int = 24,
    seed: int = 61,
    weights: Path | None = None,
    device: str = "auto",
) -> dict[str, Any]:
    """Render held-out views of a flat of each category and compare their depths; what was measured is kept.

    Args:
        work: Folder for the flats.
        runs: Store the figures in this folder's depth.json; what it holds is not measured again.
        categories: Of flats.
        width: Of the photographs in pixels.
        views: Photographs of each survey.
        seed: Of the flats.
        weights: Of `tidefield pretrain`; those that came with Tidefield if not given.
        device: auto, cpu, cuda, cuda:N or mps.
    """
    where, file = choose_device(device), given_or_shipped(weights, "swift")
    about = {"preset": "swift", "weights": weights_sha256(file)}
    record = read_json(runs / DEPTH_FILE)
    if record is None or record["method"] != about:
        record = {"figures": {}, "method": about}
    for category in categories:
        name = f"{category}, {width} px, {views} photographs, seed {seed}"
        if name in record["figures"]:
            continue
        folder = work / f"{category}_{width}_{views}_{seed}"
        say(f"{name}: photographs")
        make_flat(folder, category, seed, views, width)
        say(f"{name}: depths")
        scene = load_scene(folder)
        record["figures"][name] = compare_depths(scene, zero_shot(PRESETS["swift"], file, scene, where)[0])
        command = f"python -m benchmarks depth --width {width} --views {views} --seed {seed}"
        store(runs / DEPTH_FILE, record, record["figures"][name], record["figures"].values(), command)
    show(tables(record))
    return record


def compare_depths(scene: Scene, render: Render) -> dict[str, Any]:
    """Errors of the depths that a method and the points give, metres, over all held-out views of a built-in flat.

    Returns:
        Of each part of the ground (`all`, `vegetation`, `edges`) the share of the pixels, and by method the RMSE, mean
        and NMAD of the errors; None where the part has no pixels.
    """
    found: dict[str, list[np.ndarray]] = {"rendered": [], "points": [], "vegetation": [], "edges": []}
    for index in scene.test:
        camera = scene.cameras[index]
        stem = Path(scene.names[index]).stem
        true = torch.from_numpy(np.load(scene.root / "truth" / "depth" / f"{stem}.npy"))
        seen = doubly_seen(scene, camera) & true.isfinite()
        with torch.no_grad():
            rendered = render(camera).depth.cpu()
        vegetation, edges = _parts(scene, surface_points(camera, true).reshape(*true.shape, 3))
        found["rendered"].append((rendered - true)[seen].double().numpy())
        found["points"].append((surface_depth(camera, scene.points, scene.cameras) - true)[seen].double().numpy())
        found["vegetation"].append(vegetation[seen].numpy())
        found["edges"].append(edges[seen].numpy())
    whole = {name: np.concatenate(parts) for name, parts in found.items()}
    masks = {"all": np.ones(len(whole["edges"]), bool), "vegetation": whole["vegetation"], "edges": whole["edges"]}
    return {
        part: {"share": float(mask.mean()), **{name: errors(whole[name][mask]) for name in ("rendered", "points")}}
        if mask.any()
        else None
        for part, mask in masks.items()
    }


def _parts(scene: Scene, points: Float[Tensor, "H W 3"]) -> tuple[Bool[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """Which points of a built-in flat are plants, and which are on the edge of a channel, without plants."""
    truth = scene.root / "truth"
    about = json.loads((truth / "truth.json").read_text())["map"]
    first, step = about["first_pixel_centre_east_north_m"], about["pixel_step_east_north_m"]
    east, north = (points[..., :2].double() + scene.origin_world[:2]).unbind(-1)
    u, v = ((east - first[0]) / step[0]).float().numpy(), ((north - first[1]) / step[1]).float().numpy()
    classes = cv2.imread(str(truth / "classes.png"), cv2.IMREAD_UNCHANGED)
    assert classes is not None
    bare = np.load(truth / "bare.npy")
    bare = cv2.GaussianBlur(bare, (0, 0), BASELINE_M / 2 / step[0])
    slope = np.hypot(*np.gradient(bare, step[0])).astype(np.float32)
    plants = cv2.remap(classes, u, v, cv2.INTER_NEAREST) == VEGETATION
    steep = cv2.remap(slope, u, v, cv2.INTER_LINEAR) > STEEP
    return torch.from_numpy(plants), torch.from_numpy(steep & ~plants)


def tables(record: Mapping[str, Any]) -> list[Table]:
    """One table per part of the ground: errors of both, and the ratios."""
    result = []
    columns = ["flat", "share", *(f"{m}: {k}" for m in ("rendered", "points") for k in ("RMSE", "NMAD", "mean"))]
    for part in ("all", "vegetation", "edges"):
        rows = []
        for name, parts in record["figures"].items():
            found = parts[part]
            if found is None:
                continue
            ours, theirs = found["rendered"], found["points"]
            rows.append(
                (
                    name,
                    f"{100 * found['share']:.1f}%",
                    *(f"{100 * of[key]:.1f}" for of in (ours, theirs) for key in ("rmse_m", "nmad_m", "mean_m")),
                    *(f"{ours[key] / theirs[key]:.2f}" for key in ("rmse_m", "nmad_m")),
                )
            )
        title = {"all": "all pixels", "vegetation": "plants", "edges": "edges of channels"}[part]
        result.append(Table(f"Errors of depth, cm: {title}", [*columns, "ratio of RMSE", "ratio of NMAD"], rows))
    return result
