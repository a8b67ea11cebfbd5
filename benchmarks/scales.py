"""Views at several sizes of what was trained, or opened, at one: read at a point, with several rays, and by cones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from tyro.conf import Positional

from benchmarks.records import MEASURED, NETWORK, HiddenRunner, network_of, require_same, say, stamp
from benchmarks.table import circumstances
from tidefield.compare.run import named, run_measured, tidefield
from tidefield.compare.tables import Table
from tidefield.data.load import load_scene
from tidefield.data.pictures import decode
from tidefield.device import choose_device
from tidefield.evaluation.metrics import Image8
from tidefield.evaluation.panels import Panel, side_by_side
from tidefield.files import completed_file, read_json, write_json, write_text
from tidefield.train.checkpoint import RUN_FILE, read_run

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
SHOWN = {"points": "photographs read at one width", "cones": "photographs read by cones"}
"""What a picture shows beside the photograph, with its labels."""


def scales(
    sources: Positional[tuple[Path, ...]],
    runs: Path = MEASURED,
    widths: tuple[int, ...] = (100, 200, 400, 800, 1600),
    width: int = 400,
    device: str = "auto",
    out: Path = Path("docs/scales.md"),
    pictures: Path | None = None,
    run: HiddenRunner = run_measured,
) -> None:
    """Evaluate runs, or scenes with the trained weights, in every way; what was measured is kept. Writes the page.

    Args:
        sources: Runs, or scenes for the trained weights, such as those of `python -m benchmarks flight --scene`.
        runs: Store the figures in this folder's scales.json, after each; a repeated command continues.
        widths: Of the pictures in pixels.
        width: That scenes are opened at; a run has its own.
        device: auto, cpu, cuda, cuda:N or mps.
        out: The Markdown file to write; replaced if it is there.
        pictures: Folder for a detail of each source's first held-out photograph at the largest width, next to
            renderings by points and by cones; the page shows those that lie next to it.
        run: Runs a command.

    Raises:
        SceneError: two sources have one name.
        RunError: figures that are kept are of other weights, or were measured at another width or on another device.
    """
    record, device = read_json(runs / SCALES_FILE) or {}, str(choose_device(device))
    for name, source in named(sources).items():
        is_run = (source / RUN_FILE).exists()
        asked = {NETWORK: network_of(source), "opened_px": None if is_run else width, "device": device}
        measured = record.setdefault(name, {"figures": {}, **asked})
        require_same(runs / SCALES_FILE, name, measured, asked)
        shown: dict[str, Image8] = {}
        for picture in widths:
            for way, options in WAYS.items():
                place = measured["figures"].setdefault(str(picture), {})
                detail = pictures is not None and picture == max(widths) and way in SHOWN
                if way in place and not detail:
                    continue
                say(f"{name}, {picture} px, {way}")
                with TemporaryDirectory() as folder:
                    made = Path(folder) / "out"
                    words = [] if is_run else ["--zero-shot", "--opened-width", width]
                    words += ["--width", picture, *options, "--device", device]
                    run(tidefield("evaluate", source, made, *words), {})
                    found = read_json(made / "evaluation.json")
                    if detail:
                        file = min((made / "renderings").rglob("*.png"))
                        shown[SHOWN[way]] = torch.from_numpy(decode(file).copy())
                trained = found["configuration"].get("trained")
                measured["opened"] = (
                    f"Opened at {width} px, with trained weights as they are."
                    if trained is None
                    else f"Trained at {found['configuration']['trained_width']} px for {trained['seconds'] / 60:.1f} "
                    f"minutes, {trained['steps']:,} steps."
                )
                place[way] = {metric: found["mean"][metric] for metric in METRICS}
                place[way] |= {"seconds": found["seconds_per_frame"], "protocol": found["protocol"]}
                figures = [one for ways in measured["figures"].values() for one in ways.values()]
                stamp(measured, place[way], figures, "python -m benchmarks scales RUN|SCENE...")
                write_json(runs / SCALES_FILE, record)
        if pictures is not None:
            _write_detail(source, shown, pictures / f"scales-{name}.png")
    write_page(runs, out)
    say(out)


def _write_detail(source: Path, renderings: Mapping[str, Image8], picture: Path) -> None:
    """Write the middle of the first held-out photograph beside how it is rendered in each way."""
    scene = load_scene(read_run(source).scene if (source / RUN_FILE).exists() else source)
    photograph = scene.photographs[scene.test[0]]
    panels = []
    for title, image in {"held out": photograph, **renderings}.items():
        rows, columns, _ = image.shape
        panels.append(Panel(title, image[3 * rows // 8 : 5 * rows // 8, 3 * columns // 8 : 5 * columns // 8]))
    with completed_file(picture, overwrite=True) as partial:
        side_by_side(panels).save(partial)


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
    for name, measured in record.items():
        columns = ["width, px", "way", "PSNR", "PSNR, colour fit", "SSIM", "FLIP", "s per frame"]
        rows = [
            (
                width if way == next(iter(ways)) else "",
                way,
                *(f"{cell[metric]:.2f}" for metric in METRICS[:2]),
                *(f"{cell[metric]:.4f}" for metric in METRICS[2:]),
                f"{cell['seconds']:.1f}",
            )
            for width, ways in measured["figures"].items()
            for way, cell in ways.items()
        ]
        parts += [f"## {name}", measured["opened"], Table(name, columns, rows).markdown()]
        picture = f"scales-{name}.png"
        if (out.parent / picture).is_file():
            about = "The middle of a held-out photograph, and of how it is rendered"
            parts.append(f"![{about}]({picture})")
    parts += ["## How this was measured", "\n".join(f"- {line}" for line in circumstances(list(record.items())))]
    write_text(out, "\n\n".join(parts) + "\n")
