"""Stable ground, and what it shows: what is subtracted from the later survey, and the errors of what is left."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float32
from scipy.ndimage import uniform_filter

from tidefield.change.outlines import find_outlines
from tidefield.change.regions import dilated
from tidefield.change.registration import (
    LEAST_STABLE,
    Model,
    Registration,
    centre,
    covariance,
    fit,
    lowered,
    statistics,
)
from tidefield.change.statistics import Z95, deviation95, nmad
from tidefield.change.surfaces import ChangeError, Grid
from tidefield.change.variogram import Variogram, fit_variogram
from tidefield.change.volumes import ErrorModel

_TURNS = 4
_STANDS_OUT = 3.0
"""Deviations of a window's mean."""
MOST_SAMPLED = 2_000_000
"""Cells that quantiles are computed from."""
_NMAD_CELLS = 1000
"""With fewer cells of stable ground their 95% quantile is uncertain, and the NMAD is used if it is larger."""


def settle(
    dz: Float32[np.ndarray, "rows columns"],
    own: Float32[np.ndarray, "rows columns"] | None,
    grid: Grid,
    given: Bool[np.ndarray, "rows columns"] | None,
    model: Model,
    windows: tuple[int, ...],
    datum_error_m: float | None,
    rounding: float,
    remarks: list[str],
) -> tuple[Registration, Variogram, Float32[np.ndarray, "rows columns"] | float, Bool[np.ndarray, "rows columns"]]:
    """Find stable ground, what is subtracted, and the errors, in turns where stable ground is not given.

    Args:
        dz: later minus earlier height, metres; NaN where one of them is unknown.
        own: one sigma of each cell's dz, where both surveys have one of theirs.
        given: stable ground, if the user named it.
        windows, datum_error_m: as in `measure.Options`.
        rounding: one sigma of what the rounding of heights does to dz, metres; errors are at least as large.
        remarks: what a user should know is added.

    Returns:
        What is subtracted; the correlation of a cell's own error, and one sigma of that, of each cell or of all; and
        stable ground.

    Raises:
        ChangeError: there is too little stable ground.
    """
    ground = guess = _unchanged(dz, own, grid, model, rounding) if given is None else given
    turns = _TURNS if given is None else 1
    found = None
    for turn in range(turns):
        cells = int(ground.sum())
        if cells < LEAST_STABLE:
            raise ChangeError(
                f"the surveys have {cells} cells of stable ground: expected at least {LEAST_STABLE} to measure shift "
                "and errors on; give more polygons of ground that did not change (--stable), or a smaller --cell"
            )
        coefficients = fit(dz, ground, grid, model, rounding)
        before = statistics(sampled(dz, ground))
        residual = lowered(dz, coefficients, grid)
        residual[~ground] = np.nan
        left = fit(residual, ground, grid, "vertical", rounding)[0] if model == "none" else 0.0
        after = statistics(sampled(residual, ground))
        if own is not None:
            residual /= own
        values = sampled(residual, ground)
        middle = np.float32(np.median(values))
        values = values - middle
        size = deviation95(values)
        if len(values) < _NMAD_CELLS:
            size = max(size, nmad(values))
        size = max(size, 1e-6)
        residual -= middle
        if own is None:
            sigma = max(size, rounding)
            residual /= np.float32(sigma)
        else:
            sigma = np.maximum(own * np.float32(size), np.float32(rounding))
            residual *= own / sigma
        is_last = given is not None or turn == turns - 1
        if is_last and rounding > np.median(sampled(own, ground) * size if own is not None else size):
            remarks.append(
                f"heights are rounded, by which they are off by {rounding:.3g} m (one sigma): errors are taken to be "
                "at least that"
            )
        variogram = fit_variogram(residual, grid.cell_m)
        del residual
        found = Registration(
            model,
            coefficients,
            covariance(model, ground, sigma, variogram, grid, left, datum_error_m),
            centre(grid),
            cells,
            before,
            after,
        )
        if is_last:
            return found, variogram, sigma, ground
        moved = lowered(dz, coefficients, grid)
        outlines = find_outlines(moved, sigma, found.near(grid), variogram, grid.cell_m, windows)
        del moved
        ground = _outside(guess, outlines.labels > 0, max(windows) // 2)
    raise AssertionError("the last turn returns")


def _outside(
    guess: Bool[np.ndarray, "rows columns"], changed: Bool[np.ndarray, "rows columns"], margin: int
) -> Bool[np.ndarray, "rows columns"]:
    """Ground off what changed by a margin of cells, or by less where a small survey would have hardly any left."""
    least = min(_NMAD_CELLS, int(guess.sum()) // 3)
    while (ground := guess & ~dilated(changed, margin)).sum() < least and margin > 0:
        margin //= 2
    return ground


def _unchanged(
    dz: Float32[np.ndarray, "rows columns"],
    own: Float32[np.ndarray, "rows columns"] | None,
    grid: Grid,
    model: Model,
    rounding: float,
) -> Bool[np.ndarray, "rows columns"]:
    """Ground where no change stands out from what most of it has in common, as a first guess."""
    if model != "tilt":
        return _even_part(dz, own, rounding)
    # A change may be less than what a tilt does at the edges, and moves the plane until it is left out.
    ground = np.isfinite(dz)
    for _ in range(_TURNS):
        ground = _even_part(lowered(dz, fit(dz, ground, grid, model, rounding), grid), own, rounding)
    return ground


def _even_part(
    dz: Float32[np.ndarray, "rows columns"], own: Float32[np.ndarray, "rows columns"] | None, rounding: float
) -> Bool[np.ndarray, "rows columns"]:
    """Ground where no window's mean stands out from what most windows have in common."""
    known = np.isfinite(dz)
    ground = known
    least = rounding if own is None else rounding / float(np.median(sampled(own, known)))
    for window in (5, 11):
        mean = np.where(known, dz if own is None else dz / own, np.float32(0))
        uniform_filter(mean, window, output=mean, mode="constant")
        mean /= np.maximum(uniform_filter(known.astype(np.float32), window, mode="constant"), np.float32(1e-6))
        middle, spread = 0.0, math.inf
        for _ in range(_TURNS):
            some = sampled(mean, ground)
            middle, spread = float(np.median(some)), nmad(some)
            ground = known & (np.abs(mean - middle) <= _STANDS_OUT * max(spread, least / window))
    return ground


def false_alarms(
    dz: Float32[np.ndarray, "rows columns"], errors: ErrorModel, ground: Bool[np.ndarray, "rows columns"]
) -> float:
    """Share of stable cells that are significant by themselves."""
    alarms = 0
    for rows in errors.grid.strips():
        alarms += int((np.abs(dz[rows]) > Z95 * errors.cell_sigma(rows)).sum(where=ground[rows]))
    return alarms / int(ground.sum())


def sampled(values: Float32[np.ndarray, "rows columns"], region: Bool[np.ndarray, "rows columns"]) -> np.ndarray:
    """Values in a region; of a large one every second, third, ... in both directions."""
    step = 1 + math.isqrt(max(0, int(region.sum()) - 1) // MOST_SAMPLED)
    return values[::step, ::step][region[::step, ::step]]
