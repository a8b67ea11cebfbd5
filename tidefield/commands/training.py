"""`tidefield train` and `tidefield pretrain`: scenes become runs and weights."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console

from tidefield.baselines.nerfstudio import driver, environment
from tidefield.commands.opening import budget_of, load
from tidefield.config import PRESETS, AnyConfig, Config, FieldConfig, NerfConfig, NerfstudioConfig, going_on
from tidefield.data.scene import Scene
from tidefield.device import choose_device
from tidefield.errors import RunError, SceneError
from tidefield.evaluation.curves import QualityCurve, make_curve
from tidefield.machine import describe
from tidefield.methods import make_trainer
from tidefield.options import Pretrain, Train
from tidefield.train.checkpoint import RUN_FILE, Run, TrainingProgress, read_run, write_run
from tidefield.train.display import Display
from tidefield.train.loop import Budget
from tidefield.train.loop import train as train_loop
from tidefield.train.weights import WEIGHTS_FILE, sha256, shipped, write_weights
from tidefield.variants import vary

log = logging.getLogger(__name__)


def train(options: Train, console: Console) -> None:
    """See `tidefield train --help`."""
    budget, folder = budget_of(options.length), options.run
    where = choose_device(options.device)
    run = _resumed_run(options) if options.resume else _new_run(options)
    scene = load(run.scene, run.width, options.allow_missing, console)
    if not scene.train:
        raise SceneError(f"{options.scene} has no training photographs: expected at least three; add photographs")
    if options.curve and not scene.test:
        raise SceneError(f"{options.scene} holds no photograph out: expected one for --curve; leave --curve out")
    curve = make_curve(scene) if options.curve else None
    weights = None if options.resume else _begun_with(options)
    begins = f", beginning with {weights}" if weights else ""
    log.info(f"{len(scene.train)} photographs, {len(scene.test)} held out; {run.config.method} on {where}{begins}")
    if isinstance(run.config, NerfstudioConfig):
        if options.resume:
            raise RunError(f"{run.config.method} cannot go on where it stopped: train it again, with --overwrite")
        write_run(folder, run)
        progress, finished = _train_nerfstudio(run, scene, folder, budget, where, curve, console), True
    else:
        learner = make_trainer(run.config, scene, run.seed, where, weights)
        if options.resume:
            learner.resume(folder)
        else:
            write_run(folder, run)
        watch = curve and curve.watch(folder, budget.share(learner.progress))
        finished, progress = train_loop(learner, folder, budget, Display(console), watch), learner.progress
    _end(progress, finished, folder, console)


def pretrain(options: Pretrain, console: Console) -> None:
    """See `tidefield pretrain --help`."""
    from tidefield.train import pretrain as across
    from tidefield.train.stream import Stream

    budget, folder, config = budget_of(options.length), options.out, PRESETS[options.preset]
    occupied = not options.resume and folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    device = across.join(choose_device(options.device))  # none gets further, and writes, before all have looked
    if occupied:
        raise RunError(f"{folder} is not empty: expected a new folder; choose another, or go on in it with --resume")
    if not across.leads():
        console = Console(quiet=True)
    if across.together() and budget.steps is None:
        raise RunError("several processes were started with --minutes: expected --steps, which all of them can count")
    validation = across.Validation(across.validation_scenes(folder, options.real, console), folder)
    with Stream(folder / "scenes", options.real, across.own_seed(options.seed), device) as stream:
        shown = next(iter(validation.scenes.values()))
        learner = across.Pretrainer(config, stream, shown, options.seed, device)
        if options.resume:
            learner.resume(folder)
        finished = train_loop(learner, folder, budget, Display(console), validation)
    if learner.leads:
        done, real = learner.progress, [scene.resolve().name for scene in options.real]
        about = {"steps": done.step, "seconds": done.seconds, "seed": options.seed, "real": real, **describe()}
        about["processes"] = across.processes()
        write_weights(folder / WEIGHTS_FILE, learner.network, config, {**about, "validation": validation.points})
    _end(learner.progress, finished, folder, console)


def _end(progress: TrainingProgress, finished: bool, folder: Path, console: Console) -> None:
    """Tell what was done; a training that was interrupted ends its command as an interruption."""
    console.print(f"{progress.step} steps in {progress.seconds / 60:.1f} minutes, kept in {folder}", highlight=False)
    if not finished:
        console.print("interrupted; the same command with --resume goes on")
        raise KeyboardInterrupt


def _train_nerfstudio(
    run: Run,
    scene: Scene,
    folder: Path,
    budget: Budget,
    device: torch.device,
    curve: QualityCurve | None,
    console: Console,
) -> TrainingProgress:
    """Train one of nerfstudio's methods, with progress."""
    config = run.config
    assert isinstance(config, NerfstudioConfig), "the others train in this process"
    with Display(console) as display:

        def progress(step: int, seconds: float) -> None:
            used = TrainingProgress(step, seconds)
            display.show(budget.share(used), f"step {step}  {step / max(seconds, 1e-9):.2f} steps/s")

        return driver.train(config.method, scene, folder, budget, run.seed, device, curve, progress)


def _new_run(options: Train) -> Run:
    """A run of what is asked for, in a folder that may be one."""
    _refuse_run(options.run, options.overwrite)
    weights = _begun_with(options)
    config, digest = _config(options), None
    if weights is not None:
        assert isinstance(config, Config), "only our network begins with weights"
        config, digest = going_on(config), sha256(weights)
    return Run(options.scene.resolve(), options.width, options.seed, config, digest)


def _begun_with(options: Train) -> Path | None:
    """Weights to begin with: those that are named, else those of the preset as it is that came with Tidefield."""
    if options.weights is not None and (options.from_scratch or options.method != "tidefield"):
        raise RunError("--weights is given for what begins without them: expected one or the other; leave one out")
    if options.from_scratch or options.method != "tidefield":
        return None
    return options.weights or (shipped(options.preset) if options.variant is None else None)


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
