"""Clutter: that pictures, depths and points belong together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tidefield.data.scene import Scene
from tidefield.data.surface import surface_points
from tidefield.data.synthetic import clutter
from tidefield.data.synthetic.clutter import Rig, make_clutter

RIGS: tuple[Rig, ...] = ("front", "around", "above")


@pytest.fixture(scope="module", params=[*RIGS, "white"])
def scene(request: pytest.FixtureRequest) -> Scene:
    white = request.param == "white"
    return make_clutter(3, 5, 64, "around" if white else request.param, (), white)


def test_the_same_seed_gives_the_same_pixels() -> None:
    one, again, other = (make_clutter(seed, 2, 48, "front") for seed in (5, 5, 6))
    assert all(torch.equal(one.photographs[i], again.photographs[i]) for i in range(2))
    assert not torch.equal(one.photographs[0], other.photographs[0])


def test_points_lie_where_photographs_saw_them(scene: Scene) -> None:
    points = scene.points
    assert points is not None
    assert len(points.xyz_world) > 2
    for i in range(len(scene.cameras)):
        mine = points.camera_index == i
        uv, z = scene.cameras[i].project(points.xyz_world[points.point_index[mine]])
        assert (uv[0] - points.uv_px[mine]).norm(dim=1).median() < 0.6
        near, far = scene.cameras.near_far[i]
        assert ((z > 0.85 * near) & (z < 1.15 * far)).all()


def test_one_photographs_surface_is_anothers() -> None:
    """Where two photographs show the same surface, told by depths that agree, they show the same colour."""
    random = np.random.default_rng(7)
    textures = clutter._textures(random, torch.Generator().manual_seed(7), ())
    cards = clutter._cards(random, "front", False)
    cards = replace(cards, shine=torch.zeros(len(cards.centre)))
    cameras = clutter._cameras(random, 2, 160, "front")
    sun = torch.tensor([0.0, 0.0, 1.0])
    (first, depth), (second, other) = (clutter._photograph(cards, textures, cameras[i], sun) for i in range(2))
    known = depth.isfinite()
    uv, z = cameras[1].project(surface_points(cameras[0], torch.where(known, depth, 1.0)))
    column, row = uv[0].floor().long().unbind(-1)
    inside = (column >= 0) & (column < 160) & (row >= 0) & (row < cameras.height) & known.flatten()
    pixel = row.clamp(0, cameras.height - 1) * 160 + column.clamp(0, 159)
    same = inside & ((other.flatten()[pixel] - z[0]).abs() < 0.01 * z[0])
    assert same.float().mean() > 0.3
    difference = (first.reshape(-1, 3)[same].float() - second.reshape(-1, 3)[pixel[same]].float()).abs().mean(-1)
    assert difference.median() < 12, "half a pixel of texture at most"


def test_nothing_is_behind_things_on_white() -> None:
    white = make_clutter(3, 4, 64, "around", (), white=True)
    assert white.background_rgb == (1.0, 1.0, 1.0)
    assert any((white.photographs[i] == 255).all(-1).float().mean() > 0.3 for i in range(4))
    assert make_clutter(3, 2, 64, "around").background_rgb is None


def test_pictures_serve_as_textures() -> None:
    red = torch.tensor([255, 0, 0], dtype=torch.uint8).expand(300, 300, 3)
    plain, painted = (make_clutter(4, 2, 64, "above", pictures) for pictures in ((), (red,)))

    def reds(scene: Scene) -> float:
        colour = scene.photographs[0].float()
        return ((colour[..., 0] > 60) & (colour[..., 1:].amax(-1) < 20)).float().mean().item()

    assert reds(painted) > reds(plain) + 0.1
