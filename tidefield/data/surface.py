"""The visible surface of a camera, from the sparse points alone, and which photographs see it.

The same for every method: it says which pixels a metric is taken over (method.md, sections 12 and 13), so nothing a
method has learned may enter.

Depth is interpolated as inverse depth, which is affine in the pixel on any plane: linear interpolation is then exact
on flat ground, whatever the tilt.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from tidefield.data.scene import Scene, SparsePoints
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.geometry.scattered import interpolate_on_pixels

FRAME_MARGIN = 0.3  # points this share of the image beyond its border still shape the surface at the border
NEIGHBOURS = 16  # image neighbours that a point is compared with
OUTLIER_SPREADS = 12.0  # farther from its neighbours than so many of their spreads, a point is occluded or wrong
WIDEST_ANGLE_DEG = 60.0  # a point that was seen only from directions farther off may be hidden from here


def surface_depth(camera: Cameras, points: SparsePoints | None, cameras: Cameras) -> Float[Tensor, "H W"]:
    """z-depth of the surface in every pixel of one camera, world units.

    Linear interpolation (Delaunay, in the image) of the inverse depths of the points in the camera's frustum, whoever
    observed them, so it works for held-out and for new cameras. Outside the points' hull the residuals to a plane
    through all points continue. Without points: the plane at the harmonic middle of the camera's near and far.

    Args:
        camera: the one camera to look from.
        points: the scene's sparse points, or None.
        cameras: the scene's cameras, which `points.camera_index` counts in.
    """
    assert len(camera) == 1, f"one camera at a time, not {len(camera)}"
    if points is None:
        return _middle_depth(camera)
    return depth_through(camera, *trusted_points(camera, points, cameras))


def depth_through(camera: Cameras, uv: NDArray, inverse: NDArray) -> Float[Tensor, "H W"]:
    """`surface_depth` where its points are known already, as `trusted_points` gives them."""
    return _interpolate(camera, uv, inverse) if len(uv) else _middle_depth(camera)


def trusted_points(camera: Cameras, points: SparsePoints, cameras: Cameras) -> tuple[NDArray, NDArray]:
    """Pixels (P x 2) and inverse z-depths (P) of the points that shape a camera's surface, on and around its image.

    Those that it probably sees, without those that stand apart from all their neighbours in the image.
    """
    uv, inverse = _visible(camera, points, cameras)
    if len(uv):
        keep = _agree_with_neighbours(uv, inverse - _on_plane(_robust_plane(uv, inverse), uv))
        uv, inverse = uv[keep], inverse[keep]
    return uv, inverse


def surface_points(camera: Cameras, depth: Float[Tensor, "H W"]) -> Float[Tensor, "P 3"]:
    """World positions of all pixels of one camera at their z-depths, row by row."""
    directions = camera.directions_world(pixel_grid(camera.width, camera.height, depth.device)[None])[0]
    return camera.position_world[0] + directions * depth.reshape(-1, 1)


def seen_count(camera: Cameras, depth: Float[Tensor, "H W"], cameras: Cameras) -> Int[Tensor, "H W"]:
    """How many of `cameras` have each pixel's surface point in front of them and inside their frame."""
    points_world = surface_points(camera, depth)
    count = torch.zeros(len(points_world), dtype=torch.long, device=depth.device)
    for i in range(len(cameras)):
        uv, z = cameras[i].project(points_world)
        count += in_frame(cameras[i], uv, z)[0]
    return count.reshape(depth.shape)


def doubly_seen(scene: Scene, camera: Cameras) -> Bool[Tensor, "H W"]:
    """The pixels of a camera whose surface at least two training photographs see: what can be known of its view."""
    depth = surface_depth(camera, scene.points, scene.cameras)
    return seen_count(camera, depth, scene.cameras[list(scene.train)]) >= 2


def in_frame(cameras: Cameras, uv_px: Float[Tensor, "V P 2"], z: Float[Tensor, "V P"]) -> Bool[Tensor, "V P"]:
    """Whether projected points lie in front of each camera and inside its image."""
    return (z > 0) & (uv_px > 0).all(-1) & (uv_px < cameras.size_px[:, None]).all(-1)


def _middle_depth(camera: Cameras) -> Float[Tensor, "H W"]:
    middle = 2 / (1 / camera.near_far[0]).sum()
    return middle.expand(camera.height, camera.width).clone()


def _visible(camera: Cameras, points: SparsePoints, cameras: Cameras) -> tuple[NDArray, NDArray]:
    """Pixels and inverse depths of the points that the camera probably sees, on and a little beyond its image."""
    uv, z = camera.project(points.xyz_world)
    margin = FRAME_MARGIN * camera.size_px[0]
    inside = (z[0] > 0) & (uv[0] > -margin).all(-1) & (uv[0] < camera.size_px[0] + margin).all(-1)
    facing = inside & _seen_from_similar_direction(camera, points, cameras, inside)
    keep = facing if facing.any() else inside
    return uv[0, keep].double().cpu().numpy(), 1 / z[0, keep].double().cpu().numpy()


def _seen_from_similar_direction(
    camera: Cameras, points: SparsePoints, cameras: Cameras, asked: Bool[Tensor, " P"]
) -> Bool[Tensor, " P"]:
    """Whether some photograph observed a point from within `WIDEST_ANGLE_DEG` of this camera's direction to it; only
    the points that are asked for are looked at, which are few in a large scene."""

    def towards(position_world: Tensor, xyz: Tensor) -> Tensor:
        return torch.nn.functional.normalize(xyz - position_world, dim=-1)

    observations = asked[points.point_index].nonzero()[:, 0]
    which = points.point_index[observations].long()
    xyz = points.xyz_world[which]
    theirs = towards(cameras.position_world[points.camera_index[observations]], xyz)
    cosine = (towards(camera.position_world, xyz) * theirs).sum(-1)
    # A point without observations keeps the start value: nothing speaks against it.
    best = torch.ones(len(asked), device=cosine.device, dtype=cosine.dtype)
    best = best.scatter_reduce(0, which, cosine, "amax", include_self=False)
    return best >= np.cos(np.radians(WIDEST_ANGLE_DEG))


def _interpolate(camera: Cameras, uv: NDArray, inverse: NDArray) -> Float[Tensor, "H W"]:
    from scipy.spatial import KDTree

    width, height = camera.width, camera.height
    plane = _robust_plane(uv, inverse)
    residual = inverse - _on_plane(plane, uv)
    frame = _frame_pixels(width, height)
    nearest = np.asarray(KDTree(uv).query(frame, k=min(NEIGHBOURS, len(uv)))[1]).reshape(len(frame), -1)
    uv = np.concatenate([uv, frame])
    residual = np.concatenate([residual, np.median(residual[nearest], axis=1)])
    on_plane = _on_plane(plane, pixel_grid(width, height).double().numpy()).reshape(height, width)
    result = interpolate_on_pixels(uv, residual, width, height) + on_plane
    # Twice beyond what the points show: keeps an extrapolated plane in front of the camera.
    result = np.clip(result, inverse.min() / 2, inverse.max() * 2)
    return torch.from_numpy(1 / result).to(camera.focal_px)


def _robust_plane(uv: NDArray, inverse: NDArray) -> NDArray:
    """(a, b, c) of a u + b v + c through most of the points: reweighted least squares with Cauchy weights."""
    # Centred, so that where points do not determine the slope least squares gives the level plane through them.
    centre = uv.mean(axis=0)
    design = np.column_stack([uv - centre, np.ones(len(uv))])
    # Starting from the median, not from least squares: one far outlier would tilt the first fit.
    plane = np.array([0.0, 0.0, np.median(inverse)])
    for _ in range(10):
        error = np.abs(inverse - design @ plane)
        # The small share of the depth keeps the weights finite where the fit is already exact.
        scale = 2 * np.median(error) + 1e-9 * np.abs(inverse).max()
        weight = 1 / np.sqrt(1 + (error / scale) ** 2)
        plane = np.linalg.lstsq(design * weight[:, None], inverse * weight, rcond=None)[0]
    return plane - [0, 0, plane[:2] @ centre]


def _on_plane(plane: NDArray, uv: NDArray) -> NDArray:
    return uv @ plane[:2] + plane[2]


def _agree_with_neighbours(uv: NDArray, residual: NDArray) -> NDArray:
    """Which points lie within `OUTLIER_SPREADS` of their image neighbours' median: neither occluded nor mismatched."""
    from scipy.spatial import KDTree

    if len(uv) <= NEIGHBOURS:
        return np.ones(len(uv), dtype=bool)
    nearest = np.asarray(KDTree(uv).query(uv, k=NEIGHBOURS + 1)[1])
    around = residual[nearest[:, 1:]]
    median = np.median(around, axis=1)
    spread = np.median(np.abs(around - median[:, None]), axis=1)
    # Where neighbours agree by chance, the image's typical spread still allows a point its own opinion.
    return np.abs(residual - median) <= OUTLIER_SPREADS * np.maximum(spread, np.median(spread))


def _frame_pixels(width: int, height: int) -> NDArray:
    """Points around the image, `FRAME_MARGIN` beyond it, so that every pixel lies inside the triangulation."""
    along = np.linspace(-FRAME_MARGIN, 1 + FRAME_MARGIN, 9)
    low, high = np.full_like(along, -FRAME_MARGIN), np.full_like(along, 1 + FRAME_MARGIN)
    sides = [(along, low), (along, high), (low[1:-1], along[1:-1]), (high[1:-1], along[1:-1])]
    return np.concatenate([np.column_stack(side) for side in sides]) * [width, height]
