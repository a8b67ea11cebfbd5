"""Features of the training photographs at the sizes they are needed in, encoded block by block when first needed; least
recently used blocks go first.

Alphabet: T tiles, N views.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from tidefield.data.exposure import windows_in_common_light
from tidefield.data.images import Read
from tidefield.data.neighbours import EXTRA_VIEWS, Neighbours
from tidefield.data.pyramid import Pyramid
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.machine import cores, memory_bytes
from tidefield.model.network import Network
from tidefield.model.views import Encoded, FeatureMaps, Views
from tidefield.parallel import in_parallel, read_ahead
from tidefield.recording import moved

BLOCK_PX, WHOLE_PX = 512, 832
"""Side of the blocks that photographs are encoded in: bounds the encoder's memory, whatever the photographs' size. In a
scene without a photograph larger than the second, whole ones are encoded: blocks would have up to twice the pixels."""
MOST_NORMALISED_PX = 2048
"""Side up to which photographs are encoded whole for networks with instance norms, whatever memory that takes."""
OVERLAP_PX = 160
"""Least overlap of neighbouring blocks, so that what a tile shows lies in one of them."""
TILE_SHARE = 0.2
"""How far around its middle photographs show a tile of even depth, as a share of the overlap."""
MEMORY_SHARE, LEAST_BYTES = 0.09, 1_500_000_000
"""Memory for features: this share of the device's, or this much. Views of large photographs need more than the latter:
what does not fit is encoded again for every view."""
FREE_SHARE = 0.5
"""Share of a GPU's free memory that all processes of the machine may take for features: computing takes the rest."""
MOST_TEXELS = 2**31 - 1
"""Of a map: `views.gather` counts them with 32 bits."""
ENCODED_AT_ONCE = 4
"""Blocks that are encoded at the same time, each on one core: several times as fast as one after the other on all
cores. More would take more memory."""

BlockRead = tuple[Read, UInt8[Tensor, "_ _ 3"] | None]
"""The photograph of a block at its level, and at twice that size where that is read."""


class Block(NamedTuple):
    """A part of a photograph at a level of the pyramid: which column and row of blocks."""

    photograph: int
    level: int
    column: int
    row: int


def memory_for_features(device: torch.device) -> int:
    """Bytes for the features that one process keeps: of a machine's memory, or of what a GPU has free, it has the part
    of its threads."""
    part = min(1.0, torch.get_num_threads() / cores())
    if device.type != "cuda":
        return max(LEAST_BYTES, int(MEMORY_SHARE * (memory_bytes() * part)))
    free, total = torch.cuda.mem_get_info(device)
    return min(max(LEAST_BYTES, int(MEMORY_SHARE * total)), int(FREE_SHARE * (free * part)))


class CacheFull(Exception):
    """More blocks were asked for at once than the cache holds."""


class FeatureCache:
    """Features of one scene's photographs, in half precision.

    Args:
        network: whose encoder is used, on `device`.
        scene: the photographs.
        device: where features are computed and kept.
        cones: read photographs at the size that a view shows them in, not at the scene's own (`data.pyramid`).
        budget_bytes: memory for features, `memory_for_features` if not given; a few blocks are kept even if they need
            more.
        pyramid: of the photographs, made if not given.
    """

    def __init__(
        self,
        network: Network,
        scene: Scene,
        device: torch.device,
        cones: bool = True,
        budget_bytes: int | None = None,
        pyramid: Pyramid | None = None,
    ) -> None:
        self.network, self.scene, self.device = network, scene, device
        self.budget_bytes = memory_for_features(device) if budget_bytes is None else budget_bytes
        self.pyramid = Pyramid(scene) if pyramid is None else pyramid
        self._cones = cones
        self._cameras = self.pyramid.cameras.to(device)
        patch = torch.zeros(1, 3, 32, 32, device=device)
        with torch.no_grad():
            self._like = network.encode(patch)
        if scene.photographs.masks:
            self._like = self._like.masked(patch[:, :1], torch.zeros(1, 2, device=device))
        size = scene.cameras.size_px[list(scene.train)]
        self._block_px = WHOLE_PX if size.max() <= WHOLE_PX else BLOCK_PX
        if network.config.encoder.instance_norm:  # whose means are of all that is encoded at once, as in training
            self._block_px = min(int(self.pyramid.cameras.size_px.max()), MOST_NORMALISED_PX)
        # Twice as many as the scene has at its own size: a moving camera reads some photographs at two.
        self._blocks = 2 * int(_block_counts(size, self._block_px).prod(-1).sum())
        self._make_slots(tuple(int(x) for x in size.clamp(max=self._block_px).amax(0)))

    def _make_slots(self, side: tuple[int, ...]) -> None:
        """Make empty slots for blocks of at most a size."""
        self._side = side
        like = self._like
        texel_bytes = sum(2 * padded_channels(m.channels) * self._texels(m.stride) for m in _maps(like))
        most = MOST_TEXELS // max(self._texels(m.stride) for m in _maps(like))
        blocks = min(self._blocks, self.budget_bytes // texel_bytes, most)
        self.slots = max(blocks, self.network.config.views + EXTRA_VIEWS)
        features = {stride: self._empty(m) for stride, m in like.features.items()}
        used = None if like.used is None else self._empty(like.used)
        self._encoded = Encoded(features, self._empty(like.photographs), like.with_colours, used)
        self._slots: OrderedDict[Block, int] = OrderedDict()
        self._free = list(range(self.slots))[::-1]

    def views(
        self,
        camera: Cameras,
        neighbours: Neighbours,
        middle_world: Float[Tensor, "T 3"],
        ends_world: Float[Tensor, "T 2 3"] | None = None,
    ) -> Views:
        """Encode the neighbours of a camera's tiles around what each tile shows, at the size it shows it in.

        Args:
            camera: of the tiles.
            neighbours: photographs and their blend weights.
            middle_world: the surface in the middle of each tile.
            ends_world: where it would be there at the least and at the greatest depth that the tile shows, which
                photographs see apart; the middle if not given.

        Raises:
            CacheFull: these tiles need more blocks than the cache holds.
        """
        photographs = neighbours.index
        levels = torch.zeros_like(photographs)
        if self._cones:
            levels = self.pyramid.levels(camera, photographs, middle_world)
        rows = self.pyramid.row(photographs, levels).reshape(-1)
        ends_world = middle_world[:, None] if ends_world is None else ends_world
        points = torch.cat([middle_world[:, None], ends_world], dim=1)
        keys = self._blocks_of(photographs.reshape(-1), levels.reshape(-1), rows, points)
        distinct = dict.fromkeys(keys)
        largest = self.pyramid.cameras.size_px[rows].clamp(max=self._block_px).amax(0).tolist()
        if any(needed > own for needed, own in zip(largest, self._side, strict=True)):
            self._make_slots(tuple(max(pair) for pair in zip(largest, self._side, strict=True)))
        if len(distinct) > self.slots:
            raise CacheFull
        for key in distinct:
            if key in self._slots:
                self._slots.move_to_end(key)
        self._encode_all([key for key in distinct if key not in self._slots])
        which = torch.tensor([self._slots[key] for key in keys]).reshape(photographs.shape)
        which, rows, blend_weight = moved((which, rows, neighbours.blend_weight), self.device)
        return Views(self._cameras[rows], which, blend_weight, self._encoded)

    def _blocks_of(
        self,
        photographs: Int[Tensor, " K"],
        levels: Int[Tensor, " K"],
        rows: Int[Tensor, " K"],
        points_world: Float[Tensor, "T P 3"],
    ) -> list[Block]:
        """The block of each view whose middle is nearest to where the view sees the tile's middle, the first of its
        points; where that does not hold them all, the one nearest to the middle of them, as far as it holds the tile's.
        """
        cameras, size = self.pyramid.cameras[rows], self.pyramid.cameras.size_px[rows]
        uv, _ = cameras.project(points_world.repeat_interleave(len(rows) // len(points_world), 0))
        middle, low, high = uv[:, 0], uv.amin(1), uv.amax(1)
        index = self._nearest_blocks(size, middle)
        corner, around, most = self._corners(size, index), TILE_SHARE * OVERLAP_PX, (0.5 - TILE_SHARE) * OVERLAP_PX
        held = ((low - around).clamp(min=0) >= corner) & (torch.minimum(high + around, size) <= corner + self._block_px)
        aside = ((low + high) / 2 - middle).clamp(-most, most)
        index = torch.where(held, index, self._nearest_blocks(size, middle + aside))
        parts = zip(photographs.tolist(), levels.tolist(), index.tolist(), strict=True)
        return [Block(photograph, level, *at) for photograph, level, at in parts]

    def _nearest_blocks(self, size_px: Int[Tensor, "K 2"], uv_px: Float[Tensor, "K 2"]) -> Int[Tensor, "K 2"]:
        """Columns and rows of the blocks whose middles are nearest to pixels of photographs."""
        last = _block_counts(size_px, self._block_px) - 1
        free = (size_px - self._block_px).clamp(min=1)
        return torch.minimum(((uv_px - self._block_px / 2) / free * last).round().clamp(min=0), last.to(uv_px)).long()

    def _corners(self, size_px: Int[Tensor, "*K 2"], index: Int[Tensor, "*K 2"]) -> Int[Tensor, "*K 2"]:
        """Upper left corners of blocks, by their columns and rows."""
        last = (_block_counts(size_px, self._block_px) - 1).clamp(min=1)
        return ((size_px - self._block_px).clamp(min=0) * index / last).floor().long()

    def _encode_all(self, blocks: list[Block]) -> None:
        """Encode blocks, some at a time; one that is cancelled leaves those that are ready."""
        for start in range(0, len(blocks), ENCODED_AT_ONCE):
            some = blocks[start : start + ENCODED_AT_ONCE]
            slots = [self._free.pop() if self._free else self._slots.popitem(last=False)[1] for _ in some]
            try:
                with read_ahead(self._read, some, self.device) as read:
                    tasks = [partial(self._encode, *each, read) for each in zip(some, slots, strict=True)]
                    in_parallel(tasks, self.device)
            finally:
                self._free += [slot for block, slot in zip(some, slots, strict=True) if block not in self._slots]

    def _read(self, block: Block) -> BlockRead:
        own, doubled = self.pyramid.read(block.photograph, block.level), None
        if self._cones and self.network.config.has("doubled photographs"):
            doubled = self.pyramid.read_doubled(block.photograph, block.level)
        return own, doubled

    def _encode(self, block: Block, slot: int, read: Callable[[Block], BlockRead]) -> None:
        (colours, mask), doubled = read(block)
        size = torch.tensor([colours.shape[1], colours.shape[0]])
        corner = self._corners(size, torch.tensor([block.column, block.row]))
        (left, top), (right, bottom) = corner.tolist(), torch.minimum(corner + self._block_px, size).tolist()
        camera = self.pyramid.camera(block.photograph, block.level).to(self.device)

        def window(photograph: Tensor, scale: int) -> Tensor:
            """The block as the network reads it, of the photograph at its level or at twice that size."""
            pixels = photograph[scale * top : scale * bottom, scale * left : scale * right]
            at = camera.resized(photograph.shape[1], photograph.shape[0])
            colours = windows_in_common_light(pixels[None].to(self.device), at, scale * corner[None].to(self.device))
            return colours.permute(0, 3, 1, 2)

        first, twice = window(colours, 1), [] if doubled is None else [window(doubled, 2)]
        corner_px = corner[None].to(first)
        encoded = self.network.encode(first, corner_px, *twice)
        if self.scene.photographs.masks:
            used = torch.ones(size.flip(0).tolist(), dtype=torch.bool) if mask is None else mask
            encoded = encoded.masked(used[None, None, top:bottom, left:right].to(first), corner_px)
        for maps, found in zip(_maps(self._encoded), _maps(encoded), strict=True):
            first = slot * self._texels(maps.stride)
            maps.rows[first : first + len(found.rows), : found.channels] = found.rows
            maps.size[slot], maps.origin_px[slot] = found.size[0], found.origin_px[0]
        self._slots[block] = slot

    def _texels(self, stride: int | float) -> int:
        return math.prod(math.ceil(side / stride) for side in self._side)

    def _empty(self, like: FeatureMaps) -> FeatureMaps:
        texels, values = self._texels(like.stride), padded_channels(like.channels)
        return FeatureMaps(
            rows=torch.empty(self.slots * texels, values, dtype=torch.float16, device=self.device),
            channels=like.channels,
            first=torch.arange(self.slots, device=self.device) * texels,
            size=torch.ones(self.slots, 2, dtype=torch.long, device=self.device),
            origin_px=torch.zeros(self.slots, 2, device=self.device),
            stride=like.stride,
        )


def padded_channels(channels: int) -> int:
    """Values of a row in half precision that holds some: rows of whole 8 bytes are read twice as fast as others."""
    return 4 * -(-channels // 4)


def _maps(encoded: Encoded) -> list[FeatureMaps]:
    return [*encoded.features.values(), encoded.photographs, *([] if encoded.used is None else [encoded.used])]


def _block_counts(size_px: Int[Tensor, "*B 2"], block_px: int) -> Int[Tensor, "*B 2"]:
    """Columns and rows of blocks that cover a photograph, evenly spaced and overlapping."""
    step = block_px - OVERLAP_PX
    return 1 + (-(-(size_px - block_px) // step)).clamp(min=0).long()
