"""Areas of large surveys: what they hold is what the whole scene has there."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import textured_wall as wall
import torch
from networks import SMALL

from tidefield.data.areas import PLACES, Area, _ground, cut, select
from tidefield.data.batches import draw_batch
from tidefield.data.depth_prior import DepthPriors
from tidefield.data.matching import Matcher
from tidefield.data.neighbours import choose_neighbours
from tidefield.data.scene import Scene, SparsePoints
from tidefield.data.surface import which_see
from tidefield.geometry.halves import halves

CUT = partial(cut, whole=20, most=8)


def survey(columns: int = 8, rows: int = 6) -> Scene:
    """A grid of cameras, each of which sees half of the next one's wall."""
    row = wall.cameras(columns, step=2.5)
    pose = row.T_world_camera.repeat(rows, 1, 1)
    pose[:, 1, 3] = 1.9 * (torch.arange(rows).repeat_interleave(columns) - (rows - 1) / 2)
    pose[:, :2, 3] += 0.3 * torch.randn(len(pose), 2, generator=torch.Generator().manual_seed(1))
    own = row[torch.arange(columns).repeat(rows)]
    own = replace(own, T_world_camera=pose, near_far=torch.tensor([4.5, 5.5]).repeat(len(pose), 1))
    return wall.scene(own, test=(0, 9))


@pytest.fixture(scope="module")
def scene() -> Scene:
    at = survey()
    random = torch.Generator().manual_seed(0)
    xy = (torch.rand(3000, 2, generator=random) - 0.5) * torch.tensor([24.0, 15.0])
    xyz = torch.cat([xy, wall.wall_z(xy)[:, None]], -1)
    uv, _ = at.cameras.project(xyz)
    camera, point = ((uv > 0) & (uv < at.cameras.size_px[:, None])).all(-1).nonzero(as_tuple=True)
    points = SparsePoints(xyz, torch.rand(len(xyz), generator=random), point, camera, uv[camera, point])
    return replace(at, points=points)


@pytest.fixture(scope="module")
def areas(scene: Scene) -> list[Area]:
    return [select(scene, targets) for targets in CUT(scene)]


def test_every_training_photograph_is_a_target_of_one_area(scene: Scene):
    found = CUT(scene)
    assert sorted(i for targets in found for i in targets) == sorted(scene.train)
    assert len(found) == 8
    assert all(4 <= len(targets) <= 8 for targets in found)
    position = scene.cameras.position_world
    for targets in found:
        assert position[list(targets)][:, 0].max() - position[list(targets)][:, 0].min() < 11


def test_small_scenes_are_one_area_unless_their_photographs_are_large(scene: Scene):
    assert cut(scene) == [scene.train]
    assert len(cut(scene, whole_bytes=46 * 48 * 36 * 5 + 1.0)) == 1
    parts = cut(scene, whole_bytes=12 * 48 * 36 * 5 + 1.0)
    assert all(len(part) <= 12 for part in parts)
    assert len(cut(scene, whole_bytes=1.0)) == len(halves(np.random.default_rng(0).random((46, 3)), 8))


def test_an_area_has_its_photographs_and_all_that_see_their_ground(scene: Scene, areas: list[Area]):
    for targets, area in zip(CUT(scene), areas, strict=True):
        names = [scene.names[i] for i in targets]
        assert [area.scene.names[i] for i in area.targets] == names
        assert len(area.scene.names) < len(scene.names)
        for name in area.scene.names:
            whole, own = scene.index(name), area.scene.index(name)
            assert whole in scene.train, "what is held out stays so"
            assert torch.equal(area.scene.photographs[own], scene.photographs[whole])
            assert torch.equal(area.scene.cameras[own].T_world_camera, scene.cameras[whole].T_world_camera)
            apart = (area.scene.cameras.position_world[list(area.targets)] - scene.cameras.position_world[whole]).abs()
            assert bool(((apart[:, 0] < 6) & (apart[:, 1] < 4.5)).any()), "its frame, 5 x 3.75, meets that of a target"
        points = scene.points
        assert points is not None
        observed = torch.isin(points.camera_index, torch.tensor(targets))
        shared = torch.isin(points.point_index, points.point_index[observed])
        others = {scene.names[i] for i in points.camera_index[shared].tolist() if i in scene.train}
        assert others <= set(area.scene.names)


def test_the_ground_of_each_photograph_is_looked_at_in_its_own_frame(scene: Scene):
    cameras = scene.cameras[[3, 17, 40]]
    points = _ground(cameras)
    assert len(points) == 3 * 3 * len(PLACES) ** 2
    uv, z = cameras.project(points)
    inside = ((uv > 0) & (uv < torch.tensor([48, 36]))).all(-1).reshape(3, 3, 3, -1)  # camera, depth, photograph, place
    assert inside[[0, 1, 2], :, [0, 1, 2]].all()
    torch.testing.assert_close(z.amin(), torch.tensor(4.5))
    torch.testing.assert_close(z.amax(), torch.tensor(5.5))


def test_points_of_an_area_are_observed_where_they_were(scene: Scene, areas: list[Area]):
    area = areas[2]
    points = area.scene.points
    assert points is not None
    assert scene.points is not None
    assert len(points.xyz_world) < len(scene.points.xyz_world)
    uv, _ = area.scene.cameras.project(points.xyz_world)
    torch.testing.assert_close(uv[points.camera_index, points.point_index], points.uv_px)
    lonely = replace(scene, points=scene.points.observed(scene.points.camera_index == 0))
    assert select(lonely, CUT(scene)[-1]).scene.points is None


@pytest.mark.thorough
def test_training_sees_in_an_area_what_it_would_see_in_the_whole_scene(scene: Scene, areas: list[Area]):
    priors, config = DepthPriors(scene, match=Matcher(scene)), replace(SMALL.train, tiles=12)
    for area in (areas[0], areas[3]):
        own = DepthPriors(area.scene, match=Matcher(area.scene))
        for target in area.targets[::2]:
            name = area.scene.names[target]
            whole = priors[scene.index(name)]
            torch.testing.assert_close(own[target].cells, whole.cells)
            torch.testing.assert_close(own[target].detail, whole.detail)
            corner = torch.tensor([16.0, 8.0])
            found = []
            for at in (scene, area.scene):
                near = choose_neighbours(at.cameras[at.index(name)], whole.cells, corner, (1, 1), 16, at, 3, "seen")
                weights = near.blend_weight[0].sum(1)
                found.append({at.names[i]: float(w) for i, w in zip(near.index[0], weights, strict=True) if w > 1e-4})
            assert sorted(found[0].values()) == pytest.approx(sorted(found[1].values()), abs=1e-4)
            # Of those that weigh least some may weigh as much as others that were not chosen.
            likely = [{other for other, w in one.items() if w > min(one.values()) + 1e-3} for one in found]
            assert likely[0] == likely[1]
        batch = draw_batch(area.scene, own, config, 3, torch.Generator().manual_seed(1), area.targets)
        assert set(batch.targets.tolist()) <= set(area.targets)
        assert len(set(batch.targets.tolist())) > 1


def test_masks_and_files_stay_with_their_photographs(scene: Scene):
    masked = wall.with_left_halves_masked(scene, (12, 30))
    for targets in CUT(masked):
        part = select(masked, targets).scene
        for name, mask in zip(part.names, part.photographs.masks, strict=True):
            assert (mask is not None) == (masked.index(name) in (12, 30))


def test_which_cameras_see_points_is_found_in_parts(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    points = torch.tensor([[-10.0, 0.0, wall.DEPTH], [-9.0, 4.0, wall.DEPTH]])
    whole = which_see(scene.cameras, points)
    assert 0 < whole.sum() < 20
    monkeypatch.setattr("tidefield.data.surface.PROJECTED_AT_ONCE", 10)
    assert torch.equal(which_see(scene.cameras, points), whole)


def test_a_surface_is_matched_with_the_same_photographs_in_parts(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    cells = DepthPriors(scene)[20].cells
    whole = Matcher(scene)(scene.cameras[20], cells)
    monkeypatch.setattr("tidefield.data.matching.SELECT_ABOVE", 5)
    part = Matcher(scene)(scene.cameras[20], cells)
    assert torch.equal(part.cells, whole.cells)
    assert part.detail is not None
    assert whole.detail is not None
    assert torch.equal(part.detail, whole.detail)
