"""Make camera paths for videos: a flight among the photographs, an orbit, a nadir strip, or a file of nerfstudio.

A path follows from how the training cameras are arranged, and stays where these were, because a view is only as good
as its neighbours. `reach`, from 1 down to 0, shrinks a path towards its middle, where more photographs overlap. Focal
length and near and far come from the training cameras; all frames are at the scene's common exposure (gain 1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp
from scipy.special import softmax

from tidefield.data.hull import Hull
from tidefield.data.near_far import ranges_of_points, with_widest
from tidefield.data.readers.posed import Observations
from tidefield.data.scene import Scene
from tidefield.data.surface import doubly_seen
from tidefield.errors import TidefieldError
from tidefield.geometry.cameras import Cameras, intersect_axes
from tidefield.geometry.lenses import Lens
from tidefield.render.nerfstudio_path import read_export, read_nerfstudio_path

Vector = Float64[np.ndarray, "3"]
Positions = Float64[np.ndarray, "N 3"]
Rotations = Float64[np.ndarray, "N 3 3"]
Poses = tuple[Float64[np.ndarray, "frames 3"], Float64[np.ndarray, "frames 3 3"]]
Shape = Callable[["Layout", int, float], Poses]
"""(layout, frames, reach) to the frames' positions and camera-to-world rotations, in world coordinates."""

FRAMES_PER_SECOND = 24.0

# The constants below were chosen by eye on the scenes of docs/results.md, unless a reason is given.
PARALLEL = 0.95
"""If the mean of the unit viewing directions is longer than this, the cameras all face one way."""
OPPOSITE = 0.1
"""If it is shorter than this, they face all ways or two opposite ones, and do not look down."""
LEVEL = 0.1
"""Height of the cameras over what they see, in distances to it, below which they look outwards and not down."""
LONG = 0.7
"""Cameras that face one way and extend farther than this, in distances to the surface, are a survey."""
STEEPEST = np.radians(30)
"""Largest angle from nadir of an orbit over a nadir survey: no photograph saw the ground from farther aside."""
AHEAD = np.radians(18)
"""Angle from nadir, towards the heading, at which a flight over a nadir survey looks."""
SWING = np.radians(25)
"""Largest turn of such a flight's heading to either side; a short flight turns less."""
GENTLE = np.radians(0.8)
"""Largest motion of such a flight from frame to frame, as an angle seen from the ground, and its largest turn."""
SAMPLES_PER_KEY = 32
LEAST_NEAR = 0.02
"""Near of a camera inside the box around a visual hull, as a share of its far."""
ROTATION_SMOOTHING = 0.3
"""Standard deviation of the smoothing of orientations, in key frames: rounds the corners of slerp at the keys."""
DETOUR = 2
"""Names' order is left for a greedy tour if it is this many times as long: Blender's names jump to and fro."""
REACHES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.25)
ENOUGH = 0.95
"""Share of doubly seen pixels that every frame must have, relative to a path of the shortest reach."""
CHECKED_FRAMES, CHECKED_PX = 9, 24
"""Number of frames in which doubly seen pixels are counted, and the side of the small images for that."""
RANGE_POINTS = (20_000, 1_000_000)
"""Sparse points that the near and far of a frame are taken from, at most: first, and where these are too few."""


@dataclass(frozen=True)
class Trajectory:
    """Cameras of the frames of a video, in order, all of one size."""

    cameras: Cameras
    frames_per_second: float


@dataclass(frozen=True)
class Layout:
    """Arrangement of N training cameras, in world coordinates.

    Structure-from-motion leaves the world's axes arbitrary, so that all of it is estimated from the cameras and from
    the depths of their sparse points.

    Attributes:
        kind: `survey` flies over a surface, `facing` sees a subject from one side, `around` circles an object.
        position: camera centres.
        rotation: camera-to-world; columns are right, down, forward.
        up: away from the ground, unit.
        forward: mean viewing direction, unit.
        centre: middle of what the cameras see.
        distance: usual distance from a camera to what it sees.
    """

    kind: Literal["survey", "facing", "around"]
    position: Positions
    rotation: Rotations
    up: Vector
    forward: Vector
    centre: Vector
    distance: float

    def half_extent(self, axis: Vector) -> float:
        """Return half the cameras' extent along a unit axis, without the outermost tenth of them."""
        low, high = np.percentile(self.position @ axis, [5, 95])
        return float(high - low) / 2

    def long_axes(self, normal: Vector) -> tuple[Vector, Vector]:
        """Return unit axes across a normal, the first along the cameras' longest extent, from the first to the last."""
        across = np.eye(3) - np.outer(normal, normal)
        flat = (self.position - self.position.mean(0)) @ across
        # Minus the normal's own part, so that the normal is never the longest.
        axis = np.linalg.eigh(flat.T @ flat - np.outer(normal, normal))[1][:, 2]
        axis = axis if axis @ (self.position[-1] - self.position[0]) >= 0 else -axis
        return axis, np.cross(normal, axis)


def require_path(path: str, frames: int) -> None:
    """Raise a TidefieldError where `make_trajectory` would, as far as names and files show it without a scene."""
    if frames < 1:
        raise TidefieldError(f"a video of {frames} frames was asked for: expected at least one; choose more --frames")
    if Path(path).suffix.lower() == ".json":
        read_export(Path(path))
    elif path not in SHAPES:
        raise TidefieldError(f"no camera path is called {path!r}: expected {', '.join(SHAPES)} or a .json file")


def make_trajectory(
    path: str, scene: Scene, *, frames: int, width: int, height: int, frames_per_second: float = FRAMES_PER_SECOND
) -> Trajectory:
    """Make the camera path of a name or a file.

    Args:
        path: `cameras`, `orbit`, `strip`, or a camera-path JSON as nerfstudio's viewer exports it.
        scene: its training cameras and sparse points determine the path.
        frames, width, height, frames_per_second: of the video, pixels; a JSON has its own instead.

    Raises:
        TidefieldError: the name is none of these, it would have no frames, or the file cannot be read as a camera path.
    """
    require_path(path, frames)
    if path in SHAPES:
        return Trajectory(_well_seen(SHAPES[path], scene, frames, width, height), frames_per_second)
    stored = read_nerfstudio_path(Path(path), scene.root)
    position = stored.position - scene.origin_world.double().cpu().numpy()
    cameras = path_cameras(scene, position, stored.rotation, stored.width, stored.height, stored.focal_px)
    return Trajectory(cameras, stored.frames_per_second or FRAMES_PER_SECOND)


def layout_of(scene: Scene) -> Layout:
    """Estimate the arrangement of a scene's training cameras."""
    pose = scene.cameras.T_world_camera[list(scene.train)].double().cpu().numpy()
    rotation, position = pose[:, :, :3], pose[:, :, 3]
    ahead, image_up = rotation[:, :, 2], -rotation[:, :, 1]
    distance = _distance(scene)
    concentration = float(np.linalg.norm(ahead.mean(0)))
    forward = ahead.mean(0) / concentration if concentration > 1e-3 else ahead[0]
    focus = _focus(position, ahead)
    centre = np.median(position + ahead * distance, axis=0)
    if concentration < PARALLEL:
        kind = "around" if focus is not None else "survey"
        levelled = kind == "around" or _yaws(rotation) or concentration < OPPOSITE
        up = _level_normal(rotation) if levelled else _plane_normal(position, forward)
        if focus is not None:
            centre, distance = focus, float(np.median(np.linalg.norm(focus - position, axis=1)))
    else:
        length = 0.0
        if len(position) > 1:
            length = max(np.ptp(position @ axis) for axis in np.linalg.eigh(np.cov(position.T))[1].T)
        one_heading = float(np.linalg.norm(image_up.mean(0))) > 0.8
        kind = "facing" if one_heading and length < LONG * distance else "survey"
        up = image_up.mean(0) if kind == "facing" else _plane_normal(position, forward)
    return Layout(kind, position, rotation, up / np.linalg.norm(up), forward, centre, distance)


def among_cameras(layout: Layout, frames: int, reach: float = 1.0) -> Poses:
    """Make a smooth flight among the training cameras.

    Over a nadir survey: forward along its length, see `_flight`. Elsewhere: through the cameras one after the other,
    in the order of their names where that is no detour. Positions then lie on a centripetal Catmull-Rom spline,
    orientations are slerped and smoothed, and the apparent speed is constant: the angle that a point at the usual
    distance moves through, by travel or by turning.
    """
    if layout.kind == "survey" and layout.forward @ -layout.up > np.cos(STEEPEST):
        return _flight(layout, frames, reach)
    order = _tour(layout)
    keys = layout.position[order]
    if layout.kind != "around":
        keys = keys.mean(0) + reach * (keys - keys.mean(0))
    position, rotation = _spline(keys, layout.rotation[order])
    if len(position) == 1:
        return position.repeat(frames, axis=0), rotation.repeat(frames, axis=0)
    turned = Rotation.from_matrix(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]).magnitude()
    apparent = np.hypot(np.linalg.norm(np.diff(position, axis=0), axis=1) / layout.distance, turned)
    travelled = np.concatenate([[0.0], np.cumsum(apparent)])
    sample = np.arange(len(travelled))
    at = np.interp(np.linspace(0, travelled[-1], frames), travelled, sample)
    between = np.stack([np.interp(at, sample, p) for p in position.T], 1)
    return between, Slerp(sample, Rotation.from_matrix(rotation))(at).as_matrix()


def orbit(layout: Layout, frames: int, reach: float = 1.0) -> Poses:
    """Make a closed path around the middle of what was photographed, looking at it, so that the video can loop.

    Over a survey: at the flight's height, within the flight lines, at most 30 degrees from nadir. Around an object: at
    the cameras' own distance and height, back and forth if they saw only a part of the circle. Facing a subject: an
    ellipse within the cameras' own positions. Among cameras that look outwards: a turn on the spot.
    """
    turn = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    if layout.kind == "facing":
        right = np.cross(layout.forward, layout.up)
        right /= np.linalg.norm(right)
        upward = np.cross(right, layout.forward)
        position = (
            layout.position.mean(0)
            + 0.7 * reach * layout.half_extent(right) * np.cos(turn)[:, None] * right
            + 0.7 * reach * layout.half_extent(upward) * np.sin(turn)[:, None] * upward
        )
    else:
        first, second = layout.long_axes(layout.up)
        away = layout.position - layout.centre
        height = float(np.median(away @ layout.up))
        if layout.kind == "survey" and abs(height) < LEVEL * layout.distance:
            around = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
            return np.broadcast_to(layout.position.mean(0), around.shape), look_along(around, layout.up)
        if layout.kind == "around":
            radius = float(np.median(np.hypot(away @ first, away @ second)))
            turn = _within_azimuths(turn, np.arctan2(away @ second, away @ first))
        else:
            narrow = reach * min(layout.half_extent(first), layout.half_extent(second))
            # Not less than 0.1: directly above the centre, "up" in the picture would be undefined.
            radius = abs(height) * np.clip(narrow / max(abs(height), 1e-9), 0.1, np.tan(STEEPEST))
        around = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
        position = layout.centre + radius * around + height * layout.up
    return position, look_along(layout.centre - position, layout.up)


def strip(layout: Layout, frames: int, reach: float = 1.0) -> Poses:
    """Make a straight path along the cameras' longest extent, looking straight down (`facing`: straight ahead)."""
    if layout.kind == "facing":
        axis, up, ahead = layout.long_axes(layout.forward)[0], layout.up, layout.forward
        half, middle = layout.half_extent(axis), layout.position.mean(0)
    else:
        axis, side = layout.long_axes(layout.up)
        up, ahead = axis, -layout.up
        if layout.kind == "around":
            half, middle = layout.distance / 2, layout.centre + layout.distance * layout.up
        else:
            half = layout.half_extent(axis)
            ends = np.percentile(layout.position @ axis, [5, 95]).mean()
            middle = ends * axis + np.median(layout.position @ side) * side
            middle = middle + (layout.position @ layout.up).mean() * layout.up
    position = middle + reach * np.linspace(-half, half, frames)[:, None] * axis
    return position, look_along(np.broadcast_to(ahead, position.shape), up)


SHAPES: dict[str, Shape] = {"cameras": among_cameras, "orbit": orbit, "strip": strip}


def _distance(scene: Scene) -> float:
    """Return the median depth of the training cameras' points; without points, midway from near to far in disparity."""
    points, train = scene.points, list(scene.train)
    if points is not None:
        camera = points.camera_index
        pose = scene.cameras.T_world_camera[camera]
        depth = ((points.xyz_world[points.point_index] - pose[:, :, 3]) * pose[:, :, 2]).sum(1)
        depth = depth[(depth > 0) & torch.isin(camera, camera.new_tensor(train))]
        if len(depth):
            return float(depth.median())
    near, far = scene.cameras.near_far[train].double().median(0).values.tolist()
    return 2 / (1 / near + 1 / far)


def _focus(position: Positions, ahead: Positions) -> Vector | None:
    """Return the point nearest to all optical axes if these meet in front of the cameras (Blender, turntables)."""
    focus = intersect_axes(position, ahead)
    if focus is None:
        return None
    missed = np.linalg.norm(np.cross(focus - position, ahead), axis=1)
    spread = np.linalg.norm(position - position.mean(0), axis=1)
    in_front = ((focus - position) * ahead).sum(1) > 0
    meets = np.median(missed) < 0.25 * np.median(spread) and in_front.mean() > 0.9
    return focus if meets else None


def _yaws(rotation: Rotations) -> bool:
    """Return whether the cameras' right-hand axes point in more than one direction and its opposite."""
    right = rotation[:, :, 0]
    return bool(np.linalg.eigvalsh(right.T @ right / len(right))[1] > 0.05)


def _level_normal(rotation: Rotations) -> Vector:
    """Return the direction that the right-hand axes of cameras that never roll are perpendicular to."""
    right = rotation[:, :, 0]
    if not _yaws(rotation):  # as of two cameras that face each other: all directions across are perpendicular to it
        return -rotation[:, :, 1].mean(0)
    up = np.linalg.eigh(right.T @ right)[1][:, 0]
    return up if up @ (-rotation[:, :, 1] - rotation[:, :, 2]).mean(0) > 0 else -up


def _plane_normal(position: Positions, forward: Vector) -> Vector:
    """Return the normal of the plane of most cameras, against the viewing direction; without a plane, its opposite."""
    if len(position) < 4:  # three always lie in one
        return -forward
    variance, axes = np.linalg.eigh(np.cov(position.T))
    kept = position
    for _ in range(3):  # photographs of take-off and landing lie off the plane
        off = np.abs((position - kept.mean(0)) @ axes[:, 0])
        kept = position[off <= np.quantile(off, 0.8)]
        variance, axes = np.linalg.eigh(np.cov(kept.T))
    normal = -axes[:, 0] if axes[:, 0] @ forward > 0 else axes[:, 0]
    flat = variance[0] < 0.15**2 * variance[1]
    return normal if flat and normal @ -forward > 0.5 else -forward


def _flight(layout: Layout, frames: int, reach: float) -> Poses:
    """Fly forward over a nadir survey in one long S within its flight lines, looking a little ahead.

    The flight follows the middle of the cameras where the survey bends, and covers as much of its length as a gentle
    speed allows.
    """
    axis, side = layout.long_axes(layout.up)
    along, across, height = (layout.position @ a for a in (axis, side, layout.up))
    half = min(reach * layout.half_extent(axis), GENTLE * frames * layout.distance / 2)
    half = max(half, 1e-3 * layout.distance)  # a direction to fly in, even where all cameras are in one place
    # One more at both ends, for the headings there.
    share = np.linspace(-1, 1, frames + 2)
    # Shifted back, so that the point ahead that is looked at, not the camera, stays over the middle of the survey.
    at = np.percentile(along, [5, 95]).mean() - layout.distance * np.tan(AHEAD) + half * share
    near = softmax(-(((at[:, None] - along) / (layout.distance / 2)) ** 2) / 2, axis=1)
    middle = near @ across
    spread = np.sqrt(np.maximum(near @ across**2 - middle**2, 0))
    swing = min(SWING, GENTLE * frames / (2 * np.pi))
    aside = middle + np.minimum(reach * spread, half * np.tan(swing) / np.pi) * np.sin(np.pi * share)
    position = at[:, None] * axis + aside[:, None] * side + (near @ height)[:, None] * layout.up
    heading = np.gradient(at)[:, None] * axis + np.gradient(aside)[:, None] * side
    heading = (heading / np.linalg.norm(heading, axis=1, keepdims=True))[1:-1]
    return position[1:-1], look_along(np.sin(AHEAD) * heading - np.cos(AHEAD) * layout.up, heading)


def _spline(position: Positions, rotation: Rotations) -> Poses:
    """Sample a smooth curve through N poses densely, `SAMPLES_PER_KEY` for each step."""
    if len(position) == 1:
        return position, rotation
    chord = np.linalg.norm(np.diff(position, axis=0), axis=1)
    # Centripetal: knots by the root of the distance, which keeps close keys from making loops. The floor keeps
    # knots apart where the camera only turned.
    knot = np.concatenate([[0.0], np.cumsum(np.sqrt(np.maximum(chord, 1e-3 * chord.mean() + 1e-9)))])
    curve = CubicHermiteSpline(knot, position, np.gradient(position, knot, axis=0))
    at = np.interp(np.arange((len(knot) - 1) * SAMPLES_PER_KEY + 1) / SAMPLES_PER_KEY, np.arange(len(knot)), knot)
    quaternion = Slerp(knot, Rotation.from_matrix(rotation))(at).as_quat()
    # q and -q are the same rotation: give neighbours the same sign before averaging.
    sign = np.cumprod(np.where((quaternion[1:] * quaternion[:-1]).sum(1) < 0, -1.0, 1.0))
    quaternion[1:] *= sign[:, None]
    smooth = gaussian_filter1d(quaternion, ROTATION_SMOOTHING * SAMPLES_PER_KEY, axis=0, mode="nearest")
    return curve(at), Rotation.from_quat(smooth).as_matrix()


def _tour(layout: Layout) -> Int64[np.ndarray, " N"]:
    """Order the cameras as they are named or, where that is a detour, from one end always to the nearest one left."""
    position = layout.position
    named, left = np.arange(len(position)), np.ones(len(position), dtype=bool)

    def away(camera: int) -> Float64[np.ndarray, " N"]:
        return np.linalg.norm(position - position[camera], axis=1)

    order = [int(np.argmax([away(camera).sum() for camera in range(len(position))]))]
    left[order[0]] = False
    while left.any():
        order.append(int(np.where(left, away(order[-1]), np.inf).argmin()))
        left[order[-1]] = False
    length, greedy_length = (np.linalg.norm(np.diff(position[o], axis=0), axis=1).sum() for o in (named, order))
    return np.array(order) if DETOUR * greedy_length < length else named


def _within_azimuths(
    turn: Float64[np.ndarray, " frames"], azimuth: Float64[np.ndarray, " N"]
) -> Float64[np.ndarray, " frames"]:
    """Map a full circle to back and forth over the cameras' azimuths where a third of the circle has no camera."""
    sorted_azimuth = np.sort(azimuth)
    gap = np.diff(np.concatenate([sorted_azimuth, sorted_azimuth[:1] + 2 * np.pi]))
    widest = int(gap.argmax())
    if gap[widest] < 2 * np.pi / 3:
        return turn
    start = sorted_azimuth[(widest + 1) % len(gap)]
    return start + (2 * np.pi - gap[widest]) * (1 - np.cos(turn)) / 2


def look_along(forward: Positions, up: Vector | Positions) -> Rotations:
    """Return camera-to-world rotations that look along `forward` with `up` upwards in the picture."""
    ahead = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(ahead, right), ahead], axis=2)


def _well_seen(shape: Shape, scene: Scene, frames: int, width: int, height: int) -> Cameras:
    """Return the longest path whose frames all show almost only what at least two training photographs see.

    Around an object the reach is always 1: a shorter path would lead into the object.
    """
    layout = layout_of(scene)
    reach = 1.0
    if layout.kind != "around":
        checked = np.unique(np.linspace(0, frames - 1, CHECKED_FRAMES).round().astype(int))

        def worst(reach: float) -> float:
            """Return the smallest share of doubly seen pixels in a frame."""
            position, rotation = shape(layout, frames, reach)
            cameras = path_cameras(scene, position[checked], rotation[checked], width, height)
            cameras = cameras.resized(CHECKED_PX, CHECKED_PX)
            return min(float(doubly_seen(scene, cameras[k]).float().mean()) for k in range(len(cameras)))

        enough = ENOUGH * worst(REACHES[-1])
        reach = next(reach for reach in REACHES if worst(reach) >= enough)
    return path_cameras(scene, *shape(layout, frames, reach), width, height)


def path_cameras(
    scene: Scene,
    position: Positions,
    rotation: Rotations,
    width: int,
    height: int,
    focal_px: Float64[np.ndarray, " N"] | None = None,
) -> Cameras:
    """Return cameras of a path at the common exposure; without focal lengths, with the photographs' (the narrower view
    if the aspects differ)."""
    count, size = len(position), torch.tensor([width, height])
    if focal_px is None:
        train = scene.cameras[list(scene.train)]
        focal_px = np.full(count, float((train.focal_px / train.size_px * size).median(0).values.max()))
    pose = np.concatenate([rotation, position[:, :, None]], axis=2)
    lenses = tuple(Lens(width, height, f, f, width / 2, height / 2) for f in focal_px.tolist())
    return Cameras(
        T_world_camera=torch.as_tensor(pose, dtype=torch.float32),
        focal_px=torch.as_tensor(focal_px, dtype=torch.float32)[:, None].repeat(1, 2),
        principal_px=(size / 2).repeat(count, 1),
        size_px=size.repeat(count, 1),
        near_far=torch.as_tensor(_near_far(scene, pose, lenses), dtype=torch.float32),
        gain=torch.ones(count, 3),
    )


def free_camera(scene: Scene, T_world_camera: Float64[np.ndarray, "3 4"], lens: Lens) -> Cameras:
    """Return one camera at the common exposure, as another program's viewer or test asks for it.

    Args:
        scene: which it looks at.
        T_world_camera: in the scene's coordinates, its origin subtracted.
        lens: without distortion.
    """
    focal = np.array([lens.fx])
    camera = path_cameras(
        scene, T_world_camera[None, :, 3], T_world_camera[None, :, :3], lens.width, lens.height, focal
    )
    focal_px, principal_px = torch.tensor([[lens.fx, lens.fy]]), torch.tensor([[lens.cx, lens.cy]])
    return replace(camera, focal_px=focal_px, principal_px=principal_px)


def _near_far(scene: Scene, pose: Float64[np.ndarray, "N 3 4"], lenses: tuple[Lens, ...]) -> Float64[np.ndarray, "N 2"]:
    """Return the depth ranges of the sparse points, smoothed over the frames; each contains the frame's own one.

    Frames that show few of them have the widest range of any frame; where all do, and the scene has a visual hull, that
    of the box around it, else that of the photographs.
    """
    ranges = np.full((len(pose), 2), np.nan)
    points = torch.zeros(0, 3) if scene.points is None else scene.points.xyz_world
    for most in RANGE_POINTS:
        few = np.flatnonzero(np.isnan(ranges[:, 0]))
        if len(few) and len(points):
            some = Observations(points[:: len(points) // most + 1].double().cpu().numpy())
            ranges[few] = ranges_of_points(pose[few], tuple(lenses[i] for i in few), some)
    if scene.hull is not None and np.isnan(ranges).all():
        ranges = _ranges_of_hull(scene.hull, pose)
    filled = with_widest(ranges)
    if filled is None:
        near, far = scene.cameras.near_far[list(scene.train)].double().cpu().numpy().T
        filled = np.tile([np.quantile(near, 0.05), np.quantile(far, 0.95)], (len(pose), 1))
    # A jump of the range would be a jump in the picture: samples lie elsewhere.
    smooth = np.exp(gaussian_filter1d(np.log(filled), FRAMES_PER_SECOND / 4, axis=0, mode="nearest"))
    # A fast descent, or views that are no video, must keep what they see.
    return np.stack([np.minimum(filled, smooth)[:, 0], np.maximum(filled, smooth)[:, 1]], axis=1)


def _ranges_of_hull(hull: Hull, pose: Float64[np.ndarray, "N 3 4"]) -> Float64[np.ndarray, "N 2"]:
    """Nearest and farthest depth of the box around a visual hull, which a camera may be in; NaN where it is behind."""
    side = hull.voxel_world.double().cpu().numpy() * len(hull.filled)
    corners = hull.corner_world.double().cpu().numpy() + side * np.array(list(np.ndindex(2, 2, 2)))
    depth = (corners - pose[:, None, :, 3]) @ pose[:, :, 2, None]
    near, far = depth.min(axis=1)[:, 0], depth.max(axis=1)[:, 0]
    ranges = np.stack([near.clip(min=LEAST_NEAR * far), far], axis=1)
    return np.where(far[:, None] > 0, ranges, np.nan)
