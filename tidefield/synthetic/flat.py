"""The renderer: a tidal flat that can be photographed and mapped from anywhere."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.geometry.cameras import Cameras
from tidefield.parallel import in_parallel
from tidefield.synthetic.foliage import Plants, Shadows
from tidefield.synthetic.grids import Extent, Noise, Raster, blurred
from tidefield.synthetic.plants import grow, marsh_map
from tidefield.synthetic.rays import Parallel, Pinhole, View, height_field_depth, normalised
from tidefield.synthetic.settings import Settings
from tidefield.synthetic.shading import Ground, Light, make_ground, to_srgb
from tidefield.synthetic.terrain import make_terrain

_RAYS = 1 << 16
"""Rays shaded at once: bounds memory, and small enough for the cache."""
_FAR_M = 1e4
"""Depth given to rays into the sky, so that arithmetic on them stays finite."""


@dataclass(frozen=True)
class Orthophoto:
    """A map of a flat: row 0 in the north, pixel (i, j) centred on the ground point of its indices.

    Attributes:
        colour: diffuse (view-independent) colour seen straight down, sRGB in [0, 1].
        height_m: the surface, plants and water included.
        west_m, north_m: centre of the first pixel.
        cell_m: pixel size.
    """

    colour: Float[Tensor, "H W 3"]
    height_m: Float[Tensor, "H W"]
    west_m: float
    north_m: float
    cell_m: float


@dataclass(frozen=True)
class TidalFlat:
    """Shape, material and light of a flat. World: metres east, north and up.

    Attributes:
        surface: the higher of ground and water, without plants.
        max_slope: a bound on the surface's slope.
        ground: its material.
        plants: leaf sprays and stems.
        shadows: of the plants.
    """

    surface: Raster
    max_slope: float
    ground: Ground
    plants: Plants
    light: Light
    shadows: Shadows

    @property
    def extent(self) -> Extent:
        return self.surface.extent

    def render(
        self, cameras: Cameras, supersample: int = 2, seconds: Float[Tensor, " V"] | None = None
    ) -> tuple[Float[Tensor, "V H W 3"], Float[Tensor, "V H W"]]:
        """Render pinhole cameras of one size.

        Args:
            cameras: their gains are applied to the colours.
            supersample: rays per pixel along each side, averaged as light.
            seconds: time of each view, which moves the wavelets; None for 0.

        Returns:
            sRGB colour in [0, 1]; and exact z-depth at pixel centres, metres, inf where there is sky.
        """
        times = [0.0] * len(cameras) if seconds is None else seconds.tolist()
        tasks = [partial(self._photograph, cameras[i], supersample, times[i]) for i in range(len(cameras))]
        colour, depth = zip(*in_parallel(tasks, cameras.gain.device), strict=True)
        return torch.stack(colour), torch.stack(depth)

    def _photograph(self, camera: Cameras, supersample: int, seconds: float) -> tuple[Tensor, Tensor]:
        """Render colour [H W 3] and depth [H W] of one camera."""
        fine = Pinhole(camera, supersample)
        colour = to_srgb(_averaged(self._radiance(fine, seconds), fine, supersample)) * camera.gain[0]
        return colour.clamp(0, 1), self.depth(Pinhole(camera)).reshape(camera.height, camera.width)

    def orthophoto(self, extent: Extent, supersample: int = 2) -> Orthophoto:
        """Render the map of an extent, one pixel centred on each of its nodes."""
        cell = extent.cell_m / supersample
        edge = 0.5 * (extent.cell_m - cell)
        columns, rows = extent.columns * supersample, extent.rows * supersample
        fine = Extent(extent.west_m - edge, extent.south_m - edge, columns, rows, cell)
        top = self.highest_m + 1
        view, fine_view = (Parallel.straight_down(e, top, self.surface.values.device) for e in (extent, fine))
        tasks = [partial(self._radiance, fine_view, diffuse=True), partial(self.depth, view)]
        radiance, depth = in_parallel(tasks, view.device)
        colour = to_srgb(_averaged(radiance, fine_view, supersample))
        height = top - depth.reshape(extent.rows, extent.columns)
        return Orthophoto(colour, height, extent.west_m, extent.north_m, extent.cell_m)

    @property
    def highest_m(self) -> float:
        """A height that nothing exceeds."""
        return max(float(self.surface.values.max()), self.plants.highest_m)

    def water_depth(self, points: Float[Tensor, "3 P"]) -> Float[Tensor, " P"]:
        """Read the depth of the water under surface points; 0 on dry ground and on plants."""
        above = points[2] - self.surface.sample(points[:2])[0]
        return torch.where(above < 0.02, self.ground.sample(points[:2]).water_depth_m, 0.0)

    def depth(self, view: View) -> Float[Tensor, " R"]:
        """Compute the depth of the first surface along every ray of a view; inf where there is none."""
        depth, _ = self.plants.nearest(view)
        for ray in torch.arange(len(depth), device=view.device).split(_RAYS):
            depth[ray] = torch.minimum(depth[ray], height_field_depth(self.surface, self.max_slope, *view.rays(ray)))
        return depth

    def _radiance(self, view: View, seconds: float = 0.0, diffuse: bool = False) -> Float[Tensor, "3 R"]:
        """Compute the radiance along every ray of a view."""
        nearest, primitive = self.plants.nearest(view)
        radiance = torch.empty(3, len(nearest), device=view.device)
        for ray in torch.arange(len(nearest), device=view.device).split(_RAYS):
            origin, direction = view.rays(ray)
            depth = height_field_depth(self.surface, self.max_slope, origin, direction)
            onward = normalised(direction)
            reached = depth.clamp(max=_FAR_M)
            points = origin + direction * reached
            to_eye = None if diffuse else (-onward).expand_as(points)
            # Slanting rays lie further apart on the ground in one direction: the geometric mean of both.
            footprint = (view.footprint_m(reached) * (-onward[2]).clamp(min=0.1) ** -0.5).expand_as(reached)
            part = self.ground.radiance(self.light, points[:2], to_eye, footprint, seconds)
            sky = torch.nonzero(torch.isinf(depth))[:, 0]
            part[:, sky] = self.light.sky(onward.expand_as(points)[:, sky])
            plant = torch.nonzero(nearest[ray] < depth)[:, 0]
            hit = ray[plant]
            part[:, plant] = self.plants.radiance(self.light, self.shadows, view, hit, primitive[hit])
            radiance[:, ray] = part
        return radiance


def _averaged(radiance: Tensor, view: View, split: int) -> Float[Tensor, "H W 3"]:
    """Average the rays of each pixel."""
    blocks = radiance.reshape(3, view.rows // split, split, view.columns // split, split)
    return blocks.mean(dim=(2, 4)).permute(1, 2, 0)


def make_flat(
    settings: Settings,
    extent: Extent,
    sun_elevation_deg: float,
    sun_azimuth_deg: float,
    random: np.random.Generator,
) -> TidalFlat:
    """Build a flat over an extent, on the CPU so that a seed means the same for every device."""
    terrain = make_terrain(settings, extent, random)
    marsh = marsh_map(settings, terrain, random)
    plants = grow(settings, terrain, marsh, random)
    light = Light.make(sun_elevation_deg, sun_azimuth_deg, Noise.make(random, channels=1))
    surface = terrain.surface
    low, high = float(surface.values.min()), max(float(surface.values.max()), plants.highest_m)
    shadows = Shadows.cast(plants, extent, low, high, light)
    nodes = torch.cat([extent.nodes(), surface.values.reshape(1, -1)])
    shade = blurred(shadows.sunlit(nodes).reshape(terrain.ground.shape), 1)
    ground = make_ground(settings, terrain, marsh, light.sun, shade, random)
    return TidalFlat(surface, surface.max_slope(), ground, plants, light, shadows)


def moved(thing: Any, device: torch.device | str) -> Any:
    """Copy a dataclass to a device: its tensors and those of the dataclasses in it."""
    changed = {}
    for field in fields(thing):
        value = getattr(thing, field.name)
        if isinstance(value, Tensor):
            changed[field.name] = value.to(device)
        elif is_dataclass(value):
            changed[field.name] = moved(value, device)
    return replace(thing, **changed)
