"""Polygons of a user, in whatever files programs write."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from pyproj import CRS
from surveys_of_two_dates import NORTH, WEST

from tidefield.change.regions import read_regions
from tidefield.change.surfaces import Grid
from tidefield.errors import RunError
from tidefield.maps.grid import LOCAL_WKT

raw = pytest.importorskip("pyogrio").raw
GRID = Grid(CRS("EPSG:32630").to_wkt(), WEST, NORTH, 0.5, 200, 200)
CREEK, ROAD = (shapely.box(WEST + x, NORTH - 50, WEST + x + 20, NORTH - 10) for x in (10, 40))


def write_layers(path: Path, layers: dict[str, shapely.Geometry | None], crs: str = "EPSG:32630") -> Path:
    """A GeoPackage with one feature in each layer, some without geometries."""
    for k, (name, shape) in enumerate(layers.items()):
        raw.write(
            path,
            geometry=None if shape is None else np.array([shapely.to_wkb(shape)], object),
            field_data=[np.array([name], object)],
            fields=["name"],
            geometry_type=None if shape is None else "Polygon",
            crs=None if shape is None else crs,
            driver="GPKG",
            layer=name,
            append=k > 0,
        )
    return path


def names(path: Path) -> list[str]:
    return [region.name for region in read_regions(path, GRID)]


def test_of_several_layers_one_is_named(tmp_path: Path):
    path = write_layers(tmp_path / "a.gpkg", {"notes": None, "creeks": CREEK, "roads": ROAD})
    with pytest.raises(RunError, match="creeks, roads: expected the name of one"):
        read_regions(path, GRID)
    assert names(tmp_path / "a.gpkg:roads") == ["roads"]
    with pytest.raises(RunError, match="creeks, roads: expected the name of one"):
        read_regions(tmp_path / "a.gpkg:notes", GRID)
    with pytest.raises(RunError, match="is not a file"):
        read_regions(tmp_path / "b.gpkg:roads", GRID)


def test_the_only_layer_with_geometries_is_read(tmp_path: Path):
    assert names(write_layers(tmp_path / "a.gpkg", {"notes": None, "creeks": CREEK})) == ["creeks"]


def test_polygons_of_an_undefined_system_lie_as_the_surveys_do(tmp_path: Path):
    path = write_layers(tmp_path / "a.gpkg", {"creeks": CREEK}, 'LOCAL_CS["metres",UNIT["metre",1]]')
    assert names(path) == ["creeks"]


def test_coordinates_of_maps_in_a_local_frame_are_local(tmp_path: Path):
    square = {"type": "Polygon", "coordinates": [[[0, 0], [5, 0], [5, 5], [0, 5], [0, 0]]]}
    (tmp_path / "a.geojson").write_text(json.dumps(square))
    [region] = read_regions(tmp_path / "a.geojson", Grid(LOCAL_WKT, 0.0, 10.0, 1.0, 10, 10))
    assert region.geometry.bounds == (0, 0, 5, 5)


def test_a_table_without_geometries_is_refused(tmp_path: Path):
    (tmp_path / "a.csv").write_text("a,b\n1,2\n")
    with pytest.raises(RunError, match="no geometries"):
        read_regions(tmp_path / "a.csv", GRID)


def test_whole_numbers_are_names_as_they_are_written(tmp_path: Path):
    """With one missing, the column is read as floats."""
    features = [
        {"type": "Feature", "properties": {"id": number}, "geometry": shapely.geometry.mapping(shape)}
        for number, shape in ((7, CREEK), (None, ROAD))
    ]
    system = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32630"}}
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": system, "features": features}))
    assert names(path) == ["7", "2"]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (np.array([7, np.nan], np.float32), ["7", "2"]),
        (np.array([7.5, 9]), ["7.5", "9"]),
        (np.array(["2020-01-01", "NaT"], "datetime64[D]"), ["2020-01-01", "2"]),
    ],
)
def test_numbers_and_dates_of_whatever_type_are_names(tmp_path: Path, values: np.ndarray, expected: list[str]):
    raw.write(
        tmp_path / "a.gpkg",
        geometry=shapely.to_wkb(np.array([CREEK, ROAD], object)),
        field_data=[values],
        fields=["id"],
        geometry_type="Polygon",
        crs="EPSG:32630",
        driver="GPKG",
        layer="ground",
    )
    assert names(tmp_path / "a.gpkg") == expected


def test_a_list_is_a_name_of_its_parts(tmp_path: Path):
    square = {"type": "Polygon", "coordinates": [[[0, 0], [5, 0], [5, 5], [0, 5], [0, 0]]]}
    features = [{"type": "Feature", "properties": {"name": n}, "geometry": square} for n in (["a", "b"], [3], [])]
    path = tmp_path / "lists.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    assert [region.name for region in read_regions(path, Grid(None, 0.0, 10.0, 1.0, 10, 10))] == ["a, b", "3", "3 (2)"]
