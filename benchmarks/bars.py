"""What the benchmarks kept in a folder, and whether it is what was aimed at."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.memory import MEMORY_FILE
from benchmarks.quality import EVALUATION_FILE, FLOORS, PROCESS_FILE, SCENES, Settings
from benchmarks.records import read_json

PRESETS = ("swift", "paper")
METHODS = (*FLOORS, *PRESETS)
SPEED_FILE = "speed.json"
JUDGED = "_seen_cc"
"""Metrics are taken over doubly seen pixels after the colour fit."""
AIM = Settings(minutes=10.0, width=400, device="cpu")
GAIN_DB, TIMES_AS_FAST = 1.5, 10.0
TRAINING_BYTES, FRAME_BYTES, FRAME_PX = 4e9, 6e9, [4000, 3000]


@dataclass(frozen=True)
class Result:
    """One method on one scene: its evaluation.json, and its process.json, empty if there is none."""

    evaluation: Mapping[str, Any]
    process: Mapping[str, Any]

    def __getitem__(self, metric: str) -> float | None:
        """Its mean over the held-out photographs."""
        return self.evaluation["mean"][metric + JUDGED]


@dataclass(frozen=True)
class Stored:
    """All that was found in a folder.

    Attributes:
        results: by scene and method.
        speed, memory: what speed.json and memory.json hold; None where there is none.
    """

    results: Mapping[str, Mapping[str, Result]]
    speed: Mapping[str, Any] | None
    memory: Mapping[str, Any] | None

    def metric(self, scene: str, method: str, metric: str) -> float | None:
        result = self.results.get(scene, {}).get(method)
        return None if result is None else result[metric]

    def gain(self, scene: str, metric: str) -> float | None:
        """Of swift over the better floor."""
        floors = [self.metric(scene, floor, metric) for floor in FLOORS]
        known = [value for value in floors if value is not None]
        return difference(self.metric(scene, "swift", metric), max(known) if len(known) == len(floors) else None)


@dataclass(frozen=True)
class Bar:
    """What was aimed at, what came out, and whether that is enough; None if it was not measured."""

    aim: str
    result: str
    met: bool | None


def read_stored(runs: Path) -> Stored:
    results: dict[str, dict[str, Result]] = {}
    for path in sorted(runs.glob(f"*/*/{EVALUATION_FILE}")):
        folder = path.parent
        if folder.name in METHODS:
            result = Result(read_json(path), read_json(folder / PROCESS_FILE) or {})
            results.setdefault(folder.parent.name, {})[folder.name] = result
    return Stored(results, read_json(runs / SPEED_FILE), read_json(runs / MEMORY_FILE))


def difference(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def judge(stored: Stored) -> list[Bar]:
    """Every bar. Results of other settings than `AIM` count as not measured."""
    under = {scene: _as_aimed(methods) for scene, methods in stored.results.items()}
    aimed = Stored(under, stored.speed, stored.memory)
    psnr = {scene: aimed.gain(scene, "psnr") for scene in SCENES}
    ssim = {scene: aimed.gain(scene, "ssim") for scene in SCENES}
    loss = {s: difference(aimed.metric(s, "swift", "psnr"), aimed.metric(s, "paper", "psnr")) for s in SCENES}
    return [
        _on_each("swift's PSNR is above the better floor on each scene", psnr, "{:+.2f} dB", lambda x: x > 0),
        _on_each("swift's SSIM is above the better floor on each scene", ssim, "{:+.4f}", lambda x: x > 0),
        _in_the_mean(f"and in the mean by {GAIN_DB} dB of PSNR", psnr),
        _speed(stored.speed),
        _on_each("swift's PSNR is not below paper's on any scene", loss, "{:+.2f} dB", lambda x: x >= 0),
        _training_memory(aimed),
        _frame_memory(stored.memory),
    ]


def _as_aimed(methods: Mapping[str, Result]) -> dict[str, Result]:
    kept = {}
    for method, result in methods.items():
        settings = result.process.get("settings")
        if settings is not None and method in FLOORS:
            settings = settings | {"minutes": AIM.minutes}
        if settings == vars(AIM):
            kept[method] = result
    return kept


def _unmeasured(aim: str, values: Mapping[str, float | None]) -> Bar | None:
    missing = [scene for scene, value in values.items() if value is None]
    return Bar(aim, f"not measured on {', '.join(missing)}", None) if missing else None


def _on_each(aim: str, values: Mapping[str, float | None], style: str, enough: Callable[[float], bool]) -> Bar:
    if unmeasured := _unmeasured(aim, values):
        return unmeasured
    worst, scene = min((value, scene) for scene, value in values.items() if value is not None)
    return Bar(aim, f"least: {style.format(worst)} ({scene})", enough(worst))


def _in_the_mean(aim: str, gains: Mapping[str, float | None]) -> Bar:
    if unmeasured := _unmeasured(aim, gains):
        return unmeasured
    known = [gain for gain in gains.values() if gain is not None]
    mean = sum(known) / len(known)
    return Bar(aim, f"{mean:+.2f} dB", mean >= GAIN_DB)


def _speed(speed: Mapping[str, Any] | None) -> Bar:
    aim = f"swift renders {TIMES_AS_FAST:.0f} times as many rays per second as paper"
    if speed is None or speed["device"] != "cpu":
        return Bar(aim, "not measured on a CPU", None)
    ratio = speed["ratios"]["rendering"]
    return Bar(aim, f"{ratio:.1f} times", ratio >= TIMES_AS_FAST)


def _training_memory(aimed: Stored) -> Bar:
    aim = f"Training at {AIM.width} px stays under {TRAINING_BYTES / 1e9:.0f} GB"
    peaks = {
        (scene, preset): aimed.results.get(scene, {}).get(preset, Result({}, {})).process.get("train", {})
        for scene in SCENES
        for preset in PRESETS
    }
    missing = dict.fromkeys(scene for (scene, _), train in peaks.items() if not train)
    if missing:
        return Bar(aim, f"not measured with both presets on {', '.join(missing)}", None)
    (scene, preset), train = max(peaks.items(), key=lambda item: item[1]["peak_memory_bytes"])
    peak = train["peak_memory_bytes"]
    return Bar(aim, f"most: {peak / 1e9:.2f} GB ({preset} on {scene})", peak < TRAINING_BYTES)


def _frame_memory(memory: Mapping[str, Any] | None) -> Bar:
    aim = f"Rendering a frame of {FRAME_PX[0]} x {FRAME_PX[1]} px stays under {FRAME_BYTES / 1e9:.0f} GB"
    if memory is None or memory["size_px"] != FRAME_PX or memory["device"] != "cpu":
        return Bar(aim, "not measured at this size on a CPU", None)
    peak = memory["peak_memory_bytes"]
    return Bar(aim, f"{peak / 1e9:.2f} GB ({memory['preset']})", peak < FRAME_BYTES)
