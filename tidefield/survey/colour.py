"""Estimate and remove exposure differences and lens falloff (docs/method.md, section 12).

In display values, photograph i shows the sparse point p with the point's own colour times the photograph's gain times
the lens falloff towards the corners: log I_ip = g_i + f(r_ip) + a_p + b d_ip, with r the tangent of the angle to the
optical axis and f(r) = k1 r^2 + k2 r^4 + k3 r^6; for b d_ip see `data.exposure`. Whether gains and falloff help is
decided on points that took no part in their estimate. What the direction brings stays as it is: it belongs to the view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, UInt8

from tidefield.data.exposure import Seen, directional_terms, in_sequence, observe, robust_gains
from tidefield.data.scene import Scene
from tidefield.survey.georeference.bundle_adjustment import IMAGES_OF_A_LENS

HELPS = 0.97
"""Gains are applied if they reduce the photographs' disagreement to this share, ..."""
FALLOFF_HELPS = 0.99
"""... and the falloff if it reduces the rest to this share."""

STRIP_ROWS = 64
"""Rows that are corrected at once: in float64, a photograph of 45 megapixels would take a gigabyte several times."""


@dataclass(frozen=True)
class _Fit:
    """Log gains of the photographs, k1, k2, k3 of the lenses, and `exposure.directional_terms`."""

    gains: Float64[np.ndarray, "V 3"]
    falloff: Float64[np.ndarray, "L 3"]
    by_direction: Float64[np.ndarray, "2 3"]


@dataclass(frozen=True)
class ExposureCorrection:
    """How photographs are brought to a common exposure. The names of the attributes are keys of `stages.json`.

    Attributes:
        gain: brightness of each photograph relative to the common exposure, in the three channels; ones if `helps` is
            false.
        falloff: k1, k2, k3 of f(r) of each photograph's lens; zeros if `sees_falloff` is false, or if the lens took few
            photographs and another enough.
        before, gains_alone, after: disagreement of the photographs about points that took no part in the estimate:
            uncorrected, after division by gains, and after division by gains and falloff. A standard deviation of log
            colours: 0.05 is 5% of a pixel's value. NaN without such points.
        helps: whether gains are worth applying.
        sees_falloff: whether the falloff is.
    """

    gain: Float64[np.ndarray, "V 3"]
    falloff: Float64[np.ndarray, "V 3"]
    before: float
    gains_alone: float
    after: float
    helps: bool
    sees_falloff: bool


def estimate_correction(scene: Scene, lenses: Sequence[int], always: bool = False) -> ExposureCorrection:
    """Estimate the gains and the falloff of the training photographs of a scene.

    The gains of its held-out photographs are ones. The falloff is the lens's, so they share it.

    Args:
        scene: with sparse points; a small width suffices.
        lenses: a number for each photograph's lens.
        always: apply gains even if they do not help.
    """
    nothing = np.zeros((len(scene.cameras), 3))
    points = scene.points
    seen = None if points is None else observe(scene.photographs, scene.cameras, points, scene.train)
    if points is None or seen is None or len(np.unique(seen.point)) < 2:  # one to estimate by, one to test
        return ExposureCorrection(np.exp(nothing), nothing, np.nan, np.nan, np.nan, False, False)
    lens = np.unique(np.asarray(lenses, dtype=np.int64), return_inverse=True)[1]
    uv = points.uv_px[torch.from_numpy(seen.row)].double()
    which = torch.from_numpy(seen.photograph)
    tangent = ((uv - scene.cameras.principal_px[which]) / scene.cameras.focal_px[which]).norm(dim=1).numpy()
    power = _polynomial(tangent)
    # Points are divided, not observations: a point in both halves would be estimated and tested at once.
    odd = np.random.default_rng(0).permutation(int(seen.point.max()) + 1)[seen.point] % 2 == 1
    halves = [(seen.part(odd), power[odd]), (seen.part(~odd), power[~odd])]
    scores = np.zeros((2, 3))
    for k, (own, other) in enumerate((halves, halves[::-1])):
        gains, both = _fitted(own[0], None, lens), _fitted(*own, lens)
        none = replace(gains, gains=nothing)
        scores[k] = [_spread(*other, fit, lens) for fit in (none, gains, both)]
    before, alone, after = scores.mean(0)
    fit = _fitted(seen, power, lens)
    # With real lenses, the corners are darker than the centre.
    corner = tangent >= np.quantile(tangent, 0.95)
    darkens = (fit.falloff[lens[seen.photograph]] * power).sum(1)[corner].mean() < 0
    sees = bool(after < FALLOFF_HELPS * alone and darkens)
    helps = always or bool((after if sees else alone) < HELPS * before)
    sees = helps and sees
    if not sees:
        fit = _fitted(seen, None, lens)
    gain = np.exp(fit.gains - fit.gains[list(scene.train)].mean(0)) if helps else np.exp(nothing)
    gain[list(scene.test)] = 1.0
    return ExposureCorrection(gain, fit.falloff[lens], float(before), float(alone), float(after), helps, sees)


def to_common_exposure(
    photograph: UInt8[np.ndarray, "H W 3"],
    gain: Float64[np.ndarray, "3"],
    falloff: Float64[np.ndarray, "3"],
    tangent: Float[np.ndarray, "_ _"],
) -> UInt8[np.ndarray, "H W 3"]:
    """Bring a photograph to the common exposure and remove the lens falloff.

    Args:
        falloff: k1, k2, k3.
        tangent: of the angle between each pixel's ray and the optical axis, H x W; 1 x 1 without falloff.
    """
    corrected = np.empty_like(photograph)
    for first in range(0, len(photograph), STRIP_ROWS):
        rows = slice(first, first + STRIP_ROWS)
        shade = np.exp(_polynomial(tangent[rows] if len(tangent) > 1 else tangent) @ falloff)[..., None]
        corrected[rows] = np.clip(np.rint(photograph[rows] / (shade * gain)), 0, 255)
    return corrected


def _polynomial(tangent: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S 3"]:
    """Compute r^2, r^4, r^6."""
    square = np.square(tangent)
    return np.stack([square, square**2, square**3], axis=-1)


def _fitted(seen: Seen, power: Float64[np.ndarray, "O 3"] | None, lens: Int64[np.ndarray, " V"]) -> _Fit:
    """Gains of the photographs, and the falloff of each lens if the powers of `_polynomial` are given.

    Few photographs show points at few distances from the axis, and between and beyond these, the polynomial would be
    anything: as in bundle adjustment, their lenses have none.
    """
    lenses, own = int(lens.max()) + 1, lens[seen.photograph]
    few = np.bincount(lens[np.unique(seen.photograph)], minlength=lenses) < IMAGES_OF_A_LENS
    few &= not few.all()  # a small survey's own lens is judged by what it explains
    own[few[own]] = -1
    terms = None
    if power is not None:
        terms = np.concatenate([np.where((own == k)[:, None], power, 0.0) for k in range(lenses)], axis=1)
    prior = np.zeros(len(lens))
    order = in_sequence(np.arange(len(lens), dtype=np.float64), np.unique(seen.photograph))
    by_direction, found = directional_terms(seen, prior, order, terms)
    known = seen.direction @ by_direction + (0.0 if terms is None else (terms @ found)[:, None])
    gains, _ = robust_gains(replace(seen, value=seen.value - known), prior)
    return _Fit(gains, np.zeros((lenses, 3)) if terms is None else found.reshape(lenses, 3), by_direction)


def _spread(
    seen: Seen,
    power: Float64[np.ndarray, "O 3"],
    fit: _Fit,
    lens: Int64[np.ndarray, " V"],
) -> float:
    """Estimate the standard deviation of the log colours of each point, after a fit (robust: MAD)."""
    known = (power * fit.falloff[lens[seen.photograph]]).sum(1)[:, None] + seen.direction @ fit.by_direction
    residual = seen.centred(seen.value - fit.gains[seen.photograph] - known)
    sharing = np.bincount(seen.point)[seen.point]
    return float(1.4826 * np.median(np.abs(residual * np.sqrt(sharing / (sharing - 1))[:, None])))
