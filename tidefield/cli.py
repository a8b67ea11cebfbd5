"""The command line: `tidefield COMMAND`, as `tidefield --help` lists them.

Only what is needed to answer --help is imported here; torch and the rest are imported by the commands' functions.
"""

from __future__ import annotations

import difflib
import logging
import os
import sys
from typing import TYPE_CHECKING, Any

import tyro

from tidefield import __version__
from tidefield.commands import ablate, baselines, compare, demo, evaluate, import_, prepare, pretrain, render, train
from tidefield.errors import TidefieldError
from tidefield.machine import tune_process

if TYPE_CHECKING:
    from rich.console import Console

    from tidefield.commands.common import Verbosity

COMMANDS: dict[str, tuple[Any, Any, str]] = {
    "prepare": (prepare, prepare.Prepare, "prepare"),
    "import": (import_, import_.Import, "import_project"),
    "train": (train, train.Train, "train"),
    "evaluate": (evaluate, evaluate.Evaluate, "evaluate"),
    "render": (render, render.Render, "render"),
    "compare": (compare, compare.Compare, "compare"),
    "ablate": (ablate, ablate.Ablate, "ablate"),
    "baselines": (baselines, baselines.Baselines, "baselines"),
    "pretrain": (pretrain, pretrain.Pretrain, "pretrain"),
    "demo": (demo, demo.Demo, "demo"),
}
"""By name: module, options and function."""

DESCRIPTION = """New views of tidal flats from drone photographs.

The usual order of commands:
  tidefield prepare PHOTOS SCENE    photographs become a scene (or: tidefield import PROJECT SCENE)
  tidefield train SCENE RUN         learn the scene
  tidefield evaluate RUN            measure quality on held-out photographs
  tidefield render RUN OUT.mp4      views and videos; with --zero-shot from SCENE, without training

tidefield demo does all of it on a built-in scene."""


def main() -> None:
    """Entry point: exit status 0, 2 for a user's mistake, 130 after an interruption."""
    try:
        _run(sys.argv[1:])
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


def _run(words: list[str]) -> None:
    """Parse the command line and run its command."""
    if words == ["--version"]:
        print(f"tidefield {__version__}")
        return
    _require_command(words)
    options = tyro.extras.subcommand_cli_from_dict(
        {name: options for name, (_, options, _) in COMMANDS.items()},
        prog="tidefield",
        description=DESCRIPTION,
        args=words,
        config=(tyro.conf.FlagCreatePairsOff,),
        sort_subcommands=False,
    )
    module, function = next((m, f) for m, kind, f in COMMANDS.values() if kind is type(options))
    getattr(module, function)(options, _set_up(options.verbosity))


def _require_command(words: list[str]) -> None:
    """Raises: TidefieldError when the first word is not a command, with the one that is probably meant."""
    if not words or words[0].startswith("-") or words[0] in COMMANDS:
        return
    close = difflib.get_close_matches(words[0], COMMANDS, n=1)
    advice = f"did you mean `tidefield {close[0]}`?" if close else "`tidefield --help` explains them"
    raise TidefieldError(f"{words[0]} is not a command: expected one of {', '.join(COMMANDS)}; {advice}")


def _set_up(verbosity: Verbosity) -> Console:
    """Set up messages; returns the console that commands print to."""
    tune_process()
    from rich.console import Console
    from rich.logging import RichHandler

    console = Console(quiet=verbosity.quiet)
    level = logging.ERROR if verbosity.quiet else logging.DEBUG if verbosity.verbose else logging.INFO
    terminal, handler = Console(stderr=True), logging.StreamHandler()
    form = "%(asctime)s %(message)s"
    if terminal.is_terminal:  # elsewhere Rich would break lines
        handler, form = RichHandler(console=terminal, show_path=False, show_level=False), "%(message)s"
    logging.basicConfig(level=logging.WARNING, format=form, datefmt="%H:%M:%S", handlers=[handler], force=True)
    logging.getLogger("tidefield").setLevel(level)
    return console


if __name__ == "__main__":
    main()
