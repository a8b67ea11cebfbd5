"""Read COLMAP models, binary and text: cameras, images and points3D (https://colmap.github.io/format.html).

The files are not read by pycolmap, because a model may be damaged: pycolmap 4.2 accepts a truncated cameras.bin, with
uninitialised memory as the calibration, and hangs on a truncated frames.bin. The poses of images in rigs are complete
in the images file, so rigs and frames are not needed.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float64, Int

from tidefield.data.readers.files import in_range, inside, keep_present, naming, opened
from tidefield.data.readers.masks import masks_beside
from tidefield.data.readers.posed import Observations, PosedPhotographs
from tidefield.errors import SceneError, list_names
from tidefield.geometry.lenses import COLMAP_MODELS, COLMAP_PARAMETERS, LensModel, lens_from_colmap

_log = logging.getLogger(__name__)
_NO_POINT = -1
_OBSERVATION = np.dtype([("uv", "<f8", 2), ("point", "<i8")])
_POINT = np.dtype([("id", "i8"), ("xyz", "f8", 3), ("rgb", "u1", 3)])
_EXPECTED = "a complete file of a COLMAP model; copy or export the model again"
_MEGABYTES = 20_000


@dataclass(frozen=True)
class _Image:
    """One record of the images file: world-to-camera quaternion (w, x, y, z), translation, and observations."""

    name: str
    camera: int
    pose: Float64[np.ndarray, " 7"]
    uv_px: Float64[np.ndarray, "O 2"]
    point: Int[np.ndarray, " O"]


def find_colmap(root: Path, *folders: str) -> Path | None:
    """Find the first of these folders of a scene that holds a COLMAP model."""
    return next((root / folder for folder in folders if _suffix(root / folder)), None)


def read_colmap(root: Path, model: Path, allow_missing: bool) -> PosedPhotographs:
    """Read a COLMAP model with photographs in `root/images`.

    Raises:
        SceneError: a file is damaged, a camera model is not supported, or photographs are missing.
    """
    suffix = _suffix(model)
    assert suffix is not None, "find_colmap found no model here"
    _warn_of_others(model)
    cameras_file, images_file, points_file = (model / f"{stem}{suffix}" for stem in ("cameras", "images", "points3D"))
    is_binary = suffix == ".bin"
    with opened(cameras_file, _EXPECTED, _MEGABYTES) as file, naming(cameras_file):
        lenses = dict(_binary_cameras(file) if is_binary else _text_cameras(file))
    with opened(images_file, _EXPECTED, _MEGABYTES) as file:
        images = list(_binary_images(file) if is_binary else _text_images(file))
    with opened(points_file, _EXPECTED, _MEGABYTES) as file:
        points = np.fromiter(_binary_points(file) if is_binary else _text_points(file), dtype=_POINT)
    unknown = next((image for image in images if image.camera not in lenses), None)
    if unknown:
        raise SceneError(
            f"{images_file} assigns {unknown.name} to camera {unknown.camera}, which {cameras_file.name} does not "
            "have: expected one of its cameras; export the model again"
        )
    paths = [inside(root / "images", image.name, images_file) for image in images]
    present = keep_present(paths, images_file, allow_missing)
    masks = masks_beside((root,), [image.name for image in images], paths, present, images_file)
    images = [images[i] for i in present]
    return PosedPhotographs(
        names=tuple(image.name for image in images),
        paths=tuple(paths[i] for i in present),
        lenses=tuple(lenses[image.camera] for image in images),
        T_world_camera=_poses(images),
        points=_observations(images, points),
        masks=masks,
    )


def _warn_of_others(model: Path) -> None:
    """COLMAP writes parts of a survey that nothing connects into folders 0, 1, ...; the first may be the smallest."""
    others = sorted(
        path.name for path in model.parent.iterdir() if path != model and path.name.isdigit() and _suffix(path)
    )
    if model.name.isdigit() and others:
        _log.warning(
            f"{model.parent} has several COLMAP models, which are not connected: {model.name} is used, not "
            f"{list_names(others)}; if another has more photographs, rename its folder to {model.name}"
        )


def _suffix(model: Path) -> str | None:
    """The suffix of the format in a folder; with both formats the binary one, as in COLMAP."""
    return next((suffix for suffix in (".bin", ".txt") if (model / f"cameras{suffix}").is_file()), None)


def _poses(images: list[_Image]) -> Float64[np.ndarray, "V 3 4"]:
    pose = np.array([image.pose for image in images]).reshape(-1, 7)
    quaternion, translation = np.split(np.where(in_range(pose), pose, np.nan), [4], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):  # a quaternion of zeros becomes NaN, which is an error later
        w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    R_world_camera = np.array(  # the transpose of the quaternion's R_camera_world
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    return np.concatenate([R_world_camera, -R_world_camera @ translation[:, :, None]], axis=2)


def _observations(images: list[_Image], points: np.ndarray) -> Observations | None:
    """Observations of points, an array of `_POINT`."""
    if len(points) == 0 or not images:
        return None
    point_ids, xyz_world = points["id"], points["xyz"]
    order = np.argsort(point_ids)
    seen = np.concatenate([image.point for image in images])
    uv_px = np.concatenate([image.uv_px for image in images])
    photograph = np.repeat(np.arange(len(images)), [len(image.point) for image in images])
    row = order[np.searchsorted(point_ids, seen, sorter=order).clip(max=len(order) - 1)]
    valid = (point_ids[row] == seen) & in_range(uv_px).all(axis=1) & in_range(xyz_world[row]).all(axis=1)
    return Observations(xyz_world, row[valid], photograph[valid], uv_px[valid], points["rgb"])


class _Reader:
    """Read little-endian numbers from a file in sequence; struct.error where it ends too early."""

    def __init__(self, file: BinaryIO) -> None:
        self.bytes, self.at = file.read(), 0

    def take(self, layout: str) -> tuple:
        values = struct.unpack_from("<" + layout, self.bytes, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def count(self, smallest: int) -> int:
        """Read a number of records of at least `smallest` bytes each, which must fit into the rest of the file."""
        (count,) = self.take("Q")
        if count * smallest > len(self.bytes) - self.at:
            raise ValueError(f"it ends before the {count} records that it announces")
        return count

    def records(self, smallest: int) -> Iterator[None]:
        """Count the records of a file, which must end after the last one."""
        for _ in range(self.count(smallest)):
            yield
        if self.at != len(self.bytes):
            raise ValueError(f"it goes on for {len(self.bytes) - self.at} bytes after its last record")


def _binary_cameras(file: BinaryIO) -> Iterator[tuple[int, LensModel]]:
    reader = _Reader(file)
    for _ in reader.records(24):
        camera, model, width, height = reader.take("IiQQ")
        if not 0 <= model < len(COLMAP_MODELS):
            raise ValueError(f"it has a camera of the model number {model}, which COLMAP does not have")
        name = COLMAP_MODELS[model]
        parameters = reader.take(f"{len(COLMAP_PARAMETERS.get(name, ()))}d")
        yield camera, lens_from_colmap(name, width, height, parameters)


def _binary_images(file: BinaryIO) -> Iterator[_Image]:
    reader = _Reader(file)
    for _ in reader.records(73):
        _, *pose, camera = reader.take("I7dI")
        end = reader.bytes.index(b"\0", reader.at)
        name = reader.bytes[reader.at : end].decode()
        reader.at = end + 1
        count = reader.count(_OBSERVATION.itemsize)
        seen = np.frombuffer(reader.bytes, _OBSERVATION, count, reader.at)
        seen = seen[seen["point"] != _NO_POINT]
        reader.at += count * _OBSERVATION.itemsize
        yield _Image(name, camera, np.array(pose), seen["uv"], seen["point"])


def _binary_points(file: BinaryIO) -> Iterator[tuple[int, Sequence[float], Sequence[int]]]:
    reader = _Reader(file)
    for _ in reader.records(51):
        point, x, y, z, *colour, _ = reader.take("Q3d3Bd")  # and the error
        track = reader.count(8)
        reader.at += 8 * track  # the images file has the same observations
        yield point, (x, y, z), colour


def _lines(file: BinaryIO) -> Iterator[str]:
    return (line.strip() for line in file.read().decode().splitlines() if not line.startswith("#"))


def _text_cameras(file: BinaryIO) -> Iterator[tuple[int, LensModel]]:
    for line in filter(None, _lines(file)):
        camera, model, width, height, *parameters = line.split()
        yield int(camera), lens_from_colmap(model, int(width), int(height), [float(p) for p in parameters])


def _text_images(file: BinaryIO) -> Iterator[_Image]:
    lines = _lines(file)
    for line in filter(None, lines):
        # Two lines per image; the second is empty without observations. A name may have spaces.
        _, *pose, camera, name = line.split(maxsplit=9)
        seen = np.array((next(lines, "")).split(), dtype=np.float64).reshape(-1, 3)
        seen = seen[seen[:, 2] != _NO_POINT]
        yield _Image(
            name, int(camera), np.array(pose, dtype=np.float64).reshape(7), seen[:, :2], seen[:, 2].astype(np.int64)
        )


def _text_points(file: BinaryIO) -> Iterator[tuple[int, Sequence[float], Sequence[int]]]:
    for line in filter(None, _lines(file)):
        point, x, y, z, *colour = line.split(maxsplit=7)[:7]
        yield int(point), (float(x), float(y), float(z)), [int(c) for c in colour]
