"""Georeferencing of a model: by ground control where it is given, else by GPS, else levelled only."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from tidefield.data.georeference import Georeference, Residuals
from tidefield.errors import list_names
from tidefield.geometry.geodesy import LocalFrame, parse_crs
from tidefield.geometry.similarity import Similarity, level
from tidefield.survey.georeference.bundle_adjustment import adjust_to_positions, differential, hold_to_positions
from tidefield.survey.georeference.gps_alignment import (
    GivenPositions,
    camera_centres,
    find_down,
    fit_positions,
    given_positions,
)
from tidefield.survey.georeference.ground_control import (
    adjust_to_control,
    are_collinear,
    fit_control,
    locate_marks,
)
from tidefield.survey.io.gcp_file import refuse_elsewhere
from tidefield.survey.survey import Photograph, Progress, Survey


def georeference(model: pycolmap.Reconstruction, survey: Survey, progress: Progress) -> Georeference:
    """Transform a model of any frame into the world, in place, and adjust it to positions and ground control.

    Positions of differential receivers remove the bend of the model. With three control points or more the model is
    adjusted to these, and cross-validated, unless it keeps the shape that differential positions gave it.

    Args:
        model: its images' names are the photographs' names.
        progress: called with the numbers of finished and of all steps; several parts count from 0 each.

    Raises:
        SurveyError: the positions mirror the survey, or ground control is elsewhere or fits nothing.
    """
    registered = camera_centres(model)
    photographs = [photograph for photograph in survey.photographs if photograph.name in registered]
    positions = given_positions(photographs)
    control = survey.control and survey.control.fitted()
    if control is None:
        if not positions.names:
            return _level_only(model, photographs, positions)
        frame = positions.frame()
    else:
        if positions.names:
            refuse_elsewhere(control, *positions.middle, positions.radius_m)
        # In the system of the control, with a round coordinate as origin.
        middle = np.median(np.array(list(control.points.values()), dtype=np.float64), axis=0)
        digits = 5 if parse_crs(control.crs).is_geographic else 0
        x, y, height = (float(round(value, n)) for value, n in zip(middle, (digits, digits, 0), strict=True))
        frame = LocalFrame.at(control.crs, (x, y, height))

    world_from_model, notes = Similarity(1.0, np.eye(3), np.zeros(3)), positions.notes
    fit, shape = fit_positions(model, photographs, positions, frame), tuple[str, ...]()
    if fit is not None:
        _transform(model, fit.world_from_model)
        shape = adjust_to_positions(model, positions, fit, progress) or hold_to_positions(model, fit)
        again = fit_positions(model, photographs, positions, frame)
        assert again is not None, "the model has just been aligned with them"
        _transform(model, again.world_from_model)
        world_from_model, notes = again.world_from_model @ fit.world_from_model, (*notes, *again.notes)
        fit = fit_positions(model, photographs, positions, frame)
    gross_errors, has_part = fit.left_out if fit else (), fit is not None

    if control is not None:
        marks, unplaced = locate_marks(model, control, survey.photographs, frame)
        # Positions that found nothing to correct have confirmed the shape.
        shaped = fit is not None and len(differential(model, positions, fit)) > 0
        last, agree = fit_control(model, marks, find_down(model, photographs), fit, shaped)
        _transform(model, last)
        found = adjust_to_control(model, marks, agree, progress, fit if shaped else None)
        residuals, check, left_out = found.residuals, found.check, (*gross_errors, *unplaced, *found.rejected)
        has_part = fit is not None and (shaped or are_collinear(marks.where(agree).points.values()))
        last, notes, used = found.moved @ last, (*notes, *shape, *found.notes), found.used_world
        if fit is None and positions.names:
            notes += (f"The positions of {list_names(positions.names)} are not used: {_why_unused(positions)}.",)
    elif fit is None:
        return _level_only(model, photographs, positions)
    else:
        ground = round(_ground(_points(model)))
        last = Similarity(1.0, np.eye(3), np.array([0.0, 0.0, -ground]))
        frame = replace(frame, height_m=float(ground))
        _transform(model, last)
        residuals, check, left_out, notes = Residuals(), Residuals(), gross_errors, (*notes, *shape)
        used = np.empty((0, 3))
    return Georeference(
        frame=frame,
        source="GPS" if control is None else "ground control",
        world_from_model=last @ world_from_model,
        gps=_gps_residuals(model, positions, frame) if fit else Residuals(),
        control=residuals,
        check=check,
        left_out=left_out,
        notes=notes,
        control_world=used,
        gps_has_part=has_part,
    )


def _level_only(
    model: pycolmap.Reconstruction, photographs: Sequence[Photograph], positions: GivenPositions
) -> Georeference:
    """Level a model by its photographs, with the middle of the ground as origin and the model's own scale."""
    down = find_down(model, photographs)
    rotation = level(down.direction_model)
    points = _points(model) @ rotation.T
    similarity = Similarity(1.0, rotation, -np.append(np.median(points[:, :2], axis=0), _ground(points)))
    _transform(model, similarity)
    count = sum(photograph.position is not None for photograph in photographs)
    found = f"{count} photographs have positions" if count else "No photograph has a position"
    before, after = (), ()
    if len(positions.names) >= 3:
        before = positions.notes
        after = (
            "Check the positions, and in a file of positions its names and the order of its coordinates; or name "
            "another file with --gps.",
        )
    note = (
        f"{found}, and {_why_unused(positions)}: the scene is not georeferenced. Its scale is the model's own and not "
        f"metres; its vertical is from {down.source}, its north is arbitrary."
    )
    return Georeference(
        frame=None,
        source="none",
        world_from_model=similarity,
        gps=Residuals(),
        control=Residuals(),
        check=Residuals(),
        left_out=(),
        notes=(" ".join((*before, note, *after)),),
    )


def _why_unused(positions: GivenPositions) -> str:
    return "three are needed" if len(positions.names) < 3 else "they do not follow the photographs"


def _gps_residuals(model: pycolmap.Reconstruction, positions: GivenPositions, frame: LocalFrame) -> Residuals:
    """Compute the residuals of all positions, for a model in the world."""
    centres = camera_centres(model)
    found = np.array([centres[name] for name in positions.names])
    error_m = found - frame.from_geographic(positions.longitude_latitude_height)
    if not positions.has_heights:
        error_m[:, 2] = math.nan
    return Residuals(positions.names, error_m)


def _transform(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    model.transform(pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation))


def _points(model: pycolmap.Reconstruction) -> Float64[np.ndarray, "N 3"]:
    return np.array([point.xyz for point in model.points3D.values()], dtype=np.float64).reshape(-1, 3)


def _ground(points_world: Float64[np.ndarray, "N 3"]) -> float:
    return float(np.median(points_world[:, 2])) if len(points_world) else math.nan
