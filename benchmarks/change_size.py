"""Time and peak memory of `tidefield change` on surfaces of many cells."""

from __future__ import annotations

import resource
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.change import store
from benchmarks.records import MEASURED, say
from tidefield.compare.run import run_measured, tidefield
from tidefield.machine import cores

CELL_M = 0.05
_STRIP = 512
_TILE = 1500
"""Rows and columns of the noise, which is repeated: to make it anew for all cells would take longer than to compare."""
_PITS = 40
_SEED = 20_300


def write_pair(folder: Path, side: int) -> tuple[Path, Path]:
    """Write two surfaces of side x side cells: a wavy flat, errors that are correlated, pits and heaps at one date."""
    import rasterio
    from affine import Affine
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng(_SEED)
    noise = []
    for _ in range(2):
        white = random.normal(0, 0.015, (_TILE, _TILE))
        smooth = gaussian_filter(random.normal(size=(_TILE, _TILE)), 8, mode="wrap")
        noise.append((white + 0.01 * smooth / smooth.std()).astype(np.float32))
    centres = random.uniform(0, side, (_PITS, 2))
    depths = random.choice([-0.3, 0.3], _PITS)
    paths = folder / "earlier.tif", folder / "later.tif"
    columns = np.arange(side)
    for k, path in enumerate(paths):
        with rasterio.open(
            path, "w", driver="GTiff", width=side, height=side, count=1, dtype="float32", crs="EPSG:32630",
            transform=Affine(CELL_M, 0, 400_000, 0, -CELL_M, 5_700_000), tiled=True, blockxsize=512, blockysize=512,
            compress="DEFLATE", zlevel=1, num_threads="all_cpus",
        ) as file:  # fmt: skip
            for first in range(0, side, _STRIP):
                rows = np.arange(first, min(first + _STRIP, side))
                heights = np.sin(rows / 900)[:, None] + 0.3 * np.cos(columns / 700)[None]
                heights += noise[k][np.ix_(rows % _TILE, columns % _TILE)]
                if k:
                    for (row, column), depth in zip(centres, depths, strict=True):
                        if abs(row - rows.mean()) < 200 + _STRIP:
                            pit = np.hypot(rows[:, None] - row, columns[None] - column) < 150
                            heights += depth * pit
                file.write(heights.astype(np.float32), 1, window=((rows[0], rows[-1] + 1), (0, side)))
    return paths


def change_size(million: float = 100, runs: Path = MEASURED) -> dict[str, Any]:
    """Compare two surfaces by the command, in a process of its own; store and return what it took.

    Args:
        million: Cells of each surface, in millions.
        runs: Store the figures in this folder's change.json.
    """
    side = round((million * 1e6) ** 0.5)
    with tempfile.TemporaryDirectory() as folder:
        say(f"two surfaces of {side} x {side} cells")
        earlier, later = write_pair(Path(folder), side)
        out = Path(folder) / "out"
        say("tidefield change")
        before = _processor_seconds()
        usage = run_measured(tidefield("change", earlier, later, out, "--quiet"), {})
        found = {
            "million_cells": side * side / 1e6,
            **asdict(usage),
            "processor_seconds": _processor_seconds() - before,
            "written_bytes": sum(path.stat().st_size for path in out.iterdir()),
            "cores": cores(),
        }
    say(
        f"{found['million_cells']:.0f} million cells: {found['seconds']:.0f} s, {found['processor_seconds']:.0f} s of "
        f"the processor, {found['peak_memory_bytes'] / 1e9:.2f} GB"
    )
    store(runs, "size", found)
    return found


def _processor_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
