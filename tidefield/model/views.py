"""Neighbouring views of a batch of tiles, read at samples: projection and interpolation (docs/method.md, section 3).

The texels of a map lie in memory as rows of channels, so a read is a weighted sum of a few rows: `embedding_bag`, which
is several times faster than `grid_sample` for more than a few channels, on CPUs and GPUs alike.

Alphabet: T tiles, N views, K maps, Q texels of all maps together, P samples of a tile, C channels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.neighbours import from_border
from tidefield.geometry.cameras import Cameras

FEATHER = 0.02
"""Share of its width over which a view fades towards the border of its frame."""
LEAST_BLEND_WEIGHT = 1e-4
"""Of a view that has faded out: the logarithm enters the blending, and the view must serve where it alone sees."""


@dataclass(frozen=True)
class Gathered:
    """What N views show at P samples.

    Attributes:
        colours: C_i, at the common exposure.
        features: F_i.
        directions: d_i, unit, from each view's camera to the sample.
        cosine: d.d_i with the target's direction.
        valid: whether the sample is in front of the camera, inside the encoded part of the photograph, and not masked.
        blend_weight: above 0, to 1; lets views fade in and out (`data.neighbours`).
        octaves_coarser: how much larger the pixels of the view are there than the target's, in powers of 2.
    """

    colours: Float[Tensor, "T N P 3"]
    features: Float[Tensor, "T N P C"]
    directions: Float[Tensor, "T N P 3"]
    cosine: Float[Tensor, "T N P"]
    valid: Bool[Tensor, "T N P"]
    blend_weight: Float[Tensor, "T N P"]
    octaves_coarser: Float[Tensor, "T N P"]


@dataclass(frozen=True)
class Encoded:
    """Photographs as a network reads them.

    Attributes:
        features: maps by stride.
        photographs: the colours, at stride 1 or 1/2.
        with_colours: strides whose maps begin with three channels of mean colours, at the common exposure.
        used: 1 for pixels that are not masked, at stride 1; None without masks.
    """

    features: dict[int, FeatureMaps]
    photographs: FeatureMaps
    with_colours: frozenset[int] = frozenset()
    used: FeatureMaps | None = None

    @staticmethod
    def concatenate(parts: list[Encoded]) -> Encoded:
        """Join groups of photographs of one size each into one set."""
        features = {stride: concatenate([part.features[stride] for part in parts]) for stride in parts[0].features}
        used = [part.used for part in parts if part.used is not None]
        return Encoded(
            features,
            concatenate([part.photographs for part in parts]),
            parts[0].with_colours,
            concatenate(used) if used else None,
        )

    def masked(self, used: Float[Tensor, "K 1 H W"], corner_px: Float[Tensor, "K 2"]) -> Encoded:
        """Add which pixels of the photographs, or of the crops with these upper left corners, are not masked."""
        return replace(self, used=maps_from_images(used, corner_px, 1))


@dataclass(frozen=True)
class Views:
    """N neighbouring photographs for each of T tiles, encoded: {(I_i, P_i, F_i)} of the paper.

    Attributes:
        cameras: of the T N views, tile by tile.
        which: the map of each view.
        blend_weight: of each view at its tile's corners (`data.neighbours`).
        encoded: all maps.
    """

    cameras: Cameras
    which: Int[Tensor, "T N"]
    blend_weight: Float[Tensor, "T N 4"]
    encoded: Encoded

    def __getitem__(self, tiles: slice) -> Views:
        count = self.which.shape[1]
        first, last, _ = tiles.indices(len(self.which))
        cameras = self.cameras[slice(first * count, last * count)]
        return Views(cameras, self.which[tiles], self.blend_weight[tiles], self.encoded)

    def read(
        self,
        stride: int,
        points_world: Float[Tensor, "T P 3"],
        directions: Float[Tensor, "T P 3"],
        ray_in_tile: Float[Tensor, "T R 2"],
        pixels_per_unit: Float[Tensor, "T P"],
        mean_colours: bool = False,
    ) -> Gathered:
        """Project samples into every view and read features and colours there.

        Args:
            stride: of the feature maps to read.
            points_world: of the samples of R rays, the samples of all rays one after the other.
            directions: d, unit, from the target camera to the samples.
            ray_in_tile: where the rays pass their tile, 0 to 1 from its left and from its top.
            pixels_per_unit: of the target, that a unit of length shows as at the samples.
            mean_colours: take the mean colours of the feature maps instead of the photographs' own, in one read.
        """
        tiles, count = self.which.shape
        # One product for all views of a tile, with all x in memory, then all y, then all z.
        matrix = self.cameras.projection.unflatten(0, (tiles, count)).flatten(1, 2)
        products = torch.baddbmm(matrix[..., 3:], matrix[..., :3], points_world.transpose(1, 2))
        homogeneous = products.unflatten(1, (count, 3)).transpose(2, 3)
        z = homogeneous[..., 2:]
        front = z > 1e-6  # points on the camera's plane have no pixel
        uv = self.cameras.displaced((homogeneous[..., :2] / torch.where(front, z, 1.0)).flatten(0, 1))
        uv = uv.unflatten(0, (tiles, count))
        size = self.cameras.size_px.reshape(tiles, count, 1, 2)
        inside = front[..., 0] & (uv >= 0).all(-1) & (uv <= size).all(-1)
        values, on_map = gather(self.encoded.features[stride], self.which, uv)
        features = values[..., 3:] if stride in self.encoded.with_colours else values
        if mean_colours:
            assert stride in self.encoded.with_colours, f"maps of stride {stride} hold no colours"
            colours = values[..., :3]
        else:
            colours, on_map = gather(self.encoded.photographs, self.which, uv)
        if self.encoded.used is not None:
            # A masked pixel is read as little as one outside of the photograph.
            used, _ = gather(self.encoded.used, self.which, uv)
            on_map = on_map & (used[..., 0] > 0.5)
        offset = points_world[:, None] - self.cameras.position_world.reshape(tiles, count, 1, 3)
        # The floor keeps the direction of a point in the camera's centre finite.
        view_directions = offset * offset.square().sum(-1, keepdim=True).clamp(min=1e-18).rsqrt()
        return Gathered(
            colours=colours,
            features=features,
            directions=view_directions,
            cosine=(view_directions * directions[:, None]).sum(-1),
            valid=inside & on_map,
            blend_weight=self._blend_weight(ray_in_tile, points_world.shape[1], from_border(uv, size, FEATHER)),
            octaves_coarser=self._octaves_coarser(z[..., 0], pixels_per_unit),
        )

    def _octaves_coarser(
        self, z: Float[Tensor, "T N P"], pixels_per_unit: Float[Tensor, "T P"]
    ) -> Float[Tensor, "T N P"]:
        """How much larger the views' pixels are than the target's; limited to two octaves either way."""
        focal = self.cameras.focal_px.mean(1).reshape(*self.which.shape, 1)
        return torch.log2((z * pixels_per_unit[:, None] / focal).clamp(0.25, 4.0))

    def _blend_weight(
        self, ray_in_tile: Float[Tensor, "T R 2"], samples: int, border: Float[Tensor, "T N P"]
    ) -> Float[Tensor, "T N P"]:
        """Each view's weight at every sample: interpolated between the tile's corners, times the fade at the border."""
        right, below = (x[:, None] for x in ray_in_tile.unbind(-1))
        rows = self.blend_weight.unflatten(-1, (2, 2)).unbind(2)
        upper, lower = (torch.lerp(row[..., :1], row[..., 1:], right) for row in rows)
        rays = torch.lerp(upper, lower, below).repeat_interleave(samples // ray_in_tile.shape[1], dim=-1)
        return (rays * border).clamp(min=LEAST_BLEND_WEIGHT)


@dataclass(frozen=True)
class FeatureMaps:
    """K maps of features, of any sizes, one after the other.

    Attributes:
        rows: the texels of all maps, each map row by row; single or half precision. Their first C values count; the
            cache's rows have more (`cache.padded_channels`).
        channels: C.
        first: index in `rows` of each map's first texel.
        size: (width, height) of each map, texels.
        origin_px: pixel of the photograph at which each map's first texel is centred.
        stride: pixels between texels; 1/2 where there are twice as many.
    """

    rows: Float[Tensor, "Q _"]
    channels: int
    first: Int[Tensor, " K"]
    size: Int[Tensor, "K 2"]
    origin_px: Float[Tensor, "K 2"]
    stride: int | float


def maps_from_images(
    images: Float[Tensor, "K C h w"], corner_px: Float[Tensor, "K 2"], stride: int | float
) -> FeatureMaps:
    """Maps from images of one size.

    A convolution of odd size with stride s and padding of half its size centres its output (0, 0) at input pixel
    (0, 0), whose centre is half a pixel from the corner: hence the 0.5, whatever the stride.
    """
    count, channels, height, width = images.shape
    device = images.device
    return FeatureMaps(
        rows=images.permute(0, 2, 3, 1).reshape(-1, channels),
        channels=channels,
        first=torch.arange(count, device=device) * (height * width),
        size=_sizes(count, width, height, device),
        origin_px=corner_px + 0.5,
        stride=stride,
    )


def _sizes(count: int, width: int, height: int, device: torch.device) -> Int[Tensor, "K 2"]:
    """Filled in on the device: a copy from the processor cannot be recorded (`recording`)."""
    size = torch.full((count, 2), height, device=device)
    size[:, 0] = width
    return size


def concatenate(maps: list[FeatureMaps]) -> FeatureMaps:
    """Join maps of several sizes into one set."""
    if len(maps) == 1:
        return maps[0]
    offsets = torch.tensor([0, *(len(m.rows) for m in maps[:-1])], device=maps[0].rows.device).cumsum(0)
    return FeatureMaps(
        rows=torch.cat([m.rows for m in maps]),
        channels=maps[0].channels,
        first=torch.cat([m.first + o for m, o in zip(maps, offsets, strict=True)]),
        size=torch.cat([m.size for m in maps]),
        origin_px=torch.cat([m.origin_px for m in maps]),
        stride=maps[0].stride,
    )


def pixel_means(doubled: Float[Tensor, "K C h w"]) -> Float[Tensor, "K C h w"]:
    """Means over the pixels of photographs that were read at twice the size, one every half pixel, as `upsample_twice`.

    What a pixel would show if it lay there: nothing is interpolated, and nothing of the photograph aliases.
    """
    return F.avg_pool2d(F.pad(doubled, (0, 1, 0, 1), mode="replicate"), 2, stride=1)


def upsample_twice(images: Float[Tensor, "K C h w"]) -> Float[Tensor, "K C H W"]:
    """Images with a texel every half pixel: every second one is a pixel of the image, the others lie between.

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
    """Interpolate maps bilinearly: values of map `which[t, n]` at pixels, and whether the pixel lies on the map.

    Beyond the outermost texels' centres the border is continued; "on the map" reaches half a stride beyond them, and
    half a pixel at least.
    """
    size = maps.size[which][:, :, None]
    position = (uv_px - maps.origin_px[which][:, :, None]) / maps.stride
    reach = max(0.5, 0.5 / maps.stride)
    inside = ((position >= -reach) & (position <= size - reach)).all(-1)
    # NaN or huge positions of invalid points must still index something. What is off a coarse map may be on a fine one,
    # and is read from both.
    position = torch.minimum(position.nan_to_num(0.0).clamp(min=-reach), size - reach)
    corner = position.floor()
    later = position - corner
    low = corner.int()
    last = (size - 1).int()
    high = torch.minimum(low + 1, last)
    low = torch.minimum(low.clamp(min=0), last)
    first, width = maps.first[which][:, :, None].int(), size[..., 0].int()
    row_starts = [first + corner[..., 1] * width for corner in (low, high)]
    columns = [corner[..., 0] for corner in (low, high)]
    shares = [1 - later, later]
    index = low.new_empty(*inside.shape, 4)
    share = maps.rows.new_empty(index.shape)
    # In place: to stack the four along the last dimension takes twice as long.
    for k, (y, x) in enumerate(product((0, 1), repeat=2)):
        torch.add(row_starts[y], columns[x], out=index[..., k])
        torch.mul(shares[y][..., 1], shares[x][..., 0], out=share[..., k])
    values = weighted_rows(maps.rows, index.reshape(-1, 4), share.reshape(-1, 4))
    values = values.float() if values.dtype == torch.float16 else values
    return values[:, : maps.channels].reshape(*inside.shape, -1), inside


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
