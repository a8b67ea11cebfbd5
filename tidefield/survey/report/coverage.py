"""How many photographs see each piece of ground, and how much neighbouring photographs share."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int, UInt16
from shapely import Polygon

from tidefield.survey.report.ground import signed_area

LONG_SIDE = 600  # cells
FINER = 4  # the outline is traced on a raster so many times finer, as it runs through cells' centres
SMALLEST_HOLE = 12  # cells; smaller parts and holes of the outline are left out
SAME_PLACE = 0.02  # of the height: photographs nearer than this were taken from one place
PARALLEL_DEG = 30.0


@dataclass(frozen=True)
class Coverage:
    """A raster over the survey.

    Attributes:
        count: photographs whose footprint holds the cell's centre; rows from south to north.
        corner: x and y of the raster's south-western corner.
        cell: side of a cell.
    """

    count: UInt16[np.ndarray, "h w"]
    corner: Float64[np.ndarray, " 2"]
    cell: float

    @property
    def far_corner(self) -> Float64[np.ndarray, " 2"]:
        """x and y of the north-eastern corner."""
        return self.corner + np.array(self.count.shape[::-1]) * self.cell

    def area(self, least: int, most: int | None = None) -> float:
        """Area that at least `least` and at most `most` photographs see."""
        seen = self.count >= least
        return float((seen if most is None else seen & (self.count <= most)).sum()) * self.cell**2

    def outline(self) -> shapely.MultiPolygon:
        """Trace the area that any photograph sees; outer rings run counter-clockwise."""
        seen = np.kron(self.count > 0, np.ones((FINER, FINER), np.uint8)).astype(np.uint8)
        rings, tree = cv2.findContours(seen, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        polygons: dict[int, list[np.ndarray]] = {}
        parents = tree[0, :, 3].tolist() if tree is not None else []
        for i in sorted(range(len(rings)), key=parents.__getitem__):  # outer rings, whose parent is -1, come first
            ring = cv2.approxPolyDP(rings[i], 0.75 * FINER, True)[:, 0].astype(np.float64)
            area = signed_area(ring)
            if len(ring) < 3 or abs(area) < SMALLEST_HOLE * FINER**2:
                continue
            ring = self.corner + (ring + 0.5) * (self.cell / FINER)
            ring = ring if (area > 0) == (parents[i] < 0) else ring[::-1]
            if parents[i] < 0:
                polygons[i] = [ring]
            elif parents[i] in polygons:
                polygons[parents[i]].append(ring)
        return shapely.MultiPolygon([Polygon(outer, holes) for outer, *holes in polygons.values()])


def cover(footprints: tuple[Polygon, ...]) -> Coverage:
    """Count the footprints over every cell of a raster that holds them all."""
    corners = shapely.get_coordinates(footprints)
    low, high = (corners.min(0), corners.max(0)) if len(corners) else (np.zeros(2), np.ones(2))
    cell = float((high - low).max()) / LONG_SIDE
    columns, rows = np.ceil((high - low) / cell - 1e-9).astype(int).clip(1)
    count = np.zeros((rows, columns), np.uint16)
    for outline in footprints:
        if not outline.is_empty:
            _add(count, (shapely.get_coordinates(outline.exterior)[:-1] - low) / cell)
    return Coverage(count, low, cell)


def _add(count: UInt16[np.ndarray, "h w"], polygon: Float64[np.ndarray, "K 2"]) -> None:
    """Add one to every cell whose centre lies in a polygon (even-odd rule); `polygon` in cells.

    `cv2.fillPoly` also fills the cells that the border only touches: a footprint of 120 by 90 cells grew by 1 to 2%.
    """
    first, last = np.floor(polygon.min(0)).astype(int), np.ceil(polygon.max(0)).astype(int)
    centre_y = np.arange(first[1], last[1]) + 0.5
    turns = np.zeros((len(centre_y), last[0] - first[0] + 1), np.uint16)
    following = np.roll(polygon, -1, axis=0)
    for (x0, y0), (x1, y1) in zip(polygon, following, strict=True):
        rows = np.flatnonzero((centre_y >= min(y0, y1)) & (centre_y < max(y0, y1)))
        x = x0 + (centre_y[rows] - y0) * ((x1 - x0) / (y1 - y0)) if len(rows) else np.zeros(0)
        np.add.at(turns, (rows, np.ceil(x - 0.5).astype(int).clip(first[0], last[0]) - first[0]), 1)
    inside = np.cumsum(turns, axis=1)[:, :-1] & 1
    window = count[first[1] : last[1], first[0] : last[0]]
    window += inside[: window.shape[0], : window.shape[1]].astype(np.uint16)


@dataclass(frozen=True)
class Overlap:
    """Share of each photograph's footprint that a neighbour sees too; NaN where there is no such neighbour.

    Attributes:
        forward: the nearest photograph ahead or behind along the flight, the larger of the two.
        side: the nearest to the side, on a parallel line.
    """

    forward: Float64[np.ndarray, " N"]
    side: Float64[np.ndarray, " N"]


def overlap(
    footprints: tuple[Polygon, ...], position: Float64[np.ndarray, "N 3"], order: Int[np.ndarray, " N"], height: float
) -> Overlap:
    """Measure forward and side overlap from geometry alone, so that a missing photograph shows as a gap.

    Args:
        footprints: of every photograph; their convex hulls are compared.
        position: of the cameras.
        order: photographs in the order of the flight, from which its heading follows.
        height: of the flight above ground.
    """
    hulls = shapely.convex_hull(np.array(footprints, dtype=object))
    heading = _headings(position[:, :2], order)
    forward, side = np.full(len(position), np.nan), np.full(len(position), np.nan)

    def shared(one: Polygon, other: Polygon) -> float:
        return min(one.intersection(other).area / one.area, 1.0)

    for i in np.flatnonzero(~shapely.is_empty(hulls)):
        offset = position[:, :2] - position[i, :2]
        along, across = offset @ heading[i], offset @ [-heading[i, 1], heading[i, 0]]
        distance = np.hypot(along, across)
        parallel = np.abs(heading @ heading[i]) > np.cos(np.radians(PARALLEL_DEG))
        candidate = parallel & (distance > SAME_PLACE * height)
        ahead = candidate & (np.abs(along) > np.abs(across))
        near = [_nearest(distance, ahead & (along > 0)), _nearest(distance, ahead & (along < 0))]
        forward[i] = max((shared(hulls[i], hulls[j]) for j in near if j is not None), default=np.nan)
        neighbour = _nearest(distance, candidate & ~ahead)
        if neighbour is not None:
            side[i] = shared(hulls[i], hulls[neighbour])
    return Overlap(forward, side)


def _headings(xy: Float64[np.ndarray, "N 2"], order: Int[np.ndarray, " N"]) -> Float64[np.ndarray, "N 2"]:
    """Unit vectors of the flight's heading: along the shorter leg, before or after the photograph."""
    path = xy[order]
    steps = np.diff(path, axis=0)
    if not len(steps):
        return np.tile([[1.0, 0.0]], (len(xy), 1))
    length = np.linalg.norm(steps, axis=1)
    arriving, leaving = np.r_[np.inf, length], np.r_[length, np.inf]
    index = np.arange(len(path))
    chosen = steps[np.where(arriving < leaving, index - 1, np.minimum(index, len(steps) - 1))]
    heading = np.empty_like(xy)
    heading[order] = chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1e-9)  # hovering has none
    return heading


def _nearest(distance: Float64[np.ndarray, " N"], among: Bool[np.ndarray, " N"]) -> int | None:
    return int(np.where(among, distance, np.inf).argmin()) if among.any() else None
