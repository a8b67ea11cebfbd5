"""Where the time goes: the boxes of the network, timed from outside, without a line in the network for it.

Modules by their forward hooks, methods and functions by a stand-in for as long as it is measured. Whatever is not
named here (placing samples, choosing neighbours, the loss and so on) is "rest". The pieces that cores otherwise work on
side by side are done one after the other here, by all cores together: a clock can follow only one thing at a time.
"""

from __future__ import annotations

import functools
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import fields, is_dataclass
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.ceilings import synchronise
from tidefield.data.batches import draw_batch
from tidefield.model.aggregate import Aggregate
from tidefield.model.colour import ColourBlend
from tidefield.model.compositing import composite, weights
from tidefield.model.network import Network
from tidefield.model.ray_transformer import RayTransformer
from tidefield.model.views import Views

ENCODING, REST = "encoding", "rest"
_BOXES = {Aggregate: "aggregation", RayTransformer: "ray transformer", ColourBlend: "colour"}
_FUNCTIONS = ((draw_batch, "batches"), (weights, "compositing"), (composite, "compositing"))
STAGES = (
    "batches", ENCODING, "gathering", "aggregation", "ray transformer", "colour", "compositing", "backward",
    "optimiser", REST,
)  # fmt: skip
"""In the order in which they happen."""


class Clock:
    """Every moment is one stage's: of those that are under way, the one that began last.

    Attributes:
        seconds: by stage, in the order of `STAGES` in the end.
        bytes: size of what each stage handed on.
        photographs: how many, or crops of how many, were encoded.
    """

    def __init__(self, device: torch.device, now: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.bytes: dict[str, int] = defaultdict(int)
        self.photographs = 0
        self._device, self._now = device, now
        self._under_way = [REST]
        self._since = now()

    def begin(self, stage: str) -> None:
        self._charge()
        self._under_way.append(stage)

    def end(self, result: object = None) -> None:
        """The stage that began last is over, and this is what it hands on."""
        self._charge()
        self.bytes[self._under_way.pop()] += bytes_of(result)

    def stop(self) -> None:
        self._charge()
        assert self._under_way == [REST], f"{self._under_way} never ended"
        self.seconds = {stage: self.seconds[stage] for stage in STAGES if stage in self.seconds}

    def timing(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        """The same function, timed."""

        @functools.wraps(function)
        def timed_function(*args: Any, **kwargs: Any) -> Any:
            self.begin(stage)
            result = function(*args, **kwargs)
            self.end(result)
            return result

        return timed_function

    def _charge(self) -> None:
        synchronise(self._device)
        now = self._now()
        self.seconds[self._under_way[-1]] += now - self._since
        self._since = now


@contextmanager
def watched(network: Network, device: torch.device, optimizer: torch.optim.Optimizer | None = None) -> Iterator[Clock]:
    """A clock that runs, stage by stage, as long as the block."""
    clock = Clock(device)
    encode = network.encode

    def counting_encode(photographs: Tensor, *args: Any, **kwargs: Any) -> Any:
        clock.photographs += len(photographs)
        return encode(photographs, *args, **kwargs)

    with ExitStack() as stack:
        stack.enter_context(_in_turn())
        for module in network.modules():
            if stage := _BOXES.get(type(module)):
                begin, end = _hooks(clock, stage)
                stack.callback(module.register_forward_pre_hook(begin).remove)
                stack.callback(module.register_forward_hook(end).remove)
        if optimizer is not None:
            stack.callback(optimizer.register_step_pre_hook(lambda *_: clock.begin("optimiser")).remove)
            stack.callback(optimizer.register_step_post_hook(lambda *_: clock.end()).remove)
        stands_in = functools.partial(_stands_in, stack, clock)
        stack.enter_context(patch.object(network, "encode", clock.timing(counting_encode, ENCODING)))
        stands_in(Views, "read", "gathering")
        stands_in(Tensor, "backward", "backward")
        for function, stage in _FUNCTIONS:
            for holder in _holders(function):
                stands_in(holder, function.__name__, stage)
        yield clock
        clock.stop()


@contextmanager
def _in_turn() -> Iterator[None]:
    def in_turn(tasks: list[Callable[[], Any]], _: torch.device) -> list[Any]:
        return [task() for task in tasks]

    places = ("model.renderer", "train.parallel_backward")
    with ExitStack() as stack:
        for place in places:
            stack.enter_context(patch(f"tidefield.{place}.in_parallel", in_turn))
        yield


def _hooks(clock: Clock, stage: str) -> tuple[Callable[..., None], Callable[..., None]]:
    return lambda *_: clock.begin(stage), lambda module, inputs, result: clock.end(result)


def _stands_in(stack: ExitStack, clock: Clock, owner: Any, name: str, stage: str) -> None:
    stack.enter_context(patch.object(owner, name, clock.timing(getattr(owner, name), stage)))


def _holders(function: Callable[..., Any]) -> list[Any]:
    """The modules of tidefield that call a function by this name of theirs."""
    modules = [module for name, module in sys.modules.items() if name.startswith("tidefield.")]
    return [module for module in modules if vars(module).get(function.__name__) is function]


def bytes_of(result: object) -> int:
    """Size of all tensors in nested tuples, lists, dicts and dataclasses; what shares memory counts once."""
    shown, stored = defaultdict(int), {}
    for tensor in _tensors(result):
        storage = tensor.untyped_storage()
        shown[storage.data_ptr()] += tensor.numel() * tensor.element_size()
        stored[storage.data_ptr()] = storage.nbytes()
    return sum(min(size, stored[place]) for place, size in shown.items())


def _tensors(result: object) -> Iterator[Tensor]:
    if isinstance(result, Tensor):
        yield result
    elif is_dataclass(result):
        for field in fields(result):
            yield from _tensors(getattr(result, field.name))
    elif isinstance(result, (tuple, list, dict)):
        for part in result.values() if isinstance(result, dict) else result:
            yield from _tensors(part)


def flops_of(action: Callable[[], object]) -> int:
    """Multiplications and additions of an action's matrix products, convolutions and attention; nothing else counts."""
    # The counter knows no attention on CPUs; in its plain form it is two matrix products.
    with _in_turn(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        action()
    return counter.get_total_flops()
