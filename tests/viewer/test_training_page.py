"""A training that is looked at: a copy is shown, only to who looks, and the training itself does not change."""

import time
from pathlib import Path

import pytest
import textured_wall
import torch
from networks import SMALL
from rich.console import Console
from scenes_on_disk import PINHOLE, survey, write_colmap

from tidefield.baselines.nerf import NerfTrainer
from tidefield.commands.train import Train, train
from tidefield.config import PRESETS, Budget, NerfConfig
from tidefield.device import choose_device
from tidefield.errors import RunError
from tidefield.geometry.cameras import Cameras
from tidefield.model.renderer import Renderer
from tidefield.model.rendering import Rendering
from tidefield.recording import recording_lock
from tidefield.train.checkpoint import CHECKPOINT_FILE
from tidefield.train.loop import SceneTrainer
from tidefield.viewer import training
from tidefield.viewer.frames import Frame

pytest.importorskip("viser", reason="needs viser, which is not installed")
QUIET = Console(quiet=True)


def test_only_who_looks_is_shown_the_network_and_it_is_a_copy(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(training, "REFRESH_SECONDS", 0.0)
    scene = textured_wall.scene(textured_wall.cameras(5, 96, 72))
    trainer = SceneTrainer(PRESETS["swift"], scene, 0, choose_device("cpu"))
    with training.TrainingPage(trainer, "run", "127.0.0.1", 0) as page:
        given: list[object] = []
        replace = page.page.frames.replace_method
        monkeypatch.setattr(page.page.frames, "replace_method", lambda method: (given.append(method), replace(method)))
        page(trainer, 0.1)
        assert given == []
        shown: list[Frame] = []
        page.page.frames.ask("who", scene.cameras[1].resized(48, 36), shown.append)
        end = time.monotonic() + 60
        while not any(frame.sharp for frame in shown) and time.monotonic() < end:
            time.sleep(0.02)
        before = [frame for frame in shown if frame.sharp][-1]
        assert before.error is None
        with torch.no_grad():
            for value in trainer.network.parameters():
                value.mul_(0)
        page(trainer, 0.2)
        assert len(given) == 1
        while sum(frame.sharp for frame in shown) < 2 and time.monotonic() < end:
            time.sleep(0.02)
        after = [frame for frame in shown if frame.sharp][-1]
        assert after.rendering is not None
        assert before.rendering is not None
        assert not torch.allclose(after.rendering.colour, before.rendering.colour, atol=1e-3)
        assert trainer.network.training


def test_nothing_is_recorded_while_a_picture_of_a_training_is_made(monkeypatch: pytest.MonkeyPatch):
    scene = textured_wall.scene(textured_wall.cameras(5, 48, 36))
    trainer, locked = SceneTrainer(SMALL, scene, 0, choose_device("cpu")), []

    def method(camera: Cameras) -> Rendering:
        locked.append(recording_lock.locked())
        return Rendering(torch.zeros(36, 48, 3), torch.ones(36, 48), torch.ones(36, 48))

    monkeypatch.setattr(trainer, "renderer", lambda sampling: method)
    training._as_it_is(trainer)(scene.cameras[0])
    assert locked == [True]
    assert not recording_lock.locked()


@pytest.mark.thorough
def test_what_was_read_of_photographs_is_kept_when_weights_are_renewed(monkeypatch: pytest.MonkeyPatch):
    scene = textured_wall.scene(textured_wall.cameras(3, 32, 24))
    trainer = SceneTrainer(SMALL, scene, 0, choose_device("cpu"))
    trainer._open = trainer._ahead = object()  # large, and the training's
    copied, usual = [], SceneTrainer.renderer
    monkeypatch.setattr(SceneTrainer, "renderer", lambda own, sampling: (copied.append(own), usual(own, sampling))[1])
    kept: list[Renderer] = []
    before = training._as_it_is(trainer, kept)(scene.cameras[0])
    matcher, pyramid, features = kept[0].matcher, kept[0].cache.pyramid, kept[0].cache
    assert matcher is not None
    with torch.no_grad():
        for value in trainer.network.parameters():
            value.mul_(0.5)
    after = training._as_it_is(trainer, kept)(scene.cameras[0])
    assert (kept[0].matcher, kept[0].cache.pyramid) == (matcher, pyramid)
    assert kept[0].cache is not features, "features depend on the weights"
    assert not torch.equal(after.colour, before.colour)
    assert torch.equal(after.colour, training._as_it_is(trainer)(scene.cameras[0]).colour)
    assert None not in (trainer._open, trainer._ahead)
    assert [(own._open, own._ahead) for own in copied] == [(None, None)] * 2


def test_what_is_shown_of_a_nerf_is_a_copy_too():
    scene = textured_wall.scene(textured_wall.cameras(5, 8, 6))
    small = NerfConfig(coarse=4, fine=4, depth=2, width=16)
    trainer = NerfTrainer(small, scene, 0, choose_device("cpu"))
    torch.nn.init.constant_(trainer.network.fine.density.bias, 5.0)  # something is seen
    shown = training._as_it_is(trainer)
    before = shown(scene.cameras[0]).colour
    with torch.no_grad():
        for value in trainer.network.parameters():
            value.mul_(0)
    assert torch.equal(shown(scene.cameras[0]).colour, before)
    assert not torch.equal(training._as_it_is(trainer)(scene.cameras[0]).colour, before)


@pytest.mark.thorough
def test_a_training_that_is_looked_at_learns_the_same(tmp_path: Path):
    write_colmap(tmp_path / "scene", survey(PINHOLE))
    for name, options in (("plain", {}), ("viewed", {"view": True, "port": 0})):
        train(Train(tmp_path / "scene", tmp_path / name, budget=Budget(steps=2), device="cpu", **options), QUIET)
    from safetensors.torch import load_file

    plain, viewed = (load_file(tmp_path / name / CHECKPOINT_FILE) for name in ("plain", "viewed"))
    weights = [name for name in plain if name.startswith("network.")]
    assert weights
    assert all(torch.equal(plain[name], viewed[name]) for name in weights)


def test_a_method_of_another_program_is_not_shown(tmp_path: Path):
    write_colmap(tmp_path / "scene", survey(PINHOLE))
    options = Train(tmp_path / "scene", tmp_path / "run", method="nerfacto", view=True, port=0, device="cpu")
    with pytest.raises(RunError, match="nerfacto trains in a program of its own: --view shows our methods"):
        train(options, QUIET)
