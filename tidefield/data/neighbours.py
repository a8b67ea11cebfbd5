"""Choose the neighbouring views of tiles (the paper, "System overview"; docs/method.md, section 1).

Views are chosen at the corners of tiles and their weights are interpolated in between: adjacent tiles, which may read
different photographs, then show the same along their border.

Alphabet: K tile corners, T tiles, V candidate photographs, S surface points per corner, N neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.depth_prior import unproject_to_surface
from tidefield.data.images import Masks, is_used
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras, angle_between, pixel_grid

FADE = 0.04
"""A view has the full weight when its rank exceeds that of the first view left out by this share of its own rank."""
BORDER = 0.05
"""Share of the image width over which a view's weight falls to 0 at the border."""
ANGLE_SCALE_RAD = 0.35
"""Angle at which the rank of a view falls to 1 / e."""

PRESELECT_ABOVE, PRESELECT_STEP = 64, 7
"""With more training photographs than this, only the best of every so many corners are ranked for all corners."""
EXTRA_VIEWS = 1
"""Views of a tile beyond those of each corner, so that the views can change from one corner to another."""
SURFACE_OFFSETS = ((0.0, 0.0), (-0.4, -0.4), (0.4, -0.4), (-0.4, 0.4), (0.4, 0.4))
"""Where around a tile corner the surface is sampled, in tile sides."""


@dataclass(frozen=True)
class Neighbours:
    """The neighbouring views of T tiles, best first.

    Attributes:
        index: photographs.
        blend_weight: of each, 0 to 1, at the tile's corners: upper left and right, then lower left and right.
    """

    index: Int[Tensor, "T N"]
    blend_weight: Float[Tensor, "T N 4"]

    def __getitem__(self, tiles: Tensor | slice) -> Neighbours:
        return Neighbours(self.index[tiles], self.blend_weight[tiles])


def rank_by_view(
    targets: Cameras, surface_world: Float[Tensor, "K S 3"], candidates: Cameras, masks: Masks = ()
) -> Float[Tensor, "K V"]:
    """Rank candidates by the share of a target's surface points in their frames and not masked, times
    exp(-angle / scale).

    The angle is the mean one at the surface points between the target's and the candidate's rays. Unlike the viewing
    directions, it distinguishes nadir photographs.
    """
    corners, points = surface_world.shape[:2]
    uv, z = candidates.project(surface_world.reshape(-1, 3))
    weight = from_border(uv, candidates.size_px[:, None], BORDER) * (z > 0)
    for k, mask in enumerate(masks):
        if mask is not None:
            weight[k] *= is_used(mask, uv[k])
    share = weight.reshape(-1, corners, points).mean(-1).T
    ours = F.normalize(surface_world - targets.position_world[:, None], dim=-1)
    theirs = F.normalize(surface_world[:, None] - candidates.position_world[None, :, None], dim=-1)
    angle = angle_between(ours[:, None], theirs)
    return share * torch.exp(-angle.mean(-1) / ANGLE_SCALE_RAD)


def from_border(uv_px: Float[Tensor, "*B 2"], size_px: Tensor, share: float) -> Float[Tensor, "*B"]:
    """Weight pixels by their distance from the image border: 0 at and beyond it, 1 inside, linear in between.

    With this weight views appear and disappear continuously, and borders of photographs leave no edges.

    Args:
        size_px: width and height, to go with `uv_px`.
        share: of the image width over which the weight falls.
    """
    return (torch.minimum(uv_px, size_px - uv_px).amin(-1) / (share * size_px[..., 0])).clamp(0, 1)


def rank_by_direction(targets: Cameras, candidates: Cameras) -> Float[Tensor, "K V"]:
    """Rank candidates as the paper does: by the cosine between the viewing directions, mapped to [0, 1]."""
    return (targets.forward_world @ candidates.forward_world.T + 1) / 2


def select_best(
    rank: Float[Tensor, "K V"], count: int, spare: int = 0
) -> tuple[Int[Tensor, "K N"], Float[Tensor, "K N"]]:
    """Select the best-ranked candidates at each corner, best first; fewer where there are not as many.

    Args:
        count: of candidates with a weight above 0.
        spare: how many more follow with the weight 0.

    Returns:
        The candidates and their blend weights, 0 to 1. The weight of a candidate falls to 0 before a better one takes
        its place, so that the views change continuously.
    """
    candidates = rank.shape[1]
    found = rank.topk(min(count + max(spare, 1), candidates), dim=1)
    if candidates <= count:
        return found.indices, torch.ones_like(found.values)
    chosen, best, left_out = found.indices[:, : count + spare], found.values[:, : count + spare], found.values[:, count]
    blend_weight = (best - left_out[:, None].clamp(min=0)) / (FADE * best).clamp(min=1e-9)
    return chosen, blend_weight.clamp(0, 1)


def choose_neighbours(
    camera: Cameras,
    prior: Float[Tensor, "3 h w"],
    corner_px: Float[Tensor, "2"],
    grid: tuple[int, int],
    side_px: int,
    scene: Scene,
    count: int,
    strategy: str,
) -> Neighbours:
    """Choose among the sources of a camera's view (`Scene.sources`) the neighbours of a grid of tiles, row by row.

    Args:
        camera: of the tiles.
        prior: the camera's depth prior.
        corner_px: the grid's upper left corner.
        grid: columns and rows of tiles.
        side_px: of a tile.
        scene: of the photographs.
        count: of views at each corner; the tiles have `EXTRA_VIEWS` more, unless all corners have the same.
        strategy: `TrainConfig.neighbours`.
    """
    columns, rows = grid
    corners_px = corner_px + (pixel_grid(columns + 1, rows + 1) - 0.5) * side_px
    uv = corners_px[:, None] + corner_px.new_tensor(SURFACE_OFFSETS) * side_px
    surface = unproject_to_surface(camera, prior, uv.reshape(-1, 2)).reshape(*uv.shape[:2], 3)
    by_direction = strategy == "direction"
    spare = EXTRA_VIEWS if count and not by_direction else 0
    sources, masks_of = torch.tensor(scene.sources(camera), dtype=torch.long), scene.photographs.masks_of
    if not by_direction and len(sources) > PRESELECT_ABOVE and len(surface) > PRESELECT_STEP:
        # The best at some corners are the best at those in between: the cost stays bounded in large scenes.
        some = rank_by_view(camera, surface[::PRESELECT_STEP], scene.cameras[sources], masks_of(sources.tolist()))
        sources = sources[some.topk(min(2 * (count + spare), len(sources)), dim=1).indices.unique()]
    candidates = scene.cameras[sources]
    if by_direction:
        rank = rank_by_direction(camera, candidates).expand(len(surface), -1)
    else:
        rank = rank_by_view(camera, surface, candidates, masks_of(sources.tolist()))
    chosen, blend_weight = select_best(rank, count, spare)
    first = (torch.arange(rows)[:, None] * (columns + 1) + torch.arange(columns)).reshape(-1, 1)
    return _combine_corners(sources[chosen], blend_weight, first + torch.tensor([0, 1, columns + 1, columns + 2]))


def _combine_corners(
    chosen: Int[Tensor, "K N"], blend_weight: Float[Tensor, "K N"], corners: Int[Tensor, "T 4"]
) -> Neighbours:
    """As many neighbours of each tile as of a corner: those with the largest sum of weights at its four corners."""
    photographs, which = chosen.unique(return_inverse=True)
    # A negligible weight for all that were chosen, so that they precede those that were not.
    table = blend_weight.new_zeros(len(chosen), len(photographs)).scatter_(1, which, blend_weight.clamp(min=1e-6))
    table = table[corners].transpose(1, 2)
    best = table.sum(-1).topk(chosen.shape[1], dim=1).indices
    return Neighbours(photographs[best], table.gather(1, best[..., None].expand(-1, -1, 4)))
