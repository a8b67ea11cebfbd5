"""Run a function on many items as tasks of a Ray cluster.

Ray schedules, and repeats the tasks of a worker that dies: nothing else is lost. A worker prepares once (opens a scene,
loads a network), and works on as many items as it gets.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar, no_type_check

from tidefield.errors import RunError, need
from tidefield.machine import cores

log = logging.getLogger(__name__)

Item = TypeVar("Item")
Group = TypeVar("Group")
Options = TypeVar("Options")
Work = Callable[[Any], Any]
RETRIES = 20
"""Times that a task is repeated whose worker died."""


@dataclass(frozen=True)
class Share:
    """What a task has to itself: cores, and GPUs, of which several tasks may share one."""

    cores: float = 1.0
    gpus: float = 0.0


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """Connect to a cluster while the block lasts: `auto` finds the running one, or starts one on this machine.

    Raises:
        RunError: Ray is not installed, or does not answer.
    """
    ray = need("ray", "cluster")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray's default from its next version on
    # Where a cluster was found is none of a user's business, and --quiet leaves out warnings, too.
    start = partial(ray.init, log_to_driver=False, logging_level=max(logging.WARNING, log.getEffectiveLevel()))
    in_main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM)
    try:
        try:
            start(address=address)
        except ConnectionError:
            if address != "auto":
                raise
            start(address="local", num_cpus=cores(), include_dashboard=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise RunError(
            f"no Ray cluster answers at {address} ({error}): expected `auto` or an address such as 10.0.0.1:6379; "
            "start one with `ray start --head`, and set RAY_AUTH_MODE=token if it has a token"
        ) from error
    try:
        if in_main and before is not None:
            signal.signal(signal.SIGTERM, before)  # Ray replaces it
        yield ray
    finally:
        ray.shutdown()


def share_of(ray: Any, device: str, of: Literal["core", "gpu", "machine"]) -> Share:
    """What a task asks the cluster for.

    Args:
        ray: of `connected`.
        device: as in --device; tasks on a CPU ask for no GPU.
        of: a core with its part of its machine's GPUs, a core with a GPU, or a whole machine: where machines differ,
            one with the most GPUs, else the most cores.
    """
    machines = _machines(ray)
    all_gpus = [0.0 if device == "cpu" else machine.get("GPU", 0.0) for machine in machines]
    gpus, own_cores = max((g, machine.get("CPU", 1.0)) for g, machine in zip(all_gpus, machines, strict=True))
    if of == "machine":
        return Share(own_cores, gpus)
    if of == "gpu":
        return Share(1.0, min(1.0, gpus))
    return Share(1.0, int(1e4 * min(1.0, gpus / own_cores)) / 1e4)  # Ray counts in steps of 1e-4


def cores_of(ray: Any) -> int:
    """Cores of a cluster, all machines together."""
    return max(1, int(sum(machine.get("CPU", 0) for machine in _machines(ray))))


def _machines(ray: Any) -> list[dict[str, float]]:
    """What each machine has."""
    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def on_cluster(
    ray: Any,
    key: str,
    prepare: Callable[[], AbstractContextManager[Work]],
    items: Sequence[Item],
    share: Share = Share(),
    in_order: bool = False,
) -> Iterator[tuple[Item, Any]]:
    """Work on items as tasks of a cluster; yields each item with what was made of it, when it is done.

    Args:
        ray: of `connected`.
        key: identifies the job.
        prepare: opens the function of an item; called once in each worker process, in which it stays open. Both run on
            other machines, so files that they name must be there under the same names.
        share: of a task.
        in_order: yield in the order of the items. What is made early waits in Ray's memory, or on its disk.

    Raises:
        RunError: workers died again and again with one item. Errors of the function itself are raised as they are.
    """
    waiting = _started(ray, _work, key, prepare, items, share)
    while waiting:
        done = next(iter(waiting)) if in_order else ray.wait(list(waiting), num_returns=1)[0][0]
        item = waiting.pop(done)
        yield item, _made(ray, done, item)


def each_on_cluster(
    ray: Any,
    key: str,
    prepare: Callable[[], AbstractContextManager[Callable[[Any], Iterator[Any]]]],
    groups: Sequence[Group],
    share: Share = Share(),
) -> Iterator[Any]:
    """Work on groups of items as tasks of a cluster; yields what is made of each item when it is done.

    Args:
        ray, key, share: as of `on_cluster`.
        prepare: opens a function that works on a group and yields what it makes of each item. It is called again, and
            has to yield the same again, for the group of a worker that dies.

    Raises:
        RunError: as of `on_cluster`.
    """
    waiting = _started(ray, _each, key, prepare, groups, share, num_returns="streaming")
    while waiting:
        made = ray.wait(list(waiting), num_returns=1)[0][0]
        try:
            one = next(made)
        except StopIteration:
            del waiting[made]
        else:
            yield _made(ray, one, waiting[made])


def _started(
    ray: Any,
    function: Callable[..., Any],
    key: str,
    prepare: object,
    items: Sequence[Item],
    share: Share,
    **options: str,
) -> dict[Any, Item]:
    """Start a task for each item; returns what to wait for, with the items."""
    task = ray.remote(num_cpus=share.cores, num_gpus=share.gpus, max_retries=RETRIES, **options)(function)
    shared = ray.put(prepare)
    return {task.remote(key, shared, item): item for item in items}


def _made(ray: Any, reference: Any, item: object) -> Any:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    except ray.exceptions.RayError as error:
        raise RunError(
            f"workers of the cluster died {RETRIES + 1} times with {item} ({type(error).__name__}): expected them "
            "to go on, with memory enough for it; repeat the command, which continues from there"
        ) from error


_OPEN = ExitStack()
_READY: dict[str, Work] = {}
"""What this worker has prepared, by the key of the job; of the running job only."""


def _work(key: str, prepare: Callable[[], AbstractContextManager[Work]], item: Any) -> Any:
    if key not in _READY:
        _READY.clear()
        _OPEN.close()
        _READY[key] = _OPEN.enter_context(prepare())
    return _READY[key](item)


@no_type_check  # Ray wants a generator function, and not what checks one in the tests
def _each(key: str, prepare: Callable[[], AbstractContextManager[Work]], group: Any) -> Iterator[Any]:
    yield from _work(key, prepare, group)


def require_same(source: Path, key: str, own_key: str) -> None:
    """Raises: RunError when a worker's own key of a job differs: its files are others."""
    if own_key != key:
        raise RunError(
            f"{source} is something else on a worker of the cluster: expected the same files under the same names on "
            "all machines; use a shared folder"
        )


def absolute(options: Options) -> Options:
    """The same options, for processes in other folders: the paths of a dataclass, and of those in it, are absolute."""
    changed = {}
    for name in (field.name for field in fields(options)):  # type: ignore[arg-type]
        value = getattr(options, name)
        if isinstance(value, Path):
            changed[name] = value.resolve()
        elif is_dataclass(value):
            changed[name] = absolute(value)
    return replace(options, **changed)  # type: ignore[type-var]
