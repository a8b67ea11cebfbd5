"""What training minimises: the loss of a random batch of tiles (paper, eq. 5; docs/method.md, section 9)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.config import TrainConfig
from tidefield.data.batches import Batch, draw_batch
from tidefield.data.depth_prior import DepthPriors
from tidefield.data.scene import Scene
from tidefield.device import mixed_precision
from tidefield.evaluation.metrics import similarity
from tidefield.geometry.cameras import Cameras
from tidefield.model.network import Network, RayGrid, TileRendering
from tidefield.model.sampling import Tiles
from tidefield.model.views import Encoded, Views
from tidefield.parallel import differentiable_parts

COARSE_WEIGHT = 0.5
"""Of the coarse passes' own colours, without which nothing would teach them where the surface is."""
DEPTH_SCALE = 0.01
"""Share of its depth by which a surface may miss a sparse point before the penalty grows no faster (Huber)."""


class BatchLoss(nn.Module):
    """The loss of a batch: drawn, rendered and compared.

    A module, so that DistributedDataParallel can average what several processes learn.

    Args:
        network: to train.
        config: of the training.
    """

    def __init__(self, network: Network, config: TrainConfig) -> None:
        super().__init__()
        self.network, self.config = network, config

    def forward(
        self,
        scene: Scene,
        priors: DepthPriors,
        cameras: Cameras,
        views: int,
        generator: torch.Generator,
        precision: torch.dtype | None = None,
        of: Sequence[int] | None = None,
        doubled: Scene | None = None,
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """The loss of a random batch, and the mean squared error of its colours.

        Args:
            scene: whose training photographs are drawn from.
            priors: of its cameras.
            cameras: the scene's, on the network's device.
            views: neighbours of each tile.
            generator: of everything random.
            precision: of the encoder's convolutions; that of `choose_precision` if None.
            of: training photographs to draw from; all of them if not given.
            doubled: the scene at twice the size, where photographs are read from it, too.
        """
        network, config, device, side = self.network, self.config, cameras.gain.device, self.config.tile_px
        batch = draw_batch(scene, priors, config, views, generator, of, doubled).to(device)
        own = torch.stack([priors[i].cells for i in batch.targets.tolist()]).to(device)
        opaque = scene.background_rgb is None
        parts = batch.parts(torch.get_num_threads()) if device.type == "cpu" else [batch]
        if len(parts) == 1:
            rendering = self._render(batch, cameras, own, opaque, generator, precision)
        else:
            tasks = [
                partial(self._render_tensors, part, cameras, prior, opaque, _derived(generator), precision)
                for part, prior in zip(parts, own.split([len(part.targets) for part in parts]), strict=True)
            ]
            trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
            rendering = TileRendering.from_tensors(differentiable_parts(tasks, trained, device))
        loss, error = photometric(rendering, batch, network.grids, side)
        if config.structure_weight:
            loss = loss + config.structure_weight * structural(rendering, batch, side)
        if config.depth_weight:
            loss = loss + config.depth_weight * sparse_depth(rendering, batch, network.grids, side)
        return loss, error

    def _render(
        self,
        batch: Batch,
        cameras: Cameras,
        priors: Float[Tensor, "T 3 h w"],
        opaque: bool,
        generator: torch.Generator,
        precision: torch.dtype | None,
    ) -> TileRendering:
        network = self.network
        doubled = batch.image_doubled or (None,) * len(batch.images)
        with mixed_precision(priors.device, precision):
            groups = zip(batch.images, batch.image_corner_px, doubled, strict=True)
            encoded = [network.encode(*images) for images in groups]
        if batch.image_used:
            masks = zip(encoded, batch.image_used, batch.image_corner_px, strict=True)
            encoded = [one.masked(used, corner_px) for one, used, corner_px in masks]
        neighbours = cameras[batch.neighbours.reshape(-1)]
        views = Views(neighbours, batch.which, batch.blend_weight, Encoded.concatenate(encoded))
        tiles = Tiles(cameras[batch.targets], batch.corner_px, self.config.tile_px)
        return network(tiles, views, network.start_intervals(tiles, priors), opaque, batch.detail, generator)

    def _render_tensors(self, *arguments: Any) -> tuple[Tensor, ...]:
        return self._render(*arguments).tensors()


def _derived(generator: torch.Generator) -> torch.Generator:
    """A new generator, seeded by this one, for a thread of its own."""
    return torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator)))


def photometric(
    rendering: TileRendering, batch: Batch, grids: tuple[RayGrid, ...], side_px: int
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """The loss, and the mean squared error of the colours alone (eq. 5 divided by the number of values).

    Both are weighted by the batch's pixel weights. A coarse pass's colours are compared with the means of the pixels
    that its rays stand for.
    """
    weight = batch.weight[..., None]
    error = _mean_square(rendering.colour - batch.colours, weight)
    loss = error
    weighted_truth, share = (_picture(x, side_px) for x in (batch.colours * weight, weight))
    for grid, coarse in zip(grids, rendering.coarse_colours, strict=False):
        total = F.avg_pool2d(share, grid.stride).permute(0, 2, 3, 1)
        # The floor keeps rays of which no pixel counts finite.
        mean = F.avg_pool2d(weighted_truth, grid.stride).permute(0, 2, 3, 1) / total.clamp(min=1e-6)
        loss = loss + COARSE_WEIGHT * _mean_square(_without_margin(coarse, grid, side_px) - mean, total)
    return loss, error


def structural(rendering: TileRendering, batch: Batch, side_px: int) -> Float[Tensor, ""]:
    """1 - SSIM of the tiles' colours, as evaluation measures it, weighted by the batch's pixel weights."""
    found, truth, weight = (_picture(x, side_px) for x in (rendering.colour, batch.colours, batch.weight[..., None]))
    return ((1 - similarity(found, truth)) * weight).mean() / weight.mean().clamp(min=0.1)


def sparse_depth(rendering: TileRendering, batch: Batch, grids: tuple[RayGrid, ...], side_px: int) -> Float[Tensor, ""]:
    """How far every pass's mean inverse depths are from those of the sparse points (docs/method.md, section 13).

    Huber's penalty of their relative difference in units of `DEPTH_SCALE`, weighted by the points' reprojection errors;
    a coarse pass's rays are held to the points within the pixels that they stand for.
    """
    weight = batch.depth_weight[..., None]
    weighted, share = (_picture(x, side_px) for x in (batch.inverse_depth[..., None] * weight, weight))
    loss = weight.new_zeros(())
    for grid, inverse_depth in zip(grids, rendering.inverse_depths, strict=True):
        total = F.avg_pool2d(share, grid.stride)[:, 0]
        known = total > 0
        mean = (F.avg_pool2d(weighted, grid.stride)[:, 0] / total.clamp(min=1e-12))[known]
        miss = (_without_margin(inverse_depth, grid, side_px)[known] / mean - 1) / DEPTH_SCALE
        penalty = F.huber_loss(miss, torch.zeros_like(miss), reduction="none") * total[known]
        loss = loss + penalty.sum() / total.sum().clamp(min=1e-12)
    return loss / len(rendering.inverse_depths)


def _without_margin(rays: Tensor, grid: RayGrid, side_px: int) -> Tensor:
    """A pass's rays as rows and columns, without the margin around the tile."""
    rows = side_px // grid.stride + 2 * grid.margin
    inner = slice(grid.margin, rows - grid.margin)
    return rays.unflatten(1, (rows, rows))[:, inner, inner]


def _picture(values: Float[Tensor, "T R C"], side_px: int) -> Float[Tensor, "T C S S"]:
    return values.unflatten(1, (side_px, side_px)).permute(0, 3, 1, 2)


def _mean_square(difference: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean; a tile of which little counts is divided by a tenth at least, so that it does not dominate."""
    return (difference.square() * weight).mean() / weight.mean().clamp(min=0.1)
