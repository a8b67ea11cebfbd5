"""The tables of a comparison: the paper's Tables 2 and 3, and what each method took."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tidefield.compare import published
from tidefield.compare.results import Result, Results
from tidefield.compare.table import NOTHING, Table, shown
from tidefield.evaluation.lpips import BACKBONES

METRICS = (
    ("psnr", "PSNR, dB", "{:.2f}", True),
    ("ssim", "SSIM", "{:.3f}", True),
    ("lpips_alex", "LPIPS, AlexNet", "{:.3f}", False),
    ("lpips_vgg", "LPIPS, VGG", "{:.3f}", False),
    ("flip", "FLIP", "{:.3f}", False),
)
"""Name, title, style, and whether more is better."""
VIEWS = {
    "": "all pixels",
    "_seen": "pixels that two training photographs or more see",
    "_cc": "all pixels, after the colour fit",
    "_seen_cc": "pixels that two training photographs or more see, after the colour fit",
}
"""Suffixes of metrics, and what they mean."""
MEAN = "mean"


def all_tables(results: Results) -> list[Table]:
    """The paper's tables, where the scenes are among its, then every metric, then what each method took."""
    papers = (
        paper_table(results, published.TABLE_2, "As the paper's Table 2: scenes of mip-NeRF 360"),
        paper_table(results, published.TABLE_3, "As the paper's Table 3: tidal flats; ours are synthetic"),
    )
    return [*(table for table in papers if table is not None), *quality_tables(results), cost_table(results)]


def missing_metrics(results: Results) -> list[str]:
    """Why some metrics have no value, as sentences."""
    missing: dict[str, list[str]] = {}
    for metric, *_ in METRICS:
        for result in results.by.values():
            reason = result.evaluation["mean"]["reasons"].get(metric)
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
    told = {True: "as it is published", False: "which is another file than the published one"}
    return [
        f"LPIPS with {file}, {told[sha256.startswith(file[-12:-4])]} (SHA-256 {sha256})."
        for file, sha256 in sorted(found)
    ]


def quality_tables(results: Results) -> list[Table]:
    """One for each metric and each way to look at it; the best of a line stands out."""
    return [
        _quality(results, metric + suffix, f"{title}, {over}", style, more)
        for suffix, over in VIEWS.items()
        for metric, title, style, more in METRICS
        if any(result.metric(metric + suffix) is not None for result in results.by.values())
    ]


def _quality(results: Results, name: str, title: str, style: str, more: bool) -> Table:
    rows, bold = [], set()
    for i, scene in enumerate((*results.scenes, MEAN)):
        values = [
            results.mean(method, name, results.scenes) if scene == MEAN else results.metric(scene, method, name)
            for method in results.methods
        ]
        known = [value for value in values if value is not None]
        best = (max if more else min)(known) if len(known) > 1 else None
        bold |= {(i, j + 1) for j, value in enumerate(values) if value is not None and value == best}
        rows.append([scene, *(shown(value, style) for value in values)])
    better = "more is better" if more else "less is better"
    return Table(f"{title} ({better})", ["scene", *results.methods], rows, frozenset(bold))


def paper_table(
    results: Results, figures: Mapping[str, Mapping[str, tuple[float, float, float]]], title: str
) -> Table | None:
    """Measured figures beside published ones, as the paper arranges them; None where no scene is among them."""
    scenes = [scene for scene in results.scenes if scene in figures]
    if not scenes:
        return None
    ours = [method for method in ("tidefield", "nerfacto") if method in results.methods]
    columns, rows = ["scene"], [[scene] for scene in (*scenes, MEAN)]
    for k, (metric, style) in enumerate((("psnr", "{:.2f}"), ("ssim", "{:.3f}"), ("lpips_vgg", "{:.3f}"))):
        for method in ours:
            columns.append(f"{metric.partition('_')[0].upper()} {method}")
            values = [results.metric(s, method, metric) for s in scenes] + [results.mean(method, metric, scenes)]
            for row, value in zip(rows, values, strict=True):
                row.append(shown(value, style))
        for method in ("tidefield", "nerfacto"):
            columns.append(f"{published.METRICS[k].upper()} published, {'paper' if method == 'tidefield' else method}")
            stated = [figures[scene][method][k] for scene in scenes]
            for row, value in zip(rows, [*stated, sum(stated) / len(stated)], strict=True):
                row.append(style.format(value))
    return Table(title, columns, rows)


def cost_table(results: Results) -> Table:
    """What each method took."""
    columns = ["scene, method", "training, min", "steps", "s per frame", "rays/s", "memory, GB (train, evaluate)"]
    rows = [
        [f"{scene}, {method}", *_cost(results.by[scene, method])]
        for scene in results.scenes
        for method in results.methods
        if (scene, method) in results.by
    ]
    return Table("What it took; evaluating with the networks of LPIPS, where they are there", columns, rows)


def _cost(result: Result) -> Sequence[str]:
    memory = (result.peak_bytes(step) for step in ("train", "evaluate"))
    return [
        shown(result.trained_minutes, "{:.1f}"),
        shown(result.steps, "{:,}"),
        f"{result.evaluation['seconds_per_frame']:.2f}",
        f"{result.evaluation['rays_per_second']:,.0f}",
        ", ".join(NOTHING if value is None else f"{value / 1e9:.2f}" for value in memory),
    ]
