"""What a comparison has measured so far, read from its folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tidefield.compare.record import read_json
from tidefield.compare.run import EVALUATION_FILE, PROCESS_FILE, RUNS
from tidefield.train.curve import CURVE_FILE


@dataclass(frozen=True)
class Result:
    """One method on one scene.

    Attributes:
        folder: of the run.
        evaluation: its evaluation.json.
        process: its process.json: what training and evaluation took.
        curve: (seconds of training, PSNR) of a few small views; empty where none was asked for.
    """

    folder: Path
    evaluation: dict[str, Any]
    process: dict[str, Any]
    curve: list[tuple[float, float]]

    def metric(self, name: str) -> float | None:
        """A mean over the held-out photographs."""
        return self.evaluation["mean"][name]

    @property
    def trained_minutes(self) -> float | None:
        """None for what needs no training."""
        trained = self.evaluation["configuration"].get("trained")
        return trained["seconds"] / 60 if trained else None

    @property
    def steps(self) -> int | None:
        trained = self.evaluation["configuration"].get("trained")
        return trained["steps"] if trained else None

    def peak_bytes(self, step: str) -> int | None:
        """Of "train" or "evaluate"."""
        return self.process.get(step, {}).get("peak_memory_bytes")


@dataclass(frozen=True)
class Results:
    """All that is there.

    Attributes:
        scenes, methods: names, in the order of the tables.
        by: results by scene and method; what has not been measured is not in it.
    """

    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    by: dict[tuple[str, str], Result]

    def metric(self, scene: str, method: str, name: str) -> float | None:
        result = self.by.get((scene, method))
        return None if result is None else result.metric(name)

    def mean(self, method: str, name: str, scenes: Sequence[str]) -> float | None:
        """Over scenes; None unless all of them have a value."""
        values = [self.metric(scene, method, name) for scene in scenes]
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if known and len(known) == len(values) else None


def read_results(out: Path, scenes: Sequence[str], methods: Sequence[str]) -> Results:
    """What the folder of a comparison holds of these."""
    found = {}
    for scene in scenes:
        for method in methods:
            folder = out / RUNS / scene / method
            evaluation = read_json(folder / EVALUATION_FILE)
            if evaluation is not None:
                curve = [(float(x), float(y)) for x, y in read_json(folder / CURVE_FILE) or ()]
                found[scene, method] = Result(folder, evaluation, read_json(folder / PROCESS_FILE) or {}, curve)
    return Results(tuple(scenes), tuple(methods), found)
