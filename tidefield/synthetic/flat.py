"""The renderer: a tidal flat that can be photographed and mapped from anywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.geometry.cameras import Cameras
from tidefield.parallel import in_parallel
from tidefield.synthetic.grids import Extent, Noise, Raster, blurred
from tidefield.synthetic.plants import Plants, Shadows, grow, marsh_map
from tidefield.synthetic.rays import Parallel, Pinhole, View, height_field_depth, normalised
from tidefield.synthetic.settings import Settings
from tidefield.synthetic.shading import Ground, Light, make_ground, to_srgb
from tidefield.synthetic.terrain import Terrain, make_terrain

_RAYS = 1 << 16
"""Rays shaded at once: bounds memory, and small enough for the cache."""
_FAR_M = 1e4
"""Depth given to rays into the sky, so that arithmetic on them stays finite."""
_MAP_SUPERSAMPLE = 2
"""Rays per pixel of a map along each side."""


@dataclass(frozen=True)
class TidalFlat:
    """Shape, material and light of a flat. World: metres east, north and up.

    Attributes:
        surface: the higher of ground and water, without plants.
        bed: the ground, under water and plants too.
        marsh: how densely plants cover the ground, 0 to 1.
    """

    surface: Raster
    bed: Raster
    marsh: Raster
    ground: Ground
    plants: Plants
    light: Light
    shadows: Shadows

    @property
    def highest_m(self) -> float:
        """A height that nothing exceeds."""
        return max(float(self.surface.values.max()), self.plants.highest_m)

    def with_plants_within(self, low_m: tuple[float, float], high_m: tuple[float, float]) -> TidalFlat:
        """The same flat with only those plants that may reach into a rectangle: photographs of it are the same."""
        return replace(self, plants=self.plants.within(low_m, high_m))

    def photograph(
        self, camera: Cameras, supersample: int = 2, seconds: float = 0.0
    ) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
        """Render one pinhole camera.

        Args:
            camera: its gain is applied to the colours.
            supersample: rays per pixel along each side, averaged as light.
            seconds: time of the photograph, which moves the wavelets.

        Returns:
            sRGB colour in [0, 1]; and exact z-depth at pixel centres, metres, inf where there is sky.
        """
        fine = Pinhole(camera, supersample)
        colour = to_srgb(_averaged(self._radiance(fine, seconds), fine, supersample)) * camera.gain[0]
        return colour.clamp(0, 1), self.depth(Pinhole(camera)).reshape(camera.height, camera.width)

    def map(self, extent: Extent) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
        """Render the map of an extent: one pixel centred on each of its nodes, row 0 in the north.

        Returns:
            Diffuse (view-independent) colour seen straight down, sRGB in [0, 1]; and the height of the surface,
            metres, plants and water included.
        """
        cell = extent.cell_m / _MAP_SUPERSAMPLE
        edge = 0.5 * (extent.cell_m - cell)
        columns, rows = extent.columns * _MAP_SUPERSAMPLE, extent.rows * _MAP_SUPERSAMPLE
        fine = Extent(extent.west_m - edge, extent.south_m - edge, columns, rows, cell)
        top = self.highest_m + 1
        view, fine_view = (Parallel.straight_down(e, top) for e in (extent, fine))
        tasks = [partial(self._radiance, fine_view, diffuse=True), partial(self.depth, view)]
        radiance, depth = in_parallel(tasks, "cpu")
        colour = to_srgb(_averaged(radiance, fine_view, _MAP_SUPERSAMPLE))
        return colour, top - depth.reshape(extent.rows, extent.columns)

    def depth(self, view: View) -> Float[Tensor, " R"]:
        """Compute the depth of the first surface along every ray of a view; inf where there is none."""
        depth, _ = self.plants.nearest(view)
        for ray in torch.arange(len(depth)).split(_RAYS):
            depth[ray] = torch.minimum(depth[ray], height_field_depth(self.surface, view.rays(ray)))
        return depth

    def _radiance(self, view: View, seconds: float = 0.0, diffuse: bool = False) -> Float[Tensor, "3 R"]:
        """Compute the radiance along every ray of a view."""
        nearest, primitive = self.plants.nearest(view)
        radiance = torch.empty(3, len(nearest))
        for ray in torch.arange(len(nearest)).split(_RAYS):
            origin, direction = rays = view.rays(ray)
            depth = height_field_depth(self.surface, rays)
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


def _averaged(radiance: Float[Tensor, "3 R"], view: View, split: int) -> Float[Tensor, "H W 3"]:
    """Average the rays of each pixel."""
    blocks = radiance.reshape(3, view.rows // split, split, view.columns // split, split)
    return blocks.mean(dim=(2, 4)).permute(1, 2, 0)


def make_flat(
    settings: Settings,
    extent: Extent,
    sun_elevation_deg: float,
    sun_azimuth_deg: float,
    random: np.random.Generator,
    change: Callable[[Terrain], Terrain] | None = None,
) -> TidalFlat:
    """Build a flat over an extent; `change` is made to its ground before plants grow."""
    terrain = make_terrain(settings, extent, random)
    if change is not None:
        terrain = change(terrain)
    marsh = marsh_map(settings, terrain, random)
    plants = grow(settings, terrain, marsh, random)
    light = Light.make(sun_elevation_deg, sun_azimuth_deg, Noise(random, channels=1))
    surface = terrain.surface
    low, high = float(surface.values.min()), max(float(surface.values.max()), plants.highest_m)
    from_sun = Parallel.along_sun(extent, low, high, light.sun)
    shadows = Shadows(from_sun, plants.nearest(from_sun)[0])
    points = torch.cat([extent.nodes(), surface.values.reshape(1, -1)])
    shade = blurred(shadows.sunlit(points).reshape(terrain.ground.shape), 1)
    ground = make_ground(settings, terrain, marsh, light.sun, shade, random)
    bed, density = Raster(extent, terrain.ground[None]), Raster(extent, marsh[None])
    return TidalFlat(surface, bed, density, ground, plants, light, shadows)
