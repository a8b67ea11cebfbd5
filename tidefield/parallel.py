"""Many independent pieces of tensor work on the cores of one machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import torch

T = TypeVar("T")
_SEQUENTIAL = ContextVar("sequential", default=False)


def in_parallel(tasks: list[Callable[[], T]], device: torch.device | str) -> list[T]:
    """Run tasks at the same time where the device is a CPU; returns their results in their order.

    Each task gets one core for all of its operations. Sharing every small operation among the cores instead costs
    a hand-over per operation, several times the work itself on a busy machine; and this way the results cannot
    depend on the number of cores.
    """
    if torch.device(device).type != "cpu" or _SEQUENTIAL.get():
        return [task() for task in tasks]
    cores = torch.get_num_threads()
    try:
        # A thread's own number of cores; it becomes the default of threads yet to come, too, hence the last line.
        with ThreadPoolExecutor(cores, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(lambda task: task(), tasks))
    finally:
        torch.set_num_threads(cores)


@contextmanager
def sequential() -> Iterator[None]:
    """Make `in_parallel` run its tasks one after another in the calling thread, for profiling."""
    token = _SEQUENTIAL.set(True)
    try:
        yield
    finally:
        _SEQUENTIAL.reset(token)
