"""`tidefield prepare` on surveys as they came from the camera, compared with exhaustive structure from motion.

Exhaustive means COLMAP's defaults without knowledge of the survey: every photograph matched with every other, the focal
length free. RUNS/SURVEY/scene is the prepared scene, RUNS/SURVEY/exhaustive/model the other model; prepare.json and
exhaustive/exhaustive.json hold time and memory. What is done is not repeated. Results of training on prepared and on
ready-made scenes of the same surveys are read from comparisons.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.records import say
from tidefield.compare.results import Result, read_results
from tidefield.compare.run import WHOLE, Runner, run_measured, tidefield
from tidefield.compare.tables import NOTHING, Table, shown
from tidefield.errors import SurveyError
from tidefield.files import read_json, write_json, write_text
from tidefield.machine import describe

UNCORRECTED = "_uneven"
"""Ends the name of a scene that was prepared with --colour off."""
MEASURED = (
    ("psnr_seen_cc", "PSNR after the colour fit, dB", "{:.2f}"),
    ("psnr_seen", "PSNR, dB", "{:.2f}"),
    ("ssim_seen_cc", "SSIM after the colour fit", "{:.4f}"),
)


SURVEYS = ("brighton_beach", "turin_lot", "swindale")


def surveys(
    photographs: Path,
    runs: Path,
    names: tuple[str, ...] = SURVEYS,
    prepared: Path | None = None,
    ready: Path | None = None,
    out: Path = Path("docs/surveys.md"),
) -> None:
    """Measure and write the page.

    Args:
        photographs: Folder with the surveys' folders.
        runs: Folder for the results, as RUNS/SURVEY.
        names: Of the surveys.
        prepared: Folder of a `tidefield compare` on the prepared scenes, by the surveys' names, for the page.
        ready: Folder of a `tidefield compare` on ready-made scenes of these names, for the page.
        out: The Markdown file to write; replaced if it is there.
    """
    measure_surveys(photographs, runs, names)
    write_page(runs, names, prepared, ready, out)
    say(out)


def measure_surveys(photographs: Path, runs: Path, names: Sequence[str], run: Runner = run_measured) -> None:
    """Prepare every survey, and reconstruct it exhaustively.

    Raises:
        SurveyError: a survey is missing.
        RunError: a command failed.
    """
    for survey in names:
        source, folder = photographs_of(survey, photographs), runs / survey
        if read_json(folder / "prepare.json") is None:
            say(f"{survey}: prepare")
            usage = run(tidefield("prepare", source, folder / "scene"), {})
            write_json(folder / "prepare.json", {**asdict(usage), **describe()})
        if read_json(folder / "exhaustive" / "exhaustive.json") is None:
            say(f"{survey}: exhaustive")
            run([sys.executable, "-m", "benchmarks.surveys", str(source), str(folder / "exhaustive")], {})


def photographs_of(survey: str, photographs: Path) -> Path:
    """The folder of a survey among those of several.

    Raises:
        SurveyError: it is missing.
    """
    folder = photographs / survey
    if not folder.is_dir():
        raise SurveyError(f"{folder} is missing: expected a folder of photographs; name others with --names")
    return folder


def reconstruct_exhaustively(photographs: Path, out: Path) -> None:
    """Run structure from motion with COLMAP's defaults; writes OUT/model and OUT/exhaustive.json."""
    import pycolmap

    out.mkdir(parents=True, exist_ok=True)
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    database, seconds = out / "database.db", {}
    database.unlink(missing_ok=True)

    def step(name: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        start = time.perf_counter()
        result = function(*arguments, **options)
        seconds[name] = time.perf_counter() - start
        return result

    names = sorted(p.name for p in photographs.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    mode = pycolmap.CameraMode.SINGLE
    step("features", pycolmap.extract_features, database, photographs, image_names=names, camera_mode=mode)
    step("matches", pycolmap.match_exhaustive, database)
    models = step("poses", pycolmap.incremental_mapping, database, photographs, out)
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    pairs = len(names) * (len(names) - 1) // 2
    record: dict[str, Any] = {"photographs": len(names), "pairs": pairs, "seconds": seconds, "registered": 0}
    if best is not None:
        (out / "model").mkdir(exist_ok=True)
        best.write_binary(out / "model")
        record["registered"] = best.num_reg_images()
        record["focal_px"] = [camera.mean_focal_length() for camera in best.cameras.values()]
    write_json(out / "exhaustive.json", record)


def write_page(runs: Path, names: Sequence[str], prepared: Path | None, ready: Path | None, out: Path) -> None:
    """What `measure_surveys` and comparisons left, as Markdown; parameters are those of `surveys`.

    In `prepared` SURVEY_uneven is the survey prepared with `--colour off`.
    """
    records = {survey: _read(runs / survey) for survey in names}
    made = next((r["usage"] for r in records.values() if r["usage"] and "machine" in r["usage"]), describe())["machine"]
    parts = [
        "# Surveys",
        _model(records).markdown(),
        *_trained(names, prepared, ready),
        _time(records).markdown(),
        f"On {made['cores']} cores of {made['processor']}, without a GPU. Exhaustive means COLMAP's defaults, run by "
        "the same library (pycolmap): every photograph matched with every other, focal length free.",
        '`make bench ARGS="surveys --photographs PHOTOS --runs RUNS --prepared COMPARISON --ready COMPARISON"` '
        "wrote this page; nothing is typed by hand.",
    ]
    write_text(out, "\n\n".join(parts) + "\n")


def _read(folder: Path) -> dict[str, Any]:
    return {
        "report": read_json(folder / "scene" / "report.json"),
        "usage": read_json(folder / "prepare.json"),
        "exhaustive": read_json(folder / "exhaustive" / "exhaustive.json"),
    }


def _run(comparison: Path | None, scene: str) -> Result | None:
    """What a comparison has of our network on a scene."""
    return None if comparison is None else read_results(comparison, [scene], [WHOLE]).by.get((scene, WHOLE))


def _trained(names: Sequence[str], prepared: Path | None, ready: Path | None) -> list[str]:
    """What `swift` achieves on prepared scenes, on those without exposure correction, and on ready-made ones."""
    columns = {
        "prepared": (prepared, ""),
        "prepared with --colour off": (prepared, UNCORRECTED),
        "ready-made": (ready, ""),
    }
    rows = []
    for survey in names:
        found = [_run(folder, survey + suffix) for folder, suffix in columns.values()]
        for metric, title, style in MEASURED:
            rows.append([f"{survey}: {title}", *(shown(result and result.metric(metric), style) for result in found)])
        rows.append(
            [f"{survey}: steps of training", *(shown(result and result.trained("steps"), "{:,}") for result in found)]
        )
    if not any(cell != NOTHING for row in rows for cell in row[1:]):
        return []
    text = (
        "Over the pixels of the held-out photographs that two training photographs or more see. Prepared scenes may "
        "hold other photographs out than ready-made ones, if they have others, and photographs "
        "whose exposures were corrected are other photographs, the held-out ones included: in those that became "
        "brighter the same errors count more, in darker ones less. So compare prepared scenes after the colour fit."
    )
    return [Table("Trained and evaluated", ["", *columns], rows).markdown(), text]


def _model(records: dict[str, dict[str, Any]]) -> Table:
    columns = ["", *records]
    rows: list[list[str]] = []

    def row(title: str, value: Callable[[dict[str, Any]], str | None]) -> None:
        cells = [NOTHING if record["report"] is None else value(record) or NOTHING for record in records.values()]
        rows.append([title, *cells])

    def residual(kind: str, name: str, unit: float) -> Callable[[dict[str, Any]], str | None]:
        def cell(record: dict[str, Any]) -> str | None:
            found = [r for r in record["report"]["tidefield"]["residuals"] if r["kind"] == kind]
            return f"{unit * found[0][name]:.{2 if unit == 1 else 1}f}" if found else None

        return cell

    shots = "reconstruction_statistics"
    row(
        "photographs placed",
        lambda r: f"{r['report'][shots]['reconstructed_shots_count']} of {r['report'][shots]['initial_shots_count']}",
    )
    row("mean reprojection error, px", lambda r: f"{r['report']['tidefield']['reprojection']['mean_px']:.2f}")
    row("focal length, px", lambda r: ", ".join(f"{c['focal_px']:.0f}" for c in r["report"]["tidefield"]["cameras"]))
    row("height above ground, m (mean)", lambda r: _mean(r, "height_above_ground"))
    row("the drone's own relative altitude, m (mean)", lambda r: _mean(r, "relative_altitude"))
    for kind, title in (("gps", "GPS"), ("control", "control points"), ("check", "control points left out in turn")):
        unit, name = (1, "m") if kind == "gps" else (100, "cm")
        row(f"{title}, RMS horizontal, {name}", residual(kind, "rms_horizontal", unit))
        row(f"{title}, RMS vertical, {name}", residual(kind, "rms_vertical", unit))
    row("photographs disagree in colour by, % (before)", lambda r: _colour(r, "before"))
    row("photographs disagree in colour by, % (after)", lambda r: _colour(r, "after"))
    return Table("Model", columns, rows)


def _mean(record: dict[str, Any], name: str) -> str | None:
    value = (record["report"]["tidefield"]["resolution"].get(name) or {}).get("mean")
    return None if value is None else f"{value:.1f}"


def _colour(record: dict[str, Any], when: str) -> str | None:
    colour = record["report"]["tidefield"]["colour"]
    return f"{colour['changes'][0][when]:.1f}" if colour else None


def _time(records: dict[str, dict[str, Any]]) -> Table:
    from tidefield.survey.prepare import STAGES

    rows: list[list[str]] = []
    reports = [record["report"] for record in records.values()]
    times = [{} if report is None else report["processing_statistics"]["steps_times"] for report in reports]
    for stage in STAGES:
        cells = [f"{of[stage]:.0f}" if stage in of else NOTHING for of in times]
        rows.append([f"prepare: {stage}, s", *cells])
    usages = [record["usage"] for record in records.values()]
    rows.append(["prepare: all, s", *(shown(of and of["seconds"], "{:.0f}") for of in usages)])
    memory = [shown(of and of["peak_memory_bytes"] / 1e9, "{:.1f}") for of in usages]
    rows.append(["prepare: peak memory, GB", *memory])
    others = [record["exhaustive"] for record in records.values()]

    def row(title: str, value: Callable[[dict[str, Any]], str]) -> None:
        rows.append([f"exhaustive: {title}", *(NOTHING if o is None else value(o) for o in others)])

    row("pairs matched", lambda o: f"{o['pairs']:,}")
    for stage in ("features", "matches", "poses"):
        row(f"{stage}, s", lambda o, stage=stage: f"{o['seconds'][stage]:.0f}" if stage in o["seconds"] else NOTHING)
    row("all of these, s", lambda o: f"{_whole(o):.0f}")
    row("photographs placed", lambda o: f"{o['registered']} of {o['photographs']}" if "registered" in o else NOTHING)
    row("focal length, px", lambda o: ", ".join(f"{f:.0f}" for f in o.get("focal_px", ())) or NOTHING)
    pairs = zip(usages, others, strict=True)
    ratios = [shown(usage and other and _whole(other) / usage["seconds"], "{:.1f}") for usage, other in pairs]
    rows.append(["exhaustive / prepare", *ratios])
    return Table("Time", ["", *records], rows)


def _whole(exhaustive: dict[str, Any]) -> float:
    return sum(exhaustive["seconds"].values())


if __name__ == "__main__":
    reconstruct_exhaustively(Path(sys.argv[1]), Path(sys.argv[2]))
