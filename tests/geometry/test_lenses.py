import numpy as np
import pycolmap
import pytest

from tidefield.errors import SceneError
from tidefield.geometry.lenses import (
    COLMAP_MODELS,
    COLMAP_PARAMETERS,
    WIDEST_DEG,
    FisheyeLens,
    Lens,
    LensModel,
    colmap_parameters,
    lens_from_colmap,
    rectify,
)

CAMERAS = {
    "SIMPLE_PINHOLE": [210.0, 160.5, 119.0],
    "PINHOLE": [210.0, 220.0, 160.5, 119.0],
    "SIMPLE_RADIAL": [210.0, 160.5, 119.0, 0.07],
    "RADIAL": [280.0, 160.0, 120.0, -0.32, 0.15],
    "OPENCV": [210.0, 220.0, 163.0, 116.0, -0.2, 0.05, 0.003, -0.004],
    "SIMPLE_RADIAL_FISHEYE": [180.0, 160.5, 119.0, 0.03],
    "RADIAL_FISHEYE": [180.0, 160.5, 119.0, 0.03, -0.01],
    "OPENCV_FISHEYE": [150.0, 152.0, 161.0, 118.0, 0.04, -0.012, 0.004, -0.0008],
}
DISTORTED = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")


def lens(model: str) -> LensModel:
    return lens_from_colmap(model, 320, 240, CAMERAS[model])


def colmap(model: str) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=320, height=240, params=CAMERAS[model])


def dots(uv_px: np.ndarray, width: int = 320, height: int = 240) -> np.ndarray:
    """A picture of soft dots at given pixels."""
    v, u = np.mgrid[:height, :width] + 0.5
    light = sum(np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 2.5**2)) for x, y in uv_px)
    return np.repeat(np.round(250 * np.clip(light, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)


def centroid(picture: np.ndarray, near_px: np.ndarray, reach: int) -> np.ndarray:
    x, y = np.floor(near_px).astype(int)
    window = picture[y - reach : y + reach + 1, x - reach : x + reach + 1, 0].astype(float)
    v, u = np.mgrid[y - reach : y + reach + 1, x - reach : x + reach + 1] + 0.5
    return np.array([(u * window).sum(), (v * window).sum()]) / window.sum()


@pytest.mark.parametrize("model", CAMERAS)
def test_points_project_where_colmap_projects_them(model: str) -> None:
    random = np.random.default_rng(0)
    xyz = np.concatenate([random.uniform(-0.6, 0.6, (500, 2)), random.uniform(0.9, 3, (500, 1))], axis=1)
    np.testing.assert_allclose(lens(model).project(xyz), colmap(model).img_from_cam(xyz), atol=1e-9)


@pytest.mark.parametrize("model", CAMERAS)
def test_pixels_come_back_from_their_rays_and_agree_with_colmap(model: str) -> None:
    uv = np.random.default_rng(1).uniform((0, 0), (320, 240), (500, 2))
    xy = lens(model).unproject(uv)
    np.testing.assert_allclose(lens(model).project(np.c_[xy, np.ones(500)]), uv, atol=1e-7)
    np.testing.assert_allclose(xy, colmap(model).cam_from_img(uv), atol=1e-7)


@pytest.mark.parametrize("model", ["FOV", "THIN_PRISM_FISHEYE", "EQUIRECTANGULAR"])
def test_other_camera_models_are_refused(model: str) -> None:
    with pytest.raises(SceneError, match=rf"{model}.*RADIAL.*image_undistorter"):
        lens_from_colmap(model, 320, 240, [1.0] * 8)


def test_full_opencv_is_read_if_its_rational_terms_are_zero() -> None:
    parameters = [200.0, 201.0, 160.0, 120.0, 0.1, -0.05, 0.002, 0.001, 0.03, 0.0, 0.0, 0.0]
    own = lens_from_colmap("FULL_OPENCV", 320, 240, parameters)
    camera = pycolmap.Camera(model="FULL_OPENCV", width=320, height=240, params=parameters)
    xyz = np.random.default_rng(3).uniform((-0.7, -0.7, 1), (0.7, 0.7, 1), (50, 3))
    np.testing.assert_allclose(own.project(xyz), camera.img_from_cam(xyz), atol=1e-9)
    with pytest.raises(SceneError, match=r"k4, k5 or k6 .*image_undistorter"):
        lens_from_colmap("FULL_OPENCV", 320, 240, [*parameters[:10], 0.01, 0.0])


def test_unusable_calibrations_are_refused() -> None:
    with pytest.raises(SceneError, match="3 parameters, expected 4"):
        lens_from_colmap("PINHOLE", 320, 240, [1.0, 2.0, 3.0])
    for bad in ([float("nan"), 1.0, 1.0], [0.0, 160.0, 120.0], [-5.0, 160.0, 120.0]):
        with pytest.raises(SceneError, match="calibrat"):
            lens_from_colmap("SIMPLE_PINHOLE", 320, 240, bad)


def test_corners_that_lie_beyond_the_fold_before_they_are_corrected_have_rays() -> None:
    lens = Lens(1000, 750, 250.0, 250.0, 500.0, 375.0, k1=0.3, k2=-0.05, k3=-0.005)
    r = np.linspace(0, 3, 30001)
    distorted = r * (1 + lens.k1 * r**2 + lens.k2 * r**4 + lens.k3 * r**6)
    fold = int(np.argmax(distorted))
    assert r[fold] < 0.98 * distorted[fold], "such points are tried"
    xy = lens.undistort(np.column_stack([distorted[: fold - 300 : 100], np.zeros(len(r[: fold - 300 : 100]))]))
    np.testing.assert_allclose(xy[:, 0], r[: fold - 300 : 100], atol=1e-9)


def test_pixels_beyond_the_fold_of_a_lens_have_no_ray() -> None:
    folded = Lens(800, 600, 400.0, 400.0, 400.0, 300.0, k1=-0.3)
    # r - 0.3 r^3 is greatest at r = 1/sqrt(0.9), where it is 0.7027.
    xy = folded.undistort(np.array([[0.70, 0.0], [0.71, 0.0], [0.5, 0.0]]))
    assert np.isfinite(xy[[0, 2]]).all()
    assert np.isnan(xy[1]).all()


@pytest.mark.parametrize("distorted", [*map(lens, DISTORTED), Lens(800, 600, 400.0, 400.0, 400.0, 300.0, k1=-0.3)])
def test_the_pinhole_lies_inside_the_photograph_and_reaches_its_border(distorted: Lens) -> None:
    pinhole = distorted.pinhole()
    u, v = np.meshgrid(np.linspace(0, pinhole.width, 161), np.linspace(0, pinhole.height, 121))
    grid = np.stack([u, v], axis=-1).reshape(-1, 2)
    uv = distorted.project(np.c_[pinhole.unproject(grid), np.ones(len(grid))])
    size = np.array([distorted.width, distorted.height])
    assert (uv > -0.1).all()
    assert (uv < size + 0.1).all()
    folds = distorted.k1 == -0.3  # there the fold comes before the border
    assert folds or (uv.min(axis=0) < 0.1).all()
    assert folds or (uv.max(axis=0) > size - 0.1).all()


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV"])  # a fisheye's are far too lopsided
@pytest.mark.parametrize("reduction", [1, 2])
def test_rectified_dots_lie_where_the_pinhole_projects_them(model: str, reduction: int) -> None:
    distorted, pinhole = lens(model), lens(model).pinhole()
    u, v = np.meshgrid(np.linspace(20, 300, 8), np.linspace(20, 220, 6))
    rays = np.c_[pinhole.unproject(np.stack([u, v], axis=-1).reshape(-1, 2)), np.ones(48)]
    result = rectify(dots(distorted.project(rays)), distorted, 320 // reduction, 240 // reduction)
    expected = pinhole.resized(320 // reduction, 240 // reduction).project(rays)
    found = np.array([centroid(result, dot, 10 // reduction) for dot in expected])
    # Distortion makes the dots themselves a little lopsided.
    assert np.abs(found - expected).max() < 0.15
    assert np.abs((found - expected).mean(axis=0)).max() < 0.02  # half a pixel lost anywhere would show here


@pytest.mark.parametrize("model", DISTORTED)
def test_rectified_photographs_have_no_blank_pixels(model: str) -> None:
    white = np.full((240, 320, 3), 255, np.uint8)
    assert (rectify(white, lens(model), 320, 240) == 255).all()
    assert (rectify(white, lens(model), 100, 75) == 255).all()


def test_a_photograph_without_distortion_is_unchanged() -> None:
    photograph = np.random.default_rng(3).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    assert (rectify(photograph, lens("PINHOLE"), 320, 240) == photograph).all()
    assert lens("PINHOLE").pinhole() == lens("PINHOLE")


def test_reduction_is_the_mean_of_the_covered_pixels() -> None:
    photograph = np.random.default_rng(4).integers(0, 256, (240, 320, 4), dtype=np.uint8)
    means = photograph.reshape(60, 4, 80, 4, 4).astype(float).mean(axis=(1, 3))
    assert np.abs(rectify(photograph, lens("PINHOLE"), 80, 60) - means).max() <= 0.5


def test_a_resized_lens_projects_to_resized_pixels() -> None:
    xyz = np.array([[0.2, -0.3, 1.0]])
    np.testing.assert_allclose(lens("OPENCV").resized(160, 60).project(xyz), lens("OPENCV").project(xyz) * (0.5, 0.25))


def test_the_table_of_camera_models_is_colmaps() -> None:
    """The smallest pycolmap that is promised lacks the last models."""
    for number, model in enumerate(COLMAP_MODELS):
        if model in pycolmap.CameraModelId.__members__:
            assert int(pycolmap.CameraModelId.__members__[model]) == number
    for model, names in COLMAP_PARAMETERS.items():
        camera = pycolmap.Camera.create_from_model_name(1, model, 100.0, 320, 240)
        names = ["k" if model.startswith("SIMPLE_RADIAL") and name == "k1" else name for name in names]
        assert camera.params_info.split(", ") == names


@pytest.mark.parametrize("model", CAMERAS)
def test_parameters_come_back_in_colmaps_order(model: str) -> None:
    assert colmap_parameters(lens(model), model) == CAMERAS[model]


def test_parameters_of_a_simpler_model_drop_terms_and_average_the_focal_lengths() -> None:
    assert colmap_parameters(lens("OPENCV"), "RADIAL") == [215.0, 163.0, 116.0, -0.2, 0.05]
    assert colmap_parameters(lens("RADIAL"), "FULL_OPENCV") == [280.0, 280.0, 160.0, 120.0, -0.32, 0.15] + [0.0] * 6


WIDE = FisheyeLens(800, 600, 255.0, 255.0, 400.0, 300.0, 0.01, -0.002, 0.0003, -0.00002)  # 180 degrees across


def test_a_fisheye_sees_what_lies_far_to_the_side() -> None:
    angle = np.radians([0.0, 1e-7, 1.0, 30.0, 60.0, 85.0, 89.0])
    xyz = np.c_[np.sin(angle), np.zeros(7), np.cos(angle)]
    terms = angle + 0.01 * angle**3 - 0.002 * angle**5 + 0.0003 * angle**7 - 0.00002 * angle**9
    np.testing.assert_allclose(WIDE.project(xyz), np.c_[400 + 255 * terms, np.full(7, 300.0)], atol=1e-9)
    back = WIDE.unproject(WIDE.project(xyz))
    np.testing.assert_allclose(back[:, 0], np.tan(angle), rtol=1e-9, atol=1e-15)
    assert np.abs(WIDE.project(np.c_[back, np.ones(7)]) - WIDE.project(xyz)).max() < 0.01
    beyond = WIDE.unproject(np.array([[400 + 255 * 1.65, 300.0]]))  # more than 90 degrees from the axis
    assert np.isnan(beyond).all()


def test_the_pinhole_of_a_fisheye_has_square_pixels_and_at_most_the_widest_angle() -> None:
    pinhole = WIDE.pinhole()
    assert isinstance(pinhole, Lens)
    assert not pinhole.is_distorted
    assert (pinhole.width, pinhole.height) == (800, 600)
    assert pinhole.fx == pytest.approx(pinhole.fy)
    edges = pinhole.unproject(np.array([[0.0, 300.0], [800.0, 300.0]]))[:, 0]
    assert np.degrees(np.arctan(edges)) == pytest.approx([-WIDEST_DEG / 2, WIDEST_DEG / 2])


@pytest.mark.thorough
def test_a_straight_line_is_straight_when_a_fisheye_is_undistorted() -> None:
    pinhole, size = WIDE.pinhole(), (600, 800)
    v, u = np.mgrid[: size[0], : size[1]] + 0.5
    rays = WIDE.unproject(np.stack([u, v], -1).reshape(-1, 2)).reshape(*size, 2)
    # Distance of every pixel's ray from the line y = 0.3 x + 0.5 on the plane z = 1, which lies above dark ground.
    off = rays[..., 1] - 0.3 * rays[..., 0] - 0.5
    soft = 255 / (1 + np.exp(-np.where(np.isfinite(off), off, 1.0).clip(-1, 1) * 100))
    photograph = np.repeat(np.round(soft).astype(np.uint8)[..., None], 3, axis=2)
    result = rectify(photograph, WIDE, 800, 600)[..., 0].astype(float)
    found = []
    for column in range(100, 700, 25):
        row = int(np.flatnonzero(np.diff(np.signbit(result[:, column] - 127.5)))[0])
        share = (127.5 - result[row, column]) / (result[row + 1, column] - result[row, column])
        found.append((column + 0.5, row + 0.5 + share))
    xy = pinhole.unproject(np.array(found))
    assert np.abs(xy[:, 1] - 0.3 * xy[:, 0] - 0.5).max() * pinhole.fy < 0.05


def test_a_fisheye_that_sees_less_keeps_its_whole_field_of_view() -> None:
    narrow = FisheyeLens(800, 600, 700.0, 700.0, 400.0, 300.0)
    pinhole = narrow.pinhole()
    edge = pinhole.unproject(np.array([[800.0, 300.0]]))[0, 0]
    assert np.arctan(edge) == pytest.approx(400 / 700, rel=0.01)
