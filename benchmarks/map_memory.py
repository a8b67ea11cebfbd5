"""Peak memory of a map of a square kilometre, simulated by repeating four tiles of a scene.

Four tiles of the scene's middle are measured and rendered, as for any map, and linked as often as the square has tiles.
Everything after them, from joining the tiles to the point cloud and the report, is made at full size.
"""

from __future__ import annotations

import os
import resource
import shutil
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from benchmarks.records import say
from tidefield.commands.common import ZeroShot, open_zero_shot
from tidefield.data.load import load_scene
from tidefield.device import choose_device
from tidefield.errors import RunError
from tidefield.files import write_json
from tidefield.machine import describe, peak_bytes
from tidefield.maps.grid import Grid, make_grid, map_frame
from tidefield.maps.make import DSM, TILES, Job, TileMaker, finish_map, make_missing, tile_file

SQUARE = "square"
"""Folder of the map."""


def map_memory(
    scene: Positional[Path], runs: Path = Path("runs/maps"), metres: float = 1000.0, cell: float = 0.05
) -> dict[str, Any]:
    """Map a square that repeats a scene's middle, store the peak memory of this process and return what was measured.

    Args:
        scene: A scene in metres, such as one of those that maps makes.
        runs: Folder for the map, which is deleted afterwards, and for map_memory.json.
        metres: Side of the square.
        cell: Side of a cell, metres.

    Raises:
        RunError: the folder is there, or the scene is too small for four tiles.
    """
    out, few = runs / SQUARE, runs / f"{SQUARE}_tiles"
    if out.exists() or few.exists():
        raise RunError(f"{out} or {few} is there already: expected a new folder; delete them, or choose another --runs")
    loaded = load_scene(scene, hold_out=False)
    render, record = open_zero_shot(ZeroShot(zero_shot=True), loaded, choose_device("cpu"))
    grid = make_grid(map_frame(loaded, None), loaded, cell)
    job = Job(loaded, grid, None, False, {})
    side = job.tiles()[0].side - 2 * job.tiles()[0].margin
    if min(grid.columns, grid.rows) < 2 * side:
        raise RunError(f"{scene} has {grid.columns} x {grid.rows} cells: expected at least {2 * side} on each side")
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
        return nullcontext(lambda done, whole: None)

    started = time.monotonic()
    made = finish_map(large, out, {"scene": scene.name, "method": record}, bar)
    result = {
        "square_metres": made["area"],
        "cells": made["cells"],
        "points": made["points"],
        "cell_m": cell,
        "photographs": len(loaded.names),
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
    say(
        f"{result['square_metres']:,.0f} m2, {result['cells']:,} cells of {100 * cell:g} cm, {result['points']:,} "
        f"points: peak memory {result['peak_memory_bytes'] / 1e9:.2f} GB, {result['seconds']:.0f} s after the tiles, "
        f"{result['tile_seconds']:.0f} s a tile, {result['disk_bytes'] / 1e9:.1f} GB of files"
    )
    return result


def _peak() -> int:
    """Largest resident memory of this process so far, bytes."""
    return peak_bytes(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
