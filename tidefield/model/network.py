"""What the networks of both presets have in common: tiles and neighbouring views in, colours and depths of rays out.

`model.paper` is the paper's network, `model.swift` ours; both follow the paper's Figure 2.

Alphabet: T tiles, R rays of a tile.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tidefield.config import NetworkConfig
from tidefield.model.sampling import Intervals, Tiles, intervals_from_prior
from tidefield.model.views import Encoded, Views


class RayGrid(NamedTuple):
    """The rays of one pass: one for stride x stride pixels, and `margin` more rays around the tile."""

    stride: int
    margin: int


@dataclass(frozen=True)
class TileRendering:
    """Rendered tiles, at the common exposure.

    Attributes:
        colour: without what lies behind the scene; add (1 - opacity) times the background.
        depth: expected z-depth.
        opacity: sum of the weights.
        visibility: probability that a view sees the surface.
        inverse_depths: per pass, the mean inverse depth of its rays, margin included.
        coarse_colours: per pass but the last, the neighbours' mean colours under its weights, margin included.
        coarse_opacities: of these.
    """

    colour: Float[Tensor, "T R 3"]
    depth: Float[Tensor, "T R"]
    opacity: Float[Tensor, "T R"]
    visibility: Float[Tensor, "T R"]
    inverse_depths: tuple[Float[Tensor, "T _"], ...]
    coarse_colours: tuple[Float[Tensor, "T _ 3"], ...] = ()
    coarse_opacities: tuple[Float[Tensor, "T _"], ...] = ()

    def tensors(self) -> tuple[Tensor, ...]:
        """All tensors, one after the other; `from_tensors` is the inverse."""
        coarse = *self.coarse_colours, *self.coarse_opacities
        return (self.colour, self.depth, self.opacity, self.visibility, *self.inverse_depths, *coarse)

    @staticmethod
    def from_tensors(tensors: tuple[Tensor, ...]) -> TileRendering:
        passes = (len(tensors) - 2) // 3
        colour, depth, opacity, visibility = tensors[:4]
        first, second = 4 + passes, 3 + 2 * passes
        rest = tensors[4:first], tensors[first:second], tensors[second:]
        return TileRendering(colour, depth, opacity, visibility, *rest)

    def over(self, behind: Float[Tensor, "T 1 3"]) -> TileRendering:
        """The rendering over a background at the common exposure."""

        def composited(colour: Float[Tensor, "T _ 3"], opacity: Float[Tensor, "T _"]) -> Float[Tensor, "T _ 3"]:
            return colour + (1 - opacity[..., None]) * behind

        coarse = zip(self.coarse_colours, self.coarse_opacities, strict=True)
        return replace(
            self,
            colour=composited(self.colour, self.opacity),
            coarse_colours=tuple(composited(*one) for one in coarse),
        )


class Network(nn.Module, ABC):
    """A network over neighbouring views.

    Attributes:
        config: its configuration.
        grids: the rays of its passes, coarse to fine.
        fills_unseen: whether renderings are continued into pixels that no neighbour sees.
    """

    fills_unseen = False

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        last = len(config.passes) - 1
        # A pass that another one refines has a margin of one ray, for the next one to interpolate between.
        self.grids = tuple(RayGrid(one.stride, int(k < last)) for k, one in enumerate(config.passes))

    @abstractmethod
    def encode(
        self,
        photographs: Float[Tensor, "K 3 H W"],
        corner_px: Float[Tensor, "K 2"] | None = None,
        doubled: Float[Tensor, "K 3 2*H 2*W"] | None = None,
    ) -> Encoded:
        """Encode photographs of one size, or crops.

        Args:
            photographs: colours at the common exposure.
            corner_px: upper left corner of each crop in its photograph; None for whole photographs.
            doubled: the same, read at twice the size; None where there is no more detail than in `photographs`.
        """

    @abstractmethod
    def forward(
        self,
        tiles: Tiles,
        views: Views,
        start: Intervals,
        opaque: bool,
        detail: Float[Tensor, "T R"] | None = None,
        jitter: tuple[Float[Tensor, "T _ _"], ...] = (),
    ) -> TileRendering:
        """Render tiles.

        Args:
            tiles: what to render.
            views: the neighbouring views of the tiles.
            start: intervals of the first pass's rays (`start_intervals`).
            opaque: light that passes all samples is stopped by the last; False lets it through to the background.
            detail: what the expected inverse depth of each pixel has beyond that of the first pass's rays.
            jitter: of the samples of every pass, for training (`draw_jitter`); they lie evenly without.
        """

    def start_intervals(self, tiles: Tiles, priors: Sequence[Float[Tensor, "3 _ _"]]) -> Intervals:
        """Intervals of the first pass's rays from the depth priors of the tiles' cameras, or the one of all tiles."""
        return intervals_from_prior(priors, tiles.rays_px(*self.grids[0]))

    def draw_jitter(self, tiles: int, tile_px: int, generator: torch.Generator) -> tuple[Float[Tensor, "T _ _"], ...]:
        """Draw where the samples of every pass lie in their parts of the rays (`sampling.sample`)."""
        rays = ((tile_px // grid.stride + 2 * grid.margin) ** 2 for grid in self.grids)
        of_passes = zip(rays, self.config.passes, strict=True)
        return tuple(torch.rand(tiles, count, one.samples, generator=generator) for count, one in of_passes)

    def values_per_tile(self, tile_px: int, views: int) -> int:
        """Most numbers that a pass gathers for a tile: what bounds the memory of rendering."""
        return max(
            (tile_px // one.stride) ** 2 * one.samples * views * one.feature_channels for one in self.config.passes
        )


def make_network(config: NetworkConfig) -> Network:
    """The network of a configuration, with random weights."""
    from tidefield.model.paper import PaperNetwork
    from tidefield.model.swift import SwiftNetwork

    return {"paper": PaperNetwork, "swift": SwiftNetwork}[config.kind](config)
