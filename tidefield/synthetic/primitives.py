"""Leaf sprays and stems as analytic primitives, met exactly by the rays of any view.

Each primitive is tested against the rays of the box it spans in the view, which is ray tracing without a search
structure: the rays of a view are a grid already.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tidefield.synthetic.views import View

_PAIRS = 1 << 20
"""Rays tested against primitives at once, which bounds memory."""


def dot(a: Float[Tensor, "3 #P"], b: Float[Tensor, "3 #P"]) -> Float[Tensor, " P"]:
    """Scalar products of planar vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@dataclass(frozen=True)
class Leaves:
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

    def __len__(self) -> int:
        return self.centre.shape[1]

    @property
    def radius(self) -> Float[Tensor, " N"]:
        return torch.sqrt(torch.maximum(dot(self.u, self.u), dot(self.v, self.v)))

    @property
    def normal(self) -> Float[Tensor, "3 N"]:
        """Unit normals, on the upper side."""
        n = torch.linalg.cross(self.u, self.v, dim=0)
        n = n / torch.sqrt(dot(n, n))
        return torch.where(n[2] < 0, -n, n)

    def table(self) -> Float[Tensor, "15 N"]:
        """What an intersection reads, one row per number: centre, normal, u/|u|^2, v/|v|^2, lobes, phase, notch."""
        u, v = self.u / dot(self.u, self.u), self.v / dot(self.v, self.v)
        return torch.cat([self.centre, self.normal, u, v, torch.stack([self.lobes, self.phase, self.notch])])


@dataclass(frozen=True)
class Stems:
    """Capsules: all points within `radius` of the line from `start` to `end`."""

    start: Float[Tensor, "3 N"]
    end: Float[Tensor, "3 N"]
    radius: Float[Tensor, " N"]
    albedo: Float[Tensor, "3 N"]

    def __len__(self) -> int:
        return self.start.shape[1]


def leaf_coordinates(
    origin: Float[Tensor, "3 #P"], direction: Float[Tensor, "3 #P"], table: Float[Tensor, "15 P"]
) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"], Float[Tensor, " P"]]:
    """Where rays meet the planes of leaf sprays: depth and the coordinates a, b."""
    offset = table[0:3] - origin
    facing = dot(direction, table[3:6])
    # A ray in the spray's own plane misses it: the division gives inf or NaN, which no comparison accepts.
    depth = dot(offset, table[3:6]) / facing
    q = direction * depth - offset
    return depth, dot(q, table[6:9]), dot(q, table[9:12])


def _meet_leaf(origin: Tensor, direction: Tensor, table: Tensor) -> Tensor:
    """Depth at which rays meet leaf sprays; inf where they miss."""
    depth, a, b = leaf_coordinates(origin, direction, table)
    lobes, phase, notch = table[12:15]
    edge = 1 - 0.5 * notch * (1 + torch.cos(lobes * torch.atan2(b, a) + phase))
    return torch.where((a * a + b * b <= edge * edge) & (depth > 0), depth, torch.inf)


def meet_stem(
    origin: Float[Tensor, "3 #P"],
    direction: Float[Tensor, "3 #P"],
    start: Float[Tensor, "3 P"],
    end: Float[Tensor, "3 P"],
    radius: Float[Tensor, " P"],
) -> Float[Tensor, " P"]:
    """Depth at which rays meet capsules; inf where they miss."""
    axis, offset = end - start, origin - start
    aa, ad, ao = dot(axis, axis), dot(axis, direction), dot(axis, offset)
    dd, do, oo = dot(direction, direction), dot(direction, offset), dot(offset, offset)
    # The side: |offset + t d - axis (ao + t ad) / aa| = radius.
    qa, qb, qc = dd - ad * ad / aa, do - ad * ao / aa, oo - ao * ao / aa - radius * radius
    side = (-qb - torch.sqrt(qb * qb - qa * qc)) / qa
    along = (ao + side * ad) / aa
    nearest = torch.where((along >= 0) & (along <= 1) & (side > 0), side, torch.inf)
    for do_end, oo_end in ((do, oo), (do - ad, oo - 2 * ao + aa)):
        ball = (-do_end - torch.sqrt(do_end * do_end - dd * (oo_end - radius * radius))) / dd
        nearest = torch.minimum(nearest, torch.where(ball > 0, ball, torch.inf))
    return nearest


def _boxes(view: View, points: tuple[Tensor, ...], radius: Tensor) -> Tensor:
    """First and last column and row [4 N] of the rays that may meet the hulls of balls; last < first where none."""
    placed = [view.locate(p, radius) for p in points]
    low = torch.stack([torch.stack([u, v]) - reach for u, v, reach in placed]).amin(0)
    high = torch.stack([torch.stack([u, v]) + reach for u, v, reach in placed]).amax(0)
    limit = low.new_tensor([[view.columns], [view.rows]])
    # Ray k stands at k + 0.5.
    first = torch.ceil(low - 0.5).clamp(min=0)
    last = torch.minimum(torch.floor(high - 0.5), limit - 1)
    boxes = torch.cat([first, last])
    # Written so that NaN, from a ball at the plane of the eye, counts as empty.
    boxes[:, ~(last >= first).all(0)] = boxes.new_tensor([[0.0], [0.0], [-1.0], [-1.0]])
    return boxes.long()


def box_pairs(boxes: Int[Tensor, "4 N"], columns: int) -> Iterator[tuple[Tensor, Tensor]]:
    """All (box, cell) pairs of boxes, some million at a time.

    Args:
        boxes: first column and row, last column and row; empty where last < first.
        columns: of the grid whose cells are numbered row by row.
    """
    u0, v0, u1, v1 = boxes
    wide = u1 - u0 + 1
    count = wide * (v1 - v0 + 1)
    kept = torch.nonzero(count > 0)[:, 0]
    cumulative = count[kept].cumsum(0)
    begin = 0
    while begin < len(kept):
        done = int(cumulative[begin - 1]) if begin else 0
        end = max(begin + 1, int(torch.searchsorted(cumulative, done + _PAIRS, right=True)))
        which = kept[begin:end]
        primitive = torch.repeat_interleave(which, count[which])
        starts = cumulative[begin:end] - count[which] - done
        within = torch.arange(len(primitive), device=boxes.device) - torch.repeat_interleave(starts, count[which])
        row = torch.div(within, wide[primitive], rounding_mode="floor")
        ray = (v0[primitive] + row) * columns + u0[primitive] + within - row * wide[primitive]
        yield primitive, ray
        begin = end


@dataclass(frozen=True)
class Plants:
    """All plants of a flat; primitives are numbered leaves first, then stems."""

    leaves: Leaves
    stems: Stems

    @property
    def highest_m(self) -> float:
        """A height that no plant exceeds; -inf where there are none."""
        stems = self.stems
        tops = [self.leaves.centre[2] + self.leaves.radius, stems.start[2] + stems.radius, stems.end[2] + stems.radius]
        return max((float(top.max()) for top in tops if len(top)), default=-math.inf)

    def nearest(self, view: View) -> tuple[Float[Tensor, " R"], Int[Tensor, " R"]]:
        """For every ray of a view, the depth and number of the first primitive it meets; inf and -1 where none."""
        # Depth in the upper and the primitive in the lower half of one integer: the least is the nearest, and
        # ties have one answer whatever the order of writing.
        nearest = torch.full((view.columns * view.rows,), _packed_inf(), device=view.device)
        table = self.leaves.table()
        for primitive, ray in box_pairs(_boxes(view, (self.leaves.centre,), self.leaves.radius), view.columns):
            _keep(nearest, ray, _meet_leaf(*view.rays(ray), table[:, primitive]), primitive)
        stems = self.stems
        for primitive, ray in box_pairs(_boxes(view, (stems.start, stems.end), stems.radius), view.columns):
            start, end, radius = stems.start[:, primitive], stems.end[:, primitive], stems.radius[primitive]
            _keep(nearest, ray, meet_stem(*view.rays(ray), start, end, radius), primitive + len(self.leaves))
        depth = (nearest >> 32).to(torch.int32).view(torch.float32)
        return depth, torch.where(torch.isfinite(depth), nearest & 0xFFFFFFFF, -1)


def _packed_inf() -> int:
    return int(torch.tensor(torch.inf).view(torch.int32)) << 32


def _keep(nearest: Tensor, ray: Tensor, depth: Tensor, primitive: Tensor) -> None:
    """Note those meetings that come before what `nearest` holds."""
    met = torch.isfinite(depth)
    # Positive floats sort as their bits do.
    packed = (depth[met].view(torch.int32).long() << 32) | primitive[met]
    nearest.scatter_reduce_(0, ray[met], packed, "amin")
