"""What the commands do, once their arguments are known."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pycolmap
import torch
from rich.console import Console

from tidefield.baselines.nerfstudio import driver, environment
from tidefield.config import PRESETS, AnyConfig, FieldConfig, NerfConfig, NerfstudioConfig, config_to_json
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
from tidefield.methods import FLOORS, make_learner, trained
from tidefield.model.rendering import Render as RenderMethod
from tidefield.options import Ablate, Baselines, Compare, Demo, Evaluate, Import, Prepare, Render, Train
from tidefield.products.pictures import write_still
from tidefield.products.trajectory import make_trajectory
from tidefield.products.video import write_video
from tidefield.train.checkpoint import CHECKPOINT_FILE, RUN_FILE, Progress, Run, read_run, write_run
from tidefield.train.curve import Curve, make_curve
from tidefield.train.display import Display
from tidefield.train.evaluate import Evaluation
from tidefield.train.evaluate import evaluate as evaluate_method
from tidefield.train.loop import Budget
from tidefield.train.loop import train as train_loop
from tidefield.train.lpips import download_lpips_weights
from tidefield.variants import vary

log = logging.getLogger(__name__)

DEFAULT_MINUTES = 10.0
SYNTHETIC_WIDTH = 400
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
    budget, folder = _budget(options), options.run
    where = choose_device(options.device)
    run = _resumed_run(options) if options.resume else _new_run(options)
    scene = _load(run.scene, run.width, options.allow_missing, console)
    if not scene.train:
        raise SceneError(f"{options.scene} has no training photographs: expected at least three; add photographs")
    if options.curve and not scene.test:
        raise SceneError(f"{options.scene} holds no photograph out: expected one for --curve; leave --curve out")
    curve = make_curve(scene) if options.curve else None
    log.info(f"{len(scene.train)} photographs, {len(scene.test)} held out; {run.config.method} on {where}")
    if isinstance(run.config, NerfstudioConfig):
        if options.resume:
            raise RunError(f"{run.config.method} cannot go on where it stopped: train it again, with --overwrite")
        write_run(folder, run)
        progress, finished = _train_nerfstudio(run, scene, folder, budget, where, curve, console), True
    else:
        learner = make_learner(run.config, scene, run.seed, where)
        if options.resume:
            learner.resume(folder)
        else:
            write_run(folder, run)
        finished, progress = train_loop(learner, folder, budget, Display(console), curve), learner.progress
    console.print(f"{progress.step} steps in {progress.seconds / 60:.1f} minutes, kept in {folder}", highlight=False)
    if not finished:
        console.print("interrupted; the same command with --resume goes on")
        raise KeyboardInterrupt


def _train_nerfstudio(
    run: Run, scene: Scene, folder: Path, budget: Budget, device: torch.device, curve: Curve | None, console: Console
) -> Progress:
    """Train one of nerfstudio's methods, with progress."""
    config = run.config
    assert isinstance(config, NerfstudioConfig), "the others train in this process"
    with Display(console) as display:

        def progress(step: int, seconds: float) -> None:
            used = Progress(step, seconds)
            display.show(budget.share(used), f"step {step}  {step / max(seconds, 1e-9):.2f} steps/s")

        return driver.train(config.method, scene, folder, budget, run.seed, device, curve, progress)


def compare(options: Compare, console: Console) -> None:
    """See `tidefield compare --help`."""
    from tidefield.compare.record import run_measured
    from tidefield.compare.results import read_results
    from tidefield.compare.run import Settings
    from tidefield.compare.run import compare as run_all
    from tidefield.compare.write import write_comparison

    if find_spec("matplotlib") is None:
        raise RunError("matplotlib is not installed: expected it, for the curves; pip install 'tidefield[compare]'")
    for method in ("nerfacto", "splatfacto"):
        if method in options.methods:
            driver.require(method, choose_device(options.device))  # before anything is trained
    budget, scenes, say = _budget(options), _scenes(options), _say(console)
    settings = Settings(budget.minutes, budget.steps, options.width, options.device, options.seed)
    run_all(scenes, options.methods, settings, options.out, run_measured, say)
    results = read_results(options.out, list(scenes), options.methods)
    for file in write_comparison(results, scenes, settings, options.out):
        say(str(file))


def ablate(options: Ablate, console: Console) -> None:
    """See `tidefield ablate --help`."""
    from tidefield.compare.ablation import variants
    from tidefield.compare.protocols import named
    from tidefield.compare.record import run_measured
    from tidefield.compare.results import read_results
    from tidefield.compare.run import Settings
    from tidefield.compare.run import compare as run_all
    from tidefield.compare.write import write_ablation

    budget, scenes, say = _budget(options), named(options.scenes), _say(console)
    for name in options.variants:
        vary(PRESETS[options.preset], name)  # before anything is trained
    settings = Settings(budget.minutes, budget.steps, options.width, options.device, options.seed, options.preset)
    run_all(scenes, variants(options.variants), settings, options.out, run_measured, say)
    results = read_results(options.out, list(scenes), variants(options.variants))
    for file in write_ablation(results, settings, options.out):
        say(str(file))


def _say(console: Console) -> Callable[[str], None]:
    return lambda text: console.print(text, highlight=False, soft_wrap=True)


def _budget(options: Train | Compare | Ablate) -> Budget:
    """What is asked for; ten minutes if nothing is."""
    if options.minutes is not None and options.steps is not None:
        raise RunError("both --minutes and --steps are given: expected one of them; leave one out")
    if options.minutes is None and options.steps is None:
        return Budget(minutes=DEFAULT_MINUTES)
    return Budget(options.steps, options.minutes)


def _scenes(options: Compare) -> dict[str, Path]:
    """What is to be compared on, by name."""
    from tidefield.compare import protocols

    if options.protocol == "mipnerf360":
        if len(options.scenes) != 1:
            raise RunError("--protocol mipnerf360 compares on one data set: expected its folder; name it alone")
        return protocols.mipnerf360(options.scenes[0], options.out / "scenes")
    if options.protocol == "tidalflats":
        return protocols.tidal_flats(options.out / "scenes", options.width or SYNTHETIC_WIDTH, options.scenes)
    if not options.scenes:
        raise RunError("nothing to compare on: expected scenes, or --protocol; name some")
    return protocols.named(options.scenes)


def baselines(options: Baselines, console: Console) -> None:
    """See `tidefield baselines --help`."""
    environment.install(options.overwrite, console)
    console.print(f"nerfstudio {environment.VERSION} is in {environment.home()}", highlight=False, soft_wrap=True)


def evaluate(options: Evaluate, console: Console) -> Evaluation:
    """See `tidefield evaluate --help`."""
    if options.download_lpips:
        download_lpips_weights()
    path, out, method = options.path, options.out, options.method
    settings = {"overwrite": options.overwrite, "console": console}
    if method is None:
        if options.width is not None:
            raise RunError("--width belongs to --method: a run is evaluated at its own width; leave it out")
        with _open_run(path, options, console) as (scene, view, configuration):
            return evaluate_method(view, scene, out or path, configuration=configuration, **settings)
    if out is None:
        raise RunError(f"nowhere to write: expected `tidefield evaluate {path} OUT --method {method}`; name a folder")
    scene = _load(path, options.width, options.allow_missing, console)
    return evaluate_method(FLOORS[method](scene), scene, out, configuration={"method": method}, **settings)


def render(options: Render, console: Console) -> None:
    """See `tidefield render --help`."""
    out, camera, overwrite = options.out, options.camera, options.overwrite
    wanted = ".mp4" if camera is None else ".png"
    if out.suffix.lower() != wanted:
        what = "a video" if camera is None else "one view (--camera)"
        raise RunError(f"{out.name} was asked for: {what} is written as {wanted}; change the name")
    if not overwrite:
        refuse_existing(out)
    with _open_run(options.run, options, console) as (scene, view, _):
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
    return Run(options.scene.resolve(), options.width, options.seed, _config(options))


def _config(options: Train) -> AnyConfig:
    if options.method == "nerf":
        return NerfConfig()
    if options.method in ("nerfacto", "splatfacto"):
        return NerfstudioConfig(options.method, environment.VERSION)
    config = PRESETS[options.preset]
    if options.variant is not None:
        config = vary(config, options.variant)
    if options.field:
        config = replace(config, network=replace(config.network, field=FieldConfig()))
    return config


def _resumed_run(options: Train) -> Run:
    """The run in the folder; what else is asked for was settled when it began."""
    run = read_run(options.run)
    if run.scene != options.scene.resolve():
        raise RunError(
            f"{options.run} was trained on {run.scene}, not on {options.scene}: expected the same scene; name it"
        )
    return run


@contextmanager
def _open_run(
    folder: Path, options: Evaluate | Render, console: Console
) -> Iterator[tuple[Scene, RenderMethod, dict[str, Any]]]:
    """A run's scene, the run as a method while the block lasts, and what made it, for the record."""
    where, run = choose_device(options.device), read_run(folder)
    scene = _load(run.scene, run.width, options.allow_missing, console)
    with trained(folder, run, scene, where) as (view, progress):
        done = {"steps": progress.step, "seconds": progress.seconds}
        yield scene, view, {**config_to_json(run.config), "seed": run.seed, "trained": done}


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
