"""The feature network (paper, Table 1): ResNet-34's first three stages and a U-Net decoder, shared by all views.

Fully convolutional, any input size. No max pooling: the first residual stage strides instead. With widths (64, 64, 128,
256), blocks (3, 4, 6) and instance norms it is Table 1 as printed, whose output has a quarter of the resolution.
Finer outputs, which Table 1 does not have, continue the decoder in the same way: x2, 3x3 conv on the skip.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.config import EncoderConfig


class Encoder(nn.Module):
    """Table 1 and its finer continuation.

    Args:
        config: widths, blocks and norms.
        outputs: (stride, channels) of each output; strides 4, 2 and 1 are possible.
        aligned: the decoder returns features to where they were computed (docs/method.md, section 2).
    """

    def __init__(self, config: EncoderConfig, outputs: tuple[tuple[int, int], ...], aligned: bool = True) -> None:
        super().__init__()
        w0, w1, w2, w3 = config.widths
        norm = config.instance_norm
        self.strides = tuple(stride for stride, _ in outputs)
        self.stem = _ConvNorm(3, w0, 7, 2, norm)
        self.stages = nn.ModuleList(
            _stage(i, o, n, norm) for i, o, n in zip((w0, w1, w2), (w1, w2, w3), config.blocks, strict=True)
        )
        # Skips at strides 8 and 4 (layers 3 and 2 of Table 1), then, for finer outputs, 2 (layer 1) and 1 (the input).
        channels, skips = (w3, w2, w1, w0, min(w0, 8)), (w2, w1, w0, 3)
        steps = 2 + sum(min(self.strides) < stride for stride in (4, 2))
        self.up = nn.ModuleList(_Up(channels[k], skips[k], channels[k + 1], norm, aligned) for k in range(steps))
        at_stride = {4: w1, 2: w0, 1: min(w0, 8)}
        self.out = nn.ModuleList(nn.Conv2d(at_stride[s], c, 1) for s, c in outputs)

    def forward(self, images: Float[Tensor, "K 3 H W"]) -> tuple[Float[Tensor, "K _ _ _"], ...]:
        """One map per configured output; an H x W image gives ceil(H / stride) x ceil(W / stride).

        Args:
            images: colours in [0, 1], at the common exposure.
        """
        # Channels last is what CPUs and GPUs convolve fastest.
        x = (images - 0.5).contiguous(memory_format=torch.channels_last)
        skips = [x, F.relu(self.stem(x))]
        for stage in self.stages:
            skips.append(stage(skips[-1]))
        x, maps = skips.pop(), {}
        for up, stride in zip(self.up, (8, 4, 2, 1), strict=False):
            x = maps[stride] = up(x, skips.pop())
        return tuple(out(maps[stride]) for stride, out in zip(self.strides, self.out, strict=True))


class _ConvNorm(nn.Sequential):
    def __init__(self, inputs: int, outputs: int, size: int, stride: int, norm: bool) -> None:
        conv = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=not norm)
        super().__init__(conv, nn.InstanceNorm2d(outputs, affine=True) if norm else nn.Identity())


class _Block(nn.Module):
    """ResNet's basic block: two 3x3 convolutions and a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int, norm: bool) -> None:
        super().__init__()
        self.first = _ConvNorm(inputs, outputs, 3, stride, norm)
        self.second = _ConvNorm(outputs, outputs, 3, 1, norm)
        same = stride == 1 and inputs == outputs
        self.shortcut = nn.Identity() if same else _ConvNorm(inputs, outputs, 1, stride, norm)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.second(F.relu(self.first(x))) + self.shortcut(x))


def _stage(inputs: int, outputs: int, blocks: int, norm: bool) -> nn.Sequential:
    """Basic blocks, the first of which halves the resolution."""
    first = _Block(inputs, outputs, 2, norm)
    return nn.Sequential(first, *(_Block(outputs, outputs, 1, norm) for _ in range(blocks - 1)))


def double(maps: Float[Tensor, "K C h w"]) -> Float[Tensor, "K C H W"]:
    """Maps with twice as many texels: every second one is a texel of `maps`, the others lie halfway between.

    A convolution with stride 2 centres its texel k on texel 2 k of what it read, so that is where it must return to.
    `F.interpolate` would place it half a texel further, and neighbours flown the other way would be displaced the
    other way.
    """
    height, width = maps.shape[-2:]
    between = F.interpolate(maps, size=(2 * height - 1, 2 * width - 1), mode="bilinear", align_corners=True)
    return F.pad(between, (0, 1, 0, 1), mode="replicate")


class _Up(nn.Module):
    """3x3 upconv x2, then a 3x3 convolution on [skip, upsampled] (layers 6-7 and 8-9 of Table 1)."""

    def __init__(self, inputs: int, skip: int, outputs: int, norm: bool, aligned: bool) -> None:
        super().__init__()
        self.aligned = aligned
        self.widen = _ConvNorm(inputs, outputs, 3, 1, norm)
        self.merge = _ConvNorm(skip + outputs, outputs, 3, 1, norm)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        # By 2 exactly, then cut: an odd size was rounded up on the way down, and fitting it would shift features.
        x = double(x) if self.aligned else F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
        x = x[..., : skip.shape[-2], : skip.shape[-1]]
        return F.relu(self.merge(torch.cat([skip, F.relu(self.widen(x))], dim=1)))
