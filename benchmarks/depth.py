"""Rendered depth of held-out views of built-in flats against the exact truth, next to the triangulated points.

The baseline is the surface that interpolates the triangulated points in the view (`surface_depth`), as the method
`sparse-depth` has it. Both are measured where two training photographs or more see the ground.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.maps import errors
from benchmarks.records import store
from tidefield.compare.tables import Table
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.data.surface import doubly_seen, surface_depth, surface_points
from tidefield.files import completed_folder, read_json
from tidefield.model.rendering import Render
from tidefield.synthetic.write import VEGETATION

DEPTH_FILE = "depth.json"
STEEP = 0.25
"""Slope of the ground, metres per metre, from which it counts as a channel's edge."""
BASELINE_M = 0.5
"""Distance over which slopes are taken: that of a bank, not of a ripple."""


def measure_depth(
    work: Path,
    runs: Path,
    categories: Sequence[str],
    width: int,
    views: int,
    seed: int,
    open_scene: Callable[[Scene], Render],
    about: dict[str, Any],
    say: Callable[[str], object],
) -> dict[str, Any]:
    """Render held-out views of a flat of each category and compare their depths; what was measured is kept.

    Args:
        work: folder for the flats.
        runs: folder for depth.json.
        categories: of flats.
        width: of the photographs, pixels.
        views: photographs of each survey.
        seed: of the flats.
        open_scene: makes the method from a scene.
        about: the method, for the record; figures of another one are measured again.
        say: reports progress.
    """
    from tidefield.synthetic import make_survey, write_survey

    record = read_json(runs / DEPTH_FILE)
    if record is None or record["method"] != about:
        record = {"figures": {}, "method": about}
    for category in categories:
        name = f"{category}, {width} px, {views} photographs, seed {seed}"
        if name in record["figures"]:
            continue
        folder = work / f"{category}_{width}_{views}_{seed}"
        if not folder.exists():
            say(f"{name}: photographs")
            with completed_folder(folder) as partial:
                write_survey(make_survey(category, seed=seed, views=views, width=width), partial)
        say(f"{name}: depths")
        scene = load_scene(folder)
        record["figures"][name] = compare_depths(scene, open_scene(scene))
        command = f"python -m benchmarks depth --width {width} --views {views} --seed {seed}"
        store(runs / DEPTH_FILE, record, record["figures"][name], record["figures"].values(), command)
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
