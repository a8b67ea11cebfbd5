"""Depth priors from sparse points or a visual hull: where a camera's rays are sampled (docs/method.md, section 13)."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.hull import Hull, hull_range
from tidefield.data.scene import Scene, SparsePoints
from tidefield.data.surface import depth_through, trusted_points
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.machine import cores
from tidefield.parallel import SharedValues

STRIDE = 4
"""Pixels between the cells of a prior."""
INTERVAL_POINTS = 12
"""Nearest sparse points in the image whose depths span the interval of a cell."""
MARGIN, SPARSE_MARGIN, SPARSE_DISTANCE = 0.1, 0.5, 0.1
"""Margin of the interval as a share of the image's depth range: the first at a sparse point, growing to the second
where the nearest point is farther than this share of the image width."""
LEAST_MARGIN = 0.01
"""Least margin of the interval around the expected surface, as a share of the depth."""
HULL_DEPTH = 0.1
"""Expected depth of the surface within the hull, as a share of the hull's extent along the ray: the surface touches the
hull or, in concavities, lies behind its front."""


@dataclass(frozen=True)
class Observed:
    """The K sparse points that one photograph observed.

    Attributes:
        uv_px: pixels of the observations.
        inverse_depth: inverse z-depths of the points.
        weight: confidence in (0, 1]: 1/2 where the reprojection error is the scene's median.
    """

    uv_px: Float[Tensor, "K 2"]
    inverse_depth: Float[Tensor, " K"]
    weight: Float[Tensor, " K"]


@dataclass(frozen=True)
class DepthPrior:
    """Where the rays of one camera are searched.

    Attributes:
        cells: expected, nearest and farthest inverse z-depth, on cells of `STRIDE` pixels.
        detail: what the inverse depth of each pixel has beyond the interpolated cells; None where nothing is known.
    """

    cells: Float[Tensor, "3 h w"]
    detail: Float[Tensor, "H W"] | None = None

    @property
    def nbytes(self) -> int:
        return self.cells.nbytes + (0 if self.detail is None else self.detail.nbytes)

    def detail_of_tiles(self, corner_px: Float[Tensor, "T 2"], side_px: int) -> Float[Tensor, "T R"]:
        """Return the detail of the pixels of tiles, row by row; 0 outside of the image."""
        if self.detail is None:
            return self.cells.new_zeros(len(corner_px), side_px**2)
        tiles = self.detail.new_zeros(len(corner_px), side_px, side_px)
        for tile, (u, v) in zip(tiles, corner_px.long().tolist(), strict=True):
            part = self.detail[v : v + side_px, u : u + side_px]
            tile[: part.shape[0], : part.shape[1]] = part
        return tiles.flatten(1)


def surface_prior(
    camera: Cameras, points: SparsePoints | None, cameras: Cameras, hull: Hull | None = None
) -> Float[Tensor, "3 h w"]:
    """Estimate the expected, nearest and farthest inverse z-depth of one camera's pixels, on cells of `STRIDE` pixels.

    The expected surface interpolates the sparse points; the interval spans the nearest points, with a margin that grows
    where they are sparse. A visual hull limits both to where the ray passes it; without points the surface is expected
    near the hull's front, and rays that miss the hull have no expected depth (NaN). Without either, no ray has one, and
    the interval is the camera's near to far.
    """
    width, height = -(-camera.width // STRIDE), -(-camera.height // STRIDE)
    near, far = 1 / camera.near_far[0]
    # The cells of a grid of ceil(W / 4) columns are 4 pixels wide only if the camera is widened to match.
    cells = camera.cropped(width * STRIDE, height * STRIDE).resized(width, height)
    if points is not None:
        prior = _from_points(cells, points, cameras)
    else:
        prior = torch.stack([torch.full_like(near, torch.nan), near, far])[:, None, None].expand(3, height, width)
    return prior if hull is None else _within(prior, *hull_range(cells, hull))


def _within(
    prior: Float[Tensor, "3 h w"], shallow: Float[Tensor, "h w"], deep: Float[Tensor, "h w"], meets: Bool[Tensor, "h w"]
) -> Float[Tensor, "3 h w"]:
    """Limit a prior to the depths at which rays pass the hull; those that miss it are searched in all of their depths.

    Args:
        shallow, deep, meets: from `hull_range`.
    """
    expected, nearest, farthest = prior
    front = torch.where(expected.isnan(), 1 / torch.lerp(shallow, deep, HULL_DEPTH), expected)
    inside = torch.minimum(torch.maximum(front, 1 / deep), 1 / shallow)
    limited = torch.stack(
        [torch.where(meets, inside, torch.nan), torch.minimum(nearest, 1 / shallow), torch.maximum(farthest, 1 / deep)]
    )
    # Points may lie outside of the hull, by which their interval would be empty.
    apart = ~meets | (limited[1] <= limited[2] * (1 + LEAST_MARGIN))
    limited[1:] = torch.where(apart, torch.stack([1 / shallow, 1 / deep]), limited[1:])
    return limited


def _from_points(cells: Cameras, points: SparsePoints, cameras: Cameras) -> Float[Tensor, "3 h w"]:
    """The prior of cells from the sparse points that their camera sees."""
    width, height = cells.width, cells.height
    near, far = 1 / cells.near_far[0]
    uv, inverse = trusted_points(cells, points, cameras)
    expected = 1 / depth_through(cells, uv, inverse)
    if len(uv) < INTERVAL_POINTS:
        lowest, highest = far.expand_as(expected), near.expand_as(expected)
    else:
        from scipy.spatial import KDTree

        pixels = pixel_grid(width, height).double().numpy()
        distance, index = KDTree(uv).query(pixels, k=INTERVAL_POINTS, workers=cores())
        around = inverse[index]
        spread = np.percentile(inverse, 98) - np.percentile(inverse, 2)
        sparse = np.minimum(distance[:, 0] / (SPARSE_DISTANCE * width), 1.0)
        margin = spread * (MARGIN + (SPARSE_MARGIN - MARGIN) * sparse)
        lowest, highest = (
            torch.from_numpy(x.reshape(height, width)).to(expected)
            for x in (around.min(1) - margin, around.max(1) + margin)
        )
    # Within the camera's range and never empty: a camera's range may be narrower than that of its points.
    expected = expected.clamp(far * (1 + LEAST_MARGIN), near / (1 + LEAST_MARGIN))
    highest = torch.maximum(highest, expected * (1 + LEAST_MARGIN)).clamp(max=near)
    lowest = torch.minimum(lowest, expected / (1 + LEAST_MARGIN)).clamp(min=far)
    return torch.stack([expected, highest, lowest])


def read_prior(
    priors: Float[Tensor, "T 3 h w"], uv_px: Float[Tensor, "T R 2"]
) -> tuple[Float[Tensor, "T R"], Float[Tensor, "T R"], Float[Tensor, "T R"]]:
    """Interpolate expected, nearest and farthest inverse depth at pixels; those outside the image read its border."""
    height, width = priors.shape[-2:]
    grid = uv_px / (STRIDE * uv_px.new_tensor([width, height])) * 2 - 1
    values = F.grid_sample(priors, grid[:, :, None], padding_mode="border", align_corners=False)[..., 0]
    expected, near, far = values.unbind(1)
    return expected, near, far


def unproject_to_surface(
    camera: Cameras, prior: Float[Tensor, "3 h w"], uv_px: Float[Tensor, "P 2"]
) -> Float[Tensor, "P 3"]:
    """Find the surface points at pixels of one camera; pixels outside the image read its border."""
    uv = torch.minimum(uv_px.clamp(min=0), camera.size_px[0].to(uv_px))[None]
    expected, near, far = read_prior(prior[None], uv)
    inverse = torch.where(expected.isnan(), (near + far) / 2, expected)
    return (camera.position_world[:, None] + camera.directions_world(uv) / inverse[..., None])[0]


class DepthPriors:
    """The depth priors of a scene's cameras, computed on first use.

    Args:
        scene: of the cameras.
        observed: points for `observed` (the supervision of depth); the scene's own if not given.
        match: finds the surface of a camera from its prior's cells (`matching.Matcher`); None leaves the cells.
        most_bytes: that are kept; what goes is computed again. None keeps all.
    """

    def __init__(
        self,
        scene: Scene,
        observed: SparsePoints | None = None,
        match: Callable[[Cameras, Float[Tensor, "3 h w"]], DepthPrior] | None = None,
        most_bytes: int | None = None,
    ) -> None:
        self.scene, self.points, self.match = scene, observed or scene.points, match
        self._priors: SharedValues[int, DepthPrior] = SharedValues(most_bytes or sys.maxsize, lambda p: p.nbytes)
        self._observed: dict[int, Observed] = {}

    def __getitem__(self, index: int) -> DepthPrior:
        return self._priors.get(index, self._find)

    def _find(self, index: int) -> DepthPrior:
        cameras = self.scene.cameras
        cells = surface_prior(cameras[index], self.scene.points, cameras, self.scene.hull)
        return DepthPrior(cells) if self.match is None else self.match(cameras[index], cells)

    def observed(self, index: int) -> Observed:
        """Return the sparse points in front of a camera that its photograph observed."""
        if index not in self._observed:
            self._observed[index] = self._observe(index)
        return self._observed[index]

    def _observe(self, index: int) -> Observed:
        points = self.points
        if points is None:
            return Observed(torch.zeros(0, 2), torch.zeros(0), torch.zeros(0))
        mine = points.camera_index == index
        which = points.point_index[mine].long()
        z = self.scene.cameras[index].project(points.xyz_world[which])[1][0]
        # Cauchy's weight: a point of three times the median error counts a fifth of one of the median error.
        median = points.error_px.median().clamp(min=1e-6)
        weight = 1 / (1 + (points.error_px[which] / median) ** 2)
        front = z > 0
        return Observed(points.uv_px[mine][front], 1 / z[front], weight[front])
