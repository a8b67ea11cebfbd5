"""The similarity that lays a model onto its cameras' positions, whichever of these are wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from tidefield.data.georeference import LeftOut
from tidefield.errors import SurveyError
from tidefield.geometry.geodesy import WGS84, LocalFrame
from tidefield.geometry.similarity import Similarity, hypotheses, least_median, outliers, refine_similarity
from tidefield.survey.georeference.gps import GivenPositions
from tidefield.survey.survey import Photograph

_NOMINAL_M = 3.0
"""Standard deviation of a receiver that states none: a good fix, so that only what is far off counts as wrong."""
_LEAST_M = 0.01
_HELD_RAD = math.radians(1.0)
"""A vertical that positions tell less well than this is taken from the photographs."""
_MIRRORED = 0.3
"""Mirrored positions that fit by this much better than those given were mirrored before."""


@dataclass(frozen=True)
class Down:
    """Where down is in a model.

    Attributes:
        direction_model: unit vector.
        sigma_rad: how well it is known.
        source: in words.
    """

    direction_model: Float64[np.ndarray, " 3"]
    sigma_rad: float
    source: str


@dataclass(frozen=True)
class PositionFit:
    """A model laid onto its cameras' positions.

    Attributes:
        world_from_model: the similarity.
        centres_model: the cameras.
        given_world: their positions.
        used: which were not gross errors.
        sigma_m: standard deviations (east, north, up) as they turned out, per position.
        left_out: the gross errors, named.
        notes: what the positions could not tell.
    """

    world_from_model: Similarity
    centres_model: Float64[np.ndarray, "N 3"]
    given_world: Float64[np.ndarray, "N 3"]
    used: Bool[np.ndarray, " N"]
    sigma_m: Float64[np.ndarray, "N 3"]
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]


def camera_centres(model: pycolmap.Reconstruction) -> dict[str, Float64[np.ndarray, " 3"]]:
    """Positions of the registered photographs in the model, by name."""
    images = [model.image(number) for number in model.reg_image_ids()]
    return {image.name: image.projection_center() for image in images}


def find_down(model: pycolmap.Reconstruction, photographs: Sequence[Photograph]) -> Down:
    """Down in the model, from the gimbals where the files tell, else from how photographs are held.

    Pictures are taken level: their x axes are horizontal, whichever way the camera points. Where these axes are all
    parallel, down is as near to the mean viewing direction as they allow.
    """
    gimbal = {p.name: p.gimbal_deg for p in photographs if p.gimbal_deg is not None}
    images = [model.image(number) for number in model.reg_image_ids()]
    R_camera_model = np.array([image.cam_from_world().rotation.matrix() for image in images])
    told = [i for i, image in enumerate(images) if image.name in gimbal]
    if 2 * len(told) > len(images):
        pitch, roll = np.deg2rad([gimbal[images[i].name][1:] for i in told]).T
        down_camera = np.stack([np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll), -np.sin(pitch)], axis=1)
        down_model = np.einsum("nji,nj->ni", R_camera_model[told], down_camera)
        return Down(_unit(np.median(down_model, axis=0)), math.radians(1), "the gimbals' pitch")
    x, forward = R_camera_model[:, 0], R_camera_model[:, 2].mean(0)
    strength, axes = np.linalg.eigh(x.T @ x / len(x))
    if strength[1] > 0.05:
        return Down(axes[:, 0] * (1.0 if axes[:, 0] @ forward >= 0 else -1.0), math.radians(5), "level photographs")
    along = axes[:, 2]
    return Down(_unit(forward - (forward @ along) * along), math.radians(5), "the mean viewing direction")


def fit_positions(
    centres_model: Float64[np.ndarray, "N 3"], positions: GivenPositions, frame: LocalFrame, down: Down
) -> PositionFit | None:
    """Lay a model onto its cameras' positions.

    Args:
        centres_model: the model's cameras, in the order of `positions`.
        frame: of the world to lay it into.
        down: where down is in the model, for positions that cannot tell (all on one line).

    Returns:
        None if the positions are fewer than three, or do not follow the model's cameras.

    Raises:
        SurveyError: the positions mirror the survey, as they do when latitude and longitude are swapped.
    """
    if len(positions.names) < 3:
        return None
    given = frame.from_geographic(positions.longitude_latitude_height)
    stated = positions.stated_m[:, [0, 0, 1]]
    nominal = np.where(np.isfinite(stated), stated, _NOMINAL_M)
    similarity, median = _upright(centres_model, given, down)
    if median > _NOMINAL_M:
        _refuse_mirrored(centres_model, positions, down, median)
    sigma, notes, used = nominal, (), np.ones(len(given), dtype=bool)
    for _ in range(3):
        error = similarity(centres_model) - given
        used = ~outliers(np.linalg.norm(error, axis=1), 5 * np.linalg.norm(nominal, axis=1))
        sigma = _as_it_turned_out(error, used, stated)
        similarity, notes = _refined(similarity, centres_model[used], given[used], sigma[used], down)
    error = similarity(centres_model) - given
    if not _follow(given[used], error[used]):
        return None
    return PositionFit(similarity, centres_model, given, used, sigma, _gross(positions.names, error, used), notes)


def metres(length: float) -> str:
    """A length as a surveyor would write it."""
    if length >= 10_000:
        return f"{length / 1000:,.0f} km"
    return f"{length:,.0f} m" if length >= 20 else f"{length:.1f} m" if length >= 2 else f"{100 * length:.0f} cm"


def _as_it_turned_out(
    error: Float64[np.ndarray, "N 3"], used: Bool[np.ndarray, " N"], stated: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Robust standard deviations, horizontal and vertical; those stated count only against one another.

    A model bends by more than a differential receiver errs, so that a stated accuracy tells good fixes from poor ones,
    and not what the residuals will be.
    """
    known = np.isfinite(stated)
    typical = np.nanmedian(stated, axis=0) if known.any(axis=0).all() else np.ones(3)
    relative = np.where(known, np.maximum(stated, _LEAST_M) / np.maximum(typical, _LEAST_M), 1.0)
    scaled = np.abs(error[used]) / relative[used]
    horizontal = max(_LEAST_M, 1.4826 * float(np.median(scaled[:, :2])))
    vertical = max(_LEAST_M, 1.4826 * float(np.median(scaled[:, 2])))
    return relative * [horizontal, horizontal, vertical]


def _refined(
    start: Similarity,
    source: Float64[np.ndarray, "N 3"],
    target: Float64[np.ndarray, "N 3"],
    sigma: Float64[np.ndarray, "N 3"],
    down: Down,
) -> tuple[Similarity, tuple[str, ...]]:
    fit = refine_similarity(start, source, target, sigma)
    if fit.tilt_rad < _HELD_RAD:
        return fit.similarity, ()
    held = refine_similarity(start, source, target, sigma, down.direction_model, down.sigma_rad)
    return held.similarity, (
        f"The cameras' positions alone do not tell the vertical (they lie on one line, or are too inaccurate): it is "
        f"held by {down.source}, to within about {math.degrees(held.tilt_rad):.1f} degrees.",
    )


def _follow(given: Float64[np.ndarray, "N 3"], error: Float64[np.ndarray, "N 3"]) -> bool:
    """Whether positions say more than that all were about here."""
    spread = np.sqrt(((given - given.mean(0)) ** 2)[:, :2].sum(1).mean())
    return len(given) >= 3 and bool(np.sqrt((error[:, :2] ** 2).sum(1).mean()) < 0.5 * spread)


def _gross(
    names: tuple[str, ...], error: Float64[np.ndarray, "N 3"], used: Bool[np.ndarray, " N"]
) -> tuple[LeftOut, ...]:
    distance = np.linalg.norm(error, axis=1)
    typical = metres(float(np.median(distance[used])))
    return tuple(
        LeftOut(
            "GPS",
            names[i],
            f"its position lies {metres(float(distance[i]))} from where the photographs place the camera; "
            f"half of the others are within {typical}",
        )
        for i in np.flatnonzero(~used)
    )


def _upright(
    source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"], down: Down
) -> tuple[Similarity, float]:
    """The best of those similarities that have the ground under the cameras, and its median distance."""
    among = hypotheses(source, target, down.direction_model, np.random.default_rng(0))
    return least_median([one for one in among if (one.rotation @ down.direction_model)[2] < 0], source, target)


def _refuse_mirrored(
    centres_model: Float64[np.ndarray, "N 3"], positions: GivenPositions, down: Down, median: float
) -> None:
    """An error for positions that mirror the survey, which is so when something simple makes them fit."""
    given = positions.longitude_latitude_height
    mended = {
        "latitude and longitude are swapped": given[:, [1, 0, 2]],
        "the sign of one of the two is wrong": given * [-1, 1, 1],
    }
    for what, places in mended.items():
        possible = np.abs(places[:, 1]) < 90
        if np.count_nonzero(possible) < 3:
            continue
        longitude, latitude = np.median(places[possible], axis=0)[:2]
        frame = LocalFrame.at(WGS84, (float(longitude), float(latitude), 0.0))
        _, least = _upright(centres_model[possible], frame.from_geographic(places[possible]), down)
        if least < _MIRRORED * median:
            raise SurveyError(
                f"the positions of the photographs (latitude {positions.middle[1]:.5f}, longitude "
                f"{positions.middle[0]:.5f}) mirror what the photographs show: {what}; "
                "expected latitude, counted positive to the north, and longitude, to the east; correct them where they "
                "were given"
            )


def _unit(vector: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
    return vector / np.linalg.norm(vector)
