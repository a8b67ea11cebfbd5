"""Lens priors of metadata are in pixels of the upright photograph."""

import math
from pathlib import Path

import numpy as np
import pytest
from camera_files import exif, one, real_survey, xmp
from PIL.ExifTags import Base

from tidefield.survey.io.photographs import read_survey


def test_position_and_focal_length_of_a_phantom_3():
    first = read_survey(real_survey("brighton_beach")).photographs[0]
    assert (first.camera, first.width, first.height, first.orientation) == ("DJI FC300S", 1600, 900, 1)
    assert first.position is not None
    assert first.position.latitude_deg == pytest.approx(46 + 50 / 60 + 33.3855 / 3600)
    assert first.position.longitude_deg == pytest.approx(-(91 + 59 / 60 + 40.4156 / 3600))
    assert (first.position.height_m, first.position.datum, first.position.source) == (198.31, "unknown", "EXIF")
    assert first.relative_altitude_m == 39.8
    assert first.gimbal_deg == (45.0, -89.9, 0.0)
    assert first.lens is not None
    assert first.lens.focal_px == pytest.approx(936, rel=0.003)  # at which its height of flight came out right
    assert not first.lens.trusted


def test_the_calibration_of_a_phantom_4_multispectral():
    first = read_survey(real_survey("turin_lot")).photographs[0]
    assert first.lens is not None
    assert (first.lens.source, first.lens.trusted) == ("DJI dewarp data", True)
    assert first.lens.focal_px == pytest.approx((1973.0899658 + 1955.6500244) / 2)
    assert first.lens.principal_px == pytest.approx((800 - 19.0419922, 650 - 11.4249878))
    assert first.lens.distortion == pytest.approx((-0.42275, 0.369101, 0.0040638, 0.0040638, -0.264306))
    assert first.position is not None
    assert (first.position.horizontal_m, first.position.vertical_m) == (0.0138, 0.0205)
    assert (first.position.datum, first.position.source) == ("ellipsoid", "EXIF, RTK fixed")
    assert first.serial == "7d2ed18fec733f57faa2ea5415a75c9f"


def test_a_lens_prior_follows_the_orientation(tmp_path):
    numbers = "2024-01-01;800,800,30,-20,-0.1,0.02,0.001,-0.002,0.003"
    packet = xmp(
        {"DewarpData": numbers, "CalibratedOpticalCenterX": "500", "CalibratedOpticalCenterY": "400", "DewarpFlag": "0"}
    )
    straight = one(tmp_path / "a", size=(1000, 800), packet=packet).lens
    turned = one(tmp_path / "b", size=(1000, 800), packet=packet, table=exif({Base.Orientation: 6})).lens
    assert straight is not None
    assert turned is not None
    assert straight.principal_px == pytest.approx((530, 380))
    assert turned.principal_px == pytest.approx((800 - 380, 530))
    assert straight.distortion == pytest.approx((-0.1, 0.02, 0.001, -0.002, 0.003))

    def distorted(lens, xy):
        k1, k2, p1, p2, k3 = lens.distortion
        (x, y), r2 = xy, xy @ xy
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        return np.array(
            [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        )

    quarter = np.array([[0, -1], [1, 0]])
    xy = np.array([0.3, -0.2])
    assert distorted(turned, quarter @ xy) == pytest.approx(quarter @ distorted(straight, xy))


@pytest.mark.parametrize(("size", "principal"), [((500, 400), (265, 190)), ((500, 300), (265, 140))])
def test_dewarp_data_follow_a_photograph_that_was_reduced_and_cut(tmp_path, size, principal):
    packet = xmp(
        {
            "DewarpData": "2024-01-01;800,800,30,-20,0,0,0,0,0",
            "CalibratedOpticalCenterX": "500",
            "CalibratedOpticalCenterY": "400",
        }
    )
    lens = one(tmp_path, size=size, packet=packet).lens
    assert lens is not None
    assert lens.focal_px == pytest.approx(400)
    assert lens.principal_px == pytest.approx(principal)


def test_a_photograph_that_the_drone_dewarped_has_no_distortion(tmp_path):
    packet = xmp({"DewarpData": "2024-01-01;800,800,30,-20,-0.1,0.02,0,0,0", "DewarpFlag": "1"})
    lens = one(tmp_path, size=(1000, 800), packet=packet).lens
    assert lens is not None
    assert (lens.distortion, lens.principal_px, lens.trusted) == ((0.0,) * 5, None, True)


@pytest.mark.parametrize("numbers", ["", "2024;1,2,3", "2024;0,0,0,0,0,0,0,0,0", "2024;nan,1,1,1,1,1,1,1,1", "x;y"])
def test_dewarp_data_that_are_none_leave_the_design_focal_length(tmp_path, numbers):
    packet = xmp(
        {
            "DewarpData": numbers,
            "CalibratedFocalLength": "900",
            "CalibratedOpticalCenterX": "500",
            "CalibratedOpticalCenterY": "400",
        }
    )
    lens = one(tmp_path, size=(1000, 800), packet=packet).lens
    assert lens is not None
    assert (lens.focal_px, lens.source, lens.trusted) == (900, "DJI design focal length", False)


def test_pix4d_calibrations_are_in_millimetres(tmp_path):
    packet = xmp(
        {
            "Camera:PerspectiveFocalLength": "5.4",
            "Camera:PerspectiveFocalLengthUnits": "mm",
            "Camera:PrincipalPoint": "2.5,1.8",
            "Camera:PerspectiveDistortion": "-0.1,0.15,-0.13,0.001,-0.002",
        }
    )
    table = exif({Base.FocalPlaneXResolution: 1000 / 4.8, Base.FocalPlaneResolutionUnit: 4})
    lens = one(tmp_path, size=(1000, 750), packet=packet, table=table).lens
    assert lens is not None
    assert lens.trusted
    assert lens.focal_px == pytest.approx(5.4 / 4.8 * 1000, rel=1e-4)
    assert lens.principal_px == pytest.approx((2.5 / 4.8 * 1000, 1.8 / 4.8 * 1000), rel=1e-4)
    assert lens.distortion == pytest.approx((-0.1, 0.15, 0.001, -0.002, -0.13))


def focal(folder: Path, size: tuple[int, int], tags: dict) -> float:
    lens = one(folder, size=size, table=exif(tags)).lens
    return math.nan if lens is None else lens.focal_px


def test_an_equivalent_focal_length_is_by_the_diagonal_of_the_whole_sensor(tmp_path):
    tags = {Base.FocalLength: 8.8, Base.FocalLengthIn35mmFilm: 24}  # a one-inch sensor, 3:2
    whole = focal(tmp_path / "a", (1200, 800), tags)
    assert whole == pytest.approx(24 / math.hypot(36, 24) * math.hypot(1200, 800))
    assert whole == pytest.approx(8.8 / 13.2 * 1200, rel=0.01)
    assert focal(tmp_path / "b", (1200, 675), tags) == pytest.approx(whole)  # 16:9 is cut above and below
    assert focal(tmp_path / "c", (1067, 800), tags) == pytest.approx(whole)  # 4:3 at the sides
    assert focal(tmp_path / "d", (800, 1200), tags) == pytest.approx(whole)
    small = {Base.FocalLength: 4.5, Base.FocalLengthIn35mmFilm: 24}  # half an inch, 4:3
    assert focal(tmp_path / "e", (1280, 720), small) == pytest.approx(focal(tmp_path / "f", (1280, 960), small))


@pytest.mark.parametrize(("size", "equivalent", "width_mm"), [((1164, 873), 36, 43.8), ((1200, 800), 36, 45.0)])
def test_photographs_of_medium_formats_show_all_of_their_sensor(tmp_path, size, equivalent, width_mm):
    """Fuji GFX (4:3), Leica S (3:2): of 45 mm and, by the diagonal, 36 mm for film."""
    found = focal(tmp_path, size, {Base.FocalLength: 45.0, Base.FocalLengthIn35mmFilm: equivalent})
    assert found == pytest.approx(45.0 / width_mm * size[0], rel=0.015)


def test_the_sensor_of_a_camera_without_an_equivalent_is_looked_up(tmp_path):
    pytest.importorskip("lensfunpy", reason="lensfunpy is not installed (the extra [lensfun])")
    tags = {Base.Make: "Canon", Base.Model: "Canon EOS 5D Mark II", Base.FocalLength: 24.0}
    assert focal(tmp_path / "a", (1200, 800), tags) == pytest.approx(24 / 36 * 1200, rel=1e-3)
    assert math.isnan(focal(tmp_path / "b", (1200, 800), {**tags, Base.Make: "Nobody", Base.Model: "X"}))


def test_a_focal_length_of_nearly_nothing_has_no_crop_factor(tmp_path):
    focal(tmp_path, (120, 80), {Base.FocalLength: 1e-320, Base.FocalLengthIn35mmFilm: 65535})


def test_a_focal_plane_resolution_is_for_the_picture_that_the_camera_wrote(tmp_path):
    tags = {
        Base.FocalLength: 4.3,
        Base.FocalPlaneXResolution: 4000 / 6.2 * 25.4,
        Base.FocalPlaneResolutionUnit: 2,
        Base.ExifImageWidth: 4000,
        Base.ExifImageHeight: 3000,
    }
    assert focal(tmp_path / "a", (400, 300), tags) == pytest.approx(4.3 / 6.2 * 400, rel=1e-3)
    assert focal(tmp_path / "b", (300, 400), tags) == pytest.approx(4.3 / 6.2 * 400, rel=1e-3)
    # Whoever reduced this one wrote its own size into EXIF, but left the resolution: no sensor is 0.6 mm wide.
    assert math.isnan(focal(tmp_path / "c", (400, 300), {**tags, Base.ExifImageWidth: 400, Base.ExifImageHeight: 300}))
