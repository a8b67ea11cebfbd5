"""Small synthetic surveys with exact cameras, written in each supported layout."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from PIL import Image

from tidefield.geometry.lenses import FisheyeLens, Lens, LensModel, colmap_parameters

BARREL = Lens(64, 48, 50.0, 51.0, 31.5, 24.5, k1=-0.12, k2=0.02, p1=0.001, p2=-0.002)
PINHOLE = Lens(64, 48, 50.0, 50.0, 32.0, 24.0)
FISHEYE = FisheyeLens(64, 48, 28.0, 28.5, 31.5, 24.5, k1=0.03, k2=-0.01, k3=0.002, k4=-0.0005)
UTM = np.array([430_000.0, 6_100_000.0, 0.0])


@dataclass(frozen=True)
class Truth:
    """A survey: nine photographs in three strips, 10 m above bumpy ground, nearly straight down."""

    names: tuple[str, ...]
    lenses: tuple[LensModel, ...]
    T_world_camera: np.ndarray
    ground: np.ndarray
    pictures: tuple[np.ndarray, ...]


def survey(lens: LensModel = BARREL, offset: np.ndarray | None = None) -> Truth:
    random = np.random.default_rng(7)
    poses, pictures, names = [], [], []
    for i in range(9):
        tilt = cv2.Rodrigues(random.normal(0, 0.05, 3))[0]
        down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
        position = np.array([3.0 * (i % 3 - 1), 2.0 * (i // 3 - 1), 10 + random.normal(0, 0.1)])
        poses.append(np.concatenate([tilt @ down, position[:, None]], axis=1))
        coarse = random.integers(30, 220, (6, 8, 3), dtype=np.uint8)
        pictures.append(cv2.resize(coarse, (lens.width, lens.height), interpolation=cv2.INTER_LINEAR))
        names.append(f"strip_{i // 3}/photo_{8 - i}.png")
    xyz = np.concatenate([random.uniform(-9, 9, (600, 2)), random.uniform(0, 1, (600, 1))], axis=1)
    offset = np.zeros(3) if offset is None else offset
    poses = np.array(poses) + np.concatenate([np.zeros((3, 3)), offset[:, None]], axis=1)
    return Truth(tuple(names), (lens,) * 9, poses, xyz + offset, tuple(pictures))


def with_one_larger(truth: Truth) -> Truth:
    """The same survey, whose fourth photograph is from another camera, of twice the size and without distortion."""
    lenses = list(truth.lenses)
    lenses[3] = replace(PINHOLE.resized(128, 96))
    pictures = list(truth.pictures)
    pictures[3] = cv2.resize(pictures[3], (128, 96), interpolation=cv2.INTER_LINEAR)
    return replace(truth, lenses=tuple(lenses), pictures=tuple(pictures))


def write_pictures(folder: Path, truth: Truth) -> None:
    for name, picture in zip(truth.names, truth.pictures, strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture).save(folder / name)


def write_colmap(
    root: Path, truth: Truth, text: bool = False, place: str = "sparse/0", wrong: frozenset[str] = frozenset()
) -> Path:
    """A COLMAP model, by pycolmap; OPENCV cameras where there is distortion.

    Args:
        wrong: photographs whose observations are all in the wrong place.
    """
    model = pycolmap.Reconstruction()
    numbers = {lens: i for i, lens in enumerate(dict.fromkeys(truth.lenses), start=1)}
    for lens, number in numbers.items():
        kind, parameters = lens.colmap_model, colmap_parameters(lens, lens.colmap_model)
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model=kind, width=lens.width, height=lens.height, params=parameters)
        )
    tracks = [pycolmap.Track() for _ in truth.ground]
    for i, (name, lens, pose) in enumerate(zip(truth.names, truth.lenses, truth.T_world_camera, strict=True), start=1):
        uv, seen = observe(lens, pose, truth.ground)
        keypoints = uv[seen][::-1] if name in wrong else uv[seen]
        image = pycolmap.Image(name=name, keypoints=keypoints, camera_id=numbers[lens], image_id=i)
        rotation = pose[:, :3].T
        rigid = pycolmap.Rigid3d(np.concatenate([rotation, -rotation @ pose[:, 3:]], axis=1))
        model.add_image_with_trivial_frame(image, rigid)
        for k, point in enumerate(np.flatnonzero(seen)):
            tracks[point].add_element(i, k)
    for xyz, track in zip(truth.ground, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(xyz, track)
    folder = root / place
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))
    write_pictures(root / "images", truth)
    return folder


def observe(lens: LensModel, pose: np.ndarray, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distorted pixels of points, and which of them are in the photograph."""
    uv = lens.project((ground - pose[:, 3]) @ pose[:, :3])
    return uv, ((uv >= 0) & (uv < (lens.width, lens.height))).all(axis=1)


def opengl_matrix(pose: np.ndarray) -> list[list[float]]:
    return [*(pose * (1, -1, -1, 1)).tolist(), [0.0, 0.0, 0.0, 1.0]]


def write_transforms(root: Path, truth: Truth, **more: object) -> Path:
    """nerfstudio's transforms.json, with the calibration in every frame."""
    frames = []
    for name, lens, pose in zip(truth.names, truth.lenses, truth.T_world_camera, strict=True):
        frame = {
            "file_path": f"./images/{name}",
            "transform_matrix": opengl_matrix(pose),
            "w": lens.width,
            "h": lens.height,
        }
        frame |= {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
        names = ("k1", "k2", "k3", "k4") if isinstance(lens, FisheyeLens) else ("k1", "k2", "p1", "p2", "k3")
        frame |= {name: getattr(lens, name) for name in names if name != "k3" or lens.k3}
        frames.append(frame)
    root.mkdir(parents=True, exist_ok=True)
    file = root / "transforms.json"
    file.write_text(json.dumps({"camera_model": "OPENCV", "aabb_scale": 16, "frames": frames, **more}))
    write_pictures(root / "images", truth)
    return file


def write_llff(root: Path, truth: Truth) -> Path:
    """LLFF knows one undistorted camera with the principal point in the middle."""
    right, down, forward, position = (truth.T_world_camera[:, :, i] for i in range(4))
    size = np.array([[lens.height, lens.width, lens.fx] for lens in truth.lenses])
    matrix = np.stack([down, right, -forward, position, size], axis=2)
    bounds = np.tile([8.0, 11.0], (len(matrix), 1))
    order = np.argsort(truth.names)
    root.mkdir(parents=True, exist_ok=True)
    np.save(root / "poses_bounds.npy", np.concatenate([matrix.reshape(-1, 15), bounds], axis=1)[order])
    flat = replace(truth, names=tuple(name.replace("/", "_") for name in truth.names))
    write_pictures(root / "images", flat)
    return root / "poses_bounds.npy"


def write_blender(root: Path, parts: dict[str, int], size: int = 40, angle: float = 0.7) -> None:
    """Cameras on a sphere of radius 4 that look at the origin; a disc with a half-transparent rim."""
    v, u = np.mgrid[:size, :size] + 0.5 - size / 2
    radius = np.hypot(u, v) / size
    alpha = np.where(radius < 0.25, 255, np.where(radius < 0.35, 128, 0)).astype(np.uint8)
    picture = np.stack([np.full_like(alpha, 200), np.full_like(alpha, 100), np.zeros_like(alpha), alpha], axis=-1)
    for part, count in parts.items():
        (root / part).mkdir(parents=True, exist_ok=True)
        frames = []
        for i in range(count):
            around = 2 * np.pi * (i + 0.3 * len(part)) / count
            position = 4 * np.array([0.8 * np.cos(around), 0.8 * np.sin(around), 0.6])
            forward = -position / 4
            right = np.cross(forward, [0.0, 0.0, 1.0])
            right /= np.linalg.norm(right)
            pose = np.stack([right, np.cross(forward, right), forward, position], axis=1)
            frames.append({"file_path": f"./{part}/r_{i}", "rotation": 0.1, "transform_matrix": opengl_matrix(pose)})
            Image.fromarray(picture).save(root / part / f"r_{i}.png")
        (root / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
