"""A model in the world adjusted to ground control, with marks and points that are wrong found, named and left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from tidefield.data.georeference import LeftOut, Residuals
from tidefield.errors import list_names
from tidefield.survey.georeference.adjustment import Lens, adjust, carry_over, leave_one_out, reliable, seen_control
from tidefield.survey.georeference.alignment import metres
from tidefield.survey.georeference.ground_control import on_one_line
from tidefield.survey.georeference.marks import Marks, reprojection_px, triangulate_points

_MARK_TOLERANCE = 0.005
"""Of an image's width. A mark farther than this from where an adjusted model shows its point is wrong, or, where others
are as far, five robust standard deviations."""
_POINT_FACTOR = 5.0
_WRONG_POINTS = 3
"""More points than this are not refused for what the others say of them."""
_WORTH_FREEING = 0.9
"""A lens is adjusted where that takes a tenth off the errors of the points that are left out."""
_ROUNDS = 4


@dataclass(frozen=True)
class ControlResult:
    """What adjusting to ground control came to; see `Georeference`."""

    control: Residuals
    check: Residuals
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]


def adjust_to_control(
    model: pycolmap.Reconstruction,
    marks: Marks,
    agree: Bool[np.ndarray, " M"],
    progress: Callable[[int, int], object],
) -> ControlResult:
    """Adjust a model that has been laid onto ground control, in place.

    The lens is adjusted too if the points that are left out in turn are then met better. Marks come back when the
    adjusted model agrees with them, and go when it does not.

    Args:
        agree: the marks to begin with.
    """
    if on_one_line(_places(marks.where(agree))):
        why = (
            "Fewer than three control points can be used, or they lie on one line: the photographs were only laid onto"
        )
        seen = seen_control(model, marks.where(agree))
        return ControlResult(seen, Residuals(), _named(model, marks, agree), (f"{why} them, and cannot be checked.",))
    refused: set[str] = set()
    sound = reliable(model)
    while True:
        agree = _settled(sound, marks, agree, "held", refused)
        lens, check = _better_lens(sound, marks.where(agree), progress)
        wrong = _worst(check, _MARK_TOLERANCE * float(np.median(marks.width_px)) * _pixel_m(model))
        if wrong is None or len(refused) == _WRONG_POINTS:
            break
        refused.add(wrong)
        agree = agree & ~marks.of(wrong)
    settled = _settled(sound, marks, agree, lens, refused)
    if (settled != agree).any():
        agree, check = settled, leave_one_out(sound, marks.where(settled), lens, progress)
    adjusted = adjust(sound, marks.where(agree), lens)
    result = ControlResult(
        control=seen_control(adjusted, marks.where(agree)),
        check=check,
        left_out=_named(adjusted, marks, agree),
        notes=(*_lens_notes(model, adjusted, lens), *_unchecked(marks.where(agree), check)),
    )
    carry_over(adjusted, model)
    return result


def _settled(
    model: pycolmap.Reconstruction, marks: Marks, agree: Bool[np.ndarray, " M"], lens: Lens, refused: set[str]
) -> Bool[np.ndarray, " M"]:
    """The marks that a model adjusted to them agrees with."""
    allowed = ~marks.of(*refused)
    for _ in range(_ROUNDS):
        adjusted = adjust(model, marks.where(agree), lens)
        share = reprojection_px(adjusted, marks, marks.surveyed_world) / marks.width_px
        settled = allowed & (share < max(_MARK_TOLERANCE, 5 * 1.4826 * float(np.median(share[agree]))))
        settled &= ~marks.of(*_outvoted(marks, settled))
        if (settled == agree).all() or on_one_line(_places(marks.where(settled))):
            break
        agree = settled
    return agree


def _outvoted(marks: Marks, agree: Bool[np.ndarray, " M"]) -> list[str]:
    """Points most of whose marks disagree: then so does the point, and what agrees does so by chance."""
    return [name for name in marks.points if 2 * np.count_nonzero(agree & marks.of(name)) < marks.of(name).sum()]


def _better_lens(
    model: pycolmap.Reconstruction, marks: Marks, progress: Callable[[int, int], object]
) -> tuple[Lens, Residuals]:
    """The lens as it is, unless a freed one meets the points that are left out better."""
    held = leave_one_out(model, marks, "held", lambda done, whole: progress(done, 2 * whole))
    freed = leave_one_out(model, marks, "freed", lambda done, whole: progress(done + whole, 2 * whole))
    return ("freed", freed) if freed.rms_m < _WORTH_FREEING * held.rms_m else ("held", held)


def _worst(check: Residuals, floor_m: float) -> str | None:
    """The point that lies farther off than any other, if by much more than half of the others do."""
    if len(check.names) < 4:
        return None
    distance = np.linalg.norm(check.error_m, axis=1)
    last = int(np.argmax(distance))
    typical = float(np.median(np.delete(distance, last)))
    return check.names[last] if distance[last] > max(_POINT_FACTOR * typical, floor_m) else None


def _places(marks: Marks) -> Float64[np.ndarray, "N 3"]:
    return np.array(list(marks.points.values()), dtype=np.float64).reshape(-1, 3)


def _pixel_m(model: pycolmap.Reconstruction) -> float:
    """Ground under a pixel of the model's images, by the middle camera's height."""
    ground = np.median([point.xyz[2] for point in model.points3D.values()])
    images = [model.image(number) for number in model.reg_image_ids()]
    return float(
        np.median([(i.projection_center()[2] - ground) / model.camera(i.camera_id).mean_focal_length() for i in images])
    )


def _named(model: pycolmap.Reconstruction, marks: Marks, agree: Bool[np.ndarray, " M"]) -> tuple[LeftOut, ...]:
    """What was left out: a point as a whole where its marks agree with one another, else mark by mark."""
    found = []
    pixels = reprojection_px(model, marks, marks.surveyed_world) * marks.zoom
    for name, surveyed in marks.points.items():
        own = marks.of(name)
        wrong = np.flatnonzero(own & ~agree)
        if len(wrong) == np.count_nonzero(own) >= 2:
            seen = triangulate_points(model, marks.where(own), 2 * _MARK_TOLERANCE)
            share = reprojection_px(model, marks.where(own), np.tile(seen.get(name, surveyed), (len(wrong), 1)))
            if name in seen and (share < 2 * _MARK_TOLERANCE * marks.width_px[own]).all():
                found.append(LeftOut("control point", name, _misplaced(len(wrong), seen[name] - surveyed)))
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


def _misplaced(count: int, error_m: Float64[np.ndarray, " 3"]) -> str:
    east, north, up = error_m
    return (
        f"its {count} marks agree with one another, but show it {metres(float(np.linalg.norm(error_m)))} from where it "
        f"was surveyed ({east:+.2f} m east, {north:+.2f} m north, {up:+.2f} m up): check its coordinates and its name"
    )


def _lens_notes(model: pycolmap.Reconstruction, adjusted: pycolmap.Reconstruction, lens: Lens) -> tuple[str, ...]:
    if lens == "held":
        return ()
    changes = [
        f"{camera.mean_focal_length():.1f} to {adjusted.camera(number).mean_focal_length():.1f} px"
        for number, camera in sorted(model.cameras.items())
    ]
    return (
        f"Ground control corrected the lens (focal length {list_names(changes)}, principal point and distortion): the "
        "points that are left out in turn are met better so.",
    )


def _unchecked(marks: Marks, check: Residuals) -> tuple[str, ...]:
    rest = sorted(set(marks.point) - set(check.names))
    why = "one photograph shows it, or too few points would be left"
    return (f"Used, but not checked: {list_names(rest)}; {why}.",) if rest else ()
