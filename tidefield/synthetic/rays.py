"""Grids of rays, numbered row by row, and their intersection with a height field.

Views are pinhole cameras or parallel projections. Directions are scaled so that one unit of ray is one unit of depth
along the view's forward axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from tidefield.geometry.cameras import Cameras
from tidefield.synthetic.grids import Extent, Raster

_TOLERANCE_M = 5e-5
"""Rays this close to the surface have met it: far below the size of the finest detail drawn."""
_STEPS = 180
"""Most steps per ray; only rays that graze the surface need as many."""
_STEPS_BETWEEN_CHECKS = 4
"""Dropping finished rays after every step costs more than a few steps too many."""
_MISSED_M = 0.01
"""Rays that are still further from the surface after the last step run along it and count as sky."""

Rays = tuple[Float[Tensor, "3 #R"], Float[Tensor, "3 #R"]]
"""Origins and directions, world; the same for all rays where there is one column."""


def dot(a: Float[Tensor, "3 #P"], b: Float[Tensor, "3 #P"]) -> Float[Tensor, " P"]:
    """Compute scalar products of planar vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def normalised(a: Float[Tensor, "3 P"]) -> Float[Tensor, "3 P"]:
    """Scale planar vectors to unit length."""
    return a / torch.sqrt(dot(a, a))


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

    def rays(self, ray: Int[Tensor, " R"]) -> Rays:
        """Return numbered rays."""
        (cx, cy), (fx, fy) = self.camera.principal_px[0].tolist(), self.camera.focal_px[0].tolist()
        u, v = (ray % self.columns + 0.5) / self.split, (ray // self.columns + 0.5) / self.split
        x, y = (u - cx) / fx, (v - cy) / fy
        right, down, forward, position = self.camera.T_world_camera[0].unbind(dim=1)
        return position[:, None], right[:, None] * x + down[:, None] * y + forward[:, None]

    def footprint_m(self, depth: Float[Tensor, " R"]) -> Float[Tensor, " #R"]:
        """Return the distance between neighbouring rays at a depth."""
        return depth / (float(self.camera.focal_px[0].min()) * self.split)

    def locate(
        self, points: Float[Tensor, "3 P"], radius: Float[Tensor, " P"]
    ) -> tuple[Float[Tensor, "2 P"], Float[Tensor, "2 P"]]:
        """Bound the rays that meet balls: column and row of the centres (ray k at k + 0.5), and reach around them.

        Balls that touch the camera's plane get a NaN reach.
        """
        uv, z = self.camera.project(points.T)
        uv, z = uv[0].T * self.split, z[0]
        focal, principal = (x[0, :, None] * self.split for x in (self.camera.focal_px, self.camera.principal_px))
        # |f (x + a) / (z + b) - f x / z| <= f r sqrt(x^2 + z^2) / (z (z - r)) for |(a, b)| <= r < z.
        slant = torch.sqrt(1 + ((uv - principal) / focal) ** 2)
        return uv, torch.where(z > radius, focal * radius * slant / (z - radius), torch.nan)


@dataclass(frozen=True)
class Parallel:
    """Parallel rays through a grid of `cell_m`: straight down for maps, along the sun's rays for shadows.

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

    @staticmethod
    def straight_down(extent: Extent, height_m: float) -> Parallel:
        """View an extent from above, north up: one ray through every node."""
        axes = torch.eye(3)
        corner = torch.tensor([extent.west_m, extent.north_m, height_m])
        return Parallel(corner, axes[0], -axes[1], -axes[2], extent.columns, extent.rows, extent.cell_m)

    @staticmethod
    def along_sun(extent: Extent, low_m: float, high_m: float, sun: Float[Tensor, "3"]) -> Parallel:
        """View the box over an extent, between two heights, from the sun; `sun` is the unit vector towards it."""
        forward = -sun
        right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0]))
        right = right / right.norm() if float(right.norm()) > 1e-3 else torch.tensor([1.0, 0.0, 0.0])
        down = torch.linalg.cross(forward, right)
        x, y, z = (extent.west_m, extent.east_m), (extent.south_m, extent.north_m), (low_m, high_m)
        corners = torch.cartesian_prod(*map(torch.tensor, (x, y, z))) @ torch.stack([right, down, forward], dim=1)
        least, most = corners.amin(0), corners.amax(0)
        columns, rows = (int(n) + 2 for n in ((most - least)[:2] / extent.cell_m).tolist())
        corner = right * least[0] + down * least[1] + forward * (least[2] - 1)
        return Parallel(corner, right, down, forward, columns, rows, extent.cell_m)

    def rays(self, ray: Int[Tensor, " R"]) -> Rays:
        """Return numbered rays."""
        u, v = (ray % self.columns) * self.cell_m, (ray // self.columns) * self.cell_m
        return self.corner[:, None] + self.right[:, None] * u + self.down[:, None] * v, self.forward[:, None]

    def footprint_m(self, depth: Float[Tensor, " R"]) -> Float[Tensor, " #R"]:
        """Return the distance between neighbouring rays, the same at every depth."""
        return depth.new_full((1,), self.cell_m)

    def project(self, points: Float[Tensor, "3 P"]) -> Float[Tensor, "3 P"]:
        """Return column, row and depth of points; ray k at k, without the half of `locate`."""
        x, y, z = (points - self.corner[:, None]).unbind()
        u, v, depth = (x * a[0] + y * a[1] + z * a[2] for a in (self.right, self.down, self.forward))
        return torch.stack([u / self.cell_m, v / self.cell_m, depth])

    def locate(
        self, points: Float[Tensor, "3 P"], radius: Float[Tensor, " P"]
    ) -> tuple[Float[Tensor, "2 P"], Float[Tensor, "2 P"]]:
        """Bound the rays that meet balls: column and row of the centres (ray k at k + 0.5), and reach around them."""
        return self.project(points)[:2] + 0.5, (radius / self.cell_m).expand(2, -1)


View = Pinhole | Parallel


def height_field_depth(height: Raster, rays: Rays) -> Float[Tensor, " R"]:
    """Find the depth at which rays from above first meet a height field; inf for rays that do not.

    The surface is the bilinear interpolation of its raster, so "exact" is well defined. From a point `gap` above the
    ground, a ray that falls by -d_z and runs |d_xy| per unit of depth cannot meet a surface of slope at most L within
    gap / (L |d_xy| - d_z): that is the step (sphere tracing with a Lipschitz bound for height fields; Hart, 1996). The
    gap shrinks by a constant factor with every step, so no bisection is needed to finish.
    """
    origin, direction = rays
    falling = direction[2] < -1e-3
    fall = torch.where(falling, direction[2], -1.0)
    rate = 1 / (height.max_slope * torch.hypot(direction[0], direction[1]) - fall)
    # From where the ray enters the slab that holds the surface.
    depth = ((height.values.max() - origin[2]) / fall).clamp(min=0)
    scale = 2 / torch.tensor([*height.extent.size_m, 2.0])[:, None]
    shift = torch.tensor([height.extent.west_m, height.extent.south_m, 0.0])[:, None]
    # East and north in the raster's [-1, 1]; the height stays in metres.
    start = (origin - shift) * scale - torch.tensor([1.0, 1.0, 0.0])[:, None]
    start, step, rate, depth = torch.broadcast_tensors(start, direction * scale, rate, depth)
    rate, depth = rate[0], depth[0]
    depths, gaps = depth.clone(), torch.empty_like(depth)
    active = torch.arange(len(depth))
    at = torch.empty(1, 1, len(depth), 2)
    for k in range(_STEPS):
        torch.addcmul(start[0], depth, step[0], out=at[0, 0, :, 0])
        torch.addcmul(start[1], depth, step[1], out=at[0, 0, :, 1])
        below = F.grid_sample(height.values[None], at, padding_mode="border", align_corners=True)[0, 0, 0]
        gap = torch.addcmul(start[2], depth, step[2]).sub_(below).clamp_(min=0)
        depth = torch.addcmul(depth, gap, rate)
        if k % _STEPS_BETWEEN_CHECKS == _STEPS_BETWEEN_CHECKS - 1:
            depths[active], gaps[active] = depth, gap
            keep = torch.nonzero(gap > _TOLERANCE_M)[:, 0]
            if len(keep) == 0:
                break
            active, start, step, rate, depth = active[keep], start[:, keep], step[:, keep], rate[keep], depth[keep]
            at = at[:, :, : len(keep)].contiguous()
    return torch.where(falling & (gaps < _MISSED_M), depths, torch.inf)
