"""Angles between directions, and the point that optical axes have in common."""

import math

import numpy as np
import pytest
import torch

from tidefield.geometry.rays import angle_between, intersect_axes


@pytest.mark.parametrize("angle", [1e-6, 1e-3, 1.0, math.pi / 2, 3.0, math.pi])
def test_angles_keep_their_relative_precision(angle: float) -> None:
    first = torch.tensor([1.0, 0.0, 0.0])
    second = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    assert angle_between(first, second).item() == pytest.approx(angle, rel=1e-3 if angle > 3 else 1e-6)


def test_angles_broadcast_and_are_zero_to_oneself() -> None:
    axes = torch.eye(3)
    expected = (1 - torch.eye(3)) * math.pi / 2
    torch.testing.assert_close(angle_between(axes[:, None], axes[None]), expected)


def test_axes_through_one_point_intersect_there() -> None:
    random = np.random.default_rng(0)
    target, position = np.array([3.0, -2.0, 5.0]), random.normal(0, 4, (12, 3))
    forward = (target - position) / np.linalg.norm(target - position, axis=1, keepdims=True)
    np.testing.assert_allclose(intersect_axes(position, forward), target, atol=1e-9)


def test_two_skew_axes_give_the_middle_of_their_common_perpendicular() -> None:
    point = intersect_axes(np.array([[-5.0, 0, 0], [0.0, 4, 2]]), np.array([[1.0, 0, 0], [0.0, 1, 0]]))
    np.testing.assert_allclose(point, [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 5.0])
def test_nearly_parallel_axes_have_no_intersection(degrees: float) -> None:
    turn = np.deg2rad(degrees) * np.array([-1.0, 0, 1])
    forward = np.stack([np.sin(turn), np.zeros(3), np.cos(turn)], axis=1)
    assert intersect_axes(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), forward) is None
