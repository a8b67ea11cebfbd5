"""How many terms of distortion a survey can bear.

Every further term fits the matches better. But photographs straight down over flat ground do not tell distortion from
bent ground, and the error that a term takes off the matches may go into a bowl-shaped model. Where positions are known
they tell: a richer lens is taken only if the cameras fit their positions as well with it as without.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from tidefield.ingest.earth.adjustment import adjustment_options, thinned
from tidefield.ingest.earth.alignment import camera_centres, find_down, fit_positions
from tidefield.ingest.earth.gps import given_positions
from tidefield.ingest.survey import Photograph

TERMS = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4}
"""Lens models of COLMAP, the simplest first, and their terms of distortion."""
WORTH = 0.99
"""A richer lens must bring the reprojection error to this share, ..."""
BENDS = 1.03
"""... and may not bring the distance from the positions above this share."""
FEWEST = 6
"""Positions that can tell whether a model is bent."""


@dataclass(frozen=True)
class Trial:
    """What a model adjusted with one lens model comes to.

    Attributes:
        lens: name of the lens model.
        error_px: mean reprojection error.
        off_m: RMS distance of the cameras from their positions, after the best similarity; None if positions cannot
            tell.
    """

    lens: str
    error_px: float
    off_m: float | None


def choose_lens(
    model: pycolmap.Reconstruction,
    photographs: Sequence[Photograph],
    focal: bool,
    progress: Callable[[int, int], object],
) -> tuple[Trial, ...]:
    """Adjust a model, in place, with the richest lens model that does not bend it.

    Args:
        photographs: of the survey.
        focal: refine the focal length, too.

    Returns:
        What was tried, the simplest lens first; the last is the one that was chosen.
    """
    light, trials = thinned(model), []
    for lens in TERMS:
        copy = pycolmap.Reconstruction(light)
        _adjust(copy, lens, focal)
        trials.append(Trial(lens, copy.compute_mean_reprojection_error(), _off_m(copy, photographs)))
        progress(len(trials), len(TERMS) + 1)
    best = best_of(trials)
    _adjust(model, best.lens, focal)
    progress(1, 1)
    return (*(trial for trial in trials if trial is not best), best)


def best_of(trials: Sequence[Trial]) -> Trial:
    """The richest of lenses, given the simplest first, that improves the matches and does not bend the model."""
    best = trials[0]
    for trial in trials[1:]:
        bends = trial.off_m is not None and best.off_m is not None and trial.off_m > BENDS * best.off_m
        if trial.error_px < WORTH * best.error_px and not bends:
            best = trial
    return best


def told(trials: Sequence[Trial]) -> tuple[str, ...]:
    """Why the lens has no more terms, as a sentence for the surveyor, where positions spoke against them."""
    *others, best = trials
    richer = [t for t in others if TERMS[t.lens] > TERMS[best.lens] and t.error_px < WORTH * best.error_px]
    if not richer or best.off_m is None:
        return ()
    other = min(richer, key=lambda trial: trial.error_px)
    return (
        f"The lens has {TERMS[best.lens]} term(s) of distortion. With {TERMS[other.lens]} the matches would fit better "
        f"({other.error_px:.2f} px instead of {best.error_px:.2f}), but the cameras worse with their positions "
        f"({other.off_m:.2f} m instead of {best.off_m:.2f}): the model would be bent.",
    )


def _adjust(model: pycolmap.Reconstruction, lens: str, focal: bool) -> None:
    for camera in model.cameras.values():
        mean = (camera.focal_length_x + camera.focal_length_y) / 2
        centre = camera.principal_point_x, camera.principal_point_y
        terms = np.pad(camera.params[len(camera.focal_length_idxs()) + 2 :], (0, 4))[: TERMS[lens]]
        camera.model = getattr(pycolmap.CameraModelId, lens)
        camera.params = [*([mean, mean] if lens == "OPENCV" else [mean]), *centre, *terms]
    options = adjustment_options()
    options.refine_focal_length, options.refine_principal_point = focal, False
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()


def _off_m(model: pycolmap.Reconstruction, photographs: Sequence[Photograph]) -> float | None:
    centres = camera_centres(model)
    own = [photograph for photograph in photographs if photograph.name in centres]
    positions = given_positions(own)
    if len(positions.names) < FEWEST:
        return None
    places = np.array([centres[name] for name in positions.names])
    fit = fit_positions(places, positions, positions.frame(), find_down(model, own))
    if fit is None:
        return None
    error = (fit.world_from_model(places) - fit.given_world)[fit.used]
    return float(np.sqrt((error**2).sum(1).mean()))
