"""`tidefield export`: Gaussians for other programs' viewers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import AllowMissing, Device, Verbosity, ZeroShot, open_source
from tidefield.config import Sampling
from tidefield.errors import RunError
from tidefield.files import require_writable

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Export:
    """Export a run, or with --zero-shot a scene, as Gaussians (PLY, as in 3D Gaussian splatting).

    Every pixel of the training photographs' views becomes a flat Gaussian, unless other views see through it; nothing
    is optimised. Lost are colours that change with the direction (reflections on water), what is finer than a pixel of
    --width, and what no photograph shows. `tidefield render` shows all of it; docs/view.md has figures.
    """

    source: Annotated[Positional[Path], arg(metavar="RUN|SCENE")]
    """A trained run, or with --zero-shot a scene."""
    out: Annotated[Positional[Path], arg(metavar="OUT.ply")]
    """The file to write."""
    zero: OmitArgPrefixes[ZeroShot] = ZeroShot()
    width: int = 400
    """Longer side of the views that are rendered, in pixels: twice as many are four times as many Gaussians."""
    device: Device = "auto"
    overwrite: bool = False
    """Replace an existing file."""
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def export(options: Export, console: Console) -> None:
    """Run `tidefield export`."""
    from tidefield.device import choose_device
    from tidefield.progress import ProgressBar
    from tidefield.render.gaussians import make_gaussians, write_gaussians

    if options.out.suffix.lower() != ".ply":
        raise RunError(f"{options.out.name} was asked for: Gaussians are written as .ply; change the name")
    if not 32 <= options.width <= 4096:
        raise RunError(f"--width {options.width} was asked for: expected 32 to 4096 pixels; choose another")
    require_writable(options.out, overwrite=options.overwrite)
    device = choose_device(options.device)
    # Pixels that share a cell are averaged anyway: several rays for each would take several times as long.
    sampling = Sampling(rays_per_side=1)
    opened = open_source(options.source, options.zero, device, options.allow_missing, console, sampling)
    with opened as (scene, render, _), ProgressBar(console, "Rendering") as bar:
        found = make_gaussians(render, scene.cameras[list(scene.train)], options.width, bar)
    write_gaussians(found, options.out, scene.origin_world.tolist(), options.overwrite)
    console.print(f"{options.out}: {len(found.mean_world):,} Gaussians", highlight=False, soft_wrap=True)
