"""How quickly `tidefield view` answers: pictures after moves, frames while moving, and memory after many moves.

The camera flies the orbit of the scene, without a browser: what a network and a browser add is not measured.
"""

from __future__ import annotations

import os
import statistics
import threading
import time
from pathlib import Path
from typing import Any

from benchmarks.records import say
from tidefield.errors import RunError
from tidefield.files import write_json
from tidefield.machine import describe

VIEW_FILE = "view.json"
FIRST_BAR_SECONDS, SHARP_BAR_SECONDS = 0.3, 5.0
"""What the viewer is to reach on two cores with `swift`."""
SIZE_PX = (800, 600)
"""Of sharp pictures."""
STEP_DEGREES = 3.0
"""Of a move: about 120 views around."""
PATIENCE = 600.0


def view(scene: Path, runs: Path | None = None, moves: int = 100, rests: int = 5) -> dict[str, Any]:
    """Measure a scene's viewer, print and return the figures.

    Args:
        scene: Measure on this scene, with the installed weights of swift.
        runs: Store the figures in this folder's view.json.
        moves: Without rest, one after another.
        rests: Moves after which the sharp picture is waited for.
    """
    from tidefield.config import PRESETS
    from tidefield.data.load import load_scene
    from tidefield.device import choose_device
    from tidefield.methods import zero_shot
    from tidefield.render.camera_paths import make_trajectory
    from tidefield.train.checkpoint import given_or_shipped
    from tidefield.viewer.frames import SAMPLING, Frame, FrameServer
    from tidefield.viewer.preview import Preview

    if moves < 2 or rests < 1:
        raise RunError(f"{moves} moves and {rests} rests were asked for: expected at least 2 and 1; choose more")
    loaded, (width, height) = load_scene(scene), SIZE_PX
    config = PRESETS["swift"]
    render, _ = zero_shot(config, given_or_shipped(None, "swift"), loaded, choose_device("cpu"), SAMPLING)
    cameras = make_trajectory("orbit", loaded, frames=round(360 / STEP_DEGREES), width=width, height=height).cameras
    preview = Preview(loaded)
    server = FrameServer(preview, render, preview.prepare)
    shown: list[Frame] = []
    changed = threading.Condition()

    def show(frame: Frame) -> None:
        with changed:
            shown.append(frame)
            changed.notify_all()

    def move(k: int, sharp: bool) -> list[Frame]:
        """Move the camera, and wait for its coarse picture, or for the sharp one."""
        with changed:
            shown.clear()
        server.ask("viewer", cameras[k % len(cameras)], show)
        with changed:
            if not changed.wait_for(lambda: any(frame.sharp or not sharp for frame in shown), PATIENCE):
                raise RunError(f"no picture came within {PATIENCE:.0f} s: expected one; see the messages above")
            failed = next((frame.error for frame in shown if frame.error), None)
            if failed is not None:
                raise RunError(f"a picture failed ({failed}): expected one")
            return list(shown)

    try:
        begin = move(0, sharp=True)
        while preview.prepare():  # as the server does while nothing moves
            pass
        rested = [move(1 + k, sharp=True) for k in range(rests)]
        before = _resident_mb()
        start = time.monotonic()
        moving = [move(1 + rests + k, sharp=False)[0].seconds for k in range(moves)]
        seconds = time.monotonic() - start
        after = _resident_mb()
        server.leave("viewer")
        left = time.monotonic()
        while server.busy and time.monotonic() - left < PATIENCE:
            time.sleep(0.005)
        freed = time.monotonic() - left
    finally:
        server.close()
    record = {
        "scene": scene.resolve().name,
        "size_px": [width, height],
        "moves": moves,
        "first_ever": {"coarse_s": begin[0].seconds, "sharp_s": begin[-1].seconds},
        "after_a_move": {
            "coarse_s": [frames[0].seconds for frames in rested],
            "sharp_s": [frames[-1].seconds for frames in rested],
        },
        "while_moving": {
            "median_s": statistics.median(moving),
            "largest_s": max(moving),
            "frames_per_second": moves / seconds,
        },
        "memory_mb": {"before_moves": before, "after_moves": after},
        "leaving_frees_s": freed,
        "load_of_the_machine": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "command": f"python -m benchmarks view --scene {scene.name} --runs RUNS",
        **describe(),
    }
    if runs is not None:
        runs.mkdir(parents=True, exist_ok=True)
        write_json(runs / VIEW_FILE, record)
    say("\n".join(lines(record)))
    return record


def lines(record: dict[str, Any]) -> list[str]:
    """Describe the figures beside what they are to reach."""
    rest, moving, memory = record["after_a_move"], record["while_moving"], record["memory_mb"]
    coarse, sharp = statistics.median(rest["coarse_s"]), statistics.median(rest["sharp_s"])
    load = record["load_of_the_machine"]
    return [
        f"{record['scene']}, {record['size_px'][0]} x {record['size_px'][1]}, load of the machine "
        f"{'unknown' if load is None else f'{load:.1f}'}",
        f"first picture after a move: {coarse:.2f} s ({FIRST_BAR_SECONDS / coarse:.1f} times as fast as "
        f"{FIRST_BAR_SECONDS} s)",
        f"sharp: {sharp:.1f} s ({SHARP_BAR_SECONDS / sharp:.1f} times as fast as {SHARP_BAR_SECONDS:.0f} s); the very "
        f"first {record['first_ever']['sharp_s']:.1f} s",
        f"while moving: {moving['frames_per_second']:.1f} frames per second, the slowest {moving['largest_s']:.2f} s",
        f"memory: {memory['before_moves']:.0f} MB, after {record['moves']} moves {memory['after_moves']:.0f} MB",
        f"a viewer that leaves frees its work after {record['leaving_frees_s']:.2f} s",
    ]


def _resident_mb() -> float:
    """Memory of this process that is in use now, in MB; NaN where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
