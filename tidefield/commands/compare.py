"""`tidefield compare`: methods on the same scenes, under the same conditions."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import AnyMethod, Cluster, Device, OpensplatProgram, Verbosity
from tidefield.config import Budget, checked_seed
from tidefield.errors import RunError, TidefieldError
from tidefield.files import require_writable
from tidefield.methods import METHODS
from tidefield.processes import worker_processes

if TYPE_CHECKING:
    from rich.console import Console

    from tidefield.compare.results import Results
    from tidefield.compare.run import Failure, Settings, Usage

log = logging.getLogger(__name__)
SYNTHETIC_WIDTH = 400
Elsewhere = Callable[[Callable[[], Any], list[str]], Iterator[tuple[str, Any]]]
"""Works on scenes, given by what a worker prepares and their names; yields the name of each that is done, and what
failed on it."""


@dataclass(frozen=True)
class Compare:
    """Train and evaluate methods on the same scenes, split, resolution, machine and budget; write tables and figures.

    What is done is not repeated: the same command continues after an interruption, and with more methods or scenes.
    """

    scenes: Annotated[Positional[tuple[Path, ...]], arg(metavar="[SCENE ...]")] = ()
    """Scenes; with --protocol tidalflats in addition to its own, with --protocol mipnerf360 the folder of the data
    set."""
    methods: tuple[AnyMethod, ...] = ("tidefield", "nerfacto", "plane-sweep", "sparse-depth", "nearest")
    """Which, in the order of the tables. tidefield and paper are our presets, paper-seen is paper with neighbours
    chosen by what they see instead of by direction, zero-shot and paper-zero-shot are the presets without training on
    the scene; nerf is classical NeRF; nerfacto and splatfacto are nerfstudio's; opensplat is the program that you have
    installed; the others need no training."""
    budget: OmitArgPrefixes[Budget] = Budget()
    width: int | None = None
    """Width of the photographs in pixels; their own if not given."""
    from_scratch: bool = False
    """Start our presets from random weights."""
    protocol: Literal["mipnerf360", "tidalflats"] | None = None
    """A named set of scenes: the seven public ones of mip-NeRF 360, or five synthetic tidal flats."""
    out: Path = Path("comparison")
    """Folder for the runs, tables and figures."""
    device: Device = "auto"
    seed: int = 0
    """Of all methods that take one."""
    opensplat: OpensplatProgram = None
    cluster: Annotated[
        Cluster,
        arg(
            help="Scenes as tasks of a Ray cluster, which sees the same folders: `auto` is the running one, or one "
            "started on this machine; else its address. A scene has a whole machine to itself, all its cores and GPUs, "
            "so that minutes and seconds mean the same as without: among equal machines. Needs pip install "
            "'tidefield[cluster]'."
        ),
    ] = None
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def compare(options: Compare, console: Console) -> None:
    """Run `tidefield compare`."""
    from tidefield.cluster import connected, on_cluster, share_of
    from tidefield.compare.tables import write_comparison

    if not options.methods:
        raise RunError("nothing to compare: expected methods; name some, or leave --methods out")
    with ExitStack() as stack:
        here = options.device if options.cluster is None else "cpu"
        settings = make_settings(options.budget, options.width, here, options.seed, options.from_scratch)
        elsewhere = None
        if options.cluster is not None:
            ray = stack.enter_context(connected(options.cluster))
            share = share_of(ray, options.device, "machine")
            auto = "cuda:0" if share.gpus else "cpu"
            settings = replace(settings, device=auto if options.device == "auto" else options.device)
            elsewhere = partial(on_cluster, ray, "compare", share=share)
        environment = _require_software(options, settings.device)
        scenes = _scenes(options)
        results, failures = run_all(scenes, options.methods, settings, options.out, console, environment, elsewhere)
    if results.by:
        print_lines(console, write_comparison(results, scenes, settings, options.out, options.protocol))
    end(failures, options.out)


def _require_software(options: Compare, device: str) -> dict[str, str]:
    """Look for what the methods need, before anything is trained; returns additional variables of the environment."""
    import torch

    from tidefield.baselines import opensplat
    from tidefield.baselines.nerfstudio import driver
    from tidefield.train.checkpoint import given_or_shipped

    environment = {}
    for method in options.methods:
        if method in ("nerfacto", "splatfacto"):
            driver.require(method, torch.device(device))
        elif METHODS[method].kind == "zero-shot":
            given_or_shipped(None, str(METHODS[method].preset))
        elif method == "opensplat":
            program = opensplat.find(options.opensplat)
            opensplat.version(program)
            environment[opensplat.VARIABLE] = str(program)
    return environment


def make_settings(
    budget: Budget, width: int | None, device: str, seed: int, from_scratch: bool, preset: str = "swift"
) -> Settings:
    """What all methods of a comparison share; the record has the device that "auto" stands for."""
    from tidefield.compare.run import Settings
    from tidefield.device import choose_device

    budget, seed = budget.checked(), checked_seed(seed)
    return Settings(
        budget.minutes, budget.steps, width, str(choose_device(device)), seed, preset=preset, from_scratch=from_scratch
    )


def run_all(
    scenes: Mapping[str, Path],
    methods: Sequence[str],
    settings: Settings,
    out: Path,
    console: Console,
    variables: Mapping[str, str] = MappingProxyType({}),
    elsewhere: Elsewhere | None = None,
) -> tuple[Results, Sequence[Failure]]:
    """Train and evaluate what has not been done yet, and read all results; also returns what failed.

    Args:
        variables: additional ones of the environment of all processes.
        elsewhere: works on the scenes, if not this machine.
    """
    from tidefield.addresses import pull
    from tidefield.compare.results import read_results
    from tidefield.compare.run import (
        PROCESS_FILE,
        RUNS,
        Unfinished,
        compare,
        require_same_settings,
        run_measured,
        scene_runner,
    )
    from tidefield.compare.sources import check_scene, installed_weights, require_one_state, require_same_sources

    require_writable(out / PROCESS_FILE, overwrite=True)
    # In a process of its own, because the memory of a scene would be charged to every process that this one starts.
    with worker_processes(1) as pool:
        states = {name: pool.submit(check_scene, scene, settings.width).result() for name, scene in scenes.items()}
        weights = pool.submit(installed_weights, methods, settings).result()
    poses, contents = ({name: state[k] for name, state in states.items()} for k in (0, 1))

    def require_same() -> None:
        require_one_state(poses, methods, out)
        require_same_sources(contents, weights, out)

    require_same()
    failures: list[Failure] = []
    if elsewhere is None:
        quiet = ["--quiet"] if console.quiet else []

        def run(command: Sequence[str], environment: Mapping[str, str]) -> Usage:
            return run_measured([*command, *quiet], {**variables, **environment})

        try:
            compare(scenes, methods, settings, out, run, lambda text: print_lines(console, [text]), contents)
        except Unfinished as error:
            failures += error.failures
    else:
        require_same_settings(scenes, methods, settings, out)
        found = {name: scene.resolve() for name, scene in scenes.items()}
        opened = partial(scene_runner, found, methods, settings, out.resolve(), variables, contents)
        for number, (name, failed) in enumerate(elsewhere(partial(_with_failures, opened), list(scenes)), start=1):
            pull(out / RUNS / name)
            failures += failed
            print_lines(console, [f"{name}: {'not complete' if failed else 'done'} ({number} of {len(scenes)})"])
    require_same()
    return read_results(out, list(scenes), methods), failures


@contextmanager
def _with_failures(
    opened: Callable[[], AbstractContextManager[Callable[[str], object]]],
) -> Iterator[Callable[[str], Sequence[Failure]]]:
    """What `scene_runner` opens, as a function that returns what failed: an error would end the other scenes, too."""
    from tidefield.compare.run import Failure, Unfinished

    with opened() as work:

        def tried(name: str) -> Sequence[Failure]:
            try:
                work(name)
            except Unfinished as error:
                return error.failures
            except TidefieldError as error:
                return [Failure(name, str(error), 2)]
            return ()

        yield tried


def end(failures: Sequence[Failure], out: Path) -> None:
    """List what failed, and end with the first one's exit status; nothing if nothing failed."""
    from tidefield.addresses import push

    if not failures:
        return
    for failure in failures:
        log.error(f"{failure.title}: {failure.reason}")
    log.error(f"{len(failures)} failed, the rest is done; the same command repeats what failed")
    push(out)  # copies of addresses are sent by commands that end well
    sys.exit(failures[0].status)


def print_lines(console: Console, lines: Iterable[object]) -> None:
    for line in lines:
        console.print(str(line), highlight=False, soft_wrap=True)


def _scenes(options: Compare) -> dict[str, Path]:
    """Folders of the scenes by name."""
    from tidefield.compare.run import mipnerf360, named, tidal_flats

    if options.protocol == "mipnerf360":
        if len(options.scenes) != 1:
            raise RunError("--protocol mipnerf360 compares on one data set: expected its folder; name it alone")
        return mipnerf360(options.scenes[0], options.out / "scenes")
    if options.protocol == "tidalflats":
        # In a process of its own, as the memory that it takes would be charged to what is measured.
        with worker_processes(1) as pool:
            width = options.width or SYNTHETIC_WIDTH
            return pool.submit(tidal_flats, options.out / "scenes", width, options.scenes).result()
    if not options.scenes:
        raise RunError("nothing to compare on: expected scenes, or --protocol; name some")
    return named(options.scenes)
