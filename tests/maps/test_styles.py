"""Styles that QGIS reads by itself: next to the raster, of its name, with its band's colours."""

from pathlib import Path
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest

pytest.importorskip("rasterio", reason="needs rasterio, which is not installed")

from tidefield.maps.rasters import Raster, cog_writer
from tidefield.maps.styles import Classes, Style, change_ramp


def renderer_of(style: Style, folder: Path):
    raster = Raster(folder / "of a map.tif", ("one", "two"), "int16", 0.0, style=style)
    with cog_writer(raster, 4, 3, None, (1.0, 0.0, 0.0, 0.0, -1.0, 3.0)) as writer:
        writer.write(0, np.ones((2, 3, 4)))
    assert sorted(path.name for path in folder.iterdir()) == ["of a map.qml", "of a map.tif"]
    text = (folder / "of a map.qml").read_text()
    assert text.startswith("<!DOCTYPE qgis")
    found = fromstring(text.split("\n", 1)[1]).find("pipe/rasterrenderer")
    assert found is not None
    assert found.get("band") == str(style.band)
    return found


def test_a_ramp_is_red_below_zero_and_blue_above(tmp_path: Path):
    renderer = renderer_of(change_ramp(1, 0.5), tmp_path)
    assert renderer.get("type") == "singlebandpseudocolor"
    assert (renderer.get("classificationMin"), renderer.get("classificationMax")) == ("-0.5", "0.5")
    items = [(float(item.get("value", "")), item.get("color", "")) for item in renderer.iter("item")]
    assert [value for value, _ in items] == [-0.5, -0.25, 0.0, 0.25, 0.5]
    red_minus_blue = [int(colour[1:3], 16) - int(colour[5:7], 16) for _, colour in items]
    assert red_minus_blue == sorted(red_minus_blue, reverse=True)
    assert red_minus_blue[0] > 100
    assert red_minus_blue[2] == 0
    assert red_minus_blue[4] < -100


def test_classes_have_their_colours_and_names(tmp_path: Path):
    renderer = renderer_of(Classes(2, ((-1, "#ff0000", "lost & gone"), (2, "#00ff00", "gained"))), tmp_path)
    assert renderer.get("type") == "paletted"
    entries = [(entry.get("value"), entry.get("color"), entry.get("label")) for entry in renderer.iter("paletteEntry")]
    assert entries == [("-1", "#ff0000", "lost & gone"), ("2", "#00ff00", "gained")]
