"""The page of results, from nothing but what the other commands kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.bars import JUDGED, METHODS, Bar, Result, Stored, judge, read_stored
from benchmarks.quality import SCENES
from benchmarks.records import stamp
from tidefield.errors import RunError
from tidefield.files import completed_file

if TYPE_CHECKING:
    from rich.table import Table as ConsoleTable

METRICS = (
    ("psnr", "PSNR, dB (more is better)", "{:.2f}", True),
    ("ssim", "SSIM (more is better)", "{:.4f}", True),
    ("lpips_alex", "LPIPS, AlexNet (less is better)", "{:.3f}", False),
    ("lpips_vgg", "LPIPS, VGG (less is better)", "{:.3f}", False),
    ("flip", "FLIP (less is better)", "{:.3f}", False),
)
"""Name, title, style, and whether swift's gain over the better floor stands beside it."""
NOTHING = "-"


@dataclass(frozen=True)
class Table:
    """Cells as text; the first column is words, the others are figures."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """A heading, where there is a title, and the table."""
        lines = [self.columns, ["---", *["---:"] * (len(self.columns) - 1)], *self.rows]
        heading = [f"### {self.title}", ""] if self.title else []
        return "\n".join([*heading, *(f"| {' | '.join(line)} |" for line in lines)])

    def for_the_console(self) -> ConsoleTable:
        from rich.table import Table as ConsoleTable

        table = ConsoleTable(title=self.title)
        for number, column in enumerate(self.columns):
            table.add_column(column, justify="right" if number else "left")
        for row in self.rows:
            table.add_row(*row)
        return table


def write_page(runs: Path, out: Path) -> None:
    """Read what is in `runs` and write it as Markdown.

    Raises:
        RunError: when there is nothing.
    """
    stored = read_stored(runs)
    if not (stored.results or stored.speed or stored.memory):
        raise RunError(f"{runs} holds no results: expected what `speed`, `quality` and `memory` leave there; run them")
    with completed_file(out, overwrite=True) as partial:
        partial.write_text(page(stored), encoding="utf-8")


def page(stored: Stored) -> str:
    """The whole page."""
    parts = [
        "# Results",
        '`make bench ARGS="table --runs RUNS"` wrote this page from what `speed`, `quality` and `memory` left in RUNS; '
        "nothing is typed by hand.",
        "\n".join(f"- {line}" for line in _circumstances(stored)),
        "## What was aimed at",
        _bar_table(judge(stored)).markdown(),
        "## Quality",
        "Means over the held-out photographs, over the pixels that at least two training photographs see, after an "
        "affine colour fit.",
        *(table.markdown() for table in quality_tables(stored)),
        *_reasons(stored),
        "## Speed",
        *_speed(stored.speed),
        "## What it took",
        _cost_table(stored).markdown(),
        _frame(stored.memory),
        "## Commands",
        "\n".join(f"    {command}" for command in _commands(stored)),
    ]
    return "\n\n".join(parts) + "\n"


def _records(stored: Stored) -> list[Mapping[str, Any]]:
    """Everything with a date, a machine and a command."""
    results = [result for methods in stored.results.values() for result in methods.values()]
    processes = [result.process[step] for result in results for step in ("train", "evaluate") if step in result.process]
    return [record for record in (stored.speed, *processes, stored.memory) if record]


def _circumstances(stored: Stored) -> list[str]:
    records = _records(stored)
    machines, dates = [], sorted({record["date"] for record in records})
    for machine in (record["machine"] for record in records):
        text = (
            f"{machine['processor']}, {machine['cores']} cores, {machine['memory_bytes'] / 2**30:.0f} GiB; "
            f"{machine['system']}, Python {machine['python']}, torch {machine['torch']}"
        )
        machines += [] if text in machines else [text]
    versions = sorted({record["version"] for record in records})
    measured = " to ".join(dict.fromkeys([dates[0], dates[-1]])) if dates else "at an unknown date"
    return [
        *(f"Machine: {machine}." for machine in machines),
        f"Measured {measured} with Tidefield {', '.join(versions) or 'of unknown version'}; written {stamp()['date']}.",
        *_settings(stored),
    ]


def _settings(stored: Stored) -> list[str]:
    found = [r.process["settings"] for m in stored.results.values() for n, r in m.items() if "settings" in r.process]
    lines = [f"{s['minutes']:g} minutes of training at {s['width']} px, on {s['device']}." for s in found]
    return list(dict.fromkeys(lines))


def _bar_table(bars: Sequence[Bar]) -> Table:
    words = {True: "met", False: "not met", None: NOTHING}
    return Table("", ["aim", "result", ""], [(b.aim, b.result, words[b.met]) for b in bars])


def quality_tables(stored: Stored) -> list[Table]:
    """One per metric that anything has a value of; PSNR and SSIM always."""
    others = sorted(stored.results.keys() - set(SCENES))
    tables = []
    for metric, title, style, with_gain in METRICS:
        values = {m: {s: stored.metric(s, m, metric) for s in (*SCENES, *others)} for m in METHODS}
        columns = {method: _column(value, style) for method, value in values.items()}
        if with_gain:
            gains = {s: stored.gain(s, metric) for s in (*SCENES, *others)}
            columns["swift over the better floor"] = _column(gains, style.replace(":", ":+"))
        elif all(value is None for column in values.values() for value in column.values()):
            continue
        names = (*SCENES, "mean of these four", *others)
        tables.append(Table(title, ["scene", *columns], list(zip(names, *columns.values(), strict=True))))
    return tables


def _column(values: Mapping[str, float | None], style: str) -> list[str]:
    """Figures of the four scenes, their mean, and figures of others."""
    four = [values[scene] for scene in SCENES]
    known = [value for value in four if value is not None]
    mean = sum(known) / len(known) if len(known) == len(SCENES) else None
    others = [value for scene, value in values.items() if scene not in SCENES]
    return [_shown(value, style) for value in (*four, mean, *others)]


def _reasons(stored: Stored) -> list[str]:
    """Why there are no values of some metrics."""
    results = [result for methods in stored.results.values() for result in methods.values()]
    missing: dict[str, list[str]] = {}
    for metric, *_ in METRICS:
        for reason in dict.fromkeys(result.evaluation["mean"]["reasons"].get(metric + JUDGED) for result in results):
            if reason is not None:
                missing.setdefault(reason, []).append(metric)
    return [f"No {', '.join(metrics)}: {reason}." for reason, metrics in missing.items()]


def _shown(value: float | None, style: str) -> str:
    return NOTHING if value is None else style.format(value)


def _speed(speed: Mapping[str, Any] | None) -> list[str]:
    if speed is None:
        return ["Not measured."]
    bounds = "Shares are lower bounds: elementwise work, and what the network's boxes do within, are not counted."
    return ["Medians, on the built-in scene unless the command names another. " + bounds] + [
        table.markdown() for table in speed_tables(speed)
    ]


def speed_tables(speed: Mapping[str, Any]) -> list[Table]:
    """Rates and shares, stages, and ceilings."""
    presets, ceilings = speed["presets"], speed["ceilings"]
    rates: list[tuple[str, Callable[[Any], float], str]] = [
        ("Training, rays/s", lambda p: p["training"]["rays_per_second"], "{:,.0f}"),
        ("Rendering, rays/s, features encoded beforehand", lambda p: p["rendering"]["rays_per_second"], "{:,.0f}"),
        ("Encoding a photograph for rendering, s", lambda p: p["encoding_seconds"], "{:.3f}"),
    ]
    rows = []
    for title, read, style in rates:
        ratio = read(presets["swift"]) / read(presets["paper"])
        rows.append((title, *(style.format(read(presets[p])) for p in ("paper", "swift")), f"{ratio:.2f}"))
    for kind in ("training", "rendering"):
        for ceiling, title in (("float32", "float32 products"), ("bfloat16", "bfloat16 products"), ("copy", "copies")):
            shares = (f"{presets[p]['shares'][kind][ceiling]:.1%}" for p in ("paper", "swift"))
            rows.append((f"{kind.capitalize()}, share of the ceiling of {title}", *shares, ""))
    photographs = speed["photographs"]
    title = (
        f"{photographs['count']} photographs, {photographs['width']} px, {speed['device']}, {speed['threads']} threads"
    )
    limits = (
        ("float32 products", f"{ceilings['float32_flops'] / 1e9:,.0f} GFLOP/s"),
        ("bfloat16 products", f"{ceilings['bfloat16_flops'] / 1e9:,.0f} GFLOP/s"),
        ("copies, read and written", f"{ceilings['copy_bytes'] / 1e9:,.1f} GB/s"),
    )
    return [
        Table(title, ["", "paper", "swift", "swift / paper"], rows),
        _stage_table(presets),
        Table("Ceilings: the most that this machine did in the same run", ["", "measured"], limits),
    ]


def _stage_table(presets: Mapping[str, Any]) -> Table:
    kinds = [(preset, kind) for kind in ("training", "rendering") for preset in ("paper", "swift")]
    columns = [presets[preset][kind]["seconds_per_ray"] for preset, kind in kinds]
    stages = dict.fromkeys(stage for column in columns for stage in column)
    rows = [(stage, *(_shown(_micro(c.get(stage)), "{:.1f}") for c in columns)) for stage in stages]
    rows.append(("sum", *(f"{sum(column.values()) * 1e6:.1f}" for column in columns)))
    return Table("Where the time goes, microseconds per ray", ["stage", *map(" ".join, kinds)], rows)


def _micro(seconds: float | None) -> float | None:
    return None if seconds is None else seconds * 1e6


def _cost_table(stored: Stored) -> Table:
    columns = ["scene, method", "training, min", "steps", "training memory", "s per frame", "rays/s, encoding included"]
    columns.append("evaluation memory")
    found = stored.results
    rows = [
        (f"{scene}, {method}", *_cost(found[scene][method]))
        for scene in sorted(found, key=lambda s: SCENES.index(s) if s in SCENES else len(SCENES))
        for method in METHODS
        if method in found[scene]
    ]
    return Table("", columns, rows)


def _cost(result: Result) -> tuple[str, ...]:
    trained = result.evaluation["configuration"].get("trained")
    memory = {
        step: _shown(result.process.get(step, {}).get("peak_memory_bytes", 0) / 1e9 or None, "{:.2f} GB")
        for step in ("train", "evaluate")
    }
    return (
        f"{trained['seconds'] / 60:.1f}" if trained else NOTHING,
        f"{trained['steps']:,}" if trained else NOTHING,
        memory["train"],
        f"{result.evaluation['seconds_per_frame']:.2f}",
        f"{result.evaluation['rays_per_second']:,.0f}",
        memory["evaluate"],
    )


def _frame(memory: Mapping[str, Any] | None) -> str:
    if memory is None:
        return "A large frame: not measured."
    width, height = memory["size_px"]
    return (
        f"A frame of {width} x {height} px from {memory['photographs']} photographs of that size, decoding and "
        f"encoding included ({memory['preset']}, {memory['device']}): {memory['peak_memory_bytes'] / 1e9:.2f} GB, "
        f"{memory['seconds']:.0f} s."
    )


def _commands(stored: Stored) -> list[str]:
    """Each once, with SCENE for the name of the scene."""
    commands = [record["command"] for record in (stored.speed, stored.memory) if record]
    for scene, methods in stored.results.items():
        steps = [methods[m].process.get(step) for m in METHODS if m in methods for step in ("train", "evaluate")]
        commands += [step["command"].replace(f"/{scene}", "/SCENE") for step in steps if step]
    return list(dict.fromkeys(commands))
