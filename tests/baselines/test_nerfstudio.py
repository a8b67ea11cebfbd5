"""nerfstudio's methods: the scene is handed over as it is, and the worker's lines are understood."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
import textured_wall as wall
import torch
from rich.console import Console

from tidefield.baselines.nerfstudio import driver, environment
from tidefield.baselines.nerfstudio.export import export
from tidefield.config import Budget
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.evaluation.curves import make_curve

CPU = torch.device("cpu")
FAKE = """
import json, sys
from pathlib import Path
import numpy as np
kind, job = sys.argv[1], json.loads(Path(sys.argv[2]).read_text())
out = Path(job["out"])
def answer(**values): print(json.dumps(values), flush=True)
def picture(camera, file):
    width, height = camera["size_px"]
    np.savez(file, colour=np.full((height, width, 3), 0.5, np.float32), depth=np.ones((height, width), np.float32),
             opacity=np.ones((height, width), np.float32))
print("nerfstudio says something", file=sys.stderr)
if job["seed"] == 13:
    sys.exit("bad luck")
if kind == "train":
    (out / "curve").mkdir(exist_ok=True)
    for step in range(1, 4):
        more = {}
        if step == 2 and job["curve_seconds"]:
            more["curve"] = [f"curve/{k}.npz" for k in range(len(job["curve_cameras"]))]
            for name, camera in zip(more["curve"], job["curve_cameras"]):
                picture(camera, out / name)
        answer(step=step, seconds=10.0 * step, **more)
    answer(step=3, seconds=30.0, done=True, checkpoint="a/step-3.ckpt")
else:
    assert job["checkpoint"] == "a/step-3.ckpt"
    answer(ready=True)
    for line in sys.stdin:
        camera = json.loads(line)
        picture(camera, camera["file"])
        answer(seconds=0.1)
"""


@pytest.fixture
def scene() -> Scene:
    return wall.scene(wall.with_gains(wall.cameras(5)), test=(0, 3))


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    worker = tmp_path / "worker.py"
    worker.write_text(FAKE)
    monkeypatch.setattr(driver, "WORKER", worker)
    monkeypatch.setattr(driver, "python", lambda: Path(sys.executable))


def test_the_exported_scene_is_the_same_scene(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    factor = export(scene, tmp_path / "data")
    again = load_scene(tmp_path / "data")
    assert (again.train, again.test) == (scene.train, scene.test)
    shift = again.origin_world.float()
    torch.testing.assert_close(again.cameras.position_world + shift, scene.cameras.position_world, atol=1e-5, rtol=0)
    for part in ("focal_px", "principal_px", "size_px"):
        torch.testing.assert_close(getattr(again.cameras, part), getattr(scene.cameras, part))
    for index in range(5):
        even = scene.photographs[index].float() / scene.cameras.gain[index]
        assert (again.photographs[index].float() / factor - even).abs().max() <= 0.51 / factor.min()


def test_training_and_rendering_go_through_the_worker(scene: Scene, tmp_path: Path, fake: None):
    run, told = tmp_path / "run", []
    run.mkdir()
    curve = make_curve(scene)
    budget = Budget(minutes=0.5)
    done = driver.train("nerfacto", scene, run, budget, 0, CPU, curve, lambda step, seconds: told.append(step))
    assert told == [1, 2, 3, 3]
    assert (done.step, done.seconds) == (3, 30.0)
    ((seconds, psnr),) = json.loads((run / "curve.json").read_text())
    assert seconds == 20.0
    truth = curve.truths[0].float() / 255
    assert psnr < 60
    assert psnr == pytest.approx(float(-10 * torch.log10((truth - 0.5).square().mean())), abs=3)
    with driver.renderer(run) as render:
        for index in scene.test:
            view = render(scene.cameras[index])
            assert view.colour.shape == (36, 48, 3)
    assert "nerfstudio says something" in (run / "nerfstudio.log").read_text()
    assert driver.progress_of(run).step == 3


def test_what_nerfstudio_dies_of_is_told(scene: Scene, tmp_path: Path, fake: None):
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(RunError, match=r"bad luck.*nerfstudio\.log"):
        driver.train("nerfacto", scene, run, Budget(steps=3), 13, CPU, None, lambda step, seconds: None)
    with pytest.raises(RunError, match="not been trained to its end"):
        driver.progress_of(run)


def test_without_nerfstudio_one_is_told_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with pytest.raises(RunError, match="run `tidefield baselines install nerfacto`"):
        environment.python()


def test_an_installation_is_complete_only_when_nerfstudio_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    asked, starts = [], False

    def run(words: list[str], **options: object) -> CompletedProcess[str]:
        asked.append(words[1:])
        return CompletedProcess(words, int(words[-1] == "check" and not starts), "", "no yaml")

    monkeypatch.setattr(environment.subprocess, "run", run)
    monkeypatch.setattr(environment.venv, "create", lambda folder, with_pip: folder.mkdir())
    quiet = Console(quiet=True)
    with pytest.raises(RunError, match=r"does not start \(no yaml\)"):
        environment.install(False, quiet)
    with pytest.raises(RunError, match="is not installed"):
        environment.python()
    starts = True
    environment.install(False, quiet)
    assert environment.python().is_relative_to(tmp_path)
    packages = [word for words in asked for word in words]
    assert "nerfstudio==1.1.5" in packages
    assert any(word.startswith("torchvision==0.") for word in packages)
    with pytest.raises(RunError, match="--overwrite"):
        environment.install(False, quiet)
    monkeypatch.setattr(environment.sys, "version_info", (3, 14, 0))
    with pytest.raises(RunError, match=r"Python 3\.14: expected 3\.12 or older"):
        environment.install(True, quiet)


@pytest.mark.slow
def test_the_real_nerfacto_trains_and_renders(scene: Scene, tmp_path: Path):
    try:
        environment.python()
    except RunError as error:
        pytest.skip(str(error))
    run = tmp_path / "run"
    run.mkdir()
    plain = replace(scene, cameras=wall.cameras(5))
    driver.train("nerfacto", plain, run, Budget(steps=20), 0, CPU, None, lambda step, seconds: None)
    with driver.renderer(run) as render:
        view = render(plain.cameras[2])
    assert view.colour.shape == (36, 48, 3)
    assert np.isfinite(view.depth.numpy()).all()
    error = (view.colour - plain.photographs[2].float() / 255).square().mean()
    assert error < 0.06, "it has seen something of the wall"
