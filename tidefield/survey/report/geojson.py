"""Write survey.geojson (RFC 7946): the survey map for a GIS, in longitude and latitude (WGS 84)."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from jaxtyping import Float64
from shapely.geometry import mapping
from shapely.geometry.base import BaseGeometry

from tidefield.geometry.geodesy import LocalFrame
from tidefield.survey.report.findings import Findings
from tidefield.survey.report.numbers import plain
from tidefield.survey.report.statistics import Statistics

DECIMALS = 8  # of a degree: a millimetre

Feature = dict[str, Any]


def geojson(findings: Findings, statistics: Statistics) -> dict[str, Any]:
    """Collect cameras, their footprints, surveyed points and the outline of the area covered as features.

    Positions have no third coordinate, as RFC 7946 wants ellipsoidal heights there; heights are properties instead.
    """
    frame, block = findings.frame, statistics.block
    assert frame is not None, "a model without a georeference has no map"
    geographic = frame.to_geographic(block.position)
    rank = np.argsort(statistics.order)
    covered, area = statistics.coverage.outline(), round(statistics.coverage.area(1), 2)
    footprints = zip(block.names, statistics.footprints, statistics.gsd, strict=True)
    return {
        "type": "FeatureCollection",
        "title": findings.title,
        "vertical_datum": frame.vertical_datum,
        "features": [
            _feature(_on_earth(frame, covered), kind="area covered", area_m2=area),
            *(
                _feature(_on_earth(frame, outline), kind="footprint", photograph=name, gsd_m=gsd)
                for name, outline, gsd in footprints
                if not outline.is_empty
            ),
            *(
                _feature(
                    _point(geographic[i]),
                    kind="camera",
                    photograph=name,
                    flight_order=rank[i] + 1,
                    height_m=geographic[i, 2],
                    height_above_ground_m=statistics.height[i],
                    gsd_m=statistics.gsd[i],
                    points=statistics.observed[i],
                    reprojection_error_px=statistics.mean_px[i],
                )
                for i, name in enumerate(block.names)
            ),
            *_surveyed(frame, findings),
        ],
    }


def _surveyed(frame: LocalFrame, findings: Findings) -> list[Feature]:
    given = {name: frame.to_geographic(place[None])[0] for name, place in findings.control_points().items()}
    return [
        _feature(
            _point(given[name]),
            kind=f"{comparison.kind} point",
            name=name,
            compared=comparison.title,
            used=used,
            height_m=given[name][2],
            residual_east_m=east,
            residual_north_m=north,
            residual_up_m=up,
        )
        for comparison in findings.comparisons()
        if comparison.kind != "gps"
        for name, used, (east, north, up) in zip(
            comparison.residuals.names, comparison.used, comparison.residuals.error_m, strict=True
        )
    ]


def _feature(geometry: BaseGeometry, **properties: object) -> Feature:
    return {"type": "Feature", "geometry": mapping(geometry), "properties": plain(properties)}


def _point(longitude_latitude_height: Float64[np.ndarray, " 3"]) -> shapely.Point:
    return shapely.Point(longitude_latitude_height[:2].round(DECIMALS))


def _on_earth(frame: LocalFrame, outline: BaseGeometry) -> BaseGeometry:
    """An outline in longitude and latitude; its orientation is kept."""
    return shapely.transform(
        outline, lambda xy: frame.to_geographic(np.c_[xy, np.zeros(len(xy))])[:, :2].round(DECIMALS)
    )
