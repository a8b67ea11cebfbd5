"""Read `transforms.json` of nerfstudio and instant-ngp, and the Blender scenes of the original NeRF.

Poses are camera-to-world with OpenGL's axes (+x right, +y up, -z forward). Calibration stands in a frame or, for all
frames, at the top: fl_x, fl_y, cx, cy, w, h, k1, k2, k3, p1, p2, or camera_angle_x. nerfstudio's `applied_transform`
has been applied to the poses and to the points of `ply_file_path` alike, so it is ignored here; instant-ngp's
aabb_scale, scale and offset belong to its own grid.
(https://docs.nerf.studio/quickstart/data_conventions.html)

Blender scenes have one file per part, `transforms_{train,val,test}.json`, and pictures of an object with alpha.
"""

from __future__ import annotations

import math
import posixpath
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from tidefield.data.images import read_header
from tidefield.data.ply import read_ply
from tidefield.data.readers.files import inside, keep_present, number, read_json
from tidefield.data.readers.posed import PosedPhotographs
from tidefield.errors import SceneError
from tidefield.geometry.lenses import Lens

# Blender cameras lie on a sphere around the object at the origin and point at it. The original NeRF samples from 2 to
# 6 at a radius of 4.
_BLENDER_NEAREST, _BLENDER_FARTHEST = 0.5, 1.5
_WHITE = (1.0, 1.0, 1.0)
_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")


def read_transforms(root: Path, allow_missing: bool) -> PosedPhotographs:
    """Read a folder with a transforms.json.

    The split is the file's own where it lists training and held-out photographs (test_filenames, or else
    val_filenames; photographs in neither list are left out).

    Raises:
        SceneError: the file is damaged, a lens is not a pinhole camera with Brown's distortion, or photographs are
            missing.
    """
    file = root / "transforms.json"
    top = read_json(file)
    frames, paths = _frames(top, root, file)
    train, test = _listed(top, "train_filenames", file), _listed(top, "test_filenames", file)
    test = test or _listed(top, "val_filenames", file)
    own_split = bool(train and test)
    keys = [posixpath.normpath(frame["file_path"]) for frame in frames]
    if own_split:
        used = [i for i, key in enumerate(keys) if key in train or key in test]
        frames, paths, keys = [frames[i] for i in used], [paths[i] for i in used], [keys[i] for i in used]
    present = keep_present(paths, file, allow_missing)
    frames, paths, keys = [frames[i] for i in present], [paths[i] for i in present], [keys[i] for i in present]
    names = _names(root, paths)
    cloud = _cloud(top, root, file, allow_missing)
    return PosedPhotographs(
        names=names,
        paths=tuple(paths),
        lenses=tuple(_lens({**top, **frame}, path, file) for frame, path in zip(frames, paths, strict=True)),
        T_world_camera=_poses(frames, file),
        cloud_world=None if cloud is None else cloud[0],
        cloud_rgb=None if cloud is None else cloud[1],
        split=(
            frozenset(name for name, key in zip(names, keys, strict=True) if key in train),
            frozenset(name for name, key in zip(names, keys, strict=True) if key in test and key not in train),
        )
        if own_split
        else None,
    )


def read_blender(root: Path, allow_missing: bool) -> PosedPhotographs:
    """Read a Blender scene: its train photographs for training, its test photographs (or else val) held out.

    Raises:
        SceneError: a file is damaged, or photographs are missing.
    """
    parts = [root / "transforms_train.json"]
    held_out = [root / f"transforms_{part}.json" for part in ("test", "val")]
    parts += [part for part in held_out if part.is_file()][:1]
    names, paths, lenses, poses = [], [], [], []
    for file in parts:
        top = read_json(file)
        frames, part_paths = _frames(top, root, file)
        present = keep_present(part_paths, file, allow_missing)
        frames, part_paths = [frames[i] for i in present], [part_paths[i] for i in present]
        names.append(_names(root, part_paths))
        paths += part_paths
        lenses += [_lens({**top, **frame}, path, file) for frame, path in zip(frames, part_paths, strict=True)]
        poses.append(_poses(frames, file))
    T_world_camera = np.concatenate(poses)
    distance = np.linalg.norm(T_world_camera[:, :, 3], axis=1)
    return PosedPhotographs(
        names=sum(names, ()),
        paths=tuple(paths),
        lenses=tuple(lenses),
        T_world_camera=T_world_camera,
        near_far=np.stack([_BLENDER_NEAREST * distance, _BLENDER_FARTHEST * distance], axis=1),
        split=(frozenset(names[0]), frozenset(names[1]) - frozenset(names[0])) if len(names) == 2 else None,
        background_rgb=_WHITE,
    )


def _frames(top: Mapping[str, Any], root: Path, file: Path) -> tuple[list[dict[str, Any]], list[Path]]:
    """The frames of a description, and their photographs' paths inside `root`; the suffix may be missing for PNG."""
    frames = top.get("frames")
    if not isinstance(frames, list) or not all(
        isinstance(frame, dict) and isinstance(frame.get("file_path"), str) for frame in frames
    ):
        raise SceneError(f"{file} has no list of frames with a file_path each: export it again")
    paths = []
    for frame in frames:
        path = inside(root, frame["file_path"], file)
        as_png = inside(root, frame["file_path"] + ".png", file)
        # r_0.5 may be a name without a suffix: the existing file decides.
        paths.append(path if path.is_file() or (path.suffix and not as_png.is_file()) else as_png)
    return frames, paths


def _names(root: Path, paths: Sequence[Path]) -> tuple[str, ...]:
    """Names relative to root/images where all photographs lie there, else to root."""
    base = root / "images"
    if not all(path.is_relative_to(base) for path in paths):
        base = root
    return tuple(path.relative_to(base).as_posix() for path in paths)


def _lens(values: Mapping[str, Any], path: Path, file: Path) -> Lens:
    """The lens of a frame, whose values override those of the whole file."""
    model = values.get("camera_model", "OPENCV")
    higher = [key for key in ("k4", "k5", "k6") if number(values, key, file, 0.0)]
    fisheye = values.get("is_fisheye") or "ftheta_p0" in values or "latlong" in values
    if model not in _MODELS or higher or fisheye:
        found = f"the term {higher[0]}" if higher else f"the camera model {'fisheye' if fisheye else model}"
        raise SceneError(
            f"{file} has {found} for {path.name}: expected one of {', '.join(_MODELS)} with k1, k2, k3, p1, p2; "
            "undistort the photographs first (COLMAP's image_undistorter does)"
        )
    width, height = (int(number(values, key, file, 0.0)) for key in ("w", "h"))
    if not (width and height):
        width, height, _ = read_header(path)
    fx, fy = _focal(values, "x", width, file), _focal(values, "y", height, file)
    if fx is None:
        raise SceneError(f"{file} has neither fl_x nor camera_angle_x for {path.name}: expected one; export it again")
    return Lens(
        width,
        height,
        fx=fx,
        fy=fx if fy is None else fy,
        cx=number(values, "cx", file, width / 2),
        cy=number(values, "cy", file, height / 2),
        **{key: number(values, key, file, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")},
    )


def _poses(frames: Sequence[Mapping[str, Any]], file: Path) -> Float64[np.ndarray, "V 3 4"]:
    """OpenCV camera-to-world poses of frames."""
    poses = np.zeros((len(frames), 3, 4))
    for i, frame in enumerate(frames):
        try:
            matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
        except (TypeError, ValueError):
            matrix = np.zeros(0)
        if matrix.shape not in ((4, 4), (3, 4)):
            raise SceneError(f"{file}: {frame['file_path']} has no 4 x 4 transform_matrix of numbers; export it again")
        poses[i] = matrix[:3]
    return poses * (1, -1, -1, 1)  # OpenGL's y and z axes point the other way


def _focal(values: Mapping[str, Any], axis: str, size: int, file: Path) -> float | None:
    if f"fl_{axis}" in values:
        return number(values, f"fl_{axis}", file)
    if f"camera_angle_{axis}" not in values:
        return None
    angle = number(values, f"camera_angle_{axis}", file)
    if not 0 < angle < math.pi:
        raise SceneError(f"{file} has camera_angle_{axis} = {angle}: expected radians between 0 and pi; correct it")
    return 0.5 * size / math.tan(0.5 * angle)


def _listed(top: Mapping[str, Any], key: str, file: Path) -> frozenset[str]:
    names = top.get(key) or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{file} has {key} that is not a list of file paths: correct it or remove it")
    return frozenset(map(posixpath.normpath, names))


def _cloud(
    top: Mapping[str, Any], root: Path, file: Path, allow_missing: bool
) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"] | None] | None:
    name = top.get("ply_file_path")
    if name is None:
        return None
    path = inside(root, str(name), file)
    if path.is_file():
        return read_ply(path)
    if allow_missing:
        return None
    raise SceneError(f"{file} names the points {name}, which are missing: add them, or use --allow-missing")
