"""`tidefield compare`, `tidefield ablate` and `tidefield baselines`: our network beside others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console

from tidefield.baselines.nerfstudio import driver, environment
from tidefield.commands.opening import budget_of
from tidefield.compare import protocols
from tidefield.compare.ablation import variants, write_ablation
from tidefield.compare.results import Results, read_results
from tidefield.compare.run import Settings, run_measured
from tidefield.compare.run import compare as run_all
from tidefield.compare.tables import write_comparison
from tidefield.config import PRESETS
from tidefield.device import choose_device
from tidefield.errors import RunError
from tidefield.options import Ablate, Baselines, Compare
from tidefield.variants import vary

SYNTHETIC_WIDTH = 400


def compare(options: Compare, console: Console) -> None:
    """See `tidefield compare --help`."""
    if find_spec("matplotlib") is None:
        raise RunError("matplotlib is not installed: expected it, for the curves; pip install 'tidefield[compare]'")
    for method in ("nerfacto", "splatfacto"):
        if method in options.methods:
            driver.require(method, choose_device(options.device))  # before anything is trained
    scenes, settings = _scenes(options), _settings(options, from_scratch=options.from_scratch)
    results = _run(scenes, options.methods, settings, options.out, console)
    _say(console, write_comparison(results, scenes, settings, options.out))


def ablate(options: Ablate, console: Console) -> None:
    """See `tidefield ablate --help`."""
    for name in options.variants:
        vary(PRESETS[options.preset], name)  # before anything is trained
    # From scratch, all of them: trained weights would belong to one of the variants only.
    settings = _settings(options, preset=options.preset, from_scratch=True)
    results = _run(protocols.named(options.scenes), variants(options.variants), settings, options.out, console)
    _say(console, write_ablation(results, settings, options.out))


def _settings(options: Compare | Ablate, **others: Any) -> Settings:
    budget, device = budget_of(options.length), str(choose_device(options.device))  # the record says what auto was
    return Settings(budget.minutes, budget.steps, options.width, device, options.seed, **others)


def _run(
    scenes: Mapping[str, Path], methods: Sequence[str], settings: Settings, out: Path, console: Console
) -> Results:
    """Do what has not been done yet, and read all of it."""
    run_all(scenes, methods, settings, out, run_measured, lambda text: _say(console, [text]))
    return read_results(out, list(scenes), methods)


def _say(console: Console, lines: Iterable[object]) -> None:
    for line in lines:
        console.print(str(line), highlight=False, soft_wrap=True)


def baselines(options: Baselines, console: Console) -> None:
    """See `tidefield baselines --help`."""
    environment.install(options.overwrite, console)
    console.print(f"nerfstudio {environment.VERSION} is in {environment.home()}", highlight=False, soft_wrap=True)


def _scenes(options: Compare) -> dict[str, Path]:
    """What is to be compared on, by name."""
    if options.protocol == "mipnerf360":
        if len(options.scenes) != 1:
            raise RunError("--protocol mipnerf360 compares on one data set: expected its folder; name it alone")
        return protocols.mipnerf360(options.scenes[0], options.out / "scenes")
    if options.protocol == "tidalflats":
        return protocols.tidal_flats(options.out / "scenes", options.width or SYNTHETIC_WIDTH, options.scenes)
    if not options.scenes:
        raise RunError("nothing to compare on: expected scenes, or --protocol; name some")
    return protocols.named(options.scenes)
