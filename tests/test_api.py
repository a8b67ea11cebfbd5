"""The Python interface, as README shows it."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import textured_wall as wall
import torch
from rich.console import Console
from scenes_on_disk import PINHOLE, survey, write_colmap

import tidefield
from tidefield.addresses import copy_of
from tidefield.commands.train import Train, train
from tidefield.config import Budget
from tidefield.data.images import Photographs
from tidefield.data.scene import Scene
from tidefield.errors import RunError, SceneError
from tidefield.files import write_json
from tidefield.geometry.cameras import Cameras
from tidefield.methods import untrained
from tidefield.train.checkpoint import RUN_FILE


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    return tmp_path


def test_trained_weights_render_a_scene_by_photograph_name(folder: Path) -> None:
    scene = tidefield.load_scene(str(folder / "flats"), width=48)
    camera = scene.cameras[scene.names[0]]
    view = tidefield.zero_shot(scene, device="cpu")(camera)
    assert isinstance(view, tidefield.Rendering)
    assert view.colour.shape == (camera.height, camera.width, 3)
    with pytest.raises(RunError, match="no preset 'quick'"):
        tidefield.zero_shot(scene, "quick")
    with pytest.raises(RunError, match="not a weights file"):
        tidefield.zero_shot(scene, weights=str(folder / "none.safetensors"))
    alone = replace(scene, train=(0,))
    with pytest.raises(SceneError, match="no training photograph besides"):
        tidefield.zero_shot(alone, device="cpu")(camera)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["swift", "nearest", "sparse-depth", "plane-sweep"])
def test_the_view_of_a_photograph_is_made_without_its_pixels_unless_it_has_no_name(method: str) -> None:
    def render(scene: Scene, camera: Cameras) -> torch.Tensor:
        own = tidefield.zero_shot(scene, method, device="cpu") if method == "swift" else untrained(method, scene)
        return own(camera).colour

    scene = wall.scene(wall.cameras(6, 64, 48, step=0.4), test=(0,))
    pictures = list(scene.photographs.colours)
    pictures[3] = 255 - pictures[3]
    other = replace(scene, photographs=Photographs(tuple(pictures)))
    camera = scene.cameras["03"]
    assert torch.equal(render(scene, camera), render(other, camera))
    nameless = replace(camera, names=())
    assert not torch.equal(render(scene, nameless), render(other, nameless))


@pytest.mark.thorough
def test_a_run_is_opened_with_its_scene_and_renders_as_it_was_trained(folder: Path) -> None:
    options = Train(folder / "flats", folder / "run", budget=Budget(steps=2), width=48, device="cpu")
    train(options, Console(quiet=True))
    with tidefield.open_run(str(folder / "run"), device="cpu") as run:
        view = run(run.scene.cameras[0])
        assert repr(run) == "OpenRun('run', swift, 2 steps)"
    untrained = tidefield.zero_shot(run.scene, device="cpu")(run.scene.cameras[0])
    assert not torch.equal(view.colour, untrained.colour)


@pytest.mark.thorough
def test_a_run_is_opened_with_a_scene_at_an_address(folder: Path) -> None:
    options = Train(folder / "flats", folder / "run", budget=Budget(steps=1), width=48, device="cpu")
    train(options, Console(quiet=True))
    at = f"local://{folder}/flats"
    record = json.loads((folder / "run" / RUN_FILE).read_text())
    write_json(folder / "run" / RUN_FILE, {**record, "scene": at})
    with tidefield.open_run(folder / "run", device="cpu") as run:
        assert run.scene.root == copy_of(at)


def test_all_names_exist_and_importing_the_package_is_light() -> None:
    assert all(getattr(tidefield, name) is not None for name in tidefield.__all__)
    with pytest.raises(AttributeError, match="no attribute 'utils'"):
        _ = tidefield.utils  # type: ignore[attr-defined]
    code = "import sys, tidefield; assert 'torch' not in sys.modules; print(tidefield.__version__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == tidefield.__version__
