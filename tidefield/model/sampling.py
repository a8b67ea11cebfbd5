"""Rays of target tiles, the depths searched along them, and the samples on them.

Depths are handled as inverse z-depths, in which equal steps are equal parallax. Every ray is searched in an interval
from near to far. A sample's normalised distance s is 0 at the near end of the interval and 1 at the far end, linear in
inverse depth (multinerf's s-distance with 1/z as the warp).

Alphabet: T tiles of g x g rays, R = g^2 rays of a tile, M samples of a ray, P = R M samples of a tile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.depth_prior import read_prior
from tidefield.geometry.cameras import Cameras, pixel_grid

LEAST_MOVED = 0.01
"""Least inverse depth of an interval that is moved, as a share of what it was: beyond infinity lies what is behind the
camera."""


@dataclass(frozen=True)
class Tiles:
    """T square tiles of target views.

    Attributes:
        cameras: the target camera of each tile.
        corner_px: upper left pixel corner of each tile.
        side_px: width and height of the tiles in pixels; tiles may reach beyond the image.
    """

    cameras: Cameras
    corner_px: Float[Tensor, "T 2"]
    side_px: int

    def rays_px(self, stride: int, margin: int = 0) -> Float[Tensor, "T R 2"]:
        """Pixels of a tile's rays: centres of stride x stride squares, with `margin` more rays around the tile."""
        assert self.side_px % stride == 0, f"tiles of {self.side_px} px cannot be covered by rays every {stride} px"
        count = self.side_px // stride + 2 * margin
        return self.corner_px[:, None] + (pixel_grid(count, count, self.corner_px.device) - margin) * stride

    def pixels_per_unit(self, inverse_depth: Float[Tensor, "T R M"]) -> Float[Tensor, "T P"]:
        """Pixels that a unit of length shows as at samples' inverse z-depths, the samples of all rays one after the
        other."""
        return (inverse_depth * self.cameras.focal_px.mean(1)[:, None, None]).flatten(1)


@dataclass(frozen=True)
class Intervals:
    """Inverse z-depths between which the surface of each ray is searched, and where it is expected.

    Attributes:
        inv_near, inv_far: inverse depths of the ends of the interval; inv_near > inv_far.
        inv_expected: the likeliest inverse depth, or NaN where nothing is known.
    """

    inv_near: Float[Tensor, "T R"]
    inv_far: Float[Tensor, "T R"]
    inv_expected: Float[Tensor, "T R"]

    @property
    def s_expected(self) -> Float[Tensor, "T R"]:
        """Normalised distance of the expected surface; NaN where nothing is known."""
        return (self.inv_near - self.inv_expected) / (self.inv_near - self.inv_far)

    def moved(self, inverse_depth: Float[Tensor, "T R"]) -> Intervals:
        """Return these intervals, moved in inverse depth, but not as far as infinity."""
        ends = self.inv_near, self.inv_far, self.inv_expected
        return Intervals(*(torch.maximum(end + inverse_depth, LEAST_MOVED * end) for end in ends))

    def inverse_depth(self, s: Float[Tensor, "T R M"]) -> Float[Tensor, "T R M"]:
        return self.inv_near[..., None] + (self.inv_far - self.inv_near)[..., None] * s


def intervals_from_prior(priors: Sequence[Float[Tensor, "3 _ _"]], uv_px: Float[Tensor, "T R 2"]) -> Intervals:
    """Intervals of rays from the depth priors of the tiles' cameras, of any sizes, or from the one of all tiles."""
    uv_of_priors = uv_px.reshape(len(priors), 1, -1, 2)
    read = [read_prior(prior[None], uv) for prior, uv in zip(priors, uv_of_priors, strict=True)]
    expected, near, far = (torch.cat(x).reshape(uv_px.shape[:2]) for x in zip(*read, strict=True))
    return Intervals(inv_near=near, inv_far=far, inv_expected=expected)


@dataclass(frozen=True)
class Samples:
    """M samples on each of R rays.

    Attributes:
        s: normalised distance, 0 at the near end of the ray's interval, 1 at the far end.
        inverse_depth: inverse z-depth.
        points_world: X, the samples of all rays one after the other.
        directions: d, unit, from the target camera.
        delta: distance along the ray to the next sample; from the last one, to the far end of the interval.
    """

    s: Float[Tensor, "T R M"]
    inverse_depth: Float[Tensor, "T R M"]
    points_world: Float[Tensor, "T P 3"]
    directions: Float[Tensor, "T P 3"]
    delta: Float[Tensor, "T R M"]


def place_samples(
    cameras: Cameras, uv_px: Float[Tensor, "T R 2"], intervals: Intervals, s: Float[Tensor, "T R M"]
) -> Samples:
    """Samples on the rays through pixels, at given normalised distances."""
    inverse_depth = intervals.inverse_depth(s)
    depth = 1 / inverse_depth
    ray = cameras.directions_world(uv_px)
    length = ray.norm(dim=-1, keepdim=True)
    ends = torch.cat([depth, (1 / intervals.inv_far)[..., None]], dim=-1) * length
    # In memory all x, then all y, then all z: nearly everything that is done with points runs along many of them.
    along, unit = (x.transpose(1, 2)[..., None] for x in (ray, ray / length))
    points = cameras.position_world[..., None, None] + along * depth[:, None]
    points, unit = (x.flatten(2).transpose(1, 2) for x in (points, unit.expand_as(points)))
    return Samples(s, inverse_depth, points, unit, ends.diff(dim=-1).clamp(min=0))


def sample(pdf: Float[Tensor, "T R B"], count: int, jitter: Float[Tensor, "T R M"] | None) -> Float[Tensor, "T R M"]:
    """Normalised distances of `count` samples per ray, one in each of as many parts of equal probability.

    Args:
        pdf: not negative and not normalised, over B equal bins from near to far; one bin is the uniform density.
        jitter: where in its part each sample lies, 0 to 1, for training; None puts them in the middle.
    """
    tiles, rays, bins = pdf.shape
    device = pdf.device
    if jitter is None:
        jitter = torch.full((1, 1, count), 0.5, device=device)
    quantile = ((torch.arange(count, device=device) + jitter) / count).expand(tiles, rays, count).contiguous()
    if bins == 1:
        return quantile
    cdf = F.pad(pdf.cumsum(-1), (1, 0))
    cdf = cdf / cdf[..., -1:]
    bin_ = (torch.searchsorted(cdf, quantile, right=True) - 1).clamp(0, bins - 1)
    low, high = cdf.gather(-1, bin_), cdf.gather(-1, bin_ + 1)
    # The floor keeps quantiles in empty bins finite.
    return (bin_ + (quantile - low) / (high - low).clamp(min=1e-9)) / bins


def histogram(
    weights: Float[Tensor, "T R M"], s: Float[Tensor, "T R M"], bins: int, uniform_fraction: float
) -> Float[Tensor, "T R B"]:
    """Weights of samples as a density over equal bins, part of it uniform so that no depth is ruled out.

    Every weight is shared by the two bins whose middles it lies between.
    """
    if bins == 1:
        return (1 - uniform_fraction) * weights.sum(-1, keepdim=True) + uniform_fraction
    position = (s * bins - 0.5).clamp(0, bins - 1)
    low = position.floor().clamp(max=bins - 2)
    part = position - low
    result = torch.zeros(*weights.shape[:2], bins, device=weights.device, dtype=weights.dtype)
    result.scatter_add_(2, low.long(), weights * (1 - part)).scatter_add_(2, low.long() + 1, weights * part)
    return (1 - uniform_fraction) * result + uniform_fraction / bins


def refine(
    intervals: Intervals, pdf: Float[Tensor, "T R B"], ratio: int, margin: int
) -> tuple[Intervals, Float[Tensor, "T r B"]]:
    """Intervals of the next pass's rays, `ratio` times as dense, and the density of their samples.

    Densities of coarse rays are interpolated like their intervals, so that a ray next to an edge searches both of its
    sides. The outermost coarse rays are a margin for this; of the finer rays `margin` on each side stay.
    """
    tiles, rays, _ = pdf.shape
    side = round(rays**0.5)
    ends = torch.stack([intervals.inv_near, intervals.inv_far, intervals.inv_expected], dim=-1)
    grid = torch.cat([ends, pdf], dim=-1).transpose(1, 2).reshape(tiles, -1, side, side)
    if ratio > 1:
        grid = F.interpolate(grid, scale_factor=ratio, mode="bilinear", align_corners=False)
    cut = ratio - margin
    inner = grid[:, :, cut : grid.shape[2] - cut, cut : grid.shape[3] - cut].flatten(2).transpose(1, 2)
    near, far, expected = inner[..., :3].unbind(-1)
    return Intervals(near, far, expected), inner[..., 3:]
