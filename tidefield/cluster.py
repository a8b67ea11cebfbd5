"""Run a function on many items: here, or as tasks of a Ray cluster.

Ray schedules, and repeats the tasks of a worker that dies; what a task makes is a file, so nothing else is lost. A
worker prepares once (opens a scene, loads a network), and works on as many items as it gets.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from tidefield.errors import RunError
from tidefield.machine import cores

Item = TypeVar("Item")
Work = Callable[[Any], object]
RETRIES = 20
"""Times that a task is repeated whose worker died."""
_READY: dict[str, Work] = {}
"""What workers have prepared, by the key of the job; the one of the running job only."""


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """Connect to a cluster while the block lasts: `auto` finds the running one, or starts one on this machine.

    Raises:
        RunError: Ray is not installed, or does not answer.
    """
    try:
        import ray
    except ImportError as error:
        raise RunError(
            "--cluster needs Ray, which is not installed: expected the extra; pip install 'tidefield[cluster]'"
        ) from error
    # Tasks ask for cores alone, and may use the machine's GPU all the same.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    in_main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM)
    try:
        try:
            ray.init(address=address, log_to_driver=False)
        except ConnectionError:
            if address != "auto":
                raise
            ray.init(address="local", num_cpus=cores(), include_dashboard=False, log_to_driver=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise RunError(
            f"no Ray cluster answers at {address} ({error}): expected `auto` or an address such as 10.0.0.1:6379; "
            "start one with `ray start --head`"
        ) from error
    try:
        if in_main and before is not None:
            signal.signal(signal.SIGTERM, before)  # Ray replaces it
        yield ray
    finally:
        ray.shutdown()


def on_cluster(ray: Any, key: str, prepare: Callable[[], Work], items: Sequence[Item]) -> Iterator[Item]:
    """Work on items as tasks of a cluster, one core each; yields each item when it is done.

    Args:
        ray: of `connected`.
        key: identifies the job.
        prepare: returns the function of an item; called once in each worker process. Both run on other machines, so
            files that they name must be there under the same names.

    Raises:
        RunError: workers died again and again with one item. Errors of the function itself are raised as they are.
    """
    task = ray.remote(num_cpus=1, max_retries=RETRIES)(_work)
    shared = ray.put(prepare)
    waiting = {task.remote(key, shared, item): item for item in items}
    while waiting:
        done, _ = ray.wait(list(waiting), num_returns=1)
        item = waiting.pop(done[0])
        try:
            ray.get(done[0])
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except ray.exceptions.RayError as error:
            raise RunError(
                f"workers of the cluster died {RETRIES + 1} times with {item} ({type(error).__name__}): expected them "
                "to go on, with memory enough for it; repeat the command, which continues from there"
            ) from error
        yield item


def _work(key: str, prepare: Callable[[], Work], item: Any) -> None:
    if key not in _READY:
        import torch

        torch.set_num_threads(1)  # a task has one core
        _READY.clear()
        _READY[key] = prepare()
    _READY[key](item)
