"""Shading of a survey whose light is known."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from captures import survey
from torch import Tensor

from tidefield.data.exposure import Pairs, Seen, across_views
from tidefield.data.scene import SparsePoints
from tidefield.data.shading import CORRELATION, _chain, directional_shading, estimate_shading
from tidefield.geometry.cameras import Cameras, concatenate, pixel_grid

COUNT, NOISE = 39, 0.01
LENSES = ["wide"] * COUNT
TRAIN = tuple(i for i in range(COUNT) if i % 8 != 4)
HELD_OUT = tuple(range(4, COUNT, 8))


def planted() -> Tensor:
    """Vignetting, and a light across the frame that wanders along the flight."""
    shading = torch.zeros(COUNT, 15, 3)
    shading[:, 3] = shading[:, 5] = -0.15
    time = torch.arange(COUNT)
    shading[:, 1] = 0.08 * torch.sin(time / 4)[:, None]
    shading[:, 2] = 0.08 * torch.cos(time / 5)[:, None]
    return shading


def observed(shading: Tensor | None, turned: tuple[int, ...] = ()) -> tuple[Tensor, Cameras, SparsePoints]:
    """Log colours of all observations in a light; cameras that know nothing of it; and the points."""
    scene = survey(turned=turned)
    points = scene.points
    assert points is not None
    generator = torch.Generator().manual_seed(2)
    colour = torch.rand(len(points.xyz_world), 3, generator=generator).add(0.3).log()
    noise = NOISE * torch.randn(len(points.uv_px), 3, generator=generator)
    return colour[points.point_index] + light(scene.cameras, points, shading) + noise, scene.cameras, points


def light(cameras: Cameras, points: SparsePoints, shading: Tensor | None) -> Tensor:
    lit = replace(cameras, shading=shading)
    return lit[points.camera_index].gain_at(points.uv_px[:, None])[:, 0].log()


def seen_in(which: tuple[int, ...], value: Tensor, points: SparsePoints) -> Seen:
    row = torch.isin(points.camera_index, torch.tensor(which)).nonzero()[:, 0].numpy()
    all_seen = Seen(
        value.double().numpy(),
        points.point_index.numpy(),
        points.camera_index.numpy(),
        np.arange(len(value)),
        np.zeros((len(value), 2)),
    )
    return all_seen.part(np.isin(np.arange(len(value)), row))


def directions(cameras: Cameras, points: SparsePoints) -> np.ndarray:
    """Of the view of every observation, across the mean optical axis."""
    ray = points.xyz_world[points.point_index] - cameras.position_world[points.camera_index]
    return torch.nn.functional.normalize(ray, dim=1).double().numpy() @ across_views(cameras, TRAIN)


def differences(value: Tensor, points: SparsePoints, which: tuple[int, ...]) -> float:
    """How much photographs differ from the training photographs in the points' colours, but for their means."""
    train = torch.isin(points.camera_index, torch.tensor(TRAIN))
    total = torch.zeros(400, 3).index_add(0, points.point_index[train], value[train])
    rest = value - (total / torch.bincount(points.point_index[train], minlength=400)[:, None])[points.point_index]
    own = [rest[points.camera_index == i] for i in which]
    return float(torch.cat([one - one.mean(0) for one in own]).square().mean().sqrt())


def test_the_light_is_found_and_foretold_for_held_out_photographs(caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.DEBUG, "tidefield")
    value, cameras, points = observed(planted())
    found = estimate_shading(seen_in(TRAIN, value, points), cameras, points, LENSES, TRAIN)
    even = value - light(cameras, points, found)
    assert differences(value, points, TRAIN) > 0.03
    assert differences(even, points, TRAIN) < 1.3 * NOISE
    assert differences(even, points, HELD_OUT) < 0.6 * differences(value, points, HELD_OUT)
    assert "without the direction's squares" in caplog.text
    assert "applied" in caplog.text


def test_lenses_that_were_calibrated_for_each_photograph_are_one():
    value, cameras, points = observed(planted())
    seen = seen_in(TRAIN, value, points)
    one, each = (
        estimate_shading(seen, cameras, points, lenses, TRAIN) for lenses in (LENSES, [f"{i}" for i in range(COUNT)])
    )
    assert one is not None
    assert each is not None
    assert torch.equal(one, each)


def test_light_that_is_quadratic_in_the_direction_is_foretold_for_all_headings(caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.DEBUG, "tidefield")
    value, cameras, points = observed(None, turned=(1,))
    direction = directions(cameras, points)
    along, across = direction.T
    # Such as grass, brightest where its blades hide their shadows.
    value += torch.from_numpy(0.6 * (along + 0.4 * across) ** 2)[:, None].float()
    seen = replace(seen_in(TRAIN, value, points), direction=direction[np.isin(points.camera_index, TRAIN)])
    found = estimate_shading(seen, cameras, points, LENSES, TRAIN)
    even = value - light(cameras, points, found)
    assert differences(value, points, HELD_OUT) > 2 * NOISE
    assert differences(even, points, HELD_OUT) < 1.15 * NOISE
    assert "with the direction's squares" in caplog.text


@pytest.mark.thorough
def test_forming_the_normal_matrix_and_iterating_find_the_same(monkeypatch: pytest.MonkeyPatch):
    value, cameras, points = observed(planted())
    seen = seen_in(TRAIN, value, points)
    formed = estimate_shading(seen, cameras, points, LENSES, TRAIN)
    monkeypatch.setattr("tidefield.data.shading.MOST_DENSE", 0)
    monkeypatch.setattr("tidefield.data.shading.TOLERANCE", 1e-7)
    iterated = estimate_shading(seen, cameras, points, LENSES, TRAIN)
    assert formed is not None
    assert iterated is not None
    lit = [light(cameras, points, shading) for shading in (formed, iterated)]
    torch.testing.assert_close(*lit, atol=0.01 * NOISE, rtol=0)


def test_shading_that_is_known_is_not_estimated_again():
    value, cameras, points = observed(planted())
    known = torch.zeros(COUNT, 15, 3)
    known[:, 1] = 0.05
    with_known = value + light(cameras, points, known) - light(cameras, points, None)
    lit = replace(cameras, shading=known)
    found = estimate_shading(seen_in(TRAIN, with_known, points), lit, points, LENSES, TRAIN)
    plain = estimate_shading(seen_in(TRAIN, value, points), cameras, points, LENSES, TRAIN)
    assert found is not None
    assert plain is not None
    torch.testing.assert_close(light(cameras, points, found), light(cameras, points, plain), atol=1e-4, rtol=0)


def test_photographs_in_one_light_get_no_shading(caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.DEBUG, "tidefield")
    value, cameras, points = observed(None)
    assert estimate_shading(seen_in(TRAIN, value, points), cameras, points, LENSES, TRAIN) is None
    assert "not applied" in caplog.text


def test_too_few_photographs_get_no_shading():
    value, cameras, points = observed(planted())
    few = TRAIN[:11]
    assert estimate_shading(seen_in(few, value, points), cameras, points, LENSES, few) is None


def test_each_lens_has_its_own_vignetting():
    shading = planted()
    shading[20:, 3] = shading[20:, 5] = 0.1
    value, cameras, points = observed(shading)
    lenses = ["wide"] * 20 + ["other"] * 19
    found = estimate_shading(seen_in(TRAIN, value, points), cameras, points, lenses, TRAIN)
    assert differences(value - light(cameras, points, found), points, TRAIN) < 1.3 * NOISE


def test_the_light_of_a_picture_is_that_of_its_pixels_at_every_size():
    cameras = replace(survey().cameras, shading=planted(), gain=torch.rand(COUNT, 3) + 0.5)
    camera = cameras[5]
    uv = pixel_grid(400, 300)[None]
    whole = camera.gain_of_rows()
    torch.testing.assert_close(whole, camera.gain_at(uv)[0].reshape(300, 400, 3))
    torch.testing.assert_close(camera.gain_of_rows(slice(10, 30), slice(None, None, 3)), whole[10:30, ::3])
    small = camera.resized(200, 150).gain_at(uv[:, : 150 * 200] / 2)
    torch.testing.assert_close(small, camera.gain_at(uv[:, : 150 * 200]))
    assert torch.equal(replace(camera, shading=None).gain_of_rows(), camera.gain[0].expand(1, 1, 3))


def test_the_light_of_windows_is_that_of_the_pictures_there():
    cameras = replace(survey().cameras, shading=planted(), gain=torch.rand(COUNT, 3) + 0.5)[[5, 0, 5]]
    corners = torch.tensor([[0, 0], [30, 7], [301, 222]])
    found = cameras.gain_of_windows(corners, 60, 40)
    for k, (u, v) in enumerate(corners.tolist()):
        torch.testing.assert_close(found[k], cameras[k].gain_of_rows(slice(v, v + 40), slice(u, u + 60)))
    without = replace(cameras, shading=None)
    assert torch.equal(without.gain_of_windows(corners, 60, 40), cameras.gain[:, None, None])


def test_cameras_with_and_without_shading_are_joined_and_selected():
    with_light = replace(survey().cameras, shading=planted())
    both = concatenate([with_light[:3], survey().cameras[:2]])
    assert both.shading is not None
    assert torch.equal(both.shading[:3], planted()[:3])
    assert not both.shading[3:].any()
    assert torch.equal(with_light[7].shading[0], planted()[7])


def test_what_depends_on_the_direction_is_a_polynomial_over_each_frame():
    scene = survey()
    points = scene.points
    assert points is not None
    by_direction = np.array([[0.3, 0.2, 0.1], [-0.1, 0.0, 0.2]])
    shading = directional_shading(scene.cameras, TRAIN, by_direction)
    found = light(scene.cameras, points, shading) - light(scene.cameras, points, None)
    direction = directions(scene.cameras, points)
    assert np.ptp(direction @ by_direction) > 0.1
    np.testing.assert_allclose(found.numpy(), direction @ by_direction, atol=3e-3)


def test_the_prior_of_consecutive_photographs_is_an_autoregression_of_unit_variance():
    count = 6
    pose = torch.eye(3, 4).repeat(count, 1, 1)
    pose[4:, :, :2] *= -1  # the last two were flown the other way
    two = torch.ones(count, 2)
    cameras = Cameras(pose, two, two, torch.full((count, 2), 8), two, torch.ones(count, 3))
    steps = np.arange(count - 1)
    far = np.where(steps == 2, 1e9, 1.0)  # after a pause
    inverse = _chain(cameras, Pairs(steps, steps + 1, far)).toarray()
    covariance = np.linalg.inv(inverse)
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    group = np.array([0, 0, 0, 1, 2, 2])
    np.testing.assert_allclose(covariance, np.where(group[:, None] == group, CORRELATION**apart, 0), atol=1e-12)
