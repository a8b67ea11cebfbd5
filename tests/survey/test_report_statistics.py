"""Statistics of a survey against closed forms."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import shapely
from flat_surveys import (
    ABOVE,
    AHEAD,
    ASIDE,
    FOCAL,
    GSD,
    HEIGHT,
    WIDTH,
    findings,
    flat_ground,
    flight,
    located,
    photograph,
    reconstruction,
)

from tidefield.errors import SurveyError
from tidefield.survey.report.block import read_block
from tidefield.survey.report.figures import affine, coordinates, crossings
from tidefield.survey.report.ground import fit_ground, footprints
from tidefield.survey.report.numbers import numbers
from tidefield.survey.report.statistics import cover, find_flights, measure, unite
from tidefield.survey.survey import Survey

FOOTPRINT = (WIDTH * GSD, HEIGHT * GSD)  # 80 by 60


@pytest.fixture(scope="module")
def flat():
    return measure(findings())


def box(low, high):
    return shapely.Polygon([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])


def test_resolution_height_and_errors_are_those_of_the_construction(flat):
    np.testing.assert_allclose(flat.gsd, GSD, rtol=1e-9)
    np.testing.assert_allclose(flat.height, ABOVE, atol=1e-9)
    np.testing.assert_allclose(flat.error_px, 0.5, atol=1e-9)
    np.testing.assert_allclose(flat.rms_px, 0.5, atol=1e-9)
    assert flat.observed.sum() == flat.track_length.sum() == len(flat.error_px)


def test_footprints_are_the_frames_on_the_ground_and_run_counter_clockwise(flat):
    for outline, place in zip(flat.footprints, flat.block.position, strict=True):
        corners = shapely.get_coordinates(outline)
        assert outline.exterior.is_ccw
        assert outline.area == pytest.approx(np.prod(FOOTPRINT), rel=1e-5)
        np.testing.assert_allclose(corners.max(0) - place[:2], np.array(FOOTPRINT) / 2, atol=1e-3)
        np.testing.assert_allclose(corners.min(0) - place[:2], -np.array(FOOTPRINT) / 2, atol=1e-3)


def test_neighbours_share_what_their_distance_leaves_of_a_footprint(flat):
    np.testing.assert_allclose(flat.forward_overlap, 1 - AHEAD / FOOTPRINT[0], atol=1e-3)
    np.testing.assert_allclose(flat.side_overlap, 1 - ASIDE / FOOTPRINT[1], atol=1e-3)


def test_a_missing_photograph_shows_as_a_gap_only_where_no_other_neighbour_fills_it():
    position = np.delete(flight(1, 6), 4, axis=0)
    found = measure(findings(position))
    np.testing.assert_allclose(found.forward_overlap[:4], 1 - AHEAD / FOOTPRINT[0], atol=1e-3)
    np.testing.assert_allclose(found.forward_overlap[4], 1 - 2 * AHEAD / FOOTPRINT[0], atol=1e-3)
    assert np.isnan(found.side_overlap).all()


def test_coverage_has_the_area_of_the_union_and_of_the_intersections(flat):
    coverage = flat.coverage
    size = np.array([5 * AHEAD, 2 * ASIDE]) + FOOTPRINT
    assert coverage.area(1) == pytest.approx(size.prod(), rel=0.005)
    # Along a line, twice five photographs overlap in 16 m; across, twice two lines in 30 m.
    assert coverage.area(10) == pytest.approx(2 * AHEAD * 2 * ASIDE, rel=0.02)
    assert coverage.area(11) == 0
    assert sum(coverage.area(k, k) for k in range(1, 11)) == pytest.approx(coverage.area(1))


def test_cells_are_counted_when_their_centre_lies_in_the_polygon():
    triangle = shapely.Polygon([(0, 0), (100, 0), (0, 70)])
    coverage = cover((triangle, box((20, 10), (90, 20)), shapely.Polygon()))
    rows, columns = coverage.count.shape
    x, y = np.meshgrid((np.arange(columns) + 0.5) * coverage.cell, (np.arange(rows) + 0.5) * coverage.cell)
    inside = (x / 100 + y / 70 < 1).astype(int) + ((x > 20) & (x < 90) & (y > 10) & (y < 20))
    assert (coverage.count != inside).mean() < 1e-4


def test_the_outline_keeps_holes_and_separate_parts():
    ring = (box((0, 0), (100, 30)), box((0, 70), (100, 100)), box((0, 0), (30, 100)), box((70, 0), (100, 100)))
    crossed = shapely.Polygon([(150, 0), (200, 50), (200, 0), (150, 50)])  # two triangles, by its crossing sides
    small, large = sorted(unite((*ring, crossed, shapely.Polygon())).geoms, key=lambda part: part.area)[-2:]
    assert small.area == pytest.approx(625)
    assert large.area == pytest.approx(10000 - 1600)
    assert [shapely.Polygon(inner).area for inner in large.interiors] == pytest.approx([1600])
    assert large.exterior.is_ccw


def test_footprints_end_on_a_slope_where_the_rays_meet_it():
    slope = 0.2
    generator = np.random.default_rng(1)
    xy = generator.uniform(-90, 90, (3000, 2))
    ground = fit_ground(np.c_[xy, slope * xy[:, 0] + generator.normal(0, 0.01, 3000)])
    block = read_block(reconstruction(np.array([[0.0, 0, ABOVE]] * 2), np.c_[xy, slope * xy[:, 0]]), level=False)
    outline = shapely.get_coordinates(footprints(block, ground)[0])
    tangent = WIDTH / 2 / FOCAL
    up, down = ABOVE * tangent / (1 + slope * tangent), -ABOVE * tangent / (1 - slope * tangent)
    assert outline[:, 0].max() == pytest.approx(up, abs=0.2)
    assert outline[:, 0].min() == pytest.approx(down, abs=0.2)
    np.testing.assert_allclose(ground.above(block.position), ABOVE, atol=0.05)


def test_a_few_stray_points_do_not_move_the_ground():
    points = flat_ground(flight())
    points[::29, 2] = np.random.default_rng(2).uniform(-40, 40, len(points[::29]))
    assert np.abs(fit_ground(points).above(flight()) - ABOVE).max() < 0.5


def test_a_view_of_the_horizon_ends_at_twice_the_distance_of_its_far_points():
    tilt = np.radians(60)  # the frame's upper border looks over the horizon
    ahead = np.array([0, np.sin(tilt), -np.cos(tilt)])
    right = np.array([1.0, 0, 0])
    rotation = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    points = np.c_[np.random.default_rng(4).uniform((-60, 20), (60, 180), (2000, 2)), np.zeros(2000)]
    position = np.array([[0.0, 0, 40], [5, 0, 40]])
    found = measure(findings(position, reconstruction=reconstruction(position, points, rotation)))
    for outline, place in zip(found.footprints, position, strict=True):
        seen = np.linalg.norm(found.block.points[:, :2] - place[:2], axis=1)
        reach = np.linalg.norm(shapely.get_coordinates(outline) - place[:2], axis=1).max()
        assert seen.max() < reach < 2.1 * np.hypot(seen.max(), 40)


def test_a_photograph_that_sees_no_ground_has_no_footprint():
    model = reconstruction(flight(), flat_ground(flight()))
    sky = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), -np.array([20.0, 20, ABOVE]))
    model.add_image_with_trivial_frame(pycolmap.Image("sky.JPG", np.zeros((0, 2)), 1, 500), sky)
    found = findings(reconstruction=model)
    everyone = (*found.survey.photographs, replace(photograph(500, None), name="sky.JPG"))
    found = measure(replace(found, survey=replace(found.survey, photographs=everyone)))
    lost = found.block.names.index("sky.JPG")
    assert found.footprints[lost].is_empty
    assert np.isnan(found.gsd[lost])
    assert np.isnan(found.mean_px[lost])


def test_a_model_in_any_frame_and_unit_has_the_same_shares_and_angles(flat):
    turned = reconstruction(flight(), flat_ground(flight()))
    axis = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    axis *= np.linalg.det(axis)
    turned.transform(pycolmap.Sim3d(0.1, pycolmap.Rotation3d(axis), np.array([5.0, -3, 2])))
    found = measure(findings(reconstruction=turned, georeference=located(None)))
    np.testing.assert_allclose(found.gsd, 0.1 * GSD, rtol=1e-6)
    np.testing.assert_allclose(found.height, 0.1 * ABOVE, rtol=1e-4)
    np.testing.assert_allclose(found.forward_overlap, flat.forward_overlap, atol=2e-3)
    assert found.coverage.area(1) == pytest.approx(0.01 * flat.coverage.area(1), rel=0.01)


def test_the_order_of_the_flight_is_of_time_and_of_names_where_times_are_missing():
    position = flight(1, 4)
    read = [photograph(i, place) for i, place in enumerate(position)]
    read[0] = replace(read[0], time_s=2e9)
    by_time = measure(findings(position, survey=Survey(read[0].path, tuple(read), None)))
    assert by_time.order.tolist() == [1, 2, 3, 0]
    read[0] = replace(read[0], time_s=float("nan"))
    by_name = measure(findings(position, survey=Survey(read[0].path, tuple(read), None)))
    assert by_name.order.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("of", ["drones", "rig"])
def test_what_is_flown_at_once_are_two_flights(of):
    """Two drones on fields side by side, and two cameras of a rig, which take turns by a second."""
    one = flight()
    position = np.concatenate([one, one + (np.array([0, 3 * ASIDE, 0]) if of == "drones" else np.array([0.2, 0, 0]))])
    read = [photograph(i, place) for i, place in enumerate(position)]
    read[18:] = [replace(p, serial="second", time_s=read[i].time_s + 1) for i, p in enumerate(read[18:])]
    found = measure(findings(position, survey=Survey(read[0].path, tuple(read), None)))
    assert [own.tolist() for own in found.flights] == [[*range(18)], [*range(18, 36)]]
    np.testing.assert_allclose(found.forward_overlap, 1 - AHEAD / FOOTPRINT[0], atol=0.01)
    np.testing.assert_allclose(found.side_overlap, 1 - ASIDE / FOOTPRINT[1], atol=0.01)


def test_folders_of_one_card_are_one_flight():
    names = [f"{100 + i // 4}MEDIA/{i:02d}.JPG" for i in range(12)]
    found = measure(findings(flight(2, 6), names))
    assert [own.tolist() for own in found.flights] == [[*range(12)]]


def test_a_folder_continues_the_flight_of_its_own_drone():
    """Of two drones at once, the cards of both get a new folder on the way."""
    names = [f"{drone}/{100 + i // 3}MEDIA/{i}.JPG" for drone in "ab" for i in range(6)]
    read = findings(flight(2, 6), names).survey.photographs
    read = [replace(p, serial=p.name[0], time_s=10.0 * (i % 6) + 5 * (i // 6)) for i, p in enumerate(read)]
    assert [own.tolist() for own in find_flights(read)] == [[*range(6)], [*range(6, 12)]]


def test_a_block_is_read_in_little_more_memory_than_it_has():
    position = flight(4, 10)
    model = reconstruction(position, flat_ground(position, a_photograph=200))
    read_block(model, level=False)
    tracemalloc.start()
    try:
        block = read_block(model, level=False)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2.5 * sum(values.nbytes for values in vars(block).values() if isinstance(values, np.ndarray))


def test_the_originals_resolution_counts_their_own_pixels(flat):
    table = numbers(findings(), flat)["tidefield"]
    assert table["resolution"]["gsd"]["mean"] == pytest.approx(GSD)
    assert table["resolution"]["gsd_of_originals"]["mean"] == pytest.approx(GSD / 2)
    assert table["cameras"][0]["prior_focal_px"] == pytest.approx(FOCAL)
    assert table["cameras"][0]["corner_distortion_px"] == pytest.approx(0, abs=1e-9)


def test_an_empty_model_is_an_error_of_the_survey():
    with pytest.raises(SurveyError, match="0 photographs and 0 points"):
        measure(findings(reconstruction=pycolmap.Reconstruction()))


def test_grid_lines_cross_the_edges_where_the_coordinate_has_their_value():
    low, high = np.array([-100.0, -80]), np.array([140.0, 120])
    turn = np.radians(2)
    crs = np.array([[np.cos(turn), -np.sin(turn), 512_345], [np.sin(turn), np.cos(turn), 6_040_007]])
    found = affine(low, high, lambda xyz: np.c_[xyz[:, :2] @ crs[:, :2].T + crs[:, 2], xyz[:, 2]])
    np.testing.assert_allclose(found, crs, rtol=1e-9)
    for axis in (0, 1):
        values, digits = coordinates(found, low, high, axis, 6)
        assert 4 <= len(values) <= 8
        assert digits == 0
        assert set(values % np.diff(values)[0]) == {0}
        for edge in (low[1 - axis], high[1 - axis]):
            place = np.full((len(values), 3), [edge, edge, 1.0])
            place[:, axis] = crossings(found, axis, values, edge)
            np.testing.assert_allclose(place @ crs[axis], values, atol=1e-6)
    values, digits = coordinates(np.array([[1.5e-5, 0, -0.0004], [0, 9e-6, 54.51]]), low, high, 0, 4)
    assert digits == 3
    np.testing.assert_allclose(np.diff(values), 0.001)
