"""Scenes that are no surveys: textured cards with holes, boxes and balls, seen from the front, from around, from above.

A network that is to find depth by comparing photographs must have seen more than flat ground: near things before far
ones, edges, holes, and ranges of depth that nobody told it.

Alphabet: K surfaces, V photographs, R rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.images import Photographs
from tidefield.data.scene import Scene
from tidefield.data.synthetic.parallel import in_parallel
from tidefield.data.synthetic.tracks import sparse_points
from tidefield.geometry.cameras import Cameras, pixel_grid

Rig = Literal["front", "around", "above"]
TEXTURE_PX = 256
TEXTURES = 10
SUPERSAMPLE = 2


@dataclass(frozen=True)
class Cards:
    """K rectangles, some with holes.

    Attributes:
        centre: their middles.
        u, v: from the middle to the middles of two sides.
        texture: which one each shows ...
        scale: ... how many times along its longer side ...
        holes: ... and the share of it that is not there.
        shine: strength of the light that they mirror.
    """

    centre: Float[Tensor, "K 3"]
    u: Float[Tensor, "K 3"]
    v: Float[Tensor, "K 3"]
    texture: Int[Tensor, " K"]
    scale: Float[Tensor, " K"]
    holes: Float[Tensor, " K"]
    shine: Float[Tensor, " K"]


def make_clutter(
    seed: int, views: int, width: int, rig: Rig, pictures: tuple[UInt8[Tensor, "_ _ 3"], ...] = (), white: bool = False
) -> Scene:
    """A scene in memory. The same arguments give the same pixels.

    Args:
        seed: of everything random.
        views: photographs; none is held out.
        width: of a photograph, pixels; its height is two thirds to three quarters of it.
        rig: where they are taken from.
        pictures: whose parts serve as textures, beside noise.
        white: nothing lies behind the things; else walls and ground do.
    """
    random = np.random.default_rng([seed, 4711])
    generator = torch.Generator().manual_seed(seed)
    cameras = _cameras(random, views, width, rig)
    textures = _textures(random, generator, pictures)
    cards = _cards(random, rig, white)
    sun = F.normalize(torch.from_numpy(random.normal(size=3)).float() + torch.tensor([0.0, 0.0, 1.5]), dim=0)
    tasks = [partial(_photograph, cards, textures, cameras[i], sun) for i in range(views)]
    photographs, depth = (torch.stack(parts) for parts in zip(*in_parallel(tasks, "cpu"), strict=True))
    near_far = torch.stack([_near_far(d) for d in depth])
    cameras = replace(cameras, near_far=near_far)
    return Scene(
        root=Path(f"clutter-{rig}-{seed}"),
        names=tuple(f"{i:03d}.png" for i in range(views)),
        cameras=cameras,
        photographs=Photographs(tuple(photographs)),
        points=sparse_points(cameras, photographs, depth, random),
        train=tuple(range(views)),
        test=(),
        origin_world=torch.zeros(3),
        background_rgb=(1.0, 1.0, 1.0) if white else None,
    )


def _near_far(depth: Float[Tensor, "H W"]) -> Float[Tensor, "2"]:
    known = depth[depth.isfinite()]
    if not len(known):
        return torch.tensor([0.5, 50.0])
    return torch.stack([0.9 * known.min(), 1.1 * known.max()])


def _cameras(random: np.random.Generator, views: int, width: int, rig: Rig) -> Cameras:
    """Things lie within some metres of the origin; z is up."""
    height = round(width * float(random.choice([2 / 3, 3 / 4])))
    focal = width * float(random.uniform(0.7, 1.3))
    if rig == "around":
        turn = random.uniform(0, 2 * math.pi, views)
        lift = np.arcsin(random.uniform(math.sin(0.1), math.sin(1.2), views))
        away = 4.5 * random.uniform(0.9, 1.1, views)
        position = (
            np.stack([np.cos(turn) * np.cos(lift), np.sin(turn) * np.cos(lift), np.sin(lift)], -1) * away[:, None]
        )
        aim = random.normal(0, 0.1, (views, 3))
    elif rig == "above":
        side = math.ceil(math.sqrt(views))
        spot = np.stack([np.arange(views) % side, np.arange(views) // side], -1) - (side - 1) / 2
        step = 6.0 * width / focal * random.uniform(0.15, 0.35)
        position = np.concatenate([spot * step + random.normal(0, 0.1, (views, 2)), np.full((views, 1), 6.0)], -1)
        aim = position + random.normal(0, 0.3, (views, 3)) - [0, 0, 6.0]
    else:
        spread = random.uniform(0.15, 0.6)
        offset = random.uniform(-spread, spread, (views, 2))
        position = np.stack([offset[:, 0], np.full(views, -5.0), 1 + offset[:, 1]], -1)
        aim = np.array([0, random.uniform(-2, 3), 1]) + random.normal(0, 0.05, (views, 3))
    forward = _unit(aim - position)
    up = np.array([0.0, 1.0, 0.0]) if rig == "above" else np.array([0.0, 0.0, 1.0])
    right = _unit(np.cross(forward, up))
    down = np.cross(forward, right)
    pose = np.concatenate([np.stack([right, down, forward], -1), position[..., None]], -1)
    return Cameras(
        T_world_camera=torch.from_numpy(pose).float(),
        focal_px=torch.full((views, 2), focal),
        principal_px=torch.tensor([width / 2, height / 2]).repeat(views, 1),
        size_px=torch.tensor([width, height]).repeat(views, 1),
        near_far=torch.tensor([0.5, 50.0]).repeat(views, 1),
        gain=torch.ones(views, 3),
    )


def _cards(random: np.random.Generator, rig: Rig, white: bool) -> Cards:
    """Cards and boxes of random sizes where the rig looks, and what lies behind them."""
    made: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]] = []
    reach = {"front": [2.2, 2.5, 1.6], "around": [0.9, 0.9, 0.7], "above": [5.0, 5.0, 0.5]}[rig]
    middle = {"front": [0, -0.5, 1], "around": [0, 0, 0.2], "above": [0, 0, 0.5]}[rig]
    for _ in range(int(random.integers(5, 30)) * (2 if rig == "above" else 1)):
        centre = np.array(middle) + random.uniform(-1, 1, 3) * reach
        axes = _turn(random)
        half = np.exp(random.uniform(math.log(0.1), math.log(0.8), 3)) * (0.6 if rig == "around" else 1.0)
        if random.random() < 0.5:
            made.append((centre, axes[0] * half[0], axes[1] * half[1], float(random.choice([0, 0.3, 0.5]))))
            continue
        for k in range(3):
            u, v = axes[(k + 1) % 3] * half[(k + 1) % 3], axes[(k + 2) % 3] * half[(k + 2) % 3]
            made += [(centre + sign * axes[k] * half[k], u, v, 0.0) for sign in (-1, 1)]
    x, y, z = np.eye(3)
    if not white:
        if rig == "front":
            far = random.uniform(3, 25)
            made.append((y * far, x * 3 * (far + 5), z * 3 * (far + 5), 0.0))
        if rig == "around":
            made += [
                (sign * 12 * axis, 13 * other, 13 * z, 0.0) for axis, other in ((x, y), (y, x)) for sign in (-1, 1)
            ]
        ground = {"front": -1.0, "around": -0.6, "above": 0.0}[rig]
        made.append((z * ground, x * 40, y * 40, 0.0))
    centre, u, v = (torch.from_numpy(np.stack(parts)).float() for parts in list(zip(*made, strict=True))[:3])
    count = len(made)
    longest = torch.maximum(u.norm(dim=1), v.norm(dim=1))
    texels_per_m = torch.from_numpy(np.exp(random.uniform(math.log(0.3), math.log(3), count))).float()
    return Cards(
        centre=centre,
        u=u,
        v=v,
        texture=torch.from_numpy(random.integers(0, TEXTURES, count)),
        scale=(longest * texels_per_m).clamp(min=0.1),
        holes=torch.tensor([hole for *_, hole in made]),
        shine=torch.from_numpy(random.choice([0.0, 0.0, 0.15, 0.4], count)).float(),
    )


def _textures(
    random: np.random.Generator, generator: torch.Generator, pictures: tuple[Tensor, ...]
) -> Float[Tensor, "K 4 S S"]:
    """Colours, and a height by which holes are cut."""
    textures = []
    for _ in range(TEXTURES):
        height = _noise(generator, float(random.uniform(0.6, 1.4)))
        if pictures and random.random() < 0.6:
            picture = pictures[int(random.integers(len(pictures)))]
            top, left = (int(random.integers(max(1, side - TEXTURE_PX))) for side in picture.shape[:2])
            part = picture[top : top + TEXTURE_PX, left : left + TEXTURE_PX].permute(2, 0, 1)[None].float() / 255
            colour = F.interpolate(part, (TEXTURE_PX, TEXTURE_PX), mode="bilinear", align_corners=False)[0]
        else:
            palette = torch.rand(4, 3, generator=generator)
            first, second = _noise(generator, float(random.uniform(0.2, 1.2))), _noise(generator, 0.4)
            if random.random() < 0.5:
                first = ((first - 0.5) * float(random.uniform(4, 30))).sigmoid()
            mixed = palette[0][:, None, None] * first + palette[1][:, None, None] * (1 - first)
            colour = mixed + 0.4 * (second - 0.5) * palette[2][:, None, None]
        tint = 1 + 0.3 * torch.randn(3, 1, 1, generator=generator)
        textures.append(torch.cat([(colour * tint).clamp(0, 1), height[None]]))
    return torch.stack(textures)


def _noise(generator: torch.Generator, falloff: float) -> Float[Tensor, "S S"]:
    """In [0, 1], evenly distributed; every octave has a share of the one before it."""
    total = torch.zeros(TEXTURE_PX, TEXTURE_PX)
    for octave in range(1, 8):
        grid = torch.rand(1, 1, 2**octave + 1, 2**octave + 1, generator=generator)
        finer = F.interpolate(grid, (TEXTURE_PX, TEXTURE_PX), mode="bicubic", align_corners=True)
        total += 2.0 ** (-falloff * octave) * finer[0, 0]
    rank = total.flatten().argsort().argsort()
    return (rank.float() / rank.numel()).reshape(total.shape)


def _photograph(
    cards: Cards, textures: Float[Tensor, "K 4 S S"], camera: Cameras, sun: Float[Tensor, "3"]
) -> tuple[UInt8[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """One photograph, and the z-depth at its pixels' centres; infinite where there is nothing."""
    width, height = camera.width, camera.height
    fine = camera.resized(width * SUPERSAMPLE, height * SUPERSAMPLE)
    colour, _ = _look(cards, textures, fine, sun)
    mean = F.avg_pool2d(colour.T.reshape(1, 3, fine.height, fine.width), SUPERSAMPLE)[0].permute(1, 2, 0)
    _, depth = _look(cards, textures, camera, sun)
    return (mean.clamp(0, 1) * 255).round().to(torch.uint8), depth.reshape(height, width)


def _look(
    cards: Cards, textures: Float[Tensor, "K 4 S S"], camera: Cameras, sun: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, " R"]]:
    """Colours and z-depths of what each ray meets first."""
    rays = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0]
    start = camera.position_world[0]
    depth = torch.full((len(rays),), torch.inf)
    colour = torch.ones(len(rays), 3)
    towards = F.normalize(rays, dim=-1)
    for k in range(len(cards.centre)):
        centre, u, v = cards.centre[k], cards.u[k], cards.v[k]
        normal = F.normalize(torch.linalg.cross(u, v), dim=0)
        at = ((centre - start) @ normal) / (rays @ normal)
        offset = start + rays * at[:, None] - centre
        a, b = offset @ u / (u @ u), offset @ v / (v @ v)
        meets = ((at > 0.05) & (at < depth) & (a.abs() <= 1) & (b.abs() <= 1)).nonzero()[:, 0]
        if not len(meets):
            continue
        ratio = v.norm() / u.norm()
        spot = torch.stack([a[meets], b[meets] * ratio], -1) / max(1.0, float(ratio)) * cards.scale[k]
        folded = 1 - (spot.remainder(4) - 2).abs()  # mirrored again and again
        texture = textures[cards.texture[k]][None]
        read = F.grid_sample(texture, folded[None, None], align_corners=False, padding_mode="border")[0, :, 0].T
        solid = read[:, 3] >= cards.holes[k]
        meets, read = meets[solid], read[solid]
        facing = torch.sign(-(towards[meets] @ normal))[:, None] * normal
        light = 0.55 + 0.45 * (facing @ sun).clamp(min=0)
        mirrored = towards[meets] - 2 * (towards[meets] * facing).sum(-1, keepdim=True) * facing
        glint = cards.shine[k] * (mirrored @ sun).clamp(min=0) ** 12
        colour[meets] = read[:, :3] * light[:, None] + glint[:, None]
        depth[meets] = at[meets]
    return colour, depth


def _turn(random: np.random.Generator) -> np.ndarray:
    """Three orthogonal unit vectors."""
    return np.linalg.qr(random.normal(size=(3, 3)))[0].T


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
