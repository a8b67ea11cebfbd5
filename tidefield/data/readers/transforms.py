"""Read and write `transforms.json` of nerfstudio and instant-ngp; read the Blender scenes of the original NeRF.

Poses are camera-to-world with OpenGL's axes (+x right, +y up, -z forward). Calibration stands in a frame or, for all
frames, at the top: fl_x, fl_y, cx, cy, w, h, k1, k2, k3, p1, p2 (of a fisheye k1 to k4), or camera_angle_x. The split
is in `train_filenames` and the like. nerfstudio's `applied_transform` has been applied to the poses and to the points
of `ply_file_path` alike, so it is ignored here; instant-ngp's aabb_scale, scale and offset belong to its own grid.
(https://docs.nerf.studio/quickstart/data_conventions.html)

Blender scenes have one file per part, `transforms_{train,val,test}.json`, and pictures of an object with alpha.
"""

from __future__ import annotations

import json
import logging
import math
import posixpath
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from tidefield.data.pictures import read_header
from tidefield.data.ply import read_ply, write_ply
from tidefield.data.readers.files import LARGEST, inside, keep_present, naming, number, parsing, read_json
from tidefield.data.readers.posed import Observations, PosedPhotographs
from tidefield.errors import SceneError, list_names
from tidefield.files import completed_file
from tidefield.geometry.lenses import FisheyeLens, Lens, LensModel

# Blender cameras lie on a sphere around the object at the origin and point at it. The original NeRF samples from 2 to
# 6 at a radius of 4.
_BLENDER_NEAREST, _BLENDER_FARTHEST = 0.5, 1.5
_WHITE = (1.0, 1.0, 1.0)
_IMAGES = re.compile(r"(?:^|(?<=/))images(?:_\d+)?/")
"""Folder of the photographs in a path, in their own size or a smaller one; also one within it may be named so."""
_log = logging.getLogger(__name__)
_FILE, _CLOUD = "transforms.json", "sparse_pc.ply"
_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
_FISHEYE = "OPENCV_FISHEYE"
_DISTORTION, _FISHEYE_DISTORTION = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")


def read_transforms(root: Path, allow_missing: bool) -> PosedPhotographs:
    """Read a folder with a transforms.json.

    The split is the file's own where it lists training and held-out photographs (test_filenames, or else
    val_filenames; photographs in neither list are left out).

    Raises:
        SceneError: the file is damaged, a lens is not a pinhole camera with Brown's distortion, or photographs are
            missing.
    """
    file = root / _FILE
    top = read_json(file)
    split = read_split(top, file)
    if split is not None:
        split = _split_of_frames(split, _frames(top, file), file, allow_missing)
    keys, posed = _photographs(top, root, file, allow_missing, split and (split[0] | split[1]))
    if split is not None:
        named = dict(zip(keys, posed.names, strict=True))
        train, test = (frozenset(named[key] for key in part if key in named) for part in split)
        split = train, test
    return replace(posed, points=_cloud(top, root, file, allow_missing), split=split)


def read_blender(root: Path, allow_missing: bool) -> PosedPhotographs:
    """Read a Blender scene: its train photographs for training, its test photographs (or else val) held out.

    Raises:
        SceneError: a file is damaged, or photographs are missing.
    """
    held_out = [root / f"transforms_{part}.json" for part in ("test", "val")]
    files = [root / "transforms_train.json", *[file for file in held_out if file.is_file()][:1]]
    parts = [_photographs(read_json(file), root, file, allow_missing)[1] for file in files]
    T_world_camera = np.concatenate([part.T_world_camera for part in parts])
    distance = np.linalg.norm(T_world_camera[:, :, 3].clip(-LARGEST, LARGEST), axis=1)  # farther is an error later
    train, *test = (frozenset(part.names) for part in parts)
    return PosedPhotographs(
        names=sum((part.names for part in parts), ()),
        paths=sum((part.paths for part in parts), ()),
        lenses=sum((part.lenses for part in parts), ()),
        T_world_camera=T_world_camera,
        near_far=np.stack([_BLENDER_NEAREST * distance, _BLENDER_FARTHEST * distance], axis=1),
        split=(train, test[0] - train) if test else None,
        background_rgb=_WHITE,
        masks=_joined(parts),
    )


def _joined(parts: Sequence[PosedPhotographs]) -> tuple[Path | None, ...]:
    """The masks of several parts of a scene; empty if none has any."""
    masks = sum((part.masks or (None,) * len(part.names) for part in parts), ())
    return masks if any(masks) else ()


def _photographs(
    top: Mapping[str, Any], root: Path, file: Path, allow_missing: bool, wanted: frozenset[str] | None = None
) -> tuple[list[str], PosedPhotographs]:
    """The photographs of a description, or those wanted of them, and the normalised `file_path` of each."""
    found = []
    for frame in _frames(top, file):
        path, as_png = (inside(root, frame["file_path"] + suffix, file) for suffix in ("", ".png"))
        # The suffix may be missing for PNG. r_0.5 may be a name without a suffix: the existing file decides.
        path = path if path.is_file() or (path.suffix and not as_png.is_file()) else as_png
        key = posixpath.normpath(frame["file_path"])
        if wanted is None or key in wanted:
            found.append((key, path, frame))
    found = [found[i] for i in keep_present([path for _, path, _ in found], file, allow_missing)]
    paths = tuple(path for _, path, _ in found)
    # Names are relative to root/images where all photographs lie there, else to root.
    base = root / "images"
    if not all(path.is_relative_to(base) for path in paths):
        base = root
    return [key for key, _, _ in found], PosedPhotographs(
        names=tuple(path.relative_to(base).as_posix() for path in paths),
        paths=paths,
        lenses=tuple(_lens({**top, **frame}, path, file) for _, path, frame in found),
        T_world_camera=_poses([frame for _, _, frame in found], file),
        masks=_masks([frame for _, _, frame in found], root, file, allow_missing),
    )


def _frames(top: Mapping[str, Any], file: Path) -> list[Mapping[str, Any]]:
    """The frames of a description, each with a file_path."""
    frames = top.get("frames")
    if not isinstance(frames, list) or not all(
        isinstance(frame, dict) and isinstance(frame.get("file_path"), str) for frame in frames
    ):
        raise SceneError(f"{file} has no list of frames with a file_path each: export it again")
    return frames


def _masks(frames: Sequence[Mapping[str, Any]], root: Path, file: Path, allow_missing: bool) -> tuple[Path | None, ...]:
    """The masks that frames name; empty if none does."""
    masks: list[Path | None] = []
    for frame in frames:
        name = frame.get("mask_path")
        path = None if name is None else inside(root, str(name), file)
        if path is not None and not path.is_file():
            if not allow_missing:
                raise SceneError(
                    f"{file} names the mask {name}, which is missing: add it, or use --allow-missing to use the whole "
                    "photograph"
                )
            path = None
        masks.append(path)
    return tuple(masks) if any(masks) else ()


def _lens(values: Mapping[str, Any], path: Path, file: Path) -> LensModel:
    """The lens of a frame, whose values override those of the whole file."""
    # instant-ngp has is_fisheye instead of a model's name.
    model = _FISHEYE if values.get("is_fisheye") else values.get("camera_model", "OPENCV")
    terms = _FISHEYE_DISTORTION if model == _FISHEYE else _DISTORTION
    higher = [key for key in ("k4", "k5", "k6") if key not in terms and number(values, key, file, 0.0)]
    other = next((name for key, name in (("ftheta_p0", "F-Theta"), ("latlong", "latlong")) if key in values), None)
    if model not in (*_MODELS, _FISHEYE) or higher or other:
        found = f"the term {higher[0]}" if higher else f"the camera model {other or model}"
        raise SceneError(
            f"{file} has {found} for {path.name}: expected one of {', '.join(_MODELS)} with k1, k2, k3, p1, p2, or "
            f"{_FISHEYE} with k1, k2, k3, k4; undistort the photographs first (COLMAP's image_undistorter does)"
        )
    width, height = (int(number(values, key, file, 0.0)) for key in ("w", "h"))
    if not (width and height):
        width, height, _ = read_header(path)
    fx, fy = _focal(values, "x", width, file), _focal(values, "y", height, file)
    if fx is None:
        raise SceneError(f"{file} has neither fl_x nor camera_angle_x for {path.name}: expected one; export it again")
    cx, cy = number(values, "cx", file, width / 2), number(values, "cy", file, height / 2)
    distortion = {key: number(values, key, file, 0.0) for key in terms}
    with naming(f"{file}, {path.name}"):
        kind = FisheyeLens if model == _FISHEYE else Lens
        return kind(width, height, fx, fx if fy is None else fy, cx, cy, **distortion)


def _poses(frames: Sequence[Mapping[str, Any]], file: Path) -> Float64[np.ndarray, "V 3 4"]:
    """OpenCV camera-to-world poses of frames."""
    poses = np.zeros((len(frames), 3, 4))
    for i, frame in enumerate(frames):
        with parsing(file, f"a 4 x 4 transform_matrix of numbers for {frame['file_path']}; export it again"):
            matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
            if matrix.shape not in ((4, 4), (3, 4)):
                raise ValueError(f"it has an array of shape {matrix.shape}")
            poses[i] = matrix[:3]
    return _flip_axes(poses)


def _flip_axes(T_world_camera: Float64[np.ndarray, "*V 3 4"]) -> Float64[np.ndarray, "*V 3 4"]:
    """Convert poses between OpenCV's camera axes (+y down, +z forward) and OpenGL's (+y up, -z forward), either way."""
    return T_world_camera * (1, -1, -1, 1)


def _focal(values: Mapping[str, Any], axis: str, size: int, file: Path) -> float | None:
    if f"fl_{axis}" in values:
        return number(values, f"fl_{axis}", file)
    if f"camera_angle_{axis}" not in values:
        return None
    angle = number(values, f"camera_angle_{axis}", file)
    if not 1e-9 < angle < math.pi:  # the tangent of the least is not 0
        raise SceneError(f"{file} has camera_angle_{axis} = {angle}: expected radians between 0 and pi; correct it")
    return 0.5 * size / math.tan(0.5 * angle)


def read_split(top: Mapping[str, Any], file: Path) -> tuple[frozenset[str], frozenset[str]] | None:
    """Names of the photographs that a transforms.json lists for training, and those that it holds out, if it has both.

    Raises:
        SceneError: what it has is no list of names.
    """
    train, test, val = (_listed(top, f"{part}_filenames", file) for part in ("train", "test", "val"))
    test = test or val
    return (train, test - train) if train and test else None


def find_listed(listed: Iterable[str], names: Iterable[str]) -> dict[str, str | None]:
    """Find which of these names each listed path means: the same path, the same below a folder of images in one size or
    another, or the end of a path of another machine; without suffixes where these differ. None if it means none of
    them, or may mean several."""
    by_form: dict[str, str | None] = {}
    for name in (own := set(names)):
        for form in set(_forms(name)):
            if form == name or form not in own:
                by_form[form] = None if form in by_form else name
    found = {}
    for path in listed:
        parts = path.split("/")
        ends = ["/".join(parts[k:]) for k in range(1, len(parts))] if posixpath.isabs(path) else []
        forms = [form for end in (path, *ends) for form in _forms(end)]
        found[path] = next((by_form[form] for form in forms if form in by_form), None)
    return found


def _forms(path: str) -> list[str]:
    whole = [path, *(path[found.end() :] for found in _IMAGES.finditer(path))]
    return whole + [posixpath.splitext(one)[0] for one in whole]


def _split_of_frames(
    split: tuple[frozenset[str], frozenset[str]], frames: Sequence[Mapping[str, Any]], file: Path, allow_missing: bool
) -> tuple[frozenset[str], frozenset[str]] | None:
    """A split in the file paths of frames; None, with a warning, if frames of one part are missing altogether."""
    found = find_listed(split[0] | split[1], [posixpath.normpath(frame["file_path"]) for frame in frames])
    if unknown := sorted(path for path, name in found.items() if name is None):
        lists = f"{file} lists {list_names(unknown)} for training or testing, which none of its frames has"
        if not allow_missing:
            raise SceneError(
                f"{lists}: expected their file paths; correct the lists, or leave these out with --allow-missing"
            )
        _log.warning(f"{lists}: left out")
    train, test = (frozenset(name for path in part if (name := found[path]) is not None) for part in split)
    if train and test:
        return train, test - train
    _log.warning(f"{file} has frames of only one part of its split: every eighth is held out")
    return None


def _listed(top: Mapping[str, Any], key: str, file: Path) -> frozenset[str]:
    names = top.get(key) or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{file} has {key} that is not a list of file paths: correct it or remove it")
    return frozenset(map(posixpath.normpath, names))


def _cloud(top: Mapping[str, Any], root: Path, file: Path, allow_missing: bool) -> Observations | None:
    name = top.get("ply_file_path")
    if name is None:
        return None
    path = inside(root, str(name), file)
    if path.is_file():
        cloud = read_ply(path)
        return cloud and Observations(cloud[0], rgb=cloud[1])
    if allow_missing:
        return None
    raise SceneError(f"{file} names the points {name}, which are missing: add them, or use --allow-missing")


def write_transforms_file(
    folder: Path,
    files: Sequence[str],
    lenses: Sequence[LensModel],
    T_world_camera: Float64[np.ndarray, "V 3 4"],
    split: tuple[Sequence[int], Sequence[int]],
    xyz_world: Float64[np.ndarray, "P 3"],
    rgb: UInt8[np.ndarray, "P 3"],
    *,
    masks: Sequence[str] = (),
    header: dict[str, Any] | None = None,
    per_frame: bool = False,
    overwrite: bool = False,
) -> None:
    """Write `transforms.json` and, if there are points, `sparse_pc.ply`.

    A calibration that all photographs share is written once, at the top. nerfstudio reads the camera model there alone:
    it cannot open a scene of fisheye and other lenses.

    Args:
        folder: the scene.
        files: photographs, relative to the folder.
        lenses: of each photograph.
        T_world_camera: poses with OpenCV's axes.
        split: indices of the training and of the held-out photographs.
        xyz_world, rgb: the sparse points.
        masks: of each photograph, relative to the folder; empty if no photograph has one. nerfstudio reads masks of all
            photographs or of none.
        header: further entries at the top.
        per_frame: write the calibration for each photograph even where all share it.
        overwrite: replace existing files.

    Raises:
        RunError: a file exists already, or cannot be written.
    """
    calibrations = [_calibration(lens) for lens in lenses]
    is_shared = len(set(lenses)) == 1 and not per_frame
    train, test = ([files[i] for i in part] for part in split)
    model = _FISHEYE if all(isinstance(lens, FisheyeLens) for lens in lenses) else "OPENCV"
    top: dict[str, Any] = {"camera_model": model, **(calibrations[0] if is_shared else {}), **(header or {})}
    if len(xyz_world):
        write_ply(folder / _CLOUD, xyz_world, rgb, overwrite)
        top["ply_file_path"] = _CLOUD
    top |= {"train_filenames": train, "val_filenames": test, "test_filenames": test}
    top["frames"] = [
        {
            "file_path": file,
            **({"mask_path": masks[i]} if masks else {}),
            "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]],
            **({} if is_shared else calibration),
        }
        for i, (file, pose, calibration) in enumerate(zip(files, _flip_axes(T_world_camera), calibrations, strict=True))
    ]
    with completed_file(folder / _FILE, overwrite=overwrite) as partial:
        partial.write_text(json.dumps(top, indent=1, allow_nan=False), encoding="utf-8")


def _calibration(lens: LensModel) -> dict[str, Any]:
    """The keys of a frame's lens."""
    pinhole = {"w": lens.width, "h": lens.height, "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    if isinstance(lens, FisheyeLens):
        return {"camera_model": _FISHEYE} | pinhole | {key: getattr(lens, key) for key in _FISHEYE_DISTORTION}
    return pinhole | {key: getattr(lens, key) for key in _DISTORTION}
