"""Gaussians of a scene, for viewers that cannot run a network: from the colours and depths of its photographs' views.

Each pixel of the rendered views is a flat Gaussian on the surface, as wide as what the pixel shows, unless other views
see through it (`consistency`); those that share a cell of space are averaged. Nothing is optimised. The file is in the
layout of Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (2023), which SuperSplat, gsplat
and others open.

Alphabet: G Gaussians, P pixels of a view.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from scipy.spatial.transform import Rotation

from tidefield import SOFTWARE
from tidefield.errors import RunError
from tidefield.files import completed_file
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.machine import memory_bytes
from tidefield.model.rendering import Render, Rendering
from tidefield.render.consistency import ViewPoints, choose_points
from tidefield.render.stills import MIN_OPACITY

SH_0 = math.sqrt(1 / (4 * math.pi))
"""The constant harmonic: colour = 0.5 + SH_0 f_dc (Kerbl et al.)."""
WIDTH = 0.7
"""Standard deviation of a Gaussian along the surface, in cells: neighbours overlap without blurring much."""
FLATNESS = 0.1
"""Standard deviation across the surface over that along it."""
OPACITY = 0.95
STEEPEST = 0.15
"""Least cosine between the surface and a ray: flatter pixels are edges between near and far."""
MOST = 20_000_000
PIXEL_BYTES = 120
"""What is held of a view's pixel until all views are rendered and points are chosen."""


@dataclass(frozen=True)
class Gaussians:
    """G flat Gaussians.

    Attributes:
        mean_world: centres, relative to the scene's origin.
        normal_world: unit normals, towards the cameras.
        rgb: colours at the common exposure, in [0, 1].
        sigma: standard deviation along the surface, world units.
    """

    mean_world: Float64[np.ndarray, "G 3"]
    normal_world: Float64[np.ndarray, "G 3"]
    rgb: Float64[np.ndarray, "G 3"]
    sigma: float


@dataclass(frozen=True)
class SurfaceView:
    """What one view shows of the surface, a point per pixel.

    Attributes:
        points: where they are.
        normal_world: unit normals, towards the camera.
        rgb: colours at the common exposure, in [0, 1].
        footprint: how much of the surface a pixel shows, world units.
    """

    points: ViewPoints
    normal_world: Float64[np.ndarray, "P 3"]
    rgb: Float64[np.ndarray, "P 3"]
    footprint: Float64[np.ndarray, " P"]


def make_gaussians(
    render: Render, cameras: Cameras, width: int, progress: Callable[[int, int], None] | None = None
) -> Gaussians:
    """Make the Gaussians of a scene.

    Args:
        render: the method.
        cameras: whose views are rendered: those of the training photographs.
        width: of the views, pixels; the longer side of an upright one's is as long.
        progress: called with the number of views that are done, and of all.

    Raises:
        RunError: the views show nothing, or too much.
    """
    views = render_surfaces(render, cameras, width, progress)
    return fuse(views, choose_points([view.points for view in views]))


def render_surfaces(
    render: Render, cameras: Cameras, width: int, progress: Callable[[int, int], None] | None = None
) -> list[SurfaceView]:
    """Render the views of cameras, and find the surface in each; the arguments are those of `make_gaussians`.

    Raises:
        RunError: the points of all views do not fit into half of the memory.
    """
    scales = width / cameras.size_px.max(dim=1).values
    sizes = (cameras.size_px * scales[:, None]).round().long().clamp(min=16).tolist()
    needed = PIXEL_BYTES * sum(w * h for w, h in sizes)
    if needed > memory_bytes() / 2:
        raise RunError(
            f"{len(cameras):,} views of {width} px hold {needed / 1e9:.0f} GB of points: expected at most half of the "
            f"memory, {memory_bytes() / 2e9:.0f} GB; choose a smaller --width"
        )
    views = []
    for k, size in enumerate(sizes):
        own = cameras[k]
        # Nameless, so that a photograph serves in its own view; and in the common light.
        camera = replace(own, names=(), gain=torch.ones_like(own.gain), shading=None).resized(*size)
        views.append(_of_view(render(camera), camera))
        if progress is not None:
            progress(k + 1, len(cameras))
    return views


def _of_view(rendering: Rendering, camera: Cameras) -> SurfaceView:
    """Find the surface in one view."""
    height, width = rendering.depth.shape
    directions = camera.directions_world(pixel_grid(width, height)[None])[0].double().numpy()
    depth = rendering.depth.double().cpu().numpy()
    position = camera.position_world[0].double().numpy()
    xyz = position + directions * depth.reshape(-1, 1)
    grid = xyz.reshape(height, width, 3)
    normal = np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1)).reshape(-1, 3)
    # Keeps the division finite where neighbouring pixels show one point.
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    ray = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    cosine = -(normal * ray).sum(1)
    normal *= np.sign(cosine)[:, None]
    known = rendering.opacity.cpu().numpy().reshape(-1) >= MIN_OPACITY
    shown = known & (np.abs(cosine) > STEEPEST)
    footprint = depth.reshape(-1) / float(camera.focal_px[0].mean())
    rgb = rendering.colour.double().cpu().numpy().reshape(-1, 3)
    points = ViewPoints(camera, xyz, depth.reshape(-1).astype(np.float32), known, shown)
    return SurfaceView(points, normal, rgb, footprint)


def fuse(views: Sequence[SurfaceView], chosen: Sequence[Bool[np.ndarray, " P"]]) -> Gaussians:
    """Make Gaussians of the chosen points of views: one for each cell of space that holds any.

    A cell is as large as what half the shown pixels show at most.

    Raises:
        RunError: the views show nothing, or too much.
    """
    footprint = np.concatenate([view.footprint[view.points.shown] for view in views])
    if not len(footprint):
        raise RunError("the views show nothing: expected a scene with a surface; look at it with `tidefield view`")
    cell = float(np.median(footprint))
    parts = [
        (view.points.xyz_world[own], view.normal_world[own], view.rgb[own])
        for view, own in zip(views, chosen, strict=True)
    ]
    mean, normal, rgb = (np.concatenate(part) for part in zip(*parts, strict=True))
    found = _fused(mean, normal, rgb, cell)
    if len(found[0]) > MOST:
        raise RunError(f"{len(found[0]):,} Gaussians: expected at most {MOST:,}; choose a smaller --width")
    return Gaussians(*found, sigma=WIDTH * cell)


def _fused(
    mean: Float64[np.ndarray, "P 3"], normal: Float64[np.ndarray, "P 3"], rgb: Float64[np.ndarray, "P 3"], cell: float
) -> tuple[Float64[np.ndarray, "G 3"], Float64[np.ndarray, "G 3"], Float64[np.ndarray, "G 3"]]:
    """The means of what lies in each cell of space."""
    index = np.floor((mean - mean.min(0)) / cell).astype(np.int64)
    _, which, count = np.unique(index, axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)

    def means(values: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, "G 3"]:
        sums = [np.bincount(which, values[:, k], len(count)) for k in range(3)]
        return np.stack(sums, axis=1) / count[:, None]

    direction = means(normal)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    up = np.where(length > 1e-6, direction / np.maximum(length, 1e-6), (0.0, 0.0, 1.0))
    return means(mean), up, means(rgb)


def write_gaussians(gaussians: Gaussians, path: Path, origin_world: Sequence[float], overwrite: bool = False) -> None:
    """Write Gaussians as a binary PLY file.

    Centres are relative to the scene's origin, which is in the file's comments: 32-bit numbers cannot hold coordinates
    of a national grid to the millimetre.

    Raises:
        RunError: the file exists and must not be overwritten, or its folder cannot be written to.
    """
    from plyfile import PlyData, PlyElement

    count = len(gaussians.mean_world)
    constant = {
        "opacity": math.log(OPACITY / (1 - OPACITY)),
        "scale_0": math.log(gaussians.sigma),
        "scale_1": math.log(gaussians.sigma),
        "scale_2": math.log(FLATNESS * gaussians.sigma),
    }
    columns: dict[str, np.ndarray | float] = {
        **dict(zip("xyz", gaussians.mean_world.T, strict=True)),
        **dict(zip(("nx", "ny", "nz"), gaussians.normal_world.T, strict=True)),
        **{f"f_dc_{k}": (gaussians.rgb[:, k] - 0.5) / SH_0 for k in range(3)},
        **constant,
        **{f"rot_{k}": column for k, column in enumerate(_quaternions(gaussians.normal_world).T)},
    }
    vertex = np.empty(count, [(name, "<f4") for name in columns])
    for name, column in columns.items():
        vertex[name] = column
    origin = " ".join(f"{value:.6f}" for value in origin_world)
    comments = [SOFTWARE, f"origin_world {origin}"]
    with completed_file(path, overwrite=overwrite) as partial:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<", comments=comments).write(partial)


def _quaternions(normal: Float64[np.ndarray, "G 3"]) -> Float32[np.ndarray, "G 4"]:
    """Rotations (w, x, y, z) that take the third axis to the normals."""
    # Any axis that is not along the normal.
    helper = np.where(np.abs(normal[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal, first), normal], axis=2)
    return np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1).astype(np.float32)
