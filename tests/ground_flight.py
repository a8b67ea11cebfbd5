"""Photograph files of a small simulated nadir flight over hilly, textured ground, with ground truth."""

from dataclasses import dataclass
from pathlib import Path

import camera_files
import cv2
import numpy as np
from PIL.ExifTags import Base

from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.lenses import Lens, LensModel

WIDTH, HEIGHT, FOCAL = 400, 300, 320.0
LENS = Lens(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
ABOVE = 40.0
TEXEL_M, SIDE = 0.1, 1400
FRAME = LocalFrame.at("EPSG:4326", (-2.75, 54.0, 100.0), "the ellipsoid of WGS 84")
FOCAL_MM, EQUIVALENT_MM = 8.0, 27.69  # 320 px of a diagonal of 500, on the 43.27 mm of a full frame's


@dataclass(frozen=True)
class Flight:
    """Folder and names of the files, and true camera positions."""

    folder: Path
    position_world: np.ndarray
    names: tuple[str, ...]


def hills(xy: np.ndarray) -> np.ndarray:
    """Height of the ground, metres."""
    return 1.5 * np.sin(xy[..., 0] / 7) * np.cos(xy[..., 1] / 9)


def picture(ground: np.ndarray, position: np.ndarray, lens: LensModel = LENS) -> np.ndarray:
    """Render a nadir photograph with north at the top."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    slope = lens.unproject(np.stack([u, v], -1).reshape(-1, 2)).reshape(HEIGHT, WIDTH, 2) * (1, -1)
    xy = position[:2] + slope * position[2]
    for _ in range(8):
        xy = position[:2] + slope * (position[2] - hills(xy))[..., None]
    texel = xy / TEXEL_M + SIDE / 2
    column, row = (np.ascontiguousarray(texel[..., k], dtype=np.float32) - 0.5 for k in range(2))
    return cv2.remap(ground, column, row, cv2.INTER_LINEAR)


def fly(
    folder: Path,
    rows: int = 3,
    columns: int = 4,
    gains: np.ndarray | None = None,
    seed: int = 0,
    first: int = 0,
    east_m: float = 0.0,
    lens: LensModel = LENS,
) -> Flight:
    """Write photographs 12 m apart with EXIF of lens, time and position; numbers start at `first`."""
    ground = camera_files.texture((SIDE, SIDE), seed)
    x, y = np.meshgrid((np.arange(columns) - (columns - 1) / 2) * 12.0, (np.arange(rows) - (rows - 1) / 2) * 12.0)
    rng = np.random.default_rng(seed)
    position = np.stack([x.ravel(), y.ravel(), np.full(x.size, ABOVE) + rng.uniform(-2, 2, x.size)], 1)
    names = []
    for k, place in enumerate(position):
        pixels = picture(ground, place, lens)
        if gains is not None:
            pixels = np.clip(np.rint(pixels * gains[k]), 0, 255).astype(np.uint8)
        longitude, latitude, height = FRAME.to_geographic(place[None] + np.array([east_m, 0.0, 0.0]))[0].tolist()
        clock = f"2026:05:01 10:{(first + k) // 60:02d}:{(first + k) % 60:02d}"
        tags = {
            Base.Make: "Maker",
            Base.Model: "M1",
            Base.DateTimeOriginal: clock,
            Base.FocalLength: FOCAL_MM * lens.fx / FOCAL,
        }
        table = camera_files.exif(
            {**tags, Base.FocalLengthIn35mmFilm: EQUIVALENT_MM * lens.fx / FOCAL},
            place=(latitude, longitude),
            height_m=height,
        )
        names.append(f"flight {first + k:03d}.jpg")
        camera_files.photograph(folder / names[-1], pixels=pixels, table=table)
    return Flight(folder, position + np.array([east_m, 0.0, 0.0]), tuple(names))
