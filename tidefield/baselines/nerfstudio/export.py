"""Write a Scene for nerfstudio: the same pixels, cameras and split that all other methods use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor, ones, uint8

from tidefield.data.readers.transforms import write_transforms_file
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.lenses import Lens


def export(scene: Scene, folder: Path) -> Float[Tensor, "3"]:
    """Write photographs (PNG, undistorted, at the scene's size), transforms.json and the sparse points.

    Photographs are at the common exposure, as all other methods see them, times a factor that avoids clipping.

    Returns:
        The factor: renderings divided by it are at the common exposure.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    cameras, files = scene.cameras, [f"images/{index:05d}.png" for index in range(len(scene.names))]
    factor = cameras.gain.amin(0).clamp(max=1.0) if scene.background_rgb is None else ones(3)
    for index, file in enumerate(files):
        colour = scene.photographs[index].float() / cameras.gain[index] * factor
        Image.fromarray(colour.round().clamp(0, 255).to(uint8).numpy()).save(folder / file)
    points = scene.points
    write_transforms_file(
        folder,
        files,
        [_lens(cameras[index]) for index in range(len(files))],
        cameras.T_world_camera[:, :3].double().numpy(),
        (scene.train, scene.test),
        np.zeros((0, 3)) if points is None else points.xyz_world.double().numpy(),
        _point_colours(scene),
        overwrite=True,
    )
    return factor


def camera_to_json(camera: Cameras) -> dict[str, Any]:
    """Describe one camera for the worker."""
    return {
        "T_world_camera": camera.T_world_camera[0].tolist(),
        "focal_px": camera.focal_px[0].tolist(),
        "principal_px": camera.principal_px[0].tolist(),
        "size_px": camera.size_px[0].tolist(),
    }


def _lens(camera: Cameras) -> Lens:
    (fx, fy), (cx, cy) = camera.focal_px[0].tolist(), camera.principal_px[0].tolist()
    return Lens(camera.width, camera.height, fx=fx, fy=fy, cx=cx, cy=cy)


def _point_colours(scene: Scene) -> UInt8[np.ndarray, "P 3"]:
    """Sample each sparse point's colour in the first training photograph that shows it; grey where none does."""
    points = scene.points
    if points is None:
        return np.zeros((0, 3), dtype=np.uint8)
    rgb = np.full((len(points.xyz_world), 3), 128, dtype=np.uint8)
    for index in reversed(scene.train):
        mine = points.camera_index == index
        photograph = scene.photographs[index]
        u, v = points.uv_px[mine].floor().long().unbind(-1)
        inside = (u >= 0) & (v >= 0) & (u < photograph.shape[1]) & (v < photograph.shape[0])
        rgb[points.point_index[mine][inside].numpy()] = photograph[v[inside], u[inside]].numpy()
    return rgb
