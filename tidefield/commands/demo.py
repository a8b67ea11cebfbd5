"""`tidefield demo`: the whole job on the built-in scene."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import Device, Verbosity, ZeroShot
from tidefield.commands.evaluate import Evaluate, evaluate
from tidefield.commands.render import Render, render
from tidefield.commands.train import Train, train
from tidefield.config import Budget
from tidefield.errors import RunError
from tidefield.files import write_json

if TYPE_CHECKING:
    from rich.console import Console

SURVEY_WIDTH = 640
TRAINING_WIDTH = 480
PHOTOGRAPH = "river_mouths_0033"
"""Of the held-out photographs of the built-in scene, the one with a creek, its banks and plants."""
FRAMES, FRAMES_PER_SECOND = 32, 8
FLIGHT_SIZE = 640, 360
FIELD_OF_VIEW_DEG = 40.0
"""Vertical."""
EYES = ((30.0, -24.0, 29.0), (27.0, -4.0, 26.0), (22.0, 9.0, 25.0))
TARGETS = ((18.0, 6.0, 0.0), (20.0, 24.0, 0.0), (15.0, 31.0, 0.0))
"""Where the flight along the creek is at its start, in its middle and at its end, and the ground it looks at: metres
east, north and above the mud of the built-in scene."""


@dataclass(frozen=True)
class Demo:
    """The whole job on a built-in scene: a survey of a tidal flat, a first view, training, evaluation and a flight."""

    out: Annotated[Positional[Path], arg(metavar="[OUT]")] = Path("tidefield-demo")
    """Folder to write to."""
    minutes: float = 1.0
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
    scene, run, path = (out / name for name in ("scene", "run", "creek.json"))
    first, video, picture = (out / name for name in ("first-view.png", "flight.mp4", "side-by-side.png"))
    if not scene.exists():
        console.print("Making a survey of a tidal flat ...")
        partial = out / "scene.partial"
        shutil.rmtree(partial, ignore_errors=True)
        write_survey(make_survey("river_mouths", seed=7, views=40, width=SURVEY_WIDTH), partial)
        partial.rename(scene)
    if not first.exists():
        console.print("A first view, with trained weights that have never seen this place:")
        zero_shot = ZeroShot(zero_shot=True)
        render(Render(scene, first, camera=PHOTOGRAPH, zero=zero_shot, width=TRAINING_WIDTH, device=device), console)
    if not (run / CHECKPOINT_FILE).exists():
        budget = Budget(options.minutes)
        train(Train(scene, run, budget=budget, width=TRAINING_WIDTH, device=device, overwrite=True), console)
    evaluate(Evaluate(run, device=device, overwrite=True), console)
    write_json(path, creek_flight())
    render(Render(run, video, path=str(path), device=device, overwrite=True), console)
    shutil.copyfile(run / "pictures" / f"{PHOTOGRAPH}.png", picture)
    console.print("\nWritten:")
    for what, file in (
        ("the survey, as COLMAP scene", scene),
        ("the first view, without training", first),
        ("the metrics", run / "evaluation.json"),
        ("truth | rendering | error | depth", picture),
        ("more of these", run / "pictures"),
        ("the flight along the creek", video),
    ):
        console.print(f"  {what:<34} {file.resolve()}", highlight=False, soft_wrap=True)


def creek_flight() -> dict[str, Any]:
    """An oblique flight up the creek of the built-in scene, as a camera path of nerfstudio's viewer."""
    import numpy as np
    from scipy.interpolate import BarycentricInterpolator

    from tidefield.render.camera_paths import look_along

    # A parabola through the three points, from rest to rest.
    time = np.linspace(0, 1, FRAMES)
    time = time**2 * (3 - 2 * time)
    eyes, targets = (BarycentricInterpolator([0, 0.5, 1], points)(time) for points in (EYES, TARGETS))
    pose = np.tile(np.eye(4), (FRAMES, 1, 1))
    pose[:, :3, :3] = look_along(targets - eyes, np.array([0.0, 0.0, 1.0])) * (1, -1, -1)  # OpenGL's y and z
    pose[:, :3, 3] = eyes
    frames = [{"camera_to_world": matrix.flatten().tolist(), "fov": FIELD_OF_VIEW_DEG} for matrix in pose]
    width, height = FLIGHT_SIZE
    return {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": FRAMES_PER_SECOND,
        "camera_path": frames,
    }
