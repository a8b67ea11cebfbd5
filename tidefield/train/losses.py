"""What training minimises: the loss of a random batch of tiles (paper, eq. 5; docs/method.md, section 9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
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
from tidefield.model.sampling import Intervals, Tiles
from tidefield.model.views import Encoded, Views
from tidefield.parallel import differentiable_parts
from tidefield.recording import map_tensors

COARSE_WEIGHT = 0.5
"""Of the coarse passes' own colours, without which nothing would teach them where the surface is."""
DEPTH_SCALE = 0.01
"""Share of its depth by which a surface may miss a sparse point before the penalty grows no faster (Huber)."""


@dataclass(frozen=True)
class Inputs:
    """What the loss of a batch is computed from.

    Attributes:
        batch: the tiles, and what to encode.
        cameras: of the tiles.
        neighbours: of the tiles' neighbours, tile by tile.
        start: intervals of the first pass's rays.
        jitter: of the samples of every pass.
        behind: background of the tiles at the common exposure; None where the last sample of a ray stops all light.
    """

    batch: Batch
    cameras: Cameras
    neighbours: Cameras
    start: Intervals
    jitter: tuple[Float[Tensor, "T _ _"], ...]
    behind: Float[Tensor, "T 1 3"] | None

    @staticmethod
    def draw(
        network: Network,
        config: TrainConfig,
        scene: Scene,
        priors: DepthPriors,
        views: int,
        generator: torch.Generator,
        of: Sequence[int] | None = None,
        doubled: Scene | None = None,
        cameras: Cameras | None = None,
    ) -> Inputs:
        """Draw a random batch.

        Args:
            network: that learns from it.
            config: of the training.
            scene: whose training photographs are drawn from.
            priors: of its cameras.
            views: neighbours of each tile.
            generator: of everything random.
            of: training photographs to draw from; all of them if not given.
            doubled: the scene at twice the size, where photographs are read from it, too.
            cameras: to render with; the scene's own if not given.
        """
        batch = draw_batch(scene, priors, config, views, generator, of, doubled)
        cameras = scene.cameras if cameras is None else cameras
        own = cameras[batch.targets]
        cells = [priors[i].cells for i in batch.targets.tolist()]
        behind = None
        if scene.background_rgb is not None:
            middle = (batch.corner_px + config.tile_px / 2)[:, None]
            behind = torch.tensor(scene.background_rgb) / own.gain_at(middle)
        return Inputs(
            batch=batch,
            cameras=own,
            neighbours=cameras[batch.neighbours.reshape(-1)],
            start=network.start_intervals(Tiles(own, batch.corner_px, config.tile_px), cells),
            jitter=network.draw_jitter(len(batch.targets), config.tile_px, generator),
            behind=behind,
        )

    def parts(self, count: int) -> list[Inputs]:
        """Split into at most `count` parts of some of the tiles each; into one where tiles share images."""
        views, first, parts = self.batch.which.shape[1], 0, []
        for batch in self.batch.parts(count):
            last = first + len(batch.targets)
            tiles = slice(first, last)
            start, jitter = map_tensors((self.start, self.jitter), itemgetter(tiles))
            neighbours = self.neighbours[slice(first * views, last * views)]
            behind = None if self.behind is None else self.behind[tiles]
            parts.append(Inputs(batch, self.cameras[tiles], neighbours, start, jitter, behind))
            first = last
        return parts


class BatchLoss(nn.Module):
    """The loss of a batch: rendered and compared.

    A module, so that DistributedDataParallel can average what several processes learn.

    Args:
        network: to train.
        config: of the training.
    """

    def __init__(self, network: Network, config: TrainConfig) -> None:
        super().__init__()
        self.network, self.config = network, config

    def forward(
        self, inputs: Inputs, precision: torch.dtype | None = None
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Compute the loss of a batch, and the mean squared error of its colours.

        On a GPU nothing waits for it, and no value decides what is computed: the operations can be recorded.

        Args:
            inputs: on the network's device.
            precision: of the encoder's convolutions; that of `choose_precision` if None.
        """
        network, config, batch = self.network, self.config, inputs.batch
        device, side = batch.colours.device, config.tile_px
        parts = inputs.parts(torch.get_num_threads()) if device.type == "cpu" else [inputs]
        if len(parts) == 1:
            rendering = self._render(inputs, precision)
        else:
            tasks = [partial(self._render_tensors, part, precision) for part in parts]
            trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
            rendering = TileRendering.from_tensors(differentiable_parts(tasks, trained, device))
        if inputs.behind is not None:
            rendering = rendering.over(inputs.behind)
        loss, error = photometric(rendering, batch, network.grids, side)
        if config.structure_weight:
            loss = loss + config.structure_weight * structural(rendering, batch, side)
        if config.depth_weight:
            loss = loss + config.depth_weight * sparse_depth(rendering, batch, network.grids, side)
        return loss, error

    def _render(self, inputs: Inputs, precision: torch.dtype | None) -> TileRendering:
        network, batch = self.network, inputs.batch
        groups = range(len(batch.images))
        images = [(batch.colours_of_images(k), batch.colours_at_twice_the_size(k)) for k in groups]
        corners = [corner.float() for corner in batch.image_corner_px]
        with mixed_precision(batch.colours.device, precision):
            encoded = [network.encode(one, at, twice) for (one, twice), at in zip(images, corners, strict=True)]
        if batch.image_used:
            encoded = [one.masked(*used) for one, *used in zip(encoded, batch.image_used, corners, strict=True)]
        views = Views(inputs.neighbours, batch.which, batch.blend_weight, Encoded.concatenate(encoded))
        tiles = Tiles(inputs.cameras, batch.corner_px, self.config.tile_px)
        return network(tiles, views, inputs.start, inputs.behind is None, batch.detail, inputs.jitter)

    def _render_tensors(self, *arguments: Any) -> tuple[Tensor, ...]:
        return self._render(*arguments).tensors()


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
        mean = F.avg_pool2d(weighted, grid.stride)[:, 0] / total.clamp(min=1e-12)
        found = _without_margin(inverse_depth, grid, side_px)
        miss = (found / torch.where(total > 0, mean, found.detach()) - 1) / DEPTH_SCALE
        penalty = F.huber_loss(miss, torch.zeros_like(miss), reduction="none") * total
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
