"""Processes: signals that end a command, and children that end with the process that started them."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import spawn
from multiprocessing.context import SpawnContext, SpawnProcess
from types import FrameType
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
STOPPING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""The signals, other than Ctrl-C's SIGINT, that ask a process to end; Windows has no SIGHUP."""
_SET_PARENT_DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of prctl.h."""
end_with_parent: Callable[[], object] | None = None
"""For `Popen(preexec_fn=...)`: has the kernel end the process (SIGTERM) when the thread that started it ends, by
whatever; on Linux only. Windows refuses any function."""
if sys.platform == "linux":
    end_with_parent = partial(ctypes.CDLL(None).prctl, _SET_PARENT_DEATH_SIGNAL, signal.SIGTERM)
_MOST_ON_WINDOWS = 61
"""Processes of a pool, which waits for them by a call of Windows that takes 63 handles."""
Handler = Callable[[int, FrameType | None], object]


class Ended(KeyboardInterrupt):
    """A signal ended the command, as Ctrl-C does.

    Attributes:
        number: the signal's.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextmanager
def handled(handler: Handler, *numbers: int) -> Iterator[None]:
    """Call a handler for signals while the block lasts; `nohup` keeps SIGHUP ignored."""
    numbers = tuple(n for n in numbers if n == signal.SIGINT or signal.getsignal(n) is not signal.SIG_IGN)
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Raise Ended in the block on SIGTERM and SIGHUP, once: what is being cleaned up is not interrupted again."""

    def end(number: int, frame: FrameType | None) -> None:
        for each in STOPPING:
            signal.signal(each, signal.SIG_IGN)
        raise Ended(number)

    with handled(end, *STOPPING):
        yield


@contextmanager
def delayed_signals() -> Iterator[None]:
    """Handle signals that would end the command when the block has ended; for the main thread, in others nothing."""
    arrived: list[int] = []
    with ExitStack() as stack:
        if threading.current_thread() is threading.main_thread():
            stack.enter_context(handled(lambda number, frame: arrived.append(number), signal.SIGINT, *STOPPING))
        yield
    for number in arrived:
        signal.raise_signal(number)


def restore_sigterm() -> None:
    """Put back the handler that the import of pycolmap replaced by one that prints its stack."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def start_worker(*initializers: Callable[[], object]) -> None:
    """Set up a process of multiprocessing: its parent alone decides when it ends, and it ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_after_parent, daemon=True).start()
    for initialize in initializers:
        initialize()


def _end_after_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker has a parent"
    parent.join()
    os._exit(1)


_STARTING = threading.Lock()


class _Worker(SpawnProcess):
    """Does not run the script that started it, which may have no `if __name__ == "__main__"`: tasks are in modules."""

    @staticmethod
    def _Popen(process_obj: Any) -> Any:
        usual = spawn.get_preparation_data

        def without_script(name: str) -> dict[str, Any]:
            return {key: value for key, value in usual(name).items() if not key.startswith("init_main")}

        with _STARTING:
            spawn.get_preparation_data = without_script
            try:
                return SpawnProcess._Popen(process_obj)
            finally:
                spawn.get_preparation_data = usual


class _Context(SpawnContext):
    Process = _Worker


class _Pool(ProcessPoolExecutor):
    """Handles no signal while it submits: the first task starts all processes, and one whose start is interrupted waits
    in vain for what it is to run, and is not among the children yet."""

    def submit(self, *task: Any, **keywords: Any) -> Future[Any]:
        with delayed_signals():
            return super().submit(*task, **keywords)


def in_order(
    submit: Callable[[Item], Future[Result]], items: Sequence[Item], ahead: int
) -> Iterator[tuple[Item, Result]]:
    """Yield each item with its result, in the items' order.

    Args:
        submit: has an item worked on.
        items: what there is to do.
        ahead: items that are submitted before the first result is awaited, so that memory and files of what waits do
            not grow with the number of items.
    """
    waiting = deque(submit(item) for item in items[:ahead])
    for number, item in enumerate(items, start=ahead):
        result = waiting.popleft().result()
        if number < len(items):
            waiting.append(submit(items[number]))
        yield item, result


@contextmanager
def worker_processes(count: int, *initializers: Callable[[], object]) -> Iterator[ProcessPoolExecutor]:
    """Processes that work for this one, spawned, because forking a process with threads may hang.

    What they do and are given is of modules: they do not run the script that this process runs.
    They end with the block. After an error or a signal they do not finish what they are doing.
    """
    most = _MOST_ON_WINDOWS if sys.platform == "win32" else count
    pool = _Pool(min(count, most), _Context(), start_worker, initializers)
    try:
        yield pool
    except BaseException:
        for process in list((pool._processes or {}).values()):  # not a caller's other children
            process.kill()  # SIGTERM would print the stack of one that is importing pycolmap
        raise
    finally:
        pool.shutdown(cancel_futures=True)
