"""The interface of every method: `render(camera) -> Rendering`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from tidefield.config import Sampling
from tidefield.geometry.cameras import Cameras


@dataclass(frozen=True)
class Rendering:
    """What a camera sees.

    Attributes:
        colour: in [0, 1], display-referred like the photographs, at the camera's gain.
        depth: expected z-depth (along the camera's +z), world units.
        opacity: share of the light that the scene stops, in [0, 1].
        seconds: of a method in a process of its own, the time that it took there; None where the caller measures it.
    """

    colour: Float[Tensor, "H W 3"]
    depth: Float[Tensor, "H W"]
    opacity: Float[Tensor, "H W"]
    seconds: float | None = field(default=None, kw_only=True)


def to_8_bit(colour: Float[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
    """Clip colours to [0, 1] and round them to 0..255."""
    return (colour.detach().float().clamp(0, 1) * 255).round().to(torch.uint8)


def fill_unseen(colour: Float[Tensor, "H W 3"], seen: Bool[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
    """Continue colours smoothly into pixels that no photograph sees; middle grey if none is seen at all.

    Seen pixels are averaged over larger and larger blocks until every block has one, then interpolated back
    (pull-push: Gortler et al., The Lumigraph, 1996).
    """
    if seen.all():
        return colour
    if not seen.any():
        return torch.full_like(colour, 0.5)
    weight = seen.to(colour)[None, None]
    blocks = {"kernel_size": 2, "ceil_mode": True, "count_include_pad": False}
    coarse_weight = F.avg_pool2d(weight, **blocks)
    coarse = F.avg_pool2d(colour.permute(2, 0, 1)[None] * weight, **blocks)
    # The floor keeps blocks without a seen pixel finite; they are filled from the next coarser ones.
    coarse = (coarse / coarse_weight.clamp(min=1e-6))[0].permute(1, 2, 0)
    coarse = fill_unseen(coarse, coarse_weight[0, 0] > 0)
    # By two, also where the last block is cut off: each block stays where its pixels are.
    filled = F.interpolate(coarse.permute(2, 0, 1)[None], scale_factor=2.0, mode="bilinear", align_corners=False)
    height, width = seen.shape
    return torch.where(seen[..., None], colour, filled[0, :, :height, :width].permute(1, 2, 0))


Render = Callable[[Cameras], Rendering]
"""A method: takes one camera (a `Cameras` of length 1) and returns its view in full size."""


def with_rays(render: Render, sampling: Sampling) -> Render:
    """Render with several rays per pixel if they are asked for (one otherwise)."""
    return lambda camera: render_with_rays(render, camera, sampling.rays_per_side or 1)


def render_with_rays(render: Render, camera: Cameras, side: int) -> Rendering:
    """Render with side x side rays per pixel: the mean colour and opacity, and the depth of the mean inverse depth of
    what is not empty."""
    if side == 1:
        return render(camera)
    view = render(camera.resized(side * camera.width, side * camera.height))
    colour = F.avg_pool2d(view.colour.permute(2, 0, 1)[None], side)[0].permute(1, 2, 0)
    inverse, opacity = 1 / view.depth, view.opacity
    whole, opacity, covered = F.avg_pool2d(torch.stack([inverse, opacity, opacity * inverse])[None], side)[0]
    inverse = torch.where(opacity > 0, covered / opacity.clamp(min=torch.finfo(opacity.dtype).tiny), whole)
    return Rendering(colour=colour, depth=1 / inverse, opacity=opacity, seconds=view.seconds)
