"""What the commands do, once their arguments are known."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap
from rich.console import Console

from tidefield.baselines import plane_sweep, sparse_depth
from tidefield.config import PRESETS, FieldConfig, config_to_json
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.device import choose_device
from tidefield.errors import RunError, SceneError, TidefieldError
from tidefield.files import refuse_existing
from tidefield.geometry.cameras import Cameras
from tidefield.ingest import convert
from tidefield.ingest.findings import findings
from tidefield.ingest.motion.features import FeatureOptions
from tidefield.ingest.motion.features import choose_device as choose_pycolmap_device
from tidefield.ingest.prepare import Wishes
from tidefield.ingest.prepare import prepare as prepare_scene
from tidefield.ingest.reading.photographs import read_survey
from tidefield.ingest.report import write_report
from tidefield.meter import Meter
from tidefield.model.network import Network
from tidefield.model.renderer import Renderer
from tidefield.options import Demo, Evaluate, Import, Prepare, Render, Train
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
DEMO_FRAMES = 72
DEMO_PICTURE = "river_mouths_0033.png"
"""Of the held-out photographs of the built-in scene, the one with a creek, its banks and plants."""


def prepare(options: Prepare, console: Console) -> None:
    """See `tidefield prepare --help`."""
    if options.control is not None and options.no_control:
        raise RunError("both --control and --no-control are given: expected one of them; leave one out")
    survey = read_survey(options.photographs, options.gps, options.control)
    # Its log tells every step of structure from motion.
    pycolmap.logging.minloglevel = int(pycolmap.logging.INFO if options.talk.verbose else pycolmap.logging.ERROR)
    if options.no_control:
        survey = replace(survey, control=None)
    for remark in survey.remarks:
        log.warning(remark)
    wishes = Wishes(
        keep_all=options.keep_all,
        colour=options.colour,
        features=FeatureOptions(options.feature_width, options.features),
        redo=options.redo,
    )
    prepared = prepare_scene(survey, options.scene, wishes, choose_pycolmap_device(options.device), console)
    asked = {name: str(value) for name, value in vars(options).items() if name not in ("scene", "talk", "redo")}
    report = write_report(findings(prepared, options.scene, asked), options.scene)
    lost = len(survey.photographs) - len(prepared.models[0])
    console.print(
        f"{options.scene}: {len(prepared.models[0])} of {len(survey.photographs)} photographs"
        + (
            f"; why {lost} are missing, and more, stands in {report.page}"
            if lost
            else f"; more stands in {report.page}"
        ),
        highlight=False,
        soft_wrap=True,
    )


def import_project(options: Import, console: Console) -> None:
    """See `tidefield import --help`."""
    with Meter(console, "Placing photographs") as meter:
        made = convert.import_project(
            options.project, options.scene, link=options.link, allow_missing=options.allow_missing, progress=meter
        )
    seen = f", seen {made.observations:,} times" if made.observations else ""
    frame = made.georeference and made.georeference.frame
    where = f"; in metres about {frame.latitude_deg:.5f}, {frame.longitude_deg:.5f} ({frame.crs})" if frame else ""
    console.print(
        f"{options.scene}: {made.photographs} photographs, {made.held_out} of them held out; {made.cameras} "
        f"camera{'s' * (made.cameras > 1)}; {made.points:,} sparse points{seen}{where}",
        highlight=False,
        soft_wrap=True,
    )


def train(options: Train, console: Console) -> None:
    """See `tidefield train --help`."""
    minutes, steps, folder = options.minutes, options.steps, options.run
    if minutes is not None and steps is not None:
        raise RunError("both --minutes and --steps are given: expected one of them; leave one out")
    where = choose_device(options.device)
    run = _resumed_run(options) if options.resume else _new_run(options)
    scene = _load(run.scene, run.width, options.allow_missing, console)
    if not scene.train:
        raise SceneError(f"{options.scene} has no training photographs: expected at least three; add photographs")
    trainer = Trainer(run.config, scene, run.seed, where)
    if options.resume:
        trainer.resume(folder)
    else:
        write_run(folder, run)
    if steps is None and minutes is None:
        minutes = DEFAULT_MINUTES
    budget = Budget(steps, minutes)
    count = sum(p.numel() for p in trainer.network.parameters())
    log.info(f"{len(scene.train)} photographs, {len(scene.test)} held out; {count:,} parameters on {where}")
    finished = train_loop(trainer, folder, budget, Display(console))
    progress = trainer.progress
    console.print(f"{progress.step} steps in {progress.seconds / 60:.1f} minutes, kept in {folder}", highlight=False)
    if not finished:
        console.print("interrupted; the same command with --resume goes on")
        raise KeyboardInterrupt


def evaluate(options: Evaluate, console: Console) -> Evaluation:
    """See `tidefield evaluate --help`."""
    if options.download_lpips:
        download_lpips_weights()
    path, out, method = options.path, options.out, options.method
    if method is None:
        if options.width is not None:
            raise RunError("--width belongs to --method: a run is evaluated at its own width; leave it out")
        scene, view, configuration = _open_run(path, options, console)
        out = out or path
    else:
        if out is None:
            raise RunError(
                f"nowhere to write: expected `tidefield evaluate {path} OUT --method {method}`; name a folder"
            )
        scene = _load(path, options.width, options.allow_missing, console)
        view, configuration = METHODS[method].make(scene), {"method": method}
    return evaluate_method(view, scene, out, configuration=configuration, overwrite=options.overwrite, console=console)


def render(options: Render, console: Console) -> None:
    """See `tidefield render --help`."""
    out, camera, overwrite = options.out, options.camera, options.overwrite
    wanted = ".mp4" if camera is None else ".png"
    if out.suffix.lower() != wanted:
        what = "a video" if camera is None else "one view (--camera)"
        raise RunError(f"{out.name} was asked for: {what} is written as {wanted}; change the name")
    if not overwrite:
        refuse_existing(out)
    scene, view, _ = _open_run(options.run, options, console)
    if camera is not None:
        own = scene.cameras[scene.index(camera)]
        size = _size(own, options.width, options.height)
        for file in write_still(view(own.resized(*size)), out, overwrite=overwrite):
            console.print(str(file), highlight=False, soft_wrap=True)
        return
    width, height = _size(scene.cameras[scene.train[0]], options.width, options.height)
    trajectory = make_trajectory(options.path, scene, frames=options.frames, width=width, height=height)
    cameras = trajectory.cameras
    with Meter(console, "Rendering") as meter:
        write_video(
            (view(cameras[k]) for k in range(len(cameras))),
            out,
            trajectory.frames_per_second,
            overwrite=overwrite,
            progress=lambda done: meter(done, len(cameras)),
        )
    console.print(f"{out}: {len(cameras)} frames", highlight=False, soft_wrap=True)


def demo(options: Demo, console: Console) -> None:
    """See `tidefield demo --help`."""
    from tidefield.data.synthetic import make_survey, write_survey

    out, device = options.out, options.device
    if options.overwrite and out.exists():
        if not (out / "scene" / "truth").is_dir():
            raise RunError(f"{out} holds no demonstration: expected one to begin anew; choose another folder")
        shutil.rmtree(out)
    scene, run, video, picture = (out / name for name in ("scene", "run", "fly-through.mp4", "side-by-side.png"))
    if not scene.exists():
        console.print("Making a survey of a tidal flat ...")
        half = out / "scene.partial"
        shutil.rmtree(half, ignore_errors=True)
        write_survey(make_survey("river_mouths", seed=7, views=40, width=320), half)
        half.rename(scene)
    if not (run / CHECKPOINT_FILE).exists():
        train(Train(scene, run, minutes=options.minutes, device=device, overwrite=True), console)
    evaluate(Evaluate(run, device=device, overwrite=True), console)
    render(Render(run, video, path="cameras", frames=DEMO_FRAMES, device=device, overwrite=True), console)
    shutil.copyfile(run / "pictures" / DEMO_PICTURE, picture)
    console.print("\nWhat was made:")
    for what, path in (
        ("the survey, as COLMAP scene", scene),
        ("the numbers", run / "evaluation.json"),
        ("truth | rendering | error | depth", picture),
        ("more of these", run / "pictures"),
        ("the fly-through", video),
    ):
        console.print(f"  {what:<34} {path.resolve()}", highlight=False, soft_wrap=True)


def _new_run(options: Train) -> Run:
    """A run of what is asked for, in a folder that may be one."""
    _refuse_run(options.run, options.overwrite)
    config = PRESETS[options.preset]
    if options.field:
        config = replace(config, network=replace(config.network, field=FieldConfig()))
    return Run(options.scene.resolve(), options.width, options.seed, config)


def _resumed_run(options: Train) -> Run:
    """The run in the folder; what else is asked for was settled when it began."""
    run = read_run(options.run)
    if run.scene != options.scene.resolve():
        raise RunError(
            f"{options.run} was trained on {run.scene}, not on {options.scene}: expected the same scene; name it"
        )
    return run


def _open_run(folder: Path, options: Evaluate | Render, console: Console) -> tuple[Scene, Renderer, dict[str, Any]]:
    """A run's scene, the run as a method, and what made it, for the record."""
    where = choose_device(options.device)
    run = read_run(folder)
    network = Network(run.config.network)
    progress = load_network(folder, network)
    scene = _load(run.scene, run.width, options.allow_missing, console)
    trained = {"steps": progress.step, "seconds": progress.seconds}
    configuration = {"method": "tidefield", **config_to_json(run.config), "seed": run.seed, "trained": trained}
    return scene, Renderer(network.to(where).eval(), scene, run.config, where), configuration


def _load(scene: Path, width: int | None, allow_missing: bool, console: Console) -> Scene:
    """Read a scene, with progress while photographs are decoded."""
    with Meter(console, "Reading photographs") as meter:
        return load_scene(scene, width=width, allow_missing=allow_missing, progress=meter)


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
