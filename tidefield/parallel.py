"""Independent pieces of work on the cores of one machine, forward and backward, and values that they share."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)
Part = Callable[[], tuple[Tensor, ...]]
_SEQUENTIAL = ContextVar("sequential", default=False)
_WORKER = threading.local()
_CHECK: ContextVar[Callable[[], None] | None] = ContextVar("check", default=None)


def in_parallel(tasks: list[Callable[[], T]], device: torch.device | str) -> list[T]:
    """Run tasks at the same time where the device is a CPU; returns their results in their order.

    Tasks run in the caller's modes of inference and gradients, which threads do not have by themselves. Each task gets
    one core for all of its operations. Sharing every small operation among the cores instead costs
    a hand-over per operation, several times the work itself on a busy machine; and this way the results cannot
    depend on the number of cores.
    """
    check = _CHECK.get()
    if check is not None:
        tasks = [partial(_checked, check, task) for task in tasks]
    if torch.device(device).type != "cpu" or _SEQUENTIAL.get() or hasattr(_WORKER, "has_one_core"):
        return [task() for task in tasks]
    inference, gradients = torch.is_inference_mode_enabled(), torch.is_grad_enabled()
    with (
        _CORES.shared() as cores,
        ThreadPoolExecutor(cores, initializer=_take_one_core) as pool,
    ):
        return list(pool.map(lambda task: _in_modes(task, inference, gradients), tasks))


def _take_one_core() -> None:
    _WORKER.has_one_core = True
    torch.set_num_threads(1)


class _Cores:
    """How many cores PyTorch has, while pools whose threads have one each work.

    A thread's own number becomes the default of threads yet to come, too: what starts meanwhile would have one core.
    """

    def __init__(self) -> None:
        self._lock, self._pools, self._count = threading.Lock(), 0, 1

    @contextmanager
    def shared(self) -> Iterator[int]:
        """Yield the number, and make it the default again."""
        with self._lock:
            if self._pools == 0:
                self._count = torch.get_num_threads()
            self._pools += 1
            count = self._count
        try:
            yield count
        finally:
            with self._lock:
                self._pools -= 1
                torch.set_num_threads(count)


_CORES = _Cores()


def _in_modes(task: Callable[[], T], inference: bool, gradients: bool) -> T:
    with torch.inference_mode(inference), torch.set_grad_enabled(gradients):
        return task()


def _checked(check: Callable[[], None], task: Callable[[], T]) -> T:
    check()
    return task()


@contextmanager
def read_ahead(read: Callable[[K], T], keys: Sequence[K], device: torch.device | str) -> Iterator[Callable[[K], T]]:
    """Read at the same time what tasks on a GPU, which run one after another (`in_parallel`), ask for in turn.

    Tasks on a CPU read for themselves.

    Args:
        read: reads what belongs to a key; threads may call it at the same time.
        keys: to read; each is asked for once.
        device: of the tasks.

    Returns:
        What tasks call in place of `read` while the block lasts.
    """
    if torch.device(device).type == "cpu" or _SEQUENTIAL.get() or len(keys) < 2:
        yield read
        return
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        pending = {key: pool.submit(read, key) for key in keys}
        yield lambda key: pending.pop(key).result() if key in pending else read(key)


@contextmanager
def interruptible(check: Callable[[], None]) -> Iterator[None]:
    """Have a function called before each piece of the work: what it raises ends the work.

    `in_parallel` calls it before each task, from the task's thread; other work by `check_interrupted`.
    """
    token = _CHECK.set(check)
    try:
        yield
    finally:
        _CHECK.reset(token)


def check_interrupted() -> None:
    """End the work of this thread here if it is not wanted any more (`interruptible`)."""
    check = _CHECK.get()
    if check is not None:
        check()


@contextmanager
def sequential() -> Iterator[None]:
    """Make `in_parallel` run its tasks one after another in the calling thread, for profiling."""
    token = _SEQUENTIAL.set(True)
    try:
        yield
    finally:
        _SEQUENTIAL.reset(token)


class SharedValues(Generic[K, T]):
    """Values that threads share: each is made once, and kept as long as there is room for it.

    Args:
        most_bytes: of all values; those that were not asked for for the longest time go first.
        count_bytes: of a value.
    """

    def __init__(self, most_bytes: int, count_bytes: Callable[[T], int]) -> None:
        self.most_bytes, self._count_bytes = most_bytes, count_bytes
        self._values: OrderedDict[K, Future[T]] = OrderedDict()
        self._bytes: dict[K, int] = {}
        self._changing = threading.Lock()

    def __contains__(self, key: K) -> bool:
        return key in self._values

    def get(self, key: K, make: Callable[[K], T]) -> T:
        """Return the value of a key, which is made if there is none; threads that ask for it meanwhile wait."""
        return self.get_all([key], make)[0]

    def get_all(self, keys: Sequence[K], make: Callable[[K], T]) -> list[T]:
        """Return the values of keys. While other threads make some of them, this one makes others."""
        return [value.result() for value in [self._begin(key, make) for key in keys]]

    def _begin(self, key: K, make: Callable[[K], T]) -> Future[T]:
        """Make a value, unless it is there or another thread makes it."""
        with self._changing:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
            future = self._values[key] = Future()
        try:
            value = make(key)
        except BaseException as error:
            with self._changing:
                del self._values[key]
            future.set_exception(error)
            raise
        future.set_result(value)
        with self._changing:
            self._bytes[key] = self._count_bytes(value)
            while len(self._bytes) > 1 and sum(self._bytes.values()) > self.most_bytes:
                oldest = next(other for other in self._values if other in self._bytes)
                del self._values[oldest], self._bytes[oldest]
        return future


def differentiable_parts(
    parts: Sequence[Part], parameters: Sequence[Tensor], device: torch.device
) -> tuple[Float[Tensor, "T *_"], ...]:
    """What the parts return, concatenated along the first dimension; differentiable in the parameters.

    Args:
        parts: each returns as many tensors, of its own share of the first dimension.
        parameters: all that the parts use and that are trained.
        device: where they are.
    """
    return _DifferentiableParts.apply(parts, device, *parameters)  # type: ignore[no-any-return]


class _DifferentiableParts(torch.autograd.Function):
    """`backward` alone would walk through all parts on the one thread that calls it."""

    @staticmethod
    def forward(ctx: Any, parts: Sequence[Part], device: torch.device, *parameters: Tensor) -> tuple[Tensor, ...]:
        ctx.outputs = in_parallel([partial(_with_grad, part) for part in parts], device)
        ctx.parameters, ctx.device = parameters, device
        return tuple(torch.cat([part.detach() for part in values]) for values in zip(*ctx.outputs, strict=True))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        sizes = [len(values[0]) for values in ctx.outputs]
        shares = zip(*(gradient.split(sizes) for gradient in gradients), strict=True)
        tasks = [partial(_gradients, *each, ctx.parameters) for each in zip(ctx.outputs, shares, strict=True)]
        found = in_parallel(tasks, ctx.device)
        ctx.outputs = None
        return None, None, *(_sum(values) for values in zip(*found, strict=True))


def _with_grad(part: Part) -> tuple[Tensor, ...]:
    with torch.enable_grad():
        return part()


def _gradients(
    outputs: tuple[Tensor, ...], gradients: tuple[Tensor, ...], parameters: tuple[Tensor, ...]
) -> tuple[Tensor | None, ...]:
    pairs = [(value, gradient) for value, gradient in zip(outputs, gradients, strict=True) if value.requires_grad]
    values, own = zip(*pairs, strict=True)
    return torch.autograd.grad(values, parameters, own, allow_unused=True)


def _sum(values: Sequence[Tensor | None]) -> Tensor | None:
    """Always in the same order, so that a training can be repeated."""
    known = [value for value in values if value is not None]
    return torch.stack(known).sum(0) if known else None
