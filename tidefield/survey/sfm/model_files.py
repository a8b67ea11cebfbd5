"""Read and write the files of a COLMAP model, each of them whole.

A model may be damaged: pycolmap 4.2 accepts a truncated cameras.bin, with uninitialised memory as the calibration, and
hangs on a truncated frames.bin. Therefore all files are parsed here before pycolmap opens them.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
import pycolmap

from tidefield.data.readers.colmap import read_colmap
from tidefield.errors import SceneError

_NAMES = ("rigs.bin", "cameras.bin", "frames.bin", "images.bin", "points3D.bin")
# Of our models: a rig has one sensor, and a frame one image (https://colmap.github.io/format.html).
_RIG = np.dtype([("rig", "<u4"), ("sensors", "<u4"), ("kind", "<i4"), ("camera", "<u4")])
_FRAME = np.dtype(
    [
        *(("frame", "<u4"), ("rig", "<u4"), ("pose", "<f8", 7)),
        *(("images", "<u4"), ("kind", "<i4"), ("camera", "<u4"), ("image", "<u8")),
    ]
)


def model_files(folder: Path) -> list[Path]:
    """List the files of a model in a folder."""
    return [folder / name for name in _NAMES]


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a model that `write_model` wrote.

    Raises:
        SceneError: a file is missing or damaged.
    """
    read_colmap(folder, folder, allow_missing=True)
    for name, layout, ones in (("rigs.bin", _RIG, "sensors"), ("frames.bin", _FRAME, "images")):
        content = (folder / name).read_bytes()
        records = (
            np.frombuffer(content, layout, offset=8) if len(content) % layout.itemsize == 8 else np.empty(0, layout)
        )
        if len(content) < 8 or int.from_bytes(content[:8], "little") != len(records) or (records[ones] != 1).any():
            raise SceneError(f"{folder / name} is damaged: expected a whole file of a COLMAP model; prepare it again")
    try:
        model = pycolmap.Reconstruction(folder)
        observed = {p.point3D_id for image in model.images.values() for p in image.get_observation_points2D()}
        if not observed <= set(model.points3D):
            raise ValueError("a photograph observes points that are not there")
    except (ValueError, RuntimeError, LookupError) as error:
        raise SceneError(
            f"{folder} is damaged ({error}): expected a whole COLMAP model; prepare the scene again"
        ) from error
    return model


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model into a folder, over an older one; made if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".partial-", dir=folder) as partial:
        model.write_binary(partial)
        for name in _NAMES:
            os.replace(Path(partial, name), folder / name)
