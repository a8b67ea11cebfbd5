"""Structure from motion of a large survey in blocks that share photographs, merged by their common cameras.

Incremental mapping adjusts all that it has again and again, so its time per photograph grows with the survey. A survey
of many photographs is therefore cut by their positions; each block is reconstructed with the photographs beyond its
border that match its own best, in a process of its own that gives its memory back, and its model is kept on disk, so
that an interrupted run loses the blocks that were being made. Models are then brought into one frame by the
photographs that they share (COLMAP's alignment by reprojections, as in its hierarchical mapping), and tracks with
common observations become one.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from tidefield.errors import RunError, SceneError
from tidefield.files import write_json
from tidefield.geometry.halves import halves
from tidefield.machine import cores
from tidefield.processes import worker_processes
from tidefield.survey.georeference.bundle_adjustment import adjustment_options, all_images, carry_over, thinned
from tidefield.survey.io.positions import degrees_of
from tidefield.survey.sfm.features import copy_photographs, decode_name, set_up_pycolmap
from tidefield.survey.sfm.mapping import Mapper, write_models
from tidefield.survey.sfm.model_files import model_files, read_model
from tidefield.survey.survey import Photograph, Progress

WHOLE = 400
"""Up to this number of photographs, a survey is one block."""
BLOCK = 200
"""Most photographs of a block, without those that it shares with others."""
SHARED_EACH = 3
"""Photographs of other blocks that each photograph brings into its own: those that match it best."""
MIN_COMMON = 4
"""Photographs that two models must share to be merged."""
MAX_ERROR_PX, MIN_CONSISTENT = 12.0, 0.3
"""Two models fit if so large a share of the common photographs' observations is met by the other's points to so many
pixels: COLMAP's share, and its limit of mapping, because two blocks bend apart before they are adjusted together."""
MAX_LEFT_PX, MIN_ANGLE_DEG = 4.0, 1.5
"""After the common adjustment: COLMAP's limits of mapping."""
DONE = "done.json"


@dataclass(frozen=True)
class Block:
    """Names of photographs that are reconstructed together.

    Attributes:
        own: that belong to this block only.
        shared: of other blocks.
    """

    own: tuple[str, ...]
    shared: tuple[str, ...]

    @property
    def names(self) -> list[str]:
        return sorted([*self.own, *self.shared])


def matched_pairs(database: Path, names: Collection[str]) -> dict[tuple[str, str], int]:
    """Read the verified pairs of photographs, and the number of their inlier matches."""
    with pycolmap.Database.open(database) as db:
        name_of = {image.image_id: decode_name(image.name) for image in db.read_all_images()}
        pairs, inliers = db.read_two_view_geometry_num_inliers()
    wanted = set(names)
    found = {}
    for pair, count in zip(pairs, inliers, strict=True):
        first, second = (name_of[number] for number in pycolmap.pair_id_to_image_pair(pair))
        if count > 0 and first in wanted and second in wanted:
            found[first, second] = int(count)
    return found


def cut(
    photographs: Sequence[Photograph], pairs: Mapping[tuple[str, str], int], whole: int = WHOLE, most: int = BLOCK
) -> list[Block]:
    """Cut a survey into blocks by the positions of its photographs; one block if it is small or has few positions.

    Areas are halved across their longer side until none has more than `most` photographs. A photograph without a
    position goes with the one that it matches best.

    Args:
        pairs: number of matches of each pair of photographs that fit together.
        whole: up to this number of photographs there is one block.
        most: photographs of a block.
    """
    names = [photograph.name for photograph in photographs]
    located = [p for p in photographs if p.position is not None]
    if len(names) <= whole or 2 * len(located) < len(names):
        return [Block(tuple(names), ())]
    degrees = degrees_of(located)
    xy = degrees * [np.cos(np.radians(np.median(degrees[:, 1]))), 1.0]
    area = {located[i].name: k for k, members in enumerate(halves(xy, most)) for i in members}
    best: dict[str, list[tuple[int, str]]] = {name: [] for name in names}
    for (first, second), count in pairs.items():
        best[first].append((-count, second))
        best[second].append((-count, first))
    for name in names:
        if name not in area:
            area[name] = next((area[other] for _, other in sorted(best[name]) if other in area), 0)
    shared: dict[int, set[str]] = {number: set() for number in area.values()}
    for name in names:
        others = [other for _, other in sorted(best[name]) if area[other] != area[name]]
        shared[area[name]] |= set(others[:SHARED_EACH])
    return [
        Block(tuple(name for name in names if area[name] == number), tuple(sorted(of)))
        for number, of in sorted(shared.items())
    ]


def reconstruct_blocks(
    database: Path, folder: Path, blocks: Sequence[Block], known: bool, mapper: Mapper, resume: bool, progress: Progress
) -> list[pycolmap.Reconstruction]:
    """Reconstruct each block, and read the models of all.

    Args:
        database: with matches.
        folder: for the models of each block, and nothing else.
        known: whether all focal lengths have a prior, and are held to it.
        resume: keep the blocks that an interrupted run of the same survey has finished.
        progress: called with the numbers of photographs in finished and in all blocks.

    Raises:
        RunError: a process was killed.
    """
    if not resume:
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    places = [folder / f"block_{k:04d}" for k in range(len(blocks))]
    missing = [k for k, place in enumerate(places) if not (place / DONE).exists()]
    size, count = [len(block.names) for block in blocks], sum(len(block.names) for block in blocks)
    done = count - sum(size[k] for k in missing)
    workers = max(1, min(cores(), len(missing)))
    threads = max(1, cores() // workers)
    for k in missing:
        shutil.rmtree(places[k], ignore_errors=True)
        (places[k] / "work").mkdir(parents=True)
    _split(database, {places[k] / "work" / "database.db": blocks[k].names for k in missing})
    try:
        with worker_processes(workers, set_up_pycolmap) as pool:
            running = {
                pool.submit(_reconstruct, places[k], blocks[k].names, known, mapper, threads): k for k in missing
            }
            for future in as_completed(running):
                future.result()
                done += size[running[future]]
                progress(done, count)
    except BrokenProcessPool as error:
        raise RunError(
            f"a process that reconstructs a block of up to {max(size)} photographs was killed, which happens when "
            f"memory runs out: expected memory for {workers} of them; give fewer --features, and continue with the "
            "same command"
        ) from error
    return [model for place in places for model in _read(place)]


def _split(database: Path, parts: Mapping[Path, Collection[str]]) -> None:
    """Write what mapping reads of some photographs to databases of their own, with the numbers of the common one."""
    with pycolmap.Database.open(database) as db:
        number_of = {decode_name(image.name): image.image_id for image in db.read_all_images()}
        pairs = [pycolmap.pair_id_to_image_pair(pair) for pair in db.read_two_view_geometry_num_inliers()[0]]
        for path, names in parts.items():
            numbers = {number_of[name] for name in names}
            with pycolmap.Database.open(path) as part, pycolmap.DatabaseTransaction(part):
                copy_photographs(db, part, sorted(numbers))
                for first, second in pairs:
                    if first in numbers and second in numbers:
                        part.write_two_view_geometry(first, second, db.read_two_view_geometry(first, second))


def _reconstruct(folder: Path, names: list[str], known: bool, mapper: Mapper, threads: int) -> None:
    """Reconstruct one block, and write its models and then a file that says that they are complete."""
    work = folder / "work"
    count = write_models(work / "database.db", work, folder, names, known, mapper, threads)
    write_json(folder / DONE, {"models": count})
    shutil.rmtree(work, ignore_errors=True)


def _read(folder: Path) -> list[pycolmap.Reconstruction]:
    places = [place for place in sorted(folder.iterdir()) if place.is_dir() and place.name.isdigit()]
    try:
        return [read_model(place) for place in places if all(file.exists() for file in model_files(place))]
    except SceneError:
        (folder / DONE).unlink(missing_ok=True)  # the next run makes it again
        raise


def merge(models: Iterable[pycolmap.Reconstruction], database: Path) -> list[pycolmap.Reconstruction]:
    """Merge models that share photographs; returns what nothing connects, the largest first.

    Args:
        models: of parts of one survey, with the numbers that its database has; they are used up.
    """
    rest, merged = sorted(models, key=lambda model: -model.num_reg_images()), []
    with pycolmap.Database.open(database) as db:
        while rest:
            whole, failed = rest.pop(0), {}
            while rest:
                registered = set(whole.reg_image_ids())
                common = [len(registered & set(model.reg_image_ids())) for model in rest]
                # What did not fit is tried again where more has been merged around it.
                ranked = [
                    k for k in np.argsort(-np.array(common), kind="stable") if common[k] > failed.get(id(rest[k]), 0)
                ]
                if not ranked or common[ranked[0]] < MIN_COMMON:
                    break
                part = rest[ranked[0]]
                similarity = pycolmap.align_reconstructions_via_reprojections(
                    part, whole, min_inlier_observations=MIN_CONSISTENT, max_reproj_error=MAX_ERROR_PX
                )
                if similarity is None:
                    failed[id(part)] = common[ranked[0]]
                    continue
                part.transform(similarity)
                add(whole, part, db)
                del rest[ranked[0]]
            merged.append(whole)
    return sorted(merged, key=lambda model: -model.num_reg_images())


def add(whole: pycolmap.Reconstruction, part: pycolmap.Reconstruction, db: pycolmap.Database) -> None:
    """Add the photographs and points of an aligned model to another, in place.

    Photographs that both have keep their poses. A track that has an observation in common with one that is there
    extends it.
    """
    for number, camera in part.cameras.items():
        if not whole.exists_camera(number):
            whole.add_camera_with_trivial_rig(camera)
    for number in sorted(set(part.reg_image_ids()) - set(whole.reg_image_ids())):
        image = part.image(number)
        keypoints = np.asarray(db.read_keypoints(number), dtype=np.float64)[:, :2]
        new = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=image.camera_id, image_id=number)
        whole.add_image_with_trivial_frame(new, image.cam_from_world())
    points2D = {number: whole.image(number).points2D for number in part.reg_image_ids()}
    for point in part.points3D.values():
        track = [(element.image_id, element.point2D_idx) for element in point.track.elements]
        owners = {points2D[i][k].point3D_id for i, k in track if points2D[i][k].has_point3D()}
        free = [(i, k) for i, k in track if not points2D[i][k].has_point3D()]
        if not owners:
            elements = [pycolmap.TrackElement(i, k) for i, k in free]
            whole.add_point3D(point.xyz, pycolmap.Track(elements), point.color)
            continue
        owner = min(owners)
        seen_by = {element.image_id for element in whole.points3D[owner].track.elements}
        for i, k in free:
            if i not in seen_by:
                whole.add_observation(owner, pycolmap.TrackElement(i, k))
                seen_by.add(i)


def settle(model: pycolmap.Reconstruction) -> None:
    """Adjust a merged model, in place, and remove the observations that do not fit: its parts were bent apart.

    Lenses keep their focal lengths. A robust loss holds what was merged wrongly back.
    """
    light = thinned(model)
    options = adjustment_options()
    options.refine_principal_point = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    config = all_images(light)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, light).solve()
    carry_over(light, model)
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_LEFT_PX, MIN_ANGLE_DEG)
