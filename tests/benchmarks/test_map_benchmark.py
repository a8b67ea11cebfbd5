"""The benchmark of maps: its baselines are fair, and its tables show what was stored."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks.maps import _truth, errors, made_map, maps, overlaps, semi_global, tables
from tidefield.commands.map_ import Map
from tidefield.data.load import load_scene
from tidefield.errors import RunError
from tidefield.files import read_json, write_json
from tidefield.maps.grid import Grid, map_frame
from tidefield.synthetic import make_survey, write_survey


def test_errors_are_those_of_known_numbers():
    found = errors(np.array([-1.0, 0.0, 0.0, 1.0, 10.0]))
    assert found["mean_m"] == pytest.approx(2.0)
    assert found["rmse_m"] == pytest.approx(np.sqrt(102 / 5))
    assert found["nmad_m"] == pytest.approx(1.4826)


@pytest.mark.thorough
def test_semi_global_matching_finds_the_ground(tmp_path: Path):
    write_survey(make_survey("ground_textures", seed=4, views=6, width=320), tmp_path / "scene")
    scene = load_scene(tmp_path / "scene", hold_out=False, cache=tmp_path / "cache")
    grid = Grid(map_frame(scene, None), -4.0, 4.0, 0.2, 40, 40, 0.0)
    found = errors(semi_global(scene, grid) - _truth(tmp_path / "scene", grid)[0])
    assert found["nmad_m"] < 0.1  # its pixels show 18 cm
    assert abs(found["mean_m"]) < 0.18


def test_tables_show_what_was_stored():
    heights = {
        name: {"rmse_m": 0.02, "nmad_m": 0.01, "mean_m": -0.005} for name in ("map", "sparse points", "semi-global")
    }
    classes = {
        name: {"true": 0.25, "found": 0.5, "iou": iou}
        for name, iou in (("ground", 0.75), ("vegetation", None), ("water", 0.4))
    }
    water = [{"height": -0.75, "sigma": 0.003, "area": 40.0, "error": 0.0021}]
    figures = {
        "cells": 9,
        "classes": classes,
        "water": water,
        "cell_m": 0.05,
        "heights": heights,
        "ground": {"terrain": heights["map"], "surface": {"rmse_m": 0.6, "nmad_m": 0.1, "mean_m": 0.2}},
        "within": 0.951,
        "sigma_median_m": 0.012,
    }
    record = {"figures": {"creek": {**figures, "orthophoto_psnr": 31.26, "seconds": 3.0}}}
    first, ground, second, third, fourth = tables(record)
    assert "| creek | 2.0 | 1.0 | -0.5 |" in first.markdown()
    assert "| creek | 2.0 | 1.0 | -0.5 | 60.0 | 10.0 | 20.0 |" in ground.markdown()
    assert "95.1%" in second.markdown()
    assert "31.3" in second.markdown()
    assert "| 25.0% | 50.0% | - |" in third.markdown()
    assert "| creek | 40 | -75.0 | +0.21 | 0.30 |" in fourth.markdown()


def test_each_square_is_mapped_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    mapped, compared = [], []

    def made_map(scene: Path, out: Path, area: Path) -> dict[str, float]:
        mapped.append((out, read_json(area)["coordinates"][0][2]))
        return {"seconds": 1.0}

    monkeypatch.setattr("benchmarks.maps.make_flat", lambda *_: None)
    monkeypatch.setattr("benchmarks.maps.made_map", made_map)
    monkeypatch.setattr("benchmarks.maps.compare_with_truth", lambda scene, out: compared.append(out) or {"cells": 1})
    monkeypatch.setattr("benchmarks.maps.tables", lambda record: [])
    for half in (12.0, 6.0, 6.0):
        maps(tmp_path, ("vegetation",), 2000, 20, half)
    assert len(compared) == len(set(compared)) == 2
    assert mapped == [(compared[0], [12.0, 12.0]), (compared[1], [6.0, 6.0])]


def test_a_map_that_is_kept_is_the_one_that_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    @contextmanager
    def opened(options: Map, console: object):
        yield SimpleNamespace(key=str(options.gsd)), None, {}

    monkeypatch.setattr("tidefield.commands.map_.open_job", opened)
    made = {"complete": True, "key": "0.15", "seconds": 1}
    write_json(tmp_path / "map.json", made)
    assert made_map(tmp_path, tmp_path, gsd=0.15) == made
    with pytest.raises(RunError, match="has a map of another scene, of other weights or with other options: expected"):
        made_map(tmp_path, tmp_path, gsd=0.05)


def test_a_photograph_is_left_out_of_the_scene_that_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from benchmarks.map_views import map_views

    left = []

    def made_map(scene: Path, out: Path, **_: object) -> None:
        left.append((scene, out, [file.name for file in scene.rglob("*.png")]))
        raise RunError("as far as this")

    cameras = SimpleNamespace(position_world=torch.tensor([[0.0, 0.0, 9.0], [4.0, 0.0, 9.0]]))
    monkeypatch.setattr("benchmarks.map_views.made_map", made_map)
    for name in ("first", "second", "second"):
        scene, names = tmp_path / name / "scene", (f"{name}_1.png", f"{name}_2.png")
        loaded = SimpleNamespace(cameras=cameras, origin_world=torch.zeros(3), names=names)
        monkeypatch.setattr("benchmarks.map_views.load_scene", lambda *_, loaded=loaded, **__: loaded)
        for part in ("images", "sparse"):
            (scene / part).mkdir(parents=True, exist_ok=True)
        for file in names:
            (scene / "images" / file).touch()
        with pytest.raises(RunError, match="as far as this"):
            map_views(scene, tmp_path / "runs")
    assert [names for _, _, names in left] == [["first_2.png"], ["second_2.png"], ["second_2.png"]]
    assert left[0][:2] != left[1][:2] == left[2][:2]


def test_overlaps_are_intersections_over_unions():
    found = overlaps(np.array([2, 2, 3, 9]), np.array([2, 3, 3, 3]))
    assert [found[name]["iou"] for name in ("ground", "vegetation", "water")] == [0.5, pytest.approx(1 / 3), 0.0]
    assert overlaps(np.array([2]), np.array([2]))["water"]["iou"] is None


@pytest.mark.slow
def test_a_large_map_repeats_the_middle_of_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from benchmarks.map_memory import map_memory
    from tidefield.maps import make

    pytest.importorskip("laspy")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("LARGEST_TILE", "SMALLEST_TILE"):
        monkeypatch.setattr(make, name, 32)
    write_survey(make_survey("ground_textures", seed=4, views=9, width=240), tmp_path / "scene")
    lines: list[str] = []
    monkeypatch.setattr("benchmarks.map_memory.say", lines.append)
    found = map_memory(tmp_path / "scene", tmp_path / "runs", 30.0, 0.3)
    assert found["cells"] == found["points"] == 100 * 100
    assert found["square_metres"] == pytest.approx(900)
    assert found["peak_memory_bytes"] >= found["peak_memory_tiles_bytes"] > 1e8
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {"map_memory.json"}
    assert "16 tiles" in lines[1]


@pytest.mark.thorough
def test_an_orthophoto_is_warped_to_where_the_photograph_shows_it(tmp_path: Path):
    from benchmarks.map_views import warp
    from tidefield.maps.grid import Tile
    from tidefield.maps.surface import View

    survey = make_survey("ground_textures", seed=4, views=6, width=320)
    write_survey(survey, tmp_path / "scene")
    scene = load_scene(tmp_path / "scene", hold_out=False, cache=tmp_path / "cache")
    grid = Grid(map_frame(scene, None), -6.0, 6.0, 0.1, 120, 120, 0.0)
    height, _, colour, _ = _truth(tmp_path / "scene", grid)
    position = (scene.cameras.position_world + scene.origin_world).numpy()
    index = int(np.linalg.norm(position[:, :2], axis=1).argmin())
    view = View(scene.cameras[index], Tile(grid, 0, 0, 120, 0))
    truth = scene.photographs[index].numpy().astype(float)

    def error(heights: np.ndarray) -> float:
        shown, known = warp(colour.astype(np.uint8), heights.astype(np.float32), view, grid)
        assert 1000 < known.sum() < known.size
        away = shown[known] - truth[known]
        return float(away.std())

    assert error(height) < 0.8 * error(height + 3.0)  # 3 m shift pixels by one or more
    height[:60] = np.nan
    assert error(height) > 0
