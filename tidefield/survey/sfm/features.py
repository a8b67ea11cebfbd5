"""Extract SIFT features (Lowe, 2004; as RootSIFT: Arandjelovic and Zisserman, 2012) into a COLMAP database.

pycolmap's own `extract_features` is not used, because it does not enforce the maximum number of features (more of them
make matching slower) and reports no progress.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote, unquote

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float32, UInt8

from tidefield.data.sift import find_features
from tidefield.errors import DeviceError, RunError
from tidefield.machine import cores
from tidefield.processes import in_order, worker_processes
from tidefield.survey.io.image_decoding import upright, used_pixels
from tidefield.survey.survey import Photograph, Progress

Keypoints = Float32[np.ndarray, "K 4"]
Descriptors = UInt8[np.ndarray, "K 128"]

DEFAULT_FOCAL = 1.2
"""Focal length in widths of the photograph where no prior exists: COLMAP's default. A fisheye's is that of 180 degrees
along the diagonal."""
_SAME_FOCAL = 0.02
"""Share by which priors of one lens differ at most: a digital zoom changes them by more."""
LensKind = Literal["pinhole", "fisheye"]
"""What the lens model of a survey starts from: COLMAP's OPENCV, or its OPENCV_FISHEYE."""


OPTION_RANGE = (100, 50_000)
"""Of the number of features, and of the side in pixels to which photographs are reduced."""


@dataclass(frozen=True)
class FeatureOptions:
    """Options of feature extraction.

    Raises:
        RunError: one of them is out of its range.
    """

    side_px: int = 2400
    """Longer side to which larger photographs are reduced."""
    count: int = 6000
    """Maximum number of features per photograph; the largest are kept."""

    def __post_init__(self) -> None:
        for option, value in (("--features", self.count), ("--feature-width", self.side_px)):
            if not OPTION_RANGE[0] <= value <= OPTION_RANGE[1]:
                raise RunError(
                    f"{option} is {value}: expected a number from {OPTION_RANGE[0]} to {OPTION_RANGE[1]}; give another"
                )


def choose_device(name: str) -> pycolmap.Device:
    """Choose where pycolmap computes: `auto` is CUDA if it is available, else the CPU.

    Raises:
        DeviceError: pycolmap does not support the device here.
    """
    kind = name.partition(":")[0]
    supported = ["auto", "cpu", *(["cuda"] if pycolmap.has_cuda else [])]
    if kind not in supported:
        raise DeviceError(
            f"pycolmap does not compute on {name!r} here: expected one of {', '.join(supported)}; for CUDA, install "
            "pycolmap-cuda12 instead of pycolmap"
        )
    return getattr(pycolmap.Device, kind)


def is_gpu(device: pycolmap.Device) -> bool:
    """Decide whether pycolmap computes on a GPU, of `choose_device`."""
    return pycolmap.has_cuda and device != pycolmap.Device.cpu


def workers_on(device: pycolmap.Device, count: int) -> int:
    """Processes for `count` pieces of work: one on each core; a GPU works on one piece at a time."""
    return 1 if is_gpu(device) else max(1, min(cores(), count))


def encode_name(name: str) -> str:
    """Encode a photograph's name for the database: pycolmap separates the names of a pair by a space."""
    return quote(name)


def decode_name(encoded: str) -> str:
    """Decode a photograph's name from the database."""
    return unquote(encoded)


def is_database(path: Path) -> bool:
    """Check that a file is a whole COLMAP database; pycolmap takes an empty file for one."""
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as db:
            tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master")}
            (verdict,) = db.execute("PRAGMA quick_check(1)").fetchone()
        return verdict == "ok" and {"cameras", "images", "keypoints", "descriptors"} <= tables
    except (sqlite3.Error, UnicodeError):
        return False


def lens_groups(photographs: Sequence[Photograph]) -> list[int]:
    """Number the lenses: photographs of one camera, size, orientation and focal length share a number.

    Sensors that were turned have their principal point on another side; a photograph that the drone undistorted has
    another lens than its others; and a digital zoom changes the focal length in pixels alone.
    """
    lenses: list[tuple[Any, float]] = []
    found = []
    for p in photographs:
        focal_mm, distortion = None if np.isnan(p.focal_mm) else p.focal_mm, p.lens and p.lens.distortion
        kind = p.camera, p.serial, p.width, p.height, p.orientation, focal_mm, distortion
        own = p.lens.focal_px if p.lens else 0.0
        alike = (k for k, (other, px) in enumerate(lenses) if other == kind and abs(own - px) <= _SAME_FOCAL * own)
        number = next(alike, len(lenses))
        if number == len(lenses):
            lenses.append((kind, own))
        found.append(number)
    return found


def initial_camera(photograph: Photograph, kind: LensKind = "pinhole") -> pycolmap.Camera:
    """Make an OPENCV or OPENCV_FISHEYE camera of COLMAP from the lens prior.

    Makers calibrate no fisheyes: of their priors, the focal length alone is used.
    """
    lens, width, height = photograph.lens, photograph.width, photograph.height
    if kind == "fisheye":
        focal = lens.focal_px if lens else np.hypot(width, height) / np.pi
        number = pycolmap.INVALID_CAMERA_ID
        camera = pycolmap.Camera.create_from_model_name(number, "OPENCV_FISHEYE", focal, width, height)
        camera.has_prior_focal_length = (
            True  # so that pairs are verified by rays: pixels of a fisheye fit no epipolar line
        )
        return camera
    focal = lens.focal_px if lens else DEFAULT_FOCAL * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(pycolmap.INVALID_CAMERA_ID, "OPENCV", focal, width, height)
    if lens and lens.principal_px:
        camera.principal_point_x, camera.principal_point_y = lens.principal_px
    if lens and lens.distortion:
        k1, k2, p1, p2, k3 = lens.distortion
        # OPENCV has no r^6: k1 and k2 are fitted to all three terms over the photograph.
        r2 = np.linspace(0, 0.25 * (width**2 + height**2) / lens.focal_px**2, 50)
        shift = k1 * r2 + k2 * r2**2 + k3 * r2**3
        # The displacement is r times the radial factor, and the number of pixels at radius r is proportional to r.
        terms = np.stack([r2, r2**2], 1) * r2[:, None]
        k1, k2 = np.linalg.lstsq(terms, shift * r2, rcond=None)[0]
        camera.params = [*camera.params[:4].tolist(), k1, k2, p1, p2]
    camera.has_prior_focal_length = lens is not None
    return camera


def extract(
    photographs: Sequence[Photograph],
    database: Path,
    options: FeatureOptions,
    device: pycolmap.Device,
    progress: Progress,
    kind: LensKind = "pinhole",
) -> int:
    """Write cameras, photographs and their features to a database; what it contains already is kept.

    Returns:
        The total number of features.
    """
    with pycolmap.Database.open(database) as db:
        todo = []
        for photograph, camera_id in zip(photographs, _write_cameras(db, photographs, kind), strict=True):
            image = db.read_image_with_name(encode_name(photograph.name))
            if image is None or not db.exists_descriptors(image.image_id):
                todo.append((photograph, camera_id))
        # Processes, because pycolmap holds the interpreter's lock during extraction.
        workers, done = workers_on(device, len(todo)), len(photographs) - len(todo)
        try:
            with worker_processes(workers, set_up_pycolmap) as pool:
                found = in_order(lambda one: pool.submit(_features, one[0], options, device), todo, 2 * cores() + 1)
                for (photograph, camera_id), features in found:
                    _write_features(db, photograph, camera_id, *features)
                    done += 1
                    progress(done, len(photographs))
        except BrokenProcessPool as error:
            raise RunError(
                "a process that finds features was killed, which happens when memory runs out: "
                f"expected memory for {workers} photographs at a time; give fewer --features or a smaller "
                "--feature-width, and continue with the same command"
            ) from error
        return db.num_keypoints()


def reduced_size(width: int, height: int, side_px: int) -> tuple[int, int]:
    """Compute the width and height in which features are extracted: each is rounded by itself."""
    scale = min(1.0, side_px / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def copy_photographs(db: pycolmap.Database, part: pycolmap.Database, numbers: Iterable[int]) -> None:
    """Write cameras, and some photographs with their keypoints, to a database of their own, under the same numbers.

    For processes: COLMAP locks a database while it opens it, and a second process that opens it then fails.
    """
    for camera in db.read_all_cameras():
        part.write_camera(camera, use_camera_id=True)
    for rig in db.read_all_rigs():
        part.write_rig(rig, use_rig_id=True)
    for number in numbers:
        image = db.read_image(number)
        part.write_frame(db.read_frame(image.frame_id), use_frame_id=True)
        part.write_image(image, use_image_id=True)
        part.write_keypoints(number, db.read_keypoints(number))


def set_up_pycolmap(verbose: bool = False) -> None:
    """Make pycolmap quiet, unless the user wants its log."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.INFO if verbose else pycolmap.logging.FATAL)


def _features(
    photograph: Photograph, options: FeatureOptions, device: pycolmap.Device
) -> tuple[Keypoints, Descriptors]:
    """Extract keypoints (u, v, scale, orientation; pixels of the upright photograph) and descriptors, largest first."""
    grey = cv2.cvtColor(upright(photograph), cv2.COLOR_RGB2GRAY)
    size = photograph.width, photograph.height
    reduced = reduced_size(*size, options.side_px)
    if reduced != size:
        grey = cv2.resize(grey, reduced, interpolation=cv2.INTER_AREA)
    used = used_pixels(photograph) if photograph.mask or photograph.has_alpha else None
    keypoints, descriptors = find_features(grey, options.count, device, used)
    u, v = size[0] / reduced[0], size[1] / reduced[1]
    keypoints[:, :3] *= np.array([u, v, u], dtype=np.float32)
    return keypoints, descriptors


def _write_cameras(db: pycolmap.Database, photographs: Sequence[Photograph], kind: LensKind) -> list[int]:
    """Write the cameras that the database lacks, each with its rig; return the camera of each photograph."""
    groups = lens_groups(photographs)
    # The photographs' order is fixed, so cameras have the same numbers when an interrupted run continues.
    for group in sorted(set(groups)):
        if not db.exists_camera(group + 1):
            camera = initial_camera(photographs[groups.index(group)], kind)
            camera.camera_id = group + 1
            db.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=group + 1)
            rig.add_ref_sensor(camera.sensor_id)
            db.write_rig(rig, use_rig_id=True)
    return [group + 1 for group in groups]


def _write_features(
    db: pycolmap.Database, photograph: Photograph, camera_id: int, keypoints: Keypoints, descriptors: Descriptors
) -> None:
    """Write one photograph with its frame and features, all or nothing."""
    with pycolmap.DatabaseTransaction(db):
        image = pycolmap.Image(name=encode_name(photograph.name), camera_id=camera_id)
        image.image_id = db.write_image(image)
        frame = pycolmap.Frame(rig_id=camera_id)
        frame.add_data_id(image.data_id)
        db.write_frame(frame)
        db.write_keypoints(image.image_id, keypoints)
        typed = pycolmap.FeatureDescriptors(data=descriptors, type=pycolmap.FeatureExtractorType.SIFT)
        db.write_descriptors(image.image_id, typed)
