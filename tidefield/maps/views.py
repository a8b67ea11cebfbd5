"""See the cells of a tile in photographs: which show them, where and how well."""

from __future__ import annotations

import math
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8

from tidefield.data.neighbours import ANGLE_SCALE_RAD, BORDER
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.maps.grid import STEEPEST_DEG, Tile
from tidefield.parallel import SharedValues

BORDER_PX = 4.0
"""Pixels along a photograph's border that are not used."""
KEPT_BYTES = 600_000_000
"""Memory for grey photographs."""


class GreyPhotographs:
    """The photographs of a scene in grey, reduced to the size of coarse cells; those not read for long go first.

    Args:
        scene: at the size to match at.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._kept: SharedValues[tuple[int, int], np.ndarray] = SharedValues(KEPT_BYTES, lambda grey: grey.nbytes)

    def read(self, index: int, factor: int) -> UInt8[np.ndarray, "h w"]:
        """Read a photograph at a `factor`-th of its size."""
        return self._kept.get((index, factor), self._reduced)

    def _reduced(self, key: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
        index, factor = key
        grey = cv2.cvtColor(self.scene.photographs[index].numpy(), cv2.COLOR_RGB2GRAY)
        if factor > 1:
            size = max(1, round(grey.shape[1] / factor)), max(1, round(grey.shape[0] / factor))
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        return grey


def positions_from(tile: Tile, cameras: Cameras) -> Float64[np.ndarray, "V 3"]:
    """East, north (horizontal units) and height above `Grid.height` of cameras, from the middle of a tile."""
    affine = tile.affine
    away = cameras.T_world_camera[:, :, 3].double().numpy() - affine[:, 3]
    return away @ np.linalg.inv(affine[:, :3]).T


def stands_above(
    position: np.ndarray, east: np.ndarray, north: np.ndarray, height: np.ndarray, up: float
) -> Bool[np.ndarray, "*shape"]:
    """Whether a camera stands within `STEEPEST_DEG` from the vertical above cells; the shapes broadcast.

    Args:
        up: horizontal units in a vertical one.
    """
    above = (position[2] - height) * up
    across = (position[0] - east) ** 2 + (position[1] - north) ** 2
    return (above > 0) & (across <= (math.tan(math.radians(STEEPEST_DEG)) * above) ** 2)


class View:
    """One photograph's projection of a tile's cells.

    Args:
        camera: of the photograph.
        tile: the cells.
        used: pixels of the photograph that are not masked; None where it has no mask.
    """

    def __init__(self, camera: Cameras, tile: Tile, used: Bool[np.ndarray, "h w"] | None = None) -> None:
        affine = tile.affine
        # Exact positions in double precision: single precision would cost a hundredth of a pixel.
        pose = camera.T_world_camera[0].double().numpy()
        rotation = pose[:, :3].T
        focal, principal = camera.focal_px[0].double().numpy(), camera.principal_px[0].double().numpy()
        k = np.array([[focal[0], 0, principal[0]], [0, focal[1], principal[1]], [0, 0, 1]])
        there = affine.copy()
        there[:, 3] -= pose[:, 3]
        self.matrix = (k @ rotation @ there).astype(np.float64)
        self.size = camera.width, camera.height
        self.camera = camera
        self.used = used
        self.position = positions_from(tile, camera)[0]
        """East, north and height above `Grid.height` of the photograph, from the middle of the tile."""
        self.up = tile.grid.frame.up

    @cached_property
    def gain(self) -> float:
        """Of the photograph where it shows the middle of the tile."""
        uv = torch.tensor([[[*(self.matrix[:2, 3] / self.matrix[2, 3])]]]).float()
        return float(self.camera.gain_at(uv).mean())

    def base(self, east: np.ndarray, north: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Homogeneous pixels (3 x H x W) of cells at heights above `Grid.height`."""
        m = self.matrix.astype(np.float32)
        return np.stack([m[i, 2] * height + (m[i, 0] * east + (m[i, 1] * north + m[i, 3])) for i in range(3)])

    def displacement(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """How far the lens' residual moves pixels; None without a residual."""
        if self.camera.residual is None:
            return None
        uv = torch.from_numpy(np.stack([u, v], -1).reshape(1, -1, 2))
        moved = (self.camera.displaced(uv) - uv)[0].numpy().reshape(*u.shape, 2)
        return np.ascontiguousarray(moved[..., 0]), np.ascontiguousarray(moved[..., 1])

    def pixels(
        self, east: np.ndarray, north: np.ndarray, height: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels u and v of cells, and their z-depth."""
        q = self.base(east, north, height)
        z = np.where(np.abs(q[2]) < 1e-6, 1e-6, q[2])
        u, v = q[0] / z, q[1] / z
        moved = self.displacement(u, v)
        return (u, v, q[2]) if moved is None else (u + moved[0], v + moved[1], q[2])

    def sees(
        self, u: np.ndarray, v: np.ndarray, z: np.ndarray, height: np.ndarray, east: np.ndarray, north: np.ndarray
    ) -> np.ndarray:
        """Whether cells lie in the photograph, not masked, at no more than `STEEPEST_DEG` from the vertical."""
        inside = (z > 0) & self.shows(u, v, BORDER_PX)
        return inside & stands_above(self.position, east, north, height, self.up)

    def shows(self, u: np.ndarray, v: np.ndarray, border_px: float) -> Bool[np.ndarray, "*shape"]:
        """Whether pixels lie in the photograph, so far from its border, and are not masked."""
        width, height = self.size
        inside = (u > border_px) & (v > border_px) & (u < width - border_px) & (v < height - border_px)
        if self.used is not None:
            inside[inside] = self.used[v[inside].astype(np.int64), u[inside].astype(np.int64)]
        return inside

    def rank(self, u: np.ndarray, v: np.ndarray, height: np.ndarray, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """How well cells are seen, as a network's neighbours of a view straight down are ranked (`data.neighbours`)."""
        across = np.hypot(self.position[0] - east, self.position[1] - north)
        angle = np.arctan2(across, (self.position[2] - height) * self.up)
        inner = np.minimum(np.minimum(u, self.size[0] - u), np.minimum(v, self.size[1] - v))
        return np.exp(-angle / ANGLE_SCALE_RAD) * np.clip(inner / (BORDER * self.size[0]), 0, 1)
