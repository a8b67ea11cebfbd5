"""`tidefield prepare` on surveys as they came from the camera, beside exhaustive structure from motion.

RUNS/SURVEY/scene is the prepared scene, RUNS/SURVEY/exhaustive the other's model, and RUNS/SURVEY/prepare.json and
exhaustive/exhaustive.json hold what they took. What is there is not repeated. What comes of training on prepared scenes
and on ready-made ones of the same surveys is read from comparisons.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tidefield.compare.record import Runner, tidefield
from tidefield.compare.results import Result, read_results
from tidefield.compare.run import WHOLE
from tidefield.compare.table import NOTHING, Table, shown
from tidefield.errors import SurveyError
from tidefield.files import completed_file, read_json, write_json
from tidefield.machine import describe

AIMS = {"brighton_beach": (18, True), "turin_lot": (32, True), "swindale": (75, False)}
"""Photographs to be placed, and whether the drone says how high it flew."""
UNEVEN = "_uneven"
"""Ends the name of a scene that was prepared with --colour off."""
METRICS = (
    ("psnr_seen_cc", "PSNR after the colour fit, dB", "{:.2f}"),
    ("psnr_seen", "PSNR, dB", "{:.2f}"),
    ("ssim_seen_cc", "SSIM after the colour fit", "{:.4f}"),
)


def measure_surveys(
    photographs: Path, runs: Path, surveys: Sequence[str], pairs: int | None, run: Runner, say: Callable[[str], object]
) -> None:
    """Prepare every survey, and place its photographs exhaustively.

    Args:
        pairs: match only so many of all pairs and reckon the time of all from them; None matches all.

    Raises:
        SurveyError: a survey is not there.
        RunError: a command failed.
    """
    for survey in surveys:
        source, folder = photographs / survey, runs / survey
        if not source.is_dir():
            raise SurveyError(f"{source} is not there: expected a folder of photographs; name others with --surveys")
        if read_json(folder / "prepare.json") is None:
            say(f"{survey}: prepare")
            took = run(tidefield("prepare", source, folder / "scene"), {})
            write_json(folder / "prepare.json", {**asdict(took), **describe()})
        if pairs != 0 and read_json(folder / "exhaustive" / "exhaustive.json") is None:
            say(f"{survey}: exhaustive")
            some = [] if pairs is None else [str(pairs)]
            run([sys.executable, "-m", "benchmarks.exhaustive", str(source), str(folder / "exhaustive"), *some], {})


def write_page(runs: Path, surveys: Sequence[str], prepared: Path | None, ready: Path | None, out: Path) -> None:
    """What `measure_surveys` and comparisons left, as Markdown.

    Args:
        runs: the folder of `measure_surveys`.
        surveys: their names.
        prepared: a comparison on prepared scenes by the surveys' names; SURVEY_uneven is one of `--colour off`.
        ready: a comparison on ready-made scenes of these names.
        out: the file.
    """
    records = {survey: _read(runs / survey) for survey in surveys}
    many, made = read_json(runs / "many.json"), describe()["machine"]
    text = "\n\n".join(
        [
            "# Surveys",
            '`make bench ARGS="surveys --photographs PHOTOS --runs RUNS --prepared COMPARISON --ready COMPARISON"` '
            "wrote this page; nothing is typed by hand.",
            f"On {made['cores']} cores of {made['processor']}, without a GPU. Exhaustive means COLMAP's defaults, as "
            "the same library (pycolmap) runs them: every photograph matched with every other, focal length free. "
            "Where only some of the pairs were matched, drawn at random, the time of all is reckoned from theirs and "
            "that of placing the photographs is not in it.",
            "## What was aimed at",
            _aims(records, many, prepared, ready).markdown(),
            "## What came of it",
            _quality(records).markdown(),
            *_trained(surveys, prepared, ready),
            _time(records).markdown(),
            *_many(many),
        ]
    )
    with completed_file(out, overwrite=True) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


def _read(folder: Path) -> dict[str, Any]:
    return {
        "report": read_json(folder / "scene" / "report.json"),
        "took": read_json(folder / "prepare.json"),
        "exhaustive": read_json(folder / "exhaustive" / "exhaustive.json"),
    }


def _aims(
    records: dict[str, dict[str, Any]], many: dict[str, Any] | None, prepared: Path | None, ready: Path | None
) -> Table:
    """Every aim, what came out, and whether that is enough."""
    rows: list[list[str]] = []

    for survey, (placed, height) in AIMS.items():
        record = records.get(survey)
        if record is None or record["report"] is None:
            continue
        report = record["report"]
        shots, more = report["reconstruction_statistics"], report["tidefield"]
        found = shots["reconstructed_shots_count"]
        rows.append(_row(f"{survey}: {placed} photographs placed or more", f"{found}", found >= placed))
        error = more["reprojection"]["mean_px"]
        rows.append(_row(f"{survey}: mean reprojection error of 0.6 px or less", f"{error:.2f} px", error <= 0.6))
        if height:
            share = more["resolution"]["height_above_ground"]["mean"] / more["resolution"]["relative_altitude"]["mean"]
            aim = f"{survey}: flight height within 3 % of the drone's own"
            rows.append(_row(aim, f"{share - 1:+.1%}", abs(share - 1) <= 0.03))
        for check in (r for r in more["residuals"] if r["kind"] == "check"):
            for name, least in (("horizontal", 0.05), ("vertical", 0.10)):
                aim = f"{survey}: control points left out in turn met within {100 * least:.0f} cm, {name} RMS"
                value = check[f"rms_{name}"]
                gsd = more["resolution"]["gsd"]["mean"]
                shown = f"{100 * value:.1f} cm, {value / gsd:.1f} pixels on the ground"
                rows.append(_row(aim, shown, value < least))
            if record["took"] is not None and record["exhaustive"] is not None:
                ratio = _whole(record["exhaustive"]) / record["took"]["seconds"]
                rows.append(_row(f"{survey}: 3 times as fast as exhaustive or more", f"{ratio:.1f} times", ratio >= 3))
        ours, plain, theirs = (
            result and result.metric("psnr_seen_cc")
            for result in (_run(prepared, survey), _run(prepared, survey + UNEVEN), _run(ready, survey))
        )
        if ours is not None and theirs is not None:
            gain = f"{ours - theirs:+.2f} dB" + (
                "" if plain is None else f", with --colour off {plain - theirs:+.2f} dB"
            )
            rows.append(_row(f"{survey}: trained, PSNR not under the ready-made scene's", gain, ours >= theirs))
    if many is not None:
        aim = f"{many['photographs']} photographs in less than 4 GB"
        rows.append(_row(aim, f"{many['peak_memory_bytes'] / 1e9:.2f} GB", many["peak_memory_bytes"] < 4e9))
    return Table("", ["aim", "result", ""], rows)


def _row(aim: str, shown: str, enough: bool) -> list[str]:
    return [aim, shown, "met" if enough else "not met"]


def _run(comparison: Path | None, scene: str) -> Result | None:
    """What a comparison has of our network on a scene."""
    return None if comparison is None else read_results(comparison, [scene], [WHOLE]).by.get((scene, WHOLE))


def _trained(surveys: Sequence[str], prepared: Path | None, ready: Path | None) -> list[str]:
    """What `swift` makes of prepared scenes, of those without evened colours, and of ready-made ones."""
    columns = {
        "prepared": (prepared, ""),
        "prepared with --colour off": (prepared, UNEVEN),
        "ready-made": (ready, ""),
    }
    rows = []
    for survey in surveys:
        found = [_run(folder, survey + suffix) for folder, suffix in columns.values()]
        for metric, title, style in METRICS:
            rows.append([f"{survey}: {title}", *(shown(result and result.metric(metric), style) for result in found)])
        rows.append([f"{survey}: steps of training", *(shown(result and result.steps, "{:,}") for result in found)])
    if not any(cell != NOTHING for row in rows for cell in row[1:]):
        return []
    text = (
        "Over the pixels of the held-out photographs that two training photographs or more see. Prepared scenes may "
        "hold other photographs out than ready-made ones, if they have others, and photographs whose colours were "
        "evened are other photographs: in those that became brighter the same misses count more, in darker ones less."
    )
    return [Table("Trained and evaluated", ["", *columns], rows).markdown(), text]


def _quality(records: dict[str, dict[str, Any]]) -> Table:
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


def _many(record: dict[str, Any] | None) -> list[str]:
    if record is None:
        return []
    rows = [[f"{stage}, s", f"{seconds:.0f}"] for stage, seconds in record["steps_times"].items()]
    rows.append(["peak memory, GB", f"{record['peak_memory_bytes'] / 1e9:.2f}"])
    return [
        Table(f"{record['photographs']} small photographs, copies of one survey far apart", ["", ""], rows).markdown()
    ]


def _mean(record: dict[str, Any], name: str) -> str | None:
    value = (record["report"]["tidefield"]["resolution"].get(name) or {}).get("mean")
    return None if value is None else f"{value:.1f}"


def _colour(record: dict[str, Any], when: str) -> str | None:
    colour = record["report"]["tidefield"]["colour"]
    return f"{colour['changes'][0][when]:.1f}" if colour else None


def _time(records: dict[str, dict[str, Any]]) -> Table:
    columns = ["", *records]
    rows: list[list[str]] = []
    stages = ("quality", "features", "pairs", "matches", "poses", "georeference", "images")
    for stage in stages:
        cells = []
        for record in records.values():
            times = {} if record["report"] is None else record["report"]["processing_statistics"]["steps_times"]
            cells.append(f"{times[stage]:.0f}" if stage in times else NOTHING)
        rows.append([f"prepare: {stage}, s", *cells])
    rows.append(["prepare: all, s", *(_seconds(r["took"]) for r in records.values())])
    rows.append(["prepare: peak memory, GB", *(_memory(r["took"]) for r in records.values())])
    others = [record["exhaustive"] for record in records.values()]

    def other(title: str, value: Callable[[dict[str, Any]], str]) -> None:
        rows.append([f"exhaustive: {title}", *(NOTHING if o is None else value(o) for o in others)])

    other("pairs matched", lambda o: f"{o['pairs_matched']:,} of {o['pairs']:,}")
    for stage in ("features", "matches", "poses"):
        other(f"{stage}, s", lambda o, stage=stage: f"{o['seconds'][stage]:.0f}" if stage in o["seconds"] else NOTHING)
    other("all of these, s", lambda o: f"{_whole(o):.0f}")
    other("photographs placed", lambda o: f"{o['registered']} of {o['photographs']}" if "registered" in o else NOTHING)
    other("focal length, px", lambda o: ", ".join(f"{f:.0f}" for f in o.get("focal_px", ())) or NOTHING)
    ratios = [
        NOTHING
        if r["took"] is None or r["exhaustive"] is None
        else f"{_whole(r['exhaustive']) / r['took']['seconds']:.1f}"
        for r in records.values()
    ]
    rows.append(["exhaustive / prepare", *ratios])
    return Table("Time", columns, rows)


def _whole(exhaustive: dict[str, Any]) -> float:
    return sum(exhaustive["seconds"].values())


def _seconds(took: dict[str, Any] | None) -> str:
    return NOTHING if took is None else f"{took['seconds']:.0f}"


def _memory(took: dict[str, Any] | None) -> str:
    return NOTHING if took is None else f"{took['peak_memory_bytes'] / 1e9:.1f}"
