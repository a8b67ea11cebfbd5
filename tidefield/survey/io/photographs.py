"""Read a folder of photographs, with their positions and ground control, as a `Survey`; no pixels are decoded."""

from __future__ import annotations

import math
import os
import warnings
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Int64
from PIL import ExifTags

from tidefield.data.pictures import check_mask
from tidefield.data.readers.files import quiet_pillow
from tidefield.data.readers.masks import mask_names
from tidefield.errors import SurveyError, list_names
from tidefield.machine import cores
from tidefield.survey.io.gcp_file import CONTROL_FILES, read_control
from tidefield.survey.io.image_decoding import (
    HEIFS,
    has_alpha,
    open_image,
    refuse_truncated,
    stored_size,
    upright_size,
)
from tidefield.survey.io.lens_prior import lens_prior
from tidefield.survey.io.metadata import CORRECTED_M, ROUNDING_M, PhotographMetadata, read_metadata
from tidefield.survey.io.positions import locate_photographs
from tidefield.survey.io.text_files import find_file, normalise_name
from tidefield.survey.survey import Photograph, Survey

MASKS = "masks"
"""Folder of masks next to the photographs, and in a scene."""
FEWEST = 3
"""Fewest photographs of a survey: with two, no third view verifies the poses."""
MAX_WITHOUT_LENS = 0.1
"""Photographs without a focal length are left out up to this share; of more, the focal lengths are estimated."""

_PHOTOGRAPHS = (".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff", *HEIFS)
_RAWS = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".gpr", ".iiq", ".kdc", ".mef", ".mos"),
    *(".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
)
_OTHER_IMAGES = (".avif", ".webp", ".jp2", ".jxl", ".bmp", ".gif")
# Hidden folders, those of network storage and of macOS archives.
_HIDDEN_FOLDERS = (".", "@eadir", "__macosx")
_ODM_FOLDERS = ("opensfm", "odm_")
_CORRECTED_SHARE = 0.1
"""Of a flight's photographs: where so many are far from the drone's own positions, it was corrected."""
_REPEATED_SHARE = 0.9
"""Of a flight's photographs: where EXIF repeats the drone's own positions in so many, it was not corrected."""
_AFTER_FLIGHT = "EXIF after the flight"
"""Source of the positions of a flight that was corrected where another was not, perhaps over another vertical datum."""
_PAUSE_S = 120.0
"""Photographs further apart in time are of two flights."""
_SCENE_PARTS = ("sparse", "georeference.json", "prepare/stages.json")  # the last, in one that is still being prepared
_WRITTEN_PARTS = ("transforms.json", *_SCENE_PARTS[1:])
"""Of scenes that `prepare` or `import` wrote."""


def read_survey(
    folder: Path,
    gps: Path | None = None,
    control: Path | None = None,
    *,
    find_control: bool = True,
    masks: Path | None = None,
) -> Survey:
    """Read all photographs (JPEG, PNG, TIFF, HEIC) in a folder and its sub-folders, with positions and ground control.

    Hidden folders, scenes (folders with a `sparse` folder or a `georeference.json`) and OpenDroneMap's results are
    skipped, with a remark if they hold photographs that are nowhere else. Photographs without a focal length are left
    out if they are few: none is held to what is stated unless all are. A `gps.csv` or ODM's `geo.txt` directly in the
    folder gives positions to photographs whose EXIF has none, an ODM `gcp_list.txt` ground control.

    Args:
        folder: the photographs.
        gps: a file of positions, which have priority over EXIF.
        control: a file of ground control in the format of ODM's gcp_list.txt.
        find_control: use such a file in the folder where none is given; one that does not fit is only remarked.
        masks: a folder with NAME.png for photographs called NAME; without it, `masks` in the folder, if it has any.

    Raises:
        SurveyError: fewer than three photographs can be read, two differ only in suffix or case, the given file of
            positions or of ground control cannot be parsed, or a file gives a photograph two positions.
    """
    listed, about_files = _list_photographs(folder)
    paths, mask_of, remarks = _find_masks(folder, listed, masks)
    remarks += about_files
    _refuse_collisions([path.relative_to(folder).as_posix() for path in paths])
    _refuse_unreadable([path for path in paths if path.suffix.casefold() in HEIFS])
    names = [_name(path.relative_to(folder)) for path in paths]
    with ThreadPoolExecutor(min(8, 2 * cores())) as pool, warnings.catch_warnings():
        # Pillow warns of tags that it cannot read, without the name of the file; they count as unknown.
        warnings.simplefilter("ignore", UserWarning)
        read = list(pool.map(_read, paths, names, [mask_of.get(path) for path in paths]))
    known = [one for one in read if isinstance(one, _Read)]
    unread = [f"Left out: {problem}" for problem in read if isinstance(problem, str)]
    if len(known) < FEWEST:
        raise SurveyError(
            f"{folder} has {len(known)} photograph{'s'[: len(known) != 1]} that can be read: expected at least "
            f"{FEWEST} that overlap by more than half; add more" + "".join(f"\n{problem}" for problem in unread)
        )
    remarks += unread
    for block in ("EXIF", "XMP"):
        names = [one.photograph.name for one in known if block in one.metadata.damaged]
        if names:
            remarks.append(f"The {block} metadata of {list_names(names)} is damaged and was not read.")
    placed = _with_positions(known)
    nowhere = [
        photograph.name
        for one, photograph in zip(known, placed, strict=True)
        if photograph.position is None and one.metadata.lacks_hemisphere
    ]
    if nowhere:
        remarks.append(
            f"The EXIF positions of {list_names(nowhere)} are not used, because they do not say on which side of the "
            "equator or of Greenwich they are: write GPSLatitudeRef and GPSLongitudeRef, too (exiftool "
            "-GPSLatitudeRef=S -GPSLongitudeRef=W)."
        )
    kept, about_lenses = _drop_without_lens(placed)
    located, about_positions = locate_photographs(folder, kept, gps)
    found = None if control or not find_control else find_file(folder, CONTROL_FILES)
    survey = Survey(folder, tuple(sorted(located, key=lambda photograph: photograph.name)), None)
    ground, about_control = None, []
    try:
        if file := control or found:
            ground, about_control = read_control(file, survey.photographs)
    except SurveyError as error:
        if control:
            raise
        about_control = [control_remark(error)]
    return replace(
        survey,
        control=ground,
        control_was_found=found is not None,
        remarks=(*remarks, *about_lenses, *about_positions, *about_control),
    )


@dataclass(frozen=True)
class _Read:
    """A photograph, without its position, and its metadata."""

    photograph: Photograph
    metadata: PhotographMetadata


def _with_positions(read: Sequence[_Read]) -> list[Photograph]:
    """The photographs with their positions.

    A correction such as PPK writes all positions of a flight into EXIF, also where it moves them little. Where a flight
    was corrected, the others of the survey are taken to be, too, unless EXIF repeats what the drone wrote into XMP.
    """
    flights = _flights([one.photograph for one in read])
    moved_m = np.array([one.metadata.correction_m for one in read])
    far = moved_m > CORRECTED_M
    groups = [np.arange(len(read)), *flights]
    any_corrected = any(far[group].mean() >= _CORRECTED_SHARE for group in groups if len(group) >= FEWEST)
    corrected, whole = far.copy(), np.zeros(len(read), dtype=bool)
    for flight in flights if any_corrected else ():
        # Without times, photographs of a corrected flight and of another may be one group.
        timed = all(math.isfinite(read[k].photograph.time_s) for k in flight)
        near = flight if timed else flight[~far[flight]]
        if len(near) == 0 or (moved_m[near] <= ROUNDING_M).mean() < _REPEATED_SHARE:
            corrected[flight] = whole[flight] = True
    # Where all flights were corrected, the name stays as it is, because it is part of the keys of earlier scenes.
    apart = whole & ~whole.all()
    return [
        replace(one.photograph, position=one.metadata.position(bool(of_exif), _AFTER_FLIGHT if other else "EXIF"))
        for one, of_exif, other in zip(read, corrected, apart, strict=True)
    ]


def _flights(photographs: Sequence[Photograph]) -> list[Int64[np.ndarray, " K"]]:
    """The indices of the photographs of each camera and folder that have no long pause between them."""
    flights = []
    for own in by_camera(photographs):
        times_s = np.array([photographs[k].time_s for k in own])
        order = np.argsort(times_s)  # those without a time are last
        flights += np.split(np.array(own)[order], np.flatnonzero(np.diff(times_s[order]) > _PAUSE_S) + 1)
    return flights


def by_camera(photographs: Sequence[Photograph]) -> list[list[int]]:
    """The indices of the photographs of each camera in each folder."""
    found = defaultdict(list)
    for k, photograph in enumerate(photographs):
        found[photograph.camera, photograph.serial, photograph.name.rpartition("/")[0]].append(k)
    return list(found.values())


def control_remark(error: SurveyError) -> str:
    """Say why ground control that nobody asked for is not used."""
    return (
        f"The ground control next to the photographs was not used: {error}. --no-control leaves it out without this "
        "remark."
    )


def _drop_without_lens(photographs: Sequence[Photograph]) -> tuple[Sequence[Photograph], list[str]]:
    """Leave out photographs without a focal length if they are few, with a remark."""
    without = [photograph.name for photograph in photographs if photograph.lens is None]
    if not 0 < len(without) <= MAX_WITHOUT_LENS * len(photographs):
        return photographs, []
    return [photograph for photograph in photographs if photograph.lens is not None], [
        f"{len(without)} of {len(photographs)} photographs do not state their focal length and are left out "
        f"({list_names(without)}): with them, the focal lengths of all would be estimated, and matches determine them "
        "badly. If the camera is that of another photograph, copy what it states: exiftool -TagsFromFile OTHER -Make "
        "-Model -FocalLength -FocalLengthIn35mmFormat FILE."
    ]


def _list_photographs(folder: Path) -> tuple[list[Path], list[str]]:
    """List the photographs, with remarks on what else is there and not read."""
    try:
        if not folder.is_dir():
            found = "is a file" if folder.exists() else "does not exist"
            raise SurveyError(f"{folder} {found}: expected a folder of photographs; give one")
        results: list[Path] = []
        paths = sorted(_walk(folder, _raise, results))
    except OSError as error:
        raise SurveyError(
            f"{error.filename} cannot be read ({error.strerror}): expected a folder of yours; give one"
        ) from error
    photographs, raws, others, links = [], [], [], []
    for path in paths:
        suffix = path.suffix.casefold()
        if path.is_symlink() and path.is_dir():
            links.append(path.relative_to(folder).as_posix())
            continue
        name = os.fsencode(path.relative_to(folder))
        if suffix in (*_PHOTOGRAPHS, *_RAWS, *_OTHER_IMAGES) and name.decode(errors="replace").encode() != name:
            raise SurveyError(
                f"{folder} has a photograph whose name is not UTF-8, {name.decode(errors='backslashreplace')}: "
                "expected names that COLMAP models and JSON can hold; rename it"
            )
        if suffix in _PHOTOGRAPHS:
            photographs.append(path)
        elif suffix in _RAWS or suffix in _OTHER_IMAGES:
            (raws if suffix in _RAWS else others).append(path.relative_to(folder).as_posix())
    in_results = _remarks_on_results(folder, results, {path.name for path in photographs})
    if photographs:
        skipped = {
            "camera raw files are not read": (raws, "develop them first"),
            "pictures of other formats are not read": (others, "convert them to JPEG, PNG or TIFF"),
            "linked folders are not followed": (links, "move the photographs, or give the folder that has them"),
        }
        about = [
            f"{len(names)} {what} ({list_names(sorted(names))}): {todo}."
            for what, (names, todo) in skipped.items()
            if names
        ]
        return photographs, about + in_results
    if raws:
        raise SurveyError(
            f"{folder} has {len(raws)} camera raw files ({list_names(sorted(raws))}) and no photographs: "
            "expected JPEG, PNG or TIFF; develop them first, all with the same settings"
        )
    found = f"images of other formats ({list_names(sorted(others))})" if others else "no photographs"
    raise SurveyError(
        f"{folder} has {found}: expected JPEG, PNG or TIFF files; give their folder, or convert them"
        + "".join(f"\n{remark}" for remark in in_results)
    )


def _remarks_on_results(folder: Path, results: Sequence[Path], names: Collection[str]) -> list[str]:
    """Remarks on folders that are skipped as results and hold photographs.

    Results hold pictures, too: textures and maps come from no camera, and the photographs of a scene are in `images`,
    by the names that they have elsewhere.

    Args:
        results: the skipped folders.
        names: of the photographs that are read.
    """
    remarks = []
    for home in sorted(results):
        there = [path for path in _walk(home) if path.suffix.casefold() in _PHOTOGRAPHS]
        copies = {
            path
            for path in there
            if path.name in names and any(part.startswith("images") for part in path.relative_to(home).parts[:-1])
        }
        count = sum(map(_names_camera, {*there} - copies))
        if count:
            remarks.append(
                f"{count} photographs in {home.relative_to(folder).as_posix()} are not read, because it looks like "
                "results of ODM or a scene: move them into another folder, or give the folder itself."
            )
    return remarks


def _raise(error: OSError) -> None:
    raise error


def _walk(
    folder: Path, on_error: Callable[[OSError], None] | None = None, results: list[Path] | None = None
) -> Iterator[Path]:
    """All files in a folder and its sub-folders, and the sub-folders that are links, which are not followed.

    Args:
        on_error: is called where a folder cannot be read; None skips it.
        results: a list to which folders are added that look like results of another program, and are skipped.
    """
    for parent, folders, files in os.walk(folder, onerror=on_error):
        shown = [name for name in folders if not name.casefold().startswith(_HIDDEN_FOLDERS)]
        skipped = {
            name
            for name in shown
            if name.casefold().startswith(_ODM_FOLDERS) or _has(os.path.join(parent, name), _SCENE_PARTS)
        }
        folders[:] = [name for name in shown if name not in skipped]
        if results is not None:
            there = (Path(parent, name) for name in sorted(skipped))
            results += (path for path in there if not path.is_symlink() and not _has(path, _WRITTEN_PARTS))
        yield from (Path(parent, name) for name in files if not name.startswith("."))
        # Linked masks are found by their names.
        links = (Path(parent, name) for name in folders if os.path.islink(os.path.join(parent, name)))
        yield from (path for path in links if path != folder / MASKS)


def _has(folder: str | Path, parts: Sequence[str]) -> bool:
    """Whether one of these is in a folder; unlike Path.exists, no error where the folder may not be entered."""
    return any(os.path.exists(os.path.join(folder, part)) for part in parts)


def _refuse_collisions(names: Sequence[str]) -> None:
    """Refuse names that differ only in suffix or case: a scene has one suffix, and file systems may ignore case."""
    found: dict[str, list[str]] = defaultdict(list)
    for name in names:
        found[normalise_name(name.rpartition(".")[0])].append(name)
    same = next((several for several in found.values() if len(several) > 1), None)
    if same:
        raise SurveyError(
            f"{list_names(same)} differ in their suffix or in upper and lower case only: expected one file per "
            "photograph; remove or rename one of them"
        )


def _refuse_unreadable(heifs: Sequence[Path]) -> None:
    if heifs and find_spec("pillow_heif") is None:
        raise SurveyError(
            f"{len(heifs)} photographs are HEIC files ({list_names([path.name for path in heifs])}): expected the "
            "library that reads them; pip install 'tidefield[heic]', or export them as JPEG"
        )


def _name(path: Path) -> str:
    """The name of a photograph in a scene: other programs read no HEIC, so it is written as JPEG there."""
    return (path.with_suffix(".jpg") if path.suffix.casefold() in HEIFS else path).as_posix()


def _find_masks(
    folder: Path, listed: Sequence[Path], masks: Path | None
) -> tuple[Sequence[Path], dict[Path, Path], list[str]]:
    """Find the masks of photographs, and say what is to be said of them.

    Returns:
        Those of the listed files that are photographs, the masks by photograph, and remarks.

    Raises:
        SurveyError: there is no mask where they were asked for, or none of those that there are has the name of a
            photograph.
    """
    home = masks or folder / MASKS
    names = mask_names(path.relative_to(folder) for path in listed)
    candidates = {path: [home / name for name in names[path.relative_to(folder)]] for path in listed}
    masked = {path: next(filter(Path.is_file, own), None) for path, own in candidates.items()}
    found = {path: mask for path, mask in masked.items() if mask is not None}
    # One of the two folders may hold the other, by whatever path each is given.
    root, masks_root = folder.resolve(), home.resolve()
    places = {path: root / path.relative_to(folder) for path in listed}
    taken = {masks_root / mask.relative_to(home) for mask in found.values()}
    # Where the masks' folder holds that of the photographs, they are none of its masks.
    apart = not root.is_relative_to(masks_root)
    photographs = [
        path
        for path, place in places.items()
        if place not in taken and not (apart and place.is_relative_to(masks_root))
    ]
    others = {places[path] for path in photographs}
    there = sorted(_walk(masks_root)) if home.is_dir() else []
    pictures = [path for path in there if path.suffix.casefold() in _PHOTOGRAPHS and path not in others]
    strange = [] if masks_root == root else [path for path in pictures if path not in taken]
    named = list_names([path.relative_to(masks_root).as_posix() for path in strange])
    if not found and (masks or 2 * sum(map(_is_mask, strange)) > len(strange)):
        example = candidates[(photographs or listed)[0]][0].relative_to(home).as_posix()
        instead = f" (found: {named})" if strange else ""
        todo = "give the folder of the masks, or leave --masks out" if masks else "rename them, or move the folder away"
        raise SurveyError(
            f"{home} has no mask of any photograph in {folder}{instead}: expected a PNG called like its photograph, "
            f"such as {example}, that is black where the photograph is not to be used; {todo}"
        )
    if not found:
        return listed, found, []
    remarks = [f"{home} has masks of {len(found)} photographs: what is black there is not used."]
    if masks:
        some = f"{len(found)} of the photographs have masks in {masks}, the others are used whole."
        remarks = [some] if len(found) < len(photographs) else []
    if strange:
        remarks.append(
            f"{len(strange)} of the {len(pictures)} pictures in {home} belong to no photograph and are not used "
            f"({named}): rename them, or move them away."
        )
    return photographs, found, remarks


def _is_mask(path: Path) -> bool:
    """Whether a picture is like a mask: without colours, and from no camera."""
    try:
        with quiet_pillow(), open_image(path) as image:
            return image.mode in ("1", "L", "LA", "P") and not read_metadata(image).camera
    except SurveyError:
        return False


def _names_camera(path: Path) -> bool:
    """Whether a picture is a photograph by its metadata."""
    try:
        with quiet_pillow(), open_image(path) as image:
            return bool(read_metadata(image).camera)
    except SurveyError:
        return False


def _read(path: Path, name: str, mask: Path | None = None) -> _Read | str:
    """Read a photograph and its metadata, or return why it cannot be read."""
    try:
        with open_image(path) as image:
            metadata = read_metadata(image)
            stored, transparent = stored_size(image), has_alpha(image)
            refuse_truncated(path, image)
            if image.mode == "F":
                return f"{path} has pixels of floating-point numbers: expected 8 or 16 bits; export it with these"
    except SurveyError as error:
        return str(error)
    width, height = upright_size(*stored, metadata.orientation)
    photograph = Photograph(
        path=path,
        name=name,
        width=width,
        height=height,
        orientation=metadata.orientation,
        camera=metadata.camera,
        serial=metadata.serial,
        focal_mm=metadata.exif.number(ExifTags.Base.FocalLength),
        lens=lens_prior(metadata, *stored, metadata.orientation),
        time_s=metadata.exif.time_s,
        position=None,
        relative_altitude_m=metadata.xmp_number("RelativeAltitude", "Camera:AboveGroundAltitude"),
        gimbal_deg=metadata.gimbal_deg,
        mask=mask,
        has_alpha=transparent,
    )
    if mask is not None:
        check_mask(mask, (width, height), path)
    return _Read(photograph, metadata)
