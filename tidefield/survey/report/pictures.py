"""Small pictures inside the page, as data URIs."""

from __future__ import annotations

import base64
import io

import numpy as np
from jaxtyping import UInt8, UInt16
from PIL import Image

from tidefield.survey.report.numbers import CLASSES

# One hue apart for ground that a single photograph sees, then pale to dark, told apart by colour-blind readers too.
COLOURS = ("#f2d5c4", "#f7f0cd", "#cfe6c4", "#97cfbd", "#52a7b5", "#2c7199", "#1d3d68")
THUMBNAIL_PX = 160
JPEG_QUALITY = 72


def thumbnail_uri(picture: UInt8[np.ndarray, "h w 3"], side_px: int = THUMBNAIL_PX) -> str:
    """A JPEG of at most `side_px` a side."""
    image = Image.fromarray(picture)
    image.thumbnail((side_px, side_px))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return _uri("image/jpeg", buffer)


def coverage_uri(count: UInt16[np.ndarray, "h w"]) -> str:
    """A PNG of a raster of counts, north up, in the colours of `CLASSES`; clear where there is nothing."""
    index = np.searchsorted([least for least, _ in CLASSES], count, side="right").astype(np.uint8)
    image = Image.fromarray(index[::-1])
    colours = [bytes.fromhex(colour[1:]) for colour in COLOURS]
    image.putpalette(b"\xff\xff\xff" + b"".join(colours))
    buffer = io.BytesIO()
    image.save(buffer, "PNG", transparency=0, optimize=True)
    return _uri("image/png", buffer)


def _uri(kind: str, buffer: io.BytesIO) -> str:
    return f"data:{kind};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
