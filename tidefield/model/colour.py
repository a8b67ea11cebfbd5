"""Colour of a sample: spherical harmonics (paper, eqs. 8-10) blended with the neighbours' colours (eq. 7).

Alphabet: T tiles, N views, P samples of a tile, H hidden channels, j degree, m order, (x, y, z) a unit direction with
z = cos(theta); Y_j^m has the index j^2 + j + m.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.model.aggregate import Evidence, weighted_sum
from tidefield.model.views import Gathered

HIGHEST_DEGREE = 4


def basis(directions: Float[Tensor, "*B 3"], degree: int) -> Float[Tensor, "*B K"]:
    """Y_j^m of unit directions for all j <= degree: K = (degree + 1)^2 values, eqs. 9 and 10.

    sqrt(2) K cos(m phi) P_j^m for m > 0, sqrt(2) K sin(|m| phi) P_j^|m| for m < 0, K P_j^0 for m = 0, where P carries
    the Condon-Shortley sign. sin(theta)^m cos(m phi) and sin(theta)^m sin(m phi) are the real and imaginary parts of
    (x + i y)^m, so no angle is ever computed and the poles are no special case.

    Args:
        directions: unit vectors; the values are polynomials in them, so gradients are finite everywhere.
        degree: J of the paper, 0 to 4; 3 is its usual value.
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
            azimuth = cos_m[order] if m >= 0 else sin_m[order]
            columns.append((scale * (math.sqrt(2) if m else 1.0)) * azimuth * legendre[j, order])
    return torch.stack(columns, dim=-1)


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


def expand(coefficients: Float[Tensor, "*B 3 K"], basis_values: Float[Tensor, "*B K"]) -> Float[Tensor, "*B 3"]:
    """Colour of eq. 8: sum_jm c_j^m Y_j^m, per channel."""
    return (coefficients * basis_values[..., None, :]).sum(-1)


def blend_neighbours(logits: Float[Tensor, "T N P"], gathered: Gathered) -> Float[Tensor, "T P 3"]:
    """Eq. 7 over the neighbours alone; middle grey where none sees the sample."""
    # Where no view is valid the softmax is of nothing.
    share = torch.softmax(logits.masked_fill(~gathered.valid, -torch.inf), dim=1).nan_to_num()
    return torch.where(gathered.valid.any(1)[..., None], weighted_sum(gathered.colours, share), 0.5)


def blend(
    logits: Float[Tensor, "T N P"],
    target_logit: Float[Tensor, "T P"],
    target: Float[Tensor, "T P 3"],
    colours: Float[Tensor, "T N P 3"],
) -> Float[Tensor, "T P 3"]:
    """Eq. 7: c = sum_i C_i exp(w_ci) / sum_j exp(w_cj) over the neighbours' colours and the target's own."""
    share = torch.softmax(torch.cat([logits, target_logit[:, None]], dim=1), dim=1)
    return weighted_sum(colours, share[:, :-1]) + share[:, -1, :, None] * target


class ColourBlend(nn.Module):
    """Eqs. 7 and 8 as printed.

    The neighbours' logits come from [F_N,i, d - d_i, d.d_i, w_n,i], the target's from F_sigma. The target's colour is
    expanded in spherical harmonics of d around middle grey; its coefficients are predicted per sample and channel.

    Args:
        hidden: H.
        degree: J.
        neighbours_only: there is no target: colours are the neighbours' alone, and middle grey where none sees.
        inputs: numbers that enter each neighbour's logit next to F_N,i: d - d_i (3), d.d_i and w_n,i.
    """

    def __init__(self, hidden: int, degree: int, neighbours_only: bool = False, inputs: int = 5) -> None:
        super().__init__()
        self.degree = degree
        self.view = nn.Linear(hidden, hidden)
        self.direction = nn.Linear(inputs, hidden, bias=False)
        self.logit = nn.Linear(hidden, 1)
        nn.init.zeros_(self.logit.weight)
        self.target = None if neighbours_only else nn.Linear(hidden, 1 + 3 * (degree + 1) ** 2)
        if self.target is not None:
            nn.init.zeros_(self.target.weight)
            nn.init.zeros_(self.target.bias)

    def forward(
        self, evidence: Evidence, gathered: Gathered, direction: Float[Tensor, "T P 3"]
    ) -> Float[Tensor, "T P 3"]:
        """Colours of P samples per tile; `direction` is d, unit, towards the samples."""
        logits = self.view_logits(evidence, gathered, self.view_inputs(evidence, gathered, direction))
        if self.target is None:
            return blend_neighbours(logits, gathered)
        logits = logits.masked_fill(~gathered.valid, -torch.inf)
        return blend(logits, *self.target_colour(evidence, direction, 0.5), gathered.colours)

    def target_colour(
        self, evidence: Evidence, direction: Float[Tensor, "T P 3"], origin: Float[Tensor, "T P 3"] | float
    ) -> tuple[Float[Tensor, "T P"], Float[Tensor, "T P 3"]]:
        """The target candidate: its logit, and its colour, expanded in spherical harmonics around `origin`."""
        assert self.target is not None, "there is no target"
        head = self.target(evidence.density)
        return head[..., 0], origin + expand(head[..., 1:].unflatten(-1, (3, -1)), basis(direction, self.degree))

    def view_inputs(
        self, evidence: Evidence, gathered: Gathered, direction: Float[Tensor, "T P 3"]
    ) -> list[Float[Tensor, "T N P"]]:
        """d - d_i, d.d_i and w_n,i, scaled so that view directions 10 degrees apart, usual in surveys, are of order 1:
        |d - d_i| is 0.17 there, and 1 - d.d_i is 0.015."""
        offset = (direction[:, None] - gathered.directions) * 5
        return [*offset.unbind(-1), (1 - gathered.cosine) * -20, evidence.view_weight]

    def view_logits(
        self, evidence: Evidence, gathered: Gathered, inputs: list[Float[Tensor, "T N P"]]
    ) -> Float[Tensor, "T N P"]:
        """w_ci of eq. 7, from F_N,i and further numbers of each view."""
        hidden = self.view(evidence.per_view)
        # Each number for all samples, one after the other: a linear layer would first interleave them.
        across = self.direction.weight.T.expand(hidden.shape[0] * hidden.shape[1], -1, -1)
        hidden = torch.baddbmm(hidden.flatten(0, 1), torch.stack(inputs, dim=2).flatten(0, 1).transpose(1, 2), across)
        return self.logit(F.relu(hidden, inplace=True))[..., 0].unflatten(0, gathered.cosine.shape[:2])


class AngularColourBlend(ColourBlend):
    """Eqs. 7 and 8 with a prior on angles, for `swift`.

    Blending starts by inverse angle, as in unstructured lumigraph rendering (Buehler et al., 2001), with the angle on a
    logarithmic scale and the view's footprint as further inputs. The target's colour is a difference to the blended
    neighbours, and its share does not depend on how many there are.
    """

    def __init__(self, hidden: int, degree: int, neighbours_only: bool = False) -> None:
        super().__init__(hidden, degree, neighbours_only, inputs=7)
        self.angle = nn.Parameter(torch.tensor(1.0))
        if self.target is not None:
            with torch.no_grad():
                self.target.bias[0] = -2.0  # a share of 12%

    def forward(
        self, evidence: Evidence, gathered: Gathered, direction: Float[Tensor, "T P 3"]
    ) -> Float[Tensor, "T P 3"]:
        # 1e-4 is the angle, 0.8 degrees, below which a closer view is no better than its resampling.
        closeness = -torch.log((1 - gathered.cosine).clamp(min=0) + 1e-4)
        inputs = [*self.view_inputs(evidence, gathered, direction), closeness / 4, gathered.octaves_coarser]
        logits = self.view_logits(evidence, gathered, inputs)
        logits = logits + self.angle * closeness + gathered.blend_weight.log()
        blended = blend_neighbours(logits, gathered)
        if self.target is None:
            return blended
        # Where no view sees, the target's colour is around middle grey.
        target_logit, target = self.target_colour(evidence, direction, blended)
        # Relative to the neighbours' total, so that one bias means the same share for two views and for ten.
        mixed = torch.lerp(blended, target, torch.sigmoid(target_logit)[..., None])
        return torch.where(evidence.valid[..., None], mixed, target)
