"""Large surveys are reconstructed in blocks, which are merged by the photographs that they share."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from located_surveys import fly, photograph, quiet
from rich.console import Console

from tidefield.errors import RunError
from tidefield.geometry.similarity import Similarity, refine_similarity
from tidefield.survey import prepare
from tidefield.survey.georeference.bundle_adjustment import adjustment_options, all_images
from tidefield.survey.sfm import blocks as module
from tidefield.survey.sfm.blocks import DONE, Block, cut, matched_pairs, merge, reconstruct_blocks, settle
from tidefield.survey.sfm.features import encode_name
from tidefield.survey.survey import LensPrior


def grid(rows: int, columns: int) -> list:
    places = [(1e-4 * column, 50 + 1e-4 * row, 30.0) for row in range(rows) for column in range(columns)]
    return [photograph(i, np.array(place)) for i, place in enumerate(places)]


def neighbours(photographs: list, columns: int) -> dict[tuple[str, str], int]:
    names = [p.name for p in photographs]
    pairs = {(names[i], names[i + 1]): 90 for i in range(len(names) - 1) if (i + 1) % columns}
    return pairs | {(names[i], names[i + columns]): 60 for i in range(len(names) - columns)}


def test_a_small_survey_is_one_block_and_one_without_positions_too():
    photographs = grid(4, 5)
    assert cut(photographs, {}, whole=20, most=5) == [Block(tuple(p.name for p in photographs), ())]
    lost = [replace(p, position=None) for p in photographs[:11]] + photographs[11:]
    assert len(cut(lost, {}, whole=10, most=5)) == 1


def test_blocks_are_compact_have_every_photograph_once_and_share_those_across_their_borders():
    photographs = grid(8, 8)
    made = cut(photographs, neighbours(photographs, 8), whole=10, most=16)
    assert [len(block.own) for block in made] == [16] * 4
    assert sorted(name for block in made for name in block.own) == sorted(p.name for p in photographs)
    number = {p.name: divmod(i, 8) for i, p in enumerate(photographs)}
    for block in made:
        own = np.array([number[name] for name in block.own])
        assert (np.ptp(own, axis=0) == 3).all()
        for name in block.shared:
            assert np.abs(own - number[name]).sum(1).min() == 1, "next to a photograph of its own"
        assert len(block.shared) == 8


def test_a_photograph_without_position_goes_with_the_one_that_it_matches_best():
    photographs = grid(4, 8)
    last = photographs[-1].name
    photographs[0] = replace(photographs[0], position=None)
    pairs = {**neighbours(photographs, 8), (photographs[0].name, last): 500}
    made = cut(photographs, pairs, whole=10, most=16)
    assert [photographs[0].name in block.own for block in made] == [last in block.own for block in made]


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory):
    """A simulated flight, its exact model, and a database of its features and matches."""
    flight = fly(lines=5, each=8, noise_px=0.2)
    path = tmp_path_factory.mktemp("survey") / "database.db"
    with pycolmap.Database.open(path) as db:
        (camera,) = flight.model.cameras.values()
        camera.has_prior_focal_length = True
        db.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        db.write_rig(rig, use_rig_id=True)
        seen = {}
        for number in sorted(flight.model.reg_image_ids()):
            image = flight.model.image(number)
            new = pycolmap.Image(name=encode_name(image.name), camera_id=1, image_id=number)
            db.write_image(new, use_image_id=True)
            frame = pycolmap.Frame(rig_id=1, frame_id=number)
            frame.add_data_id(new.data_id)
            db.write_frame(frame, use_frame_id=True)
            db.write_keypoints(number, np.array([point.xy for point in image.points2D], dtype=np.float32))
            seen[number] = {p.point3D_id: k for k, p in enumerate(image.points2D) if p.has_point3D()}
        for first in seen:
            for second in seen:
                common = sorted(set(seen[first]) & set(seen[second]))
                if first < second and len(common) >= 30:
                    matches = np.array([(seen[first][p], seen[second][p]) for p in common], dtype=np.uint32)
                    db.write_matches(first, second, matches)
                    geometry = pycolmap.TwoViewGeometry()
                    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                    geometry.inlier_matches = matches
                    pose = (
                        flight.model.image(second).cam_from_world()
                        * flight.model.image(first).cam_from_world().inverse()
                    )
                    geometry.cam2_from_cam1 = pose
                    db.write_two_view_geometry(first, second, geometry)
    return flight, path


def test_a_lens_is_not_chosen_on_a_block_of_another_site(
    survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight, database = survey
    lens = LensPrior(350.0, None, None, "EXIF", trusted=False)
    known = replace(flight.survey, photographs=tuple(replace(p, lens=lens) for p in flight.survey.photographs))
    larger, smaller = fly(lines=3, each=8).model, fly(lines=2, each=8).model
    tried = []
    for name, stand_in in {
        "matched_pairs": lambda *_: {},
        "cut": lambda *_: [SimpleNamespace(names=[])] * 2,
        "reconstruct_blocks": lambda *_: [larger, smaller],
        "large_enough": lambda models, *_: models,
        "settle": lambda _: None,
        "choose_lens": lambda *given: tried.append(given[-1]),
        "write_model": lambda *_: None,
        "_to_json": lambda _: {},
    }.items():
        monkeypatch.setattr(prepare, name, stand_in)
    for merged in ([larger, smaller], [smaller, larger]):
        monkeypatch.setattr(prepare, "merge", lambda *_, merged=merged: merged)
        prepare.estimate_poses(known, database, tmp_path / "model", Console(quiet=True))
    assert tried[0].num_reg_images() == larger.num_reg_images()
    assert tried[1] is None


def test_blocks_are_merged_to_one_model_of_the_true_shape(survey, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(module, "worker_processes", lambda *_: nullcontext(ThreadPoolExecutor(1)))
    flight, database = survey
    photographs = flight.survey.photographs
    made = cut(photographs, matched_pairs(database, [p.name for p in photographs]), whole=10, most=20)
    assert len(made) == 2
    steps = []
    parts = reconstruct_blocks(
        database, tmp_path / "blocks", made, True, "incremental", False, lambda *n: steps.append(n)
    )
    assert steps[-1][0] == steps[-1][1] == sum(len(block.names) for block in made)
    observations = sum(part.compute_num_observations() for part in parts)
    (model,) = merge(parts, database)
    assert model.num_reg_images() == len(photographs)
    assert model.compute_num_observations() < observations, "common observations count once"
    for number in model.reg_image_ids():
        tracked = [p.point3D_id for p in model.image(number).points2D if p.has_point3D()]
        assert len(set(tracked)) == len(tracked), "a point is seen once in a photograph"
    settle(model)
    assert model.compute_mean_reprojection_error() < 0.3
    centres = np.array([model.find_image_with_name(p.name).projection_center() for p in photographs])
    start = Similarity(1.0, np.eye(3), np.zeros(3))
    robust = pycolmap.align_reconstruction_to_locations(
        model, [p.name for p in photographs], flight.centres_world, 3, pycolmap.RANSACOptions(max_error=5.0)
    )
    model.transform(robust)
    centres = np.array([model.find_image_with_name(p.name).projection_center() for p in photographs])
    left = refine_similarity(start, centres, flight.centres_world, np.ones_like(centres)).similarity(centres)
    assert np.abs(left - flight.centres_world).max() < 0.3


@pytest.mark.thorough
def test_finished_blocks_are_kept_by_a_run_that_continues(survey, tmp_path: Path, monkeypatch):
    flight, database = survey
    photographs = flight.survey.photographs
    made = cut(photographs, matched_pairs(database, [p.name for p in photographs]), whole=10, most=20)
    folder = tmp_path / "blocks"
    first = reconstruct_blocks(database, folder, made, True, "incremental", False, quiet)
    (folder / "block_0001" / DONE).unlink()
    kept = (folder / "block_0000" / DONE).stat().st_mtime_ns
    again = reconstruct_blocks(database, folder, made, True, "incremental", True, quiet)
    assert (folder / "block_0000" / DONE).stat().st_mtime_ns == kept
    assert (folder / "block_0001" / DONE).exists()
    assert [m.num_reg_images() for m in again] == [m.num_reg_images() for m in first]
    reconstruct_blocks(database, folder, made, True, "incremental", False, quiet)
    assert (folder / "block_0000" / DONE).stat().st_mtime_ns > kept, "a changed survey starts again"


@pytest.mark.thorough
def test_mapping_opens_no_database_that_another_process_may_be_opening(survey, tmp_path: Path, monkeypatch):
    flight, database = survey
    photographs, own = flight.survey.photographs, shutil.copy(database, tmp_path / "database.db")
    made = cut(photographs, matched_pairs(own, [p.name for p in photographs]), whole=10, most=10)
    split = module._split

    def split_and_hide(*arguments) -> None:
        split(*arguments)
        own.unlink()

    monkeypatch.setattr(module, "_split", split_and_hide)
    parts = reconstruct_blocks(own, tmp_path / "blocks", made, True, "incremental", False, quiet)
    assert [part.num_reg_images() for part in parts] == [len(block.names) for block in made]
    assert merge(parts, database)[0].num_reg_images() == len(photographs), "photographs keep their numbers"


@pytest.mark.thorough
def test_a_killed_process_is_one_error_that_says_how_to_go_on(survey, tmp_path: Path, monkeypatch):
    flight, database = survey
    names = tuple(p.name for p in flight.survey.photographs)
    monkeypatch.setattr(module, "_reconstruct", kill)
    with pytest.raises(RunError, match="continue with the same command"):
        reconstruct_blocks(database, tmp_path / "blocks", [Block(names, ())], True, "incremental", False, quiet)


def kill(*_: object) -> None:
    import os
    import signal

    os.kill(os.getpid(), signal.SIGKILL)


def test_the_equations_of_thousands_of_photographs_are_factorized():
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = options.num_cameras_per_rig = 1
    options.num_frames_per_rig, options.num_points3D = 1100, 30
    model = pycolmap.synthesize_dataset(options)
    config = all_images(model)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(adjustment_options(), config, model).solve()
    assert summary.ceres_summary.linear_solver_type_used.name == "SPARSE_SCHUR"


def test_models_that_share_no_photographs_stay_apart(survey, tmp_path: Path):
    _, database = survey
    apart = [pycolmap.Reconstruction(survey[0].model) for _ in range(2)]
    for model, keep in zip(apart, (range(1, 17), range(25, 41)), strict=True):
        for number in list(model.reg_image_ids()):
            if number not in keep:
                model.deregister_frame(model.image(number).frame_id)
    merged = merge(apart, database)
    assert [model.num_reg_images() for model in merged] == [16, 16]
