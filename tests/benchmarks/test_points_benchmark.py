"""The benchmark of scenes without points: they lose their points and nothing else."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from benchmarks.points import METRICS, points, tables, write_colmap, write_without_points
from tidefield.compare.run import Usage
from tidefield.data.holdout import Holdout
from tidefield.data.load import load_scene, read_posed
from tidefield.errors import RunError
from tidefield.files import write_json
from tidefield.geometry.lenses import Lens
from tidefield.synthetic import make_survey, write_survey


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("points") / "flat"
    write_survey(make_survey("ground_textures", seed=5, views=6, width=320, supersample=1), folder)
    return folder


def test_scenes_lose_their_points_and_nothing_else(flat: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    commands: list[list[str]] = []

    def run(command: Sequence[str], environment: Mapping[str, str]) -> Usage:
        commands.append(list(command[3:]))
        out = Path(commands[-1][2])
        out.mkdir()
        mean = dict.fromkeys(METRICS, 30.0 - len(commands))
        write_json(out / "evaluation.json", {"mean": mean, "split": {"train": ["b"], "test": ["a"]}})
        return Usage(1.0, 1)

    points((flat,), tmp_path, tmp_path, (100,), "cpu", run)
    record = points((flat,), tmp_path, tmp_path, (100,), "cpu", run)
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
    monkeypatch.setattr("benchmarks.points.network_of", lambda _: "other weights")
    with pytest.raises(RunError, match=r"flat, 100 px, with points with network .* expected other weights"):
        points((flat,), tmp_path, tmp_path, (100,), "cpu", run)


def test_masks_split_and_gains_stay(flat: Path, tmp_path: Path):
    scene = tmp_path / "scene"
    shutil.copytree(flat, scene)
    names = read_posed(flat, False).names
    (scene / "masks").mkdir()
    Image.new("L", (320, 240)).save(scene / "masks" / f"{names[1]}.png")
    write_without_points(scene, tmp_path / "by_transforms")
    Holdout(frozenset(names[2:4]), {names[0]: np.array([0.5, 1.0, 2.0])}).write(scene)
    write_without_points(scene, tmp_path / "by_holdout")
    for before, after in ((flat, tmp_path / "by_transforms"), (scene, tmp_path / "by_holdout")):
        old, new = read_posed(before, False), read_posed(after, False)
        assert new.train_and_test == old.train_and_test
        assert [mask and mask.name for mask in new.masks] == [None, f"{names[1]}.png", *[None] * 4]
    assert new.divided_by is not None
    assert np.array_equal(new.divided_by, old.divided_by)


def test_a_split_that_differs_is_found(flat: Path, tmp_path: Path):
    splits = iter(("a", "b"))

    def run(command: Sequence[str], environment: Mapping[str, str]) -> Usage:
        out = Path(command[5])
        out.mkdir()
        found = {"mean": dict.fromkeys(METRICS, 30.0), "split": {"train": [], "test": [next(splits)]}}
        write_json(out / "evaluation.json", found)
        return Usage(1.0, 1)

    with pytest.raises(AssertionError, match="holds out other photographs"):
        points((flat,), tmp_path, tmp_path, (100,), "cpu", run)


@pytest.mark.thorough
def test_posed_photographs_get_the_points_of_colmap(flat: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    bent = replace(read_posed(flat, True), points=None)
    own = Lens(**{**vars(bent.lenses[0].resized(640, 480)), "k1": 1e-4, "k3": 1e-5})
    monkeypatch.setattr("benchmarks.points.read_posed", lambda *_: replace(bent, lenses=(own, *bent.lenses[1:])))
    write_colmap(flat, tmp_path / "colmap")
    first = read_posed(tmp_path / "colmap", False).lenses[0]
    assert first == own.resized(320, 240), "with its distortion, at the photograph's size"
    model = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    assert model.num_points3D() > 50
    found = np.array([point.xyz for point in model.points3D.values()])
    surface = np.load(flat / "truth" / "surface.npy")
    assert surface.min() - 0.5 < np.median(found[:, 2]) < surface.max() + 0.5
    scene = load_scene(tmp_path / "colmap", cache=tmp_path / "cache")
    assert scene.points is not None
    assert len(scene.names) == 6
