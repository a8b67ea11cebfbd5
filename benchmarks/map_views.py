"""A photograph that took no part in a map, against the orthophoto warped into it by the map's surface.

Next to it the same orthophoto, warped by the surface of the sparse points. The colours of both are fitted to the
photograph's by an affine function, because its exposure is not known to the map.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from tyro.conf import Positional

from benchmarks.maps import made_map, read_map, whole, write_square
from benchmarks.records import say, show
from tidefield.compare.tables import Table
from tidefield.data.load import load_scene
from tidefield.evaluation.metrics import fit_colours, flip_map, ssim_map
from tidefield.files import completed_folder, write_json
from tidefield.machine import describe
from tidefield.maps.grid import Grid
from tidefield.maps.views import View

ROUNDS = 30
"""A ray's height is taken from the surface where it was last, so often."""


def map_views(scene: Positional[Path], runs: Path = Path("runs/map_views"), half: float = 6.0) -> None:
    """Map the middle of a built-in flat without its most central photograph, and compare with that.

    Args:
        scene: A built-in flat, such as one of those that maps makes.
        runs: Folder for the maps and map_views.json.
        half: Half the side of the square that is mapped, metres.

    Raises:
        RunError: the folder has a map of another scene of this name, or of another square.
    """
    loaded = load_scene(scene, hold_out=False)
    position = (loaded.cameras.position_world.double() + loaded.origin_world.double()).numpy()
    left_out = int(np.linalg.norm(position[:, :2], axis=1).argmin())
    name = loaded.names[left_out]
    folder = runs / "_".join(scene.resolve().parts[-2:])  # those of `maps` are all named "scene"
    # Copied each time, so that the map is compared with the scene that is given now.
    shutil.rmtree(folder / "scene", ignore_errors=True)
    with completed_folder(folder / "scene") as partial:
        shutil.copytree(scene / "images", partial / "images", ignore=shutil.ignore_patterns(Path(name).name))
        shutil.copytree(scene / "sparse", partial / "sparse")
    say(f"map without {name}")
    made_map(folder / "scene", folder / "map", area=write_square(runs, half), allow_missing=True)
    grid, height, sparse, colour = read_map(loaded, folder / "map")
    truth = loaded.photographs[left_out]
    view = View(loaded.cameras[left_out], whole(grid))
    result: dict[str, Any] = {"photograph": name, "cell_m": grid.cell}
    known, shown = None, {}
    for method, surface in (("map", height), ("sparse points", sparse)):
        warped, mask = warp(colour, surface - grid.height, view, grid)
        shown[method], known = warped, mask if known is None else known & mask
    assert known is not None
    rows, columns = np.nonzero(known)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    mask, photograph = torch.from_numpy(known[box]), truth[box]
    for method, picture in shown.items():
        fitted = fit_colours(torch.from_numpy(picture[box]), photograph, mask)
        cv2.imwrite(str(runs / f"{method.split()[0]}.png"), cv2.cvtColor(fitted.numpy(), cv2.COLOR_RGB2BGR))
        result[method] = {
            "ssim": float(ssim_map(fitted, photograph)[mask].mean()),
            "flip": float(flip_map(fitted, photograph)[mask].mean()),
        }
    cv2.imwrite(str(runs / "photograph.png"), cv2.cvtColor(photograph.numpy(), cv2.COLOR_RGB2BGR))
    result |= {"pixels": int(mask.sum()), **describe()}
    write_json(runs / "map_views.json", result)
    show([table(result)])


def warp(colour: np.ndarray, height: np.ndarray, view: View, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Show an orthophoto in a photograph: each pixel's ray is followed to the surface; returns it, and where it is.

    Args:
        colour: of the cells, 8 bits.
        height: of the cells above `Grid.height`, NaN where there is none.
        view: the photograph's projection; the middle of its tile is that of the grid's square.
        grid: the cells.
    """
    width, tall = view.size
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(tall) + 0.5)
    inverse = np.linalg.inv(view.matrix[:, :3])
    ray = np.stack([u, v, np.ones_like(u)], -1) @ inverse.T
    side = max(grid.rows, grid.columns)
    at = np.full(u.shape, float(np.nanmedian(height)))
    filled = np.where(np.isfinite(height), height, np.nanmedian(height)).astype(np.float32)

    def cells() -> tuple[np.ndarray, np.ndarray]:
        share = (at - view.position[2]) / ray[..., 2]
        east, north = (view.position[k] + share * ray[..., k] for k in (0, 1))
        column, row = east / grid.cell + side / 2 - 0.5, side / 2 - north / grid.cell - 0.5
        return column.astype(np.float32), row.astype(np.float32)

    for _ in range(ROUNDS):
        # Halfway each time: where the surface is steeper than the ray it would go to and fro.
        at += 0.5 * (cv2.remap(filled, *cells(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) - at)
    column, row = cells()
    there = cv2.remap(np.isfinite(height).astype(np.float32), column, row, cv2.INTER_LINEAR) == 1
    return cv2.remap(colour, column, row, cv2.INTER_LINEAR), there


def table(record: dict[str, Any]) -> Table:
    """SSIM and FLIP of both."""
    rows = [(name, f"{record[name]['ssim']:.3f}", f"{record[name]['flip']:.3f}") for name in ("map", "sparse points")]
    return Table(f"{record['photograph']}, {record['pixels']:,} pixels", ["surface", "SSIM", "FLIP"], rows)
