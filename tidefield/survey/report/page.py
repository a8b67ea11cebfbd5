"""Render report.html from the numbers of report.json: one page without scripts and without network requests."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup
from PIL import Image

from tidefield.pages import template_environment
from tidefield.survey.report.figures import COLOURS, draw_histogram, draw_map, draw_residuals, spaced
from tidefield.survey.report.findings import Findings
from tidefield.survey.report.numbers import Numbers, duration
from tidefield.survey.report.statistics import Statistics

MOST_ROWS = 24  # a longer list opens on a click
LONGEST_TRACK = 20  # longer ones share a bar
JPEG_QUALITY = 72
UNKNOWN, MINUS = "\u2013", "\u2212"
STAGES = {"quality": "Rejected for their quality", "poses": "Could not be registered"}


def page(findings: Findings, statistics: Statistics, numbers: Numbers) -> str:
    """Render the page as HTML; every name in it is escaped."""
    located = findings.frame is not None
    environment = template_environment("tidefield.survey.report")
    environment.filters |= _formats(located) | {"data_uri": _data_uri}
    scatters = [(comparison.title, draw_residuals(comparison)) for comparison in findings.comparisons()]
    lost = []
    for stage, heading in STAGES.items():
        mine = [photograph for photograph in findings.left_out if photograph.stage == stage]
        pictured = [photograph for photograph in mine if photograph.thumbnail is not None]
        lost += (
            [(heading, pictured, [photograph for photograph in mine if photograph.thumbnail is None])] if mine else []
        )
    return environment.get_template("page.html").render(
        n=numbers,
        made=f"{findings.date:%Y-%m-%d %H:%M} {findings.date.tzname() or ''}".strip(),
        ours=numbers["tidefield"],
        located=located,
        map=draw_map(findings, statistics),
        classes=list(zip(COLOURS, numbers["tidefield"]["coverage"]["classes"], strict=True)),
        charts=draw_charts(statistics, located),
        scatters=[(title, chart) for title, chart in scatters if chart],
        lost=lost,
        most_rows=MOST_ROWS,
        examples=findings.examples,
    )


def _formats(located: bool) -> dict[str, Callable[..., Any]]:
    """Filters that format numbers, each inside a `data` element with its value in report.json."""

    def written(value: float | int | None, text: Callable[[float], str]) -> str | Markup:
        if value is None:
            return UNKNOWN
        return Markup('<data value="{}">{}</data>').format(repr(value), text(value))

    def metres(value: float | int | None, digits: int = 2, unit: bool = True) -> str | Markup:
        ending = ("\u00a0m" if located else "\u00a0units") * unit
        return written(value, lambda v: (spaced(v, digits) if located else f"{v:.3g}") + ending)

    def gsd(value: float | int | None, unit: bool = True) -> str | Markup:
        ending = ("\u00a0cm/px" if located else "\u00a0units/px") * unit
        return written(value, lambda v: (_significant(100 * v) if located else f"{v:.3g}") + ending)

    def area(value: float) -> str:
        if not located:
            return f"{value:.3g} square units"
        return f"{spaced(value / 1e4, 2)}\u00a0ha" if value >= 1000 else f"{spaced(value, 0)}\u00a0m²"

    return {
        "number": lambda value, digits=0: written(value, lambda v: spaced(v, digits)),
        "metres": metres,
        "gsd": gsd,
        "area": lambda value: written(value, area),
        "percent": lambda value: written(value, lambda v: f"{100 * v:.0f}%"),
        "signed": lambda value, digits=3: UNKNOWN if value is None else f"{value:+.{digits}f}".replace("-", MINUS),
        "plainly": lambda value, digits, scale=1: UNKNOWN if value is None else f"{scale * value:.{digits}f}",
        "parameter": lambda value: written(value, lambda v: spaced(v, 2 if abs(v) >= 10 else 6)),
        "duration": lambda value: written(value, duration),
    }


def _significant(value: float) -> str:
    """Format with three significant digits."""
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}" if value else "0"


def draw_charts(statistics: Statistics, located: bool) -> list[tuple[str, Markup]]:
    """Draw the charts of a model, by title; those without values are left out.

    Args:
        located: whether lengths are in metres.
    """
    scale, unit, digits = (100, "cm/px", 2) if located else (1, "units/px", 4)
    tracks = np.minimum(statistics.track_length, LONGEST_TRACK)
    beyond = f" ({LONGEST_TRACK}: or more)" if tracks.max() == LONGEST_TRACK else ""
    share = "share of the photograph (%)"
    charts = [
        ("Reprojection errors", "error (px)", "observations", statistics.error_px, 2),
        ("Track lengths", f"photographs that see a point{beyond}", "points", tracks, None),
        ("Ground sampling distances", f"of each photograph ({unit})", "photographs", scale * statistics.gsd, digits),
        ("Points per photograph", "points", "photographs", statistics.observed[~statistics.held_out], 0),
        ("Forward overlap", share, "photographs", 100 * statistics.forward_overlap, 0),
        ("Side overlap", share, "photographs", 100 * statistics.side_overlap, 0),
    ]
    found = [(chart[0], draw_histogram(*chart)) for chart in charts]
    return [(title, chart) for title, chart in found if chart]


def _data_uri(picture: UInt8[np.ndarray, "h w 3"]) -> str:
    """Encode a picture as a data URI of a JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
