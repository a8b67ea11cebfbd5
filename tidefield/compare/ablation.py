"""The ablation: what each part of the network brings, by leaving it out, and how far another seed gets."""

from __future__ import annotations

from collections.abc import Sequence

from tidefield.compare.results import Results
from tidefield.compare.run import OTHER_SEED, WHOLE
from tidefield.compare.table import NOTHING, Table, shown
from tidefield.variants import VARIANTS

LEAST_DB = 0.05
"""What is less says nothing, even if two seeds happened to agree better."""
_METRICS = (("psnr_seen", "{:.2f}"), ("psnr_seen_cc", "{:.2f}"), ("ssim_seen", "{:.4f}"), ("lpips_vgg_seen", "{:.4f}"))


def variants(chosen: Sequence[str]) -> tuple[str, ...]:
    """The network as it is, once more with another seed, and the variants of it; all of them where none is chosen."""
    return (WHOLE, OTHER_SEED, *(chosen or VARIANTS))


def ablation_tables(results: Results) -> list[Table]:
    """One for each scene."""
    return [_table(results, scene) for scene in results.scenes]


def _table(results: Results, scene: str) -> Table:
    """A line for each variant, and what it says beside the network as it is.

    "Within the noise" is a variant whose PSNR is no further away than that of another seed, or less than `LEAST_DB`.
    """
    whole, other = (results.metric(scene, method, "psnr_seen") for method in (WHOLE, OTHER_SEED))
    noise = LEAST_DB if whole is None or other is None else max(LEAST_DB, abs(other - whole))
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
                    _verdict(method, values[0], whole, noise),
                ]
            )
    return Table(
        f"What each part brings on {scene}, over pixels that two training photographs or more see", columns, rows
    )


def _verdict(method: str, psnr: float | None, whole: float | None, noise: float) -> str:
    if psnr is None or whole is None or method == WHOLE:
        return NOTHING
    difference = psnr - whole
    within = abs(difference) <= noise and method != OTHER_SEED
    return f"{difference:+.2f}{', within the noise' if within else ''}"
