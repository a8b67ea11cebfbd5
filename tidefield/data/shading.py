"""Shading: a smooth factor over each photograph's frame that relates it to the scene's common light.

docs/method.md, section 12. Photograph i shows sparse point p at x, in the plane z = 1, as

    log I_ip = g_i + q(d) + s_l(x) + t_i(x) + a_p:

the point's own colour a_p, the photograph's gain g_i (`exposure`), a quadratic form q of the direction of view d that
all photographs share (grass is brightest where its blades hide their shadows), a polynomial s of degree 4 that all
photographs of one lens share (vignetting, and light that comes from one side all through the flight), and a polynomial
t of degree 3 of the photograph's own (clouds, the sun and what mirrors it). Consecutive photographs with one heading
have similar t_i, and so a held-out photograph's comes from its neighbours, never from its pixels.

How much photographs differ is chosen by what it explains in photographs that are left out, and nothing is changed
unless it explains some of each.

Alphabet: V photographs, O observations of sparse points, K coefficients of a polynomial, D of the
direction, T unknowns that one observation depends on, of N unknowns, F folds.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from scipy import linalg, sparse
from scipy.sparse.linalg import LinearOperator, cg
from torch import Tensor

from tidefield.data.exif import Exposures
from tidefield.data.exposure import HUBER, Pairs, Seen, across_views, exposure_and_clock, huber_weights, in_sequence
from tidefield.data.scene import SparsePoints
from tidefield.geometry.cameras import SHADING_DEGREE, Cameras, monomials

OWN_DEGREE = 3
"""Degree of a photograph's own polynomial."""
OWN_TERMS, SQUARES = (OWN_DEGREE + 1) * (OWN_DEGREE + 2) // 2, 3
"""Numbers of a photograph's own terms, and of products of two components of the direction of view."""
SPREADS = (0.003, 0.01, 0.03)
"""Standard deviations of a linear term among photographs to choose from, natural logarithms. Terms of degree d have
this over d."""
CORRELATION = 0.5
"""Of the terms of consecutive photographs with one heading."""
SAME_HEADING, LONGEST_GAP = 0.8, 5.0
"""Cosine of the angle between the vertical axes of two photographs from which they have one heading, and the time
between consecutive ones, relative to the median, from which they are not related."""
SHARED_RIDGE = 0.003
"""Cost of the shared polynomials, relative to that of the errors."""
FEWEST_PHOTOGRAPHS = 12
"""Training photographs with observations for shading to be estimated."""
FEWEST_OF_A_LENS = 8
"""Of them, for a lens to have a polynomial of its own."""
FOLDS = 4
LEAST_GAIN = 0.01
"""By which the cost of left-out photographs has to fall in every fold."""
MOST_OBSERVATIONS = 40_000
FRAME_SIDE = 15
"""Places along each side of a frame to which the polynomial of what the direction brings is fitted."""
ROUNDS = 3
"""Of robust weights."""
MOST_DENSE = 500
"""Unknowns up to which their normal matrix is formed: there this takes less time than iterating without."""
TOLERANCE = 1e-3
"""Of iterative solutions, relative to the right side: left-out photographs' differences are the same as with 1e-7 to
3%."""

_log = logging.getLogger(__name__)


def estimate_shading(
    seen: Seen,
    cameras: Cameras,
    points: SparsePoints,
    lenses: Sequence[Hashable],
    train: Sequence[int],
    metadata: Exposures | None = None,
) -> Float[Tensor, "V K 3"] | None:
    """Estimate the shading of every photograph (`Cameras.shading`); None where it explains nothing.

    Args:
        seen: observations of the points in the training photographs (`exposure.observe`).
        cameras: with the photographs' gains, and the shading that is known already, to which this comes.
        points: that are observed.
        lenses: of each photograph; equal ones are one physical camera. Those of few photographs are taken for one
            that was calibrated for each photograph.
        train: the training photographs.
        metadata: for the order in which the photographs were taken.
    """
    train_index = np.asarray(train, dtype=np.int64)
    supported = np.unique(seen.photograph)
    if len(supported) < FEWEST_PHOTOGRAPHS:
        return None
    step = -(-len(seen.value) // MOST_OBSERVATIONS)
    seen = seen.part(seen.point % step == 0)
    model = _Model.of(seen, cameras, points, lenses, metadata)
    fold = np.full(len(cameras), -1)
    fold[train_index] = np.arange(len(train_index)) % FOLDS
    weight, noise = huber_weights(seen.centred(model.value))
    none = np.array([model.cost(None, fold == k, noise) for k in range(FOLDS)])
    costs, whole = np.zeros((len(SPREADS), FOLDS)), None
    everything = model.equations(weight)
    without = [model.equations(weight * (fold[seen.photograph] != k)) for k in range(FOLDS)]
    for row, spread in zip(costs, SPREADS, strict=True):
        whole = model.solve(spread, noise, everything, whole)
        row[:] = [model.cost(model.solve(spread, noise, without[k], whole), fold == k, noise) for k in range(FOLDS)]
    best = int(costs.sum(1).argmin())
    spread, cost = SPREADS[best], costs[best]
    plain = [model.solve(spread, noise, without[k], whole, squares=False) for k in range(FOLDS)]
    less = np.array([model.cost(plain[k], fold == k, noise) for k in range(FOLDS)])
    squares = _helps(cost, less)
    cost = cost if squares else less
    helps = _helps(cost, none)
    _log.debug(
        "shading with a spread of %.1f%%, %s the direction's squares: left-out photographs' differences cost %.1f%% "
        "less: %s",
        100 * spread,
        "with" if squares else "without",
        100 * (1 - cost.sum() / none.sum()),
        "applied" if helps else "not applied",
    )
    if not helps:
        return None
    found = model.solve(spread, noise, everything, whole, squares)
    for _ in range(ROUNDS - 1):
        weight, noise = huber_weights(seen.centred(model.value - model.design @ found, weight))
        found = model.solve(spread, noise, model.equations(weight), found, squares)
    of_direction = np.concatenate([np.zeros((2, 3)), found[-SQUARES:] / model.deviation[:, None]])
    return model.polynomials(found) + directional_shading(cameras, train, of_direction)


def _helps(cost: Float64[np.ndarray, " F"], without: Float64[np.ndarray, " F"]) -> bool:
    """Whether what left-out photographs cost is less in every fold."""
    return bool((cost < (1 - LEAST_GAIN) * without).all())


def directional_shading(
    cameras: Cameras, train: Sequence[int], by_direction: Float64[np.ndarray, "D 3"]
) -> Float[Tensor, "V K 3"]:
    """The shading (`Cameras.shading`) of what depends on the direction of view alone: a polynomial over each frame.

    Args:
        cameras: of the photographs.
        train: the training photographs.
        by_direction: factors of the two components of the direction (`exposure.estimate_gains`), and, if there are
            five, of their products (`_squares`).
    """
    to_world = cameras.T_world_camera[:, :, :3].double().numpy()
    across = to_world.transpose(0, 2, 1) @ across_views(cameras, train)  # in the cameras' axes
    side = torch.linspace(0, 1, FRAME_SIDE, dtype=torch.float64)
    share = torch.cartesian_prod(side, side)
    found = np.zeros((len(cameras), len(monomials(share[:1], SHADING_DEGREE)[0]), 3))
    frames = torch.cat([cameras.size_px, cameras.focal_px, cameras.principal_px], 1).double()
    for frame in frames.unique(dim=0):
        size, focal, principal = frame.split(2)
        xy = (share * size - principal) / focal
        ray = torch.nn.functional.normalize(torch.cat([xy, torch.ones_like(xy[:, :1])], 1), dim=1).numpy()
        to_polynomial = np.linalg.pinv(monomials(xy, SHADING_DEGREE).numpy())
        same = (frames == frame).all(1).numpy()
        direction = ray @ across[same]
        terms = np.concatenate([direction, _squares(direction)], axis=-1)[..., : len(by_direction)]
        found[same] = to_polynomial @ (terms @ by_direction)
    return torch.from_numpy(found).float()


def _squares(direction: Float64[np.ndarray, "*N 2"]) -> Float64[np.ndarray, "*N 3"]:
    x, y = direction[..., 0], direction[..., 1]
    return np.stack([x * x, x * y, y * y], axis=-1)


@dataclass(frozen=True)
class _Model:
    """Log colours as linear functions of unknowns: terms of the photographs and lenses, which are orthonormal on the
    observations, and of the direction.

    Attributes:
        seen: the observations.
        value: their log colours at the common exposure.
        terms: derivatives of the values with respect to the unknowns that they depend on, T for each.
        columns: these unknowns for each photograph; of all, OWN_TERMS of each photograph come first, then those of the
            lenses, then SQUARES of the direction.
        design: the derivatives with respect to all unknowns.
        prior: inverse covariance of the unknowns of the photographs, at a spread of 1.
        to_monomials: from coefficients of the orthonormal terms to those of monomials.
        lens: of each photograph.
        deviation: standard deviation of the direction's products, which are divided by it.
    """

    seen: Seen
    value: Float64[np.ndarray, "O 3"]
    terms: Float64[np.ndarray, "O T"]
    columns: Int64[np.ndarray, "V T"]
    design: sparse.csr_array
    prior: sparse.csr_array
    to_monomials: Float64[np.ndarray, "K K"]
    lens: Int64[np.ndarray, " V"]
    deviation: Float64[np.ndarray, "3"]

    @staticmethod
    def of(
        seen: Seen, cameras: Cameras, points: SparsePoints, lenses: Sequence[Hashable], metadata: Exposures | None
    ) -> _Model:
        count, photograph = len(cameras), seen.photograph
        which = torch.from_numpy(photograph)
        xy = (points.uv_px[torch.from_numpy(seen.row)] - cameras.principal_px[which]) / cameras.focal_px[which]
        frame = monomials(xy.double(), SHADING_DEGREE).numpy()
        to_monomials = np.linalg.inv(np.linalg.qr(frame, mode="r")) * np.sqrt(len(frame))
        frame = frame @ to_monomials
        lens = _numbers(lenses, cameras, np.unique(photograph))
        squares = _squares(seen.direction)
        deviation = np.maximum(squares.std(0), 1e-9)
        own, shared, of_direction = frame[:, :OWN_TERMS], frame[:, 1:], (squares - squares.mean(0)) / deviation
        terms, columns, first = np.concatenate([own, shared, of_direction], axis=1), [], 0
        for part, group in ((own, np.arange(count)), (shared, lens), (of_direction, np.zeros(count, dtype=np.int64))):
            each = part.shape[1]
            columns.append(first + group[:, None] * each + np.arange(each))
            first += each * (int(group.max()) + 1)
        each_column = np.concatenate(columns, axis=1)
        rows = np.arange(len(terms) + 1) * terms.shape[1]
        design = sparse.csr_array((terms.ravel(), each_column[photograph].ravel(), rows), shape=(len(terms), first))
        chain = _chain(cameras, in_sequence(exposure_and_clock(metadata, count)[1], np.arange(count)))
        degree = np.repeat(np.arange(OWN_DEGREE + 1), np.arange(OWN_DEGREE + 1) + 1)
        precision = np.maximum(degree, 1.0) ** 2
        known = cameras.gain.double().log()[which]
        if cameras.shading is not None:
            known += (monomials(xy, SHADING_DEGREE)[:, None] @ cameras.shading[which])[:, 0]
        return _Model(
            seen=seen,
            value=seen.value - known.numpy(),
            terms=terms,
            columns=each_column,
            design=design,
            prior=sparse.csr_array(sparse.kron(chain, sparse.diags_array(precision))),
            to_monomials=to_monomials,
            lens=lens,
            deviation=deviation,
        )

    def equations(self, weight: Float64[np.ndarray, " O"]) -> _Equations:
        """The normal equations of weighted observations; the points' colours are eliminated."""
        of_point = np.bincount(self.seen.point, weight)
        to_points = sparse.csr_array((weight, (self.seen.point, np.arange(len(weight)))))
        sums, to_mean = sparse.csr_array(to_points @ self.design), 1 / np.maximum(of_point, 1e-12)
        back = sparse.csr_array((sparse.diags_array(to_mean) @ sums).T)
        right = self.design.T @ (weight[:, None] * self.value) - back @ (to_points @ self.value)
        eliminated = None
        if len(right) <= MOST_DENSE:
            # A matrix times its own transpose takes half the time of two matrices' product.
            root = np.sqrt(to_mean)[:, None] * sums.toarray()
            eliminated = root.T @ root
        return _Equations(self._products(weight), sums, back, right, eliminated)

    @cached_property
    def _of_each(self) -> list[Int64[np.ndarray, " _"]]:
        """The observations of each photograph."""
        ends = np.cumsum(np.bincount(self.seen.photograph, minlength=len(self.columns)))
        return np.split(np.argsort(self.seen.photograph, kind="stable"), ends[:-1])

    def _products(self, weight: Float64[np.ndarray, " O"]) -> sparse.csr_array:
        """Weighted sums of the products of two terms, from dense products of each photograph's: a tenth of the time of
        sparse ones."""
        count, each = self.columns.shape
        sums = np.empty((count, each, each))
        for product, own in zip(sums, self._of_each, strict=True):
            product[:] = self.terms[own].T @ (weight[own][:, None] * self.terms[own])
        where = np.repeat(self.columns, each, axis=1).ravel(), np.tile(self.columns, each).ravel()
        unknowns = int(self.columns.max()) + 1
        return sparse.csr_array((sums.ravel(), where), shape=(unknowns, unknowns))

    def solve(
        self,
        spread: float,
        noise: float,
        equations: _Equations,
        start: Float64[np.ndarray, "N 3"] | None = None,
        squares: bool = True,
    ) -> Float64[np.ndarray, "N 3"]:
        """Find the most probable unknowns.

        Args:
            start: unknowns near the solution, from which an iterative solution starts.
            squares: whether there is something quadratic in the direction; 0 without.
        """
        if not squares:
            first = None if start is None else start[:-SQUARES]
            return np.pad(self.solve(spread, noise, equations.without_last(SQUARES), first), ((0, SQUARES), (0, 0)))
        own, right = OWN_TERMS * len(self.lens), equations.right
        ridge = sparse.diags_array(SHARED_RIDGE * equations.products.diagonal()[own:] + 1e-9)
        prior = sparse.block_diag([self.prior * (noise / spread) ** 2, ridge])
        quadratic = sparse.csr_array(equations.products + prior)
        if equations.eliminated is not None:
            return linalg.solve(quadratic.toarray() - equations.eliminated, right, assume_a="pos")

        def normal(x: np.ndarray) -> np.ndarray:
            x = x.reshape(-1, 3)
            return (quadratic @ x - equations.back @ (equations.sums @ x)).ravel()

        system = LinearOperator(shape=(right.size, right.size), matvec=normal, dtype=np.float64)  # type: ignore[call-arg]
        inverse = sparse.diags_array(np.repeat(1 / quadratic.diagonal(), 3))
        first = None if start is None else start.ravel()
        return cg(system, right.ravel(), first, rtol=TOLERANCE, M=inverse)[0].reshape(-1, 3)

    def cost(self, unknowns: Float64[np.ndarray, "N 3"] | None, left: Bool[np.ndarray, " V"], noise: float) -> float:
        """Huber's cost of how the left-out photographs' values differ from the points' colours in the others."""
        value = self.value if unknowns is None else self.value - self.design @ unknowns
        out, count = left[self.seen.photograph], int(self.seen.point.max()) + 1
        mean = np.stack([np.bincount(self.seen.point[~out], c[~out], count) for c in value.T], 1)
        views = np.bincount(self.seen.point[~out], minlength=count)
        usable = out & (views[self.seen.point] > 0)
        point, photograph = self.seen.point[usable], self.seen.photograph[usable]
        rest = value[usable] - mean[point] / views[point, None]
        # A photograph's mean is its gain's, which other evidence determines.
        for index in np.unique(photograph):
            rest[photograph == index] -= np.median(rest[photograph == index], axis=0)
        size = np.sqrt((rest**2).mean(1)) / noise
        return float(np.where(size < HUBER, size**2 / 2, HUBER * (size - HUBER / 2)).sum())

    def polynomials(self, unknowns: Float64[np.ndarray, "N 3"]) -> Float[Tensor, "V K 3"]:
        """Shading of the photographs' and lenses' terms."""
        count, own = len(self.lens), OWN_TERMS * len(self.lens)
        coefficients = np.zeros((count, len(self.to_monomials), 3))
        coefficients[:, :OWN_TERMS] = unknowns[:own].reshape(count, -1, 3)
        coefficients[:, 1:] += unknowns[own:-SQUARES].reshape(-1, len(self.to_monomials) - 1, 3)[self.lens]
        return torch.from_numpy(self.to_monomials @ coefficients).float()


@dataclass(frozen=True)
class _Equations:
    """Normal equations of the terms, without the prior.

    Attributes:
        products: weighted sums of the products of two terms' derivatives over all observations.
        sums: those of the derivatives over the observations of each point.
        back: their transpose, each point's divided by its weight: `products - back @ sums` are the normal equations.
        right: their right side, for each channel.
        eliminated: `back @ sums` of at most MOST_DENSE unknowns.
    """

    products: sparse.csr_array
    sums: sparse.csr_array
    back: sparse.csr_array
    right: Float64[np.ndarray, "N 3"]
    eliminated: Float64[np.ndarray, "N N"] | None

    def without_last(self, count: int) -> _Equations:
        """Those of all but the last unknowns, which are 0."""
        rest = slice(-count)
        products, sums, back = self.products[rest, rest], self.sums[:, rest], self.back[rest]
        return _Equations(
            *(sparse.csr_array(matrix) for matrix in (products, sums, back)),
            right=self.right[rest],
            eliminated=None if self.eliminated is None else self.eliminated[rest, rest],
        )


def _numbers(
    lenses: Sequence[Hashable], cameras: Cameras, supported: Int64[np.ndarray, " S"]
) -> Int64[np.ndarray, " V"]:
    """Number the lenses of all photographs; those of few photographs with observations are one for each frame size.

    COLMAP gives each photograph a lens of its own unless it is asked for one; a held-out photograph's would stay
    undetermined.
    """
    shared, sizes = Counter(lenses[i] for i in supported), cameras.size_px.tolist()
    names = [
        lens if shared[lens] >= FEWEST_OF_A_LENS else tuple(size) for lens, size in zip(lenses, sizes, strict=True)
    ]
    numbers = {name: k for k, name in enumerate(dict.fromkeys(names))}
    return np.array([numbers[name] for name in names])


def _chain(cameras: Cameras, sequence: Pairs) -> sparse.sparray:
    """Inverse covariance of unit variances that are correlated along the sequence (an autoregression of order 1)."""
    down = cameras.T_world_camera[:, :, 1].double().numpy()
    related = ((down[sequence.a] * down[sequence.b]).sum(1) > SAME_HEADING) & (sequence.distance < LONGEST_GAP)
    a, b = sequence.a[related], sequence.b[related]
    rows = np.tile(np.arange(len(a)), 2)
    ones = np.ones(len(a))
    difference = sparse.csr_array((np.r_[-ones, ones], (rows, np.r_[a, b])), shape=(len(a), len(cameras)))
    left_over = 1 - CORRELATION**2
    # Of one with k others beside it in the sequence: 1 / left_over at its ends, 1 for one that is alone.
    links = np.bincount(np.r_[a, b], minlength=len(cameras))
    own = np.where(links > 0, (1 + (links - 1) * CORRELATION**2) / left_over, 1.0) - links * CORRELATION / left_over
    return sparse.diags_array(own) + CORRELATION / left_over * (difference.T @ difference)
