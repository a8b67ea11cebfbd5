"""Processes: what signals end, and what ends with the process that started it."""

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor
from pathlib import Path

import pytest

from tidefield import processes
from tidefield.compare.run import run_measured
from tidefield.errors import SceneError

ROOT = Path(__file__).parents[1]
WORK = """
import os, time

def work(file):
    open(file, "w").write(str(os.getpid()))
    time.sleep(60)

def start():
    import tidefield.survey  # whose pycolmap handles SIGTERM in its own way
"""
CHILD = """
import sys
from tidefield.processes import worker_processes
from tidefield.compare.run import run_measured
from own_work import start, work

if __name__ == "__main__":
    from tidefield.processes import ended_by_signals
    with ended_by_signals():
        if sys.argv[1] == "pool":
            with worker_processes(1, start) as pool:
                pool.submit(work, sys.argv[2]).result()
        else:
            code = f"import os, time; open({sys.argv[2]!r}, 'w').write(str(os.getpid())); time.sleep(60)"
            run_measured([sys.executable, "-c", code], {})
"""


def start(folder: Path, kind: str) -> tuple[subprocess.Popen[str], int]:
    """A process with a child of a kind, and the child's number."""
    program, file = folder / "program.py", folder / "child"
    program.write_text(CHILD)
    (folder / "own_work.py").write_text(WORK)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(program), kind, str(file)]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert within(30, lambda: file.exists() and file.read_text() != ""), "it did not start"
    return process, int(file.read_text())


def within(seconds: float, condition) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


def has_ended(number: int) -> bool:
    stat = Path(f"/proc/{number}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z"


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("kind", ["pool", "measured"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_children_end_with_the_process_that_started_them(number: signal.Signals, kind: str, tmp_path: Path):
    process, child = start(tmp_path, kind)
    process.send_signal(number)
    _, message = process.communicate(timeout=20)
    assert within(10, lambda: has_ended(child))
    assert "SIGTERM received" not in message, "pycolmap's handler prints its stack"
    if number != signal.SIGKILL:
        assert f"Ended: {number.name}" in message


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_command_with_its_exit_status(number: signal.Signals):
    # What runs in a shell's background, as the tests may, ignores SIGINT; its children do, too.
    code = "import signal, time; signal.signal(signal.SIGINT, signal.default_int_handler); from tidefield import cli"
    run = "cli._run = lambda _: (print('x', flush=True), time.sleep(60)); cli.main()"
    command = [sys.executable, "-c", f"{code}; {run}"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "x\n"
    process.send_signal(number)
    _, message = process.communicate(timeout=20)
    assert (process.returncode, message) == (128 + number, f"tidefield: interrupted ({number.name})\n")


def test_nohup_keeps_its_meaning():
    code = "import signal, os; from tidefield import cli; cli._run = lambda _: os.kill(os.getpid(), signal.SIGHUP)"
    ignore = f"import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN); {code}; cli.main()"
    assert subprocess.run([sys.executable, "-c", ignore], cwd=ROOT, check=False).returncode == 0


def test_windows_is_given_no_function_to_call_before_a_program(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "platform", "win32")
    assert runpy.run_path(processes.__file__)["end_with_parent"] is None


def test_a_process_is_measured_without_its_memory_where_the_system_does_not_tell_that(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.delattr(os, "wait4", raising=False)
    usage = run_measured([sys.executable, "-c", "pass"], {})
    assert usage.seconds > 0
    assert usage.peak_memory_bytes is None
    with pytest.raises(SystemExit, match="3"):
        run_measured([sys.executable, "-c", "raise SystemExit(3)"], {})


INTERRUPTED = """
import multiprocessing.util as util, signal
from tidefield.processes import Ended, ended_by_signals, worker_processes

spawn = util.spawnv_passfds

def spawn_and_interrupt(*given):
    number = spawn(*given)
    if "spawn_main" in str(given):
        signal.raise_signal(signal.SIGTERM)
    return number

if __name__ == "__main__":
    util.spawnv_passfds = spawn_and_interrupt
    try:
        with ended_by_signals(), worker_processes(2) as pool:
            print("worked", pool.submit(int).result())
    except Ended:
        print("ended")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="processes are spawned otherwise")
def test_a_signal_waits_until_the_workers_have_been_started(tmp_path: Path):
    program = tmp_path / "program.py"
    program.write_text(INTERRUPTED)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, str(program)], env=environment, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr, done.returncode) == ("ended\n", "", 0)


def test_a_script_without_a_main_block_starts_workers(tmp_path: Path):
    program = tmp_path / "program.py"
    program.write_text(
        "from tidefield.processes import worker_processes\n"
        "with worker_processes(2) as pool:\n    print('worked', list(pool.map(int, '12')))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, str(program)], env=environment, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr, done.returncode) == ("worked [1, 2]\n", "", 0)


def fail_while_busy(pool: Executor) -> None:
    pool.submit(int).result()
    pool.submit(time.sleep, 100)
    raise SceneError("no scene")


def test_an_error_ends_the_processes_of_its_pool_and_no_other(monkeypatch: pytest.MonkeyPatch):
    class Other:
        killed = False

        def kill(self) -> None:
            self.killed = True

    other = Other()  # a loader of somebody who calls this program
    monkeypatch.setattr(multiprocessing, "active_children", lambda: [other])
    start = time.monotonic()
    with pytest.raises(SceneError, match="no scene"), processes.worker_processes(1) as pool:
        fail_while_busy(pool)
    assert time.monotonic() - start < 60
    assert not other.killed


def test_a_pool_on_windows_has_no_more_processes_than_its_call_can_wait_for(monkeypatch: pytest.MonkeyPatch):
    counts = []

    class Pool:
        def __init__(self, count: int, *_: object) -> None:
            counts.append(count)

        def shutdown(self, cancel_futures: bool) -> None:
            pass

    monkeypatch.setattr(processes, "_Pool", Pool)
    for platform, count in (("win32", 128), ("win32", 4), ("linux", 128)):
        with monkeypatch.context() as patch:
            patch.setattr(sys, "platform", platform)
            with processes.worker_processes(count):
                pass
    assert counts == [61, 4, 128]
