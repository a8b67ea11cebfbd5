"""A Scene: posed photographs, what is known of their surface, and which of them are held out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool, Float, Int
from torch import Tensor

from tidefield.data.hull import Hull
from tidefield.data.images import Photographs
from tidefield.errors import SceneError
from tidefield.geometry.cameras import Cameras


@dataclass(frozen=True)
class SparsePoints:
    """Triangulated points of structure-from-motion, and which photograph saw which of them where.

    Attributes:
        xyz_world: positions, world units.
        error_px: mean reprojection error of each point, pixels of the Scene's photographs.
        point_index: for each observation, the point.
        camera_index: for each observation, the photograph.
        uv_px: for each observation, the (undistorted) pixel in the Scene's photograph.
    """

    xyz_world: Float[Tensor, "P 3"]
    error_px: Float[Tensor, " P"]
    point_index: Int[Tensor, " O"]
    camera_index: Int[Tensor, " O"]
    uv_px: Float[Tensor, "O 2"]

    def subset(self, kept: Bool[Tensor, " P"]) -> SparsePoints:
        """Some of the points, and what observed them."""
        seen = kept[self.point_index.long()]
        number = kept.cumsum(0) - 1
        return SparsePoints(
            xyz_world=self.xyz_world[kept],
            error_px=self.error_px[kept],
            point_index=number[self.point_index[seen].long()].to(self.point_index),
            camera_index=self.camera_index[seen],
            uv_px=self.uv_px[seen],
        )


@dataclass(frozen=True)
class Scene:
    """Everything that is read from disk, undistorted, at the working resolution.

    Attributes:
        root: the folder that was read.
        names: photograph names, relative to the scene's image folder, sorted; index i means the same everywhere.
        cameras: one pinhole camera per photograph, exactly that photograph's size. World coordinates are relative
            to `origin_world`.
        photographs: the pixels.
        points: sparse points, or None where the format has none.
        train: indices of the photographs that may be learned from and used as neighbours.
        test: indices of the held-out photographs.
        origin_world: what was subtracted, once and in float64, from the coordinates on disk.
        background_rgb: the colour behind the scene for photographs with alpha; None for real photographs.
        hull: where what stands before it can be; None where there are sparse points, or nothing is known.
    """

    root: Path
    names: tuple[str, ...]
    cameras: Cameras
    photographs: Photographs
    points: SparsePoints | None
    train: tuple[int, ...]
    test: tuple[int, ...]
    origin_world: Float[Tensor, "3"]
    background_rgb: tuple[float, float, float] | None = None
    hull: Hull | None = None

    def index(self, name: str) -> int:
        """Index of a photograph by its name, with or without its suffix."""
        for i, own in enumerate(self.names):
            if name in (own, Path(own).stem, Path(own).name):
                return i
        close = ", ".join(self.names[:3])
        raise SceneError(f"no photograph named {name!r} in {self.root}: names look like {close}; choose one of these")


def every_eighth(count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The field's usual split: photographs 0, 8, 16, ... of the sorted names are held out."""
    test = tuple(range(0, count, 8))
    train = tuple(i for i in range(count) if i % 8)
    return train, test
