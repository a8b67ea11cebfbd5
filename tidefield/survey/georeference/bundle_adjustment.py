"""Bundle adjustment: what its variants share, and the one to positions of differential receivers (RTK, PPK).

Nadir photographs over flat ground leave a model bent like a bowl if the lens distortion is slightly wrong, since the
matches fit equally well. Positions that are far more accurate than the bend remove it, and with it the errors of the
distortion and the principal point. They do not determine the focal length where all cameras fly at one height: it is
kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64

from tidefield.errors import list_names
from tidefield.geometry.lenses import colmap_parameters, lens_from_colmap
from tidefield.geometry.similarity import outliers
from tidefield.survey.georeference.gps_alignment import camera_centres, metres

DIFFERENTIAL_M = 0.3
"""Positions with a stated standard deviation below this are from a differential receiver."""
_LEAST_M = 0.01
"""Smallest standard deviation of a position, which keeps its weight finite."""
_FEWEST = 8
"""Positions that the adjustment needs, and at least half of the photographs must have one."""
_FOLDS = 4
_WORTH = 0.7
"""The model is adjusted if the distance from the positions left out falls below this share of what it was."""
_CHECK_POINTS = 20_000
_CHECK_POINTS_PER_IMAGE = 40
_IMAGES_OF_A_LENS = 8
"""A lens that took fewer photographs is kept."""
_MISMATCH = 2.0
"""Observations whose error is this many times the median are removed."""
_SIMPLER = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL")
"""COLMAP's models that OPENCV contains."""
_STEPS = 200
_TOLERANCE = 1e-7


@dataclass(frozen=True)
class Differential:
    """Positions of a differential receiver, by photograph.

    Attributes:
        given_world: the positions.
        sigma_m: their stated standard deviations, east, north and up.
    """

    given_world: dict[str, Float64[np.ndarray, " 3"]]
    sigma_m: dict[str, Float64[np.ndarray, " 3"]]


def adjust_to_positions(
    model: pycolmap.Reconstruction, positions: Differential, progress: Callable[[int, int], object]
) -> tuple[str, ...]:
    """Adjust an aligned model to differential positions, in place, if cross-validation shows that this helps.

    Each quarter of the positions is left out in turn, with the distortion fixed and free.

    Args:
        progress: called with the numbers of finished and of all adjustments.

    Returns:
        Notes on the adjustment; none if the model was not adjusted.
    """
    names = sorted(positions.given_world)
    if len(names) < max(_FEWEST, model.num_reg_images() / 2):
        return ()
    before = _residual_m(model, positions, names)
    light = thinned(model)
    left_out: dict[bool, Float64[np.ndarray, "N 3"]] = {}
    for done, free in enumerate((False, True)):
        # Each fold starts here, close to its own minimum.
        start = _adjusted(light, positions, names, free)
        error = np.empty((len(names), 3))
        for fold in range(_FOLDS):
            progress(done * _FOLDS + fold, 2 * _FOLDS)
            own = names[fold::_FOLDS]
            error[fold::_FOLDS] = _residual_m(_adjusted(start, positions, set(names) - set(own), free), positions, own)
        left_out[free] = error
    progress(1, 1)
    free = min(left_out, key=lambda mode: _median(left_out[mode]))
    after = left_out[free]
    if _median(after) > _WORTH * _median(before):
        return ()
    wrong = outliers(np.linalg.norm(after, axis=1), 5 * np.array([np.linalg.norm(positions.sigma_m[n]) for n in names]))
    rejected = [name for name, is_wrong in zip(names, wrong, strict=True) if is_wrong]
    carry_over(_adjusted(model, positions, set(names) - set(rejected), free), model)
    was, now = (
        f"{metres(_rms(error[~wrong, :2]))} horizontally and {metres(_rms(error[~wrong, 2:]))} vertically"
        for error in (before, after)
    )
    notes = [
        "The photographs were adjusted to their differential positions: positions left out in turn are met within "
        f"{now}, instead of {was}."
    ]
    if free:
        notes.append("This corrected the lens distortion and the principal point.")
    if rejected:
        notes.append(f"The positions of {list_names(rejected)} are worse than they state, and were not used for this.")
    return tuple(notes)


def carry_over(adjusted: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> None:
    """Copy the lenses and poses of an adjusted copy to a model, and triangulate the model's points again."""
    for number, camera in adjusted.cameras.items():
        model.cameras[number].model = camera.model
        model.cameras[number].params = camera.params
    for number in model.reg_frame_ids():
        model.frames[number].rig_from_world = adjusted.frames[number].rig_from_world
    for number, point in model.points3D.items():
        if adjusted.exists_point3D(number):
            point.xyz = adjusted.points3D[number].xyz
    config = all_images(model)
    for number in model.cameras:
        config.set_constant_cam_intrinsics(number)
    options = adjustment_options()
    options.refine_rig_from_world = False
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def reliable(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Copy a model without the observations that fit far worse than most after an adjustment to the matches alone.

    Mismatches that structure from motion accepted are few, but have the largest weight in the sum of squares: they
    pull the model off its control points, and slow every adjustment.
    """
    free, copy = pycolmap.Reconstruction(model), pycolmap.Reconstruction(model)
    config = all_images(free)
    generalise_lenses(free, config, free=True)
    pycolmap.create_default_bundle_adjuster(adjustment_options(), config, free).solve()
    free.update_point_3d_errors()
    typical = float(np.median([point.error for point in free.points3D.values()]))
    pycolmap.ObservationManager(free).filter_all_points3D(_MISMATCH * typical, 0.0)
    for number in list(copy.point3D_ids()):
        if not free.exists_point3D(number):
            copy.delete_point3D(number)
            continue
        kept, before = (_observations(one.points3D[number]) for one in (free, copy))
        for image, point2D in before - kept:
            copy.delete_observation(image, point2D)
    return copy


def adjustment_options() -> pycolmap.BundleAdjustmentOptions:
    """Options that adjust everything but the focal length and the cameras' poses in a rig."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_sensor_from_rig = options.refine_focal_length = False
    options.refine_principal_point = options.refine_extra_params = True
    solver = options.ceres.solver_options
    solver.max_num_iterations, solver.function_tolerance = _STEPS, _TOLERANCE
    options.ceres.solver_options = solver
    return options


def all_images(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    """Configure the adjustment of all registered photographs of a model."""
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    return config


def generalise_lenses(model: pycolmap.Reconstruction, config: pycolmap.BundleAdjustmentConfig, free: bool) -> None:
    """Convert lenses that are to be adjusted to OPENCV; fix all others, and those of few photographs."""
    taken = Counter(model.image(number).camera_id for number in model.reg_image_ids())
    for number, camera in model.cameras.items():
        if not taken[number]:
            continue
        if not free or taken[number] < _IMAGES_OF_A_LENS:
            config.set_constant_cam_intrinsics(number)
        elif camera.model.name in _SIMPLER:
            lens = lens_from_colmap(camera.model.name, camera.width, camera.height, camera.params)
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = colmap_parameters(lens, "OPENCV")


def thinned(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Copy a model with no more points than cross-validation needs."""
    copy = pycolmap.Reconstruction(model)
    numbers = np.array(sorted(copy.point3D_ids()))
    most = max(_CHECK_POINTS, _CHECK_POINTS_PER_IMAGE * copy.num_reg_images())
    for number in np.random.default_rng(0).permutation(numbers)[most:]:
        copy.delete_point3D(int(number))
    return copy


def _adjusted(
    model: pycolmap.Reconstruction, positions: Differential, names: Collection[str], free: bool
) -> pycolmap.Reconstruction:
    """Copy a model and adjust it to its matches and the positions of some photographs."""
    copy = pycolmap.Reconstruction(model)
    config = all_images(copy)
    priors = []
    for number in sorted(copy.reg_image_ids()):
        image = copy.image(number)
        if image.name in names:
            prior = pycolmap.PosePrior()
            prior.corr_data_id, prior.position = image.data_id, positions.given_world[image.name]
            prior.position_covariance = np.diag(np.maximum(positions.sigma_m[image.name], _LEAST_M) ** 2)
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            priors.append(prior)
    generalise_lenses(copy, config, free)
    options = pycolmap.PosePriorBundleAdjustmentOptions()
    options.alignment_ransac.random_seed = 0
    pycolmap.create_pose_prior_bundle_adjuster(adjustment_options(), options, config, priors, copy).solve()
    return copy


def _observations(point: pycolmap.Point3D) -> set[tuple[int, int]]:
    return {(element.image_id, element.point2D_idx) for element in point.track.elements}


def _residual_m(
    model: pycolmap.Reconstruction, positions: Differential, names: Collection[str]
) -> Float64[np.ndarray, "N 3"]:
    centres = camera_centres(model)
    return np.array([centres[name] - positions.given_world[name] for name in names])


def _median(error_m: Float64[np.ndarray, "N 3"]) -> float:
    return float(np.median(np.linalg.norm(error_m, axis=1)))


def _rms(error_m: Float64[np.ndarray, "N K"]) -> float:
    return float(np.sqrt((error_m**2).sum(1).mean()))
