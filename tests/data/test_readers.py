import json
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scenes_on_disk import BARREL, PINHOLE, survey, write_blender, write_colmap, write_llff, write_transforms

from tidefield.data.pictures import read_header
from tidefield.data.ply import read_ply
from tidefield.data.readers.colmap import find_colmap, read_colmap
from tidefield.data.readers.files import inside, opened
from tidefield.data.readers.llff import read_llff
from tidefield.data.readers.transforms import read_blender, read_transforms
from tidefield.errors import SceneError


def change(file: Path, **values: object) -> None:
    """Set values of a JSON file's first frame, which stand over those of the whole file."""
    top = json.loads(file.read_text())
    top["frames"][0] |= values
    file.write_text(json.dumps(top))


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_a_model_is_read_as_pycolmap_reads_it(tmp_path: Path, text: bool) -> None:
    folder = write_colmap(tmp_path, survey(BARREL), text)
    own, theirs = read_colmap(tmp_path, folder, False), pycolmap.Reconstruction(str(folder))
    assert own.points is not None
    assert len(own.points.xyz_world) == len(theirs.points3D)
    for i, name in enumerate(own.names):
        image = theirs.find_image_with_name(name)
        assert image is not None
        inverse = image.cam_from_world().inverse().matrix()
        np.testing.assert_allclose(own.T_world_camera[i], inverse, atol=1e-9)
        seen = [p for p in image.points2D if p.has_point3D()]
        mine = own.points.photograph_index == i
        np.testing.assert_allclose(own.points.uv_px[mine], [p.xy for p in seen], atol=1e-9)
        xyz = [theirs.points3D[p.point3D_id].xyz for p in seen]
        np.testing.assert_allclose(own.points.xyz_world[own.points.point_index[mine]], xyz, atol=1e-9)
        camera = theirs.cameras[image.camera_id]
        np.testing.assert_allclose(
            own.lenses[i].project(np.array([[0.1, 0.2, 1]])), [camera.img_from_cam([0.1, 0.2, 1])]
        )


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("keep", [0, 4, 12, 30, -1, -100])
def test_truncated_models_are_refused(tmp_path: Path, file: str, keep: int) -> None:
    folder = write_colmap(tmp_path, survey(BARREL))
    content = (folder / file).read_bytes()
    (folder / file).write_bytes(content[:keep])
    with pytest.raises(SceneError, match=rf"{file} is damaged"):
        read_colmap(tmp_path, folder, False)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_models_of_random_bytes_are_refused(tmp_path: Path, file: str) -> None:
    folder = write_colmap(tmp_path, survey(BARREL))
    (folder / file).write_bytes(np.random.default_rng(0).bytes(5000))
    with pytest.raises(SceneError, match="damaged"):
        read_colmap(tmp_path, folder, False)


def test_a_text_model_whose_pose_lacks_a_number_is_refused(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, survey(BARREL), text=True)
    lines = (folder / "images.txt").read_text().splitlines()
    (folder / "images.txt").write_text("\n".join([*lines, "77 1 0 0 0 1 2 1 short.png", ""]) + "\n")
    with pytest.raises(SceneError, match=r"images\.txt is damaged"):
        read_colmap(tmp_path, folder, False)


@pytest.mark.parametrize("special", ["pipe", "device", "folder"])
def test_only_regular_files_are_opened(tmp_path: Path, special: str) -> None:
    folder = write_colmap(tmp_path, survey(BARREL))
    places = [folder / "images.bin", tmp_path / "images" / survey(BARREL).names[0]]
    for place in places:
        place.unlink()
        {"pipe": os.mkfifo, "folder": os.mkdir, "device": lambda path: path.symlink_to("/dev/zero")}[special](place)
    with pytest.raises(SceneError, match=r"images\.bin is a folder, a pipe or a device"):
        read_colmap(tmp_path, folder, False)
    with pytest.raises(SceneError, match=r"photo_8\.png is a folder, a pipe or a device"):
        read_header(places[1])


def test_a_file_that_states_no_size_counts_as_empty() -> None:
    with opened(Path("/proc/self/environ"), "nothing", 1) as file:
        assert file.read() == b""


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("cameras.txt", "OPENCV 64", "OPENCV sixty"),
        ("cameras.txt", "OPENCV 64 48 50", "OPENCV 64 48 nan"),
        ("images.txt", "strip_0", ""),
        ("points3D.txt", "\n1 ", "\none "),
        ("points3D.txt", "\n1 ", f"\n{1 << 63} "),
    ],
)
def test_garbled_text_models_are_refused(tmp_path: Path, file: str, old: str, new: str) -> None:
    folder = write_colmap(tmp_path, survey(BARREL), text=True)
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    with pytest.raises(SceneError):
        read_colmap(tmp_path, folder, False)


@pytest.mark.thorough
def test_many_points_take_little_memory(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, survey(BARREL))
    layout = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    points = np.zeros(4_000, np.dtype(layout))
    (folder / "points3D.bin").write_bytes(np.uint64(len(points)).tobytes() + points.tobytes())
    tracemalloc.start()
    read_colmap(tmp_path, folder, False)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * points.nbytes, "the file, and an array"


def test_a_model_without_its_images_file_is_refused(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, survey(BARREL))
    (folder / "images.bin").unlink()
    with pytest.raises(SceneError, match=r"images\.bin cannot be read"):
        read_colmap(tmp_path, folder, False)


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_an_unsupported_camera_model_is_named(tmp_path: Path, text: bool) -> None:
    model = pycolmap.Reconstruction()
    parameters = [50.0, 50.0, 32.0, 24.0, *[0.0] * 8]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="THIN_PRISM_FISHEYE", width=64, height=48, params=parameters)
    )
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(folder))
    assert find_colmap(tmp_path, "sparse/0") == folder
    with pytest.raises(SceneError, match=r"model THIN_PRISM_FISHEYE: supported are .*image_undistorter"):
        read_colmap(tmp_path, folder, False)


def test_names_with_spaces_and_images_that_saw_nothing_are_read_from_text(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, survey(BARREL), text=True)
    (tmp_path / "images" / "my flight.png").write_bytes(b"")
    with (folder / "images.txt").open("a") as file:
        file.write("77 1 0 0 0 1 2 3 1 my flight.png\n\n")
    posed = read_colmap(tmp_path, folder, False)
    assert posed.names[-1] == "my flight.png"
    np.testing.assert_allclose(posed.T_world_camera[-1, :, 3], [-1, -2, -3])


def test_angles_and_focal_lengths_give_the_same_lens(tmp_path: Path) -> None:
    file = write_transforms(tmp_path, survey(BARREL))
    top = json.loads(file.read_text())
    del top["frames"][1]["fl_x"], top["frames"][1]["fl_y"]
    top["frames"][1] |= {"camera_angle_x": 2 * np.arctan(32 / 50), "camera_angle_y": 2 * np.arctan(24 / 51)}
    file.write_text(json.dumps(top))
    first, second = read_transforms(tmp_path, False).lenses[:2]
    assert first == BARREL
    assert second.fx == pytest.approx(50)
    assert second.fy == pytest.approx(51)


def test_values_missing_in_frames_come_from_the_top_or_the_photograph(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    file = write_transforms(tmp_path, truth, fl_x=60.0, k3=0.01)
    top = json.loads(file.read_text())
    for frame in top["frames"]:
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del frame[key]
        frame["file_path"] = frame["file_path"].removesuffix(".png")  # PNG is meant, as in Blender's files
    file.write_text(json.dumps(top))
    lens = read_transforms(tmp_path, False).lenses[0]
    assert (lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy) == (64, 48, 60.0, 60.0, 32.0, 24.0)
    assert lens.k3 == 0.01


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"camera_model": "FISHEYE624"}, "camera model FISHEYE624.*undistort"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera model EQUIRECTANGULAR"),
        ({"ftheta_p0": 0.0}, "camera model F-Theta"),
        ({"is_fisheye": True, "k5": 0.1}, "the term k5"),
        ({"k4": 0.1}, "the term k4"),
        ({"fl_x": "wide"}, "fl_x = 'wide'"),
        ({"fl_x": float("nan")}, "fl_x = nan"),
        ({"fl_x": 0.0}, r"transforms\.json, photo_8\.png: a camera has the unusable calibration"),
        ({"fl_x": 10**400}, r"fl_x = 1000.*\.\.\.: expected a number"),
        ({"w": 10**24}, "w = 1000"),
        ({"cx": -5000.0}, "unusable calibration"),
        ({"k1": 1e300}, "k1 = "),
        ({"fl_x": 1e38}, "fl_x = 1e"),
        ({"fl_y": 1e-30}, "unusable calibration"),
        ({"transform_matrix": [[1, 2], [3, 4]]}, "4 x 4 transform_matrix"),
        ({"transform_matrix": "identity"}, "4 x 4 transform_matrix"),
        ({"file_path": 7}, "file_path"),
    ],
)
def test_unusable_frames_are_refused(tmp_path: Path, values: dict[str, object], message: str) -> None:
    change(write_transforms(tmp_path, survey(PINHOLE)), **values)
    with pytest.raises(SceneError, match=message):
        read_transforms(tmp_path, False)


@pytest.mark.parametrize("name", ["../outside.png", "/etc/hostname", "images/../../outside.png", "", "a\0b"])
def test_paths_that_leave_the_scene_are_refused(tmp_path: Path, name: str) -> None:
    root = tmp_path / "scene"
    file = write_transforms(root, survey(PINHOLE))
    (tmp_path / "outside.png").write_bytes(b"secret")
    change(file, file_path=name)
    with pytest.raises(SceneError, match="outside of the scene's folder"):
        read_transforms(root, False)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a" * 5000, r"cannot be read \(File name too long\)"),
        ("loop/a.png", r"cannot be read \(Too many levels of symbolic links\)"),
        ("\ud800.png", r"transforms\.json is damaged \(.*surrogates"),
    ],
)
def test_names_that_the_system_refuses_are_said_to_be_no_more_than_that(
    tmp_path: Path, name: str, message: str
) -> None:
    (tmp_path / "loop").symlink_to("loop")
    change(write_transforms(tmp_path, survey(PINHOLE)), file_path=name)
    with pytest.raises(SceneError, match=message):
        read_transforms(tmp_path, False)


def test_links_may_lead_out_only_as_a_whole_folder(tmp_path: Path) -> None:
    root, disk = tmp_path / "scene", tmp_path / "disk"
    root.mkdir()
    disk.mkdir()
    (disk / "a.png").write_bytes(b"")
    (tmp_path / "secret.png").write_bytes(b"")
    (root / "images").symlink_to(disk)
    (root / "link.png").symlink_to(disk / "a.png")
    (disk / "secret.png").symlink_to(tmp_path / "secret.png")
    assert inside(root, "images/a.png", root).is_file()
    for name in ("link.png", "images/secret.png"):
        with pytest.raises(SceneError, match="outside"):
            inside(root, name, root)


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"frames": 3}', '{"frames": [3]}', "[" * 100_000])
def test_invalid_transforms_json_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(SceneError, match=r"transforms\.json .*export it again"):
        read_transforms(tmp_path, False)


def test_oversized_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "large").write_bytes(bytes(1_000_001))
    with pytest.raises(SceneError, match="at most 1 MB"):
        opened(tmp_path / "large", "less", 1).__enter__()
    with opened(tmp_path / "large", "less", 2) as file:
        assert len(file.read()) == 1_000_001


def _ascii_ply(xyz: np.ndarray) -> bytes:
    header = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    header += "property uint8 red\nend_header\n"
    return (header.format(len(xyz)) + "".join(f"{x:.9g} {y:.9g} {z:.9g} 7\n" for x, y, z in xyz)).encode()


def _binary_ply(xyz: np.ndarray) -> bytes:
    header = "ply\nformat binary_little_endian 1.0\ncomment ours\nelement vertex {}\nproperty uchar red\n"
    header += "property double x\nproperty double y\nproperty double z\nelement face 0\n"
    header += "property list uchar int vertex_index\nend_header\n"
    table = np.zeros(len(xyz), np.dtype([("red", "u1"), ("xyz", "<f8", 3)]))
    table["xyz"] = xyz
    return header.format(len(xyz)).encode() + table.tobytes()


@pytest.mark.parametrize("write", [_ascii_ply, _binary_ply])
def test_point_clouds_are_read_completely_or_refused(tmp_path: Path, write: object) -> None:
    assert callable(write)
    xyz = np.random.default_rng(0).normal(0, 5, (20, 3)).astype(np.float32).astype(np.float64)
    (tmp_path / "a.ply").write_bytes(write(xyz))
    cloud = read_ply(tmp_path / "a.ply")
    assert cloud is not None
    np.testing.assert_allclose(cloud[0], xyz, rtol=1e-7)
    assert cloud[1] is None  # red alone is no colour
    (tmp_path / "a.ply").write_bytes(write(xyz)[:-30])
    with pytest.raises(SceneError, match=r"damaged .*complete PLY"):
        read_ply(tmp_path / "a.ply")
    for count in (2**63, 10**30, -1):
        (tmp_path / "a.ply").write_bytes(write(xyz).replace(b"vertex 20", b"vertex %d" % count))
        with pytest.raises(SceneError, match=r"damaged .*complete PLY"):
            read_ply(tmp_path / "a.ply")


def test_the_cloud_of_a_transforms_json_is_read(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    write_transforms(tmp_path, truth, ply_file_path="points.ply")
    with pytest.raises(SceneError, match=r"points\.ply, which are missing"):
        read_transforms(tmp_path, False)
    assert read_transforms(tmp_path, True).points is None
    (tmp_path / "points.ply").write_bytes(_binary_ply(truth.ground))
    cloud = read_transforms(tmp_path, False).points
    assert cloud is not None
    np.testing.assert_allclose(cloud.xyz_world, truth.ground)
    assert len(cloud.uv_px) == 0


def test_val_is_held_out_where_a_blender_scene_has_no_test(tmp_path: Path) -> None:
    write_blender(tmp_path, {"train": 3, "val": 2})
    posed = read_blender(tmp_path, False)
    assert posed.split == (
        frozenset(f"train/r_{i}.png" for i in range(3)),
        frozenset(f"val/r_{i}.png" for i in range(2)),
    )


def test_llff_poses_need_one_photograph_each(tmp_path: Path) -> None:
    write_llff(tmp_path, survey(PINHOLE))
    (tmp_path / "images" / "strip_0_photo_7.png").unlink()
    with pytest.raises(SceneError, match=r"8 photographs, but .* has 9 poses"):
        read_llff(tmp_path)


def test_invalid_llff_arrays_are_refused(tmp_path: Path) -> None:
    file = write_llff(tmp_path, survey(PINHOLE))
    content, rows = file.read_bytes(), np.load(file)
    for damaged in (b"", content[:40], content[:-8], b"\x80\x04N."):
        file.write_bytes(damaged)
        with pytest.raises(SceneError, match=r"damaged .*N x 17 numbers"):
            read_llff(tmp_path)
    np.save(file, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(SceneError, match=r"damaged .*N x 17 numbers"):
        read_llff(tmp_path)
    header = content[:10] + content[10:128].replace(b"(9, 17)", b"(-1,17)")
    for damaged in (content[:10] + b"{'a': ''" + b"'" + content[19:], header + content[128:], bytes(64_000_001)):
        file.write_bytes(damaged)
        with pytest.raises(SceneError, match=r"damaged .*N x 17 numbers|at most 64 MB"):
            read_llff(tmp_path)
    file.write_bytes(content[:10] + content[10:128].replace(b"(9, 17)", b"(True,17)")[:118] + content[128:])
    with pytest.raises(SceneError, match=r"damaged|9 photographs, but"):
        read_llff(tmp_path)
    np.save(file, rows[:, :12])
    with pytest.raises(SceneError, match=r"shape \(9, 12\)"):
        read_llff(tmp_path)
    np.save(file, np.where(np.arange(17) == 15, np.nan, rows))
    with pytest.raises(SceneError, match=r"depth bounds of strip_0_photo_6\.png"):
        read_llff(tmp_path)
