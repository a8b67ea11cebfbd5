"""survey.geojson (RFC 7946): the survey map for a GIS, in longitude and latitude (WGS 84)."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from tidefield.geometry.geodesy import LocalFrame
from tidefield.survey.report.findings import Findings
from tidefield.survey.report.numbers import plain
from tidefield.survey.report.statistics import Statistics

DECIMALS = 8  # of a degree: a millimetre

Feature = dict[str, Any]


def geojson(findings: Findings, statistics: Statistics) -> dict[str, Any]:
    """A FeatureCollection of cameras, their footprints, surveyed points and the outline of the area covered.

    Positions have no third coordinate, as RFC 7946 wants ellipsoidal heights there; heights are properties instead.
    """
    frame = findings.frame
    assert frame is not None, "a model that lies nowhere has no map"
    return {
        "type": "FeatureCollection",
        "title": findings.title,
        "vertical_datum": frame.vertical_datum,
        "features": [
            _outline(frame, statistics),
            *_footprints(frame, statistics),
            *_cameras(frame, statistics),
            *_surveyed(frame, findings),
        ],
    }


def _outline(frame: LocalFrame, statistics: Statistics) -> Feature:
    polygons = [[_ring(frame, ring) for ring in rings] for rings in statistics.coverage.outline()]
    geometry = {"type": "MultiPolygon", "coordinates": polygons}
    return _feature(geometry, kind="area covered", area_m2=round(statistics.coverage.area(1), 2))


def _footprints(frame: LocalFrame, statistics: Statistics) -> list[Feature]:
    named = zip(statistics.block.names, statistics.footprints, statistics.gsd, strict=True)
    return [
        _feature(
            {"type": "Polygon", "coordinates": [_ring(frame, outline)]}, kind="footprint", photograph=name, gsd_m=gsd
        )
        for name, outline, gsd in named
        if len(outline)
    ]


def _cameras(frame: LocalFrame, statistics: Statistics) -> list[Feature]:
    block = statistics.block
    places = frame.to_geographic(block.position)
    rank = np.argsort(statistics.order)
    return [
        _feature(
            _point(places[i]),
            kind="camera",
            photograph=name,
            flight_order=rank[i] + 1,
            height_m=places[i, 2],
            height_above_ground_m=statistics.height[i],
            gsd_m=statistics.gsd[i],
            points=statistics.observed[i],
            reprojection_error_px=statistics.mean_px[i],
        )
        for i, name in enumerate(block.names)
    ]


def _surveyed(frame: LocalFrame, findings: Findings) -> list[Feature]:
    features = []
    for residuals in findings.residuals:
        if residuals.kind == "gps" or not len(residuals.names):
            continue
        places = frame.to_geographic(residuals.stated_world)
        for name, place, error, used in zip(
            residuals.names, places, residuals.east_north_up_m, residuals.used.tolist(), strict=True
        ):
            east, north, up = error
            features.append(
                _feature(
                    _point(place),
                    kind=f"{residuals.kind} point",
                    name=name,
                    compared=residuals.title,
                    used=used,
                    height_m=place[2],
                    residual_east_m=east,
                    residual_north_m=north,
                    residual_up_m=up,
                )
            )
    return features


def _feature(geometry: dict[str, Any], **properties: object) -> Feature:
    return {"type": "Feature", "geometry": geometry, "properties": plain(properties)}


def _point(place: Float64[np.ndarray, " 3"]) -> dict[str, Any]:
    return {"type": "Point", "coordinates": place[:2].round(DECIMALS).tolist()}


def _ring(frame: LocalFrame, outline: Float64[np.ndarray, "K 2"]) -> list[list[float]]:
    """A closed ring; the turn of the outline is kept."""
    closed = np.concatenate([outline, outline[:1]])
    return frame.to_geographic(np.c_[closed, np.zeros(len(closed))])[:, :2].round(DECIMALS).tolist()
