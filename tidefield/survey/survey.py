"""What a surveyor brings: photographs with what their files say of them, and ground control."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Position:
    """Where a camera was, as its receiver says (WGS 84).

    Attributes:
        latitude_deg, longitude_deg: geographic coordinates.
        height_m: altitude, NaN where unknown; above `datum`.
        horizontal_m, vertical_m: standard deviations that the receiver states (RTK); NaN where it states none.
        datum: what the height counts from. EXIF says mean sea level or nothing; makers differ.
        source: where this was read, such as "EXIF" or "gps.csv".
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    horizontal_m: float
    vertical_m: float
    datum: Literal["mean sea level", "ellipsoid", "unknown"]
    source: str


@dataclass(frozen=True)
class LensPrior:
    """What the file or the maker says of the lens, for the upright photograph at its own size.

    Attributes:
        focal_px: focal length.
        principal_px: principal point, if the maker calibrated it; pixel corners are integers (the first pixel's centre
            is at 0.5, 0.5).
        distortion: OpenCV's (k1, k2, p1, p2, k3), if the maker calibrated it.
        source: such as "DJI dewarp data", "EXIF 35 mm equivalent", "EXIF focal plane resolution".
        trusted: whether a maker calibrated it; EXIF's focal length is nominal, good to some percent.
        design_focal_px: focal length of the lens's design, where the maker states it besides.
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
        name: its path relative to the survey's folder, with forward slashes; unique.
        width, height: pixels once it stands upright.
        orientation: EXIF's, 1 to 8; 1 stands upright as stored.
        camera: make and model; empty if unknown. Photographs of one camera, size and focal length share a lens.
        serial: of the camera's body; empty if unknown.
        focal_mm: nominal focal length, which tells zoom settings apart; NaN if unknown.
        lens: what is known of the lens beforehand, or None.
        time_s: when it was taken, seconds since 1970 by the camera's clock; NaN if unknown.
        log_exposure: natural log of exposure time x ISO / f-number squared; NaN if unknown.
        position: where, or None.
        relative_altitude_m: above the place of take-off; NaN if unknown.
        gimbal_deg: yaw (clockwise from north), pitch (-90 looks straight down), roll of the camera, or None.
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
    log_exposure: float
    position: Position | None
    relative_altitude_m: float
    gimbal_deg: tuple[float, float, float] | None


@dataclass(frozen=True)
class Mark:
    """Where a control point shows in a photograph.

    Attributes:
        point: name of the control point.
        photograph: `Photograph.name`.
        uv_px: pixel in the upright photograph at its own size; the first pixel's centre is at (0.5, 0.5).
    """

    point: str
    photograph: str
    uv_px: tuple[float, float]


@dataclass(frozen=True)
class Control:
    """Surveyed ground points.

    Attributes:
        crs: their coordinate reference system, as pyproj understands it ("EPSG:27700", a proj4 string).
        points: by name, (easting or x, northing or y, height) in that system, in float64; for a geographic system
            (longitude, latitude, height).
        marks: where they show.
    """

    crs: str
    points: dict[str, tuple[float, float, float]]
    marks: tuple[Mark, ...]


@dataclass(frozen=True)
class Survey:
    """Everything that was read.

    Attributes:
        folder: where the photographs are.
        photographs: sorted by name.
        control: ground control, if there is any.
        remarks: what was left out or doubted while reading, one sentence each, for the report.
    """

    folder: Path
    photographs: tuple[Photograph, ...]
    control: Control | None
    remarks: tuple[str, ...] = ()
