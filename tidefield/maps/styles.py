"""How QGIS shows a file when it opens it: it reads NAME.qml next to a raster, and a table in a GeoPackage."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from tidefield.files import write_text
from tidefield.maps.classes import GROUND, VEGETATION, WATER

INK = "#1c2328"
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


@dataclass(frozen=True)
class Lines:
    """Shapes as lines, without a filling, in colours that an attribute chooses.

    Attributes:
        attribute: of the shapes.
        colours: its values and their colours (#rrggbb).
    """

    attribute: str
    colours: tuple[tuple[str, str], ...]


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
    root = _root()
    renderer = SubElement(SubElement(root, "pipe"), "rasterrenderer", band=str(style.band), opacity="1", alphaBand="-1")
    if isinstance(style, Ramp):
        low, high = (repr(style.stops[k][0]) for k in (0, -1))
        renderer.attrib |= {"type": "singlebandpseudocolor", "classificationMin": low, "classificationMax": high}
        ends = {"colorRampType": "INTERPOLATED", "clip": "0", "minimumValue": low, "maximumValue": high}
        shader = SubElement(SubElement(renderer, "rastershader"), "colorrampshader", ends)
        for value, colour in style.stops:
            SubElement(shader, "item", value=repr(value), color=colour, alpha="255", label=f"{value:.3g}")
    else:
        renderer.set("type", "paletted")
        palette = SubElement(renderer, "colorPalette")
        for value, colour, name in style.entries:
            SubElement(palette, "paletteEntry", value=str(value), color=colour, alpha="255", label=name)
    path = raster.with_suffix(".qml")
    write_text(path, _text(root))
    return path


def style_of_layer(style: Lines, is_area: bool) -> str:
    """The style of a layer of shapes, as QGIS keeps it in GeoPackages.

    Args:
        is_area: they are polygons, not lines.
    """
    root = _root()
    renderer = SubElement(root, "renderer-v2", type="categorizedSymbol", attr=style.attribute)
    categories, symbols = SubElement(renderer, "categories"), SubElement(renderer, "symbols")
    for number, (value, colour) in enumerate(style.colours):
        SubElement(categories, "category", symbol=str(number), value=value, label=value, render="true")
        symbol = SubElement(symbols, "symbol", type="fill" if is_area else "line", name=str(number), alpha="1")
        layer = SubElement(symbol, "layer", {"class": "SimpleLine", "enabled": "1", "pass": "0"})
        red_green_blue = ",".join(str(part) for part in bytes.fromhex(colour[1:]))
        for key, given in (("line_color", f"{red_green_blue},255"), ("line_width", "0.5"), ("line_width_unit", "MM")):
            SubElement(layer, "prop", k=key, v=given)
    return _text(root)


def _root() -> Element:
    return Element("qgis", version="3.0", styleCategories="Symbology")


def _text(root: Element) -> str:
    indent(root)
    return "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(root, "unicode") + "\n"
