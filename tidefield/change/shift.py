"""The horizontal shift between two surveys, by correlating their orthophotos.

On flats heights do not tell it: methods that use slopes (Nuth and Kaeaeb 2011) diverge there. Pictures do, where ground
has texture that lasts. Phase correlation (Kuglin and Hines 1975) of many windows gives a shift each, which maximising
the correlation coefficient (Evangelidis and Psarakis 2008) refines. Windows of ground that changed, of water and of
bland mud disagree. The median of those that agree is the shift, and their scatter its error. Where too few agree, the
ground cannot tell, and nothing is moved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from tidefield.change.statistics import nmad
from tidefield.change.surfaces import ChangeError, Grid, longer_side, opened, warped
from tidefield.geometry.geodesy import horizontal, same_system

_SIDE = 4096
"""Longest side of the pictures that are correlated."""
_COARSER = (1024, 256)
"""Sides of those that tell, where these do not, how far apart windows are looked for: up to 9% of the ground."""
_WINDOW, _COARSE_WINDOW = 128, 64
_MOST_WINDOWS = 600
_LEAST_CORRELATION = 0.35
"""Of two windows after the move."""
_FARTHEST = 0.35
"""Of a window's side: what is moved further has too little in common."""
_LEAST_WINDOWS = 12
_LEAST_AGREEING = 0.25
"""Share of the windows with texture."""
_AGREE_PX = 1.0
_LEAST_CONTRAST = 2.0
"""Deviation of the grey values of a window, of 255."""


@dataclass(frozen=True)
class Shift:
    """How far the later survey is to be moved to lie on the earlier one.

    Attributes:
        east_m, north_m: the move; None where the ground cannot tell.
        error_m: one sigma in each direction.
        windows, agreeing: with texture; and that agree.
        pixel_m: of the pictures that were correlated.
    """

    east_m: float | None
    north_m: float | None
    error_m: float
    windows: int
    agreeing: int
    pixel_m: float

    @property
    def known(self) -> bool:
        return self.east_m is not None

    def words(self) -> str:
        """What was found, in a sentence."""
        if self.east_m is None or self.north_m is None:
            return (
                f"the orthophotos do not tell the horizontal shift: {self.agreeing} of {self.windows} windows agree; "
                "the surveys are compared where they lie"
            )
        return (
            f"{self.agreeing} of {self.windows} windows of the orthophotos agree on a horizontal shift of "
            f"{self.east_m:+.3f} m east and {self.north_m:+.3f} m north, each with a standard error of "
            f"{self.error_m:.3f} m"
        )


def is_picture(dataset: Any) -> bool:
    """Whether a raster that is open has red, green and blue."""
    return dataset.count >= 3 and dataset.dtypes[0] in ("uint8", "uint16")


def require_picture(path: Path) -> None:
    """Raises: ChangeError when a raster has no red, green and blue."""
    with opened(path) as dataset:
        _require_colours(dataset, path)


def _require_colours(dataset: Any, path: Path) -> None:
    if not is_picture(dataset):
        raise ChangeError(f"{path} is no orthophoto: expected a GeoTIFF with red, green and blue")


def picture_grid(paths: tuple[Path, Path], grid: Grid, side: float = _SIDE) -> Grid:
    """The grid that two orthophotos are compared on: their coarser pixels, on the ground of another grid.

    Args:
        side: most rows and columns; where there are more, cells are larger.

    Raises:
        ChangeError: one of them is no picture.
    """
    pixel = max(_pixel(path, grid) for path in paths)
    west, south, east, north = grid.bounds
    pixel = max(pixel, (east - west) / side, (north - south) / side)
    columns, rows = max(2, math.floor((east - west) / pixel)), max(2, math.floor((north - south) / pixel))
    return Grid(grid.crs, west, north, pixel, columns, rows)


def _pixel(path: Path, grid: Grid) -> float:
    """The longer side of an orthophoto's pixels on the ground, metres."""
    with opened(path) as dataset:
        _require_colours(dataset, path)
        own = max(abs(dataset.transform.a), abs(dataset.transform.e))
        if dataset.crs is None or grid.crs is None:
            return own
        crs, target = CRS.from_wkt(dataset.crs.to_wkt()), CRS.from_wkt(grid.crs)
        if same_system(crs, target):
            return own
        try:
            to = Transformer.from_crs(horizontal(crs), target, always_xy=True)
            return longer_side(dataset.transform, dataset.width, dataset.height, to)
        except ProjError as error:
            raise ChangeError(
                f"{path} cannot be converted from {crs.name} to the surveys' system ({error}): expected an orthophoto "
                "of their ground; warp it first (gdalwarp)"
            ) from error


def read_picture(
    path: Path, grid: Grid, shift_m: tuple[float, float] = (0.0, 0.0)
) -> tuple[UInt8[np.ndarray, "rows columns 3"], np.ndarray]:
    """An orthophoto on a grid, and where it has ground."""
    with opened(path) as dataset:
        crs = CRS.from_wkt(dataset.crs.to_wkt()) if dataset.crs is not None else None
        scale = 257.0 if dataset.dtypes[0] == "uint16" else 1.0
        nodata = dataset.nodata
    picture, known = np.zeros((*grid.shape, 3), np.uint8), np.zeros(grid.shape, bool)
    with warped(path, crs, grid, shift_m, bands=(1, 2, 3), nodata=nodata) as read:
        for rows in grid.strips():
            values = read(rows.start, rows.stop) / np.float32(scale)
            # Without nodata or alpha, what is all black or all white is the frame.
            inside = (
                np.asarray(np.isfinite(values).all(axis=0), bool)
                & (values > 0).any(axis=0)
                & (values < 255).any(axis=0)
            )
            known[rows] = inside
            picture[rows] = np.where(inside[..., None], np.nan_to_num(values.transpose(1, 2, 0)), 0).clip(0, 255)
    return picture, known


def find_shift(earlier: Path, later: Path, grid: Grid) -> Shift:
    """Correlate two orthophotos; where they are too far apart, smaller ones first."""
    grids: dict[int, Grid] = {}
    for side in (_SIDE, *_COARSER):
        if (small := picture_grid((earlier, later), grid, float(side))) not in grids.values():
            grids[side] = small

    @cache
    def as_it_lies(side: int) -> tuple[UInt8[np.ndarray, "rows columns 3"], np.ndarray]:
        return read_picture(earlier, grids[side])

    def shift(side: int, moved_m: tuple[float, float]) -> Shift:
        small = grids[side]
        pictures = as_it_lies(side), read_picture(later, small, moved_m)
        greys = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) for picture, _ in pictures]
        window = _COARSE_WINDOW if side == _COARSER[-1] else _WINDOW
        found = correlate(greys[0], greys[1], pictures[0][1] & pictures[1][1], small.cell_m, window)
        if found.east_m is None or found.north_m is None:
            return found
        return replace(found, east_m=moved_m[0] + found.east_m, north_m=moved_m[1] + found.north_m)

    as_they_lie = found = shift(_SIDE, (0.0, 0.0))
    for coarse in list(grids)[1:]:
        if found.known:
            break
        found = shift(coarse, (0.0, 0.0))
        for side in [side for side in sorted(grids) if side > coarse]:
            if found.east_m is None or found.north_m is None:
                break
            found = shift(side, (found.east_m, found.north_m))
    return found if found.known else as_they_lie


def correlate(
    earlier: Float32[np.ndarray, "rows columns"],
    later: Float32[np.ndarray, "rows columns"],
    known: np.ndarray,
    pixel_m: float,
    window: int = _WINDOW,
) -> Shift:
    """Correlate two grey pictures, row 0 in the north, window by window.

    Args:
        window: side of the windows, pixels.
    """
    rows, columns = earlier.shape
    size = min(window, rows, columns)
    step = max(size // 2, math.ceil(math.sqrt(rows * columns / _MOST_WINDOWS)))
    hann = cv2.createHanningWindow((size, size), cv2.CV_32F)
    found, windows = [], 0
    for r in range(0, rows - size + 1, step):
        for c in range(0, columns - size + 1, step):
            box = (slice(r, r + size), slice(c, c + size))
            one, other = earlier[box], later[box]
            if not known[box].all() or min(one.std(), other.std()) < _LEAST_CONTRAST:
                continue
            windows += 1
            move = _refined(_even(one), _even(other), hann)
            if move is not None:
                found.append((*move, r, c))
    nothing = Shift(None, None, math.nan, windows, 0, pixel_m)
    if len(found) < _LEAST_WINDOWS:
        return nothing
    moves, places = np.split(np.array(found, dtype=np.float64), 2, axis=1)
    # The densest place: the window with which most others agree.
    near = (np.hypot(*(moves[:, None] - moves[None]).transpose(2, 0, 1)) <= 2 * _AGREE_PX).sum(axis=1)
    middle = moves[np.argmax(near)]
    agreeing = moves[np.hypot(*(moves - middle).T) <= 2 * _AGREE_PX]
    middle = np.median(agreeing, axis=0)
    together = np.hypot(*(moves - middle).T) <= 2 * _AGREE_PX
    agreeing, places = moves[together], places[together]
    if len(agreeing) < max(_LEAST_WINDOWS, _LEAST_AGREEING * windows):
        return Shift(None, None, math.nan, windows, len(agreeing), pixel_m)
    x, y = np.median(agreeing, axis=0)
    scatter = max(nmad(agreeing[:, 0]), nmad(agreeing[:, 1]), 0.02)
    # Windows overlap by half: four of them are one; a median needs pi / 2 as many values as a mean.
    error = math.hypot(scatter * math.sqrt(math.pi / 2 * 4 / len(agreeing)), _trend(agreeing, places, scatter))
    # A picture whose content lies x to the right is moved to the left.
    return Shift(float(-x) * pixel_m, float(y) * pixel_m, error * pixel_m, windows, len(agreeing), pixel_m)


def _trend(moves: Float64[np.ndarray, "N 2"], places: Float64[np.ndarray, "N 2"], scatter: float) -> float:
    """How far moves differ from place to place, by one sigma and beyond chance: surveys may be turned, too, or larger.

    Args:
        places: row and column of each.
        scatter: of the moves, one sigma.
    """
    terms = places - places.mean(axis=0)
    about = moves - moves.mean(axis=0)
    trend = terms @ np.linalg.lstsq(terms, about, rcond=None)[0]
    chance = terms.shape[1] * scatter**2 * 4 / len(moves)
    return math.sqrt(max(0.0, float((trend**2).mean(axis=0).max()) - chance))


def _refined(one: np.ndarray, other: np.ndarray, hann: np.ndarray) -> tuple[float, float] | None:
    """Move of a window's content to the right and down, or None where the pictures do not agree on one."""
    (x, y), _ = cv2.phaseCorrelate(one, other, hann)
    if math.hypot(x, y) > _FARTHEST * len(one):
        return None
    move = np.array([[1, 0, x], [0, 1, y]], np.float32)
    every = np.full(one.shape, 255, np.uint8)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
    try:
        correlation, move = cv2.findTransformECC(one, other, move, cv2.MOTION_TRANSLATION, stop, every, 3)
    except cv2.error:  # it does not converge where there is nothing in common
        return None
    return (float(move[0, 2]), float(move[1, 2])) if correlation > _LEAST_CORRELATION else None


def _even(window: np.ndarray) -> np.ndarray:
    """A window without its slow changes of light, with unit contrast."""
    flat = window - cv2.GaussianBlur(window, (0, 0), 8)
    return flat / (flat.std() + 1e-3)
