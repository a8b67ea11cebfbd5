"""Match pairs of photographs by semi-global matching, and join the heights of all pairs on the cells of a tile.

Semi-global matching (Hirschmüller, Stereo processing by semiglobal matching and mutual information, 2008) as OpenCV has
it keeps the rims of plants and bridges blank water, which windows do not. Each pair is resampled to two virtual cameras
at its own centres whose rows are parallel to the base and which look down as far as that allows, at about the map's
cell: the headings of the photographs do not matter. What both directions of a pair agree on becomes points, and of each
cell's points the median is taken.

Coordinates are a tile's: east, north and height from its middle (`Tile.affine`), K disparities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from tidefield.maps.views import GreyPhotographs, View

PAIRS = 12
"""Pairs of photographs that are matched on a tile."""
BASE, BASE_SPREAD = 0.25, 0.6
"""Preferred base of a pair, as a share of the height, and how many natural logarithms off it counts half as much."""
SHORTEST, LONGEST = 0.05, 0.9
"""Bases that are used at all."""
STEEPEST = 0.35
"""Largest rise of a base: beyond, rows of cameras that look down cannot follow it."""
OFF_NADIR_DEG = 28.0
"""Angle from the vertical at which a photograph's worth has fallen to 1/e."""
WINDOW = 3
P1, P2 = 4, 16
"""Penalties of disparities that differ by 1, and by more, times the window's area: half of those of OpenCV's
documentation, which widen crowns, as larger windows do (docs/experiments.md, Maps)."""
MOST_DISPARITIES = 512
NARROWED, MARGIN = 4, 0.1
"""How much larger the cells are in which the range of heights is found, and the share of the range as it was that is
added on both sides, for what is too small for them."""
UNIQUE, SPECKLE, SPECKLE_RANGE = 10, 100, 2
"""Per cent by which the best cost must win, and the size and step of specks that are removed, as is usual."""


def choose_pairs(
    views: Sequence[View], sees: np.ndarray, off_nadir_deg: np.ndarray, height: float
) -> list[tuple[int, int]]:
    """Choose pairs of photographs to match on a tile, the ones that add most at a few places of it first.

    Args:
        views: the photographs' projections.
        sees: which of the places each of them sees, V x P.
        off_nadir_deg: angle from the vertical at which it does, V x P.
        height: of the surface in the middle of the tile.

    Returns:
        Pairs of indices of `views`.
    """
    quality = sees * np.exp(-((off_nadir_deg / OFF_NADIR_DEG) ** 2))
    pairs, worth = [], []
    for i in range(len(views)):
        for j in range(i + 1, len(views)):
            base, up = views[j].position - views[i].position, views[i].up
            across = float(np.linalg.norm(base[:2]))
            above = max(float((views[i].position[2] + views[j].position[2]) / 2 - height) * up, 1e-6)
            if not SHORTEST <= across / above <= LONGEST or abs(base[2]) * up > STEEPEST * across:
                continue
            preferred = np.exp(-((np.log(across / above / BASE) / BASE_SPREAD) ** 2))
            gain = preferred * np.minimum(quality[i], quality[j]).ravel()
            if gain.any():
                pairs.append((i, j))
                worth.append(gain)
    chosen: list[int] = []
    covered = np.zeros(sees[0].size)
    gains = np.array(worth).reshape(len(pairs), covered.size)
    while len(chosen) < min(PAIRS, len(pairs)):
        total = (gains / (1 + covered)).sum(1)
        total[chosen] = -1
        chosen.append(int(total.argmax()))
        covered += gains[chosen[-1]]
    return [pairs[k] for k in chosen]


class Rectified:
    """Two photographs resampled to rows parallel to their base.

    Args:
        left, right: their projections; the base points from left to right.
        cell: side of a cell, horizontal units.
        side: cells along a side of the square around the origin.
        low, high: heights between which the surface is searched.
    """

    def __init__(self, left: View, right: View, cell: float, side: int, low: float, high: float) -> None:
        base = right.position - left.position
        self.base = float(np.linalg.norm(base))
        x = base / self.base
        z = np.array([0.0, 0.0, -1.0]) + x * x[2]
        z /= np.linalg.norm(z)
        self.rotation = np.stack([x, np.cross(z, x), z])
        self.centre = left.position
        half = side * cell / 2
        corners = np.array([(e, n, h) for e in (-half, half) for n in (-half, half) for h in (low, high)])
        local = (corners - self.centre) @ self.rotation.T
        depth = np.maximum(local[:, 2], 1e-6)
        self.focal = float(np.median(depth)) / cell
        u, v = self.focal * local[:, 0] / depth, self.focal * local[:, 1] / depth
        nearest, farthest = self.focal * self.base / depth.min(), self.focal * self.base / depth.max()
        self.least = int(np.floor(farthest)) - 1
        self.count = -(-int(np.ceil(nearest) - self.least + 2) // 16) * 16
        # OpenCV finds nothing in the first `count` columns of the left picture.
        self.origin = np.array([np.floor(u.min()) - self.count, np.floor(v.min())])
        self.size = int(np.ceil(u.max() - self.origin[0])), int(np.ceil(v.max() - self.origin[1]))

    def resample(self, view: View, picture: np.ndarray, shift: float) -> tuple[np.ndarray, np.ndarray]:
        """Resample a photograph; returns the picture and where it lies in the photograph.

        Args:
            view: its projection.
            picture: in grey, at any size.
            shift: columns by which its first one lies to the left of the left picture's.
        """
        columns, rows = self.size
        u = (np.arange(columns) + 0.5 + self.origin[0] - shift) / self.focal
        v = (np.arange(rows) + 0.5 + self.origin[1]) / self.focal
        m = (view.matrix[:, :3] @ self.rotation.T).astype(np.float64)
        q = [m[k, 0] * u[None] + (m[k, 1] * v + m[k, 2])[:, None] for k in range(3)]
        x, y = (q[0] / q[2]).astype(np.float32), (q[1] / q[2]).astype(np.float32)
        moved = view.displacement(x, y)
        if moved is not None:
            x, y = x + moved[0], y + moved[1]
        inside = (q[2] > 0) & view.shows(x, y, 1.0)
        scale = picture.shape[1] / view.size[0], picture.shape[0] / view.size[1]
        shown = cv2.remap(
            picture, x * scale[0] - 0.5, y * scale[1] - 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return shown, inside

    def points(self, disparity: Float32[np.ndarray, "h w"], valid: np.ndarray) -> Float64[np.ndarray, "N 3"]:
        """Points of the left picture's valid pixels."""
        rows, columns = np.nonzero(valid)
        z = self.focal * self.base / (disparity[rows, columns] + self.least)
        x = (columns + 0.5 + self.origin[0]) / self.focal * z
        y = (rows + 0.5 + self.origin[1]) / self.focal * z
        return np.column_stack([x, y, z]) @ self.rotation + self.centre


@dataclass(frozen=True)
class Pairs:
    """Pairs of photographs to match, and the square of cells around the origin whose heights they give.

    Attributes:
        indices: pairs of indices of `views`.
        views, photographs: projections of photographs, and their numbers in the scene.
        grey: the photographs, read at a `factor`-th of their size.
        cell: side of a cell, horizontal units.
        side: cells along a side of the square.
    """

    indices: Sequence[tuple[int, int]]
    views: Sequence[View]
    photographs: Sequence[int]
    grey: GreyPhotographs
    factor: int
    cell: float
    side: int

    def coarser(self, times: int) -> Pairs:
        """The same in cells so many times as large, which may reach a little beyond the square."""
        return replace(self, factor=self.factor * times, cell=self.cell * times, side=-(-self.side // times))

    def heights(self, low: float, high: float) -> Float32[np.ndarray, "H W"]:
        """Match pairs; returns the median height of each cell, NaN where no pair has any.

        Args:
            low, high: heights between which the surface is searched.
        """
        found = [np.full((self.side, self.side), np.nan, np.float32)]
        for i, j in self.indices:
            first, second = (self.grey.read(self.photographs[k], self.factor) for k in (i, j))
            one = _pair(self.views[i], self.views[j], first, second, self.cell, self.side, low, high)
            if one is not None:
                found.append(one)
        heights = np.sort(np.stack(found), axis=0)  # NaN last
        number = np.isfinite(heights).sum(0)
        low_middle = np.take_along_axis(heights, np.maximum((number - 1) // 2, 0)[None], 0)[0]
        high_middle = np.take_along_axis(heights, np.minimum(number // 2, len(heights) - 1)[None], 0)[0]
        return np.where(number > 0, (low_middle + high_middle) / 2, np.nan).astype(np.float32)

    def narrowed(self, low: float, high: float) -> tuple[float, float]:
        """Heights between which the surface lies, by matching in cells `NARROWED` times as large.

        The time of matching is proportional to the heights that are searched, and level ground lies in a few of those
        where trees might stand.
        """
        found = self.coarser(NARROWED).heights(low, high)
        if np.isnan(found).all():
            return low, high
        margin = MARGIN * (high - low)
        return max(low, float(np.nanmin(found)) - margin), min(high, float(np.nanmax(found)) + margin)


def _pair(
    left: View, right: View, first: np.ndarray, second: np.ndarray, cell: float, side: int, low: float, high: float
) -> Float32[np.ndarray, "H W"] | None:
    """Heights of cells by one pair, the highest in each; NaN where it has none."""
    rectified = Rectified(left, right, cell, side, low, high)
    if rectified.count > MOST_DISPARITIES:
        return None
    a, inside_a = rectified.resample(left, first, 0.0)
    b, inside_b = rectified.resample(right, second, float(rectified.least))
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=rectified.count, blockSize=WINDOW, P1=P1 * WINDOW**2, P2=P2 * WINDOW**2,
        disp12MaxDiff=1, uniquenessRatio=UNIQUE, speckleWindowSize=SPECKLE, speckleRange=SPECKLE_RANGE,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    # OpenCV rounds sixteenths of negative shifts up.
    disparity = matcher.compute(a, b).astype(np.float32) / 16 - 1 / 32
    valid = (disparity >= -1 / 32) & inside_a
    # Where the right picture has the same point.
    columns = np.arange(disparity.shape[1], dtype=np.float32) - disparity
    rows = np.broadcast_to(np.arange(disparity.shape[0], dtype=np.float32)[:, None], disparity.shape)
    valid &= cv2.remap(inside_b.astype(np.uint8), columns, np.ascontiguousarray(rows), cv2.INTER_NEAREST) > 0
    points = rectified.points(disparity, valid)
    points = points[(points[:, 2] >= low) & (points[:, 2] <= high)]
    column = np.floor(points[:, 0] / cell + side / 2).astype(np.int64)
    row = np.floor(side / 2 - points[:, 1] / cell).astype(np.int64)
    kept = (column >= 0) & (row >= 0) & (column < side) & (row < side)
    height = points[kept, 2].astype(np.float32)
    place = (row * side + column)[kept]
    order = np.argsort(height, kind="stable")
    result = np.full(side * side, np.nan, np.float32)
    result[place[order]] = height[order]
    return result.reshape(side, side)


def fill_gaps(height: Float32[np.ndarray, "H W"]) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """Fill NaN with means over squares that grow with the distance from known cells.

    Squares are halved in number along each side until all are known, and fade into each other on the way back (pull and
    push; Gortler and others, The lumigraph, 1996, section 3.4).

    Returns:
        The heights; and of each the standard deviation in its square, 0 of known cells.
    """
    known = np.isfinite(height)
    base = height[known].mean(dtype=np.float64).astype(np.float32)  # squares of what is small keep their digits
    above = np.where(known, height - base, 0)
    levels = [np.stack([above, above**2, known.astype(np.float32)])]
    while levels[-1][2].min() < 1:
        levels.append(_halved(levels[-1]))
    mean = levels[-1][:2]
    for finer in reversed(levels[:-1]):
        rows, columns = finer.shape[1:]
        coarse = np.stack([_doubled(band)[:rows, :columns] for band in mean])
        mean = finer[2] * finer[:2] + (1 - finer[2]) * coarse
    spread = np.sqrt(np.maximum(mean[1] - mean[0] ** 2, 0))
    return np.where(known, height, mean[0] + base), np.where(known, 0, spread)


def _halved(bands: Float32[np.ndarray, "3 h w"]) -> Float32[np.ndarray, "3 i j"]:
    """Means over two by two cells, by the last band, the share of a cell that is known; four quarters are a whole."""
    rows, columns = bands.shape[1:]
    even = np.pad(bands, ((0, 0), (0, rows % 2), (0, columns % 2)))
    even[:2] *= even[2]
    sums = even[:, ::2, ::2] + even[:, 1::2, ::2] + even[:, ::2, 1::2] + even[:, 1::2, 1::2]
    sums[:2] /= np.maximum(sums[2], 1e-6)
    sums[2] = np.minimum(sums[2], 1)
    return sums


def _doubled(band: Float32[np.ndarray, "i j"]) -> Float32[np.ndarray, "h w"]:
    return cv2.resize(band, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
