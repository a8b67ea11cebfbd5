"""A model laid onto the Earth: by ground control where it is given, else by GPS, else upright only."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from tidefield.data.georeference import Georeference, Residuals
from tidefield.geometry.geodesy import LocalFrame, parse_crs
from tidefield.geometry.similarity import Similarity, level
from tidefield.ingest.alignment import Down, PositionFit, camera_centres, find_down, fit_positions
from tidefield.ingest.control_adjustment import adjust_to_control
from tidefield.ingest.gps import GivenPositions, given_positions
from tidefield.ingest.ground_control import fit_control
from tidefield.ingest.marks import place_marks
from tidefield.ingest.survey import Control, Survey
from tidefield.ingest.which_crs import refuse_elsewhere


def georeference(
    model: pycolmap.Reconstruction, survey: Survey, progress: Callable[[int, int], object]
) -> Georeference:
    """Lay a model onto the Earth, in place: it comes in any frame and is in the world afterwards.

    With three control points or more the whole model is adjusted to them, and checked without each of them in turn.

    Args:
        model: with photographs' names as its images' names.
        progress: called with how much of how much is done.

    Raises:
        SurveyError: the positions mirror the survey, or ground control is of another place or fits nothing.
    """
    photographs = [p for p in survey.photographs if p.name in camera_centres(model)]
    positions, down = given_positions(photographs), find_down(model, photographs)
    if survey.control is None:
        return _by_positions(model, positions, down)
    if positions.names:
        refuse_elsewhere(survey.control, *positions.middle)
    frame = _control_frame(survey.control)
    fit = _fit(model, positions, frame, down)
    marks, unplaced = place_marks(model, survey.control, survey.photographs, frame)
    similarity, agree = fit_control(model, marks, down, fit)
    _move(model, similarity)
    result = adjust_to_control(model, marks, agree, progress)
    return Georeference(
        frame=frame,
        source="ground control",
        world_from_model=similarity,
        gps=_gps_residuals(model, positions, frame),
        control=result.control,
        check=result.check,
        left_out=(*positions.left_out, *(fit.left_out if fit else ()), *unplaced, *result.left_out),
        notes=result.notes,
    )


def _by_positions(model: pycolmap.Reconstruction, positions: GivenPositions, down: Down) -> Georeference:
    frame = positions.frame() if positions.names else None
    fit = None if frame is None else _fit(model, positions, frame, down)
    if frame is None or fit is None:
        return _upright_only(model, positions, down)
    ground = round(_ground(fit.world_from_model(_points(model))))
    frame = replace(frame, height_m=float(ground))
    translation = fit.world_from_model.translation - [0, 0, ground]
    similarity = replace(fit.world_from_model, translation=translation)
    _move(model, similarity)
    return Georeference(
        frame=frame,
        source="GPS",
        world_from_model=similarity,
        gps=_gps_residuals(model, positions, frame),
        control=Residuals(),
        check=Residuals(),
        left_out=(*positions.left_out, *fit.left_out),
        notes=fit.notes,
    )


def _upright_only(model: pycolmap.Reconstruction, positions: GivenPositions, down: Down) -> Georeference:
    """The vertical from the photographs, the ground's middle as origin, the model's own scale."""
    rotation = level(down.direction_model)
    points = _points(model) @ rotation.T
    similarity = Similarity(1.0, rotation, -np.append(np.median(points[:, :2], axis=0), _ground(points)))
    _move(model, similarity)
    said = f"{len(positions.names)} photographs have positions" if positions.names else "No photograph has a position"
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
            f"{said}, and {reason}: the scene is not georeferenced. Its scale is the model's own and not metres; its "
            f"vertical is from {down.source}, its north is arbitrary.",
        ),
    )


def _control_frame(control: Control) -> LocalFrame:
    """In the system of the control, with a round coordinate in the middle of it as its origin."""
    middle = np.median(np.array(list(control.points.values()), dtype=np.float64), axis=0)
    digits = 5 if parse_crs(control.crs).is_geographic else 0
    x, y, height = (float(round(value, digits)) for value, digits in zip(middle, (digits, digits, 0), strict=True))
    return LocalFrame.at(control.crs, (x, y, height))


def _fit(
    model: pycolmap.Reconstruction, positions: GivenPositions, frame: LocalFrame, down: Down
) -> PositionFit | None:
    centres = camera_centres(model)
    return fit_positions(np.array([centres[n] for n in positions.names]).reshape(-1, 3), positions, frame, down)


def _gps_residuals(model: pycolmap.Reconstruction, positions: GivenPositions, frame: LocalFrame) -> Residuals:
    """Of all positions, in the world where the model is by now."""
    if not positions.names:
        return Residuals()
    centres = camera_centres(model)
    there = np.array([centres[name] for name in positions.names])
    return Residuals(positions.names, there - frame.from_geographic(positions.longitude_latitude_height))


def _move(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    model.transform(pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation))


def _points(model: pycolmap.Reconstruction) -> Float64[np.ndarray, "N 3"]:
    return np.array([point.xyz for point in model.points3D.values()], dtype=np.float64).reshape(-1, 3)


def _ground(points_world: Float64[np.ndarray, "N 3"]) -> float:
    return float(np.median(points_world[:, 2])) if len(points_world) else math.nan
