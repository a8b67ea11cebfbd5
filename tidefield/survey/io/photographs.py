"""A folder of photographs as cameras write them, and what lies beside it, to a `Survey`; no pixels are decoded."""

from __future__ import annotations

import os
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from PIL import ExifTags

from tidefield.errors import SurveyError, list_names
from tidefield.machine import cores
from tidefield.survey.io import metadata as tags
from tidefield.survey.io.control import CONTROL_FILES, read_control
from tidefield.survey.io.gps_files import GPS_FILES, read_gps_file
from tidefield.survey.io.lens_prior import lens_prior
from tidefield.survey.io.names import Names, find_file, folded
from tidefield.survey.io.pictures import opened, refuse_truncated, stored_size, upright_size
from tidefield.survey.io.positions import drop_astray, drop_impossible
from tidefield.survey.survey import Photograph, Survey

FEWEST = 3
"""Photographs that a survey needs: two give no overlap to check the poses with."""

_PICTURES = (".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff")
_RAWS = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".gpr", ".iiq", ".kdc", ".mef", ".mos"),
    *(".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
)
_OTHER_PICTURES = (".heic", ".heif", ".avif", ".webp", ".jp2", ".jxl", ".bmp")
# What storage systems put beside pictures, and the folders of OpenDroneMap's results.
_FOREIGN_FOLDERS = ("@eadir", "__macosx", "opensfm", "odm_")


def read_survey(folder: Path, gps: Path | None = None, control: Path | None = None) -> Survey:
    """All photographs (JPEG, PNG, TIFF) in a folder and its sub-folders, with positions and ground control.

    Hidden folders and those of scenes (with a `sparse` folder or a `georeference.json` in them) and of OpenDroneMap's
    results are passed over. A `gps.csv` or ODM's `geo.txt` directly in the folder gives positions to photographs whose
    EXIF has none, an ODM `gcp_list.txt` ground control.

    Args:
        folder: the photographs.
        gps: a file of positions, which count more than EXIF's.
        control: a file of ground control in the format of ODM's gcp_list.txt.

    Raises:
        SurveyError: there are fewer than three photographs that can be read, two that differ in their suffix or the
            case of their names only, or a file beside them that cannot be understood.
    """
    paths, undeveloped, others = _list(folder)
    _refuse_none(folder, paths, undeveloped, others)
    names = [path.relative_to(folder).as_posix() for path in paths]
    _refuse_collisions(names)
    remarks = []
    if undeveloped:
        remarks.append(
            f"{len(undeveloped)} camera raw files are not read ({list_names(undeveloped)}): develop them first."
        )
    with ThreadPoolExecutor(min(8, 2 * cores())) as pool, warnings.catch_warnings():
        # Pillow's, of tags that it cannot read; they name no file, and what is not read is unknown.
        warnings.simplefilter("ignore", UserWarning)
        read = list(pool.map(_read, paths, names))
    photographs = [photograph for photograph in read if isinstance(photograph, tuple)]
    unread = [f"Left out: {problem}" for problem in read if isinstance(problem, str)]
    if len(photographs) < FEWEST:
        raise SurveyError(
            f"{folder} has {len(photographs)} photographs that can be read: expected at least {FEWEST} that overlap by "
            "more than half; add more" + "".join(f"\n{problem}" for problem in unread)
        )
    remarks += unread + _damaged(photographs)
    located, about_positions = _locate(folder, [photograph for photograph, _ in photographs], gps)
    control = control or find_file(folder, CONTROL_FILES)
    survey = Survey(folder, tuple(sorted(located, key=lambda photograph: photograph.name)), None)
    ground, about_control = read_control(control, survey.photographs) if control else (None, [])
    return replace(survey, control=ground, remarks=(*remarks, *about_positions, *about_control))


def _list(folder: Path) -> tuple[list[Path], list[str], list[str]]:
    """Photographs, and the names of camera raw files and of other pictures."""
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise SurveyError(f"{folder} is {found}: expected a folder of photographs; give one")
    photographs, undeveloped, others = [], [], []
    for path in _walk(folder):
        suffix = path.suffix.casefold()
        if suffix in _PICTURES:
            photographs.append(path)
        elif suffix in _RAWS or suffix in _OTHER_PICTURES:
            (undeveloped if suffix in _RAWS else others).append(path.relative_to(folder).as_posix())
    return sorted(photographs), sorted(undeveloped), sorted(others)


def _walk(folder: Path) -> Iterator[Path]:
    def refuse(error: OSError) -> None:
        raise SurveyError(f"{error.filename} cannot be read ({error.strerror}): expected a folder of yours; give one")

    for place, folders, files in os.walk(folder, onerror=refuse):
        here = Path(place)
        folders[:] = [name for name in folders if not (name.startswith(".") or _is_foreign(here / name))]
        yield from (here / name for name in files if not name.startswith("."))


def _is_foreign(folder: Path) -> bool:
    # The last is in a scene that is still being prepared.
    is_scene = any((folder / part).exists() for part in ("sparse", "georeference.json", "prepare/stages.json"))
    return is_scene or folder.name.casefold().startswith(_FOREIGN_FOLDERS)


def _refuse_none(folder: Path, paths: Sequence[Path], undeveloped: Sequence[str], others: Sequence[str]) -> None:
    if paths:
        return
    if undeveloped:
        raise SurveyError(
            f"{folder} has {len(undeveloped)} camera raw files ({list_names(undeveloped)}) and no photographs: "
            "expected JPEG, PNG or TIFF; develop them first, all with the same settings"
        )
    found = f"pictures of other kinds ({list_names(others)})" if others else "no photographs"
    raise SurveyError(f"{folder} has {found}: expected JPEG, PNG or TIFF files; give their folder, or convert them")


def _refuse_collisions(names: Sequence[str]) -> None:
    """A scene is written with one suffix, and may be copied to a file system that ignores case."""
    found: dict[str, list[str]] = defaultdict(list)
    for name in names:
        found[folded(name.rpartition(".")[0])].append(name)
    same = next((several for several in found.values() if len(several) > 1), None)
    if same:
        raise SurveyError(
            f"{list_names(same)} differ in their suffix or in upper and lower case only: expected one file per "
            "photograph; take one of them away or rename it"
        )


def _read(path: Path, name: str) -> tuple[Photograph, tuple[str, ...]] | str:
    """A photograph and which blocks of its metadata are damaged, or why it cannot be read."""
    try:
        with opened(path) as picture:
            found = tags.read_metadata(picture)
            width, height = stored_size(picture)
            refuse_truncated(path, picture)
    except SurveyError as error:
        return str(error)
    orientation = tags.orientation(found)
    upright_width, upright_height = upright_size(width, height, orientation)
    photograph = Photograph(
        path=path,
        name=name,
        width=upright_width,
        height=upright_height,
        orientation=orientation,
        camera=tags.camera(found),
        serial=tags.serial(found),
        focal_mm=found.number(ExifTags.Base.FocalLength),
        lens=lens_prior(found, width, height, orientation),
        time_s=tags.time_s(found),
        log_exposure=tags.log_exposure(found),
        position=tags.position(found),
        relative_altitude_m=tags.relative_altitude_m(found),
        gimbal_deg=tags.gimbal_deg(found),
    )
    return photograph, found.damaged


def _damaged(photographs: Sequence[tuple[Photograph, tuple[str, ...]]]) -> list[str]:
    remarks = []
    for block in ("EXIF", "XMP"):
        names = [photograph.name for photograph, damaged in photographs if block in damaged]
        if names:
            remarks.append(f"The {block} metadata of {list_names(names)} is damaged and was not read.")
    return remarks


def _locate(folder: Path, photographs: Sequence[Photograph], gps: Path | None) -> tuple[list[Photograph], list[str]]:
    """Positions from EXIF and from a file, checked."""
    located, remarks = drop_impossible(photographs)
    file = gps
    if file is None and any(photograph.position is None for photograph in located):
        file = find_file(folder, GPS_FILES)
    if file is not None:
        found = read_gps_file(file, Names(photograph.name for photograph in photographs))
        for index, photograph in enumerate(located):
            told = found.get(photograph.name)
            if told and (gps or photograph.position is None):
                gimbal = photograph.gimbal_deg or told.gimbal_deg
                located[index] = replace(photograph, position=told.position, gimbal_deg=gimbal)
        located, more = drop_impossible(located)
        remarks += more
    located, astray = drop_astray(located)
    remarks += astray
    without = [photograph.name for photograph in located if photograph.position is None]
    if without:
        remarks.append(f"{len(without)} of {len(located)} photographs have no position: {list_names(without)}.")
    return located, remarks
