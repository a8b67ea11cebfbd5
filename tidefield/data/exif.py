"""Read EXIF: numbers, texts, exposure and capture time, without decoding pixels. The one home of EXIF parsing."""

from __future__ import annotations

import logging
import math
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from PIL import ExifTags, Image, PngImagePlugin

from tidefield.data.readers.files import open_picture, quiet_pillow

EXPOSURE_POWERS = {
    ExifTags.Base.ExposureTime: 1,
    ExifTags.Base.ISOSpeedRatings: 1,
    ExifTags.Base.FNumber: -2,
}
"""The tags that determine the exposure, with the power that each has in the light that is recorded."""
EXIF_DAMAGE = (OSError, SyntaxError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, struct.error)
"""What Pillow raises where it reads damaged EXIF, and where it writes values that it has read."""

_MOST_BYTES = 1_000_000
"""Of EXIF that is parsed: a JPEG's has 64 kB; every tag of a longer one could refer to all of it."""
_log = logging.getLogger(__name__)
_TIMES = (ExifTags.Base.DateTimeOriginal, ExifTags.Base.DateTimeDigitized, ExifTags.Base.DateTime)


@dataclass(frozen=True)
class Exif:
    """The EXIF of one file.

    Attributes:
        tags: the tags of the image and those of its Exif block, in one table.
        gps: the GPS block.
        damaged: whether a part of the EXIF could not be read; it counts as absent.
    """

    tags: Mapping[int, object]
    gps: Mapping[int, object]
    damaged: bool = False

    def number(self, tag: int) -> float:
        """A positive number; NaN where the tag is absent, zero or not a number."""
        value = as_number(self.tags.get(tag))
        return value if value > 0 else math.nan

    def text(self, tag: int) -> str:
        """A text; empty where the tag is absent."""
        value = self.tags.get(tag, "")
        text = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value)
        return text.partition("\0")[0].strip()

    @property
    def log_exposure_terms(self) -> tuple[float, ...]:
        """Natural logs of exposure time, ISO and f-number, times their powers: they add up to the log exposure."""
        return tuple(power * math.log(self.number(tag)) for tag, power in EXPOSURE_POWERS.items())

    @property
    def time_s(self) -> float:
        """Capture time, in seconds since 1970 by the camera's clock, with EXIF's fraction; NaN if unknown."""
        for tag in _TIMES:
            try:
                moment = datetime.strptime(self.text(tag), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
            except ValueError:  # absent, or zeros from a clock that was never set
                continue
            fraction = self.text(ExifTags.Base.SubsecTimeOriginal)
            return moment.timestamp() + (float(f"0.{fraction}") if fraction.isascii() and fraction.isdigit() else 0.0)
        return math.nan


@dataclass(frozen=True)
class Exposures:
    """Exposures and capture times of V photographs; NaN where unknown.

    Attributes:
        log_exposure: natural log of exposure time x ISO / f-number^2, up to a constant.
        time_s: capture time, in seconds since any common moment.
    """

    log_exposure: Float64[np.ndarray, " V"]
    time_s: Float64[np.ndarray, " V"]


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


def read_exif(image: Image.Image) -> Exif:
    """Read the EXIF of an opened image, without decoding its pixels; empty where there is none."""
    tags: dict[int, object] = {}
    gps: dict[int, object] = {}
    # Pillow decodes the pixels of a PNG without EXIF in its header, to look for EXIF behind them.
    if isinstance(image, PngImagePlugin.PngImageFile) and "exif" not in image.info:
        return Exif(tags, gps)
    if len(image.info.get("exif") or b"") > _MOST_BYTES:
        return Exif(tags, gps, damaged=True)
    try:
        table = image.getexif()
        tags = {**table, **table.get_ifd(ExifTags.IFD.Exif)}
        gps = dict(table.get_ifd(ExifTags.IFD.GPSInfo))
    except EXIF_DAMAGE:
        return Exif(tags, gps, damaged=True)
    return Exif(tags, gps)


@quiet_pillow()
def read_exposures(paths: Sequence[Path]) -> Exposures:
    """Read exposures and capture times from the EXIF of photographs, without decoding pixels.

    A factor of the exposure that some of the photographs lack is left out for all, because it cannot be compared; those
    that have none at all have no exposure. Damaged EXIF counts as absent. Where none has a time, but numbers that are
    not as long as each other (frames of a video), their order by these counts as seconds.

    Raises:
        SceneError: a file does not exist or is not an image.
    """
    found = []
    for path in paths:
        with open_picture(path) as image:
            found.append(read_exif(image))
    terms = np.array([exif.log_exposure_terms for exif in found], dtype=np.float64).reshape(-1, len(EXPOSURE_POWERS))
    there = np.isfinite(terms)
    shared = there[there.any(axis=1)].all(axis=0)
    log_exposure = terms[:, shared].sum(axis=1) if shared.any() else np.full(len(found), math.nan)
    time_s = np.array([exif.time_s for exif in found], dtype=np.float64)
    if np.isnan(time_s).all() and (rank := _order_of_numbers(paths)) is not None:
        time_s = rank
    lacking = [np.isnan(values) for values in (log_exposure, time_s) if not np.isnan(values).all()]
    if count := np.any(lacking, axis=0).sum():
        _log.info(
            "the EXIF of %d of %d photographs has no exposure or no time: those of photographs before and after count",
            count,
            len(found),
        )
    return Exposures(log_exposure, time_s)


def _order_of_numbers(paths: Sequence[Path]) -> Float64[np.ndarray, " V"] | None:
    """The rank of each file, sorted by names, with numbers in these as numbers; None if they are not sorted, or that is
    their order already."""

    def parts(k: int) -> list[tuple[bool, int, str]]:
        found = re.findall(r"[0-9]+|[^0-9]+", paths[k].as_posix())
        return [(part.isdecimal(), int(part[-18:]) if part.isdecimal() else 0, part) for part in found]

    order = sorted(range(len(paths)), key=parts)
    if order == list(range(len(paths))) or list(paths) != sorted(paths):
        return None
    rank = np.empty(len(paths))
    rank[order] = np.arange(len(paths))
    return rank
