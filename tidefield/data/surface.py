"""Estimate a camera's visible surface from the sparse points, and count the photographs that see it.

The surface decides over which pixels metrics are taken (docs/method.md, sections 12 and 13). It is the same for every
method, and independent of what a method has learned.

Depth is interpolated as inverse depth, which is affine in the pixel on any plane: linear interpolation is then exact
on flat ground at any tilt.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.images import Masks, is_used
from tidefield.data.scene import Scene, SparsePoints
from tidefield.geometry.cameras import Cameras, pixel_grid

FRAME_MARGIN = 0.3  # points up to this share of the image size outside the image shape the surface at the border
NEIGHBOURS = 16  # nearest points in the image that a point is compared with
OUTLIER_SPREADS = 12.0  # a point farther from its neighbours' median than this many spreads is occluded or mismatched
WIDEST_ANGLE_DEG = 60.0  # a point observed only from directions farther off may be occluded
PROJECTED_AT_ONCE = 500_000  # points times cameras
PIXELS_AT_ONCE = 1_000_000  # interpolating takes 50 bytes of each

_Pixels = Float64[np.ndarray, "P 2"]
_Values = Float64[np.ndarray, " P"]


def surface_depth(camera: Cameras, points: SparsePoints | None, cameras: Cameras) -> Float[Tensor, "H W"]:
    """Estimate the z-depth of the surface in every pixel of one camera, world units.

    Linear interpolation (Delaunay, in the image) of the inverse depths of all points in the camera's frustum, also
    those that it did not observe, so it works for held-out and for new cameras. Outside the points' convex hull the
    residuals to a plane through all points are extrapolated. Without points: the plane at the harmonic mean of the
    camera's near and far.

    Args:
        camera: a single camera.
        points: the scene's sparse points, or None.
        cameras: the scene's cameras, indexed by `points.camera_index`.
    """
    assert len(camera) == 1, f"one camera at a time, not {len(camera)}"
    if points is None:
        return _mean_depth(camera)
    return depth_through(camera, *trusted_points(camera, points, cameras))


def depth_through(camera: Cameras, uv: _Pixels, inverse: _Values) -> Float[Tensor, "H W"]:
    """Estimate `surface_depth` from the pixels and inverse depths that `trusted_points` returns."""
    return _interpolate(camera, uv, inverse) if len(uv) else _mean_depth(camera)


def trusted_points(camera: Cameras, points: SparsePoints, cameras: Cameras) -> tuple[_Pixels, _Values]:
    """Select the points that shape a camera's surface: their pixels, in and around the image, and inverse z-depths.

    These are the points that the camera probably sees, without outliers among their neighbours in the image.
    """
    uv, inverse = _visible(camera, points, cameras)
    if len(uv):
        keep = agree_with_neighbours(uv, inverse - _on_plane(_robust_plane(uv, inverse), uv))
        uv, inverse = uv[keep], inverse[keep]
    return uv, inverse


def surface_points(camera: Cameras, depth: Float[Tensor, "H W"]) -> Float[Tensor, "P 3"]:
    """Unproject all pixels of one camera at their z-depths into the world, row by row."""
    directions = camera.directions_world(pixel_grid(camera.width, camera.height, depth.device)[None])[0]
    return camera.position_world[0] + directions * depth.reshape(-1, 1)


def seen_count(camera: Cameras, depth: Float[Tensor, "H W"], cameras: Cameras, masks: Masks = ()) -> Int[Tensor, "H W"]:
    """Count the `cameras` that have each pixel's surface point in front of them, inside their image, and not masked."""
    points_world = surface_points(camera, depth)
    count = torch.zeros(len(points_world), dtype=torch.long, device=depth.device)
    for some in groups(len(cameras), len(points_world)):
        part = cameras[some]
        count += in_frame(part, *part.project(points_world), masks[some.start : some.stop]).sum(0)
    return count.reshape(depth.shape)


def doubly_seen(scene: Scene, camera: Cameras) -> Bool[Tensor, "H W"]:
    """Select the pixels of a camera whose surface at least two training photographs see."""
    depth = surface_depth(camera, scene.points, scene.cameras)
    masks = scene.photographs.masks_of(scene.train)
    return seen_count(camera, depth, scene.cameras[list(scene.train)], masks) >= 2


def in_frame(
    cameras: Cameras, uv_px: Float[Tensor, "V P 2"], z: Float[Tensor, "V P"], masks: Masks = ()
) -> Bool[Tensor, "V P"]:
    """Decide which projected points lie in front of each camera and inside its image, where that is not masked."""
    inside = (z > 0) & (uv_px > 0).all(-1) & (uv_px < cameras.size_px[:, None]).all(-1)
    for k, mask in enumerate(masks):
        if mask is not None:
            inside[k] &= is_used(mask, uv_px[k])
    return inside


def which_see(cameras: Cameras, points_world: Float[Tensor, "P 3"]) -> Bool[Tensor, " V"]:
    """Decide which cameras have any of some points in their frames; memory does not grow with their number."""
    parts = [cameras[some] for some in groups(len(cameras), len(points_world))]
    return torch.cat([in_frame(part, *part.project(points_world)).any(1) for part in parts])


def groups(cameras: int, points: int) -> Iterator[slice]:
    """Split cameras into groups that points are projected with at once."""
    size = max(1, PROJECTED_AT_ONCE // points)
    return (slice(start, start + size) for start in range(0, cameras, size))


def _mean_depth(camera: Cameras) -> Float[Tensor, "H W"]:
    harmonic_mean = 2 / (1 / camera.near_far[0]).sum()
    return harmonic_mean.expand(camera.height, camera.width).clone()


def _visible(camera: Cameras, points: SparsePoints, cameras: Cameras) -> tuple[_Pixels, _Values]:
    """Pixels and inverse depths of the points that the camera probably sees, in and a little outside its image."""
    uv, z = camera.project(points.xyz_world)
    margin = FRAME_MARGIN * camera.size_px[0]
    inside = (z[0] > 0) & (uv[0] > -margin).all(-1) & (uv[0] < camera.size_px[0] + margin).all(-1)
    facing = inside & _seen_from_similar_direction(camera, points, cameras, inside)
    keep = facing if facing.any() else inside
    return uv[0, keep].double().cpu().numpy(), 1 / z[0, keep].double().cpu().numpy()


def _seen_from_similar_direction(
    camera: Cameras, points: SparsePoints, cameras: Cameras, candidates: Bool[Tensor, " P"]
) -> Bool[Tensor, " P"]:
    """Which points some photograph observed within `WIDEST_ANGLE_DEG` of this camera's direction to them.

    Only the candidates are tested: in a large scene they are few.
    """
    observations = candidates[points.point_index].nonzero()[:, 0]
    which = points.point_index[observations].long()
    xyz = points.xyz_world[which]
    ours = F.normalize(xyz - camera.position_world, dim=-1)
    theirs = F.normalize(xyz - cameras.position_world[points.camera_index[observations]], dim=-1)
    cosine = (ours * theirs).sum(-1)
    # A point without observations keeps the 1.
    best = torch.ones(len(candidates), device=cosine.device, dtype=cosine.dtype)
    best = best.scatter_reduce(0, which, cosine, "amax", include_self=False)
    return best >= np.cos(np.radians(WIDEST_ANGLE_DEG))


def _interpolate(camera: Cameras, uv: _Pixels, inverse: _Values) -> Float[Tensor, "H W"]:
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
    # At most twice beyond the points' range, so that an extrapolated plane stays in front of the camera.
    result = np.clip(result, inverse.min() / 2, inverse.max() * 2)
    return torch.from_numpy(1 / result).to(camera.focal_px)


def _robust_plane(uv: _Pixels, inverse: _Values) -> Float64[np.ndarray, "3"]:
    """(a, b, c) of a u + b v + c through most of the points: reweighted least squares with Cauchy weights."""
    # Centred, so that where points do not determine the slope least squares gives the level plane through them.
    centre = uv.mean(axis=0)
    design = np.column_stack([uv - centre, np.ones(len(uv))])
    # Starting from the median, not from least squares: one far outlier would tilt the first fit.
    plane = np.array([0.0, 0.0, np.median(inverse)])
    for _ in range(10):
        error = np.abs(inverse - design @ plane)
        # The small term keeps the weights finite where the fit is exact.
        scale = 2 * np.median(error) + 1e-9 * np.abs(inverse).max()
        weight = 1 / np.sqrt(1 + (error / scale) ** 2)
        plane = np.linalg.lstsq(design * weight[:, None], inverse * weight, rcond=None)[0]
    return plane - [0, 0, plane[:2] @ centre]


def _on_plane(plane: Float64[np.ndarray, "3"], uv: _Pixels) -> _Values:
    return uv @ plane[:2] + plane[2]


def agree_with_neighbours(uv: _Pixels, residual: _Values) -> Bool[np.ndarray, " P"]:
    """Decide which points lie within `OUTLIER_SPREADS` of their neighbours' median: neither occluded nor mismatched.

    Args:
        uv: places in an image or on a map.
        residual: what is compared with that of the `NEIGHBOURS` nearest points.
    """
    from scipy.spatial import KDTree

    if len(uv) <= NEIGHBOURS:
        return np.ones(len(uv), dtype=bool)
    nearest = np.asarray(KDTree(uv).query(uv, k=NEIGHBOURS + 1)[1])
    around = residual[nearest[:, 1:]]
    median = np.median(around, axis=1)
    spread = np.median(np.abs(around - median[:, None]), axis=1)
    # Where neighbours agree by chance, the median spread of all points applies.
    return np.abs(residual - median) <= OUTLIER_SPREADS * np.maximum(spread, np.median(spread))


def _frame_pixels(width: int, height: int) -> _Pixels:
    """Points around the image, `FRAME_MARGIN` outside of it, so that every pixel lies inside the triangulation."""
    along = np.linspace(-FRAME_MARGIN, 1 + FRAME_MARGIN, 9)
    low, high = np.full_like(along, -FRAME_MARGIN), np.full_like(along, 1 + FRAME_MARGIN)
    sides = [(along, low), (along, high), (low[1:-1], along[1:-1]), (high[1:-1], along[1:-1])]
    return np.concatenate([np.column_stack(side) for side in sides]) * [width, height]


def interpolate_on_pixels(
    uv_px: Float64[np.ndarray, "P 2"], values: Float64[np.ndarray, " P"], width: int, height: int
) -> Float64[np.ndarray, "H W"]:
    """Interpolate linearly in the Delaunay triangles of points, at the centres of all pixels.

    The result is that of scipy's LinearNDInterpolator, which searches the triangle of each pixel in the mesh. Here
    triangles are scan converted, which is 3 to 10 times as fast: each marks the pixel of a row where it starts, and
    ends where the next one starts.

    Args:
        uv_px: positions of the points; their convex hull must contain all pixel centres.
        values: at the points.
        width, height: of the image.
    """
    from scipy.spatial import Delaunay

    corners = Delaunay(uv_px).simplices
    triangles = uv_px[corners]
    slope, offset = _planes(triangles, values[corners])
    u, rows = np.arange(width) + 0.5, max(1, PIXELS_AT_ONCE // width)
    result = np.empty((height, width))
    for first in range(0, height, rows):
        v = np.arange(first, min(first + rows, height))[:, None] + 0.5
        owner = _owners(triangles - [0, first], width, len(v))
        result[first : first + rows] = slope[owner, 0] * u + slope[owner, 1] * v + offset[owner]
    return result


def _owners(triangles: Float64[np.ndarray, "T 3 2"], width: int, height: int) -> Int64[np.ndarray, "H W"]:
    """Find the triangle that contains each pixel's centre.

    A row crosses a triangle if it lies at or below the uppermost corner and above the lowest one; a row through a
    corner is thus treated as if it lay slightly lower.
    """
    upper, lower = triangles[..., 1].min(1), triangles[..., 1].max(1)
    first, end = (np.ceil(x - 0.5).clip(0, height).astype(np.int64) for x in (upper, lower))
    count = (end - first).clip(min=0)
    which = np.repeat(np.arange(len(triangles)), count)
    row = np.arange(len(which)) - np.repeat(count.cumsum() - count - first, count)
    left, lean = _left_edges(triangles[which], row + 0.5)
    order = np.lexsort((lean, left, row))
    at = np.ceil(left - 0.5).clip(0, width).astype(np.int64)
    order = order[at[order] < width]
    starts = np.full(height * width, -1)
    # Of several that start before the same pixel the last one contains it.
    starts[(row * width + at)[order]] = which[order]
    latest = np.maximum.accumulate(np.where(starts >= 0, np.arange(len(starts)), 0))
    return starts[latest].reshape(height, width)


def _left_edges(triangles: Float64[np.ndarray, "K 3 2"], v: Float64[np.ndarray, " K"]) -> tuple[np.ndarray, np.ndarray]:
    """Compute where each triangle's row starts, and how far this moves from one row to the next."""
    ahead = np.roll(triangles, -1, axis=1)
    upside = (triangles[..., 1] > ahead[..., 1])[..., None]
    above, below = np.where(upside, ahead, triangles), np.where(upside, triangles, ahead)
    crossed = (above[..., 1] <= v[:, None]) & (v[:, None] < below[..., 1])
    rise = np.where(crossed, below[..., 1] - above[..., 1], 1.0)
    lean = (below[..., 0] - above[..., 0]) / rise
    u = np.where(crossed, above[..., 0] + (v[:, None] - above[..., 1]) * lean, np.inf)
    left = u.min(1)
    return left, np.where(u == left[:, None], lean, np.inf).min(1)


def _planes(
    triangles: Float64[np.ndarray, "T 3 2"], values: Float64[np.ndarray, "T 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Fit planes through the triangles' values: slopes (T x 2) and offsets (T)."""
    first, second = (triangles[:, k] - triangles[:, 0] for k in (1, 2))
    rise, other = values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    across = np.stack([rise * second[:, 1] - other * first[:, 1], other * first[:, 0] - rise * second[:, 0]], axis=1)
    # A triangle without area contains no pixel.
    slope = across / np.where(area == 0, 1.0, area)[:, None]
    return slope, values[:, 0] - (slope * triangles[:, 0]).sum(1)
