"""Networks as they begin or stirred, and what they are given to render of a textured wall."""

from dataclasses import replace

import textured_wall as wall
import torch
from torch import Tensor

from tidefield.config import PAPER, SWIFT, EncoderConfig, NetworkConfig, PassConfig
from tidefield.data.depth_prior import surface_prior
from tidefield.data.neighbours import Neighbours
from tidefield.data.scene import Scene
from tidefield.model.cache import FeatureCache
from tidefield.model.network import Network, TileRendering, make_network
from tidefield.model.sampling import Intervals, Tiles
from tidefield.model.views import Views

CPU = torch.device("cpu")
SMALL = replace(
    SWIFT,
    network=replace(SWIFT.network, encoder=EncoderConfig((8, 8, 8, 8), (1, 1, 1), False), views=3),
    train=replace(SWIFT.train, tiles=1, tile_px=16, crop_px=48),
)
PLAIN = replace(
    SMALL,
    network=replace(SMALL.network, without=(*SMALL.network.without, "matched surface", "doubled photographs")),
)
"""For what is not about surfaces, whose search takes most of the time of a small scene."""
SMALL_PAPER = replace(
    PAPER.network,
    encoder=EncoderConfig(widths=(8, 8, 12, 16), blocks=(1, 1, 1), instance_norm=True),
    passes=(PassConfig(stride=1, samples=12, feature_stride=4, feature_channels=16, hidden=16),),
    views=3,
)
NETWORKS = {
    "swift": SWIFT.network,
    "paper": SMALL_PAPER,
}
TARGET = 3


def network(config: NetworkConfig, seed: int = 0, stir: float = 0.0) -> Network:
    """A network with random weights; `stir` moves every weight, so that parts that start at zero take part."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        own = make_network(config)
        with torch.no_grad():
            for parameter in own.parameters():
                parameter.add_(stir * torch.randn(parameter.shape))
    return own


def scene(count: int = 7, width: int = 64, height: int = 48) -> Scene:
    return wall.scene(wall.cameras(count, width, height, step=0.25), (TARGET,))


def looking(
    own: Network, at: Scene, side: int = 16, corners: tuple[tuple[int, int], ...] = ((16, 8), (40, 24))
) -> tuple[Tiles, Views, Intervals]:
    """What `forward` is given for tiles of the scene's held-out photograph."""
    tiles = Tiles(at.cameras[[TARGET] * len(corners)], torch.tensor(corners).float(), side)
    prior = surface_prior(at.cameras[TARGET], at.points, at.cameras)
    start = own.start_intervals(tiles, [prior] * len(corners))
    neighbours = torch.tensor([2, 4, 1, 5, 0])[: own.config.views].expand(len(corners), -1)
    blend_weight, middle = torch.ones(*neighbours.shape, 4), torch.zeros(len(corners), 3)
    views = FeatureCache(own, at, CPU).views(at.cameras[TARGET], Neighbours(neighbours, blend_weight), middle)
    return tiles, views, start


def outputs(rendering: TileRendering) -> list[Tensor]:
    return [rendering.colour, rendering.depth, rendering.opacity, *rendering.inverse_depths, *rendering.coarse_colours]
