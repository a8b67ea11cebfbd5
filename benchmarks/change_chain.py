"""The whole chain once: photographs of a built-in flat at two dates -> prepare -> map -> change, against the truth.

The photographs have positions of a consumer receiver and marks of surveyed control points, nothing else of the truth.
Every step is compared with it, so that it shows where what is lost gets lost.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.change import store
from benchmarks.change_pairs import centres, compared, regions_of, require_options
from benchmarks.maps import made_map
from benchmarks.records import MEASURED, say
from tidefield.change.inputs import open_survey
from tidefield.change.measure import Change, measure
from tidefield.change.regions import Region, dilated
from tidefield.change.statistics import Z95
from tidefield.change.surfaces import Grid
from tidefield.data.load import load_scene
from tidefield.files import completed_folder, write_json
from tidefield.geometry.geodesy import LocalFrame
from tidefield.synthetic.flights import BARE_M, write_flights
from tidefield.synthetic.grids import Extent, Raster
from tidefield.synthetic.two_dates import Difference, Pair, make_pair

CRS, ORIGIN = "EPSG:32631", (500_000.0, 5_800_000.0, 0.0)
CATEGORY, SEED = "river_mouths", 11
CHANGE_M = 0.2
DATES = ("2023-05-01", "2024-05-01")
_CELL_M = 0.15
AREA_M = (-8.0, -14.0, 38.0, 14.0)
"""West, south, east and north of what is mapped, in the flat's coordinates: a bank, the bar, and ground that stays."""
_LAYERS = ("bed", "surface", "seen")
_NODES_M = 0.05
"""Spacing of the truth's nodes, which shows single blades."""


def frame() -> LocalFrame:
    return LocalFrame.at(CRS, ORIGIN)


def write_photographs(pair: Pair, folder: Path) -> None:
    """Write both surveys' photographs, positions and control as a pilot has them, and the truth beside them."""
    write_flights(pair, folder, frame(), DATES, SEED)
    west, south, east, north = AREA_M
    # The outermost cells of a map may lie partly beyond the area.
    extent = Extent.around([west - 1, south - 1], [east + 1, north + 1], _NODES_M)
    layers, nodes = {}, extent.nodes()
    for k, flat in enumerate((pair.earlier.flat, pair.later.flat)):
        ground = torch.cat([flat.bed.sample(nodes), flat.surface.sample(nodes)]).reshape(2, extent.rows, extent.columns)
        values = torch.cat([ground, flat.seen(extent).values]).numpy()
        layers |= {f"{layer}{k}": value for layer, value in zip(_LAYERS, values, strict=True)}
    with (folder / "truth.npz").open("wb") as file:
        np.savez(
            file,
            allow_pickle=False,
            extent=np.array([extent.west_m, extent.south_m, extent.columns, extent.rows, extent.cell_m]),
            positions0=pair.earlier.cameras.position_world.numpy(),
            positions1=pair.later.cameras.position_world.numpy(),
            **layers,
        )


class Truth:
    """What is true of the flat at the cells of a grid, row 0 in the north: heights of bed, water and what is seen."""

    def __init__(self, file: Path, grid: Grid) -> None:
        east, north = centres(grid)
        world = frame().from_crs(np.column_stack([east, north, np.zeros(len(east))]))
        xy = torch.from_numpy(world[:, :2].T.copy()).float()
        with np.load(file, allow_pickle=False) as values:
            west, south, columns, rows, cell = values["extent"].tolist()
            extent = Extent(west, south, int(columns), int(rows), cell)
            self.of = {
                name: Raster(extent, torch.from_numpy(values[name])[None]).sample(xy)[0].numpy().reshape(grid.shape)
                for name in (f"{layer}{k}" for layer in _LAYERS for k in (0, 1))
            }

    def bare(self, *dates: int) -> np.ndarray:
        """Ground that is neither under water nor under plants at these dates."""
        water, plants = (
            np.max([self.of[f"{layer}{k}"] - self.of[f"bed{k}"] for k in dates], axis=0) for layer in _LAYERS[1:]
        )
        return (water < 1e-3) & (plants < BARE_M)

    @property
    def change(self) -> np.ndarray:
        return self.of["bed1"] - self.of["bed0"]


def change_chain(work: Path, views: int = 16, width: int = 800, runs: Path = MEASURED) -> None:
    """Make the photographs, prepare and map both surveys, compare them, and compare each step with the truth.

    Args:
        work: Folder for photographs, scenes and maps of these options; what is there is not made again.
        views: Photographs of each survey.
        width: Of the photographs in pixels.
        runs: Store the figures in this folder's change.json.

    Raises:
        RunError: the work folder holds files of other options.
    """
    from rich.console import Console

    from tidefield.commands.prepare import Prepare, prepare

    options = {"photographs": views, "width_px": width, "change_m": CHANGE_M}
    made_of = {"category": CATEGORY, "seed": SEED, "area_m": list(AREA_M), "cell_m": _CELL_M}
    require_options(work, {**options, **made_of})
    surveys = work / "surveys"
    if not surveys.exists():
        say(f"photographs: {views} of {width} px at each date")
        pair = make_pair(CATEGORY, SEED, Difference(change_m=CHANGE_M), views=views, width=width)
        with completed_folder(surveys) as partial:
            write_photographs(pair, partial)
    record: dict[str, Any] = {**options, "steps": {}}
    for k, date in enumerate(DATES):
        photographs, scene, out = surveys / date / "photographs", work / f"scene-{date}", work / f"map-{date}"
        if not (scene / "report.html").exists():
            say(f"{date}: prepare")
            prepare(Prepare(photographs, scene), Console(quiet=True))
        say(f"{date}: map")
        made_map(scene, out, gsd=_CELL_M, area=_area(work))
        record["steps"][date] = {**_poses(scene, surveys, k), **_heights(out, surveys, k)}
        say(f"{date}: {record['steps'][date]}")
    say("change")
    earlier, later = (open_survey(work / f"map-{date}", date) for date in DATES)
    for name, stable in (("found", None), ("given", lambda grid: _stable(surveys, grid))):
        found = measure(earlier, later, stable=stable, within=lambda grid: _bare(surveys, grid))
        record["steps"][f"change, stable ground {name}"] = _against_truth(found, surveys)
        say(f"stable ground {name}: {record['steps'][f'change, stable ground {name}']}")
    store(runs, "chain", record)


def _area(work: Path) -> Path:
    """Write the ground that is mapped as GeoJSON."""
    west, south, east, north = AREA_M
    corners = [[west, south, 0.0], [east, south, 0.0], [east, north, 0.0], [west, north, 0.0], [west, south, 0.0]]
    ring = frame().to_crs(np.array(corners))[:, :2].round(3).tolist()
    crs = {"type": "name", "properties": {"name": CRS}}
    write_json(work / "area.geojson", {"type": "Polygon", "crs": crs, "coordinates": [ring]})
    return work / "area.geojson"


def _poses(scene: Path, surveys: Path, k: int) -> dict[str, float]:
    """How far the cameras are from where they were, metres."""
    from tidefield.data.georeference import read_georeference

    loaded, georeference = load_scene(scene, hold_out=False), read_georeference(scene)
    assert georeference is not None
    assert georeference.frame is not None
    with np.load(surveys / "truth.npz", allow_pickle=False) as values:
        true = values[f"positions{k}"].astype(np.float64)
    number = [int(Path(name).stem[-3:]) for name in loaded.names]
    world = loaded.cameras.position_world.double().numpy() + loaded.origin_world.double().numpy()
    error = frame().from_crs(georeference.frame.to_crs(world)) - true[number]
    return {
        "placed": len(loaded.names),
        "positions_horizontal_rms_m": float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())),
        "positions_vertical_rms_m": float(np.sqrt((error[:, 2] ** 2).mean())),
    }


def _heights(out: Path, surveys: Path, k: int) -> dict[str, float]:
    """The map's heights on bare, dry ground against the truth."""
    from tidefield.change.surfaces import common_grid, open_surface

    surface = open_survey(out)
    grid = common_grid([surface])
    with surface.on_grid(grid) as read:
        heights = read(0, grid.rows)
    assert surface.sigma is not None
    with open_surface(surface.sigma).on_grid(grid) as read:
        sigma = read(0, grid.rows)
    truth = Truth(surveys / "truth.npz", grid)
    error = heights - truth.of[f"bed{k}"]
    some = truth.bare(k) & np.isfinite(error)
    middle = float(np.median(error[some]))
    return {
        "cells": int(some.sum()),
        "median_m": middle,
        "nmad_m": float(1.4826 * np.median(np.abs(error[some] - middle))),
        "within_95": float((np.abs(error) < Z95 * sigma)[some].mean()),
    }


def _bare(surveys: Path, grid: Grid) -> list[Region]:
    return regions_of(Truth(surveys / "truth.npz", grid).bare(0, 1), grid)


def _stable(surveys: Path, grid: Grid) -> list[Region]:
    """Bare ground well away from what changed."""
    truth = Truth(surveys / "truth.npz", grid)
    same = truth.bare(0, 1) & ~dilated(np.abs(truth.change) > 1e-6, 8)
    return regions_of(same, grid)


def _against_truth(change: Change, surveys: Path) -> dict[str, Any]:
    truth = Truth(surveys / "truth.npz", change.grid).change
    truth[~np.isfinite(change.dz)] = 0
    return compared(change, truth, change.grid, CHANGE_M)
