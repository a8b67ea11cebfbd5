"""Sun and sky: what they give to dull ground and what they show in a wet one.

Radiance is in units of what a white, dull, level surface shows under the open sky with the sun at the zenith.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.synthetic.noise import Noise, smoothstep
from tidefield.synthetic.primitives import dot

_REFLECTANCE_AT_NORMAL = 0.021
"""Water, refractive index 1.34, seen square on."""


@dataclass(frozen=True)
class Light:
    """The sun and a clear sky with thin cloud.

    Attributes:
        sun: unit vector towards it.
        sun_rgb: radiance of a white, dull surface square to the sun.
        sky_rgb: the same under the sky alone.
        noise: the clouds' pattern.
    """

    sun: Float[Tensor, "3"]
    sun_rgb: Float[Tensor, "3"]
    sky_rgb: Float[Tensor, "3"]
    noise: Noise

    @staticmethod
    def make(elevation_deg: float, azimuth_deg: float, noise: Noise, device: torch.device | str = "cpu") -> Light:
        """The light of a sun at an elevation above the horizon and an azimuth clockwise from north."""
        elevation, azimuth = math.radians(elevation_deg), math.radians(azimuth_deg)
        level = math.cos(elevation)
        sun = torch.tensor([level * math.sin(azimuth), level * math.cos(azimuth), math.sin(elevation)], device=device)
        # A low sun is redder and weaker: a rough fit to the air's transmission at three wavelengths.
        air = 1 / max(math.sin(elevation), 0.08)
        sun_rgb = torch.exp(-torch.tensor([0.10, 0.16, 0.26], device=device) * (air - 1)) * sun.new_tensor(
            [1.05, 1, 0.9]
        )
        return Light(sun, 1.3 * sun_rgb, sun.new_tensor([0.22, 0.255, 0.305]), noise)

    def diffuse(
        self, normal: Float[Tensor, "3 #P"], sunlit: Float[Tensor, " #P"], openness: Float[Tensor, " #P"]
    ) -> Float[Tensor, "3 P"]:
        """Radiance of white, dull surfaces."""
        facing = dot(normal, self.sun[:, None]).clamp(min=0) * sunlit
        above = (0.5 + 0.5 * normal[2]) * openness
        return self.sun_rgb[:, None] * facing + self.sky_rgb[:, None] * above

    def sky(self, direction: Float[Tensor, "3 P"]) -> Float[Tensor, "3 P"]:
        """Radiance of the sky in unit directions, the sun's disc left out."""
        up = direction[2].clamp(min=0.02)
        low = (1 - up) ** 3
        zenith, horizon = (self.sky_rgb.new_tensor(c)[:, None] for c in ([0.13, 0.24, 0.46], [0.62, 0.70, 0.80]))
        # Clouds lie on a plane: their pattern depends on where the ray would cross it.
        across = direction[:2] / (up + 0.15)
        cloud = smoothstep(-0.1, 0.5, self.noise.fractal(across, 0.9, 3)[0]) * 0.55
        near_sun = dot(direction, self.sun[:, None]).clamp(min=0)
        glow = 0.5 * near_sun**8 + 1.2 * near_sun**60
        clear = zenith + (horizon - zenith) * low
        return clear + (0.85 - clear) * cloud + glow * self.sun_rgb[:, None]

    def mirrored(
        self,
        normal: Float[Tensor, "3 P"],
        to_eye: Float[Tensor, "3 P"],
        roughness: Float[Tensor, " P"],
        sunlit: Float[Tensor, " P"],
    ) -> Float[Tensor, "3 P"]:
        """Radiance that a wet surface adds by mirroring sky and sun (Fresnel after Schlick, facets after GGX).

        Args:
            normal: unit.
            to_eye: unit.
            roughness: root-mean-square slope of the facets that are too small to be drawn.
            sunlit: share of the sun that is not in shadow.
        """
        facing = dot(normal, to_eye).clamp(min=0.02)
        reflected = 2 * facing * normal - to_eye
        sky = _fresnel(facing) * self.sky(reflected)
        half = to_eye + self.sun[:, None]
        half = half / torch.sqrt(dot(half, half))
        # GGX by tangents: alpha^2 / (pi (cos^2 (alpha^2 - 1) + 1)^2), with alpha^2 twice the slope's variance.
        alpha2 = 2 * roughness**2 + 2e-4
        cos2 = dot(normal, half).clamp(min=0) ** 2
        facets = alpha2 / (math.pi * (cos2 * (alpha2 - 1) + 1) ** 2)
        facing_sun = dot(normal, self.sun[:, None]).clamp(min=0.02)
        # Visibility of facets: the usual rational form for smooth surfaces, 1 / (4 max(cos, cos)).
        shape = facets / (4 * torch.maximum(facing, facing_sun))
        glint = _fresnel(dot(half, to_eye).clamp(min=0)) * shape * math.pi * sunlit * facing_sun
        return sky + glint * self.sun_rgb[:, None]


def _fresnel(cos: Tensor) -> Tensor:
    return _REFLECTANCE_AT_NORMAL + (1 - _REFLECTANCE_AT_NORMAL) * (1 - cos) ** 5


def to_display(radiance: Float[Tensor, "*S"]) -> Float[Tensor, "*S"]:
    """sRGB values in [0, 1] of linear radiance, its brightest part rolled off as cameras do."""
    knee = 0.7
    bright = (radiance - knee).clamp(min=0)
    linear = radiance.clamp(0, knee) + (1 - knee) * (1 - torch.exp(-bright / (1 - knee)))
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=1e-6) ** (1 / 2.4) - 0.055)
