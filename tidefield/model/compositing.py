"""Volume rendering of the samples of a ray (paper, eqs. 1-4).

Alphabet: R rays, M samples from near to far, sigma densities per unit of length, delta lengths of the samples'
intervals in the same unit, T transmittance up to a sample, w = T (1 - exp(-sigma delta)) what a sample contributes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

LIMIT = 12.0
"""Of logits: beyond it a sample is opaque, or empty, for all that single precision tells."""


def weights(sigma: Float[Tensor, "*R M"], delta: Float[Tensor, "*R M"]) -> Float[Tensor, "*R M"]:
    """w_i = T_i (1 - exp(-sigma_i delta_i)), T_i = exp(-sum_{j<i} sigma_j delta_j), eqs. 3 and 4.

    The last delta may be infinite (what lies behind the last sample): the weights then sum to 1 where its sigma is
    positive.
    """
    # An infinite interval stops all light and what reaches it is known; through exp(-sigma inf) gradients were NaN.
    endless = delta.isinf()
    thickness = sigma * delta.masked_fill(endless, 0.0)
    alpha = torch.where(endless, (sigma > 0).to(sigma), -torch.expm1(-thickness))
    before = torch.cat([torch.zeros_like(thickness[..., :1]), thickness.cumsum(-1)[..., :-1]], dim=-1)
    return torch.exp(-before) * alpha


def surface_shares(score: Float[Tensor, "*R M"], opaque: bool) -> Float[Tensor, "*R M"]:
    """The weights that `surface_logits` aims at: softmax(score), with the score 0 for what lies behind the last sample
    unless nothing does."""
    return torch.softmax(score if opaque else F.pad(score, (0, 1)), dim=-1)[..., : score.shape[-1]]


def surface_logits(score: Float[Tensor, "*R M"], opaque: bool) -> Float[Tensor, "*R M"]:
    """Logits of the opacities 1 - exp(-sigma_i delta_i) with which samples get the weights softmax(score).

    T_i a_i is a softmax's p_i where a_i = p_i / sum_{j>=i} p_j, whose logit is score_i - log sum_{j>i} exp(score_j).
    As 1 - exp(-softplus(x)) = sigmoid(x), it is a bias of a density that is a softplus. A score means the same wherever
    on the ray it stands; were scores such biases themselves, many unlikely samples in front would hide the likely one.

    Args:
        score: of each sample, finite.
        opaque: nothing lies behind the last sample; otherwise what does has the score 0.
    """
    behind = score[..., 1:] if opaque else F.pad(score[..., 1:], (0, 1))
    later = behind.flip(-1).logcumsumexp(-1).flip(-1)
    # The last sample of an opaque ray stops all light whatever its logit.
    return (score - (F.pad(later, (0, 1)) if opaque else later)).clamp(-LIMIT, LIMIT)


def composite(weights: Float[Tensor, "*R M"], values: Float[Tensor, "*R M C"]) -> Float[Tensor, "*R C"]:
    """sum_i w_i c_i of eq. 3, for colours or any other values."""
    return (weights[..., None] * values).sum(-2)
