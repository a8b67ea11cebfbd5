"""Fit the ground under a survey to its sparse points, and find what each photograph covers of it.

The ground is a plane plus a coarse grid of residuals (medians, so that trees and stray points hardly matter).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
import shapely
from jaxtyping import Float64
from scipy import ndimage
from shapely import Polygon
from shapely.geometry.polygon import orient

from tidefield.geometry.lenses import FisheyeLens, lens_from_colmap
from tidefield.survey.report.block import Block

POINTS_A_CELL = 16  # on average: enough for a median
LARGEST_GRID = 256
BORDER_POINTS = 8  # along each side of a photograph's frame
FURTHEST = 2.0  # times the distance of the photograph's far points, where the footprint of an oblique view ends
STEPS = 32
TOLERANCE = 0.004  # of a footprint's size: corners that matter less are left out


@dataclass(frozen=True)
class Ground:
    """Heights as a function of x and y.

    Attributes:
        plane: (a, b, c) of z = a x + b y + c.
        corner: x and y of the first cell's centre.
        cell: spacing of the cells.
        residual: height above the plane, rows along y; its border values go on outside.
    """

    plane: Float64[np.ndarray, " 3"]
    corner: Float64[np.ndarray, " 2"]
    cell: float
    residual: Float64[np.ndarray, "h w"]

    def above_plane(self, points: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch"]:
        """Heights of points above the plane alone."""
        return points[..., 2] - points[..., :2] @ self.plane[:2] - self.plane[2]

    def above(self, points: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch"]:
        """Heights of points above the ground (bilinear)."""
        index = np.moveaxis((points[..., :2] - self.corner)[..., ::-1] / self.cell, -1, 0)
        return self.above_plane(points) - ndimage.map_coordinates(self.residual, index, order=1, mode="nearest")


def fit_ground(points: Float64[np.ndarray, "P 3"]) -> Ground:
    """Fit the ground to sparse points (P >= 1); those far outside the others, in x, y or z, are ignored."""
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    slack = 0.1 * (high - low) + 1e-9  # the least: points in one plane have no spread at all
    points = points[((points >= low - slack) & (points <= high + slack)).all(1)]
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    size = high - low
    cell = max(float(np.sqrt(size.prod() * POINTS_A_CELL / len(points))), float(size.max()) / LARGEST_GRID, 1e-9)
    columns, rows = (np.floor(size / cell).astype(int) + 1).tolist()
    index = np.floor((points[:, :2] - low) / cell).astype(int)
    flat = index[:, 1] * columns + index[:, 0]
    cells = np.unique(flat)
    x, y = (ndimage.mean(points[:, axis], flat, cells) for axis in (0, 1))
    z = ndimage.median(points[:, 2], flat, cells)
    design = np.stack([x, y, np.ones(len(cells))], axis=1)
    plane = np.linalg.lstsq(design, z, rcond=None)[0]
    residual = np.full(rows * columns, np.nan)
    residual[cells] = z - design @ plane
    residual = residual.reshape(rows, columns)
    nearest = np.asarray(
        ndimage.distance_transform_edt(np.isnan(residual), return_distances=False, return_indices=True)
    )
    smooth = ndimage.median_filter(residual[tuple(nearest)], 3, mode="nearest")
    return Ground(plane, low + cell / 2, cell, smooth)


def footprints(block: Block, ground: Ground) -> tuple[Polygon, ...]:
    """Outline what every photograph covers of the ground: x and y, counter-clockwise; empty if it sees no ground."""
    distance = np.linalg.norm(block.points[block.point] - block.position[block.photograph], axis=1)
    far = 2 * np.maximum(ground.above(block.position), 0)
    for i, mine in block.observations():
        far[i] = np.percentile(distance[mine], 98)
    borders = [_border_directions(camera) for camera in block.cameras]
    found = []
    for i, lens in enumerate(block.lens):
        directions = borders[lens] @ block.R_world_camera[i].T
        xy = _intersect(ground, block.position[i], directions, FURTHEST * far[i])[:, :2]
        outline = Polygon(xy).simplify(TOLERANCE * float(np.ptp(xy, 0).max())) if len(xy) > 2 else Polygon()
        assert isinstance(outline, Polygon), "`simplify` keeps the topology"
        found.append(orient(outline) if outline.area > 0 else Polygon())
    return tuple(found)


def _border_directions(camera: pycolmap.Camera) -> Float64[np.ndarray, "K 3"]:
    """Unit directions, in the camera's frame, along the border of its image, or of a fisheye's pinhole."""
    border = shapely.segmentize(shapely.box(0, 0, 1, 1), 1 / BORDER_POINTS)
    uv = shapely.get_coordinates(border)[:-1] * (camera.width, camera.height)
    lens = lens_from_colmap(camera.model_name, camera.width, camera.height, camera.params)
    xy = lens.pinhole().unproject(uv) if isinstance(lens, FisheyeLens) else np.asarray(camera.cam_from_img(uv))
    xy = xy[np.isfinite(xy).all(1)]  # a strong distortion need not be invertible at the corners
    directions = np.c_[xy, np.ones(len(xy))]
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _intersect(
    ground: Ground, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "K 3"], reach: float
) -> Float64[np.ndarray, "_ 3"]:
    """First intersections of rays with the ground, or their ends; nothing if none of them goes down."""
    fall = directions[:, :2] @ ground.plane[:2] - directions[:, 2]  # towards the plane, per unit of length
    if not (fall > 1e-6).any():
        return np.zeros((0, 3))
    start = ground.above_plane(origin[None])[0]
    with np.errstate(divide="ignore"):
        enter = np.where(fall > 1e-6, (start - ground.residual.max()) / fall, np.inf).clip(0, reach)
        leave = np.where(fall > 1e-6, (start - ground.residual.min()) / fall, np.inf).clip(0, reach)
    t = enter[:, None] + (leave - enter)[:, None] * np.linspace(0, 1, STEPS)
    samples = origin + t[..., None] * directions[:, None]
    over = ground.above(samples)
    under = over <= 0
    k = np.where(under.any(1), under.argmax(1), STEPS - 1).clip(1)
    rows = np.arange(len(t))
    before, after = over[rows, k - 1], over[rows, k]
    share = np.clip(before / np.where(before > after, before - after, 1), 0, 1)
    share = np.where(under[rows, k], share, 1)
    hit = t[rows, k - 1] + share * (t[rows, k] - t[rows, k - 1])
    return origin + hit[:, None] * directions
