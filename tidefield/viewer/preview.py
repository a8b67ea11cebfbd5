"""Coarse pictures at once: photographs moved into another view by the depth of the sparse points' surface.

A network needs seconds for a picture on two cores, and a moving camera needs many a second. Here each of a few
photographs is taken at about the picture's size, its pixels are moved to where the free camera shows them (McMillan and
Bishop, Plenoptic modeling, 1995), and what no pixel reaches is continued from next to it. The last sharp picture is
moved in the same way, before all photographs: while the camera rests nearby, its depth is better than theirs.

Alphabet: P pixels of a photograph, H W pixels of the picture.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32

from tidefield.data.exposure import to_common_exposure
from tidefield.data.scene import Scene
from tidefield.data.surface import surface_depth
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.model.rendering import Rendering, fill_unseen

SOURCES = 4
"""Photographs that a coarse picture is made from."""
SOURCE_PX = 256
"""Width that photographs are read at, about."""
KEPT = 64
"""Photographs that are kept ready, the last used ones: 1.5 MB each."""
TURN_WEIGHT = 0.5
"""Distance, as a share of the distance to the surface, that a turn of one radian counts as."""


@dataclass(frozen=True)
class ColouredPoints:
    """The pixels of one picture as points of the world, with their colours at the scene's common exposure."""

    xyz_world: Float32[np.ndarray, "P 3"]
    rgb: Float32[np.ndarray, "P 3"]


def points_of(rendering: Rendering, camera: Cameras) -> ColouredPoints:
    """Return the pixels of a rendering that show something as points of the world."""
    seen = (rendering.opacity > 0.5).reshape(-1).cpu().numpy()
    xyz = _unproject(camera, rendering.depth.reshape(-1).float().cpu())
    return ColouredPoints(xyz[seen], rendering.colour.reshape(-1, 3).float().cpu().numpy()[seen])


class Preview:
    """Makes coarse pictures of a scene.

    Args:
        scene: its training photographs are what pictures are made from.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._kept: OrderedDict[int, ColouredPoints] = OrderedDict()
        train = scene.cameras[list(scene.train)]
        self._position, self._forward = train.position_world, train.forward_world
        self._distance = float(train.near_far.mean())
        self._wanted: list[int] = []

    def __call__(self, camera: Cameras, last: ColouredPoints | None = None) -> Rendering:
        """Make the picture of one camera.

        Args:
            camera: a single camera, at the common exposure.
            last: what a sharp picture from nearby has shown.
        """
        away = (self._position - camera.position_world).norm(dim=1) / self._distance
        turn = (self._forward @ camera.forward_world[0]).clamp(-1, 1).acos()
        ranked = [self.scene.train[i] for i in (away + TURN_WEIGHT * turn).argsort().tolist()]
        self._wanted = [i for i in ranked[:SOURCES] if i not in self._kept]
        ready = [i for i in ranked[: 3 * SOURCES] if i in self._kept][:SOURCES] or ranked[:1]
        layers = [] if last is None else [last]
        layers += [self._points(i) for i in ready]
        colour = np.zeros((camera.height * camera.width, 3), np.float32)
        depth = np.full(camera.height * camera.width, np.inf, np.float32)
        for points in layers:
            _splat(points, camera, colour, depth)
        seen = torch.from_numpy(np.isfinite(depth)).reshape(camera.height, camera.width)
        shown = torch.from_numpy(colour).reshape(camera.height, camera.width, 3)
        z = torch.from_numpy(depth).reshape(camera.height, camera.width, 1)
        z = fill_unseen(torch.where(seen[..., None], z, 0).expand(-1, -1, 3), seen)[..., 0]
        return Rendering(colour=fill_unseen(shown, seen), depth=z, opacity=seen.to(z))

    def prepare(self) -> bool:
        """Make one photograph ready, those that the last picture lacked first; returns whether there was one to do."""
        wanted = [i for i in self._wanted if i not in self._kept]
        if not wanted and len(self._kept) < KEPT:
            wanted = [i for i in self.scene.train if i not in self._kept]
        if wanted:
            self._points(wanted[0])
        return bool(wanted)

    def _points(self, index: int) -> ColouredPoints:
        """The points of a photograph, from the ones that are kept or made now."""
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        camera, used = self.scene.cameras[index], self.scene.photographs.used(index)
        step = max(1, round(camera.width / SOURCE_PX))
        lines = slice(step // 2, None, step)
        rgb = to_common_exposure(self.scene, index, lines, lines)
        height, width = rgb.shape[:2]
        small = camera.resized(width, height)
        xyz = _unproject(small, surface_depth(small, self.scene.points, self.scene.cameras).reshape(-1))
        shown = used[lines, lines].reshape(-1).numpy()
        points = ColouredPoints(xyz[shown], rgb.reshape(-1, 3).numpy()[shown].clip(0, 1))
        self._kept[index] = points
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return points


def _unproject(camera: Cameras, depth: Float[torch.Tensor, " P"]) -> Float32[np.ndarray, "P 3"]:
    camera = replace(camera.to("cpu"), shading=None)
    directions = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0]
    return (camera.position_world + directions * depth[:, None]).float().numpy()


def _splat(
    points: ColouredPoints,
    camera: Cameras,
    colour: Float32[np.ndarray, "N 3"],
    depth: Float32[np.ndarray, " N"],
) -> None:
    """Draw points into pixels that no earlier layer has reached, the nearest of each pixel last."""
    matrix = camera.projection[0].double().numpy()
    homogeneous = points.xyz_world @ matrix[:, :3].T.astype(np.float32) + matrix[:, 3].astype(np.float32)
    z = homogeneous[:, 2]
    ahead = np.flatnonzero(z > 1e-6 * np.abs(z).max(initial=1.0))
    uv = np.floor(homogeneous[ahead, :2] / z[ahead, None])
    inside = ((uv >= 0) & (uv < (camera.width, camera.height))).all(axis=1)
    ahead, uv = ahead[inside], uv[inside].astype(np.int64)
    pixel = uv[:, 1] * camera.width + uv[:, 0]
    free = ~np.isfinite(depth[pixel])
    ahead, pixel = ahead[free], pixel[free]
    order = np.argsort(-z[ahead], kind="stable")
    colour[pixel[order]] = points.rgb[ahead[order]]
    depth[pixel[order]] = z[ahead[order]]
