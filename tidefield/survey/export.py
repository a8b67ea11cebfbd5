"""nerfstudio's `transforms.json` and point cloud beside a COLMAP model, so that `ns-train` opens the scene as it is.

As nerfstudio's own conversion of COLMAP writes them, but for the world, which it turns so that its guess of up is z:
here it stays the model's, and `applied_transform` is the identity. `train_filenames` and the like hold out the same
photographs as Tidefield does. (https://docs.nerf.studio/quickstart/data_conventions.html)
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64, UInt8

from tidefield.data.ply import write_ply
from tidefield.data.scene import every_eighth
from tidefield.files import completed_file
from tidefield.geometry.lenses import Lens, lens_from_colmap

TRANSFORMS_FILE = "transforms.json"
CLOUD_FILE = "sparse_pc.ply"

# nerfstudio computes in float32 from the beginning, which tells apart 1 mm up to so many metres from the origin.
_FARTHEST = 10_000.0


def write_transforms(
    folder: Path, model: pycolmap.Reconstruction, *, z_is_up: bool = False, overwrite: bool = False
) -> None:
    """Write `transforms.json` and `sparse_pc.ply` of a model whose photographs are in `folder/images`.

    Coordinates are the model's. Where these are too large for float32, a whole number is subtracted from each, which
    `applied_transform` states, as nerfstudio has it: what was done to the original coordinates.

    Args:
        folder: the scene.
        model: cameras with Brown's distortion; photographs without a pose are left out.
        z_is_up: whether the world's z axis points up: nerfstudio then leaves its axes alone.
        overwrite: replace the files if they are there.

    Raises:
        SceneError: for a camera that nerfstudio's and our own lenses cannot express.
        RunError: when a file is there already, or cannot be written.
    """
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    T_world_camera = np.array([image.cam_from_world().inverse().matrix() for image in images]).reshape(-1, 3, 4)
    origin = _origin(T_world_camera[:, :, 3])
    T_world_camera[:, :, 3] -= origin
    lenses = {key: _lens(camera) for key, camera in model.cameras.items()}
    calibrations = [_calibration(lenses[image.camera_id]) for image in images]
    files = [f"images/{image.name}" for image in images]
    one_for_all = len({lenses[image.camera_id] for image in images}) == 1
    train, test = ([files[i] for i in part] for part in every_eighth(len(files)))
    top: dict[str, Any] = {"camera_model": "OPENCV", **(calibrations[0] if one_for_all else {})}
    if z_is_up:
        top["orientation_override"] = "none"
    top["applied_transform"] = np.column_stack([np.eye(3), 0.0 - origin]).tolist()
    xyz_world, rgb = _points(model)
    if len(xyz_world):
        write_ply(folder / CLOUD_FILE, xyz_world - origin, rgb, overwrite)
        top["ply_file_path"] = CLOUD_FILE
    top |= {"train_filenames": train, "val_filenames": test, "test_filenames": test}
    top["frames"] = [
        {"file_path": file, "transform_matrix": _opengl(pose), **({} if one_for_all else calibration)}
        for file, pose, calibration in zip(files, T_world_camera, calibrations, strict=True)
    ]
    with completed_file(folder / TRANSFORMS_FILE, overwrite=overwrite) as partial:
        partial.write_text(json.dumps(top, indent=1, allow_nan=False), encoding="utf-8")


def _origin(position_world: Float64[np.ndarray, "V 3"]) -> Float64[np.ndarray, " 3"]:
    """What is subtracted from coordinates: nothing, unless they are too large for float32."""
    if len(position_world) == 0 or np.abs(position_world).max() <= _FARTHEST:
        return np.zeros(3)
    return np.round(position_world.mean(axis=0))


def _lens(camera: pycolmap.Camera) -> Lens:
    return lens_from_colmap(camera.model_name, camera.width, camera.height, camera.params.tolist())


def _calibration(lens: Lens) -> dict[str, int | float]:
    size = {"w": lens.width, "h": lens.height}
    pinhole = {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    return {**size, **pinhole, **dict(zip(("k1", "k2", "p1", "p2", "k3"), lens.distortion, strict=True))}


def _opengl(pose: Float64[np.ndarray, "3 4"]) -> list[list[float]]:
    """The same pose as 4 x 4 matrix, with OpenGL's camera axes (+x right, +y up, -z forward)."""
    return [*(pose * (1, -1, -1, 1)).tolist(), [0.0, 0.0, 0.0, 1.0]]


def _points(model: pycolmap.Reconstruction) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    points = [point for _, point in sorted(model.points3D.items()) if np.isfinite(point.xyz).all()]
    xyz = np.array([point.xyz for point in points], dtype=np.float64)
    rgb = np.array([point.color for point in points], dtype=np.uint8)
    return xyz.reshape(-1, 3), rgb.reshape(-1, 3)
