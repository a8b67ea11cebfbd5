"""Where plants grow and what they are built of: tufts of marsh grass and mangroves."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.synthetic.noise import Noise, smoothstep
from tidefield.synthetic.primitives import Leaves, Plants, Stems
from tidefield.synthetic.raster import Raster
from tidefield.synthetic.settings import Settings
from tidefield.synthetic.terrain import Terrain

_GRASS = np.array([[0.115, 0.150, 0.045], [0.175, 0.185, 0.060], [0.080, 0.110, 0.045], [0.260, 0.205, 0.095],
                   [0.170, 0.105, 0.055]])  # fmt: skip
_CANOPY = np.array([[0.055, 0.105, 0.030], [0.085, 0.135, 0.035], [0.120, 0.165, 0.050], [0.060, 0.085, 0.035]])
_BARK = np.array([[0.210, 0.180, 0.145], [0.130, 0.105, 0.080], [0.300, 0.270, 0.230]])


def marsh_map(settings: Settings, terrain: Terrain, random: np.random.Generator) -> Float[Tensor, "H W"]:
    """How densely plants cover the ground, 0 to 1: patches on ground that most tides leave dry."""
    noise = Noise.make(random, channels=2)
    nodes = terrain.extent.nodes()
    pattern = (noise.fractal(nodes, 24.0, 5, gain=0.6)[0]).reshape(terrain.ground.shape)
    above = terrain.ground - settings.tide_m
    dry = smoothstep(0.2, 0.55, above) * (terrain.water_depth == 0)
    # Creek levees stand highest and drain best: plants line them.
    levee = 0.5 * smoothstep(0.0, 0.35, terrain.near_channel) * smoothstep(0.75, 0.45, terrain.near_channel)
    wanted = pattern + levee
    level = float(torch.quantile(wanted[::4, ::4].reshape(-1), 1 - min(0.98, settings.marsh_share)))
    return smoothstep(level - 0.06, level + 0.14, wanted) * dry


def grow(settings: Settings, terrain: Terrain, marsh: Float[Tensor, "H W"], random: np.random.Generator) -> Plants:
    """All plants of a flat."""
    density = Raster(terrain.extent, torch.stack([terrain.ground, marsh, terrain.water_depth]))
    tufts = _tufts(settings, density, random)
    canopies, stems = _trees(settings, density, random)
    leaves = np.concatenate([tufts, canopies], axis=1).astype(np.float32)
    return Plants(_leaves(torch.from_numpy(leaves)), _stems(torch.from_numpy(stems.astype(np.float32))))


def _leaves(rows: Tensor) -> Leaves:
    return Leaves(rows[0:3], rows[3:6], rows[6:9], rows[9], rows[10], rows[11], rows[12:15], rows[15])


def _stems(rows: Tensor) -> Stems:
    return Stems(rows[0:3], rows[3:6], rows[6], rows[7:10])


def _places(density: Raster, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Random ground points [3 count], and marsh density and water depth [2 count] there."""
    extent = density.extent
    x = random.uniform(extent.west_m, extent.east_m, count).astype(np.float32)
    y = random.uniform(extent.south_m, extent.north_m, count).astype(np.float32)
    read = density.sample(torch.from_numpy(np.stack([x, y]))).numpy()
    return np.stack([x, y, read[0]]), read[1:]


def _tufts(settings: Settings, density: Raster, random: np.random.Generator) -> np.ndarray:
    """Rosettes of blades, some tiers high: leaf rows [16 N]."""
    width, height = density.extent.size_m
    count = int(settings.tufts_per_m2 * width * height)
    place, (marsh, water) = _places(density, count, random)
    stray = 0.012 * (water == 0)
    place = place[:, random.random(count) < np.maximum(marsh, stray)]
    count = place.shape[1]
    hue = Noise.make(random, channels=2).fractal(torch.from_numpy(place[:2].astype(np.float32)), 14.0, 3).numpy()
    tall = np.clip(0.55 + 0.45 * hue[1] + 0.15 * random.normal(size=count), 0.22, 1.05)
    spread = np.clip(0.36 * tall + 0.1 * random.normal(size=count), 0.14, 0.55)
    kind = np.clip(np.floor((hue[0] * 0.9 + 0.5) * 3.2 + random.normal(0, 0.7, count)), 0, 4).astype(int)
    tiers = []
    for k, (rise, size) in enumerate(((0.3, 1.0), (0.6, 0.8), (0.9, 0.5))):
        turn, tilt = random.uniform(0, 2 * math.pi, count), np.abs(random.normal(0, 0.35, count))
        centre = place + np.stack(
            [random.normal(0, 0.12, count) * spread, random.normal(0, 0.12, count) * spread, rise * tall]
        )
        normal = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        u, v = _axes(normal, random.uniform(0, 2 * math.pi, count))
        colour = _GRASS[kind].T * random.lognormal(0, 0.16, count) * (0.7 + 0.25 * k)
        shape = np.stack([random.integers(6, 13, count), random.uniform(0, 6, count), random.uniform(0.6, 0.85, count)])
        openness = np.full((1, count), (0.4, 0.7, 1.0)[k])
        tiers.append(np.concatenate([centre, u * spread * size, v * spread * size * 0.8, shape, colour, openness]))
    return np.concatenate(tiers, axis=1)


def _axes(normal: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors square to unit normals [3 N] and to one another."""
    helper = np.where(np.abs(normal[2]) < 0.9, np.array([[0.0], [0.0], [1.0]]), np.array([[1.0], [0.0], [0.0]]))
    a = np.cross(normal, helper, axis=0)
    a = a / np.linalg.norm(a, axis=0)
    b = np.cross(normal, a, axis=0)
    return a * np.cos(turn) + b * np.sin(turn), b * np.cos(turn) - a * np.sin(turn)


def _trees(settings: Settings, density: Raster, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mangroves: leaf rows [16 N] and stem rows [10 M]."""
    width, height = density.extent.size_m
    wanted = random.poisson(settings.trees_per_ha * width * height / 1e4)
    place, (marsh, water) = _places(density, 60 * wanted + 1, random)
    # In marsh first, on other dry ground where there is little of it, and now and then in shallow water.
    chance = np.where(water > 0, 0.004 * (water < 0.4), 0.02 + 0.6 * marsh)
    place = place[:, random.random(place.shape[1]) < chance][:, :wanted]
    leaves, stems = [np.zeros((16, 0))], [np.zeros((10, 0))]
    for base in place.T:
        tall = random.uniform(2.0, 5.0)
        radius = tall * random.uniform(0.32, 0.52)
        bare = random.random() < 0.12
        stems.append(_trunk(base, tall, radius, bare, random))
        if not bare:
            leaves.append(_crown(base, tall, radius, random))
    return np.concatenate(leaves, axis=1), np.concatenate(stems, axis=1)


def _crown(base: np.ndarray, tall: float, radius: float, random: np.random.Generator) -> np.ndarray:
    """Sprays on the shells of a few overlapping lobes."""
    lobes = random.integers(3, 7)
    angle, out = random.uniform(0, 2 * math.pi, lobes), random.uniform(0.2, 0.62, lobes) * radius
    middle = np.stack([out * np.cos(angle), out * np.sin(angle), tall * random.uniform(0.62, 0.86, lobes)])
    count = int(34 * radius**2) + 20
    which = random.integers(0, lobes, count)
    direction = random.normal(size=(3, count))
    direction[2] += 0.45
    direction /= np.linalg.norm(direction, axis=0)
    size = random.uniform(0.42, 0.62, lobes)[which] * radius
    at = random.uniform(0.6, 1.0, count)
    flat = np.array([[1.0], [1.0], [0.62]])
    offset = middle[:, which] + direction * flat * size * at
    offset[2] = np.clip(offset[2], 0.25 * tall, None)
    normal = direction + np.array([[0], [0], [0.6]]) + random.normal(0, 0.35, (3, count))
    normal /= np.linalg.norm(normal, axis=0)
    u, v = _axes(normal, random.uniform(0, 2 * math.pi, count))
    spray = random.uniform(0.2, 0.42, count) * (0.7 + 0.15 * radius)
    tone = _CANOPY[random.integers(0, len(_CANOPY))][:, None] * random.lognormal(0, 0.12)
    young = _smooth(direction[2])
    colour = tone * random.lognormal(0, 0.2, count) * (0.75 + 0.5 * young)
    shape = np.stack([random.integers(4, 8, count), random.uniform(0, 6, count), random.uniform(0.35, 0.65, count)])
    openness = (0.3 + 0.7 * young * at)[None]
    centre = base[:, None] + offset
    return np.concatenate([centre, u * spray, v * spray * 0.7, shape, colour, openness])


def _smooth(x: np.ndarray) -> np.ndarray:
    """0 at -0.8, 1 at 0.9, cubic between."""
    t = np.clip((x + 0.8) / 1.7, 0, 1)
    return t * t * (3 - 2 * t)


def _trunk(base: np.ndarray, tall: float, radius: float, bare: bool, random: np.random.Generator) -> np.ndarray:
    """A few crooked stems from one foot, and arching prop roots: stem rows [10 M]."""
    rows = []
    bark = _BARK[random.integers(0, len(_BARK))]
    for _ in range(random.integers(2, 5)):
        angle, lean = random.uniform(0, 2 * math.pi), random.uniform(0.15, 0.6) * radius
        ends = [base + np.array([0.1 * math.cos(angle), 0.1 * math.sin(angle), -0.1])]
        pieces = max(3, round(tall / 0.8))
        for k in range(1, pieces + 1):
            s = k / pieces
            sway = random.normal(0, 0.06, 2)
            reach = lean * s**0.8
            step = [
                reach * math.cos(angle) + sway[0],
                reach * math.sin(angle) + sway[1],
                tall * s * (1.0 if bare else 0.8),
            ]
            ends.append(base + np.array(step))
        thick = random.uniform(0.05, 0.11) * tall / 4 + 0.02
        rows += [[*a, *b, thick * (1 - 0.6 * k / pieces), *bark] for k, (a, b) in enumerate(pairwise(ends))]
    for _ in range(random.integers(3, 8)):
        angle, out = random.uniform(0, 2 * math.pi), random.uniform(0.3, 0.9) * (0.4 + 0.25 * radius)
        way = np.array([math.cos(angle), math.sin(angle), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        knees = [base + (0.25 * out + 0.45) * up, base + 0.6 * out * way + 0.4 * up, base + out * way - 0.15 * up]
        rows += [[*a, *b, 0.035, *(0.8 * bark)] for a, b in pairwise(knees)]
    return np.array(rows).T
