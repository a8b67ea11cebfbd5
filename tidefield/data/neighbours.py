"""Which photographs are a tile's neighbouring views (paper, "System overview"; method.md, section 1).

They are chosen where tiles meet, at their corners, and fade in between: tiles side by side, which may read different
photographs, then show the same along their border.

Alphabet: K places, T tiles, V candidate photographs, S points of the visible surface per place, N neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.depth_prior import unproject_to_surface
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.geometry.rays import angle_between

FADE = 0.04
"""Share of its rank by which a view must be better than the first one left out to count in full."""
BORDER = 0.05
"""Share of its width over which a view fades out of its frame."""
ANGLE_SCALE_RAD = 0.35
"""Angle at which a view that sees the whole tile is worth as much as one straight on that sees 1 / e of it."""

FEW = 64
"""Photographs that are ranked for every place; of more, only those that every so many places see best."""
EVERY = 7
EXTRA_VIEWS = 1
"""Views that a tile has beyond those of each corner: room for others to take over within the tile."""
SPOTS = ((0.0, 0.0), (-0.4, -0.4), (0.4, -0.4), (-0.4, 0.4), (0.4, 0.4))
"""Around each corner of a tile, in its sides, where it is asked who sees the surface."""


@dataclass(frozen=True)
class Neighbours:
    """The views of T tiles, best first.

    Attributes:
        index: photographs.
        presence: how far each is there, 0 to 1, at the tile's corners: upper left and right, then lower left and right.
    """

    index: Int[Tensor, "T N"]
    presence: Float[Tensor, "T N 4"]

    def __getitem__(self, tiles: Tensor | slice) -> Neighbours:
        return Neighbours(self.index[tiles], self.presence[tiles])


def rank_by_view(targets: Cameras, surface_world: Float[Tensor, "K S 3"], candidates: Cameras) -> Float[Tensor, "K V"]:
    """How well each candidate shows what a target sees: share of the surface points in its frame times closeness.

    Closeness falls with the mean angle subtended at the points between the target's and the candidate's rays, so it
    tells nadir photographs apart, which all look in the same direction.
    """
    places, points = surface_world.shape[:2]
    uv, z = candidates.project(surface_world.reshape(-1, 3))
    share = (from_border(uv, candidates.size_px[:, None], BORDER) * (z > 0)).reshape(-1, places, points).mean(-1).T
    ours = F.normalize(surface_world - targets.position_world[:, None], dim=-1)
    theirs = F.normalize(surface_world[:, None] - candidates.position_world[None, :, None], dim=-1)
    angle = angle_between(ours[:, None], theirs)
    return share * torch.exp(-angle.mean(-1) / ANGLE_SCALE_RAD)


def from_border(uv_px: Float[Tensor, "*B 2"], size_px: Tensor, share: float) -> Float[Tensor, "*B"]:
    """Where a view shows something: 1 inside, and falling to 0 towards the border of its frame and beyond.

    Views come and go gently: otherwise pictures jump when they do, and show where a photograph ends.

    Args:
        size_px: width and height, to go with `uv_px`.
        share: of its width over which it falls.
    """
    return (torch.minimum(uv_px, size_px - uv_px).amin(-1) / (share * size_px[..., 0])).clamp(0, 1)


def rank_by_direction(targets: Cameras, candidates: Cameras) -> Float[Tensor, "K V"]:
    """The paper's ranking: cosine between the viewing directions, moved to [0, 1]."""
    return (targets.forward_world @ candidates.forward_world.T + 1) / 2


def nearest(
    rank: Float[Tensor, "K V"], excluded: Bool[Tensor, "K V"], count: int, spare: int = 0
) -> tuple[Int[Tensor, "K N"], Float[Tensor, "K N"]]:
    """The best-ranked candidates of each place, best first; fewer where there are not as many.

    Args:
        excluded: candidates that may not serve, such as the target photograph itself.
        count: of them that are there.
        spare: how many follow that are not there, but may be nearby.

    Returns:
        The candidates, and how far each is there, 0 to 1: one that is about to be left out for a better one does not
        count any more, so that nothing jumps when it is.
    """
    allowed = int((~excluded).sum(1).min())
    found = rank.masked_fill(excluded, -1.0).topk(min(count + max(spare, 1), allowed), dim=1)
    if allowed <= count:
        return found.indices, torch.ones_like(found.values)
    chosen, best, left_out = found.indices[:, : count + spare], found.values[:, : count + spare], found.values[:, count]
    presence = (best - left_out[:, None].clamp(min=0)) / (FADE * best).clamp(min=1e-9)
    return chosen, presence.clamp(0, 1)


def of_tiles(chosen: Int[Tensor, "K N"], presence: Float[Tensor, "K N"], corners: Int[Tensor, "T 4"]) -> Neighbours:
    """The neighbours of tiles from those of their corners, as many: those that are there most.

    Args:
        chosen, presence: as `nearest` gives them.
        corners: each tile's, among the K places.
    """
    photographs, which = chosen.unique(return_inverse=True)
    # A hardly visible presence of all that were chosen, so that they go before those that were not.
    everyone = presence.new_zeros(len(chosen), len(photographs)).scatter_(1, which, presence.clamp(min=1e-6))
    everyone = everyone[corners].transpose(1, 2)
    best = everyone.sum(-1).topk(chosen.shape[1], dim=1).indices
    return Neighbours(photographs[best], everyone.gather(1, best[..., None].expand(-1, -1, 4)))


def choose_neighbours(
    camera: Cameras,
    prior: Float[Tensor, "3 h w"],
    corner_px: Float[Tensor, "2"],
    grid: tuple[int, int],
    side_px: int,
    scene: Scene,
    count: int,
    strategy: str,
    excluded: int | None = None,
) -> Neighbours:
    """Training photographs that serve as neighbouring views of a grid of tiles, row by row.

    Args:
        camera: that shows the tiles.
        prior: its surface.
        corner_px: the grid's upper left corner.
        grid: columns and rows of tiles.
        side_px: of a tile.
        scene: whose photographs.
        count: of views at each corner; the tiles have `EXTRA_VIEWS` more, unless all places have the same.
        strategy: `TrainConfig.neighbours`.
        excluded: a photograph that may not serve.
    """
    columns, rows = grid
    places = corner_px + (pixel_grid(columns + 1, rows + 1) - 0.5) * side_px
    uv = places[:, None] + corner_px.new_tensor(SPOTS) * side_px
    surface = unproject_to_surface(camera, prior, uv.reshape(-1, 2)).reshape(*uv.shape[:2], 3)
    spare = EXTRA_VIEWS if count and strategy != "direction" else 0
    chosen, presence = _ranked(camera, surface, scene, count, spare, strategy, excluded)
    first = (torch.arange(rows)[:, None] * (columns + 1) + torch.arange(columns)).reshape(-1, 1)
    corners = first + torch.tensor([0, 1, columns + 1, columns + 2])
    return of_tiles(chosen, presence, corners)


def _ranked(
    camera: Cameras,
    surface_world: Float[Tensor, "K S 3"],
    scene: Scene,
    count: int,
    spare: int,
    strategy: str,
    excluded: int | None,
) -> tuple[Int[Tensor, "K N"], Float[Tensor, "K N"]]:
    """Training photographs that show some places best, and how far each is there (`nearest`)."""
    train = torch.tensor(scene.train)
    if strategy != "direction" and len(train) > FEW and len(surface_world) > EVERY:
        # What is best at some places is best at all that lie between: the work of ranking stays small, however many
        # photographs there are.
        some = rank_by_view(camera, surface_world[::EVERY], scene.cameras[train])
        train = train[some.topk(min(2 * (count + spare), len(train)), dim=1).indices.unique()]
    candidates = scene.cameras[train]
    if strategy == "direction":
        rank = rank_by_direction(camera, candidates).expand(len(surface_world), -1)
    else:
        rank = rank_by_view(camera, surface_world, candidates)
    out = (train == (-1 if excluded is None else excluded)).expand(len(rank), -1)
    chosen, presence = nearest(rank, out, count, spare)
    return train[chosen], presence
