"""Similarities (scale, rotation, translation) between point sets: minimal, robust and weighted estimates.

Closed form: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
Least median of squares: Rousseeuw, JASA 1984. It tolerates half of the points being wrong without a threshold for the
others, as RANSAC (pycolmap.estimate_sim3d_robust) needs it: receivers are good to centimetres or to ten metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.spatial.transform import Rotation

COLLINEAR = 0.02
"""Points count as collinear whose second singular value is less than this share of the first."""
_HYPOTHESES = 600
"""With 40% of the points wrong, the probability of never drawing three right ones is below 1e-60."""
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
        """Compose: apply `first`, then this one."""
        translation = self.scale * self.rotation @ first.translation + self.translation
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, translation)


def hypotheses(
    source: Float64[np.ndarray, "N 3"],
    target: Float64[np.ndarray, "N 3"],
    down_source: Float64[np.ndarray, " 3"] | None,
    generator: np.random.Generator,
) -> list[Similarity]:
    """Compute similarities from minimal subsets of the points, so that some of them contain no wrong point.

    Args:
        down_source: approximate direction of the target's -z in the source. With it two points determine a
            similarity, so that collinear points suffice.
    """
    if len(source) < 2:
        return []
    found = []
    spread = np.linalg.svd(source - source.mean(0), compute_uv=False)
    if len(source) >= 3 and spread[1] > COLLINEAR * spread[0]:
        triples = _subsets(len(source), 3, generator)
        found += zip(*_umeyama(source[triples], target[triples]), strict=True)
    if down_source is not None:
        pairs = _subsets(len(source), 2, generator)
        found += zip(*_levelled(source[pairs], target[pairs], down_source), strict=True)
    return [Similarity(float(scale), rotation, translation) for scale, rotation, translation in found]


def least_median(
    candidates: list[Similarity], source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"]
) -> tuple[Similarity, float]:
    """Select the similarity with the smallest median distance; return it and that distance."""
    rank = min(len(source), max(3, len(source) // 2 + 1)) - 1
    median = [np.partition(np.linalg.norm(one(source) - target, axis=1), rank)[rank] for one in candidates]
    best = int(np.argmin(median))
    return candidates[best], float(median[best])


@dataclass(frozen=True)
class Refined:
    """A weighted estimate.

    Attributes:
        similarity: the estimate.
        tilt_rad: standard deviation of the target's vertical, in its least certain direction.
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
    """Estimate a similarity by robust weighted least squares from a good start.

    Huber's loss of each point's whole distance, by iteratively reweighted Gauss-Newton steps. (scipy's least_squares
    applies the loss to each coordinate, so that the result depends on the axes; it takes 1.4 times as long.)

    Args:
        sigma: standard deviations of the target's coordinates.
        down_source: a prior for the direction of the target's -z in the source, of standard deviation
            `sigma_down_rad`.
    """
    centre = source.mean(0)
    scale, rotation, middle = start.scale, start.rotation, start(centre[None])[0]
    normal = np.eye(7)
    for _ in range(50):
        arms = scale * (source - centre) @ rotation.T
        residual = (arms + middle - target) / sigma
        weight = np.minimum(1, _HUBER / np.maximum(np.linalg.norm(residual, axis=1), 1e-12))
        # Jacobian by log scale, rotation about the target's axes, and position of the centre.
        jacobian = np.concatenate(
            [arms[:, :, None], -_cross(arms), np.broadcast_to(np.eye(3), (len(arms), 3, 3))], axis=2
        )
        jacobian /= sigma[:, :, None]
        normal = np.einsum("n,nij,nik->jk", weight, jacobian, jacobian)
        gradient = np.einsum("n,nij,ni->j", weight, jacobian, residual)
        if down_source is not None:
            down = rotation @ (down_source / np.linalg.norm(down_source))
            tilt = -_cross(down[None])[0] / sigma_down_rad
            normal[1:4, 1:4] += tilt.T @ tilt
            gradient[1:4] += tilt.T @ ((down + _UP) / sigma_down_rad)
        # Collinear points leave one rotation free: damp it, by a term that is negligible next to all others.
        normal += 1e-12 * np.diag(normal).max() * np.diag([1.0, 1, 1, 1, 0, 0, 0])
        step = -np.linalg.solve(normal, gradient)
        # Where points contradict each other the start has a scale near 0, from which whole steps overflow.
        step[:4] /= max(1.0, np.abs(step[:4]).max())
        scale, middle = scale * float(np.exp(step[0])), middle + step[4:]
        rotation = Rotation.from_rotvec(step[1:4]).as_matrix() @ rotation
        if np.abs(step[:4]).max() < 1e-11:
            break
    tilt_rad = float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(normal)[1:3, 1:3])[-1]))
    return Refined(Similarity(scale, rotation, middle - scale * rotation @ centre), tilt_rad)


def level(down_source: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Compute the smallest rotation that brings a direction to -z."""
    down = down_source / np.linalg.norm(down_source)
    return Rotation.align_vectors(-_UP[None], down[None])[0].as_matrix()


def outliers(distance: Float64[np.ndarray, " N"], floor: Float64[np.ndarray, " N"] | float) -> Bool[np.ndarray, " N"]:
    """Mark distances beyond four robust standard deviations (1.4826 times the median) and beyond a floor."""
    return distance > np.maximum(4 * 1.4826 * np.median(distance), floor)


def _subsets(count: int, size: int, generator: np.random.Generator) -> Int[np.ndarray, "B K"]:
    """List all subsets of a size, or _HYPOTHESES random ones."""
    if comb(count, size) <= _HYPOTHESES:
        return np.array(list(combinations(range(count), size)))
    return generator.random((_HYPOTHESES, count)).argpartition(size, axis=1)[:, :size]


def _umeyama(
    source: Float64[np.ndarray, "B K 3"], target: Float64[np.ndarray, "B K 3"]
) -> tuple[Float64[np.ndarray, " B"], Float64[np.ndarray, "B 3 3"], Float64[np.ndarray, "B 3"]]:
    """Estimate batches of similarities by least squares in closed form."""
    middle, image = source.mean(1, keepdims=True), target.mean(1, keepdims=True)
    p, q = source - middle, target - image
    u, singular, vt = np.linalg.svd(q.transpose(0, 2, 1) @ p)
    sign = np.ones_like(singular)
    sign[:, 2] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * sign[:, None, :]) @ vt
    # Keeps the division finite for coincident points; their scale is 0.
    scale = (singular * sign).sum(1) / np.maximum((p**2).sum((1, 2)), 1e-300)
    return scale, rotation, image[:, 0] - scale[:, None] * (rotation @ middle.transpose(0, 2, 1))[:, :, 0]


def _levelled(
    source: Float64[np.ndarray, "B 2 3"], target: Float64[np.ndarray, "B 2 3"], down_source: Float64[np.ndarray, " 3"]
) -> tuple[Float64[np.ndarray, " B"], Float64[np.ndarray, "B 3 3"], Float64[np.ndarray, "B 3"]]:
    """Compute similarities that rotate `down_source` to -z and map one pair of points to the other in plan view."""
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
    """Build cross-product matrices: [v]x u = v x u."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
