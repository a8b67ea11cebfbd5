"""What a photograph's file says beside its pixels: EXIF and XMP as numbers with units."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from PIL import ExifTags, Image, PngImagePlugin

from tidefield.survey.io.xmp import read_xmp
from tidefield.survey.survey import Position

_XMP_TAG = 700
# https://www.easymanua.ls/dji/mavic-3m/manual?p=89: 0 no position, 16 single point, 32 to 49 float, 50 fixed.
_RTK_SINGLE, _RTK_FLOAT, _RTK_FIXED = 16, 32, 50
# Pix4D's namespace counts a camera's pitch from straight down, the others from the horizon (as opendm/photo.py of
# OpenDroneMap has it, too). Some makers may not keep to it, so nothing is left out for a pitch alone.
_NADIR_FROM_HORIZON_DEG = -90.0


@dataclass(frozen=True)
class Metadata:
    """The tags of one file.

    Attributes:
        exif: EXIF's tags, those of the picture and those of its Exif block together.
        gps: EXIF's GPS block.
        xmp: properties, named as `read_xmp` has it.
        damaged: which of the blocks ("EXIF", "XMP") are there but cannot be read.
    """

    exif: Mapping[int, object]
    gps: Mapping[int, object]
    xmp: Mapping[str, str]
    damaged: tuple[str, ...] = ()

    def number(self, tag: int) -> float:
        """A positive number of EXIF; NaN where it is absent or none."""
        value = as_number(self.exif.get(tag))
        return value if value > 0 else math.nan

    def xmp_number(self, *names: str) -> float:
        """The first of these properties that is there, as a number; NaN where none is."""
        return next((as_number(self.xmp[name]) for name in names if name in self.xmp), math.nan)

    def xmp_numbers(self, name: str) -> tuple[float, ...]:
        """A property that lists numbers with commas or spaces between; empty where it is absent."""
        return tuple(as_number(part) for part in self.xmp.get(name, "").replace(",", " ").split())

    def text(self, tag: int, *names: str) -> str:
        """A text of EXIF, or else the first of these XMP properties; empty where there is none."""
        value = self.exif.get(tag, "")
        text = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value)
        text = text.partition("\0")[0].strip()
        return text or next((self.xmp[name] for name in names if name in self.xmp), "")


def as_number(value: object) -> float:
    """A number of EXIF or XMP ("+39.8", "527/100", the first of several); NaN for anything else."""
    if isinstance(value, tuple):
        value = value[0] if value else None
    if isinstance(value, str) and value.count("/") == 1:
        above, below = (as_number(part) for part in value.split("/"))
        return above / below if below else math.nan
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return math.nan
    return number if math.isfinite(number) else math.nan


def read_metadata(picture: Image.Image) -> Metadata:
    """EXIF and XMP of an opened photograph; a damaged block counts as absent and is named."""
    damaged = []
    exif: dict[int, object] = {}
    gps: dict[int, object] = {}
    # Of a PNG without EXIF before its pixels, Pillow would decode the pixels to look behind them.
    if not isinstance(picture, PngImagePlugin.PngImageFile) or "exif" in picture.info:
        try:
            table = picture.getexif()
            exif = {**table, **table.get_ifd(ExifTags.IFD.Exif)}
            gps = dict(table.get_ifd(ExifTags.IFD.GPSInfo))
        except (OSError, SyntaxError, ValueError, KeyError, TypeError, IndexError, struct.error):
            damaged.append("EXIF")
    xmp = {}
    packet = picture.info.get("xmp") or exif.get(_XMP_TAG)
    if isinstance(packet, bytes | str):
        try:
            xmp = read_xmp(packet)
        except ValueError:
            damaged.append("XMP")
    return Metadata(exif, gps, xmp, tuple(damaged))


def camera(metadata: Metadata) -> str:
    """Make and model, such as "DJI FC6360"; empty if unknown."""
    make = metadata.text(ExifTags.Base.Make, "Make")
    model = metadata.text(ExifTags.Base.Model, "Model")
    return model if model.casefold().startswith(make.casefold()) else f"{make} {model}".strip()


def serial(metadata: Metadata) -> str:
    """Serial number of the camera's body, or else of the drone that carries it; empty if unknown."""
    return metadata.text(ExifTags.Base.BodySerialNumber, "CameraSerialNumber", "SerialNumber", "DroneSerialNumber")


def orientation(metadata: Metadata) -> int:
    """EXIF's orientation; 1 where it is absent or none of the eight."""
    value = metadata.number(ExifTags.Base.Orientation)
    return int(value) if value in range(1, 9) else 1


def time_s(metadata: Metadata) -> float:
    """When it was taken, in seconds since 1970 by the camera's clock, with EXIF's fraction; NaN if unknown."""
    for tag in (ExifTags.Base.DateTimeOriginal, ExifTags.Base.DateTimeDigitized, ExifTags.Base.DateTime):
        try:
            moment = datetime.strptime(metadata.text(tag), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
        except ValueError:  # absent, or zeros from a clock that was never set
            continue
        fraction = metadata.text(ExifTags.Base.SubsecTimeOriginal)
        return moment.timestamp() + (float(f"0.{fraction}") if fraction.isascii() and fraction.isdigit() else 0.0)
    return math.nan


def log_exposure(metadata: Metadata) -> float:
    """Natural log of exposure time x ISO / f-number squared; NaN unless all three are known."""
    seconds = metadata.number(ExifTags.Base.ExposureTime)
    speed = metadata.number(ExifTags.Base.ISOSpeedRatings)
    return math.log(seconds * speed / metadata.number(ExifTags.Base.FNumber) ** 2)


def gimbal_deg(metadata: Metadata) -> tuple[float, float, float] | None:
    """Yaw (clockwise from north), pitch (-90 looks straight down) and roll of the camera, or None."""
    for names in (
        ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"),
        ("CameraOrientationNED/Yaw", "CameraOrientationNED/Pitch", "CameraOrientationNED/Roll"),
    ):
        yaw, pitch, roll = (metadata.xmp_number(name) for name in names)
        # All three exactly zero is what drones without a gimbal write.
        if math.isfinite(yaw + pitch + roll) and any((yaw, pitch, roll)):
            return yaw, pitch, roll
    yaw, pitch, roll = (metadata.xmp_number(f"Camera:{name}") for name in ("Yaw", "Pitch", "Roll"))
    return (yaw, pitch + _NADIR_FROM_HORIZON_DEG, roll) if math.isfinite(yaw + pitch + roll) else None


def relative_altitude_m(metadata: Metadata) -> float:
    """Height above the place of take-off; NaN if unknown."""
    return metadata.xmp_number("RelativeAltitude", "Camera:AboveGroundAltitude")


def position(metadata: Metadata) -> Position | None:
    """Where the receiver says that the camera was, or None.

    The standard deviations are the maker's (DJI's RTK, of whose two horizontal ones the larger is taken; Pix4D's), or
    EXIF's positioning error.
    """
    latitude, longitude = _degrees(metadata.gps, 1, "S"), _degrees(metadata.gps, 3, "W")
    source = "EXIF"
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        latitude = metadata.xmp_number("GpsLatitude", "GPSLatitude", "Latitude")
        # DJI's early firmware has the longitude misspelt.
        longitude = metadata.xmp_number("GpsLongitude", "GpsLongtitude", "GPSLongitude", "Longitude")
        source = "XMP"
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        return None
    rtk = metadata.xmp_number("RtkFlag")
    horizontal_m, vertical_m = _accuracy_m(metadata, rtk)
    if rtk >= _RTK_FLOAT:
        source += ", RTK fixed" if rtk == _RTK_FIXED else ", RTK float"
    return Position(latitude, longitude, _height_m(metadata), horizontal_m, vertical_m, _datum(metadata, rtk), source)


def _degrees(gps: Mapping[int, object], reference_tag: int, negative: str) -> float:
    """A latitude or longitude of EXIF's GPS block, whose value follows its reference."""
    value = gps.get(reference_tag + 1)
    parts = value if isinstance(value, tuple) else (value,)
    degrees = sum(as_number(part) / 60**power for power, part in enumerate(parts[:3]))
    reference = gps.get(reference_tag, "")
    reference = reference.decode("ascii", "replace") if isinstance(reference, bytes) else str(reference)
    return -degrees if reference.strip("\0 ").upper().startswith(negative) else degrees


def _height_m(metadata: Metadata) -> float:
    # DJI's EXIF repeats it, but in an unsigned number, which a height under zero turns to millions of metres.
    height = metadata.xmp_number("AbsoluteAltitude")
    if math.isfinite(height):
        return height
    height = as_number(metadata.gps.get(ExifTags.GPS.GPSAltitude))
    return -height if _altitude_reference(metadata) in (1, 3) else height


def _altitude_reference(metadata: Metadata) -> int | None:
    value = metadata.gps.get(ExifTags.GPS.GPSAltitudeRef)
    if isinstance(value, bytes):
        return value[0] if value else None
    return value if isinstance(value, int) else None


def _datum(metadata: Metadata, rtk: float) -> Literal["mean sea level", "ellipsoid", "unknown"]:
    """What the height counts from.

    DJI's RTK drones and those that say "RtkAlt" write ellipsoidal heights whatever EXIF says; its others write a
    barometer's, at a standard atmosphere. EXIF up to 2.32 knows sea level only (0 above, 1 below); EXIF 3.0 gave these
    numbers to the ellipsoid, and 2 and 3 to the sea level.
    """
    if rtk >= _RTK_FLOAT or "rtk" in metadata.xmp.get("AltitudeType", "").casefold():
        return "ellipsoid"
    reference = _altitude_reference(metadata)
    if "AbsoluteAltitude" in metadata.xmp or reference not in range(4):
        return "unknown"
    version = metadata.text(ExifTags.Base.ExifVersion)
    return "ellipsoid" if reference in (0, 1) and version >= "0300" else "mean sea level"


def _accuracy_m(metadata: Metadata, rtk: float) -> tuple[float, float]:
    """Horizontal and vertical standard deviation; NaN where none is stated."""
    stated = [math.nan, math.nan]
    if rtk >= _RTK_SINGLE:
        sides = [metadata.xmp_number("RtkStdLon"), metadata.xmp_number("RtkStdLat")]
        stated = [max(sides), metadata.xmp_number("RtkStdHgt")]
    others = (
        (metadata.xmp_number("Camera:GPSXYAccuracy"), metadata.xmp_number("Camera:GPSZAccuracy")),
        (as_number(metadata.gps.get(ExifTags.GPS.GPSHPositioningError)), math.nan),
    )
    for pair in others:
        stated = [a if a > 0 else b for a, b in zip(stated, pair, strict=True)]
    return tuple(a if a > 0 else math.nan for a in stated)  # pyright: ignore[reportReturnType]
