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


def positional_encoding(position: Float[Tensor, "*B"]) -> Float[Tensor, "*B 8"]:
    """sin and cos of pi 2^k position.

    A function of the sample's place between near (0) and far (1), not of its index, so M may change between training
    and rendering (method.md, section 6).
    """
    octaves = position[..., None] * (math.pi * 2.0 ** torch.arange(FREQUENCIES, device=position.device))
    return torch.cat([octaves.sin(), octaves.cos()], dim=-1)


class RayTransformer(nn.Module):
    """Positional encoding and multi-head self-attention over the samples, then a feed-forward layer (pre-norm).

    Samples that nothing is known of are masked as keys: whatever their features hold, the other samples' outputs stay
    the same.
    """

    def __init__(self, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.place = nn.Linear(2 * FREQUENCIES, hidden)
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
        rays, samples, hidden = features.shape
        x = features + self.place(positional_encoding(position))
        qkv = self.query_key_value(self.before_attention(x)).reshape(rays, samples, 3, self.heads, hidden // self.heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4)
        # A ray without any valid sample attends to all: an empty softmax is NaN, and its densities are 0 anyway.
        keys = valid | ~valid.any(-1, keepdim=True)
        attended = F.scaled_dot_product_attention(query, key, value, attn_mask=keys[:, None, None, :])
        x = x + self.after_attention(attended.transpose(1, 2).reshape(rays, samples, hidden))
        return x + self.feed_forward(x)
