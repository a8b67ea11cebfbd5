"""The visual hull of a ball before a uniform background, from cameras around it."""

import json
import math
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from PIL import Image
from torch import Tensor

from tidefield.data.depth_prior import surface_prior
from tidefield.data.hull import Hull, hull_range, visual_hull
from tidefield.data.images import Photographs
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras, pixel_grid

CENTRE, RADIUS = torch.tensor([5.0, -3.0, 2.0]), 0.8


def around(count: int = 24, size: int = 80, distance: float = 4.0) -> Cameras:
    """Cameras all around the ball, evenly distributed, pointing at its middle."""
    z = 1 - (2 * torch.arange(count) + 1) / count
    turn = torch.arange(count) * math.pi * (3 - math.sqrt(5))
    outwards = torch.stack([(1 - z * z).sqrt() * turn.cos(), (1 - z * z).sqrt() * turn.sin(), z], -1)
    forward = -outwards
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.1, 0.2, 1.0]).expand(count, 3)))
    down = torch.linalg.cross(forward, right)
    position = CENTRE + distance * outwards
    return Cameras(
        T_world_camera=torch.cat([torch.stack([right, down, forward], -1), position[:, :, None]], -1),
        focal_px=torch.full((count, 2), 1.2 * size),
        principal_px=torch.full((count, 2), size / 2),
        size_px=torch.full((count, 2), size),
        near_far=torch.tensor([[0.5 * distance, 1.5 * distance]]).repeat(count, 1),
        gain=torch.ones(count, 3),
    )


def front(camera: Cameras) -> Tensor:
    """True z-depth of the ball in each pixel; NaN outside of it."""
    ray = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0]
    apart = CENTRE - camera.position_world[0]
    along, square = ray @ apart, ray.square().sum(-1)
    root = along.square() - square * (apart.square().sum() - RADIUS**2)
    return ((along - root.sqrt()) / square).reshape(camera.height, camera.width)


def pictures(cameras: Cameras) -> Photographs:
    alphas = [front(cameras[i]).isfinite().byte() * 255 for i in range(len(cameras))]
    return Photographs(tuple(torch.zeros(*a.shape, 3, dtype=torch.uint8) for a in alphas), tuple(alphas))


def hull_of(cameras: Cameras) -> Hull:
    """Of the first 24."""
    found = visual_hull(cameras, pictures(cameras), range(24))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def hull() -> Hull:
    return hull_of(around(25))


@pytest.mark.thorough
@pytest.mark.parametrize("size", [80, 500])
def test_the_hull_holds_the_ball_and_little_else(hull: Hull, size: int):
    hull = hull if size == 80 else hull_of(around(size=size))
    drawn = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0))
    outwards = torch.nn.functional.normalize(drawn)
    assert hull.contains(CENTRE + outwards * 0.999 * RADIUS).all()
    assert hull.contains(CENTRE + outwards * 1.25 * RADIUS).float().mean() < 0.02
    assert not hull.contains(CENTRE + outwards * 3).any()


@pytest.mark.thorough
def test_the_hull_holds_an_object_that_is_larger_than_the_frames():
    """Each place of it is in four frames of ten."""
    views = around()
    closer = replace(views, focal_px=2.6 * views.focal_px)
    outwards = torch.nn.functional.normalize(CENTRE - views.position_world, dim=-1)
    assert hull_of(closer).contains(CENTRE + 0.97 * RADIUS * outwards).all()


@pytest.mark.thorough
def test_a_new_views_rays_meet_the_surface_within_the_range(hull: Hull):
    new = around(25)[24]
    near, far, meets = hull_range(new, hull)
    truth = front(new)
    there = truth.isfinite()
    assert meets[there].all()
    assert (meets & ~there).float().mean() < 0.06
    assert ((near <= truth) & (truth <= far))[there].all()
    assert (truth - near)[there].median() < 0.15
    assert ((far - near)[there]).max() < 2.6 * RADIUS
    # Rays that miss it get the range of all rays that meet it.
    torch.testing.assert_close(near[0, 0], near.min())
    torch.testing.assert_close(far[0, 0], far.max())


@pytest.mark.thorough
def test_a_view_that_misses_the_hull_keeps_its_near_and_far(hull: Hull):
    cameras = around()
    away = replace(cameras[0], T_world_camera=cameras[0].T_world_camera * torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    near, far, meets = hull_range(away, hull)
    assert not meets.any()
    assert (near == away.near_far[0, 0]).all()
    assert (far == away.near_far[0, 1]).all()


def test_no_hull_without_silhouettes_or_if_they_contradict_each_other():
    cameras = around()
    truth = pictures(cameras)
    assert visual_hull(cameras, replace(truth, alphas=()), range(24)) is None
    assert visual_hull(cameras, replace(truth, alphas=(None, *truth.alphas[1:])), range(24)) is None
    assert visual_hull(cameras, truth, range(2)) is None
    nowhere = tuple(torch.zeros(80, 80, dtype=torch.uint8) for _ in range(24))
    assert visual_hull(cameras, replace(truth, alphas=nowhere), range(24)) is None


@pytest.mark.thorough
def test_the_depth_prior_lies_within_the_hull(hull: Hull):
    cameras = around(25)
    new = cameras[24]
    expected, near, far = surface_prior(new, None, cameras, hull)
    assert expected.shape == (20, 20)
    middle = front(new)[2::4, 2::4]
    inside = middle.isfinite() & front(new)[1::4, 1::4].isfinite()
    assert ((near > 1 / middle) & (1 / middle > far))[inside].all()
    assert (expected[inside] * middle[inside] - 1).abs().median() < 0.05
    assert expected[0, 0].isnan()
    assert near[0, 0] <= near.max()


def write_blender_part(root: Path, part: str, cameras: Cameras, alphas: list[Tensor]) -> None:
    """One part of a Blender scene of the ball, moved to the origin."""
    (root / part).mkdir()
    frames = []
    for i, alpha in enumerate(alphas):
        pixels = torch.stack([alpha, alpha // 2, alpha // 3, alpha], -1).numpy()
        Image.fromarray(pixels).save(root / part / f"{i}.png")
        pose = torch.eye(4)
        pose[:3] = cameras.T_world_camera[i] * torch.tensor([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes
        pose[:3, 3] -= CENTRE
        frames.append({"file_path": f"./{part}/{i}", "transform_matrix": pose.tolist()})
    angle = 2 * math.atan(0.5 / 1.2)
    (root / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Its held-out photographs are of the background alone: they would carve away everything."""
    root, cameras = tmp_path_factory.mktemp("ball"), around()
    alphas = [alpha for alpha in pictures(cameras).alphas if alpha is not None]
    write_blender_part(root, "train", cameras, alphas)
    write_blender_part(root, "test", cameras[1:4], [torch.zeros_like(alpha) for alpha in alphas[1:4]])
    return load_scene(root, cache=root / "cache")


def test_scenes_with_alpha_have_the_hull_of_their_training_photographs(scene: Scene):
    assert scene.points is None
    assert len(scene.test) == 3
    assert scene.hull is not None
    middle = -scene.origin_world.float()
    assert scene.hull.contains(middle)
    assert not scene.hull.contains(middle + torch.tensor([0.0, 0.0, 1.5]))


def test_the_hull_is_kept_for_the_next_time(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tidefield.data.load.visual_hull", Mock(side_effect=AssertionError("carved again")))
    first, second = scene.hull, load_scene(scene.root, cache=scene.root / "cache").hull
    assert first is not None
    assert second is not None
    assert torch.equal(first.filled, second.filled)
    assert torch.equal(first.corner_world, second.corner_world)
    assert torch.equal(first.voxel_world, second.voxel_world)
