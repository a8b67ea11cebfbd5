"""A textured wall seen by a few cameras: a scene in memory whose every pixel and depth is known."""

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from tidefield.data.images import Photographs
from tidefield.data.scene import Scene, SparsePoints
from tidefield.geometry.cameras import Cameras, pixel_grid

DEPTH = 5.0


def cameras(count: int, width: int = 48, height: int = 36, step: float = 0.3) -> Cameras:
    """Side by side along x, looking along +z from z = 0."""
    pose = torch.eye(3, 4).repeat(count, 1, 1)
    pose[:, 0, 3] = step * (torch.arange(count) - (count - 1) / 2)
    return Cameras(
        T_world_camera=pose,
        focal_px=torch.full((count, 2), float(width)),
        principal_px=torch.tensor([width / 2, height / 2]).repeat(count, 1),
        size_px=torch.tensor([width, height]).repeat(count, 1),
        near_far=torch.tensor([3.0, 10.0]).repeat(count, 1),
        gain=torch.ones(count, 3),
    )


def wall_z(xy: Tensor, tilt: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """The wall's z where it is met, as a function of world x and y."""
    return DEPTH + tilt[0] * xy[..., 0] + tilt[1] * xy[..., 1]


def texture(xy: Tensor) -> Tensor:
    """A colour in (0, 1) at each point of the wall; no two places look alike."""
    x, y = xy[..., 0], xy[..., 1]
    waves = [torch.sin(7 * x + 3 * torch.sin(5 * y + k)) + torch.sin((6 + k) * y - 2 * x * x) for k in range(3)]
    return 0.5 + 0.2 * torch.stack(waves, -1)


def true_depth(camera: Cameras, tilt: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """z-depth of the wall in every pixel of a camera that looks along +z."""
    directions = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0]
    start = camera.position_world[0]
    slope = directions[:, 2] - directions[:, :2] @ torch.tensor(tilt)
    return ((wall_z(start[:2], tilt) - start[2]) / slope).reshape(camera.height, camera.width)


def photograph(camera: Cameras) -> Tensor:
    """8-bit picture of the upright wall at the camera's gain."""
    directions = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0]
    xy = (camera.position_world[0] + directions * true_depth(camera).reshape(-1, 1))[:, :2]
    colour = (texture(xy) * camera.gain[0]).clamp(0, 1).reshape(camera.height, camera.width, 3)
    return (colour * 255).round().to(torch.uint8)


def points(own: Cameras, count: int = 400, tilt: tuple[float, float] = (0.0, 0.0)) -> SparsePoints:
    """Points spread over the wall, each observed by every camera."""
    xy = 6 * torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) - 3
    xyz = torch.cat([xy, wall_z(xy, tilt)[:, None]], -1)
    uv, _ = own.project(xyz)
    return SparsePoints(
        xyz_world=xyz,
        error_px=torch.zeros(count),
        point_index=torch.arange(count).repeat(len(own)),
        camera_index=torch.arange(len(own)).repeat_interleave(count),
        uv_px=uv.reshape(-1, 2),
    )


def scene(own: Cameras, test: tuple[int, ...] = (1,)) -> Scene:
    return Scene(
        root=Path("wall"),
        names=tuple(f"{i:02d}.jpg" for i in range(len(own))),
        cameras=own,
        photographs=Photographs(tuple(photograph(own[i]) for i in range(len(own)))),
        points=points(own),
        train=tuple(i for i in range(len(own)) if i not in test),
        test=test,
        origin_world=torch.zeros(3),
    )


def mixed_scene() -> Scene:
    """Photographs of two sizes, taking turns, one narrower than a tile."""
    size = torch.tensor([[48, 36], [40, 6]]).repeat(3, 1)
    return scene(replace(cameras(6), size_px=size, principal_px=size / 2))


def with_left_halves_masked(own: Scene, which: tuple[int, ...]) -> Scene:
    """The same scene; what is left of the middle of some photographs is not to be used."""
    mask = torch.arange(own.cameras.width) >= own.cameras.width // 2
    mask = mask.expand(own.cameras.height, -1).contiguous()
    masks = tuple(mask if i in which else None for i in range(len(own.names)))
    return replace(own, photographs=replace(own.photographs, masks=masks))


def with_gains(own: Cameras) -> Cameras:
    """The same cameras, each at another exposure and white balance."""
    gain = 0.7 + 0.5 * torch.rand(len(own), 3, generator=torch.Generator().manual_seed(1))
    return replace(own, gain=gain)
