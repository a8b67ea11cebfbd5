"""The colour of a ground point as one ray sees it: mud, wet mud and water with all their fine detail."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.synthetic.ground import Ground
from tidefield.synthetic.light import Light
from tidefield.synthetic.noise import Noise, resolved, smoothstep

_GRAIN_WAVELENGTHS_M = (1.1, 0.55, 0.27, 0.13, 0.06, 0.028, 0.013)
_GRAIN_SLOPE = 0.09
_RIPPLE_WAVELENGTH_M = 0.21
_RIPPLE_SLOPE = 0.2
_WAVES = 8
_TURBID_WATER, _CLEAR_WATER = (0.150, 0.125, 0.078), (0.030, 0.045, 0.038)
_FOAM = 0.5
_ABSORPTION_PER_M = (1.9, 1.5, 1.8)


def ground_radiance(
    ground: Ground,
    light: Light,
    noise: Noise,
    xy: Float[Tensor, "2 P"],
    to_eye: Float[Tensor, "3 P"] | None,
    footprint_m: Float[Tensor, " P"],
    seconds: float,
) -> Float[Tensor, "3 P"]:
    """Radiance from ground points towards the eye; with no eye, their dull part alone (for maps).

    Args:
        ground: the flat's maps.
        light: sun and sky.
        noise: the pattern of fine detail.
        xy: points.
        to_eye: unit vectors.
        footprint_m: distance between neighbouring samples; finer detail is averaged.
        seconds: time at which wavelets are seen.
    """
    maps = ground.maps.sample(xy)
    slope, albedo, (wet, depth, silt, foam, ripple, sunlit, openness) = maps[0:2], maps[2:5], maps[5:]
    afloat = smoothstep(0.0, 0.025, depth)
    rough, tint, spare = _grain(ground, noise, xy, footprint_m, ripple)
    # Mud smooths as it gets wet: a film of water fills the smallest hollows.
    mud_slope = slope + rough * (1 - 0.6 * wet)
    normal = _normal(mud_slope)
    albedo = albedo * tint
    dull = albedo * light.diffuse(normal, sunlit, openness)
    film, roughness = slope + 0.35 * rough, 0.10 + 0.12 * (1 - wet) + spare
    wade = torch.nonzero(depth > 0)[:, 0]
    waves, smallest = _wavelets(ground, noise, xy[:, wade], footprint_m[wade], depth[wade], seconds)
    body = _water_body(albedo[:, wade], depth[wade], silt[wade], foam[wade], light, sunlit[wade])
    # Wavelets gather the light that goes down on their sunny sides.
    gathered = 1 - 1.8 * (waves[0] * light.sun[0] + waves[1] * light.sun[1])
    dull[:, wade] = torch.lerp(dull[:, wade], body * gathered, afloat[wade])
    film[:, wade] = torch.lerp(film[:, wade], waves, afloat[wade])
    roughness[wade] = torch.lerp(roughness[wade], smallest, afloat[wade])
    if to_eye is None:
        return dull
    shine = torch.maximum(smoothstep(0.35, 1.0, wet), afloat)
    shiny = torch.nonzero(shine > 0)[:, 0]
    mirrored = light.mirrored(_normal(film[:, shiny]), to_eye[:, shiny], roughness[shiny], sunlit[shiny])
    dull[:, shiny] += shine[shiny] * mirrored
    return dull


def _normal(slope: Tensor) -> Tensor:
    length = torch.rsqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    return torch.stack([-slope[0] * length, -slope[1] * length, length])


def _grain(
    ground: Ground, noise: Noise, xy: Tensor, footprint: Tensor, ripple: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Slopes [2 P] and tint [P] of the mud's grain and small ripples, and the slope [P] left unresolved."""
    finest = float(footprint.min())
    slope, tint, bend = torch.zeros_like(xy), torch.ones_like(xy[0]), torch.zeros_like(xy[0])
    for k, wavelength in enumerate(_GRAIN_WAVELENGTHS_M):
        if wavelength < 1.5 * finest:
            break
        octave = noise.octave(xy, wavelength, k)
        if k < 2:
            bend = bend + (1.6 - k) * octave[k]
        octave = octave * resolved(wavelength, footprint)
        slope = slope + _GRAIN_SLOPE * octave[0:2]
        tint = tint + 0.11 * octave[2]
        # Shells and stones: the rare peaks of one channel.
        tint = tint + ground.shells * 1.6 * (octave[3] - 0.62).clamp(min=0)
    seen = resolved(_RIPPLE_WAVELENGTH_M, footprint)
    strength = _RIPPLE_SLOPE * ripple
    if 1.5 * finest < _RIPPLE_WAVELENGTH_M:
        cos, sin = math.cos(ground.ripple_heading), math.sin(ground.ripple_heading)
        wave = torch.cos((xy[0] * cos + xy[1] * sin) * (2 * math.pi / _RIPPLE_WAVELENGTH_M) + bend)
        slope = slope + (strength * seen * wave) * xy.new_tensor([[cos], [sin]])
        tint = tint * (1 - 0.07 * ripple * seen * wave)
    return slope, tint.clamp(min=0.25), 0.25 * strength * (1 - seen)


def _water_body(albedo: Tensor, depth: Tensor, silt: Tensor, foam: Tensor, light: Light, sunlit: Tensor) -> Tensor:
    """Light that comes back out of the water: the bed through it, and the silt in it."""
    colour = [albedo.new_tensor(c)[:, None] for c in (_TURBID_WATER, _CLEAR_WATER, _ABSORPTION_PER_M)]
    body = torch.lerp(colour[1], colour[0], silt)
    through = torch.exp(-colour[2] * depth * (0.8 + 2.5 * silt))
    colour_up = (albedo * through + body * (1 - through)) * (1 - foam) + _FOAM * foam
    level = depth.new_tensor([0.0, 0.0, 1.0])[:, None]
    # Shadows are soft on water: silt scatters light into them.
    return colour_up * light.diffuse(level, 0.3 + 0.7 * sunlit, torch.ones_like(depth))


def _wavelets(
    ground: Ground, noise: Noise, xy: Tensor, footprint: Tensor, depth: Tensor, seconds: float
) -> tuple[Tensor, Tensor]:
    """Slopes [2 P] of the wavelets that a sample resolves, and the root-mean-square slope [P] of the rest."""
    slope, variance = torch.zeros_like(xy), torch.full_like(depth, 0.02**2)
    gust = 0.75 + 0.5 * noise.octave(xy, 9.0, 21)[0]
    warp, fine = noise.octave(xy, 5.3, 22), noise.octave(xy, 1.3, 23)
    share = ground.wave_slope * math.sqrt(2 / _WAVES)
    for k in range(_WAVES):
        wavelength = 0.25 * 1.4**k
        number = 2 * math.pi / wavelength
        heading = ground.ripple_heading + 1.1 * math.sin(2.4 * k + 1)
        cos, sin = math.cos(heading), math.sin(heading)
        seen = resolved(wavelength, footprint)
        # Waves on deep water: the square of the frequency is g k.
        turn = 1.9 * k - math.sqrt(9.81 * number) * seconds
        phase = number * (xy[0] * cos + xy[1] * sin) + (3.0 * warp[k % 4] + 0.8 * fine[(k + 1) % 4]) + turn
        slope = slope + (share * seen * torch.cos(phase)) * xy.new_tensor([[cos], [sin]])
        variance = variance + 0.5 * share**2 * (1 - seen)
    # Waves that cross are never as regular as their sum.
    slope = slope + (0.9 * share * resolved(1.3, footprint)) * fine[0:2] + (0.9 * share) * warp[0:2]
    # Shallow water is calm.
    height = gust * (0.25 + 0.75 * smoothstep(0.05, 0.5, depth))
    return slope * height, torch.sqrt(variance) * height
