"""What no photograph saw: colours are continued from beside it."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def fill_unseen(colour: Float[Tensor, "H W 3"], seen: Bool[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
    """Colours continued smoothly into pixels that no photograph saw; mid-grey if none was seen at all.

    Averages of seen pixels over ever larger blocks until every block has one, then back up (pull-push: Gortler et
    al., The Lumigraph, 1996).
    """
    if seen.all():
        return colour
    if not seen.any():
        return torch.full_like(colour, 0.5)
    weight = seen.to(colour)[None, None]
    blocks = {"kernel_size": 2, "ceil_mode": True, "count_include_pad": False}
    coarse_weight = F.avg_pool2d(weight, **blocks)
    coarse = F.avg_pool2d(colour.permute(2, 0, 1)[None] * weight, **blocks)
    # The floor keeps blocks without a seen pixel finite; they are filled from the next coarser ones.
    coarse = (coarse / coarse_weight.clamp(min=1e-6))[0].permute(1, 2, 0)
    coarse = fill_unseen(coarse, coarse_weight[0, 0] > 0)
    filled = F.interpolate(coarse.permute(2, 0, 1)[None], size=seen.shape, mode="bilinear", align_corners=False)
    return torch.where(seen[..., None], colour, filled[0].permute(1, 2, 0))
