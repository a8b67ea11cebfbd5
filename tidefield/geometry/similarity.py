"""Similarities (scale, rotation, translation) between point sets: closed form, against gross errors, and weighted.

Closed form: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
Least median: Rousseeuw, "Least median of squares regression", JASA 1984, which stands half of the points being wrong
without being told how good the others are.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.spatial.transform import Rotation

ON_ONE_LINE = 0.02
"""Points whose spread across is less than this share of their spread along lie on one line for our purposes."""
_HYPOTHESES = 600
"""Enough that, with 40% of the points wrong, the odds of never drawing three right ones are below 1e-60."""
_HUBER = 1.345
"""In standard deviations: 95% efficient on normal errors (Huber 1981)."""
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Similarity:
    """target = scale * rotation @ source + translation, in float64."""

    scale: float
    rotation: Float64[np.ndarray, "3 3"]
    translation: Float64[np.ndarray, " 3"]

    def __call__(self, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        return self.scale * points @ self.rotation.T + self.translation

    def inverse(self) -> Similarity:
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -rotation @ self.translation / self.scale)

    def __matmul__(self, first: Similarity) -> Similarity:
        """`first`, then this one."""
        translation = self.scale * self.rotation @ first.translation + self.translation
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, translation)


def fit_similarity(source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"]) -> Similarity:
    """Least squares over all points: three or more that do not lie on one line."""
    scale, rotation, translation = _umeyama(source[None], target[None])
    return Similarity(float(scale[0]), rotation[0], translation[0])


def hypotheses(
    source: Float64[np.ndarray, "N 3"],
    target: Float64[np.ndarray, "N 3"],
    down_source: Float64[np.ndarray, " 3"] | None,
    generator: np.random.Generator,
) -> list[Similarity]:
    """Similarities through a few of the points, so that some are through none of those that are wrong.

    Args:
        down_source: roughly where -z of the target points in the source. With it two points make a similarity, so
            that points on one line will do.
    """
    if len(source) < 2:
        return []
    found = []
    spread = np.linalg.svd(source - source.mean(0), compute_uv=False)
    if len(source) >= 3 and spread[1] > ON_ONE_LINE * spread[0]:
        triples = _subsets(len(source), 3, generator)
        found += zip(*_umeyama(source[triples], target[triples]), strict=True)
    if down_source is not None:
        pairs = _subsets(len(source), 2, generator)
        found += zip(*_level(source[pairs], target[pairs], down_source), strict=True)
    return [Similarity(float(scale), rotation, translation) for scale, rotation, translation in found]


def least_median(
    among: list[Similarity], source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"]
) -> tuple[Similarity, float]:
    """The one with the smallest median distance, and that distance."""
    rank = min(len(source), max(3, len(source) // 2 + 1)) - 1
    median = [np.partition(np.linalg.norm(one(source) - target, axis=1), rank)[rank] for one in among]
    best = int(np.argmin(median))
    return among[best], float(median[best])


@dataclass(frozen=True)
class Refined:
    """A weighted fit.

    Attributes:
        similarity: the fit.
        tilt_rad: standard deviation of the target's vertical, in the direction that is held least.
    """

    similarity: Similarity
    tilt_rad: float


def refine_similarity(
    start: Similarity,
    source: Float64[np.ndarray, "N 3"],
    target: Float64[np.ndarray, "N 3"],
    sigma: Float64[np.ndarray, "N 3"],
    down_source: Float64[np.ndarray, " 3"] | None = None,
    sigma_down_rad: float = 1.0,
) -> Refined:
    """Robust weighted least squares from a good start (Huber's loss, by iteratively reweighted Gauss-Newton steps).

    Args:
        sigma: standard deviations of the target's coordinates.
        down_source: where -z of the target points in the source, if that is to be held, to within `sigma_down_rad`.
    """
    centre = source.mean(0)
    scale, rotation, middle = start.scale, start.rotation, start(centre[None])[0]
    normal = np.eye(7)
    for _ in range(50):
        arms = scale * (source - centre) @ rotation.T
        residual = (arms + middle - target) / sigma
        weight = np.minimum(1, _HUBER / np.maximum(np.linalg.norm(residual, axis=1), 1e-12))
        # Of log scale, rotation about the world's axes, and the image of the centre.
        slope = np.concatenate([arms[:, :, None], -_cross(arms), np.broadcast_to(np.eye(3), (len(arms), 3, 3))], axis=2)
        slope /= sigma[:, :, None]
        normal = np.einsum("n,nij,nik->jk", weight, slope, slope)
        gradient = np.einsum("n,nij,ni->j", weight, slope, residual)
        if down_source is not None:
            down = rotation @ (down_source / np.linalg.norm(down_source))
            tilt = -_cross(down[None])[0] / sigma_down_rad
            normal[1:4, 1:4] += tilt.T @ tilt
            gradient[1:4] += tilt.T @ ((down + _UP) / sigma_down_rad)
        # Points on one line leave one rotation free; this keeps it where it was, and is nothing beside all others.
        normal += 1e-12 * np.diag(normal).max() * np.diag([1.0, 1, 1, 1, 0, 0, 0])
        step = -np.linalg.solve(normal, gradient)
        scale, middle = scale * float(np.exp(step[0])), middle + step[4:]
        rotation = Rotation.from_rotvec(step[1:4]).as_matrix() @ rotation
        if np.abs(step[:4]).max() < 1e-11:
            break
    tilt_rad = float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(normal)[1:3, 1:3])[-1]))
    return Refined(Similarity(scale, rotation, middle - scale * rotation @ centre), tilt_rad)


def level(down_source: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """The smallest rotation that brings a direction to -z."""
    down = down_source / np.linalg.norm(down_source)
    return Rotation.align_vectors(-_UP[None], down[None])[0].as_matrix()


def outliers(distance: Float64[np.ndarray, " N"], floor: Float64[np.ndarray, " N"] | float) -> Bool[np.ndarray, " N"]:
    """Distances beyond four robust standard deviations (1.4826 times the median), and beyond a floor."""
    return distance > np.maximum(4 * 1.4826 * np.median(distance), floor)


def _subsets(count: int, size: int, generator: np.random.Generator) -> Int[np.ndarray, "B K"]:
    """All subsets of a size, or as many random ones as are tried."""
    if comb(count, size) <= _HYPOTHESES:
        return np.array(list(combinations(range(count), size)))
    return generator.random((_HYPOTHESES, count)).argpartition(size, axis=1)[:, :size]


def _umeyama(
    source: Float64[np.ndarray, "B K 3"], target: Float64[np.ndarray, "B K 3"]
) -> tuple[Float64[np.ndarray, " B"], Float64[np.ndarray, "B 3 3"], Float64[np.ndarray, "B 3"]]:
    middle, image = source.mean(1, keepdims=True), target.mean(1, keepdims=True)
    p, q = source - middle, target - image
    u, singular, vt = np.linalg.svd(q.transpose(0, 2, 1) @ p)
    sign = np.ones_like(singular)
    sign[:, 2] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * sign[:, None, :]) @ vt
    # Points that coincide get no scale rather than none that is a number.
    scale = (singular * sign).sum(1) / np.maximum((p**2).sum((1, 2)), 1e-300)
    return scale, rotation, image[:, 0] - scale[:, None] * (rotation @ middle.transpose(0, 2, 1))[:, :, 0]


def _level(
    source: Float64[np.ndarray, "B 2 3"], target: Float64[np.ndarray, "B 2 3"], down_source: Float64[np.ndarray, " 3"]
) -> tuple[Float64[np.ndarray, " B"], Float64[np.ndarray, "B 3 3"], Float64[np.ndarray, "B 3"]]:
    """Similarities that turn `down_source` to -z and take one pair of points to the other as seen from above."""
    upright = level(down_source)
    flat = source @ upright.T
    p, q = flat[:, 1] - flat[:, 0], target[:, 1] - target[:, 0]
    length = np.linalg.norm(p[:, :2], axis=1)
    scale = np.linalg.norm(q[:, :2], axis=1) / np.maximum(length, 1e-300)
    turn = np.arctan2(q[:, 1], q[:, 0]) - np.arctan2(p[:, 1], p[:, 0])
    rotation = Rotation.from_rotvec(turn[:, None] * _UP).as_matrix() @ upright
    image = (rotation @ source.mean(1)[:, :, None])[:, :, 0]
    return scale, rotation, target.mean(1) - scale[:, None] * image


def _cross(vectors: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3 3"]:
    """[v]x, so that [v]x u = v x u."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
