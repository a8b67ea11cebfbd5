"""Photographs at several sizes: which one a view reads, and what it holds."""

from pathlib import Path

import numpy as np
import pytest
import scenes_on_disk as disk
import textured_wall as wall
import torch
from torch.nn import functional as F

from tidefield.config import SWIFT, Sampling
from tidefield.data.load import at_width, load_scene
from tidefield.data.pyramid import FINER, PER_OCTAVE, Pyramid
from tidefield.geometry.cameras import Cameras
from tidefield.model.network import make_network
from tidefield.model.renderer import Renderer
from tidefield.model.rendering import Rendering, with_rays

CPU = torch.device("cpu")
MIDDLE = torch.tensor([[0.0, 0.0, wall.DEPTH]])
HALF_STEP = 2 ** (0.5 / PER_OCTAVE)


@pytest.mark.parametrize("share", [1 / 8, 1 / 3, 1 / 2, 1.0])
def test_pixels_that_are_read_are_finer_than_the_cameras_own_by_as_much_as_they_should(share: float):
    scene = wall.scene(wall.cameras(3, 256, 192))
    pyramid = Pyramid(scene)
    camera = scene.cameras[1].resized(round(256 * share), round(192 * share))
    photographs = torch.tensor([[0, 2]])
    level = pyramid.levels(camera, photographs, MIDDLE)
    width = pyramid.cameras.size_px[pyramid.row(photographs, level)][..., 0]
    expected = min(256, FINER * 256 * share)  # there are no files with more
    assert ((width / expected > 0.99 / HALF_STEP) & (width / expected < 1.01 * HALF_STEP)).all()


def test_a_photograph_from_twice_as_far_is_read_at_twice_the_size():
    scene = wall.scene(wall.cameras(3, 256, 192))
    scene.cameras.T_world_camera[2, 2, 3] = -wall.DEPTH
    camera = scene.cameras[1].resized(64, 48)
    level = Pyramid(scene).levels(camera, torch.tensor([[0, 2]]), MIDDLE)
    assert (level[0, 1] - level[0, 0]).item() == PER_OCTAVE


def test_finer_levels_are_read_from_the_files_without_distortion(tmp_path: Path):
    disk.write_colmap(tmp_path, disk.survey(disk.BARREL.resized(128, 96)))
    scene, whole = load_scene(tmp_path, width=32), load_scene(tmp_path)
    pyramid = Pyramid(scene)
    level = 2 * PER_OCTAVE
    own = pyramid.cameras[pyramid.row(torch.tensor([4]), torch.tensor([level]))]
    colours, mask = pyramid.read(4, level)
    assert mask is None
    assert torch.equal(colours, whole.photographs[4])
    torch.testing.assert_close(own.focal_px, whole.cameras[4].focal_px)
    assert torch.equal(pyramid.read(4, 0)[0], scene.photographs[4])


def test_coarser_levels_are_means_and_use_only_what_is_used_in_full():
    scene = wall.with_left_halves_masked(wall.scene(wall.cameras(3, 256, 192)), (1,))
    colours, mask = Pyramid(scene).read(1, -2 * PER_OCTAVE)
    means = F.avg_pool2d(scene.photographs[1].permute(2, 0, 1)[None].float(), 4)[0].permute(1, 2, 0)
    np.testing.assert_allclose(colours.numpy(), means.numpy(), atol=1)
    assert mask is not None
    assert torch.equal(mask, (torch.arange(64) >= 32).expand(48, -1))


@pytest.mark.thorough
def test_a_much_smaller_view_does_not_alias():
    cameras = wall.cameras(5, 512, 384, step=0.25)
    scene = wall.scene(cameras, (2,))
    torch.manual_seed(0)
    network = make_network(SWIFT.network).eval()
    camera = cameras[2].resized(64, 48)
    noisy = torch.randint(-90, 90, (384, 512, 1), generator=torch.Generator().manual_seed(0))
    for i in range(5):
        scene.photographs[i].copy_((scene.photographs[i].int() + noisy.roll(7 * i, 1)).clamp(0, 255).byte())
    truth = F.avg_pool2d(wall.photograph(cameras[2]).permute(2, 0, 1)[None] / 255, 8)[0].permute(1, 2, 0)
    errors = [
        (Renderer(network, scene, SWIFT, CPU, Sampling(cones, 1))(camera).colour - truth).abs().mean()
        for cones in (True, False)
    ]
    assert errors[0] < 0.5 * errors[1]


def test_several_rays_give_the_mean_of_their_colours_and_of_their_inverse_depths():
    def render(camera: Cameras) -> Rendering:
        values = torch.arange(1.0, camera.width * camera.height + 1).reshape(camera.height, camera.width)
        return Rendering(values[..., None].expand(-1, -1, 3) / 100, 1 / values, values / 100)

    view = with_rays(render, Sampling(rays_per_side=2))(wall.cameras(1, 4, 2))
    assert view.colour.shape == (2, 4, 3)
    first = torch.tensor([1.0, 2.0, 9.0, 10.0]).mean()
    torch.testing.assert_close(view.colour[0, 0], first.expand(3) / 100)
    torch.testing.assert_close((1 / view.depth)[0, 0], torch.tensor((1.0 + 4 + 81 + 100) / 22))  # by their opacity
    torch.testing.assert_close(view.opacity[0, 0], first / 100)


@pytest.mark.parametrize(("share", "expected"), [(1.0, False), (0.8, False), (0.5, True)])
def test_views_much_coarser_than_the_photographs_get_several_rays(share: float, expected: bool):
    scene = wall.scene(wall.cameras(3, 256, 192))
    assert Pyramid(scene).is_much_coarser(scene.cameras[1].resized(round(256 * share), round(192 * share))) == expected


def test_a_scene_at_another_width_is_as_if_opened_at_it(tmp_path: Path):
    disk.write_colmap(tmp_path, disk.survey(disk.BARREL.resized(128, 96)))
    found, expected = at_width(load_scene(tmp_path, width=32), 64), load_scene(tmp_path, width=64)
    assert found.points is not None
    assert expected.points is not None
    for name in ("focal_px", "principal_px", "size_px", "T_world_camera"):
        torch.testing.assert_close(getattr(found.cameras, name), getattr(expected.cameras, name))
    torch.testing.assert_close(found.points.uv_px, expected.points.uv_px, atol=1e-3, rtol=0)
    for i in range(9):
        assert torch.equal(found.photographs[i], expected.photographs[i])


def test_a_level_an_octave_above_another_is_that_one_doubled(tmp_path: Path):
    disk.write_colmap(tmp_path, disk.survey(disk.BARREL.resized(256, 192)))
    pyramid = Pyramid(load_scene(tmp_path, width=33))  # odd, so that half octaves are rounded
    for level in (0, 1, 2):
        doubled = pyramid.read_doubled(4, level)
        assert doubled is not None
        assert doubled is pyramid.read(4, level + PER_OCTAVE)[0], "it is decoded once"
        above, own = (pyramid.camera(4, k).size_px for k in (level + PER_OCTAVE, level))
        assert torch.equal(above, 2 * own)


@pytest.mark.parametrize(("share", "expected"), [(0.5, True), (2.0, True), (2.8, True), (3.2, False), (4.0, False)])
def test_files_show_as_much_as_they_have(tmp_path: Path, share: float, expected: bool):
    disk.write_colmap(tmp_path, disk.survey(disk.BARREL.resized(128, 96)))
    scene = load_scene(tmp_path, width=64)  # half of what the files have
    pyramid = Pyramid(scene)
    for camera in scene.cameras[[0]], scene.cameras[[4]]:
        assert pyramid.files_show(camera.resized(round(64 * share), round(48 * share))) == expected
