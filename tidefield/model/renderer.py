"""A trained network as a `Render`: one camera in, its view out, tile by tile.

Ground that none of a tile's neighbours sees is unknown to a network that only reads neighbours. Its colours are
continued from beside it, unless the preset is to do as printed, a field knows the scene, or it may be empty there.
"""

from __future__ import annotations

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.config import Config
from tidefield.data.depth_prior import read_prior, surface_prior, unproject_to_surface
from tidefield.data.exposure import to_common_exposure
from tidefield.data.neighbours import EXTRA_VIEWS, Neighbours, choose_neighbours
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.model.cache import CacheFull, FeatureCache
from tidefield.model.fill import fill_unseen
from tidefield.model.intervals import Intervals
from tidefield.model.network import Network, Tiles
from tidefield.model.rendering import Rendering
from tidefield.model.views import Views
from tidefield.parallel import in_parallel

TILE_PX = 32
VALUES_AT_ONCE = 1_250_000
"""Values gathered at once by a stage on one core: few enough for its cache ..."""
GPU_FACTOR = 64
"""... and so many times as many keep a GPU busy."""
BEHIND_PHOTOGRAPHS, BEHIND_STEP = 32, 16
"""Photographs, and pixels between their pixels, whose mean colour lies behind what lets light through."""
BLOCK_TILES = 16
"""Tiles along the sides of the blocks that a view is made in, so that tiles that follow one another see the same."""


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
        self.shelf = FeatureCache(network, scene, device) if network.config.views else None
        stages, views = network.config.stages, network.config.views + EXTRA_VIEWS
        gathered = max((TILE_PX // s.stride) ** 2 * s.samples * views * s.feature_channels for s in stages)
        room = VALUES_AT_ONCE * (1 if device.type == "cpu" else GPU_FACTOR)
        self.tiles_at_once = max(1, room // gathered)
        # Of tiles larger than that, one on each core would take too much memory: all cores share one.
        self.side_by_side = gathered <= room
        net = network.config
        self.fills = bool(net.views) and not net.as_printed and net.field is None and scene.background_rgb is None
        few = scene.train[:: -(-len(scene.train) // BEHIND_PHOTOGRAPHS)]
        lines = slice(None, None, BEHIND_STEP)
        self.fallback = torch.stack([to_common_exposure(scene, i, lines, lines).mean((0, 1)) for i in few]).mean(0)

    @torch.inference_mode()
    def __call__(self, camera: Cameras) -> Rendering:
        """The view of one camera, at its own gain."""
        scene = self.scene
        prior = surface_prior(camera, scene.points, scene.cameras, scene.hull)
        columns, rows = (-(-x // TILE_PX) for x in (camera.width, camera.height))
        picture = torch.empty(rows * TILE_PX, columns * TILE_PX, 6)
        for top in range(0, rows, BLOCK_TILES):
            for left in range(0, columns, BLOCK_TILES):
                size = (min(BLOCK_TILES, columns - left), min(BLOCK_TILES, rows - top))
                block = self._block(camera, prior, (left, top), size)
                height, width = block.shape[:2]
                at = (top * TILE_PX, left * TILE_PX)
                picture[at[0] : at[0] + height, at[1] : at[1] + width] = block
        colour, opacity, depth, shown = picture[: camera.height, : camera.width].split([3, 1, 1, 1], dim=-1)
        white = scene.background_rgb
        behind = self.fallback * camera.gain[0] if white is None else torch.tensor(white)
        colour = colour * camera.gain[0] + (1 - opacity) * behind
        if self.fills:
            colour = fill_unseen(colour, shown[..., 0] > 0.5)
        colour = colour.clamp(0, 1)
        return Rendering(colour=colour, depth=depth[..., 0].clone(), opacity=opacity[..., 0].clamp(0, 1))

    def _block(
        self, camera: Cameras, prior: Float[Tensor, "3 h w"], corner: tuple[int, int], size: tuple[int, int]
    ) -> Float[Tensor, "H W 6"]:
        """Colour, opacity, depth of a block of tiles, and how likely a neighbour sees it; corner and size in tiles."""
        (left, top), (columns, rows) = corner, size
        v, u = torch.meshgrid(torch.arange(top, top + rows), torch.arange(left, left + columns), indexing="ij")
        corners = torch.stack([u, v], -1).reshape(-1, 2).float() * TILE_PX
        middles = unproject_to_surface(camera, prior, corners + TILE_PX / 2)
        views, strategy = self.network.config.views, self.config.train.neighbours
        neighbours = None
        if views:
            neighbours = choose_neighbours(camera, prior, corners[0], size, TILE_PX, self.scene, views, strategy)
        found = self._tiles(camera, prior, corners, neighbours, middles)
        stacked = found.reshape(rows, columns, TILE_PX, TILE_PX, 6)
        return stacked.transpose(1, 2).reshape(rows * TILE_PX, columns * TILE_PX, 6)

    def _tiles(
        self,
        camera: Cameras,
        prior: Float[Tensor, "3 h w"],
        corners: Float[Tensor, "T 2"],
        neighbours: Neighbours | None,
        middle_world: Float[Tensor, "T 3"],
    ) -> Float[Tensor, "T R 6"]:
        views = None
        if neighbours is not None:
            assert self.shelf is not None
            try:
                views = self.shelf.views(neighbours, middle_world)
            except CacheFull:
                if len(corners) == 1:
                    raise
                half = len(corners) // 2
                return torch.cat(
                    [
                        self._tiles(camera, prior, corners[s], neighbours[s], middle_world[s])
                        for s in (slice(half), slice(half, None))
                    ]
                )
        pieces = [
            partial(self._piece, camera, prior, corners[some], None if views is None else views[some])
            for some in torch.arange(len(corners)).split(self.tiles_at_once)
        ]
        return torch.cat(in_parallel(pieces, self.device) if self.side_by_side else [piece() for piece in pieces])

    @torch.inference_mode()  # of every thread its own
    def _piece(
        self, camera: Cameras, prior: Float[Tensor, "3 h w"], corners: Float[Tensor, "T 2"], views: Views | None
    ) -> Float[Tensor, "T R 6"]:
        index = torch.zeros(len(corners), dtype=torch.long)
        tiles = Tiles(camera[index].to(self.device), corners.to(self.device), TILE_PX)
        start = start_intervals(self.network, tiles, prior[None].to(self.device))
        found = self.network(tiles, views, start, self.scene.background_rgb is None)
        single = torch.stack([found.opacity, found.depth, found.shown], dim=-1)
        return torch.cat([found.colour, single], dim=-1).cpu()


def start_intervals(network: Network, tiles: Tiles, priors: Float[Tensor, "_ 3 h w"]) -> Intervals:
    """The first stage's intervals from the priors of the tiles' cameras, or from the one prior of them all."""
    uv = network.first_rays_px(tiles)
    read = read_prior(priors, uv.reshape(len(priors), -1, 2))
    expected, near, far = (x.reshape(uv.shape[:2]) for x in read)
    return Intervals(near=near, far=far, expected=expected)
