"""What the sparse points tell of a camera's rays: where to look first, and depths to hold (method.md, section 13)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.hull import Hull, hull_range
from tidefield.data.scene import Scene, SparsePoints
from tidefield.data.surface import depth_through, trusted_points
from tidefield.geometry.cameras import Cameras

STRIDE = 4
"""Pixels between the prior's cells."""
AROUND = 12
"""Sparse points whose depths span a cell's interval."""
MARGIN = 0.1
"""Share of the image's depth range by which the interval goes beyond these points ..."""
LONELY_MARGIN = 0.5
"""... and where the nearest of them is a tenth of the image's width away."""
PARALLAX_MARGIN = 0.01
"""Share of the depth by which it goes beyond the expected surface in any case."""
BEHIND_HULL = 0.1
"""How far into the hull the surface is expected: it touches the hull or, in hollows, lies behind."""


@dataclass(frozen=True)
class Observed:
    """The K sparse points that one photograph observed.

    Attributes:
        uv_px: where.
        inverse_depth: of their z-depth.
        weight: how far to trust them, in (0, 1]: 1/2 where the reprojection error is the usual one of the scene.
    """

    uv_px: Float[Tensor, "K 2"]
    inverse_depth: Float[Tensor, " K"]
    weight: Float[Tensor, " K"]


def observed_depths(camera: Cameras, points: SparsePoints | None, index: int) -> Observed:
    """The sparse points that photograph `index`, whose camera this is, observed in front of it."""
    if points is None:
        return Observed(torch.zeros(0, 2), torch.zeros(0), torch.zeros(0))
    mine = points.camera_index == index
    which = points.point_index[mine].long()
    z = camera.project(points.xyz_world[which])[1][0]
    # Cauchy's weight: a point of thrice the usual error counts a fifth of one of the usual error.
    usual = points.error_px.median().clamp(min=1e-6)
    weight = 1 / (1 + (points.error_px[which] / usual) ** 2)
    front = z > 0
    return Observed(points.uv_px[mine][front], 1 / z[front], weight[front])


def surface_prior(
    camera: Cameras, points: SparsePoints | None, cameras: Cameras, hull: Hull | None = None
) -> Float[Tensor, "3 h w"]:
    """Expected, nearest and farthest inverse z-depth of one camera's pixels, on cells of `STRIDE` pixels.

    Expected is the surface through the sparse points; the interval spans the points around, with a margin that grows
    where they are few. Without points, but before a known background, the interval is where the ray passes the visual
    hull, and the surface is expected near the hull's front. Without either, nothing is expected (NaN) and the interval
    is the camera's near to far.
    """
    width, height = -(-camera.width // STRIDE), -(-camera.height // STRIDE)
    near, far = 1 / camera.near_far[0]
    # The cells of a grid of ceil(W / 4) columns are 4 pixels wide only if the camera is widened to match.
    cells = camera.cropped(width * STRIDE, height * STRIDE).resized(width, height)
    if points is None:
        if hull is None:
            return torch.stack([torch.full_like(near, torch.nan), near, far])[:, None, None].expand(3, height, width)
        shallow, deep, meets = hull_range(cells, hull)
        front = torch.lerp(shallow, deep, BEHIND_HULL)
        return 1 / torch.stack([torch.where(meets, front, torch.nan), shallow, deep])
    uv, inverse = trusted_points(cells, points, cameras)
    expected = 1 / depth_through(cells, uv, inverse)
    if len(uv) < AROUND:
        lowest, highest = far.expand_as(expected), near.expand_as(expected)
    else:
        lowest, highest, distance = _span(uv, inverse, width, height)
        spread = np.percentile(inverse, 98) - np.percentile(inverse, 2)
        lonely = np.minimum(distance / (0.1 * width), 1.0)
        margin = spread * (MARGIN + (LONELY_MARGIN - MARGIN) * lonely)
        lowest, highest = (torch.from_numpy(x).to(expected) for x in (lowest - margin, highest + margin))
    # Never beyond the camera's own range, and never empty: a camera's range may be narrower than its points.
    expected = expected.clamp(far * (1 + PARALLAX_MARGIN), near / (1 + PARALLAX_MARGIN))
    highest = torch.maximum(highest, expected * (1 + PARALLAX_MARGIN)).clamp(max=near)
    lowest = torch.minimum(lowest, expected / (1 + PARALLAX_MARGIN)).clamp(min=far)
    return torch.stack([expected, highest, lowest])


def read_prior(
    priors: Float[Tensor, "T 3 h w"], uv_px: Float[Tensor, "T R 2"]
) -> tuple[Float[Tensor, "T R"], Float[Tensor, "T R"], Float[Tensor, "T R"]]:
    """Expected, nearest and farthest inverse depth at pixels, interpolated; beyond the image its border continues."""
    height, width = priors.shape[-2:]
    grid = uv_px / (STRIDE * uv_px.new_tensor([width, height])) * 2 - 1
    values = F.grid_sample(priors, grid[:, :, None], padding_mode="border", align_corners=False)[..., 0]
    expected, near, far = values.unbind(1)
    return expected, near, far


def _span(uv: np.ndarray, inverse: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and greatest inverse depth of the points around each cell, and the distance to the nearest, in cells."""
    from scipy.spatial import KDTree

    v, u = np.mgrid[:height, :width] + 0.5
    distance, index = KDTree(uv).query(np.stack([u, v], -1).reshape(-1, 2), k=AROUND)
    around = inverse[index]
    shape = (height, width)
    return around.min(1).reshape(shape), around.max(1).reshape(shape), distance[:, 0].reshape(shape)


def unproject_to_surface(
    camera: Cameras, prior: Float[Tensor, "3 h w"], uv_px: Float[Tensor, "P 2"]
) -> Float[Tensor, "P 3"]:
    """Surface points at pixels of one camera; beyond the image they are those at its border."""
    uv = torch.minimum(uv_px.clamp(min=0), camera.size_px[0].to(uv_px))[None]
    expected, near, far = read_prior(prior[None], uv)
    inverse = torch.where(expected.isnan(), (near + far) / 2, expected)
    return (camera.position_world[:, None] + camera.directions_world(uv) / inverse[..., None])[0]


class DepthPriors:
    """What a scene's sparse points say of every camera's surface, made when first asked for.

    Args:
        scene: whose cameras.
        observed: points that are told as observed; the scene's own if not given.
    """

    def __init__(self, scene: Scene, observed: SparsePoints | None = None) -> None:
        self.scene, self.points = scene, observed or scene.points
        self._priors: dict[int, Tensor] = {}
        self._observed: dict[int, Observed] = {}

    def __getitem__(self, index: int) -> Float[Tensor, "3 h w"]:
        if index not in self._priors:
            cameras = self.scene.cameras
            self._priors[index] = surface_prior(cameras[index], self.scene.points, cameras, self.scene.hull)
        return self._priors[index]

    def observed(self, index: int) -> Observed:
        """The sparse points that one photograph observed."""
        if index not in self._observed:
            self._observed[index] = observed_depths(self.scene.cameras[index], self.points, index)
        return self._observed[index]
