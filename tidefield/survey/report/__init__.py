"""What a survey gave and how good it is: a page to send on, the same numbers as JSON, and a map for a GIS.

The pipeline fills `Findings`; `statistics` measures the model; `numbers` puts both into one table, which report.json
holds and `page` renders.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from tidefield.files import completed_file
from tidefield.survey.report.findings import (
    Change,
    ColourEvening,
    ColourExample,
    Findings,
    LeftOut,
    Residuals,
)
from tidefield.survey.report.geojson import geojson
from tidefield.survey.report.numbers import Numbers, numbers
from tidefield.survey.report.page import page
from tidefield.survey.report.statistics import measure

__all__ = [
    "Change",
    "ColourEvening",
    "ColourExample",
    "Findings",
    "LeftOut",
    "Report",
    "Residuals",
    "write_report",
]


@dataclass(frozen=True)
class Report:
    """What was written.

    Attributes:
        page: report.html.
        table: report.json.
        map: survey.geojson, or None if the model lies nowhere on the Earth.
        numbers: what report.json holds.
    """

    page: Path
    table: Path
    map: Path | None
    numbers: Numbers


def write_report(findings: Findings, folder: Path) -> Report:
    """Write report.html, report.json and survey.geojson into a folder, over what an earlier run left there.

    Raises:
        SurveyError: the reconstruction is empty.
        RunError: the folder cannot be written to.
    """
    statistics = measure(findings)
    table = numbers(findings, statistics)
    texts = {
        "report.html": page(findings, statistics, table),
        "report.json": json.dumps(table, indent=1, allow_nan=False),
    }
    located = folder / "survey.geojson"
    if findings.frame is None:
        located.unlink(missing_ok=True)  # of an earlier run, which knew where it was
    else:
        texts[located.name] = json.dumps(geojson(findings, statistics), allow_nan=False)
    for name, text in texts.items():
        with completed_file(folder / name, overwrite=True) as partial:
            partial.write_text(text, encoding="utf-8")
    return Report(folder / "report.html", folder / "report.json", located if findings.frame else None, table)
