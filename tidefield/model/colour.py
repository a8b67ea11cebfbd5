"""Colour of a sample: a softmax blend of the neighbours' colours and of the target's own (paper, eqs. 7 and 8)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.model.aggregate import Evidence, weighted_sum
from tidefield.model.harmonics import basis, expand
from tidefield.model.views import Gathered


class ColourBlend(nn.Module):
    """c = sum_i C_i exp(w_ci) / sum_j exp(w_cj) over the neighbours and the target candidate.

    The neighbours' logits come from [F_N,i, d - d_i, d.d_i, w_n,i], the target's from F_sigma. The target's colour is
    expanded in spherical harmonics of d around middle grey; its coefficients are predicted per sample and channel.

    Args:
        hidden: H.
        degree: J.
        alone: the neighbours' colours alone; the target's share is nothing where a neighbour sees the sample.
        as_printed: nothing else. Otherwise the angle also enters on a logarithmic scale, blending begins by inverse
            angle, as in unstructured lumigraph rendering (Buehler et al., 2001), and the target begins with a small
            share and is a difference to the neighbours' mean colour.
    """

    def __init__(self, hidden: int, degree: int, as_printed: bool = False, alone: bool = False) -> None:
        super().__init__()
        self.degree, self.alone = degree, alone
        self.view = nn.Linear(hidden, hidden)
        # d - d_i (3 numbers), d.d_i, w_n,i and, if not as printed, the logarithm of the angle.
        self.direction = nn.Linear(5 if as_printed else 6, hidden, bias=False)
        self.logit = nn.Linear(hidden, 1)
        self.angle = None if as_printed else nn.Parameter(torch.tensor(1.0))
        self.target = nn.Linear(hidden, 1 + 3 * (degree + 1) ** 2)
        nn.init.zeros_(self.logit.weight)
        nn.init.zeros_(self.target.weight)
        nn.init.zeros_(self.target.bias)
        if not as_printed:
            with torch.no_grad():
                self.target.bias[0] = -4.0

    def forward(
        self, evidence: Evidence, gathered: Gathered | None, direction: Float[Tensor, "T P 3"]
    ) -> Float[Tensor, "T P 3"]:
        """Colours of P samples per tile; `direction` is d, unit, towards the samples."""
        head = self.target(evidence.density)
        coefficients = head[..., 1:].unflatten(-1, (3, -1))
        middle = 0.5 if self.angle is None else evidence.mean_colour
        target = middle + expand(coefficients, basis(direction, self.degree))
        if gathered is None:
            return target
        logits = self._view_logits(evidence, gathered, direction)
        own, seen = head[..., 0], gathered.valid.any(1)
        if self.alone:
            own = own.masked_fill(seen, -torch.inf)
        elif self.angle is not None:
            # Relative to the neighbours' total, so that one bias means the same share for two views and for ten.
            own = own + torch.where(seen, logits.masked_fill(~gathered.valid, -1e4).logsumexp(1), 0.0)
        share = torch.softmax(torch.cat([logits, own[:, None]], dim=1), dim=1)
        return weighted_sum(gathered.colours, share[:, :-1]) + share[:, -1, :, None] * target

    def _view_logits(
        self, evidence: Evidence, gathered: Gathered, direction: Float[Tensor, "T P 3"]
    ) -> Float[Tensor, "T N P"]:
        apart = 1 - gathered.cosine
        # 1e-4 is the angle, 0.8 degrees, below which a closer view is no better than its resampling.
        closeness = -torch.log(apart.clamp(min=0) + 1e-4)
        # In a survey the angles are small: scaled so that 10 degrees are of order one.
        turned = (direction[:, None] - gathered.directions) * 5
        near = [*turned.unbind(-1), apart * -20, evidence.view_weight]
        if self.angle is not None:
            near.append(closeness / 4)
        hidden = self.view(evidence.per_view)
        # Each of the numbers for all samples, one after the other: a linear layer would first lay them side by side.
        across = self.direction.weight.T.expand(hidden.shape[0] * hidden.shape[1], -1, -1)
        hidden = torch.baddbmm(hidden.flatten(0, 1), torch.stack(near, dim=2).flatten(0, 1).transpose(1, 2), across)
        logits = self.logit(F.relu(hidden, inplace=True))[..., 0].unflatten(0, gathered.cosine.shape[:2])
        if self.angle is not None:
            logits = logits + self.angle * closeness + gathered.presence.log()
        return logits.masked_fill(~gathered.valid, -torch.inf)
