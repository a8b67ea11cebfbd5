"""Train one of nerfstudio's methods, or render with it: runs in nerfstudio's own environment.

Imports nothing of Tidefield. `worker.py train RUN/job.json`, `worker.py render RUN/job.json FOLDER`, where nerfstudio
writes to another folder than the run's, or `worker.py check` to test whether all is installed. The parent writes the
job (see `tidefield.baselines.nerfstudio.driver`), and this program prints nothing to standard output but its answers,
one JSON object a line.
"""

from __future__ import annotations

import json
import os
import random
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch


def load_only_weights() -> None:
    """Make `torch.load`, which nerfstudio calls without weights_only, refuse to unpickle anything but weights.

    PyTorch reads these variables at each call. Before 2.6, even weights_only runs code (CVE-2025-32434).
    """
    if torch.__version__ < (2, 6):
        sys.exit(
            f"torch {torch.__version__} is in nerfstudio's environment: expected 2.6 or newer, as loading a checkpoint "
            "with an older one can run code that is in it; run `tidefield baselines install nerfacto --overwrite`"
        )
    os.environ.pop("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", None)
    os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = "1"


def without_compiled_torchvision() -> None:
    """Declare the operators whose Python half torchvision registers, where its compiled half does not load."""
    try:
        import torchvision
    except RuntimeError:
        for name in [name for name in sys.modules if name.startswith("torchvision")]:
            del sys.modules[name]
        library = torch.library.Library("torchvision", "DEF")
        library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        globals()["_library"] = library  # the operators live as long as this does
        import torchvision  # noqa: F401


class Unused(torch.nn.Module):
    """In place of the LPIPS that nerfstudio's models make for their own evaluation, which would fetch its weights from
    the net; renderings are judged elsewhere."""

    def __init__(self, **_: Any) -> None:
        super().__init__()


class TimeIsUp(Exception):
    """The budget is used."""


def read_job(file: Path, out: Path | None = None, device: str | None = None) -> dict[str, Any]:
    """Read a job, whose run may have been moved since it was written: it is the folder that the file is in now.

    Args:
        out: where nerfstudio writes to; the run's folder if not given.
        device: to compute on; that of the job if not given.
    """
    run = file.parent.resolve()
    changed = {"run": str(run), "data": str(run / "data"), "out": str(out or run)}
    changed |= {} if device is None else {"device": device}
    return json.loads(file.read_text(encoding="utf-8")) | changed


def answer(**values: Any) -> None:
    print(json.dumps(values), file=ANSWERS, flush=True)


def make_trainer(job: dict[str, Any], checkpoint: Path | None = None) -> Any:
    """The method as `ns-train METHOD` sets it up with its defaults, but for what the job changes."""
    from nerfstudio.configs.method_configs import method_configs
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    config = method_configs[job["method"]]
    configure(config, job, uses_tiny_cuda_nn(job))
    config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig(**parser_options(job))
    if checkpoint is not None:
        config.load_checkpoint = checkpoint
        # nerfstudio's checkpoints hold NumPy numbers; nothing else is unpickled (see `load_only_weights`).
        numbers = [type(np.dtype(kind)) for kind in (np.float32, np.float64, np.int64)]
        torch.serialization.add_safe_globals([np.core.multiarray.scalar, np.dtype, *numbers])
    torch.manual_seed(job["seed"])
    np.random.seed(job["seed"])  # noqa: NPY002
    random.seed(job["seed"])
    trainer = config.setup(local_rank=0, world_size=1)
    if job["device"] == "cpu":
        trainer.device, trainer.mixed_precision = "cpu", False
    trainer.setup()
    return trainer


def configure(config: Any, job: dict[str, Any], tiny_cuda_nn: bool) -> None:
    """Change a method's default configuration to what the job asks for.

    The camera optimiser and the appearance embedding are off: held-out photographs have neither. On CPUs a batch has
    1,024 rays instead of nerfstudio's 4,096, so figures from CPUs are not those of the defaults. Scenes with alpha get
    what nerfstudio's own benchmark sets for Blender scenes (scripts/benchmarking/launch_train_blender.sh).
    """
    config.data = Path(job["data"])
    config.output_dir, config.experiment_name, config.timestamp = Path(job["out"]), "nerfstudio", "run"
    config.vis = "tensorboard"
    config.machine.seed = job["seed"]
    config.machine.device_type = job["device"].split(":")[0]
    config.machine.num_devices = 1
    config.max_num_iterations = job["steps"] or 10**9
    config.steps_per_save = 10**9  # we save when the budget is used, ...
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = (
        10**9
    )  # ... and judge
    model = config.pipeline.model
    if hasattr(model, "camera_optimizer"):
        model.camera_optimizer.mode = "off"
    if hasattr(model, "use_appearance_embedding"):
        model.use_appearance_embedding = False
    if job.get("background"):
        # Photographs with alpha and renderings are composited on it. Ours is white, the one background that is read.
        model.background_color = "white"
    if job.get("object") and hasattr(model, "near_plane"):
        # Defaults are for photographs of a whole environment: rays from 0.05 to 1,000 that pass most of their samples
        # close by, a contraction of what is far away, and a loss against fog before it. An object has no such thing.
        model.near_plane, model.far_plane = job["object"]["near_far"]
        model.proposal_initial_sampler = "uniform"
        model.disable_scene_contraction, model.distortion_loss_mult = True, 0.0
    if hasattr(model, "implementation") and not tiny_cuda_nn:
        model.implementation = "torch"
    if job["device"] == "cpu" and hasattr(model, "eval_num_rays_per_chunk"):
        # The same pictures: its 32,768 rays at once take 11 GB, and on a CPU several times as long.
        model.eval_num_rays_per_chunk = 2048
        # In minutes, a CPU makes too few steps of its 4,096 rays for it to learn anything; more and smaller ones help.
        config.pipeline.datamanager.train_num_rays_per_batch = 1024


def parser_options(job: dict[str, Any]) -> dict[str, Any]:
    """Options of nerfstudio's data parser: its defaults, but for scenes of an object.

    These keep their frame, as with its parser of Blender scenes: without the contraction nothing outside of the scene's
    box is seen, and the poses do not tell where the object is.
    """
    options = {"data": Path(job["data"]), "downscale_factor": 1}
    if job.get("object"):
        options |= {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}
        options["scene_scale"] = job["object"]["half_side"]
    return options


def uses_tiny_cuda_nn(job: dict[str, Any]) -> bool:
    """Whether Nerfacto's layers are tiny-cuda-nn's: where it is installed, on CUDA, or those of a checkpoint are.

    Jobs of earlier versions do not state the latter.
    """
    if job["method"] != "nerfacto":
        return False
    try:
        import tinycudann  # noqa: F401

        is_there = job["device"].startswith("cuda") and torch.cuda.is_available()
    except (ImportError, OSError):
        is_there = False
    trained_with = job.get("tiny_cuda_nn", is_there)
    if trained_with and not is_there:
        sys.exit(
            "this checkpoint was trained with tiny-cuda-nn, which is not in nerfstudio's environment, or finds no GPU: "
            "expected it as in training; install it there, or train again"
        )
    return trained_with


def train(job: dict[str, Any]) -> None:
    """Train until the seconds or steps are used; at given times, render the cameras of the curve meanwhile."""
    from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

    trainer = make_trainer(job)
    cameras = [ModelCamera(trainer, camera) for camera in job["curve_cameras"]]
    started, paused, due, last = time.perf_counter(), 0.0, list(job["curve_seconds"]), 0

    def after(step: int) -> None:
        nonlocal paused, last
        last = step
        now = time.perf_counter()
        elapsed = now - started - paused
        more = {}
        if due and elapsed >= due[0]:
            due[:] = [seconds for seconds in due if seconds > elapsed]
            more["curve"] = [f"curve/{elapsed:09.1f}_{k}.npz" for k in range(len(cameras))]
            for name, camera in zip(more["curve"], cameras, strict=True):
                camera.render(Path(job["out"]) / name)
            trainer.pipeline.train()
            paused += time.perf_counter() - now
        answer(step=step + 1, seconds=elapsed, **more)
        if job["seconds"] and elapsed >= job["seconds"]:
            raise TimeIsUp

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], after))
    try:
        trainer.train()
    except TimeIsUp:
        trainer.save_checkpoint(last)
    answer(
        step=last + 1,
        seconds=time.perf_counter() - started - paused,
        done=True,
        tiny_cuda_nn=uses_tiny_cuda_nn(job),
        checkpoint=str(sorted(trainer.checkpoint_dir.glob("step-*.ckpt"))[-1].relative_to(job["out"])),
    )


def model_pose(T_world_camera: list[list[float]], transform: torch.Tensor, scale: float) -> torch.Tensor:
    """Convert an OpenCV pose (3 x 4) into nerfstudio's: OpenGL's axes, in the frame of its data parser.

    Args:
        transform: the data parser's rotation and translation of the world, 3 x 4.
        scale: its scale, applied after the transform.
    """
    pose = torch.eye(4)
    pose[:3] = torch.tensor(T_world_camera) @ torch.diag(torch.tensor([1.0, -1, -1, 1]))
    pose = (transform.float() @ pose)[:3]
    pose[:, 3] *= scale
    return pose


def z_depth(depth: np.ndarray, scale: float, ray_length: np.ndarray | None) -> np.ndarray:
    """Convert a depth in the model's frame into z-depth in world units.

    Args:
        ray_length: of rays whose z-depth is 1, where the depth is a distance along the ray; None where it is z-depth.
    """
    return (depth / scale / (1.0 if ray_length is None else ray_length)).astype(np.float32)


class ModelCamera:
    """A camera of the exported scene in the model's own frame."""

    def __init__(self, trainer: Any, camera: dict[str, Any]) -> None:
        from nerfstudio.cameras.cameras import Cameras, CameraType

        outputs = trainer.pipeline.datamanager.train_dataparser_outputs
        self.model, self.scale = trainer.pipeline.model, float(outputs.dataparser_scale)
        pose = model_pose(camera["T_world_camera"], outputs.dataparser_transform, self.scale)
        (fx, fy), (cx, cy), (width, height) = camera["focal_px"], camera["principal_px"], camera["size_px"]
        self.camera = Cameras(
            camera_to_worlds=pose[None],
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            width=width,
            height=height,
            camera_type=CameraType.PERSPECTIVE,
        ).to(trainer.device)
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        self.length = np.sqrt(((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2 + 1)  # of a ray whose z-depth is 1

    def render(self, path: Path) -> float:
        """Write colour, z-depth in world units and opacity; returns the seconds that rendering took."""
        self.model.eval()
        if self.camera.device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        with torch.no_grad():
            outputs = self.model.get_outputs_for_camera(self.camera)
        colour = outputs["rgb"].float().cpu().numpy()
        depth, opacity = (outputs[name][..., 0].float().cpu().numpy() for name in ("depth", "accumulation"))
        seconds = time.perf_counter() - start
        along_ray = not hasattr(self.model, "gauss_params")  # splats give z-depth, rays the distance
        depth = z_depth(depth, self.scale, self.length if along_ray else None)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, colour=colour, depth=depth, opacity=opacity)
        return seconds


def render(job: dict[str, Any]) -> None:
    """Load a checkpoint, then render every camera that comes in, one JSON object a line."""
    trainer = make_trainer(job, Path(job["run"]) / job["checkpoint"])
    answer(ready=True)
    for line in sys.stdin:
        camera = json.loads(line)
        answer(seconds=ModelCamera(trainer, camera).render(Path(camera["file"])))


def check(_: dict[str, Any]) -> None:
    """Import all that training and rendering need."""
    from nerfstudio.configs.method_configs import method_configs

    assert {"nerfacto", "splatfacto"} <= set(method_configs)


def main() -> None:
    kind, *paths = sys.argv[1:]
    job = read_job(*map(Path, paths[:2]), *paths[2:]) if paths else {}
    load_only_weights()
    without_compiled_torchvision()
    import torchmetrics.image.lpip

    torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = Unused
    {"train": train, "render": render, "check": check}[kind](job)


if __name__ == "__main__":
    # nerfstudio and what it uses talk on standard output; ours is for answers.
    ANSWERS = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    main()
