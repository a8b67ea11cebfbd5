"""The light on plants, and the shadows they cast."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tidefield.synthetic.light import Light
from tidefield.synthetic.primitives import Leaves, Plants, Stems, dot, leaf_coordinates, meet_stem
from tidefield.synthetic.raster import Extent
from tidefield.synthetic.views import Parallel, View, along_the_sun

_BIAS_M = 0.12
"""Plants closer than this along the sun's ray do not shade one another: a spray would shade itself."""


@dataclass(frozen=True)
class Shadows:
    """The sun's own view of the plants.

    Attributes:
        view: its rays.
        depth: depth of the first plant along them; inf where there is none.
    """

    view: Parallel
    depth: Float[Tensor, "H W"]

    @staticmethod
    def cast(plants: Plants, extent: Extent, low_m: float, high_m: float, light: Light) -> Shadows:
        """Shadows for all points over an extent between two heights."""
        view = along_the_sun(extent, low_m, high_m, light.sun, extent.cell_m)
        depth, _ = plants.nearest(view)
        return Shadows(view, depth.reshape(view.rows, view.columns))

    def sunlit(self, points: Float[Tensor, "3 P"]) -> Float[Tensor, " P"]:
        """Share of the sun that plants let through to points: four map cells compared, then interpolated."""
        u, v, depth = self.view.place(points)
        u = u.clamp(0, self.view.columns - 1.001)
        v = v.clamp(0, self.view.rows - 1.001)
        column, row = u.floor(), v.floor()
        fu, fv = u - column, v - row
        first = (row * self.view.columns + column).long()
        flat = self.depth.reshape(-1)
        lit = [(flat[first + k] + _BIAS_M > depth).float() for k in (0, 1, self.view.columns, self.view.columns + 1)]
        return torch.lerp(torch.lerp(lit[0], lit[1], fu), torch.lerp(lit[2], lit[3], fu), fv)


def plant_radiance(
    plants: Plants, light: Light, shadows: Shadows, view: View, ray: Int[Tensor, " P"], primitive: Int[Tensor, " P"]
) -> Float[Tensor, "3 P"]:
    """Radiance of the primitives that numbered rays meet; dull, so the same from all sides."""
    radiance = torch.empty(3, len(ray), device=view.device)
    count = len(plants.leaves)
    leaf, stem = torch.nonzero(primitive < count)[:, 0], torch.nonzero(primitive >= count)[:, 0]
    radiance[:, leaf] = _leaf(plants.leaves, light, shadows, *view.rays(ray[leaf]), primitive[leaf])
    radiance[:, stem] = _stem(plants.stems, light, shadows, *view.rays(ray[stem]), primitive[stem] - count)
    return radiance


def _leaf(leaves: Leaves, light: Light, shadows: Shadows, origin: Tensor, direction: Tensor, number: Tensor) -> Tensor:
    """Sprays let light through: both sides are lit, brighter towards their tips."""
    table = leaves.table()[:, number]
    depth, a, b = leaf_coordinates(origin, direction, table)
    points = origin + direction * depth
    normal = table[3:6]
    # Blades arch outwards, so each spray holds normals of many directions.
    arch = table[6:9] * (a * _length(leaves.u, number)) + table[9:12] * (b * _length(leaves.v, number))
    normal = normal + 0.6 * arch
    normal = normal / torch.sqrt(dot(normal, normal))
    facing = dot(normal, light.sun[:, None]).abs()
    sun = light.sun_rgb[:, None] * ((0.25 + 0.75 * facing) * shadows.sunlit(points))
    sky = light.sky_rgb[:, None] * leaves.openness[number]
    tip = 0.75 + 0.4 * torch.sqrt(a * a + b * b)
    return leaves.albedo[:, number] * tip * (sun + sky)


def _length(axes: Tensor, number: Tensor) -> Tensor:
    return torch.sqrt(dot(axes, axes))[number]


def _stem(stems: Stems, light: Light, shadows: Shadows, origin: Tensor, direction: Tensor, number: Tensor) -> Tensor:
    start, end, radius = stems.start[:, number], stems.end[:, number], stems.radius[number]
    depth = meet_stem(origin, direction, start, end, radius)
    points = origin + direction * depth
    axis = end - start
    along = (dot(points - start, axis) / dot(axis, axis)).clamp(0, 1)
    normal = (points - start - axis * along) / radius
    return stems.albedo[:, number] * light.diffuse(normal, shadows.sunlit(points), torch.full_like(along, 0.75))
