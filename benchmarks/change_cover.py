"""Plants and waterlines of built-in pairs of dates: what is found against what is true.

Maps are exact but for the errors of a survey's heights, noise and another exposure and white balance of the later
orthophoto: what `tidefield map` adds to them is measured with the whole chain.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.change import store
from benchmarks.change_pairs import stable_frame, write_surface
from benchmarks.records import MEASURED, say
from tidefield.change.cover import GAP_M, compare_cover
from tidefield.change.measure import Options, measure
from tidefield.change.surfaces import Grid, open_surface
from tidefield.change.water import measure_water
from tidefield.synthetic.flat import TidalFlat
from tidefield.synthetic.flights import BARE_M
from tidefield.synthetic.grids import Extent, Raster
from tidefield.synthetic.settings import settings_for
from tidefield.synthetic.survey import Survey
from tidefield.synthetic.two_dates import Difference, SurveyErrors, make_pair, surveyed

CATEGORIES = ("vegetation", "tidal_trees", "river_mouths")
FIRST_SEED = 200
"""The rules of cover were chosen on pairs 5 to 8, 100 to 102, 300 and 301."""
HALF_M = (30.0, 25.0)
CELL_M = 0.15
NOISE = 3.0
GAINS = 0.15
"""Deviation of the log gains of the later orthophoto's channels."""
ERRORS = SurveyErrors(datum_m=0.0)
"""The surveys share their control: levels of water are in both surveys' heights."""


def change_cover(seeds: int = 4, runs: Path = MEASURED) -> None:
    """Store one record for each pair, a pair of each category for each seed.

    Args:
        seeds: Pairs of each category.
        runs: Store the figures in this folder's change.json.
    """
    found = []
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        for category in CATEGORIES:
            found.append({"category": category, "seed": seed, **_pair(category, seed)})
            say(found[-1])
    store(runs, "cover", found)


def _pair(category: str, seed: int) -> dict[str, Any]:
    difference = Difference()
    pair = make_pair(category, seed, difference, views=2, width=32)
    tide = settings_for(category, np.random.default_rng([seed, 20260])).tide_m
    levels = (tide, tide + difference.tide_m)
    extent = Extent.around([-x for x in HALF_M], list(HALF_M), CELL_M)
    shape = (extent.rows, extent.columns)
    random = np.random.default_rng([seed, 20295])
    gains = np.exp(random.normal(0, GAINS, 3))
    pictures, plants, wet, paths = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for k, survey in enumerate((pair.earlier, pair.later)):
            colour, seen = (part.numpy() for part in survey.flat.map(extent))
            colour = colour * 255 * (gains if k else 1)
            pictures.append((colour + random.normal(0, NOISE, colour.shape)).clip(0, 255).astype(np.uint8))
            plants.append(covered(survey.flat, seen, extent))
            wet.append(_under(survey, extent, levels[k]))
            heights = surveyed(survey.flat.surface, extent, random, ERRORS)
            paths.append(write_surface(Path(folder) / f"{k}.tif", heights, extent))
        one, two = (open_surface(path) for path in paths)
        steady = partial(stable_frame, pair.earlier.flat.surface, pair.later.flat.surface)
        change = measure(one, two, Options(register="none", datum_error_m=0.005), stable=steady)
        line = measure_water(change, levels, ()).waterline
    grid = Grid(None, extent.west_m, extent.north_m, extent.cell_m, *shape[::-1])
    cover = compare_cover(pictures[0], pictures[1], np.ones(shape, bool), grid)
    assert line is not None
    area = cover.areas["all"]
    before, after = plants
    true = {"earlier": before, "later": after, "gained": after & ~before, "lost": before & ~after}
    dried, drowned = wet[0] & ~wet[1], wet[1] & ~wet[0]
    return {
        "area_m2": cover.known_m2,
        "cover": {
            what: {**vars(area[what]), "true_m2": float(cells.sum()) * CELL_M**2} for what, cells in true.items()
        },
        "water": {
            "wet_m2": float(wet[0].sum()) * CELL_M**2,
            "land_gained": vars(line.land_gained),
            "true_gained_m2": float(dried.sum()) * CELL_M**2,
            "land_lost": vars(line.land_lost),
            "true_lost_m2": float(drowned.sum()) * CELL_M**2,
            "move_m": list(line.move_m),
        },
    }


def covered(flat: TidalFlat, seen: np.ndarray, extent: Extent) -> np.ndarray:
    """Cells, row 0 in the north, that drawn plants cover seen straight down, closed as the product averages colours.

    Args:
        seen: heights that are seen straight down, metres, as `TidalFlat.map` returns them.
    """
    plants = seen - _on(flat.surface, extent) > BARE_M
    reach = round(GAP_M / extent.cell_m)
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.morphologyEx(plants.astype(np.uint8), cv2.MORPH_CLOSE, window).astype(bool)


def _on(raster: Raster, extent: Extent) -> np.ndarray:
    return raster.sample(extent.nodes())[0].reshape(extent.rows, extent.columns).numpy()[::-1]


def _under(survey: Survey, extent: Extent, level: float) -> np.ndarray:
    """Cells whose bed is below the tide; pools above it are none of the sea's."""
    return _on(survey.flat.bed, extent) < level
