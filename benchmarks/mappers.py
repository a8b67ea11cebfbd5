"""The two mappers of `tidefield prepare` on surveys as they came from the camera.

Everything but the mapper is the same: features, pairs and matches, the choice of the lens, georeferencing. WORK has the
prepared scenes, one of each survey and mapper; what is measured is not repeated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

from benchmarks.records import MEASURED, HiddenRunner, say, show, store
from benchmarks.surveys import SURVEYS, photographs_of
from tidefield.compare.run import run_measured, tidefield
from tidefield.compare.tables import NOTHING, Table
from tidefield.files import read_json
from tidefield.survey.sfm.mapping import Mapper

MAPPERS_FILE = "mappers.json"
AXES = ("horizontal", "vertical")
RESIDUALS = {"gps": "GPS", "check": "control points left out in turn"}


def mappers(
    photographs: Path,
    work: Path,
    runs: Path = MEASURED,
    names: tuple[str, ...] = SURVEYS,
    run: HiddenRunner = run_measured,
) -> dict[str, Any]:
    """Prepare each survey with each mapper.

    Args:
        photographs: Folder with the surveys' folders.
        work: Folder for the prepared scenes.
        runs: Store the figures in this folder's mappers.json; what it holds is not measured again.
        names: Of the surveys.
        run: Runs a command.

    Raises:
        SurveyError: a survey is missing.
        RunError: a command failed.
    """
    record = read_json(runs / MAPPERS_FILE) or {"surveys": {}}
    for survey in names:
        source = photographs_of(survey, photographs)
        for mapper in get_args(Mapper):
            measured = record["surveys"].setdefault(survey, {})
            if mapper in measured:
                continue
            say(f"{survey}: {mapper}")
            scene = work / f"{survey}_{mapper}"
            usage = run(tidefield("prepare", source, scene, "--mapper", mapper), {})
            report = read_json(scene / "report.json")
            assert report is not None, "prepare writes it"
            measured[mapper] = {**asdict(usage), **_facts(report)}
            figures = [one for of in record["surveys"].values() for one in of.values()]
            store(runs / MAPPERS_FILE, record, measured[mapper], figures, "python -m benchmarks mappers")
    show([table(record)])
    return record


def _facts(report: Mapping[str, Any]) -> dict[str, Any]:
    shots = report["reconstruction_statistics"]
    found = {residual["kind"]: residual for residual in report["tidefield"]["residuals"]}
    return {
        "placed": shots["reconstructed_shots_count"],
        "photographs": shots["initial_shots_count"],
        "reprojection_px": report["tidefield"]["reprojection"]["mean_px"],
        "poses_seconds": report["processing_statistics"]["steps_times"]["poses"],
        "rms_m": {kind: [found[kind][f"rms_{axis}"] for axis in AXES] for kind in RESIDUALS if kind in found},
    }


def table(record: Mapping[str, Any]) -> Table:
    """A row for each survey and mapper."""
    columns = ["survey", "mapper", "placed", "reprojection error, px"]
    columns += [f"{title}, RMS horizontal / vertical, cm" for title in RESIDUALS.values()]
    columns += ["poses, s", "all, s", "memory, GB"]
    rows = []
    for survey, measured in record["surveys"].items():
        for mapper, facts in measured.items():
            residuals = [facts["rms_m"].get(kind, []) for kind in RESIDUALS]
            rows.append(
                [
                    survey,
                    mapper,
                    f"{facts['placed']} of {facts['photographs']}",
                    f"{facts['reprojection_px']:.3f}",
                    *(" / ".join(f"{100 * rms:.1f}" for rms in pair) or NOTHING for pair in residuals),
                    f"{facts['poses_seconds']:.0f}",
                    f"{facts['seconds']:.0f}",
                    f"{facts['peak_memory_bytes'] / 1e9:.2f}",
                ]
            )
    return Table("", columns, rows)
