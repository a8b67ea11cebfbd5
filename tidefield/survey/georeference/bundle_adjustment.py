"""Bundle adjustment: what its variants share, and the one to positions of differential receivers (RTK, PPK).

Nadir photographs over flat ground leave a model bent like a bowl if the lens distortion is slightly wrong, since the
matches fit equally well. Positions that are far more accurate than the bend remove it, and with it the errors of the
distortion and the principal point. They do not determine the focal length where all cameras fly at one height: it is
kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from tidefield.errors import list_names
from tidefield.geometry.lenses import colmap_parameters, lens_from_colmap
from tidefield.geometry.similarity import outliers
from tidefield.survey.georeference.gps_alignment import (
    DIFFERENTIAL_M,
    FEWEST_DIFFERENTIAL,
    GivenPositions,
    PositionFit,
    camera_centres,
    metres,
    rms_m,
)
from tidefield.survey.survey import Progress

_LEAST_M = 0.01
"""Smallest standard deviation of a position, which keeps its weight finite."""
MANY = 400
"""From so many photographs on, positions of ordinary receivers hold a model, too."""
_CORRELATED = 3.0
"""Factor on their standard deviations: a receiver's error is about the same in ten photographs in a row, which together
count as one."""
_FOLDS = 4
_WORTH = 0.7
"""The model is adjusted if the distance from the positions left out falls below this share of what it was."""
_CHECK_POINTS = 20_000
_CHECK_POINTS_PER_IMAGE = 40
IMAGES_OF_A_LENS = 8
"""A lens that took fewer photographs is kept."""
_MISMATCH = 2.0
"""Observations whose error is this many times the median are removed."""
_GENERAL = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL"), "OPENCV"),
    **dict.fromkeys(("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "OPENCV_FISHEYE"),
}
"""COLMAP's models by the one that contains them."""
_STEPS = 200
_TOLERANCE = 1e-7
_SOLVED_DIRECTLY = 20_000
"""Photographs up to which the linear equations are factorized. A photograph shares points with its neighbours only, so
the factors stay sparse. COLMAP's conjugate gradients, which it takes from 1,000 on, need many times as long for the
bend of a long flight."""
_ADJUSTED_ON_ONE_THREAD = 2_500_000
"""Residuals, those of some 400 photographs, up to which one thread adjusts: several add up in an order that changes
from run to run, and last digits change with it. Two are not faster with 170,000."""


def adjust_to_positions(
    model: pycolmap.Reconstruction, positions: GivenPositions, fit: PositionFit, progress: Progress
) -> tuple[str, ...]:
    """Adjust an aligned model to differential positions, in place, if cross-validation shows that this helps.

    Each quarter of the positions is left out in turn, with the distortion fixed and free.

    Args:
        positions: with the accuracies that the receivers state.
        fit: of the model to the positions, which names gross errors.

    Returns:
        Notes on the adjustment; none if the model was not adjusted.
    """
    good, stated_m = differential(model, positions, fit), positions.stated_m[:, [0, 0, 1]]
    if not len(good):
        return ()
    given = {fit.names[i]: fit.given_world[i] for i in good}
    sigma_m = {fit.names[i]: stated_m[i] for i in good}
    names = sorted(given)
    priors = _priors(model, given, sigma_m)
    before = _residual_m(model, given, names)
    light = thinned(model)
    left_out: dict[bool, Float64[np.ndarray, "N 3"]] = {}
    for done, free in enumerate((False, True)):
        # Each fold starts here, close to its own minimum.
        start = _adjusted(light, priors, (), free)
        error = np.empty((len(names), 3))
        for fold in range(_FOLDS):
            progress(done * _FOLDS + fold, 2 * _FOLDS)
            own = names[fold::_FOLDS]
            error[fold::_FOLDS] = _residual_m(_adjusted(start, priors, own, free), given, own)
        left_out[free] = error
    progress(1, 1)
    free = min(left_out, key=lambda mode: _median(left_out[mode]))
    after = left_out[free]
    if _median(after) > _WORTH * _median(before):
        return ()
    wrong = outliers(np.linalg.norm(after, axis=1), 5 * np.array([np.linalg.norm(sigma_m[n]) for n in names]))
    rejected = [name for name, is_wrong in zip(names, wrong, strict=True) if is_wrong]
    carry_over(_adjusted(model, priors, rejected, free), model)
    was, now = (
        f"{metres(rms_m(error[~wrong, :2]))} horizontally and {metres(rms_m(error[~wrong, 2:]))} vertically"
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


def differential(
    model: pycolmap.Reconstruction, positions: GivenPositions, fit: PositionFit
) -> Int64[np.ndarray, " K"]:
    """Indices of the positions of differential receivers that fit a model; none where they are too few to shape it."""
    good = np.flatnonzero(fit.used & (positions.stated_m < DIFFERENTIAL_M).all(axis=1))
    return good if len(good) >= max(FEWEST_DIFFERENTIAL, model.num_reg_images() / 2) else good[:0]


def hold_to_positions(model: pycolmap.Reconstruction, fit: PositionFit) -> tuple[str, ...]:
    """Adjust a large aligned model to the positions of ordinary receivers, in place.

    The longer a survey, the more its model bends: matches determine it ever more weakly, while the errors of positions
    stay as they are. The distortion is adjusted with it, because a slightly wrong one prefers a bowl, which positions
    alone do not flatten. Focal lengths, principal points and lenses of few photographs are kept.

    Args:
        fit: of the model to the positions, with their observed standard deviations and gross errors.

    Returns:
        A note; none if there are too few photographs or positions.
    """
    good = np.flatnonzero(fit.used)
    if model.num_reg_images() < MANY or len(good) < model.num_reg_images() / 2:
        return ()
    priors = _priors(
        model,
        {fit.names[i]: fit.given_world[i] for i in good},
        {fit.names[i]: _CORRELATED * fit.sigma_m[i] for i in good},
    )
    light = thinned(model)
    config = all_images(light)
    _fix_rare_lenses(light, config)
    options = adjustment_options()
    options.refine_principal_point = False
    _solve_with_positions(light, config, options, list(priors.values()))
    carry_over(light, model)
    return ("The model is held by the positions of its photographs, so that it does not bend over its length.",)


def _priors(
    model: pycolmap.Reconstruction,
    given_world: Mapping[str, Float64[np.ndarray, " 3"]],
    sigma_m: Mapping[str, Float64[np.ndarray, " 3"]],
) -> dict[str, pycolmap.PosePrior]:
    """Priors of the positions of a model's photographs, by name."""
    priors: dict[str, pycolmap.PosePrior] = {}
    for image in (model.image(number) for number in sorted(model.reg_image_ids())):
        if image.name in given_world:
            prior = priors[image.name] = pycolmap.PosePrior()
            prior.corr_data_id, prior.position = image.data_id, given_world[image.name]
            prior.position_covariance = np.diag(np.maximum(sigma_m[image.name], _LEAST_M) ** 2)
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    return priors


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
    solve(model, config, refine_rig_from_world=False)


def reliable(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Copy a model without the observations that fit far worse than most after an adjustment to the matches alone.

    Mismatches that structure from motion accepted are few, but have the largest weight in the sum of squares: they
    pull the model off its control points, and slow every adjustment.
    """
    free, copy = pycolmap.Reconstruction(model), pycolmap.Reconstruction(model)
    config = all_images(free)
    generalise_lenses(free, config, free=True)
    solve(free, config)
    typical = float(np.median([point.error for point in free.points3D.values()]))
    pycolmap.ObservationManager(free).filter_all_points3D(_MISMATCH * typical, 0.0)
    for number in list(copy.point3D_ids()):
        if not free.exists_point3D(number):
            copy.delete_point3D(number)
            continue
        before, kept = (
            {(element.image_id, element.point2D_idx) for element in one.points3D[number].track.elements}
            for one in (copy, free)
        )
        for image, point2D in before - kept:
            copy.delete_observation(image, point2D)
    return copy


def adjustment_options() -> pycolmap.BundleAdjustmentOptions:
    """Options that adjust everything but the focal length and the cameras' poses in a rig."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_sensor_from_rig = options.refine_focal_length = False
    options.refine_principal_point = options.refine_extra_params = True
    options.ceres.max_num_images_direct_sparse_cpu_solver = _SOLVED_DIRECTLY
    options.ceres.min_num_residuals_for_cpu_multi_threading = _ADJUSTED_ON_ONE_THREAD
    solver = options.ceres.solver_options
    solver.max_num_iterations, solver.function_tolerance = _STEPS, _TOLERANCE
    options.ceres.solver_options = solver
    return options


def solve(model: pycolmap.Reconstruction, config: pycolmap.BundleAdjustmentConfig, **options: bool) -> None:
    """Adjust a model in place, with some of the options changed.

    Not `pycolmap.bundle_adjustment`, which prints whatever the log level.
    """
    adjustment = adjustment_options()
    for name, value in options.items():
        setattr(adjustment, name, value)
    pycolmap.create_default_bundle_adjuster(adjustment, config, model).solve()
    model.update_point_3d_errors()


def all_images(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    """Configure the adjustment of all registered photographs of a model."""
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    return config


def generalise_lenses(model: pycolmap.Reconstruction, config: pycolmap.BundleAdjustmentConfig, free: bool) -> None:
    """Convert lenses that are to be adjusted to OPENCV or OPENCV_FISHEYE; fix others, and those of few photographs."""
    for number in _fix_rare_lenses(model, config):
        camera = model.cameras[number]
        if not free:
            config.set_constant_cam_intrinsics(number)
        elif camera.model.name in _GENERAL:
            general = _GENERAL[camera.model.name]
            lens = lens_from_colmap(camera.model.name, camera.width, camera.height, camera.params)
            camera.model = getattr(pycolmap.CameraModelId, general)
            camera.params = colmap_parameters(lens, general)


def _fix_rare_lenses(model: pycolmap.Reconstruction, config: pycolmap.BundleAdjustmentConfig) -> list[int]:
    """Fix the lenses of few photographs; return the cameras that took more."""
    taken = Counter(model.image(number).camera_id for number in model.reg_image_ids())
    for number, count in taken.items():
        if count < IMAGES_OF_A_LENS:
            config.set_constant_cam_intrinsics(number)
    return [number for number, count in taken.items() if count >= IMAGES_OF_A_LENS]


def thinned(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Copy a model with no more points than cross-validation needs."""
    copy = pycolmap.Reconstruction(model)
    numbers = np.array(sorted(copy.point3D_ids()))
    most = max(_CHECK_POINTS, _CHECK_POINTS_PER_IMAGE * copy.num_reg_images())
    for number in np.random.default_rng(0).permutation(numbers)[most:]:
        copy.delete_point3D(int(number))
    return copy


def _adjusted(
    model: pycolmap.Reconstruction, priors: Mapping[str, pycolmap.PosePrior], left_out: Collection[str], free: bool
) -> pycolmap.Reconstruction:
    """Copy a model and adjust it to its matches and the positions of its photographs, without some of these."""
    copy = pycolmap.Reconstruction(model)
    config = all_images(copy)
    generalise_lenses(copy, config, free)
    used = [prior for name, prior in priors.items() if name not in left_out]
    _solve_with_positions(copy, config, adjustment_options(), used)
    return copy


def _solve_with_positions(
    model: pycolmap.Reconstruction,
    config: pycolmap.BundleAdjustmentConfig,
    adjustment: pycolmap.BundleAdjustmentOptions,
    priors: list[pycolmap.PosePrior],
) -> None:
    """Adjust a model in place to its matches and to positions."""
    options = pycolmap.PosePriorBundleAdjustmentOptions()
    options.alignment_ransac.random_seed = 0
    pycolmap.create_pose_prior_bundle_adjuster(adjustment, options, config, priors, model).solve()


def _residual_m(
    model: pycolmap.Reconstruction, given_world: Mapping[str, Float64[np.ndarray, " 3"]], names: Collection[str]
) -> Float64[np.ndarray, "N 3"]:
    centres = camera_centres(model)
    return np.array([centres[name] - given_world[name] for name in names])


def _median(error_m: Float64[np.ndarray, "N 3"]) -> float:
    return float(np.median(np.linalg.norm(error_m, axis=1)))
