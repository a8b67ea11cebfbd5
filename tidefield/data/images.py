"""Read photographs: undistorted and resized once, then cached as raw bytes in one memory-mapped file.

The file lies in the user's cache folder (see `data.cache`), named by a hash of everything that its pixels depend on, so
a scene that is opened again at the same width is not decoded again.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from tidefield.data.cache import SUFFIX, cache_folder, make_room, refuse_shared
from tidefield.data.readers.files import open_picture, quiet_pillow
from tidefield.errors import RunError, SceneError
from tidefield.files import completed_file
from tidefield.geometry.lenses import Lens, rectify
from tidefield.machine import cores

Progress = Callable[[int, int], None]
"""Called with the number of photographs that are ready, and the number of all."""

# Part of every key: to be raised when the same photograph would give other pixels.
_PIXELS_VERSION = 1
_MODES_WITH_ALPHA = ("RGBA", "LA", "PA")
_MODES = ("1", "L", "P", "RGB", "CMYK", "YCbCr", *_MODES_WITH_ALPHA)

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Photographs:
    """The pixels of a scene, photograph by photograph; sizes may differ.

    Attributes:
        colours: 8-bit sRGB pictures.
        alphas: their opacity, None for opaque photographs. Colours are already composited on the background.
    """

    colours: tuple[UInt8[Tensor, "_ _ 3"], ...]
    alphas: tuple[UInt8[Tensor, "_ _"] | None, ...] = ()

    def __post_init__(self) -> None:
        assert len(self.alphas) in (0, len(self.colours)), "one alpha (or None) per photograph"

    def __len__(self) -> int:
        return len(self.colours)

    def __getitem__(self, index: int) -> UInt8[Tensor, "H W 3"]:
        return self.colours[index]

    def alpha(self, index: int) -> UInt8[Tensor, "H W"] | None:
        return self.alphas[index] if self.alphas else None


@dataclass(frozen=True)
class PhotographFile:
    """A photograph on disk, and the size to read it at.

    Attributes:
        path: the file.
        lens: the camera that took it, for exactly the file's pixels.
        width, height: of the result.
        has_alpha: whether the file has an opacity channel.
    """

    path: Path
    lens: Lens
    width: int
    height: int
    has_alpha: bool

    @property
    def bytes(self) -> int:
        return self.width * self.height * (4 if self.has_alpha else 3)


@quiet_pillow()
def read_header(path: Path) -> tuple[int, int, bool]:
    """Read the width, the height and the presence of alpha without decoding; EXIF orientation is not applied.

    Raises:
        SceneError: the file is not a supported picture.
    """
    with open_picture(path) as picture:
        if picture.mode not in _MODES:
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


@quiet_pillow()
def open_photographs(
    files: Sequence[PhotographFile],
    background_rgb: tuple[float, float, float],
    progress: Progress | None = None,
    cache: Path | None = None,
) -> Photographs:
    """Open photographs, undistorted and resized: from the cache, or decoded into it.

    Args:
        files: the photographs.
        background_rgb: colour on which photographs with alpha are composited, in [0, 1].
        progress: called for every photograph that is decoded.
        cache: a folder; the user's if not given.

    Raises:
        SceneError: a photograph cannot be decoded completely, the disk is full, or the cache's limit is no number.
    """
    folder = cache or cache_folder()
    if folder is None:
        _log.warning(
            "this user has no home folder for a cache: photographs are held in memory and decoded again next time; "
            "set XDG_CACHE_HOME to a writable folder"
        )
        return _views(np.concatenate(list(_decoded(files, background_rgb, progress))), files)
    store = folder / f"{_key(files, background_rgb)}{SUFFIX}"
    expected = sum(file.bytes for file in files)
    try:
        store.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        refuse_shared(store.parent)
        if store.is_file() and store.stat().st_size == expected:
            os.utime(store)
        else:
            make_room(store.parent, expected)
            with completed_file(store, overwrite=True) as partial, partial.open("wb") as file:
                for picture in _decoded(files, background_rgb, progress):
                    file.write(picture.data)
        # Copy-on-write: changes to a view do not reach the file.
        return _views(np.memmap(store, dtype=np.uint8, mode="c"), files)
    except (OSError, RunError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        assert isinstance(cause, OSError), "completed_file tells what failed"
        if cause.errno in (errno.ENOSPC, errno.EDQUOT):
            raise SceneError(
                f"the disk of {store.parent} is full: {expected / 1e6:.0f} MB are needed there for the photographs; "
                "free some space (`tidefield cache --clear`), choose a smaller --width, or set XDG_CACHE_HOME to a "
                "folder on another disk"
            ) from error
        if cause.errno not in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST):
            raise
        _log.warning(
            "the cache folder %s cannot be used (%s): photographs are held in memory and decoded again next time; "
            "set XDG_CACHE_HOME to a folder of yours",
            store.parent,
            cause.strerror,
        )
    return _views(np.concatenate(list(_decoded(files, background_rgb, progress))), files)


def _key(files: Sequence[PhotographFile], background_rgb: tuple[float, float, float]) -> str:
    parts = []
    for file in files:
        status = file.path.stat()
        about = {**asdict(file), "path": str(file.path.resolve())}
        parts.append([about, status.st_size, status.st_mtime_ns])
    text = json.dumps([_PIXELS_VERSION, background_rgb, parts], sort_keys=True)
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:32]


def _views(store: UInt8[np.ndarray, " bytes"], files: Sequence[PhotographFile]) -> Photographs:
    """Photographs as views of a store's bytes."""
    colours, alphas, start = [], [], 0
    for file in files:
        pixels = file.width * file.height
        planes = torch.from_numpy(store[start : start + file.bytes])
        colours.append(planes[: 3 * pixels].view(file.height, file.width, 3))
        alphas.append(planes[3 * pixels :].view(file.height, file.width) if file.has_alpha else None)
        start += file.bytes
    return Photographs(tuple(colours), tuple(alphas))


def _decoded(
    files: Sequence[PhotographFile], background_rgb: tuple[float, float, float], progress: Progress | None
) -> Iterator[UInt8[np.ndarray, " bytes"]]:
    """The bytes of each photograph in turn, decoded a few at a time: colours, then alpha if there is any."""
    largest = max(file.lens.width * file.lens.height for file in files)
    # Decoding takes some 12 bytes per pixel; all workers together stay around a gigabyte.
    workers = max(1, min(cores(), 8, 1_000_000_000 // (12 * largest)))
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[np.ndarray]] = deque()
        try:
            for done, file in enumerate([*files, *[None] * workers], start=1 - workers):
                if file is not None:
                    waiting.append(pool.submit(_decode, file, background_rgb))
                if done > 0:
                    yield waiting.popleft().result()
                    if progress:
                        progress(done, len(files))
        finally:
            for future in waiting:
                future.cancel()


def _decode(file: PhotographFile, background_rgb: tuple[float, float, float]) -> UInt8[np.ndarray, " bytes"]:
    pixels = decode(file.path)
    if not file.has_alpha:
        return rectify(pixels, file.lens, file.width, file.height).reshape(-1)
    # Composited before it is resampled: the colour of a transparent pixel is arbitrary.
    alpha = pixels[..., 3:].astype(np.float32) / 255
    flat = pixels[..., :3] * alpha + 255 * np.array(background_rgb, np.float32) * (1 - alpha)
    pixels = np.concatenate([np.round(flat).astype(np.uint8), pixels[..., 3:]], axis=-1)
    pixels = rectify(pixels, file.lens, file.width, file.height)
    return np.concatenate([pixels[..., :3].reshape(-1), pixels[..., 3].reshape(-1)])
