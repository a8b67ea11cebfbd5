"""`tidefield cache`: show or empty the cache of decoded photographs and of what is estimated from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tyro.conf import OmitArgPrefixes

from tidefield.commands.common import Verbosity
from tidefield.errors import SceneError

if TYPE_CHECKING:
    from rich.console import Console

    from tidefield.data.cache import Stored


@dataclass(frozen=True)
class Cache:
    """Show the cache of decoded photographs and of what is estimated from them, or empty it.

    A scene that is opened for the first time at a width is decoded into one file of the cache; its points, exposures
    and lenses, as estimated, are kept in others. When a new file does not fit, those that were not used for the longest
    time are deleted. The environment variable TIDEFIELD_CACHE_GB sets the limit (20 gigabytes if not given),
    XDG_CACHE_HOME the folder that the cache is in.
    """

    clear: bool = False
    """Delete all files; scenes are then decoded again when they are opened."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def cache(options: Cache, console: Console) -> None:
    """Run `tidefield cache`."""
    from tidefield.data import cache as files

    folder = files.cache_folder()
    if folder is None:
        raise SceneError("this user has no home folder for a cache: expected one; set XDG_CACHE_HOME to a folder")
    if options.clear:
        console.print(f"deleted: {_describe(files.clear(folder))}")
    limit = files.limit_bytes() / 1e6
    console.print(f"{folder}: {_describe(files.stored(folder))} of at most {limit:,.0f} MB", soft_wrap=True)


def _describe(files: list[Stored]) -> str:
    each = "file" if len(files) == 1 else "files"
    return f"{len(files)} {each}, {sum(one.bytes for one in files) / 1e6:,.0f} MB"
