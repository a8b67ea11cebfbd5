"""Tidefield as a method of nerfstudio: `ns-train tidefield --data SCENE`, and ns-viewer, ns-render and ns-eval of it.

nerfstudio trains with what `tidefield train` trains with: the same batches, loss and learning rate. Photographs are
those of the scene (undistorted, with their exposure), not nerfstudio's. So ns-eval gives the PSNR of
`tidefield evaluate`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras as NerfstudioCameras
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from tidefield.baselines.export import pinholes
from tidefield.config import PRESETS
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.evaluation.metrics import psnr, psnr_from_mse
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.geometry.lenses import Lens
from tidefield.model.rendering import Render, to_8_bit
from tidefield.nerfstudio.data import PHOTOGRAPH, SceneOutputs, SceneParserConfig, to_nerfstudio
from tidefield.recording import moved
from tidefield.render.camera_paths import free_camera
from tidefield.train.checkpoint import given_or_shipped
from tidefield.train.loop import ADAM, SceneTrainer

STEPS = 2000
"""Of a training, if not given."""


@lru_cache(maxsize=1)
def open_scene(root: Path, width: int | None) -> Scene:
    """The scene, once for all who ask for it in a row."""
    return load_scene(root, width=width)


class SceneDataset(InputDataset):
    """Photographs of one part of a scene, undistorted, and their pinhole cameras.

    Args:
        outputs: of the data parser.
        width: of the photographs in pixels; None for their own.
        is_trained: a checkpoint is read into the model once it is made.
    """

    def __init__(self, outputs: SceneOutputs, width: int | None, is_trained: bool) -> None:
        super().__init__(outputs)
        self.scene = open_scene(outputs.metadata["root"], width)
        assert outputs.cameras.metadata is not None
        self.photographs: list[int] = outputs.cameras.metadata[PHOTOGRAPH][:, 0].tolist()
        own = self.scene.cameras[self.photographs]
        pose = own.T_world_camera.double().numpy()
        pose[:, :, 3] *= outputs.dataparser_scale
        self.cameras = to_nerfstudio(pose, pinholes(own), self.photographs)
        self.metadata = {"scene": self.scene, "scale": outputs.dataparser_scale, "is_trained": is_trained}

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        photographs, index = self.scene.photographs, self.photographs[image_idx]
        image = photographs[index]
        image = image if image_type == "uint8" else image.float() / 255
        mask = {"mask": photographs.used(index)[..., None]} if photographs.masks else {}
        return {"image_idx": image_idx, "image": image, **mask}


@dataclass
class SceneDataManagerConfig(FullImageDatamanagerConfig):
    """Photographs as Tidefield reads them."""

    _target: type = field(default_factory=lambda: SceneDataManager)
    dataparser: SceneParserConfig = field(default_factory=lambda: SceneParserConfig(load_3D_points=False))
    width: int | None = None
    """Width of the photographs in pixels; their own if not given."""


class SceneDataManager(FullImageDatamanager):
    """Gives the photographs that are compared with; those that are learned from the method draws itself."""

    config: SceneDataManagerConfig
    train_dataparser_outputs: SceneOutputs
    rays_per_batch = 0
    """Of the model's trainer, which sets it."""

    def create_train_dataset(self) -> SceneDataset:
        return self._dataset(self.train_dataparser_outputs)

    def create_eval_dataset(self) -> SceneDataset:
        return self._dataset(self.dataparser.get_dataparser_outputs(split=self.test_split))

    def _dataset(self, outputs: SceneOutputs) -> SceneDataset:
        # nerfstudio trains in the mode "val"; in others it reads a checkpoint.
        return SceneDataset(outputs, self.config.width, self.test_mode != "val")

    @cached_property
    def train_cameras(self) -> NerfstudioCameras:  # type: ignore[override]
        return self.train_dataset.cameras.to(self.device)

    def next_train(self, step: int) -> tuple[NerfstudioCameras, dict[str, Any]]:
        return self.train_cameras[:1], {}

    def get_train_rays_per_batch(self) -> int:
        return self.rays_per_batch


@dataclass
class TidefieldModelConfig(ModelConfig):
    """The network over neighbouring views."""

    _target: type = field(default_factory=lambda: TidefieldModel)
    enable_collider: bool = False
    preset: Literal["swift", "paper"] = "swift"
    """swift gives the best quality for the time; paper is the network as printed."""
    from_scratch: bool = False
    """Start from random weights instead of the installed trained ones."""
    weights: Path | None = None
    """Start from these weights, of `tidefield pretrain`."""
    seed: int = 0
    """Of the weights and of the order of the photographs."""


class TidefieldModel(Model):
    """A network, the trainer that draws its batches, and the renderer of its views."""

    config: TidefieldModelConfig

    def __init__(self, config: TidefieldModelConfig, metadata: dict[str, Any], device: Any, **given: Any) -> None:
        is_trained = bool(metadata.get("is_trained"))
        self._given = metadata["scene"], float(metadata["scale"]), torch.device(device), is_trained
        super().__init__(config, **given)

    def populate_modules(self) -> None:
        self.scene, self.scale, device, is_trained = self._given
        preset, weights = self.config.preset, None
        if not (self.config.from_scratch or is_trained):
            weights = given_or_shipped(self.config.weights, preset)
        self.trainer = SceneTrainer(PRESETS[preset], self.scene, self.config.seed, device, weights)
        self.network = self.trainer.network
        self._render: Render | None = None

    def get_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """One group, since nerfstudio clips each by itself; `NetworkAdam` splits it by the parameters' `share`."""
        for group in self.trainer.optimizer.param_groups:
            for parameter in group["params"]:
                parameter.share = group["share"]
        return {"network": list(self.network.parameters())}

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        optimizers, trainer = training_callback_attributes.optimizers, training_callback_attributes.trainer
        pipeline = training_callback_attributes.pipeline
        assert optimizers is not None
        assert trainer is not None
        assert pipeline is not None
        pipeline.datamanager.rays_per_batch = self.trainer.rays_per_step

        def set_rate(step: int) -> None:
            self.trainer.progress.step = step
            rate = self.trainer.rate(step / trainer.config.max_num_iterations) * self.trainer.learning_rate
            for group in optimizers.optimizers["network"].param_groups:
                group["lr"] = rate * group["share"]

        return [TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], set_rate)]

    def get_outputs(self, ray_bundle: NerfstudioCameras) -> dict[str, Any]:
        """In training, the loss of a batch; otherwise what a camera sees."""
        if not self.training:
            return self.get_outputs_for_camera(ray_bundle)
        self._render = None
        loss, error = self.trainer.loss(moved(self.trainer.draw(), self.trainer.device))
        return {"loss": loss, "error": error.detach()}

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: NerfstudioCameras, obb_box: Any = None) -> dict[str, torch.Tensor]:
        """Render a camera; a crop box is not applied.

        Returns:
            `rgb`, and `depth` (along the rays, in nerfstudio's units) and `accumulation`, each H x W x channels.
        """
        own = self.own_camera(camera.reshape((1,)))
        if self._render is None:
            self._render = self.trainer.renderer()
        view = self._render(own)
        per_depth = own.directions_world(pixel_grid(own.width, own.height)[None])[0].norm(dim=-1)
        depth = view.depth * per_depth.reshape(view.depth.shape) * self.scale
        found = {"rgb": view.colour, "depth": depth[..., None], "accumulation": view.opacity[..., None]}
        return {name: value.to(self.device) for name, value in found.items()}

    def own_camera(self, camera: NerfstudioCameras) -> Cameras:
        """Return a single camera of nerfstudio's as the scene has it: a photograph's own, or a free one."""
        if camera.camera_type.item() != CameraType.PERSPECTIVE.value:
            raise RunError("a camera of another kind than perspective was given: expected perspective; choose that")
        width, height = int(camera.width), int(camera.height)
        photograph = (camera.metadata or {}).get(PHOTOGRAPH)
        if photograph is not None:
            return self.scene.cameras[int(photograph)].resized(width, height)
        pose = camera.camera_to_worlds[0].double().cpu().numpy() * (1, -1, -1, 1)
        pose[:, 3] /= self.scale
        fx, fy, cx, cy = (float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
        return free_camera(self.scene, pose, Lens(width, height, fx, fy, cx, cy))

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Any]:
        error = outputs.get("error")
        return {} if error is None else {"psnr": psnr_from_mse(float(error))}

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: Any = None
    ) -> dict[str, torch.Tensor]:
        if "loss" in outputs:
            return {"loss": outputs["loss"]}
        return {"rgb_loss": (outputs["rgb"] - batch["image"]).square().mean()}

    def get_image_metrics_and_images(
        self, outputs: dict[str, Any], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, torch.Tensor]]:
        """Measure PSNR as `tidefield evaluate` does: of 8-bit images, without masked pixels."""
        truth = batch["image"].cpu()
        used = batch["mask"][..., 0].cpu() if "mask" in batch else torch.ones(truth.shape[:2], dtype=torch.bool)
        values = {"psnr": psnr(to_8_bit(outputs["rgb"].cpu()), to_8_bit(truth), used)}
        return values, {"img": torch.cat([truth, outputs["rgb"].cpu()], dim=1)}

    def get_rgba_image(self, outputs: dict[str, torch.Tensor], output_name: str = "rgb") -> torch.Tensor:
        return torch.cat([outputs[output_name], outputs["accumulation"]], dim=-1)


@dataclass
class NetworkAdam(OptimizerConfig):
    """Adam as `tidefield train` has it; the learning rate of each step is the trainer's."""

    lr: float = PRESETS["swift"].train.learning_rate
    eps: float = ADAM["eps"]
    betas: Sequence[float] = ADAM["betas"]
    max_norm: float | None = 1.0

    def setup(self, params: Sequence[torch.nn.Parameter]) -> torch.optim.Optimizer:
        """Make the optimiser, with the trainer's groups of parameters, one for each `share` of the learning rate."""
        groups = groupby(params, lambda parameter: parameter.share)
        return super().setup([{"params": list(members), "share": share} for share, members in groups])


METHOD = MethodSpecification(
    TrainerConfig(
        method_name="tidefield",
        max_num_iterations=STEPS,
        steps_per_save=500,
        steps_per_eval_batch=0,
        steps_per_eval_image=500,
        steps_per_eval_all_images=STEPS,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(datamanager=SceneDataManagerConfig(), model=TidefieldModelConfig()),
        optimizers={"network": {"optimizer": NetworkAdam(), "scheduler": None}},
        viewer=ViewerConfig(),
        vis="viewer",
    ),
    "Tidefield: the network over neighbouring views",
)
