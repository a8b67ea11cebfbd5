"""Gaussian splats: their file, and their rendering against closed forms and a brute-force evaluation."""

import math
from pathlib import Path

import numpy as np
import pytest
import textured_wall as wall
import torch
from gaussian_files import write_gaussians
from torch import Tensor

from tidefield.baselines import splats as module
from tidefield.baselines.splats import Splats, read_splats, render_splats
from tidefield.errors import SceneError
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.parallel import interruptible

CPU, BLACK = torch.device("cpu"), (0.0, 0.0, 0.0)
C0, C1 = 0.28209479177387814, 0.4886025119029199


def gaussians(mean: list, scale: list, opacity: list, colour: list) -> Splats:
    """Spheres of one colour each."""
    size = torch.tensor(scale)[:, None, None]
    return Splats(
        torch.tensor(mean), size * torch.eye(3), torch.tensor(opacity), (torch.tensor(colour) - 0.5)[..., None] / C0
    )


def camera(turned: float = 0.0) -> Cameras:
    """48 x 36 pixels, f = 48, in the origin, along +z, or turned about y by so many radians; off-centre."""
    own = wall.cameras(1)
    c, s = math.cos(turned), math.sin(turned)
    own.T_world_camera[0, :, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    own.principal_px[0] = torch.tensor([20.5, 13.5])
    return own


def brute_force(splats: Splats, own: Cameras, background: tuple[float, float, float]) -> Tensor:
    """One pixel and one Gaussian after another; spheres and ellipsoids, K = 1."""
    pose, (fx, fy), (cx, cy) = own.T_world_camera[0].double(), own.focal_px[0].tolist(), own.principal_px[0].tolist()
    picture = torch.zeros(own.height, own.width, 3)
    seen = []
    for mean, axes, opacity, harmonics in zip(
        splats.mean_world, splats.axes_world, splats.opacity, splats.harmonics, strict=True
    ):
        x, y, z = (pose[:, :3].T @ (mean.double() - pose[:, 3])).tolist()
        jacobian = torch.tensor([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]]).double()
        half = jacobian @ pose[:, :3].T @ axes.double()
        inverse = torch.linalg.inv(half @ half.T + 0.3 * torch.eye(2))
        seen.append((z, fx * x / z + cx, fy * y / z + cy, inverse, float(opacity), 0.5 + C0 * harmonics[:, 0]))
    seen.sort(key=lambda one: one[0])
    for row in range(own.height):
        for column in range(own.width):
            light, colour = 1.0, torch.zeros(3)
            for _, u, v, inverse, opacity, own_colour in seen:
                off = torch.tensor([column + 0.5 - u, row + 0.5 - v]).double()
                alpha = min(0.999, opacity * math.exp(-0.5 * float(off @ inverse @ off)))
                if alpha < 1 / 255:
                    continue
                if light * (1 - alpha) < 1e-4:
                    break
                colour, light = colour + light * alpha * own_colour.clamp(min=0), light * (1 - alpha)
            picture[row, column] = colour + light * torch.tensor(background)
    return picture.clamp(0, 1)


def test_a_sphere_is_brightest_in_its_pixel_and_falls_off_as_a_gaussian():
    own = camera()
    # Its centre falls on (30.5, 18.5), the centre of the pixel in column 30 and row 18.
    splats = gaussians([[10 / 48 * 6, 5 / 48 * 6, 6.0]], [0.25], [0.8], [[1.0, 0.5, 0.25]])
    view = render_splats(splats, own, BLACK, CPU)
    assert divmod(int(view.opacity.argmax()), own.width) == (18, 30)
    assert view.opacity[18, 30] == pytest.approx(0.8, abs=1e-5)
    torch.testing.assert_close(view.colour[18, 30], 0.8 * torch.tensor([1.0, 0.5, 0.25]))
    variance_v = (48 * 0.25 / 6) ** 2 * (1 + (5 / 48) ** 2) + 0.3
    variance_u = (48 * 0.25 / 6) ** 2 * (1 + (10 / 48) ** 2) + 0.3
    across = (48 * 0.25 / 6) ** 2 * (10 / 48) * (5 / 48)
    determinant = variance_u * variance_v - across**2
    for k in range(-4, 5):
        assert view.opacity[18, 30 + k] == pytest.approx(
            0.8 * math.exp(-0.5 * k * k * variance_v / determinant), abs=1e-5
        )
        assert view.opacity[18 + k, 30] == pytest.approx(
            0.8 * math.exp(-0.5 * k * k * variance_u / determinant), abs=1e-5
        )
    assert view.opacity[0, 0] == 0
    assert view.depth[18, 30] == pytest.approx(6, abs=1e-5)
    assert view.depth[0, 0] == own.near_far[0, 1]


def test_what_is_nearer_covers_what_is_farther():
    splats = gaussians([[0.0, 0.0, 8.0], [0.0, 0.0, 4.0]], [0.4, 0.2], [0.9, 0.75], [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    own = camera()
    view = render_splats(splats, own, (0.0, 0.0, 1.0), CPU)
    centre = view.colour[13, 20]
    torch.testing.assert_close(centre, torch.tensor([0.75, 0.25 * 0.9, 0.25 * 0.1]))
    assert view.depth[13, 20] == pytest.approx((0.75 * 4 + 0.225 * 8) / 0.975, abs=1e-4)
    assert view.opacity[13, 20] == pytest.approx(0.975, abs=1e-5)
    behind = render_splats(splats, camera(math.pi), BLACK, CPU)
    assert behind.opacity.max() == 0


def test_a_view_that_is_not_wanted_any_more_ends_at_the_next_tile():
    started = []

    def check() -> None:
        started.append(1)
        if len(started) == 3:
            raise TimeoutError

    with interruptible(check), pytest.raises(TimeoutError):
        render_splats(gaussians([[0.0, 0.0, 4.0]], [0.1], [0.5], [[1.0, 1.0, 1.0]]), camera(), BLACK, CPU)


def test_light_is_followed_until_hardly_any_is_left(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "AT_ONCE", 1)
    splats = gaussians([[0.0, 0.0, 4.0 + k] for k in range(12)], 12 * [1e5], 12 * [0.6], 12 * [[1.0, 1.0, 1.0]])
    opacity = render_splats(splats, camera(), BLACK, CPU).opacity
    # The eleventh would leave too little.
    assert 0.4**10 > 1e-4 > 0.4**11
    torch.testing.assert_close(opacity, torch.full_like(opacity, 1 - 0.4**10), atol=1e-6, rtol=0)


def test_the_colour_changes_with_the_direction_in_the_world_as_the_harmonics_say():
    """Kerbl's basis of degree 1: -C1 y, C1 z, -C1 x."""
    harmonics = torch.zeros(1, 3, 4)
    harmonics[0, 0, 3], harmonics[0, 1, 2], harmonics[0, 2, 1] = 0.5, 0.25, -0.75
    for turned in (0.0, 0.7, -1.2):
        own = camera(turned)
        own.principal_px[0] = torch.tensor([24.5, 18.5])
        towards = own.forward_world[0] + 0.2 * own.T_world_camera[0, :, 1]  # up in the picture is -y
        own.principal_px[0, 1] -= 0.2 * 48
        splats = Splats(5 * towards[None], 0.2 * torch.eye(3)[None], torch.tensor([0.999]), harmonics)
        view = render_splats(splats, own, BLACK, CPU)
        x, y, z = (towards / towards.norm()).tolist()
        expected = torch.tensor([0.5 - C1 * 0.5 * x, 0.5 + C1 * 0.25 * z, 0.5 + C1 * 0.75 * y])
        found = view.colour[18, 24] / view.opacity[18, 24]
        torch.testing.assert_close(found, expected, atol=2e-4, rtol=0)


@pytest.mark.thorough
@pytest.mark.parametrize("at_once", [1, 7, 2048])
def test_many_gaussians_look_as_pixel_by_pixel(at_once: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "AT_ONCE", at_once)
    generator = torch.Generator().manual_seed(0)
    count = 60
    mean = torch.rand(count, 3, generator=generator) * torch.tensor([4.0, 3.0, 3.0]) + torch.tensor([-2.0, -1.5, 4.0])
    axes = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator))[0]
    axes = axes * (0.02 + 0.4 * torch.rand(count, 1, 3, generator=generator))
    opacity = 0.1 + 0.9 * torch.rand(count, generator=generator)
    splats = Splats(mean, axes, opacity, torch.randn(count, 3, 1, generator=generator))
    own = camera(0.1)
    background = (0.6, 0.0, 0.4)
    found = render_splats(splats, own, background, CPU).colour
    torch.testing.assert_close(found, brute_force(splats, own, background), atol=2e-5, rtol=0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_file_is_read_as_it_was_meant(degree: int, tmp_path: Path):
    harmonics = np.arange(2 * 3 * (degree + 1) ** 2, dtype=np.float32).reshape(2, 3, -1) / 100
    half = math.sqrt(0.5)
    write_gaussians(
        tmp_path / "s.ply",
        mean=[[1, 2, 3], [4, 5, 6]],
        scale=[[1, 2, 3], [0.5, 0.5, 0.5]],
        rotation=[[3 * half, 0, 0, 3 * half], [1, 0, 0, 0]],
        opacity=[0.9, 0.1],
        harmonics=harmonics,
    )
    found = read_splats(tmp_path / "s.ply")
    torch.testing.assert_close(found.mean_world, torch.tensor([[1.0, 2, 3], [4, 5, 6]]))
    quarter_turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    torch.testing.assert_close(found.axes_world[0], quarter_turn * torch.tensor([1.0, 2, 3]), atol=1e-6, rtol=0)
    torch.testing.assert_close(found.opacity, torch.tensor([0.9, 0.1]))
    torch.testing.assert_close(found.harmonics, torch.from_numpy(harmonics))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"mean": [[math.nan, 0, 0]]}, "x or its like is not finite"),
        ({"mean": [[1e16, 0, 0]]}, "x or its like is not finite, or above"),
        ({"scale": [[1e17, 1, 1]]}, "without a size"),
        ({"rotation": [[0, 0, 0, 0]]}, "without a size or a rotation"),
        ({"harmonics": np.zeros((1, 3, 5))}, "12 columns f_rest_"),
        ({key: np.zeros((0, *shape)) for key, shape in (("mean", (3,)), ("scale", (3,)))}, "no Gaussian"),
    ],
)
def test_a_file_that_cannot_be_right_is_named(changed: dict, message: str, tmp_path: Path):
    good = {"mean": [[0, 0, 5]], "scale": [[1, 1, 1]], "rotation": [[1, 0, 0, 0]], "opacity": [0.5]}
    good["harmonics"] = np.zeros((1, 3, 1))
    count = len(changed.get("mean", [0]))
    write_gaussians(tmp_path / "s.ply", **{key: np.array(value)[:count] for key, value in {**good, **changed}.items()})
    with pytest.raises(SceneError, match=rf"s\.ply is damaged .*{message}"):
        read_splats(tmp_path / "s.ply")


@pytest.mark.parametrize("content", [b"", b"garbage", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n"])
def test_a_file_of_something_else_is_named(content: bytes, tmp_path: Path):
    (tmp_path / "s.ply").write_bytes(content)
    with pytest.raises(SceneError, match=r"s\.ply is damaged .*train again"):
        read_splats(tmp_path / "s.ply")


def test_enormous_and_tiny_gaussians_give_finite_pictures():
    splats = gaussians(
        [[0.0, 0.0, 5.0], [1e6, 0.0, 0.1], [0.0, 0.0, 4.0]], [1e14, 1e3, 1e-12], [0.5, 0.9, 0.9], [[0.2, 0.4, 0.6]] * 3
    )
    view = render_splats(splats, camera(), BLACK, CPU)
    assert view.colour.isfinite().all()
    assert view.depth.isfinite().all()
    assert view.opacity[0, 0] == pytest.approx(0.5, abs=1e-4)


def test_long_and_thin_gaussians_are_thin_in_the_picture():
    """Lines through the middle, as long as they may be, are as wide as the dilation makes them."""
    for turned in torch.arange(0.1, 1.5, 0.1):
        c, s = math.cos(turned), math.sin(turned)
        axes = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) * torch.tensor([4e14, 1e-3, 1e-3])
        splats = Splats(torch.tensor([[0.0, 0, 5]]), axes[None], torch.tensor([0.9]), torch.zeros(1, 3, 1))
        own = camera()
        view = render_splats(splats, own, BLACK, CPU)
        off = (pixel_grid(own.width, own.height) - own.principal_px) @ torch.tensor([-s, c])
        expected = 0.9 * torch.exp(-0.5 * off**2 / (0.3 + (48 * 1e-3 / 5) ** 2))
        expected = torch.where(expected < 1 / 255, 0.0, expected).reshape(own.height, own.width)
        torch.testing.assert_close(view.opacity, expected, atol=5e-3, rtol=0)
