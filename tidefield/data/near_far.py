"""How near and how far from each camera the scene may lie, as z-depths."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree

from tidefield.data.readers.posed import Observations
from tidefield.geometry.lenses import Lens
from tidefield.geometry.rays import intersect_axes

# A camera's range is [0.5 x 1st, 1.4 x 99th percentile] of the depths of its sparse points. Over flat ground seen from
# 60 m that leaves 30 m for trees whose tops were not matched, and 24 m for holes. In disparity, in which samples are
# spread, three quarters of that range lie above the ground; percentiles keep stray points from stretching it.
_NEAREST, _FARTHEST = 0.5, 1.4
_POINTS_ENOUGH = 50


def near_far_from_points(
    T_world_camera: Float64[np.ndarray, "V 3 4"], pinholes: tuple[Lens, ...], points: Observations
) -> Float64[np.ndarray, "V 2"]:
    """Ranges from the points that each camera saw; where these are few, from all points in its frustum; where even
    these are few, the widest range of any camera."""
    ranges = np.full((len(T_world_camera), 2), np.nan)
    observations = points.by_photograph(len(ranges))
    for i, (pose, pinhole) in enumerate(zip(T_world_camera, pinholes, strict=True)):
        depth = _depth(pose, points.xyz_world[points.point_index[observations[i]]])
        depth = depth[depth > 0]
        if len(depth) < _POINTS_ENOUGH:
            inside, all_depths = _frustum(pose, pinhole, points.xyz_world)
            depth = np.concatenate([depth, all_depths[inside]])
        if len(depth) >= _POINTS_ENOUGH:
            nearest, farthest = np.percentile(depth, [1, 99])
            ranges[i] = _NEAREST * nearest, _FARTHEST * farthest
    known = np.isfinite(ranges[:, 0])
    if not known.any():
        return near_far_from_cameras(T_world_camera)
    ranges[~known] = ranges[known, 0].min(), ranges[known, 1].max()
    return ranges


def near_far_from_cameras(T_world_camera: Float64[np.ndarray, "V 3 4"]) -> Float64[np.ndarray, "V 2"]:
    """Ranges where nothing is known but the cameras.

    Cameras that look at a common point (the one nearest to all optical axes, in front of nearly all of them) see from a
    tenth of the way to it to four times as far. For others, a survey flown in strips, the distance b between
    neighbouring photographs tells the scale: they overlap by half or more, so the ground is farther than b / 2,
    and it is nearer than 100 b.
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
    # Cameras in one place (a panorama) have no scale at all; any range serves.
    neighbour = float(np.median(apart[:, 1])) or spread or 1.0
    return np.tile([0.5 * neighbour, max(100 * neighbour, 2 * spread)], (len(position), 1))


def near_far_from_cloud(
    T_world_camera: Float64[np.ndarray, "V 3 4"], pinholes: tuple[Lens, ...], cloud_world: Float64[np.ndarray, "P 3"]
) -> Float64[np.ndarray, "V 2"]:
    """Ranges from points of which nobody knows who saw them."""
    nobody = np.zeros(0, dtype=np.int64)
    return near_far_from_points(T_world_camera, pinholes, Observations(cloud_world, nobody, nobody, np.zeros((0, 2))))


def _depth(pose: Float64[np.ndarray, "3 4"], xyz_world: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, " P"]:
    return (xyz_world - pose[:, 3]) @ pose[:, 2]


def _frustum(
    pose: Float64[np.ndarray, "3 4"], pinhole: Lens, xyz_world: Float64[np.ndarray, "P 3"]
) -> tuple[Bool[np.ndarray, " P"], Float64[np.ndarray, " P"]]:
    xyz = (xyz_world - pose[:, 3]) @ pose[:, :3]
    front = xyz[:, 2] > 0
    uv = pinhole.project(np.where(front[:, None], xyz, 1.0))
    return front & (uv >= 0).all(axis=1) & (uv <= (pinhole.width, pinhole.height)).all(axis=1), xyz[:, 2]
