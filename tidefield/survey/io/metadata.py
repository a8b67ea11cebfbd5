"""Read the metadata of a photograph file: EXIF, and the XMP in which drone makers write gimbal, receiver and lens."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree.ElementTree import Element, ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring
from PIL import ExifTags, Image

from tidefield.data.exif import Exif, as_number, read_exif
from tidefield.geometry.geodesy import metres_per_degree, near_longitude
from tidefield.survey.survey import Position, VerticalDatum

_XMP_TAG = 700
# https://www.easymanua.ls/dji/mavic-3m/manual?p=89: 0 no position, 16 single point, 32 to 49 float, 50 fixed.
_RTK_SINGLE, _RTK_FLOAT, _RTK_FIXED = 16, 32, 50
CORRECTED_M = 0.5
"""A position in EXIF that is farther from that in XMP was written after the flight, by PPK for example."""
ROUNDING_M = 0.015
"""What a drone writes into EXIF and into XMP differs by less: by 1 cm in brighton_beach and turin_lot."""
_LOWEST_M, _HIGHEST_M = -500.0, 9000.0  # the Dead Sea, and Mount Everest
_ROLLS_TO_THE_LEFT = ("sensefly",)
"""Makers that count the roll of a body the other way (opendm/photo.py of OpenDroneMap)."""

_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_PIX4D = "http://pix4d.com/camera/1.0"
# Packets of cameras have some kB and two levels; more is not metadata of a camera.
_MAX_XMP_BYTES = 1_000_000
_MAX_XMP_LEVELS = 4
_MAX_XMP_NAME = 200
_LISTS = tuple(f"{_RDF}{kind}/{_RDF}li" for kind in ("Bag", "Seq", "Alt"))


@dataclass(frozen=True)
class PhotographMetadata:
    """The metadata of one file.

    Attributes:
        exif: the EXIF tags.
        xmp: properties, named as `read_xmp` returns them.
        damaged: which of the blocks ("EXIF", "XMP") are present but cannot be read.
    """

    exif: Exif
    xmp: Mapping[str, str]
    damaged: tuple[str, ...] = ()

    def xmp_number(self, *names: str) -> float:
        """The first of these properties that is present, as a number; NaN where none is."""
        return next((as_number(self.xmp[name]) for name in names if name in self.xmp), math.nan)

    def xmp_numbers(self, name: str) -> tuple[float, ...]:
        """A property that lists numbers, separated by commas or spaces; empty where it is absent."""
        return tuple(as_number(part) for part in self.xmp.get(name, "").replace(",", " ").split())

    def text(self, tag: int, *names: str) -> str:
        """A text of EXIF, or else the first of these XMP properties; empty where there is none."""
        return self.exif.text(tag) or next((self.xmp[name] for name in names if name in self.xmp), "")

    @property
    def camera(self) -> str:
        """Make and model, such as "DJI FC6360"; empty if unknown."""
        make = self.text(ExifTags.Base.Make, "Make")
        model = self.text(ExifTags.Base.Model, "Model")
        return model if model.casefold().startswith(make.casefold()) else f"{make} {model}".strip()

    @property
    def serial(self) -> str:
        """Serial number of the camera's body, or else of the drone that carries it; empty if unknown."""
        return self.text(ExifTags.Base.BodySerialNumber, "CameraSerialNumber", "SerialNumber", "DroneSerialNumber")

    @property
    def orientation(self) -> int:
        """EXIF orientation; 1 where it is absent or none of the eight."""
        value = self.exif.number(ExifTags.Base.Orientation)
        return int(value) if value in range(1, 9) else 1

    @property
    def gimbal_deg(self) -> tuple[float, float, float] | None:
        """Yaw (clockwise from north), pitch (-90 looks straight down) and roll of the camera, or None."""
        for prefix, suffix in (("Gimbal", "Degree"), ("CameraOrientationNED/", "")):
            yaw, pitch, roll = (self.xmp_number(f"{prefix}{name}{suffix}") for name in ("Yaw", "Pitch", "Roll"))
            # Drones without a gimbal write three zeros.
            if math.isfinite(yaw + pitch + roll) and any((yaw, pitch, roll)):
                return yaw, pitch, roll
        # Pix4D's namespace has the angles of a body with the camera beneath it (as opendm/photo.py of OpenDroneMap also
        # has it). Some makers may not follow it, so no photograph is left out for its pitch alone.
        yaw, pitch, roll = (self.xmp_number(f"Camera:{name}") for name in ("Yaw", "Pitch", "Roll"))
        if self.text(ExifTags.Base.Make, "Make").casefold() in _ROLLS_TO_THE_LEFT:
            roll = -roll
        return gimbal_of_body(yaw, pitch, roll) if math.isfinite(yaw + pitch + roll) else None

    @property
    def correction_m(self) -> float:
        """How far EXIF's position is from the drone's own in XMP, in plan or in height; 0 where either is missing."""
        (latitude, longitude), own = self._degrees_of_exif, self._own_degrees
        if not math.isfinite(latitude + longitude):
            return 0.0
        east, north = metres_per_degree(latitude)
        turned = near_longitude(longitude, own[1]) - own[1]
        plan_m = math.hypot(north * (latitude - own[0]), east * turned)
        height_m, own_m = _exif_height_m(self), self.xmp_number("AbsoluteAltitude")
        up_m = abs(height_m - own_m) if _is_plausible(height_m, own_m) else 0.0
        return max(up_m, plan_m if math.isfinite(plan_m) else 0.0)

    @property
    def lacks_hemisphere(self) -> bool:
        """Whether EXIF has a latitude or a longitude, and does not say on which side of the Earth."""
        gps = self.exif.gps
        tags = ExifTags.GPS.GPSLatitudeRef, ExifTags.GPS.GPSLongitudeRef
        return any(gps.get(tag + 1) is not None and not _hemisphere(gps, tag) for tag in tags)

    @property
    def _degrees_of_exif(self) -> tuple[float, float]:
        return _degrees(self.exif.gps, 1, "S"), _degrees(self.exif.gps, 3, "W")

    @property
    def _own_degrees(self) -> tuple[float, float]:
        """Latitude and longitude of XMP."""
        # DJI's early firmware misspells the longitude.
        names = ("GpsLongitude", "GpsLongtitude", "GPSLongitude", "Longitude")
        return self.xmp_number("GpsLatitude", "GPSLatitude", "Latitude"), self.xmp_number(*names)

    def position(self, corrected: bool, of_exif: str = "EXIF") -> Position | None:
        """Position of the camera by its receiver, or None.

        The standard deviations are those of the maker (of the two horizontal ones of DJI's RTK, the larger; Pix4D's),
        or EXIF's positioning error.

        Args:
            corrected: whether EXIF's position was written after the flight; it is not the drone's own then.
            of_exif: the source's name where it is EXIF.
        """
        (latitude, longitude), source = self._degrees_of_exif, of_exif
        if not math.isfinite(latitude + longitude):
            (latitude, longitude), source, corrected = self._own_degrees, "XMP", False
        if not math.isfinite(latitude + longitude):
            return None
        # After a correction, the drone's own fix and its accuracy are of the past.
        rtk = math.nan if corrected else self.xmp_number("RtkFlag")
        if rtk >= _RTK_FLOAT:
            source += ", RTK fixed" if rtk == _RTK_FIXED else ", RTK float"
        accuracies_m = [
            (self.xmp_number("Camera:GPSXYAccuracy"), self.xmp_number("Camera:GPSZAccuracy")),
            (as_number(self.exif.gps.get(ExifTags.GPS.GPSHPositioningError)), math.nan),
        ]
        if rtk >= _RTK_SINGLE:
            sides = self.xmp_number("RtkStdLon"), self.xmp_number("RtkStdLat")
            accuracies_m.insert(0, (max(sides), self.xmp_number("RtkStdHgt")))
        horizontal_m, vertical_m = (
            next((value for value in values if value > 0), math.nan) for values in zip(*accuracies_m, strict=True)
        )
        height_m, datum = _height(self, rtk, corrected)
        return Position(latitude, longitude, height_m, horizontal_m, vertical_m, datum, source)


def gimbal_of_body(yaw_deg: float, pitch_deg: float, roll_deg: float) -> tuple[float, float, float]:
    """Convert the angles of a body, beneath which a camera looks straight down, to those of a gimbal.

    Args:
        yaw_deg: of the body, clockwise from north; the top of the photograph is ahead.
        pitch_deg: positive where its nose is up, so that the camera looks ahead.
        roll_deg: positive where its right side is down, so that the camera looks to the left.

    Returns:
        Yaw, pitch (-90 looks straight down) and roll of the camera, whose axes point as the body's would.
    """
    pitch, roll = math.radians(pitch_deg), math.radians(roll_deg)
    # Where the camera looks ahead and to the right of the body, and which way is down in its picture.
    turned = math.atan2(-math.sin(roll), math.sin(pitch) * math.cos(roll))
    tilt = math.atan2(math.cos(pitch) * math.sin(roll), math.sin(pitch))
    down = -math.asin(math.cos(pitch) * math.cos(roll))
    return yaw_deg + math.degrees(turned), math.degrees(down), math.degrees(tilt)


def read_metadata(image: Image.Image) -> PhotographMetadata:
    """Read EXIF and XMP of an opened photograph; a damaged block counts as absent and is reported as damaged."""
    exif, xmp = read_exif(image), {}
    damaged = ["EXIF"] if exif.damaged else []
    packet = image.info.get("xmp") or exif.tags.get(_XMP_TAG)
    if isinstance(packet, bytes | str):
        try:
            xmp = read_xmp(packet)
        except ValueError:
            damaged.append("XMP")
    return PhotographMetadata(exif, xmp, tuple(damaged))


def read_xmp(packet: bytes | str) -> dict[str, str]:
    """Read the properties of an XMP packet (ISO 16684-1).

    Names come without their namespace, because every maker has its own and uses the same names ("GimbalYawDegree").
    Only those of Pix4D's namespace, which are common words, are marked: "Camera:Yaw"; for this reason Pillow's
    `getxmp`, which drops all namespaces, does not serve. The parts of a structure come as "CameraOrientationNED/Yaw",
    the items of a list joined by commas.

    Raises:
        ValueError: the packet is not XML, has entities, or is too large to be trusted.
    """
    data = packet.encode() if isinstance(packet, str) else packet
    if len(data) > _MAX_XMP_BYTES:
        raise ValueError(f"it has {len(data)} bytes")
    data = data.strip(b"\0 \t\r\n")
    if not data:
        return {}
    try:
        root = fromstring(data)
    except (ParseError, DefusedXmlException, UnicodeError, LookupError) as error:
        raise ValueError(str(error)) from error
    found: dict[str, str] = {}
    for description in root.iter(f"{_RDF}Description"):
        _collect(description, "", _MAX_XMP_LEVELS, found)
    return found


def _collect(element: Element, prefix: str, levels: int, found: dict[str, str]) -> None:
    """Add the properties of an element, written as attributes or as children; the first of a name counts."""
    for tag, value in element.attrib.items():
        if not tag.startswith(_RDF):
            found.setdefault(prefix + _name(tag), value.strip())
    for child in element:
        if child.tag.startswith(_RDF):
            continue
        name = prefix + _name(child.tag)
        if len(name) > _MAX_XMP_NAME:
            continue
        # Not `child.iter`: descriptions in descriptions would be walked again for each of them.
        items = [item.text or "" for path in _LISTS for item in child.findall(path)]
        text = ",".join(items) if items else (child.text or "")
        if text.strip():
            found.setdefault(name, text.strip())
        if levels > 0:
            for structure in (child, *child.findall(f"{_RDF}Description")):
                _collect(structure, f"{name}/", levels - 1, found)


def _name(tag: str) -> str:
    namespace, _, name = tag.rpartition("}")
    return f"Camera:{name}" if namespace.lstrip("{").rstrip("/") == _PIX4D else name


def _degrees(gps: Mapping[int, object], reference_tag: int, negative: str) -> float:
    """A latitude or longitude of EXIF's GPS block; the tag of the value follows that of its reference (N, S, E, W).

    NaN without a reference: the value has no sign, and might be on the other side of the Earth.
    """
    value = gps.get(reference_tag + 1)
    parts = value if isinstance(value, tuple) else (value,)
    degrees = sum(as_number(part) / 60**power for power, part in enumerate(parts[:3]))
    letter = _hemisphere(gps, reference_tag)
    return math.nan if not letter else -degrees if letter == negative else degrees


def _hemisphere(gps: Mapping[int, object], reference_tag: int) -> str:
    """N, S, E or W; empty where EXIF does not say."""
    reference = gps.get(reference_tag, "")
    text = reference.decode("ascii", "replace") if isinstance(reference, bytes) else str(reference)
    return text.strip("\0 ").upper()[:1]


def _exif_height_m(metadata: PhotographMetadata) -> float:
    height_m = as_number(metadata.exif.gps.get(ExifTags.GPS.GPSAltitude))
    return -height_m if _height_reference(metadata) in (1, 3) else height_m


def _height_reference(metadata: PhotographMetadata) -> object:
    reference = metadata.exif.gps.get(ExifTags.GPS.GPSAltitudeRef)
    return reference[0] if isinstance(reference, bytes) and reference else reference


def _is_plausible(height_m: float, own_m: float) -> bool:
    """Whether a height of EXIF is one, and not the drone's own without its sign."""
    return _LOWEST_M < height_m < _HIGHEST_M and (own_m >= 0 or abs(height_m + own_m) > CORRECTED_M)


def _height(metadata: PhotographMetadata, rtk: float, corrected: bool) -> tuple[float, VerticalDatum]:
    """Height, and its vertical datum.

    DJI's RTK drones and those with "RtkAlt" write ellipsoidal heights whatever EXIF states; its others write that of a
    barometer in a standard atmosphere. EXIF up to 2.32 has sea level only (0 above, 1 below); EXIF 3.0 gave these
    numbers to the ellipsoid, and 2 and 3 to the sea level.

    Args:
        rtk: the state of the drone's receiver; NaN after a correction.
        corrected: whether EXIF has a later position than XMP.
    """
    reference, exif_m = _height_reference(metadata), _exif_height_m(metadata)
    # DJI's EXIF repeats it as an unsigned number, which turns a height below zero into millions of metres.
    height_m = metadata.xmp_number("AbsoluteAltitude")
    if not math.isfinite(height_m) or (corrected and _is_plausible(exif_m, height_m)):
        height_m = exif_m
    if rtk >= _RTK_FLOAT or (not corrected and "rtk" in metadata.xmp.get("AltitudeType", "").casefold()):
        return height_m, "ellipsoid"
    if "AbsoluteAltitude" in metadata.xmp or reference not in range(4):
        return height_m, "unknown"
    version = metadata.text(ExifTags.Base.ExifVersion)
    return height_m, "ellipsoid" if reference in (0, 1) and version >= "0300" else "mean sea level"
