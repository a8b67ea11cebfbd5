"""Import scenes and projects of other programs as a Scene on disk."""

from __future__ import annotations

import errno
import logging
import os
import posixpath
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Int64

from tidefield.data.georeference import Georeference, find_georeference
from tidefield.data.holdout import read_holdout
from tidefield.data.images import Progress
from tidefield.data.load import own_lens, read_posed
from tidefield.data.pictures import decode, read_mask, rectify_mask, write_mask
from tidefield.data.readers.files import naming, quiet_pillow
from tidefield.data.readers.posed import Observations, PosedPhotographs
from tidefield.data.triangulate import find_points
from tidefield.errors import RunError
from tidefield.files import completed_folder, refuse_existing, write_text
from tidefield.geometry.lenses import LensModel, colmap_parameters, rectify
from tidefield.machine import cores
from tidefield.survey.export import (
    reduced_folders,
    refuse_unwritable,
    write_image,
    write_reduced_images,
    write_transforms,
)
from tidefield.survey.io.text_files import PhotographNames, leading_numbers, read_list
from tidefield.survey.survey import CHECK_FILE

_GREY = 128
_CANNOT_LINK = (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP, errno.ENOSYS)

_log = logging.getLogger(__name__)


def import_project(
    source: Path,
    out: Path,
    *,
    link: bool = False,
    undistort: bool = False,
    downscale: Sequence[int] = (),
    allow_missing: bool = False,
    progress: Progress | None = None,
) -> tuple[pycolmap.Reconstruction, Georeference | None]:
    """Make a Scene of anything that `load_scene` reads; poses (float64) and photographs (undecoded) stay unchanged.

    Only photographs with k3 are undistorted: of COLMAP's models, FULL_OPENCV alone has it, which nerfstudio and gsplat
    do not open. An OPENCV camera fitted to such a lens would keep the photograph's file, but not its geometry; the
    pinhole camera does, whatever the lens, and is what `load_scene` makes of the photograph anyway.

    Args:
        source: the project or scene.
        out: the new folder, with images/, sparse/0/, transforms.json and, if the project is georeferenced,
            georeference.json, and check_points.txt if it has one; it appears when it is complete.
        link: make hard links to the photographs instead of copies.
        undistort: undistort all photographs; the original 3D Gaussian splatting opens no others.
        downscale: factors of reduced photographs to write beside the others.
        allow_missing: continue without photographs that are listed but do not exist.
        progress: called with (written, of how many) photographs; reduced ones count once more.

    Returns:
        The scene's model, with points that are triangulated from the training photographs if the project has none that
        its photographs observed, and its georeference if the project states it.

    Raises:
        SceneError: `source` is not a scene, or is damaged.
        RunError: `out` exists already or cannot be written, or a photograph that is to be changed has a format that is
            not written.
    """
    refuse_existing(out, replaceable=False)
    reduced_folders(downscale)
    read = read_posed(source, allow_missing)
    original = _at_file_size(read)
    if original.points is None or not len(original.points.uv_px):
        found = find_points(original, read.train_and_test[0], source)
        original = replace(original, points=found or original.points)
    posed = _undistorted(original, undistort)
    each = zip(posed.paths, posed.lenses, original.lenses, strict=True)
    with quiet_pillow():
        refuse_unwritable(path for path, lens, own in each if downscale or lens != own)
    located = find_georeference(source, posed.reference)
    has_checks = located is not None and (source / CHECK_FILE).is_file()
    holdout = read_holdout(source, posed.names, allow_missing)
    if posed.near_far is not None:
        _log.warning(f"{source} states near and far bounds: the imported scene estimates its own instead")
    model = to_colmap(posed)
    count, rounds = len(posed.names), 2 if downscale else 1

    def show(done: int, _: int, before: int = 0) -> None:
        if progress is not None:
            progress(before + done, rounds * count)

    with completed_folder(out) as folder:

        def write(index: int) -> None:
            path, lens = posed.paths[index], original.lenses[index]
            target = folder / "images" / posed.names[index]
            target.parent.mkdir(parents=True, exist_ok=True)
            if posed.lenses[index] == lens:
                (_link if link else shutil.copyfile)(path, target)
            else:
                write_image(rectify(decode(path), lens, lens.width, lens.height), target, path)

        with quiet_pillow(), ThreadPoolExecutor(cores()) as pool:
            for done, _ in enumerate(pool.map(write, range(count)), start=1):
                show(done, count)
        if posed.masks:
            _write_masks(posed, original.lenses, folder / "masks")
        if downscale:
            write_reduced_images(folder, posed.names, downscale, partial(show, before=count))
        sparse = folder / "sparse" / "0"
        sparse.mkdir(parents=True)
        model.write_binary(str(sparse))
        split = holdout.split(posed.names) if holdout else posed.split
        held_out = split[1] if split else ()
        write_transforms(folder, model, held_out=held_out, masks=bool(posed.masks), z_is_up=located is not None)
        if holdout:
            replace(holdout, names=frozenset(held_out)).write(folder)
        if located is not None:
            located.write(folder)
        if has_checks:
            _write_check_points(source / CHECK_FILE, posed, original.lenses, folder / CHECK_FILE)
    return model, located


def to_colmap(posed: PosedPhotographs) -> pycolmap.Reconstruction:
    """Make a COLMAP model of posed photographs, with the simplest camera model that has all of a lens's terms.

    Points without observations get empty tracks.
    """
    model = pycolmap.Reconstruction()
    camera_of = {lens: number for number, lens in enumerate(dict.fromkeys(posed.lenses), start=1)}
    for lens, number in camera_of.items():
        name, size = lens.colmap_model, {"width": lens.width, "height": lens.height}
        camera = pycolmap.Camera(camera_id=number, model=name, params=colmap_parameters(lens, name), **size)
        model.add_camera_with_trivial_rig(camera)
    points = posed.points or Observations(np.zeros((0, 3)))
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


def _add_points(model: pycolmap.Reconstruction, points: Observations, keypoint: Int64[np.ndarray, " O"]) -> None:
    """Add the points that are finite, with their tracks.

    Args:
        keypoint: number of each observation among those of its photograph.
    """
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


def _at_file_size(posed: PosedPhotographs) -> PosedPhotographs:
    """Scale lenses and observations to the sizes of the photographs' files, and normalise names.

    Raises:
        SceneError: a file does not have its camera's shape.
    """
    names = tuple(posixpath.normpath(name.replace("\\", "/")) for name in posed.names)
    lenses = tuple(own_lens(path, lens)[0] for path, lens in zip(posed.paths, posed.lenses, strict=True))
    points = posed.points
    if points is not None:
        scale = np.array(
            [(own.width / lens.width, own.height / lens.height) for own, lens in zip(lenses, posed.lenses, strict=True)]
        )
        points = replace(points, uv_px=points.uv_px * scale[points.photograph_index])
    return replace(posed, names=names, lenses=lenses, points=points)


def _undistorted(posed: PosedPhotographs, every: bool) -> PosedPhotographs:
    """Replace Brown lenses with k3, or every lens, by their pinhole cameras, and move the observations.

    Observations that lie outside the undistorted photographs are left out.
    """
    lenses = []
    for path, lens in zip(posed.paths, posed.lenses, strict=True):
        with naming(path):
            lenses.append(lens.pinhole() if every or lens.colmap_model == "FULL_OPENCV" else lens)
    changed = sum(lens != own for lens, own in zip(lenses, posed.lenses, strict=True))
    if changed:
        _log.info(f"{changed} of {len(lenses)} photographs are undistorted and encoded again")
    points = posed.points
    if points is not None:
        uv_px = points.uv_px.copy()
        for own, lens, mine in zip(posed.lenses, lenses, points.by_photograph(len(lenses)), strict=True):
            if lens != own:
                uv_px[mine] = own.to_pinhole(uv_px[mine], lens)
        good = np.isfinite(uv_px).all(axis=1)
        parts = {name: getattr(points, name)[good] for name in ("point_index", "photograph_index")}
        points = replace(points, uv_px=uv_px[good], **parts)
    return replace(posed, lenses=tuple(lenses), points=points)


def _write_masks(posed: PosedPhotographs, lenses: Sequence[LensModel], folder: Path) -> None:
    """Write the mask of every photograph, a white one for those without; undistorted as the photographs are.

    Args:
        lenses: of the photographs' files.
    """
    for name, path, lens, own, mask in zip(posed.names, posed.paths, posed.lenses, lenses, posed.masks, strict=True):
        used = read_mask(mask, (own.width, own.height), path)
        if lens != own:
            used = rectify_mask(used, own, own.width, own.height)
        write_mask(folder / f"{name}.png", used)


def _write_check_points(source: Path, posed: PosedPhotographs, lenses: Sequence[LensModel], target: Path) -> None:
    """Write the check points of a scene, with their marks where the undistorted photographs show them.

    Args:
        lenses: of the photographs' files.
    """
    (crs, lines), names = read_list(source), PhotographNames(posed.names)
    moved = [crs]
    for _, line in lines:
        *cells, rest = line.split(maxsplit=5)
        uv_px, name = leading_numbers(cells[3:]), names.split(rest)[0]
        index = posed.names.index(name) if len(uv_px) == 2 and name else None
        if index is not None and posed.lenses[index] != lenses[index]:
            uv_px = lenses[index].to_pinhole(np.array([uv_px]), lenses[index].pinhole())[0].tolist()
            line = "\t".join([*cells[:3], *map(repr, uv_px), rest])
        if np.isfinite(uv_px).all():  # else outside of what is kept of a fisheye
            moved.append(line)
    write_text(target, "\n".join(moved) + "\n")


def _link(path: Path, target: Path) -> None:
    try:
        os.link(path.resolve(), target)  # the file itself, if the path is a symbolic link
    except OSError as error:
        if error.errno not in _CANNOT_LINK:
            raise
        raise RunError(
            f"{path} cannot be linked ({error.strerror}): expected it and the new scene on one file system that has "
            "hard links; leave --link out to copy"
        ) from error
