"""The ray transformer: density from all samples of a ray together (paper, "ray transformation module").

Alphabet: R rays, M samples from near to far, H channels.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

FREQUENCIES = 4
"""Octaves of the positional encoding, from half a period over the ray's range."""
SHORT_RAY = 8
"""Samples of a ray up to which all pairs are written out: PyTorch's attention is made for long sequences, and takes
several times as long for thousands of short ones."""


def positional_encoding(position: Float[Tensor, "*B"]) -> Float[Tensor, "*B 8"]:
    """sin and cos of pi 2^k position.

    A function of the sample's normalised distance between near (0) and far (1), not of its index, so M may change
    between training and rendering (docs/method.md, section 6).
    """
    octaves = position[..., None] * (math.pi * 2.0 ** torch.arange(FREQUENCIES, device=position.device))
    return torch.cat([octaves.sin(), octaves.cos()], dim=-1)


class RayTransformer(nn.Module):
    """Positional encoding and multi-head self-attention over the samples, then a feed-forward layer (pre-norm).

    Samples that no view sees are masked as keys: whatever their features hold, the outputs of the other samples stay
    the same.
    """

    def __init__(self, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.position = nn.Linear(2 * FREQUENCIES, hidden)
        self.before_attention = nn.LayerNorm(hidden)
        self.query_key_value = nn.Linear(hidden, 3 * hidden)
        self.after_attention = nn.Linear(hidden, hidden)
        self.feed_forward = nn.Sequential(
            nn.LayerNorm(hidden), nn.Linear(hidden, 2 * hidden), nn.ReLU(), nn.Linear(2 * hidden, hidden)
        )

    def forward(
        self,
        features: Float[Tensor, "R M H"],
        position: Float[Tensor, "R M"],
        valid: Bool[Tensor, "R M"],
    ) -> Float[Tensor, "R M H"]:
        x = features + self.position(positional_encoding(position))
        qkv = self.query_key_value(self.before_attention(x)).unflatten(-1, (3, self.heads, -1))
        # A ray without any valid sample attends to all: an empty softmax is NaN, and its densities are 0 anyway.
        keys = valid | ~valid.any(-1, keepdim=True)
        attended = attend_short(qkv, keys) if features.shape[1] <= SHORT_RAY else attend(qkv, keys)
        x = x + self.after_attention(attended.flatten(2))
        return x + self.feed_forward(x)


def attend(qkv: Float[Tensor, "R M 3 A D"], keys: Bool[Tensor, "R M"]) -> Float[Tensor, "R M A D"]:
    """Scaled dot-product attention of queries, keys and values of A heads with D channels each."""
    query, key, value = qkv.permute(2, 0, 3, 1, 4)
    return F.scaled_dot_product_attention(query, key, value, attn_mask=keys[:, None, None, :]).transpose(1, 2)


def attend_short(qkv: Float[Tensor, "R M 3 A D"], keys: Bool[Tensor, "R M"]) -> Float[Tensor, "R M A D"]:
    """`attend`, for rays of a few samples."""
    # The rays come last, so that every operation runs along many of them.
    query, key, value = qkv.permute(2, 3, 1, 4, 0).contiguous()
    score = (query[:, :, None] * key[:, None]).sum(3) / math.sqrt(query.shape[2])
    share = score.masked_fill(~keys.T, -math.inf).softmax(2)
    return (share[:, :, :, None] * value[:, None]).sum(2).permute(3, 1, 0, 2)
