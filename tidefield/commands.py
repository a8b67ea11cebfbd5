"""What the commands do, once their arguments are known."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress, track

from tidefield.baselines import plane_sweep, sparse_depth
from tidefield.config import PRESETS, FieldConfig, config_to_json
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.device import choose_device
from tidefield.errors import RunError, SceneError, TidefieldError
from tidefield.files import refuse_existing
from tidefield.geometry.cameras import Cameras
from tidefield.model.network import Network
from tidefield.model.renderer import Renderer
from tidefield.model.rendering import Rendering
from tidefield.products.pictures import write_still
from tidefield.products.trajectory import make_trajectory
from tidefield.products.video import write_video
from tidefield.train.checkpoint import CHECKPOINT_FILE, RUN_FILE, Run, load_network, read_run, write_run
from tidefield.train.display import Display
from tidefield.train.evaluate import Evaluation
from tidefield.train.evaluate import evaluate as evaluate_method
from tidefield.train.loop import Budget, Trainer
from tidefield.train.loop import train as train_loop
from tidefield.train.lpips import download_lpips_weights

log = logging.getLogger(__name__)

METHODS = {"plane-sweep": plane_sweep, "sparse-depth": sparse_depth}
DEFAULT_MINUTES = 10.0


def train(
    scene: Path,
    folder: Path,
    *,
    preset: str,
    minutes: float | None,
    steps: int | None,
    width: int | None,
    device: str,
    seed: int,
    field: bool,
    resume: bool,
    overwrite: bool,
    allow_missing: bool,
    console: Console,
) -> None:
    """See `tidefield train --help`."""
    if minutes is not None and steps is not None:
        raise RunError("both --minutes and --steps are given: expected one of them; leave one out")
    where = choose_device(device)
    if resume:
        run = read_run(folder)
        if run.scene != scene.resolve():
            raise RunError(f"{folder} was trained on {run.scene}, not on {scene}: expected the same scene; name it")
    else:
        _refuse_run(folder, overwrite)
        config = PRESETS[preset]
        if field:
            config = replace(config, network=replace(config.network, field=FieldConfig()))
        run = Run(scene.resolve(), width, seed, config)
    loaded = _load(run.scene, run.width, allow_missing, console)
    if not loaded.train:
        raise SceneError(f"{scene} has no training photographs: expected at least three; add photographs")
    trainer = Trainer(run.config, loaded, run.seed, where)
    if resume:
        trainer.resume(folder)
    else:
        write_run(folder, run)
    budget = Budget(steps, None if steps is not None else minutes or DEFAULT_MINUTES)
    count = sum(p.numel() for p in trainer.network.parameters())
    log.info(f"{len(loaded.train)} photographs, {len(loaded.test)} held out; {count:,} parameters on {where}")
    finished = train_loop(trainer, folder, budget, Display(console))
    progress = trainer.progress
    console.print(f"{progress.step} steps in {progress.seconds / 60:.1f} minutes, kept in {folder}", highlight=False)
    if not finished:
        console.print("interrupted; the same command with --resume goes on")
        raise KeyboardInterrupt


def evaluate(
    path: Path,
    out: Path | None,
    *,
    method: str | None,
    width: int | None,
    device: str,
    download_lpips: bool,
    overwrite: bool,
    allow_missing: bool,
    console: Console,
) -> Evaluation:
    """See `tidefield evaluate --help`."""
    if download_lpips:
        download_lpips_weights()
    if method is None:
        if width is not None:
            raise RunError("--width belongs to --method: a run is evaluated at its own width; leave it out")
        run, scene, render = _open_run(path, device, allow_missing, console)
        configuration: dict[str, Any] = {"method": "tidefield", **config_to_json(run.config), "seed": run.seed}
        configuration |= {"trained": render.trained}
        return evaluate_method(
            render, scene, out or path, configuration=configuration, overwrite=overwrite, console=console
        )
    if out is None:
        raise RunError(f"nowhere to write: expected `tidefield evaluate {path} OUT --method {method}`; name a folder")
    scene = _load(path, width, allow_missing, console)
    return evaluate_method(
        METHODS[method].make(scene), scene, out, configuration={"method": method}, overwrite=overwrite, console=console
    )


def render(
    folder: Path,
    out: Path,
    *,
    path: str,
    camera: str | None,
    frames: int,
    width: int | None,
    height: int | None,
    device: str,
    overwrite: bool,
    allow_missing: bool,
    console: Console,
) -> None:
    """See `tidefield render --help`."""
    wanted = ".mp4" if camera is None else ".png"
    if out.suffix.lower() != wanted:
        what = "a video" if camera is None else "one view (--camera)"
        raise RunError(f"{out.name} was asked for: {what} is written as {wanted}; change the name")
    if not overwrite:
        refuse_existing(out)
    _, scene, renderer = _open_run(folder, device, allow_missing, console)
    if camera is not None:
        own = scene.cameras[scene.index(camera)]
        size = _size(own, width, height)
        for file in write_still(renderer(own.resized(*size)), out, overwrite=overwrite):
            console.print(str(file), highlight=False, soft_wrap=True)
        return
    size = _size(scene.cameras[scene.train[0]], width, height)
    trajectory = make_trajectory(path, scene, frames=frames, width=size[0], height=size[1])
    count = len(trajectory.cameras)

    def views() -> Iterator[Rendering]:
        quiet = not console.is_terminal
        for k in track(range(count), "Rendering", console=console, disable=quiet, transient=True):
            yield renderer(trajectory.cameras[k])

    write_video(views(), out, trajectory.frames_per_second, overwrite=overwrite)
    console.print(f"{out}: {count} frames", highlight=False, soft_wrap=True)


def demo(out: Path, *, minutes: float, device: str, overwrite: bool, console: Console) -> None:
    """See `tidefield demo --help`."""
    from tidefield.data.synthetic import make_survey, write_survey

    if overwrite and out.exists():
        if not (out / "scene" / "truth").is_dir():
            raise RunError(f"{out} holds no demonstration: expected one to begin anew; choose another folder")
        shutil.rmtree(out)
    scene, run = out / "scene", out / "run"
    if not scene.exists():
        console.print("Making a survey of a tidal flat ...")
        half = out / "scene.partial"
        shutil.rmtree(half, ignore_errors=True)
        write_survey(make_survey("river_mouths", seed=7, views=40, width=320), half)
        half.rename(scene)
    if not (run / CHECKPOINT_FILE).exists():
        train(
            scene,
            run,
            preset="swift",
            minutes=minutes,
            steps=None,
            width=None,
            device=device,
            seed=0,
            field=False,
            resume=False,
            overwrite=True,
            allow_missing=False,
            console=console,
        )
    common: dict[str, Any] = {"device": device, "overwrite": True, "allow_missing": False, "console": console}
    evaluate(run, None, method=None, width=None, download_lpips=False, **common)
    video = out / "fly-through.mp4"
    render(run, video, path="cameras", camera=None, frames=96, width=None, height=None, **common)
    pictures = sorted((run / "pictures").glob("*.png"))
    middle = pictures[len(pictures) // 2]
    side_by_side = out / "side-by-side.png"
    shutil.copyfile(middle, side_by_side)
    console.print("\nWhat was made:")
    for what, path in (
        ("the survey, as COLMAP scene", scene),
        ("the numbers", run / "evaluation.json"),
        ("truth | rendering | error | depth", side_by_side),
        ("more of these", run / "pictures"),
        ("the fly-through", video),
    ):
        console.print(f"  {what:<34} {path.resolve()}", highlight=False, soft_wrap=True)


class _RunRenderer(Renderer):
    """A run's renderer, with how far it was trained."""

    trained: dict[str, float]


def _open_run(folder: Path, device: str, allow_missing: bool, console: Console) -> tuple[Run, Scene, _RunRenderer]:
    where = choose_device(device)
    run = read_run(folder)
    network = Network(run.config.network)
    progress = load_network(folder, network)
    scene = _load(run.scene, run.width, allow_missing, console)
    renderer = _RunRenderer(network.to(where).eval(), scene, run.config, where)
    renderer.trained = {"steps": progress.step, "seconds": progress.seconds}
    return run, scene, renderer


def _load(scene: Path, width: int | None, allow_missing: bool, console: Console) -> Scene:
    """Read a scene, with progress while photographs are decoded."""
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("Reading photographs", total=None)

        def show(ready: int, count: int) -> None:
            progress.update(task, completed=ready, total=count)

        return load_scene(scene, width=width, allow_missing=allow_missing, progress=show)


def _refuse_run(folder: Path, overwrite: bool) -> None:
    """Raises: RunError when a folder holds a run, or is something else that a run would be mixed into."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise RunError(f"{folder} is a file: expected a new folder for the run; choose another name")
    if (folder / RUN_FILE).exists():
        if overwrite:
            return
        raise RunError(f"{folder} holds a run: expected a new folder; choose another, or add --resume or --overwrite")
    if any(folder.iterdir()):
        raise RunError(f"{folder} holds other files: expected a new or empty folder; choose a new name")


def _size(camera: Cameras, width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height of a picture: what is asked for, else the camera's, else in its proportion."""
    for name, value in (("width", width), ("height", height)):
        if value is not None and not 16 <= value <= 16384:
            raise TidefieldError(f"--{name} {value} was asked for: expected 16 to 16384 pixels; choose another")
    if width is None and height is None:
        return camera.width, camera.height
    if width is None:
        assert height is not None
        return max(16, round(height * camera.width / camera.height)), height
    return width, height if height is not None else max(16, round(width * camera.height / camera.width))
