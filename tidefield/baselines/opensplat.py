"""Train with OpenSplat, the program that the user has installed, and render what it trains.

What is relied on of OpenSplat, as its source says (https://github.com/pierotofy/OpenSplat, revision 5400876):

- `--version` prints the version. An unknown option, as any error, gives a status other than 0.
- A folder with transforms.json is nerfstudio's: poses have OpenGL's axes. All frames are trained on, whatever
  `train_filenames` says. Masks are not read. Sparse points are needed. A calibration at the top is cut to whole
  numbers; one of each frame is not.
- On CPUs the principal point is the middle of the photograph, whatever the calibration says.
- With `--keep-crs`, centres and scales are written in the frame of the poses. Training does not turn that frame, so
  harmonics are of directions in it.
- `-n` is the number of steps, 30,000 if not given. The learning rate falls by it, and splitting stops half-way.
- `--save-every K -o NAME.ply` writes NAME_K.ply, NAME_2K.ply, ..., and at the end NAME.ply.
- "Step N: LOSS" is printed before the save of step N: each step on CPUs, each tenth on GPUs.
- What no Gaussian covers has the colour `BACKGROUND_RGB`, in training too.
- It takes no seed.

RUN/opensplat/ holds the scene as OpenSplat reads it (data/), what it prints (log), its splats and job.json.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from jaxtyping import Float
from PIL import Image

from tidefield.baselines.export import at_common_exposure, exposure_factor, point_colours
from tidefield.baselines.job_file import JOB_FILE, failure, read_job
from tidefield.baselines.splats import Splats, read_splats, render_splats
from tidefield.config import Budget, Range, from_json
from tidefield.data.readers.transforms import write_transforms_file
from tidefield.data.scene import Scene
from tidefield.device import environment_of
from tidefield.errors import RunError, SceneError
from tidefield.evaluation.curves import SHARES, QualityCurve
from tidefield.files import delete_files, write_json
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.lenses import Lens
from tidefield.model.rendering import Render, Rendering
from tidefield.processes import end_with_parent
from tidefield.train.checkpoint import TrainingProgress

VARIABLE = "TIDEFIELD_OPENSPLAT"
"""The environment variable that names the program."""
OLDEST = (1, 1)
STEPS = 30_000
"""OpenSplat's default."""
SAVE_EVERY_CPU, SAVE_EVERY_GPU = 10, 100
"""Steps between saves where the budget is one of minutes: what was trained after the last is lost."""
BACKGROUND_RGB = (0.6130, 0.0101, 0.3984)
"""Behind all Gaussians: those are trained to look right before it."""
FOLDER, LOG_FILE, SPLATS_FILE = "opensplat", "log", "splat.ply"
VERSION_SECONDS, END_SECONDS = 60, 30
"""Time limits: for printing its version, and for ending after SIGTERM."""
LEAST_POINTS = 4
"""OpenSplat's first Gaussians are as large as the distances to their three nearest neighbours."""
_SHIFTS = tuple[tuple[(Annotated[float, Range(-1, 1)],) * 4], ...]


def find(given: Path | None) -> Path:
    """The program: the given one, or else $TIDEFIELD_OPENSPLAT, or else `opensplat` of PATH.

    Raises:
        RunError: there is none.
    """
    named = given or os.environ.get(VARIABLE)
    found = shutil.which(os.path.abspath(named) if named else "opensplat")
    if found is None:
        where = f"{named} is no program" if named else "there is no program opensplat on PATH"
        raise RunError(
            f"{where}: expected OpenSplat, which is not part of Tidefield; build it "
            "(https://github.com/pierotofy/OpenSplat) and name the program with --opensplat"
        )
    return Path(found)


def version(program: Path) -> str:
    """The program's version.

    Raises:
        RunError: it does not start, or is too old.
    """
    try:
        ended = subprocess.run([program, "--version"], capture_output=True, timeout=VERSION_SECONDS, check=False)
        lines = (ended.stdout if ended.returncode == 0 else ended.stderr).decode(errors="replace").strip().splitlines()
    except (OSError, subprocess.TimeoutExpired) as error:
        lines = [str(error)]
    said = lines[0][:80] if lines else "nothing"
    numbers = re.match(r"v?(\d+)\.(\d+)", said)
    if numbers is None or tuple(map(int, numbers.groups())) < OLDEST:
        raise RunError(
            f"{program} --version says {said!r}: expected {'.'.join(map(str, OLDEST))} or newer of OpenSplat; build "
            "a newer one, or name another with --opensplat"
        )
    return said


def delete_training(folder: Path) -> None:
    """Delete what training in a run's folder has left."""
    out = folder / FOLDER
    names = (
        JOB_FILE,
        LOG_FILE,
        "splat*.ply",
        "cameras.json",
        "data/transforms.json",
        "data/*.ply",
        "data/images/?????.png",
    )
    if (out / JOB_FILE).exists():
        delete_files(folder, [file for name in names for file in out.glob(name)])


@dataclass(frozen=True)
class _Save:
    """Splats on disk: after how many steps, and how many seconds of training."""

    step: int
    seconds: float
    file: Path


def train(
    program: Path,
    scene: Scene,
    folder: Path,
    budget: Budget,
    device: torch.device,
    curve: QualityCurve | None,
    progress: Callable[[int, float], object],
) -> TrainingProgress:
    """Train with OpenSplat's defaults.

    The clock starts at the first step that is reported: reading the scene is not counted, saving is. Minutes end
    training, of which the last save counts, unless OpenSplat's default number of steps is made before.

    Args:
        program: OpenSplat.
        scene: exported into the run's folder.
        folder, budget, device: of the run.
        curve: what to render and judge of some saves, after training, if the budget is one of minutes.
        progress: called with steps done and seconds of training.

    Raises:
        SceneError: the scene has no sparse points.
        RunError: OpenSplat fails, has no GPU, or saves nothing within the budget.
    """
    out = folder / FOLDER
    out.mkdir(exist_ok=True)
    job: dict[str, Any] = {"factor": None}
    write_json(out / JOB_FILE, job)
    factor = export(scene, out / "data")
    shifts = half_pixel_shifts(scene.cameras[list(scene.train)])
    seconds = None if budget.minutes is None else 60 * budget.minutes
    steps = budget.steps or STEPS
    every = SAVE_EVERY_CPU if device.type == "cpu" else SAVE_EVERY_GPU
    words = [str((out / "data").resolve()), "-o", str((out / SPLATS_FILE).resolve()), "-n", str(steps)]
    words += ["--downscale-factor", "1", "--keep-crs", *["--cpu"] * (device.type == "cpu")]
    words += [] if seconds is None else ["--save-every", str(every)]
    saves: list[_Save] = []
    due = [share * seconds for share in SHARES] if curve and seconds else []
    step, start, elapsed, is_over = 0, 0.0, 0.0, False
    with _running(program, words, device) as process:
        for line in _lines(process, out):
            if device.type != "cpu" and line.startswith("Using CPU"):
                raise RunError(f"{program} does not find {device}: expected it to be built for GPUs; use --device cpu")
            reported = re.match(r"Step (\d{1,18}):", line)
            if reported is None:
                continue
            before, now = elapsed, time.perf_counter()
            start = now if step == 0 else start
            step, elapsed = int(reported[1]), now - start
            progress(step, elapsed)
            due = _keep_saves(saves, _complete(out, step), before, due)
            if seconds is not None and elapsed >= seconds:
                is_over = True
                break
        else:
            elapsed = time.perf_counter() - start if step else 0.0
            process.wait()
    if not is_over:
        if process.returncode or not (out / SPLATS_FILE).is_file():
            raise failure("OpenSplat", out / LOG_FILE, "train")
        saves.append(_Save(steps, elapsed, out / SPLATS_FILE))
    elif not saves:
        raise RunError(
            f"OpenSplat made {step} steps in {elapsed:.0f} s, and saves after {every}: expected a save within the "
            "budget; give more --minutes, or --steps, or a smaller --width"
        )
    last = saves[-1]
    if curve is not None and seconds is not None:
        for save in saves:
            splats = read_splats(save.file)
            curve.add(save.seconds, [_render(splats, camera, factor, shifts, device) for camera in curve.cameras])
            curve.write(folder)
    else:
        read_splats(last.file)  # damaged ones are reported now
    last.file.replace(out / SPLATS_FILE)
    delete_files(folder, out.glob("splat_*.ply"))
    trained = [last.step, last.seconds]
    write_json(out / JOB_FILE, {"factor": factor.tolist(), "shifts": shifts.tolist(), "trained": trained})
    progress(last.step, last.seconds)
    return progress_of(folder)


def _complete(out: Path, step: int) -> dict[int, Path]:
    """Splats by their steps that were saved before a later step was reported, so are complete."""
    stem = SPLATS_FILE.removesuffix(".ply")
    numbered = {file: re.fullmatch(rf"{stem}_(\d{{1,18}})\.ply", file.name) for file in out.glob(f"{stem}_*.ply")}
    return {int(found[1]): file for file, found in numbered.items() if found and int(found[1]) < step}


def _keep_saves(saves: list[_Save], found: dict[int, Path], seconds: float, due: list[float]) -> list[float]:
    """Add new saves; delete the last before them unless a time of the curve was due with it. Returns what is due."""
    for step in sorted(set(found) - {save.step for save in saves}):
        was_due = len(saves) > 0 and due and saves[-1].seconds >= due[0]
        if was_due:
            due = [later for later in due if later > saves[-1].seconds]
        elif saves:
            saves.pop().file.unlink()
        saves.append(_Save(step, seconds, found[step]))
    return due


@contextmanager
def _running(program: Path, words: list[str], device: torch.device) -> Iterator[subprocess.Popen[str]]:
    """OpenSplat, ended with the block."""
    process = subprocess.Popen(
        [program, *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=environment_of(device),
        preexec_fn=end_with_parent,
    )
    assert process.stdout is not None, "it is asked for"
    try:
        yield process
    finally:
        process.terminate()
        process.stdout.close()
        try:
            process.wait(timeout=END_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _lines(process: subprocess.Popen[str], out: Path) -> Iterator[str]:
    """What the program prints, which is also kept in the log."""
    assert process.stdout is not None, "it is asked for"
    with (out / LOG_FILE).open("w", encoding="utf-8", buffering=1) as log:
        for line in process.stdout:
            log.write(line)
            yield line


def progress_of(folder: Path) -> TrainingProgress:
    """How far a run has trained.

    Raises:
        RunError: not to its end.
    """
    step, seconds = read_job(folder / FOLDER / JOB_FILE, "splats")["trained"]
    return TrainingProgress(step, seconds)


def renderer(folder: Path, device: torch.device) -> Render:
    """A trained run as a method.

    Raises:
        RunError: it has not been trained to its end.
        SceneError: its splats are damaged.
    """
    path = folder / FOLDER / JOB_FILE
    job = read_job(path, "splats")
    factor, shifts = torch.tensor(job["factor"]), job.get("shifts")
    shifts = torch.tensor(from_json(_SHIFTS, shifts, f"{path}: shifts")) if shifts else None  # none of version 0.1
    splats = read_splats(folder / FOLDER / SPLATS_FILE)
    return lambda camera: _render(splats, camera, factor, shifts, device)


def _render(
    splats: Splats,
    camera: Cameras,
    factor: Float[torch.Tensor, "3"],
    shifts: Float[torch.Tensor, "L 4"] | None,
    device: torch.device,
) -> Rendering:
    """Render a view at the camera's own gain, its principal point shifted as those of the most similar lens were."""
    if shifts is None:
        shifted = with_half_pixels(camera)
    else:
        lens = (camera.principal_px / camera.size_px - shifts[:, :2]).norm(dim=1).argmin()
        shifted = replace(camera, principal_px=camera.principal_px + shifts[lens, 2:] * camera.size_px)
    view = render_splats(splats, shifted, BACKGROUND_RGB, device)
    return replace(view, colour=(view.colour / factor * camera.gain_of_rows()).clamp(0, 1))


def with_half_pixels(cameras: Cameras) -> Cameras:
    """Round principal points to half pixels, so that a crop to whole pixels has each in its middle."""
    return replace(cameras, principal_px=(2 * cameras.principal_px).round() / 2)


def half_pixel_shifts(cameras: Cameras) -> Float[torch.Tensor, "L 4"]:
    """Principal points of the lenses, and how far `with_half_pixels` shifts them, in shares of width and height.

    Rendering shifts as training did, at any size, so that the error of at most 0.25 px is the same in both.
    """
    shift = with_half_pixels(cameras).principal_px - cameras.principal_px
    return (torch.cat([cameras.principal_px, shift], dim=1) / cameras.size_px.repeat(1, 2)).unique(dim=0)


def export(scene: Scene, folder: Path) -> Float[torch.Tensor, "3"]:
    """Write the training photographs (PNG, undistorted), transforms.json and the sparse points.

    Photographs are at the common exposure, as all other methods see them, times a factor that avoids clipping. They are
    cropped so that the principal point is in the middle, where OpenSplat takes it to be.

    Returns:
        The factor: renderings divided by it are at the common exposure.

    Raises:
        SceneError: there are no sparse points.
    """
    points = scene.points
    if points is None or len(points.xyz_world) < LEAST_POINTS:
        raise SceneError(
            f"{scene.root} has too few sparse points for OpenSplat, which starts with them: expected {LEAST_POINTS} or "
            "more; leave opensplat out, or take a scene with points, such as a COLMAP model"
        )
    (folder / "images").mkdir(parents=True, exist_ok=True)
    factor, files, lenses = exposure_factor(scene.cameras[list(scene.train)]), [], []
    for number, index in enumerate(scene.train):
        camera = with_half_pixels(scene.cameras[index])
        (left, top), (width, height) = _centred_crop(camera, scene.names[index])
        colour = at_common_exposure(scene, index, factor)[top : top + height, left : left + width]
        files.append(f"images/{number:05d}.png")
        Image.fromarray(colour).save(folder / files[-1])
        fx, fy = camera.focal_px[0].tolist()
        lenses.append(Lens(width, height, fx=fx, fy=fy, cx=width / 2, cy=height / 2))
    write_transforms_file(
        folder,
        files,
        lenses,
        scene.cameras.T_world_camera[list(scene.train), :3].double().numpy(),
        (range(len(files)), ()),
        points.xyz_world.double().numpy(),
        point_colours(scene, factor),
        per_frame=True,
        overwrite=True,
    )
    return factor


def _centred_crop(camera: Cameras, name: str) -> tuple[tuple[int, int], tuple[int, int]]:
    """The corner and the size of the largest crop, in pixels, that has the principal point in its middle.

    Raises:
        SceneError: the principal point is outside of the photograph.
    """
    middle, size = camera.principal_px[0], camera.size_px[0]
    half = torch.minimum(middle, size - middle)
    if (half < 1).any():
        raise SceneError(
            f"{name} has its principal point outside of it, at {middle.tolist()} px: expected one inside, around which "
            "the photograph is cropped for OpenSplat; leave opensplat out, or correct the calibration"
        )
    left, top = (middle - half).round().long().tolist()
    width, height = (2 * half).round().long().tolist()
    return (left, top), (width, height)
