"""What the paper's parts bring to weights that are trained across scenes: zero-shot views with each of several files.

A weights file says which parts its network has, so files of `tidefield pretrain` that were trained alike, with other
variants of the preset, are compared as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tyro.conf import Positional

from benchmarks.records import MEASURED, say, show, store
from tidefield.compare.run import named
from tidefield.compare.tables import Table
from tidefield.config import Config, config_from_json
from tidefield.data.load import load_scene
from tidefield.device import choose_device
from tidefield.errors import RunError
from tidefield.evaluation.evaluate import evaluate
from tidefield.files import read_json
from tidefield.methods import zero_shot
from tidefield.progress import make_console
from tidefield.train.checkpoint import read_weights_file, weights_sha256

PARTS_FILE = "parts.json"
METRICS = {"psnr": "{:.2f}", "ssim": "{:.4f}", "flip": "{:.4f}"}


def parts(
    weights: Positional[tuple[Path, ...]],
    scenes: tuple[Path, ...] = (),
    runs: Path = MEASURED,
    width: int = 400,
    device: str = "auto",
) -> dict[str, Any]:
    """Compare weights files on the held-out photographs of scenes; what was measured is kept.

    Args:
        weights: Files of `tidefield pretrain`, trained alike but for their parts.
        scenes: Folders.
        runs: Store the figures in this folder's parts.json; what it holds is not measured again.
        width: Of the pictures in pixels.
        device: auto, cpu, cuda, cuda:N or mps.

    Raises:
        SceneError: two scenes have one name.
        RunError: a file is damaged, or holds no weights of a preset.
    """
    folders, where = named(scenes), choose_device(device)
    record, quiet = read_json(runs / PARTS_FILE) or {"files": {}, "figures": {}}, make_console(quiet=True)
    for file in weights:
        header, _ = read_weights_file(file)
        config = config_from_json(header["config"], f"{file}: config")
        if not isinstance(config, Config):
            raise RunError(f"{file} is of {config.method}: expected weights of a preset; name others")
        own = weights_sha256(file)
        record["files"][own] = {
            **{key: header[key] for key in ("steps", "seed", "real", "validation")},
            "preset": config.preset,
            "without": list(config.network.without),
        }
        for name, folder in folders.items():
            place = record["figures"].setdefault(f"{name}, {width} px", {})
            if own in place:
                continue
            say(f"{name}, {width} px: {file}")
            scene = load_scene(folder, width=width)
            render, _ = zero_shot(config, file, scene, where)
            with TemporaryDirectory() as temporary:
                mean = evaluate(render, scene, Path(temporary) / "out", configuration={}, console=quiet).mean
            place[own] = {metric: mean[f"{metric}_seen_cc"] for metric in METRICS}
            figures = [one for of in record["figures"].values() for one in of.values()]
            command = "python -m benchmarks parts WEIGHTS... --scenes SCENE..."
            store(runs / PARTS_FILE, record, place[own], figures, command)
    show(tables(record))
    return record


def tables(record: Mapping[str, Any]) -> list[Table]:
    """Pictures of every scene with each of the files, and what the files themselves say of their validation."""
    columns = {own: _label(about) for own, about in record["files"].items()}
    rows = [
        (scene, *(style.format(found[own][metric]) for metric, style in METRICS.items() for own in columns))
        for scene, found in record["figures"].items()
        if all(own in found for own in columns)
    ]
    names = [f"{metric.upper()}: {label}" for metric in METRICS for label in columns.values()]
    last = [(label, record["files"][own]["validation"][-1]["psnr"]) for own, label in columns.items()]
    scenes = list(last[0][1])
    validated = [[label, *(f"{psnr[scene]:.2f}" for scene in scenes)] for label, psnr in last]
    return [
        Table("Held-out photographs, doubly seen pixels, after the colour fit", ["scene", *names], rows),
        Table("PSNR in dB at the end of the training, of the scenes that it validates on", ["", *scenes], validated),
    ]


def _label(about: Mapping[str, Any]) -> str:
    """How a table names a weights file: by the parts that its network lacks."""
    return f"without {' and '.join(about['without'])}" if about["without"] else "with every part"
