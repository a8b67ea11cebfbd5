"""Aggregation of the neighbouring views at a sample (paper, eq. 6 and Figure 2).

Alphabet: T tiles, N views, P samples of a tile, C channels, H hidden channels. Views come before samples, so that a
mean over views is a sum of N contiguous slabs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass(frozen=True)
class Evidence:
    """What the neighbouring views say of P samples per tile.

    Attributes:
        density: F_sigma, the feature that the ray transformer turns into density.
        per_view: F_N,i, the feature of each view.
        view_weight: w_n,i in (0, 1), the learned reliability of each view; 0 where it is invalid.
        direction_weight: w_i of eq. 6; sums to 1 over the views, or to 0 where none is valid.
        variance: v, of the views' features under the direction weights.
        valid: whether any view sees the sample.
    """

    density: Float[Tensor, "T P H"]
    per_view: Float[Tensor, "T N P H"]
    view_weight: Float[Tensor, "T N P"]
    direction_weight: Float[Tensor, "T N P"]
    variance: Float[Tensor, "T P C"]
    valid: Bool[Tensor, "T P"]


def direction_weights(
    cosine: Float[Tensor, "T N P"],
    valid: Bool[Tensor, "T N P"],
    sharpness: Float[Tensor, ""],
    blend_weight: Float[Tensor, "T N P"] | None = None,
) -> Float[Tensor, "T N P"]:
    """Eq. 6: w~_i = max(0, exp(s (d.d_i - 1)) - min_j exp(s (d.d_j - 1))), normalised over the views.

    Invalid views take no part in the minimum nor in the sum and get 0. Where every w~ is 0 (one view, or all at the
    same angle) the valid views share equally (docs/method.md, section 4).

    Args:
        cosine: d.d_i between the unit directions from the target's and from each view's camera to the sample.
        valid: whether the view sees the sample.
        sharpness: s, learnable.
        blend_weight: a factor of each w~ that lets views fade in and out; not in the paper.
    """
    closeness = torch.exp(sharpness * (cosine - 1))
    least = closeness.masked_fill(~valid, math.inf).amin(1, keepdim=True)
    raw = (closeness - least).clamp(min=0).masked_fill(~valid, 0.0)
    equal = valid.to(raw)
    if blend_weight is not None:
        raw, equal = raw * blend_weight, equal * blend_weight
    total = raw.sum(1, keepdim=True)
    # The floor keeps samples that no view sees at 0 instead of 0/0.
    equal = equal / equal.sum(1, keepdim=True).clamp(min=1e-9)
    # Below 1e-6 the differences are rounding of equal angles, not a preference.
    tied = total < 1e-6
    return torch.where(tied, equal, raw / total.masked_fill(tied, 1.0))


def weighted_moments(
    values: Float[Tensor, "T N P C"], weight: Float[Tensor, "T N P"]
) -> tuple[Float[Tensor, "T P C"], Float[Tensor, "T P C"]]:
    """Mean and variance over the views; the weights sum to 1 or, where no view is valid, to 0."""
    mean = weighted_sum(values, weight)
    variance = torch.zeros_like(mean)
    for value, share in zip(values.unbind(1), weight[..., None].unbind(1), strict=True):
        variance = variance.addcmul_(share, (value - mean).square_())
    return mean, variance


def weighted_sum(values: Float[Tensor, "T N P C"], weight: Float[Tensor, "T N P"]) -> Float[Tensor, "T P C"]:
    """Sum over the views, one view after the other: several times as fast on a CPU as all their products at once."""
    total = torch.zeros_like(values[:, 0])
    for value, share in zip(values.unbind(1), weight[..., None].unbind(1), strict=True):
        total = total.addcmul_(share, value)
    return total


class Aggregate(nn.Module):
    """[F_i, mu, v] -> F_N,i and w_n,i -> pooled again by w_n -> F_sigma (Figure 2; docs/method.md, section 5).

    Args:
        channels: C of the gathered features.
        hidden: H.
        folded: the part of the first layer that acts on F_i has been applied to the feature maps already (it commutes
            with bilinear interpolation), so channels == hidden and F_i enters as it is.
        uniform_weights: views count alike in the first pooling, whatever their directions; for the ablation.
    """

    def __init__(self, channels: int, hidden: int, folded: bool = False, uniform_weights: bool = False) -> None:
        super().__init__()
        assert not folded or channels == hidden, "the maps of a folded first layer hold its outputs"
        self.uniform_weights = uniform_weights
        # exp keeps s positive; 20 separates views 20 degrees apart by a factor of 3.
        self.log_sharpness = nn.Parameter(torch.tensor(math.log(20.0)))
        self.own = nn.Identity() if folded else nn.Linear(channels, hidden)
        self.shared = nn.Linear(2 * channels, hidden)
        self.second = nn.Linear(hidden, hidden)
        self.view_weight = nn.Linear(hidden, 1)
        self.density = nn.Sequential(nn.Linear(2 * hidden, hidden), nn.ReLU(), nn.Linear(hidden, hidden))

    def forward(
        self,
        features: Float[Tensor, "T N P C"],
        cosine: Float[Tensor, "T N P"],
        valid: Bool[Tensor, "T N P"],
        blend_weight: Float[Tensor, "T N P"] | None = None,
    ) -> Evidence:
        sharpness = self.log_sharpness.exp()
        # With a sharpness of 0 all directions are the same, and the views share equally.
        weight = direction_weights(cosine, valid, 0 * sharpness if self.uniform_weights else sharpness, blend_weight)
        mean, variance = weighted_moments(features, weight)
        # A linear layer of [F_i, mu, v] is a sum of linear layers; the shared part is computed once for all views.
        shared = self.shared(torch.cat([mean, variance], dim=-1))
        first = F.relu(self.own(features) + shared[:, None], inplace=True)
        per_view = F.relu(self.second(first), inplace=True)
        view_weight = torch.sigmoid(self.view_weight(per_view)[..., 0]) * valid
        if blend_weight is not None:
            view_weight = view_weight * blend_weight
        # Where no view is valid the sum is 0, and so are the pooled features.
        pooled = weighted_moments(per_view, view_weight / view_weight.sum(1, keepdim=True).clamp(min=1e-6))
        return Evidence(
            density=self.density(torch.cat(pooled, dim=-1)),
            per_view=per_view,
            view_weight=view_weight,
            direction_weight=weight,
            variance=variance,
            valid=valid.any(1),
        )
