"""`tidefield evaluate`: measure a method on held-out photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import (
    AllowMissing,
    Device,
    Footprint,
    UntrainedMethod,
    Verbosity,
    ZeroShot,
    load,
    open_trained,
    open_zero_shot,
)
from tidefield.errors import RunError, list_names
from tidefield.evaluation import EVALUATION_FILE
from tidefield.files import require_writable
from tidefield.methods import UNTRAINED_DEVICE, untrained

if TYPE_CHECKING:
    from rich.console import Console

    from tidefield.data.scene import Scene
    from tidefield.evaluation.evaluate import Evaluation


@dataclass(frozen=True)
class Evaluate:
    """Compare renderings of the held-out photographs with the photographs.

    Writes evaluation.json and pictures: `tidefield evaluate RUN` into the run, `tidefield evaluate SCENE OUT --method
    sparse-depth` into a folder of its own, for methods that need no training.
    """

    source: Annotated[Positional[Path], arg(metavar="RUN|SCENE")]
    """A run, or with --method or --zero-shot a scene."""
    out: Annotated[Positional[Path | None], arg(metavar="[OUT]")] = None
    """Where to write; the run itself if not given."""
    method: UntrainedMethod | None = None
    """Evaluate this method on a scene instead of a run."""
    zero: OmitArgPrefixes[ZeroShot] = ZeroShot()
    footprint: OmitArgPrefixes[Footprint] = Footprint()
    width: int | None = None
    """Width of the photographs in pixels to compare at. With --method and --zero-shot the scene is opened at it; a run
    renders from its own, and finer or coarser ones where they are better."""
    opened_width: int | None = None
    """With --zero-shot: width that the scene is opened at, as a run is trained at one, if another than --width."""
    device: Device = "auto"
    download_lpips: bool = False
    """Download the weights that LPIPS needs (AlexNet 233 MB, VGG 528 MB) if they are missing."""
    overwrite: bool = False
    """Replace an existing evaluation."""
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def evaluate(options: Evaluate, console: Console) -> Evaluation:
    """Run `tidefield evaluate`."""
    from tidefield.device import choose_device
    from tidefield.evaluation.evaluate import evaluate as evaluate_method

    source, out, method, zero_shot = options.source, options.out, options.method, options.zero.checked().zero_shot
    sampling = options.footprint.sampling
    settings = {"overwrite": options.overwrite, "console": console, "download_lpips": options.download_lpips}
    settings["goes_on"] = not options.overwrite
    if method is not None and zero_shot:
        raise RunError("both --method and --zero-shot are given: expected one of them; leave one out")
    if options.opened_width is not None and not zero_shot:
        raise RunError("--opened-width belongs to --zero-shot: others have one width; leave it out")
    if method is None and not zero_shot:
        if options.width is not None and out is None:
            raise RunError(
                f"--width is given without OUT: expected `tidefield evaluate {source} OUT --width {options.width}`, "
                "as the run itself keeps the evaluation at its own width; name a folder"
            )
        require_writable((out or source) / EVALUATION_FILE, overwrite=options.overwrite)
        opened = open_trained(source, choose_device(options.device), options.allow_missing, console, sampling)
        with opened as (scene, render, record):
            _refuse_learned(source, scene.held_out)
            truth = _at_width(scene, options.width, console)
            return evaluate_method(render, truth, out or source, configuration=record, **settings)
    if method is not None and options.device not in ("auto", UNTRAINED_DEVICE):
        raise RunError(
            f"--device {options.device} is given with --method {method}: methods without training run on the "
            "processor; leave it out"
        )
    if out is None:
        raise RunError(f"nowhere to write: expected `tidefield evaluate {source} OUT ...`; name a folder")
    require_writable(out / EVALUATION_FILE, overwrite=options.overwrite)
    if zero_shot:
        options.zero.require_weights()
    scene = load(source, options.opened_width or options.width, options.allow_missing, console)
    if method is not None:
        side = sampling.rays_per_side or 1
        record = {"method": method, **({"rays_per_side": side} if side > 1 else {})}
        render = untrained(method, scene, sampling)
        return evaluate_method(render, scene, out, configuration=record, **settings)
    render, record = open_zero_shot(options.zero, scene, choose_device(options.device), sampling)
    if options.opened_width is not None:
        record["opened_width"] = options.opened_width
    truth = scene if options.opened_width is None else _at_width(scene, options.width, console)
    return evaluate_method(render, truth, out, configuration=record, **settings)


def _at_width(scene: Scene, width: int | None, console: Console) -> Scene:
    """The scene at a width, with progress while photographs are decoded; as it is if None is given."""
    from tidefield.data.load import at_width
    from tidefield.progress import ProgressBar

    if width is None:
        return scene
    with ProgressBar(console, "Reading photographs") as bar:
        return at_width(scene, width, bar)


def _refuse_learned(folder: Path, held_out: Sequence[str]) -> None:
    """Raises: RunError when a run may have learned from photographs that its scene holds out now."""
    from tidefield.train.checkpoint import read_run

    kept = read_run(folder).held_out
    learned = [] if kept is None else [name for name in held_out if name not in kept]
    if learned:
        raise RunError(
            f"{folder} was trained when {list_names(learned)} {'was' if len(learned) == 1 else 'were'} not held out: "
            "expected photographs that it did not learn from; train it again (--overwrite)"
        )
