"""Tables of an ablation: the effect of leaving out or changing one part, next to the effect of another seed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tidefield.compare.results import Results
from tidefield.compare.run import OTHER_SEED, WHOLE, Settings
from tidefield.compare.tables import Table, shown, write_figures, write_tables
from tidefield.config import PRESETS, variants_of

LEAST_DB = 0.05
"""A smaller difference counts as noise, even if two seeds happen to agree better."""
WITHIN = "within the noise"
_METRICS = (
    ("psnr_seen", "PSNR, dB", "{:.2f}"),
    ("psnr_seen_cc", "PSNR after the colour fit, dB", "{:.2f}"),
    ("ssim_seen", "SSIM", "{:.4f}"),
    ("lpips_vgg_seen", "LPIPS, VGG", "{:.4f}"),
)


def variants(chosen: Sequence[str], preset: str) -> tuple[str, ...]:
    """The whole network, the same with another seed, and its variants; all that the preset has where none is chosen."""
    return (WHOLE, OTHER_SEED, *(chosen or variants_of(PRESETS[preset])))


def ablation_tables(results: Results) -> list[Table]:
    """One table for each scene that has results."""
    measured = {scene for scene, _ in results.by}
    return [_table(results, scene) for scene in results.scenes if scene in measured]


def summarise(results: Results) -> list[str]:
    """What the tables of all scenes show together, as sentences: which parts matter, and which bring nothing."""
    groups: dict[str, list[str]] = {}
    for method in results.methods:
        if method not in (WHOLE, OTHER_SEED):
            each = (_effect(results, scene, method) for scene in results.scenes)
            found = {effect for effect in each if effect is not None}
            beyond = found - {WITHIN}
            if found and len(beyond) < 2:
                groups.setdefault(next(iter(beyond), WITHIN), []).append(method)
    sentences = {
        "worse": "Worse than the whole network, and nowhere better",
        "better": "Better than the whole network, and nowhere worse",
        WITHIN: "Not distinguishable from another seed on any scene, so the change has no effect in this time",
    }
    return [f"{sentence}: {', '.join(groups[effect])}." for effect, sentence in sentences.items() if effect in groups]


def write_ablation(results: Results, settings: Settings, out: Path) -> list[Path]:
    """Write the tables and figures of an ablation, complete or not, over older ones.

    Returns:
        The files.
    """
    tables = ablation_tables(results)
    return [
        *write_tables("ablation", "Ablation", tables, summarise(results), results, settings, out),
        write_figures("ablation", results, settings, out),
    ]


def _difference(results: Results, scene: str, method: str) -> float | None:
    """PSNR minus that of the whole network, dB."""
    own, whole = (results.metric(scene, name, "psnr_seen") for name in (method, WHOLE))
    return None if own is None or whole is None or method == WHOLE else own - whole


def _effect(results: Results, scene: str, method: str) -> str | None:
    """Better, worse or within the noise, which is the difference of another seed, and at least `LEAST_DB`."""
    difference, other = (_difference(results, scene, name) for name in (method, OTHER_SEED))
    if difference is None:
        return None
    return WITHIN if abs(difference) <= max(LEAST_DB, abs(other or 0)) else "better" if difference > 0 else "worse"


def _table(results: Results, scene: str) -> Table:
    """A line for each variant; metrics that no variant has are left out."""
    found = {method: results.by[scene, method] for method in results.methods if (scene, method) in results.by}
    metrics = [of for of in _METRICS if any(result.metric(of[0]) is not None for result in found.values())]
    rows, budgets = [], set()
    for method, result in found.items():
        within = method != OTHER_SEED and _effect(results, scene, method) == WITHIN
        difference = shown(_difference(results, scene, method), "{:+.2f}") + (f", {WITHIN}" if within else "")
        values = (shown(result.metric(metric), style) for metric, _, style in metrics)
        rows.append([method, *values, f"{result.evaluation['rays_per_second']:,.0f}", difference])
        settings = result.process.get("settings", {})
        minutes, start = settings.get("minutes"), " from random weights" if settings.get("from_scratch") else ""
        budgets.add((f"{minutes:g} min" if minutes is not None else f"{settings.get('steps')} steps") + start)
    title = f"{scene}, {' or '.join(sorted(budgets))}, pixels that two training photographs or more see"
    return Table(title, ["variant", *(title for _, title, _ in metrics), "rays/s", "difference, dB"], rows)
