"""Real spherical harmonics, as the target colour is expanded in them (paper, eqs. 8-10; method.md, section 8).

Alphabet: j degree, m order, (x, y, z) a unit direction with z = cos(theta); index j^2 + j + m.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

HIGHEST_DEGREE = 4


def basis(directions: Float[Tensor, "*B 3"], degree: int) -> Float[Tensor, "*B K"]:
    """Y_j^m of unit directions for all j <= degree: K = (degree + 1)^2 values, eqs. 9 and 10.

    sqrt(2) K cos(m phi) P_j^m for m > 0, sqrt(2) K sin(|m| phi) P_j^|m| for m < 0, K P_j^0 for m = 0, where P carries
    the Condon-Shortley sign. sin(theta)^m cos(m phi) and sin(theta)^m sin(m phi) are the real and imaginary parts of
    (x + i y)^m, so no angle is ever computed and the poles are no special case.

    Args:
        directions: unit vectors; polynomials in them, so gradients are finite everywhere.
        degree: 0 to 4, J of the paper; 3 is its usual value.
    """
    assert 0 <= degree <= HIGHEST_DEGREE, f"degree {degree} is not in 0..{HIGHEST_DEGREE}"
    x, y, z = directions.unbind(-1)
    cos_m, sin_m = [torch.ones_like(x)], [torch.zeros_like(x)]
    for _ in range(degree):
        cos_m.append(x * cos_m[-1] - y * sin_m[-1])
        sin_m.append(x * sin_m[-1] + y * cos_m[len(sin_m) - 1])
    legendre = _legendre_over_sin(z, degree)
    columns = []
    for j in range(degree + 1):
        for m in range(-j, j + 1):
            order = abs(m)
            scale = math.sqrt((2 * j + 1) * math.factorial(j - order) / (4 * math.pi * math.factorial(j + order)))
            turn = cos_m[order] if m >= 0 else sin_m[order]
            columns.append((scale * (math.sqrt(2) if m else 1.0)) * turn * legendre[j, order])
    return torch.stack(columns, dim=-1)


def expand(coefficients: Float[Tensor, "*B 3 K"], basis_values: Float[Tensor, "*B K"]) -> Float[Tensor, "*B 3"]:
    """Colour of eq. 8: sum_jm c_j^m Y_j^m, per channel."""
    return (coefficients * basis_values[..., None, :]).sum(-1)


def _legendre_over_sin(z: Tensor, degree: int) -> dict[tuple[int, int], Tensor]:
    """P_j^m(z) / sin(theta)^m by the usual three-term recurrence in j, with the sign (-1)^m."""
    table = {(0, 0): torch.ones_like(z)}
    for m in range(degree + 1):
        if m:
            table[m, m] = -(2 * m - 1) * table[m - 1, m - 1]
        if m < degree:
            table[m + 1, m] = (2 * m + 1) * z * table[m, m]
        for j in range(m + 2, degree + 1):
            table[j, m] = ((2 * j - 1) * z * table[j - 1, m] - (j + m - 1) * table[j - 2, m]) / (j - m)
    return table
