"""A map on a cluster of this machine: how much faster two workers are than one, and what killed workers cost.

Each worker has one core. Three maps are made of a square in the middle of a survey: by two workers, by two workers of
which one is killed at random moments, and by one. Their files must be the same byte for byte. Linux only.
"""

from __future__ import annotations

import json
import os
import random
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from benchmarks.records import MEASURED, say, show
from tidefield.compare.run import tidefield
from tidefield.compare.tables import Table
from tidefield.data.georeference import read_georeference
from tidefield.data.load import load_scene
from tidefield.errors import RunError
from tidefield.files import read_json, write_json
from tidefield.machine import describe
from tidefield.maps.grid import make_grid, map_frame
from tidefield.maps.make import TILES, Job
from tidefield.processes import end_with_parent

CLUSTER_FILE = "cluster.json"
HOST, PORT = "127.0.0.1", 6399
START_SECONDS, PAUSE_SECONDS = 60.0, 0.1
WORKER = b"ray::_each"
"""Begins the command line of a process that works on tiles."""
COMPARED = (".tif", ".laz", ".geojson")
"""Suffixes of a map's files that hold no dates."""


def cluster(
    scene: Positional[Path],
    work: Positional[Path],
    runs: Path = MEASURED,
    metres: float = 1000.0,
    cell: float = 0.2,
    kills: int = 10,
    seed: int = 0,
) -> None:
    """Make the maps, and store their figures.

    Args:
        scene: A survey that is larger than the square.
        work: Folder for the maps; those that the record has are not made again.
        runs: Store the figures in this folder's cluster.json.
        metres: Side of the square in the survey's middle that is mapped.
        cell: Side of a cell, metres.
        kills: How often a worker is killed.
        seed: Of the moments.

    Raises:
        RunError: the survey is too small or not georeferenced, a command failed, or a map differs from another one.
    """
    square, tiles = _square(scene, work, metres, cell)
    if kills > max(0, tiles - 3):
        raise RunError(f"--kills {kills} was asked for, of {tiles} tiles: expected at most {max(0, tiles - 3)}")
    options = [scene, "--zero-shot", "--device", "cpu", "--gsd", cell, "--area", square, "--quiet"]
    record: dict[str, Any] = read_json(runs / CLUSTER_FILE) or {}
    made: dict[str, Any] = record.get("maps", {})
    for name, workers, count in (("two", 2, 0), ("killed", 2, kills), ("one", 1, 0)):
        if name in made and (work / name).exists():
            continue
        say(f"{name}: {workers} workers, {count} kills")
        after = _moments(tiles, count, random.Random(seed))
        with _cluster(workers) as address:
            made[name] = {"workers": workers, **_map(options, work / name, address, after)}
        record = {
            "scene": scene.name,
            "square_metres": metres**2,
            "cell_m": cell,
            "tiles": tiles,
            "maps": made,
            "command": f"python -m benchmarks cluster SCENE WORK --metres {metres:g} --cell {cell:g} --kills {kills} "
            f"--seed {seed}",
            **describe(),
        }
        write_json(runs / CLUSTER_FILE, record)
    files, different = _compare([work / name for name in made])
    record |= {"files": files, "different": different}
    write_json(runs / CLUSTER_FILE, record)
    if different:
        raise RunError(f"{len(different)} of {files} files differ between the maps in {work}: expected equal ones")
    show(tables(record))
    say(f"{files} files are the same in all maps")


def tables(record: dict[str, Any]) -> list[Table]:
    """What the maps took, against those of one worker."""
    labels = {"one": "one worker", "two": "two workers", "killed": "two workers, killed"}
    rows = [
        [
            labels[name],
            str(own["kills"]),
            f"{own['tiles_seconds']:.0f}",
            f"{record['maps']['one']['tiles_seconds'] / own['tiles_seconds']:.2f}",
            f"{own['seconds']:.0f}",
            f"{record['maps']['one']['seconds'] / own['seconds']:.2f}",
        ]
        for name, own in ((name, record["maps"][name]) for name in labels)
    ]
    title = (
        f"A map of {record['square_metres']:,.0f} m2 with cells of {100 * record['cell_m']:g} cm, "
        f"{record['tiles']} tiles"
    )
    return [Table(title, ["", "kills", "tiles, s", "times one worker", "all, s", "times one worker"], rows)]


def _square(scene_folder: Path, work: Path, metres: float, cell: float) -> tuple[Path, int]:
    """Write a square in the middle of a survey as GeoJSON; returns it with the number of its tiles."""
    scene = load_scene(scene_folder, hold_out=False)
    frame = map_frame(scene, read_georeference(scene.root))
    if frame.frame is None:
        raise RunError(f"{scene_folder} is not georeferenced: expected a survey in metres")
    east, north = np.median(frame.to_map(scene.cameras.position_world.double().numpy())[:, :2], axis=0)
    half = metres / 2
    bounds = (east - half, north - half, east + half, north + half)
    grid = make_grid(frame, scene, cell, bounds)
    if min(grid.columns, grid.rows) * cell < 0.99 * metres:
        raise RunError(f"{scene_folder} is smaller than {metres:g} m: expected a larger survey, or fewer --metres")
    west, south, east, north = bounds
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    work.mkdir(parents=True, exist_ok=True)
    shape = {"type": "Polygon", "coordinates": [ring]}
    crs = {"type": "name", "properties": {"name": frame.horizontal_wkt}}
    feature = {"type": "Feature", "properties": {}, "geometry": shape}
    path = work / "square.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    return path, len(Job(scene, grid, None, False, {}).tiles())


def _moments(tiles: int, count: int, random_: random.Random) -> list[int]:
    """Numbers of finished tiles after which a worker is killed."""
    return sorted(random_.sample(range(1, tiles - 2), count))


@contextmanager
def _cluster(workers: int) -> Iterator[str]:
    """Run a cluster of this machine while the block lasts; yields its address."""
    words = ["start", "--head", "--block", "--port", PORT, "--num-cpus", workers, "--include-dashboard", "false"]
    words += ["--node-ip-address", HOST]
    command = [sys.executable, "-m", "ray.scripts.scripts", *map(str, words), "--disable-usage-stats"]
    process = subprocess.Popen(
        command, env=_environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, preexec_fn=end_with_parent
    )
    address = f"{HOST}:{PORT}"
    check = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
    try:
        started = time.monotonic()
        while subprocess.run(check, env=_environment(), capture_output=True, check=False).returncode:
            if process.poll() is not None or time.monotonic() - started > START_SECONDS:
                raise RunError(f"no Ray cluster started at {address}: expected a free port, and Ray")
        yield address
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=60)


def _environment() -> dict[str, str]:
    """A core for each worker, this tree, and no token, which Ray may want if it has once made one."""
    root = str(Path(__file__).parents[1])
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": root, "RAY_AUTH_MODE": "disabled"}


def _map(options: list[Any], out: Path, address: str, kill_after: list[int]) -> dict[str, Any]:
    """Make a map on a cluster, killing a worker each time that so many tiles are finished."""
    command = tidefield("map", options[0], out, *options[1:], "--cluster", address, "--overwrite")
    pending, ends, killed = list(kill_after), list[float](), list[float]()
    random_ = random.Random(len(kill_after))
    started = time.monotonic()
    process = subprocess.Popen(command, env=_environment(), preexec_fn=end_with_parent)
    kill_at: float | None = None
    while process.poll() is None:
        time.sleep(PAUSE_SECONDS)
        done = len(list((out / TILES).glob("*.npz")))
        now = time.monotonic() - started
        ends += [now] * (done - len(ends))
        if kill_at is None and pending and len(ends) >= pending[0]:
            # Somewhere within the tile that follows.
            kill_at = now + random_.random() * ends[-1] / len(ends)
        if kill_at is not None and now >= kill_at:
            workers = _workers()
            if workers:
                os.kill(random_.choice(workers), signal.SIGKILL)
                killed.append(round(now, 1))
                pending.pop(0)
                kill_at = None
    if process.returncode:
        raise RunError(f"{command} ended with {process.returncode}: expected a map")
    return {
        "kills": len(killed),
        "killed_after_seconds": killed,
        "tiles_seconds": ends[-1],
        "tile_seconds": statistics.median(np.diff(ends)) if len(ends) > 1 else ends[-1],
        "seconds": time.monotonic() - started,
    }


def _workers() -> list[int]:
    """Processes that work on a tile."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                if (folder / "cmdline").read_bytes().startswith(WORKER):
                    found.append(int(folder.name))
            except (FileNotFoundError, ProcessLookupError):
                continue  # it has ended
    return sorted(found)


def _compare(maps: list[Path]) -> tuple[int, list[str]]:
    """How many files maps have, and those of which not all are the same."""
    first, *others = maps
    names = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file() and path.suffix in COMPARED)
    different = [str(name) for name in names if any(not _same(first / name, other / name) for other in others)]
    return len(names), different


def _same(one: Path, other: Path) -> bool:
    return other.is_file() and one.stat().st_size == other.stat().st_size and one.read_bytes() == other.read_bytes()
