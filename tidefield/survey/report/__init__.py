"""Report the results of a survey and their quality: a page to send on, the same numbers as JSON, and a map for a GIS.

`findings` collects what the pipeline found; `statistics` measures the model; `numbers` puts both into one table, which
report.json holds and `page` renders.
"""

from __future__ import annotations

import json
from pathlib import Path

from tidefield.files import completed_file
from tidefield.survey.report.findings import Findings, UnusedPhotograph, collect_findings
from tidefield.survey.report.geopackage import write_geopackage
from tidefield.survey.report.numbers import geojson, numbers, projected
from tidefield.survey.report.page import page
from tidefield.survey.report.statistics import measure

__all__ = ["Findings", "UnusedPhotograph", "collect_findings", "write_report"]


def write_report(findings: Findings, folder: Path) -> Path:
    """Write report.html, report.json, survey.geojson and survey.gpkg into a folder, over those of an earlier run.

    Without a georeference there are no files for a GIS.

    Returns:
        The path of report.html.

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
    if findings.frame:
        texts["survey.geojson"] = json.dumps(geojson(findings, statistics), allow_nan=False)
        with completed_file(folder / "survey.gpkg", overwrite=True) as partial:
            write_geopackage(partial, projected(findings, statistics), findings.frame, findings.date)
    else:
        for name in ("survey.geojson", "survey.gpkg"):
            (folder / name).unlink(missing_ok=True)  # of an earlier run with a georeference
    for name, text in texts.items():
        with completed_file(folder / name, overwrite=True) as partial:
            partial.write_text(text, encoding="utf-8")
    return folder / "report.html"
