"""Write renderings as pictures: 8-bit colour, depth as colours, depth as numbers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, PngImagePlugin

from tidefield.errors import RunError
from tidefield.files import completed_file, require_writable
from tidefield.model.rendering import Rendering, to_8_bit

MIN_OPACITY = 0.5
"""Share of the light that the scene must stop for a pixel's depth to mean anything."""


def colour_picture(rendering: Rendering) -> UInt8[np.ndarray, "H W 3"]:
    """Return the colours of a rendering, which must be finite, in 8 bits."""
    assert bool(rendering.colour.isfinite().all()), "a colour is not finite"
    return to_8_bit(rendering.colour).cpu().numpy()


def depth_range(rendering: Rendering) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the depths of pixels that show something."""
    depth = rendering.depth.detach().float()[rendering.opacity >= MIN_OPACITY]
    if not len(depth):
        return 1.0, 2.0
    low, high = np.percentile(depth.cpu().numpy(), [1, 99]).tolist()
    low = max(low, 1e-6)
    return low, max(high, 1.001 * low)


def depth_picture(rendering: Rendering, near: float, far: float) -> UInt8[np.ndarray, "H W 3"]:
    """Return depths as colours of OpenCV's turbo, linear in disparity: red is near, blue far, black shows nothing."""
    depth = rendering.depth.detach().float().cpu().numpy()
    nearness = (1 / np.maximum(depth, 1e-9) - 1 / far) / (1 / near - 1 / far)
    level = np.round(255 * np.clip(nearness, 0, 1)).astype(np.uint8)
    picture = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[:, :, ::-1].copy()
    picture[rendering.opacity.cpu().numpy() < MIN_OPACITY] = 0
    return picture


def write_still(rendering: Rendering, path: Path, *, overwrite: bool = False) -> tuple[Path, Path, Path]:
    """Write a view: NAME.png, and next to it NAME_depth.npy and NAME_depth.png.

    NAME_depth.npy holds z-depths as float32 (H x W), in world units (metres if the scene is georeferenced), NaN where
    the view shows nothing: COLMAP's scale is arbitrary, so a 16-bit picture in millimetres would not do.
    NAME_depth.png is for people; the depths of its red and blue ends are its text fields `near` and `far`.

    Returns:
        The three files.

    Raises:
        RunError: the name is no PNG, one of the files exists, or the folder cannot be written to.
    """
    path, numbers, picture = still_files(path)
    require_writable(path, numbers, picture, overwrite=overwrite)
    near, far = depth_range(rendering)
    text = PngImagePlugin.PngInfo()
    text.add_text("near", f"{near:.9g}")
    text.add_text("far", f"{far:.9g}")
    depth = rendering.depth.detach().float().where(rendering.opacity >= MIN_OPACITY, float("nan"))
    with completed_file(numbers, overwrite=overwrite) as partial:
        np.save(partial, depth.cpu().numpy())
    with completed_file(picture, overwrite=overwrite) as partial:
        Image.fromarray(depth_picture(rendering, near, far)).save(partial, pnginfo=text)
    with completed_file(path, overwrite=overwrite) as partial:
        Image.fromarray(colour_picture(rendering)).save(partial)
    return path, numbers, picture


def still_files(path: Path) -> tuple[Path, Path, Path]:
    """The files of a view: its colours, its depth as numbers and as a picture.

    Raises:
        RunError: the name is no PNG.
    """
    if path.suffix.lower() != ".png":
        raise RunError(f"a picture cannot be written as {path.name}: expected a name that ends in .png")
    numbers, picture = (path.with_name(f"{path.stem}_depth{suffix}") for suffix in (".npy", ".png"))
    return path, numbers, picture
