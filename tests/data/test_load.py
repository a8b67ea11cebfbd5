import json
import logging
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scenes_on_disk import (
    BARREL,
    FISHEYE,
    PINHOLE,
    UTM,
    Truth,
    survey,
    with_one_larger,
    write_blender,
    write_colmap,
    write_llff,
    write_pictures,
    write_transforms,
)
from shared_data import SHARED

from tidefield.data.georeference import read_georeference
from tidefield.data.images import read_at_size
from tidefield.data.load import at_twice_the_size, at_width, load_scene, own_lens
from tidefield.data.pictures import read_header
from tidefield.data.scene import Scene
from tidefield.errors import SceneError
from tidefield.geometry.lenses import rectify

REAL = SHARED / "scenes"


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def reprojection_px(scene: Scene) -> torch.Tensor:
    """Distances between observations and where their points project."""
    points = scene.points
    assert points is not None
    uv, depth = scene.cameras.project(points.xyz_world)
    assert (depth[points.camera_index, points.point_index] > 0).all()
    return (uv[points.camera_index, points.point_index] - points.uv_px).norm(dim=-1)


def assert_poses(scene: Scene, truth: Truth, flat: bool = False) -> None:
    names = [name.replace("/", "_") if flat else name for name in truth.names]
    order = np.argsort(names)
    assert scene.names == tuple(names[i] for i in order)
    pose = scene.cameras.T_world_camera.double().numpy()
    np.testing.assert_allclose(pose[:, :, :3], truth.T_world_camera[order][:, :, :3], atol=1e-6)
    position = pose[:, :, 3] + scene.origin_world.numpy()
    np.testing.assert_allclose(position, truth.T_world_camera[order][:, :, 3], atol=1e-5)


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("folder", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_a_colmap_model_loads_as_an_undistorted_scene(tmp_path: Path, text: bool, folder: str) -> None:
    truth = survey(BARREL)
    write_colmap(tmp_path, truth, text, folder)
    scene = load_scene(tmp_path)
    assert_poses(scene, truth)
    assert reprojection_px(scene).max() < 1e-3
    assert scene.points is not None
    assert scene.points.error_px.max() < 1e-3
    assert len(scene.points.uv_px) > 1000
    assert (scene.points.uv_px < torch.tensor([64, 48])).all()
    assert scene.test == (0, 8)
    assert scene.background_rgb is None


def test_a_scenes_folder_may_be_a_string(tmp_path: Path) -> None:
    write_colmap(tmp_path, survey(BARREL))
    scene = load_scene(str(tmp_path))
    assert scene.root == tmp_path
    assert scene.cameras["photo_3"].names == ("strip_1/photo_3.png",)
    assert repr(scene).startswith(f"Scene({tmp_path.name!r}, 9 photographs 64x48, 7 train, 2 test, ")


def test_every_layout_gives_the_same_cameras(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    write_colmap(tmp_path / "colmap", truth)
    write_transforms(tmp_path / "nerfstudio", truth)
    write_llff(tmp_path / "llff", truth)
    expected = load_scene(tmp_path / "colmap").cameras
    for layout in ("nerfstudio", "llff"):
        scene = load_scene(tmp_path / layout)
        assert_poses(scene, truth, flat=layout == "llff")
        for part in ("T_world_camera", "focal_px", "principal_px", "size_px"):
            torch.testing.assert_close(getattr(scene.cameras, part), getattr(expected, part))


def test_coordinates_of_a_map_projection_keep_their_precision(tmp_path: Path) -> None:
    truth = survey(BARREL, offset=UTM)
    write_colmap(tmp_path, truth)
    scene = load_scene(tmp_path)
    assert_poses(scene, truth)
    assert reprojection_px(scene).max() < 1e-3


def test_a_scene_may_have_several_sizes_and_lenses(tmp_path: Path) -> None:
    truth = with_one_larger(survey(BARREL))
    write_colmap(tmp_path, truth)
    scene = load_scene(tmp_path)
    larger = scene.index(truth.names[3])
    for i in range(9):
        size = (128, 96) if i == larger else (64, 48)
        assert scene.cameras.size_px[i].tolist() == list(size)
        assert scene.photographs[i].shape == (size[1], size[0], 3)
    assert (scene.photographs[larger].numpy() == truth.pictures[3]).all()
    assert reprojection_px(scene).max() < 1e-3
    narrow = load_scene(tmp_path, width=100)
    assert sorted(set(narrow.cameras.size_px[:, 0].tolist())) == [64, 100]  # reduced, never enlarged


def test_a_width_scales_cameras_pictures_and_observations_together(tmp_path: Path) -> None:
    write_colmap(tmp_path, survey(BARREL))
    full, half = load_scene(tmp_path), load_scene(tmp_path, width=32)
    assert half.cameras.size_px.unique(dim=0).tolist() == [[32, 24]]
    torch.testing.assert_close(half.cameras.focal_px * 2, full.cameras.focal_px)
    torch.testing.assert_close(half.cameras.principal_px * 2, full.cameras.principal_px)
    assert half.points is not None
    assert full.points is not None
    torch.testing.assert_close(half.points.uv_px * 2, full.points.uv_px)
    means = full.photographs[2].double().reshape(24, 2, 32, 2, 3).mean(dim=(1, 3))
    assert (half.photographs[2] - means).abs().max() <= 2  # cubic, where the larger ones were made with Lanczos
    with pytest.raises(SceneError, match="width is 3 pixels"):
        load_scene(tmp_path, width=3)


def test_photographs_of_another_size_need_the_aspect_of_their_lens(tmp_path: Path) -> None:
    truth = survey(BARREL)
    write_colmap(tmp_path, truth)
    for name in truth.names:
        path = tmp_path / "images" / name
        Image.open(path).resize((32, 24)).save(path)
    scene = load_scene(tmp_path)
    assert scene.cameras.size_px[0].tolist() == [32, 24]
    assert reprojection_px(scene).max() < 1e-3
    Image.new("RGB", (48, 64)).save(tmp_path / "images" / truth.names[0])
    with pytest.raises(SceneError, match=r"photo_8\.png has 48 x 64 pixels, but its camera has 64 x 48.*rotated"):
        load_scene(tmp_path)


def test_near_and_far_include_margins_above_and_below_the_ground(tmp_path: Path) -> None:
    write_colmap(tmp_path, survey(BARREL))
    scene = load_scene(tmp_path)
    near, far = scene.cameras.near_far.unbind(dim=1)
    assert ((near > 3) & (near < 6)).all()  # the ground lies 8 to 12 m away, along the axes of tilted cameras
    assert ((far > 12) & (far < 20)).all()


def test_the_layouts_own_split_is_kept(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    files = [f"images/{name}" for name in truth.names]
    write_transforms(tmp_path, truth, train_filenames=files[:5], val_filenames=files[5:7], test_filenames=files[7:])
    scene = load_scene(tmp_path)
    assert {scene.names[i] for i in scene.train} == set(truth.names[:5])
    assert {scene.names[i] for i in scene.test} == set(truth.names[7:])
    assert len(scene.names) == 7


@pytest.mark.parametrize("form", ["no folder", "no suffix", "elsewhere", "rig"])
def test_a_split_means_frames_by_shorter_and_longer_paths(form: str, tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    if form == "rig":  # cameras whose photographs have the same names
        truth = replace(truth, names=tuple(f"cam{k % 3}/images/{k // 3}.png" for k in range(9)))
    files = {
        "rig": [f"/home/me/rig/images/{name}" for name in truth.names],
        "no folder": list(truth.names),
        "no suffix": [f"images/{name}".removesuffix(".png") for name in truth.names],
        "elsewhere": [f"/home/me/images_2/{name}" for name in truth.names],
    }[form]
    write_transforms(tmp_path, truth, train_filenames=files[:7], test_filenames=files[7:])
    scene = load_scene(tmp_path)
    assert {scene.names[i] for i in scene.test} == set(truth.names[7:])
    assert len(scene.train) == 7


def test_a_split_of_photographs_that_no_frame_has_is_refused(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    truth = survey(PINHOLE)
    files = [f"images/{name}" for name in truth.names]
    write_transforms(tmp_path, truth, train_filenames=files, test_filenames=["other/x.png"])
    with pytest.raises(SceneError, match=r"transforms\.json lists other/x\.png for training or testing, which none of"):
        load_scene(tmp_path)
    assert load_scene(tmp_path, allow_missing=True).test == (0, 8)
    assert "lists other/x.png for training or testing, which none of its frames has: left out" in caplog.text
    assert "every eighth is held out" in caplog.text


def test_other_models_of_colmap_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    truth = survey(PINHOLE)
    parts = [replace(truth, **{f: getattr(truth, f)[:3] for f in ("names", "lenses", "T_world_camera", "pictures")})]
    for number, part in enumerate([*parts, truth]):
        write_colmap(tmp_path, part, place=f"sparse/{number}")
    assert len(load_scene(tmp_path).names) == 3
    assert "has several COLMAP models, which are not connected: 0 is used, not 1; if another has more" in caplog.text


def test_photographs_may_be_larger_than_a_camera_of_rounded_size(tmp_path: Path) -> None:
    for camera, size in (((1000, 667), (6000, 4000)), ((800, 533), (6000, 4000)), ((1600, 1067), (5472, 3648))):
        Image.new("L", size).save(tmp_path / "a.png")
        lens = PINHOLE.resized(*camera)
        assert own_lens(tmp_path / "a.png", lens)[0].width == size[0]
        with pytest.raises(SceneError, match="or the same aspect"):
            own_lens(tmp_path / "a.png", replace(lens, height=lens.height + 4))


def test_a_tiff_of_other_bands_is_to_be_converted(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "a.tif"
    place = rasterio.Affine(1, 0, 5, 0, -1, 5)
    with rasterio.open(path, "w", "GTiff", 8, 6, 3, dtype="uint16", transform=place) as file:
        file.write(np.ones((3, 6, 8), np.uint16))
    with pytest.raises(SceneError, match="expected 8 bits per colour, in grey or in red, green and blue; convert it"):
        read_header(path)


@pytest.mark.parametrize("folder", ["", "card/images/"])
def test_a_split_next_to_a_colmap_model_is_kept_where_it_lists_its_photographs(
    folder: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    truth = survey(PINHOLE)
    truth = replace(truth, names=tuple(folder + name for name in truth.names))
    files = [f"images/{name}" for name in truth.names]
    write_transforms(tmp_path, truth, train_filenames=files[:6], val_filenames=["./" + file for file in files[6:]])
    write_colmap(tmp_path, truth)
    scene = load_scene(tmp_path)
    assert {scene.names[i] for i in scene.test} == set(truth.names[6:])
    assert len(scene.train) == 6
    assert load_scene(tmp_path, hold_out=False).test == ()
    top = json.loads((tmp_path / "transforms.json").read_text())
    for place in ("images_2/", "/home/me/flats/images/"):
        smaller = {key: [name.replace("images/", place, 1) for name in top[key]] for key in top if "_filenames" in key}
        (tmp_path / "transforms.json").write_text(json.dumps(top | smaller))
        assert len(load_scene(tmp_path).train) == 6
    assert caplog.messages == []
    top = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").write_text(json.dumps({**top, "val_filenames": files[7:]}))
    scene = load_scene(tmp_path)
    assert scene.test == (0, 8)
    assert "a split of other photographs than the COLMAP model next to it: every eighth is held out" in caplog.text
    for content, fault in (("{", "is damaged"), (json.dumps({**top, "train_filenames": [5]}), "not a list of file")):
        (tmp_path / "transforms.json").write_text(content)
        with pytest.raises(SceneError, match=rf"transforms\.json .*{fault}"):
            load_scene(tmp_path)


def test_a_blender_scene_keeps_alpha_split_and_background(tmp_path: Path) -> None:
    write_blender(tmp_path, {"train": 6, "val": 2, "test": 3})
    scene = load_scene(tmp_path)
    assert [scene.names[i] for i in scene.test] == ["test/r_0.png", "test/r_1.png", "test/r_2.png"]
    assert len(scene.train) == 6
    assert len(scene.names) == 9
    assert scene.background_rgb == (1.0, 1.0, 1.0)
    assert scene.photographs[0][0, 0].tolist() == [255, 255, 255]
    assert scene.photographs[0][20, 20].tolist() == [200, 100, 0]
    assert scene.photographs[0][20, 32].tolist() == [227, 177, 127]
    alpha = scene.photographs.alpha(0)
    assert alpha is not None
    assert sorted(alpha.unique().tolist()) == [0, 128, 255]
    torch.testing.assert_close(scene.cameras.focal_px, torch.full((9, 2), 0.5 * 40 / np.tan(0.35)))
    torch.testing.assert_close(scene.cameras.near_far, torch.tensor([[2.0, 6.0]]).expand(9, 2))
    uv, depth = scene.cameras.project((-scene.origin_world[None]).float())  # they all look at the origin
    torch.testing.assert_close(uv[:, 0], torch.full((9, 2), 20.0))
    torch.testing.assert_close(depth[:, 0], torch.full((9,), 4.0))


def test_llff_bounds_become_ranges_with_a_margin(tmp_path: Path) -> None:
    write_llff(tmp_path, survey(PINHOLE))
    near_far = load_scene(tmp_path).cameras.near_far
    torch.testing.assert_close(near_far, torch.tensor([[6.0, 13.75]]).expand(9, 2))


def test_missing_photographs_are_named_and_can_be_left_out(tmp_path: Path) -> None:
    truth = survey(BARREL)
    write_colmap(tmp_path, truth)
    gone = [truth.names[i] for i in (0, 4)]
    for name in gone:
        (tmp_path / "images" / name).unlink()
    with pytest.raises(SceneError, match=r"2 of the 9 photographs .*photo_[84]\.png.*--allow-missing"):
        load_scene(tmp_path)
    scene = load_scene(tmp_path, allow_missing=True)
    assert len(scene.names) == 7
    assert not set(gone) & set(scene.names)
    assert reprojection_px(scene).max() < 1e-3
    assert scene.points is not None
    assert int(scene.points.camera_index.max()) == 6


def test_a_photograph_that_a_model_names_twice_is_refused(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, survey(BARREL), text=True)
    lines = [line for line in (folder / "images.txt").read_text().splitlines() if not line.startswith("#")]
    (folder / "images.txt").write_text("\n".join([*lines, lines[0], ""]) + "\n")
    with pytest.raises(SceneError, match=r"two poses for one photograph \((.*\.png) and \1\): .*each photograph once"):
        load_scene(tmp_path)


@pytest.mark.parametrize("link", [Path.symlink_to, Path.hardlink_to])
def test_two_names_of_one_photograph_are_refused(tmp_path: Path, link: object) -> None:
    truth = survey(PINHOLE)
    write_transforms(tmp_path, truth)
    copy = tmp_path / "images" / truth.names[4]
    copy.unlink()
    assert callable(link)
    link(copy, tmp_path / "images" / truth.names[0])
    with pytest.raises(SceneError, match=r"two poses for one photograph \(strip_0/photo_8\.png and strip_1/photo_4"):
        load_scene(tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
@pytest.mark.parametrize(
    ("closed", "named"),
    [
        (".", "sparse/0/cameras.bin"),
        ("sparse/0", "sparse/0/cameras.bin"),
        ("sparse/0/images.bin", "sparse/0/images.bin"),
        ("images", "images/strip_0/photo_8.png"),
        ("images/strip_0/photo_8.png", "images/strip_0/photo_8.png"),
        ("georeference.json", "georeference.json"),
    ],
)
def test_what_may_not_be_read_is_named(tmp_path: Path, closed: str, named: str) -> None:
    write_colmap(tmp_path, survey(BARREL))
    (tmp_path / "georeference.json").write_text("{}")
    mode = (tmp_path / closed).stat().st_mode
    (tmp_path / closed).chmod(0)
    read = read_georeference if closed == "georeference.json" else load_scene
    try:
        with pytest.raises(SceneError, match=rf"{named} cannot be read.*Permission denied"):
            read(tmp_path)
    finally:
        (tmp_path / closed).chmod(mode)


@pytest.mark.parametrize("position", [1e16, 1e300])
@pytest.mark.parametrize("layout", ["colmap", "transforms", "llff", "blender"])
def test_positions_that_float32_cannot_hold_are_refused(tmp_path: Path, layout: str, position: float) -> None:
    truth = survey(PINHOLE)
    truth.T_world_camera[4, 0, 3] = position
    if layout == "colmap":
        write_colmap(tmp_path, truth)
    elif layout == "llff":
        write_llff(tmp_path, truth)
    elif layout == "transforms":
        write_transforms(tmp_path, truth)
    else:
        write_blender(tmp_path, {"train": 5})
        top = json.loads((tmp_path / "transforms_train.json").read_text())
        top["frames"][1]["transform_matrix"][0][3] = position
        (tmp_path / "transforms_train.json").write_text(json.dumps(top))
    with pytest.raises(SceneError, match=r"the pose of .*(photo_4|r_1)\.png has numbers that are not finite, or over"):
        load_scene(tmp_path)


def test_points_that_float32_cannot_hold_are_left_out(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, survey(BARREL), text=True)
    before = load_scene(tmp_path).points
    text = (folder / "points3D.txt").read_text()
    first = next(line for line in text.splitlines() if not line.startswith("#"))
    number, _, *rest = first.split()
    (folder / "points3D.txt").write_text(text.replace(first, " ".join([number, "1e300", *rest])))
    after = load_scene(tmp_path).points
    assert before is not None
    assert after is not None
    assert len(after.xyz_world) == len(before.xyz_world) - 1


def test_a_lens_that_folds_everywhere_is_refused_with_its_photograph(tmp_path: Path) -> None:
    for number, k1 in enumerate((1e11, -1e11)):
        write_transforms(tmp_path / f"{number}", survey(replace(PINHOLE, k1=k1)))
        with pytest.raises(SceneError, match=r"photo_\d\.png: .*leaves nothing of its photographs"):
            load_scene(tmp_path / f"{number}")


def test_large_photographs_and_damaged_exif_are_read_without_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = survey(PINHOLE)
    write_transforms(tmp_path, truth)
    exif = Image.Exif()
    exif[0x010F] = "a camera of a long name"
    Image.fromarray(truth.pictures[0]).save(tmp_path / "images" / truth.names[0], exif=exif.tobytes()[:-30])
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 64 * 48 - 1)  # from here Pillow warns, from its double it refuses
    assert len(load_scene(tmp_path).names) == 9  # warnings are errors here


def test_fewer_than_three_photographs_are_refused(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    short = replace(truth, names=truth.names[:2], lenses=truth.lenses[:2], T_world_camera=truth.T_world_camera[:2])
    write_transforms(tmp_path, replace(short, pictures=truth.pictures[:2]))
    with pytest.raises(SceneError, match="2 posed photographs: expected at least 3"):
        load_scene(tmp_path)


@pytest.mark.parametrize("content", [(), ("notes.txt",), ("images/a.png", "images/b.png")])
def test_a_folder_that_is_no_scene_lists_its_files_and_the_layouts(tmp_path: Path, content: tuple[str, ...]) -> None:
    root = tmp_path / "scene"
    root.mkdir()
    for name in content:
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).touch()
    with pytest.raises(SceneError) as caught:
        load_scene(root)
    message = str(caught.value)
    assert f"found: {content[0].split('/')[0] if content else 'nothing'}" in message
    assert all(layout in message for layout in ("sparse/0", "transforms.json", "transforms_train", "poses_bounds"))
    with pytest.raises(SceneError, match="nowhere is missing"):
        load_scene(root / "nowhere")


def _turned(matrix: np.ndarray) -> np.ndarray:
    return np.diag([1.0, 1.0, -1.0, 1.0]) @ matrix


def _scaled(matrix: np.ndarray) -> np.ndarray:
    return matrix * 1.01


def _not_finite(matrix: np.ndarray) -> np.ndarray:
    return matrix * float("nan")


@pytest.mark.parametrize("spoil", [_turned, _scaled, _not_finite])
def test_invalid_poses_are_refused_and_named(tmp_path: Path, spoil: object) -> None:
    truth = survey(PINHOLE)
    file = write_transforms(tmp_path, truth)
    top = json.loads(file.read_text())
    assert callable(spoil)
    top["frames"][4]["transform_matrix"] = spoil(np.array(top["frames"][4]["transform_matrix"])).tolist()
    file.write_text(json.dumps(top))
    with pytest.raises(SceneError, match=r"the pose of strip_1/photo_4\.png .*(finite|rotation)"):
        load_scene(tmp_path)


def test_rotations_are_orthonormalised(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    noise = np.random.default_rng(0).normal(0, 1e-5, (9, 3, 4))
    write_transforms(tmp_path, replace(truth, T_world_camera=truth.T_world_camera + noise))
    rotation = load_scene(tmp_path).cameras.T_world_camera[:, :, :3]
    torch.testing.assert_close(rotation.mT @ rotation, torch.eye(3).expand(9, 3, 3), atol=1e-6, rtol=0)


def test_transparent_photographs_of_any_layout_get_a_white_background(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    clear = tuple(np.dstack([picture, np.full(picture.shape[:2], 255, np.uint8)]) for picture in truth.pictures)
    write_transforms(tmp_path, replace(truth, pictures=clear))
    assert load_scene(tmp_path).background_rgb is None
    for picture in clear:
        picture[:10, :, 3] = 0
    write_pictures(tmp_path / "images", replace(truth, pictures=clear))
    scene = load_scene(tmp_path)
    assert scene.background_rgb == (1.0, 1.0, 1.0)
    assert (scene.photographs[scene.index(truth.names[2])][:10] == 255).all()


def test_transparent_corners_of_all_photographs_are_no_background(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Sparse points lie behind those of other photographs, unlike behind what surrounds an object."""
    caplog.set_level(logging.INFO)
    truth, (v, u) = survey(PINHOLE), np.mgrid[:48, :64]
    corners = np.where(np.hypot(u - 31.5, v - 23.5) > 34, 0, 255).astype(np.uint8)
    clear = replace(truth, pictures=tuple(np.dstack([picture, corners]) for picture in truth.pictures))
    write_colmap(tmp_path / "ground", clear)
    scene = load_scene(tmp_path / "ground")
    assert scene.background_rgb is None
    assert scene.hull is None
    assert (scene.photographs.used(1).numpy() == (corners > 0)).mean() > 0.98
    assert "photo_4.png and 4 more are not used, as if they were masked" in caplog.text
    # Of an object, every photograph shows the same points.
    uv = [PINHOLE.project((truth.ground - pose[:, 3]) @ pose[:, :3]) for pose in truth.T_world_camera]
    around = [np.zeros((48, 64), np.uint8) for _ in uv]
    thing = np.hypot(*truth.ground[:, :2].T) < 2
    for alpha, pixels in zip(around, uv, strict=True):
        for x, y in pixels[thing]:
            cv2.circle(alpha, (round(x), round(y)), 2, 255, -1)
    cut = replace(truth, pictures=tuple(np.dstack([*own]) for own in zip(truth.pictures, around, strict=True)))
    write_colmap(tmp_path / "thing", cut)
    assert load_scene(tmp_path / "thing").background_rgb == (1.0, 1.0, 1.0)


def test_transparent_pixels_of_some_photographs_alone_are_masked(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    truth = survey(PINHOLE)
    pictures = list(truth.pictures)
    for k in (2, 3):
        pictures[k] = np.dstack([pictures[k], np.full((48, 64), 255, np.uint8)])
    pictures[3][:10, :, 3] = 0
    write_transforms(tmp_path, replace(truth, pictures=tuple(pictures)))
    scene = load_scene(tmp_path)
    index = scene.index(truth.names[3])
    assert scene.background_rgb is None
    assert scene.hull is None
    assert f"transparent pixels of {Path(truth.names[3]).name} are not used" in caplog.text
    for own in (scene, at_width(scene, 32), at_twice_the_size(at_width(scene, 32))):
        assert own is not None
        used, colours = own.photographs.used(index), own.photographs[index]
        rows = 10 * len(used) // 48
        assert not used[:rows].any()
        assert used[rows + 1 :].all()
        assert all(own.photographs.used(i).all() for i in range(9) if i != index)
        assert (colours[: rows - 1] < 255).any(-1).all(), "of the nearest used pixels"
    mask = read_at_size(scene.photographs, index, 64, 48)[1]
    assert mask is not None
    assert torch.equal(scene.photographs.used(index), mask)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["caliterra", "brighton_beach", "swindale", "turin_lot", "fern", "lego"])
def test_real_scenes_load_with_sane_ranges_and_points_where_they_were_seen(name: str) -> None:
    if not (REAL / name).is_dir():
        pytest.skip(f"{REAL / name} is not there")
    scene = load_scene(REAL / name, width=100)
    assert scene.cameras.size_px[:, 0].unique().tolist() == [100]
    assert torch.isfinite(scene.cameras.near_far).all()
    assert (scene.cameras.near_far[:, 0] > 0).all()
    assert (scene.cameras.near_far[:, 0] < scene.cameras.near_far[:, 1]).all()
    assert min(len(scene.train), len(scene.test)) >= 3
    if name not in ("fern", "lego"):
        distance_px = reprojection_px(scene)
        assert distance_px.max() < 2
        assert distance_px.median() < 0.1


@pytest.mark.parametrize("layout", ["colmap", "transforms.json", "instant-ngp"])
def test_photographs_of_a_fisheye_become_pinhole_ones(tmp_path: Path, layout: str) -> None:
    truth = survey(FISHEYE)
    if layout == "colmap":
        write_colmap(tmp_path, truth)
    elif layout == "transforms.json":
        write_transforms(tmp_path, truth, camera_model="OPENCV_FISHEYE")
    else:
        write_transforms(tmp_path, truth, camera_model="OPENCV", is_fisheye=True)
    scene = load_scene(tmp_path)
    pinhole = FISHEYE.pinhole()
    assert scene.cameras.focal_px[0].tolist() == pytest.approx([pinhole.fx, pinhole.fy])
    index = scene.names.index(truth.names[0])
    assert torch.equal(scene.photographs[index], torch.from_numpy(rectify(truth.pictures[0], FISHEYE, 64, 48)))
    if layout == "colmap":
        points = scene.points
        assert points is not None
        assert points.error_px.max() < 0.01
        uv = scene.cameras.project(points.xyz_world)[0]
        off = uv[points.camera_index, points.point_index] - points.uv_px
        assert off.abs().max() < 0.01
