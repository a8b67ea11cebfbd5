"""The page on damaged files and killed commands, made of nothing but what the campaigns stored."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.fuzz import FUZZ_FILE, MOST_BYTES
from benchmarks.kills import KILLS_FILE
from benchmarks.readers import CPU_SECONDS
from benchmarks.table import circumstances
from tidefield.compare.tables import Table
from tidefield.errors import RunError
from tidefield.files import read_json, write_text


def write_robustness(runs: Path, out: Path) -> None:
    """Read the stored counts and write the page as Markdown.

    Raises:
        RunError: when there are none.
    """
    fuzz, kills = read_json(runs / FUZZ_FILE), read_json(runs / KILLS_FILE)
    if not (fuzz or kills):
        raise RunError(
            f"{runs} holds no counts: expected {FUZZ_FILE} or {KILLS_FILE}; run `python -m benchmarks fuzz --runs "
            f"{runs}` and `python -m benchmarks kills`"
        )
    records = [(name, record) for name, record in (("damaged files", fuzz), ("killed commands", kills)) if record]
    parts = [
        "# Robustness",
        "## Damaged files",
        *(
            [
                "Every reader got damaged files: flipped bits, cut, inserted, repeated and exchanged parts, extreme "
                "numbers, and other values of JSON. It must accept a file, or refuse it with one message of "
                "Tidefield's own. A finding is anything else: another error, the end of the process, over "
                f"{CPU_SECONDS:g} s of computing or {MOST_BYTES / 2**30:g} GiB of memory for a file.",
                fuzz_table(fuzz["readers"]).markdown(),
            ]
            if fuzz
            else ["Not measured."]
        ),
        "## Killed commands",
        *(
            [
                "Commands were killed (SIGKILL) at random moments and repeated. Identical results are those that "
                "equal an uninterrupted run's bit for bit.",
                kills_table(kills["kills"]).markdown(),
            ]
            if kills
            else ["Not measured."]
        ),
        "## How this was measured",
        "\n".join(f"- {line}" for line in circumstances(records)),
        "`make bench ARGS=robustness` wrote this page from [docs/measured](measured). The commands:",
        "\n".join(f"    {record['command']}" for _, record in records),
    ]
    write_text(out, "\n\n".join(parts) + "\n")


def fuzz_table(readers: Mapping[str, Mapping[str, Any]]) -> Table:
    """What happened to the damaged files of every reader, and of all."""
    rows = [
        (
            name,
            *(f"{count[key]:,}" for key in ("files", "accepted", "refused")),
            str(sum(count["findings"].values())),
            f"{count['slowest_seconds']:.2f}",
        )
        for name, count in readers.items()
    ]
    sums = [sum(count[key] for count in readers.values()) for key in ("files", "accepted", "refused")]
    found = sum(sum(count["findings"].values()) for count in readers.values())
    slowest = max((count["slowest_seconds"] for count in readers.values()), default=0.0)
    rows.append(("all", *(f"{total:,}" for total in sums), str(found), f"{slowest:.2f}"))
    return Table("Damaged files", ["reader", "files", "accepted", "refused", "findings", "slowest, s"], rows)


def kills_table(kills: Mapping[str, Mapping[str, Any]]) -> Table:
    """What killed commands completed when they were repeated, and what they left behind."""
    keys = ("kills", "identical", "processes", "files")
    rows = [(f"tidefield {name}", *(str(record[key]) for key in keys)) for name, record in kills.items()]
    columns = ["command", "kills", "identical results", "processes left", "partial files left"]
    return Table("Killed commands", columns, rows)
