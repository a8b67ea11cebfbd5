"""Photographs by the names that other files give them, and the text files that do."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from tidefield.errors import SurveyError, list_names

_MEGABYTES = 50
_SUFFIX = re.compile(r"\.[a-z][a-z0-9]{1,3}")


def folded(name: str) -> str:
    """A name as a file system that ignores case and the composition of accents compares it."""
    return unicodedata.normalize("NFC", name).casefold()


class Names:
    """The photographs of a survey, found by full or shortened names.

    A name may be the path in the survey's folder or the file's name alone, with or without its suffix, in any case.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._by_rule: tuple[dict[str, list[str]], ...] = ({}, {}, {}, {})
        for name in names:
            path = PurePosixPath(folded(name))
            keys = str(path), path.name, str(path.with_suffix("")), path.stem
            for found, key in zip(self._by_rule, keys, strict=True):
                found.setdefault(key, []).append(name)

    def find(self, text: str) -> str | None:
        """The photograph that `text` names, or None.

        Raises:
            SurveyError: it names several.
        """
        wanted = folded(text.strip().strip('"').replace("\\", "/").removeprefix("./"))
        path = PurePosixPath(wanted)
        by_path, by_name, by_bare_path, by_stem = self._by_rule
        # A path from another machine still ends in the file's name; a list of raw files still names their pictures.
        stem = path.stem if _SUFFIX.fullmatch(path.suffix) else path.name
        rules = (by_path, wanted), (by_name, path.name), (by_bare_path, wanted), (by_stem, path.name), (by_stem, stem)
        names = next((found[key] for found, key in rules if key in found), [])
        if len(names) > 1:
            raise SurveyError(
                f"{text} names {len(names)} photographs ({list_names(names)}): expected one; write its folder, too"
            )
        return names[0] if names else None


def read_text(path: Path) -> str:
    """The content of a small text file in UTF-8.

    Raises:
        SurveyError: it cannot be read, is far too large, or is in another encoding.
    """
    try:
        if path.stat().st_size > _MEGABYTES * 1_000_000:
            raise SurveyError(
                f"{path} has {path.stat().st_size / 1e6:.0f} MB: expected a list of at most {_MEGABYTES} MB; give the "
                "right file"
            )
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise SurveyError(f"{path} cannot be read ({error.strerror}): expected a text file; give one") from error
    except UnicodeDecodeError as error:
        raise SurveyError(
            f"{path} is not in UTF-8 (byte {error.start} cannot be read so): expected a text file in UTF-8; save it "
            "again in that encoding"
        ) from error


def find_file(folder: Path, names: Sequence[str]) -> Path | None:
    """The first of some files that is directly in a folder, whatever the case of its name."""
    files = {path.name.casefold(): path for path in sorted(folder.iterdir(), reverse=True) if path.is_file()}
    return next((files[name] for name in names if name in files), None)
