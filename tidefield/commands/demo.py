"""`tidefield demo`: the whole job on the built-in scene."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import Device, Verbosity, ZeroShot
from tidefield.commands.evaluate import Evaluate, evaluate
from tidefield.commands.render import Render, render
from tidefield.commands.train import Train, train
from tidefield.config import Budget
from tidefield.errors import RunError, list_names
from tidefield.files import completed_file, only_writer, read_json, write_json

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
    """Start anew in a folder that holds a demonstration, and replace what that made; without it, nothing is replaced:
    what is there is used and completed."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def demo(options: Demo, console: Console) -> None:
    """Run `tidefield demo`."""
    from tidefield.device import choose_device

    Budget(options.minutes).checked()  # before a survey is made for nothing
    choose_device(options.device)
    with only_writer(options.out):
        _demo(options, console)


def _demo(options: Demo, console: Console) -> None:
    from tidefield.compare.run import make_flat
    from tidefield.train.checkpoint import CHECKPOINT_FILE

    out, device = options.out, options.device
    products = ("scene", "run", "creek.json", "first-view.png", "flight.mp4", "side-by-side.png")
    scene, run, path, first, video, picture = (out / name for name in products)
    made = Made(out, (*products, "first-view_depth.npy", "first-view_depth.png"))
    made.require_own(options.overwrite)
    if options.overwrite:
        made.delete()
    if not scene.exists():
        console.print("Making a survey of a tidal flat ...")
        with made.making():
            make_flat(scene, "river_mouths", seed=7, views=40, width=SURVEY_WIDTH)
    if not first.exists():
        console.print("A first view, with trained weights that have never seen this place:")
        view = Render(scene, first, camera=PHOTOGRAPH, zero=ZeroShot(True), width=TRAINING_WIDTH, device=device)
        with made.making():  # the picture is the last of its three files
            render(replace(view, overwrite="first-view_depth.npy" in made.files), console)
    with made.making():
        if not (run / "evaluation.json").exists():
            budget, resume = Budget(options.minutes), (run / CHECKPOINT_FILE).exists()
            training = Train(scene, run, budget=budget, width=TRAINING_WIDTH, device=device)
            train(replace(training, resume=resume, overwrite=not resume), console, "the same command")
            evaluate(Evaluate(run, device=device), console)
        if not video.exists():
            if not path.exists():
                write_json(path, creek_flight())
            render(Render(run, video, path=str(path), device=device), console)
        if not picture.exists():
            with completed_file(picture) as partial:
                shutil.copyfile(run / "pictures" / f"{PHOTOGRAPH}.png", partial)
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


class Made:
    """What a demonstration has made in its folder, which OUT/demonstration.json lists; the rest is the user's.

    Args:
        out: the folder.
        names: that the demonstration makes in it.

    Raises:
        RunError: the list is damaged.
    """

    def __init__(self, out: Path, names: Sequence[str]) -> None:
        self.out, self.names, self.file = out, names, out / "demonstration.json"
        record = read_json(self.file) or {"files": [], "unfinished": False}
        try:
            self.files, unfinished = {str(name) for name in record["files"]}, bool(record["unfinished"])
            self.others = {str(name) for name in record.get("others", [])}
        except (KeyError, TypeError) as error:
            raise RunError(f"{self.file} is damaged: expected a list of files; choose another folder") from error
        if unfinished:  # it was killed, and what is new was being made
            self.files |= self._present() - self.others
            for name in names:
                for partial in out.glob(f".{Path(name).stem}-????????.partial*"):
                    _delete(partial)

    def require_own(self, overwrite: bool) -> None:
        """Raise a RunError when the names are a user's, or when there are files of a user's in what is overwritten."""
        foreign = sorted(self._present() - self.files)
        if foreign and (overwrite or not self.file.exists()):
            raise RunError(
                f"{self.out} holds what no demonstration made ({list_names(foreign)}): expected a new folder or one of "
                "a demonstration; move these files, or choose another folder"
            )

    @contextmanager
    def making(self) -> Iterator[None]:
        """Record what is made in the block, even if it is interrupted; what others put there before is not."""
        self.others = self._present() - self.files
        self._write(unfinished=True)
        try:
            yield
        finally:
            self.files |= self._present() - self.others
            self.others.clear()
            self._write(unfinished=False)

    def delete(self) -> None:
        """Delete what was made."""
        self._write(unfinished=True)
        for name in self.names:
            _delete(self.out / name)
        self.files.clear()
        self._write(unfinished=False)

    def _present(self) -> set[str]:
        """Files, links and empty folders below the names."""
        found: set[str] = set()
        for place in (self.out / name for name in self.names):
            inside = sorted(place.rglob("*")) if place.is_dir() and not place.is_symlink() else []
            found |= {p.relative_to(self.out).as_posix() for p in inside if p.is_symlink() or not p.is_dir()}
            if os.path.lexists(place) and not inside:
                found.add(place.relative_to(self.out).as_posix())
        return found

    def _write(self, unfinished: bool) -> None:
        write_json(self.file, {"files": sorted(self.files), "others": sorted(self.others), "unfinished": unfinished})


def _delete(place: Path) -> None:
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)


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
