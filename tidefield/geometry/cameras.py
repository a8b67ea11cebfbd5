"""Batches of pinhole cameras, angles between their rays, and the point where their optical axes meet.

Conventions (OpenCV): +x right, +y down, +z forward; pixel centres at +0.5, so an image of width W spans
u in [0, W]. `T_world_camera` maps camera coordinates into the world. Lens distortion has been removed before
a `Cameras` exists (see `geometry.lenses`), but for the small `residual` that a scene's calibration may have left.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from pathlib import PurePath
from typing import SupportsIndex

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from tidefield.errors import SceneError, list_names

_PARALLEL = 0.02
"""Smallest eigenvalue of the mean projection across the axes (the mean squared sine of their angle to one direction)
below which they count as parallel: they lie within 8 degrees of it, and where they meet is ill-determined."""
FRAME_REACH = 2.0
"""Tangent of the angle to the axis, across and along, beyond which lens residual and shading stay as they are there: a
polynomial would fold the picture of what lies far outside of it back into it. Pinholes reach 1.7
(`lenses.WIDEST_DEG`)."""
SHADING_DEGREE = 4
"""Degree of the polynomial of a photograph's shading."""
_INVERSE_STEPS = 5
"""Of the fixed point that inverts a residual: each divides the error by a hundred and more."""


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras, with a small residual of the lens where one was found.

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
        shading: of the photograph beside its gain, in the plane z = 1: a pixel at (x, y) has exp of the sum of the K
            rows times `monomials` times the light that it has in the scene's common light. None without.
        residual: of the lens, in the plane z = 1: a point that a pinhole shows at (x, y) is shown at (x, y) plus the
            sum of the six rows times 1, x, y, x^2, x y, y^2 (docs/method.md, section 14). None without.
    """

    T_world_camera: Float[Tensor, "V 3 4"]
    focal_px: Float[Tensor, "V 2"]
    principal_px: Float[Tensor, "V 2"]
    size_px: Int[Tensor, "V 2"]
    near_far: Float[Tensor, "V 2"]
    gain: Float[Tensor, "V 3"]
    names: tuple[str, ...] = ()
    residual: Float[Tensor, "V 6 2"] | None = None
    shading: Float[Tensor, "V K 3"] | None = None

    def __len__(self) -> int:
        return self.T_world_camera.shape[0]

    def __repr__(self) -> str:
        return f"Cameras({len(self)} of {describe_sizes(self)})"

    def __getitem__(self, index: SupportsIndex | slice | list[int] | str | Tensor) -> Cameras:
        """Select cameras; an integer or a photograph's name gives a batch of one. A tensor's selection has no names.

        Raises:
            SceneError: no photograph has this name.
        """
        if isinstance(index, str):
            index = [find_name(index, self.names, "these cameras")]
        elif isinstance(index, SupportsIndex) and not (isinstance(index, Tensor) and index.ndim):
            index = [operator.index(index)]
        names: tuple[str, ...] = ()
        if self.names and isinstance(index, slice):
            names = self.names[index]
        elif self.names and isinstance(index, list):
            names = tuple(self.names[i] for i in index)
        return self._each(lambda tensor: tensor[index], names)

    def to(self, device: torch.device | str) -> Cameras:
        return self._each(lambda tensor: tensor.to(device), self.names)

    def _each(self, change: Callable[[Tensor], Tensor], names: tuple[str, ...]) -> Cameras:
        values = {n: change(value) for n in (*_TENSORS, *_OF_SOME) if (value := getattr(self, n)) is not None}
        return replace(self, names=names, **values)

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
        """Projection matrices P_i = K_i [R_i | t_i] of the paper to homogeneous pixels and z-depth.

        They are without the residual, which `displaced` adds.
        """
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
        return self.displaced(uv), z

    def displaced(self, uv_px: Float[Tensor, "V P 2"]) -> Float[Tensor, "V P 2"]:
        """Move pixels of the pinholes to where the lenses' residual shows them."""
        if self.residual is None:
            return uv_px
        focal = self.focal_px[:, None]
        xy = (uv_px - self.principal_px[:, None]) / focal
        return torch.addcmul(uv_px, self._residual_at(xy, self._rows_of_residual()), focal)

    def _rows_of_residual(self) -> tuple[Tensor, ...]:
        assert self.residual is not None, "there is no residual"
        return self.residual[:, None].unbind(2)

    @staticmethod
    def _residual_at(xy: Float[Tensor, "V P 2"], rows: tuple[Tensor, ...]) -> Float[Tensor, "V P 2"]:
        x, y = xy.clamp(-FRAME_REACH, FRAME_REACH).split(1, -1)
        one, of_x, of_y, of_xx, of_xy, of_yy = rows
        along_x = torch.addcmul(torch.addcmul(of_x, x, of_xx), y, of_xy)
        return torch.addcmul(torch.addcmul(one, x, along_x), y, torch.addcmul(of_y, y, of_yy))

    def directions_world(self, uv_px: Float[Tensor, "V P 2"]) -> Float[Tensor, "V P 3"]:
        """Compute ray directions through pixels, scaled to a z-depth of 1."""
        shown = xy = (uv_px - self.principal_px[:, None]) / self.focal_px[:, None]
        if self.residual is not None:
            rows = self._rows_of_residual()
            for _ in range(_INVERSE_STEPS):
                xy = shown - self._residual_at(xy, rows)
        xyz = torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1)
        return xyz @ self.T_world_camera[:, :, :3].transpose(1, 2)

    def gain_at(self, uv_px: Float[Tensor, "V P 2"]) -> Float[Tensor, "V P 3"]:
        """Compute what pixels of the photographs are divided by for the scene's common light: gain times shading."""
        gain = self.gain[:, None]
        if self.shading is None:
            return gain.expand(*uv_px.shape[:2], 3)
        xy = (uv_px - self.principal_px[:, None]) / self.focal_px[:, None]
        return gain * (monomials(xy, SHADING_DEGREE) @ self.shading).exp()

    def gain_of_rows(self, rows: slice = slice(None), columns: slice = slice(None)) -> Float[Tensor, "#h #w 3"]:
        """Compute `gain_at` of all pixels of a part of a single camera's image, or its one gain without shading."""
        if self.shading is None:
            return self.gain[0].expand(1, 1, 3)
        parts = ((columns, self.width), (rows, self.height))
        u, v = (torch.arange(size, device=self.gain.device)[chosen][None] + 0.5 for chosen, size in parts)
        return self._gain_on_grids(u, v)[0]

    def gain_of_windows(self, corner_px: Int[Tensor, "V 2"], width: int, height: int) -> Float[Tensor, "V #h #w 3"]:
        """Compute `gain_at` of all pixels of one window of each image, or their gains without shading.

        Args:
            corner_px: the windows' upper left corners.
            width, height: of all windows.
        """
        if self.shading is None:
            return self.gain[:, None, None]
        sides = ((0, width), (1, height))
        u, v = (corner_px[:, k, None] + torch.arange(size, device=corner_px.device) + 0.5 for k, size in sides)
        return self._gain_on_grids(u, v)

    def _gain_on_grids(self, u_px: Float[Tensor, "V w"], v_px: Float[Tensor, "V h"]) -> Float[Tensor, "V h w 3"]:
        """`gain_at` of all pixels of a grid in each image, with shading."""
        powers = torch.arange(SHADING_DEGREE + 1, device=u_px.device)
        sides = []
        for axis, pixel in enumerate((u_px, v_px)):
            at = (pixel - self.principal_px[:, axis, None]) / self.focal_px[:, axis, None]
            sides.append(at.clamp(-FRAME_REACH, FRAME_REACH)[..., None] ** powers)
        x, y = sides
        assert self.shading is not None, "there is no shading"
        table = x.new_zeros(len(self), SHADING_DEGREE + 1, SHADING_DEGREE + 1, 3)
        # One by one: an index of several is a tensor of the processor's, which cannot be recorded (`recording`).
        for coefficient, (of_x, of_y) in zip(self.shading.unbind(1), _exponents(SHADING_DEGREE), strict=True):
            table[:, of_y, of_x] = coefficient
        # Two products: where opt_einsum is installed, einsum takes longer to look for an order of three than for this.
        by_column = torch.einsum("vha,vabc->vhbc", y, table)
        return self.gain[:, None, None] * torch.einsum("vhbc,vwb->vhwc", by_column, x).exp()

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
    of_some: dict[str, Tensor] = {}
    for name in _OF_SOME:
        own = [getattr(one, name) for one in cameras]
        like = next((value for value in own if value is not None), None)
        if like is not None:
            counts = [len(one) for one in cameras]
            own = [like.new_zeros(n, *like.shape[1:]) if v is None else v for n, v in zip(counts, own, strict=True)]
            of_some[name] = torch.cat(own)
    return Cameras(**parts, names=(), **of_some)


def monomials(xy: Float[Tensor, "*B 2"], degree: int) -> Float[Tensor, "*B K"]:
    """Return the products of powers of x and y up to a degree: 1, x, y, x^2, x y, y^2, x^3, ..."""
    x, y = xy.clamp(-FRAME_REACH, FRAME_REACH).unbind(-1)
    return torch.stack([x**of_x * y**of_y for of_x, of_y in _exponents(degree)], dim=-1)


def _exponents(degree: int) -> list[tuple[int, int]]:
    return [(total - of_y, of_y) for total in range(degree + 1) for of_y in range(total + 1)]


def project_with_slopes(
    T_world_camera: Float64[np.ndarray, "O 3 4"], xyz_world: Float64[np.ndarray, "O 3"]
) -> tuple[Float64[np.ndarray, "O 2"], Float64[np.ndarray, "O 3 2"]]:
    """Project each point by a pinhole of its own into the plane z = 1.

    Returns:
        Where it is shown, and the derivative of that with respect to the point.
    """
    R = T_world_camera[:, :, :3]
    camera = np.einsum("oij,oi->oj", R, xyz_world - T_world_camera[:, :, 3])
    # Keeps the division finite for points in the camera's plane.
    z = np.where(np.abs(camera[:, 2]) > 1e-9, camera[:, 2], 1e-9)
    xy = camera[:, :2] / z[:, None]
    return xy, (R[:, :, :2] - R[:, :, 2:] * xy[:, None]) / z[:, None, None]


_OF_SOME = ("residual", "shading")
_COMPARED = 2000
"""Names of photographs with which a misspelt one is compared."""
_TENSORS = tuple(f.name for f in fields(Cameras) if f.name not in ("names", *_OF_SOME))


def find_name(name: str, names: Sequence[str], where: str) -> int:
    """Find a photograph by its path in the scene, its file name, or either without the suffix.

    If none fits, upper and lower case count as the same.

    Raises:
        SceneError: none of the names matches, or several match in part and none as a whole.
    """
    if name in names:
        return names.index(name)
    paths = [
        (whole, p.name, p.stem, p.with_suffix("").as_posix())
        for whole, p in zip(names, map(PurePath, names), strict=True)
    ]
    found = [i for i, forms in enumerate(paths) if name in forms]
    if not found:
        found = [i for i, forms in enumerate(paths) if name.casefold() in map(str.casefold, forms)]
    if len(found) > 1:
        matching = list_names([names[i] for i in found])
        raise SceneError(
            f"{name!r} names {len(found)} photographs in {where} ({matching}): expected one; write the whole name"
        )
    if found:
        return found[0]
    of_stem = {stem.casefold(): whole for whole, _, stem, _ in paths[:_COMPARED]}
    near = [of_stem[stem] for stem in get_close_matches(PurePath(name).stem.casefold(), of_stem)] or names[:3]
    looks = (
        f"names look like {', '.join(near)}; choose one that is there" if names else "they have no names; use indices"
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
