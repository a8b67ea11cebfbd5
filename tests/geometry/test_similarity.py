"""Similarities: exact data, gross errors, weights, and rotations that the points do not determine."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tidefield.geometry.similarity import (
    Similarity,
    hypotheses,
    least_median,
    level,
    outliers,
    refine_similarity,
)

TRUTH = Similarity(
    42.0, Rotation.from_euler("ZYX", [40, 170, 5], degrees=True).as_matrix(), np.array([900.0, -300, 70])
)
DOWN = TRUTH.rotation.T @ [0.0, 0, -1]


def cameras(count: int = 20, across: float = 1.0, seed: int = 0) -> np.ndarray:
    """Points in a model's units: nearly flat, with a given half width."""
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * (2, across, 0.02) @ TRUTH.rotation


def assert_same(found: Similarity, expected: Similarity, points: np.ndarray, within: float = 1e-8) -> None:
    np.testing.assert_allclose(found(points), expected(points), atol=within)


def test_inverse_and_composition():
    points = cameras()
    np.testing.assert_allclose(TRUTH.inverse()(TRUTH(points)), points, atol=1e-12)
    other = Similarity(0.5, level(np.array([1.0, 2, 3])), np.array([1.0, 2, 3]))
    assert_same(
        other @ TRUTH, Similarity(21.0, other.rotation @ TRUTH.rotation, other(TRUTH.translation[None])[0]), points
    )


def test_exact_points_give_the_exact_similarity():
    for found in hypotheses(cameras(3), TRUTH(cameras(3)), None, np.random.default_rng(0)):
        assert_same(found, TRUTH, cameras(), 1e-6)


def test_mirrored_points_give_rotations():
    points = cameras(5, across=1.5)
    found = hypotheses(points, TRUTH(points) * [1, 1, -1], None, np.random.default_rng(0))
    assert len(found) == 10
    assert [np.linalg.det(one.rotation) for one in found] == pytest.approx([1] * 10)


def test_coincident_points_give_finite_similarities():
    points = cameras(6)
    points[:3] = points[0]
    found = hypotheses(points, TRUTH(points), DOWN, np.random.default_rng(0))
    assert len(found) == 20 + 15
    assert all(np.isfinite(one(points)).all() for one in found)


@pytest.mark.parametrize("share", [0.05, 0.45])
def test_up_to_half_of_the_points_may_be_wrong(share):
    points = cameras(40)
    wrong = np.arange(40) < 40 * share
    target = TRUTH(points) + wrong[:, None] * np.random.default_rng(1).normal(0, 1e5, (40, 3))
    found, median = least_median(hypotheses(points, target, None, np.random.default_rng(0)), points, target)
    assert_same(found, TRUTH, points, 1e-4)
    assert median < 1e-4
    np.testing.assert_array_equal(outliers(np.linalg.norm(found(points) - target, axis=1), 15.0), wrong)


def test_collinear_points_suffice_if_down_is_given():
    points = cameras(12, across=0.0)
    points -= np.outer((points - points.mean(0)) @ DOWN, DOWN)
    candidates = hypotheses(points, TRUTH(points), DOWN, np.random.default_rng(0))
    found, _ = least_median(candidates, points, TRUTH(points))
    assert_same(found, TRUTH, cameras(), 1e-6)


def test_collinear_points_give_no_hypothesis_without_down():
    points = np.outer(np.arange(5.0), [1.0, 2, 3])
    assert hypotheses(points, TRUTH(points), None, np.random.default_rng(0)) == []


def test_accurate_points_have_more_weight():
    points = cameras(60)
    generator = np.random.default_rng(3)
    sigma = np.where(np.arange(60)[:, None] < 6, 0.02, 5.0) * np.ones((60, 3))
    target = TRUTH(points) + generator.normal(0, 1, (60, 3)) * sigma
    unweighted = refine_similarity(TRUTH, points, target, np.ones((60, 3))).similarity
    weighted = refine_similarity(TRUTH, points, target, sigma).similarity
    off = [np.linalg.norm(found(points) - TRUTH(points), axis=1).mean() for found in (unweighted, weighted)]
    assert off[1] < 0.05 < off[0]


def test_a_start_of_a_scale_near_zero_is_refined_to_the_truth():
    points = cameras()
    start = Similarity(42e-9, TRUTH.rotation, TRUTH(points.mean(0)[None])[0] - 42e-9 * TRUTH.rotation @ points.mean(0))
    found = refine_similarity(start, points, TRUTH(points), np.ones((20, 3)))
    assert_same(found.similarity, TRUTH, points, 1e-6)


def test_the_estimated_tilt_error_is_the_observed_one():
    points, tilts = cameras(30, across=0.15), []
    for seed in range(200):
        target = TRUTH(points) + np.random.default_rng(seed).normal(0, 1.5, (30, 3))
        found = refine_similarity(TRUTH, points, target, np.full((30, 3), 1.5))
        tilts.append(np.arccos(-(found.similarity.rotation @ DOWN)[2]))
    assert np.sqrt(np.mean(np.square(tilts))) == pytest.approx(found.tilt_rad, rel=0.35)


def test_a_prior_vertical_is_kept_within_its_standard_deviation():
    points = cameras(12, across=0.0)
    target = TRUTH(points) + np.random.default_rng(0).normal(0, 1, (12, 3))
    free = refine_similarity(TRUTH, points, target, np.ones((12, 3)))
    held = refine_similarity(TRUTH, points, target, np.ones((12, 3)), DOWN, np.deg2rad(1))
    assert free.tilt_rad > np.deg2rad(5)
    assert held.tilt_rad < np.deg2rad(1.1)
    assert (held.similarity.rotation @ DOWN)[2] < -np.cos(np.deg2rad(3))


@pytest.mark.parametrize("down", [[0.0, 0, -1], [0.0, 0, 1], [3.0, -1, 0.2]])
def test_levelling_rotates_down_to_minus_z(down):
    rotation = level(np.array(down))
    np.testing.assert_allclose(rotation @ np.array(down) / np.linalg.norm(down), [0, 0, -1], atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)
