"""How many terms of distortion a survey can bear, and whether it can tell its focal length.

Every further term fits the matches better. But photographs straight down over flat ground do not tell distortion from
bent ground, and the error that a term takes off the matches may go into a bowl-shaped model. Where positions are known
they tell: a richer lens is taken only if the cameras fit their positions as well with it as without.

Photographs whose optical axes are parallel do not tell the focal length, whatever the relief: a world stretched along
the axes looks through a longer lens just as it did. It is refined, where something else states it, only if the
photographs look in different directions.

Where the maker states two focal lengths, of this lens and of its design, the one is held with which the flight height
agrees better with what the drone says: height follows the focal length, and other evidence there is none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from tidefield.geometry.lenses import colmap_parameters, lens_from_colmap
from tidefield.survey.georeference.bundle_adjustment import adjustment_options, all_images, thinned
from tidefield.survey.georeference.gps_alignment import (
    PositionFit,
    camera_centres,
    find_down,
    fit_positions,
    given_positions,
)
from tidefield.survey.survey import Photograph

TERMS = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4}
"""Lens models of COLMAP, the simplest first, and their terms of distortion."""
WORTH = 0.99
"""A richer lens must bring the reprojection error to this share, ..."""
BENDS = 1.03
"""... and may not bring the distance from the positions above this share."""
FEWEST = 6
"""Positions that can tell whether a model is bent."""
DIFFERENT = 0.01
"""Two focal lengths that differ by less are one."""
LOWEST_M = 10.0
"""Below this, the height above take-off says little."""
SPREAD_DEG = 10.0
"""RMS angle of the optical axes from their mean that tells the focal length."""


@dataclass(frozen=True)
class Trial:
    """What a model adjusted with one lens model comes to.

    Attributes:
        lens: name of the lens model.
        error_px: mean reprojection error.
        off_m: RMS distance of the cameras from their positions, after the best similarity; None if positions cannot
            tell.
        focal_px: of the first camera.
    """

    lens: str
    error_px: float
    off_m: float | None
    focal_px: float


@dataclass(frozen=True)
class Heights:
    """Flight heights above the ground over those above take-off, with each of the stated focal lengths.

    Attributes:
        calibrated_px, design_px: the focal lengths.
        calibrated_share, design_share: median heights above the ground as shares of the drone's own.
    """

    calibrated_px: float
    design_px: float
    calibrated_share: float
    design_share: float

    @property
    def prefers_design(self) -> bool:
        return abs(math.log(self.design_share)) < abs(math.log(self.calibrated_share))


@dataclass(frozen=True)
class Choice:
    """How the lens of a model was chosen.

    Attributes:
        trials: what was tried; the last is the one that was chosen.
        known: whether something else than the matches states the focal length.
        freed: whether it was refined.
        spread_deg: RMS angle of the optical axes from their mean.
        heights: what the drone's height says of two stated focal lengths; None where there are not two.
    """

    trials: tuple[Trial, ...]
    known: bool
    freed: bool
    spread_deg: float
    heights: Heights | None = None


def choose_lens(
    model: pycolmap.Reconstruction,
    photographs: Sequence[Photograph],
    known: bool,
    progress: Callable[[int, int], object],
) -> Choice:
    """Adjust a model, in place, with the richest lens model that does not bend it.

    Args:
        photographs: of the survey.
        known: whether the model's focal length is stated by something else than the matches.
    """
    light, trials, spread = thinned(model), [], axes_spread_deg(model)
    tells = known and spread >= SPREAD_DEG
    steps = len(TERMS) + 1 + tells

    def attempt(lens: str, focal: bool) -> Trial:
        copy = pycolmap.Reconstruction(light)
        _adjust(copy, lens, focal)
        trials.append(_trial(copy, lens, photographs))
        progress(len(trials), steps)
        return trials[-1]

    best = best_of([attempt(lens, not known) for lens in TERMS])
    freed = not known
    if tells:
        with_focal = attempt(best.lens, True)
        freed = _better(with_focal, best)
        best = with_focal if freed else best
    _adjust(model, best.lens, freed)
    heights = None if freed else _heights(model, photographs)
    if heights is not None and heights.prefers_design:
        (camera,) = model.cameras.values()
        for index in camera.focal_length_idxs():
            camera.params[index] = heights.design_px
        _adjust(model, best.lens, focal=False)
    progress(steps, steps)
    return Choice((*(trial for trial in trials if trial is not best), best), known, freed, spread, heights)


def _heights(model: pycolmap.Reconstruction, photographs: Sequence[Photograph]) -> Heights | None:
    """None where the maker does not state two different focal lengths of the one lens, or heights are not known."""
    stated = {(p.lens.focal_px, p.lens.design_focal_px) for p in photographs if p.lens and p.lens.design_focal_px}
    if len(stated) != 1 or len(model.cameras) != 1:
        return None
    ((calibrated, design),) = stated
    fit, names = _fit(model, photographs)
    if design is None or abs(math.log(design / calibrated)) < DIFFERENT or fit is None:
        return None
    above_start = {p.name: p.relative_altitude_m for p in photographs}
    shares = []
    for image in (model.image(number) for number in model.reg_image_ids()):
        if image.name in names and above_start[image.name] > LOWEST_M:
            seen = [model.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
            ground, centre = fit.world_from_model(np.array(seen)), fit.world_from_model(image.projection_center()[None])
            shares.append((centre[0, 2] - np.median(ground[:, 2])) / above_start[image.name])
    if len(shares) < FEWEST:
        return None
    share = float(np.median(shares))
    return Heights(calibrated, design, share, share * design / calibrated)


def axes_spread_deg(model: pycolmap.Reconstruction) -> float:
    """RMS angle of the optical axes from their mean."""
    axes = np.array([model.image(number).viewing_direction() for number in model.reg_image_ids()])
    mean = axes.mean(axis=0)
    cosine = np.clip(axes @ mean / max(float(np.linalg.norm(mean)), 1e-9), -1, 1)
    return float(np.degrees(np.sqrt((np.arccos(cosine) ** 2).mean())))


def best_of(trials: Sequence[Trial]) -> Trial:
    """The richest of lenses, given the simplest first, that improves the matches and does not bend the model."""
    best = trials[0]
    for trial in trials[1:]:
        best = trial if _better(trial, best) else best
    return best


def _better(richer: Trial, plainer: Trial) -> bool:
    bends = richer.off_m is not None and plainer.off_m is not None and richer.off_m > BENDS * plainer.off_m
    return richer.error_px < WORTH * plainer.error_px and not bends


def told(choice: Choice) -> tuple[str, ...]:
    """What a surveyor should know of it, as sentences."""
    return (*_told_of_focal(choice), *_told_of_heights(choice.heights), *_told_of_terms(choice.trials))


def _told_of_focal(choice: Choice) -> list[str]:
    axes = f"the directions of the photographs differ by {choice.spread_deg:.0f} degrees"
    if choice.known and choice.freed:
        stated = choice.trials[0].focal_px
        return [f"The focal length was refined from {stated:.1f} to {choice.trials[-1].focal_px:.1f} px: {axes}."]
    if not choice.known and choice.spread_deg < SPREAD_DEG:
        return [
            f"Nothing states the focal length, and matches alone tell it badly ({axes}): unless ground control or "
            "differential GPS correct it, heights may be wrong by tens of percent. Photographs with EXIF would help."
        ]
    return []


def _told_of_heights(heights: Heights | None) -> list[str]:
    if heights is None:
        return []
    used, other = ("design", "calibrated") if heights.prefers_design else ("calibrated", "design")
    values = {
        "calibrated": (heights.calibrated_px, heights.calibrated_share),
        "design": (heights.design_px, heights.design_share),
    }
    return [
        f"The maker states two focal lengths. With the {used} one ({values[used][0]:.1f} px) the flight height is "
        f"{values[used][1]:.1%} of the drone's own, with the {other} one ({values[other][0]:.1f} px) "
        f"{values[other][1]:.1%}: the {used} one was used. The drone's height is above take-off, not above the ground."
    ]


def _told_of_terms(trials: Sequence[Trial]) -> list[str]:
    """Why the lens has no more terms, where positions spoke against them."""
    *others, best = trials
    richer = [t for t in others if TERMS[t.lens] > TERMS[best.lens] and t.error_px < WORTH * best.error_px]
    if not richer or best.off_m is None:
        return []
    other, terms = min(richer, key=lambda trial: trial.error_px), TERMS[best.lens]
    return [
        f"The lens has {terms} term{'s' * (terms > 1)} of distortion. With {TERMS[other.lens]} the matches would fit "
        f"better ({other.error_px:.2f} px instead of {best.error_px:.2f}), but the cameras worse with their positions "
        f"({other.off_m:.2f} m instead of {best.off_m:.2f}): the model would be bent."
    ]


def _trial(model: pycolmap.Reconstruction, lens: str, photographs: Sequence[Photograph]) -> Trial:
    camera = model.cameras[min(model.cameras)]
    return Trial(lens, model.compute_mean_reprojection_error(), _off_m(model, photographs), camera.mean_focal_length())


def _adjust(model: pycolmap.Reconstruction, lens: str, focal: bool) -> None:
    for camera in model.cameras.values():
        current = lens_from_colmap(camera.model.name, camera.width, camera.height, camera.params)
        mean = (current.fx + current.fy) / 2
        camera.model = getattr(pycolmap.CameraModelId, lens)
        camera.params = colmap_parameters(replace(current, fx=mean, fy=mean), lens)
    options = adjustment_options()
    options.refine_focal_length, options.refine_principal_point = focal, False
    config = all_images(model)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not `bundle_adjustment`, which is the same but prints whatever the log level.
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def _off_m(model: pycolmap.Reconstruction, photographs: Sequence[Photograph]) -> float | None:
    fit, names = _fit(model, photographs)
    if fit is None:
        return None
    centres = camera_centres(model)
    places = np.array([centres[name] for name in names])
    error = (fit.world_from_model(places) - fit.given_world)[fit.used]
    return float(np.sqrt((error**2).sum(1).mean()))


def _fit(
    model: pycolmap.Reconstruction, photographs: Sequence[Photograph]
) -> tuple[PositionFit | None, tuple[str, ...]]:
    """The model laid onto its cameras' positions, in thought, and whose positions these are; None if they are few."""
    centres = camera_centres(model)
    own = [photograph for photograph in photographs if photograph.name in centres]
    positions = given_positions(own)
    if len(positions.names) < FEWEST:
        return None, positions.names
    places = np.array([centres[name] for name in positions.names])
    return fit_positions(places, positions, positions.frame(), find_down(model, own)), positions.names
