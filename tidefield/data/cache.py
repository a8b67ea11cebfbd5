"""The user's cache of decoded photographs and of what is estimated from them: its folder, its size, and what is deleted
from it.

Each file of it holds the photographs of one scene at one width (`data.images`), its points (`data.triangulate`), or its
cameras and points as estimated when it is opened (`data.load`), is named by a hash of everything that its content
depends on, and is touched when it is used. Before another is written, the files that were not used for the longest time
are deleted until it fits.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import stat
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from platformdirs import user_cache_path

from tidefield.errors import RunError, SceneError
from tidefield.files import completed_file

Arrays = dict[str, np.ndarray]

SUFFIX, POINTS_SUFFIX, ESTIMATES_SUFFIX = ".photographs", ".points", ".estimates"
LIMIT_VARIABLE, USUAL_LIMIT_GB = "TIDEFIELD_CACHE_GB", 20.0
_DAYS_KEPT_UNUSED = 60
_WRITERS_HOUR_SECONDS = 3600
"""A file that is being written grows all the time; one that did not for so long is of a program that was killed."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stored:
    """A file of the cache.

    Attributes:
        path: of the file.
        bytes: its size.
        used_at: when it was used last, or written if it is incomplete, in seconds since 1970.
    """

    path: Path
    bytes: int
    used_at: float

    @property
    def is_being_written(self) -> bool:
        return self.path.name.startswith(".") and time.time() - self.used_at < _WRITERS_HOUR_SECONDS


def cache_folder() -> Path | None:
    """$XDG_CACHE_HOME/tidefield on every system, or else the system's own folder for caches.

    None where the system knows no home folder of this user, as in containers.
    """
    chosen = os.environ.get("XDG_CACHE_HOME")
    if chosen:
        return Path(chosen) / "tidefield"
    try:
        folder = user_cache_path("tidefield", appauthor=False)
    except RuntimeError:
        return None
    return folder if folder.is_absolute() else None  # platformdirs before 4.5 returns "~/.cache"


def open_folder(folder: Path) -> None:
    """Make a cache folder if it is not there; raise a PermissionError for one in which others can put files.

    What is read from it is hardly checked.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.stat()
    # Windows has no such bits; there the folder belongs to the user's profile.
    if os.name == "posix" and (status.st_uid != os.geteuid() or status.st_mode & stat.S_IWOTH):
        raise PermissionError(errno.EPERM, "others own it or can write to it")


def identity(path: Path) -> tuple[str, int, int]:
    """Where a file is, its size and when it was changed: what must be the same for what was made of it to be used."""
    status = path.stat()
    return str(path.resolve()), status.st_size, status.st_mtime_ns


def key(parts: object) -> str:
    """Name a file of the cache by what its content depends on, as JSON."""
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:32]


def array_hash(array: np.ndarray) -> str:
    """Identify an array, for `key`."""
    whole = np.ascontiguousarray(array)
    return hashlib.sha256(f"{whole.dtype} {whole.shape}".encode() + whole.tobytes()).hexdigest()


@cache
def code_hash() -> str:
    """Identify the code that reads scenes, for `key`: what another version of it estimated is not used."""
    package = Path(__file__).parents[1]
    files = sorted(path for name in ("data", "geometry") for path in (package / name).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def kept_arrays(name: str, folder: Path | None, make: Callable[[], Arrays]) -> Arrays:
    """Read arrays from a file of the cache, or make them and keep them there for the next time.

    Args:
        name: of the file: a `key` and one of the suffixes.
        folder: the cache's; None where there is none.
        make: makes the arrays.
    """
    store = None
    try:
        if folder is not None:
            open_folder(folder)
            store = folder / name
    except OSError as error:  # `open_photographs` tells of it
        _log.debug("the cache folder %s cannot be used (%s)", folder, error.strerror)
    if store is not None and store.is_file():
        # A damaged file is made anew, and one that another program has deleted meanwhile.
        with suppress(ValueError, KeyError, EOFError, BadZipFile, OSError):
            with store.open("rb") as file, np.load(file, allow_pickle=False) as stored_arrays:
                arrays = dict(stored_arrays)
            touch(store)
            return arrays
    arrays = make()
    if store is not None:
        try:
            make_room(store.parent, sum(array.nbytes for array in arrays.values()))
            with completed_file(store, overwrite=True) as partial, partial.open("wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]
        except (OSError, RunError) as error:
            _log.warning("what was estimated from photographs cannot be kept for the next time: %s", error)
    return arrays


def touch(path: Path) -> None:
    """Mark a file as used now, where that is possible: a folder may allow reading alone."""
    with suppress(OSError):
        os.utime(path)


def limit_bytes() -> float:
    """The size that the cache may have, which $TIDEFIELD_CACHE_GB sets in gigabytes.

    Raises:
        SceneError: that is no such number.
    """
    text = os.environ.get(LIMIT_VARIABLE) or str(USUAL_LIMIT_GB)
    with suppress(ValueError):
        if float(text) >= 0:
            return float(text) * 1e9
    raise SceneError(f"{LIMIT_VARIABLE} is {text!r}: expected gigabytes, such as 50; set it so, or unset it")


def stored(folder: Path) -> list[Stored]:
    """List the files of the cache, least recently used first."""
    found = []
    for path in (path for suffix in (SUFFIX, POINTS_SUFFIX, ESTIMATES_SUFFIX) for path in folder.glob(f"*{suffix}")):
        with suppress(FileNotFoundError):  # another program has deleted it
            status = path.stat()
            found.append(Stored(path, status.st_size, status.st_mtime))
    return sorted(found, key=lambda one: one.used_at)


def make_room(folder: Path, size: int) -> None:
    """Delete files until one of `size` bytes fits, and those unused for `_DAYS_KEPT_UNUSED` days.

    One that is larger than the limit is written all the same: then it is the only one.
    """
    files = stored(folder)
    above = sum(one.bytes for one in files) + size - limit_bytes()
    oldest = time.time() - _DAYS_KEPT_UNUSED * 86400
    for one in files:
        dead = one.path.name.startswith(".") or one.used_at < oldest
        if (above > 0 or dead) and _delete(one):
            above -= one.bytes


def clear(folder: Path) -> list[Stored]:
    """Delete all files that no program is writing; returns them."""
    return [one for one in stored(folder) if _delete(one)]


def _delete(one: Stored) -> bool:
    """Delete a file, unless a program is writing it or (on Windows) has it open."""
    if one.is_being_written:
        return False
    with suppress(FileNotFoundError, PermissionError):
        # Programs that have mapped it keep its pixels, except on Windows.
        one.path.unlink()
        return True
    return False
