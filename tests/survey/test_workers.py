"""However `tidefield prepare` ends, its worker processes end with it, without a word of C++."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ground_flight import fly

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are listed in /proc")


def workers(parent: int) -> list[int]:
    """Processes that a process has spawned; ps names those that have ended, but were not waited for, Z."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, own = stat.read_text().rpartition(")")[2].split()[:2]
            if int(own) == parent and state != "Z" and b"spawn_main" in stat.with_name("cmdline").read_bytes():
                found.append(int(stat.parent.name))
        except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            continue
    return found


def started(worker: int) -> bool:
    """Whether a process has loaded numpy: before, Python itself reads what to do, and complains if nobody tells it."""
    try:
        return "numpy" in Path(f"/proc/{worker}/maps").read_text()
    except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
        return True


def wait_for(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_prepare(number: signal.Signals, tmp_path: Path):
    fly(tmp_path / "card", rows=2, columns=3)
    command = [sys.executable, "-m", "tidefield.cli", "prepare", str(tmp_path / "card"), str(tmp_path / "scene")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        wait_for(lambda: workers(process.pid) or process.poll() is not None)
        wait_for(lambda: all(map(started, workers(process.pid))))
        spawned = workers(process.pid)
        assert spawned
        process.send_signal(number)
        _, messages = process.communicate(timeout=60)
    assert process.returncode != 0
    wait_for(lambda: not any(Path(f"/proc/{worker}").exists() for worker in spawned))
    assert "***" not in messages
    assert "Traceback" not in messages
