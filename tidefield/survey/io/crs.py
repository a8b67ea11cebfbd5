"""Coordinate reference systems as the first line of ODM's text files has them."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float64
from pyproj import Transformer

from tidefield.errors import SurveyError
from tidefield.geometry.geodesy import WGS84, parse_crs

_UTM = re.compile(r"WGS\s*-?\s*84[\s/,]+UTM\s*(?:zone)?\s*(\d{1,2})\s*([NS])", re.IGNORECASE)


def read_crs(header: str, where: str) -> str:
    """The system that a header line names: "EPSG:27700", a proj4 string, WKT, or "WGS84 UTM 32N".

    Args:
        header: the line.
        where: the file's name, for the message.

    Returns:
        A text that pyproj understands.

    Raises:
        SurveyError: it names no system, or one that is neither projected nor geographic.
    """
    text = header.strip()
    utm = _UTM.fullmatch(text)
    if utm:
        text = f"EPSG:{326 if utm[2].upper() == 'N' else 327}{int(utm[1]):02d}"
    try:
        parse_crs(text)
    except ValueError as error:
        raise SurveyError(
            f"the first line of {where} is {header.strip()[:80]!r}: expected a projected or geographic coordinate "
            'reference system such as "EPSG:27700", "+proj=utm +zone=32 +datum=WGS84" or "WGS84 UTM 32N"; write one'
        ) from error
    return text


def to_wgs84(crs: str, xy: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
    """Longitude and latitude in degrees of (easting, northing) or (longitude, latitude); infinite where undefined."""
    system = parse_crs(crs)
    horizontal = system.sub_crs_list[0] if system.is_compound else system.to_2d()
    return np.column_stack(Transformer.from_crs(horizontal, WGS84, always_xy=True).transform(*xy.T))
