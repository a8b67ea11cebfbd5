"""M3C2: distances between two clouds along the local normal (Lague et al. 2013, doi 10.1016/j.isprsjprs.2013.04.009).

Around each core point a normal is fitted to the earlier cloud. A cylinder along it collects the points of both clouds;
the distance is that between their mean positions along the normal. As CloudCompare has it, a cylinder reaches from -H
to H, its border included, deviations are of n, and the level of detection is

    LoD95 = 1.96 (sqrt(s1^2 / n1 + s2^2 / n2) + reg).

Where points have standard errors of their own (as the renderer gives them), a mean is not believed to be better than
these allow, after Winiwarter et al. 2021 (M3C2-EP, doi 10.1016/j.isprsjprs.2021.06.011): s^2 / n is replaced by the
mean of sigma^2 over n where that is larger.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from tidefield.change.surfaces import ChangeError

_AT_ONCE = 4_000_000
"""Pairs of core point and neighbour that are held at once."""
_MOST_CORES_AT_ONCE = 20_000
_LEAST_FOR_NORMAL = 3
CLOUD_COMPARE_Z95 = 1.96
Points = Float64[np.ndarray, "N 3"]


@dataclass(frozen=True)
class Distances:
    """Distances of the later cloud from the earlier one at N core points, along their normals.

    Attributes:
        distance_m: NaN where one of the cylinders has no point.
        detection_m: level of detection at 95%; NaN where one has fewer than two points.
        counts: points of each cloud in the cylinder.
        deviations_m: of these along the normal.
    """

    cores: Points
    normals: Points
    distance_m: Float64[np.ndarray, " N"]
    detection_m: Float64[np.ndarray, " N"]
    counts: Int64[np.ndarray, "N 2"]
    deviations_m: Float64[np.ndarray, "N 2"]

    @property
    def significant(self) -> Bool[np.ndarray, " N"]:
        return np.abs(self.distance_m) > self.detection_m


def m3c2(
    earlier: Float64[np.ndarray, "A 3"],
    later: Float64[np.ndarray, "B 3"],
    cores: Points,
    normals: Points,
    radius_m: float,
    half_length_m: float | Float64[np.ndarray, " N"],
    registration_m: float | Float64[np.ndarray, " N"] = 0.0,
    sigmas: tuple[Float64[np.ndarray, " A"] | None, Float64[np.ndarray, " B"] | None] = (None, None),
    tick: Callable[[int, int], Any] | None = None,
) -> Distances:
    """Measure M3C2 distances.

    Args:
        radius_m: of the cylinder (half of CloudCompare's projection diameter).
        half_length_m: H, how far the cylinders reach to either side, of all core points or of each.
        registration_m: error of the registration, 1 sigma, of all core points or of each.
        sigmas: standard errors of the points of either cloud, along any direction.
    """
    if not (radius_m > 0 and np.all(half_length_m > 0)):
        raise ChangeError(
            f"a cylinder of radius {radius_m} and half length {half_length_m} was asked for: expected positive lengths"
        )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    # Seen from above, a cylinder is no larger than this; clouds of surveys have few points above each other.
    reach = radius_m + half_length_m * np.hypot(normals[:, 0], normals[:, 1])
    half_length_m = np.broadcast_to(half_length_m, len(cores))
    counts = np.zeros((len(cores), 2), np.int64)
    means, variances = np.full((len(cores), 2), np.nan), np.full((len(cores), 2), np.nan)
    of_means = np.full((len(cores), 2), np.nan)
    for k, (cloud, sigma) in enumerate(zip((earlier, later), sigmas, strict=True)):
        for chunk, core, point in _neighbours(KDTree(cloud[:, :2]), cores[:, :2], reach):
            offset = cloud[point] - cores[core]
            along = np.einsum("ij,ij->i", offset, normals[core])
            across = np.einsum("ij,ij->i", offset, offset) - along**2
            inside = (np.abs(along) <= half_length_m[core]) & (across <= radius_m**2)
            core, along, point = core[inside] - chunk.start, along[inside], point[inside]
            size = chunk.stop - chunk.start
            n = np.bincount(core, minlength=size)
            total = np.maximum(n, 1)
            mean = np.bincount(core, along, size) / total
            variance = np.bincount(core, (along - mean[core]) ** 2, size) / total
            known = n > 0
            counts[chunk, k] = n
            means[chunk, k] = np.where(known, mean, np.nan)
            variances[chunk, k] = np.where(known, variance, np.nan)
            own = variance / total
            if sigma is not None:
                own = np.maximum(own, np.bincount(core, sigma[point] ** 2, size) / total**2)
            of_means[chunk, k] = np.where(n > 1, own, np.nan)
            if tick is not None:
                tick(k * len(cores) + chunk.stop, 2 * len(cores))
    detection = CLOUD_COMPARE_Z95 * (np.sqrt(of_means.sum(axis=1)) + registration_m)
    return Distances(cores, normals, means[:, 1] - means[:, 0], detection, counts, np.sqrt(variances))


def fit_normals(cloud: Float64[np.ndarray, "A 3"], cores: Points, radius_m: float) -> Points:
    """Normals of the planes through the points of a cloud within a radius, upward; vertical where there are too few."""
    tree = KDTree(cloud)
    normals = np.zeros_like(cores)
    normals[:, 2] = 1
    for chunk, core, point in _neighbours(tree, cores, np.full(len(cores), radius_m)):
        size = chunk.stop - chunk.start
        core = core - chunk.start
        n = np.bincount(core, minlength=size)
        offset = cloud[point] - cores[chunk][core]
        mean = np.stack([np.bincount(core, offset[:, i], size) for i in range(3)], axis=1) / np.maximum(n, 1)[:, None]
        centred = offset - mean[core]
        matrix = np.empty((size, 3, 3))
        for i in range(3):
            for j in range(3):
                matrix[:, i, j] = np.bincount(core, centred[:, i] * centred[:, j], size)
        known = n >= _LEAST_FOR_NORMAL
        smallest = np.linalg.eigh(matrix[known])[1][:, :, 0]
        normals[chunk][known] = smallest * np.where(smallest[:, 2:] < 0, -1, 1)
    return normals


def _neighbours(tree: KDTree, cores: np.ndarray, radii_m: np.ndarray) -> Any:
    """Yield slices of the core points, and the pairs of core point and neighbour of each."""
    first, size = 0, min(_MOST_CORES_AT_ONCE, max(1, len(cores)))
    while first < len(cores):
        chunk = slice(first, min(first + size, len(cores)))
        counts = tree.query_ball_point(cores[chunk], radii_m[chunk], return_length=True)
        # As many core points as have few enough pairs together, but one at least.
        fitting = max(1, int(np.searchsorted(np.cumsum(counts), _AT_ONCE, side="right")))
        chunk = slice(first, min(first + fitting, chunk.stop))
        found = tree.query_ball_point(cores[chunk], radii_m[chunk])
        lengths = [len(one) for one in found]
        core = np.repeat(np.arange(chunk.start, chunk.stop), lengths)
        point = np.concatenate([np.asarray(one, np.int64) for one in found]) if len(core) else np.zeros(0, np.int64)
        yield chunk, core, point
        first = chunk.stop
