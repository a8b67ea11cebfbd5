"""Write the report of a map: one page with its pictures, figures, check points and limits."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from tidefield import __version__
from tidefield.files import write_text
from tidefield.maps.classes import GROUND, VEGETATION, WATER
from tidefield.maps.rasters import need
from tidefield.pages import command_line, template_environment

WIDEST = 900
"""Of a picture, pixels."""


def write_report(result: dict[str, Any], out: Path, rasters: dict[str, str], fill: bool) -> Path:
    """Write odm_report/report.html.

    Args:
        result: what map.json holds.
        out: folder of the map.
        rasters: paths in it of the orthophoto, hillshade, sigma, views and classes.
        fill: whether empty cells were filled.
    """
    sigma, views = _read(out / rasters["sigma"])[0], _read(out / rasters["views"])[0]
    most = float(np.nanpercentile(sigma, 98)) if np.isfinite(sigma).any() else 1.0
    unit = result["coordinates"]["unit_up"]
    pictures = [
        ("Orthophoto", _uri(np.nan_to_num(_read(out / rasters["orthophoto"])).transpose(1, 2, 0).astype(np.uint8)), ""),
        ("Hillshade of the surface", _uri(_coloured(_read(out / rasters["hillshade"])[0], 255.0, "gray")), ""),
        ("Standard error", _uri(_coloured(sigma, most, "magma")), f"Black 0, pale {most:.3g} {unit} and more."),
        (
            "Photographs",
            _uri(_coloured(views, float(np.nanmax(views, initial=1.0)), "viridis")),
            f"How many see each cell: dark few, pale {np.nanmax(views, initial=1.0):.0f}.",
        ),
        ("Classes", _uri(_classes(_read(out / rasters["classes"])[0])), "Ground brown, vegetation green, water blue."),
    ]
    environment = template_environment("tidefield.maps")
    page = environment.get_template("map.html").render(
        m=result, pictures=pictures, version=__version__, command=command_line(), fill=fill
    )
    path = out / "odm_report" / "report.html"
    write_text(path, page)
    return path


def _read(path: Path) -> np.ndarray:
    """Bands of a raster, reduced to `WIDEST`; NaN where there is no data."""
    with need("rasterio").open(path) as dataset:
        factor = max(1.0, max(dataset.width, dataset.height) / WIDEST)
        shape = (dataset.count, max(1, round(dataset.height / factor)), max(1, round(dataset.width / factor)))
        values = dataset.read(out_shape=shape).astype(np.float32)
        if dataset.nodata is not None:
            values[values == np.float32(dataset.nodata)] = np.nan
        return values


def _coloured(values: np.ndarray, most: float, name: str) -> UInt8[np.ndarray, "h w 4"]:
    from matplotlib import colormaps

    colours = np.asarray(colormaps[name](np.nan_to_num(np.clip(values / max(most, 1e-9), 0, 1)), bytes=True))
    colours = colours.copy()
    colours[..., 3] = np.where(np.isfinite(values), 255, 0)
    return colours


def _classes(values: np.ndarray) -> UInt8[np.ndarray, "h w 4"]:
    colours = np.zeros((*values.shape, 4), np.uint8)
    for value, colour in ((GROUND, "#a07855"), (VEGETATION, "#3f9b4f"), (WATER, "#2f6fc4")):
        colours[values == value] = [*bytes.fromhex(colour[1:]), 255]
    return colours


def _uri(picture: np.ndarray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
