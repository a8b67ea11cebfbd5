"""Local frames, compared with pyproj's transformations and with distances on the ellipsoid."""

import json

import numpy as np
import pytest
from pyproj import Geod, Transformer

from tidefield.geometry.geodesy import (
    LocalFrame,
    has_unstated_unit,
    metres_per_degree,
    near_longitude,
    parse_crs,
    utm_zone,
)

BNG_PROJ4 = (
    "+proj=tmerc +lat_0=49 +lon_0=-2 +k=0.9996012717 +x_0=400000 +y_0=-100000 +ellps=airy "
    "+towgs84=446.448,-125.157,542.06,0.15,0.247,0.842,-20.489 +units=m +no_defs"
)
PLACES = {
    "EPSG:27700": (351139.0, 512875.0, 264.0),
    "EPSG:7405": (351139.0, 512875.0, 264.0),
    "EPSG:32756": (333000.0, 6256000.0, 10.0),
    "EPSG:2193": (1600000.0, 5400000.0, 5.0),
    "EPSG:2056": (2600000.0, 1200000.0, 500.0),
    "EPSG:2263": (1000000.0, 200000.0, 30.0),
    "EPSG:2263+6360": (1000000.0, 200000.0, 100.0),
    "EPSG:27572": (600000.0, 2400000.0, 30.0),
    "EPSG:4326": (-2.75, 54.5, 100.0),
    "EPSG:4807": (0.0, 50.0, 3.0),
    BNG_PROJ4: (351139.0, 512875.0, 264.0),
}


def somewhere(extent_m: float = 500.0) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (50, 3)) * (extent_m, extent_m, 100)


@pytest.mark.parametrize("crs", PLACES)
def test_conversion_to_a_system_and_back_is_exact_and_maps_the_origin_to_zero(crs):
    frame = LocalFrame.at(crs, PLACES[crs])
    np.testing.assert_allclose(frame.from_crs(frame.to_crs(somewhere())), somewhere(), atol=1e-6)
    origin = frame.to_crs(np.zeros((1, 3)))
    if parse_crs(crs).is_projected:
        np.testing.assert_allclose(origin[0], PLACES[crs], atol=1e-6)
    np.testing.assert_allclose(frame.from_system(crs, np.array([PLACES[crs]])), 0, atol=1e-6)


@pytest.mark.parametrize("crs", PLACES)
def test_gps_round_trip_is_exact_to_a_centimetre_and_keeps_heights(crs):
    frame = LocalFrame.at(crs, PLACES[crs])
    there = frame.to_geographic(somewhere())
    np.testing.assert_allclose(frame.from_geographic(there), somewhere(), atol=0.01)
    np.testing.assert_allclose(there[:, 2].mean(), frame.height_m, atol=20)


@pytest.mark.parametrize("crs", [crs for crs in PLACES if parse_crs(crs).is_projected])
def test_gps_is_converted_as_pyproj_does(crs):
    frame = LocalFrame.at(crs, PLACES[crs])
    longitude, latitude, height = frame.to_geographic(somewhere()).T
    horizontal = "EPSG:2263" if crs == "EPSG:2263+6360" else "EPSG:27700" if crs == "EPSG:7405" else crs
    expected = Transformer.from_crs("EPSG:4326", horizontal, always_xy=True).transform(longitude, latitude)
    found = frame.to_crs(frame.from_geographic(np.column_stack([longitude, latitude, height])))
    np.testing.assert_allclose(found[:, :2], np.column_stack(expected), atol=0.01)


def test_the_world_is_the_topocentric_frame_of_pyprojs_geocentric_coordinates():
    frame = LocalFrame.at("EPSG:32630", (516190.0, 6039183.0, 100.0))
    to_earth = Transformer.from_crs("EPSG:32630", "EPSG:4979", always_xy=True)
    earth = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    grid = frame.to_crs(somewhere())
    longitude, latitude, _ = to_earth.transform(516190.0, 6039183.0, 100.0)
    u, v = np.deg2rad([longitude, latitude])
    enu = np.array(
        [
            [-np.sin(u), np.cos(u), 0],
            [-np.sin(v) * np.cos(u), -np.sin(v) * np.sin(u), np.cos(v)],
            [np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)],
        ]
    )
    x, y, _ = to_earth.transform(*grid.T)
    away = np.column_stack(earth.transform(x, y, grid[:, 2])) - earth.transform(longitude, latitude, 100.0)
    np.testing.assert_allclose(away @ enu.T, somewhere(), atol=1e-6)


def test_distances_in_the_world_are_ground_distances_not_grid_distances():
    frame = LocalFrame.at("EPSG:27700", (351000.0, 512000.0, 0.0))
    grid = np.array([[350500.0, 511500.0, 0.0], [351500.0, 512500.0, 0.0]])
    on_grid = np.linalg.norm(grid[1] - grid[0])
    on_ground = Geod(ellps="airy").line_length(
        *Transformer.from_crs("EPSG:27700", "EPSG:4277", always_xy=True).transform(*grid[:, :2].T)
    )
    in_world = np.linalg.norm(np.diff(frame.from_crs(grid), axis=0))
    assert on_ground - on_grid > 0.5
    np.testing.assert_allclose(in_world, on_ground, atol=1e-3)


@pytest.mark.parametrize("latitude", [0.0, 54.0, -54.0, 80.0])
def test_the_length_of_a_degree_is_the_ellipsoids_within_0_7_per_cent(latitude):
    earth = Geod(ellps="WGS84")
    east = earth.inv(10.0, latitude, 11.0, latitude)[2]
    north = earth.inv(10.0, latitude - 0.5, 10.0, latitude + 0.5)[2]
    np.testing.assert_allclose(metres_per_degree(latitude), (east, north), rtol=0.007)


@pytest.mark.parametrize(
    ("longitude", "latitude", "zone"),
    [
        (-2.75, 54.5, "30N"),
        (151.2, -33.8, "56S"),
        (-180.0, 10.0, "1N"),
        (179.99, 10.0, "60N"),
        (180.0, 10.0, "1N"),
        (5.3, 60.4, "32N"),
        (2.9, 60.4, "31N"),
        (5.3, 52.0, "31N"),
        (15.6, 78.2, "33N"),
        (8.9, 78.2, "31N"),
        (21.5, 78.2, "35N"),
        (34.0, 78.2, "37N"),
        (-3.0, 78.2, "30N"),
    ],
)
def test_utm_zones(longitude, latitude, zone):
    assert utm_zone(longitude, latitude) == zone
    code = (32600 if zone[-1] == "N" else 32700) + int(zone[:-1])
    assert LocalFrame.at("EPSG:4326", (longitude, latitude, 0.0)).epsg == code


def test_the_utm_system_has_the_datum_of_the_coordinates_where_it_exists():
    assert LocalFrame.at("EPSG:4258", (10.0, 50.0, 0.0)).epsg == 25832
    assert LocalFrame.at("EPSG:4277", (-2.75, 54.5, 0.0)).epsg == 32630


@pytest.mark.parametrize("crs", PLACES)
def test_json_round_trip(crs):
    frame = LocalFrame.at(crs, PLACES[crs])
    again = LocalFrame.from_json(json.loads(json.dumps(frame.to_json())))
    assert again == frame
    np.testing.assert_array_equal(again.to_crs(somewhere()), frame.to_crs(somewhere()))


def test_a_system_without_epsg_code_is_kept_as_wkt():
    frame = LocalFrame.at(BNG_PROJ4, PLACES[BNG_PROJ4])
    assert frame.epsg is None
    assert "Airy" in frame.crs
    assert LocalFrame.at("+proj=utm +zone=30 +datum=WGS84", (500000.0, 6000000.0, 0.0)).epsg == 32630


def test_a_compound_system_gives_the_vertical_datum_and_the_unit_of_heights():
    assert LocalFrame.at("EPSG:7405", PLACES["EPSG:7405"]).vertical_datum == "ODN height"
    feet = LocalFrame.at("EPSG:2263+6360", (1000000.0, 200000.0, 100.0))
    assert feet.height_m == pytest.approx(30.48, abs=1e-3)
    np.testing.assert_allclose(feet.from_crs(np.array([[1000000.0, 200000.0, 200.0]]))[0], (0, 0, 30.48), atol=1e-3)
    assert feet.vertical_datum == "NAVD88 height (ftUS)"


@pytest.mark.parametrize("vertical", ["5703", "6360", "8228"])
def test_the_vertical_datum_of_products_in_metres_is_named_in_metres(vertical: str):
    frame = LocalFrame.at(f"EPSG:6318+{vertical}", (-122.0, 38.0, 100.0))
    assert frame.to_crs(np.zeros((1, 3)))[0, 2] == pytest.approx(frame.height_m)
    assert frame.vertical_datum == "NAVD88 height"


@pytest.mark.parametrize("crs", ["EPSG:4978", "EPSG:99999", "", "EPSG:5701", "the moon"])
def test_other_kinds_of_system_are_refused(crs):
    with pytest.raises(ValueError, match=r"coordinate reference system|neither projected nor geographic"):
        LocalFrame.at(crs, (0.0, 0.0, 0.0))


def test_coordinates_outside_the_domain_of_a_system_are_refused():
    with pytest.raises(ValueError, match="outside what the system can hold"):
        LocalFrame.at("EPSG:27700", (351200.0, 512900.0, 0.0)).from_crs(np.array([[1e9, 1e9, 0.0]]))


@pytest.mark.parametrize("crs", [*PLACES, "EPSG:4979", "EPSG:2263+5703", "+proj=lcc +lat_1=41 +lat_2=40 +units=us-ft"])
def test_the_unit_of_heights_is_unstated_in_flat_systems_of_other_units_than_metres(crs: str):
    flat_in_feet = ("EPSG:2263", "+proj=lcc +lat_1=41 +lat_2=40 +units=us-ft")
    assert has_unstated_unit(parse_crs(crs)) == (crs in flat_in_feet)


def test_products_of_control_in_web_mercator_are_in_true_metres():
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True).transform(5.0, 53.5)
    frame = LocalFrame.at("EPSG:3857", (x, y, 2.0))
    assert frame.crs == "EPSG:32631"
    placed = frame.from_system("EPSG:3857", np.array([[x, y, 2.0], [x + 168.0, y, 2.0]]))
    assert np.linalg.norm(placed[1] - placed[0]) == pytest.approx(100, rel=0.01)
    assert LocalFrame.at("EPSG:27700", (351_200.0, 512_900.0, 260.0)).crs == "EPSG:27700"


def test_longitudes_continue_across_the_date_line_and_stay_exact_elsewhere():
    longitudes = np.array([179.9, -179.9, 180.0, 0.1, -2.75, np.nan])
    found = near_longitude(longitudes, 179.0)
    np.testing.assert_allclose(found[:3], [179.9, 180.1, 180.0], rtol=0, atol=1e-12)
    assert np.isnan(found[5])
    np.testing.assert_array_equal(near_longitude(longitudes[:5], 0.0), longitudes[:5])
    assert near_longitude(285.0, 0.0) == -75.0
