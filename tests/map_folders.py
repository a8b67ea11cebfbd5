"""Folders of maps and changes, small, with known heights and colours."""

import json
from pathlib import Path

import numpy as np
from surveys_of_two_dates import NORTH, WEST, write_surface

CELL = 0.5
SHAPE = (80, 100)


def write_map(folder: Path, colour: tuple[int, int, int], heights: np.ndarray | None = None) -> Path:
    """A map of one colour, by default on ground that rises 0.01 per column and 0.02 per row."""
    rows, columns = np.indices(SHAPE)
    heights = (5 + 0.01 * columns + 0.02 * rows) if heights is None else heights
    picture = np.empty((4, *SHAPE), np.uint8)
    picture[:] = np.array([*colour, 255])[:, None, None]
    write_surface(folder / "odm_orthophoto" / "odm_orthophoto.tif", picture, CELL)
    write_surface(folder / "odm_dem" / "dsm.tif", heights.astype(np.float32), CELL, nodata=-9999.0)
    write_surface(folder / "odm_dem" / "dsm_sigma.tif", np.full(SHAPE, 0.02, np.float32), CELL, nodata=-9999.0)
    (folder / "map.json").write_text(json.dumps({"scene": "flat"}))
    return folder


def write_change(
    folder: Path,
    dz: np.ndarray,
    sigma: float = 0.03,
    systematic_m: float = 0.01,
    crs: str | None = "EPSG:32630",
    shared: np.ndarray | None = None,
) -> Path:
    """A change whose errors are independent from cell to cell, besides one that all share.

    Args:
        shared: that one, as a band of the raster, which older ones lack; sigma is then without it.
    """
    bands = [dz, np.full_like(dz, sigma), np.ones_like(dz)]
    if shared is not None:
        bands = [dz, np.hypot(bands[1], shared), bands[2], shared]
    bands = np.stack(bands).astype(np.float32)
    write_surface(folder / "change.tif", bands, CELL, crs=crs, nodata=float("nan"))
    numbers = {
        "earlier": {"date": "2023-05-01"},
        "later": {"date": "2024-05-03"},
        "level_of_detection_m": {"median": 1.96 * sigma},
        "registration": {"systematic_m": systematic_m},
        "variogram": {"sill_shares": [], "ranges_m": []},
        "volumes": {},
    }
    (folder / "change.json").write_text(json.dumps(numbers))
    return folder


def corner(column: float, row: float) -> tuple[float, float]:
    """East and north of a place counted in cells from the north-western corner."""
    return WEST + CELL * column, NORTH - CELL * row
