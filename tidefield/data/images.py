"""Read photographs: undistorted and resized once, then cached as raw bytes in one memory-mapped file.

The file lies in the user's cache folder (see `data.cache`), named by a hash of everything that its pixels depend on, so
a scene that is opened again at the same width is not decoded again.
"""

from __future__ import annotations

import errno
import logging
import mmap
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from tidefield.data.cache import SUFFIX, cache_folder, identity, key, make_room, open_folder, touch
from tidefield.data.pictures import decode, fill_masked, read_mask, rectify_mask
from tidefield.data.readers.files import quiet_pillow
from tidefield.errors import RunError, SceneError
from tidefield.files import completed_file
from tidefield.geometry.lenses import LensModel, rectify
from tidefield.machine import cores

Progress = Callable[[int, int], None]
"""Called with the number of photographs that are ready, and the number of all."""
Read = tuple[UInt8[Tensor, "_ _ 3"], Bool[Tensor, "_ _"] | None]
"""A photograph, and where it is used if it has a mask."""
Masks = Sequence[Bool[Tensor, "_ _"] | None]
"""One for each of some photographs, or none at all (`Photographs.masks_of`)."""

# Part of every key: to be raised when the same photograph would give other pixels.
_PIXELS_VERSION = 1

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Photographs:
    """The pixels of a scene, photograph by photograph; sizes may differ.

    Attributes:
        colours: 8-bit sRGB pictures.
        alphas: their opacity, None for opaque photographs. Colours are already composited on the background.
        masks: False for pixels that are not to be used, whose colours are those of the nearest used pixels; None for
            photographs without a mask. Empty if no photograph has one.
        files: where they were read; empty where they come from no files. Without them photographs have no other size.
        background_rgb: colour on which photographs with alpha are composited, in [0, 1].
        mapped: the file of the cache that the pixels are read from when they are used; None where they are in memory.
    """

    colours: tuple[UInt8[Tensor, "_ _ 3"], ...]
    alphas: tuple[UInt8[Tensor, "_ _"] | None, ...] = ()
    masks: tuple[Bool[Tensor, "_ _"] | None, ...] = ()
    files: tuple[PhotographFile, ...] = ()
    background_rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)
    mapped: mmap.mmap | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        assert len(self.alphas) in (0, len(self.colours)), "one alpha (or None) per photograph"
        assert len(self.masks) in (0, len(self.colours)), "one mask (or None) per photograph"

    def __len__(self) -> int:
        return len(self.colours)

    def __getitem__(self, index: int) -> UInt8[Tensor, "H W 3"]:
        return self.colours[index]

    def release(self) -> None:
        """Give back the memory of pixels that were read from the cache's file; they are read again when they are used.

        What was changed in them is lost.
        """
        if self.mapped is not None and sys.platform != "win32":  # which knows no such advice
            self.mapped.madvise(mmap.MADV_DONTNEED)

    def finest_width(self, index: int) -> int:
        """Return the width of a photograph's file, or of the photograph where it comes from none."""
        return self.files[index].lens.width if self.files else self.colours[index].shape[1]

    def reaches(self, index: int, width: int) -> bool:
        """Whether a photograph's file has a width, or hardly less: undistorted ones have lost a few columns."""
        return width <= 1.02 * self.finest_width(index)

    def alpha(self, index: int) -> UInt8[Tensor, "H W"] | None:
        return self.alphas[index] if self.alphas else None

    def used(self, index: int) -> Bool[Tensor, "H W"]:
        """Return which pixels of a photograph are to be used: all of them where it has no mask."""
        mask = self.masks[index] if self.masks else None
        return torch.ones(self.colours[index].shape[:2], dtype=torch.bool) if mask is None else mask

    def read(self, index: int) -> Read:
        """Return a photograph, and where it is used if it has a mask."""
        return self.colours[index], self.masks[index] if self.masks else None

    def masks_of(self, which: Sequence[int]) -> Masks:
        """Return the masks of some photographs, one each; empty if no photograph of the scene has one."""
        return tuple(self.masks[i] for i in which) if self.masks else ()


@dataclass(frozen=True)
class PhotographFile:
    """A photograph on disk, and the size to read it at.

    Attributes:
        path: the file.
        lens: the camera that took it, for exactly the file's pixels.
        width, height: of the result.
        has_alpha: whether the file has an opacity channel, which is read as such.
        mask: a picture of the same size, which is black where the photograph is not to be used; None for none.
        alpha_is_mask: whether the file has an opacity channel, and pixels that are not opaque are not to be used.
    """

    path: Path
    lens: LensModel
    width: int
    height: int
    has_alpha: bool
    mask: Path | None = None
    alpha_is_mask: bool = False

    def at_width(self, width: int | None) -> PhotographFile:
        """The same file, to be read at a width with its aspect kept; never enlarged, at its own where None is given."""
        own = min(width or self.lens.width, self.lens.width)
        return replace(self, width=own, height=max(1, round(self.lens.height * own / self.lens.width)))

    @property
    def bytes(self) -> int:
        return self.width * self.height * (3 + self.has_alpha + self.has_mask)

    @property
    def has_mask(self) -> bool:
        """Whether some of its pixels are not to be used, by a mask or by its own opacity."""
        return self.mask is not None or self.alpha_is_mask


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
        return _views(np.concatenate(list(_decoded(files, background_rgb, progress))), files, background_rgb)
    store = folder / f"{photographs_key(files, background_rgb)}{SUFFIX}"
    expected = sum(file.bytes for file in files)
    try:
        open_folder(store.parent)
        mapped = None
        with suppress(FileNotFoundError):  # another program may delete it meanwhile
            if store.is_file() and store.stat().st_size == expected:
                mapped = _mapped(store)
                touch(store)
        if mapped is None:
            make_room(store.parent, expected)
            with completed_file(store, overwrite=True) as partial, partial.open("wb") as file:
                for picture in _decoded(files, background_rgb, progress):
                    file.write(picture.data)
            mapped = _mapped(store)
        return _views(mapped, files, background_rgb)
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
    return _views(np.concatenate(list(_decoded(files, background_rgb, progress))), files, background_rgb)


def _mapped(store: Path) -> UInt8[np.ndarray, " bytes"]:
    """Map a file of the cache into memory. Copy-on-write: changes to a view do not reach the file."""
    return np.memmap(store, dtype=np.uint8, mode="c")


def photographs_key(files: Sequence[PhotographFile], background_rgb: tuple[float, float, float]) -> str:
    """Identify decoded photographs by their files and how they are read, for `cache.key`."""
    parts = []
    for file in files:
        path, *version = identity(file.path)
        about = {**asdict(file), "path": path}
        del about["mask"]
        if not file.alpha_is_mask:  # what is in the cache keeps its names
            del about["alpha_is_mask"]
        parts.append([about, *version])
        if file.mask is not None:
            parts.append(identity(file.mask))
    return key([_PIXELS_VERSION, background_rgb, parts])


def read_at_size(photographs: Photographs, index: int, width: int, height: int) -> Read:
    """Read a photograph from its file at another size, and its mask if it has one."""
    file = replace(photographs.files[index], width=width, height=height)
    with quiet_pillow():
        one = _views(_decode(file, photographs.background_rgb), [file], photographs.background_rgb)
    return one.read(0)


def decoded_at_once(files: Sequence[PhotographFile]) -> int:
    """How many photographs to decode at the same time: it takes some 12 bytes per pixel, a gigabyte for all of them."""
    largest = max(file.lens.width * file.lens.height for file in files)
    return max(1, min(cores(), 8, 1_000_000_000 // (12 * largest)))


def _views(
    store: UInt8[np.ndarray, " bytes"], files: Sequence[PhotographFile], background_rgb: tuple[float, float, float]
) -> Photographs:
    """Photographs as views of a store's bytes."""
    colours, alphas, masks, start = [], [], [], 0
    for file in files:
        pixels = file.width * file.height
        planes = torch.from_numpy(store[start : start + file.bytes])
        single = list(planes[3 * pixels :].view(-1, file.height, file.width))
        colours.append(planes[: 3 * pixels].view(file.height, file.width, 3))
        alphas.append(single.pop(0) if file.has_alpha else None)
        masks.append(single.pop().view(torch.bool) if file.has_mask else None)
        start += file.bytes
    masks = masks if any(mask is not None for mask in masks) else ()
    mapped = store.base if isinstance(store.base, mmap.mmap) else None
    return Photographs(tuple(colours), tuple(alphas), tuple(masks), tuple(files), background_rgb, mapped)


def _decoded(
    files: Sequence[PhotographFile], background_rgb: tuple[float, float, float], progress: Progress | None
) -> Iterator[UInt8[np.ndarray, " bytes"]]:
    """The bytes of each photograph in turn, decoded a few at a time: colours, then alpha and mask if there are any."""
    workers = decoded_at_once(files)
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
    mask = None if file.mask is None else read_mask(file.mask, (file.lens.width, file.lens.height), file.path)
    if file.alpha_is_mask:
        opaque = pixels[..., 3] == 255
        pixels, mask = pixels[..., :3], opaque if mask is None else mask & opaque
    if not file.has_alpha:
        pixels = pixels if mask is None else fill_masked(pixels, mask)
        return _planes(rectify(pixels, file.lens, file.width, file.height), mask, file)
    # Composited before it is resampled: the colour of a transparent pixel is arbitrary.
    alpha = pixels[..., 3:].astype(np.float32) / 255
    flat = pixels[..., :3] * alpha + 255 * np.array(background_rgb, np.float32) * (1 - alpha)
    pixels = np.concatenate([np.round(flat).astype(np.uint8), pixels[..., 3:]], axis=-1)
    if mask is not None:
        pixels = fill_masked(pixels, mask)
        pixels[~mask, 3] = 255  # the object may be there: it is not carved away
    return _planes(rectify(pixels, file.lens, file.width, file.height), mask, file)


def _planes(
    pixels: UInt8[np.ndarray, "H W C"], mask: Bool[np.ndarray, "_ _"] | None, file: PhotographFile
) -> UInt8[np.ndarray, " bytes"]:
    """The bytes of a store: interleaved colours, then alpha and mask, each by itself."""
    planes = [pixels[..., :3], *pixels.transpose(2, 0, 1)[3:]]
    if mask is not None:
        planes.append(rectify_mask(mask, file.lens, file.width, file.height).astype(np.uint8))
    return np.concatenate([plane.reshape(-1) for plane in planes])


def is_used(mask: Bool[Tensor, "H W"], uv_px: Float[Tensor, "*P 2"]) -> Bool[Tensor, "*P"]:
    """Read a mask at pixels; those outside of the photograph read its border."""
    u, v = uv_px.floor().long().unbind(-1)
    height, width = mask.shape
    return mask.to(uv_px.device)[v.clamp(0, height - 1), u.clamp(0, width - 1)]
