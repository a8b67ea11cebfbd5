"""`tidefield train`: learn one scene."""

from __future__ import annotations

import logging
import os
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import AllowMissing, Device, OpensplatProgram, Preset, TrainedMethod, Verbosity, load
from tidefield.config import (
    PRESETS,
    AnyConfig,
    Budget,
    Config,
    ExternalConfig,
    NerfstudioConfig,
    checked_seed,
    vary,
)
from tidefield.errors import RunError, SceneError, need
from tidefield.files import delete_files, delete_partials, is_empty, only_writer, require_writable
from tidefield.methods import configuration, make_trainer
from tidefield.processes import Ended

if TYPE_CHECKING:
    from rich.console import Console

    from tidefield.data.scene import Scene
    from tidefield.train.checkpoint import Run, TrainingProgress
    from tidefield.train.loop import Callback, Trainer

log = logging.getLogger(__name__)
_WHOLE_BYTES_PER_PX = 12_000
"""Of the square of the photographs' width; 2.8 GB in all were measured at 400 pixels, 16:9."""

AGAIN = "the same command with --resume"
USED_BEFORE = "the budget was used before: --minutes or --steps give a larger one"


@dataclass(frozen=True)
class Train:
    """Train on one scene and keep the result in a run folder.

    Ctrl-C saves before it stops; --resume continues from there.
    """

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder with posed photographs: a COLMAP model, transforms.json, a project of ODM or OpenSfM, Blender or LLFF."""
    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder for the result; must be new, unless --resume or --overwrite is given."""
    preset: Preset = "swift"
    """swift gives the best quality for the time; paper is the network as printed."""
    variant: str | None = None
    """Change one part of the preset, as `tidefield ablate` does."""
    method: TrainedMethod = "tidefield"
    """Train another method instead: classical NeRF; nerfstudio's nerfacto or splatfacto, which `tidefield baselines
    install nerfacto` installs; or OpenSplat, which you install."""
    budget: OmitArgPrefixes[Budget] = Budget()
    width: int | None = None
    """Width of the photographs in pixels; their own if not given."""
    device: Device = "auto"
    seed: int = 0
    """Of the weights and of the order of the photographs."""
    from_scratch: bool = False
    """Start from random weights instead of the installed trained ones."""
    weights: Path | None = None
    """Start from these weights, of `tidefield pretrain`."""
    resume: bool = False
    """Continue the run in the folder, to the end of its budget or of a new one, both from the run's start; one that has
    saved nothing yet starts again."""
    overwrite: bool = False
    """Replace the run in the folder."""
    opensplat: OpensplatProgram = None
    curve: bool = False
    """Render two held-out views at a quarter of their size from time to time, for a curve of quality against time; the
    time for it does not count."""
    view: bool = False
    """Show the training in a browser (`tidefield view`), on this machine only."""
    port: int = 8080
    """Port of --view; 0 for any that is free."""
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def train(options: Train, console: Console, again: str | None = None) -> None:
    """Run `tidefield train`; `again` says what continues a training that is interrupted."""
    from tidefield.compare.run import AGAIN_VARIABLE
    from tidefield.evaluation.curves import CURVE_FILE
    from tidefield.train.checkpoint import CHECKPOINT_FILE, RUN_FILE

    folder = options.run
    if options.resume and options.overwrite:
        raise RunError("--resume continues the run that --overwrite replaces: expected one of them; leave one out")
    with only_writer(folder):
        delete_partials(*(folder / name for name in (RUN_FILE, CHECKPOINT_FILE, CURVE_FILE)))
        _train(options, console, again or os.environ.get(AGAIN_VARIABLE, AGAIN))


def _train(options: Train, console: Console, again: str) -> None:
    from tidefield.device import choose_device
    from tidefield.evaluation.curves import make_curve
    from tidefield.progress import ProgressBar
    from tidefield.train.checkpoint import is_of, may_move, read_run, write_run
    from tidefield.train.loop import train as run_training

    budget, folder, weights = options.budget.checked(), options.run, None
    if options.view:
        from tidefield.viewer.ports import require_port

        need("viser", "view")
        require_port("127.0.0.1", options.port)
    device = choose_device(options.device)
    if options.resume:
        run = read_run(folder)  # its other options were settled when it was started
        scene_folder = Path(os.path.realpath(options.scene))
        if run.scene != scene_folder:
            if not may_move(run) or run.scene.exists():
                raise RunError(
                    f"{folder} was trained on {run.scene}, not on {options.scene}: expected the same scene; name it"
                )
            run = replace(run, scene=scene_folder)  # it was moved, if its poses are the same
        if isinstance(run.config, ExternalConfig):
            raise RunError(f"{run.config.method} cannot continue where it stopped: train it again, with --overwrite")
        _require_its_options(options, run)
        weights = _resumed_weights(options, run)
        if options.budget == Budget() and run.budget is not None:
            budget = run.budget.checked()
    else:
        run, weights = _new_run(options)
    if options.view and isinstance(run.config, ExternalConfig):
        raise RunError(f"{run.config.method} trains in a program of its own: --view shows our methods; leave it out")
    if options.curve and budget.minutes is None and isinstance(run.config, ExternalConfig):
        raise RunError(
            f"--curve was given with --steps: {run.config.method} has curves over minutes only; give --minutes, or "
            "leave --curve out"
        )
    scene = load(run.scene, run.width, options.allow_missing, console)
    if not scene.train:
        raise SceneError(f"{options.scene} has no training photographs: expected at least three; add photographs")
    curve = make_curve(scene) if options.curve else None
    start = f", starting from {weights}" if weights else ""
    log.info(f"{len(scene.train)} photographs, {len(scene.test)} held out; {run.config.method} on {device}{start}")
    if isinstance(run.config, ExternalConfig):
        from tidefield.baselines import opensplat
        from tidefield.baselines.nerfstudio import driver

        _start(folder, run, scene)
        with ProgressBar(console, "Training") as bar:

            def show(step: int, seconds: float) -> None:
                bar(budget.share(step, seconds), 1, f"step {step}  {step / max(seconds, 1e-9):.2f} steps/s")

            if isinstance(run.config, NerfstudioConfig):
                progress = driver.train(run.config.method, scene, folder, budget, run.seed, device, curve, show)
            else:
                program = opensplat.find(options.opensplat)
                progress = opensplat.train(program, scene, folder, budget, device, curve, show)
        stopped = None
    else:
        if options.resume and not is_of(run, scene):
            raise RunError(
                f"{options.scene} has other photographs or poses than when {folder} was started, or holds out others: "
                "expected the same; train again, with --overwrite"
            )
        trainer = make_trainer(run.config, scene, run.seed, device, weights)
        if options.resume:
            trainer.resume(folder)
            write_run(folder, replace(run, budget=budget))
            if curve is not None:
                curve.resume(folder, trainer.progress.seconds)
        else:
            _start(folder, run, scene)
        used = budget.share(trainer.progress.step, trainer.progress.seconds)
        callback = curve and curve.watch(folder, used)
        with ExitStack() as stack:
            if options.view:
                from tidefield.viewer.training import TrainingPage

                page = stack.enter_context(TrainingPage(trainer, folder.resolve().name, "127.0.0.1", options.port))
                console.print(f"{page.page.address} shows it", highlight=False, soft_wrap=True)
                callback = _both(callback, page)
            if used >= 1:
                console.print(USED_BEFORE, highlight=False)
            stopped, progress = run_training(trainer, folder, budget, console, callback), trainer.progress
        few = isinstance(run.config, Config) and progress.step < run.config.train.warm_up
        if few and budget.minutes is not None and stopped is None:
            log.warning(
                f"{progress.step} steps change little: expected hundreds; give more --minutes, or a smaller --width"
            )
    report_end(progress, stopped, folder, console, budget, again)


def _both(first: Callback | None, second: Callback) -> Callback:
    """Call one callback after the other."""
    if first is None:
        return second

    def call(trainer: Trainer, used: float) -> None:
        first(trainer, used)
        second(trainer, used)

    return call


def report_end(
    progress: TrainingProgress,
    stopped: int | None,
    folder: Path,
    console: Console,
    budget: Budget,
    again: str = AGAIN,
) -> None:
    """Print what was done; a training that a signal stopped ends its command as the signal does, and `again` says what
    continues it, if some of the budget is left."""
    console.print(f"{progress.step} steps in {progress.seconds / 60:.1f} minutes, kept in {folder}", highlight=False)
    if stopped is not None:
        left = budget.share(progress.step, progress.seconds) < 1
        console.print(f"interrupted; {again} continues" if left else "interrupted")
        raise Ended(stopped)


def _start(folder: Path, run: Run, scene: Scene) -> None:
    """Write run.json, after what an earlier run in the folder has left is deleted: it is not of this run."""
    from tidefield.baselines import opensplat
    from tidefield.baselines.nerfstudio import driver
    from tidefield.data.scene import poses_key
    from tidefield.evaluation.curves import CURVE_FILE
    from tidefield.evaluation.evaluate import delete_evaluation
    from tidefield.train.checkpoint import CHECKPOINT_FILE, write_run

    events = folder.glob("tensorboard/events.out.tfevents.*")
    delete_files(folder, [folder / CHECKPOINT_FILE, folder / CURVE_FILE, *events])
    driver.delete_training(folder)
    opensplat.delete_training(folder)
    delete_evaluation(folder, scene.names)
    poses = poses_key(scene.names, scene.cameras.T_world_camera, scene.held_out)
    write_run(folder, replace(run, poses=poses, held_out=scene.held_out))


def _require_its_options(options: Train, run: Run) -> None:
    """Raises: RunError when a run is to be continued with options that are not its own."""
    from tidefield.train.checkpoint import weights_sha256

    others = []
    if options.width not in (None, run.width):
        others.append(f"--width {options.width}")
    if options.seed not in (0, run.seed):
        others.append(f"--seed {options.seed}")
    # By name: a preset may have other numbers than when the run was started.
    preset = run.config.preset if isinstance(run.config, Config) else options.preset
    for name, usual, own in (
        ("method", "tidefield", run.config.method),
        ("preset", "swift", preset),
        ("variant", None, _variant_of(run, preset, options.variant)),
    ):
        if getattr(options, name) not in (usual, own):
            others.append(f"--{name} {getattr(options, name)}")
    if options.from_scratch and run.weights is not None:
        others.append("--from-scratch")
    if options.weights is not None and weights_sha256(options.weights) != run.weights:
        others.append(f"--weights {options.weights}")
    if others:
        raise RunError(
            f"{options.run} was not started with {', '.join(others)}: expected its own options with --resume; leave "
            f"{'it' if len(others) == 1 else 'them'} out"
        )


def _variant_of(run: Run, preset: str, asked: str | None) -> str | None:
    """The variant that a run was started with; those of older versions do not name it, and may be the one asked for."""
    if run.variant is None and asked is not None:
        return asked if vary(PRESETS[preset], asked) == run.config else None
    return run.variant


def _resumed_weights(options: Train, run: Run) -> Path | None:
    """The weights that a run started from, if it must start again because it has saved nothing yet.

    Raises:
        RunError: they are not those that are named or installed.
    """
    from tidefield.train.checkpoint import CHECKPOINT_FILE, given_or_shipped, weights_sha256

    if run.weights is None or (options.run / CHECKPOINT_FILE).exists():
        return None
    assert isinstance(run.config, Config), "only our networks start from weights"
    weights = given_or_shipped(options.weights, run.config.preset)
    if weights_sha256(weights) != run.weights:
        raise RunError(
            f"{options.run} has saved nothing, and started from other weights than {weights}: expected those with the "
            f"SHA-256 {run.weights}; name them with --weights, or train with --overwrite"
        )
    return weights


def _new_run(options: Train) -> tuple[Run, Path | None]:
    """A new run, and the weights it starts from: the named ones, else the installed ones of its network."""
    from tidefield.train.checkpoint import Run, read_weights_file, shipped_weights, weights_sha256

    _require_free(options.run, options.overwrite)
    weights, config = options.weights, _configuration(options)
    from_random = options.from_scratch or not isinstance(config, Config)
    if weights is not None and from_random:
        raise RunError(
            "--weights is given for a training that starts without (--from-scratch, another method, or a variant that "
            "is one): expected one or the other; leave one out"
        )
    if weights is not None:
        read_weights_file(weights)  # before photographs are read, which may take minutes
    elif not options.from_scratch and isinstance(config, Config):
        weights = shipped_weights(config.preset) if config.network == PRESETS[config.preset].network else None
    digest = None if weights is None else weights_sha256(weights)
    root = Path(os.path.realpath(options.scene))
    if isinstance(config, Config) and config.train.crop_px is None:
        _warn_of_whole(root, options)
    seed, budget = checked_seed(options.seed), options.budget.checked()
    return Run(root, options.width, seed, config, digest, options.variant, budget=budget), weights


def _warn_of_whole(root: Path, options: Train) -> None:
    """Warn of the memory of a network that encodes photographs whole: where it runs out, nothing else says why."""
    from tidefield.data.load import own_lens, read_posed
    from tidefield.train.stream import WHOLE_WIDTHS

    most = max(WHOLE_WIDTHS)
    if options.width is not None and options.width <= most:
        return
    posed = read_posed(root, options.allow_missing)  # before photographs are decoded, which may take minutes
    own = max(own_lens(path, lens)[0].width for path, lens in zip(posed.paths, posed.lenses, strict=True))
    width = min(options.width or own, own)
    if width > most:
        log.warning(
            f"{options.preset} encodes whole photographs, here of {width} pixels, which takes about "
            f"{_WHOLE_BYTES_PER_PX * width**2 / 1e9:.0f} GB: give --width {most} if that is too much"
        )


def _configuration(options: Train) -> AnyConfig:
    """What is to be trained."""
    config = configuration(options.method, options.preset, options.opensplat)
    if options.variant is None:
        return config
    if not isinstance(config, Config):
        raise RunError(f"--variant changes our presets, not {options.method}: expected one of them; leave one out")
    return vary(config, options.variant)


def _require_free(folder: Path, overwrite: bool) -> None:
    """Raises: RunError when a folder holds a run, or other files that a run would be mixed with."""
    from tidefield.train.checkpoint import RUN_FILE

    if (folder / RUN_FILE).exists():
        if not overwrite:
            raise RunError(
                f"{folder} holds a run: expected a new folder; choose another, or add --resume or --overwrite"
            )
    elif not is_empty(folder):
        raise RunError(f"{folder} holds other files: expected a new or empty folder; choose a new name")
    require_writable(folder / RUN_FILE, overwrite=True)
