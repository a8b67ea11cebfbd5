"""Read the results of a comparison from its folder, or from the JSON that it left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tidefield.compare.run import RUNS, read_evaluation, read_process
from tidefield.evaluation.curves import read_curve
from tidefield.files import read_json


@dataclass(frozen=True)
class Result:
    """One method on one scene.

    Attributes:
        evaluation: its evaluation.json.
        process: its process.json: what training and evaluation took.
        curve: (seconds of training, PSNR) of a few small views; empty where none was asked for.
        folder: of the run, with its pictures; None where only the figures are left.
    """

    evaluation: dict[str, Any]
    process: dict[str, Any] = field(default_factory=dict)
    curve: list[tuple[float, float]] = field(default_factory=list)
    folder: Path | None = None

    def metric(self, name: str) -> float | None:
        """A mean over the held-out photographs; None where it was not measured."""
        return self.evaluation["mean"].get(name)

    def trained(self, name: str) -> float | int | None:
        """The "steps" or "seconds" of its training; None for what needs none."""
        return (self.evaluation["configuration"].get("trained") or {}).get(name)


@dataclass(frozen=True)
class Results:
    """All results.

    Attributes:
        scenes, methods: names, in the order of the tables.
        by: results by scene and method; what has not been measured is missing.
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
    """Read the results of these scenes and methods from the folder of a comparison."""
    found = {}
    for scene in scenes:
        for method in methods:
            folder = out / RUNS / scene / method
            evaluation = read_evaluation(folder)
            if evaluation is not None:
                found[scene, method] = Result(evaluation, read_process(folder), read_curve(folder), folder)
    return Results(tuple(scenes), tuple(methods), found)


def figures_of(results: Results) -> list[dict[str, Any]]:
    """All results as JSON, without those of single photographs and without the scenes' paths on this machine."""
    return [
        {
            "scene": scene,
            "method": method,
            "evaluation": {key: value for key, value in result.evaluation.items() if key != "per_photograph"},
            "process": result.process
            | {"settings": {k: v for k, v in result.process.get("settings", {}).items() if k != "scene"}},
            "curve": result.curve,
        }
        for (scene, method), result in results.by.items()
    ]


def read_figures(files: Sequence[Path], scenes: Sequence[str], methods: Sequence[str] | None = None) -> Results:
    """Read results that comparisons stored as JSON (`figures_of`); of a result in several files the last one counts.

    Args:
        files: comparison.json or ablation.json; missing files are skipped.
        scenes: the order of the tables' first scenes; other scenes follow by name.
        methods: to read; all if not given, in the order of the files.
    """
    found = {}
    for file in files:
        for one in (read_json(file) or {"results": []})["results"]:
            if methods is None or one["method"] in methods:
                curve = [(float(x), float(y)) for x, y in one["curve"]]
                found[one["scene"], one["method"]] = Result(one["evaluation"], one["process"], curve)
    there = {scene for scene, _ in found}
    methods = tuple(dict.fromkeys(method for _, method in found)) if methods is None else methods
    order = (*(scene for scene in scenes if scene in there), *sorted(there - set(scenes)))
    pairs = [(scene, method) for scene in order for method in methods]
    return Results(order, tuple(methods), {pair: found[pair] for pair in pairs if pair in found})
