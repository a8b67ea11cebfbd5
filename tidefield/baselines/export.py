"""What other programs are given of a scene: photographs at the common exposure, and the colours of sparse points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8

from tidefield.data.scene import Scene


def exposure_factor(scene: Scene, which: Sequence[int]) -> Float[torch.Tensor, "3"]:
    """The factor, per channel, that keeps these photographs from clipping at the common exposure, shading aside."""
    gain = scene.cameras.gain[list(which)]
    return gain.amin(0).clamp(max=1.0) if scene.background_rgb is None else torch.ones(3)


def at_common_exposure(scene: Scene, index: int, factor: Float[torch.Tensor, "3"]) -> UInt8[np.ndarray, "H W 3"]:
    """A photograph at the common exposure, as all other methods see it, times a factor."""
    colour = scene.photographs[index].float() / scene.cameras[index].gain_of_rows() * factor
    return colour.round().clamp(0, 255).to(torch.uint8).numpy()


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
