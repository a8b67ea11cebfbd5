"""Atomic files and folders: they appear under their final names only when they are complete."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import math
import os
import secrets
import shutil
import stat
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import Any, BinaryIO

from tidefield.errors import RunError, list_names

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

log = logging.getLogger(__name__)

LOCK_FILE = ".lock"
_LARGEST_JSON = 1 << 26
_USERS_TO_MEND = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG),  # no room
    *(errno.EACCES, errno.EPERM, errno.EROFS),  # no permission
    *(errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENOTEMPTY, errno.ENXIO),  # something else is there
    *(errno.ENAMETOOLONG, errno.ELOOP),
)
"""The system's errors about a place that a user names."""


def user_can_mend(error: OSError) -> bool:
    """Whether the system refused a place that a user named. Libraries that lose the number report a short write."""
    return error.errno is None or error.errno in _USERS_TO_MEND


def refuse_existing(*paths: Path, replaceable: bool = True) -> None:
    """Raise a RunError when one of the names exists already.

    Args:
        replaceable: whether the command has an --overwrite.
    """
    for path in paths:
        if os.path.lexists(path):
            or_replace = ", or pass --overwrite" if replaceable else ""
            raise RunError(f"{path} is there already: expected a new name; choose one{or_replace}")


@contextmanager
def writing_to(path: Path) -> Iterator[None]:
    """Turn the system's errors of a place that cannot be written to, or is full, into one clear error.

    Raises:
        RunError: instead of the system's own errors.
    """
    if "\0" in os.fspath(path):
        raise RunError(f"{os.fspath(path)!r} has a zero byte: expected a name that a file can have; choose another")
    try:
        yield
    except OSError as error:
        if not user_can_mend(error):
            raise
        reason = error.strerror or str(error)
        name = Path(error.filename) if isinstance(error.filename, str) else path
        if name.parent != path.parent and not is_partial(name):
            reason += f": {name}"
        raise RunError(
            f"{path} cannot be written ({reason}): expected a folder of yours with free space; make room, or choose "
            "another place"
        ) from error


@contextmanager
def reading_from(path: Path) -> Iterator[None]:
    """Turn the system's errors of a place that cannot be read into one clear error.

    Raises:
        RunError: instead of the system's own errors.
    """
    try:
        yield
    except OSError as error:
        if not user_can_mend(error):
            raise
        missing = isinstance(error, FileNotFoundError)
        wanted = "that exists; name another" if missing else "that you may read; ask its owner, or name another"
        raise RunError(f"{path} cannot be read ({error.strerror or error}): expected one {wanted}") from error


def require_writable(*paths: Path, overwrite: bool = False) -> None:
    """Raise now, before long work, what writing these files at its end would raise.

    Raises:
        RunError: one is there already and must not be overwritten, is a folder, or its folder cannot be written to.
    """
    for path in paths:
        if not overwrite:
            refuse_existing(path)
        with writing_to(path):
            _refuse_folder(path)
            there = next(folder for folder in path.absolute().parents if os.path.lexists(folder))
            probe = _partial_name(there / path.name)
            probe.touch()
            probe.unlink()


@contextmanager
def completed_file(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary name next to `path` to write to; renamed to `path` when the block ends, deleted when it fails.

    Raises:
        RunError: `path` is there already and must not be overwritten, is a folder, or its folder cannot be written to.
    """
    if not overwrite:
        refuse_existing(path)
    partial = _partial_name(path)
    with writing_to(path):
        _refuse_folder(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            partial.touch()
            mode = partial.stat().st_mode  # what the user's umask leaves; some writers would keep it to the user
            yield partial
            partial.chmod(mode)
            with partial.open("rb+") as file:
                # Without this a power cut may leave the final name with nothing behind it.
                os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            with suppress(OSError):  # it has its final name, or the error that is on its way says more
                partial.unlink()


def _partial_name(path: Path) -> Path:
    """A temporary name next to `path`; the suffix stays, because writers choose their format by it."""
    return path.with_name(f".{path.stem}-{secrets.token_hex(4)}.partial{path.suffix}")


def is_partial(path: Path) -> bool:
    """Whether a name is a temporary one, of a file or folder that is not complete."""
    return path.name.startswith(".") and ".partial" in path.suffixes


def delete_partials(*paths: Path) -> None:
    """Delete what processes that were killed while they wrote these files have left of them."""
    for path in paths:
        for partial in path.parent.glob(f".{escape(path.stem)}-????????.*partial{escape(path.suffix)}"):
            with writing_to(partial):
                partial.unlink(missing_ok=True)


def delete_files(folder: Path, files: Iterable[Path]) -> None:
    """Delete files in a folder, and the folders in it that hold nothing afterwards."""
    files = [file for file in files if not file.is_dir()]
    with writing_to(folder):
        for file in files:
            file.unlink(missing_ok=True)
    emptied = {one for file in files for one in file.relative_to(folder).parents[:-1]}
    for one in sorted(emptied, key=lambda path: len(path.parts), reverse=True):
        with suppress(OSError):  # it holds other files
            (folder / one).rmdir()


def is_empty(folder: Path) -> bool:
    """Whether a folder holds nothing, or only its lock."""
    with reading_from(folder):
        return all(path.name == LOCK_FILE for path in folder.iterdir())


@contextmanager
def only_writer(folder: Path, wait_seconds: float = 0.0) -> Iterator[None]:
    """Lock a folder, which is made, against other processes that write to it; one that still holds nothing is removed.

    The system releases the lock when the process dies, however it dies.

    Args:
        wait_seconds: for another process to end.

    Raises:
        RunError: it is a file, another process has the lock, or the folder cannot be written to.
    """
    if os.path.isfile(folder):
        raise RunError(f"{folder} is a file: expected a folder or a new name; choose another")
    made = [one for one in (folder, *folder.parents) if not os.path.lexists(one)]
    path, end = folder / LOCK_FILE, time.monotonic() + wait_seconds
    try:
        while (file := _locked(path)) is None:
            if time.monotonic() >= end:
                raise RunError(
                    f"another process is writing to {folder}: expected one at a time; wait until it ends, or choose "
                    "another folder"
                )
            time.sleep(min(0.2, wait_seconds))
        with file:
            try:
                yield
            finally:
                with suppress(OSError):  # Windows does not remove what is open; a lock that nobody holds does no harm
                    path.unlink()
    finally:
        for one in filter(os.path.lexists, made):
            with suppress(OSError):  # something is in it
                one.rmdir()


def is_locked(folder: Path) -> bool:
    """Whether a process writes to a folder under `only_writer`; one that was killed has left its lock file unlocked.

    A lock that may not be tried, of another user's, counts as held.
    """
    path = folder / LOCK_FILE
    try:
        with path.open("rb+") as file:
            return not _lock(file.fileno(), folder)
    except OSError:
        return os.path.exists(path)


def _locked(path: Path) -> BinaryIO | None:
    """Open a lock file, in a folder that is made, and lock it; None where another process has it."""
    with writing_to(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab")
    try:
        # The other process may have ended, and removed its lock, after we opened it.
        mine = _lock(file.fileno(), path.parent) and path.exists()
        if mine and os.path.samestat(os.stat(path), os.stat(file.fileno())):
            return file
    except BaseException:
        file.close()
        raise
    file.close()
    return None


def _lock(descriptor: int, folder: Path) -> bool:
    """Lock an open file; False where another process has."""
    try:
        if sys.platform == "win32":
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK):
            raise
        log.warning(f"{folder} is on a file system without locks: make sure that no other process writes to it")
    return True


def _refuse_folder(path: Path) -> None:
    if path.is_dir():
        raise RunError(f"{path} is a folder: expected the name of a file; choose another")


@contextmanager
def completed_folder(path: Path) -> Iterator[Path]:
    """A temporary folder next to `path` to fill; renamed to `path` when the block ends, deleted when it fails.

    Raises:
        RunError: `path` is there already, or the folder that it would be in cannot be written to.
    """
    refuse_existing(path, replaceable=False)
    if left := sorted(path.parent.glob(f".{escape(path.name)}-????????.partial")):
        log.warning(f"{list_names(list(map(str, left)))}: left by a command that was killed, unless one still runs")
    partial = path.with_name(f".{path.name}-{secrets.token_hex(4)}.partial")
    try:
        with writing_to(path):
            partial.mkdir(parents=True)
            yield partial
            refuse_existing(path, replaceable=False)  # one that was made meanwhile would be replaced if it is empty
            partial.rename(path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def file_sha256(path: Path) -> str:
    """The SHA-256 of what a file holds, read piece by piece."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_text(path: Path, text: str) -> None:
    """Replace a text file, whole or not at all.

    Raises:
        RunError: its folder cannot be written to.
    """
    with completed_file(path, overwrite=True) as partial:
        partial.write_text(text, encoding="utf-8")


def plain_cell(value: Any) -> Any:
    """A value of a table, of which no spreadsheet takes a text for a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r") else value


def write_json(path: Path, data: Any) -> None:
    """Replace a JSON file, likewise."""
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")


def _finite(text: str) -> float:
    """A number of JSON; this program writes none that is not finite."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no finite number")
    return value


def read_json(path: Path) -> Any:
    """The content of a JSON file that this program wrote, or None where there is none.

    Raises:
        RunError: when it is damaged, or no file of a sane size.
    """
    with reading_from(path):
        if not path.exists():
            return None
        status = path.stat()  # before it is opened: opening a pipe waits for who writes to it
        if not (stat.S_ISREG(status.st_mode) and status.st_size <= _LARGEST_JSON):
            raise RunError(
                f"{path} is not what this program wrote: expected a file of at most {_LARGEST_JSON / 1e6:.0f} MB; "
                "restore it, or delete it and repeat"
            )
        content = path.read_bytes() if status.st_size else b""  # the system's own files have no size, some no end
    try:
        return json.loads(content, parse_constant=_finite, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise RunError(
            f"{path} is not valid JSON ({error}): expected what this program wrote; restore it, or delete it and repeat"
        ) from error
