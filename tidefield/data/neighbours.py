"""Which photographs are a tile's neighbouring views (paper, "System overview"; method.md, section 1).

Alphabet: T tiles, V candidate photographs, S points of the visible surface per tile, N neighbours.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from tidefield.geometry.cameras import Cameras

FADE = 0.04
"""Share of its rank by which a view must be better than the first one left out to count in full."""
BORDER = 0.05
"""Share of its width over which a view fades out of its frame."""
ANGLE_SCALE_RAD = 0.35
"""Angle at which a view that sees the whole tile is worth as much as one straight on that sees 1 / e of it."""


def rank_by_view(targets: Cameras, surface_world: Float[Tensor, "T S 3"], candidates: Cameras) -> Float[Tensor, "T V"]:
    """How well each candidate shows what a target sees: share of the surface points in its frame times closeness.

    Closeness falls with the mean angle subtended at the points between the target's and the candidate's rays, so it
    tells nadir photographs apart, which all look in the same direction.
    """
    tiles, points = surface_world.shape[:2]
    uv, z = candidates.project(surface_world.reshape(-1, 3))
    # Not a step at the border: views that come and go must do so gently, or pictures jump.
    within = torch.minimum(uv, candidates.size_px[:, None] - uv).amin(-1) / (BORDER * candidates.size_px[:, None, 0])
    share = (within.clamp(0, 1) * (z > 0)).reshape(-1, tiles, points).mean(-1).T
    ours = F.normalize(surface_world - targets.position_world[:, None], dim=-1)
    theirs = F.normalize(surface_world[:, None] - candidates.position_world[None, :, None], dim=-1)
    # From the chord: unlike the cosine it keeps small angles.
    angle = 2 * torch.asin(((theirs - ours[:, None]).norm(dim=-1) / 2).clamp(max=1))
    return share * torch.exp(-angle.mean(-1) / ANGLE_SCALE_RAD)


def rank_by_direction(targets: Cameras, candidates: Cameras) -> Float[Tensor, "T V"]:
    """The paper's ranking: cosine between the viewing directions, moved to [0, 1]."""
    return (targets.forward_world @ candidates.forward_world.T + 1) / 2


def nearest(
    rank: Float[Tensor, "T V"], excluded: Bool[Tensor, "T V"], count: int
) -> tuple[Int[Tensor, "T N"], Float[Tensor, "T N"]]:
    """The `count` best-ranked candidates of each tile, best first; fewer where there are not as many.

    Args:
        excluded: candidates that may not serve, such as the target photograph itself.

    Returns:
        The candidates, and how far each is there, in (0, 1]: one that is about to be left out for a better one
        hardly counts any more, so that nothing jumps when it is.
    """
    allowed = int((~excluded).sum(1).min())
    found = rank.masked_fill(excluded, -1.0).topk(min(count + 1, allowed), dim=1)
    best, left_out = found.values[:, :count], found.values[:, count:].clamp(min=0)
    if not left_out.shape[1]:
        return found.indices, torch.ones_like(best)
    presence = (best - left_out) / (FADE * best).clamp(min=1e-9)
    return found.indices[:, :count], presence.clamp(1e-3, 1)
