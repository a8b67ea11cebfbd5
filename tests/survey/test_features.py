"""Features and cameras are written to the database once, cameras with their priors."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import textured_wall as wall
from located_surveys import unlocated_photograph
from PIL import Image

from tidefield.data.sift import find_features
from tidefield.errors import DeviceError, RunError
from tidefield.survey.sfm import features
from tidefield.survey.sfm.features import FeatureOptions, choose_device, extract, initial_camera, lens_groups
from tidefield.survey.survey import LensPrior, Photograph

OPTIONS, CPU = FeatureOptions(side_px=400, count=200), pycolmap.Device.cpu


@pytest.fixture
def without_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(features, "worker_processes", lambda *_: nullcontext(ThreadPoolExecutor(1)))


@pytest.fixture
def wall_photographs(tmp_path: Path) -> list[Photograph]:
    """Three pictures of the textured wall with some noise on it for SIFT to find."""
    cameras, rng = wall.cameras(3, width=240, height=180), np.random.default_rng(0)
    spots = rng.integers(0, 60, (18, 24, 3))
    made = []
    for k in range(3):
        pixels = np.clip(wall.photograph(cameras[k]).numpy() + np.kron(spots, np.ones((10, 10, 1))), 0, 255)
        Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / f"{k:04d}.png")
        made.append(replace(unlocated_photograph(k, None), path=tmp_path / f"{k:04d}.png", width=240, height=180))
    return made


def test_features_are_written_largest_first_in_full_size_pixels(wall_photographs: list[Photograph], tmp_path: Path):
    calls: list[tuple[int, int]] = []
    total = extract(wall_photographs, tmp_path / "a.db", OPTIONS, CPU, lambda done, whole: calls.append((done, whole)))
    halved = extract(wall_photographs, tmp_path / "b.db", replace(OPTIONS, side_px=120), CPU, lambda done, whole: None)
    assert calls[-1] == (3, 3)
    assert total > halved > 0
    for name in ("a.db", "b.db"):
        with pycolmap.Database.open(tmp_path / name) as db:
            for image in db.read_all_images():
                keypoints = np.asarray(db.read_keypoints(image.image_id))
                assert (np.diff(keypoints[:, 2]) <= 0).all()
                assert (keypoints[:, :2] >= 0).all()
                assert keypoints[:, 0].max() > 150
                assert (keypoints[:, :2] <= [240, 180]).all()
                assert np.asarray(db.read_descriptors(image.image_id).data).shape == (len(keypoints), 128)


@pytest.mark.usefixtures("without_processes")
def test_extraction_continues_where_it_was_interrupted(wall_photographs: list[Photograph], tmp_path: Path):
    calls: list[tuple[int, int]] = []
    extract(wall_photographs[:2], tmp_path / "a.db", OPTIONS, CPU, lambda done, whole: None)
    extract(wall_photographs, tmp_path / "a.db", OPTIONS, CPU, lambda done, whole: calls.append((done, whole)))
    assert calls == [(3, 3)]
    with pycolmap.Database.open(tmp_path / "a.db") as db:
        assert db.num_images() == 3
        assert db.num_cameras() == db.num_rigs() == 1
        assert db.num_frames() == 3


def test_photographs_of_one_camera_size_and_zoom_share_a_lens():
    own = [unlocated_photograph(k, None) for k in range(5)]
    own[1] = replace(own[1], camera="Maker B")
    own[2] = replace(own[2], width=800)
    own[3] = replace(own[3], focal_mm=12.0)
    assert lens_groups(own) == [0, 1, 2, 3, 0]


def test_other_orientations_undistorted_photographs_and_digital_zooms_have_lenses_of_their_own():
    lens = LensPrior(400.0, None, None, "EXIF", trusted=False)
    own = [replace(unlocated_photograph(k, None), lens=lens) for k in range(6)]
    own[1] = replace(own[1], orientation=3)
    own[2] = replace(own[2], lens=replace(lens, distortion=(-0.1, 0.0, 0.0, 0.0, 0.0)))
    own[3] = replace(own[3], lens=replace(lens, focal_px=800.0))
    own[4] = replace(own[4], lens=replace(lens, focal_px=403.0))
    assert lens_groups(own) == [0, 1, 2, 3, 0, 0]


def test_a_nominal_focal_length_is_a_prior_and_the_default_is_not():
    known = replace(unlocated_photograph(0, None), lens=LensPrior(350.0, None, None, "EXIF", trusted=False))
    assert initial_camera(known).has_prior_focal_length
    assert initial_camera(known).params.tolist() == [350, 350, 200, 150, 0, 0, 0, 0]
    assert not initial_camera(unlocated_photograph(0, None)).has_prior_focal_length
    assert initial_camera(unlocated_photograph(0, None)).focal_length_x == 480


def test_the_initial_camera_approximates_the_makers_five_term_distortion():
    lens = LensPrior(400.0, (210.0, 140.0), (-0.4, 0.37, 0.002, -0.001, -0.26), "maker", trusted=True)
    camera = initial_camera(replace(unlocated_photograph(0, None), lens=lens))
    assert camera.params[:4].tolist() == [400, 400, 210, 140]
    xy = np.array([[x, y] for x in np.linspace(-0.5, 0.45, 7) for y in np.linspace(-0.35, 0.35, 5)])
    k1, k2, p1, p2, k3 = lens.distortion
    r2 = (xy**2).sum(1)
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x, y = xy.T
    tangential = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], 1)
    true = (xy * radial[:, None] + tangential) * 400 + [210, 140]
    found = np.asarray(camera.img_from_cam(np.column_stack([xy, np.ones(len(xy))])))
    assert np.abs(found - true).max() < 0.35


def test_an_unsupported_device_is_an_error():
    assert choose_device("auto") == pycolmap.Device.auto
    assert choose_device("cpu") == pycolmap.Device.cpu
    with pytest.raises(DeviceError, match="expected one of auto, cpu"):
        choose_device("mps")


@pytest.mark.parametrize("value", [0, -5, 99, 10**12])
def test_options_out_of_their_range_are_refused(value: int):
    with pytest.raises(RunError, match=f"--features is {value}: expected a number from 100 to 50000"):
        FeatureOptions(count=value)
    with pytest.raises(RunError, match=f"--feature-width is {value}:"):
        FeatureOptions(side_px=value)


@pytest.mark.usefixtures("without_processes")
def test_a_strip_of_one_pixel_has_no_features(tmp_path: Path):
    Image.new("RGB", (20_000, 1)).save(tmp_path / "strip.png")
    strip = replace(unlocated_photograph(0, None), path=tmp_path / "strip.png", width=20_000, height=1)
    assert extract([strip], tmp_path / "a.db", OPTIONS, CPU, lambda done, whole: None) == 0


@pytest.mark.usefixtures("without_processes")
@pytest.mark.parametrize("transparent", [False, True])
def test_masked_and_transparent_pixels_have_no_features(
    wall_photographs: list[Photograph], tmp_path: Path, transparent: bool
):
    used = np.zeros((180, 240), dtype=np.uint8)
    used[:, 100:] = 255
    if transparent:
        with Image.open(wall_photographs[0].path) as picture:
            layers = np.dstack([np.asarray(picture), used])
        Image.fromarray(layers).save(wall_photographs[0].path)
        wall_photographs[0] = replace(wall_photographs[0], has_alpha=True)
    else:
        Image.fromarray(used).save(tmp_path / "mask.png")
        wall_photographs[0] = replace(wall_photographs[0], mask=tmp_path / "mask.png")
    extract(wall_photographs, tmp_path / "a.db", OPTIONS, CPU, lambda done, whole: None)
    with pycolmap.Database.open(tmp_path / "a.db") as db:
        left, count = [], []
        for image in sorted(db.read_all_images(), key=lambda image: image.name):
            keypoints = np.asarray(db.read_keypoints(image.image_id))
            assert np.asarray(db.read_descriptors(image.image_id).data).shape == (len(keypoints), 128)
            left.append(int((keypoints[:, 0] < 100).sum()))
            count.append(len(keypoints))
    assert left[0] == 0 < count[0]
    assert min(left[1:]) > 0


def test_masked_pixels_leave_the_number_of_features_as_it_is(wall_photographs: list[Photograph]):
    grey = np.asarray(Image.open(wall_photographs[0].path).convert("L"))
    everything, _ = find_features(grey, 10_000, CPU)
    count = len(everything) // 3
    used = np.zeros((180, 240), dtype=bool)
    used[:, 120:] = True
    inside = everything[everything[:, 0] >= 120]
    assert len(inside) > count
    keypoints, descriptors = find_features(grey, count, CPU, used)
    np.testing.assert_array_equal(keypoints, inside[:count])
    assert len(descriptors) == count
    for one, other in zip(find_features(grey, count, CPU), find_features(grey, count, CPU, used | True), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.usefixtures("without_processes")
@pytest.mark.parametrize("height", [102, 100])
def test_features_of_reduced_photographs_are_where_they_are_in_the_photograph(tmp_path: Path, height: int):
    rows, columns = np.mgrid[:height, :400] + 0.5
    spots = [(100.0, 50.0), (200.0, 82.0), (300.0, 25.0)]
    light = sum(200 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 9**2)) for u, v in spots)
    Image.fromarray(np.uint8(np.rint(20 + light))).save(tmp_path / "spots.png")
    # Of 102 rows, 25.5 would be left: they are 26, and a row is 3.92 of the photograph's, a column 4.
    spotted = replace(unlocated_photograph(0, None), path=tmp_path / "spots.png", width=400, height=height)
    extract([spotted], tmp_path / "a.db", replace(OPTIONS, side_px=100), CPU, lambda done, whole: None)
    with pycolmap.Database.open(tmp_path / "a.db") as db:
        uv = np.asarray(db.read_keypoints(db.read_all_images()[0].image_id))[:, :2]
    away = np.linalg.norm(uv[:, None] - np.array(spots), axis=2).min(axis=0)
    assert away.max() < 0.5


@pytest.mark.usefixtures("without_processes")
def test_photographs_of_twice_the_size_have_the_same_features_twice_as_far_apart(
    wall_photographs: list[Photograph], tmp_path: Path
):
    """Bit for bit: the scales of both sides are equal."""
    twice = []
    for photograph in wall_photographs:
        path = tmp_path / f"twice {photograph.path.name}"
        Image.open(photograph.path).resize((480, 360), Image.Resampling.NEAREST).save(path)
        twice.append(replace(photograph, path=path, width=480, height=360))
    found = []
    for k, photographs in enumerate((wall_photographs, twice)):
        extract(photographs, tmp_path / f"{k}.db", replace(OPTIONS, side_px=240), CPU, lambda done, whole: None)
        with pycolmap.Database.open(tmp_path / f"{k}.db") as db:
            found.append([np.asarray(db.read_keypoints(image.image_id)) for image in db.read_all_images()])
    for one, two in zip(*found, strict=True):
        np.testing.assert_array_equal(two, one * np.float32([2, 2, 2, 1]))
