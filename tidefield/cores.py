"""The cores that there are to work with, and how their threads wait."""

from __future__ import annotations

import os
import sys


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def spin_briefly() -> None:
    """Set how long OpenMP's threads wait spinning for work, unless the user has; before torch is imported.

    Those that spin long take the cores from threads that have work, and a busy machine becomes several times slower;
    those that do not spin at all wake up late on a quiet one.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
