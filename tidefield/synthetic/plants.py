"""Plant growth: where tufts of marsh grass and mangroves stand, and the leaf sprays and stems they are built of."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.synthetic.foliage import Leaves, Plants, Stems
from tidefield.synthetic.grids import Noise, Raster, smoothstep
from tidefield.synthetic.settings import Settings
from tidefield.synthetic.terrain import Terrain

# Linear albedos.
_GRASS = np.array([[0.115, 0.150, 0.045], [0.175, 0.185, 0.060], [0.080, 0.110, 0.045], [0.260, 0.205, 0.095],
                   [0.170, 0.105, 0.055]])  # fmt: skip
_CANOPY = np.array([[0.055, 0.105, 0.030], [0.085, 0.135, 0.035], [0.120, 0.165, 0.050], [0.060, 0.085, 0.035]])
_BARK = np.array([[0.210, 0.180, 0.145], [0.130, 0.105, 0.080], [0.300, 0.270, 0.230]])


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


def grow(settings: Settings, terrain: Terrain, marsh: Float[Tensor, "H W"], random: np.random.Generator) -> Plants:
    """Grow all plants of a flat."""
    site = Raster(terrain.extent, torch.stack([terrain.ground, marsh, terrain.water_depth]))
    tufts = _tufts(settings, site, random)
    crowns, stems = _trees(settings, site, random)
    return Plants(Leaves.joined([*tufts, *crowns]), Stems.joined(stems))


def _random_places(site: Raster, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw ground points [3 count]; return them with marsh density and water depth [2 count]."""
    extent = site.extent
    x = random.uniform(extent.west_m, extent.east_m, count).astype(np.float32)
    y = random.uniform(extent.south_m, extent.north_m, count).astype(np.float32)
    height, *cover = site.sample(torch.from_numpy(np.stack([x, y]))).numpy()
    return np.stack([x, y, height]), np.stack(cover)


def _tufts(settings: Settings, site: Raster, random: np.random.Generator) -> list[Leaves]:
    """Grow rosettes of blades, three tiers high."""
    width, height = site.extent.size_m
    count = int(settings.tufts_per_m2 * width * height)
    base, (marsh, water) = _random_places(site, count, random)
    stray = 0.012 * (water == 0)
    base = base[:, random.random(count) < np.maximum(marsh, stray)]
    count = base.shape[1]
    hue = Noise(random, channels=2).fractal(torch.from_numpy(base[:2]), 14.0, 3).numpy()
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
        tiers.append(Leaves.of(base + np.stack(offset), u, v, *outline, albedo, np.full(count, openness)))
    return tiers


def _tangents(normal: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors perpendicular to unit normals [3 N] and to one another."""
    helper = np.where(np.abs(normal[2]) < 0.9, np.array([[0.0], [0.0], [1.0]]), np.array([[1.0], [0.0], [0.0]]))
    a = np.cross(normal, helper, axis=0)
    a = a / np.linalg.norm(a, axis=0)
    b = np.cross(normal, a, axis=0)
    return a * np.cos(turn) + b * np.sin(turn), b * np.cos(turn) - a * np.sin(turn)


def _trees(settings: Settings, site: Raster, random: np.random.Generator) -> tuple[list[Leaves], list[Stems]]:
    """Grow mangroves: crowns, and stems (at least one item, perhaps an empty one)."""
    width, height = site.extent.size_m
    wanted = random.poisson(settings.trees_per_ha * width * height / 1e4)
    bases, (marsh, water) = _random_places(site, 60 * wanted + 1, random)
    # In marsh first, on other dry ground where there is little of it, and now and then in shallow water.
    chance = np.where(water > 0, 0.004 * (water < 0.4), 0.02 + 0.6 * marsh)
    bases = bases[:, random.random(bases.shape[1]) < chance][:, :wanted]
    crowns, stems = [], [Stems.of(np.zeros((3, 0)), np.zeros((3, 0)), np.zeros(0), np.zeros((3, 0)))]
    for base in bases.T:
        tall = random.uniform(2.0, 5.0)
        radius = tall * random.uniform(0.32, 0.52)
        bare = random.random() < 0.12
        stems.append(_trunk(base, tall, radius, bare, random))
        if not bare:
            crowns.append(_crown(base, tall, radius, random))
    return crowns, stems


def _crown(base: np.ndarray, tall: float, radius: float, random: np.random.Generator) -> Leaves:
    """Place sprays on the shells of a few overlapping lobes."""
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
    return Leaves.of(base[:, None] + offset, u * spray, v * spray * 0.7, *outline, albedo, 0.3 + 0.7 * young * at)


def _trunk(base: np.ndarray, tall: float, radius: float, bare: bool, random: np.random.Generator) -> Stems:
    """Grow a few crooked stems from one foot, and arching prop roots."""
    rows = []
    bark = _BARK[random.integers(0, len(_BARK))]
    for _ in range(random.integers(2, 5)):
        angle, lean = random.uniform(0, 2 * math.pi), random.uniform(0.15, 0.6) * radius
        way = np.array([math.cos(angle), math.sin(angle), 0.0])
        joints = [base + (0.1 * way - np.array([0.0, 0.0, 0.1]))]
        pieces = max(3, round(tall / 0.8))
        for k in range(1, pieces + 1):
            s = k / pieces
            sway = random.normal(0, 0.06, 2)
            joints.append(base + (lean * s**0.8 * way + np.array([*sway, tall * s * (1.0 if bare else 0.8)])))
        thick = random.uniform(0.05, 0.11) * tall / 4 + 0.02
        rows += [[*a, *b, thick * (1 - 0.6 * k / pieces), *bark] for k, (a, b) in enumerate(pairwise(joints))]
    for _ in range(random.integers(3, 8)):
        angle, out = random.uniform(0, 2 * math.pi), random.uniform(0.3, 0.9) * (0.4 + 0.25 * radius)
        way = np.array([math.cos(angle), math.sin(angle), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        joints = [base + (0.25 * out + 0.45) * up, base + 0.6 * out * way + 0.4 * up, base + out * way - 0.15 * up]
        rows += [[*a, *b, 0.035, *(0.8 * bark)] for a, b in pairwise(joints)]
    table = np.array(rows).T
    return Stems.of(table[0:3], table[3:6], table[6], table[7:10])
