"""What is known of a lens before any geometry: the maker's calibration, or EXIF's nominal focal length in pixels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from PIL import ExifTags

from tidefield.survey.io.metadata import Metadata, camera
from tidefield.survey.io.pictures import upright_rotation, upright_uv
from tidefield.survey.survey import LensPrior

# Of 35 mm film's frame of 36 x 24 mm. CIPA's guideline DCG-001 defines the equivalent by the angle over the diagonal,
# and makers keep to it: DJI's FC300S says 20 mm of a sensor of 6.16 x 4.62 mm and 3.61 mm, which is 20.3 by the
# diagonal and 21.1 by the width.
_FILM_DIAGONAL_MM = math.hypot(36, 24)

# Crop factors from which on sensors have another shape: full frame and APS-C 3:2, Four Thirds 4:3, one inch 3:2,
# smaller ones 4:3 (https://en.wikipedia.org/wiki/Image_sensor_format).
_SHAPES = ((1.75, 3 / 2), (2.4, 4 / 3), (3.2, 3 / 2), (math.inf, 4 / 3))

# Width in mm of 4:3 sensors whose 35 mm equivalent is rounded so coarsely that it is 2% off; from OpenSfM's
# opensfm/data/sensor_data.json (BSD-2-Clause).
_SENSOR_WIDTH_MM = {
    "DJI FC300S": 6.16,
    "DJI FC300C": 6.31,
    "DJI FC300X": 6.2,
    "DJI FC330": 6.25,
    "DJI FC350": 6.17,
    "DJI FC220": 6.17,
}
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # of EXIF's FocalPlaneResolutionUnit; inches unless it says so
_SENSOR_MM = (3.0, 60.0)  # longer side, from the smallest of cameras that fly to medium format
_FOCAL_IN_WIDTHS = (0.2, 30.0)


def lens_prior(metadata: Metadata, width: int, height: int, orientation: int) -> LensPrior | None:
    """The best that a file says of its lens, or None.

    In this order: the maker's calibration (DJI's dewarp data, Pix4D's namespace), DJI's design focal length, EXIF's
    focal length over a sensor of known width, its 35 mm equivalent, its focal plane resolution.

    Args:
        metadata: the file's tags.
        width, height: of the picture as it is stored, in pixels.
        orientation: EXIF's.
    """
    prior = (
        _dji_dewarp(metadata, width, height)
        or _pix4d(metadata, width, height)
        or _dji_design(metadata, width, height)
        or _known_sensor(metadata, width, height)
        or _film_equivalent(metadata, width, height)
        or _focal_plane(metadata, width, height)
    )
    smallest, largest = (side * max(width, height) for side in _FOCAL_IN_WIDTHS)
    if prior is None or not smallest < prior.focal_px < largest:
        return None
    design = _dji_design(metadata, width, height)
    if prior.trusted and design is not None:
        prior = replace(prior, design_focal_px=design.focal_px)
    return _stood_up(prior, width, height, orientation)


def _dji_dewarp(metadata: Metadata, width: int, height: int) -> LensPrior | None:
    """`date;fx,fy,cx,cy,k1,k2,p1,p2,k3` in pixels of the full picture, cx and cy from its centre
    (https://www.easymanua.ls/dji/mavic-3m/manual?p=90)."""
    numbers = metadata.xmp.get("DewarpData", "").rpartition(";")[2].split(",")
    try:
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = map(float, numbers)
    except ValueError:  # absent, or another maker's meaning
        return None
    if not (np.isfinite([fx, fy, cx, cy, k1, k2, p1, p2, k3]).all() and min(fx, fy) > 0):
        return None
    _, scale = _dji_reduction(metadata, width, height)
    focal_px = scale * (fx + fy) / 2
    if metadata.xmp.get("DewarpFlag") == "1":
        return LensPrior(focal_px, None, (0.0, 0.0, 0.0, 0.0, 0.0), "DJI dewarp data, dewarped photograph", True)
    principal_px = width / 2 + scale * cx, height / 2 + scale * cy
    return LensPrior(focal_px, principal_px, (k1, k2, p1, p2, k3), "DJI dewarp data", True)


def _dji_reduction(metadata: Metadata, width: int, height: int) -> tuple[float, float]:
    """Width of the picture that DJI's numbers are for, whose centre it states, and how much this one is reduced."""
    full_width = 2 * metadata.xmp_number("CalibratedOpticalCenterX")
    full_height = 2 * metadata.xmp_number("CalibratedOpticalCenterY")
    if not (full_width > 0 and full_height > 0):
        full_width, full_height = _size_of_original(metadata, width, height)
    return full_width, max(width / full_width, height / full_height)  # the larger, where one side is cut


def _size_of_original(metadata: Metadata, width: int, height: int) -> tuple[float, float]:
    """Size that the camera wrote, longer side where the picture has its longer one; programs that reduce pictures
    often leave EXIF as it was."""
    sides = metadata.number(ExifTags.Base.ExifImageWidth), metadata.number(ExifTags.Base.ExifImageHeight)
    shape = max(sides) / min(sides), max(width, height) / min(width, height)
    if not math.isclose(*shape, rel_tol=0.02):  # absent, or of a picture cut otherwise
        return float(width), float(height)
    return (max(sides), min(sides)) if width >= height else (min(sides), max(sides))


def _pix4d(metadata: Metadata, width: int, height: int) -> LensPrior | None:
    """Pix4D's namespace (https://support.pix4d.com/hc/en-us/articles/360016450032): lengths in mm unless it says
    pixels, distortion R1, R2, R3, T1, T2, which are OpenCV's k1, k2, k3, p1, p2."""
    focal = metadata.xmp_number("Camera:PerspectiveFocalLength")
    if not focal > 0 or metadata.xmp.get("Camera:ModelType", "perspective").casefold() != "perspective":
        return None
    if metadata.xmp.get("Camera:PerspectiveFocalLengthUnits", "mm").casefold().startswith("pix"):
        px_per_unit = max(width, height) / max(_size_of_original(metadata, width, height))
    else:
        px_per_unit = max(width, height) / _sensor_mm(metadata, width, height)
    if not px_per_unit > 0:
        return None
    principal = metadata.xmp_numbers("Camera:PrincipalPoint")
    distortion = metadata.xmp_numbers("Camera:PerspectiveDistortion")
    principal_px = distortion_cv = None
    if len(principal) == 2 and np.isfinite(principal).all():
        principal_px = principal[0] * px_per_unit, principal[1] * px_per_unit
        inside = 0 < principal_px[0] < width and 0 < principal_px[1] < height
        principal_px = principal_px if inside else None
    if len(distortion) == 5 and np.isfinite(distortion).all():
        k1, k2, k3, p1, p2 = distortion
        distortion_cv = k1, k2, p1, p2, k3
    return LensPrior(focal * px_per_unit, principal_px, distortion_cv, "XMP perspective focal length", True)


def _dji_design(metadata: Metadata, width: int, height: int) -> LensPrior | None:
    """CalibratedFocalLength, which DJI's manuals call the lens's design; some old drones write metres there."""
    focal = metadata.xmp_number("CalibratedFocalLength")
    full_width, scale = _dji_reduction(metadata, width, height)
    if not focal > _FOCAL_IN_WIDTHS[0] * full_width:
        return None
    return LensPrior(focal * scale, None, None, "DJI design focal length", False)


def _known_sensor(metadata: Metadata, width: int, height: int) -> LensPrior | None:
    sensor_mm = _SENSOR_WIDTH_MM.get(camera(metadata))
    focal_mm = metadata.number(ExifTags.Base.FocalLength)
    if sensor_mm is None or not focal_mm > 0:
        return None
    across = _uncut(width, height, 4 / 3)[0]
    return LensPrior(focal_mm / sensor_mm * across, None, None, "EXIF focal length and the sensor's width", False)


def _film_equivalent(metadata: Metadata, width: int, height: int) -> LensPrior | None:
    """EXIF's 35 mm equivalent, which is for the whole sensor, also where the picture is cut out of it."""
    equivalent_mm = metadata.number(ExifTags.Base.FocalLengthIn35mmFilm)
    if not equivalent_mm > 0:
        return None
    crop = equivalent_mm / metadata.number(ExifTags.Base.FocalLength)
    across, up = width, height
    if crop > 0:
        across, up = _uncut(width, height, next(shape for limit, shape in _SHAPES if crop < limit))
    focal_px = equivalent_mm / _FILM_DIAGONAL_MM * math.hypot(across, up)
    return LensPrior(focal_px, None, None, "EXIF 35 mm equivalent", False)


def _uncut(width: int, height: int, shape: float) -> tuple[float, float]:
    """Sides in pixels, longer first, of the sensor of which a picture shows the full width or the full height.

    Wider pictures (16:9) are cut above and below, narrower ones left and right, but for those of 5:4: there are
    sensors of that shape.
    """
    across, up = float(max(width, height)), float(min(width, height))
    if across / up > shape:
        return across, across / shape
    return (across, up) if abs(across / up - 5 / 4) < 0.03 else (up * shape, up)


def _focal_plane(metadata: Metadata, width: int, height: int) -> LensPrior | None:
    focal_px = metadata.number(ExifTags.Base.FocalLength) / _sensor_mm(metadata, width, height) * max(width, height)
    return LensPrior(focal_px, None, None, "EXIF focal plane resolution", False) if focal_px > 0 else None


def _sensor_mm(metadata: Metadata, width: int, height: int) -> float:
    """Longer side of the sensor by EXIF's focal plane resolution; NaN where that is absent or makes no sensor.

    The resolution is for the picture as the camera wrote it. Where a program has reduced the picture and all of EXIF's
    sizes but the resolution, the sensor comes out too small; far too small is refused here.
    """
    per_unit = metadata.number(ExifTags.Base.FocalPlaneXResolution)
    unit = metadata.number(ExifTags.Base.FocalPlaneResolutionUnit)
    unit_mm = _MM_PER_UNIT.get(int(unit) if unit > 0 else 2, math.nan)
    sensor_mm = max(_size_of_original(metadata, width, height)) / per_unit * unit_mm
    return sensor_mm if _SENSOR_MM[0] <= sensor_mm <= _SENSOR_MM[1] else math.nan


def _stood_up(prior: LensPrior, width: int, height: int, orientation: int) -> LensPrior:
    """A prior of the stored picture, for the upright one."""
    principal_px, distortion = prior.principal_px, prior.distortion
    if principal_px is not None:
        principal_px = upright_uv(principal_px, width, height, orientation)
    if distortion is not None:
        k1, k2, p1, p2, k3 = distortion
        # The tangential part is r^2 q + 2 x (q . x) with q = (p2, p1), which turns as a vector does.
        p2, p1 = (float(part) for part in upright_rotation(orientation) @ (p2, p1))
        distortion = k1, k2, p1, p2, k3
    return replace(prior, principal_px=principal_px, distortion=distortion)
