"""Sparse points from posed photographs: found where there are none, and placed by training photographs alone."""

import logging
import os
import shutil
import tracemalloc
from dataclasses import replace
from pathlib import Path

import camera_files
import ground_flight as flight
import numpy as np
import pytest
import scenes_on_disk as disk
import torch
from numpy.testing import assert_allclose
from PIL import Image

import tidefield as tf
from tidefield.baselines.untrained import sparse_depth
from tidefield.data import triangulate
from tidefield.data.load import load_scene, read_posed
from tidefield.data.readers.posed import every_eighth
from tidefield.data.scene import Scene
from tidefield.geometry.lenses import Lens

DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def hills(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with poses and without points: nine photographs of hills from 40 m above."""
    lens = Lens(flight.WIDTH, flight.HEIGHT, flight.FOCAL, flight.FOCAL, flight.WIDTH / 2, flight.HEIGHT / 2)
    ground = camera_files.texture((flight.SIDE, flight.SIDE))
    x, y = np.meshgrid([-12.0, 0.0, 12.0], [-9.0, 0.0, 9.0])
    position = np.stack([x.ravel(), y.ravel(), np.linspace(39, 41, 9)], axis=1)
    poses = np.concatenate([np.tile(DOWN, (9, 1, 1)), position[:, :, None]], axis=2)
    pictures = tuple(flight.picture(ground, place) for place in position)
    names = tuple(f"{k}.png" for k in range(9))
    root = tmp_path_factory.mktemp("hills")
    disk.write_transforms(root, disk.Truth(names, (lens,) * 9, poses, np.zeros((0, 3)), pictures))
    return root


@pytest.fixture(scope="module")
def kept(hills: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Path]:
    """The scene of the hills, and the cache that it was opened with."""
    cache = tmp_path_factory.mktemp("cache")
    return load_scene(hills, cache=cache), cache


def test_points_of_a_scene_without_are_found_on_its_surface_and_kept(
    kept: tuple[Scene, Path], monkeypatch: pytest.MonkeyPatch
):
    scene, cache = kept
    assert scene.points is not None
    xyz = scene.points.xyz_world.double().numpy() + scene.origin_world.numpy()
    assert len(xyz) > 200
    error_m = np.abs(xyz[:, 2] - flight.hills(xyz[:, :2]))
    assert np.median(error_m) < 0.06, "a pixel is 12 cm"
    assert np.percentile(error_m, 95) < 0.24
    assert not np.isin(scene.points.camera_index, scene.test).any()
    assert (scene.cameras.near_far[:, 0] > 15).all()
    assert (scene.cameras.near_far[:, 1] < 65).all()
    monkeypatch.setattr(triangulate, "triangulate", lambda *_: pytest.fail("they were kept"))
    again = load_scene(scene.root, cache=cache).points
    assert again is not None
    assert torch.equal(again.xyz_world, scene.points.xyz_world)


def test_kept_points_that_are_damaged_are_found_again(
    kept: tuple[Scene, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    first, cache = kept[0].points, shutil.copytree(kept[1], tmp_path / "cache")
    (store,) = cache.glob("*.points")
    store.write_bytes(store.read_bytes()[:100])
    with caplog.at_level(logging.INFO):
        again = load_scene(kept[0].root, cache=cache).points
    assert "has no sparse points: triangulating them" in caplog.text
    assert first is not None
    assert again is not None
    assert torch.equal(again.xyz_world, first.xyz_world)


def test_points_are_found_again_where_a_mask_becomes_that_of_another_photograph(
    hills: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(triangulate, "triangulate", lambda *_: None)
    posed = read_posed(hills, False)
    mask = tmp_path / "mask.png"
    mask.touch()
    for masks in ((mask, *[None] * 8), (*[None] * 8, mask)):
        triangulate.find_points(replace(posed, masks=masks), range(9), hills, cache=tmp_path / "cache")
    assert len(list((tmp_path / "cache").glob("*.points"))) == 2


@pytest.mark.skipif(os.name != "posix", reason="Windows has no such permissions")
def test_points_of_a_cache_that_others_can_write_to_are_not_used(
    kept: tuple[Scene, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    cache = shutil.copytree(kept[1], tmp_path / "cache")
    monkeypatch.setattr(triangulate, "triangulate", lambda *_: None)
    assert load_scene(kept[0].root, cache=cache).points is not None
    cache.chmod(0o777)
    assert load_scene(kept[0].root, cache=cache).points is None


def test_a_scene_in_which_nothing_matches_says_what_to_expect(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    disk.write_transforms(tmp_path / "scene", disk.survey(disk.PINHOLE))
    for count in (1, 2):  # the second time from the cache
        assert load_scene(tmp_path / "scene", cache=tmp_path).points is None
        assert caplog.text.count("views may be blurred or torn") == count


@pytest.mark.parametrize("used", [(), (4,)])
def test_fewer_than_two_photographs_give_no_points(hills: Path, used: tuple[int, ...]):
    assert triangulate.triangulate(read_posed(hills, False), used) is None


def test_features_and_pairs_of_many_photographs_take_little_memory(hills: Path):
    posed = read_posed(hills, False)
    found = triangulate.find_photograph_features(posed.paths[0], posed.lenses[0])
    assert found.descriptors.nbytes == 128 * len(found.xy)
    poses = np.tile(posed.T_world_camera[:1], (1000, 1, 1))
    poses[:, :, 3] = np.random.default_rng(0).normal(size=(1000, 3))
    tracemalloc.start()
    pairs = triangulate.neighbouring_pairs(poses)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(pairs) > 5000
    assert peak < 8 * 1000**2 / 2


@pytest.mark.parametrize("transparent", [False, True])
def test_masked_and_transparent_pixels_leave_the_number_of_features_as_it_is(
    hills: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, transparent: bool
):
    posed = read_posed(hills, False)
    monkeypatch.setattr(triangulate, "FEATURES", 100)
    lens, path, mask = posed.lenses[0], posed.paths[0], tmp_path / "mask.png"
    used = np.zeros((lens.height, lens.width), dtype=np.uint8)
    used[:, lens.width // 2 :] = 255
    if transparent:
        with Image.open(path) as picture:
            Image.fromarray(np.dstack([np.asarray(picture.convert("RGB")), used])).save(tmp_path / "photograph.png")
        path, mask = tmp_path / "photograph.png", None
    else:
        Image.fromarray(used).save(mask)
    found = triangulate.find_photograph_features(path, lens, mask)
    assert len(found.uv_px) == 100
    assert (found.uv_px[:, 0] >= lens.width // 2).all()


def test_points_are_placed_by_the_observations_of_the_photographs_used_alone(tmp_path: Path):
    truth = disk.survey()
    disk.write_colmap(tmp_path, truth)
    posed = read_posed(tmp_path, False)
    assert posed.points is not None
    train, test = every_eighth(9)
    moved = posed.points.uv_px + 30.0 * np.isin(posed.points.photograph_index, test)[:, None]
    nowhere = replace(posed.points, xyz_world=np.zeros_like(posed.points.xyz_world), uv_px=moved)
    found = triangulate.triangulate_again(nowhere, posed.T_world_camera, posed.lenses, train)
    assert np.isin(found.photograph_index, train).all()
    assert np.bincount(found.point_index).min() >= 2
    nearest = np.linalg.norm(found.xyz_world[:, None] - truth.ground[None], axis=2).min(1)
    assert_allclose(nearest, 0, atol=1e-5)


def test_points_are_placed_alike_all_at_once_and_a_few_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    disk.write_colmap(tmp_path, disk.survey())
    posed = read_posed(tmp_path, False)
    assert posed.points is not None
    shuffled = np.random.default_rng(0).permutation(len(posed.points.uv_px))
    arrays = {name: getattr(posed.points, name)[shuffled] for name in ("point_index", "photograph_index", "uv_px")}
    found = []
    for at_once in (1 << 20, 70):
        monkeypatch.setattr(triangulate, "_AT_ONCE", at_once)
        points = replace(posed.points, **arrays)
        found.append(triangulate.triangulate_again(points, posed.T_world_camera, posed.lenses, range(9)))
    for name in ("xyz_world", "point_index", "photograph_index", "uv_px"):
        np.testing.assert_array_equal(*(getattr(points, name) for points in found))


def test_points_whose_rays_are_nearly_parallel_are_dropped(tmp_path: Path):
    truth = disk.survey()
    far = replace(truth, ground=truth.ground * (1, 1, 0) - (0, 0, 3000))
    far = replace(far, ground=far.ground * (300, 300, 1))
    disk.write_colmap(tmp_path, far)
    posed = read_posed(tmp_path, False)
    assert posed.points is not None
    assert len(posed.points.uv_px)
    assert not len(triangulate.triangulate_again(posed.points, posed.T_world_camera, posed.lenses, range(9)).uv_px)


def test_without_an_observation_that_counts_there_are_no_points(tmp_path: Path):
    disk.write_colmap(tmp_path, disk.survey())
    posed = read_posed(tmp_path, False)
    assert posed.points is not None
    found = triangulate.triangulate_again(posed.points, posed.T_world_camera, posed.lenses, ())
    assert found.xyz_world.shape == (0, 3)


def test_nothing_of_a_held_out_photograph_reaches_a_rendering(tmp_path: Path):
    truth = disk.survey()
    held_out = {sorted(truth.names)[i] for i in every_eighth(9)[1]}
    pictures = [255 - p if name in held_out else p for name, p in zip(truth.names, truth.pictures, strict=True)]
    disk.write_colmap(tmp_path / "first", truth)
    disk.write_colmap(tmp_path / "second", replace(truth, pictures=tuple(pictures)), wrong=frozenset(held_out))
    first, second = load_scene(tmp_path / "first"), load_scene(tmp_path / "second")
    for make in (sparse_depth, tf.zero_shot):
        one, other = make(first), make(second)
        for i in first.test:
            assert not torch.equal(first.photographs[i], second.photographs[i])
            views = one(first.cameras[i]), other(second.cameras[i])
            for name in ("colour", "depth", "opacity"):
                assert torch.equal(*(getattr(view, name) for view in views)), f"{make.__name__}: {name}"
