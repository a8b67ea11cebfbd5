"""What the baselines share: reading photographs at projected points."""

from __future__ import annotations

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from tidefield.data.scene import Scene


def read_photograph(scene: Scene, index: int, uv_px: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
    """Colours of one photograph at pixels inside its frame, bilinear, at the scene's common exposure."""
    photograph = scene.photographs[index]
    height, width = photograph.shape[:2]
    # Only the part that is needed is turned into floats: memory follows the caller's chunk, not the photograph.
    low = (uv_px.amin(0) - 1).long().clamp(min=0)
    left, top = low.tolist()
    right, bottom = (uv_px.amax(0) + 2).long().tolist()
    crop = photograph[top : min(bottom, height), left : min(right, width)].to(uv_px.device)
    size = uv_px.new_tensor([crop.shape[1], crop.shape[0]])
    grid = (uv_px - low) / size * 2 - 1
    colour = F.grid_sample(
        crop.to(uv_px.dtype).permute(2, 0, 1)[None], grid[None, None], padding_mode="border", align_corners=False
    )
    return colour[0, :, 0].T / 255 / scene.cameras.gain[index].to(uv_px)
