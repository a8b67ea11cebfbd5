"""Shapes of camera paths: valid rotations, constant speed, no jumps, right viewing directions."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from captures import SCENES, TILT, UP, angle, object_scene, oblique, scene_of, survey
from torch import Tensor

from tidefield.data.hull import Hull, hull_range
from tidefield.data.scene import Scene
from tidefield.geometry.lenses import Lens
from tidefield.render.camera_paths import (
    AHEAD,
    GENTLE,
    SHAPES,
    Shape,
    _plane_normal,
    _tour,
    among_cameras,
    free_camera,
    layout_of,
    orbit,
    strip,
)


def poses(shape: Shape, scene: Scene, frames: int, reach: float = 1.0) -> tuple[Tensor, Tensor]:
    position, rotation = shape(layout_of(scene), frames, reach)
    return torch.from_numpy(position).float(), torch.from_numpy(rotation).float()


def turns(rotation: Tensor) -> Tensor:
    """Angle between each frame and the next, radians."""
    change = rotation[:-1].transpose(1, 2) @ rotation[1:]
    return torch.acos(((change.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1))


@pytest.mark.parametrize("kind", SCENES)
def test_the_kind_of_capture_and_its_up_are_found_whatever_the_axes(kind: str):
    layout = layout_of(SCENES[kind]())
    assert layout.kind == ("survey" if kind == "oblique" else kind)
    assert angle(torch.tensor(layout.up).float(), UP) < 2


@pytest.mark.parametrize("path", SHAPES)
@pytest.mark.parametrize("kind", SCENES)
def test_every_path_is_made_of_rotations(kind: str, path: str):
    _, rotation = poses(SHAPES[path], SCENES[kind](), 31)
    assert torch.allclose(rotation.transpose(1, 2) @ rotation, torch.eye(3).expand(31, 3, 3), atol=1e-5)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(31), atol=1e-5)


@pytest.mark.parametrize("path", SHAPES)
@pytest.mark.parametrize("kind", SCENES)
def test_no_path_jumps_or_turns_abruptly(kind: str, path: str):
    position, rotation = poses(SHAPES[path], SCENES[kind](), 600)
    step = position.diff(dim=0).norm(dim=1) / layout_of(SCENES[kind]()).distance
    assert step.max() < 0.1
    assert torch.rad2deg(turns(rotation)).max() < 4


@pytest.mark.parametrize("path", SHAPES)
@pytest.mark.parametrize("kind", SCENES)
def test_a_path_of_less_reach_stays_within_that_of_more(kind: str, path: str):
    far, near = (poses(SHAPES[path], SCENES[kind](), 100, reach)[0] for reach in (1.0, 0.5))
    extent = [(p - p.mean(0)).norm(dim=1).max() for p in (far, near)]
    assert extent[1] < 1.001 * extent[0]
    if (kind, path) not in (("around", "cameras"), ("around", "orbit")):
        assert extent[1] < 0.9 * extent[0]


@pytest.mark.parametrize("frames", [1, 2])
@pytest.mark.parametrize("path", SHAPES)
@pytest.mark.parametrize("kept", [1, 2, 3])
@pytest.mark.parametrize("kind", SCENES)
def test_few_photographs_and_few_frames_are_enough(kind: str, kept: int, path: str, frames: int):
    scene = replace(SCENES[kind](), train=tuple(range(kept)))
    position, rotation = poses(SHAPES[path], scene, frames)
    assert (position.shape, rotation.shape) == ((frames, 3), (frames, 3, 3))
    assert position.isfinite().all()
    assert rotation.isfinite().all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_photographs_have_no_plane(count: int):
    random, down = np.random.default_rng(0), np.array([0.0, 0.6, -0.8])
    for _ in range(100):
        assert (_plane_normal(random.normal(size=(count, 3)), down) == -down).all()


def test_the_tour_passes_through_the_cameras_in_order_at_constant_speed():
    scene = oblique()
    position, _ = poses(among_cameras, scene, 400)
    apart = torch.cdist(scene.cameras.position_world, position).min(1)
    step = position.diff(dim=0).norm(dim=1)
    assert apart.values.max() <= step.max()
    assert (apart.indices.diff() > 0).all()
    assert step.std() / step.mean() < 0.02
    assert step.max() / step.mean() < 1.05


def test_the_tour_turns_at_constant_apparent_speed():
    scene = oblique()
    turned = scene.cameras.T_world_camera.clone()
    turned[13:26, :, :2] *= -1  # the second line is flown with the opposite heading
    scene = replace(scene, cameras=replace(scene.cameras, T_world_camera=turned))
    position, rotation = poses(among_cameras, scene, 400)
    turn, travel = turns(rotation), position.diff(dim=0).norm(dim=1) / layout_of(scene).distance
    speed = (turn**2 + travel**2).sqrt()
    assert turn.sum() > 2 * torch.pi * 0.95
    assert speed.max() / speed.mean() < 1.1


def test_the_tour_of_many_cameras_needs_little_memory():
    places = np.random.default_rng(0).random((150, 3))
    layout = replace(layout_of(oblique()), position=places, rotation=np.tile(np.eye(3), (150, 1, 1)))
    tracemalloc.start()
    order = _tour(layout)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sorted(order) == list(range(150))
    assert peak < 150 * 150 * 8, "not all distances at once"
    away = np.linalg.norm(places[:, None] - places, axis=2)
    assert order[0] == away.sum(1).argmax()
    for k in range(1, 150):
        assert away[order[k - 1], order[k]] == away[order[k - 1], order[k:]].min()


def test_cameras_named_in_no_order_are_toured_without_long_jumps():
    scene = object_scene()
    position, _ = poses(among_cameras, scene, 600)
    named = scene.cameras.position_world.diff(dim=0).norm(dim=1).sum()
    assert position.diff(dim=0).norm(dim=1).sum() < 0.4 * named
    assert torch.cdist(scene.cameras.position_world, position).min(1).values.max() < 0.1


def test_a_flight_over_a_survey_goes_forward_slowly_and_looks_a_little_ahead():
    position, rotation = poses(among_cameras, survey(), 240)
    travel = torch.nn.functional.normalize(position.diff(dim=0), dim=1)
    ahead, up = rotation[:, :, 2], -rotation[:, :, 1]
    assert angle(ahead, -UP) == pytest.approx(np.degrees(AHEAD), abs=0.5)
    assert angle(travel, torch.nn.functional.normalize(up - (up @ UP)[:, None] * UP, dim=1)[1:]) < 1
    assert torch.allclose(position @ UP, torch.full((240,), 40.0), atol=0.2)
    assert turns(rotation).max() <= 1.1 * GENTLE
    assert torch.rad2deg(turns(rotation)).sum() > 30, "it does turn"


def test_a_longer_flight_goes_farther_but_no_faster_and_never_beyond_the_flight_lines():
    lengths = []
    for frames in (24, 96, 960):
        position, _ = poses(among_cameras, survey(), frames)
        step = position.diff(dim=0).norm(dim=1)
        assert step.max() < 1.2 * GENTLE * 40
        lengths.append(step.sum())
        forward, across = position @ TILT[:, 0], position @ TILT[:, 1]
        assert forward.min() > -40 * np.tan(AHEAD) - 0.5
        assert forward.max() < 60.5
        assert 0 < across.min() < across.max() < 24
    assert lengths[0] < lengths[1] < lengths[2]


def test_a_flight_follows_a_survey_that_bends():
    bend = torch.linspace(0, torch.pi / 2, 40)
    position = torch.stack([200 * bend.sin(), 200 * (1 - bend.cos()), torch.full_like(bend, 40)], 1)
    scene = scene_of(position, torch.tensor([0.0, 0.0, -1.0]), torch.tensor([0.0, 1.0, 0.0]), (20.0, 60.0))
    flown, _ = poses(among_cameras, scene, 960)
    flown = flown @ TILT
    assert (flown[-1] - flown[0])[:2].norm() > 150
    assert ((flown[:, :2] - torch.tensor([0.0, 200.0])).norm(dim=1) - 200).abs().max() < 10


@pytest.mark.parametrize("kind", SCENES)
def test_an_orbit_looks_at_its_centre_and_closes(kind: str):
    scene = SCENES[kind]()
    centre = torch.tensor(layout_of(scene).centre).float()
    position, rotation = poses(orbit, scene, 48)
    assert angle(rotation[:, :, 2], torch.nn.functional.normalize(centre - position, dim=1)) < 0.1
    step = (position - position.roll(1, 0)).norm(dim=1)
    assert step[0] == pytest.approx(float(step[1:].mean()), rel=0.6)
    assert (rotation[:, :, 1] @ UP).max() < 0, "up in the world must be up in the picture"


def test_an_orbit_around_an_object_seen_from_the_front_only_stays_in_front():
    scene = object_scene()
    front = [i for i in range(60) if float(scene.cameras.position_world[i] @ TILT[:, 0]) > 0]
    position, _ = poses(orbit, replace(scene, train=tuple(front)), 48)
    assert (position @ TILT[:, 0]).min() > -0.1


def test_an_orbit_over_a_survey_keeps_height_and_looks_at_most_thirty_degrees_aside():
    position, rotation = poses(orbit, survey(), 48)
    assert torch.allclose(position @ UP, torch.full((48,), 40.0), atol=0.2)
    assert angle(rotation[:, :, 2], -UP) <= 30.1


def test_a_strip_looks_straight_down_along_the_long_axis():
    position, rotation = poses(strip, survey(), 50)
    assert angle(rotation[:, :, 2], -UP) < 0.5
    travel = torch.nn.functional.normalize(position.diff(dim=0), dim=1)
    assert angle(travel, TILT[:, 0]) < 1 or angle(travel, -TILT[:, 0]) < 1
    assert angle(-rotation[1:, :, 1], travel) < 0.5
    assert torch.allclose(position @ UP, torch.full((50,), 40.0), atol=0.2)
    assert torch.allclose(position @ TILT[:, 1], torch.full((50,), 12.0), atol=0.5)


def test_a_free_camera_always_has_a_range():
    scene, lens = survey(), Lens(400, 300, 300.0, 300.0, 200.0, 150.0)
    points = scene.points
    assert points is not None
    pose = scene.cameras.T_world_camera[5].double().numpy()
    level = free_camera(scene, pose, lens).near_far[0].tolist()
    assert 15 < level[0] < 40 < level[1] < 60
    # Looking up, no point is seen; a few of many points are seen from close above the ground.
    up = pose.copy()
    up[:, 1:3] *= -1
    assert free_camera(scene, up, lens).near_far[0].tolist() == pytest.approx([20.0, 56.0])
    many = points.xyz_world.repeat(400, 1)
    moved = many + 0.1 * torch.randn(many.shape, generator=torch.Generator().manual_seed(0))
    dense = replace(scene, points=replace(points, xyz_world=moved, error_px=torch.ones(len(many))))
    close = pose.copy()
    close[:, 3] += 36 * pose[:, 2]
    near, far = free_camera(dense, close, lens).near_far[0].tolist()
    assert near < 4 < far < 10


@pytest.mark.parametrize("distance", [0.5, 1.5, 4.0, 8.0])
def test_without_points_a_free_camera_has_the_range_of_the_visual_hull(distance: float):
    hull = Hull(torch.full((3,), -0.5), torch.full((3,), 0.25), torch.ones(4, 4, 4, dtype=torch.bool))
    scene = replace(object_scene(), points=None, hull=hull)
    pose, lens = np.eye(3, 4), Lens(40, 30, 30.0, 30.0, 20.0, 15.0)
    pose[2, 3] = -distance
    camera = free_camera(scene, pose, lens)
    far = distance + 0.5
    assert camera.near_far[0].tolist() == pytest.approx([max(distance - 0.5, 0.02 * far), far])
    assert hull_range(camera, hull)[2][15, 20]
    pose[:, 1:3] *= -1
    away = free_camera(scene, pose, lens).near_far
    if distance > 0.5:
        low, high = scene.cameras.near_far[list(scene.train)].T
        assert away[0].tolist() == pytest.approx([float(low.quantile(0.05)), float(high.quantile(0.95))])
