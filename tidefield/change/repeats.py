"""Heights that were not measured twice, because one survey has them from the other, and heights that are rounded."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.ndimage import binary_dilation, binary_opening

from tidefield.change.regions import dilated
from tidefield.change.registration import LEAST_STABLE
from tidefield.change.surfaces import Surface

_SIDE = 3
"""Cells on each side of a block that is the same in both surveys."""
_LEAST_SHARE = 0.01
"""Of cells and of steps: fewer say nothing."""
_SEVERAL_STEPS = 0.2
"""Share of two and three steps among differences of up to three, at which noise is larger than the rounding."""
_ROUNDED = 0.99
"""Share of small steps from cell to cell that are multiples of the rounding."""
_FEW_STEPS = 20
"""Larger steps are no multiples any more, because the rounding is known to a percent only."""
_LEAST_STEP_M = 0.0005
"""Of what matters: numbers of 32 bits are rounded, too."""
_READ = 1024
"""Rows and columns of the part of a surface that is read to see what it is rounded to."""
_MOST_REPEATED = 0.5
"""Of more cells that are the same in both surveys, what is left is too little to tell change from a shift."""


def leave_out_repeated(
    dz: Float32[np.ndarray, "rows columns"],
    unmoved: Float32[np.ndarray, "rows columns"],
    step_m: float,
    given: Bool[np.ndarray, "rows columns"] | None,
    area: Bool[np.ndarray, "rows columns"] | None,
    remarks: list[str],
) -> None:
    """Leave out cells that one survey has from the other, which were not measured twice, and say so.

    Args:
        unmoved: dz without a horizontal shift, which interpolates: only there are the cells the same.
        step_m: what heights are rounded to.
        given: stable ground, if the user named it.
        area: that the comparison is limited to, likewise.
    """
    same, share = repeated(unmoved, step_m)
    if not share:
        return
    if unmoved is not dz:
        same = dilated(same, 1)
    alike = f"{100 * share:.0f}% of the cells have the same height in both surveys, as if one had them from the other"
    if share == 1:
        remarks.append(
            "all heights are the same in both surveys, so that no errors can be measured: intervals have none"
        )
    elif (
        share > _MOST_REPEATED
        or (given is not None and np.count_nonzero(given & ~same) < LEAST_STABLE)
        or (area is not None and not (area & np.isfinite(dz) & ~same).any())
    ):
        remarks.append(
            f"{alike}: errors are too small if these cells were not measured twice; limit the comparison to what was "
            "(--within), and name stable ground there (--stable)"
        )
    else:
        dz[same] = np.nan
        if given is not None:
            given &= ~same
        remarks.append(f"{alike}: left out, since they were not measured twice")


def repeated(dz: Float32[np.ndarray, "rows columns"], step_m: float) -> tuple[Bool[np.ndarray, "rows columns"], float]:
    """Find blocks of cells with exactly the same height in both surveys.

    Noise makes heights the same in single cells, where they are rounded in many of them, but hardly in blocks. It does
    that where it is smaller than the rounding, so that most differences beside the blocks are none or one step.

    Args:
        step_m: what heights are rounded to; 0 if they are not.

    Returns:
        The cells, and their share of all; none where rounded heights may explain them.
    """
    same = dz == 0
    known, alike = int(np.isfinite(dz).sum()), int(np.count_nonzero(same))
    nothing = np.zeros_like(same), 0.0
    if alike <= _LEAST_SHARE * known:
        return nothing
    found = np.asarray(binary_opening(same, np.ones((_SIDE, _SIDE), bool)), bool)
    count = int(np.count_nonzero(found))
    if count <= _LEAST_SHARE * known:
        return nothing
    if step_m > 0:
        beside = np.asarray(binary_dilation(found, np.ones((_SIDE, _SIDE), bool)), bool) & ~found
        steps = np.abs(dz[beside]) / np.float32(step_m)
        steps = steps[steps < 3.5]
        if not len(steps) or (steps > 1.5).mean() < _SEVERAL_STEPS:
            return nothing
    return found, count / known


def rounding_m(surface: Surface) -> float:
    """Find what a surface's heights are rounded to, metres, from the steps between its cells; 0 if they are not."""
    from rasterio.windows import Window

    with surface.in_metres() as file:
        side = min(_READ, file.width), min(_READ, file.height)
        for across, down in ((0.5, 0.5), (0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)):
            corner = round(across * (file.width - side[0])), round(down * (file.height - side[1]))
            heights = file.read(1, window=Window(*corner, *side), masked=True)  # type: ignore[call-arg]
            heights = heights.astype(np.float64).filled(np.nan)
            if np.isfinite(heights).mean() > _LEAST_SHARE:
                return _step_of(heights)
    return 0.0


def _step_of(heights: Float64[np.ndarray, "rows columns"]) -> float:
    """What heights are multiples of: nearly all small steps from cell to cell are, and many are none, to both sides."""
    steps = [np.abs(np.diff(heights, axis=axis)) for axis in (0, 1)]
    steps = [one[np.isfinite(one)] for one in steps]
    if any(not len(one) or (one == 0).mean() <= _LEAST_SHARE or not one.any() for one in steps):
        return 0.0
    some = np.concatenate(steps)
    some = some[some > 0]
    smallest = float(np.quantile(some, 0.001))
    few = some[some < _FEW_STEPS * smallest] / smallest
    multiples = np.maximum(1, np.rint(few))
    step = float(np.median(few / multiples))
    rounded = float((np.abs(few / step - multiples) < 0.1).mean()) > _ROUNDED
    return smallest * step if rounded and smallest * step >= _LEAST_STEP_M else 0.0
