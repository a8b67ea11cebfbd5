"""Gaussians of a wall: where they are, how they look to another program's reader, and what is refused."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import textured_wall
import torch
from plyfile import PlyData
from rich.console import Console

from tidefield.baselines.splats import read_splats
from tidefield.commands.export import Export, export
from tidefield.errors import RunError
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Rendering
from tidefield.render.gaussians import FLATNESS, OPACITY, PIXEL_BYTES, make_gaussians, write_gaussians

TILT = (0.2, -0.1)


def render_wall(camera: Cameras) -> Rendering:
    grey = textured_wall.photograph(camera).float() / 255
    return Rendering(grey, textured_wall.true_depth(camera, TILT), torch.ones(camera.height, camera.width))


def test_gaussians_lie_on_the_surface_along_it_and_a_cell_apart():
    cameras = textured_wall.cameras(4, 96, 72)
    found = make_gaussians(render_wall, cameras, 96)
    z = textured_wall.wall_z(torch.from_numpy(found.mean_world[:, :2]), TILT).numpy()
    assert np.abs(found.mean_world[:, 2] - z).max() < 1e-4
    normal = np.array([TILT[0], TILT[1], -1.0]) / np.linalg.norm([*TILT, 1.0])
    assert np.abs(found.normal_world - normal).max() < 1e-3  # towards the cameras, at lower z
    assert len(found.mean_world) < 2.5 * 96 * 72, "views of the same wall were not fused"
    assert found.sigma == pytest.approx(0.7 * 5 / 96, rel=0.1)


def test_the_file_reads_back_as_flat_gaussians_of_these_colours(tmp_path: Path):
    found = make_gaussians(render_wall, textured_wall.cameras(2, 48, 36), 48)
    write_gaussians(found, tmp_path / "wall.ply", (430_000.0, 6_100_000.0, 12.5))
    splats = read_splats(tmp_path / "wall.ply")
    assert torch.allclose(splats.mean_world.double(), torch.from_numpy(found.mean_world), atol=1e-5)
    assert torch.allclose(splats.opacity, torch.tensor(OPACITY))
    lengths = splats.axes_world.norm(dim=1)
    assert torch.allclose(lengths[:, 2], FLATNESS * lengths[:, 0])
    third = splats.axes_world[:, :, 2] / lengths[:, 2:]
    assert torch.allclose(third.double(), torch.from_numpy(found.normal_world), atol=1e-4)
    colour = 0.5 + 0.28209479 * splats.harmonics[:, :, 0]
    assert torch.allclose(colour.double(), torch.from_numpy(found.rgb), atol=1e-5)
    assert "origin_world 430000.000000 6100000.000000 12.500000" in PlyData.read(tmp_path / "wall.ply").comments


def test_edges_between_near_and_far_and_empty_pixels_make_no_gaussians():
    def step(camera: Cameras) -> Rendering:
        whole = render_wall(camera)
        depth = torch.full_like(whole.depth, 5.0)
        depth[:, camera.width // 2 :] = 9.0
        opacity = torch.ones_like(depth)
        opacity[: camera.height // 2] = 0.0
        return replace(whole, depth=depth, opacity=opacity)

    found = make_gaussians(step, textured_wall.cameras(1, 96, 72), 96)
    depths = found.mean_world[:, 2]
    assert set(np.round(depths, 6)) == {5.0, 9.0}
    assert (found.mean_world[:, 1] > 0).all()  # the lower half of the picture


def test_views_of_nothing_and_other_names_are_one_clear_error(tmp_path: Path):
    def nothing(camera: Cameras) -> Rendering:
        return replace(render_wall(camera), opacity=torch.zeros(camera.height, camera.width))

    with pytest.raises(RunError, match="the views show nothing: expected a scene with a surface"):
        make_gaussians(nothing, textured_wall.cameras(1, 48, 36), 48)
    quiet = Console(quiet=True)
    with pytest.raises(RunError, match=r"wall\.glb was asked for: Gaussians are written as \.ply"):
        export(Export(tmp_path, tmp_path / "wall.glb"), quiet)
    (tmp_path / "wall.ply").touch()
    with pytest.raises(RunError, match="is there already"):
        export(Export(tmp_path, tmp_path / "wall.ply"), quiet)


def test_views_that_do_not_fit_into_memory_are_refused_before_any_is_rendered(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tidefield.render.gaussians.memory_bytes", lambda: 2_500_000)
    with pytest.raises(RunError, match="choose a smaller --width"):
        make_gaussians(lambda camera: pytest.fail("a view was rendered"), textured_wall.cameras(4, 96, 72), 96)
    assert len(make_gaussians(render_wall, textured_wall.cameras(4, 96, 72), 48).mean_world)


def test_no_more_memory_is_used_than_was_checked_for(tmp_path: Path):
    cameras = textured_wall.cameras(8, 160, 120, step=3.0)  # far apart, so that few points share cells
    tracemalloc.start()
    found = make_gaussians(render_wall, cameras, 160)
    peaks = [tracemalloc.get_traced_memory()[1]]
    tracemalloc.reset_peak()
    write_gaussians(found, tmp_path / "wall.ply", (0.0, 0.0, 0.0))
    peaks.append(tracemalloc.get_traced_memory()[1])
    tracemalloc.stop()
    assert max(peaks) < PIXEL_BYTES * 8 * 160 * 120


def test_where_there_would_be_too_many_gaussians_cells_are_larger(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    cameras = textured_wall.cameras(2, 48, 36)
    fine = make_gaussians(render_wall, cameras, 48)
    assert caplog.messages == []
    monkeypatch.setattr("tidefield.render.gaussians.MOST", len(fine.mean_world) // 2)
    coarse = make_gaussians(render_wall, cameras, 48)
    assert len(fine.mean_world) / 4 < len(coarse.mean_world) <= len(fine.mean_world) / 2
    assert coarse.sigma / fine.sigma == pytest.approx(1.25**2, rel=0.3)
    assert f"more than {len(fine.mean_world) // 2:,} Gaussians: cells are" in caplog.text


def test_a_point_far_away_does_not_join_cells():
    def with_outliers(camera: Cameras) -> Rendering:
        whole = render_wall(camera)
        whole.depth[0, :2] = torch.tensor([1e14, 3e14])
        return whole

    camera = textured_wall.cameras(1, 48, 36)
    plain, far = (make_gaussians(method, camera, 48) for method in (render_wall, with_outliers))
    assert len(far.mean_world) > 0.9 * len(plain.mean_world)
