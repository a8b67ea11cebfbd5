"""Camera paths for videos: a flight among the photographs, an orbit, a nadir strip, or a viewer's file.

Every path stays where the photographs were taken from, because a view is only as good as its neighbours. Focal length
and near and far come from the training cameras; all frames are at the scene's common exposure (gain 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from tidefield.data.near_far import near_far_from_cloud
from tidefield.data.scene import Scene
from tidefield.data.surface import doubly_seen
from tidefield.errors import TidefieldError
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.lenses import Lens
from tidefield.render.layout import Array, layout_of
from tidefield.render.paths import Shape, among_cameras, orbit, strip
from tidefield.render.viewer_path import ViewerPath, read_viewer_path

FRAMES_PER_SECOND = 24.0
SHAPES: dict[str, Shape] = {"cameras": among_cameras, "orbit": orbit, "strip": strip}
REACHES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.25)
ENOUGH = 0.95
"""Share of doubly seen pixels that every frame must have, relative to what a path of the shortest reach has."""
FRAMES_JUDGED, JUDGED_PX = 9, 24
"""How many frames of a path are judged by what they see, and the side of the small pictures that this is done in."""
POINTS_ENOUGH = 20_000
"""Sparse points that a frame's near and far are taken from, at most."""


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
    if path in SHAPES:
        return Trajectory(_well_seen(SHAPES[path], scene, frames, width, height), frames_per_second)
    if Path(path).suffix.lower() != ".json":
        raise TidefieldError(f"no camera path is called {path!r}: expected {', '.join(SHAPES)} or a .json file")
    return from_viewer(read_viewer_path(Path(path), scene.root), scene)


def from_viewer(path: ViewerPath, scene: Scene) -> Trajectory:
    """The frames of a viewer's file in the scene's own coordinates."""
    position = path.position - scene.origin_world.double().cpu().numpy()
    cameras = _cameras(scene, position, path.rotation, path.width, path.height, path.focal_px)
    return Trajectory(cameras, path.frames_per_second or FRAMES_PER_SECOND)


def _well_seen(shape: Shape, scene: Scene, frames: int, width: int, height: int) -> Cameras:
    """A path as far out as all its frames are nearly full of what at least two training photographs see.

    Around an object always as far out as it was photographed from: the way in leads to the object.
    """
    layout = layout_of(scene)
    reach = 1.0
    if layout.kind != "around":
        judged = np.unique(np.linspace(0, frames - 1, FRAMES_JUDGED).round().astype(int))

        def worst(reach: float) -> float:
            """The smallest share of doubly seen pixels in a frame."""
            position, rotation = shape(layout, frames, reach)
            cameras = _cameras(scene, position[judged], rotation[judged], width, height).resized(JUDGED_PX, JUDGED_PX)
            return min(float(doubly_seen(scene, cameras[k]).float().mean()) for k in range(len(cameras)))

        enough = ENOUGH * worst(REACHES[-1])
        reach = next(reach for reach in REACHES if worst(reach) >= enough)
    return _cameras(scene, *shape(layout, frames, reach), width, height)


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
