"""Decoding photographs: upright, 8-bit RGB, whole or not at all."""

from __future__ import annotations

import math
import mmap
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin

from tidefield.errors import SurveyError
from tidefield.survey.survey import Photograph

PIXELS_AT_MOST = 300_000_000
"""More than any camera has: a small file that claims more would only fill the memory."""

# By how the files begin. Image.open would do, but for its limit of pixels, which is one for all of the program; and of
# the several pictures in one file (MPO) the first is the photograph, which the plain JPEG reader gives.
_READERS: dict[bytes, Callable[[str], Image.Image]] = {
    b"\xff\xd8\xff": JpegImagePlugin.JpegImageFile,
    b"\x89PNG\r\n\x1a\n": PngImagePlugin.PngImageFile,
    b"II*\0": TiffImagePlugin.TiffImageFile,
    b"MM\0*": TiffImagePlugin.TiffImageFile,
    b"II+\0": TiffImagePlugin.TiffImageFile,
    b"MM\0+": TiffImagePlugin.TiffImageFile,
}
_DAMAGES = (
    *(OSError, SyntaxError, ValueError, KeyError, IndexError, TypeError, EOFError, struct.error),
    Image.DecompressionBombError,  # of TIFFs, whose reader has a limit of its own
)

_TIFF_PARTS = ((273, 324), (279, 325))  # tags of where a TIFF's strips or tiles start, and of how long they are

# EXIF's orientation -> the linear part that takes stored (x, y) to upright (x, y).
_UPRIGHT = {
    1: ((1, 0), (0, 1)),
    2: ((-1, 0), (0, 1)),
    3: ((-1, 0), (0, -1)),
    4: ((1, 0), (0, -1)),
    5: ((0, 1), (1, 0)),
    6: ((0, -1), (1, 0)),
    7: ((0, -1), (-1, 0)),
    8: ((0, 1), (-1, 0)),
}


@contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """A photograph's file with its header read; what goes wrong inside the block names the file.

    Raises:
        SurveyError: the file is empty, no JPEG, PNG or TIFF, damaged, or has more than `PIXELS_AT_MOST` pixels.
    """
    try:
        with path.open("rb") as file:
            start = file.read(8)
        reader = next((reader for magic, reader in _READERS.items() if start.startswith(magic)), None)
        if reader is None:
            raise ValueError("it is empty" if not start else "it is no JPEG, PNG or TIFF, whatever its name says")
        with reader(str(path)) as picture:
            width, height = picture.size
            if width * height > PIXELS_AT_MOST:
                raise ValueError(f"it has {width} x {height} pixels, more than {PIXELS_AT_MOST // 10**6} million")
            yield picture
    except _DAMAGES as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__
        raise SurveyError(
            f"{path} cannot be read ({reason}): expected a whole JPEG, PNG or TIFF; copy it again from the camera"
        ) from error


def refuse_truncated(path: Path, picture: Image.Image) -> None:
    """Notice, without decoding, that the end of an opened file is missing.

    Raises:
        OSError: it is.
    """
    if isinstance(picture, PngImagePlugin.PngImageFile):
        picture.verify()
    elif isinstance(picture, TiffImagePlugin.TiffImageFile):
        tags = picture.tag_v2
        starts, lengths = (np.atleast_1d(tags.get(strips) or tags.get(tiles) or 0) for strips, tiles in _TIFF_PARTS)
        if len(starts) != len(lengths) or (starts + lengths).max() > path.stat().st_size:
            raise OSError("its end is missing")
    else:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            # Within the picture's data the two bytes of the end mark cannot occur; in the segments before, they may.
            if content.rfind(b"\xff\xd9", _start_of_scan(content)) < 0:
                raise OSError("its end is missing")


def _start_of_scan(content: mmap.mmap) -> int:
    """Where a JPEG's segments end and its coded picture begins."""
    at = 2
    while content[at + 1] != 0xDA:
        at += 1 if content[at + 1] == 0xFF else 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    return at


def stored_size(picture: Image.Image) -> tuple[int, int]:
    """Width and height of an opened picture as its file has it, before EXIF's orientation is applied."""
    if isinstance(picture, TiffImagePlugin.TiffImageFile):  # may be turned already
        return int(picture.tag_v2[256]), int(picture.tag_v2[257])
    return picture.size


def upright_size(width: int, height: int, orientation: int) -> tuple[int, int]:
    """Size of a photograph stored with `width` and `height` once it stands upright."""
    return (height, width) if orientation >= 5 else (width, height)


def upright_rotation(orientation: int) -> Float64[np.ndarray, "2 2"]:
    """What takes directions in the stored picture to directions in the upright one."""
    return np.array(_UPRIGHT[orientation], dtype=np.float64)


def upright_uv(uv_px: tuple[float, float], width: int, height: int, orientation: int) -> tuple[float, float]:
    """Where a place in a picture of stored size `width`, `height` comes to lie once it stands upright.

    Pixel corners are integers on both sides: the first pixel's centre is (0.5, 0.5).
    """
    rotation = upright_rotation(orientation)
    x, y = rotation @ uv_px + np.where(rotation.sum(axis=1) < 0, upright_size(width, height, orientation), 0)
    return float(x), float(y)


def upright(photograph: Photograph) -> UInt8[np.ndarray, "H W 3"]:
    """The whole photograph, as all later stages see it.

    EXIF's orientation is applied, 16 bits are scaled to 8, grey becomes RGB, and transparency is put over white.

    Raises:
        SurveyError: it cannot be decoded whole.
    """
    with opened(photograph.path) as picture:
        return _turned(_rgb(picture), picture, photograph.orientation)


def thumbnail(photograph: Photograph, side_px: int) -> UInt8[np.ndarray, "H W 3"]:
    """The photograph reduced (never enlarged) to a longer side of `side_px`, upright, decoded no finer than needed.

    Raises:
        SurveyError: it cannot be decoded whole.
    """
    with opened(photograph.path) as picture:
        scale = side_px / max(picture.size)
        # Only JPEG can: it decodes the next size up that costs less.
        picture.draft("RGB", (math.ceil(picture.width * scale), math.ceil(picture.height * scale)))
        reduced = _rgb(picture)
        scale = side_px / max(reduced.size)
        if scale < 1:
            size = max(1, round(reduced.width * scale)), max(1, round(reduced.height * scale))
            reduced = reduced.resize(size, Image.Resampling.LANCZOS, reducing_gap=3.0)
        return _turned(reduced, picture, photograph.orientation)


def _rgb(picture: Image.Image) -> Image.Image:
    if picture.mode.startswith("I"):
        levels = np.asarray(picture).astype(np.int64)
        return Image.fromarray((levels.clip(0, 65535) >> 8).astype(np.uint8)).convert("RGB")
    if picture.mode == "F":
        raise ValueError("its pixels are floating-point numbers; export it with 8 or 16 bits")
    if picture.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in picture.info:
        layer = picture.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", layer.size, "white"), layer).convert("RGB")
    return picture.convert("RGB")


def _turned(rgb: Image.Image, picture: Image.Image, orientation: int) -> UInt8[np.ndarray, "H W 3"]:
    """The pixels of a decoded picture, stood up."""
    pixels = np.asarray(rgb)
    if isinstance(picture, TiffImagePlugin.TiffImageFile):  # Pillow has turned these while decoding
        return np.array(pixels)
    if orientation >= 5:
        pixels = pixels.transpose(1, 0, 2)
    mirrored_x, mirrored_y = upright_rotation(orientation).sum(axis=1) < 0
    return np.ascontiguousarray(pixels[:: -1 if mirrored_y else 1, :: -1 if mirrored_x else 1])
