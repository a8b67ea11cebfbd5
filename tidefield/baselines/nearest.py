"""The nearest-photograph floor: what one would see by leafing to the photograph taken closest by.

Of the training photographs that look at the same place, the one whose camera is nearest is shown on the surface that
the sparse points span; where it saw nothing, its colours are continued.
"""

from __future__ import annotations

from tidefield.baselines.photograph import read_photograph
from tidefield.data.scene import Scene
from tidefield.data.surface import in_frame, surface_depth, surface_points
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Render, Rendering, fill_unseen


def make(scene: Scene) -> Render:
    """The method for one scene; only its training photographs are read."""
    sources = scene.cameras[list(scene.train)]

    def render(camera: Cameras) -> Rendering:
        depth = surface_depth(camera, scene.points, scene.cameras)
        points_world = surface_points(camera, depth)
        uv, z = sources.project(points_world)
        seen = in_frame(sources, uv, z)
        away = (sources.position_world - camera.position_world).norm(dim=-1)
        # Half of what the best overlapping photograph sees is overlap enough to be the nearest.
        overlap = seen.float().mean(1)
        away = away.masked_fill(overlap < overlap.max() / 2, float("inf"))
        best = int(away.argmin())
        mine = seen[best]
        colour = points_world.new_zeros(len(points_world), 3)
        if mine.any():
            colour[mine] = read_photograph(scene, scene.train[best], uv[best, mine])
        filled = fill_unseen(colour.reshape(*depth.shape, 3), mine.reshape(depth.shape)) * camera.gain[0]
        return Rendering(colour=filled.clamp(0, 1), depth=depth, opacity=mine.reshape(depth.shape).to(depth))

    return render
