"""Exposure gains: one factor per photograph and colour channel that relates it to the scene's common exposure.

Method.md, section 12. The model is multiplicative on display-referred values, log I_ip = g_i + a_p: what photograph i
shows around sparse point p is the point's own colour times the photograph's gain. Three sources are solved as one
sparse least-squares problem, so that each photograph leans on what is known of it:

- training photographs that see the same points (robustly: water moves, shine wanders);
- photographs taken one after the other, whose gains differ little beyond what their EXIF exposures say;
- photographs taken close to each other, likewise.

The last two are weighted by how well they hold among the training photographs. Held-out photographs take part in them
only: their gains come from their metadata and their neighbours, never from their pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree
from torch import Tensor

from tidefield.data.exif import Exposures
from tidefield.data.images import Photographs
from tidefield.data.scene import Scene, SparsePoints
from tidefield.geometry.cameras import Cameras

DISPLAY_SLOPE = 0.45
"""Log display value per log exposure where the photographs cannot tell: sRGB's overall exponent of 1 / 2.2."""
SLOPE_TRUST = 0.01
"""Weight of `DISPLAY_SLOPE` against the measured slope: that of one pair whose log exposures differ by 0.1."""
DARK, BRIGHT, CLIPPED = 8.0, 247.0, 252
"""8-bit window means outside DARK..BRIGHT say nothing of a gain (noise and black borders, clipping); a pixel of
CLIPPED or more has lost its value, and a window may hold a tenth of such."""
HUBER = 1.345
"""Huber's threshold in standard deviations: 95% as efficient as least squares on clean Gaussian residuals."""
ITERATIONS = 15
SMALLEST_NOISE = 0.01
"""Of a log window mean: rounding to 8 bits and resampling are never better, and weights need a positive scale."""
LOOSE = 1e-6
"""Weight of a photograph's prior gain. It holds the overall level, which nothing else does, and photographs that
nothing connects."""
SUPPORT = 10
"""Observations that a training photograph needs before it takes part in judging the neighbours' likeness."""

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def estimate_gains(
    photographs: Photographs,
    cameras: Cameras,
    points: SparsePoints | None,
    train: Sequence[int],
    metadata: Exposures | None = None,
) -> Float[Tensor, "V 3"]:
    """Gain of every photograph and channel; its geometric mean over the training photographs is 1 in each channel.

    Args:
        photographs: the pixels; only training photographs' are read, and used only around sparse points.
        cameras: one per photograph, for their positions; their own gains are ignored.
        points: which photograph sees which point; without points the gains are what the EXIF exposures say,
            and 1 where these say nothing.
        train: indices of the training photographs; all others are held out.
        metadata: what the files say (`exif.read_exposures`); None means nothing.
    """
    count, learned = len(cameras), np.asarray(train, dtype=np.int64)
    exposure, clock = _exposure_and_clock(metadata, count)
    seen = observe(photographs, points, train) if points is not None else None
    if seen is not None and len(seen.value):
        gains = _solve(seen, exposure, clock, cameras.position_world.double().cpu().numpy(), learned)
    else:
        gains = DISPLAY_SLOPE * exposure[:, None] * np.ones(3)
    return torch.as_tensor(np.exp(gains - gains[learned].mean(0)), dtype=torch.float32)


def disagreement(
    photographs: Photographs, points: SparsePoints, which: Sequence[int], gains: Float[Tensor, "V 3"]
) -> tuple[float, float]:
    """How much photographs disagree about the colour of the points they share, after division by their gains.

    Returns:
        Root-mean-square of the log residuals (0.05 is 5% of a pixel's value), and 1.4826 times the median of their
        magnitudes, which outliers such as moving water do not move. NaN where no two photographs share a point.
    """
    seen = observe(photographs, points, which)
    if not len(seen.value):
        return float("nan"), float("nan")
    residual = seen.centred(seen.value - np.log(gains.double().cpu().numpy())[seen.photograph])
    # A mean of n values follows them: without this factor a point seen twice would look twice as consistent.
    sharing = np.bincount(seen.point)[seen.point]
    residual *= np.sqrt(sharing / (sharing - 1))[:, None]
    return float(np.sqrt((residual**2).mean())), float(1.4826 * np.median(np.abs(residual)))


@dataclass(frozen=True)
class Seen:
    """O usable observations of points that at least two photographs share.

    Attributes:
        value: log mean colour around the point, O x 3.
        point: the point, O.
        photograph: the photograph, O.
        row: which of the sparse points' observations each is, O.
    """

    value: Array
    point: Index
    photograph: Index
    row: Index

    def centred(self, value: Array, weight: Array | None = None) -> Array:
        """Values (O x 3) less the weighted mean of all values of the same point."""
        weight = np.ones(len(value)) if weight is None else weight
        total = np.bincount(self.point, weight)
        mean = np.stack([np.bincount(self.point, weight * c) for c in value.T], 1) / np.maximum(total, 1e-12)[:, None]
        return value - mean[self.point]


@dataclass(frozen=True)
class _Pairs:
    """Photographs whose gains are expected to be alike, and how far apart they are in time or space (1 = usual)."""

    a: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    b: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    apart: Array = field(default_factory=lambda: np.zeros(0))

    def difference(self, value: Array) -> Array:
        return value[self.b] - value[self.a]


_NOBODY = _Pairs()


def observe(photographs: Photographs, points: SparsePoints, which: Sequence[int]) -> Seen:
    """Mean log colours of a small window around every sparse point seen in the given photographs."""
    camera, uv = points.camera_index.cpu().numpy(), points.uv_px.double().cpu().numpy()
    values, rows = [np.zeros((0, 3))], [np.zeros(0, dtype=np.int64)]
    for i in which:
        row = np.flatnonzero(camera == i)
        if len(row):
            value, usable = _window_means(photographs[i].cpu().numpy(), uv[row])
            values.append(np.log(value[usable]))
            rows.append(row[usable])
    row = np.concatenate(rows)
    point = points.point_index.cpu().numpy()[row].astype(np.int64)
    shared = np.bincount(point, minlength=1)[point] > 1
    return Seen(np.concatenate(values)[shared], point[shared], camera[row][shared].astype(np.int64), row[shared])


def _window_means(pixels: NDArray[np.uint8], uv_px: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Mean 8-bit colours around pixels, and which of them lie inside and are neither black nor clipped."""
    height, width = pixels.shape[:2]
    side = max(3, 2 * round(width / 160) + 1)
    lost = (pixels >= CLIPPED).any(-1)
    mean = cv2.blur(np.asarray(pixels, dtype=np.float32), (side, side))
    clipped = cv2.blur(np.asarray(lost, dtype=np.float32), (side, side))
    column, row = np.floor(uv_px).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = column.clip(0, width - 1), row.clip(0, height - 1)
    value = mean[row, column].astype(np.float64)
    return value, inside & ((value > DARK) & (value < BRIGHT)).all(1) & (clipped[row, column] <= 0.1)


def _solve(seen: Seen, exposure: Array, clock: Array, position: Array, train: Index) -> Array:
    """Log gains from the observations alone, then again with the neighbours as far as these were alike."""
    count = len(exposure)
    first, noise = robust_gains(seen, np.zeros(count))
    supported = train[np.bincount(seen.photograph, minlength=count)[train] >= SUPPORT]
    sequence = _in_sequence(clock, supported)
    slope = _exposure_slope(sequence.difference(first), sequence.difference(exposure), sequence.apart)
    prior = slope * exposure
    pairs, weights = [], []
    for known, everyone in (
        (sequence, _in_sequence(clock, np.arange(count))),
        (_nearby(position, supported), _nearby(position, np.arange(count))),
    ):
        # A random walk: the variance of a difference grows with the distance.
        rest = known.difference(first - prior[:, None])
        variance = max(((rest**2).mean(1) / known.apart).mean(), 1e-6) if len(rest) else 1.0
        pairs.append(everyone)
        weights.append(noise**2 / (variance * everyone.apart))
    both = _Pairs(*(np.concatenate([getattr(p, name) for p in pairs]) for name in ("a", "b", "apart")))
    gains, _ = robust_gains(seen, prior, both, np.concatenate(weights))
    return gains


def robust_gains(
    seen: Seen, prior: Array, pairs: _Pairs = _NOBODY, pair_weight: Array | None = None
) -> tuple[Array, float]:
    """Log gains (V x 3) by iteratively reweighted least squares, and the residuals' standard deviation.

    Minimises sum_o w_o |y_o - g - a|^2 + sum_pairs w |(g_b - g_a) - (prior_b - prior_a)|^2 + tiny |g - prior|^2
    with Huber's weights w_o over observations. The points' colours a are eliminated in closed form.
    """
    count, rows = len(prior), np.arange(len(pairs.a))
    pair_weight = np.zeros(0) if pair_weight is None else pair_weight
    minus_plus = np.concatenate([-np.ones(len(rows)), np.ones(len(rows))])
    where = (np.concatenate([rows, rows]), np.concatenate([pairs.a, pairs.b]))
    incidence = sparse.csr_array((minus_plus, where), shape=(len(rows), count))
    fixed = incidence.T @ sparse.diags_array(pair_weight) @ incidence + sparse.diags_array(np.full(count, LOOSE))
    weight, gains, noise = np.ones(len(seen.value)), np.zeros((count, 3)), 0.0
    for _ in range(ITERATIONS):
        gains = weighted_gains(seen, seen.value, weight, fixed, fixed @ prior)
        weight, noise = huber_weights(seen.centred(seen.value - gains[seen.photograph], weight))
    return gains, noise


def weighted_gains(seen: Seen, value: Array, weight: Array, fixed: sparse.sparray, pull: Array) -> Array:
    """Least-squares gains (V x C) of values (O x C), beside the quadratic form `fixed` with right side `pull` (V)."""
    count = len(pull)
    of_point, of_photograph = np.bincount(seen.point, weight), np.bincount(seen.photograph, weight, count)
    table = sparse.csr_array((weight, (seen.point, seen.photograph)), shape=(len(of_point), count))
    shared = table.T @ sparse.diags_array(1 / np.maximum(of_point, 1e-12)) @ table
    right = weight[:, None] * seen.centred(value, weight)
    right = np.stack([np.bincount(seen.photograph, c, count) for c in right.T], 1)
    system = sparse.csc_array(sparse.diags_array(of_photograph) - shared + fixed)
    return np.asarray(spsolve(system, right + pull[:, None])).reshape(right.shape)


def huber_weights(residual: Array) -> tuple[Array, float]:
    """Weights of observations by their residuals (O x 3), and these residuals' standard deviation."""
    # One weight for the three channels: what moved or shone did so in all of them.
    size = np.sqrt((residual**2).mean(1))
    noise = max(float(1.4826 * np.median(size)), SMALLEST_NOISE)
    return np.minimum(1.0, HUBER * noise / np.maximum(size, 1e-12)), noise


def _exposure_slope(gain_change: Array, exposure_change: Array, apart: Array) -> float:
    """Log gain per log exposure, from photographs taken one after the other.

    Successive photographs, because over a longer time automatic exposure follows the light of the day, and both cancel.
    """
    held = (exposure_change**2 / apart).sum() + SLOPE_TRUST
    slope = ((gain_change.mean(1) * exposure_change / apart).sum() + SLOPE_TRUST * DISPLAY_SLOPE) / held
    return float(np.clip(slope, 0.0, 1.0))


def _exposure_and_clock(metadata: Exposures | None, count: int) -> tuple[Array, Array]:
    """Centred log exposures (0 where unknown), and a clock: seconds, or the photographs' order where times lack."""
    order = np.arange(count, dtype=np.float64)
    if metadata is None:
        return np.zeros(count), order
    exposure = metadata.log_exposure
    known = np.isfinite(exposure)
    centred = np.where(known, exposure - exposure[known].mean() if known.any() else 0.0, 0.0)
    time = metadata.time_s
    # EXIF counts whole seconds: the order breaks ties. Equal times everywhere tell nothing.
    usable = np.isfinite(time).all() and np.unique(time).size > count / 2
    return centred, time - time.min() + 1e-3 * order if usable else order


def _in_sequence(clock: Array, which: Index) -> _Pairs:
    """Each of the given photographs with the next one."""
    order = which[np.argsort(clock[which], kind="stable")]
    usual = np.median(np.diff(np.sort(clock))) if len(clock) > 1 else 1.0
    apart = np.maximum(np.diff(clock[order]) / max(usual, 1e-9), 0.1)
    return _Pairs(order[:-1], order[1:], apart)


def _nearby(position: Array, which: Index) -> _Pairs:
    """Each of the given photographs with the two taken closest to it."""
    if len(which) < 3:
        return _NOBODY
    usual = np.median(KDTree(position).query(position, k=2)[0][:, 1])
    found = KDTree(position[which]).query(position[which], k=3)
    distance, neighbour = (np.asarray(column)[:, 1:].ravel() for column in found)
    return _Pairs(np.repeat(which, 2), which[neighbour], np.maximum(distance / max(usual, 1e-9), 0.1))


def to_common_exposure(
    scene: Scene, index: int, rows: slice = slice(None), columns: slice = slice(None)
) -> Float[Tensor, "h w 3"]:
    """A part of a photograph at the common exposure: divided by its gain (method.md, section 12)."""
    return scene.photographs[index][rows, columns].float() / (255 * scene.cameras.gain[index])
