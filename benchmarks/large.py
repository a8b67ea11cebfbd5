"""`tidefield prepare` on flights of many photographs: time, memory and errors, stage by stage.

A flight is made by `tidefield.synthetic.large`; each of its sizes is a record of large.json. Memory is the resident
memory of the command and of its processes together, sampled ten times a second; Linux only.
"""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from tyro.conf import Positional

from benchmarks.records import MEASURED, say
from tidefield.compare.run import tidefield
from tidefield.errors import RunError
from tidefield.files import read_json, write_json
from tidefield.machine import describe
from tidefield.processes import end_with_parent

LARGE_FILE = "large.json"
PAUSE_S = 0.1
_STARTED = re.compile(r"(?:^|\s)(\w+): started$")


def run_by_stage(command: Sequence[str], threads: int) -> dict[str, dict[str, float]]:
    """Run a command that logs "STAGE: started"; returns seconds, CPU seconds and peak memory of each stage.

    What comes before the first stage is "start".

    Raises:
        RunError: it failed.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    process = subprocess.Popen(
        command, env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
        preexec_fn=end_with_parent,
    )  # fmt: skip
    stages: dict[str, dict[str, float]] = {"start": {"seconds": 0.0, "cpu_seconds": 0.0, "peak_bytes": 0.0}}
    current, last_lines = ["start"], [""]

    def follow() -> None:
        assert process.stderr is not None
        for line in process.stderr:
            last_lines[:] = [*last_lines[-9:], line]
            found = _STARTED.search(line.rstrip())
            if found:
                current[0] = found[1]

    reader = Thread(target=follow, daemon=True)
    reader.start()
    then, before = time.monotonic(), 0.0
    while process.poll() is None:
        time.sleep(PAUSE_S)
        memory, cpu = _usage(process.pid)
        now = time.monotonic()
        stage = stages.setdefault(current[0], {"seconds": 0.0, "cpu_seconds": 0.0, "peak_bytes": 0.0})
        stage["seconds"] += now - then
        stage["cpu_seconds"] += max(cpu - before, 0.0)
        stage["peak_bytes"] = max(stage["peak_bytes"], float(memory))
        then, before = now, max(cpu, before)
    reader.join()
    assert process.stderr is not None
    process.stderr.close()
    if process.returncode != 0:
        raise RunError(f"`{' '.join(command)}` ended with status {process.returncode}: {''.join(last_lines).strip()}")
    return stages


def _usage(root: int) -> tuple[int, float]:
    """Resident bytes, and CPU seconds so far, of a process and its descendants."""
    page, tick = os.sysconf("SC_PAGE_SIZE"), os.sysconf("SC_CLK_TCK")
    table: dict[int, tuple[int, int, float]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        table[int(folder.name)] = int(fields[1]), int(fields[21]) * page, sum(map(int, fields[11:15])) / tick
    memory, cpu, waiting = 0, 0.0, [root]
    while waiting:
        number = waiting.pop()
        _, own, seconds = table.get(number, (0, 0, 0.0))
        memory, cpu = memory + own, cpu + seconds
        waiting += [child for child, (parent, _, _) in table.items() if parent == number]
    return memory, cpu


def large(
    flights: Positional[tuple[Path, ...]],
    work: Path,
    runs: Path = MEASURED,
    options: tuple[str, ...] = (),
    threads: int = 1,
) -> None:
    """Prepare flights, and store what it cost and how far the cameras are from the truth.

    Args:
        flights: Their folders.
        work: Folder for the scenes.
        runs: Store the figures in this folder's large.json; what is measured is not measured again.
        options: Of `tidefield prepare`, without their dashes, such as mapper=global.
        threads: Of each process.
    """
    words = [word for option in options for word in f"--{option}".split("=", 1)]
    record = read_json(runs / LARGE_FILE) or {"measured": {}}
    for flight in flights:
        name = " ".join([flight.resolve().name, *options])
        if name not in record["measured"]:
            say(f"{name}: prepare")
            scene = work / name.replace(" ", "_")
            stages = run_by_stage(tidefield("prepare", flight / "photographs", scene, *words), threads)
            found = {"stages": stages, "options": words, "threads": threads, **compare_with_truth(flight, scene)}
            record["measured"][name] = {**found, **describe()}
            write_json(runs / LARGE_FILE, record)
        say("\n".join([name, *lines(record["measured"][name])]))


def compare_with_truth(flight: Path, scene: Path) -> dict[str, Any]:
    """Errors of the camera positions of a prepared flight, metres: in the scene's own coordinates, and fitted.

    Fitted means after the similarity (seven numbers for the whole survey) that brings the cameras closest to the truth:
    what is left is the bend of the model and the noise of each camera.
    """
    import pycolmap

    from tidefield.data.georeference import read_georeference
    from tidefield.geometry.similarity import Similarity, refine_similarity
    from tidefield.synthetic.large import true_positions

    located = read_georeference(scene)
    assert located is not None
    assert located.frame is not None, "the flight has positions"
    truth = true_positions(flight)
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    images = [model.image(number) for number in model.reg_image_ids()]
    found = np.array([image.projection_center() for image in images])
    exact = located.frame.from_geographic(np.array([truth[image.name] for image in images]))
    off = found - exact
    start = Similarity(1.0, np.eye(3), np.zeros(3))
    left = refine_similarity(start, found, exact, np.ones_like(exact)).similarity(found) - exact
    reprojection = model.compute_mean_reprojection_error()
    return {
        "photographs": len(truth),
        "placed": len(images),
        "points": model.num_points3D(),
        "reprojection_px": reprojection,
        "off_m": {"horizontal": _rms(off[:, :2]), "vertical": _rms(off[:, 2:])},
        "fitted_m": {
            "horizontal": _rms(left[:, :2]),
            "vertical": _rms(left[:, 2:]),
            "largest": float(np.linalg.norm(left, axis=1).max()),
        },
    }


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).sum(1).mean()))


def lines(found: dict[str, Any]) -> list[str]:
    """What was measured, for people."""
    out = [
        f"{found['placed']} of {found['photographs']} photographs, {found['points']:,} points, "
        f"{found['reprojection_px']:.2f} px",
        f"cameras off by {found['off_m']['horizontal']:.2f} m horizontally and {found['off_m']['vertical']:.2f} m "
        f"vertically, after a fit by {found['fitted_m']['horizontal']:.3f} m and {found['fitted_m']['vertical']:.3f} m "
        f"(largest {found['fitted_m']['largest']:.2f} m)",
    ]
    for stage, of in [*found["stages"].items(), ("all", total(found["stages"]))]:
        each = 1000 * of["cpu_seconds"] / found["photographs"]
        out.append(
            f"{stage:13} {of['seconds']:8.1f} s  {of['cpu_seconds']:8.1f} CPU s  {each:6.0f} CPU ms each  "
            f"{of['peak_bytes'] / 1e9:5.2f} GB"
        )
    return out


def total(stages: dict[str, dict[str, float]]) -> dict[str, float]:
    """Sum of the seconds, largest peak."""
    sums = {key: sum(stage[key] for stage in stages.values()) for key in ("seconds", "cpu_seconds")}
    return {**sums, "peak_bytes": max(stage["peak_bytes"] for stage in stages.values())}
