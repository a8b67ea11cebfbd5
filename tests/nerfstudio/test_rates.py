"""The learning rates of parameters inside nerfstudio, with a stand-in for what `method.py` takes of it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import textured_wall as wall
import torch
from networks import SMALL

from tidefield.config import PRESETS, Budget

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
    )
    (callback,) = model.get_training_callbacks(attributes)
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
