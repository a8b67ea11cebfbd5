"""From a folder on disk to a Scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from tidefield.data.exif import read_exposures
from tidefield.data.exposure import estimate_gains
from tidefield.data.hull import visual_hull
from tidefield.data.images import PhotographFile, Progress, open_photographs, read_header
from tidefield.data.near_far import near_far_from_cameras, near_far_from_cloud, near_far_from_points
from tidefield.data.readers.blender import read_blender
from tidefield.data.readers.colmap import find_colmap, read_colmap
from tidefield.data.readers.llff import read_llff
from tidefield.data.readers.opensfm import find_opensfm, read_opensfm
from tidefield.data.readers.posed import PosedPhotographs, proper_rotations
from tidefield.data.readers.transforms import read_transforms
from tidefield.data.scene import Scene, SparsePoints, every_eighth
from tidefield.errors import SceneError
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.lenses import Lens

_LAYOUTS = """expected one of
  images/ and sparse/0/ with cameras, images, points3D (.bin or .txt)    a COLMAP model
  transforms.json and the photographs that it names                      nerfstudio, instant-ngp
  transforms_train.json, transforms_test.json and their pictures         a Blender scene
  images/ and poses_bounds.npy                                           LLFF
  reconstruction.json or opensfm/reconstruction.json, and images/        OpenSfM, ODM
; make poses for the photographs first (COLMAP does it), or name the folder that holds these"""
_FEWEST = 3
_SMALLEST_WIDTH = 16


def load_scene(
    root: Path,
    *,
    width: int | None = None,
    allow_missing: bool = False,
    progress: Progress | None = None,
    cache: Path | None = None,
) -> Scene:
    """Read a scene: poses, sparse points, and photographs without distortion at the working resolution.

    Args:
        root: a folder in one of the five layouts; which of them is told from what lies in it.
        width: of every photograph in pixels, its aspect kept; None and what is wider than a photograph mean its own.
        allow_missing: go on without photographs that are named but not there.
        progress: called with (ready, of how many) while photographs are decoded; not at all when they are cached.
        cache: folder for decoded photographs; the user's if not given.

    Raises:
        SceneError: when the folder is no scene or a damaged one.
    """
    if width is not None and width < _SMALLEST_WIDTH:
        raise SceneError(f"photographs {width} pixels wide were asked for: expected at least {_SMALLEST_WIDTH}")
    posed = read_posed(root, allow_missing)
    files = tuple(map(_photograph_file, posed.paths, posed.lenses, [width] * len(posed.paths)))
    origin = posed.T_world_camera[:, :, 3].mean(axis=0)
    posed = _moved(posed, origin)
    pinholes = tuple(file.lens.pinhole().resized(file.width, file.height) for file in files)
    cameras = _cameras(posed.T_world_camera, pinholes, _near_far(posed, pinholes))
    points = _sparse_points(posed, pinholes)

    white = (1.0, 1.0, 1.0)
    photographs = open_photographs(files, posed.background_rgb or white, progress, cache)
    alphas = (photographs.alpha(i) for i in range(len(photographs)))
    see_through = any(alpha is not None and bool((alpha < 255).any()) for alpha in alphas)
    train, test = _split(posed)
    gain = estimate_gains(photographs, cameras, points, train, read_exposures(posed.paths))
    return Scene(
        root=root,
        names=posed.names,
        cameras=replace(cameras, gain=gain),
        photographs=photographs,
        points=points,
        train=train,
        test=test,
        origin_world=torch.from_numpy(origin),
        background_rgb=posed.background_rgb or (white if see_through else None),
        hull=visual_hull(cameras, photographs, train) if points is None and see_through else None,
    )


def read_posed(root: Path, allow_missing: bool) -> PosedPhotographs:
    """What a folder says of its photographs, sorted by their names; none of them is decoded.

    Args:
        root: a folder in one of the five layouts; COLMAP's model is read where there is another description, too.
        allow_missing: go on without photographs that are named but not there.

    Raises:
        SceneError: when the folder is no scene, a damaged one, or one of fewer than three photographs.
    """
    posed = _read(root, allow_missing)
    if len(posed.names) < _FEWEST:
        raise SceneError(
            f"{root} has {len(posed.names)} posed photographs: expected at least {_FEWEST}; add photographs"
        )
    return _sorted(replace(posed, T_world_camera=proper_rotations(posed.T_world_camera, posed.names, root)))


def own_lens(path: Path, lens: Lens) -> tuple[Lens, bool]:
    """The lens at its photograph's own size, and whether the photograph has an opacity channel.

    Raises:
        SceneError: when the file cannot be read, or has another aspect than its lens.
    """
    own_width, own_height, has_alpha = read_header(path)
    if abs(own_height - lens.height * own_width / lens.width) > 1:  # one pixel: an odd size was halved
        turned = " (is it stored turned? EXIF orientation is not applied)" if own_width < own_height else ""
        raise SceneError(
            f"{path} has {own_width} x {own_height} pixels, but its camera has {lens.width} x {lens.height}: expected "
            f"the same size or the same aspect{turned}; use the photographs that the poses were made with"
        )
    return lens.resized(own_width, own_height), has_alpha


def _read(root: Path, allow_missing: bool) -> PosedPhotographs:
    """Choose the layout by what is in the folder."""
    if not root.is_dir():
        raise SceneError(f"{root} is {'a file' if root.exists() else 'not there'}: {_LAYOUTS}")
    if model := find_colmap(root, "sparse/0", "sparse"):
        return read_colmap(root, model, allow_missing)
    if (root / "transforms.json").is_file():
        return read_transforms(root, allow_missing)
    if (root / "transforms_train.json").is_file():
        return read_blender(root, allow_missing)
    if (root / "poses_bounds.npy").is_file():
        return read_llff(root)
    if reconstruction := find_opensfm(root):
        return read_opensfm(root, reconstruction, allow_missing)
    if model := find_colmap(root, "colmap/sparse/0"):
        return read_colmap(root, model, allow_missing)
    found = sorted(path.name + "/" * path.is_dir() for path in root.iterdir())
    more = f" and {len(found) - 8} more" if len(found) > 8 else ""
    raise SceneError(f"{root} has no posed photographs (found: {', '.join(found[:8]) or 'nothing'}{more}): {_LAYOUTS}")


def _sorted(posed: PosedPhotographs) -> PosedPhotographs:
    """The same photographs in the order of their names."""
    order = sorted(range(len(posed.names)), key=lambda i: posed.names[i])
    points = posed.points
    if points is not None:
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        points = replace(points, photograph_index=place[points.photograph_index])
    return replace(
        posed,
        names=tuple(posed.names[i] for i in order),
        paths=tuple(posed.paths[i] for i in order),
        lenses=tuple(posed.lenses[i] for i in order),
        T_world_camera=posed.T_world_camera[order],
        near_far=None if posed.near_far is None else posed.near_far[order],
        points=points,
    )


def _photograph_file(path: Path, lens: Lens, width: int | None) -> PhotographFile:
    """What to make of a photograph; its file may have another size than its lens, of the same aspect."""
    own, has_alpha = own_lens(path, lens)
    new_width = min(width or own.width, own.width)
    new_height = max(1, round(own.height * new_width / own.width))
    return PhotographFile(path, own, new_width, new_height, has_alpha)


def _moved(posed: PosedPhotographs, origin: Float64[np.ndarray, " 3"]) -> PosedPhotographs:
    """The same in coordinates relative to a new origin."""
    T_world_camera = posed.T_world_camera.copy()
    T_world_camera[:, :, 3] -= origin
    points, cloud = posed.points, posed.cloud_world
    return replace(
        posed,
        T_world_camera=T_world_camera,
        points=points and replace(points, xyz_world=points.xyz_world - origin),
        cloud_world=None if cloud is None else cloud - origin,
    )


def _near_far(posed: PosedPhotographs, pinholes: tuple[Lens, ...]) -> Float64[np.ndarray, "V 2"]:
    if posed.near_far is not None:
        return posed.near_far
    if posed.points is not None:
        return near_far_from_points(posed.T_world_camera, pinholes, posed.points)
    if posed.cloud_world is not None:
        return near_far_from_cloud(posed.T_world_camera, pinholes, posed.cloud_world)
    return near_far_from_cameras(posed.T_world_camera)


def _cameras(
    T_world_camera: Float64[np.ndarray, "V 3 4"],
    pinholes: tuple[Lens, ...],
    near_far: Float64[np.ndarray, "V 2"],
) -> Cameras:
    return Cameras(
        T_world_camera=_float32(T_world_camera),
        focal_px=_float32([(lens.fx, lens.fy) for lens in pinholes]),
        principal_px=_float32([(lens.cx, lens.cy) for lens in pinholes]),
        size_px=torch.tensor([(lens.width, lens.height) for lens in pinholes]),
        near_far=_float32(near_far),
        gain=torch.ones(len(pinholes), 3),
    )


def _sparse_points(posed: PosedPhotographs, pinholes: tuple[Lens, ...]) -> SparsePoints | None:
    """Sparse points with their observations undistorted, without those that this puts outside of the photographs."""
    points = posed.points
    if points is None:
        return None
    uv_px = np.full((len(points.uv_px), 2), np.nan)
    off_px = np.full(len(points.uv_px), np.nan)
    observations = points.by_photograph(len(pinholes))
    for lens, pinhole, pose, mine in zip(posed.lenses, pinholes, posed.T_world_camera, observations, strict=True):
        xyz = (points.xyz_world[points.point_index[mine]] - pose[:, 3]) @ pose[:, :3]
        xy = lens.unproject(points.uv_px[mine])
        uv = xy * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
        with np.errstate(all="ignore"):  # points in the camera's plane; they are left out
            off = np.linalg.norm(pinhole.project(xyz) - uv, axis=1)
        inside = (uv >= 0).all(axis=1) & (uv < (pinhole.width, pinhole.height)).all(axis=1)
        good = inside & (xyz[:, 2] > 0) & np.isfinite(off)
        uv_px[mine[good]], off_px[mine[good]] = uv[good], off[good]
    good = np.isfinite(off_px)
    seen, point_index = np.unique(points.point_index[good], return_inverse=True)
    if len(seen) == 0:
        return None
    views = np.bincount(point_index)
    return SparsePoints(
        xyz_world=_float32(points.xyz_world[seen]),
        error_px=_float32(np.bincount(point_index, weights=off_px[good]) / views),
        point_index=torch.from_numpy(point_index.astype(np.int64)),
        camera_index=torch.from_numpy(points.photograph_index[good].astype(np.int64)),
        uv_px=_float32(uv_px[good]),
    )


def _split(posed: PosedPhotographs) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The layout's own split, or every eighth photograph held out."""
    if posed.split is None:
        return every_eighth(len(posed.names))
    train, test = (tuple(i for i, name in enumerate(posed.names) if name in part) for part in posed.split)
    assert not set(train) & set(test), "readers give disjoint parts"
    return train, test


def _float32(values: np.ndarray | Sequence[tuple[float, float]]) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float32))
