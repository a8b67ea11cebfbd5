"""`tidefield ablate`: what each part of a preset contributes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import Device, Preset, Verbosity
from tidefield.commands.compare import end, make_settings, print_lines, run_all
from tidefield.config import PRESETS, Budget, vary
from tidefield.errors import RunError

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Ablate:
    """Train and evaluate variants of a preset, each with one part left out or changed; write a table of all scenes.

    What is done is not repeated: the same command continues after an interruption, and with more variants or scenes.
    """

    scenes: Annotated[Positional[tuple[Path, ...]], arg(metavar="SCENE [SCENE ...]")]
    variants: tuple[str, ...] = ()
    """Which; all of them if not given (docs/comparing.md lists them). Several joined by `+` are changed together, and
    compared with what lacks the last: `no-sparse-points+no-agreement` with `no-sparse-points`."""
    preset: Preset = "swift"
    """What they are variants of."""
    budget: OmitArgPrefixes[Budget] = Budget()
    width: int | None = None
    """Width of the photographs in pixels; their own if not given."""
    out: Path = Path("ablation")
    """Folder for the runs and the table."""
    device: Device = "auto"
    seed: int = 0
    """The first one."""
    seeds: int = 2
    """How many times each is trained, with a seed of its own: how far these results are apart is the noise."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def ablate(options: Ablate, console: Console) -> None:
    """Run `tidefield ablate`."""
    from tidefield.compare.ablation import variants, write_ablation
    from tidefield.compare.run import named

    if not options.scenes:
        raise RunError("nothing to compare on: expected scenes; name some")
    if options.seeds < 1:
        raise RunError(f"--seeds {options.seeds} was asked for: expected 1 or more; choose another")
    for name in options.variants:
        vary(PRESETS[options.preset], name)  # before anything is trained
    # From scratch, all of them: trained weights would belong to one of the variants only.
    settings = make_settings(options.budget, options.width, options.device, options.seed, True, options.preset)
    methods = variants(options.variants, options.preset, options.seeds)
    results, failures = run_all(named(options.scenes), methods, settings, options.out, console)
    if results.by:
        print_lines(console, write_ablation(results, settings, options.out))
    end(failures, options.out)
