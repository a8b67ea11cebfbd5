"""What training minimises (paper, eq. 5; method.md, section 9)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.batches import Batch
from tidefield.model.network import Network, TileRendering

GLIMPSE_WEIGHT = 0.5
"""Of the coarse stages' own colours, without which nothing would teach them where the surface is."""


def photometric(
    rendering: TileRendering, batch: Batch, network: Network, side_px: int
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """The loss, and the mean squared error of the colours alone (eq. 5 divided by the number of values).

    A coarse stage's colours are compared with the means of the pixels that its rays stand for.
    """
    inside = batch.inside[..., None].to(batch.colours)
    error = _mean_square((rendering.colour - batch.colours) * inside, inside)
    loss = error
    truth = (batch.colours * inside).unflatten(1, (side_px, side_px)).permute(0, 3, 1, 2)
    share = inside.unflatten(1, (side_px, side_px)).permute(0, 3, 1, 2)
    for k, glimpse in enumerate(rendering.glimpses):
        stride, margin = network.config.stages[k].stride, network.margin(k)
        rows = side_px // stride + 2 * margin
        seen = glimpse.unflatten(1, (rows, rows))[:, margin : rows - margin, margin : rows - margin]
        covered = F.avg_pool2d(share, stride).permute(0, 2, 3, 1)
        mean = F.avg_pool2d(truth, stride).permute(0, 2, 3, 1)
        loss = loss + GLIMPSE_WEIGHT * _mean_square(seen * covered - mean, covered)
    return loss, error


def _mean_square(difference: Tensor, weight: Tensor) -> Tensor:
    return difference.square().sum() / (weight.sum() * difference.shape[-1] / weight.shape[-1]).clamp(min=1.0)


def psnr(mean_square: float) -> float:
    """Decibels of a mean squared error of values in [0, 1] (eq. 12)."""
    return -10 * torch.tensor(max(mean_square, 1e-10)).log10().item()
