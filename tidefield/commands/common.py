"""Options that several commands share, and how a run or a scene is opened."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg
from tyro.extras import literal_type_from_choices

from tidefield.config import PRESETS, USUAL_SAMPLING, Sampling, config_to_json
from tidefield.errors import RunError
from tidefield.methods import names

if TYPE_CHECKING:
    import torch
    from rich.console import Console

    from tidefield.data.scene import Scene
    from tidefield.model.rendering import Render

Preset = Literal["swift", "paper"]
Device = Annotated[str, arg(help="auto, cpu, cuda, cuda:N or mps.")]
AllowMissing = Annotated[bool, arg(help="Continue without photographs that the scene names but does not have.")]
Cluster = Annotated[
    str | None,
    arg(
        metavar="auto|ADDRESS",
        help="Work on a Ray cluster, which sees the same folders: `auto` is the running one, or one started on this "
        "machine; else its address, such as 10.0.0.1:6379. Needs pip install 'tidefield[cluster]'.",
    ),
]
OpensplatProgram = Annotated[
    Path | None,
    arg(help="OpenSplat; if not given, the program that $TIDEFIELD_OPENSPLAT names, or opensplat of PATH."),
]
Downscale = Annotated[
    tuple[int, ...],
    arg(
        metavar="[N [N ...]]",
        help="Also write the photographs at an Nth of their size, as images_N (masks as masks_N), which nerfstudio and "
        "gsplat open.",
    ),
]


if TYPE_CHECKING:
    TrainedMethod = UntrainedMethod = AnyMethod = str
else:
    TrainedMethod = literal_type_from_choices(["tidefield", *names("nerf", "nerfstudio", "opensplat")])
    UntrainedMethod = literal_type_from_choices(names("untrained"))
    AnyMethod = literal_type_from_choices(names())


@dataclass(frozen=True)
class Verbosity:
    """How much is printed."""

    verbose: Annotated[bool, arg(aliases=["-v"])] = False
    """Print more."""
    quiet: Annotated[bool, arg(aliases=["-q"])] = False
    """Print nothing but errors."""


@dataclass(frozen=True)
class ZeroShot:
    """Trained weights on a scene they were not trained on, instead of a run."""

    zero_shot: bool = False
    """Use a scene with trained weights, without training on it."""
    preset: Preset | None = None
    """The network; swift if not given."""
    weights: Path | None = None
    """Its weights, of `tidefield pretrain`; the installed ones if not given."""

    @property
    def network(self) -> Preset:
        return self.preset or "swift"

    @property
    def words(self) -> list[str]:
        """These options as words of a command line, without the folder of the weights."""
        words = ["--zero-shot"] if self.zero_shot else []
        words += [] if self.preset is None else ["--preset", self.preset]
        return words + ([] if self.weights is None else ["--weights", self.weights.name])

    def checked(self) -> ZeroShot:
        """These options.

        Raises:
            RunError: a network or weights are given that nothing would use.
        """
        given = next((name for name in ("preset", "weights") if getattr(self, name) is not None), None)
        if given is not None and not self.zero_shot:
            raise RunError(
                f"--{given} belongs to --zero-shot: runs have their own, and other methods none; add --zero-shot, or "
                f"leave --{given} out"
            )
        return self

    def require_weights(self) -> None:
        """Raises: RunError, before photographs are read, which may take minutes, when there are no such weights."""
        from tidefield.train.checkpoint import given_or_shipped, read_weights_file

        weights = given_or_shipped(self.weights, self.network)
        if self.weights is not None:
            read_weights_file(weights)


@dataclass(frozen=True)
class Footprint:
    """How pixels are sampled."""

    rays_per_pixel: Literal[1, 4, 9, 16] | None = None
    """Rays whose mean a pixel is. If not given, 1; with our presets, 4 where pixels show much more ground than those of
    the photographs at the scene's or the run's width."""
    no_cones: bool = False
    """Read photographs at the scene's or the run's width only, instead of where their pixels are about as large as what
    a pixel of the picture shows; for comparison."""

    @property
    def sampling(self) -> Sampling:
        side = None if self.rays_per_pixel is None else math.isqrt(self.rays_per_pixel)
        return Sampling(cones=not self.no_cones, rays_per_side=side)


def load(scene: Path, width: int | None, allow_missing: bool, console: Console, hold_out: bool = True) -> Scene:
    """Read a scene, with progress while photographs are decoded."""
    from tidefield.data.load import load_scene
    from tidefield.progress import ProgressBar

    with ProgressBar(console, "Reading photographs") as bar:
        return load_scene(scene, width=width, allow_missing=allow_missing, hold_out=hold_out, progress=bar)


def open_zero_shot(
    zero: ZeroShot, scene: Scene, device: torch.device, sampling: Sampling = USUAL_SAMPLING
) -> tuple[Render, dict[str, Any]]:
    """Trained weights as a method on a scene, and its record."""
    from tidefield.methods import zero_shot
    from tidefield.train.checkpoint import given_or_shipped

    config = PRESETS[zero.network]
    render, digest = zero_shot(config, given_or_shipped(zero.weights, zero.network), scene, device, sampling)
    return render, {**config_to_json(config), "weights": digest, "sampling": asdict(sampling)}


@contextmanager
def open_source(
    source: Path,
    zero: ZeroShot,
    device: torch.device,
    allow_missing: bool,
    console: Console,
    sampling: Sampling = USUAL_SAMPLING,
    hold_out: bool = True,
) -> Iterator[tuple[Scene, Render, dict[str, Any]]]:
    """The scene and the method of a scene with trained weights, or of a run, while the block lasts, and its record.

    Without `hold_out` all photographs are sources, as for products.

    Raises:
        RunError: a network or weights are given, but not for a scene without training.
    """
    if zero.checked().zero_shot:
        zero.require_weights()
        scene = load(source, None, allow_missing, console, hold_out)
        yield scene, *open_zero_shot(zero, scene, device, sampling)
    else:
        with open_trained(source, device, allow_missing, console, sampling, hold_out) as opened:
            yield opened


@contextmanager
def open_trained(
    folder: Path,
    device: torch.device,
    allow_missing: bool,
    console: Console,
    sampling: Sampling = USUAL_SAMPLING,
    hold_out: bool = True,
) -> Iterator[tuple[Scene, Render, dict[str, Any]]]:
    """The scene and the method of a run, while the block lasts, and its record.

    Without `hold_out` all photographs are sources, as for products.
    """
    from tidefield.data.load import is_scene
    from tidefield.methods import trained
    from tidefield.train.checkpoint import RUN_FILE, read_run, scene_of

    if not (folder / RUN_FILE).exists() and is_scene(folder):
        raise RunError(
            f"{folder} is a scene, not a run: expected a folder that `tidefield train` wrote; add --zero-shot to use "
            f"the scene without training, or train first: `tidefield train {folder} RUN`"
        )
    run = read_run(folder)
    scene = load(scene_of(folder, run), run.width, allow_missing, console, hold_out)
    with trained(folder, run, scene, device, sampling) as (render, progress):
        record = {"seed": run.seed, "weights": run.weights, "run": run.id, "trained_width": scene.cameras.width}
        record["trained"] = {"steps": progress.step, "seconds": progress.seconds}
        yield scene, render, {**config_to_json(run.config), **record, "sampling": asdict(sampling)}
