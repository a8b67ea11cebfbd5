"""Report the results of a survey and their quality: a page to send on, the same numbers as JSON, and a map for a GIS.

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
    ColourCorrection,
    ColourExample,
    Findings,
    UnusedPhotograph,
)
from tidefield.survey.report.geojson import geojson
from tidefield.survey.report.numbers import Numbers, numbers
from tidefield.survey.report.page import page
from tidefield.survey.report.statistics import measure

__all__ = [
    "Change",
    "ColourCorrection",
    "ColourExample",
    "Findings",
    "Report",
    "UnusedPhotograph",
    "write_report",
]


@dataclass(frozen=True)
class Report:
    """Files of a report.

    Attributes:
        page: report.html.
        table: report.json.
        map: survey.geojson, or None without a georeference.
        numbers: content of report.json.
    """

    page: Path
    table: Path
    map: Path | None
    numbers: Numbers


def write_report(findings: Findings, folder: Path) -> Report:
    """Write report.html, report.json and survey.geojson into a folder, over those of an earlier run.

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
        located.unlink(missing_ok=True)  # of an earlier run with a georeference
    else:
        texts[located.name] = json.dumps(geojson(findings, statistics), allow_nan=False)
    for name, text in texts.items():
        with completed_file(folder / name, overwrite=True) as partial:
            partial.write_text(text, encoding="utf-8")
    return Report(folder / "report.html", folder / "report.json", located if findings.frame else None, table)
