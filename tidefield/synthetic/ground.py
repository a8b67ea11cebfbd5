"""What the ground is made of: colours, wetness and litter, laid out on the terrain's raster once per flat."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.synthetic.noise import Noise, smoothstep
from tidefield.synthetic.raster import Raster, blurred
from tidefield.synthetic.settings import Settings
from tidefield.synthetic.terrain import Terrain

_SILT, _MUD, _SAND, _IRON, _ALGAE, _LITTER = (
    (0.255, 0.225, 0.180),
    (0.165, 0.135, 0.098),
    (0.370, 0.300, 0.205),
    (0.225, 0.130, 0.065),
    (0.105, 0.115, 0.045),
    (0.150, 0.125, 0.065),
)
"""Linear albedos when dry."""


@dataclass(frozen=True)
class Ground:
    """Everything that shading reads at a ground point.

    Attributes:
        maps: 12 channels: slope east and north, albedo red, green and blue, wetness, water depth in metres, silt in
            and foam on the water, strength of small ripples, share of the sun, share of the sky.
        ripple_heading: direction across the small ripples, radians from east.
        shells: density of pale litter.
        wave_slope: root-mean-square slope of wavelets on open water.
    """

    maps: Raster
    ripple_heading: float
    shells: float
    wave_slope: float


def make_ground(
    settings: Settings,
    terrain: Terrain,
    marsh: Float[Tensor, "H W"],
    sun: Float[Tensor, "3"],
    shade: Float[Tensor, "H W"],
    random: np.random.Generator,
) -> Ground:
    """Bake the maps.

    Args:
        settings: what the flat is like.
        terrain: its shape.
        marsh: 1 where plants grow densely.
        sun: unit vector towards it.
        shade: share of the sun that plants let through.
        random: draws the patterns.
    """
    noise = Noise.make(random, channels=4)
    nodes = terrain.extent.nodes()
    shape = (terrain.extent.rows, terrain.extent.columns)
    large = noise.fractal(nodes, 26.0, 4).reshape(4, *shape)
    small = noise.fractal(nodes + 900, 3.6, 4).reshape(4, *shape)
    surface = terrain.surface
    wet = wetness(settings, terrain, large[3] + 0.5 * small[3])
    albedo = _albedo(settings, terrain, marsh, wet, large, small)
    sunlit = shade * _terrain_sun(surface, sun)
    # Troughs see less of the sky: the height against its surroundings stands for how much.
    hollow = (surface.values[0] - blurred(surface.values[0], 6)) / 0.18
    openness = (0.95 + 0.2 * hollow).clamp(0.55, 1.15) * (1 - 0.35 * marsh)
    silt, foam = (x.reshape(shape) for x in _drift(noise, nodes, large[1].reshape(-1)))
    # Rough water foams.
    foam = foam * float(np.clip((settings.wave_slope - 0.035) / 0.03, 0, 1)) * smoothstep(0.1, 0.4, terrain.water_depth)
    ripple = terrain.ripple * (1 - marsh)
    maps = [*surface.gradient(), *albedo, wet, terrain.water_depth, silt, foam, ripple, sunlit, openness]
    return Ground(
        Raster(terrain.extent, torch.stack(maps)),
        float(random.uniform(0, math.pi)),
        settings.shells,
        settings.wave_slope,
    )


def wetness(settings: Settings, terrain: Terrain, pattern: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """0 for dry mud to 1 for mud under a film of water: low ground, channel margins and the rims of pools."""
    above_tide = terrain.ground - settings.tide_m - 0.25 * pattern
    low = smoothstep(0.75 * settings.wetness + 0.25, 0.05, above_tide)
    margin = smoothstep(0.1, 0.75, terrain.near_channel + 0.15 * pattern) * (0.5 + 0.5 * settings.wetness)
    damp = settings.wetness * smoothstep(0.15, 0.6, pattern + 0.5 * settings.wetness - 0.25)
    pool = (blurred((terrain.water_depth > 0).float(), 3) * 2.2).clamp(max=1)
    # Between sand waves the water stays longest.
    trough = (blurred(terrain.ground, 5) - terrain.ground) / (0.5 * settings.ripple_m)
    trough = (0.4 + 0.6 * settings.wetness) * terrain.ripple * smoothstep(0.1, 0.8, trough)
    rill = (0.5 + 0.5 * settings.wetness) * terrain.rill
    return torch.stack([low, margin, 0.8 * damp, pool, trough, rill]).amax(0)


def _albedo(settings: Settings, terrain: Terrain, marsh: Tensor, wet: Tensor, large: Tensor, small: Tensor) -> Tensor:
    """Dry mud and sand in patches, iron and algae on them, darkened where wet."""
    colour = [torch.tensor(c)[:, None, None] for c in (_SILT, _MUD, _SAND, _IRON, _ALGAE, _LITTER)]
    silt, mud, sand, iron, algae, litter = colour
    height = terrain.ground - blurred(terrain.ground, 10)
    mix = torch.lerp(mud.expand(3, *wet.shape), silt, smoothstep(-0.5, 0.5, large[0] + 0.45 * small[0] + 2 * height))
    sandy = settings.sand * smoothstep(-0.55, 0.25, large[1] + 0.35 * small[1] + 0.5 * terrain.ripple - 0.2)
    mix = torch.lerp(mix, sand, sandy.clamp(max=1))
    mix = torch.lerp(mix, iron, 0.35 * smoothstep(0.2, 0.7, large[2] - 0.3 * small[2]))
    film = settings.algae * smoothstep(0.15, 0.75, small[1] + 0.6 * large[2]) * (1 - terrain.ripple * 0.5)
    mix = torch.lerp(mix, algae, 0.8 * film * (1 - smoothstep(0.5, 0.9, terrain.near_channel)))
    mix = torch.lerp(mix, torch.lerp(litter, algae, (0.5 + small[3]).clamp(0, 1)), 0.75 * marsh)
    mix = mix * (1 + 0.16 * small[2] + 0.08 * large[3])
    # Water between the grains: darker by half and a little more saturated (Lekner and Dorf 1988).
    return mix * (1 - wet * torch.tensor([0.50, 0.52, 0.54])[:, None, None])


def _drift(noise: Noise, nodes: Tensor, large: Tensor) -> tuple[Tensor, Tensor]:
    """What water carries: clouds and bands of silt, and threads of foam between them, both 0 to 1."""
    bent = nodes + 4 * noise.fractal(nodes, 30.0, 3)[:2]
    bands = noise.fractal(torch.stack([bent[0], 0.5 * bent[1]]), 5.0, 5, gain=0.6)
    silt = (0.42 + 0.4 * large + 0.3 * bands[3]).clamp(0, 1)
    thread = (1 - (bands[0] + 0.3 * large).abs() / 0.12).clamp(min=0) ** 2
    flecks = smoothstep(-0.1, 0.6, noise.fractal(nodes, 0.7, 3)[1])
    windward = smoothstep(0.1, 0.5, noise.fractal(nodes + 70, 18.0, 2)[2])
    return silt, thread * flecks * windward


def _terrain_sun(surface: Raster, sun: Float[Tensor, "3"]) -> Float[Tensor, "H W"]:
    """Share of the sun's disc above the terrain's own horizon, softly, at every node."""
    level = float(torch.hypot(sun[0], sun[1]))
    height, extent = surface.values[0], surface.extent
    highest = float(height.amax()) - height.reshape(-1)
    nodes = extent.nodes()
    horizon = torch.full_like(highest, -1.0)
    if level < 1e-3:
        return torch.ones_like(height)
    reach = (float(highest.amax()) * level / float(sun[2])) + extent.cell_m
    distance = 1.5 * extent.cell_m
    while distance < reach:
        ahead = nodes + (sun[:2] * (distance / level))[:, None]
        horizon = torch.maximum(horizon, (surface.sample(ahead)[0] - height.reshape(-1)) / distance)
        distance *= 1.3
    tangent = float(sun[2]) / level
    return (1 - smoothstep(0.9 * tangent, 1.1 * tangent + 0.05, horizon)).reshape(height.shape)
