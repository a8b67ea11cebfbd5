"""The page of results, made of nothing but what the comparisons, the ablation and the benchmarks stored."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks import depth, points
from benchmarks import parts as paper_parts
from benchmarks.frames import FRAMES_FILE, frame_tables
from benchmarks.memory import MEMORY_FILE
from benchmarks.records import MEASURED, STRICT_400, say
from benchmarks.speed import SPEED_FILE, speed_tables
from tidefield.compare.ablation import ablation_tables, summarise
from tidefield.compare.circumstances import code_and_machines, machines, short, when
from tidefield.compare.results import Result, Results, read_figures
from tidefield.compare.run import WHOLE
from tidefield.compare.tables import (
    REGIONS,
    TABLE_3,
    Mark,
    Table,
    cost_table,
    learned_from,
    legend,
    lpips_weights,
    marked,
    missing_metrics,
    nerfacto_limits,
    opensplat_limits,
    paper_table,
    quality_tables,
    scene_marks,
    shown,
    trainings,
    untrained_limits,
)
from tidefield.errors import RunError
from tidefield.evaluation.metrics import METRICS
from tidefield.files import read_json, write_text
from tidefield.machine import describe
from tidefield.methods import names

COMPARISON = tuple(MEASURED / f"{name}.json" for name in ("comparison", "nerf", "paper", "paper_zero_shot"))
ABLATION = tuple(MEASURED / f"{name}.json" for name in ("ablation", "ablation_water"))
LENGTHS = tuple(MEASURED / f"{name}.json" for name in ("minute", "scratch"))
WIDTHS = (*STRICT_400, *(MEASURED / f"strict_{width}.json" for width in (800, 1600)))
SHOWN_REGIONS = ("", "_seen_cc")
"""Of `REGIONS`, those on the page; docs/measured has all."""
GPU_FOLDER, GPU_QUALITY, LARGE_FRAMES_FILE = "gpu", "strict_800.json", "frames_1920.json"
"""What was measured on a GPU, beside files of speed and frames."""
LENGTHS_PX = 400
"""Width of the photographs in comparisons of lengths of training."""
SCENES = (*TABLE_3, "caliterra", "swindale", "turin_lot", "brighton_beach", "fern", "lego")
"""In the order of the tables."""
WITHOUT_ALPHA = Mark(
    "⁴",
    ("lego",),
    "the shipped weights and their recipe do not know it. Its photographs have an alpha channel, which Tidefield uses "
    "(visual hull, known background) and which Nerfacto was not given when this was measured: any lead of Tidefield "
    "over Nerfacto here rests on that.",
)
"""Of figures without a protocol, which are older than alpha in what nerfstudio gets."""
SOURCES = (
    ("caliterra", "a building site in Texas, bare soil, from a fixed wing", "OpenDroneMap/odm_data_caliterra"),
    ("swindale", "a river restoration in Cumbria, muddy channel and grass", "vesnikos/Swindale-UAV-Images"),
    ("turin_lot", "a vacant lot in Turin, from straight above and obliquely", "vinstray/i-sfm"),
    ("brighton_beach", "a park on the shore of Lake Superior", "pierotofy/drone_dataset_brighton_beach"),
    ("fern", "a fern from the front", "LLFF (Mildenhall et al., 2019)"),
    ("lego", "a rendered model on white", "NeRF's synthetic scenes (Mildenhall et al., 2020)"),
)
"""Real scenes, and where their photographs are from: repositories of GitHub, or data of a publication."""
PUBLISHED = (
    ("IBRNet (Wang et al., CVPR 2021)", "LLFF", 25.13, 26.73),
    ("NeuRay (Liu et al., CVPR 2022)", "LLFF", 25.35, 27.06),
    ("GNT (Varma et al., ICLR 2023)", "LLFF", 25.86, 27.24),
    ("Quark (Flynn et al., SIGGRAPH Asia 2024)", "LLFF", 26.03, None),
    ("Quark (Flynn et al., SIGGRAPH Asia 2024)", "DL3DV", 31.31, None),
    ("Zip-NeRF, in Quark's comparison", "DL3DV", None, 31.22),
)
"""Methods of the same kind, and a peer: data, PSNR in dB without and with optimisation on each scene, as published."""
NO_LPIPS = (
    "There is no LPIPS column: earlier figures were made with backbone files other than the published ones; the column "
    "comes back when the measurements are repeated after `tidefield evaluate --download-lpips`, which fetches the "
    "published weights."
)


@dataclass(frozen=True)
class Stored:
    """What the benchmarks stored; None for what was not measured."""

    speed: Mapping[str, Any] | None = None
    memory: Mapping[str, Any] | None = None
    frames: Mapping[str, Any] | None = None
    depth: Mapping[str, Any] | None = None
    points: Mapping[str, Any] | None = None
    parts: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class OnGpu:
    """What was stored of a GPU: speed, views of two sizes, and a comparison with a remark on how it was made.

    `width` is that of the comparison's photographs, pixels.
    """

    speed: Mapping[str, Any] | None
    frames: Mapping[str, Any] | None
    large_frames: Mapping[str, Any] | None
    compared: Results
    remark: str
    width: int | None


def read_gpu(folder: Path) -> OnGpu:
    """Read what was measured on a GPU."""
    quality = folder / GPU_QUALITY
    compared = without_empty_columns(read_figures([quality], SCENES, names()))
    speed, frames, large = (read_json(folder / file) for file in (SPEED_FILE, FRAMES_FILE, LARGE_FRAMES_FILE))
    record = read_json(quality) or {}
    return OnGpu(speed, frames, large, compared, record.get("remark", ""), record.get("settings", {}).get("width"))


def table(
    comparison: tuple[Path, ...] = COMPARISON,
    ablation: tuple[Path, ...] = ABLATION,
    lengths: tuple[Path, ...] = LENGTHS,
    widths: tuple[Path, ...] = WIDTHS,
    runs: Path = MEASURED,
    out: Path = Path("docs/results.md"),
) -> None:
    """Read the stored measurements and write the page as Markdown.

    Args:
        comparison: Files of `tidefield compare`; of a result in several files the last one counts.
        ablation: Files of `tidefield ablate`, likewise.
        lengths: Files of `tidefield compare` at 400 px with other lengths of training, and from scratch.
        widths: Files of `tidefield compare` with the scenes at several widths.
        runs: Folder of speed, frames, memory, depth, points and parts.
        out: The Markdown file to write; replaced if it is there.

    Raises:
        RunError: when there is no measurement at all.
    """
    compared, ablated = read_figures(comparison, SCENES, names()), read_figures(ablation, SCENES)
    others = [read_figures([file], SCENES, (WHOLE,)) for file in lengths]
    sized = by_width(widths)
    files = (SPEED_FILE, MEMORY_FILE, FRAMES_FILE, depth.DEPTH_FILE, points.POINTS_FILE, paper_parts.PARTS_FILE)
    stored = Stored(*(read_json(runs / file) for file in files))
    if not (compared.by or ablated.by or sized or any(vars(stored).values())):
        places = ", ".join(map(str, (*comparison, *ablation, *widths, runs)))
        raise RunError(
            f"{places} hold no results: expected files of `tidefield compare`, `tidefield ablate` and the benchmarks; "
            "run them"
        )
    write_text(out, page(compared, ablated, others, sized, stored, read_gpu(runs / GPU_FOLDER)))
    say(out)


def page(
    compared: Results,
    ablated: Results,
    others: Sequence[Results],
    sized: Mapping[int, Results],
    stored: Stored,
    gpu: OnGpu,
) -> str:
    """The whole page: results first, circumstances and commands last."""
    records = [*_records(compared, ablated, others, sized, stored), *_gpu_records(gpu)]
    marks = scene_marks(learned_from())
    same_width = [results for width, results in sized.items() if width == LENGTHS_PX]
    lengths = [marked(table, marks) for table in length_tables(by_length([*same_width, *others]))]
    parts = [
        "# Results",
        "## Quality, by width",
        *(_widths(sized) or ["Not measured."]),
        "## Scenes",
        "None of these is a tidal flat. The others on this page are built-in flats, named after their categories.",
        Table("", ["scene", "what", "from"], SOURCES).markdown(),
        "## Quality beside other methods",
        *(_quality(compared) or ["Not measured."]),
        "## The field, as published",
        "PSNR in dB, all pixels, from the methods' own publications: other scenes, splits, GPUs and hours of training. "
        "Nothing of it was measured here, and it cannot be set beside figures of this page; it tells how far methods "
        "over neighbouring views get without training on a scene, and what that training adds.",
        published_table().markdown(),
        "## Quality against training time",
        f"Photographs of {LENGTHS_PX} px, on CPUs; from the shipped weights, or *from scratch*, from random ones.",
        *([table.markdown() for table in lengths] or ["Not measured."]),
        "## Ablation",
        *age([*ablated.by.values()]),
        *(summarise(ablated) or ["Not measured."]),
        *(table.markdown() for table in ablation_tables(ablated)),
        "## What the paper's parts bring",
        "Zero-shot, with weights that were trained across scenes alike, with and without them: the preset `swift` has "
        "those parts that bring something there.",
        *_dated(stored.parts, paper_parts.tables),
        "## Depth",
        "Zero-shot, of held-out views of built-in flats, against the exact truth, in doubly seen pixels; *points* are "
        "interpolated in the view. The weights learned from other flats of the same generator.",
        *_dated(stored.depth, depth.tables),
        "## Scenes without sparse points",
        "Zero-shot, with the points of COLMAP, and without any: then they are found when the scene is opened.",
        *_dated(stored.points, points.tables),
        "## Speed",
        *_speed(stored.speed),
        "## Zero-shot views",
        *([table.markdown() for table in frame_tables(stored.frames)] if stored.frames else ["Not measured."]),
        "## On a GPU",
        *(_on_gpu(gpu) or ["Not measured."]),
        "## Memory of a large frame",
        _frame(stored.memory),
        "## Time and memory of each method",
        *([cost_table(compared).markdown()] if compared.by else ["Not measured."]),
        "## How this was measured",
        "\n".join(f"- {line}" for line in circumstances(records)),
        "`make bench ARGS=table` wrote this page from [docs/measured](measured); nothing is typed by hand but the "
        "remark on how a GPU was used. The commands:",
        "\n".join(f"    {command}" for command in dict.fromkeys(record["command"] for _, record in records)),
    ]
    return "\n\n".join(parts) + "\n"


def _dated(record: Mapping[str, Any] | None, tables: Callable[[Mapping[str, Any]], Sequence[Table]]) -> list[str]:
    """Tables of a benchmark, after the code that they were measured with: others on the page have newer code."""
    if record is None:
        return ["Not measured."]
    commit = short(record["commit"] or "unknown")
    made = f"Measured {record['date']} at commit {commit}: compare its columns with each other."
    return [made, *(table.markdown() for table in tables(record))]


def _quality(compared: Results) -> list[str]:
    """Tables of quality with the sentences that one must know to read them."""
    if not compared.by:
        return []
    results = without_empty_columns(compared)
    marks = marks_of(results, learned_from())
    tables = quality_tables(results, {suffix: REGIONS[suffix] for suffix in SHOWN_REGIONS})
    papers = paper_table(results, TABLE_3, "As the paper's Table 3: tidal flats; ours are synthetic")
    measured = any(
        of.metric(metric) is not None for of in results.by.values() for metric in ("lpips_alex", "lpips_vgg")
    )
    return [
        *age([*compared.by.values()]),
        "Means over the held-out photographs. Every method had the same photographs, split, resolution and minutes of "
        "training; bold is the best.",
        *code_and_machines(results),
        *notes(results, marks),
        *(marked(table, marks).markdown() for table in tables),
        *([papers.markdown()] if papers else []),
        *(lpips_weights(results) if measured else [NO_LPIPS]),
        *missing_metrics(results),
    ]


def age(results: Sequence[Result]) -> list[str]:
    """What measurements without the strict protocol were made with, as a sentence; nothing if all have it."""
    older = [result for result in results if "protocol" not in result.evaluation]
    if not older:
        return []
    records = [record for result in older for record in (result.process.get("train"), result.process.get("evaluate"))]
    versions = sorted({record["version"] for record in records if record})
    return [
        f"Measured with Tidefield {', '.join(versions) or 'of unknown version'}, with the networks and weights of that "
        "time, before the strict protocol: sparse points and ranges of depths owed something to held-out photographs, "
        "too. Do not set these figures beside those by width."
    ]


def published_table() -> Table:
    """What others published of methods of this kind."""
    rows = []
    for name, data, zero_shot, trained in PUBLISHED:
        gain = None if zero_shot is None or trained is None else trained - zero_shot
        rows.append([name, data, *(shown(value, "{:.2f}") for value in (zero_shot, trained, gain))])
    return Table("", ["method", "data", "zero-shot", "trained on each scene", "gain"], rows)


def without_empty_columns(results: Results) -> Results:
    """The same results, with those methods that have any."""
    there = {method for _, method in results.by}
    return Results(results.scenes, tuple(method for method in results.methods if method in there), results.by)


def marks_of(results: Results, learned: Collection[str]) -> tuple[Mark, ...]:
    """The marks of scenes next to weights that learned from some of them."""
    nerfacto = [result for (scene, method), result in results.by.items() if method == "nerfacto" and scene == "lego"]
    older = any("protocol" not in result.evaluation for result in nerfacto)
    return (*scene_marks(learned), *([WITHOUT_ALPHA] if older else []))


def notes(results: Results, marks: Sequence[Mark]) -> list[str]:
    """What a reader must know of some methods and scenes, as sentences."""
    trained = "\n".join(f"- {line}" for line in trainings(results))
    devices = {result.process.get("settings", {}).get("device") for result in results.by.values()}
    others = [untrained_limits(results, device) for device in sorted(devices - {None})]
    limits = [*(line for lines in others for line in lines), *nerfacto_limits(results), *opensplat_limits(results)]
    return [*limits, *([trained] if trained else []), *legend(results.scenes, marks)]


def by_width(files: Sequence[Path]) -> dict[int, Results]:
    """Read comparisons of one width each; several of one width are joined."""
    groups: dict[int, list[Path]] = {}
    for file in files:
        if (record := read_json(file)) is not None:
            groups.setdefault(int(record["settings"]["width"]), []).append(file)
    return {
        width: without_empty_columns(read_figures(group, SCENES, names())) for width, group in sorted(groups.items())
    }


PLACED_AFTERWARDS = (
    "Made from photographs by `tidefield prepare --holdout`, so that their poses and points owe nothing to "
    "held-out photographs, either: "
)
PLACED_TOGETHER = "With poses and lenses of all photographs, the held-out ones included: "


def _poses(results: Results) -> list[str]:
    """Which scenes' poses owe something to held-out photographs, as sentences."""
    groups: dict[str, dict[str, None]] = {PLACED_AFTERWARDS: {}, PLACED_TOGETHER: {}}
    for (scene, _), result in results.by.items():
        groups[PLACED_AFTERWARDS if result.evaluation.get("held_out_of_poses") else PLACED_TOGETHER][scene] = None
    return [f"{sentence}{', '.join(scenes)}." for sentence, scenes in groups.items() if scenes]


def _widths(sized: Mapping[int, Results]) -> list[str]:
    """Tables of quality and costs, of one width after another."""
    suffix = SHOWN_REGIONS[-1]
    parts = [
        "No pixel of a held-out photograph, and none of its observations of sparse points, had a part in what it was "
        "compared with. `sparse-depth`, the baseline, blends the same neighbours on the surface of the sparse points "
        "and reads photographs in the same way. Our presets and the methods without training read what lies between "
        "pixels from files of twice the width, where there are such (method, section 3): on all scenes but lego at "
        "400 px, on all but caliterra at 800 px, on none at 1600 px."
    ]
    for width, results in sized.items():
        marks = marks_of(results, learned_from())
        tables = quality_tables(results, {suffix: REGIONS[suffix]})
        costs = cost_table(results)
        parts += [
            f"### {width} px",
            *code_and_machines(results),
            *_poses(results),
            *notes(results, marks),
            *(marked(replace(table, title=f"{width} px: {table.title}"), marks).markdown() for table in tables),
            replace(costs, title=f"{width} px: {costs.title}").markdown(),
        ]
    return parts if sized else []


def _on_gpu(gpu: OnGpu) -> list[str]:
    """Quality, speed and views on a GPU."""
    suffix, marks = SHOWN_REGIONS[-1], marks_of(gpu.compared, learned_from())
    quality = quality_tables(gpu.compared, {suffix: REGIONS[suffix]}) if gpu.compared.by else []
    costs = [cost_table(gpu.compared)] if gpu.compared.by else []
    views = [table for record in (gpu.frames, gpu.large_frames) if record for table in frame_tables(record)]
    tables = [*(marked(table, marks) for table in quality), *costs, *views]
    return [
        *([f"Photographs of {gpu.width} px. {gpu.remark}"] if quality else []),
        *code_and_machines(gpu.compared),
        *(_poses(gpu.compared)),
        *(notes(gpu.compared, marks) if quality else []),
        *(replace(table, title=f"On a GPU: {table.title}").markdown() for table in tables),
        *([table.markdown() for table in speed_tables(gpu.speed)] if gpu.speed else []),
    ]


def _gpu_records(gpu: OnGpu) -> list[tuple[str, Mapping[str, Any]]]:
    """What has a date, a machine and a command, all under one name."""
    steps = [one.process.get(step) for one in gpu.compared.by.values() for step in ("train", "evaluate")]
    return [("on a GPU", record) for record in (gpu.speed, gpu.frames, gpu.large_frames, *steps) if record]


ByLength = Mapping[str, Mapping[str, Result]]
"""Results by the name of the length of training, and by scene."""


def by_length(compared: Sequence[Results]) -> ByLength:
    """Our network after several lengths of training; shorter ones first, those from scratch last."""
    found: dict[tuple[bool, float, str], dict[str, Result]] = {}
    for results in compared:
        for (scene, method), result in results.by.items():
            settings = result.process.get("settings", {})
            minutes, scratch = settings.get("minutes"), bool(settings.get("from_scratch"))
            if method == "zero-shot":
                found.setdefault((False, 0.0, method), {})[scene] = result
            elif method == WHOLE and minutes is not None:
                found.setdefault((scratch, minutes, length_of(result)), {})[scene] = result
    return {name: scenes for (_, _, name), scenes in sorted(found.items(), key=lambda item: item[0])}


def length_of(result: Result) -> str:
    """The name of the length of a training."""
    settings = result.process.get("settings", {})
    minutes = settings.get("minutes")
    if minutes is None:
        name = f"{settings.get('steps')} steps"
    else:
        name = f"{60 * minutes:.0f} s" if minutes < 1 else f"{minutes:g} min"
    return f"{name} from scratch" if settings.get("from_scratch") else name


def length_tables(lengths: ByLength) -> list[Table]:
    """A table for each metric, of the scenes that were trained on for several lengths."""
    counted = [scene for scenes in lengths.values() for scene in scenes]
    shared = [scene for scene in dict.fromkeys(counted) if counted.count(scene) > 2]
    columns = {name: scenes for name, scenes in lengths.items() if set(scenes) & set(shared)}
    tables, suffix = [], SHOWN_REGIONS[-1]
    for name, metric in METRICS.items():
        values = [[(of[s].metric(name + suffix) if s in of else None) for of in columns.values()] for s in shared]
        if any(value is not None for row in values for value in row):
            rows = [[s, *(shown(v, metric.style) for v in row)] for s, row in zip(shared, values, strict=True)]
            better = "more" if metric.more_is_better else "less"
            title = f"{metric.title}, {REGIONS[suffix]} ({better} is better)"
            tables.append(Table(title, ["scene", *columns], rows))
    return tables


def _records(
    compared: Results,
    ablated: Results,
    others: Sequence[Results],
    sized: Mapping[int, Results],
    stored: Stored,
) -> list[tuple[str, Mapping[str, Any]]]:
    """Everything with a date, a machine and a command, with its name."""
    named = [
        *((method, result) for (_, method), result in compared.by.items()),
        *(("ablation", result) for result in ablated.by.values()),
        *((length_of(result), result) for results in others for result in results.by.values()),
        *((f"{width} px", result) for width, results in sized.items() for result in results.by.values()),
    ]
    steps = [(name, result.process.get(step)) for name, result in named for step in ("train", "evaluate")]
    return [(name, record) for name, record in (*vars(stored).items(), *steps) if record]


def circumstances(records: Sequence[tuple[str, Mapping[str, Any]]]) -> list[str]:
    """Machines, dates and versions of measurements, by their names."""
    measured = when(records)
    return [*machines(records), f"{measured[0].upper()}{measured[1:]}; written {describe()['date']}."]


def _speed(speed: Mapping[str, Any] | None) -> list[str]:
    if speed is None:
        return ["Not measured."]
    bounds = "Shares of the peak are lower bounds: elementwise work is not counted."
    return ["Medians, on the built-in scene unless the command names another; `paper` is the peer. " + bounds] + [
        table.markdown() for table in speed_tables(speed)
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
