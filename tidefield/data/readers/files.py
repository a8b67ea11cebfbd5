"""Read files of a scene safely: bounded in size, inside the scene's folder, and with checked JSON numbers."""

from __future__ import annotations

import json
import math
import posixpath
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tidefield.errors import SceneError, list_names

_JSON_MEGABYTES = 256


def bounded_bytes(path: Path, megabytes: int) -> bytes:
    """Read a file of at most so many megabytes.

    Raises:
        SceneError: the file is larger, or cannot be read.
    """
    with _readable(path, megabytes):
        return path.read_bytes()


def bounded_lines(path: Path, megabytes: int) -> Iterator[str]:
    """Read a text file of at most so many megabytes line by line.

    Raises:
        SceneError: the file is larger, or cannot be read.
        UnicodeDecodeError: it is not UTF-8.
    """
    with _readable(path, megabytes), path.open(encoding="utf-8") as lines:
        yield from lines


def check_size(path: Path, megabytes: int) -> None:
    """Check that a file can be read, and has at most so many megabytes.

    Raises:
        SceneError: it cannot, or is larger.
    """
    with _readable(path, megabytes), path.open("rb"):
        pass


@contextmanager
def _readable(path: Path, megabytes: int) -> Iterator[None]:
    try:
        if path.stat().st_size > megabytes * 1_000_000:
            raise SceneError(
                f"{path} has {path.stat().st_size / 1e6:.0f} MB: expected at most {megabytes} MB for a file "
                "of this kind; export it again"
            )
        yield
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}; make it a readable file") from error


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
    missing = [path for path in paths if not path.is_file()]
    if missing and not allow_missing:
        raise SceneError(
            f"{len(missing)} of the {len(paths)} photographs that {named_by} names are missing: "
            f"{list_names([str(path) for path in missing])}; add them, or use --allow-missing to leave them out"
        )
    return present


def read_json(file: Path, megabytes: int = _JSON_MEGABYTES) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        SceneError: the file cannot be read, or holds anything else.
    """
    top = read_json_value(file, megabytes)
    if not isinstance(top, dict):
        raise SceneError(f"{file} holds a {type(top).__name__}: expected an object; export it again")
    return top


def read_json_value(file: Path, megabytes: int) -> Any:
    """Read a JSON file.

    Raises:
        SceneError: the file cannot be read, or is not valid JSON.
    """
    try:
        return json.loads(bounded_bytes(file, megabytes))
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{file} is not whole JSON ({error}); copy or export it again") from error


def number(values: Mapping[str, Any], key: str, file: Path, default: float | None = None) -> float:
    """Read a finite number from a JSON object of a file.

    Raises:
        SceneError: the value is anything else, or missing without a default.
    """
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SceneError(f"{file} has {key} = {value!r}: expected a finite number; correct it")
    return float(value)
