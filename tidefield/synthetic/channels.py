"""Tidal creeks: meandering channels that branch headward, carved into the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.signal import lfilter
from torch import Tensor

from tidefield.synthetic.primitives import box_pairs
from tidefield.synthetic.raster import Extent, Raster
from tidefield.synthetic.settings import Settings


@dataclass(frozen=True)
class Reaches:
    """Straight pieces of channel, one column each.

    Attributes:
        start, end: in metres.
        half_width: at mid-reach, metres.
        depth: at mid-reach, metres.
    """

    start: Float[Tensor, "2 N"]
    end: Float[Tensor, "2 N"]
    half_width: Float[Tensor, " N"]
    depth: Float[Tensor, " N"]

    @property
    def bank(self) -> Float[Tensor, " N"]:
        """Width of the sloping bank on either side, wide enough for mud to stand."""
        return 0.5 * self.half_width + 1.6 * self.depth


def creeks(settings: Settings, extent: Extent, random: np.random.Generator) -> Reaches:
    """A network that enters from the seaward (south) edge and branches on its way in."""
    width, height = extent.size_m
    count = max(1, round(width / settings.channel_spacing_m))
    pieces: list[np.ndarray] = []
    for k in range(count):
        x = extent.west_m + width * (k + random.uniform(0.3, 0.7)) / count
        mouth = np.array([x, extent.south_m - 5.0])
        heading = math.pi / 2 + random.uniform(-0.35, 0.35)
        size = random.uniform(0.8, 1.2)
        _grow(
            pieces, mouth, heading, height * random.uniform(0.95, 1.15), settings, size, settings.branch_orders, random
        )
    table = torch.from_numpy(np.concatenate(pieces).astype(np.float32)).T
    return Reaches(table[0:2], table[2:4], table[4], table[5])


def _grow(
    pieces: list[np.ndarray],
    mouth: np.ndarray,
    heading: float,
    length_m: float,
    settings: Settings,
    size: float,
    orders: int,
    random: np.random.Generator,
) -> None:
    """Add one creek and, recursively, its branches; `size` scales width and depth."""
    half_width, depth = settings.channel_half_width_m * size, settings.channel_depth_m * size**0.5
    step = max(0.5, 0.5 * half_width)
    count = max(4, int(length_m / step))
    along = np.arange(count + 1) * step
    meander = 14 * half_width + 4
    bend = 0.75 * np.sin(2 * np.pi * (along / meander + random.random()))
    # A wandering course that keeps coming back to its heading.
    wander = lfilter([1.0], [1.0, -0.93], random.normal(0, 0.09, count + 1))
    angle = heading + bend * random.uniform(0.5, 1.2) + wander - bend[0] * 0.5
    taper = 1 - 0.75 * (along / along[-1]) ** (0.8 if orders < settings.branch_orders else 1.4)
    points = mouth + np.cumsum(np.stack([np.cos(angle), np.sin(angle)], 1) * step, axis=0)
    rows = np.column_stack([points[:-1], points[1:], half_width * taper[:-1], depth * taper[:-1] ** 0.7])
    pieces.append(rows)
    if orders == 0:
        return
    side = 1 if random.random() < 0.5 else -1
    at = settings.branch_spacing_m * random.uniform(0.3, 1.0) * size
    while at < 0.97 * along[-1]:
        i = int(at / step)
        side = side if random.random() < 0.25 else -side
        child = size * taper[i] * random.uniform(0.4, 0.62)
        reach = length_m * (1 - 0.6 * at / along[-1]) * random.uniform(0.25, 0.65)
        turn = side * random.uniform(0.65, 1.15)
        if reach > 3 * half_width * child / size:
            _grow(pieces, points[i], angle[i] + turn, reach, settings, child, orders - 1, random)
        at += settings.branch_spacing_m * random.uniform(0.5, 1.5) * max(size, 0.45)


def carve(reaches: Reaches, extent: Extent) -> Raster:
    """Depth of the network below the flat in metres, and nearness: 1 at a bed, 0 at twice the bank's width from it."""
    nodes = extent.nodes()
    carved, near = torch.zeros(nodes.shape[1]), torch.zeros(nodes.shape[1])
    margin = reaches.half_width + 2 * reaches.bank
    low = torch.minimum(reaches.start, reaches.end) - margin
    high = torch.maximum(reaches.start, reaches.end) + margin
    west_south = torch.tensor([[extent.west_m], [extent.south_m]])
    limit = torch.tensor([[extent.columns - 1], [extent.rows - 1]])
    first = torch.ceil((low - west_south) / extent.cell_m).clamp(min=0)
    last = torch.minimum(torch.floor((high - west_south) / extent.cell_m), limit).maximum(first - 1)
    axis = reaches.end - reaches.start
    table = torch.cat([reaches.start, axis / (axis**2).sum(0), axis, reaches.half_width[None], reaches.bank[None]])
    for i, node in box_pairs(torch.cat([first, last]).long(), extent.columns):
        x0, y0, ax, ay, bx, by, half_width, bank = table[:, i]
        x, y = nodes[0, node] - x0, nodes[1, node] - y0
        along = (x * ax + y * ay).clamp(0, 1)
        distance = torch.hypot(x - along * bx, y - along * by)
        depth = reaches.depth[i] * _falling(distance, 0.3 * half_width, half_width + 0.8 * bank)
        carved.scatter_reduce_(0, node, depth, "amax")
        near.scatter_reduce_(0, node, _falling(distance, 0.5 * half_width, half_width + 2 * bank), "amax")
    return Raster.of(extent, carved, near)


def _falling(x: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """1 below `low`, 0 above `high`, cubic between."""
    t = ((high - x) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)
