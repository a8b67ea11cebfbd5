"""Camera paths as nerfstudio's viewer exports them ("Generate Command" writes camera_paths/NAME.json).

The file holds render_width, render_height, fps, seconds, camera_type and camera_path: per frame a camera_to_world of 16
numbers, row by row, with OpenGL's axes (+x right, +y up, -z forward), and fov, the vertical angle of view in degrees.
(nerfstudio/viewer/render_panel.py writes it, nerfstudio/cameras/camera_paths.py get_path_from_json reads it.)

nerfstudio turns, shifts and scales a scene before it trains: p_viewer = scale * (transform [p; 1]). It writes both to
dataparser_transforms.json in the run's output folder; a copy of that file beside the path takes the path back into the
scene's coordinates. Without it the path's coordinates are taken to be the scene's own, as they are on disk.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from tidefield.data.readers.files import read_json
from tidefield.errors import TidefieldError

MAPPING_FILE = "dataparser_transforms.json"
LARGEST_SIDE = 16384


@dataclass(frozen=True)
class ViewerPath:
    """Frames of a video in a scene's coordinates as they are on disk (its origin is not subtracted yet).

    Attributes:
        position: camera centres.
        rotation: camera-to-world with OpenCV's axes (columns: right, down, forward).
        focal_px: per frame, for square pixels.
        width: of the video; height likewise.
        frames_per_second: None where the file does not say.
    """

    position: Float64[np.ndarray, "F 3"]
    rotation: Float64[np.ndarray, "F 3 3"]
    focal_px: Float64[np.ndarray, " F"]
    width: int
    height: int
    frames_per_second: float | None


def read_viewer_path(file: Path, scene_root: Path) -> ViewerPath:
    """Read a camera path.

    Args:
        file: the JSON; `dataparser_transforms.json` beside it is used if it is there.
        scene_root: the scene's folder; where the scene comes from a transforms.json of nerfstudio's, its
            applied_transform decides which coordinates "the scene's own" are.

    Raises:
        TidefieldError: the file is missing, damaged, of another camera type, or holds poses that are none.
    """
    top = read_json(file)
    kind = top.get("camera_type", "perspective")
    if kind != "perspective":
        raise TidefieldError(f"{file} is for a camera of type {kind!r}: expected perspective; export it as that")
    frames = top.get("camera_path")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise TidefieldError(f"{file} has no list camera_path of frames: expected nerfstudio's export of a camera path")
    width, height = (_side(top, key, file) for key in ("render_width", "render_height"))
    pose = np.stack([_pose(frame, i, file) for i, frame in enumerate(frames)])
    view_angle = np.array([_angle(frame, i, file) for i, frame in enumerate(frames)])
    pose = _to_scene(pose, file.with_name(MAPPING_FILE), scene_root)
    return ViewerPath(
        position=pose[:, :3, 3],
        rotation=pose[:, :3, :3] * (1.0, -1.0, -1.0),  # OpenGL's y and z turn around
        focal_px=height / 2 / np.tan(view_angle / 2),
        width=width,
        height=height,
        frames_per_second=_speed(top, len(frames), file),
    )


def _pose(frame: dict[str, Any], index: int, file: Path) -> Float64[np.ndarray, "4 4"]:
    where = f"{file}, frame {index}: camera_to_world"
    matrix = _numbers(frame.get("camera_to_world"), (16,), where).reshape(4, 4)
    last = np.array([0.0, 0.0, 0.0, 1.0])
    if not np.allclose(matrix[3], last) and np.allclose(matrix[:, 3], last):
        matrix = matrix.T  # three.js itself stores matrices column by column
    rotation = matrix[:3, :3]
    good = np.allclose(matrix[3], last, atol=1e-6) and np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3)
    if not good or np.linalg.det(rotation) < 0:
        raise TidefieldError(f"{where} is no rotation and position in a 4 x 4 matrix; export the path again")
    u, _, vt = np.linalg.svd(rotation)
    matrix[:3, :3] = u @ vt
    return matrix


def _angle(frame: dict[str, Any], index: int, file: Path) -> float:
    degrees = float(_numbers(frame.get("fov"), (), f"{file}, frame {index}: fov"))
    if not 0 < degrees < 180:
        raise TidefieldError(f"{file}, frame {index}: fov is {degrees}: expected degrees between 0 and 180; correct it")
    return math.radians(degrees)


def _side(top: dict[str, Any], key: str, file: Path) -> int:
    side = float(_numbers(top.get(key), (), f"{file}: {key}"))
    if side != round(side) or not 1 <= side <= LARGEST_SIDE:
        raise TidefieldError(f"{file}: {key} is {side}: expected whole pixels from 1 to {LARGEST_SIDE}; correct it")
    return round(side)


def _speed(top: dict[str, Any], frames: int, file: Path) -> float | None:
    """Frames per second as stated, or as the stated duration implies."""
    for key, value in (("fps", lambda x: x), ("seconds", lambda x: frames / x)):
        if top.get(key) is not None:
            stated = float(_numbers(top[key], (), f"{file}: {key}"))
            if stated <= 0:
                raise TidefieldError(f"{file}: {key} is {stated}: expected a positive number; correct it")
            return value(stated)
    return None


def _to_scene(pose: Float64[np.ndarray, "F 4 4"], mapping_file: Path, scene_root: Path) -> Float64[np.ndarray, "F 4 4"]:
    """Undo nerfstudio's normalisation, where it is known."""
    if not mapping_file.is_file():
        return pose
    top = read_json(mapping_file)
    transform = np.eye(4)
    transform[:3] = _numbers(top.get("transform"), (3, 4), f"{mapping_file}: transform")
    scale = float(_numbers(top.get("scale"), (), f"{mapping_file}: scale"))
    described = scene_root / "transforms.json"
    if described.is_file() and not (scene_root / "sparse").is_dir():
        # The mapping starts from the coordinates before applied_transform and applied_scale; such a scene's own
        # coordinates are those after them.
        meta = read_json(described)
        applied = np.eye(4)
        if "applied_transform" in meta:
            applied[:3] = _numbers(meta["applied_transform"], (3, 4), f"{described}: applied_transform")
        transform = transform @ np.linalg.inv(applied)
        scale /= float(_numbers(meta.get("applied_scale", 1.0), (), f"{described}: applied_scale"))
    turn = transform[:3, :3]
    if scale <= 0 or not np.allclose(turn.T @ turn, np.eye(3), atol=1e-3):
        raise TidefieldError(
            f"{mapping_file} has scale {scale} and a transform of determinant {np.linalg.det(turn):.3g}: expected a "
            "positive scale and a rotation with a shift; copy the file again from nerfstudio's output folder"
        )
    scene = pose.copy()
    scene[:, :3, :3] = turn.T @ pose[:, :3, :3]
    scene[:, :3, 3] = (pose[:, :3, 3] / scale - transform[:3, 3]) @ turn
    return scene


def _numbers(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """Finite numbers of a shape, or one clear error."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all() or isinstance(value, bool | str):
        wanted = " x ".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
        raise TidefieldError(f"{where} is missing or malformed: expected {wanted}; export the path again")
    return array
