"""Photographs at several sizes: each is read where its pixels are about as large as those of the rendered picture.

The paper's future work, cones instead of rays: a sample stands for what its pixel's cone covers there, and a pixel of a
photograph that is as large as that footprint holds its mean. A single reading then neither aliases where a view shows
more ground than the photographs do, nor blurs where it shows less, as far as the files have the detail. The levels are
those of mip maps (Williams, Pyramidal parametrics, 1983), half an octave apart.

Alphabet: V photographs, L levels, T tiles, N views.
"""

from __future__ import annotations

import math
import threading

import cv2
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from tidefield.data.images import Read, decoded_at_once, read_at_size
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras, concatenate
from tidefield.parallel import SharedValues

PER_OCTAVE = 2
"""Levels per factor of 2 in size."""
FINER = 2**0.5
"""How much smaller than the footprint the pixels are that are read: interpolation between them blurs, too."""
COARSEST_PX = 32
"""Least width of a level."""
KEPT_BYTES = 800_000_000
"""Memory for decoded levels; those that were not read for the longest time go first."""


class Pyramid:
    """The photographs of a scene at all levels: 0 is the scene's own size, those above are finer, as far as files go.

    Args:
        scene: of the photographs.
        doubled: the same at twice its size (`load.at_twice_the_size`), where it is open: what it has is not decoded.

    Attributes:
        first: the coarsest level of any photograph.
        cameras: of all photographs at the first level, then at the next, and so on.
    """

    def __init__(self, scene: Scene, doubled: Scene | None = None) -> None:
        self.scene, self._doubled = scene, doubled
        width = scene.cameras.size_px[:, 0]
        finest = torch.tensor([scene.photographs.finest_width(i) for i in range(len(width))])
        octaves = torch.log2(torch.stack([COARSEST_PX / width, finest / width]).double())
        coarsest, finest = (PER_OCTAVE * octaves[0]).ceil().clamp(max=0), (PER_OCTAVE * octaves[1] + 1e-3).floor()
        self._range = torch.stack([coarsest, finest.clamp(min=0)]).long()
        self.first, last = int(self._range[0].min()), int(self._range[1].max())
        self.cameras = concatenate([self._cameras(level) for level in range(self.first, last + 1)])
        files = scene.photographs.files
        self._decoding = threading.Semaphore(decoded_at_once(files) if files else 1)
        self._kept: SharedValues[tuple[int, int, int], Read] = SharedValues(KEPT_BYTES, lambda read: read[0].nbytes)

    def _cameras(self, level: int) -> Cameras:
        """The cameras of all photographs at a level, or at the nearest one that they have."""
        cameras = self.scene.cameras
        own = torch.full((len(cameras),), level).clamp(self._range[0], self._range[1])
        # An octave above another level has exactly twice its size, so that both are read from one decoded picture.
        above = own.div(PER_OCTAVE, rounding_mode="floor").clamp(min=0)
        part = own - PER_OCTAVE * above
        size = (cameras.size_px * 2.0 ** (part[:, None] / PER_OCTAVE)).round().long().clamp(min=1) * 2 ** above[:, None]
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
        """Whether a camera's pixels are more than `FINER` times as large as those of most training photographs."""
        return self._octaves_above(camera) > math.log2(FINER)

    def files_show(self, camera: Cameras) -> bool:
        """Whether the files of most training photographs have pixels at most `FINER` times as large as a camera's."""
        finest = self._range[1, list(self.scene.train)].float().median() / PER_OCTAVE
        return self._octaves_above(camera) + float(finest) > -math.log2(FINER) - 1e-3

    def _octaves_above(self, camera: Cameras) -> float:
        """How much larger a camera's pixels are on the ground than those of most training photographs, in powers of 2.

        The ground is taken to be halfway between near and far, in inverse depth.
        """
        views = self.scene.cameras[list(self.scene.train)]

        def pixels_per_unit(cameras: Cameras) -> Tensor:
            return cameras.focal_px.log2().mean(1) + (1 / cameras.near_far).mean(1).log2()

        return float(pixels_per_unit(views).median() - pixels_per_unit(camera)[0])

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
        own = self.scene.photographs.read(photograph)
        if level == 0:
            return own
        camera = self.camera(photograph, level)
        if level > 0:
            return self._read(photograph, camera.width, camera.height)
        key = photograph, camera.width, camera.height
        return self._kept.get(key, lambda _: _reduced(own, [camera.width, camera.height]))

    def read_doubled(self, photograph: int, level: int) -> UInt8[Tensor, "_ _ 3"] | None:
        """Read a photograph at twice the size of a level.

        None where its file has less, and at levels below the scene's own size, whose pixels are finer anyway.
        """
        camera = self.camera(photograph, level)
        if level < 0 or not self.scene.photographs.reaches(photograph, 2 * camera.width):
            return None
        return self._read(photograph, 2 * camera.width, 2 * camera.height)[0]

    def camera(self, photograph: int, level: int) -> Cameras:
        """The camera of a photograph at a level."""
        return self.cameras[int(self.row(torch.tensor(photograph), torch.tensor(level)))]

    def _read(self, photograph: int, width: int, height: int) -> Read:
        """Read a photograph's file at a size."""
        if self._doubled is not None and self._doubled.photographs[photograph].shape[:2] == (height, width):
            return self._doubled.photographs.read(photograph)

        def decode(key: tuple[int, int, int]) -> Read:
            with self._decoding:
                return read_at_size(self.scene.photographs, *key)

        return self._kept.get((photograph, width, height), decode)


def _reduced(photograph: Read, size: list[int]) -> Read:
    """A photograph, and where it is used in full, at a smaller size."""
    colours, mask = photograph
    colours = torch.from_numpy(cv2.resize(colours.numpy(), size, interpolation=cv2.INTER_AREA))
    if mask is not None:
        grey = cv2.resize(255 * mask.byte().numpy(), size, interpolation=cv2.INTER_AREA)
        mask = torch.from_numpy(grey == 255)
    return colours, mask
