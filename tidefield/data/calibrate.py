"""Calibrate a scene by its training photographs: what the poses' program left over of their lenses' distortion.

docs/method.md, section 14. A point X that a pinhole shows at x = pi(X), in the plane z = 1, is shown at x + r(x) by the
lens, where r is a quadratic polynomial with values in the plane. It is fitted to the observations of sparse points,
whose positions are as unknown as r, so both are estimated together: in every step the points are eliminated from the
linearised problem.

Nothing is changed unless photographs and points that took no part in the fit agree better with it, and held-out
photographs have no part at all.

Alphabet: O observations, P points, K coefficients.
"""

from __future__ import annotations

import logging
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from scipy import sparse

from tidefield.data.scene import SparsePoints
from tidefield.geometry.cameras import Cameras, project_with_slopes

FEWEST_PHOTOGRAPHS, FEWEST_OBSERVATIONS = 8, 400
"""Training photographs by one lens, and their observations, for it to be calibrated."""
MOST_OBSERVATIONS = 60_000
"""Used of one lens, those of some points only: more take time and determine twelve numbers no better."""
FOLDS = 4
"""Parts of the photographs, and of the points, each left out of the fit once."""
LEAST_GAIN = 0.01
"""By which the cost of what is left out has to fall in every fold: noise does that in none of them."""
LEAST_RESIDUAL = 5e-5
"""Root-mean-square of r below which it is left out: 0.02 px of a photograph of 400 px, which no picture shows."""
SHRINK = 0.03
"""Cost of r itself, relative to that of the errors. What is best explained by other points, such as another scale, is
not determined by the errors, and so stays 0."""
ROUNDS = 4
CAUCHY = 2.385
"""Cauchy's constant in standard deviations: 95% as efficient as least squares on clean Gaussian errors."""

_log = logging.getLogger(__name__)


def calibrate_lenses(
    cameras: Cameras, points: SparsePoints, lenses: Sequence[Hashable], train: Sequence[int]
) -> tuple[Cameras, SparsePoints]:
    """Give the cameras of each lens its residual, and move the points to where they then belong.

    Args:
        cameras: one per photograph.
        points: with the observations that are used; those of held-out photographs are not.
        lenses: of each photograph; equal ones are one physical camera.
        train: the training photographs.
    """
    train_index = torch.tensor(train)
    by_lens: dict[Hashable, list[int]] = {}
    for index, lens in enumerate(lenses):
        by_lens.setdefault(lens, []).append(index)
    for photographs in by_lens.values():
        if len(photographs) < FEWEST_PHOTOGRAPHS:
            continue
        mine = torch.zeros(len(cameras), dtype=torch.bool)
        mine[photographs] = True
        if mine[train_index].sum() < FEWEST_PHOTOGRAPHS:
            continue
        residual = _fit(cameras, points, mine, train_index)
        if residual is not None:
            whole = torch.zeros(len(cameras), 6, 2) if cameras.residual is None else cameras.residual.clone()
            whole[mine] = residual
            cameras = replace(cameras, residual=whole)
            points = _placed_again(cameras, points, train_index)
    return cameras, points


@dataclass(frozen=True)
class _Errors:
    """Reprojection errors in the plane z = 1, linear in the points' positions.

    Attributes:
        photograph, point: of each observation.
        xy: where the pinhole shows the point.
        error: how far the observation is from there, or from where the residual so far shows it.
        slope: derivative of xy with respect to the point.
    """

    photograph: Int64[np.ndarray, " O"]
    point: Int64[np.ndarray, " O"]
    xy: Float64[np.ndarray, "O 2"]
    error: Float64[np.ndarray, "O 2"]
    slope: Float64[np.ndarray, "O 2 3"]

    def moves(
        self, values: Float64[np.ndarray, "O 2 K"], weight: Float64[np.ndarray, " O"]
    ) -> Float64[np.ndarray, "P 3 K"]:
        """Find the moves of the points that explain most of the values."""
        count, slope = len(self.point), self.slope
        at = sparse.csr_array((weight, (self.point, np.arange(count))))
        across = slope.transpose(0, 2, 1)
        normal = (at @ (across @ slope).reshape(count, 9)).reshape(-1, 3, 3)
        right = (at @ (across @ values).reshape(count, -1)).reshape(len(normal), 3, -1)
        # Rays of a point's two observations may be nearly parallel: then it does not move along them.
        return np.linalg.solve(normal + (1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)), right)

    def remaining(
        self, values: Float64[np.ndarray, "O 2 K"], weight: Float64[np.ndarray, " O"]
    ) -> Float64[np.ndarray, "O 2 K"]:
        """Return what moving the points cannot explain of the values."""
        return values - self.slope @ self.moves(values, weight)[self.point]


def _errors(cameras: Cameras, points: SparsePoints, chosen: Bool[torch.Tensor, " O"]) -> _Errors:
    """Measure the errors of some observations; points are numbered among those that these show."""
    photograph = points.camera_index[chosen].long()
    own, point = points.point_index[chosen].unique(return_inverse=True)
    views = cameras[photograph]
    xyz = points.xyz_world[own].double().numpy()[point.numpy()]
    xy, slope = project_with_slopes(views.T_world_camera.double().numpy(), xyz)
    focal, principal = views.focal_px.double(), views.principal_px.double()
    pinhole_px = torch.from_numpy(xy) * focal + principal
    in_double = replace(views, focal_px=focal, principal_px=principal)
    shown_px = in_double.displaced(pinhole_px[:, None])[:, 0]
    error = ((points.uv_px[chosen].double() - shown_px) / focal).numpy()
    return _Errors(photograph.numpy(), point.numpy(), xy, error, slope.transpose(0, 2, 1))


def _fit(
    cameras: Cameras,
    points: SparsePoints,
    mine: Bool[torch.Tensor, " V"],
    train: Int64[torch.Tensor, " T"],
) -> Float[torch.Tensor, "6 2"] | None:
    """Fit the residual of the photographs `mine`; None if it does not help."""
    by_lens = mine[points.camera_index.long()] & torch.isin(points.camera_index.long(), train)
    if by_lens.sum() < FEWEST_OBSERVATIONS:
        return None
    step = -(-int(by_lens.sum()) // MOST_OBSERVATIONS)
    errors = _errors(cameras, points, by_lens & (points.point_index % step == 0))
    terms = quadratic_terms(errors.xy)
    design = np.einsum("ok,ij->oikj", terms, np.eye(2)).reshape(-1, 2, 12)
    weight, scale, coefficients = np.ones(len(terms)), np.inf, np.zeros(12)
    slopes, values = design, errors.error
    for _ in range(ROUNDS):
        slopes, values = errors.remaining(design, weight), errors.remaining(errors.error[..., None], weight)[..., 0]
        coefficients = _solve(slopes, design, values, weight)
        size = np.linalg.norm(values - slopes @ coefficients, axis=1)
        # The median length of a Gaussian error is 1.18 standard deviations; the floor keeps exact fits finite.
        scale = CAUCHY * float(np.median(size)) / 1.1774 + 1e-9
        weight = 1 / (1 + (size / scale) ** 2)
    costs = []
    # Left-out photographs, whose poses have errors; and left-out points: what a point's two observations are off from
    # each other is the same in both, so that a photograph that is left out knows the noise of those that are not.
    for whole in (errors.photograph, errors.point):
        part = np.unique(whole, return_inverse=True)[1] % FOLDS
        for fold in range(FOLDS):
            kept, left = part != fold, part == fold
            found = _solve(slopes[kept], design[kept], values[kept], weight[kept])
            costs.append([_cost(values[left] - slopes[left] @ x, scale) for x in (0 * found, found)])
    before, after = np.array(costs).T
    size = float(np.sqrt(((design @ coefficients) ** 2).sum(1).mean()))
    helps = bool((after < (1 - LEAST_GAIN) * before).all()) and size > LEAST_RESIDUAL
    focal = float(cameras.focal_px[mine].mean())
    _log.debug(
        "the lens of %d photographs has a residual of %.3f px, with which left-out errors cost %.1f%% less: %s",
        int(mine.sum()),
        focal * size,
        100 * (1 - after.sum() / before.sum()),
        "applied" if helps else "not applied",
    )
    return torch.from_numpy(coefficients.reshape(6, 2)).float() if helps else None


def quadratic_terms(xy: Float64[np.ndarray, "O 2"]) -> Float64[np.ndarray, "O 6"]:
    """Return 1, x, y, x^2, x y, y^2."""
    x, y = xy.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def _solve(
    slopes: Float64[np.ndarray, "O 2 K"],
    design: Float64[np.ndarray, "O 2 K"],
    values: Float64[np.ndarray, "O 2"],
    weight: Float64[np.ndarray, " O"],
) -> Float64[np.ndarray, " K"]:
    """Minimise sum_o w_o (|values - slopes x|^2 + SHRINK |design x|^2)."""

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a * weight[:, None, None]).reshape(-1, a.shape[2]).T @ b.reshape(-1, b.shape[2])

    normal = product(slopes, slopes) + SHRINK * product(design, design)
    return np.linalg.solve(normal, product(slopes, values[..., None]))[:, 0]


def _cost(errors: Float64[np.ndarray, "O 2"], scale: float) -> float:
    """Cauchy's cost of errors."""
    return float(np.log1p((errors**2).sum(1) / scale**2).sum())


def _placed_again(cameras: Cameras, points: SparsePoints, train: Int64[torch.Tensor, " T"]) -> SparsePoints:
    """Move the points by one Gauss-Newton step to the least squares of their reprojection errors."""
    used = torch.isin(points.camera_index.long(), train)
    errors = _errors(cameras, points, used)
    focal = cameras.focal_px.double().numpy()[errors.photograph].mean(1)
    moves = errors.moves(errors.error[..., None], focal**2)[..., 0]
    own = points.point_index[used].unique()
    xyz = points.xyz_world.clone()
    xyz[own] += torch.from_numpy(moves).to(xyz)
    moved = replace(points, xyz_world=xyz)
    error = torch.from_numpy(np.linalg.norm(_errors(cameras, moved, used).error, axis=1) * focal)
    index = points.point_index[used].long()
    total = torch.zeros(len(xyz), dtype=torch.float64).index_add(0, index, error)
    mean = total / torch.bincount(index, minlength=len(xyz)).clamp(min=1)
    error_px = points.error_px.clone()
    error_px[own] = mean[own].to(error_px)
    return replace(moved, error_px=error_px)
