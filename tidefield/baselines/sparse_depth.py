"""The sparse-depth floor: photographs blended on the surface that the sparse points span.

No training, no search: every pixel's depth is interpolated from the sparse points, and the four photographs that look
at that surface point from the most similar directions are averaged, weighted as in unstructured lumigraph rendering
(Buehler et al., 2001). On bland ground with dense overlap this scores high almost for free.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.baselines.photograph import read_photograph
from tidefield.data.scene import Scene
from tidefield.data.surface import in_frame, surface_depth, surface_points
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.rays import angle_between
from tidefield.model.fill import fill_unseen
from tidefield.model.rendering import Render, Rendering

VIEWS = 4
SOFTNESS_RAD = 0.02  # angle at which a photograph's weight has halved: below it differences in angle hardly matter
CHUNK = 2**22  # photographs x pixels handled at once, which bounds memory to some 200 MB


def make(scene: Scene) -> Render:
    """The method for one scene; only its training photographs are read."""
    sources = scene.cameras[list(scene.train)]

    def render(camera: Cameras) -> Rendering:
        depth = surface_depth(camera, scene.points, scene.cameras)
        points_world = surface_points(camera, depth)
        chunks = points_world.split(max(1, CHUNK // len(sources)))
        blended = torch.cat([_blend(scene, sources, camera, chunk) for chunk in chunks])
        colour, weight = blended[:, :3].reshape(*depth.shape, 3), blended[:, 3].reshape(depth.shape)
        colour = fill_unseen(colour, weight > 0) * camera.gain[0]
        return Rendering(colour=colour.clamp(0, 1), depth=depth, opacity=(weight > 0).to(depth))

    return render


def _blend(scene: Scene, sources: Cameras, camera: Cameras, points_world: Float[Tensor, "P 3"]) -> Float[Tensor, "P 4"]:
    """Weighted mean colour of each surface point, and the sum of its weights: 0 where no photograph sees it."""
    uv, z = sources.project(points_world)
    angle = _angles(camera, sources, points_world)
    angle = angle.masked_fill(~in_frame(sources, uv, z), torch.inf)
    nearest, which = angle.topk(min(VIEWS + 1, len(sources)), dim=0, largest=False)
    # The weight falls to 0 at the first photograph left out, so that no seam shows where the choice changes.
    limit = nearest[VIEWS] if len(sources) > VIEWS else torch.full_like(nearest[0], torch.inf)
    weight = (1 - nearest[:VIEWS] / limit).clamp(min=1e-3) / (nearest[:VIEWS] + SOFTNESS_RAD)
    weight = torch.where(nearest[:VIEWS].isfinite(), weight, torch.zeros_like(weight))
    total = points_world.new_zeros(len(points_world), 3)
    for source, index in enumerate(scene.train):
        rank, point = torch.nonzero((which[:VIEWS] == source) & (weight > 0), as_tuple=True)
        if len(point):
            colour = read_photograph(scene, index, uv[source, point])
            total[point] += weight[rank, point, None] * colour
    weight_sum = weight.sum(0)[:, None]
    return torch.cat([torch.where(weight_sum > 0, total / weight_sum, total), weight_sum], dim=-1)


def _angles(camera: Cameras, sources: Cameras, points_world: Float[Tensor, "P 3"]) -> Float[Tensor, "V P"]:
    """Angle at each point between the directions to `camera` and to each source, radians."""
    ours = torch.nn.functional.normalize(points_world - camera.position_world, dim=-1)
    theirs = torch.nn.functional.normalize(points_world - sources.position_world[:, None], dim=-1)
    return angle_between(ours, theirs)
