"""Kernels for GPUs that do in one pass what torch does in many; each has a plain twin that says what it computes.

`gather.gather` has `read`, `aggregate.weighted_moments` has `moments`. The twins are what runs on a CPU; the kernels
run there, too, in Triton's interpreter (TRITON_INTERPRET=1), which is how they are tested without a GPU.

Alphabet: K maps, Q texels of all maps together, I = T N views of tiles, P samples of a tile, C channels.
"""

# pyright: reportArgumentType=false, reportIndexIssue=false
# Triton takes plain numbers where its kernels ask for constexpr, and makes functions subscriptable.

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 64
"""Samples of one program."""


@triton.jit
def _corners(uv, first, size, origin, stride, reach, count, C: tl.constexpr, CP: tl.constexpr, B: tl.constexpr):
    """A program's samples: which, which of them there are, the same with their channels; the rows of the four texels
    around each, their shares, and whether the sample lies on the map."""
    image = tl.program_id(0)
    place = tl.program_id(1) * B + tl.arange(0, B)
    inside = place < count
    sample = image * count + place
    channel = tl.arange(0, CP)[None, :]
    there = inside[:, None] & (channel < C)
    width = tl.load(size + image * 2)
    height = tl.load(size + image * 2 + 1)
    x = (tl.load(uv + sample * 2, mask=inside, other=0.0) - tl.load(origin + image * 2)) / stride
    y = (tl.load(uv + sample * 2 + 1, mask=inside, other=0.0) - tl.load(origin + image * 2 + 1)) / stride
    on_map = (x >= -reach) & (x <= width - reach) & (y >= -reach) & (y <= height - reach)
    # NaN or huge places of invalid points must still index something.
    x = tl.where(on_map, x, 0.0)
    y = tl.where(on_map, y, 0.0)
    left, top = tl.floor(x), tl.floor(y)
    right_share, low_share = x - left, y - top
    left, top = left.to(tl.int32), top.to(tl.int32)
    right = tl.minimum(left + 1, width - 1)
    low = tl.minimum(top + 1, height - 1)
    left = tl.minimum(tl.maximum(left, 0), width - 1)
    top = tl.minimum(tl.maximum(top, 0), height - 1)
    base = tl.load(first + image)
    upper, lower = base + top * width, base + low * width
    a, b, c, d = upper + left, upper + right, lower + left, lower + right
    return sample, inside, channel, there, a, b, c, d, right_share, low_share, on_map


@triton.jit
def _read_forward(
    rows, uv, first, size, origin, values, on, stride, reach, count, C: tl.constexpr, CP: tl.constexpr, B: tl.constexpr
):
    sample, inside, channel, there, a, b, c, d, right, low, on_map = _corners(
        uv, first, size, origin, stride, reach, count, C, CP, B
    )
    total = tl.load(rows + a[:, None] * C + channel, mask=there, other=0.0) * ((1 - low) * (1 - right))[:, None]
    total += tl.load(rows + b[:, None] * C + channel, mask=there, other=0.0) * ((1 - low) * right)[:, None]
    total += tl.load(rows + c[:, None] * C + channel, mask=there, other=0.0) * (low * (1 - right))[:, None]
    total += tl.load(rows + d[:, None] * C + channel, mask=there, other=0.0) * (low * right)[:, None]
    tl.store(values + sample[:, None] * C + channel, total, mask=there)
    tl.store(on + sample, on_map, mask=inside)


@triton.jit
def _read_backward(
    uv, first, size, origin, grad, out, stride, reach, count, C: tl.constexpr, CP: tl.constexpr, B: tl.constexpr
):
    sample, _, channel, there, a, b, c, d, right, low, _ = _corners(
        uv, first, size, origin, stride, reach, count, C, CP, B
    )
    g = tl.load(grad + sample[:, None] * C + channel, mask=there, other=0.0)
    tl.atomic_add(out + a[:, None] * C + channel, g * ((1 - low) * (1 - right))[:, None], mask=there)
    tl.atomic_add(out + b[:, None] * C + channel, g * ((1 - low) * right)[:, None], mask=there)
    tl.atomic_add(out + c[:, None] * C + channel, g * (low * (1 - right))[:, None], mask=there)
    tl.atomic_add(out + d[:, None] * C + channel, g * (low * right)[:, None], mask=there)


class _Read(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, first: Tensor, size: Tensor, origin: Tensor, stride: float, uv: Tensor
    ) -> tuple[Tensor, Tensor]:
        images, count = uv.shape[:2]
        channels = rows.shape[1]
        values = torch.empty(images, count, channels, device=rows.device)
        on = torch.empty(images, count, dtype=torch.bool, device=rows.device)
        ctx.save_for_backward(uv, first, size, origin)
        ctx.shape, ctx.stride = rows.shape, stride
        grid = (images, triton.cdiv(count, BLOCK))
        padded = triton.next_power_of_2(channels)
        reach = max(0.5, 0.5 / stride)
        _read_forward[grid](rows, uv, first, size, origin, values, on, stride, reach, count, channels, padded, BLOCK)
        ctx.mark_non_differentiable(on)
        return values, on

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        uv, first, size, origin = ctx.saved_tensors
        images, count = uv.shape[:2]
        channels = ctx.shape[1]
        out = torch.zeros(ctx.shape, device=uv.device)
        grid = (images, triton.cdiv(count, BLOCK))
        padded, reach = triton.next_power_of_2(channels), max(0.5, 0.5 / ctx.stride)
        grad = grads[0].contiguous()
        _read_backward[grid](uv, first, size, origin, grad, out, ctx.stride, reach, count, channels, padded, BLOCK)
        return out, None, None, None, None, None


def read(
    rows: Tensor, first: Tensor, size: Tensor, origin_px: Tensor, stride: int | float, uv_px: Tensor
) -> tuple[Tensor, Tensor]:
    """Bilinear reading of maps; see `gather.gather`.

    Args:
        rows: texels [Q C], of all maps, single or half precision.
        first, size, origin_px: [I], [I 2], [I 2]: of the map that each view reads.
        stride: pixels between texels.
        uv_px: pixels [I P 2].

    Returns:
        Values [I P C] in single precision, and whether the pixel lies on the map [I P].
    """
    return _Read.apply(rows, first.int(), size.int(), origin_px, float(stride), uv_px.contiguous())  # type: ignore[no-any-return]


@triton.jit
def _moments_forward(values, weight, mean, variance, views, count, C: tl.constexpr, CP: tl.constexpr, B: tl.constexpr):
    tile = tl.program_id(0)
    place = tl.program_id(1) * B + tl.arange(0, B)
    inside = place < count
    channel = tl.arange(0, CP)
    there = inside[:, None] & (channel < C)[None, :]
    m = tl.zeros((B, CP), dtype=tl.float32)
    for view in range(views):
        sample = (tile * views + view) * count + place
        w = tl.load(weight + sample, mask=inside, other=0.0)
        m += w[:, None] * tl.load(values + sample[:, None] * C + channel[None, :], mask=there, other=0.0)
    v = tl.zeros((B, CP), dtype=tl.float32)
    for view in range(views):
        sample = (tile * views + view) * count + place
        w = tl.load(weight + sample, mask=inside, other=0.0)
        apart = tl.load(values + sample[:, None] * C + channel[None, :], mask=there, other=0.0) - m
        v += w[:, None] * apart * apart
    at = (tile * count + place)[:, None] * C + channel[None, :]
    tl.store(mean + at, m, mask=there)
    tl.store(variance + at, v, mask=there)


@triton.jit
def _moments_backward(
    values, weight, mean, grad_mean, grad_variance, grad_values, grad_weight, views, count,
    C: tl.constexpr, CP: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    tile = tl.program_id(0)
    place = tl.program_id(1) * B + tl.arange(0, B)
    inside = place < count
    channel = tl.arange(0, CP)
    there = inside[:, None] & (channel < C)[None, :]
    at = (tile * count + place)[:, None] * C + channel[None, :]
    m = tl.load(mean + at, mask=there, other=0.0)
    gm = tl.load(grad_mean + at, mask=there, other=0.0)
    gv = tl.load(grad_variance + at, mask=there, other=0.0)
    # d variance / d mean = -2 (sum of w (value - mean)) = -2 mean (1 - sum of w).
    total = tl.zeros((B,), dtype=tl.float32)
    for view in range(views):
        total += tl.load(weight + (tile * views + view) * count + place, mask=inside, other=0.0)
    gm -= 2 * gv * m * (1 - total)[:, None]
    for view in range(views):
        sample = (tile * views + view) * count + place
        w = tl.load(weight + sample, mask=inside, other=0.0)
        value = tl.load(values + sample[:, None] * C + channel[None, :], mask=there, other=0.0)
        apart = value - m
        tl.store(grad_values + sample[:, None] * C + channel[None, :], w[:, None] * (gm + 2 * apart * gv), mask=there)
        tl.store(grad_weight + sample, tl.sum(value * gm + apart * apart * gv, axis=1), mask=inside)


class _Moments(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        tiles, views, count, channels = values.shape
        mean, variance = (torch.empty(tiles, count, channels, device=values.device) for _ in range(2))
        grid = (tiles, triton.cdiv(count, BLOCK))
        padded = triton.next_power_of_2(channels)
        _moments_forward[grid](values, weight, mean, variance, views, count, channels, padded, BLOCK)
        ctx.save_for_backward(values, weight, mean)
        return mean, variance

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        values, weight, mean = ctx.saved_tensors
        tiles, views, count, channels = values.shape
        grad_mean, grad_variance = (g.contiguous() for g in grads)
        grad_values, grad_weight = torch.empty_like(values), torch.empty_like(weight)
        grid = (tiles, triton.cdiv(count, BLOCK))
        padded = triton.next_power_of_2(channels)
        _moments_backward[grid](
            values, weight, mean, grad_mean, grad_variance, grad_values, grad_weight, views, count,
            channels, padded, BLOCK,
        )  # fmt: skip
        return grad_values, grad_weight


def moments(values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance [T P C] over views of values [T N P C], weights [T N P]; see `aggregate.weighted_moments`."""
    return _Moments.apply(values.contiguous(), weight.contiguous())  # type: ignore[no-any-return]
