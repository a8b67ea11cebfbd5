"""Where along the rays to look (method.md, sections 13 and 14): samples, and from their weights the next stage's rays.

Depths are handled as inverse z-depths, in which equal steps are equal parallax. Every ray has an interval from near to
far and an expectation within it; a sample's place is 0 at the near end and 1 at the far end.

Alphabet: T tiles of g x g rays, R = g^2 rays of a tile, M samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F


@dataclass(frozen=True)
class Intervals:
    """Inverse z-depths between which each ray's surface lies, and where it is expected.

    Attributes:
        near, far: the interval's ends; near > far, both are inverse depths.
        expected: the likeliest inverse depth, or NaN where nothing is known.
    """

    near: Float[Tensor, "T R"]
    far: Float[Tensor, "T R"]
    expected: Float[Tensor, "T R"]

    def place(self, inverse_depth: Float[Tensor, "T R *M"]) -> Float[Tensor, "T R *M"]:
        """From inverse depths to places in [0, 1]."""
        near, far = self.near, self.far
        if inverse_depth.dim() == 3:
            near, far = near[..., None], far[..., None]
        return (near - inverse_depth) / (near - far)

    def inverse_depth(self, place: Float[Tensor, "T R M"]) -> Float[Tensor, "T R M"]:
        return self.near[..., None] + (self.far - self.near)[..., None] * place


def sample(intervals: Intervals, count: int, generator: torch.Generator | None) -> Float[Tensor, "T R M"]:
    """Places of `count` samples per ray, one in each of as many equal parts.

    Args:
        generator: jitters the samples within their parts, for training; None puts them in the middle.
    """
    tiles, rays = intervals.near.shape
    device = intervals.near.device
    if generator is None:
        jitter = torch.full((1, 1, count), 0.5, device=device)
    else:
        jitter = torch.rand(tiles, rays, count, generator=generator, device=device)
    return ((torch.arange(count, device=device) + jitter) / count).expand(tiles, rays, count)


def spread_of(
    weights: Float[Tensor, "T R M"], place: Float[Tensor, "T R M"]
) -> tuple[Float[Tensor, "T R"], Float[Tensor, "T R"]]:
    """Mean place of a ray's weights and their standard deviation, which is at least that within one sample's part."""
    total = weights.sum(-1).clamp(min=1e-6)
    mean = (weights * place).sum(-1) / total
    variance = (weights * (place - mean[..., None]).square()).sum(-1) / total
    within = 1 / (12 * place.shape[-1] ** 2)
    return mean, (variance + within).sqrt()


def refined(
    intervals: Intervals,
    mean: Float[Tensor, "T R"],
    spread: Float[Tensor, "T R"],
    ratio: int,
    reach: float,
    margin: int,
) -> Intervals:
    """Intervals of the next stage's rays, `ratio` times as dense: the coarse rays' mean +- reach x spread.

    The outermost coarse rays are a margin that finer rays lean on; of the finer rays `margin` on each side stay. At
    each coarse ray the interval is widened to hold its eight neighbours' means, so that both sides of an edge are
    looked at; then ends and expectation are interpolated.
    """
    tiles, rays = mean.shape
    side = round(rays**0.5)
    inverse = (intervals.near + (intervals.far - intervals.near) * mean).reshape(tiles, 1, side, side)
    half = (reach * spread * (intervals.near - intervals.far)).reshape(tiles, 1, side, side)
    highest = F.max_pool2d(inverse, 3, 1, 1)
    lowest = -F.max_pool2d(-inverse, 3, 1, 1)
    ends = torch.cat([torch.maximum(inverse + half, highest), torch.minimum(inverse - half, lowest), inverse], dim=1)
    if ratio > 1:
        ends = F.interpolate(ends, scale_factor=ratio, mode="bilinear", align_corners=False)
    cut = ratio - margin
    side = ends.shape[-1] - cut
    inner = ends[:, :, cut:side, cut:side].flatten(2)
    near, far, expected = inner.unbind(1)
    # An inverse depth of 0 is at infinity; beyond it lies behind the camera.
    tiniest = 1e-6 * near.abs().clamp(min=1e-12)
    far = far.clamp(min=0) + tiniest
    return Intervals(near=torch.maximum(near, far * (1 + 1e-4)), far=far, expected=expected)
