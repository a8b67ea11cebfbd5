"""The card that lies beside shipped weights: what they are, from the file itself and from what was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tidefield.train.weights import about, sha256

from benchmarks.bars import SCENES, UNSEEN
from tidefield.compare.results import Results, read_figures
from tidefield.compare.run import PAPER_ZERO_SHOT, UNTRAINED, ZERO_SHOT
from tidefield.compare.table import Table, shown
from tidefield.compare.tables import METRICS, lpips_weights
from tidefield.errors import RunError
from tidefield.files import completed_file
from tidefield.train.stream import (
    POINTLESS_SHARE,
    RECOLOURED_SHARE,
    SHIFT_PX,
    SHIFTED_SHARE,
    SPARSE_POINTS,
    SPARSE_SHARE,
    UNEVEN,
    UNEVEN_SHARE,
)

OWN = {"swift": ZERO_SHOT, "paper": PAPER_ZERO_SHOT}
"""By preset, what its weights are called in a comparison."""
PEERS = ("nerfacto", *UNTRAINED)
BY_DIRECTION = (
    "Neighbours are, as printed, the photographs that look in the most similar directions, wherever they were taken. "
    "Of a survey that looks straight down they may not show the place at all, and the view then has one colour: on "
    "surveys, use `swift`, which chooses them by what they show."
)
"""Told of presets that do so."""
LICENCES = {
    "brighton_beach": "BSD-2-Clause, (c) 2017 Piero Toffanin",
    "turin_lot": "MIT, from the repository vinstray/i-sfm",
}
"""Of the photographs of real scenes that may be learned from."""


def write_card(weights: Path, comparison: Sequence[Path]) -> Path:
    """Write PRESET.md beside the weights.

    Args:
        weights: of `tidefield pretrain`.
        comparison: files of `tidefield compare` with the method zero-shot or paper-zero-shot.

    Returns:
        The card.

    Raises:
        RunError: the comparison has no such results, or a scene was learned from whose licence is not known.
    """
    own = OWN[about(weights)["config"]["preset"]]
    results = read_figures(comparison, SCENES, (own, *PEERS))
    if not any(method == own for _, method in results.by):
        named = ", ".join(map(str, comparison))
        raise RunError(f"{named} hold no {own} results: expected some; run `tidefield compare` with them")
    out = weights.with_suffix(".md")
    with completed_file(out, overwrite=True) as partial:
        partial.write_text(card(weights, results), encoding="utf-8")
    return out


def card(weights: Path, results: Results) -> str:
    """The whole card; the first of the results' methods is what the weights are called there."""
    told = about(weights)
    unknown = [name for name in told["real"] if name not in LICENCES]
    if unknown:
        raise RunError(f"{weights} learned from {', '.join(unknown)}: expected scenes whose licences are known")
    real = "".join(f"\n- {name}: the training photographs ({LICENCES[name]})" for name in told["real"])
    machine, preset = told["machine"], told["config"]["preset"]
    named = f" --real {' '.join(told['real'])}" if told["real"] else ""
    count = told["processes"]
    launch = "tidefield" if count == 1 else f"torchrun --nproc-per-node {count} -m tidefield.cli"
    parts = [
        f"# Weights of the preset {preset}",
        f"`{weights.name}`, {weights.stat().st_size / 1e6:.2f} MB, half precision, SHA-256 `{sha256(weights)}`. "
        "`python -m benchmarks card` wrote this card from the file and from what `tidefield compare` measured.",
        "## What for",
        "Views of scenes that nothing was trained on (`--zero-shot`), and a start for `tidefield train`. For drone "
        "photographs of tidal flats that overlap well and have sparse points. Where few photographs see a place, where "
        "things move, and far from where photographs were taken, views are guesses: do not measure in them.",
        *([BY_DIRECTION] if told["config"]["train"]["neighbours"] == "direction" else []),
        "## What they were trained on",
        "- procedural tidal flats of five categories, of random altitude, overlap, lens, sun, wetness, exposure, with "
        f"moving water and wrong poses{real}",
        f"{SPARSE_SHARE:.0%} of the scenes came with {SPARSE_POINTS[0]:.0%} to {SPARSE_POINTS[1]:.0%} of their sparse "
        f"points and {POINTLESS_SHARE:.0%} without any; of {SHIFTED_SHARE:.0%} the photographs were off by "
        f"{SHIFT_PX[0]} to {SHIFT_PX[1]} px, of {UNEVEN_SHARE:.0%} the exposures by {UNEVEN[0]:.0%} to "
        f"{UNEVEN[1]:.0%}; {RECOLOURED_SHARE:.0%} had the channels of their colours in a random order, and all were "
        "turned at random.",
        f"{told['steps']:,} steps in {told['seconds'] / 3600:.1f} hours on {machine['processor']}, {machine['cores']} "
        f"cores, {told['date']}, Tidefield {told['version']}:",
        f"    {launch} pretrain OUT{named} --preset {preset} --steps {told['steps']} --seed {told['seed']}",
        "PSNR in dB on scenes that nothing is learned from (of the real ones, their held-out photographs), two small "
        "views of each:",
        _curve(told["validation"]).markdown(),
        "## What they achieve",
        "Zero-shot, means over the held-out photographs; `docs/results.md` says how the peers were trained. Nothing of "
        f"{' and '.join(UNSEEN)} was ever learned from.",
        *(_quality(results, metric, title, style).markdown() for metric, title, style, _ in METRICS[:4]),
        *lpips_weights(results),
        "## Licence",
        "Apache-2.0, as Tidefield itself.",
    ]
    return "\n\n".join(parts) + "\n"


def _curve(points: list[Mapping[str, Any]]) -> Table:
    kinds = list(points[0]["psnr"]) if points else []
    rows = [(f"{point['step']:,}", *(f"{point['psnr'][kind]:.2f}" for kind in kinds)) for point in points]
    return Table("", ["step", *kinds], rows)


def _quality(results: Results, metric: str, title: str, style: str) -> Table:
    rows = [
        (scene, *(shown(results.metric(scene, method, metric), style) for method in results.methods))
        for scene in results.scenes
        if (scene, results.methods[0]) in results.by
    ]
    return Table(title, ["scene", *results.methods], rows)
