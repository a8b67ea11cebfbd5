"""Colour of a sample: a softmax blend of the neighbours' colours and of the target's own (paper, eqs. 7 and 8)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.model.aggregate import Evidence
from tidefield.model.harmonics import basis, expand
from tidefield.model.views import Gathered

DIRECTION_FEATURES = 6
"""d - d_i (3 numbers), d.d_i, the same on a logarithmic scale, and w_n,i."""


class ColourBlend(nn.Module):
    """c = sum_i C_i exp(w_ci) / sum_j exp(w_cj) over the neighbours and the target candidate.

    The neighbours' logits come from [F_N,i, d - d_i, d.d_i, w_n,i], the target's from F_sigma. The target's colour is
    expanded in spherical harmonics of d; its coefficients are predicted per sample and channel, the constant one as a
    difference to the neighbours' mean colour (or to middle grey where nothing sees the sample).
    """

    def __init__(self, hidden: int, degree: int) -> None:
        super().__init__()
        self.degree = degree
        self.view = nn.Linear(hidden, hidden)
        self.direction = nn.Linear(DIRECTION_FEATURES, hidden, bias=False)
        self.logit = nn.Linear(hidden, 1)
        # At the start: neighbours by inverse angle, as in unstructured lumigraph rendering, and little of the target.
        self.angle = nn.Parameter(torch.tensor(1.0))
        self.target = nn.Linear(hidden, 1 + 3 * (degree + 1) ** 2)
        nn.init.zeros_(self.logit.weight)
        nn.init.zeros_(self.target.weight)
        nn.init.zeros_(self.target.bias)
        with torch.no_grad():
            self.target.bias[0] = -4.0

    def forward(
        self, evidence: Evidence, gathered: Gathered | None, direction: Float[Tensor, "T P 3"]
    ) -> Float[Tensor, "T P 3"]:
        """Colours of P samples per tile; `direction` is d, unit, towards the samples."""
        head = self.target(evidence.density)
        coefficients = head[..., 1:].unflatten(-1, (3, -1))
        target = evidence.mean_colour + expand(coefficients, basis(direction, self.degree))
        if gathered is None:
            return target
        logits = self._view_logits(evidence, gathered, direction)
        # Relative to the neighbours' total, so that one bias means the same share for two views and for ten.
        seen = gathered.valid.any(1)
        total = torch.where(seen, logits.masked_fill(~gathered.valid, -1e4).logsumexp(1), 0.0)
        own = head[..., 0] + total
        share = torch.softmax(torch.cat([logits, own[:, None]], dim=1), dim=1)
        return (share[:, :-1, :, None] * gathered.colours).sum(1) + share[:, -1, :, None] * target

    def _view_logits(
        self, evidence: Evidence, gathered: Gathered, direction: Float[Tensor, "T P 3"]
    ) -> Float[Tensor, "T N P"]:
        # In a survey the angles are small: scaled so that 10 degrees are of order one. 1e-4 is the angle, 0.8 degrees,
        # below which a closer view is no better than its resampling.
        apart = 1 - gathered.cosine
        closeness = -torch.log(apart.clamp(min=0) + 1e-4)
        near = torch.cat(
            [
                (direction[:, None] - gathered.directions) * 5,
                apart[..., None] * -20,
                closeness[..., None] / 4,
                evidence.view_weight[..., None],
            ],
            dim=-1,
        )
        logits = self.logit(F.relu(self.view(evidence.per_view) + self.direction(near)))[..., 0]
        return (logits + self.angle * closeness).masked_fill(~gathered.valid, -torch.inf)
