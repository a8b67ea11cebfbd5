import textured_wall as wall
import torch

from tidefield.baselines import sparse_depth


def test_a_wall_is_rendered_as_it_is_between_its_photographs():
    scene = wall.scene(wall.cameras(5), test=(2,))
    view = sparse_depth.make(scene)(scene.cameras[2])
    truth = scene.photographs[2].float() / 255
    torch.testing.assert_close(view.depth, torch.full((36, 48), wall.DEPTH), rtol=1e-4, atol=0)
    assert view.opacity.min() == 1
    assert (view.colour - truth)[2:-2, 2:-2].abs().mean() < 0.01


def test_photographs_are_brought_to_the_target_exposure():
    scene = wall.scene(wall.with_gains(wall.cameras(5)), test=(2,))
    view = sparse_depth.make(scene)(scene.cameras[2])
    truth = scene.photographs[2].float() / 255
    assert (view.colour - truth)[2:-2, 2:-2].abs().mean() < 0.01


def test_only_training_photographs_are_read():
    scene = wall.scene(wall.cameras(3), test=(1,))
    before = sparse_depth.make(scene)(scene.cameras[1]).colour
    scene.photographs[1].zero_()
    assert torch.equal(sparse_depth.make(scene)(scene.cameras[1]).colour, before)


def test_the_size_of_the_chunks_changes_nothing(monkeypatch):
    scene = wall.scene(wall.cameras(6), test=(2,))
    whole = sparse_depth.make(scene)(scene.cameras[2])
    monkeypatch.setattr(sparse_depth, "CHUNK", 5 * 100)
    torch.testing.assert_close(sparse_depth.make(scene)(scene.cameras[2]).colour, whole.colour)


def test_ground_that_no_photograph_saw_is_transparent_and_filled_from_beside_it():
    scene = wall.scene(wall.cameras(3, step=1.0), test=(0,))
    view = sparse_depth.make(scene)(scene.cameras[0])
    unseen = view.opacity == 0
    assert unseen.float().mean() == 10 / 48  # one step moves the picture by 9.6 columns
    beside = view.colour[:, 10].mean(0)
    assert (view.colour[unseen].mean(0) - beside).abs().max() < 0.1
