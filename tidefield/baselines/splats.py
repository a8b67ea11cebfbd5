"""Gaussian splats: read those that another program trained, and render them.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (2023), after the EWA splatting of Zwicker
et al. (2001). In PyTorch, tile by tile.

Alphabet: G Gaussians, K harmonics, P pixels of a tile; a Gaussian's alpha is its opacity at a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.data.ply import read_vertices
from tidefield.data.readers.files import LARGEST, in_range, opened
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.model.colour import basis, expand
from tidefield.model.rendering import Rendering
from tidefield.parallel import check_interrupted

DILATION_PX2 = 0.3
"""Added to the variances in the picture: no Gaussian is narrower than about a pixel (Kerbl's `computeCov2D`)."""
LEAST_ALPHA = 1 / 255
"""Less is left out."""
MOST_ALPHA = 0.999
"""gsplat's and OpenSplat's, with which the splats were trained; Kerbl et al. have 0.99."""
LEAST_LIGHT = 1e-4
"""A pixel is done before less light than that would remain."""
WIDEST = 1.3
"""The projection is linearised at most so many half pictures from the middle (Kerbl's `computeCov2D`)."""
NEAR = 0.01
"""Gaussians nearer than this share of the camera's nearest depth are left out: the linearisation fails there."""
TILE_PX = 16
AT_ONCE = 2048
"""Gaussians of a tile that are blended at once, which bounds the memory."""
_MEGABYTES = 2_000
_HARMONICS = {0: 1, 9: 4, 24: 9, 45: 16}
"""K by the number of columns f_rest_*."""


@dataclass(frozen=True)
class Splats:
    """G Gaussians.

    Attributes:
        mean_world: centres.
        axes_world: columns are the principal axes, as long as the standard deviation along them.
        opacity: at the centre, in (0, 1).
        harmonics: of the colour minus 0.5, by the viewing direction in the world.
    """

    mean_world: Float[Tensor, "G 3"]
    axes_world: Float[Tensor, "G 3 3"]
    opacity: Float[Tensor, " G"]
    harmonics: Float[Tensor, "G 3 K"]


def read_splats(path: Path) -> Splats:
    """Read a PLY file of Gaussians in the layout of Kerbl et al., which OpenSplat, gsplat and others write.

    Columns: x, y, z; scale_* are logarithms, opacity is a logit, rot_* a quaternion (w, x, y, z) of any length; f_dc_*
    and f_rest_* are harmonics, the latter channel by channel.

    Raises:
        SceneError: the file is damaged, or holds numbers that are not finite or out of range.
    """
    with opened(path, "Gaussians as OpenSplat writes them; train again", _MEGABYTES):
        vertex = read_vertices(path)
        rest = sum(name.startswith("f_rest_") for name in vertex.dtype.names)
        if rest not in _HARMONICS:
            raise ValueError(f"it has {rest} columns f_rest_*")

        def columns(*names: str) -> Float[np.ndarray, "G n"]:
            values = np.stack([vertex[name] for name in names], axis=-1).astype(np.float32)
            if not in_range(values).all():
                raise ValueError(f"{names[0]} or its like is not finite, or above {LARGEST:g}")
            return values

        mean, opacity = columns("x", "y", "z"), columns("opacity")
        log_scale, rotation = columns(*_numbered("scale_", 3)), columns(*_numbered("rot_", 4))
        length = np.linalg.norm(rotation.astype(np.float64), axis=1, keepdims=True)
        if len(mean) == 0 or (log_scale > math.log(LARGEST)).any() or not (length > 0).all():
            raise ValueError("it has no Gaussian, or one without a size or a rotation")
        middle = columns(*_numbered("f_dc_", 3))[:, :, None]
        others = columns(*_numbered("f_rest_", rest)) if rest else np.zeros((len(mean), 0), np.float32)
        harmonics = np.concatenate([middle, others.reshape(len(mean), 3, rest // 3)], axis=2)
    turn = _rotation_matrices(torch.from_numpy(rotation / length).float())
    return Splats(
        mean_world=torch.from_numpy(mean),
        axes_world=turn * torch.from_numpy(log_scale).exp()[:, None],
        opacity=torch.from_numpy(opacity[:, 0]).sigmoid(),
        harmonics=torch.from_numpy(harmonics),
    )


def _numbered(prefix: str, count: int) -> list[str]:
    return [f"{prefix}{k}" for k in range(count)]


def _rotation_matrices(wxyz: Float[Tensor, "G 4"]) -> Float[Tensor, "G 3 3"]:
    w, x, y, z = wxyz.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


@dataclass(frozen=True)
class _Projected:
    """Gaussians in a camera's picture, front to back.

    Attributes:
        uv_px: centres.
        reach_px: half the width and the height of the box outside of which alpha is below `LEAST_ALPHA`.
        conic: (a, b, c) of the inverse covariance [[a, b], [b, c]].
        opacity: at the centre.
        values: colour, z-depth and 1, which are blended.
    """

    uv_px: Float[Tensor, "G 2"]
    reach_px: Float[Tensor, "G 2"]
    conic: Float[Tensor, "G 3"]
    opacity: Float[Tensor, " G"]
    values: Float[Tensor, "G 5"]

    def __getitem__(self, which: Tensor | slice) -> _Projected:
        return _Projected(
            self.uv_px[which], self.reach_px[which], self.conic[which], self.opacity[which], self.values[which]
        )

    def meeting(self, axis: int, start_px: int) -> _Projected:
        """Those that reach the centre of a pixel of the `TILE_PX` rows or columns from `start_px` on."""
        middle, half = start_px + TILE_PX / 2, (TILE_PX - 1) / 2
        return self[(self.uv_px[:, axis] - middle).abs() <= self.reach_px[:, axis] + half]


@torch.inference_mode()
def render_splats(
    splats: Splats, camera: Cameras, background_rgb: tuple[float, float, float], device: torch.device
) -> Rendering:
    """Render the view of one camera, on a background; where nothing is, the depth is the camera's farthest."""
    width, height = camera.width, camera.height
    found = _project(splats, camera, device)
    # The last tiles may lie partly outside the picture.
    picture = torch.zeros(-(-height // TILE_PX) * TILE_PX, -(-width // TILE_PX) * TILE_PX, 5)
    corner_px = pixel_grid(TILE_PX, TILE_PX, device)
    for top in range(0, height, TILE_PX):
        row = found.meeting(1, top)
        for left in range(0, width, TILE_PX):
            check_interrupted()
            blended = _blend(row.meeting(0, left), corner_px + corner_px.new_tensor([left, top]))
            picture[top : top + TILE_PX, left : left + TILE_PX] = blended.reshape(TILE_PX, TILE_PX, 5).cpu()
    colour, depth, opacity = picture[:height, :width].split([3, 1, 1], dim=-1)
    colour = colour + (1 - opacity) * torch.tensor(background_rgb)
    depth = torch.where(opacity > 0, depth / opacity.clamp(min=LEAST_ALPHA / 2), camera.near_far[0, 1].cpu())
    return Rendering(colour.clamp(0, 1), depth[..., 0], opacity[..., 0].clamp(0, 1))


def _project(splats: Splats, camera: Cameras, device: torch.device) -> _Projected:
    """Project Gaussians into the picture (Kerbl et al., eq. 5), in float64: squares of sizes exceed float32."""
    camera = camera.to("cpu")
    pose, focal = camera.T_world_camera[0].double(), camera.focal_px[0].double()
    xyz = (splats.mean_world.double() - pose[:, 3]) @ pose[:, :3]
    kept = (xyz[:, 2] > NEAR * camera.near_far[0, 0]) & (splats.opacity > LEAST_ALPHA)
    kept = kept.nonzero()[:, 0]
    kept = kept[xyz[kept, 2].argsort(stable=True)]
    xyz, opacity, z = xyz[kept], splats.opacity[kept], xyz[kept, 2:]
    # The Jacobian of the projection, in the middle or so far from it as pictures are wide, times the axes.
    most = WIDEST * camera.size_px[0] / (2 * focal)
    slope = (xyz[:, :2] / z).clamp(-most, most)
    axes = pose[:, :3].T @ splats.axes_world[kept].double()
    spread_px = (focal / z)[..., None] * (axes[:, :2] - slope[..., None] * axes[:, 2:])
    variance = spread_px.square().sum(2) + DILATION_PX2
    across = spread_px.prod(1).sum(1)
    # |a|^2 |b|^2 - (a b)^2 = |a x b|^2: the difference would be lost to rounding where a Gaussian is long and thin.
    area = torch.linalg.cross(spread_px[:, 0], spread_px[:, 1]).square().sum(1)
    determinant = area + DILATION_PX2 * (variance.sum(1) - DILATION_PX2)
    conic = torch.stack([variance[:, 1], -across, variance[:, 0]], dim=-1) / determinant[:, None]
    reach = (2 * (opacity.double() / LEAST_ALPHA).log()[:, None] * variance).sqrt()
    uv = focal * xyz[:, :2] / z + camera.principal_px[0]
    directions = torch.nn.functional.normalize(splats.mean_world[kept] - pose[:, 3].float(), dim=-1)
    harmonics = splats.harmonics[kept]
    colour = (0.5 + expand(harmonics, basis(directions, math.isqrt(harmonics.shape[2]) - 1))).clamp(min=0)
    values = torch.cat([colour, z.float(), torch.ones_like(z).float()], dim=1)
    parts = (uv, reach, conic, opacity, values)
    return _Projected(*(part.float().to(device) for part in parts))


def _blend(tile: _Projected, uv_px: Float[Tensor, "P 2"]) -> Float[Tensor, "P 5"]:
    """Blend the values of a tile's Gaussians at its pixels, front to back (Kerbl et al., eq. 3)."""
    light = uv_px.new_ones(len(uv_px))
    total = uv_px.new_zeros(len(uv_px), 5)
    for start in range(0, len(tile.uv_px), AT_ONCE):
        part = tile[slice(start, start + AT_ONCE)]
        x, y = (uv_px - part.uv_px[:, None]).unbind(-1)
        a, b, c = part.conic[:, :, None].unbind(1)
        exponent = (0.5 * (a * x * x + c * y * y) + b * x * y).clamp(min=0)  # below by rounding
        alpha = (part.opacity[:, None] * torch.exp(-exponent)).clamp(max=MOST_ALPHA)
        alpha = torch.where(alpha < LEAST_ALPHA, 0.0, alpha)
        after = light * (1 - alpha).cumprod(0)
        before = torch.cat([light[None], after[:-1]])
        # The light only decreases: the first Gaussian that would leave too little ends the pixel.
        total += torch.where(after < LEAST_LIGHT, 0.0, alpha * before).T @ part.values
        light = after[-1]
        if (light < LEAST_LIGHT).all():
            break
    return total
