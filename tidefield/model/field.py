"""A per-scene field as a second source of evidence.

A multi-resolution hash grid (Mueller et al., 2022, section 3) under the scene contraction of mip-NeRF 360 (Barron et
al., 2022, eq. 10).

Alphabet: P points, L levels, F features per level.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from tidefield.config import FieldConfig
from tidefield.model.gather import weighted_rows

PRIMES = (1, 2_654_435_761, 805_459_861)
"""Of instant-ngp's spatial hash (its eq. 4)."""


def contract(x: Float[Tensor, "*P 3"]) -> Float[Tensor, "*P 3"]:
    """All of space into a ball of radius 2; the unit ball stays as it is."""
    # Inside, the clamp makes this x (2 - 1) / 1 = x; it also keeps the origin's gradient finite.
    length = x.norm(dim=-1, keepdim=True).clamp(min=1.0)
    return x * (2 - 1 / length) / length


class Field(nn.Module):
    """Features of positions in one scene.

    The scene's centre and radius are set once by `cover` and stored with the weights.
    """

    centre_world: Tensor
    radius: Tensor

    def __init__(self, config: FieldConfig) -> None:
        super().__init__()
        self.entries = 2**config.log2_entries
        growth = (config.finest / config.coarsest) ** (1 / max(config.levels - 1, 1))
        self.resolutions = tuple(math.floor(config.coarsest * growth**k) for k in range(config.levels))
        self.channels = config.levels * config.features
        self.table = nn.Parameter(torch.empty(config.levels * self.entries, config.features).uniform_(-1e-4, 1e-4))
        self.register_buffer("centre_world", torch.zeros(3))
        self.register_buffer("radius", torch.ones(()))

    def cover(self, centre_world: Float[Tensor, "3"], radius: float) -> None:
        """Place the field: the ball of this radius keeps full resolution, what lies outside is contracted."""
        assert radius > 0, radius
        self.centre_world.copy_(centre_world)
        self.radius.fill_(radius)

    @property
    def unit(self) -> Float[Tensor, ""]:
        """Length by which this scene's densities are measured: the radius is some 100 of them."""
        return self.radius / 100

    def forward(self, points_world: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B F"]:
        """Trilinearly interpolated features of all levels, side by side."""
        unit = contract((points_world - self.centre_world) / self.radius) / 4 + 0.5
        flat = unit.reshape(-1, 3)
        levels = [
            weighted_rows(self.table, *self._corners(flat, level, resolution))
            for level, resolution in enumerate(self.resolutions)
        ]
        return torch.cat(levels, dim=-1).reshape(*points_world.shape[:-1], self.channels)

    def _corners(
        self, unit: Float[Tensor, "P 3"], level: int, resolution: int
    ) -> tuple[Int[Tensor, "P 8"], Float[Tensor, "P 8"]]:
        """Rows of the eight grid points around each point, and their trilinear weights."""
        place = unit * resolution
        # Infinitely far away lies on the last grid point, which begins no cell.
        low = place.floor().clamp(max=resolution - 1)
        part = place - low
        columns, shares = [], []
        for corner in range(8):
            bits = torch.tensor([corner >> axis & 1 for axis in range(3)], device=unit.device)
            columns.append(self._row(low.long() + bits, resolution))
            shares.append(torch.where(bits.bool(), part, 1 - part).prod(-1))
        return torch.stack(columns, -1) + level * self.entries, torch.stack(shares, -1)

    def _row(self, cell: Int[Tensor, "P 3"], resolution: int) -> Int[Tensor, " P"]:
        """Grid points in order where a level fits into its table, hashed where it does not."""
        x, y, z = cell.unbind(-1)
        side = resolution + 1
        if side**3 <= self.entries:
            return x + side * (y + side * z)
        return ((x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) % self.entries
