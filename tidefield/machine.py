"""The machine a process runs on: its cores, how they and the memory are used, and a description for records.

Imports nothing heavy, so that it can be used before torch is imported.
"""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tidefield import __version__


def cores() -> int:
    """Number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


CONTAINER_LIMITS = tuple(Path("/sys/fs/cgroup", name) for name in ("memory.max", "memory/memory.limit_in_bytes"))
"""Files of Linux's control groups, of both versions, with the limit of a container's memory."""
OWN_GROUPS = Path("/proc/self/cgroup")
"""The control groups of this process, such as that of a job of Slurm: `number:controllers:path` in each line."""


def memory_bytes() -> int:
    """Memory that this process may use: the machine's, or the limit of its container or job."""
    if sys.platform == "win32":
        status = (ctypes.c_ulonglong * 8)()  # MEMORYSTATUSEX: two numbers of 32 bits, and seven of 64
        status[0] = ctypes.sizeof(status)
        if ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status)):
            return int(status[1])
        raise ctypes.WinError()
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limits = [path.read_text().strip() for path in (*CONTAINER_LIMITS, *_limits_of_groups()) if path.is_file()]
    return min([total, *(int(limit) for limit in limits if limit.isdigit())])


def _limits_of_groups() -> Iterator[Path]:
    """Files with the limits of this process's control groups, and of those that they are in."""
    lines = OWN_GROUPS.read_text().splitlines() if OWN_GROUPS.is_file() else []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        of_root = CONTAINER_LIMITS[bool(controllers)]
        for group in (Path(path), *Path(path).parents):
            yield of_root.parent / group.relative_to("/") / of_root.name


def tune_process() -> None:
    """Set up threads and memory for training; call before torch is imported.

    OpenMP's threads spin briefly while they wait, unless the user says otherwise: those that spin long take the cores
    from threads that have work, and a busy machine becomes several times slower; those that do not spin at all wake up
    late on a quiet one. And glibc keeps freed memory for the next step: by default blocks of over 32 MB go back to the
    system at once and come again as fresh, zeroed pages, which is half the time of a step. All threads share one heap:
    threads' own hold at most 64 MB, and larger blocks would be such pages again.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:  # there is none in other C libraries, such as musl
        trim_threshold, mmap_threshold, arena_max = -1, -3, -8  # M_TRIM_THRESHOLD and so on of malloc.h
        mallopt(trim_threshold, 1 << 30)
        mallopt(mmap_threshold, 1 << 30)
        mallopt(arena_max, 1)


def peak_bytes(ru_maxrss: int) -> int:
    """The peak memory of a process, in bytes: the system counts it in bytes on macOS, in kilobytes elsewhere."""
    return ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def release_memory() -> None:
    """Give memory back to the system that `tune_process` lets glibc keep; between stages that need it differently."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def describe() -> dict[str, Any]:
    """Date, program version and machine, for the record of a measurement."""
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "version": __version__,
        "commit": commit(),
        "machine": {
            "processor": _processor(),
            "cores": cores(),
            "memory_bytes": memory_bytes(),
            "system": f"{platform.system()} {platform.machine()}",
            "python": platform.python_version(),
            "torch": version("torch"),
            "gpus": _gpus(),
        },
    }


def _gpus() -> list[str]:
    """The CUDA devices; those that NVIDIA's driver lists where only children have imported torch."""
    torch = sys.modules.get("torch")
    if torch is not None:
        return [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
    command = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):  # there is no such driver
        return []


def commit() -> str | None:
    """The commit of the sources that run, with a + if they have been changed; None for an installed package."""
    root = Path(__file__).parents[1]
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):  # without git, or in another user's folder
        return None


def _processor() -> str:
    if sys.platform == "darwin":
        command = ["sysctl", "-n", "machdep.cpu.brand_string"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    about = Path("/proc/cpuinfo")
    lines = about.read_text().splitlines() if about.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
