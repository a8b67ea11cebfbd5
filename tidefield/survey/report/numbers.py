"""Collect the contents of report.json and of the files for a GIS; names are those of OpenSfM's and ODM's stats.json.

https://github.com/mapillary/OpenSfM (opensfm/stats.py) and https://github.com/OpenDroneMap/ODM (stages/odm_report.py)
define these names. Numbers without one are under "tidefield". Lengths are metres (model units without a georeference),
null is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pycolmap
import shapely
from jaxtyping import Float64
from shapely.geometry import mapping
from shapely.geometry.base import BaseGeometry

from tidefield.geometry.geodesy import WGS84, LocalFrame, lost_in_conversion, near_longitude, parse_crs
from tidefield.geometry.lenses import FisheyeLens, lens_from_colmap
from tidefield.survey.colour import ExposureCorrection
from tidefield.survey.report.findings import Comparison, Findings
from tidefield.survey.report.geopackage import Layer
from tidefield.survey.report.statistics import Statistics, headings, unite

Numbers = dict[str, Any]

CLASSES = ((1, 1), (2, 2), (3, 4), (5, 7), (8, 11), (12, 19), (20, None))  # photographs that see a piece of ground
DECIMALS = 8  # of a degree: a millimetre
_OPENSFM_TIME = "%d/%m/%Y at %H:%M:%S"
_OPENSFM_NAMES = {"f": "focal", "fx": "focal_x", "fy": "focal_y", "cx": "c_x", "cy": "c_y", "k": "k1"}
_IN_PIXELS = ("f", "fx", "fy", "cx", "cy")
_OPENSFM_ERRORS = {"gps": "gps_errors", "control": "gcp_errors", "check": "check_errors"}

# Limits of the warnings.
THIN_SHARE = 0.7  # of the area, seen by three photographs
LOW_FORWARD, LOW_SIDE = 0.6, 0.4  # the least of what flight planning asks for
LARGE_ERROR_PX = 1.0
FOCAL_CHANGE = 0.05
TILT_DEG = 30.0
FEWEST_CLUSTERED, LAG_M, LAG_SPREADS = 8, 0.1, 2.0  # positions; the least distance along the flight, also in spreads


def numbers(findings: Findings, statistics: Statistics) -> Numbers:
    """Collect all numbers of a report, ready for JSON: plain Python values, None for what is unknown."""
    block, frame = statistics.block, findings.frame
    comparisons = findings.comparisons()
    kinds = {comparison.kind for comparison in comparisons}
    cameras, camera_errors = _lenses(statistics)
    times = [p.time_s for p in findings.survey.photographs if math.isfinite(p.time_s)]
    captured = [datetime.fromtimestamp(at, UTC) for at in (min(times), max(times))] if times else []  # camera's clock
    start, end = [at.strftime(_OPENSFM_TIME) for at in captured] or ["unknown", "unknown"]
    observed = _observed(statistics)
    reduction = np.array([block.camera(i).width / p.width for i, p in enumerate(statistics.photographs)])
    seconds = sum(findings.seconds.values(), 0.0)
    lengths, counts = np.unique(statistics.track_length, return_counts=True)
    error = statistics.error_px[np.isfinite(statistics.error_px)]
    histogram, edges = np.histogram(error, 30, (0, max(np.percentile(error, 99.5), 1e-6) if len(error) else 1))
    table: Numbers = {
        "processing_statistics": {
            "steps_times": findings.seconds | {"Total Time": seconds},
            "date": findings.date.strftime(_OPENSFM_TIME),
            "start_date": start,
            "end_date": end,
            "area": statistics.coverage.area(1),  # as on the page; OpenSfM's is that of the cameras' bounding box
        },
        "features_statistics": {
            "detected_features": _spread(block.detected[~statistics.held_out]),
            "reconstructed_features": _spread(statistics.observed[~statistics.held_out]),
        },
        "reconstruction_statistics": {
            "components": max(len(findings.models), 1),
            "has_gps": "gps" in kinds,
            "has_gcp": "control" in kinds,
            "initial_shots_count": len(findings.survey.photographs),
            "reconstructed_shots_count": len(block),
            "reconstructed_points_count": len(block.points),
            "observations_count": len(block.point),
            "average_track_length": _mean(statistics.track_length),
            "average_track_length_over_two": _mean(statistics.track_length[statistics.track_length > 2]),
            "histogram_track_length": dict(zip(lengths.tolist(), counts.tolist(), strict=True)),
            "reprojection_error_pixels": _mean(error),
            "reprojection_histogram_pixels": [histogram, edges],
        },
        "camera_errors": camera_errors,
        "odm_processing_statistics": {
            "total_time": seconds,
            "total_time_human": duration(seconds),
            # ODM's unit; without a scale there is none.
            "average_gsd": 100 * _mean(statistics.gsd) if frame else None,
        },
        "tidefield": {
            "title": findings.title,
            "date": findings.date.isoformat(timespec="seconds"),
            "captured": [at.replace(tzinfo=None).isoformat() for at in captured] or None,
            "unit": "m" if frame else "model unit",
            "georeference": frame.to_json()
            | {
                "crs_title": crs_title(frame),
                "placed_by": findings.placed_by,
                "origin_longitude_latitude_height": frame.to_geographic(np.zeros((1, 3)))[0],
                "origin_easting_northing_height": frame.to_crs(np.zeros((1, 3)))[0],
            }
            if frame
            else None,
            "models": findings.models or (len(block),),
            "resolution": {
                "gsd": _spread(statistics.gsd),
                "gsd_of_originals": _spread(statistics.gsd * reduction),
                "height_above_ground": _spread(statistics.height),
                "relative_altitude": _spread(np.array([p.relative_altitude_m for p in statistics.photographs])),
            },
            "coverage": _coverage(statistics),
            "overlap": {"forward": _spread(statistics.forward_overlap), "side": _spread(statistics.side_overlap)},
            "reprojection": {
                "mean_px": _mean(error),
                "rms_px": math.sqrt(_mean(error**2)),
                "per_photograph": _spread(statistics.mean_px),
            },
            "cameras": cameras,
            "residuals": [_residuals(comparison) for comparison in comparisons],
            "colour": _colour(findings.colour) if findings.colour else None,
            "left_out": [
                {"name": lost.name, "stage": lost.stage, "reason": lost.reason, "measures": lost.measures}
                for lost in findings.left_out
            ],
            "photographs": [
                {
                    "name": name,
                    "position": block.position[i],
                    "height_above_ground": statistics.height[i],
                    "gsd": statistics.gsd[i],
                    "held_out": statistics.held_out[i],
                    "points": observed[i],
                    "reprojection_mean_px": statistics.mean_px[i],
                    "reprojection_rms_px": statistics.rms_px[i],
                    "forward_overlap": statistics.forward_overlap[i],
                    "side_overlap": statistics.side_overlap[i],
                }
                for i, name in enumerate(block.names)
            ],
            "options": findings.options,
            "versions": findings.versions,
            "remarks": _remarks(findings, statistics, cameras),
        },
    }
    for kind, name in _OPENSFM_ERRORS.items():
        table[name] = next((_opensfm_errors(c) for c in comparisons if c.kind == kind), {})
    return plain(table)


def layers(findings: Findings, statistics: Statistics) -> list[Layer]:
    """Collect cameras, their footprints, surveyed points and the outline of the area covered, in the world."""
    frame, block = findings.frame, statistics.block
    assert frame is not None, "a model without a georeference has no map"
    height_m = frame.to_geographic(block.position)[:, 2]
    rank, observed = np.argsort(statistics.order), _observed(statistics)
    outlines = zip(block.names, statistics.footprints, statistics.gsd, strict=True)
    cameras = [
        {
            "photograph": name,
            "flight_order": rank[i] + 1,
            "height_m": height_m[i],
            "height_above_ground_m": statistics.height[i],
            "gsd_m": statistics.gsd[i],
            "points": observed[i],
            "reprojection_error_px": statistics.mean_px[i],
        }
        for i, name in enumerate(block.names)
    ]
    found: dict[str, tuple[str, Sequence[tuple[BaseGeometry, Numbers]]]] = {
        "area covered": (
            "MULTIPOLYGON",
            [(unite(statistics.footprints), {"area_m2": round(statistics.coverage.area(1), 2)})],
        ),
        "footprint": (
            "POLYGON",
            [(outline, {"photograph": name, "gsd_m": gsd}) for name, outline, gsd in outlines if not outline.is_empty],
        ),
        "camera": ("POINT", list(zip(map(shapely.Point, block.position[:, :2]), cameras, strict=True))),
    }
    surveyed = findings.control_points()
    for comparison in (c for c in findings.comparisons() if c.kind != "gps"):
        residuals = comparison.residuals
        points = [
            (
                shapely.Point(surveyed[name][:2]),
                {
                    "name": name,
                    "compared": comparison.title,
                    "used": used,
                    "height_m": frame.to_geographic(surveyed[name][None])[0, 2],
                    "residual_east_m": error_m[0],
                    "residual_north_m": error_m[1],
                    "residual_up_m": error_m[2],
                },
            )
            for name, used, error_m in zip(residuals.names, comparison.used, residuals.error_m, strict=True)
        ]
        found[f"{comparison.kind} point"] = ("POINT", points)
    return [
        Layer(name, kind, [(place, plain(properties)) for place, properties in features])
        for name, (kind, features) in found.items()
    ]


def geojson(findings: Findings, statistics: Statistics) -> dict[str, Any]:
    """Convert the layers to features of GeoJSON (RFC 7946), in longitude and latitude (WGS 84).

    They have no third coordinate, as RFC 7946 wants ellipsoidal heights there; heights are properties instead.
    """
    frame = findings.frame
    assert frame is not None, "a model without a georeference has no map"

    def rounded(xy: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        return degrees(frame, xy).round(DECIMALS)

    return {
        "type": "FeatureCollection",
        "title": findings.title,
        "vertical_datum": frame.vertical_datum,
        "features": [
            {
                "type": "Feature",
                "geometry": mapping(shapely.transform(place, rounded)),
                "properties": {"kind": layer.name, **properties},
            }
            for layer in layers(findings, statistics)
            for place, properties in layer.features
        ],
    }


def degrees(frame: LocalFrame, xy: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
    """Convert places at height 0 to longitude and latitude; beyond 180 degrees, outlines over the date line stay
    together, which would reach around the Earth."""
    found = frame.to_geographic(np.c_[xy, np.zeros(len(xy))])[:, :2]
    return np.c_[near_longitude(found[:, 0], frame.longitude_deg), found[:, 1]]


def projected(findings: Findings, statistics: Statistics) -> list[Layer]:
    """Convert the layers to the survey's own coordinate reference system."""
    frame = findings.frame
    assert frame is not None, "a model without a georeference has no map"

    def to_crs(xy: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        return frame.to_crs(np.c_[xy, np.zeros(len(xy))])[:, :2]

    return [
        Layer(
            layer.name, layer.geometry, [(shapely.transform(place, to_crs), values) for place, values in layer.features]
        )
        for layer in layers(findings, statistics)
    ]


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


def crs_title(frame: LocalFrame) -> str:
    """Name and code of the coordinate reference system of the results."""
    name = parse_crs(frame.crs).name
    return f"{name} (EPSG:{frame.epsg})" if frame.epsg else name


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else math.nan


def _spread(values: np.ndarray) -> Numbers:
    """Least, greatest, mean and median of the known values."""
    known = values[np.isfinite(values)]
    if not len(known):
        return {"min": None, "max": None, "mean": None, "median": None}
    return {"min": known.min(), "max": known.max(), "mean": known.mean(), "median": np.median(known)}


def _observed(statistics: Statistics) -> list[int | None]:
    """Points that every photograph observes; None for those that are held out."""
    each = zip(statistics.observed.tolist(), statistics.held_out, strict=True)
    return [None if held_out else count for count, held_out in each]


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


def _opensfm_errors(comparison: Comparison) -> Numbers:
    errors = comparison.residuals.error_m[comparison.used]
    if not len(errors):
        return {"count": 0, "not_used": len(comparison.used)}
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


def _residuals(comparison: Comparison) -> Numbers:
    rows = zip(comparison.residuals.names, comparison.residuals.error_m, comparison.used, strict=True)
    return {
        "kind": comparison.kind,
        "title": comparison.title,
        **_opensfm_errors(comparison),
        "remarks": comparison.remarks,
        "each": [{"name": n, "east": e[0], "north": e[1], "up": e[2], "used": used} for n, e, used in rows],
    }


def _colour(correction: ExposureCorrection) -> Numbers:
    vignetting = " and the vignetting of the lens was removed" if correction.sees_falloff else ""
    verdict = (
        f"Exposure and white balance were corrected{vignetting}; the brightest photograph had "
        f"{correction.gain.max() / correction.gain.min():.1f} times the gain of the darkest."
        if correction.helps
        else "The photographs agree as they are: their colours were not changed."
    )
    change = {
        "what": "difference between photographs at points that took no part in the estimate",
        "before": 100 * correction.before,
        "after": 100 * (correction.after if correction.sees_falloff else correction.gains_alone),
        "unit": "% of a pixel's value",
    }
    return {"applied": correction.helps, "verdict": verdict, "changes": [change]}


def _lenses(statistics: Statistics) -> tuple[list[Numbers], dict[str, Numbers]]:
    """Describe every lens: estimate and prior, in pixels with COLMAP's names, and by name in OpenSfM's units."""
    found: list[Numbers] = []
    opensfm: dict[str, Numbers] = {}
    for index, camera in enumerate(statistics.block.cameras):
        mine = [statistics.photographs[i] for i in np.flatnonzero(statistics.block.lens == index)]
        label = mine[0].camera or "camera"
        if label in opensfm:
            label = f"{label} ({index + 1})"
        parameters = dict(zip((name.strip() for name in camera.params_info.split(",")), camera.params, strict=True))
        photograph = next((p for p in mine if p.lens is not None), mine[0])
        prior, initial = photograph.lens, {}
        if prior is not None:
            focal = prior.focal_px / max(photograph.width, photograph.height)
            initial = {"focal_x": focal, "focal_y": focal}
            initial |= dict(zip(("k1", "k2", "p1", "p2", "k3"), prior.distortion or (), strict=False))
        found.append(
            {
                "name": label,
                "photographs": len(mine),
                "width": camera.width,
                "height": camera.height,
                "model": camera.model_name,
                "parameters": parameters,
                "focal_px": camera.mean_focal_length(),
                # The model's images may be smaller than the originals.
                "prior_focal_px": prior.focal_px * (camera.width / photograph.width) if prior else None,
                "prior_source": prior.source if prior else None,
                "corner_distortion_px": _corner_distortion(camera),
            }
        )
        # Focal lengths, and offsets of the principal point from the middle, by the image's longer side.
        middle, side = {"cx": camera.width / 2, "cy": camera.height / 2}, max(camera.width, camera.height)
        opensfm[label] = {
            "initial_values": initial,
            "optimized_values": {
                _OPENSFM_NAMES.get(name, name): (value - middle.get(name, 0)) / side if name in _IN_PIXELS else value
                for name, value in parameters.items()
            },
        }
    return found, opensfm


def _corner_distortion(camera: pycolmap.Camera) -> float:
    """Largest displacement of an image corner, or of that of a fisheye's pinhole, by the distortion, in pixels."""
    corners = np.array([(0, 0), (camera.width, 0), (0, camera.height), (camera.width, camera.height)], dtype=float)
    rays = np.asarray(camera.cam_from_img(corners))
    lens = lens_from_colmap(camera.model_name, camera.width, camera.height, camera.params)
    if isinstance(lens, FisheyeLens):
        rays = lens.pinhole().unproject(corners)
        corners = lens.project(np.c_[rays, np.ones(len(rays))])
    straight = rays * (camera.focal_length_x, camera.focal_length_y)
    straight += (camera.principal_point_x, camera.principal_point_y)
    return float(np.linalg.norm(straight - corners, axis=1).max())


def _remarks(findings: Findings, statistics: Statistics, cameras: list[Numbers]) -> list[str]:
    """List warnings as whole sentences: those of the pipeline first."""
    found = list(findings.remarks)
    kinds = {comparison.kind for comparison in findings.comparisons()}
    if findings.frame is None:
        found.append(
            "The model has no georeference and no scale: lengths are in its own unit, and its ground plane is assumed "
            "to be level."
        )
    elif not kinds & {"control", "check"}:
        found.append(
            "No surveyed points were used: the model is as well placed as the receiver's positions are, and their "
            "common error does not show in any residual."
        )
    elif "check" not in kinds:
        found.append(
            "No check points were held out: the residuals of control points are those of a fit, and flatter it."
        )
    if findings.frame is not None and (lost := lost_in_conversion(parse_crs(findings.frame.crs), parse_crs(WGS84))):
        found.append(f"survey.geojson: coordinates {lost}; survey.gpkg has the same shapes in the survey's own.")
    found += _clock_remark(findings, statistics)
    share = statistics.coverage.area(3) / max(statistics.coverage.area(1), 1e-12)
    if share < THIN_SHARE:
        found.append(
            f"Only {share:.0%} of the area is seen by three photographs or more; where fewer see it, heights are weak "
            "or unknown."
        )
    oblique = statistics.block.R_world_camera[:, 2, 2] > -np.cos(np.radians(TILT_DEG))
    for name, values, least in (
        ("forward", statistics.forward_overlap, LOW_FORWARD),
        ("side", statistics.side_overlap, LOW_SIDE),
    ):
        known = values[np.isfinite(values) & ~oblique]
        if len(known) and np.median(known) < least:
            found.append(f"The {name} overlap, {np.median(known):.0%} (median), is under the usual {least:.0%}.")
    error = _mean(statistics.error_px)
    if error > LARGE_ERROR_PX:
        found.append(f"The reprojection error, {error:.2f} px, is high: it should stay under a pixel.")
    for camera in cameras:
        change = camera["focal_px"] / camera["prior_focal_px"] - 1 if camera["prior_focal_px"] else 0
        if abs(change) > FOCAL_CHANGE:
            found.append(
                f"The focal length came out {change:+.0%} from what {camera['prior_source']} says: flat ground seen "
                "straight down cannot tell focal length from height, so check the flight height."
            )
    return found


def _clock_remark(findings: Findings, statistics: Statistics) -> list[str]:
    """Warn where the clocks of camera and receiver differ: residuals along the flight change their sign with it."""
    gps = next((comparison for comparison in findings.comparisons() if comparison.kind == "gps"), None)
    row = {name: i for i, name in enumerate(statistics.block.names)}
    if gps is None:
        return []
    mine = [i for i, name in enumerate(gps.residuals.names) if gps.used[i] and name in row]
    rows = np.array([row[gps.residuals.names[i]] for i in mine], dtype=int)
    position = statistics.block.position[:, :2]
    heading = headings(position, statistics.flights)[rows]
    if len(rows) < FEWEST_CLUSTERED or np.linalg.norm(heading.mean(0)) > 0.5:
        return []  # with one direction of flight the lag is a common shift
    error = gps.residuals.error_m[mine, :2]
    along = ((error - np.median(error, axis=0)) * heading).sum(1)
    lag_m = float(np.median(along))
    spread = 1.4826 * float(np.median(np.abs(along - lag_m)))
    if not abs(lag_m) > max(LAG_M, LAG_SPREADS * spread):
        return []
    times = np.array([photograph.time_s for photograph in statistics.photographs])
    speed = [
        np.linalg.norm(np.diff(position[order], axis=0), axis=1) / np.diff(times[order]).clip(1e-9)
        for order in statistics.flights
    ]
    seconds = abs(lag_m) / float(np.median(np.concatenate(speed)))
    clock = f", as if the clocks of camera and receiver differed by about {seconds:.1f} s" if seconds < 60 else ""
    return [
        "The residuals of the positions fall into two clusters, one for each direction of flight: the receiver's "
        f"positions are {abs(lag_m):.2f} m {'behind' if lag_m > 0 else 'ahead of'} the cameras{clock}. Flown there and "
        "back, the error cancels; on single lines it shifts the survey."
    ]
