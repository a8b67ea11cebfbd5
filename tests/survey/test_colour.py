"""Gains and falloff are estimated where they exist, and photographs without them stay unchanged."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import textured_wall as wall
import torch

from tidefield.data.images import Photographs
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import pixel_grid
from tidefield.survey.colour import ExposureCorrection, estimate_correction, to_common_exposure

FALLOFF = np.array([-0.9, 0.3, 0.0])
GAINS = np.exp(np.random.default_rng(1).normal(0, 0.2, (12, 3)))
MORE_GAINS = np.exp(np.random.default_rng(1).normal(0, 0.2, (16, 3)))


def tangent(scene: Scene, index: int) -> np.ndarray:
    camera = scene.cameras[index]
    xy = (pixel_grid(camera.width, camera.height) - camera.principal_px) / camera.focal_px
    return xy.norm(dim=1).reshape(camera.height, camera.width).double().numpy()


def shaded(gains: np.ndarray, falloff: np.ndarray) -> Scene:
    """The wall at moderate brightness, each photograph with its gain and all with the lens' falloff."""
    count = len(gains)
    cameras = wall.cameras(count, width=160, height=120, step=0.12)
    scene, pictures = wall.scene(cameras), []
    r = tangent(scene, 0)
    for k in range(count):
        shade = np.exp(np.stack([r**2, r**4, r**6], -1) @ falloff)[..., None] * gains[k]
        light = wall.photograph(cameras[k]).numpy() * 0.55
        pictures.append(torch.from_numpy(np.clip(np.rint(light * shade), 0, 255).astype(np.uint8)))
    points = wall.points(cameras, 1500)
    return replace(scene, photographs=Photographs(tuple(pictures)), points=points, train=tuple(range(count)), test=())


@pytest.fixture(scope="module")
def scene() -> Scene:
    return shaded(GAINS, FALLOFF)


@pytest.fixture(scope="module")
def correction(scene: Scene) -> ExposureCorrection:
    return estimate_correction(scene, [0] * 12)


@pytest.fixture(scope="module")
def flat() -> Scene:
    return shaded(np.ones((12, 3)), np.zeros(3))


def test_gains_and_falloff_are_found(scene: Scene, correction: ExposureCorrection):
    assert correction.helps
    assert correction.sees_falloff
    assert correction.after < correction.gains_alone < 0.5 * correction.before
    relative = np.log(correction.gain / GAINS)
    np.testing.assert_allclose(relative - relative.mean(0), 0, atol=0.02)
    r = tangent(scene, 0)
    found, true = (np.stack([r**2, r**4, r**6], -1) @ f for f in (correction.falloff[0], FALLOFF))
    np.testing.assert_allclose((found - found.min()) - (true - true.min()), 0, atol=0.03)


def test_gains_that_rise_along_a_flight_are_not_pulled_to_their_mean():
    gains = np.exp(np.linspace(-0.6, 0.6, 12))[:, None] * np.ones(3)
    correction = estimate_correction(shaded(gains, FALLOFF), [0] * 12)
    assert correction.sees_falloff
    relative = np.log(correction.gain / gains)
    np.testing.assert_allclose(relative - relative.mean(0), 0, atol=0.006)


def test_the_memory_of_a_photograph_is_given_back_once_it_was_looked_at(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    released = []
    monkeypatch.setattr(Photographs, "release", lambda photographs: released.append(photographs))
    estimate_correction(scene, [0] * 12)
    assert len(released) == 12


def test_corrected_photographs_agree(scene: Scene, flat: Scene, correction: ExposureCorrection):
    ratios = []
    for k in range(12):
        ours = to_common_exposure(
            scene.photographs[k].numpy(), correction.gain[k], correction.falloff[k], tangent(scene, k)
        )
        ratios.append(
            (ours.astype(float).mean((0, 1)) + 1) / (flat.photographs[k].numpy().astype(float).mean((0, 1)) + 1)
        )
    spread = np.std(np.log(ratios), axis=0)
    assert spread.max() < 0.02


def test_photographs_that_agree_are_left_alone(flat: Scene):
    correction = estimate_correction(flat, [0] * 12)
    assert not correction.helps
    assert not correction.sees_falloff
    np.testing.assert_array_equal(correction.gain, 1)
    np.testing.assert_array_equal(correction.falloff, 0)


def test_one_point_says_nothing_of_exposures(scene: Scene):
    assert scene.points is not None
    middle = scene.points.xyz_world.norm(dim=1).argmin()
    points = scene.points.subset(torch.arange(1500) == middle)
    assert not estimate_correction(replace(scene, points=points), [0] * 12, always=True).helps


def test_gains_without_falloff_see_no_falloff():
    correction = estimate_correction(shaded(GAINS, np.zeros(3)), [0] * 12)
    assert correction.helps
    np.testing.assert_allclose(correction.falloff, 0, atol=0.05)


def test_corners_brighter_than_the_centre_are_no_falloff_and_do_not_make_the_correction_help():
    """They are not the lens's, so that they would not be removed."""
    correction = estimate_correction(shaded(np.ones((12, 3)), -FALLOFF / 2), [0] * 12)
    assert correction.after < 0.9 * min(correction.before, correction.gains_alone)
    assert not correction.sees_falloff
    assert not correction.helps
    np.testing.assert_array_equal(correction.gain, 1)


def test_each_lens_has_its_own_falloff():
    light, dark = shaded(MORE_GAINS, np.zeros(3)), shaded(MORE_GAINS, FALLOFF)
    mixed = tuple((dark if k % 2 else light).photographs[k] for k in range(16))
    correction = estimate_correction(replace(light, photographs=Photographs(mixed)), [k % 2 for k in range(16)])
    assert correction.sees_falloff
    r = 0.5
    without, with_falloff = (correction.falloff[k] @ [r**2, r**4, r**6] for k in (0, 1))
    assert with_falloff - without == pytest.approx(FALLOFF @ [r**2, r**4, r**6], abs=0.04)


def test_a_lens_of_few_photographs_has_no_falloff():
    correction = estimate_correction(shaded(MORE_GAINS, FALLOFF), [0] * 9 + [1] * 7)
    assert correction.sees_falloff
    assert (correction.falloff[:9] @ [0.5**2, 0.5**4, 0.5**6] < -0.1).all()
    np.testing.assert_array_equal(correction.falloff[9:], 0)


def test_held_out_photographs_have_gain_one_and_change_nothing():
    scene = replace(shaded(GAINS, FALLOFF), train=tuple(range(2, 12)), test=(0, 1))
    correction = estimate_correction(scene, [0] * 12)
    for k in scene.test:
        scene.photographs.colours[k].neg_()  # modulo 256
    again = estimate_correction(scene, [0] * 12)
    np.testing.assert_array_equal(again.gain, correction.gain)
    np.testing.assert_array_equal(again.falloff, correction.falloff)
    np.testing.assert_array_equal(correction.gain[:2], 1)
    np.testing.assert_array_equal(correction.falloff[:2], correction.falloff[2:4])
    relative = np.log(correction.gain / GAINS)[2:]
    np.testing.assert_allclose(relative - relative.mean(0), 0, atol=0.02)


def test_without_points_nothing_is_done(scene: Scene):
    correction = estimate_correction(replace(scene, points=None), [0] * 12)
    assert not correction.helps
    np.testing.assert_array_equal(correction.gain, 1)


def test_a_gain_is_divided_out_and_rounded():
    picture = np.full((2, 2, 3), 100, dtype=np.uint8)
    r = np.array([[0.0, 0.5], [0.5, 1.0]])
    result = to_common_exposure(picture, np.array([2.0, 1.0, 0.3]), np.array([-0.1, 0.0, 0.0]), r)
    assert result[0, 0].tolist() == [50, 100, 255]
    assert result[1, 1, 1] == round(100 * np.exp(0.1))


@pytest.mark.parametrize("has_falloff", [True, False])
def test_a_photograph_is_corrected_with_little_memory_to_the_same_pixels(has_falloff: bool):
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (1000, 600, 3), dtype=np.uint8)
    v, u = np.mgrid[:1000, :600] / 600
    falloff = FALLOFF if has_falloff else np.zeros(3)
    r = np.hypot(u - 0.5, v - 0.8).astype(np.float32) if has_falloff else np.zeros((1, 1), np.float32)
    shade = np.exp(np.stack([r**2, r**4, r**6], -1) @ falloff)[..., None]
    expected = np.clip(np.rint(picture / (shade * GAINS[0])), 0, 255).astype(np.uint8)
    tracemalloc.start()
    result = to_common_exposure(picture, GAINS[0], falloff, r)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * picture.nbytes
    assert np.abs(result.astype(int) - expected).max() <= 1
    assert (result != expected).mean() < 1e-4
