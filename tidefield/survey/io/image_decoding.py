"""Decode photographs, upright and in 8-bit RGB; a file that is incomplete is an error."""

from __future__ import annotations

import io
import math
import mmap
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from PIL import Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin

from tidefield.data.pictures import read_mask
from tidefield.data.readers.files import MAX_PIXELS
from tidefield.errors import SurveyError
from tidefield.survey.survey import Photograph

# By the first bytes of the file. `Image.open` is not used: of a file with several images (MPO), the photograph is the
# first, which the plain JPEG reader returns.
_READERS: dict[bytes, Callable[[str], Image.Image]] = {
    b"\xff\xd8\xff": JpegImagePlugin.JpegImageFile,
    b"\x89PNG\r\n\x1a\n": PngImagePlugin.PngImageFile,
    b"II*\0": TiffImagePlugin.TiffImageFile,
    b"MM\0*": TiffImagePlugin.TiffImageFile,
    b"II+\0": TiffImagePlugin.TiffImageFile,
    b"MM\0+": TiffImagePlugin.TiffImageFile,
}
HEIFS = (".heic", ".heif")
"""Suffixes of High Efficiency Image files, which pillow-heif reads (the extra `heic`)."""
_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
_DAMAGE = (
    *(OSError, SyntaxError, ValueError, KeyError, IndexError, TypeError, EOFError, struct.error),
    Image.DecompressionBombError,  # of TIFFs, whose reader has a limit of its own
)

_TIFF_PARTS = ((273, 324), (279, 325))  # offsets and lengths of the strips or tiles of a TIFF

# EXIF orientation -> linear part of the map from stored (x, y) to upright (x, y). `ImageOps.exif_transpose` would read
# the orientation, and damaged EXIF, a second time; control points need this table anyway.
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
def open_image(path: Path) -> Iterator[Image.Image]:
    """Open a photograph and read its header; errors of decoding inside the block are raised with the name of the file.

    Raises:
        SurveyError: the file is empty, not a JPEG, PNG or TIFF, damaged, an HEIF file by another suffix, or has more
            than `MAX_PIXELS` pixels.
    """
    try:
        if path.exists() and not path.is_file():  # a named pipe would be waited for
            raise ValueError("it is no regular file")
        with path.open("rb") as file:
            start = file.read(12)
        reader = next((reader for magic, reader in _READERS.items() if start.startswith(magic)), None)
        if start[4:8] == b"ftyp" and start[8:] in _HEIF_BRANDS:
            if path.suffix.casefold() not in HEIFS:  # it would be copied into the scene, where no program reads it
                raise SurveyError(f"{path} is an HEIC file: expected a name that ends in .heic; rename it")
            reader = _open_heif
        if reader is None:
            raise ValueError("it is empty" if not start else "it is not a JPEG, PNG or TIFF, whatever its suffix")
        with reader(str(path)) as image:
            width, height = image.size
            if width * height > MAX_PIXELS:
                raise ValueError(f"it has {width} x {height} pixels, more than {MAX_PIXELS // 10**6} million")
            yield image
    except _DAMAGE as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__
        raise SurveyError(
            f"{path} cannot be read ({reason}): expected a whole JPEG, PNG or TIFF; copy it again from the camera"
        ) from error


def _open_heif(path: str) -> Image.Image:
    """Open an HEIF file; the decoder applies its orientation, and its EXIF then states 1."""
    from pillow_heif import HeifImageFile

    return HeifImageFile(io.BytesIO(Path(path).read_bytes()))  # an open file would stay open


def refuse_truncated(path: Path, image: Image.Image) -> None:
    """Check, without decoding, that an opened file is complete.

    Pillow finds a truncated JPEG only by decoding it, which takes 25 times as long (11 ms and 0.4 ms for 0.6 MB).

    Raises:
        OSError: the end of the file is missing.
    """
    if isinstance(image, PngImagePlugin.PngImageFile):
        image.verify()
    elif isinstance(image, TiffImagePlugin.TiffImageFile):
        tags = image.tag_v2
        starts, lengths = (np.atleast_1d(tags.get(strips) or tags.get(tiles) or 0) for strips, tiles in _TIFF_PARTS)
        if len(starts) != len(lengths) or (starts + lengths).max() > path.stat().st_size:
            raise OSError("its end is missing")
    elif isinstance(image, JpegImagePlugin.JpegImageFile):  # the parts of an HEIF are checked when it is opened
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            at = 2
            while content[at + 1] != 0xDA:  # to the scan, where the segments end
                at += 1 if content[at + 1] == 0xFF else 2 + int.from_bytes(content[at + 2 : at + 4], "big")
            # The two bytes of the end marker cannot occur in entropy-coded data; in the segments before, they may.
            if content.rfind(b"\xff\xd9", at) < 0:
                raise OSError("its end is missing")


def stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height of an opened image as stored, before the EXIF orientation is applied."""
    if isinstance(image, TiffImagePlugin.TiffImageFile):  # Pillow may have rotated it already
        return int(image.tag_v2[256]), int(image.tag_v2[257])
    return image.size


def upright_size(width: int, height: int, orientation: int) -> tuple[int, int]:
    """Width and height of the upright photograph, from its stored size."""
    return (height, width) if orientation >= 5 else (width, height)


def upright_rotation(orientation: int) -> Float64[np.ndarray, "2 2"]:
    """Linear map from directions in the stored image to directions in the upright one."""
    return np.array(_UPRIGHT[orientation], dtype=np.float64)


def upright_uv(uv_px: tuple[float, float], width: int, height: int, orientation: int) -> tuple[float, float]:
    """Transform a pixel position of the stored image (`width` x `height`) to the upright one.

    Pixel corners are integers on both sides: the first pixel's centre is (0.5, 0.5).
    """
    rotation = upright_rotation(orientation)
    x, y = rotation @ uv_px + np.where(rotation.sum(axis=1) < 0, upright_size(width, height, orientation), 0)
    return float(x), float(y)


def upright(photograph: Photograph) -> UInt8[np.ndarray, "H W 3"]:
    """Decode a photograph at full size, as all later stages use it.

    The EXIF orientation is applied, 16 bits are scaled to 8, grey becomes RGB, and transparency is blended over
    white.

    Raises:
        SurveyError: the file is incomplete or damaged.
    """
    with open_image(photograph.path) as image:
        return _oriented(_rgb(image), image, photograph.orientation)


def used_pixels(photograph: Photograph) -> Bool[np.ndarray, "H W"]:
    """Read where an upright photograph is to be used: its mask is not black there, and the photograph shows something.

    A pixel that is transparent in part still shows something; where nothing is left of it, there is no colour.

    Raises:
        SurveyError, SceneError: a file is damaged, or the mask has another size.
    """
    used = read_mask(photograph.mask, (photograph.width, photograph.height), photograph.path)
    if photograph.has_alpha:
        with open_image(photograph.path) as image:
            alpha = image.convert("RGBA").getchannel("A")
            used = used & (_oriented(alpha, image, photograph.orientation) > 0)
    return used


def thumbnail(photograph: Photograph, side_px: int) -> UInt8[np.ndarray, "H W 3"]:
    """Decode a photograph upright, reduced (never enlarged) to a longer side of `side_px`, at the least cost.

    Raises:
        SurveyError: the file is incomplete or damaged.
    """
    with open_image(photograph.path) as image:
        scale = side_px / max(image.size)
        # Only JPEG supports it: it decodes at the smallest of its reduced sizes that is large enough.
        image.draft("RGB", (math.ceil(image.width * scale), math.ceil(image.height * scale)))
        reduced = _rgb(image)
        scale = side_px / max(reduced.size)
        if scale < 1:
            size = max(1, round(reduced.width * scale)), max(1, round(reduced.height * scale))
            reduced = reduced.resize(size, Image.Resampling.LANCZOS, reducing_gap=3.0)
        return _oriented(reduced, image, photograph.orientation)


def has_alpha(image: Image.Image) -> bool:
    """Whether an opened photograph may have transparent pixels."""
    is_deep = image.mode.startswith("I")  # whose transparency Pillow does not convert
    return image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or (not is_deep and "transparency" in image.info)


def _rgb(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):
        levels = np.asarray(image).astype(np.int64)
        return Image.fromarray((levels.clip(0, 65535) >> 8).astype(np.uint8)).convert("RGB")
    if has_alpha(image):
        layer = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", layer.size, "white"), layer).convert("RGB")
    return image.convert("RGB")


def _oriented(decoded: Image.Image, image: Image.Image, orientation: int) -> UInt8[np.ndarray, "H W *C"]:
    """Apply the EXIF orientation to the decoded pixels of `image`."""
    pixels = np.asarray(decoded)
    if isinstance(image, TiffImagePlugin.TiffImageFile):  # Pillow has applied it while decoding
        return np.array(pixels)
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    mirrored_x, mirrored_y = upright_rotation(orientation).sum(axis=1) < 0
    return np.ascontiguousarray(pixels[:: -1 if mirrored_y else 1, :: -1 if mirrored_x else 1])
