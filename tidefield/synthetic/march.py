"""Rays against the height field, in steps that cannot pass through it.

The surface is the bilinear interpolation of its raster, so "exact" is well defined. From a point `gap` above the
ground, a ray that falls by -d_z and runs |d_xy| per unit of depth cannot meet a surface of slope at most L within
gap / (L |d_xy| - d_z): that is the step (sphere tracing with a Lipschitz bound for height fields). The gap shrinks
by a constant factor with every step, so no bisection is needed to finish.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from tidefield.synthetic.raster import Raster

_TOLERANCE_M = 5e-5
_STEPS = 180
_BETWEEN_CHECKS = 4
_MISSED_M = 0.01
"""Rays that are still further from the surface after the last step run alongside it and count as sky."""


def march(
    height: Raster, steepest: float, origin: Float[Tensor, "3 #R"], direction: Float[Tensor, "3 #R"]
) -> Float[Tensor, " R"]:
    """Depth at which rays first meet a height field; inf for rays that do not.

    Args:
        height: the surface, in its only channel.
        steepest: nothing of the surface is steeper.
        origin: above the surface.
        direction: per unit of depth.
    """
    falling = direction[2] < -1e-3
    fall = torch.where(falling, direction[2], -1.0)
    rate = 1 / (steepest * torch.hypot(direction[0], direction[1]) - fall)
    # From where the ray enters the slab that holds the surface.
    depth = ((height.values.max() - origin[2]) / fall).clamp(min=0)
    scale = 2 / fall.new_tensor([*height.extent.size_m, 2.0])[:, None]
    shift = fall.new_tensor([height.extent.west_m, height.extent.south_m, 0.0])[:, None]
    # East and north in the raster's own [-1, 1]; the height stays in metres.
    start = (origin - shift) * scale - fall.new_tensor([1.0, 1.0, 0.0])[:, None]
    start, step, rate, depth = torch.broadcast_tensors(start, direction * scale, rate, depth)
    depth, gap = _approach(height.values[None], start, step, rate[0], depth[0])
    return torch.where(falling & (gap < _MISSED_M), depth, torch.inf)


def _approach(
    height: Float[Tensor, "1 1 H W"], start: Tensor, step: Tensor, rate: Tensor, depth: Tensor
) -> tuple[Tensor, Tensor]:
    """Step until the gap is below the tolerance; depths and gaps."""
    depths, gaps = depth.clone(), torch.empty_like(depth)
    active = torch.arange(len(depth), device=depth.device)
    at = torch.empty(1, 1, len(depth), 2, device=depth.device)
    for k in range(_STEPS):
        torch.addcmul(start[0], depth, step[0], out=at[0, 0, :, 0])
        torch.addcmul(start[1], depth, step[1], out=at[0, 0, :, 1])
        below = F.grid_sample(height, at, padding_mode="border", align_corners=True)[0, 0, 0]
        gap = torch.addcmul(start[2], depth, step[2]).sub_(below).clamp_(min=0)
        depth = torch.addcmul(depth, gap, rate)
        if k % _BETWEEN_CHECKS == _BETWEEN_CHECKS - 1:
            depths[active], gaps[active] = depth, gap
            keep = torch.nonzero(gap > _TOLERANCE_M)[:, 0]
            if len(keep) == 0:
                break
            active, start, step, rate, depth = active[keep], start[:, keep], step[:, keep], rate[keep], depth[keep]
            at = at[:, :, : len(keep)].contiguous()
    return depths, gaps
