"""Carve the visual hull of an object: the largest shape that agrees with all silhouettes (Laurentini, 1994).

Photographs with alpha usually come without sparse points. Their silhouettes then bound the samples: a pixel of the
background is empty all along its ray.

Alphabet: P voxels, h x w cells of a camera's pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, UInt8
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.images import Photographs
from tidefield.data.readers.posed import Observations
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.geometry.lenses import Lens

RESOLUTION, ROUNDS = 32, 3
"""Voxels along the sides of the box while it is fitted to the hull, and how many times it is."""
HALVINGS = 2
"""Subdivisions of the remaining voxels afterwards."""
SILHOUETTE_PX, MOST_SILHOUETTES = 400, 100
"""Longest side and number of the silhouettes used: larger and more ones change the hull little."""
LEAST_SEEN, LEAST_SHARE = 3, 0.3
"""A voxel must lie in the frames of so many silhouettes, and of this share of them: others are hardly constrained. Each
part of an object that is larger than the frames is in some of them only."""
STEPS_PER_VOXEL = 1.5
MOST_POINTS, FEWEST_POINTS = 2000, 20
"""Sparse points that tell an object from photographs with transparent margins: as many as are tried, and as suffice."""
MARGIN_SHARE = 0.25
"""Points of an object fall on transparent pixels of other photographs less often than this share of chance."""
_CLEAR = 128  # opacity below which a pixel is transparent


@dataclass(frozen=True)
class Hull:
    """An occupancy grid of X^3 voxels.

    Attributes:
        corner_world: lowest corner of the first voxel.
        voxel_world: side lengths of a voxel.
        filled: occupied voxels.
    """

    corner_world: Float[Tensor, "3"]
    voxel_world: Float[Tensor, "3"]
    filled: Bool[Tensor, "X X X"]

    def contains(self, points_world: Float[Tensor, "*P 3"]) -> Bool[Tensor, "*P"]:
        """Decide which points lie in the hull."""
        size = torch.tensor(self.filled.shape)
        index = ((points_world - self.corner_world) / self.voxel_world).floor().long()
        inside = ((index >= 0) & (index < size)).all(-1)
        x, y, z = index.clamp(min=0).minimum(size - 1).unbind(-1)
        return self.filled[x, y, z] & inside


def is_background(
    points: Observations,
    T_world_camera: Float64[np.ndarray, "V 3 4"],
    pinholes: Sequence[Lens],
    photographs: Photographs,
    train: Sequence[int],
) -> bool:
    """Whether transparent pixels are what lies behind an object, and not margins of photographs that show everything.

    No photograph is transparent where it has an object's point in its frame, whether or not that is hidden; behind the
    margins, by contrast, there is ground that others show. True where too few points tell.

    Args:
        points: with observations, in the world of the poses.
        pinholes: the cameras of the photographs, at their size.
        photographs: with alphas.
        train: indices of the training photographs.
    """
    used = np.unique(points.point_index)
    used = used[:: -(-len(used) // MOST_POINTS) or 1]
    row = np.full(len(points.xyz_world), -1)
    row[used] = np.arange(len(used))
    in_frame, clear = np.zeros((2, len(used), len(train)), bool)
    shown, chance = np.zeros(len(used), bool), []
    observed = points.by_photograph(len(T_world_camera))
    for k, i in enumerate(train):
        alpha = photographs.alpha(i)
        if alpha is None:
            continue
        R, centre = T_world_camera[i, :, :3], T_world_camera[i, :, 3]
        xyz = (points.xyz_world[used] - centre) @ R
        front = xyz[:, 2] > 0
        uv = np.full((len(used), 2), -1.0)
        uv[front] = pinholes[i].project(xyz[front])
        height, width = alpha.shape
        in_frame[:, k] = front & (uv >= 0).all(axis=1) & (uv < (width, height)).all(axis=1)
        u, v = uv[in_frame[:, k]].astype(np.int64).T
        is_clear = (alpha < _CLEAR).numpy()
        clear[in_frame[:, k], k] = is_clear[v, u]
        chance.append(float(is_clear.mean()))
        seen = row[points.point_index[observed[i]]]
        seen = seen[seen >= 0]
        shown[seen] |= in_frame[seen, k] & ~clear[seen, k]
    # Points that are observed on transparent pixels alone may be of what was cut off.
    if int(shown.sum()) < FEWEST_POINTS:
        return True
    return bool(clear[shown].sum() <= MARGIN_SHARE * float(np.mean(chance)) * in_frame[shown].sum())


def visual_hull(cameras: Cameras, photographs: Photographs, train: Sequence[int]) -> Hull | None:
    """Carve the hull from the alphas of the training photographs; None if it is empty or an alpha is missing.

    Args:
        cameras: of all photographs, with near and far.
        photographs: with alphas; only the training photographs' are read.
        train: indices of the training photographs.
    """
    some = train[:: -(-len(train) // MOST_SILHOUETTES)]
    alphas = [photographs.alpha(i) for i in some]
    silhouettes = [_silhouette(alpha) for alpha in alphas if alpha is not None]
    if len(silhouettes) < max(len(alphas), LEAST_SEEN):
        return None
    views = cameras[list(some)]
    middle = views.position_world + views.forward_world * views.near_far.mean(1, keepdim=True)
    widest = views.near_far.amax()
    corner, side = middle.mean(0) - widest, (2 * widest / RESOLUTION).expand(3)
    whole = _subdivide(torch.zeros(1, 3, dtype=torch.long), RESOLUTION)
    kept = _carve(whole, corner, side, views, silhouettes)
    for _ in range(ROUNDS):
        if not len(kept):
            return None
        low, high = kept.amin(0) - 1, kept.amax(0) + 2
        corner, side = corner + low * side, side * (high - low) / RESOLUTION
        kept = _carve(whole, corner, side, views, silhouettes)
    for _ in range(HALVINGS):
        side = side / 2
        kept = _carve(_subdivide(kept, 2), corner, side, views, silhouettes)
    filled = torch.zeros([RESOLUTION * 2**HALVINGS] * 3, dtype=torch.bool)
    filled[kept.unbind(-1)] = True
    return Hull(corner, side, filled) if len(kept) else None


def _subdivide(voxels: Int[Tensor, "P 3"], parts: int) -> Int[Tensor, "Q 3"]:
    """Divide each side of voxels into parts; return the indices of the smaller voxels."""
    within = torch.cartesian_prod(*[torch.arange(parts)] * 3)
    return (parts * voxels[:, None] + within).flatten(0, 1)


def _silhouette(alpha: UInt8[Tensor, "H W"]) -> Float[Tensor, "h w"]:
    """1 where a photograph shows any foreground, reduced to at most `SILHOUETTE_PX` squares along its longer side."""
    side = -(-max(alpha.shape) // SILHOUETTE_PX)
    return F.max_pool2d((alpha > 0).float()[None], side, ceil_mode=True)[0]


def _carve(
    voxels: Int[Tensor, "P 3"],
    corner: Float[Tensor, "3"],
    side: Float[Tensor, "3"],
    views: Cameras,
    silhouettes: Sequence[Float[Tensor, "_ _"]],
) -> Int[Tensor, "Q 3"]:
    """Keep the voxels that lie in enough frames, and that no photograph shows as background."""
    points = corner + (voxels + 0.5) * side
    left, seen = torch.arange(len(points)), torch.zeros(len(points), dtype=torch.long)
    for k, silhouette in enumerate(silhouettes):
        view = views[k]
        uv, z = (x[0] for x in view.project(points[left]))
        near, square = view.near_far[0, 0], -(-max(view.width, view.height) // SILHOUETTE_PX)
        inside = (z > near) & (uv >= 0).all(-1) & (uv < view.size_px).all(-1)
        # A voxel projects into a square as wide as its diagonal.
        reach = (view.focal_px.amax() * side.norm() / 2 / near / square).clamp(max=SILHOUETTE_PX).item()
        coarser = max(1, int(reach) // 3)
        around = math.ceil(reach / coarser)
        wide = F.max_pool2d(silhouette[None], coarser, ceil_mode=True)
        for across, down in ((around, 0), (0, around)):
            wide = F.max_pool2d(wide, (2 * down + 1, 2 * across + 1), 1, (down, across))
        column, row = (uv.masked_fill(~inside[:, None], 0) / (square * coarser)).long().unbind(-1)
        seen[left] += inside
        left = left[~inside | (wide[0, row, column] > 0)]
    return voxels[left[seen[left] >= max(LEAST_SEEN, LEAST_SHARE * len(silhouettes))]]


def hull_range(camera: Cameras, hull: Hull) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Intersect the rays of a camera's pixels with the hull: nearest and farthest z-depth, and whether they meet it.

    Pixels whose rays miss the hull get the range of all others; if all miss it, the camera's near and far.
    """
    width, height = camera.width, camera.height
    near, far = camera.near_far[0]
    step = hull.voxel_world.amin() / STEPS_PER_VOXEL
    ends = torch.cartesian_prod(*torch.stack([torch.zeros(3), hull.voxel_world * len(hull.filled)], -1))
    box = camera.project(hull.corner_world + ends)[1].clamp(near, far)
    depth = torch.arange(box.amin().item(), box.amax().item() + step.item(), step.item())
    ray = camera.directions_world(pixel_grid(width, height)[None])[0]
    lowest, highest = torch.full((len(ray),), torch.inf), torch.zeros(len(ray))
    for some in depth.split(16):
        inside = hull.contains(camera.position_world + ray[:, None] * some[:, None])
        lowest = torch.minimum(lowest, torch.where(inside, some, torch.inf).amin(1))
        highest = torch.maximum(highest, torch.where(inside, some, 0.0).amax(1))
    meets = (highest > 0).reshape(height, width)
    if not meets.any():
        return near.expand(height, width), far.expand(height, width), meets
    # Rays between the cells' centres get the range of the adjacent cells.
    shallow = -F.max_pool2d(-lowest.reshape(1, 1, height, width), 3, 1, 1)[0, 0] - step
    deep = F.max_pool2d(highest.reshape(1, 1, height, width), 3, 1, 1)[0, 0] + step
    around = shallow.isfinite()
    shallow = torch.where(around, shallow, shallow[around].min()).clamp(min=near)
    deep = torch.where(around, deep, deep[around].max()).clamp(max=far)
    return shallow, deep, meets
