import numpy as np
from scenes_on_disk import PINHOLE, observe, survey

from tidefield.data.near_far import estimate_near_far
from tidefield.data.readers.posed import Observations

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])


def flat_survey(height: float = 50.0, count: int = 12) -> np.ndarray:
    """Cameras in a row, straight down, 10 apart."""
    poses = [np.concatenate([DOWN, [[10.0 * i], [0], [height]]], axis=1) for i in range(count)]
    return np.array(poses)


def observations(poses: np.ndarray, xyz: np.ndarray) -> Observations:
    seen = [(point, i, uv[point]) for i, pose in enumerate(poses) for uv, good in [observe(PINHOLE, pose, xyz)]
            for point in np.flatnonzero(good)]  # fmt: skip
    point, photograph, uv = zip(*seen, strict=True)
    return Observations(xyz, np.array(point), np.array(photograph), np.array(uv))


def ground(count: int, extent: float = 150.0) -> np.ndarray:
    random = np.random.default_rng(0)
    return np.c_[random.uniform(-extent, extent, (count, 2)), np.zeros(count)]


def test_ranges_over_flat_ground_include_trees_and_holes() -> None:
    poses = flat_survey()
    near_far = estimate_near_far(poses, (PINHOLE,) * 12, observations(poses, ground(4000)))
    np.testing.assert_allclose(near_far, np.tile([25.0, 70.0], (12, 1)))


def test_a_stray_point_does_not_stretch_the_range() -> None:
    poses = flat_survey()
    xyz = np.concatenate([ground(4000), [[50.0, 0, 49.9], [50.0, 0, -5000.0]]])
    near_far = estimate_near_far(poses, (PINHOLE,) * 12, observations(poses, xyz))
    np.testing.assert_allclose(near_far, np.tile([25.0, 70.0], (12, 1)))


def test_cameras_with_few_observations_take_the_points_in_their_frustum() -> None:
    poses = flat_survey()
    all_seen = observations(poses, ground(4000))
    kept = all_seen.photograph_index != 5
    few = Observations(all_seen.xyz_world, *(a[kept] for a in (all_seen.point_index, all_seen.photograph_index)),
                       all_seen.uv_px[kept])  # fmt: skip
    np.testing.assert_allclose(estimate_near_far(poses, (PINHOLE,) * 12, few)[5], [25.0, 70.0])


def test_cameras_over_nothing_take_the_range_of_the_others() -> None:
    poses = flat_survey()
    poses[3, 0, 3] = 5000.0
    near_far = estimate_near_far(poses, (PINHOLE,) * 12, Observations(ground(4000)))
    np.testing.assert_allclose(near_far, np.tile([25.0, 70.0], (12, 1)))


def test_too_few_points_are_ignored() -> None:
    poses = survey(PINHOLE).T_world_camera
    near_far = estimate_near_far(poses, (PINHOLE,) * 9, Observations(ground(5)))
    np.testing.assert_allclose(near_far, estimate_near_far(poses, (), None))


def test_ranges_of_cameras_with_a_common_focus_surround_it() -> None:
    around = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    forward = -np.stack([np.cos(around), np.sin(around), 0 * around + 0.5], axis=1) / np.sqrt(1.25)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.stack([right, np.cross(forward, right), forward, [7.0, 8.0, 9.0] - 20 * forward], axis=2)
    np.testing.assert_allclose(estimate_near_far(poses, (), None), np.tile([2.0, 80.0], (10, 1)))


def test_ranges_of_parallel_cameras_follow_their_spacing() -> None:
    near_far = estimate_near_far(flat_survey(), (), None)
    assert (near_far[:, 0] == 5.0).all()
    assert (near_far[:, 1] == 1000.0).all()


def test_cameras_at_one_position_get_a_range() -> None:
    poses = np.tile(np.c_[DOWN, np.zeros(3)], (4, 1, 1))
    near, far = estimate_near_far(poses, (), None).T
    assert (near > 0).all()
    assert (near < far).all()
