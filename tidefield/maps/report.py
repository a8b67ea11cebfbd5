"""Write the report of a map: one page with its pictures, figures, check points and limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from markupsafe import Markup
from matplotlib.patches import Patch

from tidefield import __version__
from tidefield.errors import need
from tidefield.files import write_text
from tidefield.maps.figures import INCHES, Extent, map_of, png
from tidefield.maps.rasters import read_values
from tidefield.maps.styles import CLASSES_OF_GROUND
from tidefield.pages import command_line, template_environment

WIDEST = 900
"""Of a picture, cells."""
_HALF = 4.6
"""Inches of a map that has another next to it."""


def write_report(result: dict[str, Any], out: Path, rasters: dict[str, str], fill: bool) -> Path:
    """Write odm_report/report.html.

    Args:
        result: what map.json holds.
        out: folder of the map.
        rasters: paths in it of the orthophoto, surface, hillshade, sigma, views and classes.
        fill: whether empty cells were filled.
    """
    read = {name: _read(out / path) for name, path in rasters.items()}
    place = result["coordinates"]
    unit = place["unit_up"]
    pictures = [
        ("Orthophoto", _orthophoto(*read["orthophoto"]), "Straight down, with the scene's common exposure."),
        (
            "Surface",
            _scaled(*read["surface"], "viridis", f"height ({unit})", (2.0, 98.0), read["hillshade"][0][0]),
            "Heights of whatever is on top, over their hillshade.",
        ),
        (
            "Standard error",
            _scaled(*read["sigma"], "magma", f"standard error of heights ({unit})", (0.0, 98.0)),
            "Without that of poses and datum, which check points show.",
        ),
        ("Photographs", _scaled(*read["views"], "viridis", "photographs", (0.0, 100.0)), "How many see each cell."),
        ("Classes", _classes(*read["classes"]), "As in odm_dem/classes.tif and in the point cloud."),
    ]
    environment = template_environment("tidefield.maps")
    environment.filters |= {"area": lambda value: _area(value, place["unit"])}
    page = environment.get_template("map.html").render(
        m=result, pictures=pictures, version=__version__, command=command_line(), fill=fill
    )
    path = out / "odm_report" / "report.html"
    write_text(path, page)
    return path


def _area(value: float, unit: str) -> str:
    """An area in words: of metres in hectares, too, where it is large."""
    if unit != "m":
        return f"{value:,.0f} square {unit}"
    return f"{value:,.0f} m²" + (f" ({value / 1e4:,.1f} ha)" if value >= 1e4 else "")


def _read(path: Path) -> tuple[Float32[np.ndarray, "bands rows columns"], Extent]:
    """Bands of a raster, reduced to `WIDEST`, NaN where there is no data; and west, east, south and north."""
    with need("rasterio").open(path) as dataset:
        factor = max(1.0, max(dataset.width, dataset.height) / WIDEST)
        shape = (dataset.count, max(1, round(dataset.height / factor)), max(1, round(dataset.width / factor)))
        west, south, east, north = dataset.bounds
        return read_values(dataset, out_shape=shape), (west, east, south, north)


def _orthophoto(values: np.ndarray, extent: Extent) -> Markup:
    picture = np.nan_to_num(values).transpose(1, 2, 0).astype(np.uint8)
    figure, axes = map_of(*picture.shape[:2])
    axes.imshow(picture, extent=extent, interpolation="nearest")
    return png(figure, "Orthophoto")


def _scaled(
    values: np.ndarray,
    extent: Extent,
    colours: str,
    label: str,
    percentiles: tuple[float, float],
    relief: np.ndarray | None = None,
) -> Markup:
    """A map of one band with the scale of its colours.

    Args:
        percentiles: of the values, at the ends of the colours; 0 is the value 0.
        relief: a hillshade to draw over.
    """
    band = values[0]
    known = band[np.isfinite(band)]
    low, high = np.percentile(known, percentiles).tolist() if len(known) else (0.0, 1.0)
    low = 0.0 if percentiles[0] == 0 else low
    rows, columns = band.shape
    figure, axes = map_of(rows, columns, INCHES if relief is not None else _HALF)
    if relief is not None:
        axes.imshow(relief, cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="nearest")
    shown = None if relief is None else 0.6
    image = axes.imshow(band, cmap=colours, alpha=shown, extent=extent, interpolation="nearest")
    image.set_clim(low, max(high, low + 1e-9))
    beyond = {(True, True): "both", (True, False): "min", (False, True): "max", (False, False): "neither"}
    arrows = beyond[bool((known < low).any()), bool((known > high).any())]
    figure.colorbar(image, ax=axes, fraction=0.035, pad=0.02, extend=arrows, alpha=1).set_label(label)
    return png(figure, label)


def _classes(values: np.ndarray, extent: Extent) -> Markup:
    picture = np.zeros((*values.shape[1:], 4), np.uint8)
    for value, colour, _ in CLASSES_OF_GROUND.entries:
        picture[values[0] == value] = [*bytes.fromhex(colour[1:]), 255]
    figure, axes = map_of(values.shape[1], values.shape[2], _HALF)
    axes.imshow(picture, extent=extent, interpolation="nearest")
    handles = [Patch(color=colour, label=name) for _, colour, name in CLASSES_OF_GROUND.entries]
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncol=3, frameon=False)
    return png(figure, "Classes")
