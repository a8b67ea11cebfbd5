"""A stand-in for what `worker.py` uses of nerfstudio, with nerfstudio's conventions and defaults.

Its method knows that photographs show an upright wall, and learns the wall's colours from what it is given. So it
renders a camera right only if photographs and cameras reach it, and its answers come back, as nerfstudio has them.
`python nerfstudio_standin.py WORKER ...` runs the worker with it.
"""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

DEPTH = 5.0
"""z of the wall, as in `textured_wall`, which takes seconds to import."""
TRANSFORM = torch.tensor([[0.0, -1.0, 0.0, 0.3], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 1.0, 0.1]])
"""What the data parser makes of the world where it may turn and shift it."""


def defaults() -> Any:
    """The part of nerfacto's configuration that the worker knows."""
    model = SimpleNamespace(
        near_plane=0.05,
        far_plane=1000.0,
        background_color="last_sample",
        proposal_initial_sampler="piecewise",
        distortion_loss_mult=0.002,
        disable_scene_contraction=False,
        use_appearance_embedding=True,
        implementation="tcnn",
        eval_num_rays_per_chunk=1 << 15,
        camera_optimizer=SimpleNamespace(mode="SO3xR3"),
    )
    data = SimpleNamespace(train_num_rays_per_batch=4096, dataparser=None)
    config = SimpleNamespace(
        pipeline=SimpleNamespace(model=model, datamanager=data),
        machine=SimpleNamespace(),
        max_num_iterations=30000,
        load_checkpoint=None,
    )
    config.setup = lambda **_: Trainer(config)
    return config


def parser(data: Path, **options: Any) -> Any:
    """`NerfstudioDataParserConfig`."""
    given = {"orientation_method": "up", "center_method": "poses", "auto_scale_poses": True, "scene_scale": 1.0}
    return SimpleNamespace(data=data, **given | options)


def rays(T_world_camera: Tensor, fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> Tensor:
    """Unit directions of OpenGL's cameras: +x right, +y up, -z forward."""
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    xyz = torch.stack([(u - cx) / fx, -(v - cy) / fy, -torch.ones_like(u)], -1)
    return torch.nn.functional.normalize(xyz @ T_world_camera[:3, :3].T, dim=-1)


class Trainer:
    """nerfstudio's trainer, with its pipeline, data manager and model in one."""

    def __init__(self, config: Any) -> None:
        self.config, self.options, self.callbacks = config, config.pipeline.model, []
        self.pipeline = self.model = self.datamanager = self
        self.is_evaluating = False

    def setup(self) -> None:
        own = self.config.pipeline.datamanager.dataparser
        top = json.loads((own.data / "transforms.json").read_text())
        poses = {frame["file_path"]: torch.tensor(frame["transform_matrix"]) for frame in top["frames"]}
        may_turn = own.orientation_method != "none" and own.center_method != "none"
        transform = TRANSFORM if may_turn else torch.eye(4)[:3]
        scale = 0.25 if own.auto_scale_poses else 1.0
        self.train_dataparser_outputs = SimpleNamespace(dataparser_scale=scale, dataparser_transform=transform)
        lens = [top[name] for name in ("fl_x", "fl_y", "cx", "cy", "w", "h")]
        places, values = [], []
        for name in top["train_filenames"]:
            direction = rays(poses[name], *lens)
            reach = (DEPTH - poses[name][2, 3]) / direction[..., 2]
            places.append((poses[name][:3, 3] + reach[..., None] * direction)[..., :2].reshape(-1, 2))
            with Image.open(own.data / name) as picture:
                assert picture.mode == ("RGB" if self.options.background_color == "last_sample" else "RGBA")
                pixels = np.asarray(picture.convert("RGBA"), dtype=np.float32) / 255
            values.append(torch.from_numpy(pixels).reshape(-1, 4))
        self.places, self.values = torch.cat(places), torch.cat(values)

    def train(self) -> None:
        """Of the trainer and of the model, which nerfstudio calls alike."""
        if self.is_evaluating:
            self.is_evaluating = False
            return
        for step in range(self.config.max_num_iterations):
            for callback in self.callbacks:
                callback(step)
        self.save_checkpoint(self.config.max_num_iterations - 1)

    def eval(self) -> None:
        self.is_evaluating = True

    @property
    def checkpoint_dir(self) -> Path:
        return self.config.output_dir / self.config.experiment_name / "nerfacto" / self.config.timestamp

    def save_checkpoint(self, step: int) -> None:
        self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
        (self.checkpoint_dir / f"step-{step:09d}.ckpt").touch()

    def get_outputs_for_camera(self, camera: Any) -> dict[str, Tensor]:
        """Colour, distance and opacity of what lies on the wall, between near and far."""
        assert self.is_evaluating
        assert self.options.camera_optimizer.mode == "off"
        pose, outputs = camera.camera_to_worlds[0], self.train_dataparser_outputs
        lens = [getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")]
        turn, shift = outputs.dataparser_transform[:, :3], outputs.dataparser_transform[:, 3]
        position = turn.T @ (pose[:, 3] / outputs.dataparser_scale - shift)
        direction = rays(pose, *lens) @ turn
        reach = (DEPTH - position[2]) / direction[..., 2]
        xy = (position + reach[..., None] * direction)[..., :2].reshape(-1, 2)
        nearest = torch.cat([torch.cdist(part, self.places).argmin(1) for part in xy.split(512)])
        colour, alpha = self.values[nearest].reshape(*reach.shape, 4).split([3, 1], dim=-1)
        distance = reach[..., None] * outputs.dataparser_scale
        alpha = alpha * ((distance > self.options.near_plane) & (distance < self.options.far_plane))
        colour = colour * alpha + (1 - alpha) * float(self.options.background_color == "white")
        if self.options.use_appearance_embedding:
            colour = colour * torch.tensor([1.0, 0.8, 0.6])
        return {"rgb": colour, "depth": distance, "accumulation": alpha}


class Camera(SimpleNamespace):
    """`Cameras`."""

    def to(self, device: str) -> Camera:
        self.device = torch.device(device)
        return self


def install() -> None:
    """Make the modules that the worker imports."""
    contents = {
        "nerfstudio.configs.method_configs": {"method_configs": {"nerfacto": defaults()}},
        "nerfstudio.data.dataparsers.nerfstudio_dataparser": {"NerfstudioDataParserConfig": parser},
        "nerfstudio.engine.callbacks": {
            "TrainingCallback": lambda _, function: function,
            "TrainingCallbackLocation": SimpleNamespace(AFTER_TRAIN_ITERATION=0),
        },
        "nerfstudio.cameras.cameras": {"Cameras": Camera, "CameraType": SimpleNamespace(PERSPECTIVE=1)},
        "torchvision": {},
        "torchmetrics.image.lpip": {},
    }
    for name, values in contents.items():
        parts = name.split(".")
        for k in range(1, len(parts) + 1):
            module = sys.modules.setdefault(".".join(parts[:k]), ModuleType(parts[k - 1]))
            if k > 1:
                setattr(sys.modules[".".join(parts[: k - 1])], parts[k - 1], module)
        vars(sys.modules[name]).update(values)


if __name__ == "__main__":
    install()
    del sys.argv[0]
    runpy.run_path(sys.argv[0], run_name="__main__")
