"""Pairs of built-in surveys of two dates: false alarms, and how often intervals contain the truth."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.records import say
from tidefield.change.measure import Change, measure
from tidefield.change.regions import Region, dilated
from tidefield.change.statistics import Z95
from tidefield.change.surfaces import Grid, open_surface
from tidefield.change.volumes import Volume
from tidefield.change.write import polygons_of
from tidefield.errors import RunError
from tidefield.files import read_json, write_json
from tidefield.synthetic.grids import Extent, Raster
from tidefield.synthetic.two_dates import ground_pair, surveyed

CATEGORIES = ("river_mouths", "tidal_trees", "ground_textures")
CELLS_M = (0.25, 0.2)
"""Of the earlier and the later survey."""


def measure_pairs(seeds: Sequence[int], amounts: Sequence[float], given: bool) -> list[dict[str, Any]]:
    """One record for each amount of change; `given` is that of `measure_pair`."""
    found: list[dict[str, Any]] = []
    for amount in amounts:
        pairs = [measure_pair(seed, amount, given) for seed in seeds]
        found.append({"change_m": amount, "stable_ground": "given" if given else "found", "pairs": pairs})
        say(f"{100 * amount:+.0f} cm: {summarise(found[-1])}")
    return found


def measure_pair(seed: int, amount: float, given: bool) -> dict[str, Any]:
    """Survey a flat twice, compare the surveys, and compare that with the truth.

    Args:
        given: whether stable ground is given, a frame around the flat without what changed there, or found.
    """
    earlier, later = ground_pair(CATEGORIES[seed % len(CATEGORIES)], seed, amount)
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for k, (ground, cell) in enumerate(zip((earlier, later), CELLS_M, strict=True)):
            side = 116.0 + k
            extent = Extent(2.0 - 0.3 * k, 2.0 - 0.4 * k, round(side / cell), round(side / cell), cell)
            heights = surveyed(ground, extent, np.random.default_rng([seed, 20265, k, round(1000 * amount) + 500]))
            paths.append(write_surface(Path(folder) / f"{k}.tif", heights, extent))
        stable = partial(stable_frame, earlier, later) if given else None
        change = measure(open_surface(paths[0]), open_surface(paths[1]), stable=stable)
    truth = true_change(earlier, later, change.grid)
    truth[~np.isfinite(change.dz)] = 0
    return compared(change, truth, change.grid)


def stable_frame(earlier: Raster, later: Raster, grid: Grid) -> list[Region]:
    """A frame of a sixth of the side, without what changed and a margin around it."""
    same = np.abs(true_change(earlier, later, grid)) < 1e-6
    same &= ~dilated(~same, 8)
    rows, columns = grid.rows // 6, grid.columns // 6
    same[rows:-rows, columns:-columns] = False
    return regions_of(same, grid)


def regions_of(cells: np.ndarray, grid: Grid) -> list[Region]:
    """Cells as polygons."""
    return [Region("ground", polygon) for _, polygon in polygons_of(cells.astype(np.uint8), grid, cells)]


def compared(change: Change, truth: np.ndarray, grid: Grid, full: float | None = None) -> dict[str, Any]:
    """What was found, and what is true.

    Args:
        full: the amount of change; the largest one if None, which single cells have where truth is interpolated.
    """
    area = grid.cell_area_m2
    lower, higher = change.outlines.cells(-1), change.outlines.cells(1)
    known = np.isfinite(change.dz)
    unchanged = known & (np.abs(truth) < 1e-4)
    sigma = np.concatenate([change.errors.cell_sigma(rows) for rows in grid.strips()])
    significant = np.abs(change.dz) > Z95 * sigma
    record: dict[str, Any] = {
        "false_alarms": float(significant[unchanged].mean()),
        "detection_m": change.detection_m[1],
        "systematic_m": change.errors.registration.systematic_m,
        "shift_m": change.errors.registration.vertical_m,
        "bias_m": float((change.dz - truth)[known].mean()),
        "range_m": change.errors.variogram.range_m,
        "nugget": change.errors.variogram.nugget,
    }
    full = float(np.abs(truth).max()) if full is None else full
    if full > 0:
        plateau = np.abs(truth) > 0.95 * full
        record["detected"] = float(significant[plateau].mean())
        record["outlined"] = float((lower | higher)[plateau].mean())
        changed = np.abs(truth) > 0.1 * full
        record["bias_where_changed_m"] = float((change.dz - truth)[changed].mean())
    for name, volume, cells, sign in (
        ("net", change.net, known, 1),
        ("cut", change.cut, lower, -1),
        ("fill", change.fill, higher, 1),
    ):
        whole = truth.sum() if name == "net" else (sign * truth).clip(min=0).sum()
        record[name] = _beside(volume, float(whole) * area, float(sign * truth[cells].sum()) * area)
    return record


def _beside(volume: Volume, whole_m3: float, inside_m3: float) -> dict[str, float]:
    low, high = volume.interval_m3
    return {
        "value_m3": volume.value_m3,
        "low_m3": low,
        "high_m3": high,
        "true_m3": whole_m3,
        "true_inside_m3": inside_m3,
    }


def centres(grid: Grid) -> np.ndarray:
    """East and north [2 N] of the centres of a grid's cells, row by row from the north."""
    x = grid.west_m + (np.arange(grid.columns) + 0.5) * grid.cell_m
    y = grid.north_m - (np.arange(grid.rows) + 0.5) * grid.cell_m
    return np.stack([axis.ravel() for axis in np.meshgrid(x, y)])


def true_change(earlier: Raster, later: Raster, grid: Grid) -> np.ndarray:
    """The truth at the centres of a grid's cells, row 0 in the north."""
    xy = torch.from_numpy(centres(grid)).float()
    both = [raster.sample(xy)[0].numpy().reshape(grid.shape) for raster in (earlier, later)]
    return both[1] - both[0]


def require_options(work: Path, options: dict[str, Any]) -> None:
    """Check that what a work folder holds is of these options, and keep them in one without files.

    Raises:
        RunError: it is of other ones, or of a version that did not keep them.
    """
    path = work / "options.json"
    kept = read_json(path)
    if not any(other.is_file() for other in work.rglob("*") if other != path):
        write_json(path, options)
    elif kept != options:
        raise RunError(
            f"{work} holds files of {'unknown options' if kept is None else kept}: expected a new folder, or one of "
            f"{options}; delete it, or name another with --work"
        )


def write_surface(path: Path, heights: np.ndarray, extent: Extent) -> Path:
    """Write heights whose cells' centres are the nodes of an extent, row 0 in the north."""
    import rasterio
    from affine import Affine

    half = extent.cell_m / 2
    transform = Affine(extent.cell_m, 0, extent.west_m - half, 0, -extent.cell_m, extent.north_m + half)
    shape = {"width": extent.columns, "height": extent.rows, "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:32631", transform=transform, **shape) as file:
        file.write(heights, 1)
    return path


def summarise(found: dict[str, Any]) -> dict[str, Any]:
    """Means over pairs, and how many intervals contain the truth."""
    pairs = found["pairs"]

    def mean(key: str, digits: int) -> float | None:
        return round(float(np.mean([pair[key] for pair in pairs])), digits) if key in pairs[0] else None

    def inside(name: str, truth: str) -> int:
        return sum(p[name]["low_m3"] <= p[name][truth] <= p[name]["high_m3"] for p in pairs)

    return {
        "pairs": len(pairs),
        "false_alarms": mean("false_alarms", 4),
        "detection_m": mean("detection_m", 4),
        "detected": mean("detected", 3),
        "outlined": mean("outlined", 3),
        "bias_m": mean("bias_m", 5),
        "bias_where_changed_m": mean("bias_where_changed_m", 5),
        "net": inside("net", "true_m3"),
        "cut": inside("cut", "true_m3"),
        "fill": inside("fill", "true_m3"),
        "cut_inside": inside("cut", "true_inside_m3"),
        "fill_inside": inside("fill", "true_inside_m3"),
    }
