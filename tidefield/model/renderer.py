"""A trained network as a `Render`: one camera in, its view out, tile by tile."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tidefield.config import Config
from tidefield.data.batches import choose_neighbours, even, tile_surface
from tidefield.data.prior import read_prior, surface_prior
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.model.gather import FeatureMaps
from tidefield.model.intervals import Intervals
from tidefield.model.network import Network, TileRendering, Tiles
from tidefield.model.rendering import Rendering
from tidefield.model.views import Views

TILE_PX = 32
RAYS_AT_ONCE = 8192
"""Rays of the finest stage handled at once: enough to keep two cores or a GPU busy, few enough for the cache."""


class Renderer:
    """Renders views of one scene.

    Args:
        network: in evaluation mode, on `device`.
        scene: whose training photographs serve as neighbours.
        config: the run's.
        device: where to compute.
    """

    def __init__(self, network: Network, scene: Scene, config: Config, device: torch.device) -> None:
        self.network, self.scene, self.config, self.device = network, scene, config, device
        self.shelf = FeatureShelf(network, scene, device)
        means = [even(scene, i).mean((0, 1)) for i in scene.train]
        self.fallback = torch.stack(means).mean(0)

    @torch.inference_mode()
    def __call__(self, camera: Cameras) -> Rendering:
        """The view of one camera, at its own gain."""
        scene, network = self.scene, self.network
        prior = surface_prior(camera, scene.points, scene.cameras)
        columns, rows = (-(-x // TILE_PX) for x in (camera.width, camera.height))
        v, u = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        corners = torch.stack([u, v], -1).reshape(-1, 2).float() * TILE_PX
        surface = tile_surface(camera, prior, corners, TILE_PX)
        views, strategy = network.config.views, self.config.train.neighbours
        neighbours = choose_neighbours(camera, surface, scene, views, strategy) if views else None
        parts = []
        for some in torch.arange(len(corners)).split(max(1, RAYS_AT_ONCE // TILE_PX**2)):
            parts.append(self._tiles(camera, prior, corners[some], None if neighbours is None else neighbours[some]))

        def picture(values: list[Tensor]) -> Tensor:
            stacked = torch.cat(values).reshape(rows, columns, TILE_PX, TILE_PX, -1)
            whole = stacked.transpose(1, 2).reshape(rows * TILE_PX, columns * TILE_PX, -1)
            return whole[: camera.height, : camera.width]

        colour = picture([p.colour.cpu() for p in parts])
        opacity = picture([p.opacity.cpu() for p in parts])
        depth = picture([p.depth.cpu() for p in parts])[..., 0]
        white = scene.background_rgb
        behind = self.fallback * camera.gain[0] if white is None else torch.tensor(white)
        colour = colour * camera.gain[0] + (1 - opacity) * behind
        return Rendering(colour=colour.clamp(0, 1), depth=depth, opacity=opacity[..., 0].clamp(0, 1))

    def _tiles(
        self, camera: Cameras, prior: Tensor, corners: Float[Tensor, "T 2"], neighbours: Int[Tensor, "T N"] | None
    ) -> TileRendering:
        index = torch.zeros(len(corners), dtype=torch.long)
        tiles = Tiles(camera[index].to(self.device), corners.to(self.device), TILE_PX)
        start = start_intervals(self.network, tiles, prior.expand(len(corners), -1, -1, -1).to(self.device))
        views = None if neighbours is None else self.shelf.views(neighbours)
        return self.network(tiles, views, start, self.scene.background_rgb is None)


def start_intervals(network: Network, tiles: Tiles, priors: Float[Tensor, "T 3 h w"]) -> Intervals:
    """The first stage's intervals from the cameras' priors."""
    expected, near, far = read_prior(priors, network.first_rays_px(tiles))
    return Intervals(near=near, far=far, expected=expected)


class FeatureShelf:
    """The training photographs' features, encoded once each and kept."""

    def __init__(self, network: Network, scene: Scene, device: torch.device) -> None:
        self.network, self.scene, self.device = network, scene, device
        self.cameras = scene.cameras.to(device)
        self._maps: dict[int, FeatureMaps] | None = None
        self._slot = torch.full((len(scene.names),), -1)

    def views(self, neighbours: Int[Tensor, "T N"]) -> Views:
        if self._maps is None:
            self._maps = self._encode_all()
        cameras = self.cameras[neighbours.reshape(-1).to(self.device)]
        return Views(cameras, self._slot[neighbours].to(self.device), self._maps)

    def _encode_all(self) -> dict[int, FeatureMaps]:
        parts = []
        for slot, index in enumerate(self.scene.train):
            self._slot[index] = slot
            photograph = even(self.scene, index).permute(2, 0, 1)[None].to(self.device)
            parts.append(self.network.encode(photograph))
        return {stride: joined([p[stride] for p in parts]) for stride in parts[0]}


def joined(maps: list[FeatureMaps]) -> FeatureMaps:
    """Maps of several sizes as one set."""
    offsets = torch.tensor([0, *(len(m.rows) for m in maps[:-1])], device=maps[0].rows.device).cumsum(0)
    return FeatureMaps(
        rows=torch.cat([m.rows for m in maps]),
        first=torch.cat([m.first + o for m, o in zip(maps, offsets, strict=True)]),
        size=torch.cat([m.size for m in maps]),
        origin_px=torch.cat([m.origin_px for m in maps]),
        stride=maps[0].stride,
    )
