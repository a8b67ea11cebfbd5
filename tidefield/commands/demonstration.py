"""`tidefield demo`: all of it on a built-in scene."""

from __future__ import annotations

import shutil

from rich.console import Console

from tidefield.commands.training import train
from tidefield.commands.views import evaluate, render
from tidefield.errors import RunError
from tidefield.options import Demo, Evaluate, Length, Render, Train
from tidefield.train.checkpoint import CHECKPOINT_FILE

FRAMES = 72
PICTURE = "river_mouths_0033.png"
"""Of the held-out photographs of the built-in scene, the one with a creek, its banks and plants."""


def demo(options: Demo, console: Console) -> None:
    """See `tidefield demo --help`."""
    from tidefield.synthetic import make_survey, write_survey

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
        train(Train(scene, run, length=Length(options.minutes), device=device, overwrite=True), console)
    evaluate(Evaluate(run, device=device, overwrite=True), console)
    render(Render(run, video, path="cameras", frames=FRAMES, device=device, overwrite=True), console)
    shutil.copyfile(run / "pictures" / PICTURE, picture)
    console.print("\nWhat was made:")
    for what, path in (
        ("the survey, as COLMAP scene", scene),
        ("the numbers", run / "evaluation.json"),
        ("truth | rendering | error | depth", picture),
        ("more of these", run / "pictures"),
        ("the fly-through", video),
    ):
        console.print(f"  {what:<34} {path.resolve()}", highlight=False, soft_wrap=True)
