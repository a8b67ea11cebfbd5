"""The plane-sweep floor: per pixel, the depth at which the neighbouring photographs agree best (Collins, 1996).

Planes parallel to the image, evenly spaced in inverse depth between the camera's near and far; the neighbours' colour
variance on each plane, averaged over a window; the plane of least variance; the mean of the neighbours' colours there.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from tidefield.baselines.photograph import read_photograph
from tidefield.data.scene import Scene
from tidefield.data.surface import in_frame, surface_depth, surface_points
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.rays import angle_between
from tidefield.model.fill import fill_unseen
from tidefield.model.rendering import Render, Rendering

DEPTHS = 64
WINDOW_PX = 5
NEIGHBOURS = 8
USUAL_SPREAD = 0.1  # of colours between photographs, per channel; stands in for what too few photographs cannot show


def make(scene: Scene, *, depths: int = DEPTHS, neighbours: int = NEIGHBOURS) -> Render:
    """The method for one scene; only its training photographs are read, and no sparse points."""

    def render(camera: Cameras) -> Rendering:
        views = nearest_photographs(scene, camera, neighbours)
        depth = _sweep(scene, camera, views, depths)
        colour, count, _ = _agreement(scene, camera, views, depth)
        seen = count > 0
        colour = fill_unseen(colour, seen) * camera.gain[0]
        return Rendering(colour=colour.clamp(0, 1), depth=depth, opacity=seen.to(depth))

    return render


def nearest_photographs(scene: Scene, camera: Cameras, count: int) -> list[int]:
    """The training photographs that see most of what the camera sees, from the most similar directions.

    Ranked by the mean angle at points of the middle plane between the camera's ray and the photograph's, a point
    outside the photograph counting as a right angle.
    """
    small = camera.resized(16, 16)
    points_world = surface_points(small, surface_depth(small, None, scene.cameras))
    sources = scene.cameras[list(scene.train)]
    uv, z = sources.project(points_world)
    ours = F.normalize(points_world - camera.position_world, dim=-1)
    theirs = F.normalize(points_world - sources.position_world[:, None], dim=-1)
    angle = angle_between(ours, theirs)
    angle = torch.where(in_frame(sources, uv, z), angle, torch.pi / 2).mean(1)
    return [scene.train[i] for i in angle.argsort()[:count].tolist()]


def _sweep(scene: Scene, camera: Cameras, views: list[int], depths: int) -> Float[Tensor, "H W"]:
    """The depth of least variance; the middle plane where no depth has two photographs to compare."""
    near, far = camera.near_far[0]
    shape = (camera.height, camera.width)
    best_depth = (2 / (1 / near + 1 / far)).expand(shape).clone()
    best_cost = torch.full(shape, torch.inf, device=near.device)
    for share in torch.linspace(0, 1, depths).tolist():
        depth = 1 / ((1 - share) / near + share / far)
        _, count, variance = _agreement(scene, camera, views, depth.expand(shape))
        cost = _windowed(variance, count >= 2)
        better = cost < best_cost
        best_cost = torch.where(better, cost, best_cost)
        best_depth = torch.where(better, depth, best_depth)
    return best_depth


def _agreement(
    scene: Scene, camera: Cameras, views: list[int], depth: Float[Tensor, "H W"]
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Mean colour of the photographs that see each pixel's point, how many do, and the variance of that mean."""
    points_world = surface_points(camera, depth)
    total = points_world.new_zeros(len(points_world), 3)
    squares, count = torch.zeros_like(total), torch.zeros_like(total[:, :1])
    for index in views:
        source = scene.cameras[index]
        uv, z = source.project(points_world)
        inside = in_frame(source, uv, z)[0]
        if not inside.any():
            continue
        colour = read_photograph(scene, index, uv[0, inside])
        total[inside] += colour
        squares[inside] += colour.square()
        count[inside] += 1
    mean = total / count.clamp(min=1)
    # Squared standard error of the mean, not the bare variance: where few photographs can check a depth, they agree
    # by chance, and on thin overlap the nearest planes would win for being seen by two.
    variance = ((squares - count * mean.square()).sum(-1) + 3 * USUAL_SPREAD**2) / count[:, 0].clamp(min=1).square()
    return mean.reshape(*depth.shape, 3), count.reshape(depth.shape), variance.reshape(depth.shape)


def _windowed(variance: Float[Tensor, "H W"], valid: Bool[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Mean variance over the valid pixels of a window around each valid pixel; infinite at the others."""
    stacked = torch.stack([torch.where(valid, variance, 0), valid.to(variance)])[:, None]
    sums = F.avg_pool2d(stacked, WINDOW_PX, stride=1, padding=WINDOW_PX // 2)[:, 0]
    return torch.where(valid, sums[0] / sums[1].clamp(min=1e-6), torch.inf)
