"""Local east-north-up coordinates in metres, and their conversion to coordinate reference systems.

World is a Cartesian frame, tangent to the ellipsoid at the origin, so that its distances are true distances. Those of a
projected system are not: the British National Grid is 0.04% short in the north-west of England, and its north is not
true north. Projected coordinates are converted on the ellipsoid of that system's own datum (inverse projection,
geocentric, topocentric: EPSG guidance note 7-2, 4.1.1 and 4.1.2). This is exact: no datum shift, which may be wrong by
metres, lies between surveyed coordinates and the world, nor between the world and products.

Heights are used as given. A height above the sea is treated as one above the ellipsoid, in both directions; a height
that is too small by h shrinks the world by h / 6,371,000: 8 millionths for the 50 m between sea level and the WGS 84
ellipsoid in England.

Longitude, easting and x come before latitude, northing and y, whatever a system's own axis order. All is float64.
"""

from __future__ import annotations

import re
import warnings
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Float64
from pyproj import CRS, Proj, Transformer
from pyproj.crs import ProjectedCRS
from pyproj.crs.coordinate_operation import UTMConversion
from pyproj.database import query_utm_crs_info
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from tidefield.errors import list_names

WGS84 = "EPSG:4326"
EARTH_RADIUS_M = 6_371_000.0
"""Mean radius, for distances on a sphere that may be wrong by half a per cent."""
FOOT_M, US_SURVEY_FOOT_M = 0.3048, 1200 / 3937
_CENTIMETRES = 0.1
"""Metres. Conversions between systems of one plate are as accurate as this at best."""
_TRUE_AREA = 0.01
"""By how much areas on a map may differ from those on the ground; lengths in one direction may by twice as much."""
_NAMELESS = ("unknown", "unnamed", "undefined", "unspecified", "not specified")
"""How the names begin that programs give to what has none."""
_IN_FEET = re.compile(r" \(ft\w*\)$")
_ORIGIN = ("longitude_deg", "latitude_deg", "height_m")
Points: TypeAlias = Float64[np.ndarray, "N 3"]
_Degrees = TypeVar("_Degrees", float, np.ndarray)


@dataclass(frozen=True)
class LocalFrame:
    """A topocentric frame: east, north and up in metres from an origin, on the datum of `crs`.

    Attributes:
        longitude_deg, latitude_deg, height_m: the origin, on that datum and from its own prime meridian.
        crs: projected coordinate reference system of the products: "EPSG:27700", or WKT where it has no code.
        vertical_datum: of the heights, as text.
    """

    longitude_deg: float
    latitude_deg: float
    height_m: float
    crs: str
    vertical_datum: str

    @classmethod
    def at(cls, crs: str, origin: tuple[float, float, float], vertical_datum: str | None = None) -> LocalFrame:
        """Create a frame with its origin at a coordinate of a projected or geographic system.

        Args:
            crs: in any form that pyproj reads. A projected system is used for products too; for a geographic one, and
                for one whose metres are not those of the ground, such as Web Mercator, products use the UTM zone of
                the origin, on the same datum where that exists and on WGS 84 otherwise.
            origin: (easting, northing, height) or (longitude, latitude, height).
            vertical_datum: None reads it from the system, if this defines one; the metric twin of one in feet where
                the products' heights are in metres.

        Raises:
            ValueError: the system is unknown, neither projected nor geographic, or undefined at the origin.
        """
        system = parse_crs(crs)
        products = system
        if system.is_geographic:
            degrees = np.rad2deg(_base(system).axis_info[0].unit_conversion_factor)
            products = _utm(origin[0] * degrees, origin[1] * degrees, system)
        elif system.is_projected and in_metres(system):
            with suppress(ProjError):  # below, the origin is refused
                metric = metric_system(system, origin[0], origin[1])
                products = system if same_system(metric, system) else metric
        name = _name(products)
        named = _vertical_name(system)
        if named is not None and not products.is_compound:
            named = name_in_metres(named)
        heights = vertical_datum or named or "unknown; heights are as they were given"
        frame = cls(0.0, 0.0, 0.0, name, heights)
        longitude, latitude, height = frame._geodetic(_name(system), np.array([origin], dtype=np.float64))[0]
        return cls(float(longitude), float(latitude), float(height), frame.crs, heights)

    @property
    def epsg(self) -> int | None:
        """EPSG code of the products' system, or None."""
        return int(self.crs.removeprefix("EPSG:")) if self.crs.startswith("EPSG:") else None

    def from_system(self, crs: str, coordinates: Points) -> Points:
        """Convert (easting, northing, height) or (longitude, latitude, height) in any system to world.

        Exact for systems on the frame's datum; for others, as accurate as pyproj's datum shift.

        Raises:
            ValueError: the system is unknown, or undefined at these coordinates.
        """
        return self._transform(self._local, self._geodetic(crs, coordinates))

    def from_crs(self, easting_northing_height: Points) -> Points:
        """Convert coordinates in the frame's own projected system to world; exact."""
        return self.from_system(self.crs, easting_northing_height)

    def to_crs(self, xyz_world: Points) -> Points:
        """Convert world to easting, northing and height in the frame's projected system and its units; exact."""
        geodetic = self._transform(self._local, xyz_world, inverse=True)
        result = self._transform(self._projection, geodetic / self._degrees, inverse=True)
        result[:, 2] /= metres_per_height(self._crs)
        return result

    def from_geographic(self, longitude_latitude_height: Points) -> Points:
        """Convert WGS 84 (GPS), degrees and metres, to world."""
        return self.from_system(WGS84, longitude_latitude_height)

    def to_geographic(self, xyz_world: Points) -> Points:
        """Convert world to WGS 84 longitude and latitude, and height; as accurate as pyproj's datum shift.

        Heights keep the frame's vertical datum.
        """
        projected = self.to_crs(xyz_world)
        height_m = projected[:, 2] * metres_per_height(self._crs)
        return np.column_stack([self._transform(self._wgs84, projected)[:, :2], height_m])

    def to_json(self) -> dict:
        """Return the values that `from_json` reads."""
        return {
            "origin": {key: getattr(self, key) for key in _ORIGIN},
            "geographic_crs": _name(self._datum),
            "crs": self.crs,
            "epsg": self.epsg,
            "vertical_datum": self.vertical_datum,
        }

    @classmethod
    def from_json(cls, values: dict) -> LocalFrame:
        """Read the values of `to_json`. Raises KeyError, TypeError or ValueError if they are incomplete or wrong."""
        origin = [float(values["origin"][key]) for key in _ORIGIN]
        if not np.isfinite(origin).all() or abs(origin[0]) > 360 or abs(origin[1]) > 90:
            raise ValueError(f"the origin {origin} is not on the Earth")
        parse_crs(values["crs"])
        return cls(*origin, crs=str(values["crs"]), vertical_datum=str(values["vertical_datum"]))

    @cached_property
    def _crs(self) -> CRS:
        return parse_crs(self.crs)

    @cached_property
    def _base(self) -> CRS:
        return _base(self._crs)

    @cached_property
    def _datum(self) -> CRS:
        geodetic = self._base.geodetic_crs
        assert geodetic is not None, "parse_crs accepts only systems with a datum"
        return geodetic.to_2d()

    @cached_property
    def _projection(self) -> Transformer:
        return transformer(self._base, self._datum)

    @cached_property
    def _wgs84(self) -> Transformer:
        return transformer(horizontal(self._crs), parse_crs(WGS84))

    @cached_property
    def _degrees(self) -> Float64[np.ndarray, " 3"]:
        """Degrees per unit of the datum's geographic system (grads in France), and metres per metre."""
        unit = float(np.rad2deg(self._datum.axis_info[0].unit_conversion_factor))
        return np.array([unit, unit, 1.0])

    @cached_property
    def _local(self) -> Transformer:
        """Transformation from degrees and metres on the datum to world."""
        assert self._datum.ellipsoid is not None
        a, b = self._datum.ellipsoid.semi_major_metre, self._datum.ellipsoid.semi_minor_metre
        origin = f"+lon_0={self.longitude_deg!r} +lat_0={self.latitude_deg!r} +h_0={self.height_m!r}"
        return Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f"+step +proj=cart +a={a!r} +b={b!r} +step +proj=topocentric +a={a!r} +b={b!r} {origin}"
        )

    def _geodetic(self, crs: str, coordinates: Points) -> Points:
        """Convert coordinates in any system to degrees and metres on the frame's datum."""
        system = parse_crs(crs)
        base = _base(system)
        datum = base.geodetic_crs
        points = coordinates * np.array([1.0, 1.0, metres_per_height(system)])
        if datum is not None and datum.to_2d() == self._datum:
            if base.is_projected:
                points = self._transform(transformer(base, self._datum), points)
        else:
            # By way of the projected system as given, because its definition may hold its own shift to WGS 84.
            height_m = points[:, 2].copy()
            shift = transformer(horizontal(system), horizontal(self._crs))
            points = self._transform(self._projection, self._transform(shift, points))
            points[:, 2] = height_m
        return points * self._degrees

    @staticmethod
    def _transform(transformer: Transformer, points: Points, inverse: bool = False) -> Points:
        try:
            columns = transformer.transform(*points.T, direction="INVERSE" if inverse else "FORWARD", errcheck=True)
        except ProjError as error:
            raise ValueError(f"the coordinates lie outside what the system can hold ({error})") from error
        result = np.column_stack(columns).astype(np.float64)
        if not np.isfinite(result).all():
            raise ValueError("the coordinates lie outside what the system can hold")
        return result


@lru_cache
def transformer(source: CRS, target: CRS) -> Transformer:
    """The transformation of coordinates, longitude or easting first; PROJ takes milliseconds to find one."""
    return Transformer.from_crs(source, target, always_xy=True)


@lru_cache
def parse_crs(text: str) -> CRS:
    """Parse a projected or geographic coordinate reference system, with or without a vertical one.

    Raises:
        ValueError: the text is none, or one that cannot be transformed to WGS 84, such as those of the Moon.
    """
    try:
        crs = CRS.from_user_input(text)
    except CRSError as error:
        raise ValueError(f"{text!r} is no coordinate reference system that PROJ knows") from error
    base = _base(crs)
    if not (base.is_projected or base.is_geographic) or base.geodetic_crs is None:
        raise ValueError(f"{text!r} ({crs.name}) is neither projected nor geographic")
    try:
        Transformer.from_crs(horizontal(crs), WGS84, always_xy=True)
    except ProjError as error:
        raise ValueError(f"{text!r} ({crs.name}) cannot be transformed to WGS 84") from error
    return crs


def near_longitude(degrees: _Degrees, reference: float) -> _Degrees:
    """Turn longitudes by whole circles to within 180 degrees of another, so that they continue across the date line."""
    circles: Any = np.rint((reference - degrees) / 360)
    return degrees + 360 * circles


def metres_per_degree(latitude_deg: float) -> tuple[float, float]:
    """Compute the length of a degree of longitude and of latitude on a sphere, within 0.7% of the ellipsoid's."""
    north = float(np.deg2rad(EARTH_RADIUS_M))
    return float(np.cos(np.deg2rad(latitude_deg))) * north, north


def utm_zone(longitude_deg: float, latitude_deg: float) -> str:
    """Return the UTM zone's number and hemisphere, such as "30N".

    pyproj's query_utm_crs_info does not know the wider zones of south-west Norway and Svalbard.
    """
    zone = int((longitude_deg + 180) // 6) % 60 + 1
    if 56 <= latitude_deg < 64 and 3 <= longitude_deg < 12:
        zone = 32
    if 72 <= latitude_deg < 84 and 0 <= longitude_deg < 42:
        zone = next(z for z, east in ((31, 9), (33, 21), (35, 33), (37, 42)) if longitude_deg < east)
    return f"{zone}{'N' if latitude_deg >= 0 else 'S'}"


def _utm(longitude_deg: float, latitude_deg: float, geographic: CRS) -> CRS:
    """Find the UTM system of a place, on the datum of a geographic system if it exists there, else on WGS 84."""
    zone = utm_zone(longitude_deg, latitude_deg)
    datum = _base(geographic).name
    code = (32600 if zone.endswith("N") else 32700) + int(zone[:-1])
    if datum != "WGS 84":
        own = (i.code for i in query_utm_crs_info(datum) if i.name == f"{datum} / UTM zone {zone}")
        code = next(own, code)
    return CRS.from_epsg(code)


def _name(crs: CRS) -> str:
    """Return the shortest exact name of a system: its EPSG code, or WKT."""
    # From a confidence of 70 of 100, PROJ calls two systems equivalent though their names may differ.
    code = None if crs.is_bound else crs.to_epsg(min_confidence=70)
    return crs.to_wkt() if code is None else f"EPSG:{code}"


def metric_system(crs: CRS, x: float, y: float) -> CRS:
    """Return the horizontal part of a system where its metres are those of the ground, else a UTM zone of its datum.

    Web Mercator is projected in metres, too, of which one is 0.6 m on the ground at 53 degrees; volumes and areas of
    such cells are not those of the ground.

    Args:
        x, y: the place in that system and its units, longitude or easting first.

    Raises:
        ProjError: the place is outside of what the system can hold.
    """
    own = horizontal(crs)
    longitude, latitude = Transformer.from_crs(own, WGS84, always_xy=True).transform(x, y, errcheck=True)
    if own.is_projected and in_metres(own):
        scale = Proj(_base(own)).get_factors(longitude, latitude)
        lengths = scale.tissot_semimajor, scale.tissot_semiminor
        if abs(scale.areal_scale - 1) < _TRUE_AREA and max(abs(k - 1) for k in lengths) < 2 * _TRUE_AREA:
            return own
    geodetic = own.geodetic_crs
    if geodetic is None:
        return _utm(longitude, latitude, CRS(WGS84))
    known = _utm(longitude, latitude, geodetic)
    meridian = geodetic.prime_meridian
    same = known.geodetic_crs is not None and known.geodetic_crs.name == geodetic.name
    # WGS 84 is metres from datums that move with a plate; a system bound to WGS 84 brings its own shift to it.
    if same or own.is_bound or meridian is None or meridian.longitude != 0:
        return known
    zone = utm_zone(longitude, latitude)
    name = f"{geodetic.name} / UTM zone {zone}"
    return CRS(ProjectedCRS(UTMConversion(zone[:-1], zone[-1]), name, geodetic_crs=geodetic.to_2d()).to_wkt())


def in_metres(crs: CRS) -> bool:
    """Return whether the first axis of a system counts metres."""
    return abs(crs.axis_info[0].unit_conversion_factor - 1) < 1e-9


def same_system(one: CRS, other: CRS) -> bool:
    """Return whether two systems have the same eastings and northings."""
    return horizontal(one).equals(horizontal(other), ignore_axis_order=True)


def is_local(crs: CRS) -> bool:
    """Whether a system is that of a scene without a georeference, as `tidefield map` states it."""
    return crs.type_name == "Engineering CRS"


def lost_in_conversion(crs: CRS, target: CRS) -> str | None:
    """What a conversion of plane coordinates lacks where PROJ has not the grid of the best one, which is metres then.

    Returns:
        The end of a sentence about what is converted; None if nothing is lost.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # which is what the sentence says
        group = TransformerGroup(horizontal(crs), horizontal(target), always_xy=True)
    if group.best_available or not group.transformers or not group.unavailable_operations:
        return None
    best, used = group.unavailable_operations[0], group.transformers[0]
    grids = [grid.short_name or grid.full_name for grid in best.grids if not grid.available]
    if not grids or not used.accuracy > max(_CENTIMETRES, best.accuracy):
        return None
    return (
        f"in {horizontal(crs).name} are converted to {horizontal(target).name} to {used.accuracy:g} m only, because "
        f"PROJ lacks {list_names(grids)}: install it (`projsync --file {grids[0]}`, or PROJ_NETWORK=ON)"
    )


def horizontal(crs: CRS) -> CRS:
    """Return a system without its heights."""
    return crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()


def _base(crs: CRS) -> CRS:
    """Return the horizontal system without a shift to WGS 84 that is bound to it."""
    own = horizontal(crs)
    return own.source_crs if own.is_bound and own.source_crs is not None else own


def _vertical_name(crs: CRS) -> str | None:
    if crs.is_compound:
        return crs.sub_crs_list[1].name
    return f"the ellipsoid of {crs.name}" if crs.is_geographic and len(crs.axis_info) == 3 else None


def name_in_metres(vertical: str) -> str:
    """Return the name of a vertical system's twin in metres, which those in feet have, such as NAVD88 height (ftUS)."""
    return _IN_FEET.sub("", vertical)


def vertical_datum_of(crs: CRS) -> str | None:
    """Return the name of the vertical datum of a system, or None where it defines none."""
    if crs.is_compound:
        vertical = crs.sub_crs_list[1]
        name = vertical.name if vertical.datum is None else vertical.datum.name
        return None if name.lower().startswith(_NAMELESS) else name
    geodetic = crs.geodetic_crs
    if geodetic is None or len(crs.axis_info) < 3 or crs.is_geocentric:
        return None
    if geodetic.name.lower().startswith(_NAMELESS):
        return None
    return f"the ellipsoid of {geodetic.to_2d().name}"


def has_unstated_unit(crs: CRS) -> bool:
    """Return whether heights may be in other units than metres: a projected system's are, and it defines no heights."""
    return _base(crs).is_projected and not in_metres(crs) and not crs.is_compound and len(crs.axis_info) < 3


def metres_per_height(crs: CRS) -> float:
    """Return the length of the unit of a system's heights; 1 where it defines none."""
    if crs.is_compound:
        return crs.sub_crs_list[1].axis_info[0].unit_conversion_factor
    return crs.axis_info[2].unit_conversion_factor if len(crs.axis_info) == 3 else 1.0
