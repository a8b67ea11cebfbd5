"""Tidefield inside NerfBaselines: its own test suite of methods, in nerfstudio's environment."""

import json
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import textured_wall as wall
import torch
from foreign_environment import run
from networks import SMALL

from tidefield.config import PRESETS
from tidefield.errors import RunError
from tidefield.files import write_json
from tidefield.synthetic import make_survey, write_survey
from tidefield.train.loop import SceneTrainer


def test_the_suite_of_nerfbaselines_passes(tmp_path: Path):
    scene = tmp_path / "scene"
    write_survey(make_survey("river_mouths", seed=2, views=10, width=96), scene)
    # Without an id there are no published results to compare with.
    (scene / "nb-info.json").write_text(json.dumps({"loader": "colmap", "id": None, "scene": "river_mouths"}))
    words = "nerfbaselines test-method --method tidefield --backend python --steps 2 --data"
    printed = run(*words.split(), scene, needed=("nerfbaselines",))
    assert "All tests passed" in printed
    passed = [line for line in printed.splitlines() if "\N{CHECK MARK}" in line]
    assert len(passed) >= 18
    assert any("Restored model (without train dataset) matches original" in line for line in passed)


@pytest.fixture
def method(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """`tidefield.nerfbaselines.method`, imported with a stand-in for NerfBaselines."""
    names = ("Cameras", "Dataset", "Method", "MethodInfo", "ModelInfo", "RenderOptions", "RenderOutput")
    standin = ModuleType("nerfbaselines")
    vars(standin).update({name: type(name, (), {}) for name in names})
    monkeypatch.setitem(sys.modules, "nerfbaselines", standin)
    try:
        yield import_module("tidefield.nerfbaselines.method")
    finally:
        sys.modules.pop("tidefield.nerfbaselines.method", None)


def test_a_checkpoint_keeps_its_settings_and_needs_no_other_weights(
    method: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def missing(*_: Any) -> None:
        raise RunError("no weights are installed")

    monkeypatch.setattr(method, "given_or_shipped", missing)
    monkeypatch.setitem(PRESETS, "swift", SMALL)
    scene = wall.scene(wall.cameras(5, 64, 48, step=0.25))
    monkeypatch.setattr(method, "load_scene", lambda *_, **__: scene)
    with pytest.raises(RunError, match=r"no checkpoint\.safetensors"):
        method.TidefieldMethod(checkpoint=str(tmp_path))
    write_json(tmp_path / "settings.json", {"num_iterations": 7})
    SceneTrainer(SMALL, scene, 0, torch.device("cpu")).save(tmp_path)
    same = {"num_iterations": "7", "preset": "swift"}
    assert method.TidefieldMethod(checkpoint=str(tmp_path), config_overrides=same).loaded_step == 0
    with pytest.raises(RunError, match=r"--set num_iterations=9 was given with the checkpoint.*num_iterations=7"):
        method.TidefieldMethod(checkpoint=str(tmp_path), config_overrides={"num_iterations": "9"})
