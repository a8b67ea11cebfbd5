"""What measurements keep: figures as JSON, the machine that they were taken on, and what a process took.

Needs a Unix system. Imports nothing heavy: at its start, a process is charged with the peak memory of the one that
started it, so the measuring one must stay small.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tidefield import __version__
from tidefield.cores import cores
from tidefield.errors import RunError
from tidefield.files import completed_file


@dataclass(frozen=True)
class Took:
    """What a process took: wall-clock seconds, and the most memory that it held resident at once."""

    seconds: float
    peak_memory_bytes: int


Runner = Callable[[Sequence[str], Mapping[str, str]], Took]
"""Runs a command to its end, with more environment variables."""


def tidefield(*words: object) -> list[str]:
    """A command line of this environment's tidefield."""
    return [sys.executable, "-m", "tidefield.cli", *map(str, words)]


def run_measured(command: Sequence[str], environment: Mapping[str, str]) -> Took:
    """Run a command in a process of its own; it prints where we print.

    Raises:
        RunError: when it fails.
    """
    start = time.perf_counter()
    process = subprocess.Popen(command, env={**os.environ, **environment})
    try:
        # The usage of this one child; getrusage(RUSAGE_CHILDREN) is the largest of all so far.
        _, status, usage = os.wait4(process.pid, 0)
    except KeyboardInterrupt:
        process.wait()  # Ctrl-C has reached it, too, and it saves before it stops.
        raise
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RunError(
            f"`{shlex.join(command)}` ended with status {process.returncode}: expected 0; mend what it says, and "
            "repeat the benchmark, which goes on from there"
        )
    # Kilobytes on Linux, bytes on macOS.
    return Took(time.perf_counter() - start, usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024))


def stamp() -> dict[str, Any]:
    """When, with what and on which machine something is measured."""
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "version": __version__,
        "machine": {
            "processor": _processor(),
            "cores": cores(),
            "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
            "system": f"{platform.system()} {platform.machine()}",
            "python": platform.python_version(),
            "torch": version("torch"),
        },
    }


def _processor() -> str:
    if sys.platform == "darwin":
        command = ["sysctl", "-n", "machdep.cpu.brand_string"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    about = Path("/proc/cpuinfo")
    lines = about.read_text().splitlines() if about.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def write_json(path: Path, data: Any) -> None:
    """Replace a file whole or not at all."""
    with completed_file(path, overwrite=True) as partial:
        partial.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """What is in the file, or None where there is none.

    Raises:
        RunError: when it is damaged.
    """
    if not path.is_file():
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise RunError(
            f"{path} is no JSON ({error}): expected what a measurement left; delete it and repeat"
        ) from error
