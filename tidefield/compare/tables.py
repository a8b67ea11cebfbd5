"""Tables of a comparison as Markdown, LaTeX and CSV, and the files that a comparison leaves."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from tidefield.compare.circumstances import code_and_machines, machines, records_of, when
from tidefield.compare.results import Results, figures_of
from tidefield.compare.run import Settings, preset_of, starts_from_weights
from tidefield.config import PRESETS
from tidefield.data.load import DOUBLED_BYTES
from tidefield.evaluation.lpips import BACKBONES, hash_prefix
from tidefield.evaluation.metrics import METRICS
from tidefield.files import completed_file, write_json, write_text
from tidefield.methods import METHODS, UNTRAINED_DEVICE, names

NOTHING, MEAN = "-", "mean"
REGIONS = {
    "": "all pixels",
    "_seen": "pixels that two training photographs or more see",
    "_cc": "all pixels, after the colour fit",
    "_seen_cc": "pixels that two training photographs or more see, after the colour fit",
}
"""Suffixes of metrics, and over what they are taken."""
TABLE_2 = {
    "bicycle": {"tidefield": (22.74, 0.649, 0.384), "nerfacto": (19.62, 0.497, 0.385)},
    "bonsai": {"tidefield": (27.33, 0.872, 0.252), "nerfacto": (21.40, 0.693, 0.302)},
    "counter": {"tidefield": (25.51, 0.798, 0.328), "nerfacto": (24.01, 0.744, 0.331)},
    "garden": {"tidefield": (25.01, 0.745, 0.282), "nerfacto": (23.06, 0.627, 0.284)},
    "kitchen": {"tidefield": (25.92, 0.789, 0.302), "nerfacto": (26.00, 0.791, 0.299)},
    "room": {"tidefield": (28.54, 0.891, 0.259), "nerfacto": (22.32, 0.777, 0.303)},
    "stump": {"tidefield": (15.97, 0.369, 0.736), "nerfacto": (15.96, 0.345, 0.727)},
}
"""The paper's Table 2: PSNR, SSIM and LPIPS on scenes of mip-NeRF 360. Its Nerfacto is far below what Nerfacto's
authors publish for the same scenes, so it is shown and not relied on."""
TABLE_3 = {
    "tidal_trees": {"nerfacto": (20.46, 0.685, 0.231), "tidefield": (21.77, 0.736, 0.171)},
    "river_mouths": {"nerfacto": (25.52, 0.418, 0.189), "tidefield": (24.90, 0.463, 0.145)},
    "ground_textures": {"nerfacto": (21.65, 0.464, 0.351), "tidefield": (22.18, 0.411, 0.209)},
    "vegetation": {"nerfacto": (23.39, 0.771, 0.240), "tidefield": (23.27, 0.787, 0.229)},
    "deep_water": {"nerfacto": (20.49, 0.429, 0.384), "tidefield": (20.34, 0.443, 0.383)},
}
"""The paper's Table 3: the same on its own tidal flats, which are not public; our categories only share the names."""
CHOSE_RECIPE = ("caliterra", "swindale", "fern")
"""Scenes whose held-out photographs chose the recipe of the shipped weights (docs/experiments.md). Their files do not
know: a recipe is chosen before it is used."""
NERFACTO_STEPS, NERFACTO_RAYS, NERFACTO_CPU_RAYS = 30_000, 4096, 1024
"""Nerfacto's default number of steps and of rays a batch in nerfstudio 1.1.5, and the rays a batch that it gets on CPUs
(`baselines/nerfstudio/worker.py`)."""
OPENSPLAT_STEPS, OPENSPLAT_SCHEDULE = 30_000, 3_000
"""OpenSplat's default number of steps, and after how many it doubles the photographs' size, from a quarter on."""
_LARGER = "Its memory is that of the larger of two processes, its own and Tidefield's."
_THOUSANDS = re.compile(r"(?<=\d),(?=\d{3})")
_ESCAPES = str.maketrans(
    {c: rf"\{c}" for c in "&%_#${}"}
    | {"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}"}
)


@dataclass(frozen=True)
class Table:
    """Cells as text; the first column is words, the others are figures.

    Attributes:
        title: may be empty.
        columns: the header.
        rows: the cells.
        bold: (row, column) of cells to emphasise.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    bold: frozenset[tuple[int, int]] = frozenset()

    def markdown(self) -> str:
        """A heading, where there is a title, and the table."""
        rows = [[f"**{c}**" if (i, j) in self.bold else c for j, c in enumerate(r)] for i, r in enumerate(self.rows)]
        lines = [self.columns, ["---", *["---:"] * (len(self.columns) - 1)], *rows]
        heading = [f"### {self.title}", ""] if self.title else []
        escaped = ([cell.replace("|", r"\|") for cell in line] for line in lines)
        return "\n".join([*heading, *(f"| {' | '.join(line)} |" for line in escaped)])

    def latex(self) -> str:
        """A table environment; needs the package booktabs."""
        rows = [
            [rf"\textbf{{{_tex(c)}}}" if (i, j) in self.bold else _tex(c) for j, c in enumerate(row)]
            for i, row in enumerate(self.rows)
        ]
        head, *body = (" & ".join(line) + r" \\" for line in ([*map(_tex, self.columns)], *rows))
        begin = [r"\begin{table}", rf"\caption{{{_tex(self.title)}}}"]
        begin.append(rf"\begin{{tabular}}{{l{'r' * (len(self.columns) - 1)}}}")
        end = [r"\bottomrule", r"\end{tabular}", r"\end{table}"]
        return "\n".join([*begin, r"\toprule", head, r"\midrule", *body, *end])

    def csv(self) -> str:
        """With a header; cells without a value are empty, and figures have no commas between thousands."""
        rows = ([name, *(_THOUSANDS.sub("", cell) for cell in cells)] for name, *cells in self.rows)
        return _csv([self.columns, *(["" if cell == NOTHING else cell for cell in row] for row in rows)])


def _csv(rows: Sequence[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _tex(text: str) -> str:
    return text.translate(_ESCAPES)


def shown(value: float | int | None, style: str) -> str:
    """A number as text, or a dash where there is none."""
    return NOTHING if value is None else style.format(value)


def missing_results(results: Results) -> list[str]:
    """Which methods have no results on which scenes, as a sentence."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for scene in results.scenes:
        groups.setdefault(tuple(m for m in results.methods if (scene, m) not in results.by), []).append(scene)
    found = [f"{', '.join(methods)} on {', '.join(scenes)}" for methods, scenes in groups.items() if methods]
    return [f"Not complete: no results of {'; '.join(found)}."] if found else []


def missing_metrics(results: Results) -> list[str]:
    """Why some metrics have no value, as sentences."""
    missing: dict[str, list[str]] = {}
    for metric in METRICS:
        for result in results.by.values():
            reason = result.evaluation["mean"].get("reasons", {}).get(metric)
            if reason is not None and metric not in missing.setdefault(reason, []):
                missing[reason].append(metric)
    return [f"No {', '.join(metrics)}: {reason}." for reason, metrics in missing.items()]


def lpips_weights(results: Results) -> list[str]:
    """Which weights LPIPS was measured with, as sentences; published files are named with the start of their hash."""
    found = {
        (file, sha256)
        for result in results.by.values()
        for metric, sha256 in result.evaluation.get("lpips_weights", {}).items()
        for _, file in [BACKBONES[metric]]
    }
    origin = {True: "the published file", False: "which is another file than the published one"}
    return [
        f"LPIPS with {file}, {origin[sha256.startswith(hash_prefix(file))]} (SHA-256 {sha256})."
        for file, sha256 in sorted(found)
    ]


def quality_tables(results: Results, regions: Mapping[str, str] = REGIONS) -> list[Table]:
    """One for each metric and region; the best of a line stands out."""
    return [
        _quality(results, name + suffix, f"{metric.title}, {over}", metric.style, metric.more_is_better)
        for suffix, over in regions.items()
        for name, metric in METRICS.items()
        if any(result.metric(name + suffix) is not None for result in results.by.values())
    ]


def _quality(results: Results, name: str, title: str, style: str, more: bool) -> Table:
    rows, bold = [], set()
    measured = {scene: [results.metric(scene, method, name) for method in results.methods] for scene in results.scenes}
    means = [results.mean(method, name, results.scenes) for method in results.methods]
    for i, (scene, values) in enumerate((*measured.items(), (MEAN, means))):
        known = [value for value in values if value is not None]
        best = (max if more else min)(known) if len(known) > 1 else None
        bold |= {(i, j + 1) for j, value in enumerate(values) if value is not None and value == best}
        rows.append([scene, *(shown(value, style) for value in values)])
    better = "more is better" if more else "less is better"
    return Table(f"{title} ({better})", ["scene", *results.methods], rows, frozenset(bold))


def paper_table(
    results: Results, figures: Mapping[str, Mapping[str, tuple[float, float, float]]], title: str
) -> Table | None:
    """Measured figures next to published ones, as the paper arranges them; None where no scene is among them."""
    scenes = [scene for scene in results.scenes if scene in figures]
    if not scenes:
        return None
    measured = [method for method in ("tidefield", "nerfacto") if method in results.methods]
    columns, rows = ["scene"], [[scene] for scene in (*scenes, MEAN)]
    published = (("psnr", "PSNR", "{:.2f}"), ("ssim", "SSIM", "{:.3f}"), ("lpips_vgg", "LPIPS", "{:.3f}"))
    for k, (metric, name, style) in enumerate(published):
        if not any(results.metric(scene, method, metric) is not None for scene in scenes for method in measured):
            continue
        for method in measured:
            columns.append(f"{name} {method}")
            values = [results.metric(s, method, metric) for s in scenes] + [results.mean(method, metric, scenes)]
            for row, value in zip(rows, values, strict=True):
                row.append(shown(value, style))
        for method in ("tidefield", "nerfacto"):
            columns.append(f"{name} published, {'paper' if method == 'tidefield' else method}")
            stated = [figures[scene][method][k] for scene in scenes]
            for row, value in zip(rows, [*stated, sum(stated) / len(stated)], strict=True):
                row.append(style.format(value))
    return Table(title, columns, rows)


def cost_table(results: Results) -> Table:
    """Time, speed and memory of each method."""
    columns = ["scene, method", "training, min", "steps", "s per frame", "rays/s"]
    columns += ["memory, GB (train)", "memory, GB (evaluate)"]
    on_gpu = any(result.evaluation.get("peak_cuda_memory_bytes") for result in results.by.values())
    columns += ["GPU memory, GB (evaluate)"] if on_gpu else []
    rows = []
    for scene, method in ((scene, method) for scene in results.scenes for method in results.methods):
        if (result := results.by.get((scene, method))) is None:
            continue
        seconds = result.trained("seconds")
        peaks = [result.process.get(step, {}).get("peak_memory_bytes") for step in ("train", "evaluate")]
        rows.append(
            [
                f"{scene}, {method}",
                shown(seconds and seconds / 60, "{:.1f}"),
                shown(result.trained("steps"), "{:,}"),
                shown(result.evaluation["seconds_per_frame"], "{:.2f}"),
                shown(result.evaluation["rays_per_second"], "{:,.0f}"),
                *(shown(peak and peak / 1e9, "{:.2f}") for peak in peaks),
            ]
        )
        if on_gpu:
            peak = result.evaluation.get("peak_cuda_memory_bytes")
            rows[-1].append(shown(peak and peak / 1e9, "{:.2f}"))
    title = "Time and memory (of an evaluation, the networks of LPIPS included where they were used)"
    return Table(title, columns, rows)


def untrained_limits(results: Results, device: str) -> list[str]:
    """What runs on the processor beside methods that run elsewhere."""
    found = [method for method in results.methods if method in names("untrained")]
    if not found or device == UNTRAINED_DEVICE:
        return []
    return [f"Without training, on the processor: {', '.join(found)}. Their times are not those of {device}."]


def nerfacto_limits(results: Results) -> list[str]:
    """How Nerfacto was run, as a sentence, where it has results: on CPUs it is far from its defaults."""
    steps, devices = _steps_and_devices(results, "nerfacto")
    if not steps:
        return []
    if devices != {"cpu"}:
        return [f"Within the budget Nerfacto made {_share_of_default(steps, NERFACTO_STEPS)}. {_LARGER}"]
    return [
        f"Nerfacto ran on CPUs, with {NERFACTO_CPU_RAYS:,} rays a batch instead of its default of {NERFACTO_RAYS:,}; "
        f"within the budget it made {_share_of_default(steps, NERFACTO_STEPS)}. Its figures are those of a method at "
        "the start of its training, and they are no evidence about Nerfacto trained to its end on a GPU. {_LARGER}"
    ]


def opensplat_limits(results: Results) -> list[str]:
    """How OpenSplat was run, as a sentence, where it has results."""
    steps, _ = _steps_and_devices(results, "opensplat")
    if not steps:
        return []
    return [
        f"Within the budget OpenSplat made {_share_of_default(steps, OPENSPLAT_STEPS)}; by default, it makes the first "
        f"{OPENSPLAT_SCHEDULE:,} with photographs of a quarter of their size, and as many more with half of it. It "
        "reads no masks. Its views are rendered by Tidefield, whose speed is not that of OpenSplat. {_LARGER}"
    ]


def _steps_and_devices(results: Results, method: str) -> tuple[list[int | float], set[str | None]]:
    """Of all results of a method."""
    found = [result for (_, name), result in results.by.items() if name == method]
    steps = [count for result in found if (count := result.trained("steps"))]
    return steps, {result.process.get("settings", {}).get("device") for result in found}


def _share_of_default(steps: list[int | float], default: int) -> str:
    ends = sorted({min(steps), max(steps)})
    counts, shares = (f"{end:,}" for end in ends), dict.fromkeys(f"{end / default:.1%}" for end in ends)
    return f"{' to '.join(counts)} steps, {' to '.join(shares)} of its default of {default:,}"


@dataclass(frozen=True)
class Mark:
    """A mark of some scenes in the tables, and what it means."""

    sign: str
    scenes: Collection[str]
    meaning: str


def learned_from(presets: Collection[str] = tuple(PRESETS)) -> tuple[str, ...]:
    """Names of the scenes that the installed weights of presets learned from, as their files say."""
    from tidefield.train.checkpoint import read_weights_file, shipped_weights

    files = [file for preset in presets if (file := shipped_weights(preset)) is not None]
    return tuple(sorted({name for file in files for name in read_weights_file(file)[0].get("real", ())}))


def scene_marks(learned: Collection[str]) -> tuple[Mark, ...]:
    """What scenes are to trained weights that learned from some of them: seen, like what was seen, or validation."""
    return (
        Mark(
            "¹",
            TABLE_3,
            "a category of the synthetic generator; the shipped weights learned from other scenes of the same "
            "generator.",
        ),
        Mark(
            "²",
            CHOSE_RECIPE,
            "nothing was learned from this scene, but results on it chose the recipe of the weights: it is validation, "
            "not test.",
        ),
        Mark(
            "³",
            learned,
            "the shipped weights learned from this scene's training photographs: its zero-shot figures are not those "
            "of an unseen scene, and training on it adds to what was learned before.",
        ),
    )


def marked(table: Table, marks: Sequence[Mark]) -> Table:
    """A table whose scenes carry their marks."""
    signs = [" ".join([row[0], *(mark.sign for mark in marks if row[0] in mark.scenes)]) for row in table.rows]
    return replace(table, rows=[[sign, *row[1:]] for sign, row in zip(signs, table.rows, strict=True)])


def legend(scenes: Sequence[str], marks: Sequence[Mark]) -> list[str]:
    """The meaning of the marks that some scenes carry, as a list; nothing where none has one."""
    found = [(mark, [scene for scene in scenes if scene in mark.scenes]) for mark in marks]
    lines = [f"- {mark.sign} {', '.join(names)}: {mark.meaning}" for mark, names in found if names]
    others = [scene for scene in scenes if not any(scene in mark.scenes for mark in marks)]
    if lines and others:
        lines.append(
            f"- without a mark ({', '.join(others)}): no scene of this name taught the shipped weights or chose their "
            "recipe."
        )
    return ["\n".join(lines)] if lines else []


def trainings(results: Results) -> list[str]:
    """How the columns of our presets were trained, as sentences."""
    sentences = []
    for method in results.methods:
        kind = METHODS[method].kind if method in METHODS else None
        own = [result for (_, name), result in results.by.items() if name == method]
        if kind == "zero-shot" and own:
            sentences.append(f"The column `{method}` has trained weights as they are, without a step on the scene.")
        elif kind == "preset" and own:
            starts = {"trained" if result.evaluation["configuration"].get("weights") else "random" for result in own}
            start = " or ".join(sorted(starts))
            steps = [count for result in own if (count := result.trained("steps")) is not None]
            made = " to ".join(f"{count:,}" for count in sorted({min(steps), max(steps)})) if steps else "unknown"
            sentences.append(f"The column `{method}` began with {start} weights and was trained for {made} steps.")
    return sentences


def write_comparison(
    results: Results, scenes: Mapping[str, Path], settings: Settings, out: Path, protocol: str | None = None
) -> list[Path]:
    """Write tables, figures, curves and comparison.json into the comparison's folder, over older ones.

    Args:
        protocol: whose scenes these are, if any: other scenes may have the names of those in the paper.

    Returns:
        The files.
    """
    from tidefield.compare.figures import side_by_side, write_curves
    from tidefield.data.load import load_scene

    # The paper's table of the protocol, then every metric, then time and memory.
    published = {
        "mipnerf360": (TABLE_2, "As the paper's Table 2: scenes of mip-NeRF 360"),
        "tidalflats": (TABLE_3, "As the paper's Table 3: tidal flats; ours are synthetic"),
    }
    paper = None if protocol is None else paper_table(results, *published[protocol])
    tables = [*([] if paper is None else [paper]), *quality_tables(results), cost_table(results)]
    presets = {str(preset_of(name, settings)) for name in results.methods if starts_from_weights(name, settings)}
    marks = scene_marks(learned_from(presets)) if presets else ()
    remarks = [*trainings(results), *legend(results.scenes, marks)]
    files = write_tables("tables", "Comparison", tables, remarks, results, settings, out, marks)
    files.append(write_figures("comparison", results, settings, out))
    for name, path in scenes.items():
        measured = any(scene == name for scene, _ in results.by)
        figure = side_by_side(results, name, load_scene(path, width=settings.width)) if measured else None
        file = out / "figures" / f"{name}.png"
        if figure is None:
            file.unlink(missing_ok=True)
            continue
        with completed_file(file, overwrite=True) as partial:
            figure.save(partial)
        files.append(file)
    curves = out / "curves.png"
    if any(result.curve for result in results.by.values()):
        with completed_file(curves, overwrite=True) as partial:
            write_curves(results, partial)
        files.append(curves)
    else:
        curves.unlink(missing_ok=True)
    return files


def widths(results: Results) -> str:
    """The widths that photographs were compared at, which those of small files are not asked for."""
    by_scene = {scene: result.evaluation["width"] for (scene, _), result in results.by.items()}
    if len(set(by_scene.values())) == 1:
        return str(next(iter(by_scene.values())))
    return ", ".join(f"{width} ({scene})" for scene, width in by_scene.items())


def write_tables(
    stem: str,
    title: str,
    tables: list[Table],
    remarks: list[str],
    results: Results,
    settings: Settings,
    out: Path,
    marks: Sequence[Mark] = (),
) -> list[Path]:
    """Write tables with their circumstances as STEM.md, and without these and marks as STEM.tex and STEM.csv; returns
    the files."""
    records = records_of(results)
    budget = f"{settings.minutes:g} minutes" if settings.minutes is not None else f"{settings.steps} steps"
    page = [
        f"# {title}",
        "Means over the held-out photographs. Each method had the same photographs, split and resolution, "
        f"and {budget} of training, one after another. Our presets and methods without training read what lies between "
        "pixels from files of twice the width, where there are such; methods without training and training itself do "
        f"so where those of a scene take {DOUBLED_BYTES / 1e9:g} GB at most.",
        f"On {settings.device}; photographs {widths(results)} px wide; {when(records)}.",
        *machines(records),
        *code_and_machines(results),
        *missing_results(results),
        *untrained_limits(results, settings.device),
        *nerfacto_limits(results),
        *opensplat_limits(results),
        *remarks,
        *lpips_weights(results),
        *missing_metrics(results),
        *(marked(table, marks).markdown() for table in tables),
    ]
    texts = {
        ".md": "\n\n".join(page) + "\n",
        ".tex": "\n\n".join(table.latex() for table in tables) + "\n",
        ".csv": "\n".join(_csv([[table.title]]) + table.csv() for table in tables),
    }
    files = [out / f"{stem}{suffix}" for suffix in texts]
    for file, text in zip(files, texts.values(), strict=True):
        write_text(file, text)
    return files


def write_figures(stem: str, results: Results, settings: Settings, out: Path) -> Path:
    """Write all figures with their settings as STEM.json; returns the file."""
    path = out / f"{stem}.json"
    write_json(path, {"settings": asdict(settings), "results": figures_of(results)})
    return path
