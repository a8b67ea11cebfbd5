"""Plants: leaf sprays and stems as analytic primitives, their shadows, and how they grow.

Each primitive is tested against the rays of the box it covers in the view. The rays of a view are a grid already, so
this is exact ray tracing without a search structure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tidefield.synthetic.grids import Noise, Raster, box_pairs, smoothstep
from tidefield.synthetic.rays import Parallel, Rays, View, dot, normalised
from tidefield.synthetic.settings import Settings
from tidefield.synthetic.shading import Light
from tidefield.synthetic.terrain import Terrain

_BIAS_M = 0.12
"""Plants closer than this along the sun's ray do not shade one another: a spray would shade itself."""
_MISS = int(torch.tensor(torch.inf).view(torch.int32)) << 32
"""Packed depth and number of a ray that meets no plant; see `Plants.nearest`."""
# Linear albedos.
_GRASS = np.array([[0.115, 0.150, 0.045], [0.175, 0.185, 0.060], [0.080, 0.110, 0.045], [0.260, 0.205, 0.095],
                   [0.170, 0.105, 0.055]])  # fmt: skip
_CANOPY = np.array([[0.055, 0.105, 0.030], [0.085, 0.135, 0.035], [0.120, 0.165, 0.050], [0.060, 0.085, 0.035]])
_BARK = np.array([[0.210, 0.180, 0.145], [0.130, 0.105, 0.080], [0.300, 0.270, 0.230]])
_UP = np.array([0.0, 0.0, 1.0])


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
        return len(self.openness)

    @property
    def radius(self) -> Float[Tensor, " N"]:
        return torch.sqrt(torch.maximum(dot(self.u, self.u), dot(self.v, self.v)))

    @cached_property
    def planes(self) -> tuple[Float[Tensor, "3 N"], Float[Tensor, "3 N"], Float[Tensor, "3 N"]]:
        """Unit normals on the upper side, and u and v divided by their squared lengths."""
        normal = normalised(torch.linalg.cross(self.u, self.v, dim=0))
        normal = torch.where(normal[2] < 0, -normal, normal)
        return normal, self.u / dot(self.u, self.u), self.v / dot(self.v, self.v)

    def _meet(self, i: Tensor, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
        """Intersect each ray with the plane of its spray: depth and the coordinates a, b."""
        origin, direction = rays
        normal, u, v = (x[:, i] for x in self.planes)
        offset = self.centre[:, i] - origin
        # A ray in the spray's plane misses it: the division gives inf or NaN, which no comparison accepts.
        depth = dot(offset, normal) / dot(direction, normal)
        q = direction * depth - offset
        return depth, dot(q, u), dot(q, v)

    def depth(self, i: Int[Tensor, " R"], rays: Rays) -> Float[Tensor, " R"]:
        """Find the depth at which each ray meets its numbered spray; inf where it misses."""
        depth, a, b = self._meet(i, rays)
        edge = 1 - 0.5 * self.notch[i] * (1 + torch.cos(self.lobes[i] * torch.atan2(b, a) + self.phase[i]))
        return torch.where((a * a + b * b <= edge * edge) & (depth > 0), depth, torch.inf)

    def radiance(self, light: Light, shadows: Shadows, i: Int[Tensor, " R"], rays: Rays) -> Float[Tensor, "3 R"]:
        """Shade numbered sprays where rays meet them: light passes through, and tips are brighter."""
        (origin, direction), (depth, a, b) = rays, self._meet(i, rays)
        normal, u, v = (x[:, i] for x in self.planes)
        # Blades arch outwards, so each spray holds normals of many directions.
        length_u, length_v = (torch.sqrt(dot(x, x)) for x in (self.u[:, i], self.v[:, i]))
        arch = u * (a * length_u) + v * (b * length_v)
        facing = dot(normalised(normal + 0.6 * arch), light.sun[:, None]).abs()
        sun = light.sun_rgb[:, None] * ((0.25 + 0.75 * facing) * shadows.sunlit(origin + direction * depth))
        sky = light.sky_rgb[:, None] * self.openness[i]
        tip = 0.75 + 0.4 * torch.sqrt(a * a + b * b)
        return self.albedo[:, i] * tip * (sun + sky)


@dataclass(frozen=True)
class Stems:
    """Capsules: all points within `radius` of the line from `start` to `end`."""

    start: Float[Tensor, "3 N"]
    end: Float[Tensor, "3 N"]
    radius: Float[Tensor, " N"]
    albedo: Float[Tensor, "3 N"]

    def depth(self, i: Int[Tensor, " R"], rays: Rays) -> Float[Tensor, " R"]:
        """Find the depth at which each ray meets its numbered capsule; inf where it misses."""
        (origin, direction), start, radius = rays, self.start[:, i], self.radius[i]
        axis, offset, dd = self.end[:, i] - start, origin - start, dot(direction, direction)
        # From the ray's nearest point to the stem's middle on: in single precision, the squares of a long way to it
        # leave nothing of the square of a radius.
        near = dot(0.5 * axis - offset, direction) / dd
        offset = offset + near * direction
        aa, ad, ao = dot(axis, axis), dot(axis, direction), dot(axis, offset)
        do, oo = dot(direction, offset), dot(offset, offset)
        # The side: |offset + t d - axis (ao + t ad) / aa| = radius.
        qa, qb, qc = dd - ad * ad / aa, do - ad * ao / aa, oo - ao * ao / aa - radius * radius
        side = (-qb - torch.sqrt(qb * qb - qa * qc)) / qa
        along = (ao + side * ad) / aa
        nearest = torch.where((along >= 0) & (along <= 1) & (near + side > 0), near + side, torch.inf)
        # The balls at both ends.
        for do_end, oo_end in ((do, oo), (do - ad, oo - 2 * ao + aa)):
            ball = (-do_end - torch.sqrt(do_end * do_end - dd * (oo_end - radius * radius))) / dd
            nearest = torch.minimum(nearest, torch.where(near + ball > 0, near + ball, torch.inf))
        return nearest

    def radiance(self, light: Light, shadows: Shadows, i: Int[Tensor, " R"], rays: Rays) -> Float[Tensor, "3 R"]:
        """Shade numbered capsules where rays meet them."""
        points = rays[0] + rays[1] * self.depth(i, rays)
        start = self.start[:, i]
        axis = self.end[:, i] - start
        along = (dot(points - start, axis) / dot(axis, axis)).clamp(0, 1)
        normal = (points - start - axis * along) / self.radius[i]
        return self.albedo[:, i] * light.diffuse(normal, shadows.sunlit(points), torch.full_like(along, 0.75))


@dataclass(frozen=True)
class Plants:
    """All plants of a flat; primitives are numbered leaves first, then stems."""

    leaves: Leaves
    stems: Stems

    @property
    def highest_m(self) -> float:
        """A height that no plant exceeds; -inf without plants."""
        leaves, stems = self.leaves, self.stems
        tops = leaves.centre[2] + leaves.radius, stems.start[2] + stems.radius, stems.end[2] + stems.radius
        return float(torch.cat([*tops, torch.tensor([-math.inf])]).max())

    def within(self, low_m: tuple[float, float], high_m: tuple[float, float]) -> Plants:
        """Select what may reach into a rectangle of ground: its south-west and north-east corners."""
        leaves, stems = self.leaves, self.stems
        low, high = (torch.tensor(corner)[:, None] for corner in (low_m, high_m))
        middle = 0.5 * (stems.start + stems.end)[:2]
        reach = stems.radius + 0.5 * torch.linalg.vector_norm(stems.end - stems.start, dim=0)
        near_leaves, near_stems = (
            torch.nonzero(((at > low - r) & (at < high + r)).all(0))[:, 0]
            for at, r in ((leaves.centre[:2], leaves.radius), (middle, reach))
        )
        return Plants(
            Leaves(**{name: value[..., near_leaves] for name, value in vars(leaves).items() if name != "planes"}),
            Stems(**{name: value[..., near_stems] for name, value in vars(stems).items()}),
        )

    def nearest(self, view: View) -> tuple[Float[Tensor, " R"], Int[Tensor, " R"]]:
        """Find, for every ray of a view, depth and number of the first primitive it meets; inf and -1 where none."""
        # Depth in the upper and the primitive in the lower half of one integer: the least is the nearest, and
        # ties have one answer whatever the order of writing.
        nearest = torch.full((view.columns * view.rows,), _MISS)
        leaves, stems = self.leaves, self.stems
        for kind, ends, first in ((leaves, (leaves.centre,), 0), (stems, (stems.start, stems.end), len(leaves))):
            for i, ray in box_pairs(_boxes(view, ends, kind.radius), view.columns):
                depth = kind.depth(i, view.rays(ray))
                met = torch.isfinite(depth)
                # Positive floats sort as their bits do.
                packed = (depth[met].view(torch.int32).long() << 32) | (i + first)[met]
                nearest.scatter_reduce_(0, ray[met], packed, "amin")
        depth = (nearest >> 32).to(torch.int32).view(torch.float32)
        return depth, torch.where(torch.isfinite(depth), nearest & 0xFFFFFFFF, -1)

    def radiance(
        self, light: Light, shadows: Shadows, view: View, ray: Int[Tensor, " P"], primitive: Int[Tensor, " P"]
    ) -> Float[Tensor, "3 P"]:
        """Shade the primitives that numbered rays meet; diffuse, so the same from all sides."""
        radiance = torch.empty(3, len(ray))
        is_leaf = primitive < len(self.leaves)
        for kind, own, first in ((self.leaves, is_leaf, 0), (self.stems, ~is_leaf, len(self.leaves))):
            hit = torch.nonzero(own)[:, 0]
            radiance[:, hit] = kind.radiance(light, shadows, primitive[hit] - first, view.rays(ray[hit]))
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
    """A shadow map: the depths of the first plants in a view from the sun, inf where there are none."""

    view: Parallel
    depth: Float[Tensor, " R"]

    def sunlit(self, points: Float[Tensor, "3 P"]) -> Float[Tensor, " P"]:
        """Compute the share of the sun that plants let through to points: four map cells compared, interpolated."""
        u, v, depth = self.view.project(points)
        u, v = u.clamp(0, self.view.columns - 1.001), v.clamp(0, self.view.rows - 1.001)
        column, row = u.floor(), v.floor()
        fu, fv = u - column, v - row
        first = (row * self.view.columns + column).long()
        corners = (0, 1, self.view.columns, self.view.columns + 1)
        lit = [(self.depth[first + k] + _BIAS_M > depth).float() for k in corners]
        return torch.lerp(torch.lerp(lit[0], lit[1], fu), torch.lerp(lit[2], lit[3], fu), fv)


def marsh_map(settings: Settings, terrain: Terrain, random: np.random.Generator) -> Float[Tensor, "H W"]:
    """Map how densely plants cover the ground, 0 to 1: patches on ground that most tides leave dry."""
    noise = Noise(random, channels=2)
    pattern = noise.fractal(terrain.extent.nodes(), 24.0, 5, gain=0.6)[0].reshape(terrain.ground.shape)
    above = terrain.ground - settings.tide_m
    dry = smoothstep(0.2, 0.55, above) * (terrain.water_depth == 0)
    # Creek levees stand highest and drain best: plants line them.
    levee = 0.5 * smoothstep(0.0, 0.35, terrain.near_channel) * smoothstep(0.75, 0.45, terrain.near_channel)
    score = pattern + levee
    level = float(torch.quantile(score[::4, ::4].reshape(-1), 1 - min(0.98, settings.marsh_share)))
    return smoothstep(level - 0.06, level + 0.14, score) * dry


def grow(
    settings: Settings, dates: Sequence[tuple[Terrain, Float[Tensor, "H W"]]], random: np.random.Generator
) -> list[Plants]:
    """Grow all plants of a flat at each date; what is drawn of a plant is the same at all dates at which it stands.

    Args:
        settings: of the first date.
        dates: the terrain, and how densely plants cover it.
    """
    sites = [
        Raster(terrain.extent, torch.stack([terrain.ground, marsh, terrain.water_depth])) for terrain, marsh in dates
    ]
    tufts, tiers = _tufts(settings, sites, random)
    trees, crowns, stems = _trees(settings, sites, random)
    grown = []
    for of_tufts, of_trees in zip(tufts, trees, strict=True):
        leaves = [*(part.standing(*of_tufts) for part in tiers), *(part.standing(*of_trees) for part in crowns)]
        fields = (np.concatenate(field, axis=-1) for field in zip(*leaves, strict=True))
        grown.append(Plants(Leaves(*map(_single, fields)), Stems(*map(_single, stems.standing(*of_trees)))))
    return grown


def _single(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values.astype(np.float32, order="C"))


_Stand = tuple[np.ndarray, np.ndarray]
"""The feet [3 N] of some plants on the ground of a date, and which of them [N] stand there."""


@dataclass(frozen=True)
class _Parts:
    """Leaves or stems of plants.

    Attributes:
        plant: the number of the plant that each belongs to.
        points: the first fields of Leaves or Stems, from the plant's foot.
        rest: the other fields, in their order.
    """

    plant: Int[np.ndarray, " N"]
    points: tuple[np.ndarray, ...]
    rest: tuple[np.ndarray, ...]

    def standing(self, feet: np.ndarray, stands: np.ndarray) -> list[np.ndarray]:
        """The fields of what stands at a date."""
        here = stands[self.plant]
        foot = feet[:, self.plant[here]]
        return [*(foot + point[:, here] for point in self.points), *(field[..., here] for field in self.rest)]


def _candidates(
    sites: list[Raster], count: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw places; return them on the ground of each date [D 3 N] with marsh density and water depth [D N]."""
    extent = sites[0].extent
    x = random.uniform(extent.west_m, extent.east_m, count).astype(np.float32)
    y = random.uniform(extent.south_m, extent.north_m, count).astype(np.float32)
    xy = np.stack([x, y])
    height, marsh, water = np.stack([site.sample(torch.from_numpy(xy)).numpy() for site in sites], axis=1)
    return np.stack([np.stack([x, y, z]) for z in height]), marsh, water


def _at_any_date(feet: np.ndarray, stands: np.ndarray) -> tuple[list[_Stand], int]:
    """Leave out candidates that stand at no date; return those of each date, and how many are left."""
    kept = stands.any(0)
    return [(own[:, kept], here[kept]) for own, here in zip(feet, stands, strict=True)], int(kept.sum())


def _tufts(settings: Settings, sites: list[Raster], random: np.random.Generator) -> tuple[list[_Stand], list[_Parts]]:
    """Grow rosettes of blades, three tiers high."""
    width, height = sites[0].extent.size_m
    count = int(settings.tufts_per_m2 * width * height)
    feet, marsh, water = _candidates(sites, count, random)
    stray = 0.012 * (water == 0)
    dates, count = _at_any_date(feet, random.random(count) < np.maximum(marsh, stray))
    hue = Noise(random, channels=2).fractal(torch.from_numpy(dates[0][0][:2]), 14.0, 3).numpy()
    tall = np.clip(0.55 + 0.45 * hue[1] + 0.15 * random.normal(size=count), 0.22, 1.05)
    spread = np.clip(0.36 * tall + 0.1 * random.normal(size=count), 0.14, 0.55)
    kind = np.clip(np.floor((hue[0] * 0.9 + 0.5) * 3.2 + random.normal(0, 0.7, count)), 0, 4).astype(int)
    tiers = []
    for rise, size, shade, openness in ((0.3, 1.0, 0.7, 0.4), (0.6, 0.8, 0.95, 0.7), (0.9, 0.5, 1.2, 1.0)):
        turn, tilt = random.uniform(0, 2 * math.pi, count), np.abs(random.normal(0, 0.35, count))
        offset = [random.normal(0, 0.12, count) * spread, random.normal(0, 0.12, count) * spread, rise * tall]
        normal = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        u, v = _tangents(normal, random.uniform(0, 2 * math.pi, count))
        albedo = _GRASS[kind].T * random.lognormal(0, 0.16, count) * shade
        outline = random.integers(6, 13, count), random.uniform(0, 6, count), random.uniform(0.6, 0.85, count)
        u, v = u * spread * size, v * spread * size * 0.8
        rest = (u, v, *outline, albedo, np.full(count, openness))
        tiers.append(_Parts(np.arange(count), (np.stack(offset),), rest))
    return dates, tiers


def _tangents(normal: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors perpendicular to unit normals [3 N] and to one another."""
    helper = np.where(np.abs(normal[2]) < 0.9, np.array([[0.0], [0.0], [1.0]]), np.array([[1.0], [0.0], [0.0]]))
    a = np.cross(normal, helper, axis=0)
    a = a / np.linalg.norm(a, axis=0)
    b = np.cross(normal, a, axis=0)
    return a * np.cos(turn) + b * np.sin(turn), b * np.cos(turn) - a * np.sin(turn)


def _trees(
    settings: Settings, sites: list[Raster], random: np.random.Generator
) -> tuple[list[_Stand], list[_Parts], _Parts]:
    """Grow mangroves: the leaves of each crown, and all stems."""
    width, height = sites[0].extent.size_m
    wanted = random.poisson(settings.trees_per_ha * width * height / 1e4)
    feet, marsh, water = _candidates(sites, 60 * wanted + 1, random)
    # In marsh first, on other dry ground where there is little of it, and now and then in shallow water.
    chance = np.where(water > 0, 0.004 * (water < 0.4), 0.02 + 0.6 * marsh)
    stands = random.random(60 * wanted + 1) < chance
    # Up to the candidate that is the last one wanted at the first date.
    stands &= np.cumsum(stands[0]) - stands[0] < wanted
    dates, count = _at_any_date(feet, stands)
    crowns, stems = [], []
    for tree in range(count):
        tall = random.uniform(2.0, 5.0)
        radius = tall * random.uniform(0.32, 0.52)
        bare = random.random() < 0.12
        stems += [[tree, *piece] for piece in _trunk(tall, radius, bare, random)]
        if not bare:
            offset, *rest = _crown(tall, radius, random)
            crowns.append(_Parts(np.full(offset.shape[1], tree), (offset,), tuple(rest)))
    table = np.array(stems, dtype=np.float64).reshape(-1, 11).T
    return dates, crowns, _Parts(table[0].astype(int), (table[1:4], table[4:7]), (table[7], table[8:11]))


def _crown(tall: float, radius: float, random: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Place sprays on the shells of a few overlapping lobes: fields of Leaves, centres from the tree's foot."""
    lobes = random.integers(3, 7)
    angle, out = random.uniform(0, 2 * math.pi, lobes), random.uniform(0.2, 0.62, lobes) * radius
    middle = np.stack([out * np.cos(angle), out * np.sin(angle), tall * random.uniform(0.62, 0.86, lobes)])
    count = int(34 * radius**2) + 20
    lobe = random.integers(0, lobes, count)
    direction = random.normal(size=(3, count))
    direction[2] += 0.45
    direction /= np.linalg.norm(direction, axis=0)
    size = random.uniform(0.42, 0.62, lobes)[lobe] * radius
    at = random.uniform(0.6, 1.0, count)
    flattened = np.array([[1.0], [1.0], [0.62]])
    offset = middle[:, lobe] + direction * flattened * size * at
    offset[2] = np.clip(offset[2], 0.25 * tall, None)
    normal = direction + np.array([[0], [0], [0.6]]) + random.normal(0, 0.35, (3, count))
    normal /= np.linalg.norm(normal, axis=0)
    u, v = _tangents(normal, random.uniform(0, 2 * math.pi, count))
    spray = random.uniform(0.2, 0.42, count) * (0.7 + 0.15 * radius)
    tone = _CANOPY[random.integers(0, len(_CANOPY))][:, None] * random.lognormal(0, 0.12)
    young = smoothstep(-0.8, 0.9, direction[2])
    albedo = tone * random.lognormal(0, 0.2, count) * (0.75 + 0.5 * young)
    outline = random.integers(4, 8, count), random.uniform(0, 6, count), random.uniform(0.35, 0.65, count)
    return offset, u * spray, v * spray * 0.7, *outline, albedo, 0.3 + 0.7 * young * at


def _trunk(tall: float, radius: float, bare: bool, random: np.random.Generator) -> list[list[float]]:
    """Grow a few crooked stems from one foot, and arching prop roots; a row of numbers for each straight piece."""
    rows = []
    bark = _BARK[random.integers(0, len(_BARK))]
    for _ in range(random.integers(2, 5)):
        angle, lean = random.uniform(0, 2 * math.pi), random.uniform(0.15, 0.6) * radius
        way = np.array([math.cos(angle), math.sin(angle), 0.0])
        joints = [0.1 * way - 0.1 * _UP]
        pieces = max(3, round(tall / 0.8))
        for k in range(1, pieces + 1):
            s = k / pieces
            sway = random.normal(0, 0.06, 2)
            joints.append(lean * s**0.8 * way + np.array([*sway, tall * s * (1.0 if bare else 0.8)]))
        thick = random.uniform(0.05, 0.11) * tall / 4 + 0.02
        rows += [[*a, *b, thick * (1 - 0.6 * k / pieces), *bark] for k, (a, b) in enumerate(pairwise(joints))]
    for _ in range(random.integers(3, 8)):
        angle, out = random.uniform(0, 2 * math.pi), random.uniform(0.3, 0.9) * (0.4 + 0.25 * radius)
        way = np.array([math.cos(angle), math.sin(angle), 0.0])
        joints = [(0.25 * out + 0.45) * _UP, 0.6 * out * way + 0.4 * _UP, out * way - 0.15 * _UP]
        rows += [[*a, *b, 0.035, *(0.8 * bark)] for a, b in pairwise(joints)]
    return rows
