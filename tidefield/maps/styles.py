"""How QGIS shows a raster when it is opened: it reads the file of the same name that ends in .qml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from tidefield.files import write_text
from tidefield.maps.classes import GROUND, VEGETATION, WATER

LOWER, HIGHER = "#b2182b", "#2166ac"
GAINED, LOST, STANDING = "#1a7a3c", "#b8742a", "#b9c8a0"
_LOWER_TO_HIGHER = (LOWER, "#f4a582", "#f7f7f7", "#92c5de", HIGHER)


@dataclass(frozen=True)
class Ramp:
    """Colours of a band's values, in between those of its stops.

    Attributes:
        band: from 1.
        stops: values, increasing, and their colours (#rrggbb).
    """

    band: int
    stops: tuple[tuple[float, str], ...]


@dataclass(frozen=True)
class Classes:
    """Colours of a band whose values name something; others show nothing.

    Attributes:
        band: from 1.
        entries: value, colour (#rrggbb) and name of each class.
    """

    band: int
    entries: tuple[tuple[int, str, str], ...]


Style = Ramp | Classes
CLASSES_OF_GROUND = Classes(
    1, ((GROUND, "#a07855", "ground"), (VEGETATION, "#3f9b4f", "vegetation"), (WATER, "#2f6fc4", "water"))
)
SIGNS = ((-1, LOWER, "lower"), (1, HIGHER, "higher"))
PLANTS = ((2, STANDING, "plants at both dates"), (1, GAINED, "gained"), (-1, LOST, "lost"))


def change_ramp(band: int, limit: float) -> Ramp:
    """Red where values are negative, blue where they are positive, at their strongest from `limit` on."""
    values = (-limit, -limit / 2, 0.0, limit / 2, limit)
    return Ramp(band, tuple(zip(values, _LOWER_TO_HIGHER, strict=True)))


def write_style(style: Style, raster: Path) -> Path:
    """Write the style of a raster next to it, over an older one."""
    root = Element("qgis", version="3.0", styleCategories="Symbology")
    renderer = SubElement(SubElement(root, "pipe"), "rasterrenderer", band=str(style.band), opacity="1", alphaBand="-1")
    if isinstance(style, Ramp):
        low, high = (repr(style.stops[k][0]) for k in (0, -1))
        renderer.attrib |= {"type": "singlebandpseudocolor", "classificationMin": low, "classificationMax": high}
        ends = {"minimumValue": low, "maximumValue": high}
        shader = SubElement(
            SubElement(renderer, "rastershader"), "colorrampshader", colorRampType="INTERPOLATED", clip="0", **ends
        )
        for value, colour in style.stops:
            SubElement(shader, "item", value=repr(value), color=colour, alpha="255", label=f"{value:.3g}")
    else:
        renderer.set("type", "paletted")
        palette = SubElement(renderer, "colorPalette")
        for value, colour, name in style.entries:
            SubElement(palette, "paletteEntry", value=str(value), color=colour, alpha="255", label=name)
    indent(root)
    path = raster.with_suffix(".qml")
    write_text(path, "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(root, "unicode") + "\n")
    return path
