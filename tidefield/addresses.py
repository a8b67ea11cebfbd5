"""Files at addresses such as `s3://bucket/scene`, which fsspec reaches, as local copies.

Commands, and the libraries that they use, work on paths. So an address becomes a folder or a file in the user's cache:
`pull` makes that a copy of what is at the address before a command, and `push` sends what the command has changed there
afterwards. Both compare with a record of how each file was, here and there, when they were last the same: nothing is
transferred twice, and a file that has changed on both sides is never replaced.

On several machines the copies are under the same path, if the cache is.
"""

from __future__ import annotations

import filecmp
import os
import re
import shutil
import sqlite3
import stat
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, fields, is_dataclass
from datetime import datetime
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tidefield.data.cache import cache_folder, key, open_folder
from tidefield.errors import RunError, TidefieldError
from tidefield.files import LOCK_FILE, completed_file, is_partial, only_writer

if TYPE_CHECKING:
    from rich.console import Console

Progress = Callable[[int, int], None]

COPIES = "addresses"
"""The folder of the cache that holds the copies."""
_RECORDS, _LOCKS = ".records.sqlite", ".locks"
_WORD = re.compile(r"(--[a-z][a-z-]*=)?([a-z][a-z0-9+.-]+)://(.*)", re.DOTALL | re.IGNORECASE)  # longer than a drive
_CLUSTER = "ray"
"""Protocol of a cluster's address, which is none of files."""
_NO_NAMES = re.compile(r"|\.\.?|.*[\0\\\\].*" + (r'|.*[:*?"<>|].*' if os.name == "nt" else ""), re.DOTALL)
"""What no file or folder can be called, or leads out of its folder."""
_AT_ONCE = 64
"""Files that fsspec transfers at a time, as far as it can."""
_WAIT_SECONDS = 24 * 3600.0
_TIMES = ("mtime", "LastModified", "last_modified", "updated", "modified", "created")
_VERSIONS = ("ETag", "etag", "md5Hash", "sha", *_TIMES)
"""What the file systems of fsspec call what changes with a file."""


@dataclass(frozen=True)
class _There:
    """A file at an address: its name in fsspec's file system, its size, what changes with it, and when it did."""

    name: str
    bytes: int
    version: str
    seconds: float | None


@dataclass(frozen=True)
class _Record:
    """How a file was when its copy was last the same: there and here."""

    there: str
    here: str


def local_word(word: str) -> tuple[str, Path | None]:
    """A word of a command line with the path of the copy in place of an address, and that path; as it is without one.

    Raises:
        RunError: the address cannot have a copy.
    """
    found = _WORD.fullmatch(word)
    if found is None or found[2].lower() == _CLUSTER:
        return word, None
    option, protocol, rest = found[1], found[2].lower(), found[3]
    from fsspec import available_protocols

    if protocol not in available_protocols():
        raise RunError(
            f"{word} has the protocol {found[2]}, which is not known: expected one of fsspec's, such as s3, gs, abfs "
            "(of Azure), sftp or hdfs; correct it"
        )
    path = copy_of(f"{protocol}://{rest}")
    return f"{option or ''}{path}", path


def copy_of(address: str) -> Path:
    """The path of the copy of what is at an address.

    Raises:
        RunError: the address has parts that no path can have, or there is no folder for copies.
    """
    protocol, _, rest = address.partition("://")
    root = _root()
    if root is None:
        raise RunError(
            f"{address} needs a folder for its copy, but this user has no home folder: expected one; set XDG_CACHE_HOME"
        )
    return root.joinpath(protocol, *_parts(rest.strip("/"), address))


def path_of(name: str) -> Path:
    """The path of a scene or folder by its name in a file: that of its copy where the name is an address."""
    return Path(local_word(name)[0])


def address_of(path: Path) -> str | None:
    """The address whose copy a path is; None where it is none."""
    root = _root()
    if root is None or not Path(os.path.abspath(path)).is_relative_to(root):
        return None
    protocol, *parts = Path(os.path.abspath(path)).relative_to(root).parts or ("",)
    absolute = "/" if protocol in ("file", "local") else ""
    return f"{protocol}://{absolute}{'/'.join(parts)}" if parts else None


@contextmanager
def up_to_date(paths: Sequence[Path], console: Console) -> Iterator[None]:
    """Copies that are as their addresses when the block starts, and are sent there when it has ended well."""
    from tidefield.progress import ProgressBar

    for path in paths:
        with ProgressBar(console, f"Copying {address_of(path)}") as bar:
            pull(path, bar)
            for other in _companions(path):
                pull(other)
    try:
        yield
    except TidefieldError as error:
        text = str(error)
        for path in paths:
            text = text.replace(str(path), str(address_of(path)))
        if text == str(error):
            raise
        raise type(error)(text) from error
    for path in paths:
        with ProgressBar(console, f"Sending {address_of(path)}") as bar:
            sent = push(path, bar) + sum(push(other) for other in _companions(path))
        if sent:
            each = "file" if sent == 1 else "files"
            console.print(f"{address_of(path)}: {sent} changed {each}", highlight=False, soft_wrap=True)


def _companions(path: Path) -> set[Path]:
    """The copies of files that are written and read together with a single one, as view_depth.npy with view.png."""
    address = address_of(path)
    if address is None or not path.suffix or path.is_dir():
        return set()
    found = set(path.parent.glob(f"{escape(path.stem)}_*"))
    with _reaching(address):
        system, root = _system(address)
        folder, _, name = root.rpartition("/")
        with suppress(FileNotFoundError, NotADirectoryError):
            files = (info for info in system.ls(folder, detail=True) if info["type"] == "file")
            names = [info["name"].rpartition("/")[2] for info in files]
            found |= {path.with_name(one) for one in names if one.startswith(f"{name.removesuffix(path.suffix)}_")}
    return {one for one in found if not one.is_dir()}


def pull(path: Path, progress: Progress | None = None) -> int:
    """Make a copy that of what is at its address now; a path that is no copy is left as it is.

    What was changed here, and not there, stays.

    Returns:
        Bytes that were transferred.

    Raises:
        RunError: the address cannot be reached, the disk is too small, or a file was changed here and there.
    """
    address = address_of(path)
    if address is None:
        return 0
    with _locked(address), _reaching(address), _records() as records:
        system, root = _system(address)
        there, known = _listing(system, root, address), records.under(address)
        parts = [
            part
            for part, file in there.items()
            if part not in known or known[part].there != file.version or _version_here(_file(path, part)) is None
        ]
        size = sum(there[part].bytes for part in parts)
        path.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(path.parent).free
        if size > free:
            raise RunError(
                f"{address} has {size / 1e9:.1f} GB to copy, but the disk of {path.parent} has {free / 1e9:.1f} GB "
                "left: expected room for them; free some (`tidefield cache --clear`), or set XDG_CACHE_HOME to a "
                "folder on another disk"
            )
        for part in set(known) - set(there):
            own = _file(path, part)
            if _version_here(own) == known[part].here:
                own.unlink()
            records.forget(address, part)
        for first in range(0, len(parts), _AT_ONCE):
            some = parts[first : first + _AT_ONCE]
            _fetch(system, {part: there[part] for part in some}, known, path, address, records)
            if progress:
                progress(first + len(some), len(parts))
    return size


def push(path: Path, progress: Progress | None = None) -> int:
    """Send what has changed in a copy to its address, and delete there what was deleted here.

    Where nothing changed, nothing was deleted by a command, which would have written something, too: the copy was
    cleared away, and what is at the address stays.

    Returns:
        Files that were sent or deleted.

    Raises:
        RunError: the address cannot be written to, or a file was changed there, too.
    """
    address = address_of(path)
    if address is None:
        return 0
    with _locked(address), _reaching(address), _records() as records:
        here = {part: version for part in _own_files(path) if (version := _version_here(_file(path, part)))}
        known = records.under(address)  # after the files: what `clear` takes away it has forgotten before
        changed = [part for part, version in here.items() if part not in known or known[part].here != version]
        deleted = [part for part in known if part not in here]
        if not changed:
            for part in deleted:
                records.forget(address, part)
            return 0
        system, root = _system(address)
        there = _listing(system, root, address)
        for part in (*changed, *deleted):
            was = known[part].there if part in known else None
            now = there[part].version if part in there else None
            if now is not None and now != was:
                raise _both_changed(_joined(address, part), _file(path, part))
        names = {part: _joined(root, part) for part in changed}
        for first in range(0, len(changed), _AT_ONCE):
            some = changed[first : first + _AT_ONCE]
            for folder in {name.rpartition("/")[0] for name in (names[part] for part in some)} - {""}:
                system.makedirs(folder, exist_ok=True)
            system.put([str(_file(path, part)) for part in some], [names[part] for part in some])
            system.invalidate_cache()
            for part in some:
                records.keep(address, part, _Record(_version_there(system.info(names[part]), address), here[part]))
            if progress:
                progress(first + len(some), len(changed))
        for part in deleted:
            if part in there:
                system.rm_file(there[part].name)
            records.forget(address, part)
    return len(changed) + len(deleted)


def pull_all(options: object) -> None:
    """`pull` all paths of a dataclass, and of those in it."""
    for field in fields(options):  # type: ignore[arg-type]
        value = getattr(options, field.name)
        if isinstance(value, Path):
            pull(value)
        elif is_dataclass(value):
            pull_all(value)


def kept() -> tuple[list[Path], list[Path]]:
    """The files of all copies: those that are as at their addresses, and those whose changes were not sent."""
    root = _root()
    if root is None or not (root / _RECORDS).is_file():
        return [], []
    sent: list[Path] = []
    with _records() as records:
        for name, record in records.all():
            path = copy_of(name)
            if _version_here(path) == record.here:
                sent.append(path)
    all_files = (root / protocol / part for protocol in _protocols(root) for part in _own_files(root / protocol))
    return sent, sorted(set(all_files) - set(sent))


def clear() -> list[int]:
    """Delete the files of all copies that are as at their addresses; returns their sizes."""
    sent, _ = kept()
    sizes = [path.stat().st_size for path in sent]
    if sent:
        with _records() as records:
            for path in sent:
                name = address_of(path)
                assert name is not None, "it is a copy"
                record = records.under(name)[""]
                records.forget(name, "")  # first: what is on record and not here would be deleted there
                try:
                    path.unlink()
                except PermissionError:  # on Windows, of a file that a program has open
                    records.keep(name, "", record)
    return [size for path, size in zip(sent, sizes, strict=True) if not path.exists()]


def _root() -> Path | None:
    folder = cache_folder()
    return None if folder is None else Path(os.path.realpath(folder / COPIES))


def _protocols(root: Path) -> list[str]:
    return [path.name for path in root.iterdir() if path.is_dir() and path.name != _LOCKS]


def _parts(name: str, address: str) -> tuple[str, ...]:
    parts = tuple(name.split("/"))
    if any(_NO_NAMES.fullmatch(part) for part in parts):
        raise RunError(
            f"{address} has {name!r}, which no file can be called here: expected names of folders and files between "
            "slashes; rename it"
        )
    return parts


def _file(path: Path, part: str) -> Path:
    return path / part if part else path


def _joined(address: str, part: str) -> str:
    return f"{address}/{part}" if part else address


def _version_here(path: Path) -> str | None:
    """What changes with a local file; None where there is none."""
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return f"{status.st_size} {status.st_mtime_ns}" if stat.S_ISREG(status.st_mode) else None


def _version_there(info: Mapping[str, Any], address: str) -> str:
    found = [f"{name} {info[name]}" for name in _VERSIONS if info.get(name) is not None][:1]
    if not found:
        raise RunError(
            f"{address} is on a file system that does not tell when files change: expected one that does, such as S3, "
            "Google Cloud, Azure or SFTP; copy the files to a folder, and name that"
        )
    return f"{info.get('size')} {found[0]}"


def _seconds(info: Mapping[str, Any]) -> float | None:
    """When a file was changed, in seconds since 1970, as far as its file system tells it in a known form."""
    time = next((info[name] for name in _TIMES if info.get(name) is not None), None)
    if isinstance(time, str):
        with suppress(ValueError):
            time = datetime.fromisoformat(time)
    return time.timestamp() if isinstance(time, datetime) else float(time) if isinstance(time, int | float) else None


def _own_files(path: Path) -> Iterator[str]:
    """The files of a copy by their names in it, `""` for that of a single file; no locks, links or unfinished ones."""
    if path.is_file():
        yield ""
    for folder, folders, names in os.walk(path):
        folders[:] = [name for name in folders if not is_partial(Path(name))]
        for own in (Path(folder, name) for name in names):
            if not is_partial(own) and own.name != LOCK_FILE and not own.is_symlink():
                yield own.relative_to(path).as_posix()


def _system(address: str) -> tuple[Any, str]:
    """The file system of an address, which knows nothing from before, and the name in it."""
    from fsspec.core import url_to_fs

    system, root = url_to_fs(address)
    system.invalidate_cache()
    return system, root.rstrip("/")


def _listing(system: Any, root: str, address: str) -> dict[str, _There]:
    """The files at an address by their names in it; none where nothing is there."""
    found = {}
    with suppress(FileNotFoundError):  # some raise it where others find nothing
        found = system.find(root, detail=True)
    files = {}
    for name, info in found.items():
        info = info or system.info(name)  # some list a single file without what they know of it
        part = name.removeprefix(root).lstrip("/")
        if info["type"] == "file" and not name.endswith("/"):  # S3's folders are empty files
            if part:
                _parts(part, address)
            files[part] = _There(name, info.get("size") or 0, _version_there(info, address), _seconds(info))
    return files


def _fetch(
    system: Any,
    there: Mapping[str, _There],
    known: Mapping[str, _Record],
    path: Path,
    address: str,
    records: _Records,
) -> None:
    """Copy files, and note how they are; one that is here already has to be the same if it was changed here."""
    with ExitStack() as stack:
        partials = {}
        for part in there:
            own = _file(path, part)
            own.parent.mkdir(parents=True, exist_ok=True)
            here = _version_here(own)
            changed = here is not None and (part not in known or known[part].here != here)
            partials[part] = stack.enter_context(_replacing(own, changed, _joined(address, part)))
        system.get([file.name for file in there.values()], [str(partial) for partial in partials.values()])
    for part, file in there.items():
        if file.seconds is not None:  # the same on every machine: `prepare` knows unchanged photographs by it
            os.utime(_file(path, part), (time.time(), file.seconds))
        here = _version_here(_file(path, part))
        assert here is not None, "it has just been copied"
        records.keep(address, part, _Record(file.version, here))


@contextmanager
def _replacing(path: Path, changed: bool, address: str) -> Iterator[Path]:
    """A name to copy a file to, which then replaces `path`; one that was changed here has to be equal.

    Raises:
        RunError: it is not.
    """
    with completed_file(path, overwrite=True) as partial:
        yield partial
        if changed and not filecmp.cmp(partial, path, shallow=False):
            raise _both_changed(address, path)


def _both_changed(address: str, path: Path) -> RunError:
    return RunError(
        f"{address} has changed since it was copied, and so has its copy {path}: expected one to change; delete the "
        "one that is not wanted, or choose another address for results"
    )


@contextmanager
def _reaching(address: str) -> Iterator[None]:
    """Turn the errors of fsspec's file systems, which are of many kinds, into one clear error."""
    try:
        yield
    except (RunError, KeyboardInterrupt):
        raise
    except ImportError as error:
        raise RunError(
            f"{address} needs a package that is not installed ({error}): expected fsspec's one for this protocol; "
            "install it"
        ) from error
    except Exception as error:
        reason = str(error).strip() or type(error).__name__
        raise RunError(
            f"{address} cannot be reached ({reason}): expected an address that you may read, and write if it is for "
            "results; check it, and how its file system finds your credentials"
        ) from error


@contextmanager
def _locked(address: str) -> Iterator[None]:
    """Wait until no other process copies from or to the same address."""
    root = _root()
    assert root is not None, "the address has a copy"
    open_folder(root)
    with only_writer(root / _LOCKS / key(address), _WAIT_SECONDS):
        yield


class _Records:
    """How files were when they were last the same here and there, in a database that processes share."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database
        database.execute("CREATE TABLE IF NOT EXISTS files (name TEXT PRIMARY KEY, there TEXT, here TEXT)")

    def under(self, address: str) -> dict[str, _Record]:
        """Of what is at an address, by names in it."""
        rows = self._database.execute(
            "SELECT name, there, here FROM files WHERE name = ? OR (name > ? AND name < ?)",
            (address, f"{address}/", f"{address}0"),  # 0 follows / in Unicode
        )
        return {name.removeprefix(address).lstrip("/"): _Record(there, here) for name, there, here in rows}

    def all(self) -> list[tuple[str, _Record]]:
        rows = self._database.execute("SELECT name, there, here FROM files ORDER BY name")
        return [(name, _Record(there, here)) for name, there, here in rows]

    def keep(self, address: str, part: str, record: _Record) -> None:
        self._database.execute(
            "INSERT OR REPLACE INTO files VALUES (?, ?, ?)", (_joined(address, part), record.there, record.here)
        )

    def forget(self, address: str, part: str) -> None:
        self._database.execute("DELETE FROM files WHERE name = ?", (_joined(address, part),))


@contextmanager
def _records() -> Iterator[_Records]:
    root = _root()
    assert root is not None, "the address has a copy"
    with closing(sqlite3.connect(root / _RECORDS, timeout=60, isolation_level=None)) as database:
        yield _Records(database)
