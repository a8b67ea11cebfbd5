"""Words of pages: as they are, whatever Markdown means by them, and without the folders of this machine."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

_MARKS = re.compile(r"[!-/:-@\[-`{-~]")
"""What Markdown may take for a mark: the punctuation of ASCII."""


def shown(name: str) -> str:
    """Return a name as a page can show it: with bytes that are not UTF-8 as numbers."""
    return name.encode("utf-8", "backslashreplace").decode()


def plain(text: str) -> str:
    """Return Markdown that shows a text as it is."""
    return _MARKS.sub(r"\\\g<0>", shown(text))


def code(text: str) -> str:
    """Return Markdown that shows a text as code."""
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence} {shown(text)} {fence}" if len(fence) > 1 else f"`{shown(text)}`"


def without_folders(message: str, folders: Iterable[Path]) -> str:
    """Return a message that names files from some folders on, without where these lie."""
    places = {f"{parent}{os.sep}" for folder in folders for parent in (folder.parent, folder.resolve().parent)}
    for place in sorted(places - {f".{os.sep}"}, key=len, reverse=True):
        message = message.replace(place, "")
    return message
