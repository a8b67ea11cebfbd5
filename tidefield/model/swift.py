"""Our network: the paper's boxes in two passes, with geometry first looked for where sparse points and photographs
say it is.

What it adds to `model.paper`:

- A coarse pass with one ray for 4 x 4 pixels finds the surface; a fine pass searches around it.
- A score of each sample is the logarithm of how likely the surface is there (`Pass.weights`): the prior from matched
  photographs and sparse points, the agreement of the views, and what the aggregated features say. The density is the
  hazard rate of that distribution, so more samples do not stop more light.
- The views' colours are means over pixels, every half pixel, of learnedly sharpened photographs, and blended by angle
  (`colour.AngularColourBlend`).
- The ray transformer and the target colour are left out in the preset, because they bring nothing here
  (docs/results.md); variants have them.
- Views fade in and out (`blend_weight`), so that neither tiles nor frames of a video jump.
- The aggregation's first layer is applied to the feature maps, once per photograph instead of once per sample.

Alphabet: T tiles, R rays of a tile, M samples of a ray, P = R M, H hidden channels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.config import NetworkConfig, PassConfig
from tidefield.model.aggregate import Aggregate, Evidence, weighted_sum
from tidefield.model.colour import AngularColourBlend
from tidefield.model.compositing import composite, weights
from tidefield.model.encoder import Encoder
from tidefield.model.network import Network, TileRendering
from tidefield.model.ray_transformer import RayTransformer
from tidefield.model.sampling import Intervals, Samples, Tiles, histogram, place_samples, refine, sample
from tidefield.model.views import Encoded, Gathered, Views, maps_from_images, pixel_means, upsample_twice

LOGIT_LIMIT = 12.0
"""Of opacities: beyond it a sample is opaque, or empty, as far as single precision can represent it."""
UNSEEN_SCORE = -30.0
"""Score of a sample that no view sees."""
COLOUR_NOISE = 1e-4
"""Variance of a colour below which views agree: 2.5 of 255 levels."""
LOWEST_PRIOR = -4.0
"""Beyond it the prior would shut off, for good, samples that the views may yet find to be the surface."""


@dataclass(frozen=True)
class Weights:
    """What the samples of a ray contribute.

    Attributes:
        colour: to its colour: volume rendering of densities, which are 0 where no view sees.
        surface: probability that the surface is at each sample, including samples that no view sees.
        visibility: probability that a view sees the surface.
    """

    colour: Float[Tensor, "T R M"]
    surface: Float[Tensor, "T R M"]
    visibility: Float[Tensor, "T R"]


class SwiftNetwork(Network):
    """Coarse and fine pass: features -> samples -> aggregation -> density; then colour and volume rendering."""

    fills_unseen = True

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        channels = {one.feature_stride: one.feature_channels for one in config.passes}
        self.encoder = Encoder(config.encoder, tuple(sorted(channels.items(), reverse=True)))
        self.descriptors = nn.ModuleDict(
            {
                str(stride): nn.Conv2d(3, c, 5, padding=2, padding_mode="replicate", bias=False)
                for stride, c in channels.items()
            }
        )
        self.sharpen = nn.Parameter(torch.zeros(1, 1, 5, 5)) if config.has("sharpening") else None
        self.passes = nn.ModuleList(Pass(config, one, first=k == 0) for k, one in enumerate(config.passes))
        neighbours_only = not config.has("target colour")
        self.colour = AngularColourBlend(config.passes[-1].hidden, config.harmonics_degree, neighbours_only)

    def forward(
        self,
        tiles: Tiles,
        views: Views,
        start: Intervals,
        opaque: bool,
        detail: Float[Tensor, "T R"] | None = None,
        jitter: tuple[Float[Tensor, "T _ _"], ...] = (),
    ) -> TileRendering:
        intervals, pdf = start, torch.ones_like(start.inv_near)[..., None]
        inverse_depths, coarse_colours, coarse_opacities = [], [], []
        for k, one in enumerate(self.config.passes):
            uv = tiles.rays_px(*self.grids[k])
            s = sample(pdf, one.samples, jitter[k] if jitter else None)
            samples = place_samples(tiles.cameras, uv, intervals, s)
            in_tile = ((uv - tiles.corner_px[:, None]) / tiles.side_px).clamp(0, 1)
            last = one is self.config.passes[-1]
            gathered = views.read(
                one.feature_stride,
                samples.points_world,
                samples.directions,
                in_tile,
                tiles.pixels_per_unit(samples.inverse_depth),
                mean_colours=not last and one.feature_stride > 1,
            )
            this = cast(Pass, self.passes[k])
            evidence = this.aggregate(gathered.features, gathered.cosine, gathered.valid, gathered.blend_weight)
            weight = this.weights(evidence, samples, intervals, opaque)
            # 1e-6: a ray that nothing stops has its depth in the middle of its samples.
            known = weight.surface + 1e-6 / one.samples
            inverse_depths.append((known * samples.inverse_depth).sum(-1) / known.sum(-1))
            if last:
                colours = self.colour(evidence, gathered, samples.directions)
                return TileRendering(
                    colour=composite(weight.colour, colours.unflatten(1, samples.s.shape[1:])),
                    depth=1 / inverse_depths[-1],
                    opacity=weight.colour.sum(-1),
                    visibility=weight.visibility,
                    inverse_depths=tuple(inverse_depths),
                    coarse_colours=tuple(coarse_colours),
                    coarse_opacities=tuple(coarse_opacities),
                )
            mean_colour = mean_colours(evidence, gathered)
            coarse_colours.append(composite(weight.colour, mean_colour.unflatten(1, samples.s.shape[1:])))
            coarse_opacities.append(weight.colour.sum(-1))
            following = self.grids[k + 1]
            pdf = histogram(weight.surface.detach(), samples.s, one.samples, self.config.uniform_fraction)
            intervals, pdf = refine(intervals, pdf, one.stride // following.stride, following.margin)
            if detail is not None and following.stride == 1:
                intervals = intervals.moved(detail)
        raise AssertionError("a network has at least one pass")

    def encode(
        self,
        photographs: Float[Tensor, "K 3 H W"],
        corner_px: Float[Tensor, "K 2"] | None = None,
        doubled: Float[Tensor, "K 3 2*H 2*W"] | None = None,
    ) -> Encoded:
        corner = photographs.new_zeros(len(photographs), 2) if corner_px is None else corner_px
        # As the encoder's maps are: sums of both layouts take several times as long.
        photographs = photographs.contiguous(memory_format=torch.channels_last)
        maps = {}
        for stride, features in zip(self.encoder.strides, self.encoder(photographs), strict=True):
            colours = means_over_texels(photographs, stride)
            features = features.float() + self.descriptors[str(stride)](colours)
            channels = torch.cat([colours, features], dim=1) if stride > 1 else features
            maps[stride] = maps_from_images(channels, corner, stride)
        if doubled is None:
            colours = upsample_twice(self._sharpened(photographs, 1))
        else:
            colours = self._sharpened(pixel_means(doubled.contiguous(memory_format=torch.channels_last)), 2)
        with_colours = frozenset(stride for stride in maps if stride > 1)
        return Encoded(maps, maps_from_images(colours, corner, 0.5), with_colours)

    def _sharpened(self, colours: Float[Tensor, "K 3 H W"], step: int) -> Float[Tensor, "K 3 H W"]:
        """Sharpen against the blur of interpolation and blending: learned, starts as the identity, sums to one.

        Args:
            colours: of texels of which `step` are a pixel.
        """
        if self.sharpen is None:
            return colours
        padded = F.pad(colours, (2 * step,) * 4, mode="replicate")
        # One convolution of all channels is faster than one of each.
        each = torch.eye(3, device=colours.device)[:, :, None, None]
        return colours + F.conv2d(padded, each * (self.sharpen - self.sharpen.mean()), dilation=step)


class Pass(nn.Module):
    """Aggregation, density and, in variants, ray transformer of one pass.

    Args:
        network, config: of the whole and of this pass.
        first: only the prior says where the surface is; later passes search around what the one before has found.
    """

    def __init__(self, network: NetworkConfig, config: PassConfig, first: bool) -> None:
        super().__init__()
        hidden = config.hidden
        uniform = not network.has("direction weights")
        self.aggregate = ComparingAggregate(config.feature_channels, hidden, folded=True, uniform_weights=uniform)
        self.transformer = RayTransformer(hidden, network.heads) if network.has("ray transformer") else None
        self.density = nn.Linear(hidden, 1) if network.has("density head") else None
        self.prior_features = nn.Linear(3, hidden)
        self.agreement_features = nn.Linear(2, hidden)
        # At the start the surface is where the views agree and, in the first pass, within about two samples of where
        # it is expected (2 - 0.3 x^2 changes sign at x = 2.6); the network corrects it.
        self.agreement = nn.Parameter(torch.tensor(3.0)) if network.has("agreement") else None
        self.prior_height = nn.Parameter(torch.tensor(2.0 if first else 0.0))
        self.prior_steepness = nn.Parameter(torch.tensor(0.3 if first else 0.0))
        self.single_view_steepness = nn.Parameter(torch.tensor(10.0 if first else 0.0))
        # Of there being no surface, where a scene may be empty: as likely as one in a single sample of usual score.
        self.empty = nn.Parameter(torch.tensor(-math.log(config.samples)))
        if self.density is not None:
            nn.init.zeros_(self.density.weight)
            nn.init.zeros_(self.density.bias)

    def weights(self, evidence: Evidence, samples: Samples, intervals: Intervals, opaque: bool) -> Weights:
        """How much each sample contributes to its ray.

        The scores z_k give the surface's distribution p(s) ~ exp(z(s)) over the ray's normalised distance s, of which a
        sample has the share of the interval around it. Its hazard rate, p over the probability that the surface has not
        been met yet, is the density with which volume rendering gives the samples these shares (docs/method.md,
        section 6).
        """
        rays = samples.s.shape
        valid = evidence.valid.unflatten(1, rays[1:])
        degrees = degrees_of_freedom(evidence).unflatten(1, rays[1:])
        agreement = self._agreement_score(evidence, degrees)
        x, score = self._prior(evidence.density.unflatten(1, rays[1:]), samples, intervals, degrees, agreement)
        if self.transformer is not None:
            x = self.transformer(*(t.flatten(0, 1) for t in (x, samples.s, valid))).unflatten(0, rays[:2])
        score = score + agreement
        if self.density is not None:
            score = score + self.density(x)[..., 0]
        score = score + widths(samples.s).log()
        empty = None if opaque else self.empty
        likely = surface_shares(score, empty)
        delta = samples.delta
        logits = surface_logits(score.masked_fill(~valid, UNSEEN_SCORE), empty)
        sigma = F.softplus(logits) * valid / delta.clamp(min=1e-9)
        if opaque:
            delta = torch.cat([delta[..., :-1], torch.full_like(delta[..., -1:], torch.inf)], dim=-1)
        weight = weights(sigma, delta)
        unseen = likely * ~valid
        visibility = 1 - unseen.sum(-1)
        return Weights(weight, unseen + weight * visibility[..., None], visibility)

    def _agreement_score(self, evidence: Evidence, degrees: Float[Tensor, "T R M"]) -> Float[Tensor, "T R M"]:
        """How much likelier the surface is at each sample than at the ray's usual one, from how well the views agree.

        As if what k views see were normally distributed: with a small variance on one surface, with a large one
        elsewhere. The logarithm of the likelihood ratio grows with k - 1, so a single view, which always agrees with
        itself, says nothing.
        """
        if self.agreement is None:
            return torch.zeros_like(degrees)
        variance = self.aggregate.disagreement(evidence).unflatten(1, degrees.shape[1:])
        log_variance = torch.log(variance + COLOUR_NOISE)
        # The floor keeps rays that no two views see at 0.
        usual = (degrees * log_variance).sum(-1, keepdim=True) / degrees.sum(-1, keepdim=True).clamp(min=1e-3)
        return self.agreement * degrees * (usual - log_variance)

    def _prior(
        self,
        x: Float[Tensor, "T R M H"],
        samples: Samples,
        intervals: Intervals,
        degrees: Float[Tensor, "T R M"],
        agreement: Float[Tensor, "T R M"],
    ) -> tuple[Float[Tensor, "T R M H"], Float[Tensor, "T R M"]]:
        """Where the surface is expected, as features added to F_sigma together with the agreement, and as a score."""
        expected = intervals.s_expected
        known = expected.isfinite()[..., None]
        # In samples, so that it means the same for any number of them and any interval.
        offset = (samples.s - expected[..., None]) * samples.s.shape[-1]
        offset = torch.where(known, offset, 0.0)
        features = torch.stack([offset / 4, torch.exp(-((offset / 2) ** 2)), torch.exp(-((offset / 8) ** 2))], dim=-1)
        views_agree = torch.stack([torch.tanh(agreement / 4), torch.log1p(degrees)], dim=-1)
        # Where no two views see it, samples around where it is expected would only smear what one of them sees.
        steepness = self.prior_steepness + self.single_view_steepness * torch.exp(-degrees)
        score = (self.prior_height - steepness * offset.square()).clamp(min=LOWEST_PRIOR)
        x = x + self.prior_features(features) * known[..., None] + self.agreement_features(views_agree)
        return x, torch.where(known, score, self.prior_height)


class ComparingAggregate(Aggregate):
    """The paper's aggregation, with a learned weight of each feature in how much the views disagree."""

    def __init__(self, channels: int, hidden: int, folded: bool, uniform_weights: bool) -> None:
        super().__init__(channels, hidden, folded, uniform_weights)
        self.log_metric = nn.Parameter(torch.full((channels,), -math.log(channels)))

    def disagreement(self, evidence: Evidence) -> Float[Tensor, "T P"]:
        """How differently the views see each sample: a weighted sum of the variances of their features."""
        return evidence.variance @ self.log_metric.exp()


def degrees_of_freedom(evidence: Evidence) -> Float[Tensor, "T P"]:
    """Effective number of views, 1 / sum w_i^2 of the direction weights, less one; 0 where none or one is valid."""
    effective = evidence.valid / evidence.direction_weight.square().sum(1).clamp(min=1e-6)
    return (effective - 1).clamp(min=0) * evidence.valid


def mean_colours(evidence: Evidence, gathered: Gathered) -> Float[Tensor, "T P 3"]:
    """The views' colours averaged with the direction weights; middle grey where no view sees."""
    return weighted_sum(gathered.colours, evidence.direction_weight) + 0.5 * ~evidence.valid[..., None]


def means_over_texels(photographs: Float[Tensor, "K 3 H W"], stride: int) -> Float[Tensor, "K 3 h w"]:
    """Photographs averaged over the texels of a map: over an odd number of pixels, so that they are centred there."""
    if stride == 1:
        return photographs
    odd = stride + 1 - stride % 2
    return F.avg_pool2d(photographs, odd, stride, odd // 2, count_include_pad=False)


def widths(s: Float[Tensor, "*R M"]) -> Float[Tensor, "*R M"]:
    """How much of a ray each sample stands for, from halfway to the one before to halfway to the next, times M: 1 where
    samples are spread evenly."""
    edges = torch.cat([torch.zeros_like(s[..., :1]), (s[..., 1:] + s[..., :-1]) / 2, torch.ones_like(s[..., :1])], -1)
    return edges.diff(dim=-1).clamp(min=1e-4) * s.shape[-1]


def surface_shares(score: Float[Tensor, "*R M"], empty: Float[Tensor, ""] | None) -> Float[Tensor, "*R M"]:
    """Probability of the surface at each sample: softmax(score); `empty` is the score of there being none, for all M
    samples together, or None where there is one."""
    return torch.softmax(_with_empty(score, empty), dim=-1)[..., : score.shape[-1]]


def surface_logits(score: Float[Tensor, "*R M"], empty: Float[Tensor, ""] | None) -> Float[Tensor, "*R M"]:
    """Logits of the opacities 1 - exp(-sigma_i delta_i) with which samples get the weights softmax(score).

    T_i a_i is a softmax's p_i where a_i = p_i / sum_{j>=i} p_j, whose logit is score_i - log sum_{j>i} exp(score_j).
    As 1 - exp(-softplus(x)) = sigmoid(x), sigma_i delta_i is a softplus of it. A score means the same wherever on the
    ray its sample lies; were scores such logits themselves, many unlikely samples in front would hide the likely one.

    Args:
        score: of each sample, finite.
        empty: as for `surface_shares`; lies behind the last sample.
    """
    # Sample by sample: a few of them for many rays take less time than `logcumsumexp` does.
    scores = _with_empty(score, empty).unbind(-1)
    later = torch.stack(list(accumulate(scores[:0:-1], torch.logaddexp))[::-1], dim=-1)
    # The last sample of an opaque ray stops all light whatever its logit.
    return (score - (F.pad(later, (0, 1)) if empty is None else later)).clamp(-LOGIT_LIMIT, LOGIT_LIMIT)


def _with_empty(score: Float[Tensor, "*R M"], empty: Float[Tensor, ""] | None) -> Tensor:
    if empty is None:
        return score
    # Scores are of densities: M of them, each of an M-th of the ray, against one of the whole.
    return torch.cat([score, (empty + math.log(score.shape[-1])).expand_as(score[..., :1])], dim=-1)
