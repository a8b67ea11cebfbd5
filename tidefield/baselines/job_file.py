"""The file job.json of a training by another program: the factor of what it was given, and how far it has trained."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from tidefield.config import Range, from_json
from tidefield.errors import RunError
from tidefield.files import read_json

JOB_FILE = "job.json"
_TYPES = {
    "factor": tuple[(Annotated[float, Range(1e-9, 1)],) * 3],
    "trained": tuple[Annotated[int, Range(0, (1 << 63) - 1)], Annotated[float, Range(0, 1e12)]],
}


def read_job(path: Path, result: str) -> dict[str, Any]:
    """Read the job of a training that is complete: the factor, steps and seconds (`trained`), and what else it holds.

    Args:
        result: what such a training leaves, for the message.

    Raises:
        RunError: the file is damaged, or training has not come to its end.
    """
    job = read_json(path) or {}
    if not isinstance(job, dict):
        raise RunError(f"{path} is damaged: expected what training wrote; train it with --overwrite")
    if "trained" not in job:
        raise RunError(f"{path.parent} has not been trained to its end: expected {result}; train it with --overwrite")
    return job | {name: from_json(kind, job.get(name), f"{path}: {name}") for name, kind in _TYPES.items()}


def failure(program: str, log: Path, purpose: str) -> RunError:
    """The error of a program that ended too early, with the last line that it printed."""
    tail = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
    return RunError(
        f"{program} ended before it was done ({tail[0][:200] if tail else 'no message'}): expected it to {purpose}; "
        f"read {log}"
    )
