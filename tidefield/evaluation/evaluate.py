"""Evaluate a method on the held-out photographs: metrics, a table and pictures.

A method is only a function `render(camera) -> Rendering` here, so every method is evaluated alike.
"""

from __future__ import annotations

import json
import math
import re
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from statistics import fmean
from typing import Any

import torch
from PIL import Image
from rich.console import Console
from rich.table import Table

from tidefield import __version__
from tidefield.config import PROTOCOL
from tidefield.data.holdout import FILE_NAME as HOLDOUT_FILE
from tidefield.data.images import photographs_key
from tidefield.data.scene import Scene, poses_key
from tidefield.data.surface import doubly_seen
from tidefield.errors import RunError
from tidefield.evaluation import EVALUATION_FILE, UNFINISHED_FILE
from tidefield.evaluation.lpips import Lpips, download_lpips_weights, load_lpips, prepare_torchvision, too_large
from tidefield.evaluation.metrics import METRICS, SUFFIXES, Image8, flip_map, score
from tidefield.evaluation.panels import Panel, Scale, colours, depth_panel, side_by_side
from tidefield.files import completed_file, delete_files, delete_partials, read_json, require_writable, write_json
from tidefield.machine import commit, peak_bytes
from tidefield.model.rendering import Render, Rendering, to_8_bit
from tidefield.progress import ProgressBar, make_console

FOLDERS = ("renderings", "pictures")
NAMES = [metric + suffix for suffix in SUFFIXES for metric in METRICS]
_COLUMNS = {"": "all", "_seen": "doubly seen", "_cc": "all, colour fit", "_seen_cc": "doubly seen, colour fit"}


@dataclass(frozen=True)
class Evaluation:
    """Result of an evaluation: the path of its evaluation.json, and what that holds."""

    path: Path
    report: dict[str, Any]

    @property
    def mean(self) -> dict[str, Any]:
        """Return the means over the photographs, by metric."""
        return self.report["mean"]


def evaluate(
    render: Render,
    scene: Scene,
    out: Path,
    *,
    configuration: Mapping[str, Any],
    overwrite: bool = False,
    console: Console | None = None,
    download_lpips: bool = False,
    goes_on: bool = False,
) -> Evaluation:
    """Render every held-out photograph's camera, measure the metrics, and print a table.

    Writes `out/renderings/NAME.png`, `out/pictures/NAME.png` (ground truth | rendering | error | depth) and, last and
    complete, `out/evaluation.json`.

    Args:
        render: the method.
        scene: its test photographs are the truth; its sparse points determine which pixels are doubly seen.
        out: the folder to write to, made if needed.
        configuration: of the method, for the record; must be JSON.
        overwrite: replace an existing evaluation.
        console: where to print; standard output if None.
        download_lpips: download the weights that LPIPS needs if they are missing.
        goes_on: keep what an interrupted evaluation of the same configuration and photographs has measured; only where
            the configuration identifies the method, with its weights.

    Raises:
        RunError: `out` holds an evaluation or cannot be written to, the scene holds no photograph out, or a rendering
            is not finite.
    """
    path, console = out / EVALUATION_FILE, console or make_console()
    require_writable(path, overwrite=overwrite)
    if not scene.test:
        raise RunError(f"{scene.root} holds no photograph out: expected at least one to compare with; add photographs")
    files = picture_names([scene.names[i] for i in scene.test])
    delete_partials(path, *(out / folder / file for folder in FOLDERS for file in files))
    if download_lpips:
        if unusable := prepare_torchvision():
            raise RunError(f"--download-lpips was given, but {unusable}: expected what can use the weights; install it")
        download_lpips_weights()
    # For all photographs or for none: a mean over the smaller ones only would depend on the memory of the machine.
    width, height = max(scene.cameras.size_px[list(scene.test)].tolist(), key=math.prod)
    networks = {
        metric: network if isinstance(network, str) else too_large(metric, width, height) or network
        for metric, network in load_lpips().items()
    }
    made_of = {
        "split": {"train": [scene.names[i] for i in scene.train], "test": [scene.names[i] for i in scene.test]},
        "width": int(scene.cameras.size_px[list(scene.test), 0].max()),
        "version": __version__,
        "commit": commit(),
        "protocol": PROTOCOL,
        "poses": poses_key(scene.names, scene.cameras.T_world_camera, scene.held_out),
        "held_out_of_poses": (scene.root / HOLDOUT_FILE).exists(),
        "lpips_weights": {metric: n.sha256 for metric, n in networks.items() if isinstance(n, Lpips)},
        "configuration": dict(configuration),
    }
    files_key = photographs_key(scene.photographs.files, scene.photographs.background_rgb)
    photographs = _unfinished(out, {**made_of, "photographs": files_key}) if goes_on else {}
    continued = len(photographs)
    with ProgressBar(console, "Evaluating") as bar:
        for index, file in zip(scene.test, files, strict=True):
            if scene.names[index] in photographs and all((out / folder / file).is_file() for folder in FOLDERS):
                continue
            rendering, seconds = _timed(render, scene, index)
            if not photographs:
                delete_evaluation(out, ())  # an older one is not of the pictures that follow
            image, truth = to_8_bit(rendering.colour).cpu(), scene.photographs[index]
            used = scene.photographs.used(index)
            seen = doubly_seen(scene, scene.cameras[index]) & used
            scores = score(image, truth, seen, networks, used)
            photographs[scene.names[index]] = {
                **{name: scores.values[name] for name in NAMES},
                "reasons": scores.reasons,
                "seen_share": float(seen[used].float().mean()) if used.any() else 0.0,
                "seconds": seconds,
            }
            _write_pictures(out, file, image, truth, rendering)
            unfinished = {**made_of, "photographs": files_key, "per_photograph": photographs}
            write_json(out / UNFINISHED_FILE, unfinished)
            bar(len(photographs), len(scene.test))
    photographs = {scene.names[i]: photographs[scene.names[i]] for i in scene.test}
    seconds_in_all = sum(row["seconds"] for row in photographs.values())
    report = {
        "per_photograph": photographs,
        "mean": _mean(list(photographs.values())),
        "rays_per_second": int(scene.cameras.size_px[list(scene.test)].prod(1).sum()) / seconds_in_all,
        "seconds_per_frame": seconds_in_all / len(photographs),
        **_peak_memory(),
        **made_of,
        **({"of_an_interrupted_evaluation": continued} if continued else {}),
    }
    write_json(path, report)
    delete_files(out, [out / UNFINISHED_FILE])
    console.print(_table(scene, report))
    for remark in _remarks(report, out):
        console.print(remark, soft_wrap=True)
    return Evaluation(path, report)


def delete_evaluation(out: Path, names: Sequence[str]) -> None:
    """Delete an evaluation, its pictures, and those that one of these photographs, ended before its end, has left."""
    reports = [out / EVALUATION_FILE, out / UNFINISHED_FILE]
    for file in reports:
        with suppress(RunError):  # what is damaged is deleted, too
            report = read_json(file)
            listed = report.get("per_photograph") if isinstance(report, dict) else None
            names = [*names, *(listed if isinstance(listed, dict) else ())]
    pictures = {re.sub(r"(\.[^./]+)?$", ".png", name, count=1) for name in names}
    pictures |= {f"{name}.png" for name in names}
    found = [(file, file.relative_to(out / folder)) for folder in FOLDERS for file in (out / folder).rglob("*.png")]
    delete_files(out, [*reports, *(file for file, name in found if name.as_posix() in pictures)])


def _unfinished(out: Path, made_of: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What an interrupted evaluation of the same has measured, by photograph; not of sources that had been changed."""
    report = read_json(out / UNFINISHED_FILE)
    if (out / EVALUATION_FILE).exists() or not isinstance(report, dict) or str(made_of["commit"]).endswith("+"):
        return {}
    rows, keys = report.pop("per_photograph", None), {*NAMES, "reasons", "seen_share", "seconds"}
    if report != json.loads(json.dumps(made_of)) or not isinstance(rows, dict):
        return {}
    return {name: row for name, row in rows.items() if isinstance(row, dict) and keys <= row.keys()}


def _timed(render: Render, scene: Scene, index: int) -> tuple[Rendering, float]:
    """Render the view of one photograph's camera; also the seconds, without the way from a process of the method's."""
    camera = scene.cameras[index]
    start = time.perf_counter()
    with torch.no_grad():
        rendering = render(camera)
    if rendering.colour.is_cuda:
        torch.cuda.synchronize(rendering.colour.device)
    seconds = time.perf_counter() - start if rendering.seconds is None else rendering.seconds
    expected, got = (camera.height, camera.width, 3), tuple(rendering.colour.shape)
    assert got == expected, f"a rendering of {got} for a camera of {expected}"
    if not (rendering.colour.isfinite().all() and rendering.depth.isfinite().all()):
        raise RunError(
            f"the rendering of {scene.names[index]} holds NaN or infinity: expected finite colours and depths; the "
            "training has probably diverged: take an earlier checkpoint or train again"
        )
    return rendering, seconds


def _peak_memory() -> dict[str, int | None]:
    """This process's peak memory so far, in main memory and on the GPU that it uses."""
    peak = None
    if sys.platform != "win32":
        import resource

        peak = peak_bytes(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    gpus = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
    return {
        "peak_memory_bytes": peak,
        "peak_cuda_memory_bytes": max(map(torch.cuda.max_memory_allocated, gpus), default=None),
    }


def _mean(photographs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the means over the photographs that have a value; None, and the reason, where none has."""
    values = {name: [row[name] for row in photographs if row[name] is not None] for name in NAMES}
    return {
        **{name: fmean(found) if found else None for name, found in values.items()},
        "reasons": {name: photographs[0]["reasons"][name] for name, found in values.items() if not found},
        "seen_share": fmean(row["seen_share"] for row in photographs),
    }


def picture_names(names: Sequence[str]) -> list[Path]:
    """Return file names for pictures of photographs: NAME.png, or NAME.JPG.png if two differ in their suffix only."""
    stems = [PurePosixPath(name).with_suffix("") for name in names]
    return [Path(f"{stem if stems.count(stem) == 1 else name}.png") for stem, name in zip(stems, names, strict=True)]


def _write_pictures(out: Path, file: Path, image: Image8, truth: Image8, rendering: Rendering) -> None:
    error = Scale("magma", 0.0, 1.0)
    panels = [
        Panel("ground truth", truth),
        Panel("rendering", image),
        Panel("error (FLIP)", colours(flip_map(image, truth), error), error),
        depth_panel("depth", rendering.depth),
    ]
    for folder, picture in zip(FOLDERS, (Image.fromarray(image.numpy()), side_by_side(panels)), strict=True):
        path = out / folder / file
        with completed_file(path, overwrite=True) as partial:
            picture.save(partial)


def _table(scene: Scene, report: Mapping[str, Any]) -> Table:
    """Return the table of means: a row per metric, a column per set of pixels."""
    table = Table(title=f"{scene.root.name}, {len(scene.test)} held-out photographs, {report['width']} px")
    table.add_column("mean")
    for column in _COLUMNS.values():
        table.add_column(column, justify="right")
    for name, metric in METRICS.items():
        values = [report["mean"][name + suffix] for suffix in _COLUMNS]
        table.add_row(metric.title, *("-" if value is None else metric.style.format(value) for value in values))
    return table


def _remarks(report: Mapping[str, Any], out: Path) -> list[str]:
    """Return the lines below the table: why values are missing, speed, and the folder of the pictures."""
    reasons = report["mean"]["reasons"]
    missing: dict[str, list[str]] = {}
    for name, metric in METRICS.items():
        lacking: dict[str, list[str]] = {}
        for suffix, column in _COLUMNS.items():
            if name + suffix in reasons:
                lacking.setdefault(reasons[name + suffix], []).append(column)
        for reason, columns in lacking.items():
            of_some = "" if len(columns) == len(_COLUMNS) else f" ({'; '.join(columns)})"
            missing.setdefault(reason, []).append(metric.title + of_some)
    return [
        *(f"No {'; '.join(titles)}: {reason}" for reason, titles in missing.items()),
        f"Doubly seen: {report['mean']['seen_share']:.0%} of the pixels.",
        f"Speed: {report['seconds_per_frame']:.2f} s per frame, {report['rays_per_second']:,.0f} rays/s.",
        f"Pictures: {out / 'pictures'}",
    ]
