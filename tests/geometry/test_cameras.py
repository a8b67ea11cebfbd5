import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tidefield.geometry.cameras import Cameras, angle_between, concatenate, intersect_axes, pixel_grid


def turned(angles: tuple[float, float, float]) -> Tensor:
    """A rotation: about x, then y, then z."""
    result = torch.eye(3, dtype=torch.float64)
    for axis, angle in enumerate(angles):
        c, s = math.cos(angle), math.sin(angle)
        turn = torch.eye(3, dtype=torch.float64)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
        result = turn @ result
    return result


def cameras() -> Cameras:
    rotation = torch.stack([turned((0.2 * k, -0.3, 0.5 + k)) for k in range(3)])
    position = torch.tensor([[1.0, 2.0, 3.0], [-4.0, 0.5, 9.0], [0.0, 0.0, -2.0]], dtype=torch.float64)
    return Cameras(
        T_world_camera=torch.cat([rotation, position[..., None]], -1),
        focal_px=torch.tensor([[50.0, 60.0], [80.0, 70.0], [40.0, 40.0]], dtype=torch.float64),
        principal_px=torch.tensor([[31.0, 25.5], [40.0, 30.0], [16.0, 12.0]], dtype=torch.float64),
        size_px=torch.tensor([[64, 48], [80, 60], [32, 24]]),
        near_far=torch.tensor([[1.0, 9.0]] * 3, dtype=torch.float64),
        gain=torch.ones(3, 3, dtype=torch.float64),
    )


def bent() -> Cameras:
    """The same cameras, with lenses that move pixels by up to 3 of them."""
    own = cameras()
    residual = 0.02 * torch.randn(3, 6, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return replace(own, residual=residual)


with_and_without_residual = pytest.mark.parametrize("own", [cameras(), bent()], ids=["pinhole", "residual"])


def world_points(count: int = 6) -> Tensor:
    return 5 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_projection_is_the_pinhole_point_by_point():
    own, points = cameras(), world_points()
    uv, z = own.project(points)
    for v in range(3):
        for p in range(len(points)):
            x = own.T_world_camera[v, :, :3].T @ (points[p] - own.T_world_camera[v, :, 3])
            assert z[v, p].item() == pytest.approx(x[2].item())
            expected = own.focal_px[v] * x[:2] / x[2] + own.principal_px[v]
            torch.testing.assert_close(uv[v, p], expected)


def test_the_projection_matrix_is_what_project_uses():
    own, points = cameras(), world_points()
    homogeneous = own.projection @ torch.cat([points, torch.ones(len(points), 1, dtype=torch.float64)], 1).T
    uv, z = own.project(points)
    torch.testing.assert_close(homogeneous[:, 2], z)
    torch.testing.assert_close((homogeneous[:, :2] / homogeneous[:, 2:]).transpose(1, 2), uv)


@with_and_without_residual
def test_unprojecting_to_a_depth_and_projecting_is_the_identity(own: Cameras):
    generator = torch.Generator().manual_seed(1)
    uv = 40 * torch.rand(3, 8, 2, generator=generator, dtype=torch.float64)
    depth = 1 + 5 * torch.rand(3, 8, generator=generator, dtype=torch.float64)
    points = own.position_world[:, None] + own.directions_world(uv) * depth[..., None]
    pixels, z = own.project(points)
    torch.testing.assert_close(pixels, uv, atol=1e-5, rtol=0)
    torch.testing.assert_close(z, depth)


def test_a_lens_residual_moves_pixels_by_its_polynomial():
    own = bent()
    points = own.position_world[0] + own.directions_world(own.size_px[:, None] * 0.8)[0] * 3
    u, v = replace(own, residual=None).project(points)[0][0, 0].tolist()
    x, y = ((a - float(b)) / float(f) for a, b, f in zip((u, v), own.principal_px[0], own.focal_px[0], strict=True))
    assert own.residual is not None
    moved = torch.tensor([1, x, y, x * x, x * y, y * y], dtype=torch.float64) @ own.residual[0] * own.focal_px[0]
    torch.testing.assert_close(own.project(points)[0][0, 0], torch.tensor([u, v], dtype=torch.float64) + moved)
    assert 0.1 < moved.norm() < 3


def test_a_lens_residual_folds_nothing_into_the_picture():
    own = bent()
    far = 10.0 ** torch.arange(0, 7)
    for side in ([1.0, 0.3], [-0.2, 1.0], [-1.0, -1.0]):
        xyz = torch.cat([far[:, None] * torch.tensor(side), torch.ones(7, 1)], 1).double()
        points = own.position_world[:, None] + xyz @ own.T_world_camera[:, :, :3].transpose(1, 2)
        distance = (own.project(points)[0] - own.principal_px[:, None]).norm(dim=-1)
        assert (distance.diff() > 0).all()


def test_cameras_with_and_without_a_residual_are_joined():
    own, plain = bent(), cameras()
    both = concatenate([plain, own])
    torch.testing.assert_close(both.project(world_points())[0][:3], plain.project(world_points())[0])
    torch.testing.assert_close(both.project(world_points())[0][3:], own.project(world_points())[0])
    assert concatenate([plain, plain]).residual is None


def test_the_principal_point_looks_forward_with_x_right_and_y_down():
    own = cameras()
    torch.testing.assert_close(own.directions_world(own.principal_px[:, None])[:, 0], own.forward_world)
    upright = Cameras(
        T_world_camera=torch.eye(3, 4)[None],
        focal_px=torch.tensor([[10.0, 10.0]]),
        principal_px=torch.tensor([[8.0, 6.0]]),
        size_px=torch.tensor([[16, 12]]),
        near_far=torch.tensor([[1.0, 2.0]]),
        gain=torch.ones(1, 3),
    )
    uv, z = upright.project(torch.tensor([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 1.0, 2.0]]))
    assert uv[0].tolist() == [[8, 6], [13, 6], [8, 11]]
    assert z.tolist() == [[2, 2, 2]]


def test_points_behind_and_in_the_cameras_plane_have_z_of_zero_or_less():
    own = cameras()[0]
    behind = own.position_world - 2 * own.forward_world
    uv, z = own.project(torch.cat([behind, own.position_world]))
    assert z[0, 0].item() == pytest.approx(-2)
    assert z[0, 1].item() == pytest.approx(0, abs=1e-12)
    assert uv.isfinite().all()


@with_and_without_residual
def test_a_resized_camera_projects_to_scaled_pixels(own: Cameras):
    points = world_points()
    uv, z = own.project(points)
    small = own.resized(16, 24)
    assert (small.size_px == torch.tensor([16, 24])).all()
    smaller, same = small.project(points)
    torch.testing.assert_close(smaller, uv * (small.size_px / own.size_px)[:, None])
    torch.testing.assert_close(same, z)


@with_and_without_residual
def test_a_cropped_camera_keeps_its_pixels(own: Cameras):
    points = world_points()
    cut = own.cropped(20, 70)
    assert (cut.size_px == torch.tensor([20, 70])).all()
    torch.testing.assert_close(cut.project(points), own.project(points))


def test_indexing_keeps_the_order_of_the_indices():
    own = replace(bent(), shading=torch.rand(3, 15, 3))
    assert len(own) == 3
    assert len(own[1]) == 1
    assert (own[1].width, own[1].height) == (80, 60)
    for index, expected in [([2, 0], [2, 0]), (slice(1, 3), [1, 2]), (torch.tensor([1, 1]), [1, 1])]:
        picked = own[index]
        for name in {f.name for f in fields(Cameras)} - {"names"}:
            assert torch.equal(getattr(picked, name), getattr(own, name)[expected])


def test_an_integer_of_any_kind_selects_one_camera_with_its_name():
    named = replace(bent(), names=("0.jpg", "1.jpg", "2.jpg"))
    for index in (1, np.int64(1), torch.tensor(1)):
        one = named[index]
        assert (len(one), one.names) == (1, ("1.jpg",))


def test_the_pixel_grid_goes_row_by_row_through_pixel_centres():
    expected = [[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [0.5, 1.5], [1.5, 1.5], [2.5, 1.5]]
    assert pixel_grid(3, 2).tolist() == expected


@pytest.mark.parametrize("angle", [1e-6, 1e-3, 1.0, math.pi / 2, 3.0, math.pi])
def test_angles_keep_their_relative_precision(angle: float):
    first = torch.tensor([1.0, 0.0, 0.0])
    second = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    assert angle_between(first, second).item() == pytest.approx(angle, rel=1e-3 if angle > 3 else 1e-6)


def test_angles_broadcast_and_are_zero_to_oneself():
    axes = torch.eye(3)
    expected = (1 - torch.eye(3)) * math.pi / 2
    torch.testing.assert_close(angle_between(axes[:, None], axes[None]), expected)


def test_axes_through_one_point_intersect_there():
    random = np.random.default_rng(0)
    target, position = np.array([3.0, -2.0, 5.0]), random.normal(0, 4, (12, 3))
    forward = (target - position) / np.linalg.norm(target - position, axis=1, keepdims=True)
    np.testing.assert_allclose(intersect_axes(position, forward), target, atol=1e-9)


def test_two_skew_axes_give_the_middle_of_their_common_perpendicular():
    point = intersect_axes(np.array([[-5.0, 0, 0], [0.0, 4, 2]]), np.array([[1.0, 0, 0], [0.0, 1, 0]]))
    np.testing.assert_allclose(point, [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 5.0])
def test_nearly_parallel_axes_have_no_intersection(degrees: float):
    turn = np.deg2rad(degrees) * np.array([-1.0, 0, 1])
    forward = np.stack([np.sin(turn), np.zeros(3), np.cos(turn)], axis=1)
    assert intersect_axes(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), forward) is None
