"""The machine: which device to compute on, and how."""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec

import torch

from tidefield.errors import DeviceError


def choose_device(name: str) -> torch.device:
    """`auto` takes CUDA, then MPS, then the CPU; anything else must be there.

    Raises:
        DeviceError: the device is unknown or not on this machine.
    """
    there = ["cpu"]
    if torch.backends.mps.is_available():
        there.insert(0, "mps")
    there[:0] = [f"cuda:{k}" for k in range(torch.cuda.device_count())]
    if name == "auto":
        return torch.device(there[0])
    if name == "cuda" and "cuda:0" in there:
        return torch.device("cuda:0")
    if name not in there:
        raise DeviceError(f"there is no device {name!r} on this machine: expected auto or one of {', '.join(there)}")
    return torch.device(name)


def mixed_precision(device: torch.device) -> AbstractContextManager[object]:
    """Autocast to bfloat16 where the processor multiplies it natively; elsewhere it would only cost accuracy."""
    if device.type == "cuda":
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    elif device.type == "cpu":
        native = torch.cpu._is_avx512_bf16_supported()
    else:
        native = False
    if not native:
        return nullcontext()
    # On CPUs several threads may be at work, which would share the cache of converted weights.
    return torch.autocast(device.type, dtype=torch.bfloat16, cache_enabled=device.type != "cpu")


def fuses(values: torch.Tensor) -> bool:
    """Whether fused kernels work on these values: on CUDA, with Triton, and where TIDEFIELD_FUSED=1 asks for it.

    They are not the default, because nobody has measured yet what they gain.
    """
    return values.is_cuda and os.environ.get("TIDEFIELD_FUSED") == "1" and find_spec("triton") is not None


def keep_large_allocations() -> None:
    """Have glibc keep freed memory for the next step instead of returning it to the system.

    By default blocks of over 32 MB go back at once and come again as fresh, zeroed pages: half the time of a step.
    """
    if sys.platform != "linux":
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # another C library than glibc, such as musl
        return
    trim_threshold, mmap_threshold = -1, -3  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of malloc.h
    mallopt(trim_threshold, 1 << 30)
    mallopt(mmap_threshold, 1 << 30)
