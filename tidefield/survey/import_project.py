"""Scenes and projects of others, made into a Scene on disk: photographs, a COLMAP model, nerfstudio's transforms."""

from __future__ import annotations

import errno
import logging
import os
import posixpath
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from tidefield.data.georeference import Georeference, Residuals, read_georeference
from tidefield.data.images import Progress
from tidefield.data.load import own_lens, read_posed
from tidefield.data.readers.posed import Observations, PosedPhotographs, Reference
from tidefield.data.scene import every_eighth
from tidefield.errors import RunError, SceneError
from tidefield.files import completed_folder, refuse_existing
from tidefield.geometry.geodesy import WGS84, LocalFrame
from tidefield.geometry.lenses import Lens, colmap_parameters
from tidefield.geometry.similarity import Similarity
from tidefield.survey.export import write_transforms

_GREY = 128
_CANNOT_LINK = (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP, errno.ENOSYS)

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Imported:
    """What an imported scene has.

    Attributes:
        photographs: how many; `held_out` of them.
        cameras: different lenses.
        points: sparse points, with `observations` in photographs.
        georeference: where on Earth the world is, where the project said so.
    """

    photographs: int
    held_out: int
    cameras: int
    points: int
    observations: int
    georeference: Georeference | None


def import_project(
    source: Path,
    out: Path,
    *,
    link: bool = False,
    allow_missing: bool = False,
    progress: Progress | None = None,
) -> Imported:
    """Make a Scene of anything that `load_scene` reads: photographs and poses stay as they are, float64 and undecoded.

    Args:
        source: the project or scene.
        out: the new folder, with images/, sparse/0/, transforms.json and, where the project says where on Earth it is,
            georeference.json; it appears when it is complete.
        link: give the photographs a second name (a hard link) instead of copying them.
        allow_missing: go on without photographs that are named but not there.
        progress: called with (placed, of how many) photographs.

    Raises:
        SceneError: when `source` is no scene, or a damaged one.
        RunError: when `out` is there already or cannot be written.
    """
    refuse_existing(out, replaceable=False)
    posed = _as_on_disk(read_posed(source, allow_missing), source)
    located = read_georeference(source) or _as_stated(posed.reference)
    _tell_what_is_lost(posed, source)
    model = to_colmap(posed)
    with completed_folder(out) as folder:
        _place(posed, folder / "images", link, progress)
        sparse = folder / "sparse" / "0"
        sparse.mkdir(parents=True)
        model.write_binary(str(sparse))
        write_transforms(folder, model, z_is_up=located is not None)
        if located is not None:
            located.write(folder)
    return Imported(
        photographs=len(posed.names),
        held_out=len(every_eighth(len(posed.names))[1]),
        cameras=model.num_cameras(),
        points=model.num_points3D(),
        observations=model.compute_num_observations(),
        georeference=located,
    )


def _as_stated(reference: Reference | None) -> Georeference | None:
    """What a project says of its world, which is in metres east, north and up already."""
    if reference is None:
        return None
    return Georeference(
        frame=LocalFrame.at(WGS84, (reference.longitude_deg, reference.latitude_deg, reference.height_m)),
        source="project",
        world_from_model=Similarity(1.0, np.eye(3), np.zeros(3)),
        gps=Residuals(),
        control=Residuals(),
        check=Residuals(),
        left_out=(),
        notes=("The origin is what the imported project states; how good it is, the project knows.",),
    )


def to_colmap(posed: PosedPhotographs) -> pycolmap.Reconstruction:
    """A COLMAP model of posed photographs. Points of which nobody knows who saw them have tracks without elements."""
    model = pycolmap.Reconstruction()
    camera_of = {lens: number for number, lens in enumerate(dict.fromkeys(posed.lenses), start=1)}
    for lens, number in camera_of.items():
        model.add_camera_with_trivial_rig(_camera(lens, number))
    points = posed.points or _unseen(posed)
    rotation = posed.T_world_camera[:, :, :3].transpose(0, 2, 1)
    T_camera_world = np.concatenate([rotation, -rotation @ posed.T_world_camera[:, :, 3:]], axis=2)
    keypoint = np.zeros(len(points.uv_px), dtype=np.int64)
    for i, mine in enumerate(points.by_photograph(len(posed.names))):
        keypoint[mine] = np.arange(len(mine))
        image = pycolmap.Image(
            name=posed.names[i], keypoints=points.uv_px[mine], camera_id=camera_of[posed.lenses[i]], image_id=i + 1
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T_camera_world[i]))
    _add_points(model, points, keypoint)
    model.update_point_3d_errors()
    return model


def _camera(lens: Lens, number: int) -> pycolmap.Camera:
    """The plainest of COLMAP's cameras that has all of the lens's terms."""
    model = "FULL_OPENCV" if lens.k3 else "OPENCV" if lens.is_distorted else "PINHOLE"
    parameters = colmap_parameters(lens, model)
    return pycolmap.Camera(camera_id=number, model=model, width=lens.width, height=lens.height, params=parameters)


def _unseen(posed: PosedPhotographs) -> Observations:
    """The points without observations; none where there are none."""
    nobody = np.zeros(0, dtype=np.int64)
    cloud = np.zeros((0, 3)) if posed.cloud_world is None else posed.cloud_world
    return Observations(cloud, nobody, nobody, np.zeros((0, 2)), posed.cloud_rgb)


def _add_points(model: pycolmap.Reconstruction, points: Observations, keypoint: np.ndarray) -> None:
    order = np.argsort(points.point_index, kind="stable")
    starts = np.searchsorted(points.point_index[order], np.arange(1, len(points.xyz_world)))
    grey = np.full(3, _GREY, dtype=np.uint8)
    for k, seen in enumerate(np.split(order, starts) if len(points.xyz_world) else []):
        if not np.isfinite(points.xyz_world[k]).all():
            continue
        track = pycolmap.Track()
        for o in seen:
            track.add_element(int(points.photograph_index[o]) + 1, int(keypoint[o]))
        model.add_point3D(points.xyz_world[k], track, grey if points.rgb is None else points.rgb[k])


def _as_on_disk(posed: PosedPhotographs, source: Path) -> PosedPhotographs:
    """The same with lenses and observations at the sizes of the photographs' files, and plain names.

    Raises:
        SceneError: when a file is no photograph of its camera, or a photograph is named twice.
    """
    names = tuple(posixpath.normpath(name.replace("\\", "/")) for name in posed.names)
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise SceneError(f"{source} names the photograph {twice} twice: expected each once; take one out")
    lenses = tuple(own_lens(path, lens)[0] for path, lens in zip(posed.paths, posed.lenses, strict=True))
    points = posed.points
    if points is not None:
        scale = np.array(
            [(own.width / lens.width, own.height / lens.height) for own, lens in zip(lenses, posed.lenses, strict=True)]
        )
        points = replace(points, uv_px=points.uv_px * scale[points.photograph_index])
    return replace(posed, names=names, lenses=lenses, points=points)


def _tell_what_is_lost(posed: PosedPhotographs, source: Path) -> None:
    if posed.split is not None:
        _log.warning(f"{source} holds out photographs of its own choice: a scene has every eighth held out instead")
    if posed.near_far is not None:
        _log.warning(f"{source} states how near and far its photographs see: a scene has no place for that")


def _place(posed: PosedPhotographs, images: Path, link: bool, progress: Progress | None) -> None:
    put: Callable[[Path, Path], object] = _link if link else shutil.copyfile
    for done, (path, name) in enumerate(zip(posed.paths, posed.names, strict=True), start=1):
        target = images / name
        target.parent.mkdir(parents=True, exist_ok=True)
        put(path, target)
        if progress is not None:
            progress(done, len(posed.names))


def _link(path: Path, target: Path) -> None:
    try:
        os.link(path.resolve(), target)  # what a link names, not the link
    except OSError as error:
        if error.errno not in _CANNOT_LINK:
            raise
        raise RunError(
            f"{path} cannot be linked ({error.strerror}): expected it and the new scene on one file system that has "
            "hard links; leave --link out to copy"
        ) from error
