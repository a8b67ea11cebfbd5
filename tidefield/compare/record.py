"""What measurements keep: figures as JSON, the machine that they were taken on, and what a process took.

Needs a Unix system. Imports nothing heavy: at its start, a process is charged with the peak memory of the one that
started it, so the measuring one must stay small.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from tidefield.errors import RunError


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
