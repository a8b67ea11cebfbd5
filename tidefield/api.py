"""The Python interface: trained weights and runs as functions from a camera to a rendering."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tidefield import methods
from tidefield.config import PRESETS
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.device import choose_device
from tidefield.errors import RunError
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Render, Rendering
from tidefield.train.checkpoint import given_or_shipped, read_run, scene_of


def zero_shot(scene: Scene, preset: str = "swift", weights: str | Path | None = None, device: str = "auto") -> Render:
    """Render a scene with trained weights, without training on it.

    Args:
        scene: from `load_scene`; its training photographs serve as neighbouring views, except for their own cameras'
            (`Cameras.names`).
        preset: "swift" or "paper".
        weights: a file of `tidefield pretrain`; the installed weights of the preset if None.
        device: "auto", "cpu", "cuda", "cuda:N" or "mps".

    Returns:
        A function from one camera to its `Rendering`.

    Raises:
        RunError: there is no such preset, or the weights are missing, damaged or another network's.
        DeviceError: the device is not on this machine.
    """
    if preset not in PRESETS:
        raise RunError(f"there is no preset {preset!r}: expected one of {', '.join(PRESETS)}; choose one of these")
    file = given_or_shipped(None if weights is None else Path(weights), preset)
    return methods.zero_shot(PRESETS[preset], file, scene, choose_device(device))[0]


class OpenRun:
    """A trained run as a function from a camera to its rendering; also a context manager, which closes it.

    Attributes:
        scene: the run's scene.
        config: of its network and training.
        steps: of training so far.
    """

    def __init__(self, folder: Path, device: str) -> None:
        run, where = read_run(folder), choose_device(device)  # before photographs are read, which may take minutes
        self.folder, self.config = folder, run.config
        self.scene: Scene = load_scene(scene_of(folder, run), width=run.width)
        self._stack = ExitStack()
        trained = methods.trained(folder, run, self.scene, where)
        self._render, progress = self._stack.enter_context(trained)
        self.steps = progress.step

    def __call__(self, camera: Cameras) -> Rendering:
        """Render the view of one camera."""
        return self._render(camera)

    def close(self) -> None:
        """End what the method has started; methods of nerfstudio run in a process of their own."""
        self._stack.close()

    def __enter__(self) -> OpenRun:
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def __repr__(self) -> str:
        name = getattr(self.config, "preset", self.config.method)
        return f"OpenRun({self.folder.name!r}, {name}, {self.steps:,} steps)"


def open_run(folder: str | Path, device: str = "auto") -> OpenRun:
    """Open a run of `tidefield train`.

    Args:
        folder: of the run.
        device: "auto", "cpu", "cuda", "cuda:N" or "mps".

    Raises:
        RunError: the folder holds no run, or one that has not been trained or is damaged.
        SceneError: the run's scene cannot be read.
        DeviceError: the device is not on this machine.
    """
    return OpenRun(Path(folder), device)
