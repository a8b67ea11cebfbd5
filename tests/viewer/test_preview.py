"""Coarse pictures: photographs of a wall, moved into other views of it."""

from dataclasses import replace

import textured_wall
import torch

from tidefield.geometry.cameras import Cameras
from tidefield.viewer.preview import Preview, points_of


def moved(camera: Cameras, x: float) -> Cameras:
    pose = camera.T_world_camera.clone()
    pose[0, 0, 3] += x
    return replace(camera, T_world_camera=pose)


def difference(shown: torch.Tensor, camera: Cameras) -> float:
    true = textured_wall.photograph(camera).float() / 255
    return float((shown - true).abs().mean())


def test_the_view_between_two_photographs_shows_the_wall():
    scene = textured_wall.scene(textured_wall.cameras(6))
    camera = moved(scene.cameras[2], 0.15)
    view = Preview(scene)(replace(camera, names=()))
    photograph = scene.photographs[2].float() / 255
    assert difference(view.colour, camera) < min(0.06, difference(photograph, camera) / 2)
    seen = view.opacity > 0.5
    assert seen.float().mean() > 0.9
    assert torch.allclose(view.depth[seen], torch.tensor(textured_wall.DEPTH), atol=0.1)


def test_what_no_photograph_shows_is_continued_from_next_to_it():
    scene = textured_wall.scene(textured_wall.cameras(3))
    view = Preview(scene)(moved(scene.cameras[1], 3.0))
    assert (view.opacity < 0.5).any()
    assert view.colour.isfinite().all()
    assert float(view.colour.min()) > 0.05  # the wall is nowhere black


def test_the_last_sharp_picture_goes_before_the_photographs():
    scene = textured_wall.scene(textured_wall.cameras(4))
    camera = scene.cameras[1]
    sharp = Preview(scene)(camera)
    red = replace(sharp, colour=torch.tensor([1.0, 0, 0]).expand_as(sharp.colour), opacity=torch.ones_like(sharp.depth))
    view = Preview(scene)(moved(camera, 0.05), points_of(red, camera))
    middle = view.colour[10:-10, 10:-10].reshape(-1, 3).median(0).values
    assert torch.equal(middle, torch.tensor([1.0, 0, 0]))


def test_preparing_ends_when_all_photographs_are_ready_and_changes_no_picture():
    scene = textured_wall.scene(textured_wall.cameras(5))
    fresh, prepared = Preview(scene), Preview(scene)
    count = 0
    while prepared.prepare():
        count += 1
    assert count == len(scene.train)
    fresh(scene.cameras[0])
    while fresh.prepare():
        pass
    assert torch.equal(fresh(scene.cameras[0]).colour, prepared(scene.cameras[0]).colour)
