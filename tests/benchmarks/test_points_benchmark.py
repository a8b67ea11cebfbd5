"""The benchmark of scenes without points: they lose their points and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from benchmarks.points import METRICS, measure_points, tables, write_colmap
from tidefield.data.load import load_scene, read_posed
from tidefield.files import write_json
from tidefield.synthetic import make_survey, write_survey


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("points") / "flat"
    write_survey(make_survey("ground_textures", seed=5, views=6, width=320), folder)
    return folder


def test_scenes_lose_their_points_and_nothing_else(flat: Path, tmp_path: Path):
    commands: list[list[str]] = []

    def run(words: list[str]) -> None:
        commands.append(words)
        out = Path(words[2])
        out.mkdir()
        mean = dict.fromkeys(METRICS, 30.0 - len(commands))
        write_json(out / "evaluation.json", {"mean": mean})

    measure_points([flat], tmp_path, tmp_path, (100,), "cpu", run, lambda _: None)
    record = measure_points([flat], tmp_path, tmp_path, (100,), "cpu", run, lambda _: None)
    assert [words[1] for words in commands] == [str(flat), str(tmp_path / "flat")]
    assert "| flat | 100 | 29.00 | 28.00 | 29.000 | 28.000 |" in tables(record)[0].markdown()
    before, after = read_posed(flat, False), read_posed(tmp_path / "flat", False)
    assert before.points is not None
    assert len(before.points.uv_px)
    assert after.points is None or not len(after.points.uv_px)
    assert before.names == after.names
    assert np.array_equal(before.T_world_camera, after.T_world_camera)
    with Image.open(before.paths[0]) as first, Image.open(after.paths[0]) as second:
        assert first.tobytes() == second.tobytes()


def test_posed_photographs_get_the_points_of_colmap(flat: Path, tmp_path: Path):
    write_colmap(flat, tmp_path / "colmap")
    model = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    assert model.num_points3D() > 50
    found = np.array([point.xyz for point in model.points3D.values()])
    surface = np.load(flat / "truth" / "surface.npy")
    assert surface.min() - 0.5 < np.median(found[:, 2]) < surface.max() + 0.5
    scene = load_scene(tmp_path / "colmap", cache=tmp_path / "cache")
    assert scene.points is not None
    assert len(scene.names) == 6
