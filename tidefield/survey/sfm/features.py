"""Features of every photograph, in a COLMAP database: SIFT by pycolmap (Lowe, 2004; as RootSIFT, Arandjelovic and
Zisserman, 2012)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from urllib.parse import quote, unquote

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from tidefield.errors import DeviceError
from tidefield.machine import cores
from tidefield.survey.io.image_decoding import upright
from tidefield.survey.survey import LensPrior, Photograph

Progress = Callable[[int, int], object]

DEFAULT_FOCAL = 1.2
"""Focal length in widths of the photograph where nothing is known of the lens: COLMAP's guess."""


@dataclass(frozen=True)
class FeatureOptions:
    """How features are found."""

    side_px: int = 2400
    """Longer side to which larger photographs are reduced."""
    count: int = 6000
    """Features per photograph at most, the largest first."""


def lens_groups(photographs: Sequence[Photograph]) -> list[int]:
    """A number for each photograph; photographs of one camera, size and zoom share a number, and so a lens."""
    kinds = [(p.camera, p.serial, p.width, p.height, None if np.isnan(p.focal_mm) else p.focal_mm) for p in photographs]
    numbers = {kind: k for k, kind in enumerate(dict.fromkeys(kinds))}
    return [numbers[kind] for kind in kinds]


def first_camera(photograph: Photograph) -> pycolmap.Camera:
    """What is known of a photograph's lens before anything is measured, as COLMAP's OPENCV camera."""
    lens, width, height = photograph.lens, photograph.width, photograph.height
    focal = lens.focal_px if lens else DEFAULT_FOCAL * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(pycolmap.INVALID_CAMERA_ID, "OPENCV", focal, width, height)
    if lens and lens.principal_px:
        camera.principal_point_x, camera.principal_point_y = lens.principal_px
    if lens and lens.distortion:
        camera.params = [*camera.params[:4].tolist(), *_without_k3(lens, width, height).tolist()]
    camera.has_prior_focal_length = lens is not None
    return camera


def _without_k3(lens: LensPrior, width: int, height: int) -> NDArray[np.float64]:
    """(k1, k2, p1, p2) that act over the picture as the five-term distortion does: OPENCV has no r^6."""
    assert lens.distortion is not None
    k1, k2, p1, p2, k3 = lens.distortion
    r2 = np.linspace(0, 0.25 * (width**2 + height**2) / lens.focal_px**2, 50)
    shift = k1 * r2 + k2 * r2**2 + k3 * r2**3
    # Displacements in the picture are r times the radial factor, and that many pixels at radius r have it.
    weight = r2
    terms = np.stack([r2, r2**2], 1) * weight[:, None]
    k1, k2 = np.linalg.lstsq(terms, shift * weight, rcond=None)[0]
    return np.array([k1, k2, p1, p2])


def stored_name(name: str) -> str:
    """A photograph's name in the database: pycolmap's lists of pairs have spaces between names."""
    return quote(name)


def real_name(stored: str) -> str:
    """The photograph's own name again."""
    return unquote(stored)


@contextmanager
def opened(database: Path) -> Iterator[pycolmap.Database]:
    handle = pycolmap.Database.open(database)
    try:
        yield handle
    finally:
        handle.close()


def choose_device(name: str) -> pycolmap.Device:
    """Where pycolmap computes: `auto` is CUDA where it has that, else the CPU.

    Raises:
        DeviceError: for a device that pycolmap does not have.
    """
    kind = name.partition(":")[0]
    there = ["auto", "cpu", *(["cuda"] if pycolmap.has_cuda else [])]
    if kind not in there:
        raise DeviceError(
            f"pycolmap does not compute on {name!r} here: expected one of {', '.join(there)}; for CUDA, install "
            "pycolmap-cuda12 instead of pycolmap"
        )
    return getattr(pycolmap.Device, kind)


def extract(
    photographs: Sequence[Photograph],
    database: Path,
    options: FeatureOptions,
    device: pycolmap.Device,
    progress: Progress,
) -> int:
    """Write cameras, photographs and their features to a database; those that are in it already are kept.

    Returns:
        The number of features in all.
    """
    with opened(database) as db:
        cameras = _cameras(db, photographs)
        todo = []
        for photograph, camera in zip(photographs, cameras, strict=True):
            image = db.read_image_with_name(stored_name(photograph.name))
            if image is None or not db.exists_descriptors(image.image_id):
                todo.append((photograph, camera))
        done = len(photographs) - len(todo)
        # Processes, because pycolmap keeps the interpreter's lock while it looks for features; new ones, because a fork
        # of one that has threads may hang. A GPU works on one photograph at a time.
        on_gpu = pycolmap.has_cuda and device != pycolmap.Device.cpu
        workers = 1 if on_gpu else max(1, min(cores(), len(todo)))
        with ProcessPoolExecutor(workers, get_context("spawn"), _quieten) as pool:
            for photograph, camera, (keypoints, descriptors) in _in_order(pool, todo, options, device):
                _write(db, photograph, camera, keypoints, descriptors)
                done += 1
                progress(done, len(photographs))
        return db.num_keypoints()


def _in_order(
    pool: Executor, todo: Sequence[tuple[Photograph, int]], options: FeatureOptions, device: pycolmap.Device
) -> Iterator:
    """Features of photographs as they are ready, a few ahead: memory does not grow with their number."""
    ahead = 2 * cores() + 1
    running = deque(pool.submit(_features, photograph, options, device) for photograph, _ in todo[:ahead])
    for k, (photograph, camera) in enumerate(todo):
        found = running.popleft().result()
        if k + ahead < len(todo):
            running.append(pool.submit(_features, todo[k + ahead][0], options, device))
        yield photograph, camera, found


def _quieten() -> None:
    """What pycolmap logs in a process of its own would come between the lines of progress."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)


def _features(
    photograph: Photograph, options: FeatureOptions, device: pycolmap.Device
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Keypoints (K x 4: u, v, scale, orientation; upright pixels at full size) and descriptors (K x 128)."""
    grey = cv2.cvtColor(upright(photograph), cv2.COLOR_RGB2GRAY)
    shrunk = min(1.0, options.side_px / max(grey.shape))
    if shrunk < 1:
        size = (round(grey.shape[1] * shrunk), round(grey.shape[0] * shrunk))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    sift = pycolmap.FeatureExtractionOptions()
    sift.num_threads = 1
    sift.sift.max_num_features = options.count
    sift.sift.first_octave = 0
    extractor = pycolmap.FeatureExtractor.create(sift, device=device)
    found, descriptors = extractor.extract_from_uint8_array(grey)
    keypoints = np.asarray(pycolmap.keypoints_to_matrix(found), dtype=np.float32)[:, :4]
    keypoints[:, :3] *= photograph.width / grey.shape[1]
    # The largest are found again the most reliably; VLFeat gives some more than were asked for.
    largest = np.argsort(-keypoints[:, 2], kind="stable")[: options.count]
    return keypoints[largest], np.asarray(descriptors.data, dtype=np.uint8)[largest]


def _cameras(db: pycolmap.Database, photographs: Sequence[Photograph]) -> list[int]:
    """Camera of each photograph; written, with a rig of its own, where the database has none yet."""
    groups = lens_groups(photographs)
    # Photographs keep their place in the list, so the cameras' numbers are the same in every attempt.
    for group in sorted(set(groups)):
        if not db.exists_camera(group + 1):
            camera = first_camera(photographs[groups.index(group)])
            camera.camera_id = group + 1
            db.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=group + 1)
            rig.add_ref_sensor(camera.sensor_id)
            db.write_rig(rig, use_rig_id=True)
    return [group + 1 for group in groups]


def _write(
    db: pycolmap.Database, photograph: Photograph, camera: int, keypoints: NDArray, descriptors: NDArray
) -> None:
    with pycolmap.DatabaseTransaction(db):
        image = pycolmap.Image(name=stored_name(photograph.name), camera_id=camera)
        image.image_id = db.write_image(image)
        frame = pycolmap.Frame(rig_id=camera)
        frame.add_data_id(image.data_id)
        db.write_frame(frame)
        db.write_keypoints(image.image_id, keypoints)
        described = pycolmap.FeatureDescriptors(data=descriptors, type=pycolmap.FeatureExtractorType.SIFT)
        db.write_descriptors(image.image_id, described)
