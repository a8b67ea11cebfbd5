"""`transforms.json` describes the same scene as the COLMAP model, for nerfstudio."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scenes_on_disk import BARREL, PINHOLE, UTM, Truth, survey, with_one_larger, write_colmap

from tidefield.data.load import load_scene
from tidefield.data.ply import read_ply
from tidefield.data.readers.transforms import read_transforms
from tidefield.errors import RunError, SceneError
from tidefield.geometry.lenses import Lens
from tidefield.survey.export import write_transforms


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def exported(root: Path, truth: Truth) -> dict[str, Any]:
    """Write a COLMAP scene and its transforms; return the content of the file."""
    model = pycolmap.Reconstruction(str(write_colmap(root, truth)))
    write_transforms(root, model)
    return json.loads((root / "transforms.json").read_text())


def points_of(root: Path) -> np.ndarray:
    """The points of a model, as pycolmap reads it, in the order of their numbers."""
    model = pycolmap.Reconstruction(str(root / "sparse" / "0"))
    return np.array([point.xyz for _, point in sorted(model.points3D.items())])


@pytest.mark.parametrize("truth", [survey(BARREL), survey(PINHOLE), with_one_larger(survey(BARREL))])
def test_transforms_round_trip(tmp_path: Path, truth: Truth) -> None:
    top = exported(tmp_path, truth)
    assert ("fl_x" in top) == (len(set(truth.lenses)) == 1)
    assert all(("fl_x" in frame) != ("fl_x" in top) for frame in top["frames"])
    posed = read_transforms(tmp_path, False)
    order = np.argsort(truth.names)
    assert posed.names == tuple(truth.names[i] for i in order)
    np.testing.assert_allclose(posed.T_world_camera, truth.T_world_camera[order], atol=1e-9)
    assert posed.lenses == tuple(truth.lenses[i] for i in order)
    assert posed.points is not None
    np.testing.assert_allclose(posed.points.xyz_world, points_of(tmp_path), rtol=1e-6)


def test_transforms_hold_out_the_same_photographs_as_the_model(tmp_path: Path) -> None:
    top = exported(tmp_path, survey(PINHOLE))
    scene = load_scene(tmp_path)  # of the model, which comes first
    assert scene.points is not None
    assert top["val_filenames"] == top["test_filenames"] == [f"images/{scene.names[i]}" for i in scene.test]
    assert top["train_filenames"] == [f"images/{scene.names[i]}" for i in scene.train]
    assert sorted(frame["file_path"] for frame in top["frames"]) == sorted(
        top["train_filenames"] + top["test_filenames"]
    )
    (tmp_path / "sparse").rename(tmp_path / "elsewhere")
    alone = load_scene(tmp_path)
    assert (alone.names, alone.train, alone.test) == (scene.names, scene.train, scene.test)


def test_nerfstudios_cameras_project_points_as_colmaps_do(tmp_path: Path) -> None:
    top = exported(tmp_path, survey(BARREL))
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    for frame in top["frames"]:
        image = model.find_image_with_name(frame["file_path"].removeprefix("images/"))
        assert image is not None
        seen = [point for point in image.points2D if point.has_point3D()]
        xyz = np.array([[*model.points3D[point.point3D_id].xyz, 1] for point in seen])
        x, y, z = (xyz @ np.linalg.inv(frame["transform_matrix"]).T)[:, :3].T
        assert (z < 0).all()  # OpenGL: -z forward, +y up
        a, b = x / -z, -y / -z
        r2 = a * a + b * b
        d = 1 + top["k1"] * r2 + top["k2"] * r2**2 + top["k3"] * r2**3
        u = top["fl_x"] * (a * d + 2 * top["p1"] * a * b + top["p2"] * (r2 + 2 * a * a)) + top["cx"]
        v = top["fl_y"] * (b * d + 2 * top["p2"] * a * b + top["p1"] * (r2 + 2 * b * b)) + top["cy"]
        np.testing.assert_allclose(np.stack([u, v], -1), [point.xy for point in seen], atol=1e-6)


def test_all_terms_of_distortion_are_written(tmp_path: Path) -> None:
    lens = replace(BARREL, k3=0.01)
    model = pycolmap.Reconstruction(str(write_colmap(tmp_path, survey(BARREL))))
    camera = next(iter(model.cameras.values()))
    full = [*camera.params, lens.k3, 0, 0, 0]
    camera.model, camera.params = pycolmap.CameraModelId.FULL_OPENCV, full
    write_transforms(tmp_path, model)
    assert set(read_transforms(tmp_path, False).lenses) == {lens}


def test_large_coordinates_are_reduced(tmp_path: Path) -> None:
    truth = survey(BARREL, offset=UTM)
    top = exported(tmp_path, truth)
    posed = read_transforms(tmp_path, False)
    applied = np.array(top["applied_transform"])
    np.testing.assert_array_equal(applied[:, :3], np.eye(3))
    assert (applied[:, 3] == np.round(applied[:, 3])).all()
    assert np.abs(posed.T_world_camera[:, :, 3]).max() < 20
    expected = truth.T_world_camera[np.argsort(truth.names)][:, :, 3] + applied[:, 3]
    np.testing.assert_allclose(posed.T_world_camera[:, :, 3], expected, atol=1e-8)
    assert posed.points is not None
    np.testing.assert_allclose(posed.points.xyz_world, points_of(tmp_path) + applied[:, 3], atol=1e-6)


def test_small_coordinates_stay_unchanged_and_orientation_is_fixed_on_request(tmp_path: Path) -> None:
    top = exported(tmp_path, survey(BARREL))
    assert top["applied_transform"] == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    assert "orientation_override" not in top
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    write_transforms(tmp_path, model, z_is_up=True, overwrite=True)
    assert json.loads((tmp_path / "transforms.json").read_text()) == {**top, "orientation_override": "none"}


def test_the_cloud_has_its_colours(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(str(write_colmap(tmp_path, survey(PINHOLE))))
    for k, point in enumerate(model.points3D.values()):
        point.color = np.array([k % 256, 255, 3], dtype=np.uint8)
    write_transforms(tmp_path, model)
    cloud = read_ply(tmp_path / "sparse_pc.ply")
    assert cloud is not None
    assert cloud[1] is not None
    np.testing.assert_array_equal(cloud[1], [point.color for _, point in sorted(model.points3D.items())])


def test_a_model_without_points_names_no_cloud(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    top = exported(tmp_path, replace(truth, ground=np.zeros((0, 3))))
    assert "ply_file_path" not in top
    assert not (tmp_path / "sparse_pc.ply").exists()
    assert len(read_transforms(tmp_path, False).names) == 9


def test_photographs_without_a_pose_are_left_out(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(str(write_colmap(tmp_path, survey(PINHOLE))))
    model.deregister_frame(model.images[3].frame_id)
    write_transforms(tmp_path, model)
    names = {frame["file_path"] for frame in json.loads((tmp_path / "transforms.json").read_text())["frames"]}
    assert names == {f"images/{image.name}" for i, image in model.images.items() if i != 3}


def test_files_are_overwritten_only_on_request(tmp_path: Path) -> None:
    exported(tmp_path, survey(PINHOLE))
    before = (tmp_path / "transforms.json").read_bytes()
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    with pytest.raises(RunError, match="is there already"):
        write_transforms(tmp_path, model)
    (tmp_path / "sparse_pc.ply").unlink()
    with pytest.raises(RunError, match="is there already"):
        write_transforms(tmp_path, model)
    assert (tmp_path / "transforms.json").read_bytes() == before
    write_transforms(tmp_path, model, overwrite=True)
    assert (tmp_path / "transforms.json").read_bytes() == before


def test_unsupported_cameras_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(str(write_colmap(tmp_path, survey(PINHOLE))))
    camera = next(iter(model.cameras.values()))
    camera.model, camera.params = pycolmap.CameraModelId.THIN_PRISM_FISHEYE, [*camera.params, *[0] * 8]
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(SceneError, match="THIN_PRISM_FISHEYE"):
        write_transforms(tmp_path, model)
    assert sorted(os.listdir(tmp_path)) == before


def test_lenses_compare_by_value(tmp_path: Path) -> None:
    """Two cameras of one calibration need not be repeated in every frame."""
    truth = survey(PINHOLE)
    model = pycolmap.Reconstruction(str(write_colmap(tmp_path, with_one_larger(truth))))
    for camera in model.cameras.values():
        camera.model, camera.width, camera.height = pycolmap.CameraModelId.PINHOLE, 64, 48
        camera.params = [50.0, 50.0, 32.0, 24.0]
    write_transforms(tmp_path, model)
    assert json.loads((tmp_path / "transforms.json").read_text())["fl_x"] == Lens(64, 48, 50.0, 50.0, 32.0, 24.0).fx
