"""What training minimises (paper, eq. 5; method.md, section 9)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.batches import Batch
from tidefield.evaluation.metrics import similarity
from tidefield.model.network import Network, TileRendering

GLIMPSE_WEIGHT = 0.5
"""Of the coarse stages' own colours, without which nothing would teach them where the surface is."""
DEPTH_SCALE = 0.01
"""Share of its depth by which a surface may miss a sparse point before the penalty grows no faster (Huber)."""


def photometric(
    rendering: TileRendering, batch: Batch, network: Network, side_px: int
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """The loss, and the mean squared error of the colours alone (eq. 5 divided by the number of values).

    Both are weighted as the batch says. A coarse stage's colours are compared with the means of the pixels that its
    rays stand for.
    """
    weight = batch.weight[..., None]
    error = _mean_square(rendering.colour - batch.colours, weight)
    loss = error
    weighted_truth, share = ((_picture(x, side_px)) for x in (batch.colours * weight, weight))
    for k, glimpse in enumerate(rendering.glimpses):
        stride, margin = network.config.stages[k].stride, network.margin(k)
        rows = side_px // stride + 2 * margin
        seen = glimpse.unflatten(1, (rows, rows))[:, margin : rows - margin, margin : rows - margin]
        total = F.avg_pool2d(share, stride).permute(0, 2, 3, 1)
        mean = F.avg_pool2d(weighted_truth, stride).permute(0, 2, 3, 1) / total.clamp(min=1e-6)
        loss = loss + GLIMPSE_WEIGHT * _mean_square(seen - mean, total)
    return loss, error


def structural(rendering: TileRendering, batch: Batch, side_px: int) -> Float[Tensor, ""]:
    """1 - SSIM of the tiles' colours, as evaluation measures it, weighted as the batch says."""
    found, truth, weight = (_picture(x, side_px) for x in (rendering.colour, batch.colours, batch.weight[..., None]))
    return ((1 - similarity(found, truth)) * weight).mean() / weight.mean().clamp(min=0.1)


def sparse_depth(rendering: TileRendering, batch: Batch, network: Network, side_px: int) -> Float[Tensor, ""]:
    """How far every stage's expected inverse depths are from the sparse points' (method.md, section 13).

    Huber's penalty of their relative difference in units of `DEPTH_SCALE`, weighted by what the points' reprojection
    errors say; a coarse stage's rays are held to the points within the pixels that they stand for.
    """
    weight = batch.depth_weight[..., None]
    weighted, share = (_picture(x, side_px) for x in (batch.inverse_depth[..., None] * weight, weight))
    loss = weight.new_zeros(())
    for k, expected in enumerate(rendering.expected):
        stride, margin = network.config.stages[k].stride, network.margin(k)
        rows = side_px // stride + 2 * margin
        found = expected.unflatten(1, (rows, rows))[:, margin : rows - margin, margin : rows - margin]
        total = F.avg_pool2d(share, stride)[:, 0]
        known = total > 0
        mean = (F.avg_pool2d(weighted, stride)[:, 0] / total.clamp(min=1e-12))[known]
        miss = (found[known] / mean - 1) / DEPTH_SCALE
        loss = loss + (
            F.huber_loss(miss, torch.zeros_like(miss), reduction="none") * total[known]
        ).sum() / total.sum().clamp(min=1e-12)
    return loss / len(rendering.expected)


def _picture(values: Float[Tensor, "T R C"], side_px: int) -> Float[Tensor, "T C S S"]:
    return values.unflatten(1, (side_px, side_px)).permute(0, 3, 1, 2)


def _mean_square(difference: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean; where hardly any weight is, a sum over a tenth of the values, so that it does not become loud."""
    return (difference.square() * weight).mean() / weight.mean().clamp(min=0.1)


def psnr(mean_square: float) -> float:
    """Decibels of a mean squared error of values in [0, 1] (eq. 12)."""
    return -10 * torch.tensor(max(mean_square, 1e-10)).log10().item()
