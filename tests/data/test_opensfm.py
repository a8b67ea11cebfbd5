import logging
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from opensfm_projects import (
    CAMERAS,
    LANDSCAPE,
    PORTRAIT,
    pixel,
    project,
    reconstruction,
    tracks_of,
    write_opensfm,
    write_photographs,
    write_tracks,
)

from tidefield.data.load import load_scene, read_posed
from tidefield.data.readers.opensfm import find_opensfm, read_opensfm
from tidefield.data.readers.posed import PosedPhotographs, Reference
from tidefield.errors import SceneError


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def read(root: Path, allow_missing: bool = False) -> PosedPhotographs:
    file = find_opensfm(root)
    assert file is not None
    return read_opensfm(root, file, allow_missing)


def pixels(posed: PosedPhotographs, i: int, xyz_world: np.ndarray) -> np.ndarray:
    pose = posed.T_world_camera[i]
    return posed.lenses[i].project((xyz_world - pose[:, 3]) @ pose[:, :3])


@pytest.mark.parametrize("size", [LANDSCAPE, PORTRAIT], ids=["landscape", "portrait"])
@pytest.mark.parametrize("kind", CAMERAS)
def test_points_appear_where_opensfms_documented_formulas_put_them(
    tmp_path: Path, kind: str, size: dict[str, int]
) -> None:
    top = reconstruction(kind, size)
    write_opensfm(tmp_path, top)
    posed = read(tmp_path)
    camera = top["cameras"]["v2 make model"]
    xyz = np.array([point["coordinates"] for point in top["points"].values()])
    assert posed.names == tuple(top["shots"])
    for i, shot in enumerate(top["shots"].values()):
        expected = [pixel(camera, xy) for x in xyz if (xy := project(camera, shot, x)) is not None]
        assert len(expected) == len(xyz)
        np.testing.assert_allclose(pixels(posed, i, xyz), expected, atol=1e-9)


def test_a_camera_without_a_size_has_that_of_its_photographs(tmp_path: Path) -> None:
    top = reconstruction("perspective")
    write_opensfm(tmp_path, top)
    whole = read(tmp_path)
    del top["cameras"]["v2 make model"]["width"], top["cameras"]["v2 make model"]["height"]
    write_opensfm(tmp_path, top, photographs=False)
    assert read(tmp_path).lenses == whole.lenses


@pytest.mark.parametrize(("version", "named"), [(0, False), (0, True), (1, True), (2, True)])
def test_observations_are_those_of_tracks_of_every_version(tmp_path: Path, version: int, named: bool) -> None:
    top = reconstruction()
    write_opensfm(tmp_path, top)
    seen = tracks_of(top)
    assert len(seen) > 1000
    others = [("DJI_0000.png", "1", (0.1, 0.1)), ("left_out.png", "7", (0.1, 0.1))]  # no such point; no such photograph
    write_tracks(tmp_path / "tracks.csv", [*others, *seen], version, named)
    posed = read(tmp_path)
    points = posed.points
    assert points is not None
    names, ids = list(top["shots"]), list(top["points"])
    assert points.photograph_index.tolist() == [names.index(name) for name, _, _ in seen]
    assert points.point_index.tolist() == [ids.index(point) for _, point, _ in seen]
    expected = [pixel(top["cameras"]["v2 make model"], xy) for _, _, xy in seen]
    np.testing.assert_allclose(points.uv_px, expected, atol=1e-9)
    assert points.rgb is not None
    assert points.rgb.tolist() == [point["color"] for point in top["points"].values()]


def test_outliers_of_opensfm_are_left_out(tmp_path: Path) -> None:
    top = reconstruction()
    write_opensfm(tmp_path, top)
    seen = tracks_of(top)
    moved = [
        (name, p, (x + 0.007, y)) if k % 10 == 0 else (name, p, (x + 0.005, y))
        for k, (name, p, (x, y)) in enumerate(seen)
    ]
    write_tracks(tmp_path / "tracks.csv", moved)
    points = read(tmp_path).points
    assert points is not None
    assert len(points.uv_px) == len(seen) - len(seen[::10])


@pytest.mark.parametrize("home", ["", "opensfm"])
def test_masks_lie_next_to_the_photographs_or_the_reconstruction(
    tmp_path: Path, home: str, caplog: pytest.LogCaptureFixture
) -> None:
    top = reconstruction()
    write_opensfm(tmp_path / "opensfm", top, photographs=False)
    write_photographs(tmp_path / "images", top)
    masks = tmp_path / home / "masks"
    masks.mkdir()
    first, second, *_ = top["shots"]
    for name in (f"{first}.png", second, "unknown.png"):
        (masks / name).touch()
    assert read(tmp_path).masks == (masks / f"{first}.png", masks / second, *[None] * 7)
    assert caplog.text.count("1 of the 3 pictures") == 1


def test_a_project_loads_as_an_undistorted_scene(tmp_path: Path) -> None:
    top = reconstruction()
    write_opensfm(tmp_path, top)
    write_tracks(tmp_path / "tracks.csv", tracks_of(top))
    scene = load_scene(tmp_path)
    assert scene.names == tuple(sorted(top["shots"]))
    points = scene.points
    assert points is not None
    uv, _ = scene.cameras.project(points.xyz_world)
    assert (uv[points.camera_index, points.point_index] - points.uv_px).norm(dim=-1).max() < 1e-3
    positions = [top["shots"][name]["gps_position"] for name in scene.names]
    torch.testing.assert_close(
        scene.cameras.position_world.double() + scene.origin_world, torch.tensor(positions, dtype=torch.float64),
        atol=1e-5, rtol=0,
    )  # fmt: skip


def test_a_project_without_any_of_its_photographs_has_none(tmp_path: Path) -> None:
    top = reconstruction()
    write_opensfm(tmp_path, top, photographs=False)
    write_tracks(tmp_path / "tracks.csv", tracks_of(top))
    with pytest.raises(SceneError, match="0 posed photographs: expected at least 3"):
        read_posed(tmp_path, True)


def test_points_without_tracks_give_near_and_far(tmp_path: Path) -> None:
    top = reconstruction()
    top["points"]["7"]["coordinates"] = [float("nan"), 0.0, 0.0]
    del top["points"]["14"]["color"]
    write_opensfm(tmp_path, top)
    posed = read(tmp_path)
    cloud = posed.points
    assert cloud is not None
    assert cloud.rgb is not None
    np.testing.assert_array_equal(cloud.xyz_world[0], top["points"]["0"]["coordinates"])
    assert (len(cloud.xyz_world), len(cloud.rgb), len(cloud.uv_px)) == (599, 599, 0)
    assert cloud.rgb[1].tolist() == [128, 128, 128]
    near, far = load_scene(tmp_path).cameras.near_far.unbind(dim=1)
    assert ((near > 3) & (near < 6)).all()  # the ground lies 9 to 11 m away, along the axes of tilted cameras
    assert ((far > 12) & (far < 20)).all()


def as_odm(root: Path, top: dict[str, Any]) -> Path:
    """ODM's layout: photographs next to OpenSfM's folder, and a list of their paths on the machine that ran it."""
    write_photographs(root / "images", top)
    file = write_opensfm(root / "opensfm", top, photographs=False)
    listed = [f"/datasets/code/images/{name}" for name in top["shots"]]
    (root / "opensfm" / "image_list.txt").write_text("\n".join(listed))
    (root / "opensfm" / "reference_lla.json").write_text('{"latitude": 44.5, "longitude": -3.25, "altitude": 0.0}')
    return file


def test_odms_project_is_read_in_metres_and_not_in_its_map_projection(tmp_path: Path) -> None:
    top = reconstruction()
    file = as_odm(tmp_path, top)
    shutil.copy(file, file.with_name("reconstruction.topocentric.json"))
    for shot in top["shots"].values():
        shot["translation"][0] += 300.0
    write_opensfm(tmp_path / "opensfm", top, photographs=False)
    (tmp_path / "odm_georeferencing").mkdir()
    posed = read(tmp_path)
    np.testing.assert_allclose(posed.T_world_camera[0, :, 3], top["shots"]["DJI_0008.png"]["gps_position"], atol=1e-9)
    assert posed.paths[0] == tmp_path / "images" / "DJI_0008.png"
    assert posed.reference == Reference(44.5, -3.25, 0.0)


def test_photographs_are_found_by_image_list(tmp_path: Path) -> None:
    top = reconstruction()
    write_opensfm(tmp_path, top, photographs=False)
    write_photographs(tmp_path / "flight one", top)
    listed = [f"./flight one/{name}" for name in top["shots"]]
    (tmp_path / "image_list.txt").write_text("\n".join(listed) + "\n\n")
    assert read(tmp_path).paths[0] == tmp_path / "flight one" / "DJI_0008.png"
    (tmp_path / "image_list.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(SceneError, match=r"image_list\.txt is damaged .*UTF-8"):
        read(tmp_path)


def test_the_geographic_origin_is_read_only_if_certain(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    top = reconstruction()
    plain, odm = tmp_path / "plain", tmp_path / "odm"
    write_opensfm(plain, top)
    assert read(plain).reference is None
    top["reference_lla"] = {"latitude": 10.0, "longitude": 20.0, "altitude": 30.0}
    write_opensfm(plain, top)
    assert read(plain).reference == Reference(10.0, 20.0, 30.0)
    (plain / "reference_lla.json").write_text('{"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}')
    assert read(plain).reference is None  # no photograph had GPS
    file = as_odm(odm, top)
    with caplog.at_level(logging.WARNING, logger="tidefield"):
        assert read(odm).reference is None
    assert "may be in a map projection" in caplog.text
    file.with_name("reconstruction.geocoords.json").write_text("[]")  # older ODM: nothing was moved
    assert read(odm).reference == Reference(44.5, -3.25, 0.0)
    for bad in ('{"latitude": 95, "longitude": 0, "altitude": 0}', '{"latitude": 5, "longitude": 0}', "[", "[1]"):
        (plain / "reference_lla.json").write_text(bad)
        with pytest.raises(SceneError, match=r"reference_lla\.json"):
            read(plain)


def test_the_largest_of_several_reconstructions_is_read_and_the_others_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    small, large = reconstruction(shots=9), reconstruction(shots=9)
    small["shots"] = {f"other_{i}.png": shot for i, shot in enumerate(list(small["shots"].values())[:6])}
    write_opensfm(tmp_path, small, large)
    with caplog.at_level(logging.WARNING, logger="tidefield"):
        assert read(tmp_path).names == tuple(large["shots"])
    assert "2 reconstructions that are not connected: the largest, of 9 photographs" in caplog.text
    assert "other_0.png, other_1.png, other_2.png, other_3.png, other_4.png and 1 more" in caplog.text


def test_photographs_missing_are_named_and_can_be_left_out(tmp_path: Path) -> None:
    top = reconstruction()
    write_opensfm(tmp_path, top)
    write_tracks(tmp_path / "tracks.csv", tracks_of(top))
    (tmp_path / "images" / "DJI_0003.png").unlink()
    with pytest.raises(SceneError, match=r"1 of the 9 photographs .*images/DJI_0003\.png.*--allow-missing"):
        read(tmp_path)
    posed = read(tmp_path, allow_missing=True)
    assert posed.names == tuple(name for name in top["shots"] if name != "DJI_0003.png")
    assert posed.points is not None
    for i in range(8):
        mine = posed.points.photograph_index == i
        xyz = posed.points.xyz_world[posed.points.point_index[mine]]
        np.testing.assert_allclose(pixels(posed, i, xyz), posed.points.uv_px[mine], atol=1e-6)


def test_rotation_vectors_longer_than_a_turn_are_read(tmp_path: Path) -> None:
    top = reconstruction()
    once = read_opensfm(tmp_path, write_opensfm(tmp_path, top), False)
    for shot in top["shots"].values():
        turn = np.array(shot["rotation"])
        shot["rotation"] = (turn * (1 + 2 * np.pi / np.linalg.norm(turn))).tolist()
    again = read_opensfm(tmp_path, write_opensfm(tmp_path, top), False)
    np.testing.assert_allclose(again.T_world_camera, once.T_world_camera, atol=1e-9)


def test_tracks_of_another_project_are_ignored(tmp_path: Path) -> None:
    write_opensfm(tmp_path, reconstruction())
    for seen in (("other.png", "3", (0.1, 0.2)), ("DJI_0008.png", "0", (float("nan"), 0.2))):
        write_tracks(tmp_path / "tracks.csv", [seen])
        cloud = read(tmp_path).points
        assert cloud is not None
        assert len(cloud.uv_px) == 0


def test_other_layouts_come_before_an_opensfm_project(tmp_path: Path) -> None:
    write_opensfm(tmp_path, reconstruction())
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(SceneError, match=r"transforms\.json has no list of frames"):
        load_scene(tmp_path)
