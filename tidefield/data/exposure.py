"""Exposure gains: one factor per photograph and colour channel that relates it to the scene's common exposure.

docs/method.md, section 12. The model is multiplicative on display-referred values,

    log I_ip = g_i + a_p + b d_ip:

photograph i shows sparse point p in the point's own colour times the photograph's gain, and times a factor that depends
on the direction of view d_ip, for the ground is brighter towards the sun or away from it. Over flat ground all of
b d_ip is the same as gains and colours that change with the place, exponentially: what photographs share cannot tell
one from the other. Flights can: they go to and fro, and light changes seldom. Three sources enter one sparse
least-squares problem:

- training photographs that see the same points (robustly: water moves, and so do reflections);
- consecutive photographs, whose gains differ little beyond the difference of their EXIF exposures (robustly: of some,
  they differ much);
- photographs taken close to each other, likewise.

Held-out photographs enter through the last two only: their gains come from their metadata and their neighbours, never
from their pixels.

Alphabet: V photographs, O observations of sparse points, N pairs of photographs, C values per observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, Int64, UInt8
from scipy import sparse
from scipy.sparse.linalg import aslinearoperator, cg, spsolve
from scipy.spatial import KDTree
from torch import Tensor

from tidefield.data.exif import Exposures
from tidefield.data.images import Photographs
from tidefield.data.scene import Scene, SparsePoints
from tidefield.geometry.cameras import Cameras

DISPLAY_SLOPE = 0.45
"""Log display value per log exposure in the absence of evidence: sRGB's overall exponent of 1 / 2.2."""
SLOPE_WEIGHT = 0.01
"""Weight of `DISPLAY_SLOPE` against the measured slope: that of one pair whose log exposures differ by 0.1."""
DARK, BRIGHT, CLIPPED, CLIPPED_SHARE = 8.0, 247.0, 252, 0.1
"""Windows are used if their 8-bit mean lies in DARK..BRIGHT (not noise, black borders or clipping) and at most this
share of their pixels is clipped, that is CLIPPED or more in a channel."""
HUBER = 1.345
"""Huber's threshold in standard deviations: 95% as efficient as least squares on clean Gaussian residuals."""
ITERATIONS = 15
LEAST_NOISE = 0.01
"""Least standard deviation of a log window mean: rounding to 8 bits and resampling; weights need a positive scale."""
LOOSE = 1e-6
"""Weight of a photograph's prior gain. It determines the overall level, and photographs without any connection."""
INDEPENDENT = 50
"""Independent observations that those of a photograph count for where directions are estimated, however many they are:
surfaces and lenses have other errors, which neighbouring observations share."""
FIRST_STEP, LEAST_STEP = 0.05, 0.005
"""Standard deviation of most differences of consecutive photographs' log gains: at first, and at least."""
SUN = 0.1
"""Standard deviation, among surveys, of how log colours change with a component of the direction."""
ENOUGH, ENOUGH_OF_EACH = 40_000, 200
"""Observations from which directions are estimated, and for each photograph of large surveys: more change nothing."""
SETTLED = 1e-4
"""Change of all log gains, and of all coefficients, from which reweighting ends."""
RIDGE = 1e-6
"""On coefficients of further terms: what no observation tells apart stays at zero."""
MOST_SHARED = 64
"""Photographs per observed point, in the mean over observations, above which the normal matrix is not formed: it has
this many entries per observation. Here both ways take equally long, on a strip of 2,000 photographs."""
SUPPORT = 10
"""Fewest observations of a training photograph that takes part in the estimate of the pairs' weights."""


def estimate_gains(
    seen: Seen | None,
    cameras: Cameras,
    train: Sequence[int],
    metadata: Exposures | None = None,
    divided_by: Float64[np.ndarray, "V 3"] | None = None,
) -> tuple[Float[Tensor, "V 3"], Float64[np.ndarray, "2 3"]]:
    """Estimate the gain of every photograph and channel, with geometric mean 1 over the training photographs.

    Returns:
        The gains; and how log colours change with the two components of `Seen.direction`.

    Args:
        seen: what the training photographs show of the sparse points (`observe`); without, the gains follow from the
            EXIF exposures, and are 1 without these.
        cameras: one per photograph, for their positions; their own gains are ignored.
        train: indices of the training photographs; all others are held out.
        metadata: exposures and times (`exif.read_exposures`), if any.
        divided_by: gains that the photographs' files were divided by, ones if not given. EXIF is of photographs as
            taken, so the gains are estimated of these, and divided by the same at the end.
    """
    count, learned = len(cameras), np.asarray(train, dtype=np.int64)
    exposure, clock = exposure_and_clock(metadata, count)
    applied = np.zeros((count, 3)) if divided_by is None else np.log(divided_by)
    if seen is not None and len(seen.value):
        seen = replace(seen, value=seen.value + applied[seen.photograph])
        gains, by_direction = _solve(seen, exposure, clock, cameras.position_world.double().cpu().numpy(), learned)
    else:
        gains, by_direction = DISPLAY_SLOPE * exposure[:, None] * np.ones(3), np.zeros((2, 3))
    gains = gains - applied
    return torch.as_tensor(np.exp(gains - gains[learned].mean(0)), dtype=torch.float32), by_direction


@dataclass(frozen=True)
class Seen:
    """O usable observations of points that at least two photographs share.

    Attributes:
        value: log mean colour around the point.
        point: the point.
        photograph: the photograph.
        row: the index among the sparse points' observations.
        direction: of the view, the components along `across_views` of the unit vector from photograph to point.
    """

    value: Float64[np.ndarray, "O 3"]
    point: Int64[np.ndarray, " O"]
    photograph: Int64[np.ndarray, " O"]
    row: Int64[np.ndarray, " O"]
    direction: Float64[np.ndarray, "O 2"]

    def part(self, chosen: Bool[np.ndarray, " O"]) -> Seen:
        """Select observations; points are numbered anew."""
        point = np.unique(self.point[chosen], return_inverse=True)[1]
        return Seen(self.value[chosen], point, self.photograph[chosen], self.row[chosen], self.direction[chosen])

    def centred(
        self, value: Float64[np.ndarray, "O C"], weight: Float64[np.ndarray, " O"] | None = None
    ) -> Float64[np.ndarray, "O C"]:
        """Subtract the weighted mean of all values of the same point."""
        weight = np.ones(len(value)) if weight is None else weight
        total = np.bincount(self.point, weight)
        mean = np.stack([np.bincount(self.point, weight * c) for c in value.T], 1) / np.maximum(total, 1e-12)[:, None]
        return value - mean[self.point]


@dataclass(frozen=True)
class Pairs:
    """N pairs a, b of photographs with similar gains, and their distances in time or space, relative to the median."""

    a: Int64[np.ndarray, " N"]
    b: Int64[np.ndarray, " N"]
    distance: Float64[np.ndarray, " N"]

    def difference(self, value: Float64[np.ndarray, "V *C"]) -> Float64[np.ndarray, "N *C"]:
        return value[self.b] - value[self.a]


_NO_INDEX = np.zeros(0, dtype=np.int64)
_NO_PAIRS = Pairs(_NO_INDEX, _NO_INDEX, np.zeros(0))


def across_views(cameras: Cameras, which: Sequence[int]) -> Float64[np.ndarray, "3 2"]:
    """Two unit vectors across the mean optical axis of some cameras, in world coordinates."""
    mean = cameras.T_world_camera[list(which), :, 2].double().mean(0).cpu().numpy()
    return np.linalg.svd(mean[None])[2][1:].T


def observe(photographs: Photographs, cameras: Cameras, points: SparsePoints, which: Sequence[int]) -> Seen:
    """Measure the mean log colour of a small window around every observation in the given photographs.

    The memory of each photograph is given back once it was looked at.

    Args:
        photographs, cameras, points: of a scene.
        which: indices of the photographs.
    """
    camera, uv = points.camera_index.cpu().numpy(), points.uv_px.double().cpu().numpy()
    values, rows = [np.zeros((0, 3))], [_NO_INDEX]
    for i in which:
        row = np.flatnonzero(camera == i)
        if len(row):
            value, usable = _window_means(photographs[i].cpu().numpy(), uv[row])
            values.append(np.log(value[usable]))
            rows.append(row[usable])
            photographs.release()
    row = np.concatenate(rows)
    point = points.point_index.cpu().numpy()[row].astype(np.int64)
    shared = np.bincount(point, minlength=1)[point] > 1
    point, photograph, row = point[shared], camera[row][shared].astype(np.int64), row[shared]
    # Through the pixels: positions are relative to an origin that held-out photographs take part in.
    ray = cameras[torch.from_numpy(photograph)].directions_world(points.uv_px[torch.from_numpy(row), None])[:, 0]
    direction = torch.nn.functional.normalize(ray.double(), dim=1).cpu().numpy() @ across_views(cameras, which)
    return Seen(np.concatenate(values)[shared], point, photograph, row, direction)


def _window_means(
    pixels: UInt8[np.ndarray, "H W 3"], uv_px: Float64[np.ndarray, "P 2"]
) -> tuple[Float64[np.ndarray, "P 3"], Bool[np.ndarray, " P"]]:
    """Mean 8-bit colours around pixels, and which of them lie inside and are neither dark nor clipped."""
    height, width = pixels.shape[:2]
    side = max(3, 2 * round(width / 160) + 1)
    mean = cv2.boxFilter(pixels, cv2.CV_32F, (side, side))
    red, green, blue = cv2.split(pixels)
    brightest = np.asarray(cv2.max(cv2.max(red, green), blue))
    clipped = cv2.boxFilter((brightest >= CLIPPED).astype(np.uint8), cv2.CV_32F, (side, side))
    column, row = np.floor(uv_px).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = column.clip(0, width - 1), row.clip(0, height - 1)
    value = mean[row, column].astype(np.float64)
    return value, inside & ((value > DARK) & (value < BRIGHT)).all(1) & (clipped[row, column] <= CLIPPED_SHARE)


def _solve(
    seen: Seen,
    exposure: Float64[np.ndarray, " V"],
    clock: Float64[np.ndarray, " V"],
    position: Float64[np.ndarray, "V 3"],
    train: Int64[np.ndarray, " T"],
) -> tuple[Float64[np.ndarray, "V 3"], Float64[np.ndarray, "2 3"]]:
    """Log gains, and how log colours change with the direction."""
    count = len(exposure)
    supported = train[np.bincount(seen.photograph, minlength=count)[train] >= SUPPORT]
    sequence = in_sequence(clock, supported)
    change, nothing = sequence.difference(exposure), np.zeros(count)

    def slope(gains: Float64[np.ndarray, "V 3"]) -> float:
        """Log gain per log exposure, from consecutive photographs: over a longer time automatic exposure follows the
        daylight, and both cancel."""
        total = (change**2 / sequence.distance).sum() + SLOPE_WEIGHT
        follows = (sequence.difference(gains).mean(1) * change / sequence.distance).sum()
        return float(np.clip((follows + SLOPE_WEIGHT * DISPLAY_SLOPE) / total, 0.0, 1.0))

    even, by_direction = _without_directions(seen, nothing, sequence)
    if change.any():
        expected = slope(robust_gains(even, nothing)[0]) * exposure
        even, by_direction = _without_directions(seen, expected, sequence)
    first, noise = robust_gains(even, nothing)
    prior = slope(first) * exposure
    pairs, weights = [], []
    for supporting, everyone in (
        (sequence, in_sequence(clock, np.arange(count))),
        (_nearby(position, supported), _nearby(position, np.arange(count))),
    ):
        # A random walk: the variance of a difference grows with the distance.
        rest = supporting.difference(first - prior[:, None])
        variance = max(((rest**2).mean(1) / supporting.distance).mean(), 1e-6) if len(rest) else 1.0
        pairs.append(everyone)
        weights.append(noise**2 / (variance * everyone.distance))
    both = Pairs(*(np.concatenate([getattr(p, name) for p in pairs]) for name in ("a", "b", "distance")))
    return robust_gains(even, prior, both, np.concatenate(weights))[0], by_direction


def _without_directions(
    seen: Seen, prior: Float64[np.ndarray, " V"], sequence: Pairs
) -> tuple[Seen, Float64[np.ndarray, "2 3"]]:
    """What is seen, without what depends on the direction of view, and how it does."""
    by_direction, _ = directional_terms(seen, prior, sequence)
    return replace(seen, value=seen.value - seen.direction @ by_direction), by_direction


def directional_terms(
    seen: Seen,
    prior: Float64[np.ndarray, " V"],
    sequence: Pairs,
    terms: Float64[np.ndarray, "O K"] | None = None,
) -> tuple[Float64[np.ndarray, "2 3"], Float64[np.ndarray, " K"]]:
    """Estimate how log colours change with the direction of view, by iteratively reweighted least squares.

    Minimises sum_o w_o |y_o - g - a - b d_o - c t_o|^2 + sum_pairs w |(g_b - g_a) - (prior_b - prior_a)|^2, with
    Huber's weights over observations and pairs, and a normal distribution of b around 0 (`SUN`). The points' colours a
    and the gains g are eliminated first (Frisch and Waugh, 1933): residuals of the colours are regressed on those of
    directions and terms.

    Args:
        prior: log gains that are expected.
        sequence: consecutive photographs, most of whose gains change as is expected.
        terms: further ones, whose coefficients are the same in all channels.

    Returns:
        Changes of log colours with the two components of `Seen.direction`, and the coefficients of the terms.
    """
    count = len(prior)
    terms = np.zeros((len(seen.value), 0)) if terms is None else terms
    chosen = seen.point % -(-len(seen.value) // max(ENOUGH, ENOUGH_OF_EACH * count)) == 0
    seen, terms = seen.part(chosen), terms[chosen]
    values = np.concatenate([seen.value, seen.direction, terms], axis=1)
    steps, loose, root = _incidence(sequence, count), LOOSE * sparse.eye_array(count), np.sqrt(sequence.distance)
    least = min(1.0, INDEPENDENT * len(np.unique(seen.photograph)) / max(1, len(seen.value)))
    weight, noise, spread = np.full(len(seen.value), least), LEAST_NOISE, FIRST_STEP
    coefficients, fitted = np.zeros((values.shape[1] - 3, 3)), np.zeros((count, values.shape[1]))
    away = np.zeros((count, 3))
    for _ in range(ITERATIONS):
        step = np.sqrt(((steps @ away) ** 2).mean(1)) / root
        if step.any():
            spread = max(float(1.4826 * np.median(step)), LEAST_STEP)
        of_steps = (noise / (spread * root)) ** 2 * np.minimum(1.0, HUBER * spread / np.maximum(step, 1e-12))
        held = loose + steps.T @ sparse.diags_array(of_steps) @ steps
        pull = np.zeros_like(fitted)
        pull[:, :3] = (held @ prior)[:, None]
        fitted = weighted_gains(seen, values, weight, held, pull, fitted)
        rest = seen.centred(values - fitted[seen.photograph], weight)
        x, own = rest[:, 3:], fitted[:, 3:]
        normal = (weight[:, None] * x).T @ x + own.T @ (held @ own)
        normal += np.diag([*[(noise / SUN) ** 2] * 2, *[RIDGE] * terms.shape[1]])
        right = (weight[:, None] * x).T @ rest[:, :3] + own.T @ (held @ (fitted[:, :3] - prior[:, None]))
        before, coefficients = coefficients, np.linalg.solve(normal, right)
        # The same in all channels: the mean of the channels' own, around which the directions' are found again.
        coefficients[2:] = coefficients[2:].mean(1, keepdims=True)
        coefficients[:2] = np.linalg.solve(normal[:2, :2], right[:2] - normal[:2, 2:] @ coefficients[2:])
        away = fitted[:, :3] - own @ coefficients - prior[:, None]
        weight, noise = huber_weights(rest[:, :3] - x @ coefficients)
        weight *= least
        if np.abs(coefficients - before).max() < SETTLED:
            break
    return coefficients[:2], coefficients[2:, 0]


def _incidence(pairs: Pairs, count: int) -> sparse.csr_array:
    """The matrix that takes values of photographs to the pairs' differences."""
    rows = np.arange(len(pairs.a))
    minus_plus = np.concatenate([-np.ones(len(rows)), np.ones(len(rows))])
    where = (np.concatenate([rows, rows]), np.concatenate([pairs.a, pairs.b]))
    return sparse.csr_array((minus_plus, where), shape=(len(rows), count))


def robust_gains(
    seen: Seen,
    prior: Float64[np.ndarray, " V"],
    pairs: Pairs = _NO_PAIRS,
    pair_weight: Float64[np.ndarray, " N"] | None = None,
) -> tuple[Float64[np.ndarray, "V 3"], float]:
    """Estimate log gains by iteratively reweighted least squares, and the residuals' standard deviation.

    Minimises sum_o w_o |y_o - g - a|^2 + sum_pairs w |(g_b - g_a) - (prior_b - prior_a)|^2
    + sum_photographs LOOSE |g - prior|^2, with Huber's weights w_o over observations. The points' colours a are
    eliminated in closed form.

    Args:
        prior: log gains that are expected.
        pairs: of photographs with similar gains.
        pair_weight: of the pairs.
    """
    count, between = len(prior), _incidence(pairs, len(prior))
    fixed = between.T @ sparse.diags_array(np.zeros(0) if pair_weight is None else pair_weight) @ between
    fixed = fixed + LOOSE * sparse.eye_array(count)
    pull = np.repeat((fixed @ prior)[:, None], 3, 1)
    weight, gains, noise = np.ones(len(seen.value)), np.zeros((count, 3)), 0.0
    for _ in range(ITERATIONS):
        before, gains = gains, weighted_gains(seen, seen.value, weight, fixed, pull, gains)
        weight, noise = huber_weights(seen.centred(seen.value - gains[seen.photograph], weight))
        if np.abs(gains - before).max() < SETTLED:
            break
    return gains, noise


def weighted_gains(
    seen: Seen,
    value: Float64[np.ndarray, "O C"],
    weight: Float64[np.ndarray, " O"],
    fixed: sparse.sparray,
    pull: Float64[np.ndarray, "V C"],
    start: Float64[np.ndarray, "V C"] | None = None,
) -> Float64[np.ndarray, "V C"]:
    """Solve for the least-squares gains of values, with the quadratic form `fixed` and its right side `pull` added.

    Args:
        start: gains near the solution, from which an iterative solution starts.
    """
    count = len(pull)
    of_point, of_photograph = np.bincount(seen.point, weight), np.bincount(seen.photograph, weight, count)
    table = sparse.csr_array((weight, (seen.point, seen.photograph)), shape=(len(of_point), count))
    to_mean = sparse.diags_array(1 / np.maximum(of_point, 1e-12))
    right = weight[:, None] * seen.centred(value, weight)
    right = np.stack([np.bincount(seen.photograph, c, count) for c in right.T], 1)
    right += pull
    own = sparse.diags_array(of_photograph) + fixed
    if np.bincount(seen.point)[seen.point].sum() > MOST_SHARED * len(seen.point):
        # Conjugate gradients: the more photographs share points, the fewer steps they take.
        system = aslinearoperator(own) - aslinearoperator(table.T) @ aslinearoperator(to_mean) @ aslinearoperator(table)
        inverse = sparse.diags_array(1 / own.diagonal())
        start = np.zeros_like(right) if start is None else start
        solved = [cg(system, b, x0, rtol=1e-14, M=inverse) for b, x0 in zip(right.T, start.T, strict=True)]
        if not any(steps for _, steps in solved):  # else it ended before the solution, by rounding
            return np.stack([column for column, _ in solved], 1)
    system = sparse.csc_array(own - table.T @ to_mean @ table)
    return np.asarray(spsolve(system, right)).reshape(right.shape)


def huber_weights(residual: Float64[np.ndarray, "O 3"]) -> tuple[Float64[np.ndarray, " O"], float]:
    """Weight observations by their residuals; return the weights and the residuals' standard deviation."""
    # One weight for the three channels: motion and reflections affect all of them.
    size = np.sqrt((residual**2).mean(1))
    noise = max(float(1.4826 * np.median(size)), LEAST_NOISE)
    return np.minimum(1.0, HUBER * noise / np.maximum(size, 1e-12)), noise


def exposure_and_clock(
    metadata: Exposures | None, count: int
) -> tuple[Float64[np.ndarray, " V"], Float64[np.ndarray, " V"]]:
    """Centred log exposures (0 without any), and times in seconds, or the photographs' order without times.

    What some photographs lack is taken from those before and after them.
    """
    clock = order = np.arange(count, dtype=np.float64)
    if metadata is None:
        return np.zeros(count), clock
    time = metadata.time_s
    # EXIF has whole seconds: the order breaks ties. Mostly equal times carry no information.
    if np.unique(time[np.isfinite(time)]).size > count / 2:
        time = _filled(time, order)
        clock = time - time.min() + 1e-3 * order
    exposure = _filled(metadata.log_exposure, clock)
    return exposure - exposure.mean(), clock


def _filled(values: Float64[np.ndarray, " V"], clock: Float64[np.ndarray, " V"]) -> Float64[np.ndarray, " V"]:
    """Values, of which those that are missing are interpolated over the clock; 0 without any."""
    there = np.argsort(clock)
    there = there[np.isfinite(values[there])]
    if not len(there):
        return np.zeros(len(values))
    return np.where(np.isfinite(values), values, np.interp(clock, clock[there], values[there]))


def in_sequence(clock: Float64[np.ndarray, " V"], which: Int64[np.ndarray, " S"]) -> Pairs:
    """Pair each of the given photographs with the next one."""
    order = which[np.argsort(clock[which], kind="stable")]
    median = np.median(np.diff(np.sort(clock))) if len(clock) > 1 else 1.0
    distance = np.maximum(np.diff(clock[order]) / max(median, 1e-9), 0.1)
    return Pairs(order[:-1], order[1:], distance)


def _nearby(position: Float64[np.ndarray, "V 3"], which: Int64[np.ndarray, " S"]) -> Pairs:
    """Pair each of the given photographs with the two taken closest to it."""
    if len(which) < 3:
        return _NO_PAIRS
    median = np.median(KDTree(position).query(position, k=2)[0][:, 1])
    found = KDTree(position[which]).query(position[which], k=3)
    distance, neighbour = (np.asarray(column)[:, 1:].ravel() for column in found)
    return Pairs(np.repeat(which, 2), which[neighbour], np.maximum(distance / max(median, 1e-9), 0.1))


def to_common_exposure(
    scene: Scene, index: int, rows: slice = slice(None), columns: slice = slice(None)
) -> Float[Tensor, "h w 3"]:
    """Read a part of a photograph in the common light: divided by gain and shading (docs/method.md, section 12)."""
    return scene.photographs[index][rows, columns].float() / (255 * scene.cameras[index].gain_of_rows(rows, columns))


def windows_in_common_light(
    windows: UInt8[Tensor, "V h w 3"], cameras: Cameras, corner_px: Int[Tensor, "V 2"]
) -> Float[Tensor, "V h w 3"]:
    """Bring windows of photographs, one of each camera, into the common light, as `to_common_exposure` does.

    Args:
        windows: their pixels.
        cameras: of the photographs.
        corner_px: the windows' upper left corners.
    """
    height, width = windows.shape[1:3]
    return windows.float() / (255 * cameras.gain_of_windows(corner_px, width, height))
