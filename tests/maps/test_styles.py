"""Styles that QGIS reads by itself: next to the raster, of its name, with its band's colours."""

import sqlite3
from contextlib import closing
from pathlib import Path
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest
import shapely

pytest.importorskip("rasterio", reason="needs rasterio, which is not installed")

from tidefield.maps.rasters import Raster, cog_writer
from tidefield.maps.styles import Classes, Lines, Style, change_ramp
from tidefield.maps.vectors import Layer, write_geopackage


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


def test_layers_of_a_geopackage_are_lines_in_the_colours_of_their_attribute(tmp_path: Path):
    pytest.importorskip("pyogrio", reason="needs pyogrio, which is not installed")
    style = Lines("change", (("lower", "#b2182b"), ("higher", "#2166ac")))
    square = shapely.MultiPolygon([shapely.box(0, 0, 1, 1)])
    layers = [
        Layer("outlines", "MultiPolygon", [square], {"change": ["lower"]}, style),
        Layer("shores", "LineString", [shapely.LineString([(0, 0), (1, 1)])], {"change": ["higher"]}, style),
        Layer("plain", "MultiPolygon", [square], {"area_m2": [1.0]}),
    ]
    write_geopackage(tmp_path / "change.gpkg", layers, "EPSG:32631")
    with closing(sqlite3.connect(tmp_path / "change.gpkg")) as file:
        asked = "SELECT f_table_name, styleQML FROM layer_styles WHERE f_table_schema = '' AND f_table_catalog = ''"
        styles = dict(file.execute(f"{asked} AND f_geometry_column = 'geom' AND useAsDefault").fetchall())
        tables = dict(file.execute("SELECT table_name, column_name FROM gpkg_geometry_columns").fetchall())
    assert styles.keys() == {"outlines", "shores"}
    assert set(tables.values()) == {"geom"}
    for name, kind in (("outlines", "fill"), ("shores", "line")):
        root = fromstring(styles[name].split("\n", 1)[1])
        assert [symbol.get("type") for symbol in root.iter("symbol")] == [kind, kind]
        assert [category.get("value") for category in root.iter("category")] == ["lower", "higher"]
        colours = [prop.get("v") for prop in root.iter("prop") if prop.get("k") == "line_color"]
        assert colours == ["178,24,43,255", "33,102,172,255"]
