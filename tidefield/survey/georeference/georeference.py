"""Georeferencing of a model: by ground control where it is given, else by GPS, else levelled only."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from tidefield.data.georeference import Georeference, Residuals
from tidefield.geometry.geodesy import LocalFrame, parse_crs
from tidefield.geometry.similarity import Similarity, level
from tidefield.survey.georeference.bundle_adjustment import DIFFERENTIAL_M, Differential, adjust_to_positions
from tidefield.survey.georeference.control_adjustment import adjust_to_control
from tidefield.survey.georeference.gps_alignment import (
    Down,
    GivenPositions,
    PositionFit,
    camera_centres,
    find_down,
    fit_positions,
    given_positions,
)
from tidefield.survey.georeference.ground_control import fit_control, locate_marks
from tidefield.survey.io.gcp_file import refuse_elsewhere
from tidefield.survey.survey import Control, Photograph, Survey


def georeference(
    model: pycolmap.Reconstruction, survey: Survey, progress: Callable[[int, int], object]
) -> Georeference:
    """Transform a model of any frame into the world, in place, and adjust it to positions and ground control.

    Positions of differential receivers remove the bend of the model. With three control points or more the model is
    adjusted to these, and cross-validated.

    Args:
        model: its images' names are the photographs' names.
        progress: called with the numbers of finished and of all steps; several parts count from 0 each.

    Raises:
        SurveyError: the positions mirror the survey, or ground control is elsewhere or fits nothing.
    """
    photographs = [p for p in survey.photographs if p.name in camera_centres(model)]
    positions = given_positions(photographs)
    if survey.control is not None and positions.names:
        refuse_elsewhere(survey.control, *positions.middle)
    frame = _frame(survey, positions)
    if frame is None:
        return _level_only(model, positions, find_down(model, photographs))
    aligned = _align_with_positions(model, positions, frame, photographs, progress)
    if survey.control is not None:
        return _by_control(model, survey, survey.control, positions, frame, aligned, progress)
    if aligned.fit is None:
        return _level_only(model, positions, find_down(model, photographs))
    ground = round(_ground(_points(model)))
    to_ground = Similarity(1.0, np.eye(3), np.array([0.0, 0.0, -ground]))
    frame = replace(frame, height_m=float(ground))
    _transform(model, to_ground)
    return Georeference(
        frame=frame,
        source="GPS",
        world_from_model=to_ground @ aligned.world_from_model,
        gps=_gps_residuals(model, positions, frame),
        control=Residuals(),
        check=Residuals(),
        left_out=(*positions.left_out, *aligned.fit.left_out),
        notes=aligned.notes,
    )


@dataclass(frozen=True)
class _Aligned:
    """Result of the alignment of a model with its cameras' positions.

    Attributes:
        fit: of the transformed model to the positions; None if these do not determine it.
        world_from_model: from the original model.
        notes: on what was done.
    """

    fit: PositionFit | None
    world_from_model: Similarity
    notes: tuple[str, ...]


def _align_with_positions(
    model: pycolmap.Reconstruction,
    positions: GivenPositions,
    frame: LocalFrame,
    photographs: Sequence[Photograph],
    progress: Callable[[int, int], object],
) -> _Aligned:
    fit = _fit(model, positions, frame, find_down(model, photographs))
    if fit is None:
        return _Aligned(None, Similarity(1.0, np.eye(3), np.zeros(3)), ())
    _transform(model, fit.world_from_model)
    adjusted = adjust_to_positions(model, _differential(positions, fit, frame), progress)
    again = _fit(model, positions, frame, find_down(model, photographs))
    assert again is not None, "the model has just been aligned with them"
    _transform(model, again.world_from_model)
    final = _fit(model, positions, frame, find_down(model, photographs))
    return _Aligned(final, again.world_from_model @ fit.world_from_model, (*again.notes, *adjusted))


def _by_control(
    model: pycolmap.Reconstruction,
    survey: Survey,
    control: Control,
    positions: GivenPositions,
    frame: LocalFrame,
    aligned: _Aligned,
    progress: Callable[[int, int], object],
) -> Georeference:
    marks, unplaced = locate_marks(model, control, survey.photographs, frame)
    similarity, agree = fit_control(model, marks, find_down(model, survey.photographs), aligned.fit)
    _transform(model, similarity)
    result = adjust_to_control(model, marks, agree, progress)
    gross_errors = aligned.fit.left_out if aligned.fit else ()
    return Georeference(
        frame=frame,
        source="ground control",
        world_from_model=similarity @ aligned.world_from_model,
        gps=_gps_residuals(model, positions, frame),
        control=result.control,
        check=result.check,
        left_out=(*positions.left_out, *gross_errors, *unplaced, *result.left_out),
        notes=(*aligned.notes, *result.notes),
    )


def _frame(survey: Survey, positions: GivenPositions) -> LocalFrame | None:
    """Choose the frame: in the system of the control, with a round coordinate as origin; else around the positions."""
    if survey.control is None:
        return positions.frame() if positions.names else None
    control = survey.control
    middle = np.median(np.array(list(control.points.values()), dtype=np.float64), axis=0)
    digits = 5 if parse_crs(control.crs).is_geographic else 0
    x, y, height = (float(round(value, n)) for value, n in zip(middle, (digits, digits, 0), strict=True))
    return LocalFrame.at(control.crs, (x, y, height))


def _level_only(model: pycolmap.Reconstruction, positions: GivenPositions, down: Down) -> Georeference:
    """Level a model by its photographs, with the middle of the ground as origin and the model's own scale."""
    rotation = level(down.direction_model)
    points = _points(model) @ rotation.T
    similarity = Similarity(1.0, rotation, -np.append(np.median(points[:, :2], axis=0), _ground(points)))
    _transform(model, similarity)
    found = f"{len(positions.names)} photographs have positions" if positions.names else "No photograph has a position"
    reason = "they do not follow the photographs" if len(positions.names) >= 3 else "three are needed"
    return Georeference(
        frame=None,
        source="none",
        world_from_model=similarity,
        gps=Residuals(),
        control=Residuals(),
        check=Residuals(),
        left_out=positions.left_out,
        notes=(
            f"{found}, and {reason}: the scene is not georeferenced. Its scale is the model's own and not metres; its "
            f"vertical is from {down.source}, its north is arbitrary.",
        ),
    )


def _fit(
    model: pycolmap.Reconstruction, positions: GivenPositions, frame: LocalFrame, down: Down
) -> PositionFit | None:
    centres = camera_centres(model)
    return fit_positions(np.array([centres[n] for n in positions.names]).reshape(-1, 3), positions, frame, down)


def _differential(positions: GivenPositions, fit: PositionFit, frame: LocalFrame) -> Differential:
    """Select positions whose stated accuracy is that of a differential receiver, without gross errors."""
    given = frame.from_geographic(positions.longitude_latitude_height)
    stated = positions.stated_m[:, [0, 0, 1]]
    good = np.flatnonzero(fit.used & (stated < DIFFERENTIAL_M).all(axis=1))
    names = [positions.names[i] for i in good]
    return Differential(dict(zip(names, given[good], strict=True)), dict(zip(names, stated[good], strict=True)))


def _gps_residuals(model: pycolmap.Reconstruction, positions: GivenPositions, frame: LocalFrame) -> Residuals:
    """Compute the residuals of all positions, for a model in the world."""
    if not positions.names:
        return Residuals()
    centres = camera_centres(model)
    found = np.array([centres[name] for name in positions.names])
    return Residuals(positions.names, found - frame.from_geographic(positions.longitude_latitude_height))


def _transform(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    model.transform(pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation))


def _points(model: pycolmap.Reconstruction) -> Float64[np.ndarray, "N 3"]:
    return np.array([point.xyz for point in model.points3D.values()], dtype=np.float64).reshape(-1, 3)


def _ground(points_world: Float64[np.ndarray, "N 3"]) -> float:
    return float(np.median(points_world[:, 2])) if len(points_world) else math.nan
