"""Work that a GPU repeats without the processor starting each operation.

A step of training is some thousand small operations: starting them takes a processor several times as long as computing
them takes a GPU. They are the same every time, so they are recorded once, as a CUDA graph, and then started together.
"""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import fields, is_dataclass, replace
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")
R = TypeVar("R")

WARM_UPS = 3
"""Times that something is computed before it is recorded: libraries choose their algorithms, and allocate, at first."""
KEPT = 16
"""Recordings for inputs of different shapes; those that were not used for the longest time go first."""
recording_lock = threading.Lock()
"""Held while something is recorded, when no other thread of the process may use a GPU. A thread that computes beside
one that records holds it as well; what is not recorded yet is then computed without."""


def map_tensors(value: T, change: Callable[[Tensor], Tensor]) -> T:
    """Return a dataclass, or tuple, with all tensors in it changed, in the order of its fields."""
    if isinstance(value, Tensor):
        return change(value)  # type: ignore[return-value]
    if isinstance(value, tuple):
        return tuple(map_tensors(one, change) for one in value)  # type: ignore[return-value]
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: map_tensors(getattr(value, f.name), change) for f in fields(value)})
    return value


def tensors_of(value: object) -> list[Tensor]:
    """List all tensors in a dataclass, or tuple, in the order of `map_tensors`."""
    found: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        found.append(tensor)
        return tensor

    map_tensors(value, keep)
    return found


class Recorder(Generic[T, R]):
    """Computes a function of inputs from recordings, one for each kind of inputs.

    Args:
        compute: the function. Values of tensors must not decide what it computes, and nothing may be moved from or to
            the processor.
        device: where it computes, a GPU.
        after: times that a kind of inputs is computed before it is recorded, since some do not come again.
    """

    def __init__(self, compute: Callable[[T], R], device: torch.device, after: int = 0) -> None:
        self._compute, self._device, self._after = compute, device, after
        self._seen: Counter[Hashable] = Counter()
        self._kept: OrderedDict[Hashable, _Recording[T, R]] = OrderedDict()
        # One recording at a time is in use: they share their memory.
        self._pool: Any = torch.cuda.graph_pool_handle()

    def __call__(self, inputs: T, kind: Hashable = None) -> R:
        """Compute the function; tensors that it returns are valid until the next call.

        Args:
            inputs: on any device.
            kind: what decides about the operations besides the shapes of the inputs.
        """
        key = kind, tuple((tensor.shape, tensor.dtype) for tensor in tensors_of(inputs))
        with torch.cuda.device(self._device):
            if key not in self._kept:
                self._seen[key] += 1
                if self._seen[key] <= self._after or not recording_lock.acquire(blocking=False):
                    return self._compute(moved(inputs, self._device))
                try:
                    while len(self._kept) >= KEPT:
                        self._kept.popitem(last=False)
                    self._kept[key] = _Recording(self._compute, inputs, self._device, self._pool)
                finally:
                    recording_lock.release()
            self._kept.move_to_end(key)
            return self._kept[key].replay(inputs)


def moved(inputs: T, device: torch.device) -> T:
    """Return inputs from the processor on a device; on a GPU of CUDA without waiting for what it is at work on."""
    if device.type == "cpu":
        return inputs
    # Others, such as MPS, may read the memory of a tensor that is released meanwhile.
    ahead = device.type == "cuda"
    return map_tensors(inputs, lambda tensor: tensor.to(device, non_blocking=ahead and tensor.device.type == "cpu"))


class _Recording(Generic[T, R]):
    def __init__(self, compute: Callable[[T], R], inputs: T, device: torch.device, pool: Any) -> None:
        self._inputs = map_tensors(inputs, lambda tensor: tensor.to(device, copy=True))
        aside = torch.cuda.Stream(device)
        aside.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(aside):
            for _ in range(WARM_UPS):
                compute(self._inputs)
        torch.cuda.current_stream(device).wait_stream(aside)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, pool=pool):
            self._result = compute(self._inputs)

    def replay(self, inputs: T) -> R:
        for own, given in zip(tensors_of(self._inputs), tensors_of(inputs), strict=True):
            own.copy_(given, non_blocking=given.device.type == "cpu")
        self._graph.replay()
        return self._result
