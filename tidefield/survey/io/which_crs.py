"""Ground control that lies elsewhere than the photographs: how far, and which system would bring it here."""

from __future__ import annotations

import numpy as np
from pyproj import CRS, Geod, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError, ProjError

from tidefield.errors import SurveyError
from tidefield.geometry.geodesy import WGS84, parse_crs
from tidefield.survey.survey import Control

NEAR_M = 3_000.0
"""Control this far from the photographs is not theirs. Shifts between datums are less, flights with control as well."""
_FITTING_M = 1_000.0
_AT_MOST = 4


def refuse_elsewhere(control: Control, longitude_deg: float, latitude_deg: float) -> None:
    """Raise a SurveyError if ground control is far from a place, with the systems that would bring it there."""
    points = np.array(list(control.points.values()), dtype=np.float64)
    x, y = np.median(points[:, 0]), np.median(points[:, 1])
    here = longitude_deg, latitude_deg
    away = _distance_m(parse_crs(control.crs), x, y, here)
    if away < NEAR_M:
        return
    name = parse_crs(control.crs).name
    found = _fitting(control.crs, x, y, here)
    advice = (
        f"they would be here in {' or '.join(found)}" if found else "no system that is used here would put them here"
    )
    where = f"{away / 1000:,.0f} km from" if np.isfinite(away) else "nowhere near"
    raise SurveyError(
        f"the {len(points)} points of ground control, about ({x:.1f}, {y:.1f}) in {name}, lie {where} the photographs "
        f"(longitude {longitude_deg:.5f}, latitude {latitude_deg:.5f}): expected the same place; {advice}; correct the "
        "control file"
    )


def _fitting(crs: str, x: float, y: float, here: tuple[float, float]) -> list[str]:
    """Names of systems in which the coordinates are here, the nearest first: those in use here, and degrees."""
    area = AreaOfInterest(*here, *here)
    used = query_crs_info(auth_name="EPSG", pj_types=PJType.PROJECTED_CRS, area_of_interest=area, contains=True)
    # Systems with northing first differ from others only by what has been settled already: x is easting.
    systems = {f"EPSG:{i.code} ({i.name})": f"EPSG:{i.code}" for i in used if "(N-E)" not in i.name}
    systems[f"{WGS84} (longitude and latitude)"] = WGS84
    if f"EPSG:{parse_crs(crs).to_epsg()}" not in systems.values():
        systems[parse_crs(crs).name] = crs
    for first, second, order in ((x, y, ""), (y, x, ", with the two coordinates swapped")):
        away = {name + order: _distance_m(parse_crs(text), first, second, here) for name, text in systems.items()}
        near = sorted((name for name in away if away[name] < _FITTING_M), key=lambda name: away[name])
        if near:
            return near[:_AT_MOST]
    return []


def _distance_m(crs: CRS, x: float, y: float, here: tuple[float, float]) -> float:
    """Metres on the ellipsoid; infinite where the system cannot hold the coordinates."""
    try:
        there = Transformer.from_crs(crs.to_2d(), WGS84, always_xy=True).transform(x, y, errcheck=True)
    except (ProjError, CRSError):
        return float("inf")
    if not np.isfinite(there).all() or abs(there[1]) > 90:
        return float("inf")
    return abs(Geod(ellps="WGS84").inv(*here, *there)[2])
