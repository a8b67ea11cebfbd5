"""What other programs are given of a scene: photographs at the common exposure, pinholes, colours of sparse points."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, UInt8

from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.lenses import Lens


def exposure_factor(cameras: Cameras) -> Float[torch.Tensor, "3"]:
    """The factor, per channel, that keeps photographs from clipping at the common exposure: their least gain times
    shading, at most 1."""
    least = [cameras[index].gain_of_rows().amin((0, 1)) for index in range(len(cameras))]
    return torch.stack(least).amin(0).clamp(max=1.0)


def at_common_exposure(
    scene: Scene, index: int, factor: Float[torch.Tensor, "3"], *, with_alpha: bool = False
) -> UInt8[np.ndarray, "H W C"]:
    """A photograph at the common exposure, as all other methods see it, times a factor.

    Args:
        with_alpha: as RGBA, with the colours before they were composited, where the scene has a background.
    """
    colour, more = scene.photographs[index].float(), []
    if with_alpha and scene.background_rgb is not None:
        colour, alpha = _straight(scene, index)
        more = [255 * alpha]
    colour = colour / scene.cameras[index].gain_of_rows() * factor
    return torch.cat([colour, *more], dim=-1).round().clamp(0, 255).to(torch.uint8).numpy()


def _straight(scene: Scene, index: int) -> tuple[Float[torch.Tensor, "H W 3"], Float[torch.Tensor, "H W 1"]]:
    """Colours of a photograph, 0 to 255, before they were composited, and alpha, 0 to 1; black where that is 0."""
    colour, alpha = scene.photographs[index].float(), scene.photographs.alpha(index)
    if alpha is None or scene.background_rgb is None:
        return colour, torch.ones_like(colour[..., :1])
    opacity = alpha[..., None].float() / 255
    own = colour - (1 - opacity) * 255 * torch.tensor(scene.background_rgb)
    return torch.where(opacity > 0, own / opacity.clamp(min=1 / 255), 0.0), opacity


def pinholes(cameras: Cameras) -> list[Lens]:
    """The lenses of undistorted photographs."""
    columns = torch.cat([cameras.size_px, cameras.focal_px, cameras.principal_px], dim=1).tolist()
    return [Lens(round(w), round(h), fx=fx, fy=fy, cx=cx, cy=cy) for w, h, fx, fy, cx, cy in columns]


def point_colours(scene: Scene, factor: Float[torch.Tensor, "3"]) -> UInt8[np.ndarray, "P 3"]:
    """Sample each sparse point's colour in the first training photograph that shows it, at the common exposure times a
    factor; grey where none does."""
    points = scene.points
    if points is None:
        return np.zeros((0, 3), dtype=np.uint8)
    rgb = np.full((len(points.xyz_world), 3), 128, dtype=np.uint8)
    for index in reversed(scene.train):
        mine = points.camera_index == index
        photograph = at_common_exposure(scene, index, factor)
        u, v = points.uv_px[mine].floor().long().unbind(-1)
        inside = (u >= 0) & (v >= 0) & (u < photograph.shape[1]) & (v < photograph.shape[0])
        rgb[points.point_index[mine][inside].numpy()] = photograph[v[inside], u[inside]]
    return rgb
