"""The machine: which device to compute on, and how."""

from __future__ import annotations

import math
import os
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from threading import Lock
from time import perf_counter

import torch
from torch.nn.functional import conv2d, embedding_bag, grid_sample

from tidefield.errors import DeviceError

_TRIES = 5
_TRYING = Lock()


def choose_device(name: str) -> torch.device:
    """`auto` takes CUDA, then MPS, then the CPU; anything else must be there.

    Raises:
        DeviceError: the device is unknown, not on this machine, or lacks what our networks compute.
    """
    there = ["cpu"]
    if torch.backends.mps.is_available():
        if _has_all(torch.device("mps")):
            there.insert(0, "mps")
        elif name == "mps":
            raise DeviceError(
                f"PyTorch {torch.__version__} lacks what our networks need on MPS: expected a later one; update it, or "
                "choose --device cpu"
            )
    there[:0] = [f"cuda:{k}" for k in range(torch.cuda.device_count())]
    if name == "auto":
        return torch.device(there[0])
    if name == "cuda" and "cuda:0" in there:
        return torch.device("cuda:0")
    if name not in there:
        raise DeviceError(f"there is no device {name!r} on this machine: expected auto or one of {', '.join(there)}")
    return torch.device(name)


def _has_all(device: torch.device) -> bool:
    """Whether PyTorch has our less usual operations on a device: on MPS they came one after another."""
    try:
        grid_sample(
            torch.zeros(1, 1, 2, 2, device=device),
            torch.zeros(1, 1, 1, 2, device=device),
            padding_mode="border",
            align_corners=False,
        )
        index, rows = torch.zeros(1, 2, dtype=torch.int32, device=device), torch.zeros(2, 4, device=device)
        embedding_bag(index, rows, per_sample_weights=torch.ones(1, 2, device=device), mode="sum")
    except (NotImplementedError, RuntimeError):
        return False
    return True


def choose_precision(device: torch.device) -> torch.dtype:
    """bfloat16 where the processor gains by it; elsewhere it would only cost accuracy."""
    if device.type == "cuda":
        gains = torch.cuda.is_bf16_supported(including_emulation=False)
    elif device.type == "cpu":
        with _TRYING:  # several threads may ask at once
            gains = _cpu_gains_by_bfloat16()
    else:
        gains = False
    return torch.bfloat16 if gains else torch.float32


def mixed_precision(device: torch.device, precision: torch.dtype | None = None) -> AbstractContextManager[object]:
    """Autocast to a precision; to that of `choose_precision` if None."""
    if (precision or choose_precision(device)) == torch.float32:
        return nullcontext()
    # On CPUs several threads may be at work, which would share the cache of converted weights.
    return torch.autocast(device.type, dtype=torch.bfloat16, cache_enabled=device.type != "cpu")


@cache
def _cpu_gains_by_bfloat16() -> bool:
    """Whether convolutions in bfloat16 take less time here: tried, since some CPUs with bfloat16 take twice as long."""
    if "AVX512" not in torch.backends.cpu.get_cpu_capability():  # bfloat16 came with a later AVX-512
        return False
    images, weight = torch.ones(1, 64, 64, 64).contiguous(memory_format=torch.channels_last), torch.ones(64, 64, 3, 3)
    least = {torch.float32: math.inf, torch.bfloat16: math.inf}
    # The first try prepares the kernels; in turns, so that what else the machine does meets both.
    with torch.no_grad():
        for number in range(1 + _TRIES):
            for dtype in least:
                given = images.to(dtype), weight.to(dtype)
                began = perf_counter()
                conv2d(*given, padding=1)
                if number:
                    least[dtype] = min(least[dtype], perf_counter() - began)
    return least[torch.bfloat16] < least[torch.float32]


def environment_of(device: torch.device) -> dict[str, str]:
    """This process's environment, for a program that takes the first GPU that it sees: of several, this device only."""
    environment = dict(os.environ)
    if device.index is not None:
        visible = [one for one in environment.get("CUDA_VISIBLE_DEVICES", "").split(",") if one]
        environment["CUDA_VISIBLE_DEVICES"] = visible[device.index] if visible else str(device.index)
    return environment
