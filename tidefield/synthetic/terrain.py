"""The ground and the still water on it: height fields on one raster."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.synthetic.channels import carve, creeks
from tidefield.synthetic.noise import Noise, resolved, smoothstep
from tidefield.synthetic.raster import Extent, Raster
from tidefield.synthetic.settings import Settings

_SAND_WAVE_M = 1.35
"""Mean distance between crests: what a drone some 50 m up can resolve."""


@dataclass(frozen=True)
class Terrain:
    """Heights at the nodes of an extent, metres above mean mud level, row 0 in the south.

    Attributes:
        ground: the bed, under water too.
        water: the water's surface where there is water, else far below the ground.
        near_channel: 1 in a channel's bed, falling to 0 beyond its banks.
        rill: 1 in the threads along which the flat drains, 0 between them.
        ripple: how well developed the sand waves are, 0 to 1.
    """

    extent: Extent
    ground: Float[Tensor, "H W"]
    water: Float[Tensor, "H W"]
    near_channel: Float[Tensor, "H W"]
    rill: Float[Tensor, "H W"]
    ripple: Float[Tensor, "H W"]

    @property
    def surface(self) -> Raster:
        """What a photograph sees of it: the higher of bed and water."""
        return Raster(self.extent, torch.maximum(self.ground, self.water)[None])

    @property
    def water_depth(self) -> Float[Tensor, "H W"]:
        return (self.water - self.ground).clamp(min=0)


def make_terrain(settings: Settings, extent: Extent, random: np.random.Generator) -> Terrain:
    """Humps and hollows, creeks, sand waves and pools."""
    noise = Noise.make(random, channels=4)
    nodes = extent.nodes()
    broad = noise.fractal(nodes, 38.0, 4)
    fine = noise.fractal(nodes + 500, 7.0, 4)
    seaward = (nodes[1] - extent.south_m) / extent.size_m[1]
    shore = seaward + 0.16 * noise.fractal(nodes, 55.0, 3)[2]
    base = settings.tilt_m * (shore - 0.62) + settings.relief_m * (broad[0] + 0.22 * fine[0])
    base = base + 0.018 * noise.fractal(nodes - 300, 2.4, 3)[1]

    rill = _rills(nodes, noise, fine[2:4]) * smoothstep(-0.1, 0.45, broad[3])
    # The banks are roughened by looking at a smooth network from displaced places.
    seen_from = nodes + 0.9 * fine[2:4] + 0.22 * noise.fractal(nodes, 1.9, 2)[0:2]
    (west, south), (east, north) = seen_from.amin(1).tolist(), seen_from.amax(1).tolist()
    wider = Extent.around(west, south, east, north, 2 * extent.cell_m)
    carved, near = carve(creeks(settings, extent, random), wider).sample(seen_from)
    ripple = smoothstep(-0.25, 0.35, broad[1]) * (1 - smoothstep(0.3, 0.9, near)) + 0.35 * smoothstep(0.2, 0.6, fine[1])
    ripple = ripple.clamp(max=1) * (1 - 0.85 * smoothstep(0.25, 0.6, -fine[1]))
    crests = _sand_waves(nodes, noise, float(random.uniform(0, math.pi)))
    # From high above, the nodes are too far apart to carry them.
    crests = crests * resolved(_SAND_WAVE_M, torch.tensor(extent.cell_m))
    ground = base - carved - 0.05 * rill * (1 - near) + settings.ripple_m * ripple * crests
    water = torch.full_like(ground, settings.tide_m)
    ground, water = _pools(settings, extent, ground, water, near, fine[2:4] + noise.fractal(nodes, 2.6, 3)[0:2], random)

    shape = (extent.rows, extent.columns)
    ground, water, near, rill, ripple = (x.reshape(shape) for x in (ground, water, near, rill, ripple))
    # Where the bed stands clear of it, the water's plane is of no use and its shoreline would be ragged.
    water = torch.where(water > ground, water, ground - 10.0)
    return Terrain(extent, ground, water, near, rill, ripple)


def _rills(nodes: Tensor, noise: Noise, warp: Tensor) -> Tensor:
    """Threads where a noise crosses zero, thinner and denser ones joining thicker ones."""
    bent = nodes + 1.6 * warp + 0.5 * noise.octave(nodes, 1.6, 7)[0:2]
    thick = 1 - (noise.octave(bent, 11.0, 8)[0].abs() / 0.07)
    thin = 1 - (noise.octave(bent, 4.6, 9)[1].abs() / 0.10)
    return torch.maximum(thick, 0.6 * thin).clamp(min=0)


def _sand_waves(nodes: Tensor, noise: Noise, heading: float) -> Tensor:
    """Crests in [-0.5, 0.5] whose spacing and direction wander; steeper on the lee side, with forks."""
    warp = noise.fractal(nodes + 200, 22.0, 3)
    x = nodes[0] + 2.6 * warp[0] + 0.35 * noise.octave(nodes, 3.1, 3)[1]
    y = nodes[1] + 2.6 * warp[1] + 0.35 * noise.octave(nodes, 3.1, 3)[2]
    phase = (x * math.cos(heading) + y * math.sin(heading)) * (2 * math.pi / _SAND_WAVE_M)
    forked = phase + 1.1 * noise.octave(nodes, 4.3, 5)[3]
    return 0.5 * torch.sin(forked + 0.35 * torch.sin(forked)) * (0.7 + 0.3 * warp[2])


def _pools(
    settings: Settings,
    extent: Extent,
    ground: Tensor,
    water: Tensor,
    near_channel: Tensor,
    warp: Tensor,
    random: np.random.Generator,
) -> tuple[Tensor, Tensor]:
    """Press shallow hollows into the flat and fill each to its own level."""
    width, height = extent.size_m
    count = random.poisson(settings.pools_per_ha * width * height / 1e4)
    nodes = extent.nodes()
    ground, water = ground.clone(), water.clone()
    for _ in range(count):
        centre = (extent.west_m + width * random.random(), extent.south_m + height * random.random())
        radius, depth = float(random.gamma(3.0, 0.65) + 0.5), float(random.uniform(0.06, 0.2))
        stretch, turn = float(random.uniform(0.4, 1.0)), float(random.uniform(0, math.pi))
        node = _near(extent, centre, 2 * radius)
        level = float(ground[_near(extent, centre, 0.5)].mean())
        if float(near_channel[node].max()) > 0.6 or level < settings.tide_m + 0.15:
            continue
        x = nodes[0, node] - centre[0] + 0.7 * radius * warp[0, node]
        y = nodes[1, node] - centre[1] + 0.7 * radius * warp[1, node]
        a, b = x * math.cos(turn) + y * math.sin(turn), (y * math.cos(turn) - x * math.sin(turn)) / stretch
        inside = smoothstep(1.25, 0.35, torch.hypot(a, b) / radius)
        # A hollow flattens what was there, ripples and all, towards its own floor.
        floor = level - depth * inside
        ground[node] = torch.lerp(ground[node], torch.minimum(ground[node], floor), inside)
        rim = node[(inside > 0.04) & (inside < 0.2)]
        full = min(level - 0.2 * depth, float(ground[rim].quantile(0.1))) if len(rim) else level - depth
        water[node] = torch.where(inside > 0.04, water[node].clamp(min=full), water[node])
    return ground, water


def _near(extent: Extent, centre: tuple[float, float], reach_m: float) -> Tensor:
    """Numbers of the nodes in a square around a place."""
    spans = []
    for at, start, count in (
        (centre[0], extent.west_m, extent.columns),
        (centre[1], extent.south_m, extent.rows),
    ):
        first = max(0, math.ceil((at - reach_m - start) / extent.cell_m))
        last = min(count - 1, math.floor((at + reach_m - start) / extent.cell_m))
        spans.append(torch.arange(first, max(first, last) + 1).clamp(max=count - 1))
    return (spans[1][:, None] * extent.columns + spans[0]).reshape(-1)
