"""Which points of several views to keep, so that no view's points stand in front of what other views show.

A view sees freely up to the depth that it shows: a point in between is contradicted by it. Points are chosen in passes,
those that no view contradicts first; later passes fill what is still uncovered, the least contradicted points first.
After the fusion by visibility of Merrell et al., "Real-Time Visibility-Based Fusion of Depth Maps" (2007).

Alphabet: K views, P pixels of a view, N points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64

from tidefield.geometry.cameras import Cameras

SAME_DEPTH = 0.01
"""Share of the depth within which a point agrees with a view (docs/experiments.md, 2026-11-26)."""
OTHER_VIEWS = 16
"""Views that a view's points are compared with: those that see most of them."""
PASSES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Largest share of contradicting views of the points that each pass adds; the last one fills with any."""
_EVERY = 37
"""One in so many points decides which views see most of them."""


@dataclass(frozen=True)
class ViewPoints:
    """The surface in one view, a point per pixel, row by row.

    Attributes:
        camera: of the view.
        xyz_world: the points.
        depth: their z-depths, world units.
        known: where the view shows something, so that its depth means anything.
        shown: the points that may be chosen: those on a surface that is not too steep.
    """

    camera: Cameras
    xyz_world: Float64[np.ndarray, "P 3"]
    depth: Float32[np.ndarray, " P"]
    known: Bool[np.ndarray, " P"]
    shown: Bool[np.ndarray, " P"]

    def pixels(
        self, xyz_world: Float64[np.ndarray, "N 3"]
    ) -> tuple[Int64[np.ndarray, " N"], Float32[np.ndarray, " N"]]:
        """Find the pixels that show points, -1 outside of the view, and the points' z-depths."""
        uv, z = (of[0].numpy() for of in self.camera.project(torch.from_numpy(xyz_world).float()))
        width, height = self.camera.width, self.camera.height
        inside = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < width) & (uv[:, 1] < height)
        column, row = np.where(inside[:, None], uv, 0).astype(np.int64).T
        return np.where(inside, row * width + column, -1), z

    def depths_around(self) -> tuple[Float32[np.ndarray, " P"], Float32[np.ndarray, " P"]]:
        """Compute the smallest and the largest depth of each pixel and its eight neighbours.

        A point that is shown between pixels, or beside an edge, lies between both.
        """
        size, block = (self.camera.height, self.camera.width), np.ones((3, 3), np.uint8)
        nearest = cv2.erode(np.where(self.known, self.depth, np.float32(np.inf)).reshape(size), block)
        farthest = cv2.dilate(np.where(self.known, self.depth, np.float32(0)).reshape(size), block)
        return nearest.ravel(), farthest.ravel()


def choose_points(views: Sequence[ViewPoints], passes: Sequence[float] = PASSES) -> list[Bool[np.ndarray, " P"]]:
    """Choose the points of every view that are to be shown.

    The first pass chooses all points that are contradicted at most as it says. Each further one adds to every view the
    points, contradicted at most as it says, of the pixels that nothing covers yet. With a last pass of 1, every shown
    pixel of every view is covered in the end.

    Args:
        views: of one scene.
        passes: largest share of contradicting views, ascending.
    """
    others = other_views(views)
    contradicted = contradicted_shares(views, others)
    chosen = [view.shown & (share <= passes[0]) for view, share in zip(views, contradicted, strict=True)]
    counts = [np.zeros(len(view.depth), np.float32) for view in views]
    _count(counts, views, others, chosen)
    for most in passes[1:]:
        added = [
            view.shown & ~own & (share <= most) & ~_covered(count, view.camera)
            for view, own, share, count in zip(views, chosen, contradicted, counts, strict=True)
        ]
        _count(counts, views, others, added)
        chosen = [own | more for own, more in zip(chosen, added, strict=True)]
    return chosen


def other_views(views: Sequence[ViewPoints]) -> list[list[int]]:
    """List for each view the `OTHER_VIEWS` others that see most of its points, best first; all see some."""
    result = []
    for k, view in enumerate(views):
        some = view.xyz_world[::_EVERY]
        seen = np.array([0 if j == k else int((other.pixels(some)[0] >= 0).sum()) for j, other in enumerate(views)])
        result.append([int(j) for j in np.argsort(-seen, kind="stable")[:OTHER_VIEWS] if seen[j]])
    return result


def contradicted_shares(
    views: Sequence[ViewPoints], others: Sequence[Sequence[int]]
) -> list[Float64[np.ndarray, " P"]]:
    """Compute the share of contradicting views for every point of every view.

    A view contradicts a point that lies in front of what it shows there, and agrees with one within `SAME_DEPTH` of it.
    To points behind that it says nothing. The share is of both; 0 where no view says anything.
    """
    around = [view.depths_around() for view in views]
    result = []
    for k, view in enumerate(views):
        against, agreeing = np.zeros(len(view.depth)), np.zeros(len(view.depth))
        for j in others[k]:
            pixel, z = views[j].pixels(view.xyz_world)
            nearest, farthest = around[j]
            seen = (pixel >= 0) & views[j].known[pixel]
            in_front = seen & (z < (1 - SAME_DEPTH) * nearest[pixel])
            against += in_front
            agreeing += seen & ~in_front & (z <= (1 + SAME_DEPTH) * farthest[pixel])
        result.append(against / np.maximum(against + agreeing, 1))
    return result


def _count(
    counts: Sequence[Float32[np.ndarray, " P"]],
    views: Sequence[ViewPoints],
    others: Sequence[Sequence[int]],
    added: Sequence[Bool[np.ndarray, " P"]],
) -> None:
    """Add to the number of points in each pixel those that are added, of the view itself and of its others."""
    points = [view.xyz_world[more] for view, more in zip(views, added, strict=True)]
    for k, view in enumerate(views):
        counts[k][:] += added[k]
        for j in others[k]:
            pixel, _ = view.pixels(points[j])
            counts[k][:] += np.bincount(pixel[pixel >= 0], minlength=len(counts[k]))


def _covered(count: Float32[np.ndarray, " P"], camera: Cameras) -> Bool[np.ndarray, " P"]:
    """Which pixels hold at least one point on average with their neighbours, as densely as a view's own points lie."""
    mean = cv2.blur(count.reshape(camera.height, camera.width), (3, 3), borderType=cv2.BORDER_REFLECT_101)
    return mean.ravel() > 1 - 1e-3  # rounding
