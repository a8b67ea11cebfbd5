"""The Scene: posed photographs, sparse points of their surface, and which photographs are held out."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tidefield.data.hull import Hull
from tidefield.data.images import Photographs
from tidefield.data.readers.posed import Reference
from tidefield.geometry.cameras import Cameras, describe_sizes, find_name


@dataclass(frozen=True)
class SparsePoints:
    """P points triangulated by structure-from-motion, and their O observations in photographs.

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

    def observed(self, kept: Bool[Tensor, " O"]) -> SparsePoints:
        """Select observations; all points stay."""
        parts = {name: getattr(self, name)[kept] for name in ("point_index", "camera_index", "uv_px")}
        return replace(self, **parts)

    def subset(self, kept: Bool[Tensor, " P"]) -> SparsePoints:
        """Select points together with their observations."""
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
        cameras: one pinhole camera per photograph, of exactly that photograph's size, with the photographs' names.
            World coordinates are relative to `origin_world`.
        photographs: the pixels.
        points: sparse points, or None where the format has none.
        train: indices of the training photographs, which also serve as neighbours.
        test: indices of the held-out photographs.
        origin_world: what was subtracted, once and in float64, from the coordinates on disk.
        background_rgb: the background colour of photographs with alpha; None for real photographs.
        hull: the visual hull of the object; None without alpha.
        reference: the geographic origin of another program's project, where it states one.
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
    reference: Reference | None = None

    def __post_init__(self) -> None:
        if self.cameras.names != self.names:
            object.__setattr__(self, "cameras", replace(self.cameras, names=self.names))

    def __repr__(self) -> str:
        parts = [f"{len(self.names)} photographs {describe_sizes(self.cameras)}"]
        parts += [f"{len(self.train)} train", f"{len(self.test)} test"]
        parts += [f"{len(self.points.xyz_world):,} points"] if self.points is not None else ["no points"]
        parts += ["masks"] if self.photographs.masks else []
        return f"Scene({self.root.name!r}, {', '.join(parts)})"

    @property
    def held_out(self) -> tuple[str, ...]:
        """Names of the held-out photographs."""
        return tuple(self.names[i] for i in self.test)

    def index(self, name: str) -> int:
        """Find a photograph's index by its name, with or without its folder and suffix.

        Raises:
            SceneError: no photograph has this name.
        """
        return find_name(name, self.names, str(self.root))

    def sources(self, camera: Cameras) -> tuple[int, ...]:
        """List the photographs that one camera's view may be made from: the training photographs, but not its own.

        A camera's own photograph has its name and its pose. A camera without a name has none.
        """
        own = self.names.index(camera.names[0]) if camera.names and camera.names[0] in self.names else None
        if own is None or not torch.equal(self.cameras.T_world_camera[own], camera.T_world_camera[0]):
            return self.train
        return tuple(i for i in self.train if i != own)


def poses_key(names: Sequence[str], T_world_camera: Float[Tensor, "V 3 4"], held_out: Collection[str]) -> str:
    """Identify photographs, their poses around their mean position, and which are held out.

    That of a scene which was made anew differs. Poses are rounded to 1e-5: rounding on another machine does not count.
    """
    train, test = (tuple(i for i, name in enumerate(names) if (name in held_out) == out) for out in (False, True))
    poses = T_world_camera.double().cpu().round(decimals=5) + 0.0  # no -0.0
    return hashlib.sha256(json.dumps([names, train, test, poses.tolist()]).encode()).hexdigest()
