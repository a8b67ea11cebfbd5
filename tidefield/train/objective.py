"""What a batch of tiles teaches the network: drawn, rendered and compared."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tidefield.config import TrainConfig
from tidefield.data.batches import Surfaces, draw_batch
from tidefield.data.scene import Scene
from tidefield.device import mixed_precision
from tidefield.geometry.cameras import Cameras
from tidefield.model.network import Network, Tiles
from tidefield.model.renderer import start_intervals
from tidefield.model.views import Encoded, Views
from tidefield.train.losses import photometric, sparse_depth, structural


class Objective(nn.Module):
    """A module, so that DistributedDataParallel can share what several processes learn.

    Args:
        network: what learns.
        config: how.
    """

    def __init__(self, network: Network, config: TrainConfig) -> None:
        super().__init__()
        self.network, self.config = network, config

    def forward(
        self, scene: Scene, surfaces: Surfaces, cameras: Cameras, views: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """The loss of a random batch, and the mean squared error of its colours.

        Args:
            scene: whose training photographs are drawn from.
            surfaces: of its cameras.
            cameras: the scene's, where the network is.
            views: neighbours of each tile.
            generator: of all that is random.
        """
        network, config, device, side = self.network, self.config, cameras.gain.device, self.config.tile_px
        batch = draw_batch(scene, surfaces, config, views, generator).to(device)
        seen = None
        if batch.images:
            parts = []
            with mixed_precision(device):
                for images, corner in zip(batch.images, batch.image_corner_px, strict=True):
                    parts.append(network.encode(images, corner))
            seen = Views(cameras[batch.neighbours.reshape(-1)], batch.which, batch.presence, Encoded.joined(parts))
        tiles = Tiles(cameras[batch.targets], batch.corner_px, side)
        priors = torch.stack([surfaces[i] for i in batch.targets.tolist()]).to(device)
        opaque = scene.background_rgb is None
        rendering = network(tiles, seen, start_intervals(network, tiles, priors), opaque, generator)
        loss, error = photometric(rendering, batch, network, side)
        if config.structure_weight:
            loss = loss + config.structure_weight * structural(rendering, batch, side)
        if config.depth_weight:
            loss = loss + config.depth_weight * sparse_depth(rendering, batch, network, side)
        return loss, error
