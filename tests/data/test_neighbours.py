import math

import pytest
import textured_wall as wall
import torch
from torch import Tensor

from tidefield.data.neighbours import (
    ANGLE_SCALE_RAD,
    BORDER,
    FADE,
    from_border,
    nearest,
    rank_by_direction,
    rank_by_view,
)
from tidefield.geometry.cameras import Cameras

HEIGHT = 30.0
NADIR = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""Columns: right is east, down is south, forward is down to earth."""


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


def nobody(count: int) -> Tensor:
    return torch.zeros(1, count, dtype=torch.bool)


def test_above_flat_ground_the_nearest_photograph_comes_first():
    own = nadir_grid()
    target = flight(torch.tensor([[1.0, 0.3, HEIGHT]]))
    chosen = nearest(rank_by_view(target, ground(target), own), nobody(25), 9)[0][0]
    distance = (own.position_world - target.position_world).norm(dim=-1)
    assert chosen[0] == distance.argmin()
    assert distance[chosen[:3]].tolist() == pytest.approx(distance.sort().values[:3].tolist())
    assert distance[chosen].max() < 10


def test_a_photograph_of_the_grid_has_its_four_neighbours_and_never_itself():
    own, middle = nadir_grid(), 12
    target = own[middle]
    chosen = nearest(rank_by_view(target, ground(target), own), torch.arange(25)[None] == middle, 4)[0][0]
    assert set(chosen.tolist()) == {7, 11, 13, 17}
    every = nearest(rank_by_view(target, ground(target), own), torch.arange(25)[None] == middle, 100)[0][0]
    assert sorted(every.tolist()) == [i for i in range(25) if i != middle]


def test_the_rank_is_the_share_seen_times_how_close_the_angle_is():
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


def test_a_photograph_of_other_ground_or_of_the_sky_is_worth_nothing():
    target = flight(torch.tensor([[0.0, 0.0, HEIGHT]]))
    away = flight(torch.tensor([[200.0, 0.0, HEIGHT], [0.0, 0.0, HEIGHT]]), torch.stack([NADIR, tilted(math.pi)]))
    assert rank_by_view(target, ground(target), away).tolist() == [[0.0, 0.0]]


def test_each_tile_has_its_own_neighbours():
    own = nadir_grid()
    targets = flight(torch.tensor([[-7.0, -7.0, HEIGHT], [7.0, 7.0, HEIGHT]]))
    surface = torch.cat([ground(targets[0]), ground(targets[1])])
    first, _ = nearest(rank_by_view(targets, surface, own), torch.zeros(2, 25, dtype=torch.bool), 1)
    assert first.flatten().tolist() == [0, 24]


def test_the_papers_strategy_ranks_by_the_angle_between_viewing_directions():
    angles = torch.tensor([0.9, 0.1, 0.5, math.pi, 0.3])
    # The farther, the better aligned: position must play no part.
    positions = torch.stack([1e3 / angles, torch.zeros(5), torch.full((5,), HEIGHT)], -1)
    own = flight(positions, torch.stack([tilted(float(a)) for a in angles]))
    target = flight(torch.tensor([[0.0, 0.0, HEIGHT]]))
    rank = rank_by_direction(target, own)
    torch.testing.assert_close(rank[0], (angles.cos() + 1) / 2)
    assert nearest(rank, nobody(5), 5)[0][0].tolist() == [1, 4, 2, 0, 3]


def test_the_direction_alone_cannot_tell_nadir_photographs_apart():
    own = nadir_grid()
    torch.testing.assert_close(rank_by_direction(own[:2], own), torch.ones(2, 25))


def test_excluded_photographs_never_serve_even_where_nothing_else_is_worth_anything():
    rank = torch.tensor([[0.9, 0.0, 0.0, 0.8]])
    excluded = torch.tensor([[True, False, False, True]])
    assert set(nearest(rank, excluded, 3)[0][0].tolist()) == {1, 2}


def test_the_textured_walls_neighbours_are_those_beside_it():
    own = wall.cameras(7)
    surface = own[3].position_world[:, None] + torch.tensor([[[0.0, 0.0, wall.DEPTH], [0.5, 0.3, wall.DEPTH]]])
    chosen = nearest(rank_by_view(own[3], surface, own), torch.arange(7)[None] == 3, 4)[0][0].tolist()
    assert set(chosen[:2]) == {2, 4}
    assert set(chosen[2:]) == {1, 5}


def test_a_view_fades_before_it_is_left_out():
    """As the last view's rank falls to that of the first one left out, its presence falls to nothing, evenly."""
    rank = torch.tensor([[0.5, 0.9, better, 0.8] for better in (0.7, 0.5 + FADE * 0.5 / 2, 0.5, 0.3)])
    chosen, presence = nearest(rank, torch.zeros(4, 4, dtype=torch.bool), 3)
    assert chosen[:, :2].tolist() == [[1, 3]] * 4
    assert presence[:, :2].tolist() == [[1, 1]] * 4
    assert presence[:, 2].tolist() == pytest.approx([1, 0.5 / (1 + FADE / 2), 0, 1], abs=1e-4)


def test_where_no_view_is_left_out_all_are_there():
    chosen, presence = nearest(torch.tensor([[0.5, 0.2]]), torch.zeros(1, 2, dtype=torch.bool), 3)
    assert (chosen.tolist(), presence.tolist()) == ([[0, 1]], [[1, 1]])


def test_views_fade_towards_the_border_of_their_frame():
    size = torch.tensor([400, 300])
    uv = torch.tensor([[200.0, 150.0], [20.0, 150.0], [5.0, 150.0], [398.0, 150.0], [200.0, 299.0], [-3.0, 20.0]])
    assert from_border(uv, size, 0.05).tolist() == pytest.approx([1, 1, 0.25, 0.1, 0.05, 0])
