"""Read the text files of a survey: lists of lines, numbers, photographs' names, coordinate reference systems."""

from __future__ import annotations

import re
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from pyproj import CRS

from tidefield.errors import SurveyError, list_names
from tidefield.geometry.geodesy import has_unstated_unit, parse_crs

_MAX_MEGABYTES = 50
_MAX_WORDS = 64
"""Of a photograph's name: each further word is one more name to look up, so that long lines would take hours."""
_CAMERA_FOLDER = re.compile(r"\d{3}\w+")
"""As cameras name the folders of a card (DCF)."""
_SUFFIX = re.compile(r"\.[a-z][a-z0-9]{1,3}")
_UTM = re.compile(r"WGS\s*-?\s*84[\s/,]+UTM\s*(?:zone)?\s*(\d{1,2})\s*([NS])", re.IGNORECASE)
_CODE = re.compile(r"\+|\w+[:[]")
"""How a proj4 string, a code and WKT begin."""


class PhotographNames:
    """Index of the photographs of a survey by full or shortened name.

    A name may be the path in the survey's folder or the file name alone, with or without suffix, in any case. One in
    another of a camera's folders (100MEDIA, 101MEDIA) is another photograph: numbers start again in each.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names: dict[tuple[str, str], list[str]] = defaultdict(list)
        for name in names:
            path = PurePosixPath(normalise_name(name))
            self._names["path", str(path)].append(name)
            self._names["name", path.name].append(name)
            self._names["bare path", str(path.with_suffix(""))].append(name)
            self._names["stem", path.stem].append(name)

    def find(self, text: str) -> str | None:
        """The photograph with this name, or None.

        Raises:
            SurveyError: several photographs match.
        """
        wanted = normalise_name(text.strip().strip('"').replace("\\", "/").removeprefix("./"))
        path = PurePosixPath(wanted)
        # A path of another machine still ends in the folder, if there are several, and the file name; a list of raw
        # files still names their JPEGs.
        stem = path.stem if _SUFFIX.fullmatch(path.suffix) else path.name
        tails = ["/".join(path.parts[k:]) for k in range(len(path.parts) - 1)]
        places = [(kind, tail) for kind in ("path", "bare path") for tail in (wanted, *tails)]
        keys = *places, ("name", path.name), ("stem", path.name), ("stem", stem)
        names = next((self._names[key] for key in keys if key in self._names), [])
        if len(names) > 1:
            raise SurveyError(
                f"{text} names {len(names)} photographs ({list_names(names)}): expected one; write its folder, too"
            )
        if not names:
            return None
        folders = {path.parent.name, PurePosixPath(normalise_name(names[0])).parent.name}
        return None if len(folders) > 1 and all(map(_CAMERA_FOLDER.fullmatch, folders)) else names[0]

    def split(self, line: str) -> tuple[str | None, list[str]]:
        """Split a line that begins with a photograph's name, which may have spaces, into the name and further cells."""
        joint = "\t" if "\t" in line else " "
        cells = line.split("\t") if "\t" in line else line.split()
        for count in range(min(len(cells), _MAX_WORDS), 0, -1):
            name = self.find(joint.join(cells[:count]))
            if name is not None:
                return name, cells[count:]
        return None, cells[1:]


def normalise_name(name: str) -> str:
    """Fold case and compose accents, as file systems do that ignore both."""
    return unicodedata.normalize("NFC", name).casefold()


def find_file(folder: Path, names: Sequence[str]) -> Path | None:
    """Find the first of some files directly in a folder, in any case."""
    files = {path.name.casefold(): path for path in sorted(folder.iterdir(), reverse=True) if path.is_file()}
    return next((files[name] for name in names if name in files), None)


def read_lines(path: Path) -> list[str]:
    """Read a small text file in UTF-8.

    Raises:
        SurveyError: it cannot be read, is far too large, or has another encoding.
    """
    try:
        if path.exists() and not path.is_file():
            raise SurveyError(f"{path} is no regular file: expected a text file; give one")
        with path.open("rb") as file:
            content = file.read(_MAX_MEGABYTES * 1_000_000 + 1)
        if len(content) > _MAX_MEGABYTES * 1_000_000:
            raise SurveyError(
                f"{path} has more than {_MAX_MEGABYTES} MB: expected a list of photographs; give the right file"
            )
        return content.decode("utf-8-sig").splitlines()
    except OSError as error:
        raise SurveyError(f"{path} cannot be read ({error.strerror}): expected a text file; give one") from error
    except UnicodeDecodeError as error:
        raise SurveyError(
            f"{path} is not in UTF-8 (byte {error.start} is invalid): expected a text file in UTF-8; save it again in "
            "that encoding"
        ) from error


def read_list(path: Path) -> tuple[str, list[tuple[str, str]]]:
    """Read one of ODM's lists: a coordinate reference system, then one item per line, with comments (#) between.

    The system is "EPSG:27700", a proj4 string, WKT, or "WGS84 UTM 32N".

    Returns:
        The system as pyproj understands it, and for every item its file and line number, for messages, and its text.

    Raises:
        SurveyError: the file cannot be read, or its first line is no projected or geographic system.
    """
    lines = read_lines(path)
    header, crs = _header(lines)
    try:
        parse_crs(crs)
    except ValueError as error:
        raise SurveyError(
            f"the first line of {path} is {header.strip()[:80]!r}: expected a projected or geographic coordinate "
            'reference system such as "EPSG:27700", "+proj=utm +zone=32 +datum=WGS84" or "WGS84 UTM 32N"; write one'
        ) from error
    items = [(f"{path}, line {number}", line.strip()) for number, line in enumerate(lines, start=1) if line != header]
    return crs, [(where, text) for where, text in items if text and not text.startswith("#")]


def _header(lines: Sequence[str]) -> tuple[str, str]:
    """The first line that is no comment, and as pyproj understands it."""
    header = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    utm = _UTM.fullmatch(header.strip())
    return header, f"EPSG:{326 if utm[2].upper() == 'N' else 327}{int(utm[1]):02d}" if utm else header.strip()


def first_system(lines: Sequence[str]) -> CRS | None:
    """The coordinate reference system that the first line that is no comment is; None where it is none."""
    try:
        return parse_crs(_header(lines)[1])
    except ValueError:
        return None


def names_a_system(lines: Sequence[str]) -> bool:
    """Whether the first line that is no comment names its coordinate reference system as no title would.

    That is by a code, a proj4 string, WKT, or a name with a number, such as "ETRS89". PROJ takes "Tokyo", "Survey" and
    "2024" for systems, too.
    """
    header = _header(lines)[0].strip()
    if _CODE.match(header) or _UTM.fullmatch(header):
        return True
    name, own = (re.sub(r"[\s/_-]", "", text).casefold() for text in (header, parse_crs(header).name))
    return name == own and re.search(r"\d", name) is not None


def unit_remarks(path: Path, system: CRS) -> list[str]:
    """Say what the unit of heights in one of ODM's lists is where their system leaves it open.

    ODM takes them in metres (https://github.com/OpenDroneMap/ODM/issues/1932).
    """
    if not has_unstated_unit(system):
        return []
    return [
        f"{path.name}: the unit of {system.name} is the {system.axis_info[0].unit_name}, and it defines no heights; "
        "these are taken in metres, as ODM does. If they have another unit, name their system, too, as in "
        '"EPSG:2263+6360" (NAVD88 in US survey feet).'
    ]


def leading_numbers(cells: Iterable[str]) -> list[float]:
    """Read the numbers with which a row of cells begins, up to the first cell that is none; NaN counts as one."""
    numbers = []
    for cell in cells:
        try:
            numbers.append(float(cell))
        except ValueError:
            break
    return numbers
