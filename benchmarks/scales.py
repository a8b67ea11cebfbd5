"""Views at several sizes of what was trained, or opened, at one: read at a point, with several rays, and by cones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.table import circumstances
from tidefield.compare.tables import Table
from tidefield.errors import RunError
from tidefield.files import read_json, write_json, write_text
from tidefield.machine import describe

SCALES_FILE = "scales.json"
WAYS = {
    "points": ("--no-cones", "--rays-per-pixel", "1"),
    "points, 2 x 2 rays": ("--no-cones", "--rays-per-pixel", "4"),
    "cones": ("--rays-per-pixel", "1"),
    "cones, 2 x 2 rays": ("--rays-per-pixel", "4"),
    "as usual": (),
}
"""Options of `tidefield evaluate`, by the name of what they do."""
METRICS = ("psnr_seen", "psnr_seen_cc", "ssim_seen", "flip_seen")
Run = Callable[[list[str]], None]


def measure_scales(
    sources: Sequence[Path], runs: Path, widths: Iterable[int], width: int, device: str, run: Run, say: Callable
) -> dict[str, Any]:
    """Evaluate runs, or scenes with the trained weights, at several widths in every way; what was measured is kept.

    Args:
        sources: folders of runs, or of scenes.
        runs: folder of scales.json.
        widths: of the pictures.
        width: that scenes are opened at; runs have their own.
        run: runs a command of Tidefield's, given without "tidefield".
        say: reports progress.

    Raises:
        RunError: two sources have one name.
    """
    named = {source.resolve().name: source for source in sources}
    if len(named) < len(sources):
        raise RunError(f"two of {', '.join(map(str, sources))} have one name: expected different ones; rename a folder")
    record = read_json(runs / SCALES_FILE) or {"figures": {}}
    for name, source in named.items():
        for picture in widths:
            for way, options in WAYS.items():
                place = record["figures"].setdefault(name, {}).setdefault(str(picture), {})
                if way in place:
                    continue
                say(f"{name}, {picture} px, {way}")
                with TemporaryDirectory() as folder:
                    out = Path(folder) / "out"
                    of = [] if (source / "run.json").exists() else ["--zero-shot", "--opened-width", str(width)]
                    run(["evaluate", str(source), str(out), *of, "--width", str(picture), *options, "--device", device])
                    found = read_json(out / "evaluation.json")
                trained = found["configuration"].get("trained")
                record.setdefault("opened", {})[name] = (
                    f"Opened at {width} px, with trained weights as they are."
                    if trained is None
                    else f"Trained at {found['configuration']['trained_width']} px for {trained['seconds'] / 60:.1f} "
                    f"minutes, {trained['steps']:,} steps."
                )
                place[way] = {metric: found["mean"][metric] for metric in METRICS}
                place[way] |= {"seconds": found["seconds_per_frame"], "protocol": found["protocol"]}
                command = "python -m benchmarks scales RUN|SCENE..."
                write_json(runs / SCALES_FILE, {**record, **describe(), "command": command})
    return record["figures"]


def write_page(runs: Path, out: Path) -> None:
    """Write the page as Markdown from what was stored."""
    record = read_json(runs / SCALES_FILE)
    parts = [
        "# Scales",
        "Held-out views at several widths, by networks that were trained, or scenes that were opened, at one. "
        "*Points*: photographs are read at that one width. *Cones*: they are read where their pixels are about as "
        "large as what a pixel of the picture shows (method, section 15). *As usual*: cones, and 2 x 2 rays where "
        "pixels are much larger than those of the photographs. PSNR, SSIM and FLIP of doubly seen pixels; the second "
        "PSNR after the colour fit.",
    ]
    for name, of_widths in record["figures"].items():
        columns = ["width, px", "way", "PSNR", "PSNR, colour fit", "SSIM", "FLIP", "s per frame"]
        rows = [
            (
                width if way == next(iter(ways)) else "",
                way,
                *(f"{cell[metric]:.2f}" for metric in METRICS[:2]),
                *(f"{cell[metric]:.4f}" for metric in METRICS[2:]),
                f"{cell['seconds']:.1f}",
            )
            for width, ways in of_widths.items()
            for way, cell in ways.items()
        ]
        parts += [f"## {name}", record["opened"][name], Table(name, columns, rows).markdown()]
    parts += ["## How this was measured", "\n".join(f"- {line}" for line in circumstances([("scales", record)]))]
    write_text(out, "\n\n".join(parts) + "\n")
