"""Photographs of a scene are copied where nothing changes, else turned upright and corrected."""

import struct
from dataclasses import replace
from pathlib import Path

import camera_files
import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageCms
from PIL.ExifTags import GPS, IFD, Base

from tidefield.data.pictures import decode, read_header
from tidefield.errors import RunError
from tidefield.survey import export
from tidefield.survey.colour import ExposureCorrection, to_common_exposure
from tidefield.survey.export import (
    reduced_folders,
    tangent_map,
    write_image,
    write_images,
    write_masks,
    write_reduced_images,
)
from tidefield.survey.io.image_decoding import upright
from tidefield.survey.io.photographs import read_survey
from tidefield.survey.survey import Photograph

SIZE = (64, 48)
LENS = pycolmap.Camera(model="SIMPLE_RADIAL", width=64, height=48, params=[50, 32, 24, 0.1], camera_id=1)
TURNED = pycolmap.Camera(model="SIMPLE_RADIAL", width=48, height=64, params=[50, 24, 32, 0.1], camera_id=2)
LENSES = [LENS, LENS, TURNED]


def quiet(done: int, whole: int) -> None:
    assert 0 <= done <= whole


def correction(gains: list[float], helps: bool = True, falloff: float = 0.0) -> ExposureCorrection:
    gain = np.outer(gains, np.ones(3))
    return ExposureCorrection(gain, np.full((3, 3), [falloff, 0, 0]), 0.2, 0.1, 0.1, helps, falloff != 0)


@pytest.fixture
def photographs(tmp_path: Path) -> tuple[Photograph, ...]:
    """A JPEG, a PNG in a sub-folder, and a JPEG that stands on its side."""
    camera_files.photograph(tmp_path / "card" / "a b.jpg", SIZE, camera_files.exif({Base.Model: "M1"}))
    camera_files.photograph(tmp_path / "card" / "flight é" / "b.png", SIZE)
    camera_files.photograph(tmp_path / "card" / "turned.jpg", SIZE, camera_files.exif({Base.Orientation: 6}))
    return read_survey(tmp_path / "card").photographs


def test_unchanged_files_are_copied_and_rotated_ones_turned_upright(photographs, tmp_path: Path):
    write_images(photographs, tmp_path / "images", None, LENSES, quiet)
    for photograph in photographs[:2]:
        assert (tmp_path / "images" / photograph.name).read_bytes() == photograph.path.read_bytes()
    with Image.open(tmp_path / "images" / "turned.jpg") as picture:
        assert picture.size == (48, 64)
        assert picture.getexif()[Base.Orientation] == 1
        difference = np.asarray(picture).astype(int) - upright(photographs[2])
    assert np.abs(difference).mean() < 2


def test_gains_that_do_not_help_change_nothing(photographs, tmp_path: Path):
    write_images(photographs, tmp_path / "images", correction([2, 1, 1], helps=False), LENSES, quiet)
    assert (tmp_path / "images" / "a b.jpg").read_bytes() == photographs[0].path.read_bytes()


def test_gains_are_divided_out_and_exif_is_kept(photographs, tmp_path: Path):
    write_images(photographs, tmp_path / "images", correction([0.8, 1.25, 1.0]), LENSES, quiet)
    for photograph, gain in zip(photographs, (0.8, 1.25, 1.0), strict=True):
        with Image.open(tmp_path / "images" / photograph.name) as picture:
            ours = np.asarray(picture).astype(float)
        true = np.clip(upright(photograph) / gain, 0, 255)
        assert np.abs(ours - true).mean() < 2
    with Image.open(tmp_path / "images" / "a b.jpg") as picture:
        assert picture.getexif()[Base.Model] == "M1"


def test_the_falloff_brightens_the_corners(photographs, tmp_path: Path):
    write_images(photographs, tmp_path / "images", correction([1, 1, 1], falloff=-0.5), LENSES, quiet)
    with Image.open(tmp_path / "images" / "flight é" / "b.png") as picture:
        ours = np.asarray(picture).astype(float)
    before = upright(photographs[1]).astype(float)
    tangent = np.asarray(LENS.cam_from_img(np.array([[0.5, 0.5]])))[0]
    assert ours[24, 32] == pytest.approx(before[24, 32], abs=1)
    np.testing.assert_allclose(ours[0, 0], np.minimum(before[0, 0] * np.exp(0.5 * (tangent**2).sum()), 255), atol=2)


def test_tiffs_stay_tiffs(tmp_path: Path):
    for k in range(3):
        camera_files.photograph(tmp_path / "card" / f"{k}.tif", SIZE)
    photographs = read_survey(tmp_path / "card").photographs
    write_images(photographs, tmp_path / "images", correction([0.8, 1.25, 1.0]), [LENS] * 3, quiet)
    with Image.open(tmp_path / "images" / "0.tif") as picture:
        assert picture.format == "TIFF"
        np.testing.assert_allclose(np.asarray(picture), np.clip(upright(photographs[0]) / 0.8, 0, 255), atol=0.51)


DESCRIBED = camera_files.exif({Base.Model: "M1", Base.ExposureTime: 0.01}, place=(54.5, -2.75), height_m=80)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_changed_tiff_keeps_what_its_exif_says_of_the_photograph(tmp_path: Path, orientation: int):
    table = camera_files.exif(
        {Base.Orientation: orientation, Base.Model: "M1", Base.ExposureTime: 0.01}, place=(54, -2)
    )
    for k in range(3):
        camera_files.photograph(tmp_path / "card" / f"{k}.tif", SIZE, table)
    photographs = read_survey(tmp_path / "card").photographs
    write_images(photographs, tmp_path / "images", correction([0.8, 1.25, 1.0]), [LENS] * 3, quiet)
    written = tmp_path / "images" / "0.tif"
    np.testing.assert_allclose(decode(written), np.clip(upright(photographs[0]) / 0.8, 0, 255), atol=0.51)
    with Image.open(written) as picture:
        found = picture.getexif()
        assert (found[Base.Model], found[Base.Orientation]) == ("M1", 1)
        assert found.get_ifd(IFD.Exif)[Base.ExposureTime] == pytest.approx(0.01)
        assert found.get_ifd(IFD.GPSInfo)[GPS.GPSLatitude] == (54, 0, 0)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "CMYK"])
def test_a_reduced_tiff_has_its_own_size_and_colours(tmp_path: Path, mode: str):
    (tmp_path / "images").mkdir()
    original = tmp_path / "images" / "a.tif"
    Image.fromarray(camera_files.texture((64, 48))).convert(mode).save(original, exif=DESCRIBED.tobytes())
    write_reduced_images(tmp_path, ["a.tif"], (4,), quiet)
    pixels = decode(original)
    means = pixels.reshape(12, 4, 16, 4, pixels.shape[2]).mean(axis=(1, 3))
    np.testing.assert_allclose(decode(tmp_path / "images_4" / "a.tif"), means, atol=0.51)
    with Image.open(tmp_path / "images_4" / "a.tif") as picture:
        assert picture.getexif().get_ifd(IFD.GPSInfo)[GPS.GPSAltitude] == 80


WITH_DIFFERENTIAL = camera_files.exif(gps={GPS.GPSDifferential: 1}).tobytes()
SHORT, LONG = ">HHIHH", ">HHII"


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "heic"])
def test_a_rewritten_photograph_keeps_its_colour_profile(tmp_path: Path, suffix: str):
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    original, target = tmp_path / f"a.{suffix}", tmp_path / f"b.{suffix.replace('heic', 'jpg')}"
    picture = Image.fromarray(camera_files.texture(SIZE))
    if suffix == "heic":
        heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed (the extra [heic])")
        heif.from_pillow(picture).save(original, icc_profile=profile)
    else:
        picture.save(original, icc_profile=profile)
    write_image(camera_files.texture(SIZE, 1), target, original)
    with Image.open(target) as written:
        assert written.info["icc_profile"] == profile


def test_a_profile_of_other_colours_than_rgb_is_left_out(tmp_path: Path):
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    profile[16:20] = b"CMYK"
    Image.fromarray(camera_files.texture(SIZE)).convert("CMYK").save(tmp_path / "a.jpg", icc_profile=bytes(profile))
    write_image(camera_files.texture(SIZE), tmp_path / "b.jpg", tmp_path / "a.jpg")
    with Image.open(tmp_path / "b.jpg") as written:
        assert (written.mode, "icc_profile" in written.info) == ("RGB", False)


DAMAGED = {
    "no header": b"Exif\0\0" + 40 * b"x",
    "a number that Pillow reads and does not write": WITH_DIFFERENTIAL.replace(
        struct.pack(SHORT, GPS.GPSDifferential, 3, 1, 1, 0), struct.pack(LONG, GPS.GPSDifferential, 4, 1, 1 << 20)
    ),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_exif_is_left_out_with_a_warning(tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture):
    (tmp_path / "card").mkdir()
    for k in range(3):
        picture = Image.fromarray(camera_files.texture(SIZE, k))
        picture.save(tmp_path / "card" / f"{k}.jpg", dpi=(72, 72), exif=DAMAGED[damage] if k == 0 else b"")
    photographs = read_survey(tmp_path / "card").photographs
    write_images(photographs, tmp_path / "images", correction([0.8, 1.25, 1.0]), [LENS] * 3, quiet)
    (warning,) = [record.message for record in caplog.records]
    assert f"the EXIF of {tmp_path / 'card' / '0.jpg'} is damaged" in warning
    with Image.open(tmp_path / "images" / "0.jpg") as picture:
        assert dict(picture.getexif()) == {Base.Orientation: 1}
        assert picture.size == SIZE


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_transparent_photographs_are_written_opaque_and_what_is_transparent_is_masked(tmp_path: Path, suffix: str):
    (tmp_path / "card").mkdir()
    alpha = np.full((48, 64), 255, np.uint8)
    alpha[:12], alpha[12:20] = 0, 100
    for k in range(3):
        layers = np.dstack([camera_files.texture(SIZE, k), alpha])
        exif = camera_files.exif({Base.Orientation: 6 if k == 2 else 1}).tobytes()
        # Pillow 13 garbles turned TIFFs that are not compressed, of 1 or 4 bytes a pixel.
        options = {"compression": "tiff_lzw"} if suffix == "tif" else {}
        picture = Image.fromarray(layers if k else layers[..., :3])
        picture.save(tmp_path / "card" / f"{k}.{suffix}", exif=exif, **options)
    Image.fromarray(np.uint8(255 * (np.mgrid[:48, :64][1] < 30))).save(tmp_path / f"1.{suffix}.png")
    photographs = read_survey(tmp_path / "card").photographs
    assert [photograph.has_alpha for photograph in photographs] == [False, True, True]
    photographs = (*photographs[:1], replace(photographs[1], mask=tmp_path / f"1.{suffix}.png"), photographs[2])
    write_images(photographs, tmp_path / "images", None, LENSES, quiet)
    write_masks(photographs, tmp_path / "masks", quiet)
    for k, photograph in enumerate(photographs):
        assert not read_header(tmp_path / "images" / photograph.name)[2]
        np.testing.assert_array_equal(decode(tmp_path / "images" / photograph.name), upright(photograph))
        used = decode(tmp_path / "masks" / f"{photograph.name}.png")[..., 0] > 0
        shown = np.ones((48, 64), bool) if k == 0 else alpha > 0  # in part is enough
        if k == 1:
            shown[:, 30:] = False
        np.testing.assert_array_equal(used, np.rot90(shown, -1) if k == 2 else shown)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_photographs_of_16_bits_are_written_with_8_which_scenes_have(tmp_path: Path, suffix: str):
    (tmp_path / "card").mkdir()
    levels = np.linspace(0, 65535, 64 * 48).reshape(48, 64).astype(np.uint16)
    for k in range(3):
        Image.fromarray(levels).save(tmp_path / "card" / f"{k}.{suffix}")
    photographs = read_survey(tmp_path / "card").photographs
    write_images(photographs, tmp_path / "images", None, [LENS] * 3, quiet)
    assert read_header(tmp_path / "images" / f"0.{suffix}") == (64, 48, False)
    np.testing.assert_array_equal(decode(tmp_path / "images" / f"0.{suffix}"), upright(photographs[0]))


def test_reduced_photographs_are_means_of_whole_blocks_in_the_format_of_the_others(tmp_path: Path):
    pixels = np.random.default_rng(0).integers(0, 256, (11, 14, 4), dtype=np.uint8)
    (tmp_path / "images" / "a").mkdir(parents=True)
    Image.fromarray(pixels).save(tmp_path / "images" / "a" / "alpha.png")
    camera_files.photograph(tmp_path / "images" / "b.jpg", (14, 11), camera_files.exif({Base.Model: "M1"}))
    write_reduced_images(tmp_path, ["a/alpha.png", "b.jpg"], (2, 4), quiet)
    for factor, (width, height) in {2: (7, 5), 4: (3, 2)}.items():
        blocks = pixels[: height * factor, : width * factor].reshape(height, factor, width, factor, 4)
        with Image.open(tmp_path / f"images_{factor}" / "a" / "alpha.png") as picture:
            np.testing.assert_allclose(np.asarray(picture), blocks.mean(axis=(1, 3)), atol=0.51)
        with Image.open(tmp_path / f"images_{factor}" / "b.jpg") as picture:
            assert (picture.format, picture.size, picture.getexif()[Base.Model]) == ("JPEG", (width, height), "M1")


@pytest.mark.parametrize("factors", [(1,), (0,), (-2,), (2, 2), (65,)])
def test_factors_that_do_not_reduce_are_one_clear_error(factors: tuple[int, ...]):
    with pytest.raises(RunError, match=r"--downscale is .*expected different whole numbers from 2 to 64"):
        reduced_folders(factors)


def test_a_photograph_that_is_too_small_to_reduce_is_named(tmp_path: Path):
    camera_files.photograph(tmp_path / "images" / "b.jpg", (14, 3))
    with pytest.raises(RunError, match=r"b\.jpg has 14 x 3 pixels: expected at least 4 each way for images_4"):
        write_reduced_images(tmp_path, ["b.jpg"], (4,), quiet)


def test_other_files_in_the_folder_stay(photographs, tmp_path: Path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "notes.txt").write_bytes(b"mine")
    write_images(photographs, tmp_path / "images", None, LENSES, quiet)
    assert (tmp_path / "images" / "notes.txt").read_bytes() == b"mine"


def test_angles_are_found_once_for_each_lens_that_darkens(photographs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    found = []
    monkeypatch.setattr(export, "tangent_map", lambda camera: found.append(camera) or tangent_map(camera))
    asked = correction([1, 1, 1], falloff=-0.4)
    asked.falloff[2] = 0
    write_images(photographs, tmp_path / "images", asked, LENSES, quiet)
    assert found == [LENS]


def test_nothing_is_black_where_a_lens_images_no_point():
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=160, height=120, params=[100, 80, 60, -0.25], camera_id=1)
    found = tangent_map(lens)
    assert np.isfinite(found).all()
    assert found[0, 0] == found.max()
    even = np.full((120, 160, 3), 120, np.uint8)
    assert to_common_exposure(even, np.ones(3), np.array([-0.05, 0.02, -0.01]), found).min() >= 100


def test_interpolated_angles_equal_the_lens_model():
    lens = pycolmap.Camera(model="RADIAL", width=403, height=301, params=[320, 200, 150, -0.2, 0.1], camera_id=1)
    found = tangent_map(lens)
    assert found.shape == (301, 403)
    for u, v in ((10, 20), (200, 150), (390, 290), (333, 40)):
        true = np.linalg.norm(np.asarray(lens.cam_from_img(np.array([[u + 0.5, v + 0.5]])))[0])
        assert found[v, u] == pytest.approx(true, abs=0.01)
