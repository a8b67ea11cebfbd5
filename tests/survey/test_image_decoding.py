"""Photographs are decoded upright, in 8-bit RGB, whole or not at all."""

import struct
import zlib
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from camera_files import exif, photograph, survey_folder, texture
from PIL import Image, ImageOps
from PIL.ExifTags import Base

from tidefield.data.readers.files import open_picture, quiet_pillow
from tidefield.errors import SceneError, SurveyError
from tidefield.survey.io import image_decoding
from tidefield.survey.io.image_decoding import thumbnail, upright, upright_size, upright_uv
from tidefield.survey.io.photographs import _Read, _read, read_survey
from tidefield.survey.survey import Photograph


def read(path: Path) -> Photograph:
    found = _read(path, path.name)
    assert isinstance(found, _Read), found
    return found.photograph


def unread(path: Path) -> Photograph:
    """A photograph without metadata, for files that cannot be read."""
    nan = float("nan")
    return Photograph(path, path.name, 1, 1, 1, "", "", nan, None, nan, None, nan, None)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_orientation_is_decoded_upright(tmp_path, suffix, orientation):
    path = photograph(tmp_path / f"a.{suffix}", (64, 48), exif({Base.Orientation: orientation}))
    taken = read(path)
    pixels = upright(taken)
    with Image.open(path) as picture:
        expected = np.asarray(ImageOps.exif_transpose(picture))
    assert pixels.dtype == np.uint8
    assert pixels.flags.c_contiguous
    assert pixels.shape == (taken.height, taken.width, 3) == expected.shape
    np.testing.assert_array_equal(pixels, expected)
    assert thumbnail(taken, 32).shape == ((24, 32, 3) if orientation < 5 else (32, 24, 3))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixel_positions_follow_the_orientation(tmp_path, orientation):
    stored = np.zeros((48, 64, 3), np.uint8)
    stored[10, 20] = 255
    path = photograph(tmp_path / "a.png", table=exif({Base.Orientation: orientation}), pixels=stored)
    row, column = np.argwhere(upright(read(path))[..., 0])[0]
    assert upright_uv((20.5, 10.5), 64, 48, orientation) == (column + 0.5, row + 0.5)
    corner = upright_uv((64.0, 48.0), 64, 48, orientation)
    assert corner[0] in (0, upright_size(64, 48, orientation)[0])


def test_transparency_is_blended_over_white(tmp_path):
    layer = np.dstack([np.full((8, 8, 3), 100, np.uint8), np.full((8, 8), 51, np.uint8)])
    layer[0, 0, 3] = 0
    layer[1, 1, 3] = 255
    Image.fromarray(layer).save(tmp_path / "a.png")
    pixels = upright(read(tmp_path / "a.png"))
    assert pixels[0, 0].tolist() == [255, 255, 255]
    assert pixels[1, 1].tolist() == [100, 100, 100]
    assert pixels[2, 2].tolist() == [224, 224, 224]  # 255 - (255 - 100) / 5


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_sixteen_bits_become_eight(tmp_path, suffix):
    levels = np.linspace(0, 65535, 64 * 48).reshape(48, 64).astype(np.uint16)
    Image.fromarray(levels).save(tmp_path / f"a.{suffix}")
    pixels = upright(read(tmp_path / f"a.{suffix}"))
    np.testing.assert_array_equal(pixels, np.repeat((levels >> 8).astype(np.uint8)[..., None], 3, axis=-1))


@pytest.mark.parametrize("mode", ["L", "P", "1", "CMYK", "LA"])
def test_other_kinds_of_pixels_become_rgb(tmp_path, mode):
    picture = Image.fromarray(texture((64, 48))).convert(mode)
    path = tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
    picture.save(path)
    pixels = upright(read(path))
    assert pixels.shape == (48, 64, 3)
    np.testing.assert_array_equal(pixels, np.asarray(picture.convert("RGB")))


def test_a_survey_leaves_photographs_of_floating_point_numbers_out(tmp_path):
    survey_folder(tmp_path)
    Image.fromarray(np.zeros((48, 64), np.float32)).save(tmp_path / "a.tif")
    survey = read_survey(tmp_path)
    assert "a.tif" not in [photograph.name for photograph in survey.photographs]
    assert "a.tif has pixels of floating-point numbers: expected 8 or 16 bits; export it" in " ".join(survey.remarks)


def test_a_thumbnail_is_the_photograph_reduced(tmp_path):
    pixels = np.full((1200, 1600, 3), 30, np.uint8)
    pixels[:600, 800:] = 220
    taken = read(photograph(tmp_path / "a.jpg", pixels=pixels))
    small = thumbnail(taken, 200)
    assert small.shape == (150, 200, 3)
    assert small[:70, 105:].min() > 210
    assert small[80:].max() < 40
    assert thumbnail(taken, 5000).shape == (1200, 1600, 3)


def test_a_thumbnail_of_a_truncated_photograph_is_an_error(tmp_path):
    path = photograph(tmp_path / "a.jpg", (400, 300))
    path.write_bytes(path.read_bytes()[:-3000])
    for decode in (upright, lambda taken: thumbnail(taken, 50)):
        with pytest.raises(SurveyError, match=r"a.jpg cannot be read .*truncated.*copy it again"):
            decode(unread(path))


def png_header(path: Path, width: int, height: int) -> Path:
    """A PNG of a few bytes that claims a size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b""))
    return path


def test_a_small_file_that_claims_billions_of_pixels_is_refused_before_it_is_decoded(tmp_path):
    path = png_header(tmp_path / "bomb.png", 60_000, 60_000)
    with pytest.raises(SurveyError, match="60000 x 60000 pixels, more than 178 million"):
        upright(unread(path))
    found = _read(path, path.name)
    assert isinstance(found, str)
    assert "more than 178 million" in found


def test_a_photograph_of_a_hundred_megapixels_is_opened(tmp_path):
    with image_decoding.open_image(png_header(tmp_path / "large.png", 11_648, 8_736)) as picture:
        assert picture.size == (11_648, 8_736)


@pytest.mark.parametrize(("height", "opens"), [(15_979, True), (15_980, False)])
def test_surveys_and_scenes_have_the_same_limit_of_pixels(tmp_path, height, opens):
    path = png_header(tmp_path / "large.png", 11_199, height)
    for reader, error in ((image_decoding.open_image, SurveyError), (open_picture, SceneError)):
        with quiet_pillow(), nullcontext() if opens else pytest.raises(error), reader(path) as picture:
            assert picture.size == (11_199, height)
