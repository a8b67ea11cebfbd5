"""What results were measured with, from their records: code, machines and dates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tidefield.compare.results import Result, Results
from tidefield.compare.run import STEPS

Record = Mapping[str, Any]
"""What `tidefield.machine.describe` returned, of one step of a result or of a benchmark."""
_INSTALLED = "an installed package"


def records_of(results: Results) -> list[tuple[str, Record]]:
    """The records of all trainings and evaluations, with the names of their methods."""
    return [
        (method, record)
        for (_, method), result in results.by.items()
        for step in STEPS
        if "machine" in (record := result.process.get(step, {}))
    ]


def code_and_machines(results: Results) -> list[str]:
    """Which commit and which machine measured what: code, and what a minute brings, are not the same on all of them."""
    commits = _groups({k: commit for k, one in results.by.items() if (commit := _commit_of(one))})
    machines = _groups({k: machine for k, one in results.by.items() if (machine := _machine_of(one))})

    def each(groups: Mapping[str, str]) -> str:
        return "; ".join(f"{label} ({of})" for label, of in groups.items())

    sentences = [f"Measured at commit {commit}." for commit in commits if commit != _INSTALLED]
    if len(commits) > 1:
        sentences = [f"Measured at different commits, whose code and settings differ: {each(commits)}."]
    if len(machines) > 1:
        sentences.append(
            f"Measured on different machines, on which a minute does not bring the same: {each(machines)}."
        )
    return sentences


def short(commit: object) -> str:
    """The beginning of a commit, with the + of sources that had been changed."""
    return str(commit)[:7] + "+" * str(commit).endswith("+")


def _commit_of(result: Result) -> str | None:
    """The code that a result was measured with; None where nothing was recorded, as by earlier versions."""
    records = {"train": result.process.get("train", {}), "evaluate": result.evaluation}
    found = {step: record["commit"] for step, record in records.items() if "commit" in record}
    commits = {step: short(commit) for step, commit in found.items() if commit}
    return _INSTALLED if found and not commits else _of_steps(commits)


def _machine_of(result: Result) -> str | None:
    """Where a result was measured: what its minutes depend on; None where nothing was recorded."""
    found = {step: result.process.get(step, {}).get("machine") for step in STEPS}
    return _of_steps({step: ", ".join([_cores(of), *of.get("gpus", [])]) for step, of in found.items() if of})


def _of_steps(found: Mapping[str, str]) -> str | None:
    """What was found of a result's steps: once where it is the same; None where there is nothing."""
    if len(set(found.values())) > 1:
        return f"{found['train']} for training and {found['evaluate']} for evaluation"
    return next(iter(found.values()), None)


def _cores(machine: Record) -> str:
    return f"{machine['processor']}, {machine['cores']} core{'s' * (machine['cores'] > 1)}"


def _groups(labels: Mapping[tuple[str, str], str]) -> dict[str, str]:
    """What has each label, from labels of scenes and methods: columns, or scenes of a column that has several."""
    measured = sorted((label, method, scene) for (scene, method), label in labels.items())

    def scenes(label: str, method: str) -> str:
        own = [scene for *of, scene in measured if of == [label, method]]
        return "" if len(own) == sum(other == method for _, other, _ in measured) else f" of {', '.join(own)}"

    groups = {}
    for label in dict.fromkeys(label for label, _, _ in measured):
        columns: dict[str, list[str]] = {}
        for method in sorted({method for of, method, _ in measured if of == label}):
            columns.setdefault(scenes(label, method), []).append(method)
        groups[label] = "; ".join(", ".join(methods) + of for of, methods in columns.items())
    return groups


def machines(records: Sequence[tuple[str, Record]]) -> list[str]:
    """The machines of measurements, as sentences; with the measurements' names where there are several."""
    found: dict[str, dict[str, None]] = {}
    for name, record in records:
        machine = record["machine"]
        text = (
            f"{_cores(machine)}, {machine['memory_bytes'] / 2**30:.0f} GiB; {machine['system']}, "
            f"Python {machine['python']}, torch {machine['torch']}"
            + "".join(f", {gpu}" for gpu in machine.get("gpus", []))
        )
        found.setdefault(text, {})[name] = None
    several = len(found) > 1
    return [f"Machine: {': '.join([text, ', '.join(names)] if several else [text])}." for text, names in found.items()]


def when(records: Sequence[tuple[str, Record]]) -> str:
    """Dates and versions of measurements, as the end of a sentence."""
    dates = sorted({record["date"] for _, record in records})
    versions = sorted({record["version"] for _, record in records})
    measured = " to ".join(dict.fromkeys([dates[0], dates[-1]])) if dates else "at an unknown date"
    return f"measured {measured} with Tidefield {', '.join(versions) or 'of unknown version'}"
