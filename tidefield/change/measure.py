"""Measure the change between two surveys: difference, errors, outlines and volumes.

The error of a cell's dz has a part of its own, whose size and correlation are measured over stable ground, and a part
that all cells share, which is what co-registration leaves. Stable ground is given as polygons; else it is what is left
when all that changed is outlined, in turns, until both agree.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32
from pyproj import CRS

from tidefield.change.choice import repeat_choice
from tidefield.change.errors import degrees_of_freedom
from tidefield.change.outlines import WINDOWS, Outlines, find_outlines
from tidefield.change.regions import Region, rasterised
from tidefield.change.registration import LEAST_STABLE, Model
from tidefield.change.repeats import leave_out_repeated, rounding_m
from tidefield.change.shift import Shift, find_shift
from tidefield.change.stable import MOST_SAMPLED, false_alarms, sampled, settle
from tidefield.change.statistics import Z95
from tidefield.change.surfaces import ChangeError, Grid, Surface, compared_grid, open_surface, other_datums, warped
from tidefield.change.volumes import ErrorModel, Volume
from tidefield.errors import list_names
from tidefield.geometry.geodesy import lost_in_conversion
from tidefield.maps.classes import WATER

log = logging.getLogger(__name__)

Register = Literal["auto", "none", "vertical", "tilt"]
_WHOLE = 0.99
"""Share of a polygon that is all of it but for its edges."""


@dataclass(frozen=True)
class Options:
    """How two surveys are compared.

    Attributes:
        cell_m: side of the cells; the coarsest of the surveys' pixels if None.
        register: what is subtracted from the later survey; auto is vertical.
        shift: horizontally, from the orthophotos: where they tell it; not at all; or refused where they do not.
        datum_error_m: one sigma of the error that all cells share, as the user knows it.
        shift_error_m: one sigma of the horizontal shift in each direction, as the user knows it; counts where the
            orthophotos do not tell the shift.
        windows: cells along each side of the windows in which change is tested; those wider than half of the surveys'
            shorter side are left out, but for the smallest.
    """

    cell_m: float | None = None
    register: Register = "auto"
    shift: Literal["auto", "none", "images"] = "auto"
    datum_error_m: float | None = None
    shift_error_m: float | None = None
    windows: tuple[int, ...] = WINDOWS


class InPolygon(NamedTuple):
    """What changed in one of the user's polygons.

    Attributes:
        cut, fill: in the outlines; both positive.
        compared: share of the polygon where both surveys have heights, which the volumes are of.
    """

    region: Region
    net: Volume
    cut: Volume
    fill: Volume
    compared: float

    @property
    def volumes(self) -> dict[str, Volume]:
        return {"net": self.net, "cut": self.cut, "fill": self.fill}


class OnWater(NamedTuple):
    """Cells that the map of one survey or both says are water, whose heights are not those of the ground.

    Attributes:
        cells: of the grid.
        dz: in these, row by row, as in `Change.dz`.
    """

    cells: Bool[np.ndarray, "rows columns"]
    dz: Float32[np.ndarray, " N"]


@dataclass(frozen=True)
class Change:
    """What changed between two surveys.

    Attributes:
        dz: later minus earlier height after co-registration, metres; NaN where one of them is unknown, or of water.
        errors: of dz.
        stable: cells that co-registration and errors were measured on; they may lie outside of what is compared.
        stable_dz: dz in these, or in every second, third, ... of them.
        stable_before_dz: the same before co-registration.
        stable_given: whether the user named them.
        false_alarms: share of stable cells that are significant by themselves: the null test.
        net: of all cells, without a threshold.
        cut, fill: in the outlines; both positive.
        per_region: the same in each of the user's polygons.
    """

    earlier: Surface
    later: Surface
    grid: Grid
    dz: Float32[np.ndarray, "rows columns"]
    errors: ErrorModel
    stable: Bool[np.ndarray, "rows columns"]
    stable_dz: Float32[np.ndarray, " N"]
    stable_before_dz: Float32[np.ndarray, " N"]
    stable_given: bool
    outlines: Outlines
    false_alarms: float
    net: Volume
    cut: Volume
    fill: Volume
    outside: Volume
    each: list[tuple[int, Volume, float]]
    per_region: list[InPolygon]
    threshold_cut_m3: float
    threshold_fill_m3: float
    detection_m: tuple[float, float, float]
    remarks: list[str] = field(default_factory=list)
    water: OnWater | None = None

    @property
    def with_water(self) -> Float32[np.ndarray, "rows columns"]:
        """dz of the water as well."""
        if self.water is None:
            return self.dz
        dz = self.dz.copy()
        dz[self.water.cells] = self.water.dz
        return dz


def read_difference(
    earlier: Surface,
    later: Surface,
    grid: Grid,
    shift_m: tuple[float, float] = (0.0, 0.0),
    tick: Callable[[int, int], Any] | None = None,
) -> Float32[np.ndarray, "rows columns"]:
    """Later minus earlier heights on a grid, metres; NaN where one of them is unknown."""
    dz = np.empty(grid.shape, np.float32)
    for surface, sign, moved in ((earlier, -1, (0.0, 0.0)), (later, 1, shift_m)):
        with surface.on_grid(grid, moved) as read:
            for rows in grid.strips():
                heights = read(rows.start, rows.stop)
                dz[rows] = -heights if sign < 0 else dz[rows] + heights
                if tick is not None:
                    tick(rows.stop + (grid.rows if sign > 0 else 0), 2 * grid.rows)
    return dz


def read_sigma(
    earlier: Surface, later: Surface, grid: Grid, shift_m: tuple[float, float] = (0.0, 0.0)
) -> Float32[np.ndarray, "rows columns"] | None:
    """One sigma of later minus earlier heights, metres, NaN where it is unknown; None unless both surveys have one."""
    if earlier.sigma is None or later.sigma is None:
        return None
    sigma = np.zeros(grid.shape, np.float32)
    for surface, path, moved in ((earlier, earlier.sigma, (0.0, 0.0)), (later, later.sigma, shift_m)):
        # In the unit of the heights, whatever unit of heights the raster of errors states.
        raster = replace(open_surface(path), metres=surface.metres)
        with raster.on_grid(grid, moved) as read:
            for rows in grid.strips():
                own = read(rows.start, rows.stop)
                own[~(own > 0)] = np.nan
                sigma[rows] = np.hypot(sigma[rows], own)
    return sigma


def measure(
    earlier: Surface,
    later: Surface,
    options: Options | None = None,
    *,
    stable: Callable[[Grid], list[Region]] | None = None,
    within: Callable[[Grid], list[Region]] | None = None,
    regions: Callable[[Grid], list[Region]] | None = None,
    tick: Callable[[int, int], Any] | None = None,
) -> Change:
    """Measure the change between two surveys.

    Args:
        stable: reads the polygons of stable ground; if None, stable ground is found.
        within: reads the polygons that the comparison is limited to.
        regions: reads polygons whose volumes are given one by one.

    Raises:
        ChangeError: the surveys do not overlap, have too little stable ground, or state different vertical datums
            and are not registered.
    """
    options = options or Options()
    grid = compared_grid(earlier, later, options.cell_m, options.register != "none")
    remarks = [*dict.fromkeys([*earlier.remarks, *later.remarks])]
    # What cannot be read is found before all is measured.
    steady, limits, polygons = ([] if read is None else read(grid) for read in (stable, within, regions))
    target = None if grid.crs is None else CRS.from_wkt(grid.crs)
    for surface in (earlier, later):
        if surface.crs is not None and target is not None and (lost := lost_in_conversion(surface.crs, target)):
            remarks.append(f"{surface.file}: coordinates {lost}; errors do not include that")
    if datums := other_datums(earlier, later):
        remarks.append(f"{datums}; only stable ground takes the difference")
    log.info(f"comparing {grid.shape[0]:,} x {grid.shape[1]:,} cells of {grid.cell_m:g} m")
    shift = _shift(earlier, later, grid, options, remarks)
    moved = (shift.east_m or 0.0, shift.north_m or 0.0) if shift is not None else (0.0, 0.0)
    dz = read_difference(earlier, later, grid, moved, tick=tick)
    filled = _marked(earlier, later, grid, moved, "filled")
    _leave_out(dz, filled, grid, "were filled in at one date or both and not measured (filled.tif): left out", remarks)
    own = read_sigma(earlier, later, grid, moved)
    if own is not None:
        files = list_names([*dict.fromkeys(surface.sigma.name for surface in (earlier, later) if surface.sigma)])
        unsure = f"have no standard error above 0 in one survey or both ({files}): left out; without these files all of"
        _leave_out(dz, ~np.isfinite(own), grid, f"{unsure} them are compared", remarks)
        own[~np.isfinite(dz)] = np.nan
    elif earlier.sigma is not None or later.sigma is not None:
        remarks.append("only one survey has standard errors of its cells; they are not used")
    wet = _marked(earlier, later, grid, moved, "classes") & np.isfinite(dz)
    on_water = dz[wet]
    tidal = (
        "are water at one date or both by the classes of the maps: left out, since their heights are the water's and "
        "not the ground's"
    )
    _leave_out(dz, wet, grid, tidal, remarks)
    given = rasterised(steady, grid) if steady else None
    if given is not None:
        given &= np.isfinite(dz)
    # Stable ground lies outside of what is asked about, too.
    area = rasterised(limits, grid) if limits else None
    known = int(np.isfinite(dz).sum())
    if area is not None and not np.isfinite(dz[area]).any():
        raise ChangeError(
            f"{earlier.file} and {later.file} have no cell with heights of both within the polygons that the "
            "comparison is limited to: expected some; check --within, and the surveys' nodata there"
        )
    if known < LEAST_STABLE:
        raise ChangeError(
            f"{earlier.file} and {later.file} both have heights in {known} cells{' of ground' if len(on_water) else ''}"
            f": expected at least {LEAST_STABLE}; check their nodata and their places, or give a smaller --cell"
        )
    unmoved = dz if moved == (0, 0) else read_difference(earlier, later, grid)
    unmoved[~np.isfinite(dz)] = np.nan
    steps = rounding_m(earlier), rounding_m(later)
    leave_out_repeated(dz, unmoved, max(steps), given, area, remarks)
    del unmoved
    rounding = math.hypot(*steps) / math.sqrt(12)  # each error is uniform within a step
    model: Model = "vertical" if options.register == "auto" else options.register
    windows = tuple(window for window in options.windows if 2 * window <= min(grid.shape)) or (min(options.windows),)
    log.info("measuring errors" if given is not None else "finding stable ground, and measuring errors on it")
    registration, variogram, sigma, ground = settle(
        dz, own, grid, given, model, windows, options.datum_error_m, rounding, remarks
    )
    slopes = None
    shift_error_m = shift.error_m if shift is not None and shift.known else options.shift_error_m
    if shift is not None:
        registration = replace(registration, shift_m=moved, words=[shift.words()])
    if shift_error_m is not None:
        stated = shift is None or not shift.known
        registration = replace(registration, shift_error_m=shift_error_m, shift_stated=stated)
        slopes = _slopes(earlier, grid)
        if model != "none":
            # The mean over stable ground of what an error of the shift does was subtracted there.
            slopes -= np.stack([sampled(part, ground).mean() for part in slopes])[:, None, None]
    shown_before = sampled(dz, ground)
    for rows in grid.strips():
        dz[rows] -= registration.plane(grid, rows)
    if len(on_water):
        on_water -= np.concatenate([registration.plane(grid, rows)[wet[rows]] for rows in grid.strips()])
    degrees = degrees_of_freedom(variogram, ground, grid.cell_m)
    errors = ErrorModel(sigma, variogram, registration, grid, degrees, slopes, options.datum_error_m or 0.0)
    alarms = false_alarms(dz, errors, ground)
    shown = sampled(dz, ground), shown_before
    if area is not None:
        dz[~area] = np.nan
        on_water[~area[wet]] = np.nan
    if not variogram.reached:
        remarks.append(
            "errors are correlated over longer distances than stable ground can show: intervals may be too narrow"
        )
    if variogram.assumed_m > 0:
        remarks.append(
            "stable ground has too few neighbouring cells to show what these share: that errors are shared within "
            f"{variogram.assumed_m:.1f} m is taken for granted"
        )
    if given is None:
        remarks.append(
            f"stable ground was found, not given: {100 * ground.sum() / max(known, 1):.0f}% of the cells, where no "
            "change stands out; a shift of all ground cannot be told from a change of all ground"
        )
    log.info("outlining change, and what chance would have outlined")
    outlines = find_outlines(dz, sigma, errors.near_sigma(), variogram, grid.cell_m, windows)
    found = _summed(earlier, later, dz, errors, ground, shown, given is not None, outlines, alarms, polygons, remarks)
    partial = [f"{one.region.name} ({100 * one.compared:.0f}%)" for one in found.per_region if one.compared < _WHOLE]
    if partial:
        limited = " and --within reaches" if area is not None else ""
        remarks.append(
            f"polygon{'s'[: len(partial) > 1]} {list_names(partial)}: only this part is compared, where both surveys "
            f"have heights{' of ground' if len(on_water) else ''}{limited}, and its volumes are of that part"
        )
    return replace(found, water=OnWater(wet, on_water)) if len(on_water) else found


def _marked(
    earlier: Surface, later: Surface, grid: Grid, shift_m: tuple[float, float], by: Literal["filled", "classes"]
) -> Bool[np.ndarray, "rows columns"]:
    """Cells that the rasters of either survey mark as filled in, or as water."""
    found = np.zeros(grid.shape, bool)
    for surface, moved in ((earlier, (0.0, 0.0)), (later, shift_m)):
        path = surface.filled if by == "filled" else surface.classes
        if path is not None:
            with warped(path, surface.crs, grid, moved, nearest=by == "classes") as read:
                for rows in grid.strips():
                    marks = read(rows.start, rows.stop)[0]
                    # Between a filled cell and a measured one the value is between 0 and 1.
                    found[rows] |= marks > 0 if by == "filled" else marks == WATER
    return found


def _leave_out(
    dz: Float32[np.ndarray, "rows columns"],
    cells: Bool[np.ndarray, "rows columns"],
    grid: Grid,
    why: str,
    remarks: list[str],
) -> None:
    """Make dz unknown in some cells, with a remark on how many had heights."""
    known = np.isfinite(dz)
    count = np.count_nonzero(known & cells)
    if count:
        share = 100 * count / np.count_nonzero(known)
        remarks.append(f"{share:.1f}% of the cells, {count * grid.cell_area_m2:,.0f} m², {why}")
        dz[cells] = np.nan


def _shift(earlier: Surface, later: Surface, grid: Grid, options: Options, remarks: list[str]) -> Shift | None:
    """The horizontal shift that the orthophotos tell, if it is asked for and there are any.

    Raises:
        ChangeError: it must be known, and is not.
    """
    if options.shift == "none" or (options.shift == "auto" and options.register == "none"):
        return None
    if earlier.orthophoto is None or later.orthophoto is None:
        if options.shift == "images":
            raise ChangeError(
                "--shift images was given, but one survey has no orthophoto: expected two; name them (--orthophotos)"
            )
        return None
    shift = find_shift(earlier.orthophoto, later.orthophoto, grid)
    if not shift.known:
        if options.shift == "images":
            raise ChangeError(f"{shift.words()}: expected at least a quarter; give control, or leave --shift out")
        on_slopes = (
            "no error has what a shift would do on slopes: state how large it may be (--shift-error)"
            if options.shift_error_m is None
            else f"the standard error of {options.shift_error_m:g} m that was stated counts on slopes"
        )
        remarks.append(f"{shift.words()}, and {on_slopes}")
    return shift


def _slopes(surface: Surface, grid: Grid) -> Float32[np.ndarray, "2 rows columns"]:
    """Slopes of a surface to the east and to the north; 0 where they are unknown."""
    out = np.empty((2, *grid.shape), np.float32)
    with surface.on_grid(grid) as read:
        for rows in grid.strips():
            first = max(0, rows.start - 1)
            south, east = np.gradient(read(first, min(grid.rows, rows.stop + 1)), grid.cell_m)
            out[:, rows] = np.stack([east, -south])[:, rows.start - first :][:, : rows.stop - rows.start]
    return np.nan_to_num(out, copy=False)


def _summed(
    earlier: Surface,
    later: Surface,
    dz: Float32[np.ndarray, "rows columns"],
    errors: ErrorModel,
    ground: Bool[np.ndarray, "rows columns"],
    stable_dz: tuple[Float32[np.ndarray, " N"], Float32[np.ndarray, " N"]],
    stable_given: bool,
    outlines: Outlines,
    alarms: float,
    regions: list[Region],
    remarks: list[str],
) -> Change:
    """The volumes of a difference."""
    grid, known = errors.grid, np.isfinite(dz)
    beyond, detection = np.zeros(2), []
    for rows in grid.strips():
        sigma = errors.cell_sigma(rows)
        significant = np.abs(dz[rows]) > Z95 * sigma
        beyond[0] -= float(dz[rows].sum(where=significant & (dz[rows] < 0), dtype=np.float64))
        beyond[1] += float(dz[rows].sum(where=significant & (dz[rows] > 0), dtype=np.float64))
        detection.append(sigma[known[rows]][:: max(1, grid.columns * grid.rows // MOST_SAMPLED)])
    low, middle, high = (Z95 * np.quantile(np.concatenate(detection), (0.05, 0.5, 0.95))).tolist()
    lower, higher = outlines.cells(-1), outlines.cells(1)
    choices = None
    if len(outlines.signs):
        choices = repeat_choice(dz, errors.sigma, errors.near_sigma(), errors.variogram, grid.cell_m, outlines)

    whole, counts = (slice(0, grid.rows), slice(0, grid.columns)), [int(np.count_nonzero(of)) for of in (lower, higher)]

    def chosen(inside: Bool[np.ndarray, "rows columns"], box: tuple[slice, slice] = whole) -> tuple[Volume, Volume]:
        """Cut and fill of the outlines' cells in a region of a box, with its share of what their choice adds."""
        volumes = []
        for k, (outlined, sign) in enumerate(((lower, -1.0), (higher, 1.0))):
            cells = inside & outlined[box]
            volume, count = errors.volume(dz[box], cells, sign, box), int(np.count_nonzero(cells))
            if choices is not None and count:
                share = count / counts[k]
                bias, deviation = sign * choices[k].bias * share, choices[k].deviation * math.sqrt(share)
                volume = volume.chosen(bias * grid.cell_area_m2, deviation * grid.cell_area_m2)
            volumes.append(volume)
        return volumes[0], volumes[1]

    cut, fill = chosen(known)
    each = []
    for k, (box, sign) in enumerate(zip(outlines.boxes, outlines.signs.tolist(), strict=True), start=1):
        part, inside = dz[box], outlines.labels[box] == k
        each.append((k, errors.volume(part, inside, float(sign), box), float(np.abs(part[inside]).max())))
    per_region, empty = [], []
    for region in regions:
        box = grid.box_of(region.geometry.bounds)
        cells = region.cells(grid.part(box))
        inside = cells & known[box]
        if not inside.any():
            empty.append(region.name)
            continue
        compared = region.share_on(grid) * np.count_nonzero(inside) / np.count_nonzero(cells)
        per_region.append(InPolygon(region, errors.volume(dz[box], inside, 1.0, box), *chosen(inside, box), compared))
    if empty:
        remarks.append(f"polygon{'s'[: len(empty) > 1]} {list_names(empty)}: no cell of both surveys is in it")
    return Change(
        earlier,
        later,
        grid,
        dz,
        errors,
        ground,
        *stable_dz,
        stable_given,
        outlines,
        alarms,
        errors.volume(dz, known),
        cut,
        fill,
        errors.volume(dz, known & ~lower & ~higher),
        each,
        per_region,
        float(beyond[0]) * grid.cell_area_m2,
        float(beyond[1]) * grid.cell_area_m2,
        (low, middle, high),
        remarks,
    )
