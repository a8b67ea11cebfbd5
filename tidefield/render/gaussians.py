"""Gaussians of a scene, for viewers that cannot run a network: from the colours and depths of its photographs' views.

Each pixel of the rendered views is a flat Gaussian on the surface, as wide as what the pixel shows, unless other views
see through it (`consistency`); those that share a cell of space are averaged. Nothing is optimised. The file is in the
layout of Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (2023), which SuperSplat, gsplat
and others open.

Alphabet: G Gaussians, P pixels of a view.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.spatial.transform import Rotation

from tidefield import SOFTWARE
from tidefield.errors import RunError
from tidefield.files import completed_file
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.machine import memory_bytes
from tidefield.model.rendering import Render, Rendering
from tidefield.render.consistency import ViewPoints, choose_points
from tidefield.render.stills import MIN_OPACITY

log = logging.getLogger(__name__)

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
"""Where there would be more, cells are larger."""
GROWTH = 1.25
PIXEL_BYTES = 160
"""What is held of a view's pixel at most: while the points of all views are sorted into cells."""
WRITTEN_AT_ONCE = 1 << 14


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
    """

    points: ViewPoints
    normal_world: Float64[np.ndarray, "P 3"]
    rgb: Float32[np.ndarray, "P 3"]


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
        RunError: the views show nothing, or their points do not fit into half of the memory.
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
    rgb = rendering.colour.cpu().numpy().reshape(-1, 3).astype(np.float32)
    points = ViewPoints(camera, xyz, depth.reshape(-1).astype(np.float32), known, shown)
    return SurfaceView(points, normal, rgb)


def fuse(views: Sequence[SurfaceView], chosen: Sequence[Bool[np.ndarray, " P"]]) -> Gaussians:
    """Make Gaussians of the chosen points of views: one for each cell of space that holds any.

    A cell is as large as what half the shown pixels show at most, or larger where there would be more than `MOST`.

    Raises:
        RunError: the views show nothing.
    """
    points = [view.points for view in views]
    footprint = np.concatenate([np.float64(of.depth[of.shown]) / float(of.camera.focal_px[0].mean()) for of in points])
    if not len(footprint):
        raise RunError("the views show nothing: expected a scene with a surface; look at it with `tidefield view`")
    cell = finest = float(np.median(footprint))

    def columns(values: Sequence[np.ndarray]) -> Iterable[np.ndarray]:
        """The coordinates of the chosen points, one after the other: all at once would double what is held."""
        return (np.concatenate([of[own, k] for of, own in zip(values, chosen, strict=True)]) for k in range(3))

    xyz = [of.xyz_world for of in points]
    which = _cells(columns(xyz), cell)
    while which.max() >= MOST:
        cell *= GROWTH
        which = _cells(columns(xyz), cell)
    if cell > finest:
        log.warning(
            f"a cell for what each pixel shows would make more than {MOST:,} Gaussians: cells are {cell / finest:.3g} "
            "times as wide; a smaller --width takes less time for the same"
        )
    count = np.bincount(which)[:, None]

    def means(values: Sequence[np.ndarray]) -> Float64[np.ndarray, "G 3"]:
        sums = np.stack([np.bincount(which, column) for column in columns(values)], axis=1)
        sums /= count
        return sums

    mean, rgb, normal = means(xyz), means([view.rgb for view in views]), means([view.normal_world for view in views])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.maximum(length, 1e-6)
    normal[length[:, 0] <= 1e-6] = (0.0, 0.0, 1.0)
    return Gaussians(mean, normal, rgb, sigma=WIDTH * cell)


def _cells(columns: Iterable[Float64[np.ndarray, " P"]], cell: float) -> Int64[np.ndarray, " P"]:
    """Number the cells of space that points lie in, by their first coordinate, then by the others."""
    which = np.zeros(1, np.int64)
    for column in columns:
        # Ranks, since indices themselves, where one point lies far away, have products beyond 64 bits.
        column -= column.min()
        column /= cell
        rank = np.unique(np.floor(column, out=column), return_inverse=True)[1]
        which = np.unique(which * (rank.max() + 1) + rank, return_inverse=True)[1]
    return which


def write_gaussians(gaussians: Gaussians, path: Path, origin_world: Sequence[float], overwrite: bool = False) -> None:
    """Write Gaussians as a binary PLY file.

    Centres are relative to the scene's origin, which is in the file's comments: 32-bit numbers cannot hold coordinates
    of a national grid to the millimetre.

    Raises:
        RunError: the file exists and must not be overwritten, or its folder cannot be written to.
    """
    from plyfile import PlyData, PlyElement

    names = ("x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), "opacity")
    names = (*names, *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)))
    table = np.empty((len(gaussians.mean_world), len(names)), "<f4")
    table[:, :3], table[:, 3:6] = gaussians.mean_world, gaussians.normal_world
    table[:, 9], table[:, 10:12] = math.log(OPACITY / (1 - OPACITY)), math.log(gaussians.sigma)
    table[:, 12] = math.log(FLATNESS * gaussians.sigma)
    for first in range(0, len(table), WRITTEN_AT_ONCE):
        part = slice(first, first + WRITTEN_AT_ONCE)
        table[part, 6:9] = (gaussians.rgb[part] - 0.5) / SH_0
        table[part, 13:] = _quaternions(gaussians.normal_world[part])
    vertex = table.view([(name, "<f4") for name in names])[:, 0]
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
