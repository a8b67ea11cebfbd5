"""The machine a process runs on: its cores, how their threads wait, and a description for records.

Imports nothing heavy, so that it can be used before torch is imported.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tidefield import __version__


def cores() -> int:
    """Number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def spin_briefly() -> None:
    """Limit how long OpenMP's threads spin while they wait, unless the user has; call before torch is imported.

    Threads that spin long take the cores from threads that have work, and a busy machine becomes several times slower;
    threads that do not spin at all wake up late on a quiet one.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")


def describe() -> dict[str, Any]:
    """Date, program version and machine, for the record of a measurement."""
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
