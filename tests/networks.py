"""Networks as they begin or stirred, and what they are given to render of a textured wall."""

from dataclasses import replace

import textured_wall as wall
import torch
from torch import Tensor

from tidefield.config import PAPER, SWIFT, EncoderConfig, FieldConfig, NetworkConfig, StageConfig
from tidefield.data.depth_prior import surface_prior
from tidefield.data.neighbours import Neighbours
from tidefield.data.scene import Scene
from tidefield.model.cache import FeatureCache
from tidefield.model.intervals import Intervals
from tidefield.model.network import Network, TileRendering, Tiles
from tidefield.model.renderer import start_intervals
from tidefield.model.views import Views

CPU = torch.device("cpu")
SMALL = replace(
    SWIFT,
    network=replace(SWIFT.network, encoder=EncoderConfig((8, 8, 8, 8), (1, 1, 1), False), views=3),
    train=replace(SWIFT.train, tiles=1, tile_px=16, crop_px=48),
)
FIELD = FieldConfig(levels=4, log2_entries=10, coarsest=4, finest=64)
SMALL_PAPER = replace(
    PAPER.network,
    encoder=EncoderConfig(widths=(8, 8, 12, 16), blocks=(1, 1, 1), instance_norm=True),
    stages=(StageConfig(stride=1, samples=12, feature_stride=4, feature_channels=16, hidden=16),),
    views=3,
)
NETWORKS = {
    "swift": SWIFT.network,
    "paper": SMALL_PAPER,
    "swift and field": replace(SWIFT.network, field=FIELD),
    "paper and field": replace(SMALL_PAPER, field=FIELD),
    "field alone": replace(SMALL_PAPER, views=0, field=FIELD),
    "swift's stages on a field alone": replace(SWIFT.network, views=0, field=FIELD),
}
TARGET = 3


def network(config: NetworkConfig, seed: int = 0, stir: float = 0.0) -> Network:
    """As it begins; `stir` moves every weight, so that parts that begin at zero take part."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        own = Network(config)
        with torch.no_grad():
            for parameter in own.parameters():
                parameter.add_(stir * torch.randn(parameter.shape))
    if own.field:
        own.field.cover(torch.tensor([0.0, 0.0, wall.DEPTH]), 3.0)
    return own


def scene(count: int = 7, width: int = 64, height: int = 48) -> Scene:
    return wall.scene(wall.cameras(count, width, height, step=0.25), (TARGET,))


def looking(
    own: Network, at: Scene, side: int = 16, corners: tuple[tuple[int, int], ...] = ((16, 8), (40, 24))
) -> tuple[Tiles, Views | None, Intervals]:
    """What `forward` is given for tiles of the scene's held-out photograph."""
    tiles = Tiles(at.cameras[[TARGET] * len(corners)], torch.tensor(corners).float(), side)
    prior = surface_prior(at.cameras[TARGET], at.points, at.cameras)
    start = start_intervals(own, tiles, prior.expand(len(corners), -1, -1, -1))
    if not own.config.views:
        return tiles, None, start
    neighbours = torch.tensor([2, 4, 1, 5, 0])[: own.config.views].expand(len(corners), -1)
    presence, middle = torch.ones(*neighbours.shape, 4), torch.zeros(len(corners), 3)
    return tiles, FeatureCache(own, at, CPU).views(Neighbours(neighbours, presence), middle), start


def outputs(rendering: TileRendering) -> list[Tensor]:
    return [rendering.colour, rendering.depth, rendering.opacity, *rendering.expected, *rendering.glimpses]
