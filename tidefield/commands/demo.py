"""`tidefield demo`: the whole job on the built-in scene."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import Device, Verbosity
from tidefield.commands.evaluate import Evaluate, evaluate
from tidefield.commands.render import Render, render
from tidefield.commands.train import Train, train
from tidefield.config import Budget
from tidefield.errors import RunError

if TYPE_CHECKING:
    from rich.console import Console

FRAMES = 72
PICTURE = "river_mouths_0033.png"
"""Of the held-out photographs of the built-in scene, the one with a creek, its banks and plants."""


@dataclass(frozen=True)
class Demo:
    """The whole job on the built-in scene: make a survey of a tidal flat, train, evaluate, and render a fly-through."""

    out: Annotated[Positional[Path], arg(metavar="[OUT]")] = Path("tidefield-demo")
    """Folder to write to."""
    minutes: float = 3.0
    """Minutes of training."""
    device: Device = "auto"
    overwrite: bool = False
    """Start anew in a folder that holds a demonstration; without it, what is there is used and completed."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def demo(options: Demo, console: Console) -> None:
    """Run `tidefield demo`."""
    from tidefield.synthetic import make_survey, write_survey
    from tidefield.train.checkpoint import CHECKPOINT_FILE

    out, device = options.out, options.device
    if options.overwrite and out.exists():
        if not (out / "scene" / "truth").is_dir():
            raise RunError(f"{out} holds no demonstration: expected one to replace; choose another folder")
        shutil.rmtree(out)
    scene, run, video, picture = (out / name for name in ("scene", "run", "fly-through.mp4", "side-by-side.png"))
    if not scene.exists():
        console.print("Making a survey of a tidal flat ...")
        partial = out / "scene.partial"
        shutil.rmtree(partial, ignore_errors=True)
        write_survey(make_survey("river_mouths", seed=7, views=40, width=320), partial)
        partial.rename(scene)
    if not (run / CHECKPOINT_FILE).exists():
        train(Train(scene, run, budget=Budget(options.minutes), device=device, overwrite=True), console)
    evaluate(Evaluate(run, device=device, overwrite=True), console)
    render(Render(run, video, path="cameras", frames=FRAMES, device=device, overwrite=True), console)
    shutil.copyfile(run / "pictures" / PICTURE, picture)
    console.print("\nWritten:")
    for what, path in (
        ("the survey, as COLMAP scene", scene),
        ("the metrics", run / "evaluation.json"),
        ("truth | rendering | error | depth", picture),
        ("more of these", run / "pictures"),
        ("the fly-through", video),
    ):
        console.print(f"  {what:<34} {path.resolve()}", highlight=False, soft_wrap=True)
