"""The benchmark of exported Gaussians: the ways differ as they should, and what was measured is not measured again."""

from __future__ import annotations

from pathlib import Path

import pytest
import textured_wall as wall
import torch

from benchmarks.gaussians import METHOD, WAYS, compare_ways, gaussians, tables
from tidefield.errors import RunError
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Rendering
from tidefield.synthetic import make_survey, write_survey

CPU = torch.device("cpu")


def test_a_floater_costs_quality_until_it_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    own = wall.scene(wall.cameras(4, 96, 72, step=0.2), (2,))
    monkeypatch.setattr("benchmarks.gaussians.at_width", lambda scene, width: scene)

    def render(camera: Cameras) -> Rendering:
        colour, depth = wall.photograph(camera).float() / 255, wall.true_depth(camera)
        if torch.equal(camera.T_world_camera, own.cameras.T_world_camera[1:2]):
            colour[20:50, 30:60], depth[20:50, 30:60] = 0.0, 3.0
        return Rendering(colour, depth, torch.ones_like(depth))

    found = compare_ways(own, render, 96, CPU)
    every, checked, filled = (found[way] for way in WAYS)
    assert filled["psnr"] > every["psnr"] + 2
    assert filled["ssim"] > every["ssim"]
    assert checked["gaussians"] <= filled["gaussians"] < every["gaussians"]
    assert filled["covered"] > every["covered"] - 0.01
    assert found[METHOD]["psnr"] > filled["psnr"]


def test_uncovered_pixels_are_black(monkeypatch: pytest.MonkeyPatch) -> None:
    own = wall.scene(wall.cameras(4, 96, 72, step=0.2), (2,))
    monkeypatch.setattr("benchmarks.gaussians.at_width", lambda scene, width: scene)

    def half(camera: Cameras) -> Rendering:
        opacity = torch.ones(camera.height, camera.width)
        opacity[: camera.height // 2] = 0.0
        return Rendering(wall.photograph(camera).float() / 255, wall.true_depth(camera), opacity)

    found = compare_ways(own, half, 96, CPU)["every point"]
    assert found["covered"] == pytest.approx(0.5, abs=0.03)
    assert found["psnr"] < 12 < 18 < found["psnr_covered"]


@pytest.mark.thorough
def test_a_scene_is_measured_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_survey(make_survey("ground_textures", seed=5, views=9, width=64), tmp_path / "flat")
    lines: list[str] = []
    monkeypatch.setattr("benchmarks.gaussians.say", lines.append)
    for _ in range(2):
        record = gaussians((tmp_path / "flat",), tmp_path, (48,), "cpu")
    assert lines == ["flat, 48 px"]
    (made,) = tables(record)
    assert [row[0] for row in made.rows] == [*WAYS, METHOD]
    assert all(len(row) == len(made.columns) for row in made.rows)


def test_a_scene_without_held_out_photographs_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from contextlib import contextmanager

    @contextmanager
    def opened(*_):
        yield wall.scene(wall.cameras(3), ()), None, {}

    monkeypatch.setattr("benchmarks.gaussians.open_source", opened)
    with pytest.raises(RunError, match="holds no photograph out: expected at least one"):
        gaussians((tmp_path,), tmp_path, (48,), "cpu")
