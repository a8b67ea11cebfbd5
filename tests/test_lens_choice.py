"""A lens gets the terms of distortion that it has, and none that would bend the model."""

import numpy as np
import pycolmap
import pytest
from located_surveys import FOCAL, HEIGHT, WIDTH, fly

from tidefield.ingest.motion.lens_choice import TERMS, Trial, best_of, choose_lens, told


def quiet(done: int, whole: int) -> None:
    assert 0 <= done <= whole


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
    trials = choose_lens(model, flight.survey.photographs, False, quiet)
    assert [trial.lens for trial in trials if trial is not trials[-1]] == [name for name in TERMS if name != lens]
    assert trials[-1].lens == lens
    (found,) = model.cameras.values()
    assert found.model_name == lens
    assert found.focal_length_x == FOCAL
    assert model.compute_mean_reprojection_error() < 0.3
    true = np.asarray(own.params[4:])[: TERMS[lens]]
    np.testing.assert_allclose(np.asarray(found.params)[-TERMS[lens] :], true, atol=0.02)


def test_without_enough_positions_matches_alone_decide():
    flight = fly(camera=camera(-0.25, 0.2), noise_px=0.2)
    trials = choose_lens(pycolmap.Reconstruction(flight.model), flight.survey.photographs[:3], False, quiet)
    assert trials[-1].lens == "RADIAL"
    assert all(trial.off_m is None for trial in trials)


def test_an_unknown_focal_length_is_refined():
    flight = fly(lines=4, each=6)
    model = pycolmap.Reconstruction(flight.model)
    (own,) = model.cameras.values()
    own.params = [1.1 * FOCAL, *own.params[1:]]
    choose_lens(model, flight.survey.photographs, True, quiet)
    (found,) = model.cameras.values()
    assert found.focal_length_x != pytest.approx(1.1 * FOCAL, rel=1e-3)
    assert model.compute_mean_reprojection_error() < 0.45


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
def test_a_richer_lens_must_be_worth_it_and_not_bend_the_model(errors, offs, lens):
    trials = [Trial(*values) for values in zip(TERMS, errors, offs, strict=True)]
    assert best_of(trials).lens == lens


def test_the_surveyor_is_told_where_positions_spoke_against_a_richer_lens():
    simple, radial, full = Trial("SIMPLE_RADIAL", 0.46, 0.59), Trial("RADIAL", 0.43, 0.65), Trial("OPENCV", 0.42, 0.67)
    (sentence,) = told((radial, full, simple))
    assert "0.42 px instead of 0.46" in sentence
    assert "0.67 m instead of 0.59" in sentence
    assert told((simple, radial, full)) == ()
