"""What a batch of tiles teaches the network: drawn, rendered and compared."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tidefield.config import TrainConfig
from tidefield.data.batches import Batch, draw_batch
from tidefield.data.depth_prior import DepthPriors
from tidefield.data.scene import Scene
from tidefield.device import mixed_precision
from tidefield.geometry.cameras import Cameras
from tidefield.model.network import Network, TileRendering, Tiles
from tidefield.model.renderer import start_intervals
from tidefield.model.views import Encoded, Views
from tidefield.train.losses import photometric, sparse_depth, structural
from tidefield.train.parallel_backward import side_by_side


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
        self, scene: Scene, surfaces: DepthPriors, cameras: Cameras, views: int, generator: torch.Generator
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
        priors = torch.stack([surfaces[i] for i in batch.targets.tolist()]).to(device)
        opaque = scene.background_rgb is None
        parts = batch.parts(torch.get_num_threads()) if device.type == "cpu" else [batch]
        if len(parts) == 1:
            rendering = self._rendered(batch, cameras, priors, opaque, generator)
        else:
            shares = priors.split([len(part.targets) for part in parts])
            tasks = [
                partial(self._in_pieces, part, cameras, prior, opaque, _another(generator))
                for part, prior in zip(parts, shares, strict=True)
            ]
            learns = [parameter for parameter in network.parameters() if parameter.requires_grad]
            rendering = TileRendering.from_pieces(side_by_side(tasks, learns, device))
        loss, error = photometric(rendering, batch, network, side)
        if config.structure_weight:
            loss = loss + config.structure_weight * structural(rendering, batch, side)
        if config.depth_weight:
            loss = loss + config.depth_weight * sparse_depth(rendering, batch, network, side)
        return loss, error

    def _rendered(
        self, batch: Batch, cameras: Cameras, priors: Float[Tensor, "T 3 h w"], opaque: bool, generator: torch.Generator
    ) -> TileRendering:
        network, seen = self.network, None
        if batch.images:
            with mixed_precision(priors.device):
                encoded = [network.encode(*images) for images in zip(batch.images, batch.image_corner_px, strict=True)]
            seen = Views(
                cameras[batch.neighbours.reshape(-1)], batch.which, batch.blend_weight, Encoded.joined(encoded)
            )
        tiles = Tiles(cameras[batch.targets], batch.corner_px, self.config.tile_px)
        return network(tiles, seen, start_intervals(network, tiles, priors), opaque, generator)

    def _in_pieces(self, *given: Any) -> tuple[Tensor, ...]:
        return self._rendered(*given).pieces()


def _another(generator: torch.Generator) -> torch.Generator:
    """One that a thread can have for itself."""
    return torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator)))
