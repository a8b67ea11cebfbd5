"""Warn of weak surveys, by the limits that are written here."""

from __future__ import annotations

import numpy as np

from tidefield.survey.report.findings import Findings
from tidefield.survey.report.statistics import Statistics

THIN_SHARE = 0.7  # of the area, seen by three photographs
LOW_FORWARD, LOW_SIDE = 0.6, 0.4  # the least of what flight planning asks for
LARGE_ERROR_PX = 1.0
FOCAL_CHANGE = 0.05
TILT_DEG = 30.0


def remarks(findings: Findings, statistics: Statistics) -> list[str]:
    """List warnings as whole sentences: those of the pipeline first."""
    return [*findings.remarks, *_georeference(findings), *_geometry(statistics), *_lens(statistics)]


def _georeference(findings: Findings) -> list[str]:
    if findings.frame is None:
        return [
            "The model has no georeference and no scale: lengths are in its own unit, and its ground plane is assumed "
            "to be level."
        ]
    kinds = {comparison.kind for comparison in findings.comparisons()}
    if not kinds & {"control", "check"}:
        return [
            "No surveyed points were used: the model is as well placed as the receiver's positions are, and their "
            "common error does not show in any residual."
        ]
    if "check" not in kinds:
        return ["No check points were held out: the residuals of control points are those of a fit, and flatter it."]
    return []


def _geometry(statistics: Statistics) -> list[str]:
    found = []
    coverage = statistics.coverage
    share = coverage.area(3) / max(coverage.area(1), 1e-12)
    if share < THIN_SHARE:
        found.append(
            f"Only {share:.0%} of the area is seen by three photographs or more; where fewer see it, heights are weak "
            "or unknown."
        )
    vertical = -statistics.block.R_world_camera[:, 2, 2]
    oblique = np.degrees(np.arccos(np.clip(vertical, -1, 1))) > TILT_DEG
    for name, values, least in (
        ("forward", statistics.overlap.forward, LOW_FORWARD),
        ("side", statistics.overlap.side, LOW_SIDE),
    ):
        known = values[np.isfinite(values) & ~oblique]
        if len(known) and np.median(known) < least:
            found.append(f"The {name} overlap, {np.median(known):.0%} (median), is under the usual {least:.0%}.")
    error = statistics.error_px[np.isfinite(statistics.error_px)]
    if len(error) and error.mean() > LARGE_ERROR_PX:
        found.append(f"The reprojection error, {error.mean():.2f} px, is high: it should stay under a pixel.")
    return found


def _lens(statistics: Statistics) -> list[str]:
    found = []
    for index, camera in enumerate(statistics.block.cameras):
        mine = (statistics.photographs[i] for i in np.flatnonzero(statistics.block.lens == index))
        photograph = next((p for p in mine if p is not None and p.lens is not None), None)
        if photograph is None or photograph.lens is None:
            continue
        change = camera.mean_focal_length() / (photograph.lens.focal_px * camera.width / photograph.width) - 1
        if abs(change) > FOCAL_CHANGE:
            found.append(
                f"The focal length came out {change:+.0%} from what {photograph.lens.source} says: flat ground seen "
                "straight down cannot tell focal length from height, so check the flight height."
            )
    return found
