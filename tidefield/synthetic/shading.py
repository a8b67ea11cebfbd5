"""Light and ground: sun and sky, what the ground is made of, and the colour of a ground point as one ray sees it.

Radiance is in units of what a white, diffuse, level surface shows under the open sky with the sun at the zenith.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.synthetic.grids import Noise, Raster, blurred, resolved, smoothstep
from tidefield.synthetic.rays import dot, normalised
from tidefield.synthetic.settings import Settings
from tidefield.synthetic.terrain import Terrain

_FRESNEL_AT_NORMAL = 0.021
"""Reflectance of water, refractive index 1.34, seen at right angles."""
# Linear albedos when dry.
_SILT, _MUD, _SAND = (0.255, 0.225, 0.180), (0.165, 0.135, 0.098), (0.370, 0.300, 0.205)
_IRON, _ALGAE, _LITTER = (0.225, 0.130, 0.065), (0.105, 0.115, 0.045), (0.150, 0.125, 0.065)
_TURBID_WATER, _CLEAR_WATER = (0.150, 0.125, 0.078), (0.030, 0.045, 0.038)
_FOAM = 0.5
_ABSORPTION_PER_M = (1.9, 1.5, 1.8)
# Detail finer than the maps. Octaves of mud grain roughly halve; root-mean-square slopes are chosen by eye.
_GRAIN_WAVELENGTHS_M = (1.1, 0.55, 0.27, 0.13, 0.06, 0.028, 0.013)
_GRAIN_SLOPE = 0.09
_RIPPLE_WAVELENGTH_M = 0.21
_RIPPLE_SLOPE = 0.2
_WAVES = 8


@dataclass(frozen=True)
class Light:
    """The sun and a clear sky with thin cloud.

    Attributes:
        sun: unit vector towards it.
        sun_rgb: radiance of a white, diffuse surface that faces the sun.
        sky_rgb: the same under the sky alone.
        noise: the pattern of the clouds.
    """

    sun: Float[Tensor, "3"]
    sun_rgb: Float[Tensor, "3"]
    sky_rgb: Float[Tensor, "3"]
    noise: Noise

    @staticmethod
    def make(elevation_deg: float, azimuth_deg: float, noise: Noise) -> Light:
        """Build the light of a sun at an elevation above the horizon and an azimuth clockwise from north."""
        elevation, azimuth = math.radians(elevation_deg), math.radians(azimuth_deg)
        level, up = math.cos(elevation), math.sin(elevation)
        sun = torch.tensor([level * math.sin(azimuth), level * math.cos(azimuth), up])
        # A low sun is redder and weaker: a rough fit to the air's transmission at three wavelengths.
        air_mass = 1 / max(up, 0.08)
        sun_rgb = torch.exp(-torch.tensor([0.10, 0.16, 0.26]) * (air_mass - 1)) * torch.tensor([1.05, 1, 0.9])
        return Light(sun, 1.3 * sun_rgb, torch.tensor([0.22, 0.255, 0.305]), noise)

    def diffuse(
        self, normal: Float[Tensor, "3 #P"], sunlit: Float[Tensor, " #P"], openness: Float[Tensor, " #P"]
    ) -> Float[Tensor, "3 P"]:
        """Compute the radiance of white, diffuse surfaces, given the shares of sun and sky that reach them."""
        facing = dot(normal, self.sun[:, None]).clamp(min=0) * sunlit
        above = (0.5 + 0.5 * normal[2]) * openness
        return self.sun_rgb[:, None] * facing + self.sky_rgb[:, None] * above

    def sky(self, direction: Float[Tensor, "3 P"]) -> Float[Tensor, "3 P"]:
        """Compute the radiance of the sky in unit directions, without the sun's disc."""
        up = direction[2].clamp(min=0.02)
        zenith, horizon = (torch.tensor(c)[:, None] for c in ([0.13, 0.24, 0.46], [0.62, 0.70, 0.80]))
        # Clouds lie on a plane: their pattern depends on where the ray would cross it.
        across = direction[:2] / (up + 0.15)
        cloud = smoothstep(-0.1, 0.5, self.noise.fractal(across, 0.9, 3)[0]) * 0.55
        near_sun = dot(direction, self.sun[:, None]).clamp(min=0)
        glow = 0.5 * near_sun**8 + 1.2 * near_sun**60
        clear = zenith + (horizon - zenith) * (1 - up) ** 3
        return clear + (0.85 - clear) * cloud + glow * self.sun_rgb[:, None]

    def specular(
        self,
        normal: Float[Tensor, "3 P"],
        to_eye: Float[Tensor, "3 P"],
        roughness: Float[Tensor, " P"],
        sunlit: Float[Tensor, " P"],
    ) -> Float[Tensor, "3 P"]:
        """Compute what a wet surface reflects of sky and sun (Fresnel after Schlick, facets after GGX).

        Normals and directions are unit vectors; `roughness` is the root-mean-square slope of the facets that are too
        small to be drawn, `sunlit` the share of the sun that is not in shadow.
        """
        facing = dot(normal, to_eye).clamp(min=0.02)
        reflected = 2 * facing * normal - to_eye
        sky = _fresnel(facing) * self.sky(reflected)
        half = normalised(to_eye + self.sun[:, None])
        # GGX by tangents: alpha^2 / (pi (cos^2 (alpha^2 - 1) + 1)^2), with alpha^2 twice the slope's variance.
        alpha2 = 2 * roughness**2 + 2e-4
        facets = alpha2 / (math.pi * (dot(normal, half).clamp(min=0) ** 2 * (alpha2 - 1) + 1) ** 2)
        facing_sun = dot(normal, self.sun[:, None]).clamp(min=0.02)
        # Visibility of facets: the usual rational form for smooth surfaces, 1 / (4 max(cos, cos)).
        shape = facets / (4 * torch.maximum(facing, facing_sun))
        glint = _fresnel(dot(half, to_eye).clamp(min=0)) * shape * math.pi * sunlit * facing_sun
        return sky + glint * self.sun_rgb[:, None]


def _fresnel(cos: Tensor) -> Tensor:
    return _FRESNEL_AT_NORMAL + (1 - _FRESNEL_AT_NORMAL) * (1 - cos) ** 5


def to_srgb(radiance: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
    """Convert linear radiance to sRGB values in [0, 1], highlights rolled off as cameras do."""
    knee = 0.7
    bright = (radiance - knee).clamp(min=0)
    linear = radiance.clamp(0, knee) + (1 - knee) * (1 - torch.exp(-bright / (1 - knee)))
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=1e-6) ** (1 / 2.4) - 0.055)


@dataclass(frozen=True)
class GroundPoints:
    """The ground's maps at points.

    Attributes:
        slope: east and north.
        wetness: 0 for dry mud to 1 for mud under a film of water.
        silt: in the water, 0 to 1.
        foam: on the water, 0 to 1.
        ripple: strength of the small ripples, 0 to 1.
        sunlit: share of the sun.
        openness: share of the sky.
    """

    slope: Float[Tensor, "2 P"]
    albedo: Float[Tensor, "3 P"]
    wetness: Float[Tensor, " P"]
    water_depth_m: Float[Tensor, " P"]
    silt: Float[Tensor, " P"]
    foam: Float[Tensor, " P"]
    ripple: Float[Tensor, " P"]
    sunlit: Float[Tensor, " P"]
    openness: Float[Tensor, " P"]


@dataclass(frozen=True)
class Ground:
    """What the ground is made of.

    Attributes:
        maps: the channels of `GroundPoints`, in its order.
        ripple_heading: direction across the small ripples, radians from east.
        shells: density of pale litter.
        wave_slope: root-mean-square slope of wavelets on open water.
        noise: the pattern of detail finer than the maps.
    """

    maps: Raster
    ripple_heading: float
    shells: float
    wave_slope: float
    noise: Noise

    def sample(self, xy: Float[Tensor, "2 P"]) -> GroundPoints:
        """Interpolate the maps at ground points."""
        maps = self.maps.sample(xy)
        return GroundPoints(maps[0:2], maps[2:5], *maps[5:])

    def radiance(
        self,
        light: Light,
        xy: Float[Tensor, "2 P"],
        to_eye: Float[Tensor, "3 P"] | None,
        footprint_m: Float[Tensor, " P"],
        seconds: float,
    ) -> Float[Tensor, "3 P"]:
        """Compute the radiance of ground points: mud, wet mud and water with all their fine detail.

        Args:
            to_eye: unit vectors; None for the diffuse part alone (for maps).
            footprint_m: distance between neighbouring samples; finer detail is averaged.
            seconds: time at which wavelets are seen.
        """
        at = self.sample(xy)
        wet, depth, sunlit = at.wetness, at.water_depth_m, at.sunlit
        is_water = smoothstep(0.0, 0.025, depth)
        rough, tint, unresolved = self._grain(xy, footprint_m, at.ripple)
        # Mud smooths as it gets wet: a film of water fills the smallest hollows.
        normal = _normal(at.slope + rough * (1 - 0.6 * wet))
        albedo = at.albedo * tint
        radiance = albedo * light.diffuse(normal, sunlit, at.openness)
        film, roughness = at.slope + 0.35 * rough, 0.10 + 0.12 * (1 - wet) + unresolved
        wade = torch.nonzero(depth > 0)[:, 0]
        waves, wave_roughness = self._wavelets(xy[:, wade], footprint_m[wade], depth[wade], seconds)
        body = _water_body(albedo[:, wade], depth[wade], at.silt[wade], at.foam[wade], light, sunlit[wade])
        # Wavelets gather the light that goes down on their sunny sides.
        gathered = 1 - 1.8 * (waves[0] * light.sun[0] + waves[1] * light.sun[1])
        radiance[:, wade] = torch.lerp(radiance[:, wade], body * gathered, is_water[wade])
        film[:, wade] = torch.lerp(film[:, wade], waves, is_water[wade])
        roughness[wade] = torch.lerp(roughness[wade], wave_roughness, is_water[wade])
        if to_eye is None:
            return radiance
        gloss = torch.maximum(smoothstep(0.35, 1.0, wet), is_water)
        glossy = torch.nonzero(gloss > 0)[:, 0]
        specular = light.specular(_normal(film[:, glossy]), to_eye[:, glossy], roughness[glossy], sunlit[glossy])
        radiance[:, glossy] += gloss[glossy] * specular
        return radiance

    def _grain(self, xy: Tensor, footprint_m: Tensor, ripple: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute slopes [2 P] and tint [P] of grain and small ripples, and the slope [P] left unresolved."""
        finest = float(footprint_m.min())
        slope, tint, bend = torch.zeros_like(xy), torch.ones_like(xy[0]), torch.zeros_like(xy[0])
        for k, wavelength in enumerate(_GRAIN_WAVELENGTHS_M):
            if wavelength < 1.5 * finest:
                break
            octave = self.noise.octave(xy, wavelength, k)
            if k < 2:
                bend = bend + (1.6 - k) * octave[k]
            octave = octave * resolved(wavelength, footprint_m)
            slope = slope + _GRAIN_SLOPE * octave[0:2]
            tint = tint + 0.11 * octave[2]
            # Shells and stones: the rare peaks of one channel.
            tint = tint + self.shells * 1.6 * (octave[3] - 0.62).clamp(min=0)
        share = resolved(_RIPPLE_WAVELENGTH_M, footprint_m)
        strength = _RIPPLE_SLOPE * ripple
        if 1.5 * finest < _RIPPLE_WAVELENGTH_M:
            cos, sin = math.cos(self.ripple_heading), math.sin(self.ripple_heading)
            wave = torch.cos((xy[0] * cos + xy[1] * sin) * (2 * math.pi / _RIPPLE_WAVELENGTH_M) + bend)
            slope = slope + (strength * share * wave) * torch.tensor([[cos], [sin]])
            tint = tint * (1 - 0.07 * ripple * share * wave)
        return slope, tint.clamp(min=0.25), 0.25 * strength * (1 - share)

    def _wavelets(self, xy: Tensor, footprint_m: Tensor, depth: Tensor, seconds: float) -> tuple[Tensor, Tensor]:
        """Compute slopes [2 P] of the resolved wavelets, and the root-mean-square slope [P] of the others."""
        slope, variance = torch.zeros_like(xy), torch.full_like(depth, 0.02**2)
        gust = 0.75 + 0.5 * self.noise.octave(xy, 9.0, 21)[0]
        warp, fine = self.noise.octave(xy, 5.3, 22), self.noise.octave(xy, 1.3, 23)
        amplitude = self.wave_slope * math.sqrt(2 / _WAVES)
        for k in range(_WAVES):
            wavelength = 0.25 * 1.4**k
            number = 2 * math.pi / wavelength
            heading = self.ripple_heading + 1.1 * math.sin(2.4 * k + 1)
            cos, sin = math.cos(heading), math.sin(heading)
            share = resolved(wavelength, footprint_m)
            # Waves on deep water: the square of the frequency is g k.
            turn = 1.9 * k - math.sqrt(9.81 * number) * seconds
            phase = number * (xy[0] * cos + xy[1] * sin) + (3.0 * warp[k % 4] + 0.8 * fine[(k + 1) % 4]) + turn
            slope = slope + (amplitude * share * torch.cos(phase)) * torch.tensor([[cos], [sin]])
            variance = variance + 0.5 * amplitude**2 * (1 - share)
        # Waves that cross are never as regular as their sum.
        slope = slope + (0.9 * amplitude * resolved(1.3, footprint_m)) * fine[0:2] + (0.9 * amplitude) * warp[0:2]
        # Shallow water is calm.
        height = gust * (0.25 + 0.75 * smoothstep(0.05, 0.5, depth))
        return slope * height, torch.sqrt(variance) * height


def _normal(slope: Tensor) -> Tensor:
    length = torch.rsqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    return torch.stack([-slope[0] * length, -slope[1] * length, length])


def _water_body(albedo: Tensor, depth: Tensor, silt: Tensor, foam: Tensor, light: Light, sunlit: Tensor) -> Tensor:
    """Compute the light that comes back out of the water: the bed through it, and the silt in it."""
    turbid, clear, absorption = (torch.tensor(c)[:, None] for c in (_TURBID_WATER, _CLEAR_WATER, _ABSORPTION_PER_M))
    body = torch.lerp(clear, turbid, silt)
    through = torch.exp(-absorption * depth * (0.8 + 2.5 * silt))
    upwelling = (albedo * through + body * (1 - through)) * (1 - foam) + _FOAM * foam
    level = torch.tensor([0.0, 0.0, 1.0])[:, None]
    # Shadows are soft on water: silt scatters light into them.
    return upwelling * light.diffuse(level, 0.3 + 0.7 * sunlit, torch.ones_like(depth))


def make_ground(
    settings: Settings,
    terrain: Terrain,
    marsh: Float[Tensor, "H W"],
    sun: Float[Tensor, "3"],
    shade: Float[Tensor, "H W"],
    random: np.random.Generator,
) -> Ground:
    """Compute the ground's maps, given the density of plants and the share of the sun that they let through."""
    noise = Noise(random, channels=4)
    nodes = terrain.extent.nodes()
    shape = terrain.ground.shape
    large = noise.fractal(nodes, 26.0, 4).reshape(4, *shape)
    small = noise.fractal(nodes + 900, 3.6, 4).reshape(4, *shape)
    surface = terrain.surface
    height = surface.values[0]
    wet = _wetness(settings, terrain, large[3] + 0.5 * small[3])
    albedo = _albedo(settings, terrain, marsh, wet, large, small)
    sunlit = shade * _terrain_sun(surface, sun)
    # Troughs see less of the sky: the height against its surroundings stands for how much.
    hollow = (height - blurred(height, 6)) / 0.18
    openness = (0.95 + 0.2 * hollow).clamp(0.55, 1.15) * (1 - 0.35 * marsh)
    silt, foam = (x.reshape(shape) for x in _drift(noise, nodes, large[1].reshape(-1)))
    # Rough water foams.
    foam = foam * float(np.clip((settings.wave_slope - 0.035) / 0.03, 0, 1)) * smoothstep(0.1, 0.4, terrain.water_depth)
    ripple = terrain.ripple * (1 - marsh)
    north, east = torch.gradient(height, spacing=terrain.extent.cell_m)
    maps = [east, north, *albedo, wet, terrain.water_depth, silt, foam, ripple, sunlit, openness]
    heading = float(random.uniform(0, math.pi))
    detail = Noise(random, channels=4)
    return Ground(Raster(terrain.extent, torch.stack(maps)), heading, settings.shells, settings.wave_slope, detail)


def _wetness(settings: Settings, terrain: Terrain, pattern: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Map the wetness of the mud: low ground, channel margins and the rims of pools are wet."""
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
    """Mix mud and sand in patches, iron and algae on them, darkened where wet."""
    silt, mud, sand, iron, algae, litter = (
        torch.tensor(c)[:, None, None] for c in (_SILT, _MUD, _SAND, _IRON, _ALGAE, _LITTER)
    )
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
    """Map what water carries: clouds and bands of silt, and threads of foam between them, both 0 to 1."""
    bent = nodes + 4 * noise.fractal(nodes, 30.0, 3)[:2]
    bands = noise.fractal(torch.stack([bent[0], 0.5 * bent[1]]), 5.0, 5, gain=0.6)
    silt = (0.42 + 0.4 * large + 0.3 * bands[3]).clamp(0, 1)
    thread = (1 - (bands[0] + 0.3 * large).abs() / 0.12).clamp(min=0) ** 2
    flecks = smoothstep(-0.1, 0.6, noise.fractal(nodes, 0.7, 3)[1])
    windward = smoothstep(0.1, 0.5, noise.fractal(nodes + 70, 18.0, 2)[2])
    return silt, thread * flecks * windward


def _terrain_sun(surface: Raster, sun: Float[Tensor, "3"]) -> Float[Tensor, "H W"]:
    """Compute the share of the sun's disc above the terrain's horizon at every node, with a soft edge."""
    level, up = float(torch.hypot(sun[0], sun[1])), float(sun[2])
    height, nodes, cell_m = surface.values.reshape(-1), surface.extent.nodes(), surface.extent.cell_m
    if level < 1e-3:
        return torch.ones_like(surface.values[0])
    horizon = torch.full_like(height, -1.0)
    reach = float((height.amax() - height).amax()) * level / up + cell_m
    distance = 1.5 * cell_m
    while distance < reach:
        ahead = nodes + (sun[:2] * (distance / level))[:, None]
        horizon = torch.maximum(horizon, (surface.sample(ahead)[0] - height) / distance)
        distance *= 1.3
    tangent = up / level
    return (1 - smoothstep(0.9 * tangent, 1.1 * tangent + 0.05, horizon)).reshape(surface.values.shape[1:])
