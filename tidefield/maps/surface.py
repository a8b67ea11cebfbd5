"""Measure the height of every cell of a map by matching the photographs that see it, and its standard error.

Pairs of photographs are matched semi-globally first (`stereo`), which keeps the rims of plants. Then heights around
that surface are tried: the photographs are projected onto the surface at each height, and each is compared with the
mean of the others by windowed normalised cross-correlation, and with their median by colour. Where they agree best is
the surface (the vertical line locus of photogrammetry; Collins, A space-sweep approach to true multi-image matching,
1996, with windows that follow the surface found so far). A parabola through the best score and its neighbours places it
between the heights that were tried. Where that is not determined, as on blank and mirroring water, the surface of the
pairs stays. A bilateral filter and planes take noise off after each search, and keep rims and slopes.

The standard error comes from the spread of the heights that the photographs give one by one, from the curvature of the
score, and from the roughness of the surface within the window, whose smoothing no comparison of photographs can show.
Where no pair matches, the sparse points' surface continues the heights around, and the error is that of doing so,
unless the photographs determine the height then.

Alphabet: V photographs, K heights, H W cells of a tile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int
from scipy.spatial import KDTree

from tidefield.data.scene import Scene
from tidefield.data.surface import agree_with_neighbours, interpolate_on_pixels
from tidefield.maps.grid import Grid, Tile
from tidefield.maps.smoothing import smoothed
from tidefield.maps.stereo import Pairs, choose_pairs, fill_gaps
from tidefield.maps.views import GreyPhotographs, View, positions_from, stands_above

COARSEST = 8
"""Cells, along a side, of the coarse cells that the sparse points' surface is interpolated on."""
AROUND = 12
"""Nearest points whose median height the surface has outside of all points."""
PAD = 32
"""Cells around a tile that are matched with it: windows and the paths of semi-global matching reach beyond the tile."""
VIEWS = 8
"""Photographs that are compared with each other; more add little and take as long each."""
STEP_PX = 0.7
"""Parallax between heights that are tried, of the photographs farthest apart, in cells."""
SWEEPS = ((1.0, 3), (0.5, 3), (0.35, 3))
"""Share of the step, and heights that are tried above and below the surface found so far, in each sweep."""
ABOVE, BELOW = 0.15, 0.05
"""How far above and below the sparse points the surface is searched, as a share of the flight's height: that is how
tall a tree without any point may be."""
SIGMA_CELLS = 1.4
"""Standard deviation of the windows in which photographs are normalised, in cells."""
SHARP, WIDE = 1.0, 2.5
"""Standard deviations of the two windows, in cells, over whose mean scores are summed: one peak keeps the edges of
plants, the other bridges bare ground."""
GAPS, GAP_CELLS, LIKELIER = 0.02, 6.0, 0.03
"""Share of a tile without matched cells from which these are compared with the sparse points' surface; standard
deviation of the windows, in cells, over whose mean that is done; and by how much more photographs must correlate
there."""
UNDETERMINED, BRIDGED_CELLS = 0.8, 3.0
"""Standard error of a sweep's height, in its steps, at which half of it counts; the rest is a weighted mean over
windows of so many cells."""
DIFFERENCE, DIFFERENCE_WEIGHT = 20.0, 2.0
"""Grey values of 255 beyond which a photograph's difference from the median of all is an occlusion, and the weight of
the mean difference, as a share of that, against the correlation."""
BILATERAL_STEPS, BILATERAL_CELLS = 0.6, 2.5
"""Range, in steps, and radius, in cells, of the bilateral filter that takes noise off between rims."""
PLANE_ERRORS, PLANE_CELLS = 1.2, 7
"""Deviation of heights from planes, in standard errors of cells' matching, at which half of the surface is planes, and
radius, in cells, of the windows that these are fitted to."""
NOISIEST_STEPS = 3.0
"""Largest standard error of cells' matching there, in steps: rims are no noise."""
ERROR_CELLS = 2.0
"""Standard deviation of the windows in which standard errors of cells' matching are means, in cells."""
SHARE_MATCHING, SHARE_SLOPE, SHARE_ROUGHNESS = 0.3, 4.0, 7.0
DETAIL_CELLS, ROUGHNESS_CELLS, SLOPE_CELLS, STEEPEST_SLOPE = 1.0, 3.0, 2.0, 2.0
"""Shares of the standard error: of that of single cells' matching, of that times the slope, and of the roughness.
Roughness is what windows of the first size take off the surface, over windows of the second: of slopes and ripples that
is little, and these are measured well. Slopes are those after a blur of the third. The shares were found on built-in
flats of other seeds than those of `python -m benchmarks maps`, at two sizes (docs/experiments.md, Maps)."""
FLOOR = 3.0
"""Standard deviation of windows, in grey values of 255, below which they count as blank: noise of a photograph."""
PULL = 0.02
"""Score that is lost at the ends of the search range: blank and moving surfaces stay where they are expected."""

Height = Float32[np.ndarray, "H W"]


@dataclass(frozen=True)
class Matched:
    """The surface of a tile.

    Attributes:
        height: map units.
        sigma: standard error of the height, map units.
        score: mean normalised cross-correlation of the photographs there, -1 to 1.
        count: photographs that see each cell.
        main: the one that sees it best, 0 for none, else its index plus 1.
    """

    height: Height
    sigma: Height
    score: Height
    count: Int[np.ndarray, "H W"]
    main: Int[np.ndarray, "H W"]


@dataclass(frozen=True)
class Start:
    """The surface of the sparse points, from which heights are searched.

    Attributes:
        grid: of coarse cells.
        height: of the points, interpolated linearly.
    """

    grid: Grid
    height: Height

    def on(self, tile: Tile, pad: int) -> Height:
        """Height at the centres of a tile's cells and of `pad` cells around it."""
        east, north = tile.offsets(pad)
        middle = tile.centre
        u = (middle[0] + east.astype(np.float64) - self.grid.west) / self.grid.cell - 0.5
        v = (self.grid.north - middle[1] - north.astype(np.float64)) / self.grid.cell - 0.5
        # OpenCV's remap has no more than 32,766 columns, less than the coarse cells of a long coast.
        columns, rows = (_around(at, side) for at, side in zip((u, v), self.height.shape[::-1], strict=True))
        u, v = (u - columns.start).astype(np.float32), (v - rows.start).astype(np.float32)
        u, v = np.broadcast_arrays(u, v)
        return cv2.remap(self.height[rows, columns], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _around(at: np.ndarray, side: int) -> slice:
    """The cells of a side that positions in cells lie between; the nearest one outside of it."""
    first = int(np.clip(math.floor(at.min()), 0, side - 1))
    return slice(first, int(np.clip(math.ceil(at.max()), first, side - 1)) + 1)


def sparse_surface(scene: Scene, grid: Grid) -> Start:
    """Interpolate the sparse points on a grid of coarse cells.

    Points that do not agree with their neighbours are left out. Outside of all points the surface is that of the
    nearest ones.
    """
    assert scene.points is not None, "make_grid refuses scenes without points"
    xyz = grid.frame.to_map(scene.points.xyz_world.double().numpy())
    xyz = xyz[agree_with_neighbours(xyz[:, :2], xyz[:, 2])]
    uv = np.column_stack([(xyz[:, 0] - grid.west) / grid.cell, (grid.north - xyz[:, 1]) / grid.cell])
    inside = ((uv > -50) & (uv < [grid.columns + 50, grid.rows + 50])).all(1)
    if inside.sum() >= 3:
        uv, xyz = uv[inside], xyz[inside]
    low = np.minimum(uv.min(0), 0) - 1.0
    high = np.maximum(uv.max(0), [grid.columns, grid.rows]) + 1.0
    along = np.linspace(0, 1, 9)
    frame = np.array([(a, b) for a in along for b in along if a in (0, 1) or b in (0, 1)]) * (high - low) + low
    near = np.asarray(KDTree(uv).query(frame, k=min(AROUND, len(uv)))[1]).reshape(len(frame), -1)
    heights = np.concatenate([xyz[:, 2], np.median(xyz[near, 2], axis=1)])
    # Rounded positions may coincide, which Delaunay's triangles leave out.
    height = interpolate_on_pixels(np.concatenate([uv, frame]), heights - grid.height, grid.columns, grid.rows)
    height += grid.height
    return Start(grid, height.astype(np.float32))


@dataclass(frozen=True)
class Choice:
    """The photographs of a tile.

    Attributes:
        views: projections of all that see some of it.
        indices: their numbers in the scene.
        chosen: of `views`, those to compare with each other.
        pairs: of `views`, those to match semi-globally.
    """

    views: list[View]
    indices: list[int]
    chosen: list[int]
    pairs: list[tuple[int, int]]


def choose_views(tile: Tile, scene: Scene, start: Start) -> Choice:
    """Choose photographs to compare on a tile.

    Each time the photograph that adds most at a few places of the tile: where few photographs were chosen, not too far
    from the vertical, and from another direction than those chosen.
    """
    at = np.linspace(0, tile.side - 1, 7).round().astype(int)
    along = (at + 0.5).astype(np.float32) - tile.side / 2
    east, north = np.meshgrid(along * tile.grid.cell, -along * tile.grid.cell)
    height = start.on(tile, 0)[np.ix_(at, at)] - np.float32(tile.grid.height)
    views, indices, seen, direction = [], [], [], []
    # Projecting the cells into each of thousands of photographs would take most of a tile's time.
    up, positions = tile.grid.frame.up, positions_from(tile, scene.cameras)
    near = stands_above(positions.T[..., None, None], east, north, height, up).any((1, 2))
    for index in np.flatnonzero(near).tolist():
        (mask,) = scene.photographs.masks_of([index]) or (None,)
        view = View(scene.cameras[index], tile, None if mask is None else mask.numpy())
        u, v, z = view.pixels(east, north, height)
        sees = view.sees(u, v, z, height, east, north)
        if sees.any():
            views.append(view)
            indices.append(index)
            seen.append(sees)
            to = view.position[:, None, None] - np.stack([east, north, height])
            to[2] *= up
            direction.append(to / np.linalg.norm(to, axis=0))
    if not views:
        return Choice([], [], [], [])
    sees, to = np.stack(seen), np.stack(direction)
    angle = np.degrees(np.arccos(np.clip(to[:, 2], -1, 1)))
    quality = sees * np.exp(-((angle / 35.0) ** 2))
    chosen: list[int] = []
    covered = np.zeros(sees.shape[1:])
    nearest = np.full(sees.shape, 1.0)
    most = VIEWS
    while len(chosen) < min(most, len(views)):
        gain = (quality * nearest / (1 + covered) ** 1.5).sum((1, 2))
        gain[chosen] = -1
        best = int(gain.argmax())
        if gain[best] <= 0:
            break
        chosen.append(best)
        covered += sees[best]
        between = np.degrees(np.arccos(np.clip((to * to[best]).sum(1), -1, 1)))
        apart = 1 - np.exp(-((between / 8.0) ** 2))
        nearest = np.where(sees[best], np.minimum(nearest, apart), nearest)
        if len(chosen) == most and most < 2 * VIEWS and (covered[sees.sum(0) >= 4] < 4).any():
            most += 1
    places = (len(views), -1)
    pairs = choose_pairs(views, sees.reshape(places), angle.reshape(places), float(np.median(height)))
    return Choice(views, indices, chosen, pairs)


def match(tile: Tile, start: Start, scene: Scene, grey: GreyPhotographs, gsd: float) -> Matched:
    """Measure the heights of a tile's cells, margin included.

    Where fewer than two photographs see any of it, the surface is that of the sparse points.

    Args:
        tile: the cells.
        start: the sparse points' surface.
        scene: all photographs, at the size to match at.
        grey: the same photographs in grey.
        gsd: the photographs' median ground sampling distance, horizontal units.
    """
    choice = choose_views(tile, scene, start)
    views, indices = choice.views, choice.indices
    expected = start.on(tile, PAD) - np.float32(tile.grid.height)
    standing = [view.position[2] for view in views] or positions_from(tile, scene.cameras)[:, 2]
    above = float(np.median(standing) - np.median(expected))
    low, high = float(expected.min()) - BELOW * above, float(expected.max()) + ABOVE * above
    if len(views) < 2:  # then four standard errors span the heights that would be searched
        found = expected, np.full_like(expected, (high - low) / 4), np.zeros_like(expected)
    else:
        found = _matched(tile, choice, grey, max(1, round(tile.grid.cell / gsd)), expected, low, high)
    inner = slice(PAD, PAD + tile.side)
    height, sigma, score = (values[inner, inner] for values in found)
    east, north = tile.offsets()
    count, main = np.zeros(height.shape, np.int64), np.zeros(height.shape, np.int64)
    best = np.zeros(height.shape, np.float32)
    for view, index in zip(views, indices, strict=True):
        u, v, z = view.pixels(east, north, height)
        sees = view.sees(u, v, z, height, east, north)
        count += sees
        rank = np.where(sees, view.rank(u, v, height, east, north), 0)
        main[rank > best] = index + 1
        best = np.maximum(rank, best)
    return Matched((height + np.float32(tile.grid.height)).astype(np.float32), sigma, score, count, main)


def _matched(
    tile: Tile, choice: Choice, grey: GreyPhotographs, factor: int, expected: Height, low: float, high: float
) -> tuple[Height, Height, Height]:
    """Heights between two limits, their standard errors and scores, of a tile's cells and `PAD` cells around it."""
    views, indices = choice.views, choice.indices
    pairs = Pairs(choice.pairs, views, indices, grey, factor, tile.grid.cell, tile.side + 2 * PAD)
    low, high = pairs.narrowed(low, high)
    height = pairs.heights(low, high)
    used = [(views[k], indices[k]) for k in choice.chosen]
    east, north = tile.offsets(PAD)
    step = STEP_PX * tile.grid.cell_up / _parallax(views, choice.chosen, float(np.median(expected)))
    if np.isnan(height).all():
        height, spread = expected, np.full_like(expected, (high - low) / 4)
    else:
        gaps = np.isnan(height)
        above_points, spread = fill_gaps(height - expected)
        height = expected + above_points
        if gaps.mean() > GAPS:
            height = _likelier(used, grey, factor, east, north, height, expected, gaps, step)
    matching = score = np.zeros_like(height)
    for share, half in SWEEPS:
        offsets = _offsets(step * share, half)
        found, matching, score = _sweep(used, grey, factor, east, north, height, offsets)
        height = _cleaned(found, matching, height, step * share)
    matching = np.nan_to_num(matching, nan=10 * step).astype(np.float32)
    score = np.nan_to_num(score).astype(np.float32)
    by_gap = (1 - _blur(_determined(matching, step * SWEEPS[-1][0]), BRIDGED_CELLS)) * spread
    sigma = np.hypot(standard_error(height, matching, tile.grid.cell_up), by_gap).astype(np.float32)
    return height, sigma, score


def standard_error(height: Height, matching: Height, cell: float) -> Height:
    """Estimate the standard error of heights from that of the matching of single cells, and the surface around them.

    Most of the error lies where the surface is rough: windows widen plants, and hide the gaps between them. On slopes
    photographs show windows differently, and what matching misses across is missed in height. The shares are such that
    on built-in flats some 95% of the cells lie within 1.96 standard errors, or more.

    Args:
        height: of cells.
        matching: standard error of the matching of single cells.
        cell: side of a cell, in the unit of heights.
    """
    detail = height - _blur(height, DETAIL_CELLS)
    roughness = np.sqrt(_blur(detail**2, ROUGHNESS_CELLS))
    south, east = np.gradient(_blur(height, SLOPE_CELLS), cell)
    slope = np.minimum(_blur(np.hypot(south, east), ROUGHNESS_CELLS), STEEPEST_SLOPE)
    matched = _blur(matching, ERROR_CELLS) * np.hypot(SHARE_MATCHING, SHARE_SLOPE * slope)
    return np.hypot(matched, SHARE_ROUGHNESS * roughness).astype(np.float32)


def _parallax(views: list[View], chosen: Sequence[int], ground: float) -> float:
    """Shift of the photographs farthest apart per height, both in one unit, in the middle of the tile."""
    above = [max(views[k].position[2] - ground, 1e-6) * views[k].up for k in chosen]
    slope = np.array([views[k].position[:2] / height for k, height in zip(chosen, above, strict=True)])
    apart = np.linalg.norm(slope[:, None] - slope[None], axis=-1)
    return float(np.clip(np.percentile(apart[np.triu_indices(len(slope), 1)], 90), 0.1, 2.0))


def _likelier(
    used: list[tuple[View, int]],
    grey: GreyPhotographs,
    factor: int,
    east: np.ndarray,
    north: np.ndarray,
    filled: Height,
    expected: Height,
    gaps: Bool[np.ndarray, "H W"],
    step: float,
) -> Height:
    """Put the sparse points' surface into gaps between matched cells where it fits the photographs better.

    At a survey's edge, which two photographs far apart see, few cells match, often by chance, and what surrounds a gap
    says little of it.

    Args:
        filled: heights of matched cells, and of gaps what these say of them.
        expected: of the sparse points.
        step: between heights that are tried.
    """
    share, half = SWEEPS[0]
    offsets = _offsets(step * share, half)
    fits = []
    for start in (filled, expected):
        score = _sweep(used, grey, factor, east, north, start, offsets)[2]
        fits.append(smoothed(score, np.isfinite(score) & gaps, GAP_CELLS))
    better = (gaps & (fits[1] > fits[0] + LIKELIER)).astype(np.float32)
    weight = gaps * cv2.GaussianBlur(better, (0, 0), GAP_CELLS / 2)
    return (filled + weight * (expected - filled)).astype(np.float32)


def _offsets(step: float, half: int) -> Float32[np.ndarray, " K"]:
    """Heights that are tried above and below a surface."""
    return (step * np.arange(-half, half + 1)).astype(np.float32)


def _sweep(
    used: list[tuple[View, int]],
    grey: GreyPhotographs,
    factor: int,
    east: np.ndarray,
    north: np.ndarray,
    height: np.ndarray,
    offsets: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Try heights; returns the best one, its standard error and the correlation; NaN where less than two see it."""
    views = []
    for view, index in used:
        picture = grey.read(index, factor)
        base = view.base(east, north, height)
        u0, v0 = base[0] / base[2], base[1] / base[2]
        sees = view.sees(u0, v0, base[2], height, east, north)
        moved = view.displacement(u0, v0)
        scale = picture.shape[1] / view.size[0], picture.shape[0] / view.size[1]
        views.append((view, picture, base, sees.astype(np.float32), moved, scale))
    sees = np.stack([v[3] for v in views])
    number = sees.sum(0)
    gains = [view.gain for view, *_ in views]
    each = np.empty((len(offsets), len(views), *height.shape), np.float32)
    joint = np.empty((len(offsets), *height.shape), np.float32)
    for k, offset in enumerate(offsets):
        raw, normal = [], []
        for view, picture, base, mask, moved, scale in views:
            m = view.matrix[:, 2].astype(np.float32) * offset
            inverse = 1 / (base[2] + m[2])
            u, v = (base[0] + m[0]) * inverse, (base[1] + m[1]) * inverse
            if moved is not None:
                u, v = u + moved[0], v + moved[1]
            shown = cv2.remap(
                picture, u * scale[0] - 0.5, v * scale[1] - 0.5, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
            ).astype(np.float32)
            raw.append(shown)
            shown = shown - _blur(shown, SIGMA_CELLS)
            shown /= np.sqrt(_blur(shown * shown, SIGMA_CELLS) + FLOOR**2)
            normal.append(shown * mask)
        total = np.sum(normal, axis=0)
        score = np.zeros(height.shape, np.float32)
        for i, shown in enumerate(normal):
            own = shown * (total - shown) / np.maximum(number - sees[i], 1)
            each[k, i] = _blur(own, SIGMA_CELLS)
            score += own * sees[i]
        score /= np.maximum(number, 1)
        score -= DIFFERENCE_WEIGHT * _difference([r / g for r, g in zip(raw, gains, strict=True)], sees, number)
        joint[k] = 0.5 * (_blur(score, SHARP) + _blur(score, WIDE))
    return _best(joint, each, sees, offsets, height)


def _blur(values: np.ndarray, sigma: float) -> np.ndarray:
    side = 2 * round(2.5 * sigma) + 1
    return cv2.GaussianBlur(values, (side, side), sigma)


def _difference(shown: list[np.ndarray], sees: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Mean difference of the photographs from their median, each at most `DIFFERENCE`, as a share of that."""
    mean = sum(one * mask for one, mask in zip(shown, sees, strict=True)) / np.maximum(number, 1)
    values = [np.where(mask > 0, one, mean) for one, mask in zip(shown, sees, strict=True)]
    middle = _median(values)
    away = sum(np.minimum(np.abs(one - middle), DIFFERENCE) * mask for one, mask in zip(values, sees, strict=True))
    return (away / (np.maximum(number, 1) * DIFFERENCE)).astype(np.float32)


def _median(values: list[np.ndarray]) -> np.ndarray:
    """Median of arrays, element by element, by exchanges: ten times as fast as NumPy's for a few large arrays."""
    ordered, count = list(values), len(values)
    for i in range(count // 2 + 1):
        for j in range(count - 1, i, -1):
            low = np.minimum(ordered[j - 1], ordered[j])
            ordered[j], ordered[j - 1] = np.maximum(ordered[j - 1], ordered[j]), low
    return ordered[count // 2] if count % 2 else (ordered[count // 2 - 1] + ordered[count // 2]) / 2


def _best(
    joint: Float32[np.ndarray, "K H W"],
    each: Float32[np.ndarray, "K V H W"],
    sees: Float32[np.ndarray, "V H W"],
    offsets: np.ndarray,
    height: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the height of the best score, its standard error, and the mean correlation there."""
    number = sees.sum(0)
    step = float(offsets[1] - offsets[0])
    pulled = joint - PULL * (offsets / offsets[-1])[:, None, None] ** 2
    best = pulled[1:-1].argmax(0) + 1
    low, mid, high = (np.take_along_axis(joint, (best + d)[None], 0)[0] for d in (-1, 0, 1))
    curvature = np.maximum(2 * mid - low - high, 1e-3)
    shift = np.clip((high - low) / (2 * curvature), -1, 1)
    # The same for each photograph against the mean of the others.
    index = np.broadcast_to(best[None, None] + np.array([-1, 0, 1])[:, None, None, None], (3, *each.shape[1:]))
    own = np.take_along_axis(each, index, 0)
    bend = np.maximum(2 * own[1] - own[0] - own[2], 1e-3)
    alone = np.clip((own[2] - own[0]) / (2 * bend), -2, 2)
    weight = sees * bend
    spread = (weight * (alone - shift) ** 2).sum(0) / np.maximum(weight.sum(0), 1e-6)
    error = np.sqrt(spread / np.maximum(number - 1, 1))
    correlation = (own[1] * sees).sum(0) / np.maximum(number, 1)
    blank = 0.3 * np.sqrt(np.maximum(1 - correlation, 0.02) / (curvature * np.maximum(number, 1)))
    valid = number >= 2
    found = height + offsets[best] + shift * step
    parts = (found, np.hypot(error, blank) * step, correlation)
    found, error, correlation = (np.where(valid, part, np.nan).astype(np.float32) for part in parts)
    return found, error, correlation


def _cleaned(found: np.ndarray, sigma: np.ndarray, before: np.ndarray, step: float) -> Height:
    """Keep of a sweep what it determines, and remove single outliers and noise.

    Of cells with a large standard error the shift is a weighted mean over their surroundings, and counts the less.
    """
    shift = np.nan_to_num(found - before)
    sigma = np.nan_to_num(sigma, nan=10 * step).astype(np.float32)
    weight = (1 / (sigma**2 + (0.05 * step) ** 2)).astype(np.float32)
    around = _blur((shift * weight).astype(np.float32), BRIDGED_CELLS) / _blur(weight, BRIDGED_CELLS)
    share = _determined(sigma, step)
    height = (before + share * (share * shift + (1 - share) * around)).astype(np.float32)
    median = cv2.medianBlur(height, 5)
    height = np.where(np.abs(height - median) > 3 * step, median, height).astype(np.float32)
    return _smoothed(height, sigma, step)


def _determined(sigma: np.ndarray, step: float) -> np.ndarray:
    """How much a sweep's height counts, 0 to 1."""
    return 1 / (1 + (sigma / (UNDETERMINED * step)) ** 4)


def _smoothed(height: Height, sigma: Height, step: float) -> Height:
    """Take noise off a surface, and keep its rims, slopes and bends.

    A bilateral filter keeps rims, but makes stairs of slopes. Where windows are plane but for noise, the mean of the
    planes that are fitted to all windows around a cell takes its place: a guided filter (He, Sun and Tang, Guided image
    filtering, 2013, section 3) whose guides are the axes. The square of the variance decides which, so that little is
    left of either where the other is right.

    Args:
        height: of cells.
        sigma: standard error of their matching, not zero.
        step: between heights that were tried.
    """
    across = 2 * PLANE_CELLS + 1
    away = np.arange(-PLANE_CELLS, PLANE_CELLS + 1, dtype=np.float32)
    flat = np.full(across, 1 / across, np.float32)
    spread = float((away**2).mean())

    def mean(values: Height, columns: np.ndarray = flat, rows: np.ndarray = flat) -> Height:
        return cv2.sepFilter2D(values, cv2.CV_32F, columns, rows, borderType=cv2.BORDER_REPLICATE)

    base = float(height.mean())  # squares of what is small keep their digits
    above = height - base
    middle = mean(above)
    east, south = mean(above, away / across) / spread, mean(above, flat, away / across) / spread
    variance = mean(above**2) - middle**2 - spread * (east**2 + south**2)
    noise = PLANE_ERRORS * np.minimum(_blur(sigma, ERROR_CELLS), NOISIEST_STEPS * step)
    smooth = 1 / (1 + (np.maximum(variance, 0) / noise**2) ** 2)
    rough = 1 - smooth
    plane = mean(smooth * middle) - mean(smooth * east, away / across) - mean(smooth * south, flat, away / across)
    sharp = cv2.bilateralFilter(height, 9, float(BILATERAL_STEPS * step), BILATERAL_CELLS)
    return (mean(rough) * (sharp - base) + plane + base).astype(np.float32)
