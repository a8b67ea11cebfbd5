"""Read LLFF scenes: `images/` and `poses_bounds.npy` (https://github.com/Fyusion/LLFF#using-your-own-poses-without-running-colmap).

Each row of the array is a 3 x 5 matrix (the camera's down, right and backward axes in the world, its position, and
height, width, focal length in pixels) and the nearest and farthest depth of the photograph's sparse points. Rows belong
to the photographs in the order of their names; principal points are the middles.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tidefield.data.readers.files import in_range, naming, opened
from tidefield.data.readers.posed import PosedPhotographs
from tidefield.errors import SceneError
from tidefield.geometry.lenses import Lens

_FOLDERS = ("images", "images_4", "images_8")
_MEGABYTES = 64
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff")
# The bounds are the 0.1th and 99.9th percentile of the sparse points' depths; the margins are for surfaces without.
_NEAREST, _FARTHEST = 0.75, 1.25


def read_llff(root: Path) -> PosedPhotographs:
    """Read an LLFF scene with the photographs of `images`, or else of `images_4` or `images_8`.

    Raises:
        SceneError: the array is damaged, or there is not one photograph per row.
    """
    file = root / "poses_bounds.npy"
    with opened(file, "N x 17 numbers; export it again", _MEGABYTES):
        # Memory-mapped, so that nothing is allocated for a header that announces terabytes.
        rows = np.array(np.load(file, allow_pickle=False, mmap_mode="r"))
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "fiu":
        raise SceneError(f"{file} holds {rows.dtype} of shape {rows.shape}: expected N x 17 numbers; export it again")
    folder = next((root / name for name in _FOLDERS if (root / name).is_dir()), root / "images")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if len(paths) != len(rows):
        raise SceneError(
            f"{folder} has {len(paths)} photographs, but {file} has {len(rows)} poses: expected one photograph per "
            "pose, in the order of their names; add the missing ones"
        )
    matrix = rows[:, :15].astype(np.float64).reshape(-1, 3, 5)
    bounds = rows[:, 15:].astype(np.float64)
    usable = (bounds[:, 0] > 0) & (bounds[:, 0] < bounds[:, 1]) & in_range(bounds[:, 1])
    if not usable.all():
        name = paths[int(usable.argmin())].name
        raise SceneError(f"{file}: the depth bounds of {name} are unusable: expected 0 < near < far; export them again")
    down, right, backward, position = (matrix[:, :, i] for i in range(4))
    return PosedPhotographs(
        names=tuple(path.name for path in paths),
        paths=tuple(paths),
        lenses=tuple(_lens(path, *row[:, 4].tolist(), file=file) for path, row in zip(paths, matrix, strict=True)),
        T_world_camera=np.stack([right, down, -backward, position], axis=2),
        near_far=bounds * (_NEAREST, _FARTHEST),
    )


def _lens(path: Path, height: float, width: float, focal: float, *, file: Path) -> Lens:
    if not (np.isfinite([height, width]).all() and min(height, width) >= 1):
        raise SceneError(f"{file}: the size {width} x {height} of {path.name} is unusable; export it again")
    with naming(f"{file}, {path.name}"):
        return Lens(round(width), round(height), focal, focal, round(width) / 2, round(height) / 2)
