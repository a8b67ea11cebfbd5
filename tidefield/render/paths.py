"""The shapes of camera paths: a flight among the cameras, an orbit, a nadir strip.

All are functions of how the training cameras lie, and stay where these were, because a view is only as good as its
neighbours. `reach`, from 1 down to 0, draws a path in towards its middle, where more photographs see the same.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp
from scipy.special import softmax

from tidefield.render.layout import Array, Layout

Poses = tuple[Float64[np.ndarray, "frames 3"], Float64[np.ndarray, "frames 3 3"]]
Shape = Callable[[Layout, int, float], Poses]
"""(layout, frames, reach) to the frames' positions and camera-to-world rotations, in world coordinates."""

STEEPEST = np.radians(30)
"""How far from straight down an orbit over a nadir survey looks: farther, and no photograph saw it so."""
AHEAD = np.radians(18)
"""How far from straight down a flight over a nadir survey looks ahead."""
SWING = np.radians(25)
"""How far such a flight's heading turns to either side, where there is time for it."""
GENTLE = np.radians(0.8)
"""How far such a flight moves (as seen from the ground) and turns from frame to frame: the eye still follows."""
SAMPLES_PER_KEY = 32
TANGENT_WINDOW = 0.3
"""Standard deviation of the smoothing of orientations, in key frames: rounds the corners of slerp at the keys."""


def among_cameras(layout: Layout, frames: int, reach: float = 1.0) -> Poses:
    """A smooth flight among the training cameras.

    Over a nadir survey: forward along its length, see `_flight`. Elsewhere: through the cameras one after the other,
    in the order of their names where that is no detour. Positions then lie on a centripetal Catmull-Rom spline,
    orientations are slerped and smoothed, and the speed is constant in what the eye sees of it: the angle that a
    point at the usual distance moves through, by travel or by turning.
    """
    if layout.kind == "survey" and layout.forward @ -layout.up > np.cos(STEEPEST):
        return _flight(layout, frames, reach)
    order = _tour(layout)
    keys = layout.position[order]
    if layout.kind != "around":
        keys = keys.mean(0) + reach * (keys - keys.mean(0))
    position, rotation = _spline(keys, layout.rotation[order])
    travelled = np.concatenate([[0.0], np.cumsum(_apparent(position, rotation, layout.distance))])
    at = np.interp(np.linspace(0, travelled[-1], frames), travelled, np.arange(len(travelled)))
    step = np.arange(len(travelled))
    between = np.stack([np.interp(at, step, p) for p in position.T], 1)
    return between, Slerp(step, Rotation.from_matrix(rotation))(at).as_matrix()


def orbit(layout: Layout, frames: int, reach: float = 1.0) -> Poses:
    """Around the middle of what was photographed, looking at it; closed, so that the video can loop.

    Over a survey: at the flight's height, within the flight lines, at most 30 degrees off straight down. Around an
    object: at the cameras' own distance and height, back and forth where they saw only a part of the round. Before a
    motif: an ellipse within the cameras' own positions.
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
        first, second = _horizontal_axes(layout)
        away = layout.position - layout.centre
        height = float(np.median(away @ layout.up))
        if layout.kind == "around":
            azimuth = np.arctan2(away @ second, away @ first)
            radius = float(np.median(np.hypot(away @ first, away @ second)))
            turn = _within_azimuths(turn, azimuth)
        else:
            narrow = reach * min(layout.half_extent(first), layout.half_extent(second))
            # Not less than 0.1: directly above the centre, "up" in the picture would be undefined.
            radius = abs(height) * np.clip(narrow / max(abs(height), 1e-9), 0.1, np.tan(STEEPEST))
        around = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
        position = layout.centre + radius * around + height * layout.up
    return position, _looking(layout.centre - position, layout.up)


def strip(layout: Layout, frames: int, reach: float = 1.0) -> Poses:
    """Straight down (before a motif: straight ahead) along the longest extent of the cameras, at constant speed."""
    if layout.kind == "facing":
        axis, up, look = _long_axes(layout, layout.forward)[0], layout.up, layout.forward
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
    position = middle + reach * np.linspace(-half, half, frames)[:, None] * axis
    return position, _looking(np.broadcast_to(look, position.shape), up)


def _flight(layout: Layout, frames: int, reach: float) -> Poses:
    """Forward over a nadir survey along its length, in one long S within the flight lines, looking a little ahead.

    It follows the middle of the cameras where that bends, and covers as much of the length as a gentle speed allows.
    """
    axis, side = _horizontal_axes(layout)
    along, across, height = (layout.position @ a for a in (axis, side, layout.up))
    half = min(reach * layout.half_extent(axis), GENTLE * frames * layout.distance / 2)
    half = max(half, 1e-3 * layout.distance)  # a direction to fly in, even where all cameras are in one place
    # One more at both ends, for the headings there.
    share = np.linspace(-1, 1, frames + 2)
    # So far back that what is looked at, ahead, and not the camera keeps to the middle of the survey.
    at = np.percentile(along, [5, 95]).mean() - layout.distance * np.tan(AHEAD) + half * share
    near = softmax(-(((at[:, None] - along) / (layout.distance / 2)) ** 2) / 2, axis=1)
    middle = near @ across
    spread = np.sqrt(np.maximum(near @ across**2 - middle**2, 0))
    swing = min(SWING, GENTLE * frames / (2 * np.pi))
    aside = middle + np.minimum(reach * spread, half * np.tan(swing) / np.pi) * np.sin(np.pi * share)
    position = at[:, None] * axis + aside[:, None] * side + (near @ height)[:, None] * layout.up
    heading = np.gradient(at)[:, None] * axis + np.gradient(aside)[:, None] * side
    heading = (heading / np.linalg.norm(heading, axis=1, keepdims=True))[1:-1]
    return position[1:-1], _looking(np.sin(AHEAD) * heading - np.cos(AHEAD) * layout.up, heading)


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
    """Camera-to-world rotations (N x 3 x 3) that look along `forward` with `up` (one, or N) upwards in the picture."""
    ahead = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(ahead, right), ahead], axis=2)
