"""GPS alignment and the adjustment to differential positions, with right and wrong positions."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from located_surveys import (
    CONTROL,
    FOCAL,
    FRAME,
    HEIGHT,
    WIDTH,
    Flight,
    fly,
    ground_m,
    located,
    name_of,
    photograph,
    photographed,
    quiet,
    with_control,
)
from scipy.spatial.transform import Rotation

from tidefield.data.georeference import Georeference
from tidefield.errors import SurveyError
from tidefield.survey.georeference import bundle_adjustment
from tidefield.survey.georeference.georeference import georeference
from tidefield.survey.georeference.gps_alignment import camera_centres, find_down, given_positions
from tidefield.survey.io.positions import read_gps_file
from tidefield.survey.io.text_files import PhotographNames
from tidefield.survey.survey import Survey


def moved(survey: Survey, changes: dict[str, dict]) -> Survey:
    """Change the positions of some photographs; None removes one."""
    photographs = [
        replace(p, position=changes[p.name] and replace(p.position, **changes[p.name])) if p.name in changes else p
        for p in survey.photographs
    ]
    return replace(survey, photographs=tuple(photographs))


def all_moved(survey: Survey, change) -> Survey:
    return moved(survey, {p.name: change(p.position) for p in survey.photographs})


def off_m(flight, model, frame) -> np.ndarray:
    """Compute the errors of the camera positions by way of longitude and latitude."""
    centres = camera_centres(model)
    names = sorted(centres)
    truth = frame.from_geographic(FRAME.to_geographic(flight.centres_world))
    order = [int(name.split()[-1][:3]) for name in names]
    return np.array([centres[name] for name in names]) - truth[order]


def test_exact_positions_give_an_exact_model():
    flight = fly(noise_px=0.0)
    model, found = located(flight)
    assert found.source == "GPS"
    assert found.frame is not None
    assert found.frame.epsg == 32630
    assert found.frame.vertical_datum.startswith("mean sea level")
    assert np.abs(off_m(flight, model, found.frame)).max() < 0.01
    assert found.gps.horizontal_rms_m < 0.01
    assert found.left_out == found.notes == ()
    np.testing.assert_allclose(found.world_from_model.scale, 25, rtol=1e-4)
    assert abs(np.median([point.xyz[2] for point in model.points3D.values()])) < 1.0, "the origin is on the ground"


def test_noise_of_positions_averages_out():
    flight = fly(lines=4, each=8, position_m=2.0)
    model, found = located(flight)
    off = off_m(flight, model, found.frame)
    assert np.sqrt((off**2).mean()) < 1.0
    assert found.gps_used.horizontal_rms_m == pytest.approx(2.0 * math.sqrt(2), rel=0.25)
    assert found.gps_used.vertical_rms_m == pytest.approx(2.0, rel=0.35)


@pytest.mark.parametrize("degrees", [1.0, 0.0005])
def test_a_gross_error_is_reported_and_not_used(degrees):
    flight = fly(position_m=1.0)
    name = name_of(7)
    survey = moved(flight.survey, {name: {"latitude_deg": 54.51 + degrees}})
    model, found = located(flight, survey)
    assert [(item.kind, item.name) for item in found.left_out] == [("GPS", name)]
    assert ("km" if degrees == 1 else " m") in found.left_out[0].reason
    assert np.abs(off_m(flight, model, found.frame)).max() < 3.0
    assert name in found.gps.names
    assert name not in found.gps_used.names


def test_a_third_of_the_positions_may_be_wrong():
    flight = fly(lines=4, each=6, position_m=1.0)
    generator = np.random.default_rng(0)
    wrong = [name_of(i) for i in (0, 3, 4, 9, 13, 15, 20, 23)]
    survey = moved(flight.survey, {n: {"latitude_deg": 54.51 + generator.uniform(0.002, 0.01)} for n in wrong})
    model, found = located(flight, survey)
    assert sorted(item.name for item in found.left_out) == wrong
    assert np.abs(off_m(flight, model, found.frame)).max() < 3.0


def test_stated_accuracy_is_the_weight_of_a_position():
    flight = fly(lines=3, each=6, position_m=0.01)
    generator = np.random.default_rng(5)
    states = {}
    for i, each in enumerate(flight.survey.photographs):
        poor = i % 2 == 0
        north = each.position.latitude_deg + (generator.normal(0, 4) + 3 if poor else 0) / 111_000
        states[each.name] = {"latitude_deg": north, "horizontal_m": 4.0 if poor else 0.02, "vertical_m": 0.04}
    model, found = located(flight, moved(flight.survey, states))
    assert np.abs(off_m(flight, model, found.frame)).max() < 0.1


def partly_differential(flight, differential, common_m: float, noise_m: float) -> Survey:
    """State accuracies of some positions, and move the others east by a common error, and each by one of its own."""
    generator = np.random.default_rng(3)
    states = {}
    for i, each in enumerate(flight.survey.photographs):
        east, north, up = generator.normal((common_m, 0, 0), noise_m)
        at = each.position
        states[each.name] = (
            {"horizontal_m": 0.02, "vertical_m": 0.03}
            if differential(i)
            else {
                "longitude_deg": at.longitude_deg + east / 64_500,
                "latitude_deg": at.latitude_deg + north / 111_000,
                "height_m": at.height_m + up,
            }
        )
    return moved(flight.survey, states)


@pytest.mark.parametrize("noise_m", [0.1, 2.0])
def test_differential_positions_outweigh_a_majority_of_unknown_accuracy(noise_m):
    flight = fly(lines=5, each=6, position_m=0.01)
    survey = partly_differential(flight, lambda i: i % 5 < 2, common_m=2.0, noise_m=noise_m)
    model, found = located(flight, survey)
    assert found.left_out == ()
    assert np.abs(off_m(flight, model, found.frame)).max() < 0.1


def test_differential_positions_at_one_place_do_not_hide_gross_errors_of_the_others():
    generator = np.random.default_rng(2)
    x, y = np.meshgrid(np.arange(-2, 3) * 15.0, np.arange(-2, 3) * 25.0)
    centres = np.c_[x.ravel(), y.ravel(), 75 + generator.normal(0, 1.5, 25)]
    centres = np.concatenate([centres[:1] + generator.normal(0, 0.02, (8, 3)), centres])  # hovering, then flying
    ground = generator.uniform((-75, -85), (75, 85), (450, 2))
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2], camera_id=1
    )
    down = np.broadcast_to(np.diag([1.0, -1, -1]), (len(centres), 3, 3))
    model = photographed(camera, down, centres, np.c_[ground, ground_m(ground)], 0.3, generator)
    given = centres + generator.normal(0, 0.02, centres.shape)
    photographs = tuple(map(photograph, range(len(centres)), FRAME.to_geographic(given)))
    flight = Flight(model, Survey(Path("."), photographs, None), centres)
    survey = partly_differential(flight, lambda i: i < 8, common_m=0.0, noise_m=0.5)
    wrong = {name_of(i): {"latitude_deg": 54.51 + 0.0005 * i} for i in (12, 20, 28)}
    model, found = located(flight, moved(survey, wrong))
    assert [item.name for item in found.left_out] == list(wrong)
    assert np.abs(off_m(flight, model, found.frame)).max() < 1.0


def test_a_single_strip_is_levelled_by_its_photographs():
    flight = fly(lines=1, each=12, position_m=1.0)
    model, found = located(flight)
    assert any("vertical" in note and "mean viewing direction" in note for note in found.notes)
    down = find_down(model, flight.survey.photographs).direction_model
    assert down[2] < -math.cos(math.radians(4))
    assert np.abs(off_m(flight, model, found.frame)).max() < 4.0


def test_a_single_strip_is_levelled_by_gimbal_angles_if_given():
    flight = fly(lines=1, each=12, position_m=1.0)
    gimbals = []
    for i, each in enumerate(flight.survey.photographs):
        R = flight.model.image(i + 1).cam_from_world().rotation.matrix()
        pitch = math.degrees(math.asin(R[2, 2]))
        roll = math.degrees(math.atan2(-R[0, 2], -R[1, 2]))
        gimbals.append(replace(each, gimbal_deg=(0.0, pitch, roll)))
    model, found = located(flight, replace(flight.survey, photographs=tuple(gimbals)))
    assert any("gimbal" in note for note in found.notes)
    down = np.array([model.image(i + 1).cam_from_world().rotation.matrix()[2] for i in range(12)])
    truth = np.array([flight.model.image(i + 1).cam_from_world().rotation.matrix()[2] for i in range(12)])
    assert np.abs(down[:, 2] - truth[:, 2]).max() < 0.01


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0.0, 0.0), (12.0, 0.0), (0.0, 8.0), (-6.0, -20.0), (35.0, 10.0)])
def test_the_vertical_of_a_drone_without_a_gimbal_is_that_of_its_angles(tmp_path, pitch_deg, roll_deg):
    """One line, flown with a bank: camera axes right, down, forward are the drone's right, back, down."""
    flight, lines = fly(lines=1, each=12), ["EPSG:4326"]
    for i in range(12):
        body = Rotation.from_euler("ZYX", (20.0 * i, pitch_deg + 0.1 * i, roll_deg - 0.1 * i), degrees=True)
        camera_ned = body.as_matrix() @ [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
        R = camera_ned.T @ [[0, 1, 0], [1, 0, 0], [0, 0, -1]]  # from east, north and up
        frame = flight.model.frames[flight.model.image(i + 1).frame_id]
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ flight.centres_world[i])
        yaw, pitch, roll = body.as_euler("ZYX", degrees=True)
        lines.append(f"{name_of(i)} -2.75 54.5 300 {yaw} {pitch} {roll}")
    (tmp_path / "geo.txt").write_text("\n".join(lines))
    records, _ = read_gps_file(tmp_path / "geo.txt", PhotographNames(map(name_of, range(12))))
    photographs = [replace(p, gimbal_deg=records[p.name].gimbal_deg) for p in flight.survey.photographs]
    down = find_down(flight.model, photographs)
    assert "gimbal" in down.source
    np.testing.assert_allclose(down.direction_model, (0, 0, -1), atol=1e-6)


def looking(forward: np.ndarray, centres: np.ndarray, points: np.ndarray, position_m: float) -> Flight:
    """Photographs held level that look in these directions, without gimbal angles."""
    generator = np.random.default_rng(4)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotations = np.stack([right, np.cross(forward, right), forward], axis=2)
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2], camera_id=1
    )
    model = photographed(camera, rotations, centres, points, 0.3, generator)
    places = FRAME.to_geographic(centres + position_m * generator.normal(0, 1, centres.shape))
    return Flight(model, Survey(Path("."), tuple(map(photograph, range(len(places)), places)), None), centres)


@pytest.mark.parametrize("pitch_deg", [-80.0, -30.0, 0.0, 5.0, 35.0])
def test_photographs_around_a_tree_do_not_turn_it_over(pitch_deg):
    around, pitch = np.linspace(0, 2 * np.pi, 16, endpoint=False), math.radians(pitch_deg)
    out = np.c_[np.cos(around), np.sin(around), np.zeros(16)]
    forward = np.array([0, 0, math.sin(pitch)]) - math.cos(pitch) * out
    tree = np.random.default_rng(1).uniform((-3, -3, -14), (3, 3, 14), (900, 3))
    flight = looking(forward, 12 * out, tree, position_m=0.5)
    assert find_down(flight.model, flight.survey.photographs).direction_model[2] < -0.99
    model, found = located(flight)
    assert np.abs(off_m(flight, model, found.frame)).max() < 1.0


def wall(rows: int, position_m: float, pitch_deg: float = 2.0) -> Flight:
    """Parallel photographs of a wall, looking north and slightly upwards."""
    generator, pitch = np.random.default_rng(1), math.radians(pitch_deg)
    x, z = np.meshgrid(np.arange(8) * 4.0, np.arange(rows) * 4.0)
    centres = np.c_[x.ravel(), np.zeros(x.size), z.ravel()]
    forward = np.tile([0.0, math.cos(pitch), math.sin(pitch)], (x.size, 1))
    return looking(forward, centres, generator.uniform((-8, 8, -8), (36, 11, 24), (900, 3)), position_m)


@pytest.mark.parametrize("position_m", [0.05, 1.0])
def test_positions_in_front_of_a_wall_determine_its_vertical(position_m):
    flight = wall(4, position_m)
    model, found = located(flight)
    assert np.abs(off_m(flight, model, found.frame)).max() < 0.1 + 1.5 * position_m
    assert any("alone, to within about" in note and "not look straight down" in note for note in found.notes) == (
        position_m == 1.0
    )


def test_what_the_vertical_of_parallel_photographs_assumes_is_noted():
    _, found = located(wall(1, 0.5))
    assert any("as if the photographs looked straight down" in note for note in found.notes)


def test_missing_heights_are_relative_altitudes_or_level_flight():
    flight = fly(lines=3, each=6, position_m=0.5)
    without = all_moved(flight.survey, lambda position: {"height_m": math.nan})
    model, found = located(flight, without)
    assert "mean height of flight" in found.frame.vertical_datum
    heights = np.array([centre[2] for centre in camera_centres(model).values()])
    assert abs(heights.mean() - found.frame.height_m * -1) < 5
    assert np.isnan(found.gps.error_m[:, 2]).all(), "heights that were not given have no errors"
    assert found.gps_used.known_in_plan.all()
    assert found.gps_used.horizontal_rms_m < 2.0
    above = tuple(
        replace(p, relative_altitude_m=float(flight.centres_world[i, 2])) for i, p in enumerate(without.photographs)
    )
    model, found = located(flight, replace(without, photographs=above))
    assert found.frame.vertical_datum == "the place of take-off"
    assert found.gps_used.vertical_rms_m < 1.0


@pytest.mark.parametrize("of", ["heights", "relative altitudes"])
def test_a_few_heights_do_not_put_the_other_positions_aside(of):
    flight = fly(lines=3, each=6, position_m=0.5)
    without = moved(flight.survey, {name_of(i): {"height_m": math.nan} for i in range(3 if of == "heights" else 0, 18)})
    if of != "heights":
        above = [replace(p, relative_altitude_m=75.0) if i < 3 else p for i, p in enumerate(without.photographs)]
        without = replace(without, photographs=tuple(above))
    without = all_moved(without, lambda position: {"vertical_m": 0.03})
    assert np.isnan(given_positions(without.photographs).stated_m).all(), "the heights are not the receiver's"
    model, found = located(flight, without)
    assert "Only 3 of 18 positions have a height" in found.notes[0]
    assert len(found.gps.names) == 18
    assert "mean height of flight" in found.frame.vertical_datum
    assert np.abs(off_m(flight, model, found.frame)[:, :2]).max() < 1.5


def test_positions_without_the_height_that_most_have_are_not_used_and_counted():
    flight = fly(lines=3, each=6, position_m=0.5)
    model, found = located(flight, moved(flight.survey, {name_of(i): {"height_m": math.nan} for i in range(9)}))
    assert found.gps.names == tuple(name_of(i) for i in range(9, 18))
    assert found.frame.vertical_datum.startswith("mean sea level")
    assert "9 of 18 positions are not used" in found.notes[0]
    assert np.abs(off_m(flight, model, found.frame)).max() < 3.0


def over_two_zeros(survey: Survey, first: int, **accuracies: float) -> Survey:
    """Survey whose photographs from the first one on have positions of a file, 20 m higher."""
    return moved(
        survey,
        {
            p.name: {"height_m": p.position.height_m + 20, "datum": "unknown", "source": "ppk.csv", **accuracies}
            for p in survey.photographs[first:]
        },
    )


@pytest.mark.parametrize(
    ("first", "accuracies", "kept"),
    [
        (8, {}, range(8, 20)),
        (12, {}, range(12)),
        (12, {"horizontal_m": 0.02, "vertical_m": 0.03}, range(12, 20)),
    ],
)
def test_heights_over_another_zero_do_not_tilt_the_model(first, accuracies, kept):
    flight = fly(lines=4, each=5, noise_px=0.1)
    model, found = located(flight, over_two_zeros(flight.survey, first, **accuracies))
    assert found.gps.names == tuple(map(name_of, kept))
    assert f"{20 - len(kept)} of 20 positions are not used: their heights are over" in found.notes[0]
    assert "an unknown datum (ppk.csv)" in found.notes[0]
    assert found.frame.vertical_datum.startswith("unknown" if kept[0] else "mean sea level")
    off = off_m(flight, model, found.frame)[:, 2]
    spread_m = np.ptp(flight.centres_world[:, 1])
    assert np.ptp(off) < math.tan(math.radians(0.1)) * spread_m, "the model is tilted"


def test_a_few_differential_positions_on_one_line_do_not_push_out_the_others():
    survey = fly(lines=5, each=9).survey
    fixed = {"datum": "ellipsoid", "horizontal_m": 0.02, "vertical_m": 0.03}
    given = given_positions(moved(survey, {p.name: fixed for p in survey.photographs[:9]}).photographs)
    assert given.names == tuple(map(name_of, range(9, 45)))
    given = given_positions(moved(survey, {p.name: fixed for p in survey.photographs[:27]}).photographs)
    assert given.names == tuple(map(name_of, range(27)))
    given = given_positions(moved(survey, {p.name: fixed for p in survey.photographs[::5]}).photographs)
    assert given.names == tuple(map(name_of, range(0, 45, 5)))


def test_differential_positions_along_a_single_line_go_before_many_others_along_it():
    """Across the line, positions differ by their receivers' errors: less where these are differential."""
    generator = np.random.default_rng(0)
    survey = fly(lines=1, each=40).survey
    plain = {
        p.name: {"latitude_deg": p.position.latitude_deg + generator.normal(0, 1.5) / 111_000}
        for p in survey.photographs
        if p.position is not None
    }
    fixed = {"datum": "ellipsoid", "horizontal_m": 0.02, "vertical_m": 0.03}
    along = {name_of(i): fixed for i in range(0, 40, 3)}
    assert given_positions(moved(survey, plain | along).photographs).names == tuple(along)
    hovering = {name_of(i): {**fixed, "longitude_deg": -2.75} for i in range(8)}
    given = given_positions(moved(survey, plain | hovering).photographs)
    assert given.names == tuple(map(name_of, range(8, 40))), "one place says nothing of scale and heading"


def test_the_ellipsoid_is_one_zero_whoever_names_it():
    flight = fly()
    sources = ("EXIF, RTK fixed", "EXIF, RTK float", "XMP", "gps.csv")
    survey = moved(
        flight.survey,
        {p.name: {"datum": "ellipsoid", "source": sources[i % 4]} for i, p in enumerate(flight.survey.photographs)},
    )
    given = given_positions(survey.photographs)
    assert (len(given.names), given.notes) == (15, ())


def test_two_heights_over_each_of_two_zeros_are_too_few():
    survey = over_two_zeros(fly(lines=1, each=4).survey, 2)
    given = given_positions(survey.photographs)
    assert len(given.names) == 4
    assert "Only 2 of 4 positions have a height over one vertical datum" in given.notes[0]


@pytest.mark.parametrize(("slope_deg", "noted"), [(1.0, False), (3.0, True)])
def test_positions_that_contradict_the_gimbals_are_noted(slope_deg, noted):
    flight = fly(lines=4, each=5)
    rise_m = math.tan(math.radians(slope_deg)) * flight.centres_world[:, 1]
    heights_m = [p.position.height_m + rise for p, rise in zip(flight.survey.photographs, rise_m, strict=True)]
    survey = moved(flight.survey, {name_of(i): {"height_m": height_m} for i, height_m in enumerate(heights_m)})
    gimbals = []
    for i, each in enumerate(survey.photographs):
        R = flight.model.image(i + 1).cam_from_world().rotation.matrix()
        pitch, roll = math.degrees(math.asin(R[2, 2])), math.degrees(math.atan2(-R[0, 2], -R[1, 2]))
        gimbals.append(replace(each, gimbal_deg=(0.0, pitch, roll)))
    _, found = located(flight, replace(survey, photographs=tuple(gimbals)))
    assert any("degrees off that of the gimbals" in note for note in found.notes) == noted


@pytest.mark.parametrize("left", [0, 2])
def test_without_positions_the_model_is_only_levelled(left):
    flight = fly()
    survey = moved(flight.survey, {name_of(i): None for i in range(left, 15)})
    model, found = located(flight, survey)
    assert (found.source, found.frame) == ("none", None)
    assert "not georeferenced" in found.notes[0]
    assert found.world_from_model.scale == 1
    forward = np.mean([model.image(i + 1).cam_from_world().rotation.matrix()[2] for i in range(15)], axis=0)
    assert forward[2] < -0.99
    assert np.abs(np.median([point.xyz for point in model.points3D.values()], axis=0)).max() < 0.5


def test_identical_positions_give_no_georeference():
    flight = fly()
    _, found = located(flight, all_moved(flight.survey, lambda p: {"latitude_deg": 54.5, "longitude_deg": -2.75}))
    assert found.source == "none"
    assert "do not follow" in found.notes[0]


def test_a_scene_without_georeference_has_all_reasons_in_its_first_note():
    survey = over_two_zeros(all_moved(fly().survey, lambda p: {"latitude_deg": 54.5, "longitude_deg": -2.75}), 10)
    _, found = located(fly(), survey)
    assert found.notes[0].startswith("5 of 15 positions are not used: their heights are over")
    assert "15 photographs have positions, and they do not follow the photographs" in found.notes[0]
    assert "another file with --gps" in found.notes[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: {"latitude_deg": p.longitude_deg, "longitude_deg": p.latitude_deg}, "are swapped"),
        (lambda p: {"longitude_deg": -p.longitude_deg}, "sign of one of the two"),
        (lambda p: {"latitude_deg": -p.latitude_deg}, "sign of one of the two"),
    ],
)
def test_mirrored_positions_are_an_error_that_names_the_mistake(change, words):
    flight = fly(lines=4, position_m=1.0)
    with pytest.raises(SurveyError, match=words):
        located(flight, all_moved(flight.survey, change))


def test_positions_across_the_date_line():
    flight = fly(noise_px=0.0)
    east = 180.0 - flight.survey.photographs[7].position.longitude_deg
    survey = all_moved(
        flight.survey,
        lambda p: {"longitude_deg": (p.longitude_deg + east + 180) % 360 - 180},
    )
    assert len({p.position.longitude_deg > 0 for p in survey.photographs}) == 2
    _, found = located(flight, survey)
    assert found.frame.epsg in (32601, 32660)
    assert found.gps.horizontal_rms_m < 0.05


def differential(survey: Survey) -> Survey:
    return all_moved(survey, lambda position: {"horizontal_m": 0.015, "vertical_m": 0.025})


@pytest.fixture(scope="module")
def bowl():
    """A survey bent by the wrong lens distortion, with positions accurate to 2 cm."""
    lens = [FOCAL, FOCAL, WIDTH / 2 - 4, HEIGHT / 2 + 6, -0.03, 0.01, 0.002, -0.001]
    camera = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=lens, camera_id=1)
    true = fly(lines=4, each=7, position_m=0.015, camera=camera)
    model = pycolmap.Reconstruction(true.model)
    model.cameras[1].model = pycolmap.CameraModelId.SIMPLE_RADIAL
    model.cameras[1].params = [FOCAL, WIDTH / 2, HEIGHT / 2, 0.02]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_focal_length = options.refine_extra_params = False
    pycolmap.bundle_adjustment(model, options)
    return replace(true, model=model), true.model


def ground_off_m(truth, model, frame) -> np.ndarray:
    numbers = sorted(truth.points3D)
    there = frame.from_geographic(FRAME.to_geographic(np.array([truth.points3D[k].xyz for k in numbers])))
    return np.array([model.points3D[k].xyz for k in numbers]) - there


def test_differential_positions_remove_the_bend(bowl):
    flight, truth = bowl
    model, found = located(flight)
    bent = ground_off_m(truth, model, found.frame)
    assert found.notes == ()
    model, found = located(flight, differential(flight.survey))
    straight = ground_off_m(truth, model, found.frame)
    assert "adjusted to their differential positions" in found.notes[0]
    assert found.gps.horizontal_rms_m < 0.05
    assert np.median(np.abs(straight[:, 2])) < 0.15
    assert np.median(np.abs(straight[:, 2])) < 0.4 * np.median(np.abs(bent[:, 2]))
    assert model.cameras[1].params[0] == pytest.approx(FOCAL), "positions at one height do not determine it"


def test_a_differential_position_worse_than_stated_is_rejected(bowl):
    flight, _ = bowl
    survey = differential(flight.survey)
    place = next(p.position for p in survey.photographs if p.name == name_of(9))
    _, found = located(flight, moved(survey, {name_of(9): {"height_m": place.height_m + 1.2}}))
    assert any(name_of(9) in note and "worse than they state" in note for note in found.notes)
    assert found.gps.horizontal_rms_m < 0.05
    others = [i for i, name in enumerate(found.gps.names) if name != name_of(9)]
    assert np.abs(found.gps.error_m[others]).max() < 0.1


def test_differential_positions_and_ground_control_combine(bowl):
    flight, truth = bowl
    survey = replace(
        differential(flight.survey), control=with_control(replace(flight, model=truth), CONTROL[:3]).control
    )
    model, found = located(flight, survey)
    assert found.source == "ground control"
    assert "differential" in found.notes[0]
    numbers = sorted(truth.points3D)
    there = found.frame.from_crs(FRAME.to_crs(np.array([truth.points3D[k].xyz for k in numbers])))
    assert np.median(np.abs(np.array([model.points3D[k].xyz for k in numbers]) - there)[:, 2]) < 0.15


def test_a_long_model_that_bends_is_held_by_the_positions_of_ordinary_receivers(monkeypatch):
    flight = fly(lines=2, each=40, noise_px=1.5, position_m=0.5)
    bent = pycolmap.Reconstruction(flight.model)
    bundle_adjustment.solve(bent, bundle_adjustment.all_images(bent), refine_extra_params=False)
    errors = {}
    for many in (10_000, 10):
        monkeypatch.setattr(bundle_adjustment, "MANY", many)
        model = pycolmap.Reconstruction(bent)
        found = georeference(model, flight.survey, quiet)
        assert any("held by the positions" in note for note in found.notes) == (many == 10)
        centres = camera_centres(model)
        off = np.array([centres[p.name] for p in flight.survey.photographs]) - flight.centres_world
        errors[many] = float(np.std(off[:, 2]))
    assert errors[10] < 0.8 * errors[10_000], errors


def test_positions_of_ordinary_receivers_correct_the_distortion_that_bows_a_large_model(monkeypatch):
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2, 0.0], camera_id=1
    )
    flight = fly(lines=8, each=16, position_m=0.5, camera=camera)
    bowed = pycolmap.Reconstruction(flight.model)
    bowed.cameras[1].params = [FOCAL, WIDTH / 2, HEIGHT / 2, -0.005]
    only_poses = {"refine_extra_params": False, "refine_principal_point": False}
    bundle_adjustment.solve(bowed, bundle_adjustment.all_images(bowed), **only_poses)
    monkeypatch.setattr(bundle_adjustment, "MANY", 100)
    georeference(bowed, flight.survey, quiet)
    centres = camera_centres(bowed)
    off = np.array([centres[p.name] for p in flight.survey.photographs]) - flight.centres_world
    assert np.std(off[:, 2]) < 0.2
    assert bowed.cameras[1].params == pytest.approx([FOCAL, WIDTH / 2, HEIGHT / 2, 0.0], abs=1e-3)


def off_truth(flight: Flight, survey: Survey) -> tuple[np.ndarray, Georeference]:
    """How far cameras are from where they were, after georeferencing."""
    model, found = located(flight, survey)
    assert found.frame is not None
    centres, truth = camera_centres(model), found.frame.from_crs(FRAME.to_crs(flight.centres_world))
    return np.array([centres[name_of(i)] for i in range(len(truth))]) - truth, found


@pytest.mark.thorough
def test_control_in_one_corner_does_not_turn_what_differential_positions_have_placed():
    flight = fly(lines=4, each=20, position_m=0.015)
    corner = np.array([[-140.0, -30], [-121, -28], [-139, -11], [-122, -9]])
    control, generator = with_control(flight, corner).control, np.random.default_rng(3)
    assert control is not None
    noisy = {name: tuple(np.array(xyz) + 0.02 * generator.normal(size=3)) for name, xyz in control.points.items()}
    survey = replace(flight.survey, control=replace(control, points=noisy))
    off, found = off_truth(flight, survey)
    assert np.abs(off[:, 2]).max() > 0.3, "control alone turns the survey"
    off, found = off_truth(flight, differential(survey))
    assert np.abs(off[:, :2]).max() < 0.03
    assert np.abs(off[:, 2]).max() < 0.06
    assert found.source == "ground control"
    assert "keeps the shape that the positions gave it" in found.notes[-1]
    assert found.check.names == ("G1", "G2", "G3", "G4")
    assert found.check.rms_m > found.control.rms_m
    assert len(found.control_world) == 4


@pytest.mark.thorough
def test_a_wrong_point_neither_moves_nor_reshapes_what_differential_positions_have_placed():
    flight = fly(lines=4, each=7, position_m=0.015)
    control = with_control(flight, CONTROL[:4]).control
    assert control is not None
    x, y, z = control.points["G2"]
    survey = replace(flight.survey, control=replace(control, points={**control.points, "G2": (x + 1.0, y, z)}))
    off, found = off_truth(flight, differential(survey))
    assert any(item.name.startswith("G2") for item in found.left_out)
    assert np.abs(off).max() < 0.1
    assert np.abs(off.mean(0)).max() < 0.05
