"""Photographs at several sizes: each is read where its pixels are about as large as those of the rendered picture.

The paper's future work, cones instead of rays: a sample stands for what its pixel's cone covers there, and a pixel of a
photograph that is as large as that footprint holds its mean. A single reading then neither aliases where a view shows
more ground than the photographs do, nor blurs where it shows less, as far as the files have the detail. The levels are
those of mip maps (Williams, Pyramidal parametrics, 1983), half an octave apart.

Alphabet: V photographs, L levels, T tiles, N views.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from functools import partial

import cv2
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from tidefield.data.images import read_at_size
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras, concatenate

PER_OCTAVE = 2
"""Levels per factor of 2 in size."""
FINER = 2**0.5
"""How much smaller than the footprint the pixels are that are read: interpolation between them blurs, too."""
COARSEST_PX = 32
"""Least width of a level."""
KEPT_BYTES = 800_000_000
"""Memory for decoded levels; those that were not read for the longest time go first."""
Read = tuple[UInt8[Tensor, "_ _ 3"], Bool[Tensor, "_ _"] | None]
"""A photograph, and where it is used if it has a mask."""


class Pyramid:
    """The photographs of a scene at all levels: 0 is the scene's own size, those above are finer, as far as files go.

    Attributes:
        first: the coarsest level of any photograph.
        cameras: of all photographs at the first level, then at the next, and so on.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        width = scene.cameras.size_px[:, 0]
        finest = torch.tensor([scene.photographs.finest_width(i) for i in range(len(width))])
        octaves = torch.log2(torch.stack([COARSEST_PX / width, finest / width]).double())
        coarsest, finest = (PER_OCTAVE * octaves[0]).ceil().clamp(max=0), (PER_OCTAVE * octaves[1] + 1e-3).floor()
        self._range = torch.stack([coarsest, finest.clamp(min=0)]).long()
        self.first, last = int(self._range[0].min()), int(self._range[1].max())
        self.cameras = concatenate([self._cameras(level) for level in range(self.first, last + 1)])
        self._kept: OrderedDict[tuple[int, ...], Read] = OrderedDict()

    def _cameras(self, level: int) -> Cameras:
        """The cameras of all photographs at a level, or at the nearest one that they have."""
        cameras = self.scene.cameras
        own = torch.full((len(cameras),), level).clamp(self._range[0], self._range[1])
        size = (cameras.size_px * 2.0 ** (own[:, None] / PER_OCTAVE)).round().long().clamp(min=1)
        return cameras.resized_each(torch.where(own[:, None] == 0, cameras.size_px, size))

    def row(self, photographs: Int[Tensor, "*B"], levels: Int[Tensor, "*B"]) -> Int[Tensor, "*B"]:
        """Return the indices in `cameras` of photographs at levels."""
        return (levels - self.first) * len(self.scene.names) + photographs

    def levels(
        self, camera: Cameras, photographs: Int[Tensor, "T N"], points_world: Float[Tensor, "T 3"]
    ) -> Int[Tensor, "T N"]:
        """Choose the levels at which photographs have pixels about as large at a point as those of a camera.

        Below the scene's own size they are `FINER`: there photographs have what is needed without decoding.
        """
        octaves = self._octaves_finer(camera, photographs, points_world)
        level = (PER_OCTAVE * octaves).round()
        level = torch.maximum(level, (PER_OCTAVE * (octaves + math.log2(FINER))).round().clamp(max=0)).long()
        lowest, highest = self._range[:, photographs.reshape(-1)].unflatten(1, photographs.shape)
        return torch.minimum(torch.maximum(level, lowest), highest)

    def is_much_coarser(self, camera: Cameras) -> bool:
        """Whether most of a camera's pixels are more than `FINER` larger than those of the training photographs.

        The ground is taken to be halfway between near and far, in inverse depth.
        """
        views = self.scene.cameras[list(self.scene.train)]

        def pixels_per_unit(cameras: Cameras) -> Tensor:
            return cameras.focal_px.log2().mean(1) + (1 / cameras.near_far).mean(1).log2()

        return bool(pixels_per_unit(camera)[0] < pixels_per_unit(views).median() - math.log2(FINER))

    def _octaves_finer(
        self, camera: Cameras, photographs: Int[Tensor, "T N"], points_world: Float[Tensor, "T 3"]
    ) -> Float[Tensor, "T N"]:
        """How much smaller the footprints of a camera's pixels are than those of photographs, in powers of 2."""
        views = self.scene.cameras[photographs.reshape(-1)]
        points = points_world.repeat_interleave(photographs.shape[1], 0)
        depth = views.project(points[:, None])[1][:, 0]
        own_depth = camera.project(points_world)[1][0].repeat_interleave(photographs.shape[1], 0)
        finer = camera.focal_px.log2().mean() - own_depth.clamp(min=1e-6).log2()
        finer = finer - (views.focal_px.log2().mean(1) - depth.clamp(min=1e-6).log2())
        return torch.where((depth > 0) & (own_depth > 0), finer, 0.0).reshape(photographs.shape)

    def read(self, photograph: int, level: int) -> Read:
        """Read a photograph at a level, and where it is used if it has a mask."""
        photographs = self.scene.photographs
        own = photographs[photograph], photographs.masks[photograph] if photographs.masks else None
        if level == 0:
            return own
        size = self.camera(photograph, level).size_px[0].tolist()

        def make() -> Read:
            # One decoding serves this size and twice it.
            finer = own if level < 0 else self._doubled(photograph, level)
            return read_at_size(photographs, photograph, *size) if finer is None else _reduced(finer, size)

        return self._keep(photograph, size, make)

    def read_doubled(self, photograph: int, level: int) -> UInt8[Tensor, "_ _ 3"] | None:
        """Read a photograph at twice the size of a level.

        None where its file has less, and at levels below the scene's own size, whose pixels are finer anyway.
        """
        doubled = None if level < 0 else self._doubled(photograph, level)
        return None if doubled is None else doubled[0]

    def camera(self, photograph: int, level: int) -> Cameras:
        """The camera of a photograph at a level."""
        return self.cameras[int(self.row(torch.tensor(photograph), torch.tensor(level)))]

    def _doubled(self, photograph: int, level: int) -> Read | None:
        photographs, size = self.scene.photographs, (2 * self.camera(photograph, level).size_px[0]).tolist()
        if not photographs.reaches(photograph, size[0]):
            return None
        return self._keep(photograph, size, partial(read_at_size, photographs, photograph, *size))

    def _keep(self, photograph: int, size: list[int], make: Callable[[], Read]) -> Read:
        """What was made for a photograph and a size, as long as there is room for it."""
        key = photograph, *size
        if key not in self._kept:
            self._kept[key] = make()
            while len(self._kept) > 1 and sum(one.nbytes for one, _ in self._kept.values()) > KEPT_BYTES:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


def _reduced(photograph: Read, size: list[int]) -> Read:
    """A photograph, and where it is used in full, at a smaller size."""
    colours, mask = photograph
    colours = torch.from_numpy(cv2.resize(colours.numpy(), size, interpolation=cv2.INTER_AREA))
    if mask is not None:
        grey = cv2.resize(255 * mask.byte().numpy(), size, interpolation=cv2.INTER_AREA)
        mask = torch.from_numpy(grey == 255)
    return colours, mask
