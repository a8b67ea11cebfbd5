"""Scenes with cameras and points only: a survey, a forward-facing capture, an object."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from tidefield.data.images import Photographs
from tidefield.data.scene import Scene, SparsePoints
from tidefield.geometry.cameras import Cameras

TILT = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
TILT = TILT * torch.linalg.det(TILT)
"""Structure-from-motion's arbitrary axes: every scene here is rotated by this."""
UP = TILT[:, 2]


def scene_of(position: Tensor, forward: Tensor, image_up: Tensor, near_far=(2.0, 6.0), points=None) -> Scene:
    """A scene of N cameras, all of them training cameras, in rotated coordinates."""
    count = len(position)
    ahead = torch.nn.functional.normalize(forward.expand(count, 3), dim=1)
    right = torch.nn.functional.normalize(torch.linalg.cross(ahead, image_up.expand(count, 3)), dim=1)
    rotation = torch.stack([right, torch.linalg.cross(ahead, right), ahead], 2)
    pose = TILT @ torch.cat([rotation, position[:, :, None]], 2)
    cameras = Cameras(
        pose,
        torch.full((count, 2), 300.0),
        torch.tensor([200.0, 150.0]).repeat(count, 1),
        torch.tensor([400, 300]).repeat(count, 1),
        torch.tensor(near_far).repeat(count, 1),
        torch.ones(count, 3),
    )
    blank = Photographs(tuple(torch.zeros(2, 2, 3, dtype=torch.uint8) for _ in range(count)))
    names = tuple(f"{i:03d}.jpg" for i in range(count))
    everyone = tuple(range(count))
    return Scene(Path("nowhere"), names, cameras, blank, points, everyone, (), torch.zeros(3, dtype=torch.float64))


def survey(rows: int = 3, every: int = 1, turned: Sequence[int] = ()) -> Scene:
    """Boustrophedon nadir flight at 40 above a flat ground; the drone keeps its heading but on `turned` lines.

    One photograph every 5 along lines 12 apart, of which `every` one in so many is kept. On turned lines the heading is
    to the side.
    """
    lines = [
        torch.stack([torch.arange(13) * 5.0, torch.full((13,), 12.0 * r), torch.full((13,), 40.0)], 1)
        for r in range(rows)
    ]
    position = torch.cat([line if r % 2 == 0 else line.flip(0) for r, line in enumerate(lines)])[::every]
    ground = torch.cat(
        [
            torch.rand(400, 2, generator=torch.Generator().manual_seed(2)) * torch.tensor([60.0, 24.0]),
            torch.zeros(400, 1),
        ],
        1,
    )
    side = torch.isin((position[:, 1] / 12).round().long(), torch.tensor(turned, dtype=torch.long))
    heading = torch.where(side[:, None], torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
    scene = scene_of(position, torch.tensor([0.0, 0.0, -1.0]), heading, (20.0, 56.0))
    xyz = ground @ TILT.T
    uv, z = scene.cameras.project(xyz)
    seen = (z > 0) & (uv > 0).all(-1) & (uv < torch.tensor([400.0, 300.0])).all(-1)
    camera, point = seen.nonzero(as_tuple=True)
    return replace(scene, points=SparsePoints(xyz, torch.ones(400), point, camera, uv[seen]))


def motif() -> Scene:
    """Cameras close together before a wall, as in LLFF."""
    generator = torch.Generator().manual_seed(3)
    position = torch.rand(12, 3, generator=generator) * torch.tensor([4.0, 0.5, 2.0])
    return scene_of(position, torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]), (10.0, 40.0))


def object_scene() -> Scene:
    """Cameras on the upper half of a sphere of radius 4, pointing at its middle, in random order (Blender)."""
    generator = torch.Generator().manual_seed(4)
    azimuth = torch.rand(60, generator=generator) * 2 * math.pi
    height = 0.1 + 0.8 * torch.rand(60, generator=generator)
    level = (1 - height**2).sqrt()
    position = 4 * torch.stack([azimuth.cos() * level, azimuth.sin() * level, height], 1)
    return scene_of(position, -position, torch.tensor([0.0, 0.0, 1.0]))


def oblique() -> Scene:
    """The same flight with cameras tilted by 45 degrees: the ground below the flight is not in the photographs."""
    position = survey().cameras.position_world @ TILT
    return scene_of(position, torch.tensor([0.0, 1.0, -1.0]), torch.tensor([0.0, 1.0, 1.0]), (30.0, 90.0))


SCENES = {"survey": survey, "oblique": oblique, "facing": motif, "around": object_scene}


def angle(a: Tensor, b: Tensor) -> float:
    """Largest angle between unit vectors, degrees."""
    return float(torch.rad2deg(torch.acos((a * b).sum(-1).clamp(-1, 1))).max())
