"""The ground and the still water on it: relief, tidal creeks, sand waves and pools as height fields on one raster."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.signal import lfilter
from torch import Tensor

from tidefield.synthetic.grids import Extent, Noise, Raster, box_pairs, resolved, smoothstep
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
        """The higher of bed and water."""
        return Raster(self.extent, torch.maximum(self.ground, self.water)[None])

    @property
    def water_depth(self) -> Float[Tensor, "H W"]:
        return (self.water - self.ground).clamp(min=0)


def make_terrain(settings: Settings, extent: Extent, random: np.random.Generator) -> Terrain:
    """Build humps and hollows, creeks, sand waves and pools."""
    noise = Noise(random, channels=4)
    nodes = extent.nodes()
    broad = noise.fractal(nodes, 38.0, 4)
    fine = noise.fractal(nodes + 500, 7.0, 4)
    seaward = (nodes[1] - extent.south_m) / extent.size_m[1]
    shore = seaward + 0.16 * noise.fractal(nodes, 55.0, 3)[2]
    base = settings.tilt_m * (shore - 0.62) + settings.relief_m * (broad[0] + 0.22 * fine[0])
    base = base + 0.018 * noise.fractal(nodes - 300, 2.4, 3)[1]

    rill = _rills(nodes, noise, fine[2:4]) * smoothstep(-0.1, 0.45, broad[3])
    # Banks are roughened by sampling a smooth network at displaced points.
    displaced = nodes + 0.9 * fine[2:4] + 0.22 * noise.fractal(nodes, 1.9, 2)[0:2]
    wider = Extent.around(displaced.amin(1).tolist(), displaced.amax(1).tolist(), 2 * extent.cell_m)
    carved, near = _carve(_creeks(settings, extent, random), wider).sample(displaced)
    ripple = smoothstep(-0.25, 0.35, broad[1]) * (1 - smoothstep(0.3, 0.9, near)) + 0.35 * smoothstep(0.2, 0.6, fine[1])
    ripple = ripple.clamp(max=1) * (1 - 0.85 * smoothstep(0.25, 0.6, -fine[1]))
    crests = _sand_waves(nodes, noise, float(random.uniform(0, math.pi)))
    # From high above, the nodes are too far apart to carry them.
    crests = crests * resolved(_SAND_WAVE_M, torch.tensor(extent.cell_m))
    ground = base - carved - 0.05 * rill * (1 - near) + settings.ripple_m * ripple * crests
    water = torch.full_like(ground, settings.tide_m)
    warp = fine[2:4] + noise.fractal(nodes, 2.6, 3)[0:2]
    _add_pools(settings, extent, ground, water, near, warp, random)

    shape = (extent.rows, extent.columns)
    ground, water, near, rill, ripple = (x.reshape(shape) for x in (ground, water, near, rill, ripple))
    # On dry ground the water's plane is lowered out of reach: close below, it would make the shoreline ragged.
    water = torch.where(water > ground, water, ground - 10.0)
    return Terrain(extent, ground, water, near, rill, ripple)


def _rills(nodes: Tensor, noise: Noise, warp: Tensor) -> Tensor:
    """Draw threads where a noise crosses zero, thinner and denser ones joining thicker ones."""
    bent = nodes + 1.6 * warp + 0.5 * noise.octave(nodes, 1.6, 7)[0:2]
    thick = 1 - (noise.octave(bent, 11.0, 8)[0].abs() / 0.07)
    thin = 1 - (noise.octave(bent, 4.6, 9)[1].abs() / 0.10)
    return torch.maximum(thick, 0.6 * thin).clamp(min=0)


def _sand_waves(nodes: Tensor, noise: Noise, heading: float) -> Tensor:
    """Compute crests in [-0.5, 0.5] whose spacing and direction wander; steeper on the lee side, with forks."""
    warp = noise.fractal(nodes + 200, 22.0, 3)
    bend = noise.octave(nodes, 3.1, 3)
    x = nodes[0] + 2.6 * warp[0] + 0.35 * bend[1]
    y = nodes[1] + 2.6 * warp[1] + 0.35 * bend[2]
    phase = (x * math.cos(heading) + y * math.sin(heading)) * (2 * math.pi / _SAND_WAVE_M)
    forked = phase + 1.1 * noise.octave(nodes, 4.3, 5)[3]
    return 0.5 * torch.sin(forked + 0.35 * torch.sin(forked)) * (0.7 + 0.3 * warp[2])


def _creeks(settings: Settings, extent: Extent, random: np.random.Generator) -> Float[Tensor, "6 N"]:
    """Grow a network of meandering creeks from the seaward (south) edge, branching headward.

    Returns:
        Straight pieces of channel, one column each: start and end, east and north, then half width and depth at
        mid-reach, all in metres.
    """
    rows: list[np.ndarray] = []

    def grow(mouth: np.ndarray, heading: float, length_m: float, size: float, orders: int) -> None:
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
        rows.append(np.column_stack([points[:-1], points[1:], half_width * taper[:-1], depth * taper[:-1] ** 0.7]))
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
                grow(points[i], angle[i] + turn, reach, child, orders - 1)
            at += settings.branch_spacing_m * random.uniform(0.5, 1.5) * max(size, 0.45)

    width, height = extent.size_m
    count = max(1, round(width / settings.channel_spacing_m))
    for k in range(count):
        x = extent.west_m + width * (k + random.uniform(0.3, 0.7)) / count
        heading, size = math.pi / 2 + random.uniform(-0.35, 0.35), random.uniform(0.8, 1.2)
        length_m = height * random.uniform(0.95, 1.15)
        grow(np.array([x, extent.south_m - 5.0]), heading, length_m, size, settings.branch_orders)
    return torch.from_numpy(np.concatenate(rows).astype(np.float32)).T


def _carve(reaches: Float[Tensor, "6 N"], extent: Extent) -> Raster:
    """Compute the creeks' depth below the flat in metres, and `Terrain.near_channel`."""
    start, end, half_widths, depths = reaches[0:2], reaches[2:4], reaches[4], reaches[5]
    # The sloping bank is wide enough for mud to stand.
    banks = 0.5 * half_widths + 1.6 * depths
    margin = half_widths + 2 * banks
    boxes = extent.boxes(torch.minimum(start, end) - margin, torch.maximum(start, end) + margin)
    axis = end - start
    table = torch.cat([start, axis / (axis**2).sum(0), axis, torch.stack([half_widths, banks, depths])])
    nodes = extent.nodes()
    maps = torch.zeros_like(nodes)
    carved, near = maps
    for i, node in box_pairs(boxes, extent.columns):
        x0, y0, ax, ay, bx, by, half_width, bank, depth = table[:, i]
        x, y = nodes[0, node] - x0, nodes[1, node] - y0
        along = (x * ax + y * ay).clamp(0, 1)
        distance = torch.hypot(x - along * bx, y - along * by)
        hollow = depth * smoothstep(half_width + 0.8 * bank, 0.3 * half_width, distance)
        carved.scatter_reduce_(0, node, hollow, "amax")
        near.scatter_reduce_(0, node, smoothstep(half_width + 2 * bank, 0.5 * half_width, distance), "amax")
    return Raster(extent, maps.reshape(2, extent.rows, extent.columns))


def _add_pools(
    settings: Settings,
    extent: Extent,
    ground: Float[Tensor, " P"],
    water: Float[Tensor, " P"],
    near_channel: Float[Tensor, " P"],
    warp: Float[Tensor, "2 P"],
    random: np.random.Generator,
) -> None:
    """Press shallow hollows into the ground and fill each to a level; changes `ground` and `water`."""
    width, height = extent.size_m
    nodes = extent.nodes()
    for _ in range(random.poisson(settings.pools_per_ha * width * height / 1e4)):
        centre = (extent.west_m + width * random.random(), extent.south_m + height * random.random())
        radius, depth = float(random.gamma(3.0, 0.65) + 0.5), float(random.uniform(0.06, 0.2))
        stretch, turn = float(random.uniform(0.4, 1.0)), float(random.uniform(0, math.pi))
        node = _nodes_around(extent, centre, 2 * radius)
        level = float(ground[_nodes_around(extent, centre, 0.5)].mean())
        if float(near_channel[node].max()) > 0.6 or level < settings.tide_m + 0.15:
            continue
        x = nodes[0, node] - centre[0] + 0.7 * radius * warp[0, node]
        y = nodes[1, node] - centre[1] + 0.7 * radius * warp[1, node]
        a, b = x * math.cos(turn) + y * math.sin(turn), (y * math.cos(turn) - x * math.sin(turn)) / stretch
        inside = smoothstep(1.25, 0.35, torch.hypot(a, b) / radius)
        # A hollow flattens the ground, ripples and all, towards its floor.
        floor = level - depth * inside
        ground[node] = torch.lerp(ground[node], torch.minimum(ground[node], floor), inside)
        rim = node[(inside > 0.04) & (inside < 0.2)]
        full = min(level - 0.2 * depth, float(ground[rim].quantile(0.1))) if len(rim) else level - depth
        water[node] = torch.where(inside > 0.04, water[node].clamp(min=full), water[node])


def _nodes_around(extent: Extent, centre: tuple[float, float], reach_m: float) -> Int[Tensor, " K"]:
    """Number the nodes in a square around a point."""
    middle = torch.tensor(centre, dtype=torch.float64)[:, None]
    [(_, node)] = box_pairs(extent.boxes(middle - reach_m, middle + reach_m), extent.columns)
    return node
