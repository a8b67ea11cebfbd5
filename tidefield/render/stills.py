"""Write renderings as pictures: 8-bit colour, depth as colours, depth as numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, PngImagePlugin

from tidefield import SOFTWARE
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.files import completed_file, require_writable
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Rendering, to_8_bit

MIN_OPACITY = 0.5
"""Share of the light that the scene must stop for a pixel's depth to mean anything."""
CONVENTION = (
    "OpenCV: +x right, +y down, +z forward; pixel centres at +0.5; T_world_camera maps camera coordinates into the "
    "world coordinates of the scene's files"
)


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


def title(scene: Scene, what: str | None) -> str:
    """Name a scene, without its folder, and what is shown of it."""
    text = ", ".join(filter(None, (scene.root.resolve().name, what)))
    return text.encode("utf-8", "replace").decode()  # names of files may be no UTF-8


def describe_view(scene: Scene, camera: Cameras) -> dict[str, str]:
    """Describe the view of one camera for `write_still`: `Title`, and `Camera` as JSON; no folder's name is in them."""
    pose = camera.T_world_camera[0].double().cpu()
    pose[:, 3] += scene.origin_world.cpu()
    name = camera.names[0] if camera.names else None
    own = {
        "scene": scene.root.resolve().name,
        "photograph": name,
        "width": camera.width,
        "height": camera.height,
        "focal_px": camera.focal_px[0].tolist(),
        "principal_px": camera.principal_px[0].tolist(),
        "T_world_camera": pose.tolist(),
        "residual": None if camera.residual is None else camera.residual[0].tolist(),
        "convention": CONVENTION,
    }
    return {"Title": title(scene, name), "Camera": json.dumps(own)}


def write_still(
    rendering: Rendering, path: Path, *, about: Mapping[str, str] | None = None, overwrite: bool = False
) -> tuple[Path, Path, Path]:
    """Write a view: NAME.png, and next to it NAME_depth.npy and NAME_depth.png.

    NAME_depth.npy holds z-depths as float32 (H x W), in world units (metres if the scene is georeferenced), NaN where
    the view shows nothing: COLMAP's scale is arbitrary, so a 16-bit picture in millimetres would not do.
    NAME_depth.png is for people; the depths of its red and blue ends are its text fields `near` and `far`.

    Args:
        rendering: the view.
        path: NAME.png.
        about: more text fields of both pictures, such as those of `describe_view`; `Software` is always one.
        overwrite: replace existing files.

    Returns:
        The three files.

    Raises:
        RunError: the name is no PNG, one of the files exists, or the folder cannot be written to.
    """
    path, numbers, picture = still_files(path)
    require_writable(path, numbers, picture, overwrite=overwrite)
    near, far = depth_range(rendering)
    fields = {"Software": SOFTWARE, **(about or {})}
    ends = {"near": f"{near:.9g}", "far": f"{far:.9g}"}
    depth = rendering.depth.detach().float().where(rendering.opacity >= MIN_OPACITY, float("nan"))
    with completed_file(numbers, overwrite=overwrite) as partial:
        np.save(partial, depth.cpu().numpy())
    with completed_file(picture, overwrite=overwrite) as partial:
        Image.fromarray(depth_picture(rendering, near, far)).save(partial, pnginfo=_text(fields | ends))
    with completed_file(path, overwrite=overwrite) as partial:
        Image.fromarray(colour_picture(rendering)).save(partial, pnginfo=_text(fields))
    return path, numbers, picture


def _text(fields: Mapping[str, str]) -> PngImagePlugin.PngInfo:
    text = PngImagePlugin.PngInfo()
    for name, value in fields.items():
        text.add_itxt(name, value)  # UTF-8; the plain text of PNG is Latin-1
    return text


def still_files(path: Path) -> tuple[Path, Path, Path]:
    """The files of a view: its colours, its depth as numbers and as a picture.

    Raises:
        RunError: the name is no PNG.
    """
    if path.suffix.lower() != ".png":
        raise RunError(f"a picture cannot be written as {path.name}: expected a name that ends in .png")
    numbers, picture = (path.with_name(f"{path.stem}_depth{suffix}") for suffix in (".npy", ".png"))
    return path, numbers, picture
