"""Colour differences between photographs, and their removal (method.md, section 12).

On display-referred values, what photograph i shows of sparse point p is the point's own colour times the photograph's
gain times the lens' falloff towards the corners: log I_ip = g_i + f(r_ip) + a_p, with r the tangent of the angle to the
optical axis and f(r) = k1 r^2 + k2 r^4 + k3 r^6. Whether gains and falloff help is judged on points that took no part
in their estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from numpy.typing import NDArray
from scipy import sparse

from tidefield.data.exposure import ITERATIONS, LOOSE, Seen, huber_weights, observe, robust_gains, weighted_gains
from tidefield.data.scene import Scene

HELPS = 0.97
"""Gains are worth it where the photographs' disagreement falls to this share of what it was, ..."""
FALLOFF_HELPS = 0.99
"""... and a falloff where it falls by so much again."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Evening:
    """How photographs are brought to a common exposure.

    Attributes:
        gain: V x 3, by which a photograph is brighter than the common exposure; ones where that does not help.
        falloff: of each photograph's lens, k1, k2, k3 of f(r); zeros where none is seen.
        before, gains_alone, after: how much photographs disagree about points that took no part in the estimate, as
            the standard deviation of log colours (0.05 is 5% of a pixel's value): as they are, after division by gains,
            and by the falloff too.
        helps: whether gains are worth applying.
        sees_falloff: whether the falloff is.
    """

    gain: Array
    falloff: Array
    before: float
    gains_alone: float
    after: float
    helps: bool
    sees_falloff: bool


def estimate_evening(scene: Scene, lenses: Sequence[int], always: bool = False) -> Evening:
    """Gains and falloff of all photographs of a scene.

    Args:
        scene: with sparse points; a small width is enough.
        lenses: any number for each photograph's lens.
        always: apply gains even where they do not help.
    """
    count, nothing = len(scene.cameras), np.zeros((len(scene.cameras), 3))
    seen = observe(scene.photographs, scene.points, range(count)) if scene.points is not None else None
    if seen is None or not len(seen.value):
        return Evening(np.exp(nothing), nothing, np.nan, np.nan, np.nan, False, False)
    lens = np.unique(np.asarray(lenses, dtype=np.int64), return_inverse=True)[1]
    power = _powers(scene, seen)
    # Whole points, not observations: a point on both sides would carry what was learned across.
    odd = np.random.default_rng(0).permutation(int(seen.point.max()) + 1)[seen.point] % 2 == 1
    halves = [(_part(seen, odd), power[odd]), (_part(seen, ~odd), power[~odd])]
    scores = np.zeros((2, 3))
    for k, (own, other) in enumerate((halves, halves[::-1])):
        gains = robust_gains(own[0], np.zeros(count))[0]
        both = _gains_and_falloff(*own, lens, count)
        scores[k] = [_spread(*other, g, f, lens) for g, f in ((nothing, nothing), (gains, nothing), both)]
    before, alone, after = scores.mean(0)
    helps = always or bool(min(alone, after) < HELPS * before)
    gains, falloff = _gains_and_falloff(seen, power, lens, count)
    sees = helps and bool(after < FALLOFF_HELPS * alone) and _darkens(falloff[lens[seen.photograph]], power)
    if not sees:
        gains, falloff = robust_gains(seen, np.zeros(count))[0], np.zeros_like(falloff)
    gain = np.exp(gains - gains.mean(0)) if helps else np.exp(nothing)
    return Evening(gain, falloff[lens], float(before), float(alone), float(after), helps, sees)


def evened(
    photograph: UInt8[np.ndarray, "H W 3"],
    gain: Float64[np.ndarray, "3"],
    falloff: Float64[np.ndarray, "3"],
    tangent: Float[np.ndarray, "_ _"],
) -> UInt8[np.ndarray, "H W 3"]:
    """A photograph at the common exposure, without its lens' falloff.

    Args:
        photograph: H x W x 3.
        gain: 3.
        falloff: k1, k2, k3.
        tangent: H x W, of the angle between each pixel's ray and the optical axis; 1 x 1 where there is no falloff.
    """
    shade = np.exp(_polynomial(tangent) @ falloff)[..., None]
    return np.clip(np.rint(photograph / (shade * gain)), 0, 255).astype(np.uint8)


def _polynomial(tangent: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S 3"]:
    square = np.square(tangent)
    return np.stack([square, square**2, square**3], axis=-1)


def _powers(scene: Scene, seen: Seen) -> Array:
    """r^2, r^4, r^6 of every observation, O x 3."""
    assert scene.points is not None
    uv = scene.points.uv_px[torch.from_numpy(seen.row)].double()
    which = torch.from_numpy(seen.photograph)
    xy = (uv - scene.cameras.principal_px[which]) / scene.cameras.focal_px[which]
    return _polynomial(xy.norm(dim=1).numpy())


def _part(seen: Seen, chosen: NDArray[np.bool_]) -> Seen:
    return replace(
        seen,
        value=seen.value[chosen],
        point=seen.point[chosen],
        photograph=seen.photograph[chosen],
        row=seen.row[chosen],
    )


def _gains_and_falloff(seen: Seen, power: Array, lens: NDArray[np.int64], count: int) -> tuple[Array, Array]:
    """Log gains V x 3 and falloff L x 3, the same in all channels, by iteratively reweighted least squares.

    Gains and points are eliminated first (Frisch and Waugh, 1933): what of the falloff's terms no gain can explain is
    fitted to what of the colours none can.
    """
    lenses, own = int(lens.max()) + 1, lens[seen.photograph]
    terms = np.concatenate([np.where((own == k)[:, None], power, 0.0) for k in range(lenses)], axis=1)
    loose, nothing = sparse.diags_array(np.full(count, LOOSE)), np.zeros(count)
    weight = np.ones(len(seen.value))
    gains, falloff = np.zeros((count, 3)), np.zeros(3 * lenses)
    for _ in range(ITERATIONS):
        values = np.concatenate([seen.value, terms], axis=1)
        fitted = weighted_gains(seen, values, weight, loose, nothing)
        rest = seen.centred(values - fitted[seen.photograph], weight)
        root = np.sqrt(weight)[:, None]
        x, y = root * rest[:, 3:], root[:, 0] * rest[:, :3].mean(1)
        # The little ridge leaves a falloff that nothing shows at zero.
        falloff = np.linalg.solve(x.T @ x + 1e-6 * np.eye(3 * lenses), x.T @ y)
        gains = fitted[:, :3] - (fitted[:, 3:] @ falloff)[:, None]
        weight, _ = huber_weights(rest[:, :3] - (rest[:, 3:] @ falloff)[:, None])
    return gains, falloff.reshape(lenses, 3)


def _spread(seen: Seen, power: Array, gains: Array, falloff: Array, lens: NDArray[np.int64]) -> float:
    """Robust standard deviation of the log colours of the same points, after gains and falloff."""
    own = lens[seen.photograph]
    shade = (power * falloff[own]).sum(1)[:, None] if falloff.any() else 0.0
    residual = seen.centred(seen.value - gains[seen.photograph] - shade)
    sharing = np.bincount(seen.point)[seen.point]
    return float(1.4826 * np.median(np.abs(residual * np.sqrt(sharing / (sharing - 1))[:, None])))


def _darkens(falloff: Array, power: Array) -> bool:
    """Whether the corners are darker than the middle, as lenses make them."""
    return bool((falloff * power).sum(1)[power[:, 0] >= np.quantile(power[:, 0], 0.95)].mean() < 0)
