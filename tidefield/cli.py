"""The command line: `tidefield COMMAND`, as `tidefield --help` lists them.

Only what is needed to answer --help is imported here; torch and the rest are imported by the commands' functions.
"""

from __future__ import annotations

import difflib
import errno
import logging
import os
import re
import shlex
import signal
import sys
import traceback
from contextlib import ExitStack
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import tyro

from tidefield import __version__
from tidefield.commands import (
    ablate,
    baselines,
    cache,
    change,
    compare,
    demo,
    evaluate,
    export,
    import_,
    map_,
    prepare,
    pretrain,
    render,
    train,
    view,
)
from tidefield.errors import TidefieldError
from tidefield.files import user_can_mend
from tidefield.machine import tune_process
from tidefield.processes import Ended, ended_by_signals

if TYPE_CHECKING:
    from rich.console import Console

    from tidefield.commands.common import Verbosity

COMMANDS: dict[str, tuple[Any, Any, str]] = {
    "prepare": (prepare, prepare.Prepare, "prepare"),
    "import": (import_, import_.Import, "import_project"),
    "train": (train, train.Train, "train"),
    "evaluate": (evaluate, evaluate.Evaluate, "evaluate"),
    "render": (render, render.Render, "render"),
    "view": (view, view.View, "view"),
    "export": (export, export.Export, "export"),
    "map": (map_, map_.Map, "map_"),
    "change": (change, change.Change, "change"),
    "compare": (compare, compare.Compare, "compare"),
    "ablate": (ablate, ablate.Ablate, "ablate"),
    "baselines": (baselines, baselines.Baselines, "baselines"),
    "pretrain": (pretrain, pretrain.Pretrain, "pretrain"),
    "demo": (demo, demo.Demo, "demo"),
    "cache": (cache, cache.Cache, "cache"),
}
"""By name: module, options and function."""

_NO_MEMORY = re.compile("out of memory|(can't|cannot) allocate memory|not enough memory", re.IGNORECASE)
DESCRIPTION = """New views of tidal flats from drone photographs.

The usual order of commands:
  tidefield prepare PHOTOS SCENE      photographs become a scene (or: tidefield import PROJECT SCENE)
  tidefield train SCENE RUN           learn the scene
  tidefield evaluate RUN              measure quality on held-out photographs
  tidefield render RUN OUT.mp4        views and videos; with --zero-shot from SCENE, without training
  tidefield view RUN                  look at it in a browser; with --zero-shot from SCENE
  tidefield map RUN OUT               orthophoto, surface model and point cloud; with --zero-shot from SCENE
  tidefield change EARLIER LATER OUT  what changed between two surveys, with volumes and intervals

tidefield demo trains, evaluates and renders on a built-in scene."""


def main() -> None:
    """Entry point; `docs/commands.md` lists the exit statuses."""
    try:
        with ended_by_signals():
            _run(sys.argv[1:])
            if sys.stdout is not None:
                sys.stdout.flush()
    except TidefieldError as error:
        _end(2, str(error))
    except KeyboardInterrupt as error:
        number = error.number if isinstance(error, Ended) else signal.SIGINT
        _end(128 + number, f"interrupted ({signal.Signals(number).name})")
    except BrokenPipeError:
        # The reader, such as `head`, has seen enough. Python would complain once more when it flushes at exit.
        if sys.stdout is not None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except Exception as error:
        if _is_out_of_memory(error):
            sentences = re.split(r"\n|\. |: you tried", str(error))
            reason = next(filter(_NO_MEMORY.search, sentences), sentences[0]) or "the system gave no more"
            todo = "choose a smaller --width or another --device, where the command has them, or end other programs"
            _end(2, f"not enough memory ({reason}): expected more; {todo}")
        if isinstance(error, OSError) and error.filename is not None and user_can_mend(error):
            place = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else error.filename
            _end(2, f"{place} cannot be used ({error.strerror}): expected a place of yours; check name and permissions")
        traceback.print_exc()
        _end(
            70,
            "this is a defect of the program; please report it with the lines above and these:\n"
            f"  version: {__version__}, Python {sys.version.split()[0]}, {sys.platform}\n"
            f"  command: {shlex.join(sys.argv)}",
        )


def _is_out_of_memory(error: Exception) -> bool:
    """Whether an error is of the system's memory, or of PyTorch's, whose text alone says so except on NVIDIA's GPUs."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, RuntimeError) and _NO_MEMORY.search(str(error)) is not None


def _end(status: int, message: str) -> NoReturn:
    print(f"tidefield: {message}", file=sys.stderr)
    sys.exit(status)


def _run(words: list[str]) -> None:
    """Parse the command line and run its command."""
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # of a name that is no UTF-8, as standard error does
    if any("\0" in word for word in words):
        raise TidefieldError("a word of the command has a zero byte: expected names that files can have")
    if words == ["--version"]:
        print(f"tidefield {__version__}")
        return
    _require_command(words)
    words, copies = _with_copies(words)
    if os.environ.get("NO_COLOR"):
        tyro._experimental_options["ansi_codes"] = False
    options = tyro.extras.subcommand_cli_from_dict(
        {name: options for name, (_, options, _) in COMMANDS.items()},
        prog="tidefield",
        description=DESCRIPTION,
        args=words,
        config=(tyro.conf.FlagCreatePairsOff,),
        sort_subcommands=False,
    )
    module, function = next((m, f) for m, kind, f in COMMANDS.values() if kind is type(options))
    console = _set_up(options.verbosity)
    with ExitStack() as stack:
        if copies:
            from tidefield.addresses import up_to_date

            stack.enter_context(up_to_date(copies, console))
        getattr(module, function)(options, console)


def _with_copies(words: list[str]) -> tuple[list[str], list[Path]]:
    """The words with local paths in place of addresses such as s3://bucket/scene, and these paths."""
    if not any("://" in word for word in words):
        return words, []
    from tidefield.addresses import local_word

    found = [local_word(word) for word in words]
    return [word for word, _ in found], list(dict.fromkeys(path for _, path in found if path is not None))


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

    from tidefield.progress import make_console

    level = logging.ERROR if verbosity.quiet else logging.DEBUG if verbosity.verbose else logging.INFO
    terminal, handler = Console(stderr=True), logging.StreamHandler()
    form = "%(asctime)s %(message)s"
    if terminal.is_terminal:  # elsewhere Rich would break lines
        handler, form = RichHandler(console=terminal, show_path=False, show_level=False), "%(message)s"
    logging.basicConfig(level=logging.WARNING, format=form, datefmt="%H:%M:%S", handlers=[handler], force=True)
    logging.getLogger("tidefield").setLevel(level)
    return make_console(quiet=verbosity.quiet)


if __name__ == "__main__":
    main()
