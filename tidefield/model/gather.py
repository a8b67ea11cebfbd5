"""Reading feature maps at projected samples (method.md, section 3).

A map's texels lie in memory as rows of channels, so a read is a weighted sum of a few rows: `embedding_bag`, which is
several times faster than `grid_sample` for more than a few channels, on CPUs and GPUs alike.

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


def joined(maps: list[FeatureMaps]) -> FeatureMaps:
    """Maps of several sizes as one set."""
    offsets = torch.tensor([0, *(len(m.rows) for m in maps[:-1])], device=maps[0].rows.device).cumsum(0)
    return FeatureMaps(
        rows=torch.cat([m.rows for m in maps]),
        first=torch.cat([m.first + o for m, o in zip(maps, offsets, strict=True)]),
        size=torch.cat([m.size for m in maps]),
        origin_px=torch.cat([m.origin_px for m in maps]),
        stride=maps[0].stride,
    )


def gather(
    maps: FeatureMaps, which: Int[Tensor, "T N"], uv_px: Float[Tensor, "T N P 2"], cubic: bool = False
) -> tuple[Float[Tensor, "T N P C"], Bool[Tensor, "T N P"]]:
    """Values of map `which[t, n]` at pixels, and whether the pixel lies on the map.

    Beyond the outermost texels' centres the border is continued; "on the map" reaches half a stride beyond them.

    Args:
        cubic: interpolate by cubic convolution of 4 x 4 texels instead of bilinearly of 2 x 2.
    """
    size = maps.size[which][:, :, None]
    place = (uv_px - maps.origin_px[which][:, :, None]) / maps.stride
    inside = ((place >= -0.5) & (place <= size - 0.5)).all(-1)
    # NaN or huge places of invalid points must still index something.
    place = torch.where(inside[..., None], place, torch.zeros_like(place))
    corner = place.floor()
    share = _cubic(place - corner) if cubic else torch.stack([1 - (place - corner), place - corner], dim=-1)
    taps = share.shape[-1]
    cell = corner.long()[..., None] + (torch.arange(taps, device=place.device) - (taps // 2 - 1))
    column, row = torch.minimum(cell.clamp(min=0), size[..., None] - 1).unbind(-2)
    first = (maps.first[which][:, :, None, None] + row * size[..., :1])[..., :, None]
    indices = (first + column[..., None, :]).reshape(-1, taps * taps)
    shares = (share[..., 1, :, None] * share[..., 0, None, :]).reshape(-1, taps * taps)
    values = weighted_rows(maps.rows, indices, shares.to(maps.rows.dtype))
    values = values.float() if values.dtype == torch.float16 else values
    return values.reshape(*uv_px.shape[:-1], -1), inside


def _cubic(part: Float[Tensor, "*B"]) -> Float[Tensor, "*B 4"]:
    """Weights of the texels at -1, 0, 1 and 2 for a place between 0 and 1.

    Keys, Cubic convolution interpolation for digital image processing, 1981, eq. 15 (a = -1/2).
    """
    distance = torch.stack([1 + part, part, 1 - part, 2 - part], dim=-1)
    near = (1.5 * distance - 2.5) * distance.square() + 1
    far = ((-0.5 * distance + 2.5) * distance - 4) * distance + 2
    return torch.where(distance <= 1, near, far)


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
