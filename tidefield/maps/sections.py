"""Cut cross-sections through a surface along lines: a CSV, and a plot with a 95% band."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from shapely.geometry.base import BaseGeometry

from tidefield.files import completed_file, plain_cell, write_text
from tidefield.maps.grid import Grid
from tidefield.maps.rasters import sample

BAND = 1.96
"""Standard errors on both sides of a height that hold 95% of normal errors."""
MOST_POINTS = 100_000
_MOST_DRAWN = 24


@dataclass(frozen=True)
class Section:
    """Heights along a line.

    Attributes:
        name: of the line.
        distance: along the line, horizontal units.
        place: easting and northing.
        height, sigma: of the surface and its standard error, NaN where it has none.
    """

    name: str
    distance: Float64[np.ndarray, " N"]
    place: Float64[np.ndarray, "N 2"]
    height: Float64[np.ndarray, " N"]
    sigma: Float64[np.ndarray, " N"]


def cut(lines: Sequence[tuple[BaseGeometry, str]], dsm: Path, sigma: Path, grid: Grid) -> list[Section]:
    """Cut a surface along lines, a point every cell.

    Args:
        lines: in map coordinates, with their names, "" for a number.
        dsm, sigma: rasters of heights and their standard errors.
        grid: of the rasters.
    """
    result = []
    for number, (line, name) in enumerate(lines, start=1):
        count = int(min(max(2, np.ceil(line.length / grid.cell) + 1), MOST_POINTS))
        along = np.linspace(0, line.length, count)
        place = np.array([line.interpolate(d).coords[0][:2] for d in along], dtype=np.float64)
        height, error = sample([dsm, sigma], place, grid).T
        result.append(Section(name or f"section {number}", along, place, height, error))
    return result


def write_sections(sections: Sequence[Section], folder: Path, unit: str, unit_up: str) -> None:
    """Write sections.csv and sections.svg into a folder, with the units of distances and of heights."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["section", "distance", "easting", "northing", "height", "sigma", "low_95", "high_95"])
    for one in sections:
        for d, (x, y), z, s in zip(one.distance, one.place, one.height, one.sigma, strict=True):
            numbers = ["" if np.isnan(value) else f"{value:.4f}" for value in (z, s, z - BAND * s, z + BAND * s)]
            writer.writerow([plain_cell(one.name), f"{d:.3f}", f"{x:.3f}", f"{y:.3f}", *numbers])
    write_text(folder / "sections.csv", text.getvalue())
    plot = draw(sections, unit, unit_up)
    with completed_file(folder / "sections.svg", overwrite=True) as partial:
        plot.savefig(partial, format="svg", metadata={"Date": None})


def draw(sections: Sequence[Section], unit: str, unit_up: str) -> Any:
    """Draw sections below each other, with 95% bands; the first `_MOST_DRAWN` of many."""
    from matplotlib.figure import Figure

    sections = sections[:_MOST_DRAWN]
    figure = Figure(figsize=(9, 1 + 2.4 * len(sections)), layout="constrained")
    axes = figure.subplots(len(sections), 1, squeeze=False)[:, 0]
    for one, plot in zip(sections, axes, strict=True):
        plot.fill_between(
            one.distance, one.height - BAND * one.sigma, one.height + BAND * one.sigma, color="#97cfbd", label="95%"
        )
        plot.plot(one.distance, one.height, color="#1d3d68", linewidth=1, label="surface")
        plot.set_title(one.name, parse_math=False)
        plot.set(xlabel=f"distance ({unit})", ylabel=f"height ({unit_up})")
        plot.grid(color="#d5dbdf", linewidth=0.6)
    axes[0].legend(frameon=False)
    return figure
