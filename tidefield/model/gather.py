"""Reading feature maps at projected samples (method.md, section 3).

A map's texels lie in memory as rows of channels, so a bilinear read is a weighted sum of four rows: `embedding_bag`,
which is several times faster than `grid_sample` for more than a few channels, on CPUs and GPUs alike.

Alphabet: K maps, Q texels of all maps together, T tiles, N views, P samples, C channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F


@dataclass(frozen=True)
class FeatureMaps:
    """K maps of features, of any sizes, one after the other.

    Attributes:
        rows: the texels of all maps, each map row by row; single or half precision.
        first: index in `rows` of each map's first texel.
        size: (width, height) of each map, texels.
        origin_px: pixel of the photograph at which each map's first texel is centred.
        stride: pixels between texels.
    """

    rows: Float[Tensor, "Q C"]
    first: Int[Tensor, " K"]
    size: Int[Tensor, "K 2"]
    origin_px: Float[Tensor, "K 2"]
    stride: int


def maps_from_images(images: Float[Tensor, "K C h w"], corner_px: Float[Tensor, "K 2"], stride: int) -> FeatureMaps:
    """Maps of one size.

    A convolution of odd size with stride s and padding of half its size centres its output (0, 0) at input pixel
    (0, 0), whose centre is half a pixel from the corner: hence the 0.5, whatever the stride.
    """
    count, channels, height, width = images.shape
    device = images.device
    return FeatureMaps(
        rows=images.permute(0, 2, 3, 1).reshape(-1, channels),
        first=torch.arange(count, device=device) * (height * width),
        size=torch.tensor([width, height], device=device).expand(count, 2),
        origin_px=corner_px + 0.5,
        stride=stride,
    )


def gather(
    maps: FeatureMaps, which: Int[Tensor, "T N"], uv_px: Float[Tensor, "T N P 2"]
) -> tuple[Float[Tensor, "T N P C"], Bool[Tensor, "T N P"]]:
    """Bilinear values of map `which[t, n]` at pixels, and whether the pixel lies on the map.

    Beyond the outermost texels' centres the border is continued; "on the map" reaches half a stride beyond them.
    """
    size = maps.size[which][:, :, None]
    place = (uv_px - maps.origin_px[which][:, :, None]) / maps.stride
    inside = ((place >= -0.5) & (place <= size - 0.5)).all(-1)
    # NaN or huge places of invalid points must still index something.
    place = torch.where(inside[..., None], place, torch.zeros_like(place))
    place = torch.minimum(place.clamp(min=0), (size - 1).to(place))
    corner = torch.minimum(place.floor(), (size - 2).clamp(min=0).to(place))
    fx, fy = (place - corner).unbind(-1)
    column, row = corner.long().unbind(-1)
    width = size[..., 0]
    index = maps.first[which][:, :, None] + row * width + column
    # A map one texel wide or high has no second column or row.
    right = (width > 1).long()
    below = torch.where(size[..., 1] > 1, width, 0)
    indices = torch.stack([index, index + right, index + below, index + below + right], dim=-1)
    share = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], dim=-1)
    values = weighted_rows(maps.rows, indices.reshape(-1, 4), share.reshape(-1, 4).to(maps.rows.dtype))
    return values.float().reshape(*uv_px.shape[:-1], -1), inside


def weighted_rows(
    rows: Float[Tensor, "Q C"], index: Int[Tensor, "S B"], share: Float[Tensor, "S B"]
) -> Float[Tensor, "S C"]:
    """sum_b share[s, b] rows[index[s, b]]; differentiable in `rows` only, as sample positions are not learned."""
    return _WeightedRows.apply(rows, index, share)  # type: ignore[no-any-return]


class _WeightedRows(torch.autograd.Function):
    """`embedding_bag` would do alone, but its own backward is several times slower than one `scatter_add`."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, index: Tensor, share: Tensor) -> Tensor:
        ctx.save_for_backward(index, share)
        ctx.shape = rows.shape
        return F.embedding_bag(index, rows, per_sample_weights=share, mode="sum")

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, None, None]:
        index, share = ctx.saved_tensors
        (grad,) = grads
        spread = (grad[:, None] * share[..., None]).reshape(-1, grad.shape[-1])
        result = torch.zeros(ctx.shape, dtype=grad.dtype, device=grad.device)
        return result.scatter_add_(0, index.reshape(-1, 1).expand_as(spread), spread), None, None
