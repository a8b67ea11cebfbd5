"""What photograph files say about themselves without their pixels: exposure and time, from EXIF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import ExifTags, Image
from torch import Tensor

EXPOSURE_TAGS = {
    ExifTags.Base.ExposureTime: 1,
    ExifTags.Base.ISOSpeedRatings: 1,
    ExifTags.Base.FNumber: -2,
}
"""The tags that exposure is made of, with their powers in the light that reaches the picture."""


@dataclass(frozen=True)
class Metadata:
    """What the files of V photographs say; NaN where they say nothing.

    Attributes:
        log_exposure: natural log of exposure time x ISO / f-number^2, up to a constant.
        time_s: when each was taken, in seconds since any common moment.
    """

    log_exposure: Float[Tensor, " V"]
    time_s: Float[Tensor, " V"]


def read_metadata(paths: Sequence[Path]) -> Metadata:
    """Exposure and time of photographs from their EXIF; decodes no pixels.

    A tag of the exposure that some of the photographs lack is left out for all, because it could not be compared.

    Raises:
        OSError: a file is not there or is no picture.
    """
    tables = [_exif(path) for path in paths]
    exposure = torch.zeros(len(paths), dtype=torch.float64)
    known = False
    for tag, power in EXPOSURE_TAGS.items():
        term = torch.tensor([_log(table.get(tag)) for table in tables], dtype=torch.float64)
        if term.isfinite().all():
            exposure, known = exposure + power * term, True
    time = torch.tensor([_seconds(table) for table in tables], dtype=torch.float64)
    return Metadata(exposure if known else torch.full_like(exposure, math.nan), time)


def _exif(path: Path) -> dict:
    with Image.open(path) as image:
        return dict(image.getexif().get_ifd(ExifTags.IFD.Exif))


def _log(value: object) -> float:
    """Log of a positive EXIF number; NaN for anything else (absent, zero, 0/0, several values)."""
    if isinstance(value, tuple):
        value = value[0] if value else None
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
    return math.log(number) if 0 < number < math.inf else math.nan


def _seconds(table: dict) -> float:
    """DateTimeOriginal with its fraction, in seconds; NaN where it is absent or malformed."""
    try:
        text = str(table[ExifTags.Base.DateTimeOriginal]).strip("\0 ")
        moment = datetime.strptime(text, "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except (KeyError, ValueError):
        return math.nan
    fraction = str(table.get(ExifTags.Base.SubsecTimeOriginal, "")).strip("\0 ")
    return moment.timestamp() + (float(f"0.{fraction}") if fraction.isdigit() else 0.0)
