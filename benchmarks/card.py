"""The card of shipped weights, from the file itself and from stored measurements."""

from __future__ import annotations

from pathlib import Path

from benchmarks.records import STRICT_400, say
from benchmarks.table import SCENES, age, marks_of, notes, without_empty_columns
from tidefield.compare.results import Results, read_figures
from tidefield.compare.tables import Table, lpips_weights, marked, shown
from tidefield.errors import RunError
from tidefield.evaluation.metrics import METRICS
from tidefield.files import write_text
from tidefield.methods import METHODS, names
from tidefield.train.checkpoint import read_weights_file, weights_sha256
from tidefield.train.stream import (
    EXPOSURE_ERROR,
    EXPOSURE_ERROR_SHARE,
    POINTLESS_SHARE,
    RECOLOURED_SHARE,
    SHIFT_PX,
    SHIFTED_SHARE,
    SPARSE_POINTS,
    SPARSE_SHARE,
)

OTHERS = ("nerfacto", *names("untrained"))
"""Methods next to which zero-shot results stand."""
BY_DIRECTION = (
    "Neighbours are, as printed, the photographs that look in the most similar directions, wherever they were taken. "
    "Of a survey that looks straight down they may not show the place at all, and the view then has one colour: on "
    "surveys, use `swift`, which chooses them by what they show."
)
"""For presets that do so."""
LICENCES = {
    "brighton_beach": "BSD-2-Clause, (c) 2017 Piero Toffanin",
    "turin_lot": "MIT, from the repository vinstray/i-sfm",
}
"""Of the photographs of real scenes that may be learned from."""


def card(weights: Path, comparison: tuple[Path, ...] = STRICT_400) -> Path:
    """Write PRESET.md next to the weights; returns it.

    Args:
        weights: Of `tidefield pretrain`.
        comparison: Files of `tidefield compare` with the method zero-shot, or paper-zero-shot for those of paper.

    Raises:
        RunError: the comparison has no such results, or a scene was learned from whose licence is not known.
    """
    preset = read_weights_file(weights)[0]["config"]["preset"]
    own = next(name for name in names("zero-shot") if METHODS[name].preset == preset)
    results = without_empty_columns(read_figures(comparison, SCENES, (own, *OTHERS)))
    if not any(method == own for _, method in results.by):
        files = ", ".join(map(str, comparison))
        raise RunError(f"{files} hold no {own} results: expected some; run `tidefield compare` with them")
    out = weights.with_suffix(".md")
    write_text(out, _page(weights, results))
    say(out)
    return out


def _page(weights: Path, results: Results) -> str:
    """The whole card; the first of the results' methods is what the weights are called there."""
    recorded, _ = read_weights_file(weights)
    unknown = [name for name in recorded["real"] if name not in LICENCES]
    if unknown:
        raise RunError(f"{weights} learned from {', '.join(unknown)}: expected scenes whose licences are known")
    real = "".join(f"\n- {name}: the training photographs ({LICENCES[name]})" for name in recorded["real"])
    machine, preset = recorded["machine"], recorded["config"]["preset"]
    named = f" --real {' '.join(recorded['real'])}" if recorded["real"] else ""
    count = recorded["processes"]
    launch = "tidefield" if count == 1 else f"torchrun --nproc-per-node {count} -m tidefield.cli"
    points = recorded["validation"]
    kinds = list(points[0]["psnr"]) if points else []
    curve = [(f"{point['step']:,}", *(f"{point['psnr'][kind]:.2f}" for kind in kinds)) for point in points]
    marks = marks_of(results, recorded["real"])
    parts = [
        f"# Weights of the preset {preset}",
        f"`{weights.name}`, {weights.stat().st_size / 1e6:.2f} MB, half precision, "
        f"SHA-256 `{weights_sha256(weights)}`. "
        "`python -m benchmarks card` wrote this card from the file and from what `tidefield compare` measured.",
        "## What for",
        "Views of scenes that nothing was trained on (`--zero-shot`), and a start for `tidefield train`. For drone "
        "photographs of tidal flats that overlap well and have sparse points. Where few photographs see a place, where "
        "things move, and far from where photographs were taken, views are guesses: do not measure in them.",
        *([BY_DIRECTION] if recorded["config"]["train"]["neighbours"] == "direction" else []),
        "## What they were trained on",
        "- procedural tidal flats of five categories, of random altitude, overlap, lens, sun, wetness, exposure, with "
        f"moving water and wrong poses{real}",
        f"{SPARSE_SHARE:.0%} of the scenes came with {SPARSE_POINTS[0]:.0%} to {SPARSE_POINTS[1]:.0%} of their sparse "
        f"points and {POINTLESS_SHARE:.0%} without any; of {SHIFTED_SHARE:.0%} the photographs were off by "
        f"{SHIFT_PX[0]} to {SHIFT_PX[1]} px, of {EXPOSURE_ERROR_SHARE:.0%} the exposures by {EXPOSURE_ERROR[0]:.0%} to "
        f"{EXPOSURE_ERROR[1]:.0%}; {RECOLOURED_SHARE:.0%} had the channels of their colours in a random order, and all "
        "were rotated at random.",
        f"{recorded['steps']:,} steps in {recorded['seconds'] / 3600:.1f} hours on {machine['processor']}, "
        f"{machine['cores']} cores, {recorded['date']}, Tidefield {recorded['version']}:",
        f"    {launch} pretrain OUT{named} --preset {preset} --steps {recorded['steps']} --seed {recorded['seed']}",
        "PSNR in dB on scenes that nothing is learned from (of the real ones, their held-out photographs), two small "
        "views of each:",
        Table("", ["step", *kinds], curve).markdown(),
        "## What they achieve",
        "Zero-shot, means over all pixels of the held-out photographs, without a fit of the colours; "
        "`docs/results.md` says how the others were trained.",
        *age([*results.by.values()]),
        *notes(results, marks),
        *(marked(table, marks).markdown() for table in _quality(results)),
        *lpips_weights(results),
        "## Licence",
        "Apache-2.0, as Tidefield itself.",
    ]
    return "\n\n".join(parts) + "\n"


def _quality(results: Results) -> list[Table]:
    """A table for each measured metric, of the scenes on which these weights were measured."""
    scenes = [scene for scene in results.scenes if (scene, results.methods[0]) in results.by]
    tables = []
    for name, metric in METRICS.items():
        rows = [[scene, *(results.metric(scene, method, name) for method in results.methods)] for scene in scenes]
        if any(value is not None for row in rows for value in row[1:]):
            cells = [[str(row[0]), *(shown(value, metric.style) for value in row[1:])] for row in rows]
            tables.append(Table(metric.title, ["scene", *results.methods], cells))
    return tables
