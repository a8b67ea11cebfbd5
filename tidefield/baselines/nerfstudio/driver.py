"""Train and render with nerfstudio's methods: write it a scene, and be the other end of `worker.py`'s lines.

RUN/data/ is the scene as nerfstudio reads it, RUN/nerfstudio/ what nerfstudio writes, RUN/job.json its job.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from tidefield.baselines.export import at_common_exposure, exposure_factor, point_colours
from tidefield.baselines.nerfstudio.environment import WORKER, python
from tidefield.config import Budget, Range, from_json
from tidefield.data.images import write_mask
from tidefield.data.readers.transforms import write_transforms_file
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.evaluation.curves import SHARES, QualityCurve
from tidefield.files import delete_files, read_json, write_json
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.lenses import Lens
from tidefield.model.rendering import Render, Rendering
from tidefield.processes import end_with_parent
from tidefield.train.checkpoint import TrainingProgress

NerfstudioMethod = Literal["nerfacto", "splatfacto"]
JOB_FILE, LOG_FILE, DATA, CURVE = "job.json", "nerfstudio.log", "data", "curve"
KEEP_LARGE_ALLOCATIONS = {"MALLOC_TRIM_THRESHOLD_": str(1 << 30), "MALLOC_MMAP_THRESHOLD_": str(1 << 30)}
"""What `tidefield.machine.tune_process` does for us, as glibc takes it from the environment."""
END_SECONDS = 30
"""A worker may take so long to end."""
_TRAINED = tuple[Annotated[int, Range(0, (1 << 63) - 1)], Annotated[float, Range(0, 1e12)]]
_FACTOR = tuple[(Annotated[float, Range(1e-9, 1)],) * 3]
"""Types of what job.json holds."""


def delete_training(folder: Path) -> None:
    """Delete what training in a run's folder has left."""
    names = (
        JOB_FILE,
        LOG_FILE,
        "rendering.npz",
        f"{DATA}/transforms.json",
        f"{DATA}/*.ply",
        f"{DATA}/images/?????.png",
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
    factor = export(scene, folder / DATA)
    seconds = None if budget.minutes is None else 60 * budget.minutes
    job = {
        "method": method,
        "data": str((folder / DATA).resolve()),
        "out": str(folder.resolve()),
        "steps": budget.steps,
        "seconds": seconds,
        "seed": seed,
        "device": str(device),
        "curve_seconds": [share * seconds for share in SHARES] if curve and seconds else [],
        "curve_cameras": [camera_to_json(camera) for camera in curve.cameras] if curve else [],
        "factor": factor.tolist(),
    }
    write_json(folder / JOB_FILE, job)
    last: dict[str, Any] = {}
    with _worker("train", folder) as worker:
        for last in worker.lines():
            if "curve" in last and curve is not None:
                files = [folder / name for name in last["curve"]]
                views = zip(files, curve.cameras, strict=True)
                curve.add(last["seconds"], [read_rendering(file, camera, factor) for file, camera in views])
                curve.write(folder)
            progress(last["step"], last["seconds"])
    if not last.get("done"):
        raise _failed(folder)
    write_json(folder / JOB_FILE, {**job, "checkpoint": last["checkpoint"], "trained": [last["step"], last["seconds"]]})
    return progress_of(folder)


def require(method: NerfstudioMethod, device: torch.device) -> None:
    """Raises: RunError when the method cannot be trained here."""
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
def renderer(folder: Path) -> Iterator[Render]:
    """A trained run as a method, while the block lasts.

    Raises:
        RunError: nerfstudio is not installed, or fails.
    """
    factor = torch.tensor(_read_job(folder)[1])
    with _worker("render", folder) as worker:
        worker.answer()  # once it has loaded

        def render(camera: Cameras) -> Rendering:
            file = folder / "rendering.npz"
            worker.ask({**camera_to_json(camera), "file": str(file.resolve())})
            return read_rendering(file, camera, factor)

        yield render


def read_rendering(file: Path, camera: Cameras, factor: torch.Tensor) -> Rendering:
    """What the worker wrote, at the camera's own gain."""
    with np.load(file, allow_pickle=False) as values:
        colour, depth, opacity = (torch.from_numpy(values[name]) for name in ("colour", "depth", "opacity"))
    file.unlink()
    return Rendering((colour / factor * camera.gain[0]).clamp(0, 1), depth, opacity.clamp(0, 1))


class _Process:
    """The worker's lines."""

    def __init__(self, process: subprocess.Popen[str], folder: Path) -> None:
        self.process, self.folder = process, folder

    def lines(self) -> Iterator[dict[str, Any]]:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            yield json.loads(line)

    def answer(self) -> dict[str, Any]:
        found = next(self.lines(), None)
        if found is None:
            raise _failed(self.folder)
        return found

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(question) + "\n")
        self.process.stdin.flush()
        return self.answer()


@contextmanager
def _worker(kind: Literal["train", "render"], folder: Path) -> Iterator[_Process]:
    command = [str(python()), str(WORKER), kind, str(folder / JOB_FILE)]
    with (folder / LOG_FILE).open("a", encoding="utf-8") as log:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env={**os.environ, **KEEP_LARGE_ALLOCATIONS},
            preexec_fn=end_with_parent,
        )
        try:
            yield _Process(process, folder)
        finally:
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None, "both are asked for"
                pipe.close()
            try:
                # With its input at its end it stops, and stops the processes that nerfstudio has started.
                process.wait(timeout=END_SECONDS if kind == "render" else None)
            except subprocess.TimeoutExpired:
                process.terminate()
                process.wait()


def _failed(folder: Path) -> RunError:
    tail = (folder / LOG_FILE).read_text(encoding="utf-8").strip().splitlines()[-1:]
    return RunError(
        f"nerfstudio ended before it was done ({tail[0] if tail else 'no message'}): expected it to train and "
        f"render; read {folder / LOG_FILE}"
    )


def _read_job(folder: Path) -> tuple[tuple[int, float], tuple[float, ...]]:
    """Steps and seconds of a training that is complete, and the factor of its scene."""
    path = folder / JOB_FILE
    job = read_json(path) or {}
    if not isinstance(job, dict):
        raise RunError(f"{path} is damaged: expected what training wrote; train it with --overwrite")
    if "trained" not in job:
        raise RunError(f"{folder} has not been trained to its end: expected a checkpoint; train it with --overwrite")
    factor = from_json(_FACTOR, job.get("factor"), f"{path}: factor")
    return from_json(_TRAINED, job["trained"], f"{path}: trained"), factor


def export(scene: Scene, folder: Path) -> Float[torch.Tensor, "3"]:
    """Write photographs and masks (PNG, undistorted, at the scene's size), transforms.json and the sparse points.

    Photographs are at the common exposure, as all other methods see them, times a factor that avoids clipping.

    Returns:
        The factor: renderings divided by it are at the common exposure.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    cameras, files = scene.cameras, [f"images/{index:05d}.png" for index in range(len(scene.names))]
    factor = exposure_factor(scene, range(len(files)))
    for index, file in enumerate(files):
        Image.fromarray(at_common_exposure(scene, index, factor)).save(folder / file)
    masks = [f"masks/{index:05d}.png" for index in range(len(files)) if scene.photographs.masks]
    for index, mask in enumerate(masks):
        write_mask(folder / mask, scene.photographs.used(index).numpy())
    columns = torch.cat([cameras.size_px, cameras.focal_px, cameras.principal_px], dim=1).tolist()
    lenses = [Lens(round(w), round(h), fx=fx, fy=fy, cx=cx, cy=cy) for w, h, fx, fy, cx, cy in columns]
    points = scene.points
    write_transforms_file(
        folder,
        files,
        lenses,
        cameras.T_world_camera[:, :3].double().numpy(),
        (scene.train, scene.test),
        np.zeros((0, 3)) if points is None else points.xyz_world.double().numpy(),
        point_colours(scene),
        masks=masks,
        overwrite=True,
    )
    return factor


def camera_to_json(camera: Cameras) -> dict[str, Any]:
    """Describe one camera for the worker."""
    names = ("T_world_camera", "focal_px", "principal_px", "size_px")
    return {name: getattr(camera, name)[0].tolist() for name in names}
