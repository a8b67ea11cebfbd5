"""Zero-shot views of scenes with COLMAP's sparse points, and of the same without any, which are then found on opening.

A scene without a COLMAP model (NeRF's synthetic ones) gets one first: its photographs on white instead of transparent,
COLMAP's features and exhaustive matches, its triangulation with the poses held.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image
from tyro.conf import Positional

from benchmarks.records import MEASURED, NETWORK, HiddenRunner, network_of, require_same, say, show, store
from tidefield.compare.run import named, run_measured, tidefield
from tidefield.compare.tables import Table
from tidefield.data.holdout import FILE_NAME as HOLDOUT_FILE
from tidefield.data.load import own_lens, read_posed
from tidefield.data.readers.colmap import find_colmap
from tidefield.files import completed_folder, read_json
from tidefield.geometry.lenses import colmap_parameters
from tidefield.survey.sfm.features import set_up_pycolmap

POINTS_FILE = "points.json"
WAYS = ("with", "without")
METRICS = ("psnr_seen_cc", "ssim_seen_cc", "flip_seen_cc")
MODELS = ("sparse/0", "sparse")
TRANSFORMS_FILE = "transforms.json"
"""Its split counts, next to a COLMAP model."""


def points(
    scenes: Positional[tuple[Path, ...]],
    work: Path = Path("runs/points"),
    runs: Path = MEASURED,
    widths: tuple[int, ...] = (400,),
    device: str = "auto",
    run: HiddenRunner = run_measured,
) -> dict[str, Any]:
    """Evaluate scenes with and without their points; what was measured is kept.

    Args:
        scenes: With COLMAP models, or posed photographs only, which get COLMAP's points first.
        work: Folder for the scenes without points.
        runs: Store the figures in this folder's points.json; what it holds is not measured again.
        widths: Of the pictures in pixels.
        device: auto, cpu, cuda, cuda:N or mps.
        run: Runs a command.

    Raises:
        SceneError: two scenes have one name.
        RunError: a figure that is kept is of other weights.
    """
    record = read_json(runs / POINTS_FILE) or {"figures": {}}
    for name, scene in named(scenes).items():
        network = {NETWORK: network_of(scene)}
        folders = {"with": scene, "without": work / name}
        if find_colmap(scene, *MODELS) is None:
            folders["with"] = work / f"{name}_colmap"
            if not folders["with"].exists():
                say(f"{name}: points of COLMAP")
                with completed_folder(folders["with"]) as partial:
                    write_colmap(scene, partial)
        if not folders["without"].exists():
            with completed_folder(folders["without"]) as partial:
                write_without_points(folders["with"], partial)
        for width in widths:
            for way in WAYS:
                place = record["figures"].setdefault(name, {}).setdefault(str(width), {})
                if way in place:
                    require_same(runs / POINTS_FILE, f"{name}, {width} px, {way} points", place[way], network)
                    continue
                say(f"{name}, {width} px, {way} points")
                with TemporaryDirectory() as temporary:
                    out = Path(temporary) / "out"
                    words = ["evaluate", folders[way], out, "--zero-shot", "--width", width, "--device", device]
                    run(tidefield(*words), {})
                    found = read_json(out / "evaluation.json")
                place[way] = {metric: found["mean"][metric] for metric in METRICS}
                place[way] |= {**network, "held_out": found["split"]["test"]}
                held_out = {tuple(place[way]["held_out"]) for way in place}
                assert len(held_out) == 1, f"{name} with and without points holds out other photographs: {held_out}"
                figures = [one for of in record["figures"].values() for ways in of.values() for one in ways.values()]
                store(runs / POINTS_FILE, record, place[way], figures, "python -m benchmarks points SCENE...")
    show(tables(record))
    return record


def write_without_points(scene: Path, folder: Path) -> None:
    """Copy a COLMAP scene without its points: photographs, masks, split and gains stay."""
    import pycolmap

    model_folder = find_colmap(scene, *MODELS)
    assert model_folder is not None
    model = pycolmap.Reconstruction(model_folder)
    for point in list(model.point3D_ids()):
        model.delete_point3D(point)
    for part in ("images", "masks"):
        if (scene / part).is_dir():
            shutil.copytree(scene / part, folder / part)
    for file in (HOLDOUT_FILE, TRANSFORMS_FILE):
        if (scene / file).is_file():
            shutil.copy(scene / file, folder / file)
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")


def write_colmap(scene: Path, folder: Path) -> None:
    """Make a COLMAP scene of a posed one, on white, with the points of COLMAP's own features and exhaustive matches."""
    import pycolmap

    set_up_pycolmap()
    posed = read_posed(scene, True)
    used = range(len(posed.names))
    if posed.split is not None:
        used = [i for i in used if posed.names[i] in posed.split[0]]
    (folder / "images").mkdir(parents=True)
    names = [f"{k:04d}.png" for k in range(len(used))]
    for name, i in zip(names, used, strict=True):
        with Image.open(posed.paths[i]) as picture:
            rgba = picture.convert("RGBA")
        white = Image.new("RGBA", rgba.size, "white")
        Image.alpha_composite(white, rgba).convert("RGB").save(folder / "images" / name)
        if posed.masks and (mask := posed.masks[i]) is not None:
            (folder / "masks").mkdir(exist_ok=True)
            shutil.copy(mask, folder / "masks" / f"{name}.png")
    with TemporaryDirectory() as temporary:
        database = Path(temporary) / "database.db"
        pycolmap.extract_features(
            database, folder / "images", image_names=names, camera_mode=pycolmap.CameraMode.PER_IMAGE
        )
        pycolmap.match_exhaustive(database)
        with pycolmap.Database.open(database) as db:
            images = {image.name: image for image in db.read_all_images()}
            keypoints = {name: db.read_keypoints(image.image_id)[:, :2] for name, image in images.items()}
            cameras = {}
            for name, i in zip(names, used, strict=True):
                lens, _ = own_lens(posed.paths[i], posed.lenses[i])
                parameters = colmap_parameters(lens, lens.colmap_model)
                size = {"width": lens.width, "height": lens.height}
                number = images[name].camera_id
                cameras[name] = pycolmap.Camera(camera_id=number, model=lens.colmap_model, params=parameters, **size)
                db.update_camera(cameras[name])
        model = pycolmap.Reconstruction()
        for name, i in zip(names, used, strict=True):
            pose, image = posed.T_world_camera[i], images[name]
            model.add_camera_with_trivial_rig(cameras[name])
            inverse = pycolmap.Rigid3d(np.column_stack([pose[:, :3].T, -pose[:, :3].T @ pose[:, 3]]))
            shown = pycolmap.Image(
                name=name, keypoints=keypoints[name], camera_id=image.camera_id, image_id=image.image_id
            )
            model.add_image_with_trivial_frame(shown, inverse)
        (folder / "sparse" / "0").mkdir(parents=True)
        model = pycolmap.triangulate_points(model, database, folder / "images", folder / "sparse" / "0")
        model.write_binary(folder / "sparse" / "0")


def tables(record: Mapping[str, Any]) -> list[Table]:
    """Pictures of every scene with its points and without."""
    styles = dict(zip(METRICS, ("{:.2f}", "{:.3f}", "{:.3f}"), strict=True))
    columns = ["scene", "width, px", *(f"{m}: {w}" for m in ("PSNR", "SSIM", "FLIP") for w in WAYS)]
    rows = []
    for name, widths in record["figures"].items():
        for width, ways in widths.items():
            if all(way in ways for way in WAYS):
                cells = (style.format(ways[way][metric]) for metric, style in styles.items() for way in WAYS)
                rows.append((name, width, *cells))
    return [Table("Doubly seen pixels, after the colour fit", columns, rows)]
