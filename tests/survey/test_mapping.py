"""A lens gets the terms of distortion that it has, and none that would make the model curved."""

from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pycolmap
import pytest
from located_surveys import FOCAL, HEIGHT, WIDTH, Flight, fly, quiet

from tidefield.errors import RunError
from tidefield.survey.georeference.bundle_adjustment import adjustment_options, all_images, solve
from tidefield.survey.sfm.mapping import (
    MIN_SPREAD_DEG,
    TERMS,
    Heights,
    LensChoice,
    LensTrial,
    _compare_heights,
    best_of,
    choose_lens,
    find_models,
    large_enough,
    lens_notes,
    reconstruct,
    registered_names,
)
from tidefield.survey.sfm.model_files import write_model
from tidefield.survey.survey import LensPrior


def camera(k1: float, k2: float, p1: float = 0.0, p2: float = 0.0) -> pycolmap.Camera:
    params = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, k1, k2, p1, p2]
    return pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=params, camera_id=1)


@pytest.mark.parametrize(
    ("own", "lens"),
    [
        (camera(-0.08, 0.0), "SIMPLE_RADIAL"),
        (camera(-0.25, 0.2), "RADIAL"),
        (camera(-0.25, 0.2, 0.004, -0.003), "OPENCV"),
    ],
)
def test_the_terms_that_a_lens_has_are_found(own: pycolmap.Camera, lens: str):
    flight = fly(camera=own, noise_px=0.2)
    model = pycolmap.Reconstruction(flight.model)
    choice = choose_lens(model, flight.survey.photographs, True, quiet)
    trials = choice.trials
    assert not choice.freed
    assert [trial.lens for trial in trials if trial is not trials[-1]] == [name for name in TERMS if name != lens]
    assert trials[-1].lens == lens
    (found,) = model.cameras.values()
    assert found.model_name == lens
    assert found.focal_length_x == FOCAL
    assert model.compute_mean_reprojection_error() < 0.3
    true = np.asarray(own.params[4:])[: TERMS[lens]]
    np.testing.assert_allclose(np.asarray(found.params)[-TERMS[lens] :], true, atol=0.02)


def test_without_enough_positions_matches_decide():
    flight = fly(camera=camera(-0.25, 0.2), noise_px=0.2)
    trials = choose_lens(pycolmap.Reconstruction(flight.model), flight.survey.photographs[:3], True, quiet).trials
    assert trials[-1].lens == "RADIAL"
    assert all(trial.off_m is None for trial in trials)


def test_a_focal_length_without_prior_is_refined():
    flight = fly(lines=4, each=6)
    model = pycolmap.Reconstruction(flight.model)
    (own,) = model.cameras.values()
    own.params = [1.1 * FOCAL, *own.params[1:]]
    choice = choose_lens(model, flight.survey.photographs, False, quiet)
    (found,) = model.cameras.values()
    assert choice.freed
    assert "heights may be wrong" in lens_notes(choice, flight.survey.photographs)[0]
    assert found.focal_length_x != pytest.approx(1.1 * FOCAL, rel=1e-3)
    assert model.compute_mean_reprojection_error() < 0.45


def test_the_note_names_the_photographs_without_a_focal_length():
    choice = LensChoice((LensTrial("RADIAL", 0.5, None, FOCAL),), known=False, freed=True, spread_deg=3.0)
    lens = LensPrior(FOCAL, None, None, "EXIF 35 mm equivalent", False)
    without = fly().survey.photographs[:4]
    assert lens_notes(choice, without)[0].startswith("The photographs do not state the focal length, and matches")
    (note,) = lens_notes(choice, [*without[:1], *(replace(one, lens=lens) for one in without[1:])])
    assert note.startswith(f"1 of 4 photographs do not state the focal length ({without[0].name}), so that it was")
    assert "leave them out" in note


@pytest.mark.parametrize(
    ("errors", "offs", "lens"),
    [
        ((0.50, 0.45, 0.40), (0.6, 0.6, 0.6), "OPENCV"),
        ((0.50, 0.45, 0.449), (0.6, 0.6, 0.6), "RADIAL"),
        ((0.50, 0.45, 0.40), (0.6, 0.7, 0.7), "SIMPLE_RADIAL"),
        ((0.50, 0.45, 0.40), (0.6, 0.7, 0.6), "OPENCV"),
        ((0.50, 0.45, 0.40), (None, None, None), "OPENCV"),
    ],
)
def test_more_terms_must_reduce_the_error_and_not_curve_the_model(errors, offs, lens):
    trials = [LensTrial(*values, FOCAL) for values in zip(TERMS, errors, offs, strict=True)]
    assert best_of(trials).lens == lens


def test_notes_explain_why_positions_ruled_out_more_terms():
    simple, radial, full = (
        LensTrial(*values, FOCAL)
        for values in (("SIMPLE_RADIAL", 0.46, 0.59), ("RADIAL", 0.43, 0.65), ("OPENCV", 0.42, 0.67))
    )
    (sentence,) = lens_notes(LensChoice((radial, full, simple), known=True, freed=False, spread_deg=3.0), ())
    assert "0.42 px instead of 0.46" in sentence
    assert "0.67 m instead of 0.59" in sentence
    assert lens_notes(LensChoice((simple, radial, full), known=True, freed=False, spread_deg=3.0), ()) == ()


def test_oblique_photographs_correct_a_wrong_focal_length():
    flight = fly(lines=4, each=6, tilt_deg=25.0, noise_px=0.2)
    model = adjusted_with(flight, 1.04 * FOCAL)
    choice = choose_lens(model, flight.survey.photographs, True, quiet)
    assert choice.spread_deg > MIN_SPREAD_DEG
    assert choice.freed
    assert model.cameras[1].focal_length_x == pytest.approx(FOCAL, rel=0.005)
    assert f"refined from {1.04 * FOCAL:.1f} to" in lens_notes(choice, flight.survey.photographs)[0]


def test_vertical_photographs_keep_the_prior_focal_length():
    flight = fly(lines=4, each=6, noise_px=0.2)
    model = adjusted_with(flight, 1.04 * FOCAL)
    choice = choose_lens(model, flight.survey.photographs, True, quiet)
    assert choice.spread_deg < MIN_SPREAD_DEG
    assert not choice.freed
    assert model.cameras[1].focal_length_x == pytest.approx(1.04 * FOCAL)


def adjusted_with(flight: Flight, focal_px: float) -> pycolmap.Reconstruction:
    """The result of structure from motion with a wrong focal length."""
    model = pycolmap.Reconstruction(flight.model)
    model.cameras[1].params = [focal_px, *model.cameras[1].params[1:]]
    options = adjustment_options()
    options.refine_principal_point = False
    pycolmap.bundle_adjustment(model, options)
    return model


@pytest.mark.thorough
@pytest.mark.parametrize(("true", "design", "used"), [(1.0, 1.04, 1.0), (1.04, 1.0, 1.0), (1.04, 1.035, 1.04)])
def test_of_two_stated_focal_lengths_the_one_with_the_drones_flight_height_is_chosen(true, design, used):
    """The stated calibration is `true` times the real focal length; the drone's own height is right."""
    flight = fly(lines=4, each=6, noise_px=0.2)
    lens = LensPrior(true * FOCAL, None, None, "DJI dewarp data", True, design * FOCAL)
    heights = [
        place[2] - float(np.median([p.xyz[2] for p in flight.model.points3D.values()]))
        for place in flight.centres_world
    ]
    photographs = [
        replace(p, lens=lens, relative_altitude_m=h) for p, h in zip(flight.survey.photographs, heights, strict=True)
    ]
    model = adjusted_with(flight, true * FOCAL)
    choice = choose_lens(model, photographs, True, quiet)
    assert model.cameras[1].focal_length_x == pytest.approx(used * FOCAL)
    if design == 1.035:
        assert choice.heights is None
    else:
        chosen = "design" if true > design else "calibrated"
        assert f"the {chosen} one was used" in lens_notes(choice, photographs)[0]
        assert choice.heights is not None
        assert choice.heights.calibrated_share == pytest.approx(true, rel=0.01)


@pytest.mark.parametrize(
    ("calibrated_share", "prefers_design", "can_tell"),
    [
        (1.0, False, True),
        (1.005, False, True),
        (1.02, True, True),
        (1.035, True, True),
        (1.10, False, False),
        (0.90, False, False),
    ],
)
def test_ground_below_the_place_of_take_off_does_not_choose_the_focal_length(
    calibrated_share: float, prefers_design: bool, can_tell: bool
):
    heights = Heights(3650.0, 3578.0, calibrated_share, calibrated_share * 3578 / 3650)
    assert (heights.prefers_design, heights.can_tell) == (prefers_design, can_tell)
    choice = LensChoice((LensTrial("RADIAL", 0.5, 0.6, 3650.0),), True, False, 3.0, heights)
    (note,) = lens_notes(choice, ())
    assert ("cannot tell which one is right" in note) == (not can_tell)
    assert f"the {'design' if prefers_design else 'calibrated'} one was used" in note
    assert Heights(1964.4, 1913.3, 1.050, 1.023).prefers_design, "as on turin_lot, whose ground is level"


def test_a_photograph_without_points_has_no_flight_height():
    flight = fly(lines=4, each=6, noise_px=0.2)
    lens = LensPrior(FOCAL, None, None, "DJI dewarp data", True, 1.04 * FOCAL)
    photographs = [replace(p, lens=lens, relative_altitude_m=75.0) for p in flight.survey.photographs]
    model = pycolmap.Reconstruction(flight.model)
    alone = model.image(1)
    for index, point in enumerate(list(alone.points2D)):
        if point.has_point3D():
            model.delete_observation(alone.image_id, index)
    choice = choose_lens(model, photographs, True, quiet)
    assert choice.heights is not None
    assert choice.heights.calibrated_share == pytest.approx(1.0, abs=0.05)


def test_ground_above_the_cameras_gives_no_flight_heights():
    flight = fly(lines=4, each=6, noise_px=0.2)
    lens = LensPrior(FOCAL, None, None, "DJI dewarp data", True, 1.04 * FOCAL)
    photographs = [replace(p, lens=lens, relative_altitude_m=75.0) for p in flight.survey.photographs]
    model = pycolmap.Reconstruction(flight.model)
    assert _compare_heights(model, photographs) is not None
    for point in model.points3D.values():
        point.xyz = point.xyz + np.array([0.0, 0.0, 150.0])
    assert _compare_heights(model, photographs) is None


def simulated_matches(path: Path) -> list[str]:
    """Write a database of simulated photographs, and return their names."""
    options, noise = pycolmap.SyntheticDatasetOptions(), pycolmap.SyntheticNoiseOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D, noise.point2D_stddev = 1, 5, 5500, 0.5
    with pycolmap.Database.open(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(noise, truth, database)
    return [image.name for image in truth.images.values()]


@pytest.mark.thorough
def test_ctrl_c_ends_the_global_mapper_because_it_has_a_process_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    names = simulated_matches(tmp_path / "database.db")
    monkeypatch.setattr(pycolmap, "global_mapping", Mock(side_effect=AssertionError("not in this process")))
    (model,) = reconstruct(tmp_path / "database.db", tmp_path / "models", names, quiet, known=False, mapper="global")
    assert registered_names(model) == sorted(names)


@pytest.mark.thorough
def test_a_photograph_that_sees_no_point_is_in_no_model(tmp_path: Path):
    names = simulated_matches(tmp_path / "database.db")
    with pycolmap.Database.open(tmp_path / "database.db") as db:
        other = db.read_image_with_name(names[0])
        lens = pycolmap.Camera.create_from_model_name(99, "PINHOLE", 500.0, 640, 480)
        lens.has_prior_focal_length = True
        db.write_camera(lens, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=99)
        rig.add_ref_sensor(lens.sensor_id)
        db.write_rig(rig, use_rig_id=True)
        image = pycolmap.Image(name="stray.jpg", camera_id=99)
        image.image_id = db.write_image(image)
        frame = pycolmap.Frame(rig_id=99)
        frame.add_data_id(image.data_id)
        db.write_frame(frame)
        random = np.random.default_rng(0)
        db.write_keypoints(image.image_id, random.uniform(0, 480, (200, 4)).astype(np.float32))
        by_chance = np.stack([np.arange(20), np.arange(20)], axis=1).astype(np.uint32)
        kind = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry = pycolmap.TwoViewGeometry(config=kind, inlier_matches=by_chance)
        db.write_two_view_geometry(other.image_id, image.image_id, geometry)
    work = (tmp_path / "database.db", tmp_path / "models", [*names, "stray.jpg"])
    (model,) = find_models(*work, quiet, True, "global", 1)
    assert registered_names(model) == sorted(names)
    assert 99 not in model.cameras


def test_an_early_attempt_whose_photographs_are_in_a_later_one_is_no_model(tmp_path: Path):
    whole, part = fly().model, pycolmap.Reconstruction(fly().model)
    for image in list(part.images.values())[3:]:
        part.deregister_frame(image.frame_id)
    assert large_enough([whole, part], tmp_path / "none", []) == [whole]


def test_a_killed_process_of_the_global_mapper_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ProcessPoolExecutor, "submit", Mock(side_effect=BrokenProcessPool("terminated")))
    with pytest.raises(RunError, match=r"poses of 3 photographs was killed, .*: expected memory for .*; give fewer"):
        reconstruct(tmp_path / "database.db", tmp_path, list("abc"), quiet, known=False, mapper="global")


@pytest.mark.thorough
def test_the_same_matches_give_the_same_model_to_the_last_bit(tmp_path: Path):
    names = simulated_matches(tmp_path / "database.db")

    def points(number: int) -> bytes:
        (model,) = reconstruct(tmp_path / "database.db", tmp_path / str(number), names, quiet, known=False)
        solve(model, all_images(model))
        write_model(model, tmp_path / f"{number}-model")
        return (tmp_path / f"{number}-model" / "points3D.bin").read_bytes()

    assert points(0) == points(1)
