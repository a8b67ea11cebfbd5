"""The page on damaged files and killed commands, made of nothing but what the campaigns stored."""

from __future__ import annotations

from pathlib import Path

from benchmarks.fuzz import FUZZ_FILE, MOST_BYTES, fuzz_table
from benchmarks.kills import KILLS_FILE, kills_table
from benchmarks.readers import CPU_SECONDS
from benchmarks.records import MEASURED, say
from benchmarks.table import circumstances
from tidefield.errors import RunError
from tidefield.files import read_json, write_text


def robustness(runs: Path = MEASURED, out: Path = Path("docs/robustness.md")) -> None:
    """Read the stored counts and write the page as Markdown.

    Args:
        runs: Folder of fuzz.json and kills.json.
        out: The Markdown file to write; replaced if it is there.

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
    say(out)
