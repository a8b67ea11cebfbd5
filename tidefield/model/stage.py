"""One pass along the rays: samples, what is known of them, and the weights with which they make the picture.

Alphabet: T tiles, R rays of a tile, M samples of a ray, P = R M, H hidden channels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.config import NetworkConfig, StageConfig
from tidefield.geometry.cameras import Cameras
from tidefield.model.aggregate import Aggregate, Evidence
from tidefield.model.compositing import surface_logits, surface_shares, weights
from tidefield.model.intervals import Intervals
from tidefield.model.ray_transformer import RayTransformer
from tidefield.model.views import Gathered

UNLIKELY = -30.0
"""Score of a sample that no view sees."""
NOISE = 1e-4
"""Variance of a colour below which views agree: 2.5 of 255 levels."""


@dataclass(frozen=True)
class Samples:
    """M samples on each of R rays.

    Attributes:
        place: 0 at the near end of the ray's interval, 1 at the far end.
        inverse_depth: inverse z-depth.
        points_world: X, all rays' samples one after the other.
        directions: d, unit, from the target's camera.
        delta: distance along the ray to the next sample; from the last one, to the interval's far end.
    """

    place: Float[Tensor, "T R M"]
    inverse_depth: Float[Tensor, "T R M"]
    points_world: Float[Tensor, "T P 3"]
    directions: Float[Tensor, "T P 3"]
    delta: Float[Tensor, "T R M"]


def place_samples(
    cameras: Cameras, uv_px: Float[Tensor, "T R 2"], intervals: Intervals, place: Float[Tensor, "T R M"]
) -> Samples:
    """Samples on the rays through pixels, at given places of the rays' intervals."""
    inverse_depth = intervals.inverse_depth(place)
    depth = 1 / inverse_depth
    ray = cameras.directions_world(uv_px)
    length = ray.norm(dim=-1, keepdim=True)
    ends = torch.cat([depth, (1 / intervals.far)[..., None]], dim=-1) * length
    # In memory all x, then all y, then all z: nearly everything that is done with points runs along many of them.
    along, unit = (x.transpose(1, 2)[..., None] for x in (ray, ray / length))
    points = cameras.position_world[..., None, None] + along * depth[:, None]
    points, unit = (x.flatten(2).transpose(1, 2) for x in (points, unit.expand_as(points)))
    return Samples(place, inverse_depth, points, unit, ends.diff(dim=-1).clamp(min=0))


@dataclass(frozen=True)
class Weights:
    """What the samples of a ray contribute.

    Attributes:
        colour: to its colour: volume rendering of densities, which are 0 where no view sees.
        surface: how likely the surface is at each sample, those included that no view sees.
        shown: how likely a view sees it.
    """

    colour: Float[Tensor, "T R M"]
    surface: Float[Tensor, "T R M"]
    shown: Float[Tensor, "T R"]


class Stage(nn.Module):
    """Evidence, ray transformer and density of one pass.

    Args:
        network, config: of the whole and of this pass.
        field_channels: of the per-scene field; 0 without one.
        first: nothing but the sparse points has said yet where the surface is.
    """

    def __init__(self, network: NetworkConfig, config: StageConfig, field_channels: int, first: bool) -> None:
        super().__init__()
        self.hidden = hidden = config.hidden
        if network.views:
            alike = "direction weights" in network.without
            self.aggregate = Aggregate(config.feature_channels, hidden, network.fold, network.as_printed, alike)
            if "ray transformer" not in network.without:
                self.transformer = RayTransformer(hidden, network.heads)
        if field_channels:
            self.from_field = nn.Sequential(nn.Linear(field_channels, hidden), nn.ReLU(), nn.Linear(hidden, hidden))
        self.density = nn.Linear(hidden, 1)
        self.as_printed = network.as_printed
        if not network.as_printed:
            self.guide = nn.Linear(3, hidden)
            # At the start: the surface is where the views agree and, in the first pass, within some samples of where
            # it is expected; the network corrects it.
            self.match = nn.Parameter(torch.tensor(3.0))
            self.guide_height = nn.Parameter(torch.tensor(2.0 if first else 0.0))
            self.guide_steepness = nn.Parameter(torch.tensor(0.3 if first else 0.0))
            self.lone_steepness = nn.Parameter(torch.tensor(10.0 if first else 0.0))
            nn.init.zeros_(self.density.weight)
            nn.init.zeros_(self.density.bias)

    def evidence(self, gathered: Gathered | None, field: Float[Tensor, "T P F"] | None) -> Evidence:
        """What the neighbours and the per-scene field say of the samples; their density features add up."""
        if gathered is None:
            assert field is not None, "a network without views needs a field"
            tiles, count = field.shape[:2]
            empty = field.new_zeros(tiles, 0, count, self.hidden)
            known = torch.ones(tiles, count, dtype=torch.bool, device=field.device)
            grey = field.new_full((tiles, count, 3), 0.5)
            none = grey[..., 0] * 0
            return Evidence(self.from_field(field), empty, empty[..., 0], grey, none, none, known)
        presence = None if self.as_printed else gathered.presence
        evidence = self.aggregate(gathered.features, gathered.colours, gathered.cosine, gathered.valid, presence)
        if field is None:
            return evidence
        return replace(
            evidence, density=evidence.density + self.from_field(field), valid=torch.ones_like(evidence.valid)
        )

    def weights(
        self, evidence: Evidence, samples: Samples, intervals: Intervals, opaque: bool, unit: Float[Tensor, ""] | None
    ) -> Weights:
        """How much each sample contributes to its ray.

        Density is predicted per unit of length. With views the unit is a length that their features resolve, whatever
        the scene's scale: the sample's own interval or, as printed, the mean one of the ray; a field, which must say
        the same from everywhere, brings its own.
        """
        shape = samples.place.shape
        x = evidence.density.unflatten(1, shape[1:])
        valid = evidence.valid.unflatten(1, shape[1:])
        bias: Tensor | float = 0.0
        likely: Tensor | None = None
        if not self.as_printed:
            freedom = (evidence.count.unflatten(1, shape[1:]) - 1).clamp(min=0) * valid
            x, bias = self._guide(x, samples, intervals, freedom)
            if unit is None:
                score = bias + self._agreement(evidence, freedom)
                likely = surface_shares(score, opaque)
                bias = surface_logits(score.masked_fill(~valid, UNLIKELY), opaque)
        if hasattr(self, "transformer"):
            rays = (t.flatten(0, 1) for t in (x, samples.place, valid))
            x = self.transformer(*rays).unflatten(0, shape[:2])
        delta = samples.delta
        own = delta.mean(-1, keepdim=True) if self.as_printed else delta.clamp(min=1e-9)
        length = own if unit is None else unit
        sigma = F.softplus(self.density(x)[..., 0] + bias) * valid / length
        if opaque:
            delta = torch.cat([delta[..., :-1], torch.full_like(delta[..., -1:], torch.inf)], dim=-1)
        found = weights(sigma, delta)
        if likely is None:
            return Weights(found, found, torch.ones_like(found[..., 0]))
        hidden = likely * ~valid
        shown = 1 - hidden.sum(-1)
        return Weights(found, hidden + found * shown[..., None], shown)

    def _agreement(self, evidence: Evidence, freedom: Float[Tensor, "T R M"]) -> Float[Tensor, "T R M"]:
        """How much likelier the surface is at each sample than at the ray's usual one, from how well the views agree.

        As if what k views see were normal: of one surface with a small variance, of k different things with a large
        one. The logarithm of the ratio of the two likelihoods grows with k - 1, so a lone view, which always agrees
        with itself, says nothing.
        """
        unlike = torch.log(evidence.disagreement.unflatten(1, freedom.shape[1:]) + NOISE)
        usual = (freedom * unlike).sum(-1, keepdim=True) / freedom.sum(-1, keepdim=True).clamp(min=1e-3)
        return self.match * freedom * (usual - unlike)

    def _guide(
        self, x: Float[Tensor, "T R M H"], samples: Samples, intervals: Intervals, freedom: Float[Tensor, "T R M"]
    ) -> tuple[Float[Tensor, "T R M H"], Float[Tensor, "T R M"]]:
        """Tell the samples where the surface is expected: as a feature, and as a score."""
        expected = intervals.expected_place
        known = expected.isfinite()[..., None]
        # In samples, so that it means the same for any number of them and any interval.
        offset = (samples.place - expected[..., None]) * samples.place.shape[-1]
        offset = torch.where(known, offset, 0.0)
        features = torch.stack([offset / 4, torch.exp(-((offset / 2) ** 2)), torch.exp(-((offset / 8) ** 2))], dim=-1)
        # Where no two views see it, samples around where it is expected would only smear what one of them sees.
        steepness = self.guide_steepness + self.lone_steepness * torch.exp(-freedom)
        # Beyond the floor it would shut off, for good, samples that the views may yet find to be the surface.
        bias = (self.guide_height - steepness * offset.square()).clamp(min=-4)
        return x + self.guide(features) * known[..., None], torch.where(known, bias, self.guide_height)
