"""Scenes to compare on, by the names of protocols."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from tidefield.errors import SceneError
from tidefield.synthetic import CATEGORIES, make_survey, write_survey

Protocol = Literal["mipnerf360", "tidalflats"]

MIPNERF360 = {
    "bicycle": "images_4",
    "bonsai": "images_2",
    "counter": "images_2",
    "garden": "images_4",
    "kitchen": "images_2",
    "room": "images_2",
    "stump": "images_4",
}
"""The seven public scenes of mip-NeRF 360, and which of their folders of photographs is used: as in that paper, a
quarter of the size outdoors and half of it indoors."""
SYNTHETIC_VIEWS, SYNTHETIC_SEED = 40, 11


def mipnerf360(folder: Path, out: Path) -> dict[str, Path]:
    """The scenes in a folder as it is published, by name.

    Args:
        folder: the data set's.
        out: for a folder of each scene, of links to its poses and to the photographs of the size that is used.

    Raises:
        SceneError: none of them is there, or one has no photographs of that size.
    """
    there = [name for name in MIPNERF360 if (folder / name / "sparse").is_dir()]
    if not there:
        raise SceneError(
            f"{folder} has none of {', '.join(MIPNERF360)}: expected the folder that the data set of mip-NeRF 360 "
            "unpacks to; name it"
        )
    for name in there:
        photographs = folder / name / MIPNERF360[name]
        if not photographs.is_dir():
            raise SceneError(f"{photographs} is not there: expected the photographs as published; unpack them all")
        (out / name).mkdir(parents=True, exist_ok=True)
        for link, target in (("images", photographs), ("sparse", folder / name / "sparse")):
            if not (out / name / link).is_symlink():
                (out / name / link).symlink_to(target.resolve(), target_is_directory=True)
    return {name: out / name for name in there}


def tidal_flats(folder: Path, width: int, real: Sequence[Path]) -> dict[str, Path]:
    """The five synthetic categories, made in `folder` unless they are there, and real surveys, by name."""
    scenes = {}
    for category in CATEGORIES:
        scene = folder / f"{category}-{width}"
        if not scene.exists():
            half = scene.with_name(f".{scene.name}.partial")
            write_survey(make_survey(category, seed=SYNTHETIC_SEED, views=SYNTHETIC_VIEWS, width=width), half)
            half.rename(scene)
        scenes[category] = scene
    return scenes | named(real)


def named(scenes: Sequence[Path]) -> dict[str, Path]:
    """Scenes by the names of their folders.

    Raises:
        SceneError: two have the same.
    """
    names = [Path(os.path.abspath(scene)).name for scene in scenes]  # a link has a name of its own
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise SceneError(f"two scenes are named {twice}: expected different names of folders; rename or link one")
    return dict(zip(names, scenes, strict=True))
