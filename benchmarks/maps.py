"""Maps of built-in flats against the exact truth, next to two baselines.

The baselines are the surface of the sparse points, and OpenCV's semi-global matching (Hirschmüller, Stereo processing
by semiglobal matching and mutual information, 2008) of pairs of photographs, fused into the map's grid. Both know the
exact poses, as the map does.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.records import say, show, store
from tidefield.compare.run import make_flat
from tidefield.compare.tables import Table
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.errors import RunError, need
from tidefield.files import read_json, write_json
from tidefield.maps.classes import GROUND, VEGETATION, WATER
from tidefield.maps.grid import Grid, Tile, map_frame
from tidefield.maps.make import CLASSES, DSM, DTM, MAP_FILE, ORTHOPHOTO, SIGMA
from tidefield.maps.rasters import read_raster
from tidefield.maps.surface import COARSEST, sparse_surface
from tidefield.synthetic import CATEGORIES

MAPS_FILE = "maps.json"
SEED = 41
PAIRS = 16
"""Pairs of photographs of semi-global matching: those whose bases are nearest to the middle of the map."""
BASE = (0.12, 0.45)
"""Least and largest base of a pair, as a share of the height."""


def maps(
    runs: Path = Path("runs/maps"),
    categories: tuple[str, ...] = tuple(CATEGORIES),
    width: int = 2000,
    views: int = 20,
    half: float = 12.0,
) -> None:
    """Map the middle of a flat of each category, and compare with the truth; what was measured is kept.

    Args:
        runs: Folder for flats, maps and maps.json; what it holds is not measured again.
        categories: Of flats.
        width: Of the photographs in pixels.
        views: Photographs of each survey.
        half: Half the side of the square that is mapped, metres.
    """
    record = read_json(runs / MAPS_FILE) or {"figures": {}}
    area = write_square(runs, half)
    for category in categories:
        name = f"{category}, {width} px, {views} photographs, {2 * half:g} x {2 * half:g} m"
        if name in record["figures"]:
            continue
        folder = runs / f"{category}_{width}_{views}"
        scene, out = folder / "scene", folder / f"map_{half:g}"
        say(f"{name}: photographs")
        make_flat(scene, category, SEED, views, width)
        say(f"{name}: map")
        made = made_map(scene, out, area=area)
        say(f"{name}: baselines")
        record["figures"][name] = {**compare_with_truth(scene, out), "seconds": made["seconds"]}
        command = f"python -m benchmarks maps --width {width} --views {views} --half {half:g}"
        store(runs / MAPS_FILE, record, record["figures"][name], record["figures"].values(), command)
    show(tables(record))


def write_square(folder: Path, half_m: float) -> Path:
    """Write area.json into a folder: a square around the origin, for `--area`."""
    square = [[x * half_m, y * half_m] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
    write_json(folder / "area.json", {"type": "Polygon", "coordinates": [square]})
    return folder / "area.json"


def made_map(scene: Path, out: Path, **options: Any) -> dict[str, Any]:
    """What `tidefield map --zero-shot` records of a map; it is made unless it is there.

    Args:
        scene: the scene's folder.
        out: the map's folder.
        options: further ones of the command.

    Raises:
        RunError: the folder holds another map, or the command failed.
    """
    from rich.console import Console

    from tidefield.commands.common import ZeroShot
    from tidefield.commands.map_ import Map, map_, open_job

    asked, console = Map(scene, out, ZeroShot(zero_shot=True), **options), Console(quiet=True)
    made = read_json(out / MAP_FILE) or {}
    if not made.get("complete"):
        return map_(asked, console)
    with open_job(asked, console) as (job, _, _):
        if made.get("key") != job.key:
            raise RunError(
                f"{out} has a map of another scene, of other weights or with other options: expected that which is "
                "asked for; delete the folder to make it"
            )
    return made


def compare_with_truth(root: Path, out: Path) -> dict[str, Any]:
    """Measure a map and the baselines against the truth of a built-in flat, on cells with a height in all of them."""
    scene = load_scene(root, hold_out=False)
    grid, height, sparse, picture = read_map(scene, out)
    (sigma, _), (terrain, _), (found_classes, _) = (read_raster(out / name) for name in (SIGMA, DTM, CLASSES))
    true, bare, colour, classes = _truth(root, grid)
    stereo = semi_global(scene, grid)
    kept = np.isfinite(height) & np.isfinite(true) & np.isfinite(stereo)
    # The photographs' common exposure differs from the truth by a factor of each channel.
    shown = picture * (colour[kept].mean(0) / picture[kept].mean(0))
    mse = ((shown[kept].clip(0, 255) - colour[kept]) ** 2).mean()
    found = {"map": height, "sparse points": sparse, "semi-global": stereo}
    return {
        "cells": int(kept.sum()),
        "cell_m": grid.cell,
        "heights": {name: errors((values - true)[kept]) for name, values in found.items()},
        "ground": {"terrain": errors((terrain - bare)[kept]), "surface": errors((height - bare)[kept])},
        "within": float((np.abs(height - true) < 1.96 * sigma)[kept].mean()),
        "sigma_median_m": float(np.median(sigma[kept])),
        "orthophoto_psnr": float(10 * np.log10(255**2 / mse)),
        "classes": overlaps(found_classes[kept], classes[kept]),
        "water": _levels(json.loads((out / MAP_FILE).read_text())["water"], true[kept & (classes == WATER)]),
    }


def read_map(scene: Scene, out: Path) -> tuple[Grid, np.ndarray, np.ndarray, np.ndarray]:
    """Read a map of a scene without a georeference.

    Returns:
        Its cells; their heights (rows x columns), NaN where there is none; those of the sparse points' surface; and the
        orthophoto's colours (rows x columns x 3, 8 bits).
    """
    height, profile = read_raster(out / DSM)
    with need("rasterio").open(out / ORTHOPHOTO) as dataset:
        colour = dataset.read([1, 2, 3]).transpose(1, 2, 0)
    at, (rows, columns) = profile["transform"], height.shape
    grid = Grid(map_frame(scene, None), at.c, at.f, at.a, columns, rows, float(np.nanmedian(height)))
    # The grid of coarse cells begins at the same corner.
    sparse = sparse_surface(scene, grid.coarser(COARSEST)).on(whole(grid), 0)[:rows, :columns]
    return grid, height, sparse, colour


def overlaps(found: np.ndarray, true: np.ndarray) -> dict[str, dict[str, float | None]]:
    """Intersection over union of each class, and the share that it has of the true and the found cells."""
    result = {}
    for name, value in (("ground", GROUND), ("vegetation", VEGETATION), ("water", WATER)):
        a, b = found == value, true == value
        union = int((a | b).sum())
        overlap = int((a & b).sum()) / union if union else None
        result[name] = {"true": float(b.mean()), "found": float(a.mean()), "iou": overlap}
    return result


def _levels(bodies: Sequence[dict[str, float]], true: np.ndarray) -> list[dict[str, float | None]]:
    """Levels of the bodies of water that were found, against the median of the true water's heights."""
    if not len(true):
        return [{**body, "error": None} for body in bodies]
    return [{**body, "error": body["height"] - float(np.median(true))} for body in bodies]


def errors(error: np.ndarray) -> dict[str, float]:
    """RMSE, mean and NMAD (Höhle and Höhle, 2009), metres."""
    middle = np.median(error)
    return {
        "rmse_m": float(np.sqrt((error**2).mean())),
        "mean_m": float(error.mean()),
        "nmad_m": float(1.4826 * np.median(np.abs(error - middle))),
    }


def whole(grid: Grid) -> Tile:
    """A tile of all cells, and more where they are no square."""
    return Tile(grid, 0, 0, max(grid.rows, grid.columns), 0)


def _truth(root: Path, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Heights with and without plants, colours and classes of a flat at the centres of cells."""
    about = json.loads((root / "truth" / "truth.json").read_text())["map"]
    west, north = about["first_pixel_centre_east_north_m"]
    cell = about["pixel_step_east_north_m"][0]
    east = (grid.west + (np.arange(grid.columns) + 0.5) * grid.cell - west) / cell
    south = (north - (grid.north - (np.arange(grid.rows) + 0.5) * grid.cell)) / cell
    u, v = np.meshgrid(east.astype(np.float32), south.astype(np.float32))
    height, bare = (
        cv2.remap(np.load(root / "truth" / f"{name}.npy"), u, v, cv2.INTER_LINEAR) for name in ("surface", "bare")
    )
    picture = cv2.imread(str(root / "truth" / "orthophoto.png"))
    assert picture is not None
    classes = cv2.imread(str(root / "truth" / "classes.png"), cv2.IMREAD_GRAYSCALE)
    assert classes is not None
    colour = cv2.remap(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), u, v, cv2.INTER_LINEAR).astype(np.float64)
    return height, bare, colour, cv2.remap(classes, u, v, cv2.INTER_NEAREST)


def semi_global(scene: Scene, grid: Grid) -> np.ndarray:
    """Match pairs of photographs with OpenCV's StereoSGBM, and fuse their heights into a grid: the median of a cell.

    Cells without a height take that of the nearest cell with one.
    """
    from scipy.ndimage import distance_transform_edt

    cameras = scene.cameras
    pose = cameras.T_world_camera.double().numpy()
    position = pose[:, :, 3]
    assert scene.points is not None
    ground = scene.points.xyz_world.numpy()
    above = float(np.median(position[:, 2]) - np.median(ground[:, 2]))
    middle = grid.frame.to_scene(np.array([[*whole(grid).centre, grid.height]]))[0]
    pairs = [
        (np.linalg.norm((position[i] + position[j])[:2] / 2 - middle[:2]), i, j)
        for i in range(len(pose))
        for j in range(i + 1, len(pose))
        if BASE[0] < np.linalg.norm(position[i] - position[j]) / above < BASE[1]
        # Of one heading: OpenCV's rectification does not turn photographs of strips flown to and fro.
        and np.trace(pose[i, :, :3].T @ pose[j, :, :3]) > 2.5
    ]
    cells, heights = [], []
    for _, i, j in sorted(pairs)[:PAIRS]:
        points = _stereo_points(scene, i, j, ground)
        column = np.floor((points[:, 0] - grid.west) / grid.cell).astype(int)
        row = np.floor((grid.north - points[:, 1]) / grid.cell).astype(int)
        inside = (column >= 0) & (row >= 0) & (column < grid.columns) & (row < grid.rows)
        cells.append((row * grid.columns + column)[inside])
        heights.append(points[inside, 2])
    cell, height = np.concatenate(cells), np.concatenate(heights)
    order = np.lexsort((height, cell))
    cell, height = cell[order], height[order]
    unique, first, count = np.unique(cell, return_index=True, return_counts=True)
    result = np.full(grid.rows * grid.columns, np.nan)
    result[unique] = height[first + count // 2]
    result = result.reshape(grid.rows, grid.columns)
    nearest = np.asarray(distance_transform_edt(np.isnan(result), return_distances=False, return_indices=True))
    return result[nearest[0], nearest[1]]


def _stereo_points(scene: Scene, i: int, j: int, ground: np.ndarray) -> np.ndarray:
    """Points of two photographs in the map's frame, which in built-in flats is the world without its origin."""
    cameras = scene.cameras
    pose = cameras.T_world_camera.double().numpy()
    size = cameras[i].width, cameras[i].height
    k = np.array(
        [
            [float(cameras.focal_px[i, 0]), 0, float(cameras.principal_px[i, 0])],
            [0, float(cameras.focal_px[i, 1]), float(cameras.principal_px[i, 1])],
            [0, 0, 1],
        ]
    )
    rotation = pose[j, :, :3].T @ pose[i, :, :3]
    translation = pose[j, :, :3].T @ (pose[i, :, 3] - pose[j, :, 3])
    # Pixel centres of OpenCV are at whole numbers, ours at halves.
    k[:2, 2] -= 0.5
    none = np.zeros(5)
    r1, r2, p1, p2, _, _, _ = cv2.stereoRectify(k, none, k, none, size, rotation, translation[:, None], alpha=0)
    vertical = abs(p2[1, 3]) > abs(p2[0, 3])
    pictures = []
    for index, r, p in ((i, r1, p1), (j, r2, p2)):
        maps = cv2.initUndistortRectifyMap(k, none, r, p, size, cv2.CV_32FC1)
        grey = cv2.cvtColor(scene.photographs[index].numpy(), cv2.COLOR_RGB2GRAY)
        picture = cv2.remap(grey, maps[0], maps[1], cv2.INTER_LINEAR)
        pictures.append(np.ascontiguousarray(picture.T) if vertical else picture)
    shift = float(p2[1, 3] if vertical else p2[0, 3])
    offset = float((p1 - p2)[1, 2] if vertical else (p1 - p2)[0, 2])
    local = (ground - pose[i, :, 3]) @ pose[i, :, :3] @ r1.T
    depth = local[:, 2][local[:, 2] > 0]
    # Where the second camera lies on the other side, pictures are flipped so that disparities are positive.
    expected = -shift / np.percentile(depth, [1, 99]) + offset
    flipped = expected.mean() < 0
    if flipped:
        pictures = [np.ascontiguousarray(picture[:, ::-1]) for picture in pictures]
        expected = -expected
    low = int(np.floor(expected.min() - 0.02 * abs(expected).max())) - 4
    count = -(-int(np.ceil(expected.max() * 1.06) - low + 8) // 16) * 16
    matcher = cv2.StereoSGBM.create(
        minDisparity=low, numDisparities=count, blockSize=5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=1,
        uniquenessRatio=10, speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(*pictures).astype(np.float32) / 16
    valid = disparity > low
    if flipped:
        disparity, valid = -disparity[:, ::-1], valid[:, ::-1]
    if vertical:
        disparity, valid = disparity.T, valid.T
    rows, columns = np.nonzero(valid)
    z = -shift / (disparity[rows, columns] - offset)
    x = (columns - p1[0, 2]) / p1[0, 0] * z
    y = (rows - p1[1, 2]) / p1[1, 1] * z
    local = np.column_stack([x, y, z]) @ r1
    return local @ pose[i, :, :3].T + pose[i, :, 3] + scene.origin_world.numpy()


def tables(record: dict[str, Any]) -> list[Table]:
    """The stored figures as tables: heights, and what else there is of each map."""
    others = [
        "flat",
        "cell, cm",
        "within 1.96 standard errors",
        "median standard error, cm",
        "orthophoto PSNR, dB",
        "s",
    ]
    more = [
        (
            name,
            f"{100 * found['cell_m']:.1f}",
            f"{100 * found['within']:.1f}%",
            f"{100 * found['sigma_median_m']:.1f}",
            f"{found['orthophoto_psnr']:.1f}",
            f"{found['seconds']:.0f}",
        )
        for name, found in record["figures"].items()
    ]
    shares = [
        "flat",
        *(f"{name}: {part}" for name in ("ground", "vegetation", "water") for part in ("true", "found", "IoU")),
    ]
    masks = [
        (
            name,
            *(
                cell
                for one in ("ground", "vegetation", "water")
                for cell in (
                    f"{100 * found['classes'][one]['true']:.1f}%",
                    f"{100 * found['classes'][one]['found']:.1f}%",
                    "-" if found["classes"][one]["iou"] is None else f"{found['classes'][one]['iou']:.3f}",
                )
            ),
        )
        for name, found in record["figures"].items()
    ]
    levels = [
        (
            name,
            f"{body['area']:.0f}",
            f"{100 * body['height']:.1f}",
            "no water there" if body["error"] is None else f"{100 * body['error']:+.2f}",
            f"{100 * body['sigma']:.2f}",
        )
        for name, found in record["figures"].items()
        for body in found["water"]
    ]
    return [
        _errors_table("Errors of heights, cm", record, "heights", ("map", "sparse points", "semi-global")),
        _errors_table(
            "Errors of the ground, cm: terrain, and the surface as it is", record, "ground", ("terrain", "surface")
        ),
        Table("Maps", others, more),
        Table("Classes: shares of the cells, and intersection over union", shares, masks),
        Table("Waterlines, cm", ["flat", "area, m2", "height", "error", "standard error"], levels),
    ]


def _errors_table(title: str, record: dict[str, Any], key: str, methods: Sequence[str]) -> Table:
    """Stored errors, in cm, of what stands side by side under a key of every flat."""
    rows = [
        (
            name,
            *(
                f"{100 * found[key][method][measure]:.1f}"
                for method in methods
                for measure in ("rmse_m", "nmad_m", "mean_m")
            ),
        )
        for name, found in record["figures"].items()
    ]
    columns = ["flat", *(f"{name}: {measure}" for name in methods for measure in ("RMSE", "NMAD", "mean"))]
    return Table(title, columns, rows)
