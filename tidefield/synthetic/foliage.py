"""Leaf sprays and stems as analytic primitives: exact intersection with the rays of any view, shadows and shading.

Each primitive is tested against the rays of the box it covers in the view. The rays of a view are a grid already, so
this is ray tracing without a search structure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tidefield.synthetic.grids import box_pairs
from tidefield.synthetic.rays import Parallel, View, dot, normalised
from tidefield.synthetic.shading import Light

_BIAS_M = 0.12
"""Plants closer than this along the sun's ray do not shade one another: a spray would shade itself."""
_MISS = int(torch.tensor(torch.inf).view(torch.int32)) << 32
"""Packed depth and number of a ray that meets no plant; see `Plants.nearest`."""

Kind = TypeVar("Kind", bound="_Primitives")


@dataclass(frozen=True)
class _Primitives:
    """Primitives in columns: the last axis of every field."""

    @classmethod
    def of(cls: type[Kind], *fields: np.ndarray) -> Kind:
        """Build from the fields in their order, as float32."""
        return cls(*(torch.from_numpy(field.astype(np.float32)) for field in fields))

    @classmethod
    def joined(cls: type[Kind], parts: list[Kind]) -> Kind:
        """Concatenate primitives of one kind."""
        return cls(*(torch.cat(field, dim=-1) for field in zip(*(vars(part).values() for part in parts), strict=True)))

    def __getitem__(self: Kind, index: Int[Tensor, " P"]) -> Kind:
        return type(self)(*(field[..., index] for field in vars(self).values()))

    def __len__(self) -> int:
        return next(iter(vars(self).values())).shape[-1]


@dataclass(frozen=True)
class _LeafPlanes(_Primitives):
    """Leaf sprays prepared for intersection; u and v are the half axes divided by their squared lengths.

    Attributes:
        normal: unit, on the upper side.
    """

    centre: Float[Tensor, "3 N"]
    normal: Float[Tensor, "3 N"]
    u: Float[Tensor, "3 N"]
    v: Float[Tensor, "3 N"]
    lobes: Float[Tensor, " N"]
    phase: Float[Tensor, " N"]
    notch: Float[Tensor, " N"]

    def meet(self, origin: Float[Tensor, "3 #N"], direction: Float[Tensor, "3 #N"]) -> tuple[Tensor, Tensor, Tensor]:
        """Intersect each plane with a ray: depth and the coordinates a, b."""
        offset = self.centre - origin
        # A ray in the spray's plane misses it: the division gives inf or NaN, which no comparison accepts.
        depth = dot(offset, self.normal) / dot(direction, self.normal)
        q = direction * depth - offset
        return depth, dot(q, self.u), dot(q, self.v)

    def depth(self, origin: Float[Tensor, "3 #N"], direction: Float[Tensor, "3 #N"]) -> Float[Tensor, " N"]:
        """Find the depth at which a ray meets each spray; inf where it misses."""
        depth, a, b = self.meet(origin, direction)
        edge = 1 - 0.5 * self.notch * (1 + torch.cos(self.lobes * torch.atan2(b, a) + self.phase))
        return torch.where((a * a + b * b <= edge * edge) & (depth > 0), depth, torch.inf)


@dataclass(frozen=True)
class Leaves(_Primitives):
    """Flat sprays of leaves: lobed ellipses in space.

    A point centre + a * u + b * v belongs to the spray where sqrt(a^2 + b^2) is at most
    1 - notch (1 + cos(lobes * atan2(b, a) + phase)) / 2.

    Attributes:
        u, v: half axes, perpendicular, metres.
        openness: share of the sky that reaches the spray.
    """

    centre: Float[Tensor, "3 N"]
    u: Float[Tensor, "3 N"]
    v: Float[Tensor, "3 N"]
    lobes: Float[Tensor, " N"]
    phase: Float[Tensor, " N"]
    notch: Float[Tensor, " N"]
    albedo: Float[Tensor, "3 N"]
    openness: Float[Tensor, " N"]

    @property
    def radius(self) -> Float[Tensor, " N"]:
        return torch.sqrt(torch.maximum(dot(self.u, self.u), dot(self.v, self.v)))

    def planes(self) -> _LeafPlanes:
        """Prepare the sprays for intersection."""
        normal = normalised(torch.linalg.cross(self.u, self.v, dim=0))
        normal = torch.where(normal[2] < 0, -normal, normal)
        u, v = self.u / dot(self.u, self.u), self.v / dot(self.v, self.v)
        return _LeafPlanes(self.centre, normal, u, v, self.lobes, self.phase, self.notch)

    def radiance(
        self, light: Light, shadows: Shadows, origin: Float[Tensor, "3 #N"], direction: Float[Tensor, "3 #N"]
    ) -> Float[Tensor, "3 N"]:
        """Shade each spray where a ray meets it: light passes through, and tips are brighter."""
        planes = self.planes()
        depth, a, b = planes.meet(origin, direction)
        # Blades arch outwards, so each spray holds normals of many directions.
        length_u, length_v = torch.sqrt(dot(self.u, self.u)), torch.sqrt(dot(self.v, self.v))
        arch = planes.u * (a * length_u) + planes.v * (b * length_v)
        facing = dot(normalised(planes.normal + 0.6 * arch), light.sun[:, None]).abs()
        sun = light.sun_rgb[:, None] * ((0.25 + 0.75 * facing) * shadows.sunlit(origin + direction * depth))
        sky = light.sky_rgb[:, None] * self.openness
        tip = 0.75 + 0.4 * torch.sqrt(a * a + b * b)
        return self.albedo * tip * (sun + sky)


@dataclass(frozen=True)
class Stems(_Primitives):
    """Capsules: all points within `radius` of the line from `start` to `end`."""

    start: Float[Tensor, "3 N"]
    end: Float[Tensor, "3 N"]
    radius: Float[Tensor, " N"]
    albedo: Float[Tensor, "3 N"]

    def depth(self, origin: Float[Tensor, "3 #N"], direction: Float[Tensor, "3 #N"]) -> Float[Tensor, " N"]:
        """Find the depth at which a ray meets each capsule; inf where it misses."""
        axis, offset, radius = self.end - self.start, origin - self.start, self.radius
        aa, ad, ao = dot(axis, axis), dot(axis, direction), dot(axis, offset)
        dd, do, oo = dot(direction, direction), dot(direction, offset), dot(offset, offset)
        # The side: |offset + t d - axis (ao + t ad) / aa| = radius.
        qa, qb, qc = dd - ad * ad / aa, do - ad * ao / aa, oo - ao * ao / aa - radius * radius
        side = (-qb - torch.sqrt(qb * qb - qa * qc)) / qa
        along = (ao + side * ad) / aa
        nearest = torch.where((along >= 0) & (along <= 1) & (side > 0), side, torch.inf)
        # The balls at both ends.
        for do_end, oo_end in ((do, oo), (do - ad, oo - 2 * ao + aa)):
            ball = (-do_end - torch.sqrt(do_end * do_end - dd * (oo_end - radius * radius))) / dd
            nearest = torch.minimum(nearest, torch.where(ball > 0, ball, torch.inf))
        return nearest

    def radiance(
        self, light: Light, shadows: Shadows, origin: Float[Tensor, "3 #N"], direction: Float[Tensor, "3 #N"]
    ) -> Float[Tensor, "3 N"]:
        """Shade each capsule where a ray meets it."""
        points = origin + direction * self.depth(origin, direction)
        axis = self.end - self.start
        along = (dot(points - self.start, axis) / dot(axis, axis)).clamp(0, 1)
        normal = (points - self.start - axis * along) / self.radius
        return self.albedo * light.diffuse(normal, shadows.sunlit(points), torch.full_like(along, 0.75))


@dataclass(frozen=True)
class Plants:
    """All plants of a flat; primitives are numbered leaves first, then stems."""

    leaves: Leaves
    stems: Stems

    @property
    def highest_m(self) -> float:
        """A height that no plant exceeds; -inf without plants."""
        stems = self.stems
        tops = [self.leaves.centre[2] + self.leaves.radius, stems.start[2] + stems.radius, stems.end[2] + stems.radius]
        return max((float(top.max()) for top in tops if len(top)), default=-math.inf)

    def nearest(self, view: View) -> tuple[Float[Tensor, " R"], Int[Tensor, " R"]]:
        """Find, for every ray of a view, depth and number of the first primitive it meets; inf and -1 where none."""
        # Depth in the upper and the primitive in the lower half of one integer: the least is the nearest, and
        # ties have one answer whatever the order of writing.
        nearest = torch.full((view.columns * view.rows,), _MISS)
        leaves, stems = self.leaves, self.stems
        for primitives, boxes, first_number in (
            (leaves.planes(), _boxes(view, (leaves.centre,), leaves.radius), 0),
            (stems, _boxes(view, (stems.start, stems.end), stems.radius), len(leaves)),
        ):
            for i, ray in box_pairs(boxes, view.columns):
                depth = primitives[i].depth(*view.rays(ray))
                met = torch.isfinite(depth)
                # Positive floats sort as their bits do.
                packed = (depth[met].view(torch.int32).long() << 32) | (i + first_number)[met]
                nearest.scatter_reduce_(0, ray[met], packed, "amin")
        depth = (nearest >> 32).to(torch.int32).view(torch.float32)
        return depth, torch.where(torch.isfinite(depth), nearest & 0xFFFFFFFF, -1)

    def radiance(
        self, light: Light, shadows: Shadows, view: View, ray: Int[Tensor, " P"], primitive: Int[Tensor, " P"]
    ) -> Float[Tensor, "3 P"]:
        """Shade the primitives that numbered rays meet; diffuse, so the same from all sides."""
        radiance = torch.empty(3, len(ray))
        is_stem = primitive >= len(self.leaves)
        leaf, stem = torch.nonzero(~is_stem)[:, 0], torch.nonzero(is_stem)[:, 0]
        leaves, stems = self.leaves[primitive[leaf]], self.stems[primitive[stem] - len(self.leaves)]
        radiance[:, leaf] = leaves.radiance(light, shadows, *view.rays(ray[leaf]))
        radiance[:, stem] = stems.radiance(light, shadows, *view.rays(ray[stem]))
        return radiance


def _boxes(view: View, points: tuple[Float[Tensor, "3 N"], ...], radius: Float[Tensor, " N"]) -> Int[Tensor, "4 N"]:
    """Bound the rays that may meet the hulls of balls: first and last column and row; last < first where none."""
    located = [view.locate(p, radius) for p in points]
    low = torch.stack([uv - reach for uv, reach in located]).amin(0)
    high = torch.stack([uv + reach for uv, reach in located]).amax(0)
    limit = low.new_tensor([[view.columns], [view.rows]])
    first = torch.ceil(low - 0.5).clamp(min=0)
    last = torch.minimum(torch.floor(high - 0.5), limit - 1)
    boxes = torch.cat([first, last])
    # Written so that NaN, from a ball at the camera's plane, counts as empty.
    boxes[:, ~(last >= first).all(0)] = boxes.new_tensor([[0.0], [0.0], [-1.0], [-1.0]])
    return boxes.long()


@dataclass(frozen=True)
class Shadows:
    """A shadow map: the plants as seen from the sun.

    Attributes:
        view: its rays.
        depth: depth of the first plant along them; inf where there is none.
    """

    view: Parallel
    depth: Float[Tensor, "H W"]

    @staticmethod
    def cast(plants: Plants, view: Parallel) -> Shadows:
        """Compute the shadows in a view from the sun."""
        depth, _ = plants.nearest(view)
        return Shadows(view, depth.reshape(view.rows, view.columns))

    def sunlit(self, points: Float[Tensor, "3 P"]) -> Float[Tensor, " P"]:
        """Compute the share of the sun that plants let through to points: four map cells compared, interpolated."""
        u, v, depth = self.view.project(points)
        u = u.clamp(0, self.view.columns - 1.001)
        v = v.clamp(0, self.view.rows - 1.001)
        column, row = u.floor(), v.floor()
        fu, fv = u - column, v - row
        first = (row * self.view.columns + column).long()
        flat = self.depth.reshape(-1)
        lit = [(flat[first + k] + _BIAS_M > depth).float() for k in (0, 1, self.view.columns, self.view.columns + 1)]
        return torch.lerp(torch.lerp(lit[0], lit[1], fu), torch.lerp(lit[2], lit[3], fu), fv)
