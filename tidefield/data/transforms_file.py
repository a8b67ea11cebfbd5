"""Write `transforms.json`, the scene format of nerfstudio, with the sparse points as a PLY file.

Poses are camera-to-world with OpenGL's axes. The split is in `train_filenames` and the like.
(https://docs.nerf.studio/quickstart/data_conventions.html)
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from tidefield.data.ply import write_ply
from tidefield.files import completed_file
from tidefield.geometry.lenses import NERFSTUDIO_MODEL, Lens

TRANSFORMS_FILE = "transforms.json"
CLOUD_FILE = "sparse_pc.ply"


def flip_axes(T_world_camera: Float64[np.ndarray, "*V 3 4"]) -> Float64[np.ndarray, "*V 3 4"]:
    """Convert poses between OpenCV's camera axes (+y down, +z forward) and OpenGL's (+y up, -z forward), either way."""
    return T_world_camera * (1, -1, -1, 1)


def write_transforms_file(
    folder: Path,
    files: Sequence[str],
    lenses: Sequence[Lens],
    T_world_camera: Float64[np.ndarray, "V 3 4"],
    split: tuple[Sequence[int], Sequence[int]],
    xyz_world: Float64[np.ndarray, "P 3"],
    rgb: UInt8[np.ndarray, "P 3"],
    *,
    header: dict[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Write `transforms.json` and, if there are points, `sparse_pc.ply`.

    A calibration that all photographs share is written once, at the top.

    Args:
        folder: the scene.
        files: photographs, relative to the folder.
        lenses: of each photograph.
        T_world_camera: poses with OpenCV's axes.
        split: indices of the training and of the held-out photographs.
        xyz_world, rgb: the sparse points.
        header: further entries at the top.
        overwrite: replace existing files.

    Raises:
        RunError: a file exists already, or cannot be written.
    """
    calibrations = [lens.nerfstudio_keys() for lens in lenses]
    is_shared = len(set(lenses)) == 1
    train, test = ([files[i] for i in part] for part in split)
    top: dict[str, Any] = {"camera_model": NERFSTUDIO_MODEL, **(calibrations[0] if is_shared else {}), **(header or {})}
    if len(xyz_world):
        write_ply(folder / CLOUD_FILE, xyz_world, rgb, overwrite)
        top["ply_file_path"] = CLOUD_FILE
    top |= {"train_filenames": train, "val_filenames": test, "test_filenames": test}
    top["frames"] = [
        {
            "file_path": file,
            "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]],
            **({} if is_shared else calibration),
        }
        for file, pose, calibration in zip(files, flip_axes(T_world_camera), calibrations, strict=True)
    ]
    with completed_file(folder / TRANSFORMS_FILE, overwrite=overwrite) as partial:
        partial.write_text(json.dumps(top, indent=1, allow_nan=False), encoding="utf-8")
