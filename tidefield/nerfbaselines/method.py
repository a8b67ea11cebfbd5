"""The method that NerfBaselines trains, renders and measures.

A view is made from photographs, so a checkpoint holds them: CHECKPOINT/scene is a scene that Tidefield opens, beside
CHECKPOINT/checkpoint.safetensors and what the training was asked for, CHECKPOINT/settings.json.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
from nerfbaselines import Cameras as GivenCameras
from nerfbaselines import Dataset, Method, MethodInfo, ModelInfo, RenderOptions, RenderOutput
from PIL import Image

from tidefield.config import PRESETS, Budget, Range, Seed, from_json
from tidefield.data.load import load_scene
from tidefield.data.pictures import write_mask
from tidefield.data.readers.transforms import write_transforms_file
from tidefield.device import choose_device
from tidefield.errors import RunError
from tidefield.evaluation.metrics import psnr_from_mse
from tidefield.files import read_json, write_json
from tidefield.geometry.lenses import Lens
from tidefield.model.rendering import Render
from tidefield.render.camera_paths import free_camera
from tidefield.train.checkpoint import given_or_shipped, require_checkpoint
from tidefield.train.loop import SceneTrainer

SCENE, SETTINGS_FILE = "scene", "settings.json"
SETTINGS: dict[str, Any] = {"preset": "swift", "num_iterations": 2000, "seed": 0}
"""What `--set` changes, and its defaults."""
_TYPES = {"preset": Literal["swift", "paper"], "num_iterations": Annotated[int, Range(1, 1 << 40)], "seed": Seed}
OUTPUTS = ("color", "depth", "accumulation")


class TidefieldMethod(Method):
    """Trains on the photographs of a dataset from the installed weights on, or continues from a checkpoint.

    Raises:
        RunError: there is neither, a setting is unknown, or other than that of the checkpoint.
    """

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Dataset | None = None,
        config_overrides: dict[str, Any] | None = None,
    ) -> None:
        self.checkpoint = checkpoint
        if checkpoint is not None:
            self.folder = Path(checkpoint)
            require_checkpoint(self.folder)
            stored = read_json(self.folder / SETTINGS_FILE) or {}
            self.settings = _settings(stored)
            asked = _settings({**stored, **(config_overrides or {})})
            if other := [f"{name}={asked[name]}" for name in SETTINGS if asked[name] != self.settings[name]]:
                raise RunError(
                    f"--set {' '.join(other)} was given with the checkpoint {checkpoint}: expected its own settings, "
                    f"{', '.join(f'{name}={value}' for name, value in self.settings.items())}; leave --set out, or "
                    "train without a checkpoint"
                )
        else:
            if train_dataset is None:
                raise RunError("neither a checkpoint nor a dataset was given: expected one of them; name one")
            self.settings = _settings(config_overrides or {})
            self._temporary = TemporaryDirectory()
            self.folder = Path(self._temporary.name)
            write_scene(train_dataset, self.folder / SCENE)
        self.scene = load_scene(self.folder / SCENE, hold_out=False)
        preset, seed = str(self.settings["preset"]), int(self.settings["seed"])
        weights = given_or_shipped(None, preset) if checkpoint is None else None
        self.trainer = SceneTrainer(PRESETS[preset], self.scene, seed, choose_device("auto"), weights)
        if checkpoint is not None:
            self.trainer.resume(self.folder)
        self.loaded_step = None if checkpoint is None else self.trainer.progress.step
        self._render: Render | None = None

    @classmethod
    def get_method_info(cls) -> MethodInfo:
        return {
            "method_id": "tidefield",
            "required_features": frozenset(("color",)),
            "supported_camera_models": frozenset(("pinhole",)),
            "supported_outputs": OUTPUTS,
            "can_resume_training": True,
        }

    def get_info(self) -> ModelInfo:
        return {
            **self.get_method_info(),
            "num_iterations": self.settings["num_iterations"],
            "loaded_step": self.loaded_step,
            "loaded_checkpoint": self.checkpoint,
            "batch_size": self.trainer.rays_per_step,
            "hparams": dict(self.settings),
        }

    def train_iteration(self, step: int) -> dict[str, float]:
        self._render = None
        self.trainer.network.train()
        mse = self.trainer.step(Budget(steps=self.settings["num_iterations"]))
        return {"mse": mse, "psnr": psnr_from_mse(mse)}

    def render(self, camera: GivenCameras, *, options: RenderOptions | None = None) -> RenderOutput:
        """Render one pinhole camera at the scene's common exposure."""
        if self._render is None:
            self.trainer.network.eval()
            self._render = self.trainer.renderer()
        camera = camera.item()
        pose = np.asarray(camera.poses, np.float64)[:3].copy()
        pose[:, 3] -= self.scene.origin_world.numpy()
        fx, fy, cx, cy = (float(x) for x in camera.intrinsics)
        width, height = (int(x) for x in camera.image_sizes)
        view = self._render(free_camera(self.scene, pose, Lens(width, height, fx, fy, cx, cy)))
        found = {"color": view.colour, "depth": view.depth, "accumulation": view.opacity}
        wanted = (options or {}).get("outputs") or OUTPUTS
        return {name: value.cpu().numpy() for name, value in found.items() if name in wanted}

    def save(self, path: str) -> None:
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copytree(self.folder / SCENE, folder / SCENE, dirs_exist_ok=True)
        write_json(folder / SETTINGS_FILE, self.settings)
        self.trainer.save(folder)


def _settings(given: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with their defaults, checked; the command line has numbers as text."""
    unknown = sorted(set(given) - set(SETTINGS))
    if unknown:
        raise RunError(f"there is no setting {unknown[0]}: expected {', '.join(SETTINGS)}; choose one of these")
    number = re.compile(r"-?\d{1,20}")
    values = {name: given.get(name, value) for name, value in SETTINGS.items()}
    values = {name: int(x) if isinstance(x, str) and number.fullmatch(x) else x for name, x in values.items()}
    return {name: from_json(_TYPES[name], value, name) for name, value in values.items()}


def write_scene(dataset: Dataset, folder: Path) -> None:
    """Write a dataset of pinhole cameras as a scene that Tidefield opens.

    Points are not written: they come without their observations, and Tidefield triangulates its own.
    """
    (folder / "images").mkdir(parents=True)
    cameras, masks = dataset["cameras"], dataset["masks"]
    files = [f"images/{index:05d}.png" for index in range(len(cameras))]
    for file, image in zip(files, dataset["images"], strict=True):
        Image.fromarray(np.asarray(image)).save(folder / file)
    mask_files = [file.replace("images", "masks") for file in files if masks is not None]
    for file, mask in zip(mask_files, masks if masks is not None else (), strict=True):
        (folder / "masks").mkdir(exist_ok=True)
        write_mask(folder / file, np.asarray(mask) > 0)
    lenses = [
        Lens(int(width), int(height), *(float(x) for x in intrinsics))
        for (width, height), intrinsics in zip(cameras.image_sizes, cameras.intrinsics, strict=True)
    ]
    write_transforms_file(
        folder,
        files,
        lenses,
        np.asarray(cameras.poses, np.float64)[:, :3],
        (range(len(files)), ()),
        np.zeros((0, 3)),
        np.zeros((0, 3), np.uint8),
        masks=mask_files,
    )
