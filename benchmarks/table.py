"""The page of results, from nothing but what the comparison, the ablation and the benchmarks kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.bars import SCENES, Bar, Kept, judge
from benchmarks.begun import by_length, length_of, length_tables
from benchmarks.frames import FRAMES_FILE
from benchmarks.memory import MEMORY_FILE
from tidefield.compare.ablation import ablation_tables, variants, verdicts
from tidefield.compare.results import Results, read_figures
from tidefield.compare.run import METHODS, WHOLE
from tidefield.compare.table import NOTHING, Table, shown
from tidefield.compare.tables import all_tables, lpips_weights, missing_metrics
from tidefield.errors import RunError
from tidefield.files import completed_file, read_json
from tidefield.machine import describe

SPEED_FILE = "speed.json"


def write_page(
    comparison: Sequence[Path], ablation: Sequence[Path], begun: Sequence[Path], runs: Path, out: Path
) -> None:
    """Read what is there and write it as Markdown.

    Args:
        comparison: files of `tidefield compare`.
        ablation: files of `tidefield ablate`.
        begun: files of `tidefield compare` with other lengths of training, and from scratch.
        runs: folder of the benchmarks.
        out: the file.

    Raises:
        RunError: when there is nothing.
    """
    compared, ablated = read_figures(comparison, SCENES, METHODS), read_figures(ablation, SCENES, variants(()))
    shorter = [read_figures([file], SCENES, (WHOLE,)) for file in begun]
    kept = Kept(*(read_json(runs / file) for file in (SPEED_FILE, MEMORY_FILE, FRAMES_FILE)))
    if not (compared.by or ablated.by or kept.speed or kept.memory or kept.frames):
        named = ", ".join(map(str, (*comparison, *ablation, runs)))
        raise RunError(
            f"{named} hold no results: expected what `tidefield compare`, `tidefield ablate` and the benchmarks leave "
            "there; run them"
        )
    with completed_file(out, overwrite=True) as partial:
        partial.write_text(page(compared, ablated, shorter, kept), encoding="utf-8")


def page(compared: Results, ablated: Results, begun: Sequence[Results], kept: Kept) -> str:
    """The whole page."""
    records, lengths = _records(compared, ablated, begun, kept), by_length(compared, begun)
    return (
        "\n\n".join(
            [
                "# Results",
                "`make bench ARGS=table` wrote this page from what `tidefield compare`, `tidefield ablate`, `speed`, "
                "`frames` and `memory` left in [docs/measured](measured); nothing is typed by hand.",
                "\n".join(f"- {line}" for line in _circumstances(records)),
                "## What was aimed at",
                _bar_table(judge(compared, kept, lengths)).markdown(),
                "## Methods on the same photographs, split, resolution, machine and budget",
                "Means over the held-out photographs.",
                *(table.markdown() for table in (all_tables(_narrowed(compared)) if compared.by else ())),
                *lpips_weights(compared),
                *missing_metrics(compared),
                "## What trained weights bring",
                *([table.markdown() for table in length_tables(lengths)] or ["Not measured."]),
                "## What each part brings",
                *(verdicts(ablated) or ["Not measured."]),
                *(table.markdown() for table in ablation_tables(ablated)),
                "## Speed",
                *_speed(kept.speed),
                "## Views of a scene that nothing was trained on",
                *([table.markdown() for table in frame_tables(kept.frames)] if kept.frames else ["Not measured."]),
                "## A large frame",
                _frame(kept.memory),
                "## Commands",
                "\n".join(f"    {command}" for command in dict.fromkeys(record["command"] for _, record in records)),
            ]
        )
        + "\n"
    )


def _narrowed(results: Results) -> Results:
    """Without columns of methods that were nowhere."""
    there = tuple(method for method in results.methods if any(m == method for _, m in results.by))
    return Results(results.scenes, there, results.by)


def _records(
    compared: Results, ablated: Results, begun: Sequence[Results], kept: Kept
) -> list[tuple[str, Mapping[str, Any]]]:
    """Everything with a date, a machine and a command, and what it is called."""
    named = [
        *((method, result) for (_, method), result in compared.by.items()),
        *(("ablation", result) for result in ablated.by.values()),
        *((length_of(result), result) for results in begun for result in results.by.values()),
    ]
    steps = [(name, result.process.get(step)) for name, result in named for step in ("train", "evaluate")]
    return [(name, record) for name, record in (*vars(kept).items(), *steps) if record]


def _circumstances(records: Sequence[tuple[str, Mapping[str, Any]]]) -> list[str]:
    machines: dict[str, dict[str, None]] = {}
    dates = sorted({record["date"] for _, record in records})
    for name, record in records:
        machine = record["machine"]
        text = (
            f"{machine['processor']}, {machine['cores']} cores, {machine['memory_bytes'] / 2**30:.0f} GiB; "
            f"{machine['system']}, Python {machine['python']}, torch {machine['torch']}"
        )
        machines.setdefault(text, {})[name] = None
    versions = sorted({record["version"] for _, record in records})
    measured = " to ".join(dict.fromkeys([dates[0], dates[-1]])) if dates else "at an unknown date"
    several = len(machines) > 1
    return [
        *(
            f"Machine: {': '.join([text, ', '.join(names)] if several else [text])}."
            for text, names in machines.items()
        ),
        f"Measured {measured} with Tidefield {', '.join(versions) or 'of unknown version'}; "
        f"written {describe()['date']}.",
    ]


def _bar_table(bars: Sequence[Bar]) -> Table:
    words = {True: "met", False: "not met", None: NOTHING}
    return Table("", ["aim", "result", ""], [(b.aim, b.result, words[b.met]) for b in bars])


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
    rows = [(stage, *(shown(_micro(c.get(stage)), "{:.1f}") for c in columns)) for stage in stages]
    rows.append(("sum", *(f"{sum(column.values()) * 1e6:.1f}" for column in columns)))
    return Table(
        "Where the time goes, microseconds per ray, with all cores at one piece after another",
        ["stage", *map(" ".join, kinds)],
        rows,
    )


def _micro(seconds: float | None) -> float | None:
    return None if seconds is None else seconds * 1e6


def frame_tables(frames: Mapping[str, Any]) -> list[Table]:
    """Seconds of views, and how steady they are."""
    (width, height), first = frames["size_px"], frames["first"]
    rows = [
        ("the first, from the scene on disk and with the program's start", f"{first['seconds']:.1f}"),
        ("every further one along a flight, median", f"{frames['further_seconds']:.2f}"),
        *(
            (f"one view again and again, of {count} photographs", f"{seconds:.2f}")
            for count, seconds in frames["by_photographs"].items()
        ),
    ]
    steady = [
        (
            name,
            *(shown(found[key], "{:.2f}") for key in ("mean_levels", "greatest_levels", "greatest_of_a_tile_levels")),
        )
        for name, found in frames["steadiness"].items()
    ]
    title = f"Zero-shot views of {width} x {height} px, {frames['preset']}, {frames['device']}"
    return [
        Table(title, ["view", "seconds"], rows),
        Table(
            "Neighbours that fade before they are left out: how much consecutive views of a slow flight differ where "
            "they show the same, levels of 255",
            ["neighbours", "mean", "the two that differ most", "the tile that differs most"],
            steady,
        ),
    ]


def _frame(memory: Mapping[str, Any] | None) -> str:
    if memory is None:
        return "Not measured."
    width, height = memory["size_px"]
    return (
        f"A frame of {width} x {height} px from {memory['photographs']} photographs of that size, decoding and "
        f"encoding included ({memory['preset']}, {memory['device']}): {memory['peak_memory_bytes'] / 1e9:.2f} GB, "
        f"{memory['seconds']:.0f} s."
    )
