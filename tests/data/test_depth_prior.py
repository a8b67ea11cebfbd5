import math
from dataclasses import replace

import numpy as np
import pytest
import textured_wall as wall
import torch
from torch import Tensor

from tidefield.data.depth_prior import (
    INTERVAL_POINTS,
    LEAST_MARGIN,
    MARGIN,
    SPARSE_DISTANCE,
    SPARSE_MARGIN,
    STRIDE,
    DepthPrior,
    DepthPriors,
    read_prior,
    surface_prior,
)
from tidefield.data.surface import trusted_points
from tidefield.geometry.cameras import Cameras, pixel_grid

TILT = (0.15, -0.1)


def centres(prior: Tensor) -> Tensor:
    """Pixels at the middles of a prior's cells, 1 R 2."""
    height, width = prior.shape[-2:]
    return pixel_grid(width, height)[None] * STRIDE


def inverse_wall(camera: Cameras, uv: Tensor) -> Tensor:
    """True inverse depth of the tilted wall at pixels, 1 R."""
    direction = camera.directions_world(uv)
    start = camera.position_world[0]
    slope = direction[..., 2] - direction[..., :2] @ torch.tensor(TILT)
    return slope / (wall.wall_z(start[:2], TILT) - start[2])


@pytest.mark.parametrize(("width", "height"), [(48, 36), (50, 33), (47, 39)])
def test_on_a_tilted_plane_the_expected_depth_is_exact(width: int, height: int):
    own = wall.cameras(3, width, height)
    prior = surface_prior(own[1], wall.points(own, tilt=TILT), own)
    assert prior.shape == (3, math.ceil(height / 4), math.ceil(width / 4))
    uv = centres(prior)
    torch.testing.assert_close(prior[0].reshape(1, -1), inverse_wall(own[1], uv), rtol=1e-4, atol=0)


def test_reading_between_the_cells_is_exact_on_a_plane_within_the_outermost_middles():
    own = wall.cameras(3, 50, 33)
    prior = surface_prior(own[1], wall.points(own, tilt=TILT), own)
    uv = pixel_grid(50, 33)[None]
    inner = ((uv >= 2) & (uv <= torch.tensor([prior.shape[2], prior.shape[1]]) * 4 - 2)).all(-1)
    expected, near, far = read_prior(prior[None], uv)
    torch.testing.assert_close(expected[inner], inverse_wall(own[1], uv)[inner], rtol=1e-4, atol=0)
    assert (near > expected).all()
    assert (expected > far).all()


def test_beyond_the_image_the_border_continues():
    own = wall.cameras(3)
    prior = surface_prior(own[1], wall.points(own), own)[None]
    outside = read_prior(prior, torch.tensor([[[-50.0, 10.0], [500.0, 10.0]]]))
    border = read_prior(prior, torch.tensor([[[0.0, 10.0], [48.0, 10.0]]]))
    for one, other in zip(outside, border, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("count", [1, 5, 40, 400])
def test_the_interval_holds_the_surface_and_stays_within_the_cameras_range(count: int):
    own = wall.cameras(3)
    expected, near, far = surface_prior(own[0], wall.points(own, count, TILT), own)
    true = inverse_wall(own[0], pixel_grid(12, 9)[None] * 4).reshape(9, 12)
    assert (near > far).all()
    assert (near <= 1 / 3 + 1e-6).all()
    assert (far >= 1 / 10 - 1e-6).all()
    if count >= 40:
        assert ((near >= expected) & (expected >= far)).all()
        assert ((near >= true) & (true >= far)).all()


def test_without_points_the_interval_is_the_cameras_near_and_far():
    own = wall.cameras(2)
    own = replace(own, near_far=torch.tensor([[3.0, 10.0], [2.0, 8.0]]))
    expected, near, far = surface_prior(own[1], None, own)
    assert expected.shape == (9, 12)
    assert expected.isnan().all()
    assert (near == 1 / 2).all()
    assert (far == 1 / 8).all()
    read = read_prior(torch.stack([expected, near, far])[None], torch.tensor([[[-3.0, 7.0], [20.0, 11.0]]]))
    assert read[0].isnan().all()
    torch.testing.assert_close(read[1], torch.full((1, 2), 0.5))
    torch.testing.assert_close(read[2], torch.full((1, 2), 0.125))


def test_with_too_few_points_for_an_interval_it_is_the_cameras_near_and_far():
    own = wall.cameras(3)
    points = wall.points(own[[0]])
    inside = (points.uv_px > 0).all(-1) & (points.uv_px < own.size_px[0]).all(-1)
    few = points.subset(inside & (inside.cumsum(0) < INTERVAL_POINTS))
    expected, near, far = surface_prior(own[0], few, own)
    torch.testing.assert_close(expected, torch.full_like(expected, 1 / wall.DEPTH))
    torch.testing.assert_close(near, torch.full_like(near, 1 / 3))
    torch.testing.assert_close(far, torch.full_like(far, 1 / 10))


def test_no_more_priors_are_kept_than_there_is_room_for():
    scene, found = wall.scene(wall.cameras(4)), []

    def match(camera: Cameras, cells: Tensor) -> DepthPrior:
        found.append(len(found))
        return DepthPrior(cells, torch.zeros(camera.height, camera.width))

    one = DepthPriors(scene, match=match)[0].nbytes
    priors = DepthPriors(scene, match=match, most_bytes=2 * one)
    for index in (0, 1, 0, 2, 0, 1):
        assert priors[index].nbytes == one
    assert len(found) - 1 == 4, "1 went when 2 came"


def test_a_new_camera_without_observations_has_a_prior():
    own = wall.cameras(5)
    points = wall.points(own[[0, 1, 3, 4]], tilt=TILT)
    prior = surface_prior(own[2], points, own[[0, 1, 3, 4]])
    torch.testing.assert_close(prior[0].reshape(1, -1), inverse_wall(own[2], centres(prior)), rtol=1e-4, atol=0)


def test_a_scene_in_millimetres_has_the_same_prior_in_other_units():
    own = wall.cameras(3)
    points = wall.points(own, tilt=TILT)
    pose = own.T_world_camera.clone()
    pose[:, :, 3] *= 1000
    larger = replace(own, T_world_camera=pose, near_far=own.near_far * 1000)
    scaled = surface_prior(larger[0], replace(points, xyz_world=points.xyz_world * 1000), larger)
    torch.testing.assert_close(scaled * 1000, surface_prior(own[0], points, own), rtol=1e-3, atol=0)


def test_the_interval_extends_beyond_the_nearest_points_by_the_margin():
    """Against a plain search of each cell's nearest points."""
    own = wall.cameras(3)
    wide = replace(own, near_far=torch.tensor([[0.5, 100.0]]).repeat(3, 1))
    points = wall.points(own, 60, (0.6, -0.5))
    expected, near, far = surface_prior(wide[0], points, wide)
    uv, inverse = trusted_points(wide[0].resized(12, 9), points, wide)
    spread = np.percentile(inverse, 98) - np.percentile(inverse, 2)
    margins = set()
    for row in range(9):
        for column in range(12):
            distance = np.hypot(uv[:, 0] - column - 0.5, uv[:, 1] - row - 0.5)
            around = inverse[np.argsort(distance)[:INTERVAL_POINTS]]
            share = min(distance.min() / (SPARSE_DISTANCE * 12), 1)
            margin = spread * (MARGIN * (1 - share) + SPARSE_MARGIN * share)
            surface = float(expected[row, column])
            assert float(near[row, column]) == pytest.approx(
                max(around.max() + margin, surface * (1 + LEAST_MARGIN)), rel=1e-5
            )
            assert float(far[row, column]) == pytest.approx(
                max(min(around.min() - margin, surface / (1 + LEAST_MARGIN)), 1 / 100), rel=1e-5
            )
            margins.add(round(margin / spread, 2))
    assert max(margins) == SPARSE_MARGIN
    assert min(margins) < 0.2


def test_the_interval_contains_the_surface_with_the_least_margin_where_all_points_have_one_depth():
    own = wall.cameras(3)
    expected, near, far = surface_prior(own[1], wall.points(own), own)
    torch.testing.assert_close(expected, torch.full_like(expected, 1 / wall.DEPTH))
    torch.testing.assert_close(near, expected * (1 + LEAST_MARGIN))
    torch.testing.assert_close(far, expected / (1 + LEAST_MARGIN))
