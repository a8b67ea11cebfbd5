"""Write a synthetic survey as a COLMAP dataset, with the ground truth next to it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch
from jaxtyping import UInt8
from torch import Tensor

from tidefield.errors import SceneError
from tidefield.synthetic.grids import Extent
from tidefield.synthetic.survey import Survey


def write_survey(survey: Survey, folder: Path, suffix: str = ".png") -> None:
    """Write `images/`, a COLMAP model in `sparse/0`, and `truth/`.

    `truth/` holds `depth/NAME.npy` (float32 z-depth at pixel centres, metres), `orthophoto.png` and
    `surface.npy` (float32 height, metres) on one north-up grid, and `truth.json` with that grid and each
    photograph's gain.

    Args:
        survey: photographs, cameras and truth.
        folder: new or empty.
        suffix: of the photographs, .png or .jpg (quality 97).

    Raises:
        SceneError: the folder is not empty or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SceneError(f"{folder} is not empty: a synthetic scene needs an empty folder; name another or empty it")
    names = _photograph_names(survey, suffix)
    try:
        for part in ("images", "sparse/0", "truth/depth"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        for name, photograph, depth in zip(names, survey.photographs.cpu(), survey.depth.cpu(), strict=True):
            _write_picture(folder / "images" / name, photograph)
            np.save(folder / "truth" / "depth" / f"{Path(name).stem}.npy", depth.numpy())
        _reconstruction(survey, names).write_binary(folder / "sparse" / "0")
        _write_map(survey, names, folder / "truth")
    except OSError as error:
        raise SceneError(f"cannot write to {folder}: {error}; free some space or name another folder") from error


def _photograph_names(survey: Survey, suffix: str = ".png") -> tuple[str, ...]:
    """Name the photographs; flight order is sorted order."""
    return tuple(f"{survey.category}_{i + 1:04d}{suffix}" for i in range(len(survey.cameras)))


def _reconstruction(survey: Survey, names: tuple[str, ...]) -> pycolmap.Reconstruction:
    """Build the COLMAP model: true poses, one PINHOLE camera, the sparse points and their tracks."""
    cameras, points = survey.cameras.to("cpu"), survey.points
    model = pycolmap.Reconstruction()
    (fx, fy), (cx, cy) = cameras.focal_px[0].tolist(), cameras.principal_px[0].tolist()
    lens = pycolmap.Camera(
        model="PINHOLE", width=cameras.width, height=cameras.height, params=[fx, fy, cx, cy], camera_id=1
    )
    model.add_camera_with_trivial_rig(lens)
    point, camera, uv = (x.cpu().numpy() for x in (points.point_index, points.camera_index, points.uv_px))
    slot = np.zeros(len(point), dtype=int)
    for i, name in enumerate(names):
        rows = np.nonzero(camera == i)[0]
        slot[rows] = np.arange(len(rows))
        image = pycolmap.Image(name=name, keypoints=uv[rows].astype(np.float64), camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, _camera_from_world(cameras.T_world_camera[i]))
    photographs = survey.photographs.cpu().numpy()
    order = np.argsort(point, kind="stable")
    tracks = np.split(order, np.nonzero(np.diff(point[order]))[0] + 1) if len(order) else []
    xyz, error = points.xyz_world.cpu().numpy().astype(np.float64), points.error_px.cpu().numpy()
    for track in tracks:
        elements = [pycolmap.TrackElement(int(camera[k]) + 1, int(slot[k])) for k in track]
        column, row = uv[track[0]].astype(int)
        colour = photographs[camera[track[0]], row, column]
        point_id = model.add_point3D(xyz[point[track[0]]], pycolmap.Track(elements), colour)
        model.point3D(point_id).error = float(error[point[track[0]]])
    return model


def _camera_from_world(pose: Tensor) -> pycolmap.Rigid3d:
    rotation = pose[:, :3].double().numpy().T
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ pose[:, 3].double().numpy())


def _write_picture(path: Path, colour: UInt8[Tensor, "H W 3"]) -> None:
    quality = [] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 97]
    if not cv2.imwrite(str(path), cv2.cvtColor(colour.numpy(), cv2.COLOR_RGB2BGR), quality):
        raise SceneError(f"cannot write {path}: free some space or name another folder")


def _write_map(survey: Survey, names: tuple[str, ...], folder: Path) -> None:
    """Write orthophoto, surface and truth.json of the surveyed ground, at about the photographs' resolution."""
    cameras, extent = survey.cameras, survey.flat.extent
    cell = float((cameras.position_world[:, 2] / cameras.focal_px[:, 0]).median())
    ground = survey.flat.orthophoto(Extent.around(extent.west_m, extent.south_m, extent.east_m, extent.north_m, cell))
    _write_picture(folder / "orthophoto.png", (ground.colour * 255).round().to(torch.uint8).cpu())
    np.save(folder / "surface.npy", ground.height_m.cpu().numpy())
    rows, columns = ground.height_m.shape
    truth = {
        "category": survey.category,
        "seed": survey.seed,
        "map": {
            "rows": rows,
            "columns": columns,
            "first_pixel_centre_east_north_m": [ground.west_m, ground.north_m],
            "pixel_step_east_north_m": [ground.cell_m, -ground.cell_m],
            "colour": "sRGB, straight down, without mirrored light",
            "height": "metres above mean mud level, plants and water included",
        },
        "gain": dict(zip(names, cameras.gain.cpu().tolist(), strict=True)),
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
