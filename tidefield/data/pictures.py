"""Files of photographs and of masks: their sizes, pixels, and what is written.

Without PyTorch, because the processes of `prepare` read them, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

from tidefield.data.readers.files import open_picture, quiet_pillow
from tidefield.errors import SceneError
from tidefield.files import completed_file
from tidefield.geometry.lenses import LensModel, rectify

_MODES_WITH_ALPHA = ("RGBA", "LA", "PA")
MODES = ("1", "L", "P", "RGB", "CMYK", "YCbCr", *_MODES_WITH_ALPHA)
"""Pillow's names of the kinds of pixels that are read: 8 bits per colour."""


@quiet_pillow()
def read_header(path: Path) -> tuple[int, int, bool]:
    """Read the width, the height and the presence of alpha without decoding; EXIF orientation is not applied.

    Raises:
        SceneError: the file is not a supported picture.
    """
    with open_picture(path) as picture:
        if picture.mode not in MODES:
            raise SceneError(f"{path} has pixels of the mode {picture.mode}: expected 8 bits per colour; convert it")
        return *picture.size, _has_alpha(picture)


def decode(path: Path) -> UInt8[np.ndarray, "H W C"]:
    """Decode a photograph as it is stored: RGB, or RGBA if it has alpha; EXIF orientation is not applied.

    Raises:
        SceneError: it cannot be decoded completely.
    """
    with open_picture(path) as picture:
        return np.asarray(picture.convert("RGBA" if _has_alpha(picture) else "RGB"))


def _has_alpha(picture: Image.Image) -> bool:
    return picture.mode in _MODES_WITH_ALPHA or "transparency" in picture.info


def rectify_mask(
    mask: Bool[np.ndarray, "H W"], lens: LensModel, width: int, height: int
) -> Bool[np.ndarray, "height width"]:
    """Resample a mask as its photograph (`rectify`); True where a pixel is made of used ones alone."""
    return rectify(255 * mask[..., None].astype(np.uint8), lens, width, height)[..., 0] == 255


def read_mask(path: Path | None, size: tuple[int, int], photograph: Path) -> Bool[np.ndarray, "H W"]:
    """Read a mask: False where it is black, that is where the photograph is not to be used; without one, all is used.

    Args:
        size: width and height of the photograph.
        photograph: for messages.

    Raises:
        SceneError: the mask cannot be read, or has another size than the photograph.
    """
    if path is None:
        return np.ones(size[::-1], dtype=bool)
    with _open_mask(path, size, photograph) as picture:
        return np.asarray(picture.convert("L")) > 0


def check_mask(path: Path, size: tuple[int, int], photograph: Path) -> None:
    """Check, without decoding it, that a mask fits its photograph (see `read_mask`)."""
    with _open_mask(path, size, photograph):
        pass


@contextmanager
def _open_mask(path: Path, size: tuple[int, int], photograph: Path) -> Iterator[Image.Image]:
    with open_picture(path) as picture:
        if picture.size != size:
            raise SceneError(
                f"{path} has {picture.width} x {picture.height} pixels, but its photograph {photograph} has {size[0]} "
                f"x {size[1]}: expected a mask of the same size, black where the photograph is not to be used; make it "
                "again at that size"
            )
        yield picture


def write_mask(path: Path, mask: Bool[np.ndarray, "H W"]) -> None:
    """Write a mask as a grey PNG of black and white, the one kind that nerfstudio reads, too."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with completed_file(path, overwrite=True) as partial:
        Image.fromarray(255 * mask.astype(np.uint8)).save(partial, format="PNG")


def fill_masked(pixels: UInt8[np.ndarray, "H W C"], mask: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W C"]:
    """Give masked pixels the colour of the nearest used one, so that no window or filter sees what was masked."""
    if mask.all() or not mask.any():
        return pixels.copy()
    # Labels number the used pixels from 1, row by row.
    labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )[1]
    label = np.asarray(labels, dtype=np.int64)
    where = np.zeros(label.max() + 1, dtype=np.int64)
    where[label[mask]] = np.flatnonzero(mask)
    return pixels.reshape(-1, pixels.shape[2])[where[label]]
