"""Render the true orthophoto of a tile: rays straight down, through the same method that renders every other view.

A camera stands above the middle of the tile, so far that its rays are parallel: a cell at the tile's edge, as high
above or as deep below the middle as any, is shown `PARALLEL_PX` of a pixel beside its place at most. Its picture is at
the scene's common exposure, so it shows no borders of photographs.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from tidefield.data.depth_prior import STRIDE
from tidefield.geometry.cameras import Cameras
from tidefield.maps.grid import Tile
from tidefield.model.renderer import Renderer
from tidefield.model.rendering import Render

PARALLEL_PX = 0.1
"""Largest shift, in cells, of what a tile's camera shows, against parallel rays."""
NEAREST_SIDES, FARTHEST = 20.0, 5e4
"""Least distance of a camera in sides of its tile, and the largest in scene units, where single precision is 6 mm."""
MARGIN_SIGMAS, MARGIN_CELLS = 3.0, 2.0
"""Rays are sampled within so many standard errors of the surface, and so many cells more, above and below it."""


def camera_above(tile: Tile, height: Float32[np.ndarray, "H W"]) -> tuple[Cameras, float]:
    """Place a camera above a tile, for parallel rays.

    Args:
        tile: what the camera shows, margin included: one pixel a cell.
        height: of the cells above `Grid.height`.

    Returns:
        The camera, and its height above `Grid.height` in scene units.
    """
    affine = tile.affine
    east, north, up = (affine[:, k] / np.linalg.norm(affine[:, k]) for k in range(3))
    units = float(np.linalg.norm(affine[:, :2], axis=0).mean())  # scene units per map unit
    units_up = float(np.linalg.norm(affine[:, 2]))
    middle = float(np.median(height)) * units_up
    farthest = float(np.abs(height * units_up - middle).max())
    cell = tile.grid.cell * units
    distance = max(NEAREST_SIDES * tile.side * cell, tile.side / 2 * farthest / PARALLEL_PX)
    distance = min(distance, FARTHEST) + middle
    pose = np.column_stack([east, -north, -up, affine[:, 3] + distance * up])
    away = distance - middle
    focal = away / cell
    camera = Cameras(
        T_world_camera=torch.from_numpy(pose[None]).float(),
        focal_px=torch.full((1, 2), focal),
        principal_px=torch.full((1, 2), tile.side / 2),
        size_px=torch.tensor([[tile.side, tile.side]]),
        near_far=torch.tensor([[away - farthest - 10 * cell, away + farthest + 10 * cell]]),
        gain=torch.ones(1, 3),
    )
    return camera, distance


def prior_of(
    height: Float32[np.ndarray, "H W"], sigma: Float32[np.ndarray, "H W"], tile: Tile, above: float
) -> Float[Tensor, "3 h w"]:
    """Depth prior of a tile's camera from the tile's surface: expected, nearest and farthest inverse depth.

    Args:
        height: of the cells above `Grid.height`.
        sigma: standard error of the heights.
        tile: of the cells.
        above: height of the camera above `Grid.height`, scene units.
    """
    units_up = float(np.linalg.norm(tile.affine[:, 2]))
    cell = tile.grid.cell_up
    reach = np.minimum(MARGIN_SIGMAS * sigma, 100 * cell) + MARGIN_CELLS * cell
    around = np.ones((3 * STRIDE, 3 * STRIDE), np.uint8)
    high, low = cv2.dilate(height + reach, around), cv2.erode(height - reach, around)
    rows, columns = -(-height.shape[0] // STRIDE), -(-height.shape[1] // STRIDE)
    parts = [cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA) for part in (height, high, low)]
    depth = above - np.stack(parts).astype(np.float64) * units_up
    return torch.from_numpy((1 / depth).astype(np.float32))


def render_tile(
    render: Render, tile: Tile, height: Float32[np.ndarray, "H W"], sigma: Float32[np.ndarray, "H W"]
) -> Float32[np.ndarray, "H W 3"]:
    """Render the colours of a tile's cells straight down, sRGB in [0, 1], at the scene's common exposure."""
    camera, above = camera_above(tile, height)
    if isinstance(render, Renderer):
        return render(camera, prior_of(height, sigma, tile, above)).colour.numpy()
    return render(camera).colour.numpy()
