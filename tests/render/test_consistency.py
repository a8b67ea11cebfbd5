"""Points of several views: those that other views see through go, unless nothing else is there."""

import numpy as np
import textured_wall
import torch

from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.model.rendering import Rendering
from tidefield.render.consistency import PASSES, ViewPoints, choose_points
from tidefield.render.gaussians import make_gaussians


def view_at(camera: Cameras, depth: float | np.ndarray, shown: bool = True, known: bool = True) -> ViewPoints:
    count = camera.width * camera.height
    depths = np.broadcast_to(np.asarray(depth, dtype=np.float32), count).copy()
    directions = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0].double().numpy()
    xyz = camera.position_world[0].double().numpy() + directions * depths[:, None]
    return ViewPoints(camera, xyz, depths, np.full(count, known), np.full(count, shown))


def step_depth(camera: Cameras) -> np.ndarray:
    """A wall at z = 5 where x < 0, another at z = 9 beside and behind it."""
    directions = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0]
    return np.where(camera.position_world[0, 0] + 5 * directions[:, 0] < 0, 5.0, 9.0)


def test_a_floater_in_front_of_a_wall_goes_where_other_views_see_the_wall():
    cameras = textured_wall.cameras(4, 96, 72)
    wall = (textured_wall.photograph(cameras[0]).float() / 255, torch.full((72, 96), 5.0))

    def with_floater(camera: Cameras) -> Rendering:
        depth = wall[1].clone()
        if torch.equal(camera.T_world_camera, cameras.T_world_camera[1:2]):
            depth[30:40, 40:56] = 3.0
        return Rendering(wall[0], depth, torch.ones(72, 96))

    found = make_gaussians(with_floater, cameras, 96).mean_world
    assert np.abs(found[:, 2] - 5).max() < 1e-4
    hole = found[(np.abs(found[:, 0]) < 0.4) & (np.abs(found[:, 1]) < 0.3)]
    assert len(hole) > 0.7 * (0.8 * 0.6) / (5 / 96) ** 2, "the wall behind it has a hole"


def test_what_only_one_view_sees_stays():
    cameras = textured_wall.cameras(2, 48, 36, step=3.0)  # of 5 units each sees 2 that the other sees, too
    chosen = choose_points([view_at(cameras[0], 5.0), view_at(cameras[1], 5.0)])
    assert all(own.all() for own in chosen)
    alone = choose_points([view_at(cameras[0], 5.0)])
    assert alone[0].all()


def test_edges_and_what_is_hidden_behind_them_contradict_nothing():
    cameras = textured_wall.cameras(5, 96, 72, step=0.4)
    views = [view_at(cameras[k], step_depth(cameras[k])) for k in range(5)]
    assert all(own.all() for own in choose_points(views, PASSES[:1]))


def test_a_contradicted_point_stays_where_nothing_else_is():
    cameras = textured_wall.cameras(2, 48, 36)
    views = [view_at(cameras[0], 4.0), view_at(cameras[1], 5.0, shown=False)]
    seen_through = views[1].pixels(views[0].xyz_world)[0] >= 0
    assert 0.8 < seen_through.mean() < 1
    np.testing.assert_array_equal(choose_points(views, PASSES[:1])[0], ~seen_through)
    assert choose_points(views)[0].mean() > 0.98, "holes were not filled"
    assert not choose_points(views)[1].any()


def test_of_contradicted_points_the_least_contradicted_fills():
    camera = textured_wall.cameras(1, 48, 36)
    depths = {3.0: True, 4.0: True, 4.0001: False, 5.0: False, 5.0001: False}
    chosen = choose_points([view_at(camera, depth, shown) for depth, shown in depths.items()])
    assert not chosen[0].any(), "all other views see through it"
    assert chosen[1].all(), "two of three other views see through it"


def test_views_of_nothing_contradict_nothing():
    cameras = textured_wall.cameras(2, 48, 36)
    views = [view_at(cameras[0], 4.0), view_at(cameras[1], 9.0, shown=False, known=False)]
    assert choose_points(views, PASSES[:1])[0].all()


def test_small_differences_of_depth_agree():
    cameras = textured_wall.cameras(2, 48, 36)
    views = [view_at(cameras[0], 5.0), view_at(cameras[1], 5.04)]
    assert all(own.all() for own in choose_points(views, PASSES[:1]))
    farther = [views[0], view_at(cameras[1], 5.1)]
    first, second = choose_points(farther, PASSES[:1])
    assert first.mean() < 0.2
    assert second.all()
