"""Areas and sections, as GIS programs write them."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from pyproj import CRS, Transformer
from rich.console import Console

from tidefield.commands.map_ import Map, map_
from tidefield.errors import RunError
from tidefield.geometry.drawn import read_drawn
from tidefield.geometry.geodesy import LocalFrame, parse_crs
from tidefield.maps.area import inside, touches
from tidefield.maps.grid import LOCAL_WKT, Grid, MapFrame

EAST, NORTH, SIDE = 400_000.0, 500_000.0, 80.0
WKT = parse_crs("EPSG:27700").to_wkt()
FRAME = MapFrame(LocalFrame.at("EPSG:27700", (EAST, NORTH, 10.0)), np.zeros(3), np.eye(3), WKT, WKT, "the sea")
LOCAL = MapFrame(None, np.zeros(3), np.eye(3), LOCAL_WKT, LOCAL_WKT, "local")
TO = Transformer.from_crs("EPSG:27700", "EPSG:4326", always_xy=True)


def ring(*corners: tuple[float, float]) -> list[list[float]]:
    return [list(TO.transform(EAST + SIDE * x, NORTH + SIDE * y)) for x, y in (*corners, corners[0])]


SQUARE = ring((0, 0), (1, 0), (1, 1), (0, 1))
BOW_TIE = ring((0, 0), (1, 1), (1, 0), (0, 1))


def feature(geometry: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": {"name": "a"}, "geometry": geometry}


def polygon(*rings: list[list[float]]) -> dict[str, Any]:
    return {"type": "Polygon", "coordinates": rings}


def write(path: Path, *geometries: Any, **members: Any) -> Path:
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature(g) for g in geometries], **members}))
    return path


def read_shapes(path: Path, frame: MapFrame, kind: str) -> list[tuple[shapely.Geometry, str]]:
    found = read_drawn(path).of_kind(kind).placed(CRS.from_wkt(frame.horizontal_wkt)).of_kind(kind)
    return list(zip(found.geometries, found.names, strict=True))


def area(path: Path) -> float:
    return shapely.union_all([shape for shape, _ in read_shapes(path, FRAME, "Polygon")]).area


@pytest.mark.parametrize(
    ("geometries", "members"),
    [
        ([None, polygon(SQUARE)], {}),
        ([polygon(SQUARE)], {"crs": None}),
        ([{"type": "GeometryCollection", "geometries": [{"type": "MultiPolygon", "coordinates": [[SQUARE]]}]}], {}),
        ([polygon(BOW_TIE), polygon(SQUARE)], {}),
    ],
    ids=["null geometry", "null crs", "nested", "bow tie and square"],
)
def test_all_valid_forms_of_an_area_are_read(tmp_path: Path, geometries: list[Any], members: dict[str, Any]):
    assert area(write(tmp_path / "a.geojson", *geometries, **members)) == pytest.approx(SIDE**2, rel=1e-4)


@pytest.mark.parametrize("name", ["a.gpkg", "a.shp"])
def test_areas_are_read_from_other_formats_in_their_own_system(tmp_path: Path, name: str):
    pytest.importorskip("pyogrio").raw.write(
        tmp_path / name,
        geometry=shapely.to_wkb(np.array([shapely.box(EAST, NORTH, EAST + SIDE, NORTH + SIDE)], object)),
        field_data=[np.array(["flat"], object)],
        fields=["name"],
        geometry_type="Polygon",
        crs="EPSG:27700",
    )
    [(found, title)] = read_shapes(tmp_path / name, FRAME, "Polygon")
    assert (found.bounds, title) == ((EAST, NORTH, EAST + SIDE, NORTH + SIDE), "flat")


def test_a_system_that_nobody_knows_is_refused(tmp_path: Path):
    system = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::999999"}}
    with pytest.raises(RunError, match=r"names the coordinate system .*999999.*, which nobody knows"):
        read_shapes(write(tmp_path / "a.geojson", polygon(SQUARE), crs=system), FRAME, "Polygon")


@pytest.mark.parametrize(
    "name", ["CRS84", "CRS:84", "urn:ogc:def:crs:OGC:1.3:CRS84", "http://www.opengis.net/gml/srs/epsg.xml#4326"]
)
def test_names_of_longitude_and_latitude_are_read(tmp_path: Path, name: str):
    path = write(tmp_path / "a.geojson", polygon(SQUARE), crs={"type": "name", "properties": {"name": name}})
    assert area(path) == pytest.approx(SIDE**2, rel=1e-5)


def test_a_feature_a_line_is_read(tmp_path: Path):
    features = [{"type": "Feature", "geometry": polygon(SQUARE), "properties": {"k": k}} for k in range(2)]
    (tmp_path / "a.geojsonl").write_text("\n".join(map(json.dumps, features)))
    assert len(read_shapes(tmp_path / "a.geojsonl", FRAME, "Polygon")) == 2


def test_a_degenerate_polygon_next_to_a_line_is_no_line(tmp_path: Path):
    line, spike = {"type": "LineString", "coordinates": SQUARE}, polygon(ring((0, 0), (1, 1), (2, 2)))
    assert len(read_shapes(write(tmp_path / "a.geojson", line, spike), FRAME, "LineString")) == 1


def test_a_file_that_refers_to_other_data_is_refused(tmp_path: Path):
    other = write(tmp_path / "other.geojson", polygon(SQUARE))
    source = f"<OGRVRTLayer name='other'><SrcDataSource>{other}</SrcDataSource></OGRVRTLayer>"
    (tmp_path / "a.geojson").write_text(f"<OGRVRTDataSource>{source}</OGRVRTDataSource>")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.write(tmp_path / "a.geojson", "a.vrt")
    for name in ("a.geojson", "a.zip"):
        with pytest.raises(RunError, match="refers to other data: expected polygons or lines as GeoJSON"):
            read_shapes(tmp_path / name, FRAME, "Polygon")


@pytest.mark.parametrize("frame", [FRAME, LOCAL])
def test_an_outline_that_crosses_itself_has_the_inside_of_both_its_parts(tmp_path: Path, frame: MapFrame):
    path = write(tmp_path / "a.geojson", polygon(BOW_TIE))
    shapes = [shape for shape, _ in read_shapes(path, frame, "Polygon")]
    assert [shape.geom_type for shape in shapes] == ["Polygon", "Polygon"]
    assert all(shape.is_valid for shape in shapes)
    box = shapely.box(*shapely.union_all(shapes).bounds)
    assert sum(shape.area for shape in shapes) == pytest.approx(box.area / 2, rel=0.1)


@pytest.mark.parametrize("frame", [FRAME, LOCAL])
@pytest.mark.parametrize("kind", ["Polygon", "LineString"])
@pytest.mark.parametrize("number", ["NaN", "1e999", "-Infinity", pytest.param("1" + "0" * 400, id="huge")])
def test_coordinates_that_are_not_finite_are_refused(tmp_path: Path, frame: MapFrame, kind: str, number: str):
    geometry = polygon(SQUARE) if kind == "Polygon" else {"type": kind, "coordinates": SQUARE}
    path = write(tmp_path / "a.geojson", geometry)
    path.write_text(path.read_text().replace(json.dumps(SQUARE[1][1]), number))
    with pytest.raises(RunError, match=r"has coordinates outside of|is no GeoJSON"):
        read_shapes(path, frame, kind)


def test_lines_keep_their_vertices(tmp_path: Path):
    line = {"type": "LineString", "coordinates": BOW_TIE}
    ((found, name),) = read_shapes(write(tmp_path / "a.geojson", line), FRAME, "LineString")
    assert len(found.coords) == 5
    assert name == "a"
    spot = {"type": "LineString", "coordinates": [SQUARE[0], SQUARE[0]]}
    with pytest.raises(RunError, match="has no LineString"):
        read_shapes(write(tmp_path / "a.geojson", spot), FRAME, "LineString")


def test_an_area_has_the_cells_and_tiles_that_lie_in_it_not_in_its_rectangle():
    tiles = Grid(LOCAL, 0.0, 64.0, 0.5, 128, 128, 0.0).tiles(32, 16)
    triangle = shapely.Polygon([(0, 0), (64, 0), (0, 64)])
    for tile in tiles:
        east, north = (part + middle for part, middle in zip(tile.offsets(), tile.centre, strict=True))
        expected = (east > 0) & (north > 0) & (east + north < 64)
        np.testing.assert_array_equal(inside(triangle, tile), expected)
        assert inside(None, tile).all()
        # A tile that meets a side in one corner may be made, for nothing.
        if expected.any() or sum(tile.centre) > 64 + tile.side * 0.5:
            assert touches(triangle, tile) == expected.any()
    made = [touches(triangle, tile) for tile in tiles]
    assert 0.4 < np.mean(made) < 0.95
    assert all(touches(None, tile) for tile in tiles)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"area": "notes.txt"}, "notes.txt is no GeoJSON"),
        ({"sections": "notes.txt"}, "notes.txt is no GeoJSON"),
        ({"sections": "missing.geojson"}, "missing.geojson is not a file"),
        ({"area": "line.geojson"}, "line.geojson has no Polygon"),
        ({"gsd": -0.1}, "--gsd -0.1"),
    ],
)
def test_mistakes_of_maps_are_refused_before_photographs_are_read(
    options: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("tidefield.commands.map_.open_source", lambda *_, **__: pytest.fail("photographs were read"))
    (tmp_path / "notes.txt").write_text("none")
    write(tmp_path / "line.geojson", {"type": "LineString", "coordinates": SQUARE})
    given = {name: tmp_path / value if isinstance(value, str) else value for name, value in options.items()}
    with pytest.raises(RunError, match=message):
        map_(Map(tmp_path / "run", tmp_path / "out", **given), Console(quiet=True))
    assert not (tmp_path / "out").exists()
