"""Heights of a map's surface at ground control that is left out in turn.

`tidefield prepare` leaves out each control point in turn and triangulates it from its marks: its residuals have how far
the scene without a point misses it. The surface is measured in the scene that knows all of them, around each point. A
scene without the point carries its surface along, so what it misses is the surface's own height, and what leaving the
point out moves the scene there: the up residual without the point minus the one with it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tyro.conf import Positional

from benchmarks.maps import errors
from benchmarks.records import show
from tidefield.compare.tables import Table
from tidefield.data.georeference import read_georeference
from tidefield.data.load import at_width, load_scene
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.files import write_json
from tidefield.machine import describe
from tidefield.maps.grid import Grid, Tile, ground_sampling_distance, make_grid, map_frame
from tidefield.maps.make import FEWEST_VIEWS
from tidefield.maps.surface import COARSEST, match, sparse_surface
from tidefield.maps.views import GreyPhotographs
from tidefield.survey.io.text_files import PhotographNames, leading_numbers, read_list

SIDE = 96
"""Cells of the tile that is measured around each point."""
BAR_M = 0.05
"""The RMSE of heights should be below this and one ground sampling distance."""


def map_control(scene: Positional[Path], control: Positional[Path], runs: Path = Path("runs/maps")) -> dict[str, Any]:
    """Measure the surface at each point of a prepared scene's gcp_list.txt, print, store and return it.

    Args:
        scene: A scene that was prepared with ground control.
        control: Its gcp_list.txt.
        runs: Folder for map_control.json.

    Raises:
        RunError: the scene has no ground control.
    """
    record = _measure(scene, control)
    show(tables(record))
    write_json(runs / "map_control.json", record)
    return record


def _measure(root: Path, control: Path) -> dict[str, Any]:
    georeference = read_georeference(root)
    if georeference is None or georeference.frame is None or not georeference.check.names:
        raise RunError(f"{root} has no ground control that was left out: expected a scene prepared with a gcp_list.txt")
    scene = load_scene(root, hold_out=False)
    widest = max(file.lens.width for file in scene.photographs.files)
    scene = scene if scene.cameras.width >= widest else at_width(scene, widest)
    frame = map_frame(scene, georeference)
    grid = make_grid(frame, scene, None)
    crs, lines = read_list(control)
    local = georeference.frame
    surveyed: dict[str, list[float]] = {}
    marks: dict[str, list[tuple[str, list[float]]]] = {}
    names = PhotographNames(scene.names)
    for _, line in lines:
        name = line.split()[-1]
        surveyed[name] = leading_numbers(line.split()[:3])
        photograph = names.split(line.split(maxsplit=5)[5])[0]
        if photograph is not None:
            marks.setdefault(name, []).append((photograph, leading_numbers(line.split()[3:5])))
    given = np.array(list(surveyed.values()), dtype=np.float64)
    there = dict(zip(surveyed, frame.to_map(local.from_system(crs, given) - frame.origin_world), strict=True))
    with_it = dict(zip(georeference.control.names, georeference.control.error_m, strict=True))
    without = dict(zip(georeference.check.names, georeference.check.error_m, strict=True))
    refused = {one.name for one in georeference.left_out if one.kind == "control point"}
    start, grey = sparse_surface(scene, grid.coarser(COARSEST)), GreyPhotographs(scene)
    gsd = ground_sampling_distance(scene) * frame.metre
    found = []
    for name, point in there.items():
        column, row = int((point[0] - grid.west) / grid.cell), int((grid.north - point[1]) / grid.cell)
        tile = Tile(grid, row - SIDE // 2, column - SIDE // 2, SIDE, 0)
        inside = 0 <= column < grid.columns and 0 <= row < grid.rows
        matched = match(tile, start, scene, grey, gsd) if inside else None
        if matched is not None and matched.count[SIDE // 2, SIDE // 2] < FEWEST_VIEWS:
            matched = None  # its height is that of the sparse points
        one: dict[str, Any] = {
            "name": name,
            "marks": len(marks.get(name, [])),
            "refused": name in refused,
            "surface": None,
        }
        if matched is not None:
            u = np.full((1, 1), (point[0] - tile.centre[0]) / grid.cell + SIDE / 2 - 0.5, np.float32)
            v = np.full((1, 1), (tile.centre[1] - point[1]) / grid.cell + SIDE / 2 - 0.5, np.float32)
            height, sigma, count = (
                float(cv2.remap(part.astype(np.float32), u, v, cv2.INTER_LINEAR)[0, 0])
                for part in (matched.height - point[2], matched.sigma, matched.count)
            )
            one |= {"surface": height, "sigma": sigma, "views": round(count)}
            if name in without:
                one["left_out"] = height + float(without[name][2] - with_it[name][2])
        one["mark_px"] = _mark_errors(scene, grid, point, marks.get(name, []))
        found.append(one)
    used = [one for one in found if one.get("left_out") is not None]
    error = np.array([one["left_out"] for one in used])
    return {
        "points": found,
        "n": len(used),
        **errors(error),
        "within": float((np.abs(error) < 1.96 * np.array([one["sigma"] for one in used])).mean()),
        "cell_m": grid.cell / frame.metre,
        "gsd_m": gsd / frame.metre,
        "bar_m": BAR_M + gsd / frame.metre,
        "poses_rms_m": georeference.check.vertical_rms_m,
        **describe(),
    }


def _mark_errors(scene: Scene, grid: Grid, point: np.ndarray, marks: list[tuple[str, list[float]]]) -> float | None:
    """Largest distance, in pixels of the photographs, between the surveyed point and its marks."""
    import torch

    place = torch.from_numpy(grid.frame.to_scene(point[None])).float()
    distances = []
    for photograph, uv in marks:
        index = scene.names.index(photograph)
        lens = scene.photographs.files[index].lens
        x, y = lens.to_pinhole(np.array([uv], dtype=np.float64), lens.pinhole())[0]
        camera = scene.cameras[index]
        shown = camera.project(place)[0][0, 0].numpy()
        distances.append(
            float(np.hypot(x * camera.width / lens.width - shown[0], y * camera.height / lens.height - shown[1]))
        )
    return max(distances) if distances else None


def tables(record: dict[str, Any]) -> list[Table]:
    """Each point, and the statistics of those that were left out."""

    def cm(value: float | None) -> str:
        return "-" if value is None else f"{100 * value:+.1f}"

    rows = [
        (
            one["name"],
            str(one["marks"]),
            "-" if one["mark_px"] is None else f"{one['mark_px']:.1f}",
            cm(one["surface"]),
            cm(one.get("left_out")),
            "-" if one["surface"] is None else f"{100 * one['sigma']:.1f}",
            str(one.get("views", "-")),
            "refused by prepare" if one["refused"] else "" if one.get("left_out") is not None else "not checked",
        )
        for one in sorted(record["points"], key=lambda one: one["name"])
    ]
    head = ["point", "marks", "mark off, px", "surface", "left out", "standard error", "photographs", ""]
    whole = (
        str(record["n"]),
        *(f"{100 * record[name]:.1f}" for name in ("rmse_m", "mean_m", "nmad_m")),
        f"{100 * record['poses_rms_m']:.1f}",
        f"{100 * record['bar_m']:.1f}",
        f"{100 * record['gsd_m']:.1f}",
        f"{100 * record['within']:.0f}%",
    )
    columns = ["n", "RMSE", "mean", "NMAD", "RMS of the poses alone", "aim: 5 cm + 1 GSD", "GSD", "within 1.96 errors"]
    return [Table("Heights at control points, cm", head, rows), Table("Left out in turn, cm", columns, [whole])]
