"""What commands share: how they report, and records of figures that are measured one after another.

A record has what each figure was measured with, and what it is of. torch and the rest are imported inside.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Fixed, Suppress

from tidefield.compare.run import Runner
from tidefield.errors import RunError
from tidefield.files import file_sha256, write_json
from tidefield.machine import describe

if TYPE_CHECKING:
    from tidefield.compare.tables import Table

MEASURED = Path("docs/measured")
STRICT_400 = tuple(MEASURED / f"strict_400{rest}.json" for rest in ("", "_scenes"))
HiddenRunner = Suppress[Fixed[Runner]]
"""What runs commands, a parameter that is no option: tests give one that runs nothing."""
say = partial(print, flush=True)
NETWORK = "network"
"""Entry of a figure with the SHA-256 of the weights that it is of."""


def show(tables: Iterable[Table]) -> None:
    """Print tables as Markdown."""
    for table in tables:
        say(table.markdown(), end="\n\n")


def store(
    path: Path, record: dict[str, Any], new: dict[str, Any], figures: Iterable[dict[str, Any]], command: str
) -> None:
    """Write a record with a new figure, which is dated (see `stamp`)."""
    stamp(record, new, figures, command)
    write_json(path, record)


def stamp(record: dict[str, Any], new: dict[str, Any], figures: Iterable[dict[str, Any]], command: str) -> None:
    """Give a new figure, and the record that it is in, the date, code and machine of now.

    Args:
        record: of which each figure keeps its own; that of the record is the newest one's.
        new: the new figure, one of `figures`.
        figures: all of the record. Those without a date are of a version that dated the record alone: they get its.
        command: that measured the new one.
    """
    now = describe()
    for figure in figures:
        if figure is not new and "date" not in figure:
            figure |= {key: record[key] for key in now if key in record}
    new |= now
    record |= {**now, "command": command}


def network_of(source: Path) -> str:
    """SHA-256 of what a run has learned, or of the trained weights for a scene.

    Raises:
        RunError: no weights are installed.
    """
    from tidefield.train.checkpoint import CHECKPOINT_FILE, RUN_FILE, given_or_shipped

    if not (source / RUN_FILE).exists():
        return file_sha256(given_or_shipped(None, "swift"))
    checkpoint = source / CHECKPOINT_FILE  # other programs' runs have none
    return file_sha256(checkpoint if checkpoint.exists() else source / RUN_FILE)


def require_same(path: Path, name: str, kept: dict[str, Any], asked: dict[str, Any]) -> None:
    """Check that a figure that is kept was measured as is asked for now.

    Raises:
        RunError: it was not, or an earlier version did not store how.
    """
    for key, value in asked.items():
        if kept.get(key) != value:
            raise RunError(
                f"{path} has {name} with {key} {kept.get(key, 'not stored')}: expected {value}, as is asked for now; "
                "delete it there to measure it again, or store into another folder with --runs"
            )
