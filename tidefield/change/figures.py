"""Draw the maps and charts of a page of change: red lowers, blue rises."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, NullFormatter

from tidefield.change.cover import Cover
from tidefield.change.measure import Change
from tidefield.change.statistics import Z95
from tidefield.change.surfaces import Grid
from tidefield.change.water import Waterline
from tidefield.maps.figures import INCHES, RULE, SOFT, Extent, figure_of, map_of, png
from tidefield.maps.styles import HIGHER, INK, LOWER, PLANTS
from tidefield.maps.terrain import hillshade

STABLE = "#7a9a3a"
_SIDE = 1400
"""Longest side of a map, cells."""


@dataclass(frozen=True)
class Thinned:
    """A change at the detail of a page.

    Attributes:
        dz, heights: of the difference and the earlier survey.
        signs: of the outlines.
        stable: ground that errors were measured on.
    """

    grid: Grid
    dz: Float32[np.ndarray, "rows columns"]
    heights: Float32[np.ndarray, "rows columns"]
    signs: np.ndarray
    stable: np.ndarray


def thinned(change: Change) -> Thinned:
    """Take every second, third, ... cell of a large change."""
    grid = change.grid
    # Slopes need two rows and columns.
    step = min(-(-max(grid.shape) // _SIDE), min(grid.shape) // 2)
    small = grid.thinned(step)
    heights = np.empty(small.shape, np.float32)
    with change.earlier.on_grid(grid) as read:
        for part in grid.strips():
            first = -(-part.start // step) * step
            heights[first // step : -(-part.stop // step)] = read(part.start, part.stop)[
                first - part.start :: step, ::step
            ]
    lookup = np.concatenate([[0], change.outlines.signs])
    return Thinned(
        small,
        change.dz[::step, ::step],
        heights,
        lookup[change.outlines.labels[::step, ::step]],
        change.stable[::step, ::step],
    )


def draw_change(small: Thinned, limit_m: float, what: str) -> Markup:
    """The map of dz over the earlier survey's relief, with the outlines."""
    figure, axes = _map(small)
    dz = small.dz.clip(-limit_m, limit_m)
    alpha = np.where(np.isfinite(dz), 0.15 + 0.8 * np.minimum(np.abs(np.nan_to_num(dz)) / (0.5 * limit_m), 1), 0)
    image = axes.imshow(
        dz, cmap="RdBu", vmin=-limit_m, vmax=limit_m, alpha=alpha, extent=_extent(small.grid), interpolation="nearest"
    )
    image.set_rasterized(True)
    for sign, colour in ((-1, LOWER), (1, HIGHER)):
        if (small.signs == sign).any():
            place = {"extent": _extent(small.grid), "origin": "upper"}
            axes.contour(small.signs == sign, levels=[0.5], colors=colour, linewidths=0.9, **place)
    bar = figure.colorbar(image, ax=axes, fraction=0.035, pad=0.02, alpha=1)
    bar.set_label("later minus earlier height (m)")
    return png(figure, what)


def draw_stable(small: Thinned, what: str) -> Markup:
    """The map of the ground that shift and errors were measured on."""
    figure, axes = _map(small)
    cover = np.where(small.stable, 1.0, np.nan)
    axes.imshow(cover, cmap=ListedColormap([STABLE]), alpha=0.55, extent=_extent(small.grid), interpolation="nearest")
    axes.legend(handles=[Patch(color=STABLE, alpha=0.55, label="stable ground")], loc="lower left", framealpha=0.9)
    return png(figure, what)


def draw_cover(cover: Cover, small: Thinned, what: str) -> Markup:
    """The map of plants gained, lost and at both dates over the earlier survey's relief."""
    step = -(-max(cover.grid.shape) // _SIDE)
    classes, extent = cover.classes[::step, ::step], _extent(cover.grid.thinned(step))
    figure, axes = _map(small)
    handles = []
    for code, colour, label in PLANTS:
        shown = np.where(classes == code, 1.0, np.nan)
        axes.imshow(shown, cmap=ListedColormap([colour]), extent=extent, interpolation="nearest")
        handles.append(Patch(color=colour, label=label))
    axes.legend(handles=handles, loc="lower left", framealpha=0.9)
    return png(figure, what)


def draw_waterlines(line: Waterline, small: Thinned, names: tuple[str, str], what: str) -> Markup:
    """Both waterlines over the earlier survey's relief."""
    figure, axes = _map(small)
    for lines, colour, name, level in zip(line.lines, (INK, HIGHER), names, line.levels_m, strict=True):
        for k, part in enumerate(lines):
            x, y = np.asarray(part.coords).T[:2]
            label = f"{name}, {level:.2f} m" if k == 0 else None
            axes.plot(x, y, color=colour, linewidth=1.2, label=label)
    west, east, south, north = _extent(small.grid)
    axes.set(xlim=(west, east), ylim=(south, north))
    if any(line.lines):
        axes.legend(loc="lower left", framealpha=0.9)
    return png(figure, what)


def draw_stable_histogram(change: Change, what: str) -> Markup:
    """Residuals over stable ground, before and after co-registration, and the level of detection."""
    after = change.stable_dz
    figure = figure_of(5.0, 2.7)
    axes = figure.add_axes((0.11, 0.2, 0.86, 0.74))
    registration = change.errors.registration
    spread = max(registration.after[2], registration.before[2])
    reach = max(3 * Z95 / 2 * spread, 1.2 * abs(registration.before[0]), 1e-3)
    edges = np.linspace(-reach, reach, 81)
    for values, colour, label in ((change.stable_before_dz, SOFT, "before"), (after, "#1f5f86", "after")):
        axes.hist(values, edges.tolist(), histtype="step", color=colour, label=label)
    for sign in (-1, 1):
        axes.axvline(sign * change.detection_m[1], color=LOWER, linewidth=0.8, linestyle="--")
    axes.set(xlabel="dz over stable ground (m); dashed: level of detection", yticks=[])
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    return png(figure, what)


def draw_variogram(change: Change, what: str) -> Markup | None:
    """The variogram over stable ground and the model; None where it could not be measured."""
    variogram = change.errors.variogram
    if not variogram.lags_m:
        return None
    figure = figure_of(5.0, 2.7)
    axes = figure.add_axes((0.12, 0.2, 0.85, 0.74))
    lags = np.array(variogram.lags_m)
    line = np.geomspace(lags[0], lags[-1], 200)
    axes.semilogx(lags, variogram.semivariances, "o", color="#1f5f86", markersize=3.5, label="measured")
    axes.semilogx(line, 1 - variogram.correlation(line), color=SOFT, linewidth=1, label="model")
    axes.axhline(variogram.nugget, color=RULE, linewidth=0.8)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set(xlabel="distance (m)", ylabel="semivariance over variance", ylim=(0, None))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower right")
    return png(figure, what)


def draw_section(change: Change, row: int, what: str) -> Markup:
    """Heights of both dates along a row of the grid, with the 95% band of the later one."""
    grid = change.grid
    with change.earlier.on_grid(grid) as read:
        earlier = read(row, row + 1)[0]
    later = earlier + change.dz[row]
    band = Z95 * change.errors.cell_sigma(slice(row, row + 1))[0]
    x = (np.arange(grid.columns) + 0.5) * grid.cell_m
    figure = figure_of(INCHES, 2.5)
    axes = figure.add_axes((0.08, 0.22, 0.9, 0.73))
    axes.fill_between(x, later - band, later + band, color=HIGHER, alpha=0.25, linewidth=0)
    axes.plot(x, earlier, color=INK, linewidth=0.9, label=change.earlier.name)
    axes.plot(x, later, color=HIGHER, linewidth=0.9, label=f"{change.later.name}, with its 95% band of change")
    axes.set(xlabel="metres from the western edge", ylabel="height (m)", xlim=(x[0], x[-1]))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    return png(figure, what)


def _map(small: Thinned) -> tuple[Figure, Axes]:
    """A map of the earlier survey's relief, exaggerated where it is flat."""
    figure, axes = map_of(*small.grid.shape)
    steepness = np.hypot(*np.gradient(small.heights, small.grid.cell_m))
    known = steepness[np.isfinite(steepness)]
    scale = min(8.0, 0.35 / max(float(np.quantile(known, 0.9)), 1e-6)) if len(known) else 1.0
    shade = np.where(np.isfinite(small.heights), hillshade(scale * small.heights, small.grid.cell_m), np.nan)
    axes.imshow(0.45 + 0.5 * shade, cmap="gray", vmin=0, vmax=1, extent=_extent(small.grid), interpolation="nearest")
    return figure, axes


def _extent(grid: Grid) -> Extent:
    west, south, east, north = grid.bounds
    return west, east, south, north
