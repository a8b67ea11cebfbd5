"""The untrained baselines: `nearest`, `plane_sweep`, `sparse_depth` make a `Render` from a scene at once.

All read nothing but the training photographs and, except for the plane sweep, the sparse points. Where no photograph
sees a pixel's surface point, the colours next to it are continued, and the opacity is 0.

Alphabet: V photographs, P points, H W pixels.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from tidefield.data.load import load_scene
from tidefield.data.matching import blend_weights
from tidefield.data.scene import Scene
from tidefield.data.surface import in_frame, surface_depth, surface_points
from tidefield.geometry.cameras import Cameras, angle_between
from tidefield.model.rendering import Render, Rendering, fill_unseen
from tidefield.model.views import pixel_means, upsample_twice

CHUNK = 2**22
"""Photographs x pixels that `sparse_depth` handles at once, which bounds its memory to some 200 MB."""
CUBIC_REACH_PX = 2
"""Pixels around a position that its colour depends on."""
DEPTHS = 64
"""Planes of `plane_sweep`."""
WINDOW_PX = 5
"""Side of the window over which `plane_sweep` averages its cost."""
NEIGHBOURS = 8
"""Photographs that `plane_sweep` compares."""
USUAL_SPREAD = 0.1
"""Of colours between photographs, per channel; stands in for what too few photographs cannot show."""


def read_photograph(
    scene: Scene, index: int, uv_px: Float[Tensor, "P 2"], doubled: Scene | None = None
) -> Float[Tensor, "P 3"]:
    """Read colours of one photograph at pixels inside its frame, at the scene's common exposure.

    Reads as our network does, means over pixels of the scene at twice the size (`pixel_means`) or else interpolated
    ones (`upsample_twice`), so that what is better than these baselines is not better for sharper reading.
    """
    photograph = scene.photographs[index]
    # Only the part that is needed is turned into floats: memory follows the caller's chunk, not the photograph.
    low = (uv_px.amin(0) - CUBIC_REACH_PX).long().clamp(min=0)
    left, top = low.tolist()
    right, bottom = (uv_px.amax(0) + CUBIC_REACH_PX + 1).long().tolist()
    if doubled is None:
        crop, texels_from = photograph[top:bottom, left:right], upsample_twice
    else:
        crop = doubled.photographs[index][2 * top : 2 * bottom, 2 * left : 2 * right]
        texels_from = pixel_means
    texels = texels_from(crop.to(uv_px.device, uv_px.dtype).permute(2, 0, 1)[None])
    texel = 2 * (uv_px - low) - 0.5  # twice as many texels as pixels, of which the first is centred on the first pixel
    grid = 2 * texel / uv_px.new_tensor([texels.shape[3], texels.shape[2]]) - 1
    colour = F.grid_sample(texels, grid[None, None], padding_mode="border", align_corners=False)
    return colour[0, :, 0].T / 255 / scene.cameras[index].gain_at(uv_px[None])[0].to(uv_px)


def nearest(scene: Scene, doubled: Scene | None = None) -> Render:
    """Project the nearest photograph onto the surface through the sparse points.

    Only photographs that see at least half as much of that surface as the best of them are candidates.
    """

    def render(camera: Cameras) -> Rendering:
        indices = scene.sources(camera)
        sources = scene.cameras[list(indices)]
        depth = surface_depth(camera, scene.points, scene.cameras)
        points_world, masks_of = surface_points(camera, depth), scene.photographs.masks_of
        overlap = torch.zeros(len(indices), dtype=torch.long)
        for chunk in points_world.split(max(1, CHUNK // len(indices))):
            overlap += in_frame(sources, *sources.project(chunk), masks_of(indices)).sum(1)
        distance = (sources.position_world - camera.position_world).norm(dim=-1)
        best = int(distance.masked_fill(overlap < overlap.max() / 2, torch.inf).argmin())
        uv, z = sources[best].project(points_world)
        seen = in_frame(sources[best], uv, z, masks_of([indices[best]]))[0]
        colour = torch.zeros_like(points_world)
        if seen.any():
            colour[seen] = read_photograph(scene, indices[best], uv[0, seen], doubled)
        return _filled(camera, colour, depth, seen)

    return render


def sparse_depth(scene: Scene, doubled: Scene | None = None) -> Render:
    """Blend the four photographs of the most similar directions on the surface through the sparse points.

    The weights are `blend_weights`. On plain ground with dense overlap this scores high for nearly no work.
    """

    def render(camera: Cameras) -> Rendering:
        indices = scene.sources(camera)
        depth = surface_depth(camera, scene.points, scene.cameras)
        chunks = surface_points(camera, depth).split(max(1, CHUNK // len(indices)))
        blended = torch.cat([_blend(scene, doubled, indices, camera, chunk) for chunk in chunks])
        return _filled(camera, blended[:, :3], depth, blended[:, 3] > 0)

    return render


def sparse_depth_as_given(scene: Scene, doubled: Scene | None = None) -> Render:
    """Blend like `sparse_depth`, without the lens residual and the shading that are estimated when a scene is opened.

    It tells what these two bring, which every other method shares (docs/method.md, sections 12 and 14). What depends on
    the direction of view alone stays: gains are estimated with it.
    """
    width = int(scene.cameras.size_px[:, 0].max())
    given = load_scene(scene.root, width=width, allow_missing=True, hold_out=bool(scene.test), calibrate=False)
    blend = sparse_depth(given, doubled)

    def render(camera: Cameras) -> Rendering:
        shading = given.cameras[given.index(camera.names[0])].shading if camera.names else None
        return blend(replace(camera, residual=None, shading=shading))

    return render


def plane_sweep(
    scene: Scene, doubled: Scene | None = None, *, depths: int = DEPTHS, neighbours: int = NEIGHBOURS
) -> Render:
    """Blend photographs at the depth at which they match best (Collins, 1996); reads no sparse points.

    Planes parallel to the image, evenly spaced in inverse depth between the camera's near and far; the photographs'
    colour variance on each plane, averaged over a window; the plane of least variance; the photographs' mean there.
    """

    def render(camera: Cameras) -> Rendering:
        views = nearest_photographs(scene, camera, neighbours)
        depth = _sweep(scene, doubled, camera, views, depths)
        colour, count, _ = _match(scene, doubled, camera, views, depth)
        return _filled(camera, colour.flatten(0, 1), depth, (count > 0).flatten())

    return render


def nearest_photographs(scene: Scene, camera: Cameras, count: int) -> list[int]:
    """Choose the training photographs that see most of what a camera sees, from the most similar directions.

    Ranked by the mean angle at points of the middle plane between the camera's ray and the photograph's, a point
    outside the photograph counting as a right angle.
    """
    small = camera.resized(16, 16)
    points_world = surface_points(small, surface_depth(small, None, scene.cameras))
    indices = scene.sources(camera)
    sources = scene.cameras[list(indices)]
    uv, z = sources.project(points_world)
    angle = _angles(camera, sources, points_world)
    seen = in_frame(sources, uv, z, scene.photographs.masks_of(indices))
    angle = torch.where(seen, angle, torch.pi / 2).mean(1)
    return [indices[i] for i in angle.argsort()[:count].tolist()]


def _filled(
    camera: Cameras, colour: Float[Tensor, "P 3"], depth: Float[Tensor, "H W"], seen: Bool[Tensor, " P"]
) -> Rendering:
    """A rendering at the camera's exposure, with unseen pixels filled from those next to them."""
    visible = seen.reshape(depth.shape)
    filled = fill_unseen(colour.reshape(*depth.shape, 3), visible) * camera.gain_of_rows()
    return Rendering(colour=filled.clamp(0, 1), depth=depth, opacity=visible.to(depth))


def _angles(camera: Cameras, sources: Cameras, points_world: Float[Tensor, "P 3"]) -> Float[Tensor, "V P"]:
    """Angle at each point between the directions to `camera` and to each source, radians."""
    ours = F.normalize(points_world - camera.position_world, dim=-1)
    theirs = F.normalize(points_world - sources.position_world[:, None], dim=-1)
    return angle_between(ours, theirs)


def _blend(
    scene: Scene,
    doubled: Scene | None,
    indices: tuple[int, ...],
    camera: Cameras,
    points_world: Float[Tensor, "P 3"],
) -> Float[Tensor, "P 4"]:
    """Weighted mean colour of each surface point, and the sum of its weights: 0 where no photograph sees it."""
    sources = scene.cameras[list(indices)]
    uv, z = sources.project(points_world)
    angle = _angles(camera, sources, points_world)
    seen = in_frame(sources, uv, z, scene.photographs.masks_of(indices))
    angle = angle.masked_fill(~seen, torch.inf)
    weight, which = blend_weights(angle)
    total = points_world.new_zeros(len(points_world), 3)
    for source, index in enumerate(indices):
        rank, point = torch.nonzero((which == source) & (weight > 0), as_tuple=True)
        if len(point):
            total[point] += weight[rank, point, None] * read_photograph(scene, index, uv[source, point], doubled)
    weight_sum = weight.sum(0)[:, None]
    return torch.cat([torch.where(weight_sum > 0, total / weight_sum, total), weight_sum], dim=-1)


def _sweep(scene: Scene, doubled: Scene | None, camera: Cameras, views: list[int], depths: int) -> Float[Tensor, "H W"]:
    """The depth of least variance; the middle plane where no depth has two photographs to compare."""
    near, far = camera.near_far[0]
    shape = (camera.height, camera.width)
    best_depth = (2 / (1 / near + 1 / far)).expand(shape).clone()
    best_cost = torch.full(shape, torch.inf, device=near.device)
    for share in torch.linspace(0, 1, depths).tolist():
        depth = 1 / ((1 - share) / near + share / far)
        _, count, variance = _match(scene, doubled, camera, views, depth.expand(shape))
        cost = _windowed(variance, count >= 2)
        better = cost < best_cost
        best_cost = torch.where(better, cost, best_cost)
        best_depth = torch.where(better, depth, best_depth)
    return best_depth


def _match(
    scene: Scene, doubled: Scene | None, camera: Cameras, views: list[int], depth: Float[Tensor, "H W"]
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Mean colour of the photographs that see each pixel's point, how many do, and the variance of that mean."""
    points_world = surface_points(camera, depth)
    total = points_world.new_zeros(len(points_world), 3)
    squares, count = torch.zeros_like(total), torch.zeros_like(total[:, :1])
    for index in views:
        source = scene.cameras[index]
        uv, z = source.project(points_world)
        inside = in_frame(source, uv, z, scene.photographs.masks_of([index]))[0]
        if not inside.any():
            continue
        colour = read_photograph(scene, index, uv[0, inside], doubled)
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
