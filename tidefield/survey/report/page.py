"""Render report.html from the numbers of report.json: one page without scripts and without network requests."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import UInt8
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from tidefield.survey.report.figures import COLOURS, draw_bars, draw_histogram, draw_map, draw_residuals, spaced
from tidefield.survey.report.findings import Findings, UnusedPhotograph
from tidefield.survey.report.numbers import Numbers, duration
from tidefield.survey.report.statistics import Statistics

MOST_THUMBNAILS = 24  # of each stage
MOST_EXAMPLES = 4
MOST_ROWS = 24  # a longer list opens on a click
LONGEST_TRACK = 20  # longer ones share a bar
EXAMPLE_PX = 320
THUMBNAIL_PX = 160
JPEG_QUALITY = 72
UNKNOWN, MINUS = "\u2013", "\u2212"
STAGES = {
    "reading": "Could not be read",
    "quality": "Rejected for their quality",
    "poses": "Could not be registered",
}


def page(findings: Findings, statistics: Statistics, numbers: Numbers) -> str:
    """Render the page as HTML; every name in it is escaped."""
    environment = Environment(
        loader=PackageLoader("tidefield.survey.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= _formats(findings.frame is not None)
    return environment.get_template("page.html").render(
        n=numbers,
        made=f"{findings.date:%Y-%m-%d %H:%M} {findings.date.tzname() or ''}".strip(),
        ours=numbers["tidefield"],
        located=findings.frame is not None,
        map=draw_map(findings, statistics),
        classes=list(zip(COLOURS, numbers["tidefield"]["coverage"]["classes"], strict=True)),
        charts=_charts(statistics, findings.frame is not None),
        scatters=_scatters(findings),
        lost=_lost(findings.left_out),
        most_rows=MOST_ROWS,
        examples=_examples(findings),
    )


def _formats(located: bool) -> dict[str, Callable[..., Any]]:
    """Filters that format numbers, each inside a `data` element with its value in report.json."""

    def written(value: float | int | None, text: Callable[[float], str]) -> str | Markup:
        if value is None:
            return UNKNOWN
        return Markup('<data value="{}">{}</data>').format(repr(value), text(value))

    def number(value: float | int | None, digits: int = 0) -> str | Markup:
        return written(value, lambda v: spaced(v, digits))

    def metres(value: float | int | None, digits: int = 2, unit: bool = True) -> str | Markup:
        ending = ("\u00a0m" if located else "\u00a0units") * unit
        return written(value, lambda v: (spaced(v, digits) if located else f"{v:.3g}") + ending)

    def gsd(value: float | int | None, unit: bool = True) -> str | Markup:
        ending = ("\u00a0cm/px" if located else "\u00a0units/px") * unit
        return written(value, lambda v: (_significant(100 * v) if located else f"{v:.3g}") + ending)

    def area(value: float | int | None) -> str | Markup:
        def text(v: float) -> str:
            if not located:
                return f"{v:.3g} square units"
            return f"{spaced(v / 1e4, 2)}\u00a0ha" if v >= 1000 else f"{spaced(v, 0)}\u00a0m²"

        return written(value, text)

    return {
        "number": number,
        "metres": metres,
        "gsd": gsd,
        "area": area,
        "percent": lambda value: written(value, lambda v: f"{100 * v:.0f}%"),
        "signed": lambda value, digits=3: UNKNOWN if value is None else f"{value:+.{digits}f}".replace("-", MINUS),
        "plainly": lambda value, digits, scale=1: UNKNOWN if value is None else f"{scale * value:.{digits}f}",
        "parameter": lambda value: written(value, lambda v: spaced(v, 2 if abs(v) >= 10 else 6)),
        "duration": lambda value: written(value, duration),
    }


def _significant(value: float) -> str:
    """Format with three significant digits."""
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}" if value else "0"


def _charts(statistics: Statistics, located: bool) -> list[tuple[str, Markup]]:
    """Titles and charts; those without values are left out."""
    lengths = np.bincount(np.minimum(statistics.track_length, LONGEST_TRACK), minlength=4)[2:]
    edges = np.arange(2, 3 + len(lengths)) - 0.5
    scale, unit, digits = (100, "cm/px", 2) if located else (1, "units/px", 4)
    beyond = f" ({LONGEST_TRACK}: or more)" if len(lengths) + 1 == LONGEST_TRACK else ""
    observed = statistics.observed.astype(np.float64)
    charts = [
        ("Reprojection errors", "error (px)", "observations", statistics.error_px, 2),
        (
            "Ground sampling distances",
            f"of each photograph ({unit})",
            "photographs",
            scale * statistics.gsd,
            digits,
        ),
        ("Points per photograph", "points", "photographs", observed, 0),
        ("Forward overlap", "share of the photograph (%)", "photographs", 100 * statistics.overlap.forward, 0),
        ("Side overlap", "share of the photograph (%)", "photographs", 100 * statistics.overlap.side, 0),
    ]
    found = [(chart[0], draw_histogram(*chart)) for chart in charts]
    title, axis = "Track lengths", f"photographs that see a point{beyond}"
    found.insert(1, (title, draw_bars(title, axis, "points", lengths.tolist(), edges.tolist(), None)))
    return [(title, chart) for title, chart in found if chart]


def _scatters(findings: Findings) -> list[tuple[str, Markup]]:
    found = [(comparison.title, draw_residuals(comparison)) for comparison in findings.comparisons()]
    return [(title, chart) for title, chart in found if chart]


def _lost(
    left_out: tuple[UnusedPhotograph, ...],
) -> list[tuple[str, list[tuple[UnusedPhotograph, str]], list[UnusedPhotograph]]]:
    """Group photographs by the stage that left them out: the first with thumbnails, and the others."""
    groups = []
    for stage, heading in STAGES.items():
        pictured: list[tuple[UnusedPhotograph, str]] = []
        others: list[UnusedPhotograph] = []
        for lost in (lost for lost in left_out if lost.stage == stage):
            if lost.thumbnail is not None and len(pictured) < MOST_THUMBNAILS:
                pictured.append((lost, thumbnail_uri(lost.thumbnail)))
            else:
                others.append(lost)
        if pictured or others:
            groups.append((heading, pictured, others))
    return groups


def _examples(findings: Findings) -> list[tuple[str, str, str]]:
    examples = findings.colour.examples[:MOST_EXAMPLES] if findings.colour else ()
    return [(e.name, thumbnail_uri(e.before, EXAMPLE_PX), thumbnail_uri(e.after, EXAMPLE_PX)) for e in examples]


def thumbnail_uri(picture: UInt8[np.ndarray, "h w 3"], side_px: int = THUMBNAIL_PX) -> str:
    """Encode a JPEG of at most `side_px` a side as a data URI."""
    image = Image.fromarray(picture)
    image.thumbnail((side_px, side_px))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
