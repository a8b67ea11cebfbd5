"""Sparse points as structure-from-motion would leave them: noisy observations, triangulated, without outliers."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from tidefield.data.scene import SparsePoints
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.synthetic.flat import TidalFlat

_NOISE_PX = 0.3
"""Standard deviation of an observation, per axis."""
_FOUND = 0.7
"""Chance that a photograph that sees a point also matches it."""
_VISIBLE_PX = 0.75
"""A photograph sees a point whose depth agrees with that of the pixel it falls on to so many pixels' footprints."""
_UNSURE_PX = 3.0
"""Points whose position is less certain than so many pixels' footprints are dropped: their rays are near parallel."""
_DEEP_M = 0.1
"""No points are found on water deeper than this: what shows there moves with the eye."""


def sparse_points(
    flat: TidalFlat,
    cameras: Cameras,
    photographs: UInt8[Tensor, "V H W 3"],
    depth: Float[Tensor, "V H W"],
    random: np.random.Generator,
) -> SparsePoints:
    """Pick corners, find them in the other photographs by their true depth, add noise and triangulate."""
    device = depth.device
    true = torch.cat([_corners(cameras[i], photographs[i], depth[i], random) for i in range(len(cameras))])
    true = true[flat.water_depth(true.T) < _DEEP_M]
    seen = _seen(cameras, depth, true)
    seen &= torch.from_numpy(random.random(seen.shape) < _FOUND).to(device)
    camera, point = torch.nonzero(seen, as_tuple=True)
    noise = torch.from_numpy(random.normal(0, _NOISE_PX, (*seen.shape, 2))).to(device)
    uv = cameras.project(true)[0].double()[camera, point] + noise[camera, point]
    xyz, certain = _triangulated(cameras, true.double(), point, camera, uv)
    inside = ((uv > 0) & (uv < cameras.size_px[camera])).all(1)
    often = torch.bincount(point[inside], minlength=len(true)) >= 2
    kept = certain & often
    point, camera, uv = (x[inside & kept[point]] for x in (point, camera, uv))
    _, _, residual = _linearised(cameras, xyz, point, camera, uv)
    count = torch.bincount(point, minlength=len(true))
    error = (
        torch.zeros(len(true), dtype=torch.float64, device=device).index_add_(0, point, residual.norm(dim=1)) / count
    )
    number = kept.cumsum(0) - 1
    return SparsePoints(xyz[kept].float(), error[kept].float(), number[point], camera, uv.float())


def _corners(
    camera: Cameras, photograph: UInt8[Tensor, "H W 3"], depth: Float[Tensor, "H W"], random: np.random.Generator
) -> Float[Tensor, "P 3"]:
    """World points of pixels drawn by their cornerness."""
    grey = cv2.cvtColor(photograph.cpu().numpy(), cv2.COLOR_RGB2GRAY)
    strength = np.sqrt(cv2.cornerMinEigenVal(grey, 3).clip(min=1e-8)).reshape(-1)
    strength = np.where(np.isfinite(depth.cpu().numpy().reshape(-1)), strength, 0)
    wanted = int(np.clip(grey.size / 400, 60, 200))
    # The largest of u^(1/w) are a weighted sample without replacement (Efraimidis and Spirakis 2006).
    key = np.log(random.random(grey.size)) / np.maximum(strength, 1e-12)
    pixel = torch.from_numpy(np.sort(np.argpartition(-key, wanted)[:wanted])).to(depth.device)
    z = depth.reshape(-1)[pixel]
    uv = pixel_grid(camera.width, camera.height, depth.device)[pixel]
    at = camera.position_world + camera.directions_world(uv[None])[0] * z[:, None]
    return at[torch.isfinite(z)]


def _seen(cameras: Cameras, depth: Float[Tensor, "V H W"], points: Float[Tensor, "P 3"]) -> Tensor:
    """Which photographs [V P] see which points."""
    uv, z = cameras.project(points)
    height, width = depth.shape[1:]
    column, row = uv.floor().long().unbind(-1)
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    surface = depth.flatten(1).gather(1, pixel)
    return inside & ((z - surface).abs() < _VISIBLE_PX * z / cameras.focal_px[:, :1])


def _triangulated(
    cameras: Cameras,
    start: Float[Tensor, "P 3"],
    point: Int[Tensor, " O"],
    camera: Int[Tensor, " O"],
    uv: Float[Tensor, "O 2"],
) -> tuple[Tensor, Tensor]:
    """Least-squares points [P 3] by Gauss-Newton from a start, and which of them [P] are well determined."""
    xyz = start
    for _ in range(3):
        normal, right, _ = _normal_equations(cameras, xyz, point, camera, uv)
        # Points with fewer than two rays are dropped below, but must be solved without a fuss.
        tiny = 1e-9 * torch.eye(3, dtype=xyz.dtype, device=xyz.device)
        xyz = xyz + torch.linalg.solve(normal + tiny, right).clamp(-10, 10)
    normal, _, z = _normal_equations(cameras, xyz, point, camera, uv)
    unsure = _NOISE_PX / torch.sqrt(torch.linalg.eigvalsh(normal)[:, 0].clamp(min=1e-12))
    footprint = torch.zeros_like(unsure).scatter_reduce_(0, point, z / cameras.focal_px[camera, 0], "amax")
    return xyz, unsure < _UNSURE_PX * footprint


def _normal_equations(
    cameras: Cameras, xyz: Tensor, point: Tensor, camera: Tensor, uv: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Left [P 3 3] and right [P 3] side for each point, and the z-depth [O] of each observation."""
    jacobian, z, residual = _linearised(cameras, xyz, point, camera, uv)
    transposed = jacobian.transpose(1, 2)
    normal = torch.zeros(len(xyz), 3, 3, dtype=xyz.dtype, device=xyz.device)
    normal.index_add_(0, point, transposed @ jacobian)
    right = torch.zeros_like(xyz).index_add_(0, point, (transposed @ residual[..., None])[..., 0])
    return normal, right, z


def _linearised(
    cameras: Cameras, xyz: Tensor, point: Tensor, camera: Tensor, uv: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Jacobians [O 2 3] of observations by their points, z-depths [O] and residuals [O 2]."""
    pose = cameras.T_world_camera.double()[camera]
    focal, principal = cameras.focal_px.double()[camera], cameras.principal_px.double()[camera]
    local = ((xyz[point] - pose[:, :, 3])[:, None] @ pose[:, :, :3])[:, 0]
    z = local[:, 2]
    ratio = local[:, :2] / z[:, None]
    axes = pose[:, :, :3].transpose(1, 2)
    jacobian = (focal / z[:, None])[..., None] * (axes[:, :2] - ratio[..., None] * axes[:, 2:])
    return jacobian, z, uv - (ratio * focal + principal)
