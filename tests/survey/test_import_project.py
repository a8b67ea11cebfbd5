import io
import json
import logging
import os
import shutil
from dataclasses import replace
from pathlib import Path

import camera_files
import numpy as np
import pycolmap
import pytest
import torch
from opensfm_projects import reconstruction, tracks_of, write_opensfm, write_tracks
from PIL import Image
from PIL.ExifTags import Base
from rich.console import Console
from scenes_on_disk import (
    BARREL,
    PINHOLE,
    UTM,
    Truth,
    survey,
    with_one_larger,
    write_blender,
    write_colmap,
    write_llff,
    write_transforms,
)

from tidefield.change.views import Site
from tidefield.commands import import_
from tidefield.data.georeference import read_georeference
from tidefield.data.load import load_scene, read_posed
from tidefield.data.readers.posed import Observations
from tidefield.data.scene import Scene
from tidefield.errors import RunError, SceneError
from tidefield.maps.check_points import read_check_points
from tidefield.maps.grid import map_frame
from tidefield.survey import import_project as convert
from tidefield.survey.import_project import import_project
from tidefield.survey.survey import CHECK_FILE


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(autouse=True)
def _no_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of an import depends on the exposures that loading estimates."""
    nothing = torch.zeros(1)
    monkeypatch.setattr("tidefield.data.load.estimate_gains", lambda _, own, *__: (torch.ones(len(own), 3), nothing))


def write_project(root: Path, kind: str = "brown", tracks: bool = True) -> None:
    top = reconstruction(kind)
    write_opensfm(root, top)
    if tracks:
        write_tracks(root / "tracks.csv", tracks_of(top))


def assert_same(own: Scene, other: Scene) -> None:
    """Compare what a scene on disk stores."""
    assert own.names == other.names
    for part in ("T_world_camera", "focal_px", "principal_px", "size_px"):
        torch.testing.assert_close(getattr(own.cameras, part), getattr(other.cameras, part))
    torch.testing.assert_close(own.origin_world, other.origin_world)
    for mine, theirs in zip(own.photographs.colours, other.photographs.colours, strict=True):
        assert torch.equal(mine, theirs)


@pytest.mark.parametrize(
    ("truth", "text"),
    [
        (survey(BARREL), False),
        (with_one_larger(survey(BARREL)), True),
        (survey(PINHOLE, offset=UTM), False),
        (survey(PINHOLE, offset=UTM), True),
    ],
)
def test_a_colmap_scene_is_imported_unchanged(tmp_path: Path, truth: Truth, text: bool) -> None:
    write_colmap(tmp_path / "theirs", truth, text)
    made, _ = import_project(tmp_path / "theirs", tmp_path / "ours")
    theirs, ours = read_posed(tmp_path / "theirs", False), read_posed(tmp_path / "ours", False)
    np.testing.assert_allclose(ours.T_world_camera, theirs.T_world_camera, atol=1e-8)
    assert (ours.names, ours.lenses) == (theirs.names, theirs.lenses)
    assert ours.points is not None
    assert theirs.points is not None

    def observed(points: Observations) -> set[tuple[float, ...]]:
        seen = np.concatenate([points.xyz_world[points.point_index], points.photograph_index[:, None], points.uv_px], 1)
        return set(map(tuple, seen))

    assert observed(ours.points) == observed(theirs.points)
    assert (made.num_images(), made.num_cameras()) == (9, len(set(truth.lenses)))
    assert made.num_points3D() == len(theirs.points.xyz_world)
    assert made.compute_num_observations() == len(theirs.points.uv_px)
    assert_same(load_scene(tmp_path / "ours"), load_scene(tmp_path / "theirs"))


@pytest.mark.parametrize("kind", ["perspective", "brown"])
def test_an_opensfm_project_becomes_a_consistent_colmap_model(tmp_path: Path, kind: str) -> None:
    write_project(tmp_path / "project", kind)
    made, _ = import_project(tmp_path / "project", tmp_path / "scene")
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
    assert model.num_reg_images() == made.num_images() == 9
    assert model.compute_num_observations() == made.compute_num_observations() > 1000
    assert max(point.error for point in model.points3D.values()) < 1e-6
    expected = "PINHOLE" if kind == "brown" else "OPENCV"  # only brown has a sixth order
    assert {camera.model_name for camera in model.cameras.values()} == {expected}
    colours = [point["color"] for point in reconstruction(kind)["points"].values()]
    assert [point.color.tolist() for _, point in sorted(model.points3D.items())] == colours
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-6
    assert_same(load_scene(tmp_path / "scene"), load_scene(tmp_path / "project"))


@pytest.mark.parametrize("undistort", [False, True])
def test_photographs_with_k3_or_all_on_request_are_undistorted_and_others_keep_their_files(
    tmp_path: Path, undistort: bool
) -> None:
    truth = survey(replace(BARREL, k3=-0.01))
    lenses = (*truth.lenses[:2], BARREL, PINHOLE, *truth.lenses[4:])
    truth = replace(truth, lenses=lenses, names=tuple(name.replace("png", "jpg") for name in truth.names))
    write_transforms(tmp_path / "theirs", truth)
    for name, picture in zip(truth.names, truth.pictures, strict=True):
        camera_files.photograph(
            tmp_path / "theirs" / "images" / name, table=camera_files.exif({Base.Orientation: 6}), pixels=picture
        )
    import_project(tmp_path / "theirs", tmp_path / "ours", undistort=undistort)
    model = pycolmap.Reconstruction(str(tmp_path / "ours" / "sparse" / "0"))
    kinds = {"PINHOLE"} if undistort else {"PINHOLE", "OPENCV"}
    assert {camera.model_name for camera in model.cameras.values()} == kinds
    for name, lens in zip(truth.names, lenses, strict=True):
        own, other = (tmp_path / folder / "images" / name for folder in ("ours", "theirs"))
        is_new = bool(lens.k3) or (undistort and lens.is_distorted)
        assert (own.read_bytes() != other.read_bytes()) == is_new
        with Image.open(own) as picture:
            assert (picture.format, picture.size) == ("JPEG", (64, 48))
            assert picture.getexif()[Base.Orientation] == (1 if is_new else 6), "the pixels are not turned"
    ours, theirs = load_scene(tmp_path / "ours"), load_scene(tmp_path / "theirs")
    for part in ("T_world_camera", "focal_px", "principal_px", "size_px"):
        torch.testing.assert_close(getattr(ours.cameras, part), getattr(theirs.cameras, part))
    for own, other in zip(ours.photographs.colours, theirs.photographs.colours, strict=True):
        assert (own.float() - other.float()).abs().mean() < 1.5, "JPEG's loss at quality 95"


def test_reduced_photographs_are_written_beside_the_others_on_request(tmp_path: Path) -> None:
    truth = survey(BARREL)
    write_colmap(tmp_path / "theirs", truth)
    calls: list[tuple[int, int]] = []
    import_project(
        tmp_path / "theirs", tmp_path / "ours", downscale=(2, 4), progress=lambda *so_far: calls.append(so_far)
    )
    assert calls == [(i, 18) for i in range(1, 19)]
    for folder, size in {"images": (64, 48), "images_2": (32, 24), "images_4": (16, 12)}.items():
        for name in truth.names:
            with Image.open(tmp_path / "ours" / folder / name) as picture:
                assert picture.size == size
    assert_same(load_scene(tmp_path / "ours"), load_scene(tmp_path / "theirs"))
    with pytest.raises(RunError, match="--downscale is 2 1: expected"):
        import_project(tmp_path / "theirs", tmp_path / "refused", downscale=(2, 1))


def as_format(root: Path, truth: Truth, format: str) -> None:
    """Write a scene whose photographs have another format, whatever their names."""
    write_colmap(root, truth)
    for name, pixels in zip(truth.names, truth.pictures, strict=True):
        options = {"lossless": True} if format == "WEBP" else {}
        Image.fromarray(pixels).save(root / "images" / name, format, **options)


@pytest.mark.parametrize("format", ["WEBP", "BMP"])
def test_scenes_of_other_formats_are_undistorted_and_reduced_without_loss(tmp_path: Path, format: str) -> None:
    truth = survey(BARREL)
    for kind in (format, "PNG"):
        as_format(tmp_path / kind, truth, kind)
        import_project(tmp_path / kind, tmp_path / f"{kind} ours", undistort=True, downscale=(2,))
    for folder in ("images", "images_2"):
        for name in truth.names:
            with (
                Image.open(tmp_path / f"{format} ours" / folder / name) as ours,
                Image.open(tmp_path / "PNG ours" / folder / name) as expected,
            ):
                assert ours.format == format
                np.testing.assert_array_equal(np.asarray(ours), np.asarray(expected))
    load_scene(tmp_path / f"{format} ours")


def test_formats_that_cannot_be_written_are_refused_before_anything_is(tmp_path: Path) -> None:
    as_format(tmp_path / "theirs", survey(BARREL), "PPM")
    calls: list[tuple[int, int]] = []
    for options in ({"undistort": True}, {"downscale": (2,)}):
        with pytest.raises(RunError, match=r"png is a PPM file.*expected one of JPEG, PNG, .*--downscale, --undistort"):
            import_project(tmp_path / "theirs", tmp_path / "ours", progress=lambda *far: calls.append(far), **options)
    assert calls == []
    import_project(tmp_path / "theirs", tmp_path / "ours")


def test_observations_of_undistorted_photographs_are_exact_and_inside(tmp_path: Path) -> None:
    write_project(tmp_path / "project")
    import_project(tmp_path / "project", tmp_path / "scene")
    theirs, ours = (read_posed(tmp_path / name, False) for name in ("project", "scene"))
    assert theirs.points is not None
    assert ours.points is not None
    moved = theirs.lenses[0].unproject(theirs.points.uv_px) * (ours.lenses[0].fx, ours.lenses[0].fy)
    moved += (ours.lenses[0].cx, ours.lenses[0].cy)
    moved = moved[((moved >= 0) & (moved < (64, 48))).all(axis=1)]
    assert 0.7 * len(theirs.points.uv_px) < len(moved) < len(theirs.points.uv_px)
    np.testing.assert_allclose(np.sort(ours.points.uv_px, axis=0), np.sort(moved, axis=0), atol=1e-6)
    for pose, lens, mine in zip(ours.T_world_camera, ours.lenses, ours.points.by_photograph(9), strict=True):
        xyz_camera = (ours.points.xyz_world[ours.points.point_index[mine]] - pose[:, 3]) @ pose[:, :3]
        off_px = np.linalg.norm(lens.project(xyz_camera) - ours.points.uv_px[mine], axis=1)
        assert off_px.max() < 1e-6


def test_points_without_observations_are_kept(tmp_path: Path) -> None:
    write_project(tmp_path / "project", tracks=False)
    made, _ = import_project(tmp_path / "project", tmp_path / "scene")
    assert (made.num_points3D(), made.compute_num_observations()) == (600, 0)
    ours, theirs = load_scene(tmp_path / "scene"), load_scene(tmp_path / "project")
    assert ours.points is None
    torch.testing.assert_close(ours.cameras.near_far, theirs.cameras.near_far)
    posed = read_posed(tmp_path / "scene", False)
    assert posed.points is not None
    assert posed.points.rgb is not None
    own = np.concatenate([posed.points.xyz_world, posed.points.rgb], axis=1)
    truth = {(*point["coordinates"], *point["color"]) for point in reconstruction()["points"].values()}
    assert set(map(tuple, own.tolist())) == truth


def test_other_layouts_are_imported_with_a_warning_of_losses(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_transforms(tmp_path / "nerfstudio", survey(BARREL))
    write_llff(tmp_path / "llff", survey(PINHOLE))
    write_blender(tmp_path / "blender", {"train": 6, "test": 3})
    with caplog.at_level(logging.WARNING, logger="tidefield"):
        for layout in ("nerfstudio", "llff", "blender"):
            import_project(tmp_path / layout, tmp_path / f"{layout}-scene")
            ours, theirs = load_scene(tmp_path / f"{layout}-scene"), load_scene(tmp_path / layout)
            assert_same(ours, theirs)
            assert (ours.train, ours.test) == (theirs.train, theirs.test)
    warnings = [text for record in caplog.records if "triangulated" not in (text := record.getMessage())]
    assert [Path(message.split()[0]).name for message in warnings] == ["llff", "blender"]


def test_points_are_found_in_training_photographs_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truth, used = survey(BARREL), []
    names = [f"./images/{name}" for name in truth.names]
    write_transforms(tmp_path / "theirs", truth, train_filenames=names[3:], test_filenames=names[:3])
    monkeypatch.setattr(convert, "find_points", lambda posed, train, root: used.extend(train))
    import_project(tmp_path / "theirs", tmp_path / "ours")
    assert used == list(range(3, len(names)))


@pytest.mark.parametrize("listed", [3, None])
def test_the_command_counts_the_held_out_photographs_without_reading_the_whole_scene_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, listed: int | None
) -> None:
    truth = survey(BARREL)
    names = [f"./images/{name}" for name in truth.names]
    split = {"train_filenames": names[listed:], "test_filenames": names[:listed]} if listed else {}
    write_transforms(tmp_path / "theirs", truth, **split)
    console = Console(file=io.StringIO())
    with monkeypatch.context() as patch:
        patch.setattr("tidefield.data.load.read_posed", lambda *_: pytest.fail("read again"))
        import_.import_project(import_.Import(tmp_path / "theirs", tmp_path / "ours"), console)
    assert f"9 photographs, {listed or 2} of them held out; 1 camera;" in console.file.getvalue()
    assert len(read_posed(tmp_path / "ours", False).train_and_test[1]) == (listed or 2)


def test_the_georeference_of_a_project_is_imported(tmp_path: Path) -> None:
    write_project(tmp_path / "project")
    assert import_project(tmp_path / "project", tmp_path / "a")[1] is None
    (tmp_path / "project" / "reference_lla.json").write_text('{"latitude": 4.5, "longitude": -3.0, "altitude": 2.0}')
    import_project(tmp_path / "project", tmp_path / "b")
    import_project(tmp_path / "b", tmp_path / "c")
    for name in "bc":
        located = read_georeference(tmp_path / name)
        assert located is not None
        assert located.frame is not None
        assert located.source == "project"
        np.testing.assert_allclose(located.frame.to_geographic(np.zeros((1, 3))), [[-3.0, 4.5, 2.0]], atol=1e-9)
        assert located.frame.crs == "EPSG:32630"
        assert '"orientation_override": "none"' in (tmp_path / name / "transforms.json").read_text()
    assert not (tmp_path / "a" / "georeference.json").exists()


def test_a_project_lies_where_the_scene_that_is_imported_of_it_does(tmp_path: Path) -> None:
    write_project(tmp_path / "project")
    (tmp_path / "project" / "reference_lla.json").write_text('{"latitude": 4.5, "longitude": -3.0, "altitude": 2.0}')
    import_project(tmp_path / "project", tmp_path / "imported")
    project, imported = (
        Site.of(load_scene(tmp_path / name, cache=tmp_path / "cache"), lambda *_: None).frame
        for name in ("project", "imported")
    )
    assert "UTM zone 30N" in project.wkt
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 6.0]])
    np.testing.assert_allclose(project.to_map(points), imported.to_map(points), rtol=0, atol=1e-6)


def test_a_scene_that_prepare_has_not_finished_is_not_imported(tmp_path: Path) -> None:
    write_project(tmp_path / "project")
    import_project(tmp_path / "project", tmp_path / "a")
    (tmp_path / "a" / "prepare").mkdir()
    (tmp_path / "a" / "prepare" / "stages.json").write_text('{"images": {"done": false}}')
    with pytest.raises(SceneError, match="is not prepared to its end"):
        import_project(tmp_path / "a", tmp_path / "b")
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize("undistort", [False, True])
def test_check_points_are_imported_with_their_marks_in_the_written_photographs(tmp_path: Path, undistort: bool) -> None:
    write_project(tmp_path / "project", "radial")
    (tmp_path / "project" / "reference_lla.json").write_text('{"latitude": 4.5, "longitude": -3.0, "altitude": 2.0}')
    import_project(tmp_path / "project", tmp_path / "a")
    assert not (tmp_path / "a" / CHECK_FILE).exists()
    names = read_posed(tmp_path / "a", False).names
    marks = [(names[0], (3.5, 4.25)), (names[1], (60.0, 40.0)), ("gone.jpg", (1.0, 2.0))]
    lines = [f"500000.0\t497000.5\t3.25\t{u}\t{v}\t{name}\tCHK 1" for name, (u, v) in marks]
    text = "\n".join(["EPSG:32630", *lines, "500001.0 497001.0 3.0 CHK2"]) + "\n"
    (tmp_path / "a" / CHECK_FILE).write_text(text)
    import_project(tmp_path / "a", tmp_path / "b", undistort=undistort)
    written = (tmp_path / "b" / CHECK_FILE).read_text()
    assert (written == text) == (not undistort)
    found, expected = (
        read_check_points(scene / CHECK_FILE, loaded, map_frame(loaded, read_georeference(scene)))
        for scene in (tmp_path / "b", tmp_path / "a")
        for loaded in [load_scene(scene)]
    )
    for own, other in zip(found, expected, strict=True):
        assert own.name == other.name
        np.testing.assert_array_equal(own.surveyed, other.surveyed)
        assert [index for index, _ in own.marks] == [index for index, _ in other.marks]
        for (_, uv), (_, theirs) in zip(own.marks, other.marks, strict=True):
            np.testing.assert_allclose(uv, theirs, atol=1e-6)
    assert len(found[0].marks) == 2


def test_photographs_are_copied_or_linked_untouched(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    write_colmap(tmp_path / "theirs", truth)
    disk = tmp_path / "disk"
    (tmp_path / "theirs" / "images").rename(disk)
    (tmp_path / "theirs" / "images").symlink_to(disk)
    calls: list[tuple[int, int]] = []
    import_project(tmp_path / "theirs", tmp_path / "copied", progress=lambda *so_far: calls.append(so_far))
    import_project(tmp_path / "theirs", tmp_path / "linked", link=True)
    assert calls == [(i, 9) for i in range(1, 10)]
    for name in truth.names:
        copy, link = (tmp_path / kind / "images" / name for kind in ("copied", "linked"))
        assert copy.read_bytes() == (disk / name).read_bytes()
        assert not copy.samefile(disk / name)
        assert link.samefile(disk / name)
        assert not link.is_symlink()


def test_cameras_are_scaled_to_reduced_photographs(tmp_path: Path) -> None:
    truth = survey(BARREL)
    write_colmap(tmp_path / "theirs", truth)
    for name in truth.names:
        path = tmp_path / "theirs" / "images" / name
        Image.open(path).resize((32, 24)).save(path)
    import_project(tmp_path / "theirs", tmp_path / "ours")
    model = pycolmap.Reconstruction(str(tmp_path / "ours" / "sparse" / "0"))
    assert {(camera.width, camera.height) for camera in model.cameras.values()} == {(32, 24)}
    assert model.compute_mean_reprojection_error() < 1e-6
    Image.new("RGB", (48, 64)).save(tmp_path / "theirs" / "images" / truth.names[0])
    with pytest.raises(SceneError, match="48 x 64 pixels, but its camera has 64 x 48"):
        import_project(tmp_path / "theirs", tmp_path / "refused")


def test_backslashes_in_names_become_folders(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    write_colmap(tmp_path / "theirs", replace(truth, names=tuple(name.replace("/", "\\") for name in truth.names)))
    shutil.rmtree(tmp_path / "theirs" / "images")
    write_colmap(tmp_path / "plain", truth)
    (tmp_path / "plain" / "images").rename(tmp_path / "theirs" / "images")
    import_project(tmp_path / "theirs", tmp_path / "ours")
    assert load_scene(tmp_path / "ours").names == tuple(sorted(truth.names))


def test_a_photograph_listed_twice_is_refused(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    write_transforms(tmp_path / "theirs", replace(truth, names=(*truth.names[:8], truth.names[0])))
    with pytest.raises(SceneError, match=r"two poses for one photograph \(strip_0/photo_8\.png"):
        import_project(tmp_path / "theirs", tmp_path / "ours")


def test_missing_photographs_are_left_out_on_request(tmp_path: Path) -> None:
    write_project(tmp_path / "project")
    (tmp_path / "project" / "images" / "DJI_0003.png").unlink()
    with pytest.raises(SceneError, match="--allow-missing"):
        import_project(tmp_path / "project", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()
    model, _ = import_project(tmp_path / "project", tmp_path / "scene", allow_missing=True)
    assert model.num_images() == 8
    assert len(load_scene(tmp_path / "scene").names) == 8


def test_an_existing_folder_is_not_overwritten(tmp_path: Path) -> None:
    write_project(tmp_path / "project")
    (tmp_path / "scene").mkdir()
    with pytest.raises(RunError, match=r"scene is there already: expected a new name; choose one$"):
        import_project(tmp_path / "project", tmp_path / "scene")
    assert os.listdir(tmp_path / "scene") == []


def test_a_failed_import_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_project(tmp_path / "project", "radial")

    def stumble(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_project(tmp_path / "project", tmp_path / "scene", progress=stumble)
    assert os.listdir(tmp_path) == ["project"]

    def across(*_: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(convert.os, "link", across)
    with pytest.raises(RunError, match=r"cannot be linked \(Invalid cross-device link\).*leave --link out"):
        import_project(tmp_path / "project", tmp_path / "scene", link=True)
    assert os.listdir(tmp_path) == ["project"]


def test_an_unwritable_folder_is_an_error(tmp_path: Path) -> None:
    write_project(tmp_path / "project")
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="cannot be written"):
        import_project(tmp_path / "project", tmp_path / "file" / "scene")


def test_masks_are_imported_in_the_places_where_colmap_and_nerfstudio_look(tmp_path: Path) -> None:
    write_colmap(tmp_path / "theirs", truth := survey(BARREL))
    used = np.zeros((48, 64, 3), dtype=np.uint8)
    used[:, 20:] = 1  # what is not black is used
    (tmp_path / "theirs" / "masks" / "strip_0").mkdir(parents=True)
    Image.fromarray(used).save(tmp_path / "theirs" / "masks" / f"{truth.names[0]}.png")
    import_project(tmp_path / "theirs", tmp_path / "ours")
    theirs, ours = load_scene(tmp_path / "theirs"), load_scene(tmp_path / "ours")
    (tmp_path / "nerfstudio").mkdir()
    for part in ("images", "masks", "transforms.json", "sparse_pc.ply"):
        (tmp_path / "ours" / part).rename(tmp_path / "nerfstudio" / part)
    by_path = load_scene(tmp_path / "nerfstudio")
    for i in range(9):
        assert torch.equal(ours.photographs.used(i), theirs.photographs.used(i))
        assert torch.equal(by_path.photographs.used(i), theirs.photographs.used(i))
    assert not theirs.photographs.used(theirs.index(truth.names[0])).all()


def test_masks_are_reduced_with_their_photographs(tmp_path: Path) -> None:
    write_colmap(tmp_path / "theirs", truth := survey(BARREL))
    used = np.full((48, 64), 255, dtype=np.uint8)
    used[:, :21] = 0
    (tmp_path / "theirs" / "masks" / "strip_0").mkdir(parents=True)
    Image.fromarray(used).save(tmp_path / "theirs" / "masks" / f"{truth.names[0]}.png")
    import_project(tmp_path / "theirs", tmp_path / "ours", downscale=(2,))
    for k, name in enumerate(truth.names):
        with Image.open(tmp_path / "ours" / "masks_2" / f"{name}.png") as mask:
            assert mask.size == (32, 24)
            row = np.where((k == 0) & (np.arange(32) < 11), 0, 255)
            np.testing.assert_array_equal(np.array(mask), np.tile(row, (24, 1)))


def test_a_fisheye_stays_one_for_colmap_and_nerfstudio(tmp_path: Path) -> None:
    write_opensfm(tmp_path / "theirs", reconstruction("fisheye_opencv"))
    made, _ = import_project(tmp_path / "theirs", tmp_path / "ours")
    lenses = read_posed(tmp_path / "theirs", False).lenses
    assert {camera.model_name for camera in made.cameras.values()} == {"OPENCV_FISHEYE"}
    assert read_posed(tmp_path / "ours", False).lenses == lenses
    top = json.loads((tmp_path / "ours" / "transforms.json").read_text())
    assert top["camera_model"] == "OPENCV_FISHEYE"
    assert [top[key] for key in ("k1", "k2", "k3", "k4")] == list(lenses[0].distortion)
    shutil.rmtree(tmp_path / "ours" / "sparse")
    assert read_posed(tmp_path / "ours", False).lenses == lenses
