"""Read projects of OpenSfM and OpenDroneMap (ODM): `reconstruction.json`, photographs and, if present, tracks.

OpenSfM measures photographs from their middle, in units of their longer side s. With pixel corners at integers

    u = s (f_x x_d + c_x) + width / 2,   v = s (f_y y_d + c_y) + height / 2

where x_d, y_d are distorted as in `tidefield.geometry.lenses`. EXIF orientation is not applied. A shot's
rotation (an angle-axis vector) and translation take the world into the camera, whose axes are OpenCV's.
(https://opensfm.org/docs/geometry.html; that page lacks two squares in Brown's tangential terms, which OpenSfM's code
has.)

ODM keeps OpenSfM's project in the folder opensfm, next to the photographs. With GPS it rewrites reconstruction.json in
a map projection, which shears and scales it a little, and keeps the original, in metres east, north and up of
reference_lla.json, as reconstruction.topocentric.json: then that is read.

A line of `tracks.csv` has a photograph's name, a track's (a point's) name, a feature's number and a position, separated
by tabs, and then columns that are not needed, of which later versions have more. The first line names the version; the
oldest version has no such line.
"""

from __future__ import annotations

import logging
import posixpath
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64, Int, UInt8
from scipy.spatial.transform import Rotation

from tidefield.data.pictures import read_header
from tidefield.data.readers.files import (
    in_range,
    inside,
    keep_present,
    naming,
    number,
    numbers,
    opened,
    parsing,
    read_json,
)
from tidefield.data.readers.masks import masks_beside
from tidefield.data.readers.posed import Observations, PosedPhotographs, Reference
from tidefield.errors import SceneError, list_names
from tidefield.geometry.lenses import FisheyeLens, Lens, LensModel

Object = dict[str, Any]

_MEGABYTES, _LIST_MEGABYTES, _TRACKS_MEGABYTES = 2_000, 64, 8_000
_TOPOCENTRIC = "reconstruction.topocentric.json"
_TRACKS_HEADER = "OPENSFM_TRACKS_VERSION_v"
_TRACKS_COLUMNS = {"0": 8, "1": 9, "2": 11}
# Projection type -> its distortion terms.
_TERMS = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2"),
    "fisheye_opencv": ("k1", "k2", "k3", "k4"),
}
_ONE_FOCAL = ("perspective", "fisheye")
# Reprojection error as a share of the photograph's longer side above which OpenSfM rejects an observation (its
# bundle_outlier_fixed_threshold), but keeps it in tracks.csv.
_OUTLIER = 0.006

_log = logging.getLogger(__name__)


def find_opensfm(root: Path) -> Path | None:
    """Find the reconstruction to read in an ODM project or an OpenSfM data set; None without any."""
    files = [root / folder / name for folder in ("opensfm", "") for name in (_TOPOCENTRIC, "reconstruction.json")]
    return next((file for file in files if file.is_file()), None)


def read_opensfm(root: Path, file: Path, allow_missing: bool) -> PosedPhotographs:
    """Read the largest reconstruction of a project.

    Raises:
        SceneError: a file is damaged, a lens is neither a pinhole camera with Brown's distortion nor a fisheye, or
            photographs are missing.
    """
    reconstruction = _largest(file)
    shots, cameras = _objects(reconstruction, "shots", file), _objects(reconstruction, "cameras", file)
    paths = _photographs(root, file, list(shots))
    present = keep_present(paths, file, allow_missing)
    masks = masks_beside((root, file.parent), list(shots), paths, present, file)
    names, paths = [list(shots)[i] for i in present], [paths[i] for i in present]
    lenses = tuple(_lens(name, shots[name], cameras, path, file) for name, path in zip(names, paths, strict=True))
    T_world_camera = _poses([shots[name] for name in names], names, file)
    ids, xyz_world, rgb = _points(_objects(reconstruction, "points", file), file)
    points = Observations(xyz_world, rgb=rgb) if len(ids) else None
    if (tracks_file := file.with_name("tracks.csv")).is_file():
        tracks = _read_tracks(tracks_file, names, ids, lenses)
        points = _inliers(Observations(xyz_world, *tracks, rgb), lenses, T_world_camera) or points
    return PosedPhotographs(
        names=tuple(names),
        paths=tuple(paths),
        lenses=lenses,
        T_world_camera=T_world_camera,
        points=points,
        reference=_reference(file, reconstruction),
        masks=masks,
    )


def _largest(file: Path) -> Object:
    """The reconstruction of the most photographs; a warning names the photographs of the others."""
    reconstructions = read_json(file, list, _MEGABYTES)
    if not reconstructions or not all(isinstance(one, dict) for one in reconstructions):
        raise SceneError(f"{file} holds no list of reconstructions: expected the format of OpenSfM; run it again")
    largest, *others = sorted(reconstructions, key=lambda r: len(_objects(r, "shots", file)), reverse=True)
    left = [name for other in others for name in _objects(other, "shots", file)]
    if left:
        _log.warning(
            f"{file} has {len(reconstructions)} reconstructions that are not connected: the largest, of "
            f"{len(largest['shots'])} photographs, is used; left out: {list_names(left)}"
        )
    return largest


def _objects(reconstruction: Mapping[str, Any], key: str, file: Path) -> dict[str, Object]:
    objects = reconstruction.get(key, {})
    if not isinstance(objects, dict) or not all(isinstance(one, dict) for one in objects.values()):
        raise SceneError(f"{file} has {key} that are no table of objects: expected the format of OpenSfM; run it again")
    return objects


def _photographs(root: Path, file: Path, names: Sequence[str]) -> list[Path]:
    """Paths of the photographs: in a folder images, or as listed in image_list.txt; the first if none exists."""
    folders = list(dict.fromkeys((root / "images", file.parent / "images")))
    image_list = file.with_name("image_list.txt")
    listed = _listed(root, image_list) if image_list.is_file() else {}
    paths = []
    for name in names:
        candidates = [inside(folder, name, file) for folder in folders]
        if name in listed and not any(path.is_file() for path in candidates):
            candidates.append(inside(root, listed[name], image_list))
        paths.append(next((path for path in candidates if path.is_file()), candidates[0]))
    return paths


def _listed(root: Path, image_list: Path) -> dict[str, str]:
    """Paths relative to `root` by photographs' names. Absolute ones belong to the machine that ran ODM: skipped."""
    with opened(image_list, "a path per line, in UTF-8; correct it", _LIST_MEGABYTES) as file:
        lines = file.read().decode().splitlines()
    here = image_list.parent.relative_to(root).as_posix()
    paths = [PurePosixPath(line.strip()) for line in lines if line.strip()]
    return {path.name: posixpath.join(here, path) for path in paths if not path.is_absolute()}


def _lens(name: str, shot: Object, cameras: Mapping[str, Object], path: Path, file: Path) -> LensModel:
    camera = cameras.get(str(shot.get("camera")))
    if camera is None:
        raise SceneError(
            f"{file} assigns {name} to the camera {shot.get('camera')!r}, which it does not have; run OpenSfM again"
        )
    kind = camera.get("projection_type", "perspective")
    if kind not in _TERMS:
        raise SceneError(
            f"{file} has a camera of the projection type {kind!r}: supported are {', '.join(_TERMS)}; open the folder "
            "undistorted instead, which `opensfm undistort` writes (ODM: opensfm/undistorted)"
        )
    width, height = (int(number(camera, key, file, 0.0)) for key in ("width", "height"))
    if not (width and height):
        width, height, _ = read_header(path)
    longer = max(width, height)
    focal = ("focal", "focal") if kind in _ONE_FOCAL else ("focal_x", "focal_y")
    fx, fy = (number(camera, key, file) for key in focal)
    # The principal point of cameras with one focal length is the middle; other values are ignored.
    cx, cy = (0.0 if kind in _ONE_FOCAL else number(camera, key, file, 0.0) for key in ("c_x", "c_y"))
    terms = {term: number(camera, term, file, 0.0) for term in _TERMS[kind]}
    with naming(f"{file}, {name}"):
        return (FisheyeLens if kind.startswith("fisheye") else Lens)(
            width,
            height,
            fx=fx * longer,
            fy=fy * longer,
            cx=cx * longer + width / 2,
            cy=cy * longer + height / 2,
            **terms,
        )


def _poses(shots: Sequence[Object], names: Sequence[str], file: Path) -> Float64[np.ndarray, "V 3 4"]:
    rotation, translation = (
        np.array([numbers(shot, key, f"{file}, {name},", (3,)) for shot, name in zip(shots, names, strict=True)])
        for key in ("rotation", "translation")
    )
    R_world_camera = Rotation.from_rotvec(rotation.reshape(-1, 3)).as_matrix().transpose(0, 2, 1)
    return np.concatenate([R_world_camera, -R_world_camera @ translation.reshape(-1, 3, 1)], axis=2)


def _points(
    points: Mapping[str, Object], file: Path
) -> tuple[list[str], Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Names, positions and colours of the points at finite positions."""
    with parsing(file, "points with coordinates and a color of three numbers each; run OpenSfM again"):
        xyz = np.array([point["coordinates"] for point in points.values()], dtype=np.float64).reshape(len(points), 3)
        grey = [128, 128, 128]
        rgb = np.array([point.get("color", grey) for point in points.values()], dtype=np.float64)
        rgb = rgb.reshape(len(points), 3)
        if not ((rgb >= 0) & (rgb <= 255)).all():
            raise ValueError("it has colours outside of 0 to 255")
    names, finite = list(points), np.flatnonzero(in_range(xyz).all(axis=1))
    return [names[i] for i in finite], xyz[finite], rgb[finite].astype(np.uint8)


def _read_tracks(
    file: Path, names: Sequence[str], points: Sequence[str], lenses: Sequence[LensModel]
) -> tuple[Int[np.ndarray, " O"], Int[np.ndarray, " O"], Float64[np.ndarray, "O 2"]]:
    """Read the observations of these points in these photographs: point, photograph and pixel of each."""
    photograph_of, point_of = ({name: i for i, name in enumerate(each)} for each in (names, points))
    photograph_index, point_index, xy = array("q"), array("q"), array("d")
    columns = _TRACKS_COLUMNS["0"]
    expected = "complete lines of OpenSfM's tracks; copy it again, or remove it to use no observations"
    with opened(file, expected, _TRACKS_MEGABYTES) as content:
        try:
            for row, encoded in enumerate(content):
                line = encoded.decode()
                if row == 0 and line.startswith(_TRACKS_HEADER):
                    version = line.removeprefix(_TRACKS_HEADER).strip()
                    if version not in _TRACKS_COLUMNS:
                        raise SceneError(
                            f"{file} has the version {version!r} of OpenSfM's tracks: expected "
                            f"{', '.join(_TRACKS_COLUMNS)}; remove the file to use no observations"
                        )
                    columns = _TRACKS_COLUMNS[version]
                    continue
                record = line.rstrip("\r\n").split("\t")
                if len(record) != columns:
                    raise ValueError(f"a line has {len(record)} columns, not {columns}")
                photograph, point, _, x, y, *_ = record
                if photograph in photograph_of and point in point_of:
                    photograph_index.append(photograph_of[photograph])
                    point_index.append(point_of[point])
                    xy.extend((float(x), float(y)))
        except ValueError as error:
            raise ValueError(f"{error}, after {len(xy) // 2} observations") from error
    photograph = np.array(photograph_index, dtype=np.int64)
    size = np.array([(lens.width, lens.height) for lens in lenses], dtype=np.float64).reshape(-1, 2)[photograph]
    uv_px = np.array(xy, dtype=np.float64).reshape(-1, 2) * size.max(axis=1, keepdims=True, initial=0) + size / 2
    return np.array(point_index, dtype=np.int64), photograph, uv_px


def _inliers(
    seen: Observations, lenses: Sequence[LensModel], T_world_camera: Float64[np.ndarray, "V 3 4"]
) -> Observations | None:
    """The observations that OpenSfM accepted as inliers; None without any."""
    good = np.zeros(len(seen.uv_px), dtype=bool)
    for lens, pose, mine in zip(lenses, T_world_camera, seen.by_photograph(len(lenses)), strict=True):
        xyz_camera = (seen.xyz_world[seen.point_index[mine]] - pose[:, 3]) @ pose[:, :3]
        with np.errstate(all="ignore"):  # points in the camera's plane, which are left out
            off_px = np.linalg.norm(lens.project(xyz_camera) - seen.uv_px[mine], axis=1)
        good[mine] = (xyz_camera[:, 2] > 0) & (off_px <= _OUTLIER * max(lens.width, lens.height))
    if not good.any():
        return None
    parts = {name: getattr(seen, name)[good] for name in ("point_index", "photograph_index", "uv_px")}
    return replace(seen, **parts)


def _reference(file: Path, reconstruction: Mapping[str, Any]) -> Reference | None:
    """The geographic origin, if it is stated and the reconstruction is in metres east, north and up of it."""
    # ODM moves reconstruction.json into a map projection without a mark in the file.
    folder = file.resolve().parent
    moved = folder.name == "opensfm" or (folder.parent / "odm_georeferencing").is_dir()
    original = file.name == _TOPOCENTRIC or (folder / "reconstruction.geocoords.json").is_file()
    source = file.with_name("reference_lla.json")
    if source.is_file():
        where = read_json(source)
    else:
        source, where = file, reconstruction.get("reference_lla")
    if not isinstance(where, dict):
        return None
    latitude, longitude, height = (number(where, key, source) for key in ("latitude", "longitude", "altitude"))
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        raise SceneError(
            f"{source} has the latitude {latitude} and the longitude {longitude}: expected degrees of WGS 84; correct "
            "them or remove the file"
        )
    if latitude == longitude == 0:  # what OpenSfM writes where no photograph has GPS
        return None
    if moved and not original:
        _log.warning(
            f"{file} may be in a map projection, as there is no {_TOPOCENTRIC} next to it: the scene has no geographic "
            "origin"
        )
        return None
    return Reference(latitude, longitude, height)
