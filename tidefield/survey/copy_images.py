"""The photographs of a scene, as they are to be used: upright, and evened out where that helps.

A file that needs no change is copied byte for byte.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float32
from PIL import ExifTags, Image

from tidefield.files import completed_file
from tidefield.machine import cores
from tidefield.survey.colour import Evening, evened
from tidefield.survey.io.image_decoding import upright
from tidefield.survey.survey import Photograph

STEP_PX = 8
"""Distance at which a lens' angles are computed; between, they are interpolated."""
JPEG_QUALITY = 95


def place_photographs(
    photographs: Sequence[Photograph],
    folder: Path,
    evening: Evening | None,
    lenses: Sequence[pycolmap.Camera],
    progress: Callable[[int, int], object],
) -> None:
    """Write photographs into a folder under their names; what else the folder holds is removed.

    Args:
        evening: of these photographs, in this order; None leaves their colours alone.
        lenses: of each photograph; photographs of one lens share the object.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = {folder / photograph.name for photograph in photographs}
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_file() and path not in wanted:
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            path.rmdir()
    tangents = {lens.camera_id: tangent_map(lens) for lens in lenses} if evening and evening.sees_falloff else {}

    def place(number: int) -> None:
        photograph = photographs[number]
        target = folder / photograph.name
        if evening is None or not evening.helps:
            if photograph.orientation == 1:
                with completed_file(target, overwrite=True) as partial:
                    shutil.copyfile(photograph.path, partial)
                return
            pixels = upright(photograph)
        else:
            tangent = tangents.get(lenses[number].camera_id, np.zeros((1, 1), dtype=np.float32))
            pixels = evened(upright(photograph), evening.gain[number], evening.falloff[number], tangent)
        _save(pixels, photograph.path, target)

    with ThreadPoolExecutor(cores()) as pool:
        for done, _ in enumerate(pool.map(place, range(len(photographs))), start=1):
            progress(done, len(photographs))


def tangent_map(lens: pycolmap.Camera) -> Float32[np.ndarray, "H W"]:
    """Tangent of the angle between each pixel's ray and the optical axis."""
    # From the first pixel's centre to the last's, so that nothing is extrapolated.
    columns, rows = (max(2, 1 + -(-x // STEP_PX)) for x in (lens.width, lens.height))
    u, v = np.linspace(0.5, lens.width - 0.5, columns), np.linspace(0.5, lens.height - 0.5, rows)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    coarse = np.linalg.norm(np.asarray(lens.cam_from_img(uv)), axis=1).reshape(rows, columns).astype(np.float32)
    column = np.linspace(0, columns - 1, lens.width, dtype=np.float32)
    row = np.linspace(0, rows - 1, lens.height, dtype=np.float32)
    return cv2.remap(coarse, *np.meshgrid(column, row), cv2.INTER_LINEAR)


def _save(pixels: np.ndarray, source: Path, target: Path) -> None:
    """Write pixels in the format of the target's name, with what the source's EXIF says of how they were taken."""
    with Image.open(source) as original:
        exif = original.getexif()
    exif[ExifTags.Base.Orientation] = 1
    picture = Image.fromarray(pixels)
    with completed_file(target, overwrite=True) as partial:
        if target.suffix.lower() in (".jpg", ".jpeg"):
            picture.save(partial, exif=exif, quality=JPEG_QUALITY, subsampling=0)
        else:
            picture.save(partial, exif=exif)
