"""Write synthetic surveys: COLMAP and this package read them, and the ground truth is next to them."""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from tidefield.data.load import load_scene
from tidefield.errors import SceneError
from tidefield.synthetic import Flight, Survey, make_survey, write_survey


@pytest.fixture(scope="module")
def survey() -> Survey:
    return make_survey("river_mouths", seed=2, views=9, width=120, flight=Flight(focal_ratio=1.6), supersample=1)


@pytest.fixture(scope="module")
def folder(survey: Survey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic") / "scene"
    write_survey(survey, folder)
    return folder


def test_colmap_reads_the_model_and_its_reprojection_errors(folder: Path, survey: Survey) -> None:
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert model.num_reg_images() == 9
    assert model.num_points3D() == len(survey.points.xyz_world) > 200
    assert model.compute_num_observations() == len(survey.points.uv_px)
    stated = model.compute_mean_reprojection_error()
    model.update_point_3d_errors()
    errors = np.array([point.error for point in model.points3D.values()])
    assert errors.mean() == pytest.approx(stated, rel=1e-2)
    assert 0.1 < errors.mean() < 0.45
    assert errors.max() < 1.5
    assert min(point.track.length() for point in model.points3D.values()) >= 2


def test_sparse_points_lie_on_the_surface(survey: Survey) -> None:
    z = survey.cameras.project(survey.points.xyz_world)[1][survey.points.camera_index, survey.points.point_index]
    column, row = survey.points.uv_px.floor().long().T
    depth = survey.depth[survey.points.camera_index, row, column]
    footprint = float(survey.depth.median() / survey.cameras.focal_px[0, 0])
    assert (z - depth).abs().median() < footprint
    assert ((z - depth).abs() < 6 * footprint).float().mean() > 0.97


def test_load_scene_returns_the_same_photographs_and_poses(folder: Path, survey: Survey) -> None:
    scene = load_scene(folder)
    assert scene.names[0] == "river_mouths_0001.png"
    assert torch.equal(torch.as_tensor(scene.photographs[3]), survey.photographs[3])
    back = scene.cameras.position_world + scene.origin_world
    assert torch.allclose(back.float(), survey.cameras.position_world, atol=1e-4)
    assert torch.allclose(scene.cameras.T_world_camera[..., :3], survey.cameras.T_world_camera[..., :3], atol=1e-5)
    whole = load_scene(folder, hold_out=False).points
    assert whole is not None
    assert len(whole.xyz_world) == len(survey.points.xyz_world)
    depth = survey.depth.flatten(1)
    assert (scene.cameras.near_far[:, 0] < depth.quantile(0.01, dim=1)).all()
    assert (scene.cameras.near_far[:, 1] > depth.quantile(0.99, dim=1)).all()


def test_ground_truth_files_match_the_survey(folder: Path, survey: Survey) -> None:
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    depth = np.load(folder / "truth" / "depth" / "river_mouths_0005.npy")
    assert np.array_equal(depth, survey.depth[4].numpy())
    picture = cv2.imread(str(folder / "truth" / "orthophoto.png"))
    surface = np.load(folder / "truth" / "surface.npy")
    assert picture is not None
    assert picture.shape[:2] == surface.shape == (truth["map"]["rows"], truth["map"]["columns"])
    east, north = truth["map"]["first_pixel_centre_east_north_m"]
    step = truth["map"]["pixel_step_east_north_m"]
    # Most sparse points are on bare ground, where their height is that of the map's surface.
    x, y, z = survey.points.xyz_world.numpy().T
    column, row = np.rint((x - east) / step[0]).astype(int), np.rint((y - north) / step[1]).astype(int)
    assert np.median(np.abs(surface[row, column] - z)) < 0.3
    assert truth["gain"]["river_mouths_0001.png"] == [1.0, 1.0, 1.0]
    # Plants alone rise above the ground and the water, and water is level.
    bare, classes = np.load(folder / "truth" / "bare.npy"), cv2.imread(str(folder / "truth" / "classes.png"), -1)
    assert set(np.unique(classes)) == {2, 3, 9}
    assert np.abs(surface - bare)[classes != 3].max() < 0.03 <= (surface - bare)[classes == 3].min()
    sea = survey.flat.ground.sample(torch.tensor([[east + 2 * step[0]], [north - 2 * step[0]]])).water_depth_m
    assert (classes[2, 2] == 9) == bool(sea > 0.0125)


def test_photographs_can_be_jpegs(survey: Survey, tmp_path: Path) -> None:
    write_survey(survey, tmp_path / "jpegs", suffix=".jpg")
    picture = cv2.imread(str(tmp_path / "jpegs" / "images" / "river_mouths_0002.jpg"))
    assert picture is not None
    assert np.abs(picture[..., ::-1].astype(int) - survey.photographs[1].numpy()).mean() < 4


def test_folders_can_have_names_that_opencv_cannot_write_to(
    survey: Survey, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its `imwrite` takes no other names than ASCII on Windows."""
    monkeypatch.setattr(cv2, "imwrite", lambda *_: False)
    write_survey(survey, tmp_path / "Süßwasserwatt")
    pictures = [path.relative_to(folder) for path in folder.rglob("*.png")]
    assert len(pictures) == 9 + 2
    for path in pictures:
        assert (tmp_path / "Süßwasserwatt" / path).read_bytes() == (folder / path).read_bytes()


def test_the_truth_can_be_left_out(survey: Survey, folder: Path, tmp_path: Path) -> None:
    write_survey(survey, tmp_path / "scene", truth=False)
    written = {path.relative_to(tmp_path / "scene") for path in (tmp_path / "scene").rglob("*") if path.is_file()}
    whole = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    assert written == {path for path in whole if path.parts[0] != "truth"}


def test_a_folder_that_is_not_empty_is_refused(survey: Survey, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("keep me")
    with pytest.raises(SceneError, match="not empty"):
        write_survey(survey, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
