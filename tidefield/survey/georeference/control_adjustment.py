"""Bundle adjustment to ground control, its cross-validation, and the rejection of wrong marks and points.

A model that is only aligned with its control points keeps the bend of its own matches. Adjusted together with the
matches, fixed control points remove the bend, and determine lens parameters that flat ground does not: a longer lens is
equivalent to a higher flight, unless points lie at two heights or a bend shows the difference.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from tidefield.data.georeference import LeftOut, Residuals
from tidefield.errors import list_names
from tidefield.survey.georeference.bundle_adjustment import (
    all_images,
    carry_over,
    generalise_lenses,
    reliable,
    solve,
    thinned,
)
from tidefield.survey.georeference.gps_alignment import metres
from tidefield.survey.georeference.ground_control import (
    Marks,
    are_collinear,
    reprojection_px,
    triangulate,
    triangulate_points,
)

_REPEATS = 4
"""Weight of a mark. A matched point is as precise as a mark, but its errors are correlated with its neighbours' (lens,
shutter), which the sum of squares ignores; the weight compensates for that."""
_MARK_TOLERANCE = 0.005
"""Of the image width. Marks with a larger reprojection error in an adjusted model are wrong, or, if others are as bad,
those beyond five robust standard deviations."""
_POINT_FACTOR = 5.0
"""A point is wrong whose error, left out, is this many times the median of the others."""
_WRONG_POINTS = 3
"""No more points than this are rejected by cross-validation."""
_WORTH_FREEING = 0.9
"""The lens is adjusted if the errors of the points left out fall below this share."""
_ROUNDS = 4
_FOLDS = 12
_FOLDS_OF_LARGE = 4
_LARGE = 300  # photographs


def adjust_to_control(
    model: pycolmap.Reconstruction,
    marks: Marks,
    agree: Bool[np.ndarray, " M"],
    progress: Callable[[int, int], object],
) -> tuple[Residuals, Residuals, tuple[LeftOut, ...], tuple[str, ...]]:
    """Adjust a model that is aligned with its control points, in place.

    The lens is adjusted too if this reduces the errors of the points that are left out in turn. Marks are added when
    the adjusted model agrees with them, and removed when it does not.

    Args:
        agree: the marks to start with.

    Returns:
        The residuals of the control points, those of each after an adjustment without it, the rejected marks and
        points, and notes.
    """
    if are_collinear(_coordinates(marks.where(agree))):
        note = (
            "Fewer than three control points can be used, or they lie on one line: the photographs were aligned with "
            "them without adjustment, and cannot be checked."
        )
        return _control_residuals(model, marks.where(agree)), Residuals(), _rejected(model, marks, agree), (note,)
    refused: set[str] = set()
    sound = reliable(model)
    while True:
        agree = _consistent(sound, marks, agree, False, refused)
        free_lens, check = _choose_lens(sound, marks.where(agree), progress)
        wrong = _worst(check, _MARK_TOLERANCE * float(np.median(marks.width_px)) * _pixel_m(model))
        if wrong is None or len(refused) == _WRONG_POINTS:
            break
        refused.add(wrong)
        agree = agree & ~marks.of(wrong)
    final = _consistent(sound, marks, agree, free_lens, refused)
    if (final != agree).any():
        agree, check = final, _cross_validate(sound, marks.where(final), free_lens, progress)
    adjusted = _adjusted(sound, marks.where(agree), free_lens)
    notes = []
    if free_lens:
        changes = [
            f"{camera.mean_focal_length():.1f} to {adjusted.camera(number).mean_focal_length():.1f} px"
            for number, camera in sorted(model.cameras.items())
        ]
        notes.append(
            f"Ground control corrected the lens (focal length {list_names(changes)}, principal point and distortion): "
            "this reduces the errors of points that are left out in turn."
        )
    unchecked = sorted(marks.where(agree).points.keys() - set(check.names))
    if unchecked:
        why = "one photograph shows it, or too few points would be left"
        notes.append(f"Used, but not checked: {list_names(unchecked)}; {why}.")
    carry_over(adjusted, model)
    return _control_residuals(adjusted, marks.where(agree)), check, _rejected(adjusted, marks, agree), tuple(notes)


def _adjusted(model: pycolmap.Reconstruction, marks: Marks, free_lens: bool) -> pycolmap.Reconstruction:
    """Copy a model in the world and adjust it to its matches and to marks of fixed points.

    Args:
        free_lens: adjust focal length, principal point and distortion too, of COLMAP's OPENCV.
    """
    copy = pycolmap.Reconstruction(model)
    config = all_images(copy)
    generalise_lenses(copy, config, free_lens)
    for name, surveyed in marks.points.items():
        track, own = pycolmap.Track(), marks.of(name)
        for number, uv in zip(marks.image[own], marks.uv_px[own], strict=True):
            points = copy.image(int(number)).points2D
            for _ in range(_REPEATS):
                points.append(pycolmap.Point2D(uv))
                track.add_element(int(number), len(points) - 1)
        config.add_constant_point(copy.add_point3D(surveyed, track))
    solve(copy, config, refine_focal_length=True)
    return copy


def _cross_validate(
    model: pycolmap.Reconstruction, marks: Marks, free_lens: bool, progress: Callable[[int, int], object]
) -> Residuals:
    """Leave out each control point in turn, adjust, and triangulate it from its marks.

    With more than a dozen points a twelfth of them is left out at a time, with more than 300 photographs a quarter.
    Large models are thinned, which hardly changes the errors.

    Args:
        model: in the world, not yet adjusted to any of the points.
        progress: called with the numbers of finished and of all adjustments.
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
        if are_collinear(_coordinates(rest)):
            continue
        adjusted = _adjusted(light, rest, free_lens)
        for name in fold:
            point = triangulate(adjusted, marks.where(marks.of(name)))
            if point is not None:
                names.append(name)
                errors.append(point - surveyed[name])
    progress(len(folds), len(folds))
    return Residuals(tuple(names), np.array(errors, dtype=np.float64).reshape(-1, 3))


def _control_residuals(adjusted: pycolmap.Reconstruction, marks: Marks) -> Residuals:
    """Compute triangulated minus surveyed coordinates of the control points."""
    seen, surveyed = triangulate_points(adjusted, marks, 1.0), marks.points
    errors = [point - surveyed[name] for name, point in seen.items()]
    return Residuals(tuple(seen), np.array(errors, dtype=np.float64).reshape(-1, 3))


def _consistent(
    model: pycolmap.Reconstruction, marks: Marks, agree: Bool[np.ndarray, " M"], free_lens: bool, refused: set[str]
) -> Bool[np.ndarray, " M"]:
    """Find marks with which a model agrees that is adjusted to them."""
    allowed = ~marks.of(*refused)
    for _ in range(_ROUNDS):
        adjusted = _adjusted(model, marks.where(agree), free_lens)
        share = reprojection_px(adjusted, marks, marks.surveyed_world) / marks.width_px
        found = allowed & (share < max(_MARK_TOLERANCE, 5 * 1.4826 * float(np.median(share[agree]))))
        # Where most of a point's marks disagree, those that agree do so by chance.
        found &= ~marks.of(*(n for n in marks.points if 2 * (found & marks.of(n)).sum() < marks.of(n).sum()))
        if (found == agree).all() or are_collinear(_coordinates(marks.where(found))):
            break
        agree = found
    return agree


def _choose_lens(
    model: pycolmap.Reconstruction, marks: Marks, progress: Callable[[int, int], object]
) -> tuple[bool, Residuals]:
    """Decide whether to adjust the lens, by the points that are left out; also return their residuals."""
    fixed = _cross_validate(model, marks, False, lambda done, whole: progress(done, 2 * whole))
    free = _cross_validate(model, marks, True, lambda done, whole: progress(done + whole, 2 * whole))
    return (True, free) if free.rms_m < _WORTH_FREEING * fixed.rms_m else (False, fixed)


def _worst(check: Residuals, floor_m: float) -> str | None:
    """Find the point of the largest error, if this is far larger than the others' median."""
    if len(check.names) < 4:
        return None
    distance = np.linalg.norm(check.error_m, axis=1)
    last = int(np.argmax(distance))
    typical = float(np.median(np.delete(distance, last)))
    return check.names[last] if distance[last] > max(_POINT_FACTOR * typical, floor_m) else None


def _coordinates(marks: Marks) -> Float64[np.ndarray, "N 3"]:
    return np.array(list(marks.points.values()), dtype=np.float64).reshape(-1, 3)


def _pixel_m(model: pycolmap.Reconstruction) -> float:
    """Compute the ground sampling distance of the model's images: the median over the cameras."""
    ground = np.median([point.xyz[2] for point in model.points3D.values()])
    images = [model.image(number) for number in model.reg_image_ids()]
    return float(
        np.median([(i.projection_center()[2] - ground) / model.camera(i.camera_id).mean_focal_length() for i in images])
    )


def _rejected(model: pycolmap.Reconstruction, marks: Marks, agree: Bool[np.ndarray, " M"]) -> tuple[LeftOut, ...]:
    """Describe rejected marks: a point as a whole where its marks agree with one another, else mark by mark."""
    found = []
    pixels = reprojection_px(model, marks, marks.surveyed_world) * marks.zoom
    for name, surveyed in marks.points.items():
        own = marks.of(name)
        wrong = np.flatnonzero(own & ~agree)
        if len(wrong) == np.count_nonzero(own) >= 2:
            seen = triangulate_points(model, marks.where(own), 2 * _MARK_TOLERANCE)
            share = reprojection_px(model, marks.where(own), np.tile(seen.get(name, surveyed), (len(wrong), 1)))
            if name in seen and (share < 2 * _MARK_TOLERANCE * marks.width_px[own]).all():
                east, north, up = error_m = seen[name] - surveyed
                reason = (
                    f"its {len(wrong)} marks agree with one another, but show it "
                    f"{metres(float(np.linalg.norm(error_m)))} from where it was surveyed ({east:+.2f} m east, "
                    f"{north:+.2f} m north, {up:+.2f} m up): check its coordinates and its name"
                )
                found.append(LeftOut("control point", name, reason))
                continue
        found += [
            LeftOut(
                "mark",
                f"{name} in {marks.photograph[i]}",
                f"it is {pixels[i]:,.0f} pixels from where the surveyed point shows"
                if np.isfinite(pixels[i])
                else "the surveyed point is behind the camera",
            )
            for i in wrong
        ]
    return tuple(found)
