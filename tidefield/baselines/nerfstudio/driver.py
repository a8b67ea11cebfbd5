"""Train and render with nerfstudio's methods: write it a scene, and be the other end of `worker.py`'s lines.

RUN/data/ is the scene as nerfstudio reads it, RUN/nerfstudio/ what nerfstudio writes, RUN/job.json its job. Rendering
changes nothing in RUN.
"""

from __future__ import annotations

import itertools
import json
import logging
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from tidefield.baselines.export import at_common_exposure, exposure_factor, pinholes, point_colours
from tidefield.baselines.job_file import JOB_FILE, failure, read_job
from tidefield.baselines.nerfstudio.environment import WORKER, python, without_our_python
from tidefield.config import Budget, Range, from_json
from tidefield.data.pictures import write_mask
from tidefield.data.readers.transforms import write_transforms_file
from tidefield.data.scene import Scene
from tidefield.device import environment_of
from tidefield.errors import RunError
from tidefield.evaluation.curves import SHARES, QualityCurve
from tidefield.files import delete_files, write_json
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Render, Rendering
from tidefield.processes import end_with_parent
from tidefield.train.checkpoint import TrainingProgress

log = logging.getLogger(__name__)

NerfstudioMethod = Literal["nerfacto", "splatfacto"]
LOG_FILE, DATA, CURVE = "nerfstudio.log", "data", "curve"
KEEP_LARGE_ALLOCATIONS = {"MALLOC_TRIM_THRESHOLD_": str(1 << 30), "MALLOC_MMAP_THRESHOLD_": str(1 << 30)}
"""What `tidefield.machine.tune_process` does for us, as glibc takes it from the environment."""
END_SECONDS = 30
"""Time limit for a worker that renders to end."""
SAID_LINES = 20
"""Of what a worker said before it failed to render, which are shown."""
_BACKGROUND = tuple[(Annotated[float, Range(0, 1)],) * 3]
"""Type of the colour behind objects in job.json."""


@dataclass(frozen=True)
class Colours:
    """What the colours of an exported scene are, for the way back.

    Attributes:
        factor: renderings divided by it are at the common exposure.
        background_rgb: what they are composited on; None where photographs have no alpha.
    """

    factor: Float[torch.Tensor, "3"]
    background_rgb: tuple[float, ...] | None


def delete_training(folder: Path) -> None:
    """Delete what training in a run's folder has left."""
    names = (
        JOB_FILE,
        LOG_FILE,
        f"{DATA}/transforms.json",
        f"{DATA}/*.ply",
        f"{DATA}/images/?????.png",
        f"{DATA}/masks/?????.png",
    )
    found = (folder.glob(name) for name in (*names, f"{CURVE}/*.npz", "nerfstudio/*/run/**/*"))
    if (folder / JOB_FILE).exists():
        delete_files(folder, itertools.chain.from_iterable(found))


def train(
    method: NerfstudioMethod,
    scene: Scene,
    folder: Path,
    budget: Budget,
    seed: int,
    device: torch.device,
    curve: QualityCurve | None,
    progress: Callable[[int, float], object],
) -> TrainingProgress:
    """Train with nerfstudio's defaults, without the camera optimiser and the appearance embedding.

    On CPUs a batch has 1,024 rays instead of the default 4,096 (see `worker.configure`).

    Args:
        method: by nerfstudio's name.
        scene: exported into the run's folder.
        folder, budget, seed, device: of the run.
        curve: what to render and judge meanwhile, if the budget is one of minutes; training's clock stands still then.
        progress: called with steps done and seconds of training.

    Raises:
        RunError: nerfstudio is not installed, the method does not run on the device, or nerfstudio fails.
    """
    require(method, device)
    write_json(folder / JOB_FILE, {"method": method})  # from now on `delete_training` finds what is written
    colours = export(scene, folder / DATA)
    seconds = None if budget.minutes is None else 60 * budget.minutes
    job = {
        "method": method,
        "steps": budget.steps,
        "seconds": seconds,
        "seed": seed % (1 << 32),  # more than this NumPy does not take
        "device": str(device),
        "curve_seconds": [share * seconds for share in SHARES] if curve and seconds else [],
        "curve_cameras": [camera_to_json(camera) for camera in curve.cameras] if curve else [],
        "factor": colours.factor.tolist(),
        "background": colours.background_rgb,
        "object": object_limits(scene),
    }
    write_json(folder / JOB_FILE, job)
    last: dict[str, Any] = {}
    with _worker(["train", folder / JOB_FILE], folder / LOG_FILE, device) as worker:
        for last in worker.lines():
            if "curve" in last and curve is not None:
                files = [folder / name for name in last["curve"]]
                views = zip(files, curve.cameras, strict=True)
                curve.add(last["seconds"], [read_rendering(file, camera, colours) for file, camera in views])
                curve.write(folder)
            progress(last["step"], last["seconds"])
    if not last.get("done"):
        raise failure("nerfstudio", folder / LOG_FILE, "train and render")
    job |= {name: last[name] for name in ("checkpoint", "tiny_cuda_nn") if name in last}
    write_json(folder / JOB_FILE, {**job, "trained": [last["step"], last["seconds"]]})
    return progress_of(folder)


def require(method: NerfstudioMethod, device: torch.device) -> None:
    """Raises: RunError when the method does not run on a device, or nerfstudio is not installed."""
    if method == "splatfacto" and device.type != "cuda":
        raise RunError(
            f"splatfacto was asked for on {device}: expected CUDA, its only device; leave it out, or --device"
        )
    python()


def progress_of(folder: Path) -> TrainingProgress:
    """How far a run has trained.

    Raises:
        RunError: not to its end.
    """
    step, seconds = _read_job(folder)[0]
    return TrainingProgress(step, seconds)


@contextmanager
def renderer(folder: Path, device: torch.device) -> Iterator[Render]:
    """A trained run as a method, while the block lasts.

    Args:
        folder: of the run.
        device: to render on.

    Raises:
        RunError: nerfstudio is not installed, or fails, or the method does not run on the device.
    """
    _, colours, job = _read_job(folder)
    if job.get("method") == "splatfacto":
        require("splatfacto", device)
    if job.get("tiny_cuda_nn") and device.type != "cuda":
        raise RunError(
            f"{folder} was trained with tiny-cuda-nn, whose layers run on CUDA alone: expected --device cuda, got "
            f"{device}; render it there, or train it again on {device} with --overwrite"
        )
    with ExitStack() as stack:
        own = Path(stack.enter_context(TemporaryDirectory()))
        file = own / "rendering.npz"
        worker = stack.enter_context(_worker(["render", folder / JOB_FILE, own, device], own / LOG_FILE, device))
        worker.answer()  # once it has loaded

        def render(camera: Cameras) -> Rendering:
            answer = worker.ask({**camera_to_json(camera), "file": str(file)})
            return replace(read_rendering(file, camera, colours), seconds=float(answer["seconds"]))

        yield render


def read_rendering(file: Path, camera: Cameras, colours: Colours) -> Rendering:
    """What the worker wrote, at the camera's own gain; the background has none."""
    with np.load(file, allow_pickle=False) as values:
        colour, depth, opacity = (torch.from_numpy(values[name]) for name in ("colour", "depth", "opacity"))
    file.unlink()
    opacity = opacity.clamp(0, 1)
    behind = (1 - opacity[..., None]) * torch.tensor(colours.background_rgb or (0.0, 0.0, 0.0))
    colour = (colour - behind) / colours.factor * camera.gain_of_rows() + behind
    return Rendering(colour.clamp(0, 1), depth, opacity)


class _Process:
    """The worker's lines."""

    def __init__(self, process: subprocess.Popen[str], log_file: Path) -> None:
        self.process, self.log_file = process, log_file

    def lines(self) -> Iterator[dict[str, Any]]:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            yield json.loads(line)

    def answer(self) -> dict[str, Any]:
        found = next(self.lines(), None)
        if found is None:
            said = self.log_file.read_text(encoding="utf-8", errors="replace").splitlines()
            log.error("\n".join(said[-SAID_LINES:]))
            raise RunError("nerfstudio ended before it was done: expected it to render; read what it says above")
        return found

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # it has ended, which `answer` reports
            self.process.stdin.write(json.dumps(question) + "\n")
            self.process.stdin.flush()
        return self.answer()


@contextmanager
def _worker(words: Sequence[str | Path | torch.device], log_file: Path, device: torch.device) -> Iterator[_Process]:
    command = [str(python()), str(WORKER), *map(str, words)]
    with log_file.open("a", encoding="utf-8") as said:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            text=True,
            env=without_our_python(environment_of(device)) | KEEP_LARGE_ALLOCATIONS,
            preexec_fn=end_with_parent,
        )
        try:
            yield _Process(process, log_file)
        finally:
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None, "both are asked for"
                with suppress(BrokenPipeError):  # a question that was not read is still to be written
                    pipe.close()
            try:
                # With its input at its end it stops, and stops the processes that nerfstudio has started.
                process.wait(timeout=END_SECONDS if words[0] == "render" else None)
            except subprocess.TimeoutExpired:
                process.terminate()
                process.wait()


def _read_job(folder: Path) -> tuple[tuple[int, float], Colours, dict[str, Any]]:
    """Steps and seconds of a training that is complete, the colours of its scene, and the whole job."""
    path = folder / JOB_FILE
    job = read_job(path, "a checkpoint")
    # Of version 0.1, which exported no alpha, there is none.
    background = job.get("background") and from_json(_BACKGROUND, job["background"], f"{path}: background")
    return job["trained"], Colours(torch.tensor(job["factor"]), background), job


def export(scene: Scene, folder: Path) -> Colours:
    """Write photographs and masks (PNG, undistorted, at the scene's size), transforms.json and the sparse points.

    Photographs are at the common exposure, as all other methods see them, times a factor that keeps those for training
    from clipping. Those of a scene with alpha have it, and colours that are not multiplied by it, as nerfstudio reads
    them.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    cameras, files = scene.cameras, [f"images/{index:05d}.png" for index in range(len(scene.names))]
    colours = Colours(exposure_factor(cameras[list(scene.train)]), scene.background_rgb)
    for index, file in enumerate(files):
        Image.fromarray(at_common_exposure(scene, index, colours.factor, with_alpha=True)).save(folder / file)
    masks = [f"masks/{index:05d}.png" for index in range(len(files)) if scene.photographs.masks]
    for index, mask in enumerate(masks):
        write_mask(folder / mask, scene.photographs.used(index).numpy())
    points = scene.points
    write_transforms_file(
        folder,
        files,
        pinholes(cameras),
        cameras.T_world_camera[:, :3].double().numpy(),
        (scene.train, scene.test),
        np.zeros((0, 3)) if points is None else points.xyz_world.double().numpy(),
        point_colours(scene, colours.factor),
        masks=masks,
        overwrite=True,
    )
    return colours


def object_limits(scene: Scene) -> dict[str, Any] | None:
    """Where the object of a scene with alpha is: the ends of rays, and half the side of a box around the origin.

    None where no visual hull tells of it. The ends are distances along the rays, which are longer than depths.
    """
    if scene.hull is None:
        return None
    cameras, hull = scene.cameras, scene.hull
    corners = cameras.size_px[:, None] * torch.tensor([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    longest = cameras.directions_world(corners).norm(dim=-1).amax(1)
    box = torch.stack([hull.corner_world, hull.corner_world + hull.voxel_world * torch.tensor(hull.filled.shape)])
    return {
        "near_far": [float(cameras.near_far[:, 0].min()), float((cameras.near_far[:, 1] * longest).max())],
        "half_side": float(box.abs().max()),
    }


def camera_to_json(camera: Cameras) -> dict[str, Any]:
    """Describe one camera for the worker."""
    names = ("T_world_camera", "focal_px", "principal_px", "size_px")
    return {name: getattr(camera, name)[0].tolist() for name in names}
