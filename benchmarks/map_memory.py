"""Peak memory of a map of a square kilometre, simulated by repeating four tiles of a scene.

Four tiles of the scene's middle are measured and rendered, as for any map, and linked as often as the square has tiles.
Everything after them, from joining the tiles to the point cloud and the report, is made at full size.
"""

from __future__ import annotations

import os
import resource
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from tidefield.data.load import load_scene
from tidefield.errors import RunError
from tidefield.files import write_json
from tidefield.machine import describe
from tidefield.maps.grid import Grid, make_grid, map_frame
from tidefield.maps.make import DSM, TILES, Job, TileMaker, finish_map, make_missing, tile_file

SQUARE = "square"
"""Folder of the map."""


def measure_memory(
    scene_folder: Path, runs: Path, metres: float, cell: float, say: Callable[[str], object]
) -> dict[str, Any]:
    """Map a square that repeats a scene's middle, and store the peak memory of this process in map_memory.json.

    The map is deleted afterwards.

    Args:
        scene_folder: a scene in metres.
        runs: folder for the map, some 40 bytes a cell.
        metres: side of the square.
        cell: side of a cell, metres.
        say: reports progress.

    Raises:
        RunError: the folder is there, or the scene is too small for four tiles.
    """
    from tidefield.commands.common import ZeroShot, open_zero_shot
    from tidefield.device import choose_device

    out, few = runs / SQUARE, runs / f"{SQUARE}_tiles"
    if out.exists() or few.exists():
        raise RunError(f"{out} or {few} is there already: expected a new folder; delete them, or choose another --runs")
    scene = load_scene(scene_folder, hold_out=False)
    render, record = open_zero_shot(ZeroShot(zero_shot=True), scene, choose_device("cpu"))
    grid = make_grid(map_frame(scene, None), scene, cell)
    job = Job(scene, grid, None, False, {})
    side = job.tiles()[0].side - 2 * job.tiles()[0].margin
    if min(grid.columns, grid.rows) < 2 * side:
        raise RunError(
            f"{scene_folder} has {grid.columns} x {grid.rows} cells: expected at least {2 * side} on each side"
        )
    west = grid.west + (grid.columns // 2 - side) * grid.cell
    north = grid.north - (grid.rows // 2 - side) * grid.cell
    middle = replace(job, grid=replace(grid, west=west, north=north, columns=2 * side, rows=2 * side))
    started = time.monotonic()
    say(f"4 tiles of {side} x {side} cells")
    make_missing(middle, few, lambda done, whole: None, TileMaker(middle, render, few).several)
    del render
    tiles_bytes, tiles_seconds = _peak(), time.monotonic() - started
    count = round(metres / cell)
    large = replace(job, grid=Grid(grid.frame, 0.0, metres, cell, count, count, grid.height))
    say(f"{len(large.tiles())} tiles, {count} x {count} cells")
    (out / TILES).mkdir(parents=True)
    four = [tile_file(few, tile) for tile in middle.tiles()]
    across = -(-count // side)
    for number, tile in enumerate(large.tiles()):
        row, column = divmod(number, across)
        os.link(four[2 * (row % 2) + column % 2], tile_file(out, tile))

    def bar(name: str) -> Any:
        say(name)
        return _Quiet()

    started = time.monotonic()
    made = finish_map(large, out, {"scene": scene_folder.name, "method": record}, bar)
    result = {
        "square_metres": made["area"],
        "cells": made["cells"],
        "points": made["points"],
        "cell_m": cell,
        "photographs": len(scene.names),
        "peak_memory_bytes": _peak(),
        "peak_memory_tiles_bytes": tiles_bytes,
        "tile_seconds": tiles_seconds / 4,
        "seconds": time.monotonic() - started,
        "disk_bytes": sum(path.stat().st_size for path in out.rglob("*") if path.is_file() and path.suffix != ".npz"),
        "surface_bytes": (out / DSM).stat().st_size,
        **describe(),
    }
    shutil.rmtree(out)
    shutil.rmtree(few)
    write_json(runs / "map_memory.json", result)
    return result


class _Quiet:
    """A progress bar that shows nothing."""

    def __enter__(self) -> Callable[[int, int], None]:
        return lambda done, whole: None

    def __exit__(self, *_: object) -> None:
        return None


def _peak() -> int:
    """Largest resident memory of this process so far, bytes."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
