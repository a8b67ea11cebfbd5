"""Find the masks of photographs by their names, in a folder next to that of the photographs."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path

from tidefield.data.readers.files import inside, relative_path
from tidefield.data.readers.llff import SUFFIXES
from tidefield.errors import SceneError, list_names

_log = logging.getLogger(__name__)


def mask_names(photographs: Iterable[Path]) -> dict[Path, list[Path]]:
    """The names that the mask of each photograph may have, the better one first."""
    names = {p: [p.with_name(f"{p.name}.png"), p.with_suffix(".png")] for p in {*photographs}}
    fitting = Counter(name for both in names.values() for name in {*both})
    return {p: [own] + [by_stem] * (fitting[by_stem] == 1) for p, (own, by_stem) in names.items()}


def masks_beside(
    roots: Sequence[Path], names: Sequence[str], paths: Sequence[Path], present: Sequence[int], named_by: Path
) -> tuple[Path | None, ...]:
    """Find the masks of photographs in a folder masks, and report pictures there that belong to no photograph.

    The mask of IMG_1.jpg is IMG_1.jpg.png, as in COLMAP and OpenSfM, or IMG_1.png if that fits no other photograph.

    Args:
        roots: folders that may hold a folder masks; the first with a mask counts.
        names: of all photographs in the scene's description.
        paths: their files, which end with the names.
        present: indices of the photographs to find masks of.
        named_by: the scene's description.

    Returns:
        A mask or None for each photograph that is present; empty if none has one.

    Raises:
        SceneError: a folder masks has pictures, and none of them belongs to a photograph.
    """
    photographs = [relative_path(name) for name in names]
    images = {path.parents[len(photograph.parts) - 1] for photograph, path in zip(photographs, paths, strict=True)}
    for folder in dict.fromkeys(root / "masks" for root in roots):
        if not (present and folder.is_dir()):
            continue
        pictures = {path.relative_to(folder) for path in folder.rglob("*") if _is_picture(path)}
        # Photographs without a pose, which only the files tell of, may have masks, too.
        parents = {picture.parent for picture in pictures}
        known = {*photographs}.union(*(_photographs(home, parent) for home, parent in product(images, parents)))
        candidates = mask_names(known)
        strange = pictures.difference(*candidates.values())
        if strange:
            _report(folder, strange, pictures, example=candidates[photographs[present[0]]][0])
        found = []
        for i in present:
            files = [inside(folder, mask.as_posix(), named_by) for mask in candidates[photographs[i]]]
            found.append(next((file for file in files if file.is_file()), None))
        if any(found):
            return tuple(found)
    return ()


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and path.is_file()


def _photographs(home: Path, parent: Path) -> set[Path]:
    """The photographs in a folder, if it exists, with their names relative to that of all photographs."""
    folder = home / parent
    return {parent / path.name for path in folder.iterdir() if _is_picture(path)} if folder.is_dir() else set()


def _report(folder: Path, strange: set[Path], pictures: set[Path], example: Path) -> None:
    """Warn of pictures that belong to no photograph; raise a SceneError where these are all of them."""
    listed = list_names(sorted(picture.as_posix() for picture in strange))
    if strange == pictures:
        raise SceneError(
            f"{folder} has no mask of any photograph (found: {listed}): expected a PNG called like its photograph, "
            f"such as {example.as_posix()}, that is black where the photograph is not to be used; rename the masks, or "
            "move the folder away"
        )
    _log.warning(
        "%d of the %d pictures in %s belong to no photograph and are not used: %s; expected names such as %s; rename "
        "them, or move them away",
        *(len(strange), len(pictures), folder, listed, example.as_posix()),
    )
