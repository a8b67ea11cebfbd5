"""Photographs in one memory-mapped store (to be written)."""
from __future__ import annotations
from dataclasses import dataclass

from jaxtyping import UInt8
from torch import Tensor


@dataclass(frozen=True)
class Photographs:
    def __len__(self) -> int: ...
    def __getitem__(self, index: int) -> UInt8[Tensor, "H W 3"]: ...
