"""Write a synthetic survey as a COLMAP dataset, with the ground truth next to it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from torch import Tensor

from tidefield.errors import SceneError
from tidefield.geometry.cameras import Cameras
from tidefield.synthetic.flat import TidalFlat
from tidefield.synthetic.grids import Extent
from tidefield.synthetic.survey import Survey

GROUND, VEGETATION, WATER = 2, 3, 9
"""Values of `classes.png`: those of the LAS specification."""
_LEAST_PLANT_M, _LEAST_WATER_M = 0.03, 0.0125
"""Height above the ground from which a plant counts, and the depth at which water is half drawn."""


def write_survey(survey: Survey, folder: Path, suffix: str = ".png", truth: bool = True) -> None:
    """Write `images/`, a COLMAP model in `sparse/0`, and, with `truth`, `truth/`.

    `truth/` holds `depth/NAME.npy` (float32 z-depth at pixel centres, metres), and on one north-up grid
    `orthophoto.png`, `surface.npy` (float32 height, metres), `bare.npy` (the same without plants) and `classes.png`
    (`GROUND`, `VEGETATION` or `WATER`); and `truth.json` with that grid and each photograph's gain.

    Args:
        survey: photographs, cameras and truth.
        folder: new or empty.
        suffix: of the photographs, .png or .jpg (quality 97).
        truth: takes a quarter of the time.

    Raises:
        SceneError: the folder is not empty or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SceneError(f"{folder} is not empty: a synthetic scene needs an empty folder; name another or empty it")
    # The order of the flight is sorted order.
    names = [f"{survey.category}_{i + 1:04d}{suffix}" for i in range(len(survey.cameras))]
    try:
        for part in ("images", "sparse/0"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        for name, photograph in zip(names, survey.photographs, strict=True):
            write_picture(folder / "images" / name, photograph.numpy())
        _reconstruction(survey, names).write_binary(folder / "sparse" / "0")
        if truth:
            (folder / "truth" / "depth").mkdir(parents=True, exist_ok=True)
            for name, depth in zip(names, survey.depth, strict=True):
                np.save(folder / "truth" / "depth" / f"{Path(name).stem}.npy", depth.numpy())
            _write_map(survey, names, folder / "truth")
    except OSError as error:
        raise SceneError(f"cannot write to {folder}: {error}; free some space or name another folder") from error


def model_of_lens(cameras: Cameras) -> pycolmap.Reconstruction:
    """Start a COLMAP model whose one PINHOLE camera, number 1, is that of all cameras."""
    model = pycolmap.Reconstruction()
    params = [*cameras.focal_px[0].tolist(), *cameras.principal_px[0].tolist()]
    lens = pycolmap.Camera(model="PINHOLE", width=cameras.width, height=cameras.height, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(lens)
    return model


def add_photograph(
    model: pycolmap.Reconstruction, cameras: Cameras, index: int, name: str, uv_px: Float64[np.ndarray, "K 2"]
) -> None:
    """Add a photograph with its true pose and its keypoints to such a model, with number `index` + 1."""
    image = pycolmap.Image(name=name, keypoints=uv_px, camera_id=1, image_id=index + 1)
    pose = cameras.T_world_camera[index].double().numpy()
    rotation = pose[:, :3].T
    T_camera_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ pose[:, 3])
    model.add_image_with_trivial_frame(image, T_camera_world)


def _reconstruction(survey: Survey, names: list[str]) -> pycolmap.Reconstruction:
    """Build the COLMAP model: true poses, one PINHOLE camera, the sparse points and their tracks."""
    cameras, points, photographs = survey.cameras, survey.points, survey.photographs.numpy()
    model = model_of_lens(cameras)
    point, camera, uv = points.point_index.numpy(), points.camera_index.numpy(), points.uv_px.numpy()
    slot = np.zeros(len(point), dtype=int)
    for i, name in enumerate(names):
        rows = np.nonzero(camera == i)[0]
        slot[rows] = np.arange(len(rows))
        add_photograph(model, cameras, i, name, uv[rows].astype(np.float64))
    order = np.argsort(point, kind="stable")
    tracks = np.split(order, np.nonzero(np.diff(point[order]))[0] + 1) if len(order) else []
    for track, xyz, error in zip(tracks, points.xyz_world.double().numpy(), points.error_px.tolist(), strict=True):
        elements = [pycolmap.TrackElement(int(camera[k]) + 1, int(slot[k])) for k in track]
        column, row = uv[track[0]].astype(int)
        point_id = model.add_point3D(xyz, pycolmap.Track(elements), photographs[camera[track[0]], row, column])
        model.point3D(point_id).error = error
    return model


def write_picture(
    path: Path, picture: UInt8[np.ndarray, "H W 3"] | UInt8[np.ndarray, "H W"], jpeg_quality: int = 97
) -> None:
    """Write colours, or the values of one band, as PNG or JPEG, by the name."""
    options = [] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    bands = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    # Not `imwrite`, which on Windows takes ASCII names only.
    path.write_bytes(cv2.imencode(path.suffix, bands, options)[1].tobytes())


def _write_map(survey: Survey, names: list[str], folder: Path) -> None:
    """Write orthophoto, surface and truth.json of the surveyed ground, at about the photographs' resolution."""
    cameras, whole = survey.cameras, survey.flat.surface.extent
    cell = float((cameras.position_world[:, 2] / cameras.focal_px[:, 0]).median())
    extent = Extent.around([whole.west_m, whole.south_m], [whole.east_m, whole.north_m], cell)
    colour, height_m = survey.flat.map(extent)
    write_picture(folder / "orthophoto.png", (colour * 255).round().to(torch.uint8).numpy())
    np.save(folder / "surface.npy", height_m.numpy())
    bare_m, classes = _classes(survey.flat, extent, height_m)
    np.save(folder / "bare.npy", bare_m)
    write_picture(folder / "classes.png", classes)
    truth = {
        "category": survey.category,
        "seed": survey.seed,
        "map": {
            "rows": extent.rows,
            "columns": extent.columns,
            "first_pixel_centre_east_north_m": [extent.west_m, extent.north_m],
            "pixel_step_east_north_m": [cell, -cell],
            "colour": "sRGB, straight down, without mirrored light",
            "height": "metres above mean mud level, plants and water included",
            "classes": {"ground": GROUND, "vegetation": VEGETATION, "water": WATER},
        },
        "gain": dict(zip(names, cameras.gain.tolist(), strict=True)),
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")


def _classes(
    flat: TidalFlat, extent: Extent, height_m: Float[Tensor, "H W"]
) -> tuple[Float32[np.ndarray, "H W"], UInt8[np.ndarray, "H W"]]:
    """Height of ground or water at the nodes of a map, row 0 in the north, and what is seen there from above."""
    nodes = extent.nodes().split(1 << 20, dim=1)
    bare, bed = (
        torch.cat([raster.sample(part)[0] for part in nodes]).reshape(extent.rows, extent.columns).flip(0)
        for raster in (flat.surface, flat.bed)
    )
    classes = torch.where(bare - bed > _LEAST_WATER_M, WATER, GROUND)
    classes = torch.where(height_m - bare > _LEAST_PLANT_M, VEGETATION, classes)
    return bare.numpy(), classes.to(torch.uint8).numpy()
