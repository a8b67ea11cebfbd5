"""What this machine can do at most: large matrix products and copies, measured like everything else."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

LARGEST_SIDE = 8192
COPY_BYTES = 1 << 28
"""Larger than any cache."""


@dataclass(frozen=True)
class Ceilings:
    """Best of several runs.

    Attributes:
        float32_flops: multiplications and additions per second in products of large float32 matrices.
        bfloat16_flops: the same in bfloat16.
        copy_bytes: bytes read and written per second while a large tensor is copied.
    """

    float32_flops: float
    bfloat16_flops: float
    copy_bytes: float


def synchronise(device: torch.device) -> None:
    """Wait until the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()


def timed(action: Callable[[], object], device: torch.device) -> float:
    """Seconds that an action takes."""
    synchronise(device)
    start = time.perf_counter()
    action()
    synchronise(device)
    return time.perf_counter() - start


def measure_ceilings(device: torch.device, seconds: float) -> Ceilings:
    """Spends about `seconds` on each of the three."""
    a = torch.zeros(COPY_BYTES // 4, device=device)
    b = torch.empty_like(a)
    return Ceilings(
        float32_flops=_product_rate(torch.float32, device, seconds),
        bfloat16_flops=_product_rate(torch.bfloat16, device, seconds),
        copy_bytes=2 * COPY_BYTES / _best(lambda: b.copy_(a), device, seconds),
    )


def _product_rate(dtype: torch.dtype, device: torch.device, seconds: float) -> float:
    """Of square matrices as large as the time allows."""
    side = 256
    while side < LARGEST_SIDE and _best(_product(side, dtype, device), device, 0.0) < seconds / 16:
        side *= 2
    return 2 * side**3 / _best(_product(side, dtype, device), device, seconds)


def _product(side: int, dtype: torch.dtype, device: torch.device) -> Callable[[], Tensor]:
    matrix = torch.rand(side, side, device=device).to(dtype)
    return lambda: matrix @ matrix


def _best(action: Callable[[], object], device: torch.device, seconds: float) -> float:
    """Of as many runs as the time allows, at least one, after one that does not count."""
    timed(action, device)
    times = [timed(action, device)]
    while sum(times) < seconds:
        times.append(timed(action, device))
    return min(times)
