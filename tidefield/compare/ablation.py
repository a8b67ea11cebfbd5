"""The ablation: what each part of the network brings, by leaving it out, and how far another seed gets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tidefield.compare.results import Results
from tidefield.compare.run import OTHER_SEED, WHOLE
from tidefield.compare.table import Table, shown
from tidefield.variants import VARIANTS

LEAST_DB = 0.05
"""What is less says nothing, even if two seeds happened to agree better."""
WITHIN = "within the noise"
_METRICS = (("psnr_seen", "{:.2f}"), ("psnr_seen_cc", "{:.2f}"), ("ssim_seen", "{:.4f}"), ("lpips_vgg_seen", "{:.4f}"))


def variants(chosen: Sequence[str]) -> tuple[str, ...]:
    """The network as it is, once more with another seed, and the variants of it; all of them where none is chosen."""
    return (WHOLE, OTHER_SEED, *(chosen or VARIANTS))


def ablation_tables(results: Results) -> list[Table]:
    """One for each scene of which something is there."""
    there = {scene for scene, _ in results.by}
    return [_table(results, scene) for scene in results.scenes if scene in there]


def verdicts(results: Results) -> list[str]:
    """What the tables say of all scenes together, as sentences: which parts matter, and which bring nothing."""
    told: dict[str, list[str]] = {}
    for method in results.methods:
        if method not in (WHOLE, OTHER_SEED):
            each = (_verdict(results, scene, method) for scene in results.scenes)
            found = {verdict for verdict in each if verdict is not None}
            beyond = found - {WITHIN}
            if found and len(beyond) < 2:
                told.setdefault(next(iter(beyond), WITHIN), []).append(method)
    sentences = {
        "worse": "Worse than the whole, and nowhere better",
        "better": "Better than the whole, and nowhere worse",
        WITHIN: "Nowhere to be told from another seed, so that what was changed brings nothing in this time",
    }
    return [f"{said}: {', '.join(told[verdict])}." for verdict, said in sentences.items() if verdict in told]


def _difference(results: Results, scene: str, method: str) -> float | None:
    """PSNR beside that of the network as it is, dB."""
    own, whole = (results.metric(scene, name, "psnr_seen") for name in (method, WHOLE))
    return None if own is None or whole is None or method == WHOLE else own - whole


def _verdict(results: Results, scene: str, method: str) -> str | None:
    """Better, worse or within the noise, which is what another seed makes, and at least `LEAST_DB`."""
    difference, other = (_difference(results, scene, name) for name in (method, OTHER_SEED))
    if difference is None:
        return None
    return WITHIN if abs(difference) <= max(LEAST_DB, abs(other or 0)) else "better" if difference > 0 else "worse"


def _table(results: Results, scene: str) -> Table:
    """A line for each variant, and what it says beside the network as it is."""
    columns = ["variant", "PSNR, dB", "PSNR after the colour fit, dB", "SSIM", "LPIPS, VGG", "rays/s", "difference, dB"]
    rows = []
    for method in results.methods:
        result = results.by.get((scene, method))
        if result is not None:
            values = [result.metric(metric) for metric, _ in _METRICS]
            rows.append(
                [
                    method,
                    *(shown(value, style) for value, (_, style) in zip(values, _METRICS, strict=True)),
                    f"{result.evaluation['rays_per_second']:,.0f}",
                    _shown_difference(results, scene, method),
                ]
            )
    budgets = {_budget(result.process.get("settings", {})) for (at, _), result in results.by.items() if at == scene}
    title = f"{scene}, {' or '.join(sorted(budgets))}, pixels that two training photographs or more see"
    return Table(title, columns, rows)


def _budget(settings: Mapping[str, Any]) -> str:
    """How a variant was trained."""
    steps, minutes = settings.get("steps"), settings.get("minutes")
    begun = " from random weights" if settings.get("from_scratch") else ""
    return (f"{minutes:g} min" if minutes is not None else f"{steps} steps") + begun


def _shown_difference(results: Results, scene: str, method: str) -> str:
    within = _verdict(results, scene, method) == WITHIN and method != OTHER_SEED
    return shown(_difference(results, scene, method), "{:+.2f}") + (f", {WITHIN}" if within else "")
