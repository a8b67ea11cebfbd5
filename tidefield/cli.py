"""The command line: `tidefield train | evaluate | render | demo`.

Only what is needed to answer --help is imported here; torch and the rest are imported inside the commands.
"""

from __future__ import annotations

import logging
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from tidefield.errors import TidefieldError

if TYPE_CHECKING:
    from rich.console import Console

Preset = Literal["swift", "paper"]
Method = Literal["plane-sweep", "sparse-depth"]


@dataclass(frozen=True)
class Talk:
    """How much is said."""

    verbose: Annotated[bool, arg(aliases=["-v"])] = False
    """Say more."""
    quiet: Annotated[bool, arg(aliases=["-q"])] = False
    """Say nothing but errors."""


def train(
    scene: Annotated[Positional[Path], arg(metavar="SCENE")],
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    /,
    preset: Preset = "swift",
    minutes: float | None = None,
    steps: int | None = None,
    width: int | None = None,
    device: str = "auto",
    seed: int = 0,
    field: bool = False,
    resume: bool = False,
    overwrite: bool = False,
    allow_missing: bool = False,
    talk: tyro.conf.OmitArgPrefixes[Talk] = Talk(),
) -> None:
    """Train on one scene and keep the result in a run folder.

    Ctrl-C saves before it stops; --resume goes on from there.

    Args:
        scene: Folder with posed photographs: a COLMAP model, transforms.json, a Blender scene or LLFF.
        run: Folder for the result; must be new, unless --resume or --overwrite is given.
        preset: swift is the best quality for the time; paper is the network as printed.
        minutes: Train for so long; 10 if neither this nor --steps is given.
        steps: Train for so many steps instead.
        width: Width of the photographs in pixels; their own if not given.
        device: auto, cpu, cuda, cuda:N or mps.
        seed: Of the weights and of the order of the photographs.
        field: Add the per-scene field (a hash grid) to what the neighbours say.
        resume: Go on with the run that is in the folder.
        overwrite: Replace the run that is in the folder.
        allow_missing: Go on without photographs that the scene names but does not have.
        talk: How much is said.
    """
    from tidefield import commands

    console = _begin(talk)
    commands.train(
        scene,
        run,
        preset=preset,
        minutes=minutes,
        steps=steps,
        width=width,
        device=device,
        seed=seed,
        field=field,
        resume=resume,
        overwrite=overwrite,
        allow_missing=allow_missing,
        console=console,
    )


def evaluate(
    path: Annotated[Positional[Path], arg(metavar="RUN|SCENE")],
    out: Annotated[Positional[Path | None], arg(metavar="[OUT]")] = None,
    /,
    method: Method | None = None,
    width: int | None = None,
    device: str = "auto",
    download_lpips: bool = False,
    overwrite: bool = False,
    allow_missing: bool = False,
    talk: tyro.conf.OmitArgPrefixes[Talk] = Talk(),
) -> None:
    """Compare renderings of the held-out photographs with the photographs.

    Writes evaluation.json and pictures: `tidefield evaluate RUN` into the run, `tidefield evaluate SCENE OUT --method
    sparse-depth` into a folder of its own, for methods that need no training.

    Args:
        path: A run, or with --method a scene.
        out: Where to write; the run itself if not given.
        method: Evaluate this method on a scene instead of a run.
        width: Width of the photographs in pixels, with --method; a run knows its own.
        device: auto, cpu, cuda, cuda:N or mps.
        download_lpips: Fetch the weights that LPIPS needs (AlexNet 233 MB, VGG 528 MB) if they are not there.
        overwrite: Replace an evaluation that is there.
        allow_missing: Go on without photographs that the scene names but does not have.
        talk: How much is said.
    """
    from tidefield import commands

    console = _begin(talk)
    commands.evaluate(
        path,
        out,
        method=method,
        width=width,
        device=device,
        download_lpips=download_lpips,
        overwrite=overwrite,
        allow_missing=allow_missing,
        console=console,
    )


def render(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    out: Annotated[Positional[Path], arg(metavar="OUT")],
    /,
    path: str = "orbit",
    camera: str | None = None,
    frames: int = 240,
    width: int | None = None,
    height: int | None = None,
    device: str = "auto",
    overwrite: bool = False,
    allow_missing: bool = False,
    talk: tyro.conf.OmitArgPrefixes[Talk] = Talk(),
) -> None:
    """Render a video along a path (OUT.mp4), or the view of one photograph's camera with its depth (OUT.png).

    Args:
        run: A trained run.
        out: The file to write; .mp4 for a video, .png with --camera.
        path: orbit, cameras (a flight among the photographs), strip (straight down, along the survey), or a camera-path
            JSON as nerfstudio's viewer exports it.
        camera: Name of a photograph whose camera is rendered instead of a path.
        frames: Frames of the video; 24 are a second.
        width: Width of the picture in pixels; that of the run's photographs if not given.
        height: Height of the picture in pixels; in proportion to the width if not given.
        device: auto, cpu, cuda, cuda:N or mps.
        overwrite: Replace files that are there.
        allow_missing: Go on without photographs that the scene names but does not have.
        talk: How much is said.
    """
    from tidefield import commands

    console = _begin(talk)
    commands.render(
        run,
        out,
        path=path,
        camera=camera,
        frames=frames,
        width=width,
        height=height,
        device=device,
        overwrite=overwrite,
        allow_missing=allow_missing,
        console=console,
    )


def demo(
    out: Annotated[Positional[Path], arg(metavar="[OUT]")] = Path("tidefield-demo"),
    /,
    minutes: float = 3.0,
    device: str = "auto",
    overwrite: bool = False,
    talk: tyro.conf.OmitArgPrefixes[Talk] = Talk(),
) -> None:
    """The whole job on a built-in scene: make a survey of a tidal flat, train, evaluate, and render a fly-through.

    Args:
        out: Folder to write to.
        minutes: Minutes of training.
        device: auto, cpu, cuda, cuda:N or mps.
        overwrite: Begin anew in a folder that holds a demonstration; without it, what is there is used and finished.
        talk: How much is said.
    """
    from tidefield import commands

    commands.demo(out, minutes=minutes, device=device, overwrite=overwrite, console=_begin(talk))


def _begin(talk: Talk) -> Console:
    """Set up messages; returns the console that commands print to."""
    # Before torch is imported: threads that wait spinning for work take the cores from those that have some, and on a
    # busy machine a step takes ten times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from rich.console import Console
    from rich.logging import RichHandler

    from tidefield.device import keep_large_allocations

    console = Console(quiet=talk.quiet)
    level = logging.ERROR if talk.quiet else logging.DEBUG if talk.verbose else logging.INFO
    handler = RichHandler(console=Console(stderr=True), show_path=False, show_level=False, log_time_format="%H:%M:%S")
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[handler], force=True)
    logging.getLogger("tidefield").setLevel(level)
    keep_large_allocations()
    return console


def main() -> None:
    """Entry point: exit status 0, 2 for a user's mistake, 130 after an interruption."""
    commands = {"train": train, "evaluate": evaluate, "render": render, "demo": demo}
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands, prog="tidefield", description="New views of tidal flats from drone photographs."
        )
    except TidefieldError as error:
        print(f"tidefield: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("tidefield: interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        # The reader, such as `head`, has seen enough. Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)


if __name__ == "__main__":
    main()
