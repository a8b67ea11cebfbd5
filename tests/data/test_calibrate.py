"""Calibration of a survey whose lens is known."""

import logging
from dataclasses import replace

import pytest
import torch
from captures import survey
from torch import Tensor

from tidefield.data.calibrate import calibrate_lenses
from tidefield.data.scene import SparsePoints
from tidefield.geometry.cameras import Cameras

TRUE = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.006, 0.004], [-0.002, -0.004], [0.008, 0.002]])
TRAIN = tuple(i for i in range(39) if i % 8)
HELD_OUT = tuple(range(0, 39, 8))


def observed(residual: Tensor | None, noise_px: float) -> tuple[Cameras, SparsePoints]:
    """Pinhole cameras, and the points that lenses with a residual observed, where the pinholes put them."""
    scene = survey()
    points = scene.points
    assert points is not None
    exact = scene.cameras if residual is None else replace(scene.cameras, residual=residual.expand(39, 6, 2))
    noise = noise_px * torch.randn(len(points.uv_px), 2, generator=torch.Generator().manual_seed(1))
    uv = exact.project(points.xyz_world)[0][points.camera_index, points.point_index] + noise
    return scene.cameras, replace(points, uv_px=uv)


def error_px(cameras: Cameras, points: SparsePoints, which: tuple[int, ...]) -> float:
    """Root-mean-square reprojection error in some photographs."""
    off = cameras.project(points.xyz_world)[0][points.camera_index, points.point_index] - points.uv_px
    mine = torch.isin(points.camera_index, torch.tensor(which))
    return float(off[mine].square().sum(-1).mean().sqrt())


def test_the_residual_of_the_lens_is_found_for_held_out_photographs_too(caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.DEBUG, "tidefield")
    cameras, points = observed(TRUE, 0.1)
    found, moved = calibrate_lenses(cameras, points, ["wide"] * 39, TRAIN)
    assert found.residual is not None
    torch.testing.assert_close(found.residual[0, 3:], TRUE[3:], atol=6e-4, rtol=0)
    assert error_px(cameras, points, HELD_OUT) > 0.4
    assert error_px(found, moved, HELD_OUT) < 0.16  # 0.14 are noise
    assert "applied" in caplog.text
    assert "px" in caplog.text


@pytest.mark.parametrize("noise_px", [0.0, 0.1])
def test_lenses_without_a_residual_get_none(noise_px: float):
    cameras, points = observed(None, noise_px)
    found, same = calibrate_lenses(cameras, points, ["wide"] * 39, TRAIN)
    assert found is cameras
    assert same is points


@pytest.mark.parametrize("seed", [3, 68, 97])
def test_noise_of_points_that_are_seen_twice_is_no_residual(seed: int):
    scene, random = survey(), torch.Generator().manual_seed(seed)
    points = scene.points
    assert points is not None
    train = torch.randperm(39, generator=random)[:12]
    mine = torch.nonzero(torch.isin(points.camera_index.long(), train))[:, 0]
    mine = mine[torch.randperm(len(mine), generator=random)]
    twice = torch.stack([torch.cumsum(points.point_index[mine] == k, 0) for k in range(len(points.xyz_world))])
    mine = mine[twice[points.point_index[mine].long(), torch.arange(len(mine))] <= 2]
    mine = mine[torch.bincount(points.point_index[mine].long())[points.point_index[mine].long()] == 2]
    camera, point = points.camera_index[mine], points.point_index[mine]
    uv = scene.cameras.project(points.xyz_world)[0][camera.long(), point.long()]
    uv = uv + 0.3 * torch.randn(len(mine), 2, generator=random)
    own = replace(points, camera_index=camera, point_index=point, uv_px=uv)
    found, _ = calibrate_lenses(scene.cameras, own, ["wide"] * 39, tuple(sorted(train.tolist())))
    assert found is scene.cameras


def test_held_out_photographs_change_nothing():
    cameras, points = observed(TRUE, 0.1)
    pose, uv = cameras.T_world_camera.clone(), points.uv_px.clone()
    pose[list(HELD_OUT), :, 3] += 1
    uv[torch.isin(points.camera_index, torch.tensor(HELD_OUT))] += 5
    found, moved = calibrate_lenses(cameras, points, ["wide"] * 39, TRAIN)
    again, same = calibrate_lenses(
        replace(cameras, T_world_camera=pose), replace(points, uv_px=uv), ["wide"] * 39, TRAIN
    )
    assert found.residual is not None
    assert again.residual is not None
    assert torch.equal(found.residual, again.residual)
    assert torch.equal(moved.xyz_world, same.xyz_world)


def test_each_lens_has_its_own_residual_and_too_few_photographs_have_none():
    cameras, points = observed(TRUE, 0.1)
    lenses = ["wide" if i < 25 else "other" if i < 32 else str(i) for i in range(39)]
    found, _ = calibrate_lenses(cameras, points, lenses, TRAIN)
    assert found.residual is not None
    assert (found.residual[:25] == found.residual[0]).all()
    assert found.residual[0].any()
    assert not found.residual[25:].any()
