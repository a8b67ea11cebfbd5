"""The similarity that lays a model onto ground control, whichever marks and points are wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from tidefield.errors import SurveyError
from tidefield.geometry.similarity import COLLINEAR, Similarity, hypotheses, refine_similarity
from tidefield.survey.georeference.alignment import Down, PositionFit
from tidefield.survey.georeference.marks import Marks, reprojection_px, triangulate_points

PLAINLY_WRONG = 0.02
"""Of an image's width: a mark this far from where an unadjusted model has its point, which bends by less, is wrong."""
_CONTROL_M = 0.02
"""Standard deviation of a surveyed point, beside that of the cameras' positions."""


def fit_control(
    model: pycolmap.Reconstruction, marks: Marks, down: Down, positions: PositionFit | None
) -> tuple[Similarity, Bool[np.ndarray, " M"]]:
    """Lay a model onto control points.

    Similarities through few of the points, and those of the cameras' positions moved onto one point, are judged by all
    marks, so that a point with one mark counts too and a wrong point is outvoted.

    Args:
        positions: the cameras laid onto their own positions. Where control points are too few or on one line, these
            still hold what the points do not.

    Returns:
        The similarity, and which marks agree with it.

    Raises:
        SurveyError: there are too few points, or most of the marks fit no similarity.
    """
    source, target = _pairs(model, marks)
    among = hypotheses(source, target, None if positions else down.direction_model, np.random.default_rng(0))
    among = [one for one in among if (one.rotation @ down.direction_model)[2] < 0]
    if positions is not None:
        prior = positions.world_from_model
        shifts = target - prior(source)
        among += [prior, *(replace(prior, translation=prior.translation + shift) for shift in shifts)]
    if not among:
        raise SurveyError(
            f"{len(source)} control points show in two photographs or more, and the photographs have no positions: "
            "expected three such points; mark more, or give the photographs' positions"
        )
    similarity = min(among, key=lambda one: float((np.minimum(_share(model, marks, one), 1) ** 2).sum()))
    agree = _share(model, marks, similarity) < 1
    if 2 * np.count_nonzero(agree) < len(marks):
        raise SurveyError(
            f"only {np.count_nonzero(agree)} of the {len(marks)} marks of ground control fit together with the "
            "photographs: expected most of them; check the coordinate reference system, the order of the coordinates, "
            "the names of the points and what size of photograph the marks were made on"
        )
    source, target = _pairs(model, marks.where(agree))
    sigma = np.full_like(target, _CONTROL_M)
    if not on_one_line(target):
        similarity = refine_similarity(similarity, source, target, sigma).similarity
    elif positions is not None:
        similarity = _with_positions(similarity, source, target, positions)
    elif len(source) >= 2:
        held = down.direction_model, down.sigma_rad
        similarity = refine_similarity(similarity, source, target, sigma, *held).similarity
    return similarity, _share(model, marks, similarity) < 1


def on_one_line(points: Float64[np.ndarray, "N 3"]) -> bool:
    """Whether points leave a rotation about them free: fewer than three, or on one line."""
    if len(points) < 3:
        return True
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(spread[1] <= COLLINEAR * spread[0])


def _pairs(
    model: pycolmap.Reconstruction, marks: Marks
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Points that two marks or more agree on, as the model sees them and as they were surveyed."""
    seen, surveyed = triangulate_points(model, marks, PLAINLY_WRONG), marks.points
    return np.array(list(seen.values())).reshape(-1, 3), np.array([surveyed[name] for name in seen]).reshape(-1, 3)


def _with_positions(
    start: Similarity, source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"], positions: PositionFit
) -> Similarity:
    """Few control points say where the model is, and the cameras' positions, moved as one, how it is turned."""
    if len(source) == 0:
        return start
    prior, used = positions.world_from_model, positions.used
    shift = (target - prior(source)).mean(0)
    return refine_similarity(
        replace(prior, translation=prior.translation + shift),
        np.concatenate([source, positions.centres_model[used]]),
        np.concatenate([target, positions.given_world[used] + shift]),
        np.concatenate([np.full_like(target, _CONTROL_M), positions.sigma_m[used]]),
    ).similarity


def _share(model: pycolmap.Reconstruction, marks: Marks, similarity: Similarity) -> Float64[np.ndarray, " M"]:
    """Reprojection error of surveyed points in widths of the image, over what is plainly wrong."""
    points = similarity.inverse()(marks.surveyed_world)
    return reprojection_px(model, marks, points) / marks.width_px / PLAINLY_WRONG
