"""Read files of a scene safely: bounded in size, inside the scene's folder, and with checked numbers.

All readers open files with `opened` and photographs with `open_picture`, take paths from files with `inside`, numbers
of JSON with `number` and `numbers`, and check others with `in_range`.
"""

from __future__ import annotations

import io
import json
import os
import posixpath
import stat
import struct
import tokenize
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float64
from PIL import Image, UnidentifiedImageError

from tidefield.errors import SceneError, list_names

LARGEST = 1e15
"""Largest magnitude of a number of a scene: squares of such positions still fit into float32."""
MAX_PIXELS = 178_956_970
"""Of a photograph: Pillow opens no larger one, because a small file that states more would only fill the memory."""
_JSON_MEGABYTES, _PICTURE_MEGABYTES = 256, 4_000
_DAMAGE = (
    *(ValueError, LookupError, TypeError, AttributeError, ArithmeticError, EOFError, MemoryError, RecursionError),
    *(struct.error, tokenize.TokenError),  # the last from numpy, for headers of arrays
)
T = TypeVar("T", dict, list)


@contextmanager
def opened(path: Path, expected: str, megabytes: int) -> Iterator[BinaryIO]:
    """Open a file of at most so many megabytes, and name it in the errors of reading it (see `parsing`).

    Raises:
        SceneError: the file is larger, no regular file, cannot be read, or the block fails on what it holds.
    """
    with parsing(path, expected):
        size = _size(path, megabytes)
        with path.open("rb") as file:
            # The system's own files, which have no size, count as empty: reading some of them does not end.
            yield file if size else io.BytesIO()


def _size(path: Path, megabytes: int) -> int:
    """The size of a file in bytes, before it is opened: opening a pipe waits for who writes to it."""
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise SceneError(f"{path} is a folder, a pipe or a device: expected a file; copy the file there")
    if status.st_size > megabytes * 1_000_000:
        raise SceneError(
            f"{path} has {status.st_size / 1e6:.0f} MB: expected at most {megabytes} MB for a file of this kind; "
            "export it again"
        )
    return status.st_size


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn the system's errors of reading files and folders at or below a path into one SceneError."""
    try:
        yield
    except OSError as error:
        name = _short(str(error.filename or path), 400)
        raise SceneError(
            f"{name} cannot be read ({error.strerror or error}): expected files and folders that you may read; correct "
            "the path, or the permissions"
        ) from error


@contextmanager
def parsing(path: Path, expected: str) -> Iterator[None]:
    """Turn every error of reading a file, or of what it holds, into one SceneError that names it.

    Args:
        expected: what the file should hold, and what to do.
    """
    try:
        with reading(path):
            yield
    except _DAMAGE as error:
        raise SceneError(f"{path} is damaged ({error}): expected {expected}") from error


@contextmanager
def naming(place: Path | str) -> Iterator[None]:
    """Name the file in the SceneErrors of a block that does not know it, such as those of a lens."""
    try:
        yield
    except SceneError as error:
        raise SceneError(f"{place}: {error}") from error


@contextmanager
def open_picture(path: Path) -> Iterator[Image.Image]:
    """Open a photograph without decoding it.

    Raises:
        SceneError: instead of Pillow's errors, also of those in the block.
    """
    try:
        _size(path, _PICTURE_MEGABYTES)
        with Image.open(path) as picture:
            yield picture
    # Pillow raises SyntaxError for broken PNGs, and a plain Exception for decompression bombs.
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        expected = "a complete JPEG or PNG; copy it again from the camera, or remove it and use --allow-missing"
        if isinstance(error, UnidentifiedImageError) and _is_tiff(path):
            expected = "8 bits per colour, in grey or in red, green and blue; convert it"
        raise SceneError(f"{path} cannot be read as a photograph ({error}): expected {expected}") from error


def _is_tiff(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(4) in (b"II*\0", b"MM\0*")


@contextmanager
def quiet_pillow() -> Iterator[None]:
    """Hide Pillow's warnings, which name no file: large photographs are read, damaged EXIF counts as absent.

    Not for a single thread of several: the filters of warnings belong to the process.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"PIL\.")
        yield


def relative_path(name: str) -> Path:
    """Resolve the steps of a file name from a scene's description, which may be written as on Windows."""
    return Path(posixpath.normpath(name.replace("\\", "/")))


def inside(root: Path, name: str, named_by: Path) -> Path:
    """Resolve a file name from a scene's description to a path inside the scene.

    `name` must be relative and must not leave `root` by ".." or by links. As an exception a folder directly in `root`
    may be a link (photographs on another disk): then the file must lie inside the linked folder.

    Raises:
        SceneError: the path is outside.
    """
    relative = relative_path(name)
    path = root / relative
    within = bool(relative.parts) and not relative.anchor and ".." not in relative.parts and "\0" not in name
    if within:
        with parsing(named_by, "names of files; export it again"):
            real = Path(os.path.realpath(path))
            homes = (os.path.realpath(root / first) for first in ("", *relative.parts[:-1][:1]))
            within = any(real.is_relative_to(home) for home in homes)
            with suppress(FileNotFoundError, NotADirectoryError):  # a missing file is judged by `keep_present`
                path.stat()
    if not within:
        raise SceneError(
            f"{named_by} names the file {name!r}, which is outside of the scene's folder {root}: expected paths "
            "relative to that folder; move the photographs into it and correct the paths"
        )
    return path


def keep_present(paths: Sequence[Path], named_by: Path, allow_missing: bool) -> list[int]:
    """Find the indices of the files that exist.

    Raises:
        SceneError: some are missing, and that is not allowed.
    """
    present = [i for i, path in enumerate(paths) if path.is_file()]
    if len(present) < len(paths) and not allow_missing:
        missing = [str(path) for path in paths if not path.is_file()]
        raise SceneError(
            f"{len(missing)} of the {len(paths)} photographs that {named_by} names are missing: "
            f"{list_names(missing)}; add them, or use --allow-missing to leave them out"
        )
    return present


def read_json(file: Path, kind: type[T] = dict, megabytes: int = _JSON_MEGABYTES) -> T:
    """Read a JSON file that holds an object, or a list.

    Raises:
        SceneError: the file cannot be read, or holds anything else.
    """
    with opened(file, "whole JSON; copy or export it again", megabytes) as content:
        top = json.load(content)
    if not isinstance(top, kind):
        wanted = "an object" if kind is dict else "a list"
        raise SceneError(f"{file} holds a {type(top).__name__}: expected {wanted}; export it again")
    return top


def number(
    values: Mapping[str, Any],
    key: str,
    place: Path | str,
    default: float | None = None,
    least: float = -LARGEST,
    most: float = LARGEST,
) -> float:
    """Read a number from a JSON object of a file.

    Raises:
        SceneError: the value is anything else, out of range, or missing without a default.
    """
    value = values.get(key, default)
    # Python compares its integers, which JSON may make longer than any float, exactly.
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise SceneError(
            f"{place} has {key} = {_short(repr(value))}: expected a number from {least:g} to {most:g}; correct it"
        )
    return float(value)


def numbers(
    values: Mapping[str, Any], key: str, place: Path | str, shape: tuple[int, ...]
) -> Float64[np.ndarray, "*shape"]:
    """Read an array of numbers from lists of a JSON object of a file.

    Raises:
        SceneError: the value is anything else, or has another shape.
    """
    array = np.array(values.get(key), dtype=object)
    if array.shape != shape:
        wanted = " x ".join(map(str, shape))
        raise SceneError(f"{place} has {key} = {_short(repr(values.get(key)))}: expected {wanted} numbers; correct it")
    return np.array([number({key: value}, key, place) for value in array.flat]).reshape(shape)


def in_range(values: Float[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Test which numbers are finite and at most `LARGEST`."""
    return np.abs(values) <= LARGEST


def _short(text: str, most: int = 60) -> str:
    return text if len(text) <= most else f"{text[:most]}..."
