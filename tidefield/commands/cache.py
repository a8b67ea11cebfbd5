"""`tidefield cache`: show or empty the cache of decoded photographs and of what is estimated from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tyro.conf import OmitArgPrefixes

from tidefield.commands.common import Verbosity
from tidefield.errors import SceneError

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console


@dataclass(frozen=True)
class Cache:
    """Show the cache of decoded photographs and of what is estimated from them, or empty it.

    A scene that is opened for the first time at a width is decoded into one file of the cache; its points, exposures
    and lenses, as estimated, are kept in others. When a new file does not fit, those that were not used for the longest
    time are deleted. The environment variable TIDEFIELD_CACHE_GB sets the limit (20 gigabytes if not given),
    XDG_CACHE_HOME the folder that the cache is in.

    Copies of what is at addresses such as s3://bucket/scene are kept until the cache is emptied.
    """

    clear: bool = False
    """Delete all files; scenes are then decoded again when they are opened, and copied again from their addresses.
    Results that were not sent to their address yet stay."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def cache(options: Cache, console: Console) -> None:
    """Run `tidefield cache`."""
    from tidefield import addresses
    from tidefield.data import cache as files

    folder = files.cache_folder()
    if folder is None:
        raise SceneError("this user has no home folder for a cache: expected one; set XDG_CACHE_HOME to a folder")
    if options.clear:
        deleted = [*(one.bytes for one in files.clear(folder)), *addresses.clear()]
        console.print(f"deleted: {_describe(deleted)}")
    limit = files.limit_bytes() / 1e6
    sizes = [one.bytes for one in files.stored(folder)]
    console.print(f"{folder}: {_describe(sizes)} of at most {limit:,.0f} MB", soft_wrap=True)
    sent, changed = addresses.kept()
    if sent or changed:
        console.print(
            f"copies of files at addresses: {_describe(_sizes(sent))}; not sent yet: {_describe(_sizes(changed))}",
            soft_wrap=True,
        )


def _sizes(paths: list[Path]) -> list[int]:
    return [path.stat().st_size for path in paths]


def _describe(sizes: list[int]) -> str:
    each = "file" if len(sizes) == 1 else "files"
    return f"{len(sizes)} {each}, {sum(sizes) / 1e6:,.0f} MB"
