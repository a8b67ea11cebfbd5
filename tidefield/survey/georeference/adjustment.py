"""Bundle adjustment of a whole model with surveyed points, and how well it does without each of them.

A survey that is laid onto its control points keeps the bend that its own matches left it with. Adjusted together with
the matches, in the world, the marks of points that do not move take out the bend, and what of the lens flat ground
cannot tell: a longer lens is a higher flight, but not with points at two heights or a bend to show for it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Float64

from tidefield.data.georeference import Residuals
from tidefield.geometry.lenses import colmap_parameters, lens_from_colmap
from tidefield.survey.georeference.ground_control import on_one_line
from tidefield.survey.georeference.marks import Marks, triangulate, triangulate_points

Lens = Literal["held", "freed"]

REPEATS = 4
"""How often each mark counts. A matched point is as well seen as a mark, but its errors are shared with its neighbours'
(the lens, the shutter), which the sum of squares does not know; repeats stand for that."""
_FOLDS = 12
_FOLDS_OF_LARGE = 4
_LARGE = 300  # photographs
_CHECK_POINTS = 20_000
_CHECK_POINTS_PER_IMAGE = 40
_IMAGES_OF_A_LENS = 8
"""A lens that took fewer photographs stays as it is."""
_MISMATCH = 2.0
"""Observations are left out whose error is so many times that of the middle point."""
_SIMPLER = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_STEPS = 200
_TOLERANCE = 1e-7


def adjust(model: pycolmap.Reconstruction, marks: Marks, lens: Lens) -> pycolmap.Reconstruction:
    """A copy of a model in the world, adjusted to its matches and to marks of points that stay where they are.

    Args:
        lens: "held" as it is; "freed" adjusts focal length, principal point and distortion too, of OpenCV's model.
    """
    copy = pycolmap.Reconstruction(model)
    config = all_images(copy)
    generalise_lenses(copy, config, freed=lens == "freed")
    for name, surveyed in marks.points.items():
        config.add_constant_point(_add_control(copy, marks.where(marks.of(name)), surveyed))
    options = adjustment_options()
    options.refine_focal_length = True
    pycolmap.create_default_bundle_adjuster(options, config, copy).solve()
    return copy


def carry_over(adjusted: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> None:
    """Give a model the lenses and poses of its adjusted copy, and its points the places that these give them."""
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
    """A copy without the observations that fit far worse than most, once the model is adjusted to its matches alone.

    Mismatches that structure from motion lets pass are few, but the sum of squares counts them most: they pull the
    model off its control points, and slow every adjustment.
    """
    free, copy = pycolmap.Reconstruction(model), pycolmap.Reconstruction(model)
    config = all_images(free)
    generalise_lenses(free, config, freed=True)
    pycolmap.create_default_bundle_adjuster(adjustment_options(), config, free).solve()
    free.update_point_3d_errors()
    typical = float(np.median([point.error for point in free.points3D.values()]))
    pycolmap.ObservationManager(free).filter_all_points3D(_MISMATCH * typical, 0.0)
    for number in list(copy.point3D_ids()):
        if not free.exists_point3D(number):
            copy.delete_point3D(number)
            continue
        kept, before = (_seen_in(one.points3D[number]) for one in (free, copy))
        for image, point2D in before - kept:
            copy.delete_observation(image, point2D)
    return copy


def _seen_in(point: pycolmap.Point3D) -> set[tuple[int, int]]:
    return {(element.image_id, element.point2D_idx) for element in point.track.elements}


def leave_one_out(
    model: pycolmap.Reconstruction, marks: Marks, lens: Lens, progress: Callable[[int, int], object]
) -> Residuals:
    """Adjust without each control point in turn, and see where its marks then put it.

    With more than a dozen points a twelfth of them is left out at a time, of more than 300 photographs a quarter. Large
    models are thinned: the answer is the same but for what fewer matches hold less well.

    Args:
        model: in the world, not yet adjusted to any of the points.
        progress: called with how many adjustments of how many are done.
    """
    surveyed = marks.points
    seen = [name for name in surveyed if np.count_nonzero(marks.of(name)) >= 2]
    count = _FOLDS if model.num_reg_images() <= _LARGE else _FOLDS_OF_LARGE
    folds = [fold for fold in (seen[start::count] for start in range(count)) if fold]
    names, errors = [], []
    light = thinned(model)
    for done, fold in enumerate(folds):
        progress(done, len(folds))
        rest = marks.where(~marks.of(*fold))
        if on_one_line(np.array(list(rest.points.values())).reshape(-1, 3)):
            continue
        adjusted = adjust(light, rest, lens)
        for name in fold:
            point = triangulate(adjusted, marks.where(marks.of(name)))
            if point is not None:
                names.append(name)
                errors.append(point - surveyed[name])
    progress(len(folds), len(folds))
    return Residuals(tuple(names), np.array(errors, dtype=np.float64).reshape(-1, 3))


def seen_control(adjusted: pycolmap.Reconstruction, marks: Marks) -> Residuals:
    """Control points as the photographs see them."""
    seen, surveyed = triangulate_points(adjusted, marks, 1.0), marks.points
    errors = [point - surveyed[name] for name, point in seen.items()]
    return Residuals(tuple(seen), np.array(errors, dtype=np.float64).reshape(-1, 3))


def adjustment_options() -> pycolmap.BundleAdjustmentOptions:
    """All is adjusted but the focal length and how the cameras of a rig sit on it; until nothing much changes."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_sensor_from_rig = options.refine_focal_length = False
    options.refine_principal_point = options.refine_extra_params = True
    solver = options.ceres.solver_options
    solver.max_num_iterations, solver.function_tolerance = _STEPS, _TOLERANCE
    options.ceres.solver_options = solver
    return options


def all_images(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    """That a model is to be adjusted with all its photographs."""
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    return config


def generalise_lenses(model: pycolmap.Reconstruction, config: pycolmap.BundleAdjustmentConfig, freed: bool) -> None:
    """Make lenses that are to be adjusted ones of OpenCV's model; hold all others (those of few photographs too)."""
    taken = Counter(model.image(number).camera_id for number in model.reg_image_ids())
    for number, camera in model.cameras.items():
        if freed and taken[number] >= _IMAGES_OF_A_LENS:
            _generalise(camera)
        elif taken[number]:
            config.set_constant_cam_intrinsics(number)


def _add_control(model: pycolmap.Reconstruction, marks: Marks, surveyed: Float64[np.ndarray, " 3"]) -> int:
    track = pycolmap.Track()
    for number, uv in zip(marks.image, marks.uv_px, strict=True):
        points = model.image(int(number)).points2D
        for _ in range(REPEATS):
            points.append(pycolmap.Point2D(uv))
            track.add_element(int(number), len(points) - 1)
    return model.add_point3D(surveyed, track)


def _generalise(camera: pycolmap.Camera) -> None:
    """The same lens as OpenCV's model with two radial and two tangential terms, if it is a simpler one."""
    if camera.model.name in _SIMPLER:
        lens = lens_from_colmap(camera.model.name, camera.width, camera.height, camera.params)
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = colmap_parameters(lens, "OPENCV")


def thinned(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with no more points than a check needs."""
    copy = pycolmap.Reconstruction(model)
    numbers = np.array(sorted(copy.point3D_ids()))
    most = max(_CHECK_POINTS, _CHECK_POINTS_PER_IMAGE * copy.num_reg_images())
    for number in np.random.default_rng(0).permutation(numbers)[most:]:
        copy.delete_point3D(int(number))
    return copy
