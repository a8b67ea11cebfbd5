from dataclasses import replace

import pytest
import textured_wall as wall
import torch

from tidefield.data.scene import SparsePoints
from tidefield.data.surface import doubly_seen, seen_count, surface_depth

TILT = (0.2, -0.1)


def joined(first: SparsePoints, xyz: torch.Tensor, observer: int) -> SparsePoints:
    """More points, each observed by one camera."""
    count = len(first.xyz_world)
    more = torch.arange(count, count + len(xyz))
    return SparsePoints(
        xyz_world=torch.cat([first.xyz_world, xyz]),
        error_px=torch.zeros(count + len(xyz)),
        point_index=torch.cat([first.point_index, more]),
        camera_index=torch.cat([first.camera_index, torch.full_like(more, observer)]),
        uv_px=torch.cat([first.uv_px, torch.zeros(len(xyz), 2)]),
    )


def test_depth_is_exact_on_a_tilted_plane_for_a_camera_without_observations():
    own = wall.cameras(3)
    points = wall.points(own, tilt=TILT)
    new = wall.cameras(1, width=40, height=20)
    torch.testing.assert_close(surface_depth(new, points, own), wall.true_depth(new, TILT), rtol=1e-4, atol=0)


def test_a_plane_continues_exactly_outside_the_hull_of_its_points():
    own = wall.cameras(1)
    points = wall.points(own, tilt=TILT)
    corner = points.xyz_world[:, :2].amax(1) < 0
    some = SparsePoints(
        xyz_world=points.xyz_world[corner],
        error_px=points.error_px[corner],
        point_index=torch.arange(int(corner.sum())),
        camera_index=torch.zeros(int(corner.sum()), dtype=torch.long),
        uv_px=points.uv_px[corner],
    )
    torch.testing.assert_close(surface_depth(own, some, own), wall.true_depth(own, TILT), rtol=1e-4, atol=0)


def test_outliers_before_and_behind_the_surface_have_no_influence():
    own = wall.cameras(3)
    wrong = torch.tensor([[0.1, 0.2, 2.0], [-0.7, 0.3, 60.0], [0.8, -0.5, 9.0], [0.0, 0.0, 0.5]])
    points = joined(wall.points(own, tilt=TILT), wrong, observer=0)
    depth = surface_depth(own[1], points, own)
    torch.testing.assert_close(depth, wall.true_depth(own[1], TILT), rtol=1e-4, atol=0)


def test_points_seen_only_from_behind_the_surface_are_left_out():
    own = wall.cameras(2)
    pose = own.T_world_camera.clone()
    pose[1, :, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    pose[1, :, 3] = torch.tensor([0.0, 0.0, 30.0])
    own = replace(own, T_world_camera=pose)
    front = wall.points(own[0])
    behind = front.xyz_world + torch.tensor([0.01, 0.02, 3.0])
    depth = surface_depth(own[0], joined(front, behind, observer=1), own)
    torch.testing.assert_close(depth, torch.full_like(depth, wall.DEPTH), rtol=1e-4, atol=0)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points_still_give_a_depth_everywhere(count: int):
    """Without any, that of the plane at the harmonic mean of near and far."""
    own = wall.cameras(1)
    points = wall.points(own, count=400)
    visible = points.xyz_world[points.xyz_world[:, :2].abs().amax(1) < 1][:count]
    some = SparsePoints(visible, torch.zeros(count), torch.arange(count), torch.zeros(count).long(), visible[:, :2])
    middle = wall.DEPTH if count else 2 / (1 / 3.0 + 1 / 10.0)
    for points in (some, None) if count == 0 else (some,):
        torch.testing.assert_close(surface_depth(own, points, own), torch.full((36, 48), middle), rtol=1e-4, atol=0)


def test_seen_count_is_how_many_frames_hold_the_surface_point():
    # At depth 5 and focal 48 a step of 0.3 moves the picture by 2.88 px: column centres below 2.5 leave the frame of
    # the camera to the right, those below 5.5 of the next one.
    own = wall.cameras(4)
    count = seen_count(own[0], torch.full((36, 48), wall.DEPTH), own)
    columns = torch.arange(48) + 0.5
    expected = sum((columns > 2.88 * k).long() for k in range(4))
    assert torch.equal(count, expected.expand(36, 48))


def test_a_point_behind_a_camera_is_not_seen_by_it():
    own = wall.cameras(2, step=0.0)
    pose = own.T_world_camera.clone()
    pose[1, 2, 3] = wall.DEPTH + 1
    behind = replace(own, T_world_camera=pose)
    count = seen_count(behind[0], torch.full((36, 48), wall.DEPTH), behind)
    assert torch.equal(count, torch.ones_like(count))


def test_doubly_seen_counts_training_photographs_only():
    scene = wall.scene(wall.cameras(3), test=(1,))
    seen = doubly_seen(scene, scene.cameras[1])
    # Each of the two training photographs misses the three outermost columns of one side.
    assert not seen[:, :2].any()
    assert not seen[:, -2:].any()
    assert seen[:, 3:-3].all()
