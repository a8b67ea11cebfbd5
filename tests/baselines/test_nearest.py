"""The nearest-photograph floor."""

import textured_wall as wall
import torch

from tidefield.baselines import nearest, sparse_depth


def test_the_photograph_beside_is_shown_where_the_surface_says():
    scene = wall.scene(wall.cameras(5), test=(2,))
    view = nearest.make(scene)(scene.cameras[2])
    truth = scene.photographs[2].float() / 255
    seen = view.opacity > 0
    assert 0.8 < seen.float().mean() < 1  # the neighbour is a step aside
    assert (view.colour - truth)[seen].abs().mean() < 0.02
    torch.testing.assert_close(view.depth, torch.full((36, 48), wall.DEPTH), rtol=1e-4, atol=0)


def test_it_is_one_photograph_and_none_that_is_held_out():
    scene = wall.scene(wall.cameras(5), test=(2,))
    before = nearest.make(scene)(scene.cameras[2]).colour
    scene.photographs[2].zero_()
    for index in (0, 4):
        scene.photographs[index].zero_()
    one_of_two = nearest.make(scene)(scene.cameras[2]).colour
    assert torch.equal(one_of_two, before)
    blended = sparse_depth.make(scene)(scene.cameras[2]).colour
    assert not torch.allclose(blended, before, atol=1e-3)


def test_the_nearest_camera_that_sees_something_else_is_passed_over():
    cameras = wall.cameras(4, step=0.3)
    pose = cameras.T_world_camera.clone()
    pose[1, :, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # looks away from the wall
    from dataclasses import replace

    scene = wall.scene(replace(cameras, T_world_camera=pose), test=(2,))
    view = nearest.make(scene)(scene.cameras[2])
    truth = scene.photographs[2].float() / 255
    seen = view.opacity > 0
    assert seen.float().mean() > 0.8
    assert (view.colour - truth)[seen].abs().mean() < 0.02
