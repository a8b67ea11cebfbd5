import textured_wall as wall
import torch

from tidefield.baselines import plane_sweep


def test_a_textured_wall_is_found_where_it_stands():
    scene = wall.scene(wall.cameras(5, step=0.6), test=(2,))
    view = plane_sweep.make(scene)(scene.cameras[2])
    step = (1 / 3.0 - 1 / 10.0) / (plane_sweep.DEPTHS - 1)
    inner = (1 / view.depth - 1 / wall.DEPTH)[4:-4, 4:-4].abs()
    assert (inner < step).float().mean() > 0.98
    truth = scene.photographs[2].float() / 255
    assert (view.colour - truth)[4:-4, 4:-4].abs().mean() < 0.02


def test_different_exposures_do_not_hide_the_wall():
    scene = wall.scene(wall.with_gains(wall.cameras(5, step=0.6)), test=(2,))
    view = plane_sweep.make(scene)(scene.cameras[2])
    step = (1 / 3.0 - 1 / 10.0) / (plane_sweep.DEPTHS - 1)
    assert ((1 / view.depth - 1 / wall.DEPTH)[4:-4, 4:-4].abs() < step).float().mean() > 0.95


def test_the_nearest_photographs_are_training_photographs_beside_the_camera():
    scene = wall.scene(wall.cameras(9), test=(4,))
    assert set(plane_sweep.nearest_photographs(scene, scene.cameras[4], 4)) == {2, 3, 5, 6}


def test_agreement_is_the_squared_standard_error_of_the_mean_colour():
    scene = wall.scene(wall.cameras(3, step=0.0), test=())
    for value, picture in zip((51, 102, 255), scene.photographs.colours, strict=True):
        picture.fill_(value)
    camera = scene.cameras[0]
    depth = torch.full((camera.height, camera.width), 4.0)
    mean, count, variance = plane_sweep._agreement(scene, camera, [0, 1, 2], depth)
    values = torch.tensor([0.2, 0.4, 1.0])
    torch.testing.assert_close(mean, values.mean().expand_as(mean))
    assert (count == 3).all()
    squares = 3 * (values - values.mean()).square().sum() + 3 * plane_sweep.USUAL_SPREAD**2
    torch.testing.assert_close(variance, (squares / 9).expand_as(variance))


def test_where_two_photographs_never_meet_the_middle_plane_is_used():
    scene = wall.scene(wall.cameras(2), test=(1,))
    view = plane_sweep.make(scene)(scene.cameras[1])
    torch.testing.assert_close(view.depth, torch.full((36, 48), 2 / (1 / 3.0 + 1 / 10.0)))
