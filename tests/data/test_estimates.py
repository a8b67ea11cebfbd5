"""What is estimated when a scene is opened is kept for the next time, and used only where it would be the same."""

from __future__ import annotations

import os
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tidefield.data import load
from tidefield.data.cache import ESTIMATES_SUFFIX
from tidefield.data.load import load_scene
from tidefield.data.readers.posed import PosedPhotographs
from tidefield.data.scene import Scene
from tidefield.synthetic import Flight, make_survey, write_survey


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("estimates") / "scene"
    flight = Flight(focal_ratio=2.4)
    survey = make_survey("ground_textures", seed=2, views=9, width=64, flight=flight, supersample=1)
    write_survey(survey, made, truth=False)
    return made


def require_equal(one: Scene, other: Scene) -> None:
    for own, same in ((one.cameras, other.cameras), (one.points, other.points)):
        for field in fields(own):
            value, again = getattr(own, field.name), getattr(same, field.name)
            if isinstance(value, Tensor):
                assert value.dtype == again.dtype
                assert torch.equal(value, again), field.name
            else:
                assert value == again


def files(cache: Path) -> list[Path]:
    return list(cache.glob(f"*{ESTIMATES_SUFFIX}"))


def test_a_scene_is_estimated_once(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = load_scene(folder, cache=tmp_path)
    assert first.points is not None
    assert (first.cameras.gain != 1).any()
    assert len(files(tmp_path)) == 1
    with monkeypatch.context() as patch:
        patch.delattr(load, "observe")
        again = load_scene(folder, cache=tmp_path)
    require_equal(first, again)
    again.cameras.gain[0] = 9.0
    require_equal(first, load_scene(folder, cache=tmp_path))


@pytest.mark.parametrize("options", [{"hold_out": False}, {"calibrate": False}, {"width": 32}])
def test_other_options_are_estimated_anew(folder: Path, tmp_path: Path, options: dict) -> None:
    load_scene(folder, cache=tmp_path)
    changed = load_scene(folder, cache=tmp_path, **options)
    assert len(files(tmp_path)) == 2
    require_equal(changed, load_scene(folder, cache=tmp_path / "another", **options))


def test_changed_files_and_changed_code_are_estimated_anew(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_scene(folder, cache=tmp_path)
    os.utime(next((folder / "images").iterdir()), ns=(0, 0))
    load_scene(folder, cache=tmp_path)
    assert len(files(tmp_path)) == 2
    count = len(files(tmp_path))
    monkeypatch.setattr(load, "code_hash", lambda: "another")
    load_scene(folder, cache=tmp_path)
    assert len(files(tmp_path)) == count + 1


@pytest.mark.parametrize("what", ["points", "poses", "lenses"])
def test_what_is_read_otherwise_is_estimated_anew(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    load_scene(folder, cache=tmp_path)
    read = load.read_posed

    def changed(*asked: Any) -> PosedPhotographs:
        posed = read(*asked)
        assert posed.points is not None
        if what == "points":
            return replace(posed, points=replace(posed.points, uv_px=posed.points.uv_px + 1e-3))
        if what == "poses":
            return replace(posed, T_world_camera=posed.T_world_camera * [1, 1, 1, 1.001])
        return replace(posed, lenses=tuple(replace(lens, fx=lens.fx * 1.001) for lens in posed.lenses))

    monkeypatch.setattr(load, "read_posed", changed)
    load_scene(folder, cache=tmp_path)
    assert len(files(tmp_path)) == 2


@pytest.mark.parametrize("content", [b"", b"PK no zip", None])
def test_a_damaged_file_is_made_anew(folder: Path, tmp_path: Path, content: bytes | None) -> None:
    first = load_scene(folder, cache=tmp_path)
    (file,) = files(tmp_path)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if content is None else content)
    require_equal(first, load_scene(folder, cache=tmp_path))
    assert len(file.read_bytes()) == len(whole)


@pytest.mark.skipif(os.name != "posix", reason="Windows has no such permissions")
def test_a_cache_that_others_can_write_to_is_not_used(folder: Path, tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    load_scene(folder, cache=tmp_path)
    assert not files(tmp_path)
