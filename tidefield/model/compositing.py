"""Volume rendering of the samples of a ray (paper, eqs. 1-4).

Alphabet: R rays, M samples from near to far, sigma densities per unit of length, delta lengths of the samples'
intervals in the same unit, T transmittance up to a sample, w = T (1 - exp(-sigma delta)) the weight of a sample.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


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


def composite(weights: Float[Tensor, "*R M"], values: Float[Tensor, "*R M C"]) -> Float[Tensor, "*R C"]:
    """sum_i w_i c_i of eq. 3, for colours or any other values."""
    return (weights[..., None] * values).sum(-2)
