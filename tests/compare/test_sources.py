"""Results are reused on the same contents of a scene and with the same trained weights only."""

import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from comparisons import SETTINGS, Children, quiet
from PIL import Image
from rich.console import Console
from scenes_on_disk import BARREL, PINHOLE, Truth, survey, write_colmap

from tidefield.commands.compare import Compare
from tidefield.commands.compare import compare as compare_command
from tidefield.compare.run import compare
from tidefield.compare.sources import check_scene, installed_weights, require_same_sources
from tidefield.data.load import load_scene
from tidefield.errors import RunError
from tidefield.files import read_json, write_json
from tidefield.train.checkpoint import shipped_weights, weights_sha256


def brighten(scene: Path, truth: Truth) -> None:
    """One photograph, as another correction of the colours leaves it."""
    file = scene / "images" / truth.names[4]
    with Image.open(file) as picture:
        brighter = picture.point(lambda value: min(255, value + 3))
    brighter.save(file)


def mask(scene: Path, truth: Truth) -> None:
    for name in truth.names:
        file = scene / "masks" / f"{name}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((48, 64), 255, np.uint8)).save(file)


def drop_points(scene: Path, truth: Truth) -> None:
    write_colmap(scene, replace(truth, ground=truth.ground[:-20]))


def change_lens(scene: Path, truth: Truth) -> None:
    write_colmap(scene, replace(truth, lenses=(replace(BARREL, k2=0.021),) * 9))


def test_the_contents_of_a_scene_are_those_of_its_files_wherever_they_are(tmp_path: Path):
    truth = survey(BARREL)
    write_colmap(tmp_path / "scene", truth)
    poses, contents = check_scene(tmp_path / "scene", None)
    shutil.copytree(tmp_path / "scene", tmp_path / "copy", copy_function=shutil.copyfile)
    assert check_scene(tmp_path / "copy", None) == (poses, contents)
    found = {contents}
    for change in (brighten, mask, drop_points, change_lens):
        shutil.copytree(tmp_path / "scene", tmp_path / change.__name__)
        change(tmp_path / change.__name__, truth)
        changed = check_scene(tmp_path / change.__name__, None)
        assert changed[0] == poses, "what identifies poses and split does not show it"
        found.add(changed[1])
    assert len(found) == 5


def test_results_on_other_photographs_are_not_reused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    @contextmanager
    def here(count: int):
        yield SimpleNamespace(submit=lambda function, *given: SimpleNamespace(result=lambda: function(*given)))

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("tidefield.commands.compare.worker_processes", here)
    truth, scene = survey(PINHOLE), tmp_path / "flats"
    write_colmap(scene, truth)
    run = Children(load_scene(scene, width=48))
    monkeypatch.setattr("tidefield.compare.run.run_measured", lambda command, own: run(command[:-1], own))
    options = Compare((scene,), methods=("nearest",), width=48, device="cpu", out=tmp_path / "out")
    compare_command(options, Console(quiet=True))
    compare_command(options, Console(quiet=True))
    assert len(run.words) == 1
    brighten(scene, truth)
    with pytest.raises(RunError, match=r"flats/nearest was made with other photographs, masks.*name another folder"):
        compare_command(options, Console(quiet=True))
    record = tmp_path / "out" / "runs" / "flats" / "nearest" / "process.json"
    older = read_json(record) or {}
    del older["scene"]
    write_json(record, older)
    compare_command(options, Console(quiet=True))
    assert len(run.words) == 1, "what was made before there was such a record is reused"


def test_results_of_other_weights_are_not_reused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    methods, out = ("tidefield", "zero-shot", "nearest"), tmp_path / "out"
    compare({"flats": tmp_path / "flats"}, methods, SETTINGS, out, Children(load_scene(tmp_path / "flats")), quiet)
    contents, folder = {"flats": "same"}, out / "runs" / "flats"
    weights = {"tidefield": "0123456789abcdef", "zero-shot": "0123456789abcdef", "nearest": None}
    require_same_sources(contents, weights, out)  # evaluations that do not say
    write_json(folder / "tidefield" / "run.json", {"weights": weights["tidefield"]})
    require_same_sources(contents, weights, out)
    write_json(folder / "tidefield" / "run.json", {"weights": None})
    expected = r"tidefield was made with other trained .* \(those with SHA-256 0123456789ab\.\.\.\), found none; delete"
    with pytest.raises(RunError, match=expected):
        require_same_sources(contents, weights, out)
    (folder / "tidefield" / "process.json").unlink()  # the training was interrupted, and is started again
    require_same_sources(contents, weights, out)
    file = folder / "zero-shot" / "evaluation.json"
    evaluation = read_json(file) or {}
    write_json(file, {**evaluation, "configuration": {"weights": "f00d"}})
    with pytest.raises(RunError, match="zero-shot was made with other trained weights"):
        require_same_sources(contents, weights, out)


def test_weights_are_those_that_a_method_starts_from():
    file = shipped_weights("swift")
    assert file is not None
    swift, methods = weights_sha256(file), ("tidefield", "zero-shot", "nerfacto", "views-2")
    found = installed_weights(methods, SETTINGS)
    assert found == {"tidefield": swift, "zero-shot": swift, "nerfacto": None, "views-2": None}
    scratch = installed_weights(methods, replace(SETTINGS, from_scratch=True))
    assert scratch == {**found, "tidefield": None}
