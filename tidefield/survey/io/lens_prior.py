"""Derive a lens prior from metadata: the maker's calibration, or EXIF's nominal focal length in pixels."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from PIL import ExifTags

from tidefield.survey.io.image_decoding import upright_rotation, upright_uv
from tidefield.survey.io.metadata import PhotographMetadata
from tidefield.survey.io.text_files import leading_numbers
from tidefield.survey.survey import LensPrior

# Diagonal of the 36 x 24 mm frame of 35 mm film. CIPA's guideline DCG-001 defines the equivalent by the angle over the
# diagonal, and makers follow it: DJI's FC300S states 20 mm for a sensor of 6.16 x 4.62 mm and a lens of 3.61 mm, which
# is 20.3 by the diagonal and 21.1 by the width.
_FILM_DIAGONAL_MM = math.hypot(36, 24)

# Aspect ratio of sensors by the upper limit of their crop factor: full frame and APS-C 3:2, Four Thirds 4:3,
# one inch 3:2, smaller ones 4:3 (https://en.wikipedia.org/wiki/Image_sensor_format).
_SHAPES = ((1.75, 3 / 2), (2.4, 4 / 3), (3.2, 3 / 2), (math.inf, 4 / 3))
_MEDIUM_FORMAT = 0.9
"""Crop factor below which sensors are of either shape, and photographs are taken to show all of them."""

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
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # of EXIF's FocalPlaneResolutionUnit; inches where it is absent
_SENSOR_MM = (3.0, 60.0)  # longer side, from the smallest of cameras that fly to medium format
_FOCAL_IN_WIDTHS = (0.2, 30.0)
_MAX_DISTORTION = 100.0  # of any term; those of real lenses are below ten


def lens_prior(metadata: PhotographMetadata, width: int, height: int, orientation: int) -> LensPrior | None:
    """Derive the best lens prior that a file's metadata allow, or None.

    In order of preference: the maker's calibration (DJI's dewarp data, Pix4D's namespace), DJI's design focal length,
    EXIF's focal length over a sensor of known width, its 35 mm equivalent, its focal plane resolution, and the crop
    factor that lensfun's database has of the camera (the extra `lensfun`).

    Args:
        width, height: size of the image as stored, in pixels.
        orientation: EXIF orientation.
    """
    design_px = _dji_design_px(metadata, width, height)
    prior = _dji_dewarp(metadata, width, height) or _pix4d(metadata, width, height)
    if prior is None:
        nominal = {
            "DJI design focal length": design_px,
            "EXIF focal length and the sensor's width": _sensor_table_px(metadata, width, height),
            "EXIF 35 mm equivalent": _film_equivalent_px(metadata, width, height),
            "EXIF focal plane resolution": (
                metadata.exif.number(ExifTags.Base.FocalLength)
                / _sensor_mm(metadata, width, height)
                * max(width, height)
            ),
        }
        if not any(px > 0 for px in nominal.values()):
            nominal["EXIF focal length and lensfun's crop factor"] = _lensfun_px(metadata, width, height)
        prior = next((LensPrior(px, None, None, source, False) for source, px in nominal.items() if px > 0), None)
    smallest, largest = (side * max(width, height) for side in _FOCAL_IN_WIDTHS)
    if prior is None or not smallest < prior.focal_px < largest:
        return None
    if prior.trusted and design_px > 0:
        prior = replace(prior, design_focal_px=design_px)
    if prior.distortion and max(map(abs, prior.distortion)) > _MAX_DISTORTION:
        prior = replace(prior, distortion=None)
    # From the stored image to the upright one.
    principal_px, distortion = prior.principal_px, prior.distortion
    if principal_px is not None:
        principal_px = upright_uv(principal_px, width, height, orientation)
    if distortion is not None:
        k1, k2, p1, p2, k3 = distortion
        # The tangential part is r^2 q + 2 x (q . x) with q = (p2, p1), which rotates like a vector.
        p2, p1 = (float(part) for part in upright_rotation(orientation) @ (p2, p1))
        distortion = k1, k2, p1, p2, k3
    return replace(prior, principal_px=principal_px, distortion=distortion)


def _dji_dewarp(metadata: PhotographMetadata, width: int, height: int) -> LensPrior | None:
    """`date;fx,fy,cx,cy,k1,k2,p1,p2,k3` in pixels of the full image, cx and cy from its centre
    (https://www.easymanua.ls/dji/mavic-3m/manual?p=90)."""
    numbers = leading_numbers(metadata.xmp.get("DewarpData", "").rpartition(";")[2].split(","))
    if len(numbers) != 9 or not np.isfinite(numbers).all() or min(numbers[:2]) <= 0:  # absent, or of another format
        return None
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers
    _, scale = _dji_reduction(metadata, width, height)
    focal_px = scale * (fx + fy) / 2
    if metadata.xmp.get("DewarpFlag") == "1":
        return LensPrior(focal_px, None, (0.0, 0.0, 0.0, 0.0, 0.0), "DJI dewarp data, dewarped photograph", True)
    principal_px = width / 2 + scale * cx, height / 2 + scale * cy
    return LensPrior(focal_px, principal_px, (k1, k2, p1, p2, k3), "DJI dewarp data", True)


def _dji_reduction(metadata: PhotographMetadata, width: int, height: int) -> tuple[float, float]:
    """Width of the image to which DJI's numbers refer (it states its centre), and the scale of this one to it."""
    full_width = 2 * metadata.xmp_number("CalibratedOpticalCenterX")
    full_height = 2 * metadata.xmp_number("CalibratedOpticalCenterY")
    if not (full_width > 0 and full_height > 0):
        full_width, full_height = _size_of_original(metadata, width, height)
    return full_width, max(width / full_width, height / full_height)  # the larger, where one side is cropped


def _size_of_original(metadata: PhotographMetadata, width: int, height: int) -> tuple[float, float]:
    """Size that the camera wrote, in the orientation of this image; programs that reduce images often leave EXIF as it
    was."""
    sides = metadata.exif.number(ExifTags.Base.ExifImageWidth), metadata.exif.number(ExifTags.Base.ExifImageHeight)
    shape = max(sides) / min(sides), max(width, height) / min(width, height)
    if not math.isclose(*shape, rel_tol=0.02):  # absent, or of an image with another crop
        return float(width), float(height)
    return (max(sides), min(sides)) if width >= height else (min(sides), max(sides))


def _pix4d(metadata: PhotographMetadata, width: int, height: int) -> LensPrior | None:
    """Pix4D's namespace (https://support.pix4d.com/hc/en-us/articles/360016450032): lengths in mm unless it states
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


def _dji_design_px(metadata: PhotographMetadata, width: int, height: int) -> float:
    """CalibratedFocalLength, which DJI's manuals call the design focal length; NaN if absent, or in metres as of old
    drones."""
    focal = metadata.xmp_number("CalibratedFocalLength")
    full_width, scale = _dji_reduction(metadata, width, height)
    return focal * scale if focal > _FOCAL_IN_WIDTHS[0] * full_width else math.nan


def _sensor_table_px(metadata: PhotographMetadata, width: int, height: int) -> float:
    """EXIF's focal length over a sensor of known width; NaN if one of them is unknown."""
    sensor_mm = _SENSOR_WIDTH_MM.get(metadata.camera, math.nan)
    return metadata.exif.number(ExifTags.Base.FocalLength) / sensor_mm * _uncropped_px(width, height, 4 / 3)[0]


def _film_equivalent_px(metadata: PhotographMetadata, width: int, height: int) -> float:
    """EXIF's 35 mm equivalent, which is for the whole sensor, also where the image is a crop of it; NaN if absent."""
    equivalent_mm = metadata.exif.number(ExifTags.Base.FocalLengthIn35mmFilm)
    return _equivalent_px(equivalent_mm, equivalent_mm / metadata.exif.number(ExifTags.Base.FocalLength), width, height)


def _lensfun_px(metadata: PhotographMetadata, width: int, height: int) -> float:
    """EXIF's focal length times the crop factor of the camera's sensor; NaN if one of them is unknown."""
    crop = _crop_factor(metadata.text(ExifTags.Base.Make, "Make"), metadata.text(ExifTags.Base.Model, "Model"))
    return _equivalent_px(metadata.exif.number(ExifTags.Base.FocalLength) * crop, crop, width, height)


@lru_cache
def _crop_factor(make: str, model: str) -> float:
    """The crop factor of a camera in lensfun's database; NaN if it is not there, or lensfunpy is not installed."""
    try:
        import lensfunpy
    except ImportError:
        return math.nan
    database: Any = lensfunpy.Database()  # type: ignore[attr-defined]
    found = database.find_cameras(make, model) if make and model else []
    return found[0].crop_factor if found else math.nan


def _equivalent_px(equivalent_mm: float, crop: float, width: int, height: int) -> float:
    """The focal length of which the equivalent for 35 mm film is known, for the diagonal of the whole sensor."""
    columns, rows = width, height
    if _MEDIUM_FORMAT < crop < math.inf:
        columns, rows = _uncropped_px(width, height, next(shape for limit, shape in _SHAPES if crop < limit))
    return equivalent_mm / _FILM_DIAGONAL_MM * math.hypot(columns, rows)


def _uncropped_px(width: int, height: int, shape: float) -> tuple[float, float]:
    """Sides in pixels, longer first, of a sensor of aspect ratio `shape` from which an image was cropped.

    Wider images (16:9) were cropped at top and bottom, narrower ones left and right, except those of 5:4: there are
    sensors of that shape.
    """
    longer, shorter = float(max(width, height)), float(min(width, height))
    if longer / shorter > shape:
        return longer, longer / shape
    return (longer, shorter) if abs(longer / shorter - 5 / 4) < 0.03 else (shorter * shape, shorter)


def _sensor_mm(metadata: PhotographMetadata, width: int, height: int) -> float:
    """Longer side of the sensor by EXIF's focal plane resolution; NaN where that is absent or no sensor has that size.

    The resolution is for the image as the camera wrote it. Where a program has reduced the image and all sizes in EXIF
    but not the resolution, the sensor comes out too small; impossible sizes are rejected here.
    """
    per_unit = metadata.exif.number(ExifTags.Base.FocalPlaneXResolution)
    unit = metadata.exif.number(ExifTags.Base.FocalPlaneResolutionUnit)
    unit_mm = _MM_PER_UNIT.get(int(unit) if unit > 0 else 2, math.nan)
    sensor_mm = max(_size_of_original(metadata, width, height)) / per_unit * unit_mm
    return sensor_mm if _SENSOR_MM[0] <= sensor_mm <= _SENSOR_MM[1] else math.nan
