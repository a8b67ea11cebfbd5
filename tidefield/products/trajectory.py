"""Camera paths for videos: through the photographs, an orbit, a nadir strip, or a viewer's file.

Every path stays where the photographs were taken from, because a view is only as good as its neighbours. Focal length
and near and far come from the training cameras; all frames are at the scene's common exposure (gain 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from tidefield.data.near_far import near_far_from_cloud
from tidefield.data.scene import Scene
from tidefield.errors import TidefieldError
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.lenses import Lens
from tidefield.products.layout import Layout, layout_of
from tidefield.products.viewer_path import ViewerPath, read_viewer_path

Array = NDArray[np.float64]

FRAMES_PER_SECOND = 24.0
STEEPEST = np.radians(30)
"""How far from straight down an orbit over a nadir survey looks: farther, and no photograph saw it so."""
SAMPLES_PER_KEY = 32
POINTS_ENOUGH = 20_000
"""Sparse points that a frame's near and far are taken from, at most."""
TANGENT_WINDOW = 0.3
"""Standard deviation of the smoothing of orientations, in key frames: rounds the corners of slerp at the keys."""


@dataclass(frozen=True)
class Trajectory:
    """Cameras of the frames of a video, in order, all of one size."""

    cameras: Cameras
    frames_per_second: float


def make_trajectory(
    path: str, scene: Scene, *, frames: int, width: int, height: int, frames_per_second: float = FRAMES_PER_SECOND
) -> Trajectory:
    """The path that a user named.

    Args:
        path: `cameras`, `orbit`, `strip`, or a camera-path JSON as nerfstudio's viewer exports it.
        frames: how many; a JSON brings its own frames, size and speed, and these arguments are not used then.

    Raises:
        TidefieldError: the name is none of these, or the file cannot be read as a camera path.
    """
    makers = {"cameras": through_cameras, "orbit": orbit, "strip": strip}
    if path in makers:
        return Trajectory(makers[path](scene, frames, width, height), frames_per_second)
    if Path(path).suffix.lower() != ".json":
        raise TidefieldError(f"no camera path is called {path!r}: expected {', '.join(makers)} or a .json file")
    return from_viewer(read_viewer_path(Path(path), scene.root), scene)


def through_cameras(scene: Scene, frames: int, width: int, height: int) -> Cameras:
    """A smooth flight through the training cameras, in the order of their names where that is no detour.

    Positions lie on a centripetal Catmull-Rom spline, orientations are slerped and smoothed. The speed is constant in
    what the eye sees of it: the angle that a point at the usual distance moves through, by travel or by turning.
    """
    layout = layout_of(scene)
    order = _tour(layout)
    position, rotation = _spline(layout.position[order], layout.rotation[order])
    travelled = np.concatenate([[0.0], np.cumsum(_apparent(position, rotation, layout.distance))])
    at = np.interp(np.linspace(0, travelled[-1], frames), travelled, np.arange(len(travelled)))
    step = np.arange(len(travelled))
    between = np.stack([np.interp(at, step, p) for p in position.T], 1)
    return _cameras(scene, between, Slerp(step, Rotation.from_matrix(rotation))(at).as_matrix(), width, height)


def orbit(scene: Scene, frames: int, width: int, height: int) -> Cameras:
    """Around the middle of what was photographed, looking at it; closed, so that the video can loop.

    Over a survey: at the flight's height, within the flight lines, at most 30 degrees off straight down. Around an
    object: at the cameras' own distance and height, back and forth where they saw only a part of the round. Before a
    motif: an ellipse within the cameras' own positions.
    """
    layout = layout_of(scene)
    turn = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    if layout.kind == "facing":
        right = np.cross(layout.forward, layout.up)
        right /= np.linalg.norm(right)
        upward = np.cross(right, layout.forward)
        position = (
            layout.position.mean(0)
            + 0.7 * layout.half_extent(right) * np.cos(turn)[:, None] * right
            + 0.7 * layout.half_extent(upward) * np.sin(turn)[:, None] * upward
        )
    else:
        first, second = _horizontal_axes(layout)
        away = layout.position - layout.centre
        height_above = float(np.median(away @ layout.up))
        if layout.kind == "around":
            azimuth = np.arctan2(away @ second, away @ first)
            radius = float(np.median(np.hypot(away @ first, away @ second)))
            turn = _within_azimuths(turn, azimuth)
        else:
            narrow = min(layout.half_extent(first), layout.half_extent(second))
            # Not less than 0.1: directly above the centre, "up" in the picture would be undefined.
            radius = abs(height_above) * np.clip(narrow / max(abs(height_above), 1e-9), 0.1, np.tan(STEEPEST))
        around = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
        position = layout.centre + radius * around + height_above * layout.up
    rotation = _looking(layout.centre - position, np.broadcast_to(layout.up, position.shape))
    return _cameras(scene, position, rotation, width, height)


def strip(scene: Scene, frames: int, width: int, height: int) -> Cameras:
    """Straight along the long axis of the survey at its mean height, looking straight down, ahead being up.

    Before a motif (all photographs face one wall) the strip looks the way that the photographs do.
    """
    layout = layout_of(scene)
    if layout.kind == "facing":
        axis, side, up, look = *_long_axes(layout, layout.forward), layout.up, layout.forward
        half, middle = layout.half_extent(axis), layout.position.mean(0)
    else:
        axis, side = _horizontal_axes(layout)
        up, look = axis, -layout.up
        if layout.kind == "around":
            half, middle = layout.distance / 2, layout.centre + layout.distance * layout.up
        else:
            half = layout.half_extent(axis)
            ends = np.percentile(layout.position @ axis, [5, 95]).mean()
            middle = ends * axis + np.median(layout.position @ side) * side
            middle = middle + (layout.position @ layout.up).mean() * layout.up
    position = middle + np.linspace(-half, half, frames)[:, None] * axis
    rotation = _looking(np.broadcast_to(look, position.shape), np.broadcast_to(up, position.shape))
    return _cameras(scene, position, rotation, width, height)


def from_viewer(path: ViewerPath, scene: Scene) -> Trajectory:
    """The frames of a viewer's file in the scene's own coordinates."""
    position = path.position - scene.origin_world.double().cpu().numpy()
    cameras = _cameras(scene, position, path.rotation, path.width, path.height, path.focal_px)
    return Trajectory(cameras, path.frames_per_second or FRAMES_PER_SECOND)


def _spline(position: Array, rotation: Array) -> tuple[Array, Array]:
    """Dense samples of a smooth curve through N poses, SAMPLES_PER_KEY for each step."""
    if len(position) == 1:
        return position, rotation
    chord = np.linalg.norm(np.diff(position, axis=0), axis=1)
    # Centripetal: knots by the root of the distance, which keeps close keys from making loops. The floor keeps
    # knots apart where the camera only turned.
    knot = np.concatenate([[0.0], np.cumsum(np.sqrt(np.maximum(chord, 1e-3 * chord.mean() + 1e-9)))])
    slope = np.diff(position, axis=0) / np.diff(knot)[:, None]
    if len(position) > 2:
        share = (np.diff(knot)[:-1] / (knot[2:] - knot[:-2]))[:, None]
        inner = slope[:-1] * (1 - share) + slope[1:] * share
        slope = np.concatenate([slope[:1], inner, slope[-1:]])
    else:
        slope = np.repeat(slope, 2, axis=0)
    at = np.interp(np.arange((len(knot) - 1) * SAMPLES_PER_KEY + 1) / SAMPLES_PER_KEY, np.arange(len(knot)), knot)
    quaternion = Slerp(knot, Rotation.from_matrix(rotation))(at).as_quat()
    # q and -q turn alike: make neighbours the near ones before averaging.
    sign = np.cumprod(np.where((quaternion[1:] * quaternion[:-1]).sum(1) < 0, -1.0, 1.0))
    quaternion[1:] *= sign[:, None]
    smooth = gaussian_filter1d(quaternion, TANGENT_WINDOW * SAMPLES_PER_KEY, axis=0, mode="nearest")
    return CubicHermiteSpline(knot, position, slope)(at), Rotation.from_quat(smooth).as_matrix()


def _apparent(position: Array, rotation: Array, distance: float) -> Array:
    """How far the picture moves from each pose to the next, as an angle in radians."""
    turned = Rotation.from_matrix(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]).magnitude()
    return np.hypot(np.linalg.norm(np.diff(position, axis=0), axis=1) / distance, turned)


def _tour(layout: Layout) -> NDArray[np.int64]:
    """Order of the cameras: as they are named, or a short tour where the names lead to and fro (Blender's do)."""
    count = len(layout.position)
    away = np.linalg.norm(layout.position[:, None] - layout.position[None], axis=2) / layout.distance
    named = np.arange(count, dtype=np.int64)
    tour = _shorten(_nearest_next(away), away)
    lengths = [away[order[:-1], order[1:]].sum() for order in (named, tour)]
    return tour if lengths[1] < 0.4 * lengths[0] else named


def _nearest_next(away: Array) -> NDArray[np.int64]:
    """From one end, always on to the nearest camera that is left."""
    left = np.ones(len(away), dtype=bool)
    order = [int(away.sum(1).argmax())]
    left[order[0]] = False
    while left.any():
        order.append(int(np.where(left, away[order[-1]], np.inf).argmin()))
        left[order[-1]] = False
    return np.array(order, dtype=np.int64)


def _shorten(order: NDArray[np.int64], away: Array) -> NDArray[np.int64]:
    """Reverse stretches of an open tour as long as that shortens it (2-opt), within a bounded number of sweeps."""
    for _ in range(10):
        before = order.copy()
        for i in range(len(order) - 2):
            a, b, c, d = order[i], order[i + 1], order[i + 2 : -1], order[i + 3 :]
            gain = away[a, b] + away[c, d] - away[a, c] - away[b, d]
            if len(gain) and gain.max() > 1e-9:
                end = i + 2 + int(gain.argmax())
                order[i + 1 : end + 1] = order[i + 1 : end + 1][::-1]
        if (order == before).all():
            break
    return order


def _within_azimuths(turn: Array, azimuth: Array) -> Array:
    """A full round, or where no camera stood in a third of it, back and forth over the rest."""
    sorted_azimuth = np.sort(azimuth)
    gap = np.diff(np.concatenate([sorted_azimuth, sorted_azimuth[:1] + 2 * np.pi]))
    widest = int(gap.argmax())
    if gap[widest] < 2 * np.pi / 3:
        return turn
    start = sorted_azimuth[(widest + 1) % len(gap)]
    return start + (2 * np.pi - gap[widest]) * (1 - np.cos(turn)) / 2


def _horizontal_axes(layout: Layout) -> tuple[Array, Array]:
    """Level unit axes, the first along the longest extent of the cameras, in the direction of the flight."""
    return _long_axes(layout, layout.up)


def _long_axes(layout: Layout, normal: Array) -> tuple[Array, Array]:
    """Unit axes across a normal, the first along the longest extent of the cameras, from the first to the last."""
    across = np.eye(3) - np.outer(normal, normal)
    flat = (layout.position - layout.position.mean(0)) @ across
    # Added along the normal, so that the normal itself is never the longest.
    axis = np.linalg.eigh(flat.T @ flat - np.outer(normal, normal))[1][:, 2]
    axis = axis if axis @ (layout.position[-1] - layout.position[0]) >= 0 else -axis
    return axis, np.cross(normal, axis)


def _looking(forward: Array, up: Array) -> Array:
    """Camera-to-world rotations (N x 3 x 3) that look along `forward` with `up` upwards in the picture."""
    ahead = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(ahead, right), ahead], axis=2)


def _cameras(
    scene: Scene, position: Array, rotation: Array, width: int, height: int, focal_px: Array | None = None
) -> Cameras:
    """Path cameras; where no focal lengths are given, the photographs' (the narrower view, if the aspects differ)."""
    train = scene.cameras[list(scene.train)]
    count, size = len(position), torch.tensor([width, height])
    if focal_px is None:
        focal_px = np.full(count, float((train.focal_px / train.size_px * size).median(0).values.max()))
    pose = np.concatenate([rotation, position[:, :, None]], axis=2)
    return Cameras(
        T_world_camera=torch.as_tensor(pose, dtype=torch.float32),
        focal_px=torch.as_tensor(focal_px, dtype=torch.float32)[:, None].repeat(1, 2),
        principal_px=(size / 2).repeat(count, 1),
        size_px=size.repeat(count, 1),
        near_far=torch.as_tensor(_near_far(scene, pose, focal_px, width, height), dtype=torch.float32),
        gain=torch.ones(count, 3),
    )


def _near_far(scene: Scene, pose: Array, focal_px: Array, width: int, height: int) -> Array:
    """Ranges of the sparse points in each frame, steady from frame to frame; without points, the photographs'."""
    if scene.points is None:
        near, far = scene.cameras.near_far[list(scene.train)].double().cpu().numpy().T
        return np.tile([np.quantile(near, 0.05), np.quantile(far, 0.95)], (len(pose), 1))
    xyz = scene.points.xyz_world.double().cpu().numpy()
    lenses = tuple(Lens(width, height, f, f, width / 2, height / 2) for f in focal_px.tolist())
    ranges = near_far_from_cloud(pose, lenses, xyz[:: len(xyz) // POINTS_ENOUGH + 1])
    # Jumps of the range would jump in the picture: samples lie elsewhere.
    return np.exp(gaussian_filter1d(np.log(ranges), FRAMES_PER_SECOND / 4, axis=0, mode="nearest"))
