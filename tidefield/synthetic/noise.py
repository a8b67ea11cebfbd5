"""Band-limited random detail: octaves of lattice noise that fade before a pixel would alias them.

Points and vectors are planar in this package (`3 P`, not `P 3`): every coordinate is one contiguous row, which
is what elementwise arithmetic wants.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

_CELLS = 256
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def smoothstep(low: float, high: float, x: Tensor) -> Tensor:
    """0 below `low`, 1 above `high`, cubic between; `low > high` falls instead of rising."""
    t = ((x - low) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def resolved(wavelength_m: float, footprint_m: Tensor) -> Tensor:
    """How much of a wave may be drawn where a sample covers `footprint_m`: 1 above three samples a wave, 0 below 1.5.

    Nyquist asks for two; the fade around it is what keeps detail from shimmering between photographs.
    """
    return smoothstep(1.5, 3.0, wavelength_m / footprint_m)


@dataclass(frozen=True)
class Noise:
    """A periodic lattice of independent values in [-1, 1], C of them per node, interpolated smoothly.

    Attributes:
        table: node values; the last row and column repeat the first.
    """

    table: Float[Tensor, "1 C 257 257"]

    @staticmethod
    def make(random: np.random.Generator, channels: int, device: torch.device | str = "cpu") -> Noise:
        """A lattice drawn from `random`."""
        table = random.uniform(-1, 1, (1, channels, _CELLS, _CELLS)).astype(np.float32)
        table = np.pad(table, ((0, 0), (0, 0), (0, 1), (0, 1)), mode="wrap")
        return Noise(torch.from_numpy(table).to(device))

    def octave(self, xy: Float[Tensor, "2 P"], wavelength_m: float, octave: int) -> Float[Tensor, "C P"]:
        """One octave at ground points; each `octave` number turns and shifts the lattice so that none line up."""
        angle = octave * _GOLDEN_ANGLE
        cos, sin = math.cos(angle) / wavelength_m, math.sin(angle) / wavelength_m
        x = _faded(xy[0] * cos - xy[1] * sin + 37.3 * octave)
        y = _faded(xy[0] * sin + xy[1] * cos + 91.7 * octave)
        grid = torch.stack([x, y], dim=-1)[None, None]
        # Corners aligned: this is a lattice of nodes, not an image of pixels.
        return F.grid_sample(self.table, grid, mode="bilinear", padding_mode="border", align_corners=True)[0, :, 0]

    def fractal(
        self, xy: Float[Tensor, "2 P"], wavelength_m: float, octaves: int, gain: float = 0.5
    ) -> Float[Tensor, "C P"]:
        """Octaves of halving wavelength and of amplitude falling by `gain`, some +-0.8 in all."""
        total = self.octave(xy, wavelength_m, 0)
        for k in range(1, octaves):
            total = total + gain**k * self.octave(xy, wavelength_m / 2**k, k)
        return total * (1 - gain) / (1 - gain**octaves) * 1.6


def _faded(x: Tensor) -> Tensor:
    """Lattice coordinate in [-1, 1] whose linear interpolation is the cubic-faded one."""
    x = x - _CELLS * torch.floor(x / _CELLS)
    cell = torch.floor(x)
    f = x - cell
    return (cell + f * f * (3 - 2 * f)) * (2 / _CELLS) - 1
