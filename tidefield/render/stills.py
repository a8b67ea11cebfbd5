"""Renderings as pictures: 8-bit colour, depth to look at, depth to measure with."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, PngImagePlugin
from torch import Tensor

from tidefield.errors import RunError
from tidefield.files import completed_file, refuse_existing
from tidefield.model.rendering import Rendering, to_8_bit

SEEN_OPACITY = 0.5
"""Where the scene stopped less light than this, a depth means nothing."""


def to_8bit(colour: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colours in [0, 1], rounded (and clipped) to 8 bits."""
    assert bool(colour.isfinite().all()), "a colour is not finite"
    return to_8_bit(colour).cpu().numpy()


def depth_range(rendering: Rendering) -> tuple[float, float]:
    """Nearest and farthest depth without the outermost hundredths, over pixels where there is something."""
    depth = rendering.depth.detach().float()[rendering.opacity >= SEEN_OPACITY]
    if not len(depth):
        return 1.0, 2.0
    low, high = np.percentile(depth.cpu().numpy(), [1, 99]).tolist()
    low = max(low, 1e-6)
    return low, max(high, 1.001 * low)


def depth_picture(rendering: Rendering, near_far: tuple[float, float] | None = None) -> UInt8[np.ndarray, "H W 3"]:
    """Depth as colours, linear in disparity: red is near, blue far, black where there is nothing (OpenCV's turbo).

    Args:
        near_far: depths of the two ends; None takes the picture's own. Frames of a video should share them.
    """
    near, far = near_far or depth_range(rendering)
    depth = rendering.depth.detach().float().cpu().numpy()
    nearness = (1 / np.maximum(depth, 1e-9) - 1 / far) / (1 / near - 1 / far)
    level = np.round(255 * np.clip(nearness, 0, 1)).astype(np.uint8)
    picture = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[:, :, ::-1].copy()
    picture[rendering.opacity.cpu().numpy() < SEEN_OPACITY] = 0
    return picture


def write_still(rendering: Rendering, path: Path, *, overwrite: bool = False) -> tuple[Path, Path, Path]:
    """Write a view: NAME.png, and beside it NAME_depth.npy and NAME_depth.png.

    NAME_depth.npy holds z-depths as float32 (H x W), in world units (metres where the scene is georeferenced), NaN
    where there is nothing: COLMAP's scale is arbitrary, so a 16-bit picture in millimetres would not do.
    NAME_depth.png is to look at; the depths of its red and blue ends stand in its text fields `near` and `far`.

    Returns:
        The three files.

    Raises:
        RunError: the name is no PNG, a file is there already, or the folder cannot be written to.
    """
    if path.suffix.lower() != ".png":
        raise RunError(f"a picture cannot be written as {path.name}: expected a name that ends in .png")
    depths, look = path.with_name(f"{path.stem}_depth.npy"), path.with_name(f"{path.stem}_depth.png")
    if not overwrite:
        refuse_existing(path, depths, look)
    near, far = depth_range(rendering)
    text = PngImagePlugin.PngInfo()
    text.add_text("near", f"{near:.9g}")
    text.add_text("far", f"{far:.9g}")
    depth = rendering.depth.detach().float().where(rendering.opacity >= SEEN_OPACITY, float("nan"))
    with completed_file(depths, overwrite=overwrite) as partial:
        np.save(partial, depth.cpu().numpy())
    with completed_file(look, overwrite=overwrite) as partial:
        Image.fromarray(depth_picture(rendering, (near, far))).save(partial, pnginfo=text)
    with completed_file(path, overwrite=overwrite) as partial:
        Image.fromarray(to_8bit(rendering.colour)).save(partial)
    return path, depths, look
