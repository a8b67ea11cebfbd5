"""Grids over the ground: rasters, boxes of cells, and band-limited lattice noise.

Points and vectors are planar in this package (`3 P`, not `P 3`): every coordinate is one contiguous row, which
suits elementwise arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

_LATTICE_CELLS = 256
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
_PAIRS = 1 << 20
"""Pairs of box and cell handled at once, which bounds memory."""

Values = TypeVar("Values", Tensor, np.ndarray)


@dataclass(frozen=True)
class Extent:
    """A rectangle of ground, in metres east and north, and the spacing of its nodes."""

    west_m: float
    south_m: float
    columns: int
    rows: int
    cell_m: float

    @staticmethod
    def around(south_west_m: list[float], north_east_m: list[float], cell_m: float) -> Extent:
        """Return the smallest grid of nodes that covers a rectangle, border included."""
        sides = (high - low for low, high in zip(south_west_m, north_east_m, strict=True))
        columns, rows = (int(-(-side // cell_m)) + 1 for side in sides)
        return Extent(south_west_m[0], south_west_m[1], columns, rows, cell_m)

    @property
    def size_m(self) -> tuple[float, float]:
        """East-west and north-south length between the outer nodes."""
        return (self.columns - 1) * self.cell_m, (self.rows - 1) * self.cell_m

    @property
    def east_m(self) -> float:
        return self.west_m + self.size_m[0]

    @property
    def north_m(self) -> float:
        return self.south_m + self.size_m[1]

    def nodes(self) -> Float[Tensor, "2 P"]:
        """Return all nodes, row by row from the south-west."""
        x = torch.arange(self.columns) * self.cell_m + self.west_m
        y = torch.arange(self.rows) * self.cell_m + self.south_m
        return torch.stack(torch.meshgrid(x, y, indexing="xy")).reshape(2, -1)

    def boxes(self, low: Float[Tensor, "2 N"], high: Float[Tensor, "2 N"]) -> Int[Tensor, "4 N"]:
        """Bound the nodes between corners, metres: first column and row, last column and row; last < first if none."""
        south_west = low.new_tensor([[self.west_m], [self.south_m]])
        first = torch.ceil((low - south_west) / self.cell_m).clamp(min=0)
        most = low.new_tensor([[self.columns - 1], [self.rows - 1]])
        last = torch.minimum(torch.floor((high - south_west) / self.cell_m), most).maximum(first - 1)
        return torch.cat([first, last]).long()


@dataclass(frozen=True)
class Raster:
    """C values per node of an extent; row 0 is the south."""

    extent: Extent
    values: Float[Tensor, "C H W"]

    def sample(self, xy: Float[Tensor, "2 P"]) -> Float[Tensor, "C P"]:
        """Interpolate bilinearly at ground points; points beyond the border take its values."""
        width, height = self.extent.size_m
        x = (xy[0] - self.extent.west_m) * (2 / width) - 1
        y = (xy[1] - self.extent.south_m) * (2 / height) - 1
        grid = torch.stack([x, y], dim=-1)[None, None]
        # Corners aligned: the outer nodes lie on the extent's border.
        return F.grid_sample(self.values[None], grid, padding_mode="border", align_corners=True)[0, :, 0]

    @cached_property
    def max_slope(self) -> float:
        """A bound on the slope of the bilinear surface of the first channel."""
        z = self.values[0]
        east, north = z.diff(dim=1).abs() / self.extent.cell_m, z.diff(dim=0).abs() / self.extent.cell_m
        east = torch.maximum(east[1:], east[:-1])
        north = torch.maximum(north[:, 1:], north[:, :-1])
        return float(torch.sqrt(east**2 + north**2).max())


def blurred(values: Float[Tensor, "H W"], radius: int) -> Float[Tensor, "H W"]:
    """Blur by two passes of a box of (2 radius + 1) nodes, which is nearly a Gaussian."""
    size = 2 * radius + 1
    x = values[None, None]
    for _ in range(2):
        x = F.avg_pool2d(F.pad(x, (radius, radius, 0, 0), mode="replicate"), (1, size), stride=1)
        x = F.avg_pool2d(F.pad(x, (0, 0, radius, radius), mode="replicate"), (size, 1), stride=1)
    return x[0, 0]


def box_pairs(boxes: Int[Tensor, "4 N"], columns: int) -> Iterator[tuple[Int[Tensor, " K"], Int[Tensor, " K"]]]:
    """List all pairs of a box and a cell within it, about a million at a time.

    Args:
        boxes: first column and row, last column and row; empty where last < first.
        columns: of the grid, whose cells are numbered row by row.
    """
    u0, v0, u1, v1 = boxes
    width = u1 - u0 + 1
    count = width * (v1 - v0 + 1)
    kept = torch.nonzero(count > 0)[:, 0]
    cumulative = count[kept].cumsum(0)
    start = 0
    while start < len(kept):
        done = int(cumulative[start - 1]) if start else 0
        end = max(start + 1, int(torch.searchsorted(cumulative, done + _PAIRS, right=True)))
        chunk = kept[start:end]
        box = torch.repeat_interleave(chunk, count[chunk])
        first = cumulative[start:end] - count[chunk] - done
        within = torch.arange(len(box)) - torch.repeat_interleave(first, count[chunk])
        row = within // width[box]
        yield box, (v0[box] + row) * columns + u0[box] + within - row * width[box]
        start = end


def smoothstep(low: float | Tensor, high: float | Tensor, x: Values) -> Values:
    """Return 0 below `low`, 1 above `high`, cubic between; `low > high` falls instead of rising."""
    t = ((x - low) / (high - low)).clip(0, 1)
    return t * t * (3 - 2 * t)


def resolved(wavelength_m: float, footprint_m: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
    """Fade out waves that samples `footprint_m` apart cannot carry: 1 above three samples per wave, 0 below 1.5.

    Nyquist asks for two; the fade around it keeps detail from shimmering between photographs.
    """
    return smoothstep(1.5, 3.0, wavelength_m / footprint_m)


class Noise:
    """A periodic lattice of independent values in [-1, 1], C per node, interpolated smoothly.

    Attributes:
        table: node values; the last row and column repeat the first.
    """

    table: Float[Tensor, "1 C 257 257"]

    def __init__(self, random: np.random.Generator, channels: int) -> None:
        table = random.uniform(-1, 1, (1, channels, _LATTICE_CELLS, _LATTICE_CELLS)).astype(np.float32)
        self.table = torch.from_numpy(np.pad(table, ((0, 0), (0, 0), (0, 1), (0, 1)), mode="wrap"))

    def octave(self, xy: Float[Tensor, "2 P"], wavelength_m: float, octave: int) -> Float[Tensor, "C P"]:
        """Evaluate one octave; each `octave` number turns and shifts the lattice so that no two line up."""
        angle = octave * _GOLDEN_ANGLE
        cos, sin = math.cos(angle) / wavelength_m, math.sin(angle) / wavelength_m
        x = _lattice_coordinate(xy[0] * cos - xy[1] * sin + 37.3 * octave)
        y = _lattice_coordinate(xy[0] * sin + xy[1] * cos + 91.7 * octave)
        grid = torch.stack([x, y], dim=-1)[None, None]
        # Corners aligned: this is a lattice of nodes, not an image of pixels.
        return F.grid_sample(self.table, grid, padding_mode="border", align_corners=True)[0, :, 0]

    def fractal(
        self, xy: Float[Tensor, "2 P"], wavelength_m: float, octaves: int, gain: float = 0.5
    ) -> Float[Tensor, "C P"]:
        """Sum octaves of halving wavelength and of amplitude falling by `gain`; the sum reaches about 0.8."""
        total = self.octave(xy, wavelength_m, 0)
        for k in range(1, octaves):
            total = total + gain**k * self.octave(xy, wavelength_m / 2**k, k)
        return total * (1 - gain) / (1 - gain**octaves) * 1.6


def _lattice_coordinate(x: Tensor) -> Tensor:
    """Return the coordinate in [-1, 1] at which linear interpolation gives the cubic fade."""
    x = x - _LATTICE_CELLS * torch.floor(x / _LATTICE_CELLS)
    cell = torch.floor(x)
    f = x - cell
    return (cell + f * f * (3 - 2 * f)) * (2 / _LATTICE_CELLS) - 1
