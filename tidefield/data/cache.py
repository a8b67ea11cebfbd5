"""The user's cache of decoded photographs and triangulated points: its folder, its size, and what is deleted from it.

Each file of it holds the photographs of one scene at one width (`data.images`) or its points (`data.triangulate`), is
named by a hash of everything that its content depends on, and is touched when it is used. Before another is written,
the files that were not used for the longest time are deleted until it fits.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import stat
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from platformdirs import user_cache_path

from tidefield.errors import SceneError

SUFFIX, POINTS_SUFFIX = ".photographs", ".points"
LIMIT_VARIABLE, USUAL_LIMIT_GB = "TIDEFIELD_CACHE_GB", 20.0
_DAYS_KEPT_UNUSED = 60
_WRITERS_HOUR_SECONDS = 3600
"""A file that is being written grows all the time; one that did not for so long is of a program that was killed."""


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
    for path in (path for suffix in (SUFFIX, POINTS_SUFFIX) for path in folder.glob(f"*{suffix}")):
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
