import math
from dataclasses import replace
from pathlib import Path

import pytest
import textured_wall as wall
import torch
from torch import Tensor

from tidefield.data import neighbours
from tidefield.data.images import Photographs
from tidefield.data.neighbours import (
    ANGLE_SCALE_RAD,
    BORDER,
    FADE,
    PRESELECT_ABOVE,
    choose_neighbours,
    from_border,
    rank_by_direction,
    rank_by_view,
    select_best,
)
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras

HEIGHT = 30.0
NADIR = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""Columns: right is east, down is south, forward is down."""


def flight(positions: Tensor, turn: Tensor | None = None) -> Cameras:
    """Cameras at positions, looking straight down unless turned."""
    count = len(positions)
    rotation = NADIR.expand(count, 3, 3) if turn is None else turn
    return Cameras(
        T_world_camera=torch.cat([rotation, positions[..., None]], -1),
        focal_px=torch.full((count, 2), 60.0),
        principal_px=torch.tensor([[32.0, 24.0]]).repeat(count, 1),
        size_px=torch.tensor([[64, 48]]).repeat(count, 1),
        near_far=torch.tensor([[20.0, 40.0]]).repeat(count, 1),
        gain=torch.ones(count, 3),
    )


def nadir_grid(side: int = 5, step: float = 4.0) -> Cameras:
    line = (torch.arange(side) - side // 2) * step
    y, x = torch.meshgrid(line, line, indexing="ij")
    return flight(torch.stack([x, y, torch.full_like(x, HEIGHT)], -1).reshape(-1, 3))


def ground(camera: Cameras) -> Tensor:
    """Where five pixels of one camera meet the ground, 1 5 3."""
    uv = torch.tensor([[[32.0, 24.0], [6.0, 5.0], [58.0, 5.0], [6.0, 43.0], [58.0, 43.0]]])
    return camera.position_world[:, None] + camera.directions_world(uv) * HEIGHT


def tilted(angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]) @ NADIR


def test_above_flat_ground_the_nearest_photograph_comes_first():
    own = nadir_grid()
    target = flight(torch.tensor([[1.0, 0.3, HEIGHT]]))
    chosen = select_best(rank_by_view(target, ground(target), own), 9)[0][0]
    distance = (own.position_world - target.position_world).norm(dim=-1)
    assert chosen[0] == distance.argmin()
    assert distance[chosen[:3]].tolist() == pytest.approx(distance.sort().values[:3].tolist())
    assert distance[chosen].max() < 10


def test_a_photograph_of_the_grid_has_its_four_neighbours_and_never_itself():
    scene, middle = wall.scene(nadir_grid(), test=()), 12
    target = scene.cameras[middle]
    others = scene.sources(target)
    assert others == tuple(i for i in range(25) if i != middle)
    rank = rank_by_view(target, ground(target), scene.cameras[list(others)])
    assert {others[i] for i in select_best(rank, 4)[0][0].tolist()} == {7, 11, 13, 17}


def test_only_a_camera_with_the_name_and_the_pose_of_a_photograph_has_one_of_its_own():
    scene = wall.scene(wall.cameras(5))
    own = scene.cameras[2]
    assert scene.sources(own) == scene.sources(own.resized(24, 18)) == (0, 3, 4)
    assert scene.sources(replace(own, names=())) == scene.train
    assert scene.sources(replace(own, T_world_camera=own.T_world_camera + 0.1)) == scene.train
    assert scene.sources(replace(own, names=("of-another-survey.jpg",))) == scene.train
    assert scene.sources(scene.cameras[1]) == scene.train  # held out: no source of any view


def test_rank_is_share_in_frame_times_angle_weight():
    own = nadir_grid()
    target = flight(torch.tensor([[3.0, -2.0, HEIGHT]]))
    surface = ground(target)
    rank = rank_by_view(target, surface, own)[0]
    for v in range(25):
        uv, z = own[v].project(surface[0])
        seen, angles = 0.0, []
        for p in range(5):
            if z[0, p] > 0:
                u, w = uv[0, p].tolist()
                seen += min(max(min(u, 64 - u, w, 48 - w) / (BORDER * 64), 0), 1)
            ours, theirs = (surface[0, p] - c.position_world[0] for c in (target, own[v]))
            angles.append(math.acos(float(ours @ theirs / ours.norm() / theirs.norm())))
        expected = seen / 5 * math.exp(-sum(angles) / 5 / ANGLE_SCALE_RAD)
        assert rank[v].item() == pytest.approx(expected, abs=1e-4)


def test_photographs_of_other_ground_or_of_the_sky_have_rank_zero():
    target = flight(torch.tensor([[0.0, 0.0, HEIGHT]]))
    away = flight(torch.tensor([[200.0, 0.0, HEIGHT], [0.0, 0.0, HEIGHT]]), torch.stack([NADIR, tilted(math.pi)]))
    assert rank_by_view(target, ground(target), away).tolist() == [[0.0, 0.0]]


def test_each_tile_has_its_own_neighbours():
    own = nadir_grid()
    targets = flight(torch.tensor([[-7.0, -7.0, HEIGHT], [7.0, 7.0, HEIGHT]]))
    surface = torch.cat([ground(targets[0]), ground(targets[1])])
    first, _ = select_best(rank_by_view(targets, surface, own), 1)
    assert first.flatten().tolist() == [0, 24]


def test_direction_strategy_ranks_by_angle_between_viewing_directions():
    angles = torch.tensor([0.9, 0.1, 0.5, math.pi, 0.3])
    # The farther, the better aligned: position must have no influence.
    positions = torch.stack([1e3 / angles, torch.zeros(5), torch.full((5,), HEIGHT)], -1)
    own = flight(positions, torch.stack([tilted(float(a)) for a in angles]))
    target = flight(torch.tensor([[0.0, 0.0, HEIGHT]]))
    rank = rank_by_direction(target, own)
    torch.testing.assert_close(rank[0], (angles.cos() + 1) / 2)
    assert select_best(rank, 5)[0][0].tolist() == [1, 4, 2, 0, 3]


def test_blend_weight_falls_to_zero_before_a_view_is_replaced():
    """As the last view's rank falls to that of the first one left out, its blend weight falls linearly to 0."""
    rank = torch.tensor([[0.5, 0.9, better, 0.8] for better in (0.7, 0.5 + FADE * 0.5 / 2, 0.5, 0.3)])
    chosen, blend_weight = select_best(rank, 3)
    assert chosen[:, :2].tolist() == [[1, 3]] * 4
    assert blend_weight[:, :2].tolist() == [[1, 1]] * 4
    assert blend_weight[:, 2].tolist() == pytest.approx([1, 0.5 / (1 + FADE / 2), 0, 1], abs=1e-4)


def test_all_weights_are_one_if_no_view_is_left_out():
    chosen, blend_weight = select_best(torch.tensor([[0.5, 0.2]]), 3)
    assert (chosen.tolist(), blend_weight.tolist()) == ([[0, 1]], [[1, 1]])


def test_weights_fall_towards_the_image_border():
    size = torch.tensor([400, 300])
    uv = torch.tensor([[200.0, 150.0], [20.0, 150.0], [5.0, 150.0], [398.0, 150.0], [200.0, 299.0], [-3.0, 20.0]])
    assert from_border(uv, size, 0.05).tolist() == pytest.approx([1, 1, 0.25, 0.1, 0.05, 0])


def test_preselection_in_large_scenes_finds_the_neighbours_of_every_tile(monkeypatch: pytest.MonkeyPatch):
    """A wide view along a row of 100 narrow photographs: every part of it has other neighbours."""
    own = wall.cameras(101)
    wide = replace(wall.cameras(1, 288, 36), focal_px=torch.full((1, 2), 48.0))
    prior = torch.full((3, 9, 72), 1 / wall.DEPTH)
    scene = Scene(
        root=Path("row"),
        names=tuple(f"{i:03d}.jpg" for i in range(101)),
        cameras=own,
        photographs=Photographs((torch.zeros(1, 1, 3, dtype=torch.uint8),) * 101),
        points=None,
        train=tuple(range(101)),
        test=(),
        origin_world=torch.zeros(3),
    )
    assert len(scene.train) > PRESELECT_ABOVE

    def weights() -> Tensor:
        found = choose_neighbours(wide, prior, torch.zeros(2), (36, 4), 8, scene, 3, "seen")
        return torch.zeros(36 * 4, 101, 4).scatter_(1, found.index[..., None].expand(-1, -1, 4), found.blend_weight)

    preselected = weights()
    assert len((preselected > 0.5).any(-1).any(0).nonzero()) > 50
    monkeypatch.setattr(neighbours, "PRESELECT_ABOVE", 1000)
    torch.testing.assert_close(preselected, weights(), atol=2e-6, rtol=0)
