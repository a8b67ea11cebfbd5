"""nerfstudio's methods: the scene that they get, their configuration, and the way back of what they render."""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from pickle import UnpicklingError
from subprocess import PIPE, CompletedProcess
from types import ModuleType, SimpleNamespace

import nerfstudio_standin
import numpy as np
import pytest
import textured_wall as wall
import torch
from PIL import Image
from rich.console import Console
from torch.torch_version import TorchVersion

from tidefield.baselines.nerfstudio import driver, environment, worker
from tidefield.config import Budget, Sampling
from tidefield.data.hull import Hull
from tidefield.data.images import Photographs
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.evaluation.curves import SHARES, make_curve
from tidefield.evaluation.evaluate import _timed
from tidefield.files import write_json
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.model.rendering import Rendering, with_rays

CPU = torch.device("cpu")
FAKE = """
import json, sys
from pathlib import Path
import numpy as np
kind, job = sys.argv[1], json.loads(Path(sys.argv[2]).read_text())
out = Path(sys.argv[2]).parent
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
    answer(step=3, seconds=30.0, done=True, checkpoint="a/step-3.ckpt", tiny_cuda_nn=False)
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
    factor = driver.export(scene, tmp_path / "data").factor
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
    run, steps = tmp_path / "run", []
    run.mkdir()
    curve = make_curve(scene)
    budget = Budget(minutes=0.5)
    (run / "data" / "masks").mkdir(parents=True)
    (run / "data" / "masks" / "00000.png").touch()
    seed = 20261130123000
    done = driver.train("nerfacto", scene, run, budget, seed, CPU, curve, lambda step, seconds: steps.append(step))
    assert steps == [1, 2, 3, 3]
    assert (done.step, done.seconds) == (3, 30.0)
    ((seconds, psnr),) = json.loads((run / "curve.json").read_text())
    assert seconds == 20.0
    job = json.loads((run / "job.json").read_text())
    assert job["seconds"] == 30.0
    assert 0 <= job["seed"] < 1 << 32
    assert worker.read_job(run / "job.json", None, "cuda:1")["device"] == "cuda:1"
    assert job["curve_seconds"] == pytest.approx([30 * share for share in SHARES])
    assert len(job["curve_cameras"]) == len(curve.cameras)
    factor = torch.tensor(job["factor"])
    assert factor.min() < 0.9, "a scene whose factor matters"
    expected = []
    for truth, camera in zip(curve.truths, curve.cameras, strict=True):
        grey = (0.5 / factor * camera.gain[0]).clamp(0, 1)
        expected.append(float(-10 * torch.log10((truth.float() / 255 - grey).square().mean())))
    assert psnr == pytest.approx(sum(expected) / len(expected), abs=0.05)
    with driver.renderer(run, CPU) as render:
        for index in scene.test:
            view = render(scene.cameras[index])
            grey = (0.5 / factor * scene.cameras.gain[index]).clamp(0, 1)
            torch.testing.assert_close(view.colour, grey.expand(36, 48, 3))
        for rays in (1, 2):
            seconds = _timed(with_rays(render, Sampling(rays_per_side=rays)), scene, 0)[1]
            assert seconds == 0.1, "the way from nerfstudio's process is not counted"
    assert "nerfstudio says something" in (run / "nerfstudio.log").read_text()
    assert not (run / "rendering.npz").exists()
    assert driver.progress_of(run).step == 3
    assert json.loads((run / "job.json").read_text())["tiny_cuda_nn"] is False
    write_json(run / "job.json", {**job, "method": "splatfacto"})
    with pytest.raises(RunError, match="splatfacto was asked for on cpu: expected CUDA"), driver.renderer(run, CPU):
        pass
    driver.delete_training(run)
    assert not (run / "data" / "masks" / "00000.png").exists()


def test_the_time_that_a_worker_renders_the_curve_in_is_not_that_of_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A step takes a second, and each of the curve's two pictures takes 100."""
    clock, said = [0.0], []

    def pass_time(seconds: float) -> None:
        clock[0] += seconds

    def train() -> None:
        for step in range(100):
            pass_time(1.0)
            for callback in trainer.callbacks:
                callback(step)

    trainer = SimpleNamespace(callbacks=[], train=train, save_checkpoint=lambda step: None, checkpoint_dir=tmp_path)
    trainer.pipeline = SimpleNamespace(train=lambda: None)
    (tmp_path / "step-1.ckpt").touch()
    callbacks = ModuleType("nerfstudio.engine.callbacks")
    callbacks.TrainingCallback = lambda _, function: function  # type: ignore[attr-defined]
    callbacks.TrainingCallbackLocation = SimpleNamespace(AFTER_TRAIN_ITERATION=0)  # type: ignore[attr-defined]
    for module in (ModuleType("nerfstudio"), ModuleType("nerfstudio.engine"), callbacks):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(worker, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    monkeypatch.setattr(worker, "make_trainer", lambda job: trainer)
    monkeypatch.setattr(worker, "ModelCamera", lambda *_: SimpleNamespace(render=lambda path: pass_time(100.0)))
    monkeypatch.setattr(worker, "answer", lambda **values: said.append(values))
    job = {"curve_cameras": [{}, {}], "curve_seconds": [3.0], "seconds": 10.0, "out": str(tmp_path)}
    worker.train(job | {"method": "nerfacto", "device": "cpu"})
    assert [one["seconds"] for one in said] == [*map(float, range(1, 11)), 10.0]
    assert [one["step"] for one in said] == [*range(1, 11), 10]
    assert [one["step"] for one in said if "curve" in one] == [3]
    assert clock[0] == 210.0


@pytest.mark.parametrize(("visible", "expected"), [(None, "1"), ("4,7", "7")])
def test_the_worker_sees_only_the_gpu_that_was_asked_for(
    visible: str | None, expected: str, scene: Scene, tmp_path: Path, fake: None, monkeypatch: pytest.MonkeyPatch
):
    script, seen = driver.WORKER, tmp_path / "seen"
    write = f"print(os.environ.get('CUDA_VISIBLE_DEVICES'), file=open({str(seen)!r}, 'a'))"
    script.write_text(f"import os\n{write}\n{FAKE}")
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    gpu = torch.device("cuda:1")
    driver.train("nerfacto", scene, tmp_path, Budget(steps=3), 0, gpu, None, lambda step, seconds: None)
    with driver.renderer(tmp_path, gpu):
        pass
    with driver.renderer(tmp_path, CPU):
        pass
    assert seen.read_text().splitlines() == [expected, expected, str(visible)]


def test_a_worker_that_has_died_between_two_views_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    script = tmp_path / "worker.py"
    script.write_text("import sys\nprint('{}', flush=True)\nsys.exit('no memory is left')")
    monkeypatch.setattr(driver, "WORKER", script)
    monkeypatch.setattr(driver, "python", lambda: Path(sys.executable))
    with driver._worker(["render"], tmp_path / "log", CPU) as worker:
        worker.answer()
        worker.process.wait()
        with pytest.raises(RunError, match="nerfstudio ended before it was done"):
            worker.ask({"file": "view.npz"})
    assert "no memory is left" in caplog.text
    assert worker.process.stdout is not None
    assert worker.process.stdout.closed


@pytest.fixture
def standin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """nerfstudio's own worker, in a process where nerfstudio is its stand-in."""
    script = tmp_path / "worker.py"
    folder = Path(nerfstudio_standin.__file__).parent
    script.write_text(
        f"import runpy, sys\nsys.path.insert(0, {str(folder)!r})\n"
        f"sys.argv.insert(1, {worker.__file__!r})\n"
        f"runpy.run_path({nerfstudio_standin.__file__!r}, run_name='__main__')\n"
    )
    monkeypatch.setattr(driver, "WORKER", script)
    monkeypatch.setattr(driver, "python", lambda: Path(sys.executable))


def looks_like(rendering: Rendering, truth: torch.Tensor, camera: Cameras) -> None:
    """Whether the middle of a view, which all others show, is that of the photograph, at its exposure and depth."""
    inner = np.s_[8:-8, 16:-16]
    difference = (rendering.colour - truth.float() / 255)[inner]
    assert difference.mean((0, 1)).abs().max() < 0.01, "the colours are not those of this exposure"
    assert difference.square().mean() < 0.003, "it is not this view"
    torch.testing.assert_close(rendering.depth, wall.true_depth(camera), atol=0.01, rtol=0)


@pytest.mark.thorough
def test_what_nerfstudio_has_learned_comes_back_as_the_view_of_the_camera(tmp_path: Path, standin: None):
    cameras = wall.with_gains(wall.cameras(5, 96, 72))
    cameras = replace(cameras, focal_px=torch.tensor([[96.0, 80.0]] * 5), principal_px=torch.tensor([[45.0, 38.0]] * 5))
    scene = wall.scene(cameras, test=(2,))
    assert driver.export(scene, tmp_path / "data").factor.max() < 0.95, "a scene whose factor matters"
    driver.train("nerfacto", scene, tmp_path, Budget(steps=2), 0, CPU, None, lambda step, seconds: None)
    with driver.renderer(tmp_path, CPU) as render:
        view = render(scene.cameras[2])
    looks_like(view, scene.photographs[2], scene.cameras[2])
    assert view.opacity.min() == 1


@pytest.mark.thorough
def test_a_run_that_was_moved_is_rendered_and_nothing_in_it_changes(tmp_path: Path, standin: None):
    scene, run = wall.scene(wall.cameras(5, 96, 72), test=(1, 3)), tmp_path / "run"
    run.mkdir()
    driver.train("nerfacto", scene, run, Budget(steps=2), 0, CPU, None, lambda step, seconds: None)
    moved = run.rename(tmp_path / "moved")
    before = {path: path.stat().st_mtime_ns for path in moved.rglob("*")}
    with driver.renderer(moved, CPU) as one, driver.renderer(moved, CPU) as other:
        for render, index in ((one, 1), (other, 3), (one, 3), (other, 1)):
            looks_like(render(scene.cameras[index]), scene.photographs[index], scene.cameras[index])
        assert {path: path.stat().st_mtime_ns for path in moved.rglob("*")} == before
    assert {path: path.stat().st_mtime_ns for path in moved.rglob("*")} == before
    assert not run.exists()


def test_two_commands_render_one_run_in_files_of_their_own(scene: Scene, tmp_path: Path, fake: None):
    driver.train("nerfacto", scene, tmp_path, Budget(steps=3), 0, CPU, None, lambda step, seconds: None)
    asked, ask = [], driver._Process.ask
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver._Process, "ask", lambda self, it: asked.append(it["file"]) or ask(self, it))
        with driver.renderer(tmp_path, CPU) as one, driver.renderer(tmp_path, CPU) as other:
            one(scene.cameras[0])
            other(scene.cameras[0])
    first, second = map(Path, asked)
    assert first != second
    assert not first.parent.exists()


def test_what_nerfstudio_says_when_it_cannot_render_is_shown(
    scene: Scene, tmp_path: Path, fake: None, caplog: pytest.LogCaptureFixture
):
    driver.train("nerfacto", scene, tmp_path, Budget(steps=3), 0, CPU, None, lambda step, seconds: None)
    driver.WORKER.write_text("import sys\nsys.exit('no memory is left')")
    with pytest.raises(RunError, match="read what it says above"), driver.renderer(tmp_path, CPU):
        pass
    assert "no memory is left" in caplog.text


def with_alpha(scene: Scene) -> Scene:
    """The same wall, more and more transparent to the right, before white."""
    colours, alphas = [], []
    for index, colour in enumerate(scene.photographs.colours):
        camera = scene.cameras[index]
        x = camera.position_world[0, 0] + wall.DEPTH * camera.directions_world(pixel_grid(96, 72)[None])[0, :, 0]
        alpha = (0.5 - 0.5 * x).clamp(0, 1).reshape(72, 96)
        colours.append((alpha[..., None] * colour + (1 - alpha[..., None]) * 255).round().to(torch.uint8))
        alphas.append((255 * alpha).round().to(torch.uint8))
    hull = Hull(torch.tensor([-4.0, -3.0, 4.0]), torch.full((3,), 0.5), torch.ones(16, 16, 16, dtype=torch.bool))
    photographs = Photographs(tuple(colours), tuple(alphas))
    return replace(scene, photographs=photographs, background_rgb=(1.0, 1.0, 1.0), hull=hull)


@pytest.fixture
def transparent() -> Scene:
    return with_alpha(wall.scene(wall.with_gains(wall.cameras(5, 96, 72)), test=(2,)))


def test_photographs_with_alpha_are_exported_with_it_and_composited_give_the_same(transparent: Scene, tmp_path: Path):
    factor = driver.export(transparent, tmp_path).factor
    for index in range(5):
        with Image.open(tmp_path / "images" / f"{index:05d}.png") as picture:
            assert picture.mode == "RGBA"
            pixels = torch.from_numpy(np.array(picture)).float() / 255
        colour, alpha = pixels.split([3, 1], dim=-1)
        gain = transparent.cameras.gain[index]
        shown = colour / factor * gain * alpha + (1 - alpha)
        difference = (shown - transparent.photographs[index].float() / 255).abs()
        assert difference.max() < 2.5 / 255
        opaque = wall.photograph(transparent.cameras[index])[alpha[..., 0] > 0.2].float() / 255
        assert ((colour / factor * gain)[alpha[..., 0] > 0.2] - opaque).abs().max() < 8 / 255, "it was multiplied"
        assert not colour[alpha[..., 0] == 0].any()


@pytest.mark.thorough
def test_the_background_of_a_scene_with_alpha_comes_back_without_gain(
    transparent: Scene, tmp_path: Path, standin: None
):
    driver.train("nerfacto", transparent, tmp_path, Budget(steps=2), 0, CPU, None, lambda step, seconds: None)
    with driver.renderer(tmp_path, CPU) as render:
        view = render(transparent.cameras[2])
    looks_like(view, transparent.photographs[2], transparent.cameras[2])
    alpha = transparent.photographs.alpha(2)
    assert alpha is not None
    assert (view.opacity - alpha / 255)[8:-8, 16:-16].abs().max() < 0.03
    assert view.colour[alpha == 0].min() == 1


def test_rays_and_box_hold_the_object_of_a_scene_with_alpha(transparent: Scene):
    limits = driver.object_limits(transparent)
    assert limits is not None
    near, far = limits["near_far"]
    assert near == 3.0
    assert far == pytest.approx(10 * (1 + 0.5**2 + 0.375**2) ** 0.5), "the ray through a corner is longer than deep"
    assert limits["half_side"] == 12.0
    assert driver.object_limits(replace(transparent, hull=None)) is None


def test_an_error_of_nerfstudio_is_reported(scene: Scene, tmp_path: Path, fake: None):
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(RunError, match=r"bad luck.*nerfstudio\.log"):
        driver.train("nerfacto", scene, run, Budget(steps=3), 13, CPU, None, lambda step, seconds: None)
    with pytest.raises(RunError, match="not been trained to its end"):
        driver.progress_of(run)


@pytest.mark.parametrize(
    "job",
    [
        *("[1]", '{"trained": 7}', '{"trained": [3, 30.0]}', '{"trained": [3, 30.0], "factor": [1, 1]}'),
        f'{{"trained": [3, 1{400 * "0"}], "factor": [1, 1, 1]}}',
    ],
)
def test_a_damaged_job_is_named(job: str, tmp_path: Path):
    (tmp_path / "job.json").write_text(job)
    with pytest.raises(RunError, match=r"job\.json.*expected"):
        driver.progress_of(tmp_path)


def test_without_nerfstudio_the_message_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with pytest.raises(RunError, match="run `tidefield baselines install nerfacto`"):
        environment.python()


def test_a_home_that_cannot_be_made_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(environment, "_NEWEST_PYTHON", sys.version_info[:2])
    with pytest.raises(RunError, match=r"file/tidefield/nerfstudio-.* cannot be written \(Not a directory"):
        environment.install(False, Console(quiet=True))


def test_without_a_home_folder_the_message_says_what_to_set(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as of a user that the system does not know
    with pytest.raises(RunError, match=r"no home folder.*XDG_DATA_HOME"):
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
    assert any(word.startswith("torchvision<0.") for word in packages)
    assert "--quiet" in packages
    with pytest.raises(RunError, match="--overwrite"):
        environment.install(False, quiet)
    monkeypatch.setattr(environment.sys, "version_info", (3, 14, 0))
    with pytest.raises(RunError, match=r"Python 3\.14: expected 3\.12 or older"):
        environment.install(True, quiet)


def test_an_installation_says_what_it_needs_and_what_it_does_and_lets_pip_talk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    pip = """
import sys
if "pip" in sys.argv:
    print("Collecting", sys.argv[-1], flush=True)
"""

    def create(folder: Path, with_pip: bool) -> None:
        (folder / "bin").mkdir(parents=True)
        interpreter = folder / "bin" / "python"
        interpreter.write_text(f"#!{sys.executable}{pip}")
        interpreter.chmod(0o755)

    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setattr(environment, "_NEWEST_PYTHON", sys.version_info[:2])
    monkeypatch.setattr(environment, "_interpreter", lambda: environment.home() / "bin" / "python")
    monkeypatch.setattr(environment.venv, "create", create)
    environment.install(False, Console(width=500))
    lines = capfd.readouterr().out.splitlines()
    assert "gigabytes" in lines[0]
    assert "nvcc and a C++ compiler" in lines[0]
    assert [line[:6] for line in lines[1:] if not line.startswith("Collecting")] == [f"{k} of 4" for k in (1, 2, 3, 4)]
    assert lines.index("Collecting nerfstudio==1.1.5") == 5
    pip = pip.replace("flush=True)", "flush=True)\n    sys.exit(1)")
    with pytest.raises(RunError, match=r"pip could not install what nerfstudio needs into .*read what it says above"):
        environment.install(True, Console(quiet=True))
    assert not environment._complete().exists()


@pytest.mark.parametrize(
    ("torch", "vision"),
    [("2.6.0", "<0.22"), ("2.7.1", "<0.23"), ("2.13.0", "<0.29"), ("2.15.0.post1", "<0.31"), ("2.15.0a0", "<0.31")],
)
def test_torchvision_is_the_newest_that_there_is_for_the_torch(torch: str, vision: str):
    assert environment._vision(torch) == f"torchvision{vision}"


@pytest.mark.parametrize(
    ("torch", "message"),
    [("2.5.1", r"2\.5\.1 is here.*not safe: expected 2\.6 or newer"), ("3.0.0", "3.0.0 is new .*expected 2.x")],
)
def test_nothing_is_installed_for_a_torch_that_is_too_old_or_too_new(
    torch: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setattr(environment, "_NEWEST_PYTHON", sys.version_info[:2])
    monkeypatch.setattr(environment, "version", lambda _: f"{torch}+cpu")
    with pytest.raises(RunError, match=message):
        environment.install(False, Console(quiet=True))
    assert list(tmp_path.iterdir()) == []


class Pickled:
    """Runs code when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return exec, ("raise SystemExit('code of a checkpoint ran')",)


def test_a_checkpoint_cannot_run_code_in_the_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")
    monkeypatch.setenv("TORCH_FORCE_WEIGHTS_ONLY_LOAD", "0")
    torch.save({"step": 1, "pipeline": Pickled()}, tmp_path / "step-1.ckpt")
    with pytest.warns(UserWarning, match="forcing weights_only=False"), pytest.raises(SystemExit, match="ran"):
        torch.load(tmp_path / "step-1.ckpt", map_location="cpu")
    worker.load_only_weights()
    with pytest.raises(UnpicklingError, match="Weights only load failed"):
        torch.load(tmp_path / "step-1.ckpt", map_location="cpu")


def test_the_worker_refuses_a_torch_whose_loading_is_not_safe(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(worker.torch, "__version__", TorchVersion("2.5.1+cpu"))
    with pytest.raises(SystemExit, match=r"torch 2\.5\.1\+cpu .*expected 2\.6 or newer.*install nerfacto --overwrite"):
        worker.load_only_weights()


def test_a_pose_is_converted_into_the_frame_of_the_model():
    turn = torch.linalg.qr(torch.rand(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    right, down, forward = turn.T  # OpenCV's axes of the camera in the world
    position = torch.tensor([1.0, -2.0, 3.0])
    world = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    shift, scale = torch.tensor([0.5, 0.25, -1.0]), 0.2
    T_world_camera = torch.cat([turn, position[:, None]], dim=1)
    pose = worker.model_pose(T_world_camera.tolist(), torch.cat([world, shift[:, None]], dim=1), scale)
    # OpenGL's camera: +x right, +y up, -z forward.
    for column, axis in zip(pose[:, :3].T, (right, -down, -forward), strict=True):
        torch.testing.assert_close(column, world @ axis)
    torch.testing.assert_close(pose[:, 3], scale * (world @ position + shift))


def test_depths_are_converted_into_z_depths_of_the_world():
    distance = np.array([[2.0, 3.0]])
    np.testing.assert_allclose(worker.z_depth(distance, 0.5, np.array([[1.0, 1.5]])), [[4.0, 4.0]])
    np.testing.assert_allclose(worker.z_depth(distance, 0.5, None), [[4.0, 6.0]])


@pytest.mark.parametrize("device", ["cpu", "cuda:0"])
def test_the_configuration_differs_from_the_defaults_only_where_it_must(device: str):
    model = SimpleNamespace(
        camera_optimizer=SimpleNamespace(mode="SO3xR3"),
        use_appearance_embedding=True,
        implementation="tcnn",
        eval_num_rays_per_chunk=32768,
    )
    data = SimpleNamespace(train_num_rays_per_batch=4096)
    config = SimpleNamespace(
        pipeline=SimpleNamespace(model=model, datamanager=data), machine=SimpleNamespace(), max_num_iterations=30000
    )
    job = {"method": "nerfacto", "data": "d", "out": "o", "steps": None, "seed": 3, "device": device}
    worker.configure(config, job, tiny_cuda_nn=device != "cpu")
    assert model.camera_optimizer.mode == "off"
    assert not model.use_appearance_embedding
    assert config.machine.seed == 3
    assert config.machine.device_type == device.split(":")[0]
    expected = ("torch", 2048, 1024) if device == "cpu" else ("tcnn", 32768, 4096)
    assert (model.implementation, model.eval_num_rays_per_chunk, data.train_num_rays_per_batch) == expected


def test_scenes_of_an_object_get_nerfstudios_settings_for_blender_scenes():
    config = nerfstudio_standin.defaults()
    job = {"method": "nerfacto", "data": "d", "out": "o", "steps": None, "seed": 3, "device": "cpu"}
    job |= {"background": None, "object": None}
    worker.configure(config, job, tiny_cuda_nn=False)
    model, before = config.pipeline.model, nerfstudio_standin.defaults().pipeline.model
    own = ("near_plane", "far_plane", "background_color", "proposal_initial_sampler", "distortion_loss_mult")
    own = (*own, "disable_scene_contraction")
    assert [getattr(model, name) for name in own] == [getattr(before, name) for name in own]
    assert worker.parser_options(job) == {"data": Path("d"), "downscale_factor": 1}
    job |= {"background": [1, 1, 1], "object": {"near_far": [2.0, 6.0], "half_side": 1.5}}
    worker.configure(config, job, tiny_cuda_nn=False)
    assert [getattr(model, name) for name in own] == [2.0, 6.0, "white", "uniform", 0.0, True]
    kept = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False, "scene_scale": 1.5}
    assert worker.parser_options(job) == {"data": Path("d"), "downscale_factor": 1} | kept


@pytest.mark.slow
def test_the_real_nerfacto_trains_and_renders(scene: Scene, tmp_path: Path):
    try:
        environment.python()
    except RunError as error:
        pytest.skip(str(error))
    run = tmp_path / "run"
    run.mkdir()
    plain = replace(scene, cameras=wall.cameras(5))
    driver.train("nerfacto", plain, run, Budget(steps=500), 0, CPU, None, lambda step, seconds: None)
    with driver.renderer(run, CPU) as render:
        view = render(plain.cameras[2])
    assert view.colour.shape == (36, 48, 3)
    assert np.isfinite(view.depth.numpy()).all()
    truth = plain.photographs[2].float() / 255
    uniform = (truth - truth.mean((0, 1))).square().mean()
    error = (view.colour - truth).square().mean()
    assert error < 0.8 * uniform, "better than the best picture of one colour"


def test_masks_are_exported_for_all_photographs_or_none(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    masked = wall.with_left_halves_masked(scene, (2,))
    driver.export(masked, tmp_path / "data")
    frames = json.loads((tmp_path / "data" / "transforms.json").read_text())["frames"]
    assert [frame["mask_path"] for frame in frames] == [f"masks/{i:05d}.png" for i in range(5)]
    again = load_scene(tmp_path / "data")
    assert all(torch.equal(again.photographs.used(i), masked.photographs.used(i)) for i in range(5))


def shaded(scene: Scene) -> Scene:
    """White photographs, a third as bright in their corners; a held-out one is far darker."""
    cameras = replace(scene.cameras, shading=torch.zeros(5, 15, 3))
    assert cameras.shading is not None
    cameras.shading[:, 3:] = -2.0
    cameras.gain[0] = 0.01
    white = tuple(torch.full_like(photograph, 255) for photograph in scene.photographs.colours)
    return replace(scene, cameras=cameras, photographs=replace(scene.photographs, colours=white))


def test_no_training_photograph_clips_at_the_common_exposure(scene: Scene, tmp_path: Path):
    own = shaded(scene)
    factor = driver.export(own, tmp_path).factor
    assert 0.05 < factor.min() < 0.2, "of the training photographs, with their shading"
    for index in own.train:
        with Image.open(tmp_path / "images" / f"{index:05d}.png") as picture:
            pixels = torch.from_numpy(np.array(picture)).float()
        shown = pixels / factor * own.cameras[index].gain_of_rows()
        assert (shown - 255).abs().max() <= 0.51 / float(factor.min()) * 1.3


def test_an_export_that_was_interrupted_is_deleted(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupted(scene: Scene, folder: Path) -> None:
        (folder / "images").mkdir(parents=True)
        (folder / "images" / "00000.png").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(driver, "export", interrupted)
    monkeypatch.setattr(driver, "require", lambda *_: None)
    with pytest.raises(KeyboardInterrupt):
        driver.train("nerfacto", scene, tmp_path, Budget(steps=3), 0, CPU, None, lambda step, seconds: None)
    with pytest.raises(RunError, match="not been trained to its end"):
        driver.progress_of(tmp_path)
    driver.delete_training(tmp_path)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_the_worker_gets_no_modules_of_our_python(tmp_path: Path, fake: None, monkeypatch: pytest.MonkeyPatch):
    driver.WORKER.write_text("import json, os\nprint(json.dumps({**os.environ}), flush=True)\ninput()")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("OURS", "is kept")
    with driver._worker(["train"], tmp_path / "log", CPU) as running:
        found = running.answer()
    assert "PYTHONPATH" not in found
    assert found["OURS"] == "is kept"
    printed = environment._run([sys.executable, "-c", "import os; print(*os.environ)"], stdout=PIPE, text=True).stdout
    assert "PYTHONPATH" not in printed.split()


def test_layers_of_tiny_cuda_nn_are_those_of_the_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    job = {"method": "nerfacto", "factor": [1.0] * 3, "trained": [3, 30.0], "checkpoint": "a", "tiny_cuda_nn": True}
    write_json(tmp_path / "job.json", job)
    with (
        pytest.raises(RunError, match=r"trained with tiny-cuda-nn.* got cpu; render it"),
        driver.renderer(tmp_path, CPU),
    ):
        pass
    with pytest.raises(SystemExit, match="trained with tiny-cuda-nn, which is not in nerfstudio's environment"):
        worker.uses_tiny_cuda_nn(job | {"device": "cuda"})
    monkeypatch.setitem(sys.modules, "tinycudann", ModuleType("tinycudann"))
    monkeypatch.setattr(worker.torch.cuda, "is_available", lambda: True)
    asked = {"method": "nerfacto", "device": "cuda:0"}
    assert worker.uses_tiny_cuda_nn(asked)
    assert not worker.uses_tiny_cuda_nn(asked | {"tiny_cuda_nn": False}), "weights of PyTorch's layers do not fit"
    assert not worker.uses_tiny_cuda_nn(asked | {"device": "cpu"})
    assert not worker.uses_tiny_cuda_nn(asked | {"method": "splatfacto"})


def test_an_interrupted_deletion_leaves_no_complete_installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupted(*_, **__) -> None:
        raise KeyboardInterrupt

    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setattr(environment, "_NEWEST_PYTHON", sys.version_info[:2])
    environment.home().mkdir(parents=True)
    environment._complete().touch()
    monkeypatch.setattr(environment.shutil, "rmtree", interrupted)
    with pytest.raises(KeyboardInterrupt):
        environment.install(True, Console(quiet=True))
    with pytest.raises(RunError, match="is not installed"):
        environment.python()
