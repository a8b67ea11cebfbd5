"""Write the files of a scene: photographs, upright and at the common exposure, reduced ones, and `transforms.json`."""

from __future__ import annotations

import io
import logging
import shutil
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float32, UInt8
from PIL import ExifTags, Image

from tidefield.data.exif import EXIF_DAMAGE, read_exif
from tidefield.data.pictures import MODES, decode, read_mask, write_mask
from tidefield.data.readers.files import open_picture, quiet_pillow
from tidefield.data.readers.posed import every_eighth
from tidefield.data.readers.transforms import write_transforms_file
from tidefield.errors import RunError
from tidefield.files import completed_file
from tidefield.geometry.lenses import FisheyeLens, lens_from_colmap
from tidefield.machine import cores
from tidefield.survey.colour import ExposureCorrection, to_common_exposure
from tidefield.survey.io.image_decoding import HEIFS, open_image, upright, used_pixels
from tidefield.survey.survey import Photograph, Progress

log = logging.getLogger(__name__)

GRID_PX = 8
"""Spacing of the pixels whose viewing angles are computed; between them they are interpolated."""
JPEG_QUALITY = 95
_WRITTEN: dict[str, dict[str, Any]] = {
    "JPEG": {"quality": JPEG_QUALITY, "subsampling": 0},
    "PNG": {},
    "TIFF": {},
    "WEBP": {"lossless": True},
    "BMP": {},
}
"""Pillow's names of the formats that changed photographs are written in, and its options for them."""
MOST_REDUCED = 64
MAX_COORDINATE_M = 10_000.0
"""nerfstudio computes in float32, which resolves 1 mm up to this distance from the origin."""
# The others of the first block describe how the original stores its pixels.
_DESCRIPTION = (
    *(ExifTags.Base.ImageDescription, ExifTags.Base.Make, ExifTags.Base.Model, ExifTags.Base.Software),
    *(ExifTags.Base.DateTime, ExifTags.Base.Artist, ExifTags.Base.Copyright),
)


def write_images(
    photographs: Sequence[Photograph],
    folder: Path,
    correction: ExposureCorrection | None,
    cameras: Sequence[pycolmap.Camera],
    progress: Progress,
) -> None:
    """Write photographs into a folder under their names.

    A file that needs no change, and that all other commands read, is copied byte for byte. A transparent photograph is
    written opaque: the readers of scenes would take it for an object before a background.

    Args:
        correction: of these photographs, in this order; None leaves their colours as they are.
        cameras: of each photograph; photographs of one lens share the object.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if correction is not None and not correction.helps:
        correction = None
    falloffs = np.zeros((len(cameras), 3)) if correction is None else correction.falloff
    darkening = {camera.camera_id: camera for camera, terms in zip(cameras, falloffs, strict=True) if terms.any()}
    tangents = {number: tangent_map(camera) for number, camera in darkening.items()}

    def write(index: int) -> None:
        photograph = photographs[index]
        target = folder / photograph.name
        same = correction is None or ((correction.gain[index] == 1).all() and not correction.falloff[index].any())
        if same and photograph.orientation == 1 and not photograph.has_alpha and _is_readable(photograph.path):
            with completed_file(target, overwrite=True) as partial:
                shutil.copyfile(photograph.path, partial)
            return
        pixels = upright(photograph)
        if correction is not None and not same:
            tangent = tangents.get(cameras[index].camera_id, np.zeros((1, 1), dtype=np.float32))
            pixels = to_common_exposure(pixels, correction.gain[index], correction.falloff[index], tangent)
        write_image(pixels, target, photograph.path)

    with quiet_pillow(), ThreadPoolExecutor(cores()) as pool:
        for done, _ in enumerate(pool.map(write, range(len(photographs))), start=1):
            progress(done, len(photographs))


def _is_readable(path: Path) -> bool:
    """Whether the readers of scenes, ours and others', accept a photograph's format and kind of pixels."""
    if path.suffix.casefold() in HEIFS:
        return False
    with open_image(path) as picture:
        return picture.mode in MODES


def write_image(pixels: UInt8[np.ndarray, "H W C"], target: Path, original: Path) -> None:
    """Write changed pixels of a photograph in its format, with its EXIF and colours; the orientation becomes upright.

    HEIC becomes JPEG, and of a file with several pictures the first is written.

    Raises:
        RunError: the format cannot be written (see `refuse_unwritable`).
    """
    with _open_original(original) as picture:
        kind = _written_kind(picture, original)
        exif = _kept_exif(picture, kind, original)
        profile = picture.info.get("icc_profile") or b""
    # The pixels are RGB now, which the profile of a grey photograph or of one in CMYK does not describe.
    colours = {"icc_profile": profile} if profile[16:20] == b"RGB " else {}
    with completed_file(target, overwrite=True) as partial:
        Image.fromarray(pixels).save(partial, kind, exif=exif, **colours, **_WRITTEN[kind])


def refuse_unwritable(originals: Iterable[Path]) -> None:
    """Check, without decoding them, that changed pixels of photographs can be written in the photographs' formats.

    Raises:
        RunError: one has another format than `write_image` writes.
    """
    for original in originals:
        with _open_original(original) as picture:
            _written_kind(picture, original)


def _open_original(path: Path) -> AbstractContextManager[Image.Image]:
    """Open a photograph of a survey or of a scene, which may have more formats."""
    return open_image(path) if path.suffix.casefold() in HEIFS else open_picture(path)


def _written_kind(picture: Image.Image, original: Path) -> str:
    """Choose the format that changed pixels of an opened photograph are written in."""
    if picture.format == "MPO" or original.suffix.casefold() in HEIFS:
        return "JPEG"
    if picture.format not in _WRITTEN:
        raise RunError(
            f"{original} is a {picture.format} file, and its pixels are to be changed: expected one of "
            f"{', '.join(_WRITTEN)}; convert it, or do without what changes it (--downscale, --undistort)"
        )
    return picture.format


def _kept_exif(picture: Image.Image, kind: str, original: Path) -> bytes:
    """Collect the EXIF of an opened photograph that stays true of other pixels; none of it if a part is damaged.

    Args:
        kind: format that it is written in.
        original: for the warning.
    """
    kept, upright = Image.Exif(), Image.Exif()
    kept[ExifTags.Base.Orientation] = upright[ExifTags.Base.Orientation] = 1
    if not read_exif(picture).damaged:
        with suppress(*EXIF_DAMAGE):
            found = picture.getexif()
            for tag in _DESCRIPTION:
                if tag in found:
                    kept[tag] = found[tag]
            for block in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
                # Interop is a third block, of which this has the position in the original file.
                values = {tag: value for tag, value in found.get_ifd(block).items() if tag != ExifTags.IFD.Interop}
                if values:
                    kept[block] = values
            exif = kept.tobytes()
            # Pillow reads values that it does not write, or not in this format.
            Image.new("RGB", (1, 1)).save(io.BytesIO(), kind, exif=exif)
            return exif
    log.warning(f"the EXIF of {original} is damaged, or cannot be written again: the photograph is written without it")
    return upright.tobytes()


def reduced_folders(factors: Sequence[int]) -> list[str]:
    """Name the folders of reduced photographs as nerfstudio and gsplat do: images_2, images_4.

    Raises:
        RunError: a factor does not reduce, or is given twice.
    """
    if len(set(factors)) < len(factors) or not all(2 <= factor <= MOST_REDUCED for factor in factors):
        raise RunError(
            f"--downscale is {' '.join(map(str, factors))}: expected different whole numbers from 2 to "
            f"{MOST_REDUCED}; correct them"
        )
    return [f"images_{factor}" for factor in factors]


def write_reduced_images(scene: Path, names: Sequence[str], factors: Sequence[int], progress: Progress) -> None:
    """Write images_N beside images: the photographs at an Nth of their size, under their names; masks_N beside masks.

    Each pixel is the mean of N x N, which in a mask are all used. Columns and rows that are left over at the right and
    at the bottom are dropped: the size is rounded down, as nerfstudio and gsplat do with their cameras, and the
    calibration is exactly an Nth.
    """
    folders = reduced_folders(factors)

    def write(name: str) -> None:
        original = scene / "images" / name
        pixels = decode(original)
        for folder, factor in zip(folders, factors, strict=True):
            height, width = (size // factor for size in pixels.shape[:2])
            if not (width and height):
                raise RunError(
                    f"{name} has {pixels.shape[1]} x {pixels.shape[0]} pixels: expected at least {factor} each way "
                    f"for {folder}; choose a smaller --downscale"
                )
            whole = pixels[: height * factor, : width * factor]
            reduced = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
            write_image(reduced, scene / folder / name, original)
            if (mask := scene / "masks" / f"{name}.png").is_file():
                used = read_mask(mask, (pixels.shape[1], pixels.shape[0]), original)
                blocks = used[: height * factor, : width * factor].reshape(height, factor, width, factor)
                write_mask(scene / f"masks_{factor}" / f"{name}.png", np.asarray(blocks.all(axis=(1, 3))))

    with quiet_pillow(), ThreadPoolExecutor(cores()) as pool:
        for done, _ in enumerate(pool.map(write, names), start=1):
            progress(done, len(names))


def write_masks(photographs: Sequence[Photograph], folder: Path, progress: Progress) -> None:
    """Write the masks of photographs into a folder as NAME.png, a white one for photographs without.

    nerfstudio reads masks of all photographs or of none.
    """

    def write(photograph: Photograph) -> None:
        write_mask(folder / f"{photograph.name}.png", used_pixels(photograph))

    with quiet_pillow(), ThreadPoolExecutor(cores()) as pool:
        for done, _ in enumerate(pool.map(write, photographs), start=1):
            progress(done, len(photographs))


def tangent_map(camera: pycolmap.Camera) -> Float32[np.ndarray, "H W"]:
    """Compute the tangent of the angle between each pixel's ray and the optical axis.

    Beyond a fold, where the lens images no point, and beyond the widest angle of a fisheye that is shown, it is the
    largest that is shown: the falloff there is unknown.
    """
    # From the centre of the first pixel to that of the last, so that nothing is extrapolated.
    columns, rows = (max(2, 1 + -(-size // GRID_PX)) for size in (camera.width, camera.height))
    u, v = np.linspace(0.5, camera.width - 0.5, columns), np.linspace(0.5, camera.height - 0.5, rows)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    lens = lens_from_colmap(camera.model_name, camera.width, camera.height, camera.params)
    tangent = np.linalg.norm(lens.unproject(uv), axis=1)
    largest = np.nanmax(tangent)
    if isinstance(lens, FisheyeLens):
        corners = lens.pinhole().unproject(np.array([(0.0, 0.0), (lens.width, lens.height)]))
        largest = np.linalg.norm(corners, axis=1).max()
    tangent = np.fmin(tangent, largest)
    grid = tangent.reshape(rows, columns).astype(np.float32)
    column = np.linspace(0, columns - 1, camera.width, dtype=np.float32)
    row = np.linspace(0, rows - 1, camera.height, dtype=np.float32)
    return cv2.remap(grid, *np.meshgrid(column, row), cv2.INTER_LINEAR)


def write_transforms(
    folder: Path,
    model: pycolmap.Reconstruction,
    *,
    held_out: Collection[str] = (),
    masks: bool = False,
    z_is_up: bool = False,
    overwrite: bool = False,
) -> None:
    """Write `transforms.json` and `sparse_pc.ply` of a model whose photographs are in `folder/images`.

    Coordinates are the model's; coordinates too large for
    float32 are reduced by whole numbers, which `applied_transform` states.

    Args:
        model: cameras with Brown's distortion; photographs without a pose are left out.
        held_out: names of photographs; without any, every eighth one is held out, as `load_scene` does.
        masks: whether `folder/masks` has a mask of every photograph.
        z_is_up: whether the world's z axis points up: nerfstudio then does not rotate the world.

    Raises:
        SceneError: a camera model that nerfstudio's and our lenses cannot express.
        RunError: a file exists already, or cannot be written.
    """
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    T_world_camera = np.array([image.cam_from_world().inverse().matrix() for image in images]).reshape(-1, 3, 4)
    position = T_world_camera[:, :, 3]
    is_large = np.abs(position).max(initial=0.0) > MAX_COORDINATE_M
    origin = np.round(position.mean(axis=0)) if is_large else np.zeros(3)
    position -= origin
    lenses = {
        key: lens_from_colmap(camera.model_name, camera.width, camera.height, camera.params.tolist())
        for key, camera in model.cameras.items()
    }
    split: tuple[Sequence[int], Sequence[int]] = every_eighth(len(images))
    if held_out:
        test = [i for i, image in enumerate(images) if image.name in held_out]
        split = sorted({*range(len(images))} - {*test}), test
    points = [point for _, point in sorted(model.points3D.items()) if np.isfinite(point.xyz).all()]
    write_transforms_file(
        folder,
        [f"images/{image.name}" for image in images],
        [lenses[image.camera_id] for image in images],
        T_world_camera,
        split,
        np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3) - origin,
        np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        masks=[f"masks/{image.name}.png" for image in images if masks],
        header={
            **({"orientation_override": "none"} if z_is_up else {}),
            "applied_transform": np.column_stack([np.eye(3), 0.0 - origin]).tolist(),
        },
        overwrite=overwrite,
    )
