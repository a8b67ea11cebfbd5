"""Estimate the near and far z-depths of cameras."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from tidefield.data.readers.posed import Observations
from tidefield.geometry.cameras import intersect_axes
from tidefield.geometry.lenses import Lens

# A camera's range is [0.5 x 1st, 1.4 x 99th percentile] of the depths of its sparse points. Over flat ground seen from
# 60 m that leaves 30 m for trees whose tops were not matched, and 24 m for holes. In disparity, in which samples are
# spaced, three quarters of that range lie above the ground; percentiles are robust to outliers.
_NEAREST, _FARTHEST = 0.5, 1.4
_FEWEST_POINTS = 50  # for a 1st and a 99th percentile that one outlier does not decide


def estimate_near_far(
    T_world_camera: Float64[np.ndarray, "V 3 4"], pinholes: tuple[Lens, ...], points: Observations | None
) -> Float64[np.ndarray, "V 2"]:
    """Estimate ranges from the points that each camera observed, or from the cameras alone if there are too few.

    Cameras with few of them take all points in their frustum; where these are few too, the widest range of any camera.
    """
    if points is None:
        return _from_cameras(T_world_camera)
    ranges = with_widest(ranges_of_points(T_world_camera, pinholes, points))
    return _from_cameras(T_world_camera) if ranges is None else ranges


def ranges_of_points(
    T_world_camera: Float64[np.ndarray, "V 3 4"], pinholes: tuple[Lens, ...], points: Observations
) -> Float64[np.ndarray, "V 2"]:
    """Estimate ranges from the points that each camera observed, or has in its frustum; NaN where these are too few."""
    ranges = np.full((len(T_world_camera), 2), np.nan)
    observations = points.by_photograph(len(ranges))
    for i, (pose, pinhole) in enumerate(zip(T_world_camera, pinholes, strict=True)):
        depth = (points.xyz_world[points.point_index[observations[i]]] - pose[:, 3]) @ pose[:, 2]
        depth = depth[depth > 0]
        if len(depth) < _FEWEST_POINTS:
            depth = np.concatenate([depth, _depths_in_frustum(pose, pinhole, points.xyz_world)])
        if len(depth) >= _FEWEST_POINTS:
            nearest, farthest = np.percentile(depth, [1, 99])
            ranges[i] = _NEAREST * nearest, _FARTHEST * farthest
    return ranges


def with_widest(ranges: Float64[np.ndarray, "V 2"]) -> Float64[np.ndarray, "V 2"] | None:
    """Give cameras without a range (NaN) the widest of any; None where none has one."""
    valid = np.isfinite(ranges[:, 0])
    if not valid.any():
        return None
    widest = ranges[valid, 0].min(), ranges[valid, 1].max()
    return np.where(valid[:, None], ranges, widest)


def _from_cameras(T_world_camera: Float64[np.ndarray, "V 3 4"]) -> Float64[np.ndarray, "V 2"]:
    """Estimate ranges from the cameras alone.

    Cameras with a common focus (the point nearest to all optical axes, in front of nearly all of them) get a tenth to
    four times their distance to it. For others, such as a survey flown in strips, the distance b between neighbouring
    photographs gives the scale: they overlap by half or more, so the ground is farther than b / 2; and it is nearer
    than 100 b.
    """
    position, forward = T_world_camera[:, :, 3], T_world_camera[:, :, 2]
    spread = np.linalg.norm(position - position.mean(axis=0), axis=1).max()
    focus = intersect_axes(position, forward)
    if focus is not None:
        depth = ((focus - position) * forward).sum(axis=1)
        if np.mean(depth > 0.1 * spread) > 0.9:
            depth = np.maximum(depth, 0.1 * spread)
            return np.stack([0.1 * depth, 4 * depth], axis=1)
    apart, _ = KDTree(position).query(position, k=2)
    # Cameras at one position (a panorama) have no scale; any range serves.
    neighbour = float(np.median(apart[:, 1])) or spread or 1.0
    return np.tile([0.5 * neighbour, max(100 * neighbour, 2 * spread)], (len(position), 1))


def _depths_in_frustum(
    pose: Float64[np.ndarray, "3 4"], pinhole: Lens, xyz_world: Float64[np.ndarray, "P 3"]
) -> Float64[np.ndarray, " _"]:
    """The z-depths of the points in a camera's frustum."""
    xyz = (xyz_world - pose[:, 3]) @ pose[:, :3]
    front = xyz[:, 2] > 0
    uv = pinhole.project(np.where(front[:, None], xyz, 1.0))
    return xyz[front & (uv >= 0).all(axis=1) & (uv <= (pinhole.width, pinhole.height)).all(axis=1), 2]
