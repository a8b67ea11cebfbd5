"""Read camera paths that nerfstudio's viewer exports ("Generate Command" writes camera_paths/NAME.json).

The file holds render_width, render_height, fps, seconds, camera_type and camera_path: per frame a camera_to_world, 16
numbers row by row or a list of 4 rows, with OpenGL's axes (+x right, +y up, -z forward), and fov, the vertical field of
view in degrees.
(nerfstudio/viewer/render_panel.py writes it, nerfstudio/cameras/camera_paths.py get_path_from_json reads it.)

nerfstudio rotates, shifts and scales a scene before training: p_viewer = scale * (transform [p; 1]). It writes both to
dataparser_transforms.json in the run's output folder; a copy of that file next to the path takes the path back into the
scene's coordinates. Without it the path is taken to be in the scene's own coordinates, as they are on disk.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from tidefield.data.readers.files import LARGEST, in_range, number, numbers, parsing, read_json
from tidefield.errors import TidefieldError

NORMALISATION_FILE = "dataparser_transforms.json"
LARGEST_SIDE = 16384.0  # the largest that x264 encodes
_NARROWEST, _WIDEST = 0.01, 179.0  # degrees
_SMALLEST_SCALE = 1e-9
_SLOWEST, _FASTEST = 0.01, 1000.0  # frames per second


@dataclass(frozen=True)
class NerfstudioPath:
    """Frames of a video in a scene's coordinates as they are on disk (its origin is not subtracted yet)."""

    position: Float64[np.ndarray, "F 3"]
    rotation: Float64[np.ndarray, "F 3 3"]
    """Camera-to-world with OpenCV's axes (columns: right, down, forward)."""
    focal_px: Float64[np.ndarray, " F"]
    """For square pixels."""
    width: int
    height: int
    frames_per_second: float | None
    """None if the file does not state it."""


def read_export(file: Path) -> Mapping[str, Any]:
    """Read the JSON of a camera path, without its poses and numbers, which need a scene.

    Raises:
        TidefieldError: the file is missing, no JSON, of another camera type, or has no frames.
    """
    top = read_json(file)
    kind = top.get("camera_type", "perspective")
    if kind != "perspective":
        raise TidefieldError(f"{file} is for a camera of type {kind!r}: expected perspective; export it as that")
    frames = top.get("camera_path")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise TidefieldError(f"{file} has no list camera_path of frames: expected nerfstudio's export of a camera path")
    return top


def read_nerfstudio_path(file: Path, scene_root: Path) -> NerfstudioPath:
    """Read a camera path into a scene's coordinates.

    Args:
        file: the JSON; a `dataparser_transforms.json` next to it is used.
        scene_root: the scene's folder; if the scene comes from a transforms.json of nerfstudio's, its
            applied_transform decides which coordinates "the scene's own" are.

    Raises:
        TidefieldError: the file is missing, damaged, of another camera type, or holds invalid poses.
    """
    top = read_export(file)
    frames = top["camera_path"]
    width, height = (number(top, key, file, least=1.0, most=LARGEST_SIDE) for key in ("render_width", "render_height"))
    placed = [(frame, f"{file}, frame {i}") for i, frame in enumerate(frames)]
    degrees = [number(frame, "fov", place, least=_NARROWEST, most=_WIDEST) for frame, place in placed]
    pose = np.stack([_pose(frame, place) for frame, place in placed])
    pose = _undo_normalisation(pose, file.with_name(NORMALISATION_FILE), scene_root)
    speed = None
    if top.get("fps") is not None:
        speed = number(top, "fps", file, least=_SLOWEST, most=_FASTEST)
    elif top.get("seconds") is not None:
        speed = len(frames) / number(top, "seconds", file, least=len(frames) / _FASTEST, most=len(frames) / _SLOWEST)
    return NerfstudioPath(
        position=pose[:, :3, 3],
        rotation=pose[:, :3, :3] * (1.0, -1.0, -1.0),  # from OpenGL's to OpenCV's y and z
        focal_px=height / 2 / np.tan(np.radians(degrees) / 2),
        width=round(width),
        height=round(height),
        frames_per_second=speed,
    )


def _pose(frame: Mapping[str, Any], place: str) -> Float64[np.ndarray, "4 4"]:
    value = frame.get("camera_to_world")
    shape = (4, 4) if isinstance(value, list) and len(value) == 4 else (16,)
    matrix = numbers(frame, "camera_to_world", place, shape).reshape(4, 4)
    last = np.array([0.0, 0.0, 0.0, 1.0])
    if not np.allclose(matrix[3], last) and np.allclose(matrix[:, 3], last):
        matrix = matrix.T  # three.js itself stores matrices column by column
    if not np.allclose(matrix[3], last, atol=1e-6) or not _is_rotation(matrix[:3, :3]):
        raise TidefieldError(
            f"{place}: camera_to_world is no rotation and position in a 4 x 4 matrix; export the path again"
        )
    u, _, vt = np.linalg.svd(matrix[:3, :3])  # orthogonal to the last digit
    matrix[:3, :3] = u @ vt
    return matrix


def _undo_normalisation(pose: Float64[np.ndarray, "F 4 4"], file: Path, root: Path) -> Float64[np.ndarray, "F 4 4"]:
    """Take poses from nerfstudio's normalised coordinates to the scene's, if `file` describes them."""
    if not file.is_file():
        return pose
    top, transform = read_json(file), np.eye(4)
    transform[:3] = numbers(top, "transform", file, (3, 4))
    scale = number(top, "scale", file, least=_SMALLEST_SCALE)
    transforms = root / "transforms.json"
    # What our own data parser wrote, which names a georeference, starts from the scene's own coordinates.
    if "georeference" not in top and transforms.is_file() and not (root / "sparse").is_dir():
        # The normalisation starts from the coordinates before applied_transform and applied_scale; such a scene's own
        # coordinates are those after them.
        meta, applied = {"applied_scale": 1.0, **read_json(transforms)}, np.eye(4)
        if "applied_transform" in meta:
            applied[:3] = numbers(meta, "applied_transform", transforms, (3, 4))
        with parsing(transforms, "a rotation and a shift as applied_transform; export it again"):
            transform = transform @ np.linalg.inv(applied)
        scale /= number(meta, "applied_scale", transforms, least=_SMALLEST_SCALE)
    rotation = transform[:3, :3]
    if not _is_rotation(rotation, mirrored=True):
        raise TidefieldError(
            f"{file} has a transform of determinant {np.linalg.det(rotation):.3g}: expected a rotation with a shift; "
            "copy the file again from nerfstudio's output folder"
        )
    scene = pose.copy()
    scene[:, :3, :3] = rotation.T @ pose[:, :3, :3]
    scene[:, :3, 3] = (pose[:, :3, 3] / scale - transform[:3, 3]) @ rotation
    if not in_range(scene).all():
        raise TidefieldError(f"{file} takes the path farther than {LARGEST:g} away: copy it and the path again")
    return scene


def _is_rotation(matrix: Float64[np.ndarray, "3 3"], mirrored: bool = False) -> bool:
    """Return whether a matrix is orthogonal to 1e-3 and, unless it may be mirrored, of positive determinant."""
    orthogonal = np.allclose(matrix.T @ matrix, np.eye(3), atol=1e-3)
    return orthogonal and (mirrored or bool(np.linalg.det(matrix) > 0))
