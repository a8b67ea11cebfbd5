"""Parts of a batch, each on a core of its own, forward and backward."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from tidefield.parallel import in_parallel

Part = Callable[[], tuple[Tensor, ...]]


def side_by_side(
    parts: Sequence[Part], parameters: Sequence[Tensor], device: torch.device
) -> tuple[Float[Tensor, "T *_"], ...]:
    """What the parts return, joined along the first dimension; differentiable in the parameters.

    Args:
        parts: each returns as many tensors, of its own share of the first dimension.
        parameters: all that the parts use and that learns.
        device: where that is.
    """
    return _SideBySide.apply(parts, device, *parameters)  # type: ignore[no-any-return]


class _SideBySide(torch.autograd.Function):
    """`backward` alone would walk through all parts on the one thread that calls it."""

    @staticmethod
    def forward(ctx: Any, parts: Sequence[Part], device: torch.device, *parameters: Tensor) -> tuple[Tensor, ...]:
        ctx.found = in_parallel([partial(_with_grad, part) for part in parts], device)
        ctx.parameters, ctx.device = parameters, device
        return tuple(torch.cat([part.detach() for part in values]) for values in zip(*ctx.found, strict=True))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        sizes = [len(values[0]) for values in ctx.found]
        shares = zip(*(gradient.split(sizes) for gradient in gradients), strict=True)
        tasks = [partial(_learned, *each, ctx.parameters) for each in zip(ctx.found, shares, strict=True)]
        found = in_parallel(tasks, ctx.device)
        ctx.found = None
        return None, None, *(_sum(values) for values in zip(*found, strict=True))


def _with_grad(part: Part) -> tuple[Tensor, ...]:
    with torch.enable_grad():
        return part()


def _learned(
    found: tuple[Tensor, ...], gradients: tuple[Tensor, ...], parameters: tuple[Tensor, ...]
) -> tuple[Tensor | None, ...]:
    known = [(value, gradient) for value, gradient in zip(found, gradients, strict=True) if value.requires_grad]
    values, theirs = zip(*known, strict=True)
    return torch.autograd.grad(values, parameters, theirs, allow_unused=True)


def _sum(values: Sequence[Tensor | None]) -> Tensor | None:
    """Always in the same order, so that a training can be repeated."""
    there = [value for value in values if value is not None]
    return torch.stack(there).sum(0) if there else None
