"""report.json: the numbers of the page, under the names of OpenSfM's and ODM's stats.json where they have one.

https://github.com/mapillary/OpenSfM (opensfm/stats.py) and https://github.com/OpenDroneMap/ODM (stages/odm_report.py)
say what their names mean. What they have no name for stands under "tidefield". Lengths are metres (World units where
nothing placed the model on the Earth), null is unknown.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

import numpy as np

from tidefield.geometry.geodesy import LocalFrame, parse_crs
from tidefield.survey.report.findings import Findings, LeftOut, Residuals
from tidefield.survey.report.lenses import lenses
from tidefield.survey.report.remarks import remarks
from tidefield.survey.report.statistics import Statistics

Numbers = dict[str, Any]

CLASSES = ((1, 1), (2, 2), (3, 4), (5, 7), (8, 11), (12, 19), (20, None))  # photographs that see a piece of ground
_OPENSFM_TIME = "%d/%m/%Y at %H:%M:%S"
_OPENSFM_ERRORS = {"gps": "gps_errors", "control": "gcp_errors", "check": "check_errors"}


def numbers(findings: Findings, statistics: Statistics) -> Numbers:
    """All numbers of a report, ready for JSON: plain Python values, None for what is unknown."""
    gps = [r for r in findings.residuals if r.kind == "gps"]
    table: Numbers = {
        "processing_statistics": _processing(findings, statistics),
        "features_statistics": {
            "detected_features": _spread(statistics.block.detected),
            "reconstructed_features": _spread(statistics.observed),
        },
        "reconstruction_statistics": _reconstruction(findings, statistics, bool(gps)),
        "camera_errors": {camera["name"]: camera["opensfm"] for camera in lenses(statistics)},
        "odm_processing_statistics": {
            "total_time": sum(findings.seconds.values(), 0.0),
            "total_time_human": duration(sum(findings.seconds.values(), 0.0)),
            # ODM's unit; without a scale there is none.
            "average_gsd": 100 * _mean(statistics.gsd) if findings.frame else None,
        },
        "tidefield": _ours(findings, statistics),
    }
    for kind, name in _OPENSFM_ERRORS.items():
        table[name] = next((_opensfm_errors(r) for r in findings.residuals if r.kind == kind), {})
    return plain(table)


def duration(seconds: float) -> str:
    """A time span in words: 42 s, 3 min 20 s, 2 h 5 min."""
    if seconds < 60:
        return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1f} s"
    whole = round(seconds)
    return f"{whole // 60} min {whole % 60} s" if whole < 3600 else f"{whole // 3600} h {whole % 3600 // 60} min"


def plain(value: Any) -> Any:
    """The same of Python's own types, with None for every number that is not finite."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _processing(findings: Findings, statistics: Statistics) -> Numbers:
    start, end = _capture(findings)
    size = np.ptp(statistics.block.position[:, :2], axis=0)
    return {
        "steps_times": findings.seconds | {"Total Time": sum(findings.seconds.values(), 0.0)},
        "date": findings.date.strftime(_OPENSFM_TIME),
        "start_date": start.strftime(_OPENSFM_TIME) if start else "unknown",
        "end_date": end.strftime(_OPENSFM_TIME) if end else "unknown",
        "area": size.prod(),  # OpenSfM's: of the cameras' bounding box
    }


def _capture(findings: Findings) -> tuple[datetime | None, datetime | None]:
    times = [p.time_s for p in findings.survey.photographs if math.isfinite(p.time_s)]
    if not times:
        return None, None
    return datetime.fromtimestamp(min(times), UTC), datetime.fromtimestamp(max(times), UTC)  # the camera's own clock


def _reconstruction(findings: Findings, statistics: Statistics, has_gps: bool) -> Numbers:
    lengths, counts = np.unique(statistics.track_length, return_counts=True)
    error = statistics.error_px[np.isfinite(statistics.error_px)]
    histogram, edges = np.histogram(error, 30, (0, max(np.percentile(error, 99.5), 1e-6) if len(error) else 1))
    longer = statistics.track_length[statistics.track_length > 2]
    return {
        "components": max(len(findings.models), 1),
        "has_gps": has_gps,
        "has_gcp": any(r.kind == "control" for r in findings.residuals),
        "initial_shots_count": len(findings.survey.photographs),
        "reconstructed_shots_count": len(statistics.block),
        "reconstructed_points_count": len(statistics.block.points),
        "observations_count": len(statistics.block.point),
        "average_track_length": _mean(statistics.track_length),
        "average_track_length_over_two": _mean(longer),
        "histogram_track_length": dict(zip(lengths.tolist(), counts.tolist(), strict=True)),
        "reprojection_error_pixels": _mean(error),
        "reprojection_histogram_pixels": [histogram, edges],
    }


def _opensfm_errors(residuals: Residuals) -> Numbers:
    errors = residuals.east_north_up_m[residuals.used]
    if not len(errors):
        return {}
    horizontal, vertical = np.linalg.norm(errors[:, :2], axis=1), np.abs(errors[:, 2])
    rms = np.sqrt((errors**2).mean(0))
    return {
        "mean": dict(zip("xyz", errors.mean(0), strict=True)),
        "std": dict(zip("xyz", errors.std(0), strict=True)),
        "error": dict(zip("xyz", rms, strict=True)),
        "average_error": np.linalg.norm(errors, axis=1).mean(),
        "ce90": np.percentile(horizontal, 90),
        "le90": np.percentile(vertical, 90),
        "count": len(errors),
        "not_used": int((~residuals.used).sum()),
        "rms_horizontal": np.hypot(rms[0], rms[1]),
        "rms_vertical": rms[2],
        "largest_horizontal": horizontal.max(),
        "largest_vertical": vertical.max(),
    }


def _ours(findings: Findings, statistics: Statistics) -> Numbers:
    error = statistics.error_px[np.isfinite(statistics.error_px)]
    start, end = _capture(findings)
    frame, colour = findings.frame, findings.colour
    return {
        "title": findings.title,
        "date": findings.date.isoformat(timespec="seconds"),
        "captured": [start.replace(tzinfo=None).isoformat() if start else None, end.replace(tzinfo=None).isoformat()]
        if start and end
        else None,
        "unit": "m" if frame else "model unit",
        "georeference": _georeference(findings, frame) if frame else None,
        "models": findings.models or (len(statistics.block),),
        "resolution": {
            "gsd": _spread(statistics.gsd),
            "gsd_of_originals": _spread(statistics.gsd * _reduction(statistics)),
            "height_above_ground": _spread(statistics.height),
            "relative_altitude": _spread(
                np.array([np.nan if p is None else p.relative_altitude_m for p in statistics.photographs])
            ),
        },
        "coverage": _coverage(statistics),
        "overlap": {"forward": _spread(statistics.overlap.forward), "side": _spread(statistics.overlap.side)},
        "reprojection": {
            "mean_px": _mean(error),
            "rms_px": math.sqrt(_mean(error**2)),
            "per_photograph": _spread(statistics.mean_px),
        },
        "cameras": [{key: value for key, value in camera.items() if key != "opensfm"} for camera in lenses(statistics)],
        "residuals": [_residuals(residuals) for residuals in findings.residuals],
        "colour": None
        if colour is None
        else {
            "applied": colour.applied,
            "verdict": colour.verdict,
            "changes": [vars(change) for change in colour.changes],
        },
        "left_out": [_left_out(lost) for lost in findings.left_out],
        "photographs": [_photograph(statistics, i) for i in range(len(statistics.block))],
        "options": findings.options,
        "versions": findings.versions,
        "remarks": remarks(findings, statistics),
    }


def crs_title(frame: LocalFrame) -> str:
    """Name and code of the system that results are given in."""
    name = parse_crs(frame.crs).name
    return f"{name} (EPSG:{frame.epsg})" if frame.epsg else name


def _georeference(findings: Findings, frame: LocalFrame) -> Numbers:
    origin = np.zeros((1, 3))
    return frame.to_json() | {
        "crs_title": crs_title(frame),
        "placed_by": findings.placed_by,
        "origin_longitude_latitude_height": frame.to_geographic(origin)[0],
        "origin_easting_northing_height": frame.to_crs(origin)[0],
    }


def _reduction(statistics: Statistics) -> np.ndarray:
    """Width in the model over the original photograph's, per photograph."""
    widths = [statistics.block.camera(i).width for i in range(len(statistics.block))]
    return np.array([np.nan if p is None else w / p.width for p, w in zip(statistics.photographs, widths, strict=True)])


def _coverage(statistics: Statistics) -> Numbers:
    coverage = statistics.coverage
    total = coverage.area(1)
    seen = coverage.count[coverage.count > 0]
    return {
        "area": total,
        "share_seen_by_2": coverage.area(2) / total if total else None,
        "share_seen_by_3": coverage.area(3) / total if total else None,
        "median_photographs": np.median(seen) if len(seen) else None,
        "cell": coverage.cell,
        "classes": [{"least": least, "most": most, "area": coverage.area(least, most)} for least, most in CLASSES],
    }


def _residuals(residuals: Residuals) -> Numbers:
    rows = zip(residuals.names, residuals.east_north_up_m, residuals.used, strict=True)
    return {
        "kind": residuals.kind,
        "title": residuals.title,
        **_opensfm_errors(residuals),
        "remarks": residuals.remarks,
        "each": [{"name": n, "east": e[0], "north": e[1], "up": e[2], "used": used} for n, e, used in rows],
    }


def _left_out(lost: LeftOut) -> Numbers:
    return {"name": lost.name, "stage": lost.stage, "reason": lost.reason, "measures": lost.measures}


def _photograph(statistics: Statistics, i: int) -> Numbers:
    return {
        "name": statistics.block.names[i],
        "position": statistics.block.position[i],
        "height_above_ground": statistics.height[i],
        "gsd": statistics.gsd[i],
        "points": statistics.observed[i],
        "reprojection_mean_px": statistics.mean_px[i],
        "reprojection_rms_px": statistics.rms_px[i],
        "forward_overlap": statistics.overlap.forward[i],
        "side_overlap": statistics.overlap.side[i],
    }


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else math.nan


def _spread(values: np.ndarray) -> Numbers:
    """Least, greatest, mean and median of the known values."""
    known = values[np.isfinite(values)]
    if not len(known):
        return {"min": None, "max": None, "mean": None, "median": None}
    return {"min": known.min(), "max": known.max(), "mean": known.mean(), "median": np.median(known)}
