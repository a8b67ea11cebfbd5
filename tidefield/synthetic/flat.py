"""The renderer: a tidal flat that can be photographed and mapped from anywhere."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
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
        fine_view = Parallel.straight_down(fine, self.highest_m + 1)
        tasks = [partial(self._radiance, fine_view, diffuse=True), lambda: self.seen(extent).values[0].flip(0)]
        radiance, height = in_parallel(tasks, "cpu")
        return to_srgb(_averaged(radiance, fine_view, _MAP_SUPERSAMPLE)), height

    def seen(self, extent: Extent) -> Raster:
        """Find the height, metres, of what is seen straight down at an extent's nodes, plants and water included."""
        top = self.highest_m + 1
        depth = self.depth(Parallel.straight_down(extent, top))
        return Raster(extent, (top - depth.reshape(1, extent.rows, extent.columns)).flip(1))

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


@dataclass(frozen=True)
class Date:
    """What a flat is like at one date.

    Attributes:
        sun_azimuth_deg: clockwise from north.
        change: made to the ground before plants grow.
    """

    settings: Settings
    sun_elevation_deg: float
    sun_azimuth_deg: float
    change: Callable[[Terrain], Terrain] | None = None


def make_flat(date: Date, extent: Extent, random: np.random.Generator) -> TidalFlat:
    """Build a flat over an extent."""
    [flat] = make_flats([date], extent, random)
    return flat


def make_flats(dates: Sequence[Date], extent: Extent, random: np.random.Generator) -> list[TidalFlat]:
    """Build one flat over an extent at several dates: all that is drawn is the same, and only the dates differ.

    As many plants as the settings of the first date want compete for places; those of each date stand where its
    ground and marsh let them.
    """
    sites = []
    for date, own in zip(dates, _in_one_state(random, len(dates)), strict=True):
        terrain = make_terrain(date.settings, extent, own)
        if date.change is not None:
            terrain = date.change(terrain)
        sites.append((terrain, marsh_map(date.settings, terrain, own)))
    plants = grow(dates[0].settings, sites, random)
    randoms = _in_one_state(random, len(dates))
    return [_lit(*parts) for parts in zip(dates, sites, plants, randoms, strict=True)]


def _in_one_state(random: np.random.Generator, count: int) -> list[np.random.Generator]:
    """The generator, which goes on with what it is used for here, and copies of it."""
    return [random, *(copy.deepcopy(random) for _ in range(count - 1))]


def _lit(
    date: Date, site: tuple[Terrain, Float[Tensor, "H W"]], plants: Plants, random: np.random.Generator
) -> TidalFlat:
    """Cast light and shadows on ground and plants, and make the ground's material."""
    terrain, marsh = site
    extent, surface = terrain.extent, terrain.surface
    light = Light.make(date.sun_elevation_deg, date.sun_azimuth_deg, Noise(random, channels=1))
    low, high = float(surface.values.min()), max(float(surface.values.max()), plants.highest_m)
    from_sun = Parallel.along_sun(extent, low, high, light.sun)
    shadows = Shadows(from_sun, plants.nearest(from_sun)[0])
    points = torch.cat([extent.nodes(), surface.values.reshape(1, -1)])
    shade = blurred(shadows.sunlit(points).reshape(terrain.ground.shape), 1)
    ground = make_ground(date.settings, terrain, marsh, light.sun, shade, random)
    bed, density = Raster(extent, terrain.ground[None]), Raster(extent, marsh[None])
    return TidalFlat(surface, bed, density, ground, plants, light, shadows)
