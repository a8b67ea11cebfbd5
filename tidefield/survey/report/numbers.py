"""Collect the numbers of report.json and of the page, named as in OpenSfM's and ODM's stats.json where they are there.

https://github.com/mapillary/OpenSfM (opensfm/stats.py) and https://github.com/OpenDroneMap/ODM (stages/odm_report.py)
define these names. Numbers without one are under "tidefield". Lengths are metres (model units without a georeference),
null is unknown.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pycolmap

from tidefield.geometry.geodesy import LocalFrame, parse_crs
from tidefield.survey.report.findings import Comparison, Findings, UnusedPhotograph
from tidefield.survey.report.remarks import remarks
from tidefield.survey.report.statistics import Statistics
from tidefield.survey.survey import Photograph

Numbers = dict[str, Any]

CLASSES = ((1, 1), (2, 2), (3, 4), (5, 7), (8, 11), (12, 19), (20, None))  # photographs that see a piece of ground
_OPENSFM_TIME = "%d/%m/%Y at %H:%M:%S"
_OPENSFM_NAMES = {"f": "focal", "fx": "focal_x", "fy": "focal_y", "cx": "c_x", "cy": "c_y", "k": "k1"}
_IN_PIXELS = ("f", "fx", "fy", "cx", "cy")
_OPENSFM_ERRORS = {"gps": "gps_errors", "control": "gcp_errors", "check": "check_errors"}


def numbers(findings: Findings, statistics: Statistics) -> Numbers:
    """Collect all numbers of a report, ready for JSON: plain Python values, None for what is unknown."""
    comparisons = findings.comparisons()
    table: Numbers = {
        "processing_statistics": _processing(findings, statistics),
        "features_statistics": {
            "detected_features": _spread(statistics.block.detected),
            "reconstructed_features": _spread(statistics.observed),
        },
        "reconstruction_statistics": _reconstruction(findings, statistics),
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
        table[name] = next((_opensfm_errors(r) for r in comparisons if r.kind == kind), {})
    return plain(table)


def duration(seconds: float) -> str:
    """Format a time span: 42 s, 3 min 20 s, 2 h 5 min."""
    if seconds < 60:
        return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1f} s"
    whole = round(seconds)
    return f"{whole // 60} min {whole % 60} s" if whole < 3600 else f"{whole // 3600} h {whole % 3600 // 60} min"


def plain(value: Any) -> Any:
    """Convert NumPy values to Python's, with None for every number that is not finite."""
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


def _reconstruction(findings: Findings, statistics: Statistics) -> Numbers:
    kinds = {comparison.kind for comparison in findings.comparisons()}
    lengths, counts = np.unique(statistics.track_length, return_counts=True)
    error = statistics.error_px[np.isfinite(statistics.error_px)]
    histogram, edges = np.histogram(error, 30, (0, max(np.percentile(error, 99.5), 1e-6) if len(error) else 1))
    longer = statistics.track_length[statistics.track_length > 2]
    return {
        "components": max(len(findings.models), 1),
        "has_gps": "gps" in kinds,
        "has_gcp": "control" in kinds,
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


def _opensfm_errors(comparison: Comparison) -> Numbers:
    errors = comparison.residuals.error_m[comparison.used]
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
        "not_used": int((~comparison.used).sum()),
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
        "residuals": [_residuals(comparison) for comparison in findings.comparisons()],
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
    """Name and code of the coordinate reference system of the results."""
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


def _residuals(comparison: Comparison) -> Numbers:
    rows = zip(comparison.residuals.names, comparison.residuals.error_m, comparison.used, strict=True)
    return {
        "kind": comparison.kind,
        "title": comparison.title,
        **_opensfm_errors(comparison),
        "remarks": comparison.remarks,
        "each": [{"name": n, "east": e[0], "north": e[1], "up": e[2], "used": used} for n, e, used in rows],
    }


def _left_out(lost: UnusedPhotograph) -> Numbers:
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


def lenses(statistics: Statistics) -> list[dict[str, Any]]:
    """Describe every lens: estimate and prior, in pixels with COLMAP's names and (`opensfm`) in OpenSfM's units."""
    found: list[dict[str, Any]] = []
    for index, camera in enumerate(statistics.block.cameras):
        mine = np.flatnonzero(statistics.block.lens == index)
        photograph = next((p for p in (statistics.photographs[i] for i in mine) if p is not None), None)
        label = (photograph.camera if photograph else "") or "camera"
        if any(other["name"] == label for other in found):
            label = f"{label} ({index + 1})"
        names = [name.strip() for name in camera.params_info.split(",")]
        found.append(
            {
                "name": label,
                "photographs": len(mine),
                "width": camera.width,
                "height": camera.height,
                "model": camera.model_name,
                "parameters": dict(zip(names, camera.params, strict=True)),
                "focal_px": camera.mean_focal_length(),
                **_prior(photograph, camera),
                "corner_distortion_px": _corner_distortion(camera),
                "opensfm": {
                    "initial_values": _initial(photograph, camera),
                    "optimized_values": _normalised(camera, names),
                },
            }
        )
    return found


def _prior(photograph: Photograph | None, camera: pycolmap.Camera) -> dict[str, Any]:
    if photograph is None or photograph.lens is None:
        return {"prior_focal_px": None, "prior_source": None}
    scale = camera.width / photograph.width  # the model's images may be smaller than the originals
    return {"prior_focal_px": photograph.lens.focal_px * scale, "prior_source": photograph.lens.source}


def _initial(photograph: Photograph | None, camera: pycolmap.Camera) -> dict[str, float]:
    if photograph is None or photograph.lens is None:
        return {}
    focal = photograph.lens.focal_px / max(photograph.width, photograph.height)
    known = {"focal_x": focal, "focal_y": focal}
    if photograph.lens.distortion:
        known |= dict(zip(("k1", "k2", "p1", "p2", "k3"), photograph.lens.distortion, strict=True))
    return known


def _normalised(camera: pycolmap.Camera, names: list[str]) -> dict[str, float]:
    """Focal lengths, and offsets of the principal point from the middle, by the image's longer side."""
    side = max(camera.width, camera.height)
    middle = {"cx": camera.width / 2, "cy": camera.height / 2}
    values = {}
    for name, value in zip(names, camera.params, strict=True):
        values[_OPENSFM_NAMES.get(name, name)] = (value - middle.get(name, 0)) / side if name in _IN_PIXELS else value
    return values


def _corner_distortion(camera: pycolmap.Camera) -> float:
    """Largest displacement of an image corner by the distortion, in pixels."""
    corners = np.array([(0, 0), (camera.width, 0), (0, camera.height), (camera.width, camera.height)], dtype=float)
    straight = np.asarray(camera.cam_from_img(corners)) * (camera.focal_length_x, camera.focal_length_y)
    straight += (camera.principal_point_x, camera.principal_point_y)
    return float(np.linalg.norm(straight - corners, axis=1).max())
