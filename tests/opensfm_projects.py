"""OpenSfM projects in OpenSfM's format, and an independent implementation of its documented projection."""

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

LANDSCAPE = {"width": 64, "height": 48}
PORTRAIT = {"width": 48, "height": 64}
BROWN = {"projection_type": "brown", "focal_x": 0.78, "focal_y": 0.80, "c_x": 0.012, "c_y": -0.021}
BROWN |= {"k1": -0.11, "k2": 0.03, "k3": -0.007, "p1": 0.0015, "p2": -0.0025}
CAMERAS: dict[str, dict[str, Any]] = {
    "perspective": {"projection_type": "perspective", "focal": 0.81, "k1": -0.1, "k2": 0.02},
    "brown": BROWN,
    "radial": {**{key: BROWN[key] for key in ("focal_x", "focal_y", "c_x", "c_y", "k1", "k2")}},
    "simple_radial": {**{key: BROWN[key] for key in ("focal_x", "focal_y", "c_x", "c_y", "k1")}},
}
CAMERAS["fisheye"] = {"projection_type": "fisheye", "focal": 0.41, "k1": 0.03, "k2": -0.01}
CAMERAS["fisheye_opencv"] = {"projection_type": "fisheye_opencv", "focal_x": 0.41, "focal_y": 0.42}
CAMERAS["fisheye_opencv"] |= {"c_x": 0.012, "c_y": -0.021, "k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": -0.0005}
for kind in ("radial", "simple_radial"):
    CAMERAS[kind]["projection_type"] = kind


def project(camera: dict[str, Any], shot: dict[str, Any], xyz_world: np.ndarray) -> tuple[float, float] | None:
    """Normalised image coordinates by https://opensfm.org/docs/geometry.html, squares in Brown's terms as in its code.

    None behind the camera.
    """
    x, y, z = (cv2.Rodrigues(np.array(shot["rotation"]))[0] @ xyz_world + shot["translation"]).tolist()
    if z <= 0:
        return None
    xn, yn = x / z, y / z
    r = math.hypot(xn, yn)
    if camera["projection_type"].startswith("fisheye"):
        angle = math.atan2(math.hypot(x, y), z)
        d = sum(camera.get(f"k{k}", 0) * angle ** (2 * k) for k in range(1, 5))
        d = (1 + d) * angle / math.hypot(x, y)
        fx, fy = camera.get("focal_x", camera.get("focal")), camera.get("focal_y", camera.get("focal"))
        return fx * d * x + camera.get("c_x", 0), fy * d * y + camera.get("c_y", 0)
    d = 1 + camera.get("k1", 0) * r**2 + camera.get("k2", 0) * r**4
    if camera["projection_type"] == "perspective":
        return camera["focal"] * d * xn, camera["focal"] * d * yn
    d += camera.get("k3", 0) * r**6
    p1, p2 = camera.get("p1", 0), camera.get("p2", 0)
    tx = 2 * p1 * xn * yn + p2 * (r**2 + 2 * xn**2)
    ty = 2 * p2 * xn * yn + p1 * (r**2 + 2 * yn**2)
    return (
        camera["focal_x"] * (d * xn + tx) + camera["c_x"],
        camera["focal_y"] * (d * yn + ty) + camera["c_y"],
    )


def pixel(camera: dict[str, Any], xy: tuple[float, float]) -> tuple[float, float]:
    """By the same page, whose pixel (0, 0) is the middle of the first; ours is its corner."""
    longer = max(camera["width"], camera["height"])
    u, v = longer * xy[0] + (camera["width"] - 1) / 2, longer * xy[1] + (camera["height"] - 1) / 2
    return u + 0.5, v + 0.5


def reconstruction(kind: str = "brown", size: dict[str, int] = LANDSCAPE, shots: int = 9) -> dict[str, Any]:
    """A survey of three strips, 10 m above bumpy ground, tilted a little."""
    random = np.random.default_rng(5)
    flown = {}
    for i in range(shots):
        tilt = cv2.Rodrigues(random.normal(0, 0.05, 3))[0]
        rotation = np.diag([1.0, -1.0, -1.0]) @ tilt
        position = np.array([3.0 * (i % 3 - 1), 2.0 * (i // 3 - 1), 10 + random.normal(0, 0.1)])
        flown[f"DJI_{8 - i:04d}.png"] = {
            "rotation": cv2.Rodrigues(rotation)[0][:, 0].tolist(),
            "translation": (-rotation @ position).tolist(),
            "camera": "v2 make model",
            "orientation": 1,
            "gps_dop": 5.0,
            "gps_position": position.tolist(),
        }
    xyz = np.concatenate([random.uniform(-9, 9, (600, 2)), random.uniform(0, 1, (600, 1))], axis=1)
    colours = random.integers(0, 256, (600, 3)).astype(float)
    points = {
        str(7 * k): {"coordinates": x.tolist(), "color": c.tolist()}
        for k, (x, c) in enumerate(zip(xyz, colours, strict=True))
    }
    return {"cameras": {"v2 make model": {**CAMERAS[kind], **size}}, "shots": flown, "points": points}


def write_photographs(folder: Path, top: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(6)
    for name, shot in top["shots"].items():
        camera = top["cameras"][shot["camera"]]
        coarse = random.integers(30, 220, (6, 8, 3), dtype=np.uint8)
        Image.fromarray(cv2.resize(coarse, (camera["width"], camera["height"]))).save(folder / name)


def write_opensfm(root: Path, *tops: dict[str, Any], photographs: bool = True) -> Path:
    """A data set of OpenSfM with these reconstructions."""
    root.mkdir(parents=True, exist_ok=True)
    for top in tops if photographs else ():
        write_photographs(root / "images", top)
    file = root / "reconstruction.json"
    file.write_text(json.dumps(tops))
    return file


def tracks_of(top: dict[str, Any]) -> list[tuple[str, str, tuple[float, float]]]:
    """Every observation: photograph, point, normalised image coordinates."""
    seen = []
    for name, shot in top["shots"].items():
        camera = top["cameras"][shot["camera"]]
        for point, values in top["points"].items():
            xy = project(camera, shot, np.array(values["coordinates"]))
            if xy is not None:
                u, v = pixel(camera, xy)
                if 0 <= u <= camera["width"] and 0 <= v <= camera["height"]:
                    seen.append((name, point, xy))
    return seen


def write_tracks(
    file: Path, seen: list[tuple[str, str, tuple[float, float]]], version: int | None = 2, name_it: bool = True
) -> None:
    """tracks.csv of a version; the oldest usually has no header."""
    lines = [f"OPENSFM_TRACKS_VERSION_v{version}"] if name_it else []
    for k, (name, point, (x, y)) in enumerate(seen):
        record = [name, point, str(k), repr(x), repr(y), *(["0.004"] if version else []), "10", "20", "30"]
        lines.append("\t".join(record + (["-1", "-1"] if version == 2 else [])))
    file.write_text("\n".join(lines) + "\n")
