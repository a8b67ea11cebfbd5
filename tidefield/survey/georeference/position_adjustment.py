"""A model in the world adjusted to positions that are good to centimetres: of differential receivers (RTK, PPK).

Photographs straight down over flat ground leave a model bent like a bowl when the lens' distortion is a little wrong:
the matches fit as well. Positions that are far more accurate than the bend take it out, and with it the error of the
distortion and the principal point. What they cannot tell is the focal length, where all fly at one height: it stays.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Float64

from tidefield.errors import list_names
from tidefield.geometry.similarity import outliers
from tidefield.survey.georeference.adjustment import (
    adjustment_options,
    all_images,
    carry_over,
    generalise_lenses,
    thinned,
)
from tidefield.survey.georeference.alignment import camera_centres, metres

DIFFERENTIAL_M = 0.3
"""Positions that state a standard deviation of less are from a differential receiver."""
_LEAST_M = 0.01
_FEWEST = 8
_FOLDS = 4
_WORTH = 0.7
"""The model is adjusted where that takes as much off its distance from positions, of those it was not adjusted to."""

Lens = Literal["held", "distortion"]


@dataclass(frozen=True)
class Differential:
    """Positions of a differential receiver, by photograph.

    Attributes:
        given_world: the positions.
        sigma_m: their standard deviations, east, north and up, as stated.
    """

    given_world: dict[str, Float64[np.ndarray, " 3"]]
    sigma_m: dict[str, Float64[np.ndarray, " 3"]]


def adjust_to_positions(
    model: pycolmap.Reconstruction, positions: Differential, progress: Callable[[int, int], object]
) -> tuple[str, ...]:
    """Adjust a model that has been laid onto its cameras' positions, in place, if that brings it closer to others.

    A quarter of the positions is left out in turn, and tells by how much.

    Args:
        progress: called with how much of how much is done.

    Returns:
        What was done, as sentences; nothing if nothing was.
    """
    names = sorted(positions.given_world)
    if len(names) < max(_FEWEST, model.num_reg_images() / 2):
        return ()
    before = _off_m(model, positions, names)
    light = thinned(model)
    left_out: dict[Lens, Float64[np.ndarray, "N 3"]] = {}
    modes: tuple[Lens, ...] = ("held", "distortion")
    for done, lens in enumerate(modes):
        # From here it is not far, and the same minimum is reached, to where each part of the positions leads.
        begun = _adjusted(light, positions, names, lens)
        error = np.empty((len(names), 3))
        for fold in range(_FOLDS):
            progress(done * _FOLDS + fold, len(modes) * _FOLDS)
            own = names[fold::_FOLDS]
            error[fold::_FOLDS] = _off_m(_adjusted(begun, positions, set(names) - set(own), lens), positions, own)
        left_out[lens] = error
    progress(1, 1)
    best = min(modes, key=lambda lens: _median(left_out[lens]))
    if _median(left_out[best]) > _WORTH * _median(before):
        return ()
    distance = np.linalg.norm(left_out[best], axis=1)
    wrong = outliers(distance, 5 * np.array([np.linalg.norm(positions.sigma_m[name]) for name in names]))
    astray = [name for name, is_wrong in zip(names, wrong, strict=True) if is_wrong]
    carry_over(_adjusted(model, positions, set(names) - set(astray), best), model)
    return _told(before[~wrong], left_out[best][~wrong], best, astray)


def _told(
    before: Float64[np.ndarray, "N 3"], left_out: Float64[np.ndarray, "N 3"], lens: Lens, astray: list[str]
) -> tuple[str, ...]:
    was, now = (
        f"{metres(_rms(error[:, :2]))} horizontally and {metres(_rms(error[:, 2:]))} vertically"
        for error in (before, left_out)
    )
    told = [
        f"The photographs were adjusted to their differential positions: those left out in turn are met within {now}, "
        f"instead of {was}."
    ]
    if lens == "distortion":
        told.append("The lens' distortion and principal point were corrected by them.")
    if astray:
        told.append(f"The positions of {list_names(astray)} are worse than they state, and were not used for that.")
    return tuple(told)


def _adjusted(
    model: pycolmap.Reconstruction, positions: Differential, names: Collection[str], lens: Lens
) -> pycolmap.Reconstruction:
    copy = pycolmap.Reconstruction(model)
    config = all_images(copy)
    priors = []
    for number in sorted(copy.reg_image_ids()):
        image = copy.image(number)
        if image.name in names:
            prior = pycolmap.PosePrior()
            prior.corr_data_id, prior.position = image.data_id, positions.given_world[image.name]
            prior.position_covariance = np.diag(np.maximum(positions.sigma_m[image.name], _LEAST_M) ** 2)
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            priors.append(prior)
    generalise_lenses(copy, config, freed=lens == "distortion")
    trust = pycolmap.PosePriorBundleAdjustmentOptions()
    trust.alignment_ransac.random_seed = 0
    pycolmap.create_pose_prior_bundle_adjuster(adjustment_options(), trust, config, priors, copy).solve()
    return copy


def _off_m(
    model: pycolmap.Reconstruction, positions: Differential, names: Collection[str]
) -> Float64[np.ndarray, "N 3"]:
    centres = camera_centres(model)
    return np.array([centres[name] - positions.given_world[name] for name in names])


def _median(error_m: Float64[np.ndarray, "N 3"]) -> float:
    return float(np.median(np.linalg.norm(error_m, axis=1)))


def _rms(error_m: Float64[np.ndarray, "N K"]) -> float:
    return float(np.sqrt((error_m**2).sum(1).mean()))
