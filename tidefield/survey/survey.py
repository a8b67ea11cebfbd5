"""Inputs of a survey: photographs with their metadata, and ground control.

The `repr` of Position, LensPrior and Control is part of the keys in `stages.json`: renaming a class or a field makes
scenes that were prepared earlier start again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Progress = Callable[[int, int], object]
"""Called with (done, of how many)."""
VerticalDatum = Literal["mean sea level", "ellipsoid", "unknown"]


@dataclass(frozen=True)
class Position:
    """Position of a camera from its GPS receiver (WGS 84).

    Attributes:
        latitude_deg, longitude_deg: geographic coordinates.
        height_m: altitude above `datum`; NaN if unknown.
        horizontal_m, vertical_m: standard deviations that the receiver states (RTK); NaN if it states none.
        datum: vertical one of the height. EXIF states mean sea level or nothing; makers differ.
        source: where the position was read, such as "EXIF" or "gps.csv".
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    horizontal_m: float
    vertical_m: float
    datum: VerticalDatum
    source: str


@dataclass(frozen=True)
class LensPrior:
    """Calibration of a lens from the file or its maker, for the upright photograph at full size.

    Attributes:
        focal_px: focal length.
        principal_px: principal point, if the maker calibrated it; pixel corners are integers (the first pixel's centre
            is at 0.5, 0.5).
        distortion: OpenCV's (k1, k2, p1, p2, k3), if the maker calibrated it.
        source: such as "DJI dewarp data", "EXIF 35 mm equivalent", "EXIF focal plane resolution".
        trusted: whether the maker calibrated it; EXIF's focal length is nominal, accurate to some percent.
        design_focal_px: focal length of the lens's design, if the maker states it too.
    """

    focal_px: float
    principal_px: tuple[float, float] | None
    distortion: tuple[float, float, float, float, float] | None
    source: str
    trusted: bool
    design_focal_px: float | None = None


@dataclass(frozen=True)
class Photograph:
    """One photograph of a survey, undecoded.

    Attributes:
        path: the file.
        name: its path relative to the survey's folder, with forward slashes; unique. Ends in .jpg for HEIC files.
        width, height: pixels of the upright photograph.
        orientation: EXIF's, 1 to 8; 1 is stored upright.
        camera: make and model; empty if unknown. Photographs of one camera, size and focal length share a lens.
        serial: serial number of the camera; empty if unknown.
        focal_mm: nominal focal length, which differs between zoom settings; NaN if unknown.
        lens: prior of the lens, or None.
        time_s: seconds since 1970 by the camera's clock; NaN if unknown.
        position: of the camera, or None.
        relative_altitude_m: height above take-off; NaN if unknown.
        gimbal_deg: yaw (clockwise from north), pitch (-90 looks straight down), roll of the camera, or None.
        mask: a picture of the upright photograph's size that is black where the photograph is not to be used, or None.
        has_alpha: whether the file may have transparent pixels, which are not to be used either.
        gimbal_is_given: whether the angles are those of a file of positions, not the photograph's own.
    """

    path: Path
    name: str
    width: int
    height: int
    orientation: int
    camera: str
    serial: str
    focal_mm: float
    lens: LensPrior | None
    time_s: float
    position: Position | None
    relative_altitude_m: float
    gimbal_deg: tuple[float, float, float] | None
    mask: Path | None = None
    has_alpha: bool = False
    gimbal_is_given: bool = False


@dataclass(frozen=True)
class Mark:
    """Image position of a control point in a photograph.

    Attributes:
        point: name of the control point.
        photograph: `Photograph.name`.
        uv_px: pixel in the upright photograph at full size; the first pixel's centre is at (0.5, 0.5).
    """

    point: str
    photograph: str
    uv_px: tuple[float, float]


@dataclass(frozen=True)
class Control:
    """Ground control points.

    Attributes:
        crs: their coordinate reference system, as pyproj understands it ("EPSG:27700", a proj4 string).
        points: by name, (easting or x, northing or y, height) in that system, in float64; for a geographic system
            (longitude, latitude, height).
        marks: their image positions.
    """

    crs: str
    points: dict[str, tuple[float, float, float]]
    marks: tuple[Mark, ...]

    def fitted(self) -> Control | None:
        """The points that a model is fitted to: all but check points; None if there are none."""
        return self._of({name for name in self.points if not is_check_point(name)})

    def checks(self) -> Control | None:
        """The check points; None if there are none."""
        return self._of({name for name in self.points if is_check_point(name)})

    def _of(self, names: set[str]) -> Control | None:
        points = {name: xyz for name, xyz in self.points.items() if name in names}
        marks = tuple(mark for mark in self.marks if mark.point in names)
        return Control(self.crs, points, marks) if points else None


CHECK_PREFIX = "CHK"
"""Begins the names of check points, in any case."""
CHECK_FILE = "check_points.txt"
"""Check points of a scene, in its folder: a file like gcp_list.txt."""


def is_check_point(name: str) -> bool:
    """Whether a surveyed point is kept out of the adjustment, by its name."""
    return name.upper().startswith(CHECK_PREFIX)


@dataclass(frozen=True)
class Survey:
    """All inputs.

    Attributes:
        folder: of the photographs.
        photographs: sorted by name.
        control: ground control, or None.
        control_was_found: next to the photographs, and not asked for: if it does not fit, there is none.
        remarks: what was skipped or is doubtful, one sentence each, for the report.
    """

    folder: Path
    photographs: tuple[Photograph, ...]
    control: Control | None
    remarks: tuple[str, ...] = ()
    control_was_found: bool = False
