"""The command line: `tidefield COMMAND`, as `tidefield --help` lists them.

Only what is needed to answer --help is imported here; torch and the rest are imported once a command is known.
"""

from __future__ import annotations

import logging
import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING

import tyro

from tidefield.errors import TidefieldError
from tidefield.machine import spin_briefly
from tidefield.options import (
    Ablate,
    Baselines,
    Compare,
    Demo,
    Evaluate,
    Import,
    Prepare,
    Pretrain,
    Render,
    Train,
    Verbosity,
)

if TYPE_CHECKING:
    from rich.console import Console

COMMANDS = {
    "prepare": (Prepare, "surveys", "prepare"),
    "import": (Import, "surveys", "import_project"),
    "train": (Train, "training", "train"),
    "pretrain": (Pretrain, "training", "pretrain"),
    "evaluate": (Evaluate, "views", "evaluate"),
    "render": (Render, "views", "render"),
    "compare": (Compare, "peers", "compare"),
    "ablate": (Ablate, "peers", "ablate"),
    "baselines": (Baselines, "peers", "baselines"),
    "demo": (Demo, "demonstration", "demo"),
}
"""By name: what can be asked, and module and function of `tidefield.commands`, imported only when it is asked for."""


def main() -> None:
    """Entry point: exit status 0, 2 for a user's mistake, 130 after an interruption."""
    try:
        _run()
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


def _run() -> None:
    """Understand the command line and do what it says."""
    options = tyro.extras.subcommand_cli_from_dict(
        {name: asked for name, (asked, _, _) in COMMANDS.items()},
        prog="tidefield",
        description="New views of tidal flats from drone photographs.",
    )
    console = _begin(options.verbosity)
    module, function = next((module, name) for asked, module, name in COMMANDS.values() if asked is type(options))
    getattr(import_module(f"tidefield.commands.{module}"), function)(options, console)


def _begin(verbosity: Verbosity) -> Console:
    """Set up messages; returns the console that commands print to."""
    spin_briefly()
    from rich.console import Console
    from rich.logging import RichHandler

    from tidefield.device import keep_large_allocations

    console = Console(quiet=verbosity.quiet)
    level = logging.ERROR if verbosity.quiet else logging.DEBUG if verbosity.verbose else logging.INFO
    terminal, handler = Console(stderr=True), logging.StreamHandler()
    form = "%(asctime)s %(message)s"
    if terminal.is_terminal:  # elsewhere Rich would break lines
        handler, form = RichHandler(console=terminal, show_path=False, show_level=False), "%(message)s"
    logging.basicConfig(level=logging.WARNING, format=form, datefmt="%H:%M:%S", handlers=[handler], force=True)
    logging.getLogger("tidefield").setLevel(level)
    keep_large_allocations()
    return console


if __name__ == "__main__":
    main()
