"""Nothing changed: two flights over the same ground, 27 minutes apart, prepared and mapped as two surveys.

The river and what is wet changes, and so do vehicles and people; dry ground does not. Stable ground for shift and
errors is a half of the dry ground, squares like the black ones of a chessboard; false alarms are counted on the other
half, which nothing was measured on.
"""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from benchmarks.change import store
from benchmarks.change_pairs import regions_of, require_options
from benchmarks.maps import made_map
from benchmarks.records import MEASURED, say
from tidefield.change.inputs import open_survey
from tidefield.change.light import greenness
from tidefield.change.measure import Options, measure
from tidefield.change.regions import Region, dilated, rasterised
from tidefield.change.shift import picture_grid, read_picture
from tidefield.change.statistics import Z95
from tidefield.change.surfaces import Grid, Surface, common_grid
from tidefield.files import completed_folder, write_text
from tidefield.maps.smoothing import smoothed

FLIGHTS = {"first": (1414, 1481), "third": (1548, 1618)}
CELL_M = 0.15
SQUARE_M = 20.0
"""Side of the squares of the chessboard: longer than errors of matching are correlated."""
GRASS = 0.1
"""Greenness from which ground is grass: neither water, nor mud that may be wet, nor a track that is driven on."""
SMOOTH_PX = 1.5
MODELS = ("vertical", "tilt")
_MARGIN_CELLS = 7
_LISTS = ("gps.csv", "gcp_list.txt")


def copy_flight(photographs: Path, flight: tuple[int, int], folder: Path) -> None:
    """Copy the photographs of one flight with what the pilot's lists say about them."""
    with completed_folder(folder) as partial_:
        for path in sorted(photographs.glob("IMG_*.jpg")):
            if flight[0] <= int(path.stem.removeprefix("IMG_")) <= flight[1]:
                shutil.copyfile(path, partial_ / path.name)
        names = {path.name for path in partial_.iterdir()}
        shutil.copyfile(photographs / "gps.csv", partial_ / "gps.csv")
        first, *lines = (photographs / "gcp_list.txt").read_text().splitlines()
        kept = [line for line in lines if len(line.split()) > 5 and line.split()[5] in names]
        write_text(partial_ / "gcp_list.txt", "\n".join([first, *kept]) + "\n")


def change_null(photographs: Path, work: Path, runs: Path = MEASURED) -> None:
    """Prepare, map and compare both flights.

    Args:
        photographs: Folder with swindale's photographs, gps.csv and gcp_list.txt.
        work: Folder for scenes and maps of these photographs; what is there is not made again.
        runs: Store the figures in this folder's change.json.

    Raises:
        RunError: the work folder holds files of other photographs or options.
    """
    from rich.console import Console

    from tidefield.commands.prepare import Prepare, prepare

    flights = {name: list(flight) for name, flight in FLIGHTS.items()}
    require_options(work, {"photographs": str(photographs.resolve()), "flights": flights, "cell_m": CELL_M})
    record: dict[str, Any] = {}
    for name, flight in FLIGHTS.items():
        own = work / name
        if not (own / "photographs").exists():
            copy_flight(photographs, flight, own / "photographs")
        if not (own / "scene" / "report.html").exists():
            say(f"{name}: prepare")
            prepare(Prepare(own / "photographs", own / "scene"), Console(quiet=True))
        say(f"{name}: map")
        made = made_map(own / "scene", own / "map", gsd=CELL_M)
        record[name] = {key: made[key] for key in ("area", "sigma_median", "views_median")}
    store(runs, "null", {**record, **compare(work)})


def compare(work: Path) -> dict[str, Any]:
    """Compare the maps of both flights over dry ground."""
    earlier, later = (open_survey(work / name / "map") for name in FLIGHTS)
    grid = common_grid([earlier, later])
    dry = dry_ground(earlier, later, grid)
    board = chessboard(grid)
    halves = [_regions(dry & (board == k), grid) for k in (0, 1)]
    record: dict[str, Any] = {"dry_m2": float(dry.sum()) * grid.cell_area_m2}
    for model in MODELS:
        change = measure(
            earlier,
            later,
            Options(register=model),
            stable=partial(_given, halves[0]),
            within=partial(_given, _regions(dry, grid)),
        )
        assert change.grid == grid
        other = rasterised(halves[1], grid) & np.isfinite(change.dz)
        sigma = np.concatenate([change.errors.cell_sigma(rows) for rows in grid.strips()])
        registration = change.errors.registration
        record[model] = {
            "significant_share_of_other_half": float((np.abs(change.dz) > Z95 * sigma)[other].mean()),
            "other_cells": int(other.sum()),
            "vertical_m": registration.vertical_m,
            "shift_m": list(registration.shift_m),
            "before": list(registration.before),
            "after": list(registration.after),
            "detection_m": list(change.detection_m),
            "ranges_m": list(change.errors.variogram.ranges_m),
            "sills": list(change.errors.variogram.sills),
            "net": change.net.to_json(),
            "other_net": change.errors.volume(change.dz, other).to_json(),
            "outlined_share": float((change.outlines.labels[np.isfinite(change.dz)] > 0).mean()),
            "remarks": change.remarks,
        }
        say(f"{model}: {record[model]}")
    return record


def _given(regions: list[Region], grid: Grid) -> list[Region]:
    return regions


def chessboard(grid: Grid) -> np.ndarray:
    """0 and 1 in squares."""
    rows, columns = (np.floor(np.arange(n) * grid.cell_m / SQUARE_M).astype(int) for n in grid.shape)
    return (rows[:, None] + columns[None]) % 2


def dry_ground(earlier: Surface, later: Surface, grid: Grid) -> np.ndarray:
    """Cells that both surveys show as grass, a metre away from what is none.

    Colours alone decide: heights, which are what is tested, do not.
    """
    assert earlier.orthophoto is not None
    assert later.orthophoto is not None
    small = picture_grid((earlier.orthophoto, later.orthophoto), grid)
    dry = np.ones(grid.shape, bool)
    for path in (earlier.orthophoto, later.orthophoto):
        picture, known = read_picture(path, small)
        assert small.shape == grid.shape
        dry &= ~dilated(~known | (greenness(smoothed(picture, known, SMOOTH_PX)) < GRASS), _MARGIN_CELLS)
    return dry


def _regions(cells: np.ndarray, grid: Grid) -> list[Region]:
    return [region for region in regions_of(cells, grid) if shapely.area(region.geometry) > grid.cell_area_m2]
