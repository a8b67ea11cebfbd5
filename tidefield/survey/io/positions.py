"""Positions that cannot be right, found by themselves and by the others."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from tidefield.errors import list_names
from tidefield.geometry.geodesy import EARTH_RADIUS_M, metres_per_degree
from tidefield.survey.survey import Photograph, Position

# A position this far from the middle of the others is wrong: no single flight is so long.
_FAR_M = 10_000.0
_FAR_TIMES_MEDIAN = 20.0
# More photographs than this in the distance are a second place, not errors of the receiver.
_ASTRAY_AT_MOST = 0.1


def impossible(position: Position) -> str | None:
    """What is wrong with a position taken alone, or None."""
    latitude, longitude = position.latitude_deg, position.longitude_deg
    if not (np.isfinite(latitude) and np.isfinite(longitude)):
        return "it is no number"
    # One of the two alone may be zero: on the equator, and in Greenwich.
    if max(abs(latitude), abs(longitude)) < 1e-3:
        return "it is zero: the receiver had no fix"
    if abs(latitude) > 90 and abs(longitude) <= 90:
        return "its latitude is beyond the poles: latitude and longitude are swapped"
    if abs(latitude) > 90 or abs(longitude) > 180:
        return "it is no place on the Earth"
    return None


def drop_impossible(photographs: Iterable[Photograph]) -> tuple[list[Photograph], list[str]]:
    """The photographs, without those positions that are impossible, and a remark for each kind of mistake."""
    kept, dropped = [], defaultdict(list)
    for photograph in photographs:
        position = photograph.position
        reason = impossible(position) if position else None
        if position and reason:
            dropped[f"from {position.source} is left out, because {reason}"].append(photograph)
        kept.append(replace(photograph, position=None) if reason else photograph)
    return kept, [_remark(astray, what) for what, astray in dropped.items()]


def drop_astray(photographs: Sequence[Photograph]) -> tuple[list[Photograph], list[str]]:
    """The photographs, those without positions whose positions are far from all others, and what was found.

    Far is 10 km, or 20 times as far from the middle as half of the others are. Where more than a tenth of the
    photographs (and more than two) are far, they are taken for a second place and keep their positions.
    """
    located = [photograph for photograph in photographs if photograph.position is not None]
    if len(located) < 3:
        return list(photographs), []
    xyz_m = np.concatenate([_geocentric_m(photograph.position) for photograph in located if photograph.position])
    middle = np.median(xyz_m, axis=0)
    away_m = np.linalg.norm(xyz_m - middle, axis=1)
    limit_m = max(_FAR_M, _FAR_TIMES_MEDIAN * float(np.median(away_m)))
    far = [index for index, distance in enumerate(away_m) if distance > limit_m]
    if len(far) > max(2, _ASTRAY_AT_MOST * len(located)):
        names = list_names([located[index].name for index in far])
        return list(photographs), [
            f"{len(far)} of the {len(located)} positions lie {away_m[far].min() / 1000:.0f} km and more from the "
            f"others ({names}): these may be two places."
        ]
    remarks = []
    for index in far:
        photograph = located[index]
        assert photograph.position is not None
        away_km = away_m[index] / 1000
        what = f"from {photograph.position.source} is left out, because it is {away_km:.0f} km from the others"
        if np.linalg.norm(_geocentric_m(_swapped(photograph.position))[0] - middle) < limit_m:
            what += ": latitude and longitude are swapped"
        remarks.append(_remark([photograph], what))
    astray = {located[index].name for index in far}
    return [replace(p, position=None) if p.name in astray else p for p in photographs], remarks


def metres_around(positions: Sequence[Position]) -> Float64[np.ndarray, "N 2"]:
    """East and north of the middle of some positions; on a sphere, good to some per cent over tens of kilometres."""
    degrees = np.array([(position.longitude_deg, position.latitude_deg) for position in positions]).reshape(-1, 2)
    east = (degrees[:, 0] - degrees[:1, 0] + 180) % 360 - 180  # also across the date line
    metres = np.column_stack([east, degrees[:, 1]]) * metres_per_degree(float(np.median(degrees[:, 1])))
    return metres - np.median(metres, axis=0)


def _swapped(position: Position) -> Position:
    return replace(position, latitude_deg=position.longitude_deg, longitude_deg=position.latitude_deg)


def _geocentric_m(position: Position) -> Float64[np.ndarray, "1 3"]:
    """On a sphere: for distances that need not be exact, but must not jump where the longitude does."""
    latitude, longitude = np.deg2rad([position.latitude_deg, position.longitude_deg])
    around = np.cos(latitude) * np.array([np.cos(longitude), np.sin(longitude)])
    return EARTH_RADIUS_M * np.array([[*around, np.sin(latitude)]])


def _remark(photographs: Sequence[Photograph], what: str) -> str:
    position = photographs[0].position
    assert position is not None
    example = f"latitude {position.latitude_deg:.6g}, longitude {position.longitude_deg:.6g}"
    return f"The position of {list_names([p.name for p in photographs])} ({example}) {what}."
