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

from tidefield.device import fuses


@dataclass(frozen=True)
class FeatureMaps:
    """K maps of features, of any sizes, one after the other.

    Attributes:
        rows: the texels of all maps, each map row by row; single or half precision.
        first: index in `rows` of each map's first texel.
        size: (width, height) of each map, texels.
        origin_px: pixel of the photograph at which each map's first texel is centred.
        stride: pixels between texels; 1/2 where there are twice as many.
    """

    rows: Float[Tensor, "Q C"]
    first: Int[Tensor, " K"]
    size: Int[Tensor, "K 2"]
    origin_px: Float[Tensor, "K 2"]
    stride: int | float


def maps_from_images(
    images: Float[Tensor, "K C h w"], corner_px: Float[Tensor, "K 2"], stride: int | float
) -> FeatureMaps:
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


def doubled(images: Float[Tensor, "K C h w"]) -> Float[Tensor, "K C H W"]:
    """Images with a texel every half pixel: every second is one of the image's, the others lie between.

    By cubic convolution (Keys, Cubic convolution interpolation for digital image processing, 1981, eq. 15 with a =
    -1/2, halfway). What is read bilinearly from the result hardly differs from what 4 x 4 texels of the images would
    give, at a quarter of the reads.
    """
    for dim in (2, 3):
        ends = [images.narrow(dim, at, 1) for at in (0, -1)]
        padded = torch.cat([ends[0], images, ends[1], ends[1]], dim)
        size = images.shape[dim]
        outer = padded.narrow(dim, 0, size) + padded.narrow(dim, 3, size)
        inner = images + padded.narrow(dim, 2, size)
        between = (9 * inner - outer) / 16
        images = torch.stack([images, between], dim + 1).flatten(dim, dim + 1)
    return images


def gather(
    maps: FeatureMaps, which: Int[Tensor, "T N"], uv_px: Float[Tensor, "T N P 2"]
) -> tuple[Float[Tensor, "T N P C"], Bool[Tensor, "T N P"]]:
    """Bilinearly interpolated values of map `which[t, n]` at pixels, and whether the pixel lies on the map.

    Beyond the outermost texels' centres the border is continued; "on the map" reaches half a stride beyond them, and
    half a pixel at least.
    """
    if fuses(uv_px):
        from tidefield.model import fused

        own = (maps.first[which].flatten(), maps.size[which].flatten(0, 1), maps.origin_px[which].flatten(0, 1))
        read, there = fused.read(maps.rows, *own, maps.stride, uv_px.flatten(0, 1))
        return read.unflatten(0, which.shape), there.unflatten(0, which.shape)
    size = maps.size[which][:, :, None]
    place = (uv_px - maps.origin_px[which][:, :, None]) / maps.stride
    reach = max(0.5, 0.5 / maps.stride)
    inside = ((place >= -reach) & (place <= size - reach)).all(-1)
    # NaN or huge places of invalid points must still index something.
    place = torch.where(inside[..., None], place, torch.zeros_like(place))
    corner = place.floor()
    right, below = (place - corner).unbind(-1)
    left, above = 1 - right, 1 - below
    low = corner.int()
    last = (size - 1).int()
    high = torch.minimum(low + 1, last)
    low = torch.minimum(low.clamp(min=0), last)
    first, width = maps.first[which][:, :, None].int(), size[..., 0].int()
    upper, lower = first + low[..., 1] * width, first + high[..., 1] * width
    columns = low[..., 0], high[..., 0]
    indices = torch.stack([row + column for row in (upper, lower) for column in columns], dim=-1)
    shares = torch.stack([row * column for row in (above, below) for column in (left, right)], dim=-1)
    values = weighted_rows(maps.rows, indices.reshape(-1, 4), shares.reshape(-1, 4).to(maps.rows.dtype))
    values = values.float() if values.dtype == torch.float16 else values
    return values.reshape(*uv_px.shape[:-1], -1), inside


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
        return result.scatter_add_(0, index.reshape(-1, 1).long().expand_as(spread), spread), None, None
