"""Batches of pinhole cameras, angles between their rays, and the point where their optical axes meet.

Conventions (OpenCV): +x right, +y down, +z forward; pixel centres at +0.5, so an image of width W spans
u in [0, W]. `T_world_camera` maps camera coordinates into the world. Lens distortion has been removed before
a `Cameras` exists (see `geometry.lenses`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import PurePath

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from tidefield.errors import SceneError

_PARALLEL = 0.02
"""Smallest eigenvalue of the mean projection across the axes (the mean squared sine of their angle to one direction)
below which they count as parallel: they lie within 8 degrees of it, and where they meet is ill-determined."""


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras.

    Attributes:
        T_world_camera: camera-to-world rotation and position, world units.
        focal_px: (fx, fy).
        principal_px: (cx, cy), pixel centres at +0.5.
        size_px: (width, height).
        near_far: nearest and farthest z-depth (along +z) of the scene for this camera, world units.
        gain: colour gain of the photograph, per channel, relative to the scene's common exposure; 1 where unknown.
            A photograph divided by its gain is at the common exposure (docs/method.md, section 12).
        names: of the photographs, to index by; empty where the cameras have none. The view of a scene's own photograph
            is rendered without that photograph, as if it were held out; with `dataclasses.replace(camera, names=())` it
            serves as any other.
    """

    T_world_camera: Float[Tensor, "V 3 4"]
    focal_px: Float[Tensor, "V 2"]
    principal_px: Float[Tensor, "V 2"]
    size_px: Int[Tensor, "V 2"]
    near_far: Float[Tensor, "V 2"]
    gain: Float[Tensor, "V 3"]
    names: tuple[str, ...] = ()

    def __len__(self) -> int:
        return self.T_world_camera.shape[0]

    def __repr__(self) -> str:
        return f"Cameras({len(self)} of {describe_sizes(self)})"

    def __getitem__(self, index: int | slice | list[int] | str | Tensor) -> Cameras:
        """Select cameras; an integer or a photograph's name gives a batch of one. A tensor's selection has no names.

        Raises:
            SceneError: no photograph has this name.
        """
        if isinstance(index, str):
            index = find_name(index, self.names, "these cameras")
        if isinstance(index, int):
            index = [index]
        names: tuple[str, ...] = ()
        if self.names and isinstance(index, slice):
            names = self.names[index]
        elif self.names and isinstance(index, list):
            names = tuple(self.names[i] for i in index)
        return Cameras(**{name: getattr(self, name)[index] for name in _TENSORS}, names=names)

    def to(self, device: torch.device | str) -> Cameras:
        return Cameras(**{name: getattr(self, name).to(device) for name in _TENSORS}, names=self.names)

    @property
    def width(self) -> int:
        """Width of a single camera, in pixels."""
        return int(self.size_px[0, 0])

    @property
    def height(self) -> int:
        """Height of a single camera, in pixels."""
        return int(self.size_px[0, 1])

    @property
    def position_world(self) -> Float[Tensor, "V 3"]:
        return self.T_world_camera[:, :, 3]

    @property
    def forward_world(self) -> Float[Tensor, "V 3"]:
        """Unit viewing directions (+z of each camera)."""
        return self.T_world_camera[:, :, 2]

    @property
    def projection(self) -> Float[Tensor, "V 3 4"]:
        """Projection matrices P_i = K_i [R_i | t_i] of the paper to homogeneous pixels and z-depth."""
        rotation = self.T_world_camera[:, :, :3].transpose(1, 2)
        view = torch.cat([rotation, -rotation @ self.position_world[:, :, None]], dim=2)
        depth = view[:, 2:]
        return torch.cat([self.focal_px[..., None] * view[:, :2] + self.principal_px[..., None] * depth, depth], dim=1)

    def project(
        self, points_world: Float[Tensor, "P 3"] | Float[Tensor, "V P 3"]
    ) -> tuple[Float[Tensor, "V P 2"], Float[Tensor, "V P"]]:
        """Project points with every camera, the same ones or each camera's own: pixels and z-depths.

        Points at or behind a camera have z <= 0 and meaningless pixels: test z before using them.
        """
        matrix = self.projection
        points = points_world.expand(len(self), -1, -1)
        homogeneous = points @ matrix[:, :, :3].transpose(1, 2) + matrix[:, None, :, 3]
        z = homogeneous[..., 2]
        # Keeps the division finite for points in the camera's plane; they are invalid by z <= 0 or out of the image.
        uv = homogeneous[..., :2] / torch.where(z.abs() < 1e-9, 1e-9, z)[..., None]
        return uv, z

    def directions_world(self, uv_px: Float[Tensor, "V P 2"]) -> Float[Tensor, "V P 3"]:
        """Compute ray directions through pixels, scaled to a z-depth of 1."""
        xy = (uv_px - self.principal_px[:, None]) / self.focal_px[:, None]
        xyz = torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1)
        return xyz @ self.T_world_camera[:, :, :3].transpose(1, 2)

    def resized(self, width: int, height: int) -> Cameras:
        """Scale the images to width x height pixels."""
        return self.resized_each(self.size_px.new_tensor([width, height]).expand_as(self.size_px))

    def resized_each(self, size_px: Int[Tensor, "V 2"]) -> Cameras:
        """Scale each image to a size of its own."""
        ratio = size_px / self.size_px
        return replace(self, focal_px=self.focal_px * ratio, principal_px=self.principal_px * ratio, size_px=size_px)

    def cropped(self, width: int, height: int) -> Cameras:
        """Crop or extend the images at the right and the bottom."""
        return replace(self, size_px=self.size_px.new_tensor([width, height]).expand_as(self.size_px))


def concatenate(cameras: Sequence[Cameras]) -> Cameras:
    """Join cameras into one set, without their names."""
    parts = {name: torch.cat([getattr(one, name) for one in cameras]) for name in _TENSORS}
    return Cameras(**parts, names=())


_TENSORS = tuple(f.name for f in fields(Cameras) if f.name != "names")


def find_name(name: str, names: Sequence[str], where: str) -> int:
    """Find a photograph by its path in the scene, its file name, or its path without the folder and the suffix.

    Raises:
        SceneError: none of the names matches.
    """
    for i, own in enumerate(names):
        if name in (own, PurePath(own).stem, PurePath(own).name):
            return i
    looks = (
        f"names look like {', '.join(names[:3])}; choose one of these" if names else "they have no names; use indices"
    )
    raise SceneError(f"no photograph named {name!r} in {where}: {looks}")


def describe_sizes(cameras: Cameras) -> str:
    """Describe the cameras' image sizes in short: `320x240`, or `2 sizes`."""
    sizes = cameras.size_px.unique(dim=0).tolist() if len(cameras) else []
    return "x".join(map(str, sizes[0])) if len(sizes) == 1 else f"{len(sizes)} sizes"


def pixel_grid(width: int, height: int, device: torch.device | str | None = None) -> Float[Tensor, "P 2"]:
    """List the centres of all pixels of an image, row by row: (0.5, 0.5), (1.5, 0.5), ..."""
    v, u = torch.meshgrid(
        torch.arange(height, device=device) + 0.5, torch.arange(width, device=device) + 0.5, indexing="ij"
    )
    return torch.stack([u, v], dim=-1).reshape(-1, 2)


def angle_between(first: Float[Tensor, "*#B 3"], second: Float[Tensor, "*#B 3"]) -> Float[Tensor, "*B"]:
    """Compute angles between unit vectors, radians.

    They are computed from the chord: the arc cosine of the dot product loses small angles to rounding.
    """
    return 2 * ((second - first).norm(dim=-1) / 2).clamp(max=1).asin()


def intersect_axes(
    position: Float64[np.ndarray, "V 3"], forward: Float64[np.ndarray, "V 3"]
) -> Float64[np.ndarray, " 3"] | None:
    """Find the least-squares point nearest to all optical axes; None where these are nearly parallel.

    Args:
        forward: unit vectors along the axes.
    """
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] <= _PARALLEL:
        return None
    return np.linalg.solve(across.sum(axis=0), (across @ position[:, :, None]).sum(axis=0))[:, 0]
