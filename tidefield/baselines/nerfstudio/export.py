"""A Scene as nerfstudio reads it: the very pixels, cameras and split that every other method here gets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from tidefield.data.ply import write_ply
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras

TRANSFORMS_FILE, CLOUD_FILE = "transforms.json", "points.ply"


def export(scene: Scene, folder: Path) -> torch.Tensor:
    """Write photographs (PNG, undistorted, at the scene's size), transforms.json and the sparse points.

    Photographs are at the common exposure, as all other methods see them, times a factor that keeps the brightest in
    range.

    Returns:
        The factor: renderings divided by it are at the common exposure.
    """
    (folder / "images").mkdir(parents=True, exist_ok=True)
    factor = scene.cameras.gain.amin(0).clamp(max=1.0)
    if scene.background_rgb is not None:
        factor = torch.ones(3)
    frames, files = [], []
    for index in range(len(scene.names)):
        file = f"images/{index:05d}.png"
        even = scene.photographs[index].float() / scene.cameras.gain[index] * factor
        Image.fromarray(even.round().clamp(0, 255).to(torch.uint8).numpy()).save(folder / file)
        files.append(file)
        frames.append({"file_path": file, **_frame(scene.cameras[index])})
    top: dict[str, Any] = {
        "camera_model": "OPENCV",
        "train_filenames": [files[i] for i in scene.train],
        "val_filenames": [files[i] for i in scene.test],
        "test_filenames": [files[i] for i in scene.test],
        "frames": frames,
    }
    if scene.points is not None:
        xyz = scene.points.xyz_world.double().numpy()
        write_ply(folder / CLOUD_FILE, xyz, _colours(scene), overwrite=True)
        top["ply_file_path"] = CLOUD_FILE
    (folder / TRANSFORMS_FILE).write_text(json.dumps(top), encoding="utf-8")
    return factor


def camera_to_json(camera: Cameras) -> dict[str, Any]:
    """One camera, for the worker."""
    return {
        "T_world_camera": camera.T_world_camera[0].tolist(),
        "focal_px": camera.focal_px[0].tolist(),
        "principal_px": camera.principal_px[0].tolist(),
        "size_px": camera.size_px[0].tolist(),
    }


def _frame(camera: Cameras) -> dict[str, Any]:
    (fx, fy), (cx, cy) = camera.focal_px[0].tolist(), camera.principal_px[0].tolist()
    # OpenGL's axes: +x right, +y up, -z forward.
    pose = camera.T_world_camera[0].double() * torch.tensor([1.0, -1.0, -1.0, 1.0])
    matrix = [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
    size = {"w": camera.width, "h": camera.height}
    return {**size, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "transform_matrix": matrix}


def _colours(scene: Scene) -> np.ndarray:
    """Colours of the sparse points, as the first photograph that may be learned from shows them."""
    points = scene.points
    assert points is not None, "asked for only where there are some"
    rgb = np.full((len(points.xyz_world), 3), 128, dtype=np.uint8)
    for index in reversed(scene.train):
        mine = points.camera_index == index
        photograph = scene.photographs[index]
        u, v = points.uv_px[mine].floor().long().unbind(-1)
        inside = (u >= 0) & (v >= 0) & (u < photograph.shape[1]) & (v < photograph.shape[0])
        rgb[points.point_index[mine][inside].numpy()] = photograph[v[inside], u[inside]].numpy()
    return rgb
