"""Learning rates, weights and points inside nerfstudio, with a stand-in for what `method.py` takes of it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import textured_wall as wall
import torch
from networks import SMALL
from PIL import Image

from tidefield.config import PRESETS, Budget
from tidefield.data.readers.posed import Observations, PosedPhotographs
from tidefield.errors import RunError
from tidefield.geometry.lenses import Lens

OURS = ("tidefield.nerfstudio.data", "tidefield.nerfstudio.method")
MODULES = (
    "cameras.cameras",
    "configs.base_config",
    *("data.datamanagers.full_images_datamanager", "data.datasets.base_dataset", "data.scene_box"),
    "data.dataparsers.base_dataparser",
    *("engine.callbacks", "engine.optimizers", "engine.trainer"),
    "models.base_model",
    "pipelines.base_pipeline",
    *("plugins.registry_dataparser", "plugins.types"),
)


class Anything:
    """A class of nerfstudio's whose instances only keep what they are given."""

    def __init__(self, *words: Any, **named: Any) -> None:
        self.words = words
        vars(self).update(named)


class AnyModule(ModuleType):
    """A module of nerfstudio's, with every class that is asked for."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        made = type(name, (Anything,), {})
        setattr(self, name, made)
        return made


class Model(torch.nn.Module):
    def __init__(self, config: Any) -> None:
        super().__init__()
        self.config = config
        self.populate_modules()

    def populate_modules(self) -> None: ...


class OptimizerConfig:
    """nerfstudio's own, of version 1.1.5."""

    _target = torch.optim.Adam

    def setup(self, params: Any) -> torch.optim.Optimizer:
        options = vars(self).copy()
        options.pop("max_norm")
        return self._target(params, **options)


@pytest.fixture
def method(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """`tidefield.nerfstudio.method`, imported with the stand-in."""
    for name in MODULES:
        parts = ("nerfstudio", *name.split("."))
        for count in range(1, len(parts) + 1):
            full = ".".join(parts[:count])
            monkeypatch.setitem(sys.modules, full, AnyModule(full))
    monkeypatch.setattr(sys.modules["nerfstudio.models.base_model"], "Model", Model, raising=False)
    monkeypatch.setattr(sys.modules["nerfstudio.engine.optimizers"], "OptimizerConfig", OptimizerConfig, raising=False)
    callbacks: Any = sys.modules["nerfstudio.engine.callbacks"]
    callbacks.TrainingCallbackLocation = SimpleNamespace(BEFORE_TRAIN_ITERATION=0)
    try:
        yield import_module(OURS[1])
    finally:
        for name in OURS:
            sys.modules.pop(name, None)


def test_nerfstudio_trains_each_parameter_at_the_trainers_rate(method: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "swift", SMALL)
    scene = wall.scene(wall.cameras(5, 64, 48, step=0.25))
    model = method.TidefieldModel(method.TidefieldModelConfig(from_scratch=True), {"scene": scene, "scale": 1.0}, "cpu")
    (params,) = model.get_param_groups().values()
    assert list(params) == list(model.network.parameters()), "their gradients are clipped together"
    optimizer = method.NetworkAdam().setup(params)
    attributes = method.TrainingCallbackAttributes(
        optimizers=SimpleNamespace(optimizers={"network": optimizer}),
        trainer=SimpleNamespace(config=SimpleNamespace(max_num_iterations=100)),
        pipeline=SimpleNamespace(datamanager=method.SceneDataManager()),
    )
    (callback,) = model.get_training_callbacks(attributes)
    assert attributes.pipeline.datamanager.get_train_rays_per_batch() == model.trainer.rays_per_step > 0
    monkeypatch.setattr(model.trainer, "backward", lambda: torch.zeros(()))
    monkeypatch.setattr(model.trainer, "draw_ahead", lambda: None)
    for step in range(3):
        callback.words[1](step)
        found = rates(optimizer)
        model.trainer.step(Budget(steps=100))
        assert found == pytest.approx(rates(model.trainer.optimizer))
        assert len(set(found.values())) == 2, "the encoder's is bounded"


def rates(optimizer: torch.optim.Optimizer) -> dict[torch.nn.Parameter, float]:
    return {parameter: group["lr"] for group in optimizer.param_groups for parameter in group["params"]}


def test_a_model_whose_checkpoint_follows_needs_no_other_weights(method: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: Any) -> None:
        raise RunError("no weights are installed")

    monkeypatch.setitem(PRESETS, "swift", SMALL)
    monkeypatch.setattr(method, "given_or_shipped", missing)
    scene = wall.scene(wall.cameras(5, 64, 48, step=0.25))
    given = {"scene": scene, "scale": 1.0}
    assert method.TidefieldModel(method.TidefieldModelConfig(), {**given, "is_trained": True}, "cpu").network
    with pytest.raises(RunError, match="no weights"):
        method.TidefieldModel(method.TidefieldModelConfig(), given, "cpu")
    asked = []
    monkeypatch.setattr(method.SceneDataset, "__init__", lambda _, outputs, width, is_trained: asked.append(is_trained))
    outputs, width = sys.modules[OURS[0]].SceneOutputs(), SimpleNamespace(width=None)
    for mode in ("val", "test", "inference"):
        method.SceneDataManager(config=width, test_mode=mode, train_dataparser_outputs=outputs).create_train_dataset()
    assert asked == [False, True, True], "nerfstudio trains in the mode val"


def test_points_have_the_colours_of_training_photographs(method: Any, tmp_path: Path) -> None:
    """Of photographs at half the lens's size; what the model says of colours does not count."""
    data = sys.modules[OURS[0]]
    for k in range(3):
        Image.fromarray(np.full((6, 8, 3), 50 * k, np.uint8)).save(tmp_path / f"{k}.png")
    points = Observations(
        xyz_world=np.zeros((3, 3)),
        point_index=np.array([0, 0, 1, 2]),
        photograph_index=np.array([0, 1, 2, 1]),
        uv_px=np.array([[3.0, 3.0], [15.0, 11.0], [3.0, 3.0], [17.0, 3.0]]),
        rgb=np.full((3, 3), 250, np.uint8),
    )
    posed = PosedPhotographs(
        names=("0.png", "1.png", "2.png"),
        paths=tuple(tmp_path / f"{k}.png" for k in range(3)),
        lenses=(Lens(16, 12, 10.0, 10.0, 8.0, 6.0),) * 3,
        T_world_camera=np.zeros((3, 3, 4)),
    )
    assert data._colours(points, posed, (1, 2)).tolist() == [[50] * 3, [100] * 3, [128] * 3]
