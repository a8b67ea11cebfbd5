"""Read files of a scene safely: bounded in size, inside the scene's folder, and with checked JSON numbers.

All readers open files with `opened` and photographs with `open_picture`, take paths from files with `inside`, and
numbers of JSON with `number`.
"""

from __future__ import annotations

import json
import math
import os
import posixpath
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from PIL import Image

from tidefield.errors import SceneError, list_names

_JSON_MEGABYTES = 256
_DAMAGE = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, EOFError, MemoryError, RecursionError)
T = TypeVar("T", dict, list)


@contextmanager
def opened(path: Path, expected: str, megabytes: int) -> Iterator[BinaryIO]:
    """Open a file of at most so many megabytes, and name it in the errors of reading it (see `parsing`).

    Raises:
        SceneError: the file is larger, cannot be read, or the block fails on what it holds.
    """
    with parsing(path, expected), path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > megabytes * 1_000_000:
            raise SceneError(
                f"{path} has {size / 1e6:.0f} MB: expected at most {megabytes} MB for a file of this kind; "
                "export it again"
            )
        yield file


@contextmanager
def parsing(path: Path, expected: str) -> Iterator[None]:
    """Turn every error of reading a file, or of what it holds, into one SceneError that names it.

    Args:
        expected: what the file should hold, and what to do.
    """
    try:
        yield
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}; make it a readable file") from error
    except (*_DAMAGE, struct.error) as error:
        raise SceneError(f"{path} is damaged ({error}): expected {expected}") from error


@contextmanager
def open_picture(path: Path) -> Iterator[Image.Image]:
    """Open a photograph without decoding it.

    Raises:
        SceneError: instead of Pillow's errors, also of those in the block.
    """
    try:
        with Image.open(path) as picture:
            yield picture
    # Pillow raises SyntaxError for broken PNGs, and a plain Exception for decompression bombs.
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise SceneError(
            f"{path} cannot be read as a photograph ({error}): expected a complete JPEG or PNG; copy it again from the "
            "camera, or remove it and use --allow-missing"
        ) from error


def inside(root: Path, name: str, named_by: Path) -> Path:
    """Resolve a file name from a scene's description to a path inside the scene.

    `name` must be relative and must not leave `root` by ".." or by links. As an exception a folder directly in `root`
    may be a link (photographs on another disk): then the file must lie inside the linked folder.

    Raises:
        SceneError: the path is outside.
    """
    relative = Path(posixpath.normpath(name.replace("\\", "/")))
    path = root / relative
    lexically = not relative.anchor and ".." not in relative.parts and "\0" not in name and relative.parts
    homes = [(root / first).resolve() for first in ("", *relative.parts[:-1][:1])] if lexically else []
    try:
        real = path.resolve() if homes else path
        outside = not any(real.is_relative_to(home) for home in homes)
        path.is_file()
    except (OSError, RuntimeError):  # a name too long for the system; circular links
        outside = True
    if outside:
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


def number(values: Mapping[str, Any], key: str, file: Path, default: float | None = None) -> float:
    """Read a finite number from a JSON object of a file.

    Raises:
        SceneError: the value is anything else, or missing without a default.
    """
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SceneError(f"{file} has {key} = {value!r}: expected a finite number; correct it")
    return float(value)
