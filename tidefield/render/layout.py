"""How a scene's training cameras lie: which way is up, what they look at, and what kind of capture it is.

Structure-from-motion leaves the world's axes arbitrary, so everything here comes from the cameras and what they saw.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tidefield.data.scene import Scene
from tidefield.geometry.rays import intersect_axes

Array = NDArray[np.float64]
Kind = Literal["survey", "facing", "around"]

PARALLEL = 0.95
"""Mean of the unit viewing directions longer than this: the cameras all look one way."""
LONG = 0.7
"""A flight longer than this, in distances to the surface, is a survey; shorter, a few steps before a motif."""


@dataclass(frozen=True)
class Layout:
    """Where N training cameras are and what they look at. All in world coordinates, float64.

    Attributes:
        kind: `survey` flies over a surface, `facing` stands before a motif, `around` circles an object.
        position: camera centres, N x 3.
        rotation: camera-to-world rotations, N x 3 x 3; columns are right, down, forward.
        up: away from the ground, unit.
        forward: mean viewing direction, unit.
        centre: the middle of what is looked at.
        distance: usual distance from a camera to what it looks at.
    """

    kind: Kind
    position: Array
    rotation: Array
    up: Array
    forward: Array
    centre: Array
    distance: float

    def half_extent(self, axis: Array) -> float:
        """Half the length of the captured stretch along a unit axis, without its outermost tenth of cameras."""
        low, high = np.percentile(self.position @ axis, [5, 95])
        return float(high - low) / 2


def layout_of(scene: Scene) -> Layout:
    """The layout of a scene's training cameras."""
    pose = scene.cameras.T_world_camera[list(scene.train)].double().cpu().numpy()
    rotation, position = pose[:, :, :3], pose[:, :, 3]
    ahead, image_up = rotation[:, :, 2], -rotation[:, :, 1]
    distance = _distance(scene)
    together = float(np.linalg.norm(ahead.mean(0)))
    forward = ahead.mean(0) / together if together > 1e-3 else ahead[0]
    focus = _focus(position, ahead)
    centre = np.median(position + ahead * distance, axis=0)
    if together < PARALLEL:
        kind = "around" if focus is not None else "survey"
        up = _never_rolled(rotation) if kind == "around" or _yaws(rotation) else _plane_normal(position, forward)
        if focus is not None:
            centre, distance = focus, float(np.median(np.linalg.norm(focus - position, axis=1)))
    else:
        length = max(np.ptp(position @ axis) for axis in np.linalg.eigh(np.cov(position.T))[1].T)
        one_heading = float(np.linalg.norm(image_up.mean(0))) > 0.8
        kind = "facing" if one_heading and length < LONG * distance else "survey"
        up = image_up.mean(0) if kind == "facing" else _plane_normal(position, forward)
    return Layout(kind, position, rotation, up / np.linalg.norm(up), forward, centre, distance)


def _distance(scene: Scene) -> float:
    """Median depth of what training cameras saw; without sparse points, midway in disparity from near to far."""
    points = scene.points
    train = list(scene.train)
    if points is not None:
        camera = points.camera_index
        pose = scene.cameras.T_world_camera[camera]
        depth = ((points.xyz_world[points.point_index] - pose[:, :, 3]) * pose[:, :, 2]).sum(1)
        depth = depth[(depth > 0) & (camera[:, None] == camera.new_tensor(train)).any(1)]
        if len(depth):
            return float(depth.median())
    near, far = scene.cameras.near_far[train].double().median(0).values.tolist()
    return 2 / (1 / near + 1 / far)


def _focus(position: Array, ahead: Array) -> Array | None:
    """The point nearest to all optical axes, where these do meet, in front of the cameras (Blender, turntables)."""
    focus = intersect_axes(position, ahead)
    if focus is None:
        return None
    missed = np.linalg.norm(np.cross(ahead, focus - position), axis=1)
    spread = np.linalg.norm(position - position.mean(0), axis=1)
    in_front = ((focus - position) * ahead).sum(1) > 0
    meets = np.median(missed) < 0.25 * np.median(spread) and in_front.mean() > 0.9
    return focus if meets else None


def _yaws(rotation: Array) -> bool:
    """Whether the cameras' right-hand axes point in more than one direction and its opposite."""
    right = rotation[:, :, 0]
    return bool(np.linalg.eigvalsh(right.T @ right / len(right))[1] > 0.05)


def _never_rolled(rotation: Array) -> Array:
    """The direction that all cameras' right-hand axes are level to."""
    right = rotation[:, :, 0]
    up = np.linalg.eigh(right.T @ right)[1][:, 0]
    return up if up @ (-rotation[:, :, 1] - rotation[:, :, 2]).mean(0) > 0 else -up


def _plane_normal(position: Array, forward: Array) -> Array:
    """Normal of the plane that most cameras lie in, against the viewing direction; this itself where there is none."""
    variance, axes = np.linalg.eigh(np.cov(position.T))
    kept = position
    for _ in range(3):  # photographs of take-off and landing lie off the plane
        off = np.abs((position - kept.mean(0)) @ axes[:, 0])
        kept = position[off <= np.quantile(off, 0.8)]
        variance, axes = np.linalg.eigh(np.cov(kept.T))
    normal = -axes[:, 0] if axes[:, 0] @ forward > 0 else axes[:, 0]
    flat = variance[0] < 0.15**2 * variance[1]
    return normal if flat and normal @ -forward > 0.5 else -forward
