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

    @property
    def expected_place(self) -> Float[Tensor, "T R"]:
        """Where the surface is expected: 0 at the near end, 1 at the far end; NaN where nothing is known."""
        return (self.near - self.expected) / (self.near - self.far)

    def inverse_depth(self, place: Float[Tensor, "T R M"]) -> Float[Tensor, "T R M"]:
        return self.near[..., None] + (self.far - self.near)[..., None] * place


def sample(density: Float[Tensor, "T R B"], count: int, generator: torch.Generator | None) -> Float[Tensor, "T R M"]:
    """Places of `count` samples per ray, one in each of as many parts of equal probability.

    Args:
        density: not negative and not normalised, over B equal bins from near to far.
        generator: jitters the samples within their parts, for training; None puts them in the middle.
    """
    tiles, rays, bins = density.shape
    device = density.device
    if generator is None:
        jitter = torch.full((1, 1, count), 0.5, device=device)
    else:
        jitter = torch.rand(tiles, rays, count, generator=generator).to(device)
    wanted = ((torch.arange(count, device=device) + jitter) / count).expand(tiles, rays, count).contiguous()
    if bins == 1:
        return wanted
    below = F.pad(density.cumsum(-1), (1, 0))
    below = below / below[..., -1:]
    bin_ = (torch.searchsorted(below, wanted, right=True) - 1).clamp(0, bins - 1)
    low, high = below.gather(-1, bin_), below.gather(-1, bin_ + 1)
    return (bin_ + (wanted - low) / (high - low).clamp(min=1e-9)) / bins


def refined(
    intervals: Intervals, density: Float[Tensor, "T R B"], ratio: int, margin: int
) -> tuple[Intervals, Float[Tensor, "T r B"]]:
    """Intervals of the next stage's rays, `ratio` times as dense, and where in them to look.

    Coarse rays' densities are interpolated like their intervals, so that a ray beside an edge looks at both of its
    sides. The outermost coarse rays are a margin for this; of the finer rays `margin` on each side stay.
    """
    tiles, rays, _ = density.shape
    side = round(rays**0.5)
    known = torch.stack([intervals.near, intervals.far, intervals.expected], dim=-1)
    grid = torch.cat([known, density], dim=-1).transpose(1, 2).reshape(tiles, -1, side, side)
    if ratio > 1:
        grid = F.interpolate(grid, scale_factor=ratio, mode="bilinear", align_corners=False)
    cut = ratio - margin
    inner = grid[:, :, cut : grid.shape[2] - cut, cut : grid.shape[3] - cut].flatten(2).transpose(1, 2)
    near, far, expected = inner[..., :3].unbind(-1)
    return Intervals(near, far, expected), inner[..., 3:]


def histogram(
    weights: Float[Tensor, "T R M"], place: Float[Tensor, "T R M"], bins: int, floor: float
) -> Float[Tensor, "T R B"]:
    """Weights at places as a density over equal bins; `floor` of the whole is spread evenly, so nothing is ruled out.

    Every weight is shared by the two bins whose middles it lies between.
    """
    if bins == 1:
        return (1 - floor) * weights.sum(-1, keepdim=True) + floor
    spot = (place * bins - 0.5).clamp(0, bins - 1)
    low = spot.floor().clamp(max=bins - 2)
    part = spot - low
    result = torch.zeros(*weights.shape[:2], bins, device=weights.device, dtype=weights.dtype)
    result.scatter_add_(2, low.long(), weights * (1 - part)).scatter_add_(2, low.long() + 1, weights * part)
    return (1 - floor) * result + floor / bins
