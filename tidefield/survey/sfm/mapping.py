"""Estimate poses, sparse points and lenses: incremental mapping by pycolmap, then a choice of the lens model.

Focal length: photographs with parallel optical axes do not determine it, whatever the relief, because a longer lens
with a scene stretched along the axes explains the matches as well. During mapping, a focal length with a prior is
therefore fixed. Afterwards it is refined only if the photographs look in different directions.

Distortion: each further term reduces the reprojection error. But vertical photographs of flat ground do not distinguish
distortion from curved ground, and the reduction may come from a bowl-shaped model. Camera positions (GPS) do
distinguish them: a lens model with more terms is chosen only if the cameras fit their positions as well as before.

Two focal lengths: some makers state one focal length of this lens and one of its design. The flight height is
proportional to the focal length, so that of the design is chosen where the drone's own height confirms it: closer than
the other's, and within what the two differ by. Ground that rises or falls from the place of take-off changes heights
by more, in both directions, and then the calibration stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotReady
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import pycolmap

from tidefield.errors import RunError, SurveyError, list_names
from tidefield.geometry.lenses import colmap_parameters, lens_from_colmap
from tidefield.processes import worker_processes
from tidefield.survey.georeference.bundle_adjustment import all_images, solve, thinned
from tidefield.survey.georeference.gps_alignment import PositionFit, fit_positions, given_positions, rms_m
from tidefield.survey.sfm.features import decode_name, encode_name, set_up_pycolmap
from tidefield.survey.sfm.model_files import read_model, write_model
from tidefield.survey.sfm.placing import MIN_INLIERS
from tidefield.survey.survey import Photograph, Progress

Result = TypeVar("Result")
Mapper = Literal["incremental", "global"]
"""pycolmap's structure from motion: one photograph after the other, or all at once."""
FEW_FEATURES = 500
"""Photographs with fewer features show too little texture, or are blurred."""
MIN_PHOTOGRAPHS = 3
"""Photographs of the smallest model."""
TERMS = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4}
"""Lens models of COLMAP, the simplest first, and their terms of distortion."""
FISHEYE_TERMS = {"SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2, "OPENCV_FISHEYE": 4}
"""The same of fisheyes."""
MAX_ERROR_RATIO = 0.99
"""More terms must reduce the reprojection error to this share, ..."""
MAX_POSITION_RATIO = 1.03
"""... and may not increase the distance from the positions above this share."""
MIN_POSITIONS = 6
"""Fewer positions cannot show whether a model is curved."""
MIN_FOCAL_DIFFERENCE = 0.01
"""Relative difference below which two stated focal lengths count as one."""
MIN_HEIGHT_M = 10.0
"""Below this, the height above take-off is too inaccurate to be compared."""
MIN_SPREAD_DEG = 10.0
"""RMS angle of the optical axes from their mean that determines the focal length."""


@dataclass(frozen=True)
class LensTrial:
    """Result of a bundle adjustment with one lens model.

    Attributes:
        lens: name of the lens model.
        error_px: mean reprojection error.
        off_m: RMS distance of the cameras from their positions, after the best similarity; None if there are too few.
        focal_px: of the first camera.
    """

    lens: str
    error_px: float
    off_m: float | None
    focal_px: float


@dataclass(frozen=True)
class Heights:
    """Flight heights above ground, relative to the drone's height above take-off, by focal length.

    Attributes:
        calibrated_px, design_px: the focal lengths that the maker states.
        calibrated_share, design_share: median of the estimated height over the drone's own.
    """

    calibrated_px: float
    design_px: float
    calibrated_share: float
    design_share: float

    @property
    def prefers_design(self) -> bool:
        closer = abs(math.log(self.design_share)) < abs(math.log(self.calibrated_share))
        return closer and self._confirms(self.design_share)

    @property
    def can_tell(self) -> bool:
        return self._confirms(self.design_share) or self._confirms(self.calibrated_share)

    def _confirms(self, share: float) -> bool:
        return abs(math.log(share)) < abs(math.log(self.design_px / self.calibrated_px))


@dataclass(frozen=True)
class LensChoice:
    """How the lens of a model was chosen. The names of the attributes are keys of `stages.json`.

    Attributes:
        trials: lens models that were tried; the last one was chosen.
        known: whether all focal lengths have a prior.
        freed: whether it was refined.
        spread_deg: RMS angle of the optical axes from their mean.
        heights: comparison of two stated focal lengths; None if there are not two.
    """

    trials: tuple[LensTrial, ...]
    known: bool
    freed: bool
    spread_deg: float
    heights: Heights | None = None


def reconstruct(
    database: Path,
    folder: Path,
    names: Collection[str],
    progress: Progress,
    known: bool,
    mapper: Mapper = "incremental",
) -> list[pycolmap.Reconstruction]:
    """Run structure from motion on the matches of photographs of a database.

    Args:
        names: of the photographs; others in the database take no part.
        folder: where pycolmap may write; created if it does not exist.
        known: whether all focal lengths have a prior, and are held to it.
        mapper: of pycolmap.

    Returns:
        The models that nothing connects, the one with the most photographs first, with the photographs' own names.

    Raises:
        SurveyError: no three photographs fit together.
        RunError: the process of the global mapper was killed.
    """
    find = _find_models_globally if mapper == "global" else find_models
    return large_enough(find(database, folder, names, progress, known, mapper), database, names)


def _find_models_globally(
    database: Path, folder: Path, names: Collection[str], progress: Progress, known: bool, mapper: Mapper
) -> list[pycolmap.Reconstruction]:
    """Run `find_models` in a process, which Ctrl-C ends: the global mapper has no way to be cancelled."""
    set_up = partial(set_up_pycolmap, pycolmap.logging.minloglevel == int(pycolmap.logging.INFO))
    try:
        with worker_processes(1, set_up) as pool:
            count = pool.submit(write_models, database, folder, folder, list(names), known, mapper).result()
    except BrokenProcessPool as error:
        raise RunError(
            f"the process that estimates the poses of {len(names)} photographs was killed, which happens when memory "
            "runs out: expected memory for all of their matches; give fewer --features, and continue with the same "
            "command"
        ) from error
    progress(len(names), len(names))
    return [read_model(folder / str(number)) for number in range(count)]


def write_models(
    database: Path,
    work: Path,
    folder: Path,
    names: Collection[str],
    known: bool,
    mapper: Mapper,
    threads: int | None = None,
) -> int:
    """Write the models of `find_models` to folders 0, 1, ... of a folder; returns their number.

    Args:
        work: where pycolmap may write.
    """
    models = find_models(database, work, names, lambda done, whole: None, known, mapper, threads)
    for number, model in enumerate(models):
        write_model(model, folder / str(number))
    return len(models)


def interruptible(job: Callable[[pycolmap.CancellationToken], Result]) -> Result:
    """Run a long job of pycolmap in a thread and cancel it on Ctrl-C, which it would not notice itself."""
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(job, token)
        try:
            while True:
                try:
                    return future.result(timeout=0.2)
                except NotReady:
                    if future.done():  # the job itself raised it
                        raise
        except BaseException:
            token.cancel()
            raise


def find_models(
    database: Path,
    folder: Path,
    names: Collection[str],
    progress: Progress,
    known: bool,
    mapper: Mapper,
    threads: int | None = None,
) -> list[pycolmap.Reconstruction]:
    """Run `reconstruct` without the error: there may be no model, and small ones.

    Args:
        threads: of the global mapper; all cores if not given. The incremental one has one thread.
    """
    count, registered = len(names), 0

    def count_image() -> None:
        nonlocal registered
        registered += 1
        progress(min(registered, count), count)

    folder.mkdir(parents=True, exist_ok=True)
    if mapper == "global":
        found = _map_globally(database, folder, names, known, threads)
        progress(count, count)
    else:
        options = pycolmap.IncrementalPipelineOptions()
        options.image_names = sorted(map(encode_name, names))
        # Several threads add up in an order that changes from run to run, and points and poses change with it; on two
        # cores they are 4% faster.
        options.num_threads = 1
        options.min_model_size, options.extract_colors, options.random_seed = MIN_PHOTOGRAPHS, False, 0
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not known
        found = interruptible(
            lambda token: pycolmap.incremental_mapping(
                database, folder, folder, options, next_image_callback=count_image, cancellation_token=token
            )
        )
    for model in found.values():
        for image in model.images.values():
            image.name = decode_name(image.name)
    return sorted(found.values(), key=lambda model: -model.num_reg_images())


def _map_globally(
    database: Path, folder: Path, names: Collection[str], known: bool, threads: int | None
) -> dict[int, pycolmap.Reconstruction]:
    """Estimate all poses at once (GLOMAP: Pan et al., Global Structure-from-Motion Revisited, ECCV 2024)."""
    options = pycolmap.GlobalPipelineOptions()
    options.image_names, options.random_seed = sorted(map(encode_name, names)), 0
    options.num_threads = options.num_threads if threads is None else threads
    options.min_model_size = MIN_PHOTOGRAPHS
    options.mapper.bundle_adjustment.refine_focal_length = not known
    models = pycolmap.global_mapping(database, folder, folder, options)
    for model in models.values():
        # Each photograph that a pair connects gets a pose, whether or not it sees any point afterwards.
        for number in list(model.reg_image_ids()):
            if model.image(number).num_points3D < MIN_INLIERS:
                model.deregister_frame(model.image(number).frame_id)
        model.tear_down()
    return models


def large_enough(
    models: list[pycolmap.Reconstruction], database: Path, names: Collection[str]
) -> list[pycolmap.Reconstruction]:
    """Select the models of three photographs or more.

    Incremental mapping may return an early attempt, all of whose photographs are in a later one.

    Args:
        models: as `find_models` returns them, the largest first.

    Raises:
        SurveyError: there is none; with what the photographs lack.
    """
    large, found = [], list[set[str]]()
    for model in models:
        own = set(registered_names(model))
        if len(own) >= MIN_PHOTOGRAPHS and not any(own <= other for other in found):
            large.append(model)
            found.append(own)
    if not large:
        fit = models[0].num_reg_images() if models else 0
        reason = _why_so_few(database, {encode_name(name) for name in names})
        raise SurveyError(
            f"{fit or 'none'} of the {len(names)} photographs fit together ({reason}): expected "
            f"at least {MIN_PHOTOGRAPHS} that overlap by half or more and show ground with some texture; fly with more "
            "overlap, or add the photographs in between"
        )
    return large


def _why_so_few(database: Path, encoded: Collection[str]) -> str:
    """Say what photographs of a database lack to fit together."""
    with pycolmap.Database.open(database) as db:
        numbers = [image.image_id for image in db.read_all_images() if image.name in encoded]
        images = {number: db.num_keypoints_for_image(number) for number in numbers}
        verified = zip(*db.read_two_view_geometry_num_inliers(), strict=True)
        pairs = [set(pycolmap.pair_id_to_image_pair(pair)) for pair, inliers in verified if inliers]
        matched = {number for pair in pairs if pair <= set(images) for number in pair}
    plain = [number for number, features in images.items() if features < FEW_FEATURES]
    single = [number for number in images if number not in matched and number not in plain]
    reasons = [
        f"{len(plain)} show too little texture, with fewer than {FEW_FEATURES} features" if plain else "",
        f"{len(single)} match no other photograph" if single else "",
    ]
    return " and ".join(filter(None, reasons)) or "their matches are too few, or too close to one line"


def registered_names(model: pycolmap.Reconstruction) -> list[str]:
    """List the photographs that have a pose, sorted by name."""
    return sorted(model.image(number).name for number in model.reg_image_ids())


def choose_lens(
    model: pycolmap.Reconstruction,
    photographs: Sequence[Photograph],
    known: bool,
    progress: Progress,
    part: pycolmap.Reconstruction | None = None,
) -> LensChoice:
    """Adjust a model, in place, with the lens model of the most terms that does not make it curved.

    Args:
        photographs: of the survey.
        known: whether all focal lengths of the model have a prior.
        part: of the model, on which lenses are tried; all of it if not given.
    """
    axes = np.array([model.image(number).viewing_direction() for number in model.reg_image_ids()])
    cosine = np.clip(axes @ axes.mean(0) / max(float(np.linalg.norm(axes.mean(0))), 1e-9), -1, 1)
    spread = float(np.degrees(np.sqrt((np.arccos(cosine) ** 2).mean())))
    light, trials = thinned(part or model), []
    try_focal = known and spread >= MIN_SPREAD_DEG
    is_fisheye = any(camera.model_name in FISHEYE_TERMS for camera in model.cameras.values())
    lenses = FISHEYE_TERMS if is_fisheye else TERMS
    steps = len(lenses) + 1 + try_focal

    def attempt(lens: str, refine_focal: bool) -> LensTrial:
        trials.append(_try_lens(light, photographs, lens, refine_focal))
        progress(len(trials), steps)
        return trials[-1]

    best = best_of([attempt(lens, not known) for lens in lenses])
    freed = not known
    if try_focal:
        refined = attempt(best.lens, True)
        freed = _is_better(refined, best)
        best = refined if freed else best
    _adjust(model, best.lens, freed)
    heights = None if freed else _compare_heights(model, photographs)
    if heights is not None and heights.prefers_design:
        (camera,) = model.cameras.values()
        for index in camera.focal_length_idxs():
            camera.params[index] = heights.design_px
        _adjust(model, best.lens, focal=False)
    progress(steps, steps)
    return LensChoice((*(trial for trial in trials if trial is not best), best), known, freed, spread, heights)


def best_of(trials: Sequence[LensTrial]) -> LensTrial:
    """Choose the last of the trials, simplest lens first, that reduces the error without making the model curved."""
    best = trials[0]
    for trial in trials[1:]:
        best = trial if _is_better(trial, best) else best
    return best


def _is_better(richer: LensTrial, simpler: LensTrial) -> bool:
    if richer.off_m is not None and simpler.off_m is not None and richer.off_m > MAX_POSITION_RATIO * simpler.off_m:
        return False
    return richer.error_px < MAX_ERROR_RATIO * simpler.error_px


def _try_lens(
    model: pycolmap.Reconstruction, photographs: Sequence[Photograph], lens: str, refine_focal: bool
) -> LensTrial:
    """Adjust a copy of a model with a lens model."""
    model = pycolmap.Reconstruction(model)
    _adjust(model, lens, refine_focal)
    fit, off_m = _fit_to_positions(model, photographs), None
    if fit is not None:
        off_m = rms_m((fit.world_from_model(fit.centres_model) - fit.given_world)[fit.used])
    camera = model.cameras[min(model.cameras)]
    return LensTrial(lens, model.compute_mean_reprojection_error(), off_m, camera.mean_focal_length())


def _adjust(model: pycolmap.Reconstruction, lens: str, focal: bool) -> None:
    """Adjust all poses, points and lenses of a model; `focal`: refine focal lengths too."""
    for camera in model.cameras.values():
        current = lens_from_colmap(camera.model.name, camera.width, camera.height, camera.params)
        mean = (current.fx + current.fy) / 2
        camera.model = getattr(pycolmap.CameraModelId, lens)
        camera.params = colmap_parameters(replace(current, fx=mean, fy=mean), lens)
    config = all_images(model)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    solve(model, config, refine_focal_length=focal, refine_principal_point=False)


def _compare_heights(model: pycolmap.Reconstruction, photographs: Sequence[Photograph]) -> Heights | None:
    """Compare flight heights; None if the maker does not state two focal lengths of one lens, or no heights exist.

    Also None where the ground is above the cameras, as wrong positions have it.
    """
    stated = {(p.lens.focal_px, p.lens.design_focal_px) for p in photographs if p.lens and p.lens.design_focal_px}
    if len(stated) != 1 or len(model.cameras) != 1:
        return None
    ((calibrated, design),) = stated
    fit = _fit_to_positions(model, photographs)
    if design is None or abs(math.log(design / calibrated)) < MIN_FOCAL_DIFFERENCE or fit is None:
        return None
    above_start_m = {p.name: p.relative_altitude_m for p in photographs}
    shares = []
    for image in (model.image(number) for number in model.reg_image_ids()):
        if image.name in fit.names and above_start_m[image.name] > MIN_HEIGHT_M:
            seen = [model.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
            if not seen:
                continue
            ground, centre = fit.world_from_model(np.array(seen)), fit.world_from_model(image.projection_center()[None])
            shares.append((centre[0, 2] - np.median(ground[:, 2])) / above_start_m[image.name])
    if len(shares) < MIN_POSITIONS:
        return None
    share = float(np.median(shares))
    if share <= 0:
        return None
    return Heights(calibrated, design, share, share * design / calibrated)


def _fit_to_positions(model: pycolmap.Reconstruction, photographs: Sequence[Photograph]) -> PositionFit | None:
    """Fit a similarity to the cameras' positions without moving the model; None if there are too few."""
    registered = set(registered_names(model))
    own = [photograph for photograph in photographs if photograph.name in registered]
    positions = given_positions(own)
    return fit_positions(model, own, positions, positions.frame()) if len(positions.names) >= MIN_POSITIONS else None


def lens_notes(choice: LensChoice, photographs: Sequence[Photograph]) -> tuple[str, ...]:
    """Describe a choice for the report, where the surveyor should know of it.

    Args:
        photographs: of the survey.
    """
    axes = f"the directions of the photographs differ by {choice.spread_deg:.0f} degrees"
    heights, (*others, best) = choice.heights, choice.trials
    notes = []
    if choice.known and choice.freed:
        prior_px, refined_px = choice.trials[0].focal_px, best.focal_px
        notes.append(f"The focal length was refined from {prior_px:.1f} to {refined_px:.1f} px: {axes}.")
    elif not choice.known and choice.spread_deg < MIN_SPREAD_DEG:
        without = [photograph.name for photograph in photographs if photograph.lens is None]
        found, advice = "The photographs do not state the focal length", "Photographs with EXIF would help."
        if len(without) < len(photographs):
            found = f"{len(without)} of {len(photographs)} photographs do not state the focal length"
            found += f" ({list_names(without)}), so that it was estimated for all"
            advice = "Write it into the EXIF of these, or leave them out."
        notes.append(
            f"{found}, and matches alone determine it badly ({axes}): unless ground control or differential GPS "
            f"correct it, heights may be wrong by tens of percent. {advice}"
        )
    if heights is not None:
        calibrated = ("calibrated", heights.calibrated_px, heights.calibrated_share)
        design = ("design", heights.design_px, heights.design_share)
        used, other = (design, calibrated) if heights.prefers_design else (calibrated, design)
        tell = "" if heights.can_tell else ", and cannot tell which one is right"
        notes.append(
            f"The maker states two focal lengths. With the {used[0]} one ({used[1]:.1f} px) the flight height is "
            f"{used[2]:.1%} of the drone's own, with the {other[0]} one ({other[1]:.1f} px) {other[2]:.1%}: the "
            f"{used[0]} one was used. The drone's height is above take-off, not above the ground{tell}."
        )
    # Why there are no more terms of distortion, where positions were the reason.
    terms_of = TERMS | FISHEYE_TERMS
    more = [t for t in others if terms_of[t.lens] > terms_of[best.lens]]
    richer = [t for t in more if t.error_px < MAX_ERROR_RATIO * best.error_px]
    if richer and best.off_m is not None:
        other, terms = min(richer, key=lambda trial: trial.error_px), terms_of[best.lens]
        notes.append(
            f"The lens has {terms} term{'s' * (terms > 1)} of distortion. With {terms_of[other.lens]} the matches "
            f"would fit better ({other.error_px:.2f} px instead of {best.error_px:.2f}), but the cameras fit their "
            f"positions worse ({other.off_m:.2f} m instead of {best.off_m:.2f}): the model would be curved."
        )
    return tuple(notes)
