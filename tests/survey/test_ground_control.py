"""Alignment with and adjustment to ground control, and the rejection of wrong marks and points."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from located_surveys import (
    CONTROL,
    FOCAL,
    FRAME,
    HEIGHT,
    WIDTH,
    fly,
    in_a_frame_of_its_own,
    located,
    name_of,
    quiet,
    with_control,
)

from tidefield.errors import SurveyError
from tidefield.survey.georeference.bundle_adjustment import reliable
from tidefield.survey.georeference.georeference import georeference
from tidefield.survey.georeference.ground_control import _MOST_PAIRS, Marks, triangulate_points
from tidefield.survey.survey import Control, Survey


def without_positions(survey: Survey) -> Survey:
    return replace(survey, photographs=tuple(replace(p, position=None) for p in survey.photographs))


def with_marks(survey: Survey, change) -> Survey:
    """Replace each mark by `change(mark)`; None removes it."""
    assert survey.control is not None
    marks = [changed for mark in survey.control.marks if (changed := change(mark)) is not None]
    return replace(survey, control=replace(survey.control, marks=tuple(marks)))


def only_marks(survey: Survey, point: str, count: int) -> Survey:
    """Keep only the first few marks of a point."""
    assert survey.control is not None
    kept = [mark for mark in survey.control.marks if mark.point == point][:count]
    return with_marks(survey, lambda mark: mark if mark.point != point or mark in kept else None)


def off_m(flight, model, found) -> np.ndarray:
    """Compute the errors of the sparse points."""
    truth = np.array([flight.model.points3D[k].xyz for k in sorted(flight.model.points3D)])
    there = found.frame.from_crs(FRAME.to_crs(truth))
    return np.array([model.points3D[k].xyz for k in sorted(model.points3D)]) - there


@pytest.fixture(scope="module")
def flight():
    return fly(position_m=2.0)


@pytest.fixture(scope="module")
def bent():
    """A survey through a lens with distortion, reconstructed as if it had none and were 3% longer."""
    lens = [1.0 * FOCAL, FOCAL, WIDTH / 2 - 4, HEIGHT / 2 + 6, -0.03, 0.01, 0.002, -0.001]
    true = fly(
        camera=pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=lens, camera_id=1), position_m=2.0
    )
    survey = with_control(true)
    model = pycolmap.Reconstruction(true.model)
    model.cameras[1].model = pycolmap.CameraModelId.SIMPLE_RADIAL
    model.cameras[1].params = [1.03 * FOCAL, WIDTH / 2, HEIGHT / 2, -0.02]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_focal_length = options.refine_extra_params = False
    pycolmap.bundle_adjustment(model, options)
    return true, model, survey


def test_a_point_with_many_marks_is_triangulated_from_those_that_agree():
    """Not all pairs of them are tried; a third of the marks is wrong."""
    model, rng = fly(lines=6, each=20).model, np.random.default_rng(0)
    true = np.array([3.0, 2.0, 1.0])
    seen = [(model.image(k), model.image(k).project_point(true)) for k in model.reg_image_ids()]
    seen = [(image, uv) for image, uv in seen if uv is not None and (uv > 0).all() and (uv < (WIDTH, HEIGHT)).all()]
    uv = np.array([uv for _, uv in seen]) + rng.normal(0, 0.3, (len(seen), 2))
    uv[::3] += rng.uniform(30, 200, uv[::3].shape)
    marks = Marks(
        np.array(["A"] * len(seen)),
        np.array([image.name for image, _ in seen]),
        np.array([image.image_id for image, _ in seen]),
        uv,
        np.ones(len(seen)),
        np.full(len(seen), float(WIDTH)),
        np.tile(true, (len(seen), 1)),
    )
    assert len(seen) * (len(seen) - 1) / 2 > _MOST_PAIRS
    np.testing.assert_allclose(triangulate_points(model, marks, 0.01)["A"], true, atol=0.03)


@pytest.mark.parametrize("positions", [True, False])
def test_the_model_meets_the_control_with_and_without_positions_and_gets_no_points_of_it(flight, positions):
    survey = with_control(flight)
    model, found = located(flight, survey if positions else without_positions(survey))
    assert found.source == "ground control"
    assert found.frame.epsg == 27700
    off = off_m(flight, model, found)
    assert np.median(np.linalg.norm(off[:, :2], axis=1)) < 0.05
    assert np.median(np.abs(off[:, 2])) < 0.10
    assert found.control.horizontal_rms_m < 0.03
    assert found.check.names == tuple(f"G{k}" for k in range(1, 9))
    assert 0.005 < found.check.horizontal_rms_m < 0.06
    assert 0.005 < found.check.vertical_rms_m < 0.15
    assert found.left_out == ()
    assert len(found.gps.names) == (15 if positions else 0)
    assert not found.gps_has_part
    assert model.num_points3D() == flight.model.num_points3D()
    for number in flight.model.reg_image_ids():
        assert len(model.image(number).points2D) == len(flight.model.image(number).points2D)
    assert model.compute_mean_reprojection_error() == pytest.approx(0.36, abs=0.08)


@pytest.mark.thorough
@pytest.mark.parametrize(("kept", "why"), [(2, "three are needed"), (15, "they do not follow the photographs")])
def test_positions_that_took_no_part_are_not_compared_with(flight, kept, why):
    survey = with_control(flight)
    one = survey.photographs[0].position
    photographs = tuple(replace(p, position=one if i < kept else None) for i, p in enumerate(survey.photographs))
    _, found = located(flight, replace(survey, photographs=photographs))
    assert found.source == "ground control"
    assert found.gps.names == ()
    assert any(note.startswith("The positions of ") and note.endswith(f"are not used: {why}.") for note in found.notes)


@pytest.mark.thorough
def test_errors_of_control_are_what_the_model_has_minus_what_was_surveyed(flight):
    survey = with_control(flight)
    assert survey.control is not None
    east, north, up = survey.control.points["G2"]
    raised = survey.control.points | {"G2": (east + 0.2, north, up + 0.3)}
    control, check = [], []
    for points in (survey.control.points, raised):
        _, found = located(flight, replace(survey, control=replace(survey.control, points=points)))
        assert found.left_out == ()
        control.append(found.control.error_m[found.control.names.index("G2")])
        check.append(found.check.error_m[found.check.names.index("G2")])
    # The model that a point is checked with does not know of it.
    assert check[1] - check[0] == pytest.approx([-0.2, 0, -0.3], abs=0.01)
    # The one that is fitted to all points gives way, more in height than in plan.
    moved = control[1] - control[0]
    assert -0.2 < moved[0] < -0.05
    assert -0.2 < moved[2] < -0.01


def test_a_common_shift_of_all_positions_is_reported_and_ignored(flight):
    lifted = tuple(
        replace(p, position=replace(p.position, height_m=p.position.height_m + 48)) for p in flight.survey.photographs
    )
    survey = replace(with_control(flight, CONTROL[:5]), photographs=lifted)
    model, found = located(flight, survey)
    assert found.gps.median_m[2] == pytest.approx(-48, abs=2)
    assert np.abs(off_m(flight, model, found)).max() < 1.0


@pytest.mark.thorough
@pytest.mark.parametrize("marks", [2, 3, 4])
@pytest.mark.parametrize("positions", [True, False])
def test_a_mark_moved_by_200_pixels_is_rejected(flight, marks, positions):
    survey = only_marks(with_control(flight), "G3", marks)
    if not positions:
        survey = without_positions(survey)
    assert survey.control is not None
    wrong = next(mark for mark in survey.control.marks if mark.point == "G3")
    away = replace(wrong, uv_px=(wrong.uv_px[0] + 120, wrong.uv_px[1] - 160))
    model, found = located(flight, with_marks(survey, lambda mark: away if mark == wrong else mark))
    assert [(item.kind, item.name) for item in found.left_out] == [("mark", f"G3 in {wrong.photograph}")]
    assert int(found.left_out[0].reason.split()[2]) == pytest.approx(200, abs=5)
    assert np.abs(off_m(flight, model, found)).max() < 1.0
    assert ("G3" in found.check.names) == (marks > 2)


def test_a_wrongly_surveyed_point_is_rejected(flight):
    survey = with_control(flight)
    assert survey.control is not None
    east, north, up = survey.control.points["G2"]
    points = survey.control.points | {"G2": (east, north - 2.0, up + 4.0)}
    model, found = located(flight, replace(survey, control=replace(survey.control, points=points)))
    assert [(item.kind, item.name) for item in found.left_out] == [("control point", "G2")]
    assert "4.5 m from where it was surveyed" in found.left_out[0].reason
    assert "-4.0" in found.left_out[0].reason
    assert "G2" not in found.check.names
    assert np.abs(off_m(flight, model, found)).max() < 1.0


def test_a_point_half_a_metre_off_is_rejected_by_cross_validation():
    flight = fly(lines=4, each=6, position_m=2.0)
    survey = with_control(flight, np.r_[CONTROL, [[-15, -35], [15, 38]]])
    assert survey.control is not None
    east, north, up = survey.control.points["G5"]
    points = survey.control.points | {"G5": (east + 0.5, north, up + 0.9)}
    _, found = located(flight, replace(survey, control=replace(survey.control, points=points)))
    assert [(item.kind, item.name) for item in found.left_out] == [("control point", "G5")]


def test_a_point_with_one_of_three_marks_agreeing_by_chance_is_rejected(flight):
    survey = only_marks(with_control(flight, CONTROL[:6]), "G6", 3)
    assert survey.control is not None
    one, *others = [mark for mark in survey.control.marks if mark.point == "G6"]
    moved = {
        mark: replace(mark, uv_px=(mark.uv_px[0] + 90, mark.uv_px[1] + 40 - 80 * i)) for i, mark in enumerate(others)
    }
    _, found = located(flight, with_marks(survey, lambda mark: moved.get(mark, mark)))
    assert {item.name for item in found.left_out} == {f"G6 in {mark.photograph}" for mark in (one, *others)}
    assert "G6" not in found.control.names


def test_mismatches_are_removed_before_the_adjustment(flight):
    model = pycolmap.Reconstruction(flight.model)
    wrong = {}
    for number in sorted(model.point3D_ids())[::15]:
        element = model.points3D[number].track.elements[0]
        wrong[number] = element.image_id
        model.images[element.image_id].points2D[element.point2D_idx].xy += (5.0, -3.0)
    sound = reliable(model)
    assert len(wrong) > 15
    for number, image in wrong.items():
        assert not sound.exists_point3D(number) or image not in seen_by(sound, number)
    assert sound.compute_num_observations() > 0.85 * model.compute_num_observations()
    assert model.num_points3D() == flight.model.num_points3D()


def seen_by(model: pycolmap.Reconstruction, number: int) -> set[int]:
    return {element.image_id for element in model.points3D[number].track.elements}


def test_points_in_one_photograph_are_used_and_reported_as_unchecked(flight):
    survey = only_marks(only_marks(with_control(flight), "G1", 1), "G4", 1)
    _, found = located(flight, survey)
    assert found.check.names == ("G2", "G3", "G5", "G6", "G7", "G8")
    assert any("G1, G4" in note and "not checked" in note for note in found.notes)


@pytest.mark.thorough
def test_control_removes_the_bend_of_a_wrong_lens(bent):
    true, model, survey = bent
    turned = in_a_frame_of_its_own(model)
    found = georeference(turned, survey, quiet)
    off = off_m(true, turned, found)
    assert any("corrected the lens" in note for note in found.notes)
    assert turned.cameras[1].model == pycolmap.CameraModelId.OPENCV
    np.testing.assert_allclose(turned.cameras[1].params[:4], [FOCAL, FOCAL, WIDTH / 2 - 4, HEIGHT / 2 + 6], atol=8)
    assert np.sqrt((off[:, :2] ** 2).sum(1).mean()) < 0.1
    assert np.sqrt((off[:, 2] ** 2).mean()) < 0.2
    positions_only = in_a_frame_of_its_own(model)
    without = georeference(positions_only, replace(survey, control=None), quiet)
    worse = off_m(true, positions_only, without)
    assert np.sqrt((worse[:, 2] ** 2).mean()) > 3 * np.sqrt((off[:, 2] ** 2).mean())


def test_two_points_shift_the_model_aligned_with_positions(flight):
    survey = with_control(flight, CONTROL[:2])
    model, found = located(flight, survey)
    assert found.control.names == ("G1", "G2")
    assert found.check.names == ()
    assert any("Fewer than three" in note for note in found.notes)
    assert found.gps_has_part
    assert np.abs(off_m(flight, model, found)).max() < 3.0
    assert found.control.horizontal_rms_m < 0.5


def test_two_points_suffice_with_the_vertical_of_the_photographs(flight):
    model, found = located(flight, without_positions(with_control(flight, CONTROL[:2])))
    assert np.linalg.norm(off_m(flight, model, found)[:, :2], axis=1).mean() < 5.0


def test_collinear_points_do_not_turn_the_model_over(flight):
    line = np.column_stack([np.linspace(-35, 35, 5), np.zeros(5)])
    model, found = located(flight, with_control(flight, line))
    assert np.abs(off_m(flight, model, found)).max() < 5.0


def marked_once(survey: Survey) -> Survey:
    assert survey.control is not None
    for name in survey.control.points:
        survey = only_marks(survey, name, 1)
    return survey


@pytest.mark.parametrize("places", [CONTROL[:2], np.column_stack([np.linspace(-35, 35, 5), np.zeros(5)])])
def test_few_points_marked_once_place_nothing_and_are_refused(flight, places):
    survey = marked_once(with_control(flight, places))
    with pytest.raises(
        SurveyError, match=r"no point of ground control \(G1, G2.*expected marks of a point in two photographs"
    ):
        located(flight, survey)
    near = fly(position_m=0.3)
    with pytest.raises(SurveyError, match=r"no point of ground control"):
        located(near, marked_once(with_control(near, places)))
    both = with_control(near, places)
    for name in ("G2", "G3", "G4", "G5"):
        both = only_marks(both, name, 1)
    _, found = located(near, both)
    assert found.control.names == ("G1",)


@pytest.mark.thorough
def test_many_points_marked_once_adjust_the_model_unless_differential_positions_shape_it():
    plain, accurate = fly(position_m=0.3), fly(position_m=0.015)
    model, found = located(plain, marked_once(with_control(plain)))
    assert len(found.control_world) == 8
    assert np.median(np.abs(off_m(plain, model, found)[:, :2])) < 0.15
    fixed = tuple(
        replace(p, position=replace(p.position, horizontal_m=0.015, vertical_m=0.025))
        for p in accurate.survey.photographs
    )
    with pytest.raises(SurveyError, match="has two marks that fit together"):
        located(accurate, replace(marked_once(with_control(accurate)), photographs=fixed))
    assert located(accurate, replace(with_control(accurate), photographs=fixed))[1].gps_has_part


def test_points_marked_once_that_do_not_fit_the_positions_are_to_be_marked_twice():
    far = fly(position_m=0.3)
    moved = with_control(far)
    assert moved.control is not None
    points = {name: (x + 20, y, z) for name, (x, y, z) in moved.control.points.items()}
    survey = replace(moved, control=replace(moved.control, points=points))
    with pytest.raises(SurveyError, match=r"of no point do two marks fit together: mark each in two photographs"):
        located(far, marked_once(survey))


def test_one_point_without_positions_is_too_few(flight):
    survey = without_positions(with_control(flight, CONTROL[:1]))
    with pytest.raises(SurveyError, match="expected two such points"):
        located(flight, survey)


def test_exchanged_point_names_are_an_error(flight):
    survey = with_control(flight)
    assert survey.control is not None
    names = sorted(survey.control.points)
    mixed = dict(zip(names, [survey.control.points[n] for n in [*names[3:], *names[:3]]], strict=True))
    with pytest.raises(SurveyError, match="marks of ground control fit together"):
        located(flight, replace(survey, control=replace(survey.control, points=mixed)))


def test_control_in_the_wrong_system_is_an_error(flight):
    survey = with_control(flight)
    assert survey.control is not None
    wrong = Control("EPSG:32630", survey.control.points, survey.control.marks)
    with pytest.raises(SurveyError, match=r"lie [\d,]+ km from the photographs.*EPSG:27700"):
        located(flight, replace(survey, control=wrong))


@pytest.mark.thorough
def test_marks_in_photographs_without_a_pose_are_left_out(flight):
    survey = with_control(flight)
    astray = with_marks(survey, lambda m: replace(m, photograph="lost.jpg") if m.photograph == name_of(2) else m)
    _, found = located(flight, astray)
    assert found.left_out
    assert all(item.kind == "mark" and "lost.jpg" in item.name for item in found.left_out)
    with pytest.raises(SurveyError, match="could not be placed"):
        located(flight, with_marks(survey, lambda m: replace(m, photograph="lost.jpg")))


@pytest.mark.thorough
def test_check_points_take_no_part_however_wrong_they_are(flight):
    survey = with_control(flight)
    model, found = located(flight, survey)
    assert survey.control is not None
    name = sorted(survey.control.points)[0]

    def renamed(point: str) -> str:
        return f"CHK_{point}" if point == name else point

    points = {renamed(point): xyz for point, xyz in survey.control.points.items()}
    marks = tuple(replace(mark, point=renamed(mark.point)) for mark in survey.control.marks)
    x, y, z = points[renamed(name)]
    wrong = {**points, renamed(name): (x + 50.0, y, z - 7.0)}
    results = []
    for places in (points, wrong):
        model, found = located(flight, replace(survey, control=replace(survey.control, points=places, marks=marks)))
        results.append(np.array([model.points3D[k].xyz for k in sorted(model.points3D)]))
        assert renamed(name) not in (*found.control.names, *found.check.names)
    # The frame's origin comes from the control alone, too.
    np.testing.assert_array_equal(results[0], results[1])
