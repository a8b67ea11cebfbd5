"""The one seam of the program: `render(camera) -> Rendering`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tidefield.geometry.cameras import Cameras


@dataclass(frozen=True)
class Rendering:
    """What a camera sees.

    Attributes:
        colour: in [0, 1], display-referred like the photographs, at the camera's own gain.
        depth: expected z-depth (along the camera's +z), world units.
        opacity: share of the light that the scene stopped, in [0, 1].
    """

    colour: Float[Tensor, "H W 3"]
    depth: Float[Tensor, "H W"]
    opacity: Float[Tensor, "H W"]


def to_8_bit(colour: Float[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
    """Colours in [0, 1], clipped and rounded to 0..255."""
    return (colour.detach().float().clamp(0, 1) * 255).round().to(torch.uint8)


Render = Callable[[Cameras], Rendering]
"""A method that makes views: takes one camera (a `Cameras` of length 1), returns the view of its full size."""
