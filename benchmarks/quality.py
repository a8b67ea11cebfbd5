"""Floors and presets on real scenes, each in processes of its own, one after another.

RUNS/SCENE/METHOD/ holds what `tidefield train` and `tidefield evaluate` write, and process.json: what they took. What
has an evaluation.json is not repeated; a training that was broken off begins anew, so that its figures are those of one
process.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.records import Runner, read_json, stamp, tidefield, write_json
from tidefield.errors import RunError, SceneError

SCENES = ("caliterra", "swindale", "turin_lot", "brighton_beach")
FLOORS = ("plane-sweep", "sparse-depth")
PROCESS_FILE, EVALUATION_FILE, RUN_FILE = "process.json", "evaluation.json", "run.json"


@dataclass(frozen=True)
class Settings:
    """What all scenes and methods share."""

    minutes: float
    width: int
    device: str


def steps(data: Path, runs: Path, scene: str, method: str, settings: Settings) -> dict[str, list[str]]:
    """A method's tidefield commands on a scene, by name, in their order."""
    source, folder = str(data / scene), str(runs / scene / method)
    device = ["--device", settings.device]
    if method in FLOORS:
        return {"evaluate": ["evaluate", source, folder, "--method", method, "--width", str(settings.width), *device]}
    budget = ["--minutes", f"{settings.minutes:g}", "--width", str(settings.width)]
    return {
        "train": ["train", source, folder, "--preset", method, *budget, *device],
        "evaluate": ["evaluate", folder, *device],
    }


def measure_quality(
    data: Path,
    runs: Path,
    scenes: Sequence[str],
    methods: Sequence[str],
    settings: Settings,
    run: Runner,
    say: Callable[[str], object],
) -> None:
    """Train and evaluate what has not been evaluated yet.

    Raises:
        SceneError: a scene is not there.
        RunError: a command failed, or a folder holds results of other settings.
    """
    missing = [scene for scene in scenes if not (data / scene).is_dir()]
    if missing:
        there = sorted(path.name for path in data.iterdir() if path.is_dir()) if data.is_dir() else "nothing"
        raise SceneError(
            f"{data} has no {', '.join(missing)} (found: {there}): expected a folder of each; name others with --scenes"
        )
    pairs = [(scene, method) for scene in scenes for method in methods]
    for scene, method in pairs:
        _refuse_other_settings(runs / scene / method, method, settings)
    for number, (scene, method) in enumerate(pairs, start=1):
        title = f"{scene}, {method} ({number} of {len(pairs)})"
        if (runs / scene / method / EVALUATION_FILE).exists():
            say(f"{title}: is there")
            continue
        for name, words in steps(data, runs, scene, method, settings).items():
            say(f"{title}: {name}")
            shown = steps(Path("DATA"), Path("RUNS"), scene, method, settings)[name]
            _step(runs / scene / method, name, words, shown, settings, run)


def _refuse_other_settings(folder: Path, method: str, settings: Settings) -> None:
    wanted, found = asdict(settings), (read_json(folder / PROCESS_FILE) or {}).get("settings")
    if method in FLOORS and found is not None:
        found = found | {"minutes": settings.minutes}
    if found not in (None, wanted):
        raise RunError(f"{folder} was made with {found}: expected {wanted}; name another folder with --runs")


def _step(folder: Path, name: str, words: list[str], shown: list[str], settings: Settings, run: Runner) -> None:
    """One command, unless it is a training that has ended, and what it took."""
    record = read_json(folder / PROCESS_FILE) or {"settings": asdict(settings)}
    if name == "train" and name in record:
        return
    again = ["--overwrite"] if name == "train" and (folder / RUN_FILE).exists() else []
    took = run(tidefield(*words, *again), {})
    record[name] = {"command": shlex.join(["tidefield", *shown]), **asdict(took), **stamp()}
    write_json(folder / PROCESS_FILE, record)
