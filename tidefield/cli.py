"""The command line: `tidefield COMMAND`, as `tidefield --help` lists them.

Only what is needed to answer --help is imported here; torch and the rest are imported once a command is known.
"""

from __future__ import annotations

import logging
import os
import sys
from typing import TYPE_CHECKING

import tyro

from tidefield.cores import spin_briefly
from tidefield.errors import TidefieldError
from tidefield.options import Ablate, Baselines, Compare, Demo, Evaluate, Import, Prepare, Pretrain, Render, Talk, Train

if TYPE_CHECKING:
    from rich.console import Console


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
        {
            "prepare": Prepare,
            "import": Import,
            "train": Train,
            "pretrain": Pretrain,
            "evaluate": Evaluate,
            "render": Render,
            "compare": Compare,
            "ablate": Ablate,
            "baselines": Baselines,
            "demo": Demo,
        },
        prog="tidefield",
        description="New views of tidal flats from drone photographs.",
    )
    console = _begin(options.talk)
    from tidefield import commands

    todo = {
        Prepare: commands.prepare,
        Import: commands.import_project,
        Train: commands.train,
        Pretrain: commands.pretrain,
        Evaluate: commands.evaluate,
        Render: commands.render,
        Compare: commands.compare,
        Ablate: commands.ablate,
        Baselines: commands.baselines,
        Demo: commands.demo,
    }
    todo[type(options)](options, console)


def _begin(talk: Talk) -> Console:
    """Set up messages; returns the console that commands print to."""
    spin_briefly()
    from rich.console import Console
    from rich.logging import RichHandler

    from tidefield.device import keep_large_allocations

    console = Console(quiet=talk.quiet)
    level = logging.ERROR if talk.quiet else logging.DEBUG if talk.verbose else logging.INFO
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
