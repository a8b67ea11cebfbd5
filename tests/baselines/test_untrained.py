"""The untrained baselines: nearest photograph, plane sweep and sparse-depth blending."""

from dataclasses import replace
from pathlib import Path

import textured_wall as wall
import torch
from scenes_on_disk import survey, write_colmap

from tidefield.baselines import untrained
from tidefield.baselines.untrained import nearest, plane_sweep, sparse_depth, sparse_depth_as_given
from tidefield.data.load import load_scene
from tidefield.geometry.cameras import Cameras


def test_nearest_shows_the_next_photograph_on_the_surface():
    scene = wall.scene(wall.cameras(5), test=(2,))
    view = nearest(scene)(scene.cameras[2])
    truth = scene.photographs[2].float() / 255
    seen = view.opacity > 0
    assert 0.8 < seen.float().mean() < 1  # the neighbour is one step to the side
    assert (view.colour - truth)[seen].abs().mean() < 0.02
    torch.testing.assert_close(view.depth, torch.full((36, 48), wall.DEPTH), rtol=1e-4, atol=0)


def test_nearest_reads_one_training_photograph():
    scene = wall.scene(wall.cameras(5), test=(2,))
    before = nearest(scene)(scene.cameras[2]).colour
    scene.photographs[2].zero_()
    for index in (0, 4):
        scene.photographs[index].zero_()
    one_of_two = nearest(scene)(scene.cameras[2]).colour
    assert torch.equal(one_of_two, before)
    blended = sparse_depth(scene)(scene.cameras[2]).colour
    assert not torch.allclose(blended, before, atol=1e-3)


def test_nearest_skips_a_camera_that_looks_elsewhere():
    cameras = wall.cameras(4, step=0.3)
    pose = cameras.T_world_camera.clone()
    pose[1, :, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # looks away from the wall
    scene = wall.scene(replace(cameras, T_world_camera=pose), test=(2,))
    view = nearest(scene)(scene.cameras[2])
    truth = scene.photographs[2].float() / 255
    seen = view.opacity > 0
    assert seen.float().mean() > 0.8
    assert (view.colour - truth)[seen].abs().mean() < 0.02


def test_plane_sweep_finds_the_depth_of_a_textured_wall():
    scene = wall.scene(wall.cameras(5, step=0.6), test=(2,))
    view = plane_sweep(scene)(scene.cameras[2])
    step = (1 / 3.0 - 1 / 10.0) / (untrained.DEPTHS - 1)
    inner = (1 / view.depth - 1 / wall.DEPTH)[4:-4, 4:-4].abs()
    assert (inner < step).float().mean() > 0.98
    truth = scene.photographs[2].float() / 255
    assert (view.colour - truth)[4:-4, 4:-4].abs().mean() < 0.02


def test_plane_sweep_finds_the_depth_at_different_exposures():
    scene = wall.scene(wall.with_gains(wall.cameras(5, step=0.6)), test=(2,))
    view = plane_sweep(scene)(scene.cameras[2])
    step = (1 / 3.0 - 1 / 10.0) / (untrained.DEPTHS - 1)
    assert ((1 / view.depth - 1 / wall.DEPTH)[4:-4, 4:-4].abs() < step).float().mean() > 0.95


def test_the_nearest_photographs_are_training_photographs_next_to_the_camera():
    scene = wall.scene(wall.cameras(9), test=(4,))
    assert set(untrained.nearest_photographs(scene, scene.cameras[4], 4)) == {2, 3, 5, 6}


def test_the_matching_cost_is_the_squared_standard_error_of_the_mean_colour():
    scene = wall.scene(wall.cameras(3, step=0.0), test=())
    for value, picture in zip((51, 102, 255), scene.photographs.colours, strict=True):
        picture.fill_(value)
    camera = scene.cameras[0]
    depth = torch.full((camera.height, camera.width), 4.0)
    mean, count, variance = untrained._match(scene, None, camera, [0, 1, 2], depth)
    values = torch.tensor([0.2, 0.4, 1.0])
    torch.testing.assert_close(mean, values.mean().expand_as(mean))
    assert (count == 3).all()
    squares = 3 * (values - values.mean()).square().sum() + 3 * untrained.USUAL_SPREAD**2
    torch.testing.assert_close(variance, (squares / 9).expand_as(variance))


def test_plane_sweep_uses_the_middle_plane_where_no_two_photographs_overlap():
    scene = wall.scene(wall.cameras(2), test=(1,))
    view = plane_sweep(scene)(scene.cameras[1])
    torch.testing.assert_close(view.depth, torch.full((36, 48), 2 / (1 / 3.0 + 1 / 10.0)))


def test_sparse_depth_renders_a_wall_between_its_photographs():
    scene = wall.scene(wall.cameras(5), test=(2,))
    view = sparse_depth(scene)(scene.cameras[2])
    truth = scene.photographs[2].float() / 255
    torch.testing.assert_close(view.depth, torch.full((36, 48), wall.DEPTH), rtol=1e-4, atol=0)
    assert view.opacity.min() == 1
    assert (view.colour - truth)[2:-2, 2:-2].abs().mean() < 0.01


def test_sparse_depth_renders_at_the_target_exposure():
    scene = wall.scene(wall.with_gains(wall.cameras(5)), test=(2,))
    view = sparse_depth(scene)(scene.cameras[2])
    truth = scene.photographs[2].float() / 255
    assert (view.colour - truth)[2:-2, 2:-2].abs().mean() < 0.01


def test_sparse_depth_reads_only_training_photographs():
    scene = wall.scene(wall.cameras(3), test=(1,))
    before = sparse_depth(scene)(scene.cameras[1]).colour
    scene.photographs[1].zero_()
    assert torch.equal(sparse_depth(scene)(scene.cameras[1]).colour, before)


def test_the_chunk_size_does_not_change_the_result(monkeypatch):
    scene = wall.scene(wall.cameras(6), test=(2,))
    whole = sparse_depth(scene)(scene.cameras[2])
    monkeypatch.setattr(untrained, "CHUNK", 5 * 100)
    torch.testing.assert_close(sparse_depth(scene)(scene.cameras[2]).colour, whole.colour)


def test_nearest_never_projects_all_photographs_onto_all_pixels_at_once(monkeypatch):
    scene = wall.scene(wall.cameras(6), test=(2,))
    whole = nearest(scene)(scene.cameras[2])
    monkeypatch.setattr(untrained, "CHUNK", 5 * 100)
    project, most = Cameras.project, []

    def counted(cameras: Cameras, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        most.append(len(cameras) * points.shape[-2])
        return project(cameras, points)

    monkeypatch.setattr(Cameras, "project", counted)
    torch.testing.assert_close(nearest(scene)(scene.cameras[2]).colour, whole.colour)
    pixels = 36 * 48
    assert max(most) <= max(5 * 100, pixels)


def test_unseen_ground_is_transparent_and_filled_from_next_to_it():
    scene = wall.scene(wall.cameras(3, step=1.0), test=(0,))
    view = sparse_depth(scene)(scene.cameras[0])
    unseen = view.opacity == 0
    assert unseen.float().mean() == 10 / 48  # one step moves the picture by 9.6 columns
    next_to = view.colour[:, 10].mean(0)
    assert (view.colour[unseen].mean(0) - next_to).abs().max() < 0.1


def test_masked_pixels_are_read_by_no_baseline():
    scene = wall.with_left_halves_masked(wall.scene(wall.cameras(5, step=0.6), test=(2,)), (0, 1, 3, 4))
    for index in (0, 1, 3, 4):
        scene.photographs[index][:, :23] = 255  # brighter than all of the wall
    for method in (sparse_depth, plane_sweep, nearest):
        view = method(scene)(scene.cameras[2])
        shown = view.opacity > 0
        # Photographs 0.6 m apart see the wall 5.8 px apart: the last masks end at 24 - 2 * 5.8, the next at 24 + 5.8.
        assert shown[:, 30:36].all()
        assert view.colour[shown].max() < 0.95
        if method is not plane_sweep:
            assert not shown[:, :12].any()
            assert (view.colour - scene.photographs[2] / 255)[:, 30:36].abs().mean() < 0.02


def test_blending_as_given_knows_neither_shading_nor_residual(tmp_path: Path):
    write_colmap(tmp_path, survey())
    plain = load_scene(tmp_path, calibrate=False)
    count = len(plain.cameras)
    shading, residual = torch.zeros(count, 15, 3), torch.zeros(count, 6, 2)
    shading[:, 1], residual[:, 0] = 0.5, 0.1
    calibrated = replace(plain, cameras=replace(plain.cameras, shading=shading, residual=residual))
    test = plain.test[0]
    as_given = sparse_depth_as_given(calibrated)(calibrated.cameras[test])
    assert torch.equal(as_given.colour, sparse_depth(plain)(plain.cameras[test]).colour)
    assert not torch.equal(as_given.colour, sparse_depth(calibrated)(calibrated.cameras[test]).colour)
