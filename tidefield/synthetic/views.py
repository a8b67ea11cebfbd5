"""Grids of rays, numbered row by row: a pinhole camera's and a parallel projection's.

Directions are scaled so that one unit of ray is one unit of depth along the view's forward axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tidefield.geometry.cameras import Cameras
from tidefield.synthetic.raster import Extent


@dataclass(frozen=True)
class Pinhole:
    """One camera, every pixel split into `split` x `split` rays."""

    camera: Cameras
    split: int = 1

    @property
    def columns(self) -> int:
        return self.camera.width * self.split

    @property
    def rows(self) -> int:
        return self.camera.height * self.split

    @property
    def device(self) -> torch.device:
        return self.camera.T_world_camera.device

    def rays(self, ray: Int[Tensor, " R"]) -> tuple[Float[Tensor, "3 #R"], Float[Tensor, "3 #R"]]:
        """Origins and directions of numbered rays."""
        u = ((ray % self.columns) + 0.5) / self.split
        v = (torch.div(ray, self.columns, rounding_mode="floor") + 0.5) / self.split
        (cx, cy), (fx, fy) = self.camera.principal_px[0].tolist(), self.camera.focal_px[0].tolist()
        right, down, forward, position = self.camera.T_world_camera[0].unbind(dim=1)
        x, y = (u - cx) / fx, (v - cy) / fy
        return position[:, None], right[:, None] * x + down[:, None] * y + forward[:, None]

    def footprint_m(self, depth: Float[Tensor, " R"]) -> Float[Tensor, " #R"]:
        """Distance between neighbouring rays at a depth."""
        return depth / (float(self.camera.focal_px[0].min()) * self.split)

    def locate(self, points: Float[Tensor, "3 P"], radius: Float[Tensor, " P"]) -> tuple[Tensor, Tensor, Tensor]:
        """Column and row of points, [P] each, and a reach [2 P] such that balls around them lie within it.

        Balls that touch the plane of the eye get a NaN reach.
        """
        uv, z = self.camera.project(points.T)
        uv, z = uv[0].T * self.split, z[0]
        focal = self.camera.focal_px[0] * self.split
        principal = self.camera.principal_px[0] * self.split
        # |f (x + a) / (z + b) - f x / z| <= f r sqrt(x^2 + z^2) / (z (z - r)) for |(a, b)| <= r < z.
        slant = torch.sqrt(1 + ((uv - principal[:, None]) / focal[:, None]) ** 2)
        reach = focal[:, None] * radius * slant / (z - radius)
        return uv[0], uv[1], torch.where(z > radius, reach, torch.nan)


@dataclass(frozen=True)
class Parallel:
    """Parallel rays through a grid of `cell_m`: straight down for maps, along the sun for shadows.

    Attributes:
        corner: start of ray (0, 0), world.
        right, down, forward: orthonormal axes, world.
    """

    corner: Float[Tensor, "3"]
    right: Float[Tensor, "3"]
    down: Float[Tensor, "3"]
    forward: Float[Tensor, "3"]
    columns: int
    rows: int
    cell_m: float

    @property
    def device(self) -> torch.device:
        return self.corner.device

    def rays(self, ray: Int[Tensor, " R"]) -> tuple[Float[Tensor, "3 #R"], Float[Tensor, "3 #R"]]:
        """Origins and directions of numbered rays."""
        u = (ray % self.columns) * self.cell_m
        v = torch.div(ray, self.columns, rounding_mode="floor") * self.cell_m
        origin = self.corner[:, None] + self.right[:, None] * u + self.down[:, None] * v
        return origin, self.forward[:, None]

    def footprint_m(self, depth: Float[Tensor, " R"]) -> Float[Tensor, " #R"]:
        """Distance between neighbouring rays, the same at every depth."""
        return depth.new_full((1,), self.cell_m)

    def place(self, points: Float[Tensor, "3 P"]) -> tuple[Tensor, Tensor, Tensor]:
        """Column, row and depth of points, [P] each; ray k stands at k."""
        x, y, z = (points - self.corner[:, None]).unbind()
        u, v, depth = (x * a[0] + y * a[1] + z * a[2] for a in (self.right, self.down, self.forward))
        return u / self.cell_m, v / self.cell_m, depth

    def locate(self, points: Float[Tensor, "3 P"], radius: Float[Tensor, " P"]) -> tuple[Tensor, Tensor, Tensor]:
        """Column and row of points, [P] each, and the reach [2 P] of balls around them; ray k stands at k + 0.5."""
        u, v, _ = self.place(points)
        return u + 0.5, v + 0.5, (radius / self.cell_m).expand(2, -1)


View = Pinhole | Parallel


def straight_down(extent: Extent, height_m: float, device: torch.device | str | None = None) -> Parallel:
    """The map of an extent, north up: one ray down through every node."""
    axes = torch.eye(3, device=device)
    corner = axes.new_tensor([extent.west_m, extent.north_m, height_m])
    return Parallel(corner, axes[0], -axes[1], -axes[2], extent.columns, extent.rows, extent.cell_m)


def along_the_sun(extent: Extent, low_m: float, high_m: float, sun: Float[Tensor, "3"], cell_m: float) -> Parallel:
    """The sun's own view of everything over an extent between two heights; `sun` points at it."""
    forward = -sun
    right = torch.linalg.cross(forward, forward.new_tensor([0.0, 0.0, 1.0]))
    right = right / right.norm() if float(right.norm()) > 1e-3 else forward.new_tensor([1.0, 0.0, 0.0])
    down = torch.linalg.cross(forward, right)
    box = forward.new_tensor(
        [
            [x, y, z]
            for x in (extent.west_m, extent.east_m)
            for y in (extent.south_m, extent.north_m)
            for z in (low_m, high_m)
        ]
    )
    placed = box @ torch.stack([right, down, forward], dim=1)
    least, most = placed.amin(0), placed.amax(0)
    columns, rows = (int(n) + 2 for n in ((most - least)[:2] / cell_m).tolist())
    corner = right * least[0] + down * least[1] + forward * (least[2] - 1)
    return Parallel(corner, right, down, forward, columns, rows, cell_m)
