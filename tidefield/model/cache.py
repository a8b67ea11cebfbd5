"""Features of the training photographs, encoded block by block when first needed; least recently used blocks go first.

Alphabet: T tiles, N views.
"""

from __future__ import annotations

import math
from collections import OrderedDict

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tidefield.data.exposure import to_common_exposure
from tidefield.data.neighbours import EXTRA_VIEWS, Neighbours
from tidefield.data.scene import Scene
from tidefield.model.network import Network
from tidefield.model.views import Encoded, FeatureMaps, Views

BLOCK_PX = 1024
"""Side of the blocks that photographs are encoded in: bounds the encoder's memory, whatever the photographs' size."""
OVERLAP_PX = 384
"""Least overlap of neighbouring blocks, so that what a tile shows lies in one of them."""
BUDGET_BYTES = 1_500_000_000
"""Memory for features."""


class CacheFull(Exception):
    """More blocks were asked for at once than the cache holds."""


class FeatureCache:
    """Features of one scene's photographs, in half precision.

    Args:
        network: whose encoder is used, on `device`.
        scene: the photographs.
        device: where features are computed and kept.
        budget_bytes: memory for features; a few blocks are kept even if they need more.
    """

    def __init__(self, network: Network, scene: Scene, device: torch.device, budget_bytes: int = BUDGET_BYTES) -> None:
        self.network, self.scene, self.device = network, scene, device
        self.cameras = scene.cameras.to(device)
        size = scene.cameras.size_px[list(scene.train)]
        self._side = tuple(int(x) for x in size.clamp(max=BLOCK_PX).amax(0))
        blocks = int(_block_counts(size).prod(-1).sum())
        patch = torch.zeros(1, 3, 32, 32, device=device)
        with torch.no_grad():
            like = network.encode(patch)
        if scene.photographs.masks:
            like = like.masked(patch[:, :1], torch.zeros(1, 2, device=device))
        texel_bytes = sum(2 * m.rows.shape[1] * self._texels(m.stride) for m in _maps(like))
        self.slots = max(min(blocks, budget_bytes // texel_bytes), network.config.views + EXTRA_VIEWS)
        features = {stride: self._empty(m) for stride, m in like.features.items()}
        used = None if like.used is None else self._empty(like.used)
        self._encoded = Encoded(features, self._empty(like.photographs), like.with_colours, used)
        self._slots: OrderedDict[tuple[int, int, int], int] = OrderedDict()

    def views(self, neighbours: Neighbours, middle_world: Float[Tensor, "T 3"]) -> Views:
        """Encode the neighbours of tiles around what each tile shows.

        Args:
            neighbours: photographs and their blend weights.
            middle_world: the surface in the middle of each tile.

        Raises:
            CacheFull: these tiles need more blocks than the cache holds.
        """
        keys = self._blocks(neighbours.index, middle_world)
        distinct = dict.fromkeys(keys)
        if len(distinct) > self.slots:
            raise CacheFull
        for key in distinct:
            if key in self._slots:
                self._slots.move_to_end(key)
        for key in distinct:
            if key not in self._slots:
                self._encode(key)
        which = torch.tensor([self._slots[key] for key in keys], device=self.device).reshape(neighbours.index.shape)
        cameras = self.cameras[neighbours.index.reshape(-1).to(self.device)]
        return Views(cameras, which, neighbours.blend_weight.to(self.device), self._encoded)

    def _blocks(self, neighbours: Int[Tensor, "T N"], middle_world: Float[Tensor, "T 3"]) -> list[tuple[int, int, int]]:
        """(photograph, column, row) of the block whose middle is nearest to where each view sees the tile's middle."""
        photographs = neighbours.reshape(-1)
        cameras = self.scene.cameras[photographs]
        points = middle_world.repeat_interleave(neighbours.shape[1], 0)
        uv = cameras.project(points[:, None])[0][:, 0]
        last = _block_counts(cameras.size_px) - 1
        free = (cameras.size_px - BLOCK_PX).clamp(min=1)
        index = torch.minimum(((uv - BLOCK_PX / 2) / free * last).round().clamp(min=0), last.to(uv)).long()
        return [(i, *at) for i, at in zip(photographs.tolist(), index.tolist(), strict=True)]

    def _encode(self, key: tuple[int, int, int]) -> None:
        photograph, column, row = key
        slot = self._slots.popitem(last=False)[1] if len(self._slots) == self.slots else len(self._slots)
        size = self.scene.cameras.size_px[photograph]
        last = (_block_counts(size) - 1).clamp(min=1)
        corner = ((size - BLOCK_PX).clamp(min=0) * torch.tensor([column, row]) / last).floor().long()
        (left, top), (right, bottom) = corner.tolist(), torch.minimum(corner + BLOCK_PX, size.long()).tolist()
        colours = to_common_exposure(self.scene, photograph, slice(top, bottom), slice(left, right)).permute(2, 0, 1)[
            None
        ]
        corner_px = corner[None].to(colours).to(self.device)
        encoded = self.network.encode(colours.to(self.device), corner_px)
        if self.scene.photographs.masks:
            used = self.scene.photographs.used(photograph)[None, None, top:bottom, left:right]
            encoded = encoded.masked(used.to(colours).to(self.device), corner_px)
        for maps, block in zip(_maps(self._encoded), _maps(encoded), strict=True):
            first = slot * self._texels(maps.stride)
            maps.rows[first : first + len(block.rows)] = block.rows.to(maps.rows.dtype)
            maps.size[slot], maps.origin_px[slot] = block.size[0], block.origin_px[0]
        self._slots[key] = slot

    def _texels(self, stride: int | float) -> int:
        return math.prod(math.ceil(side / stride) for side in self._side)

    def _empty(self, like: FeatureMaps) -> FeatureMaps:
        texels, channels = self._texels(like.stride), like.rows.shape[1]
        return FeatureMaps(
            rows=torch.empty(self.slots * texels, channels, dtype=torch.float16, device=self.device),
            first=torch.arange(self.slots, device=self.device) * texels,
            size=torch.ones(self.slots, 2, dtype=torch.long, device=self.device),
            origin_px=torch.zeros(self.slots, 2, device=self.device),
            stride=like.stride,
        )


def _maps(encoded: Encoded) -> list[FeatureMaps]:
    return [*encoded.features.values(), encoded.photographs, *([] if encoded.used is None else [encoded.used])]


def _block_counts(size_px: Int[Tensor, "*B 2"]) -> Int[Tensor, "*B 2"]:
    """Columns and rows of blocks that cover a photograph, evenly spaced and overlapping."""
    step = BLOCK_PX - OVERLAP_PX
    return 1 + (-(-(size_px - BLOCK_PX) // step)).clamp(min=0).long()
