"""Both ways of reading pictures at pixels: photographs for the baselines, feature maps for the network."""

from dataclasses import replace
from itertools import pairwise

import pytest
import textured_wall as wall
import torch
from torch import Tensor
from torch.nn import functional as F

from tidefield.baselines.untrained import read_photograph
from tidefield.model.rendering import Rendering, fill_unseen, render_with_rays
from tidefield.model.views import (
    concatenate,
    gather,
    maps_from_images,
    pixel_means,
    upsample_twice,
    weighted_rows,
)


def test_reading_at_pixel_centres_gives_the_pixels_at_the_common_exposure():
    scene = wall.scene(wall.with_gains(wall.cameras(2)))
    uv = torch.tensor([[0.5, 0.5], [47.5, 35.5], [10.5, 20.5]])
    pixels = scene.photographs[0][[0, 35, 20], [0, 47, 10]].float() / 255
    torch.testing.assert_close(read_photograph(scene, 0, uv), pixels / scene.cameras.gain[0])


def test_reading_between_pixels_is_cubic_and_stops_at_the_border():
    scene = wall.scene(wall.cameras(2))
    image = scene.photographs[0].float() / 255
    between = read_photograph(scene, 0, torch.tensor([[6.0, 7.5]]))[0]
    torch.testing.assert_close(between, (9 * (image[7, 5] + image[7, 6]) - image[7, 4] - image[7, 7]) / 16)
    quarter = read_photograph(scene, 0, torch.tensor([[5.75, 7.5]]))[0]
    torch.testing.assert_close(quarter, (between + image[7, 5]) / 2)
    torch.testing.assert_close(read_photograph(scene, 0, torch.tensor([[0.1, 0.1]]))[0], image[0, 0])


def test_filling_keeps_what_was_seen_and_continues_it():
    colour = torch.rand(9, 13, 3, generator=torch.Generator().manual_seed(0))
    seen = torch.ones(9, 13, dtype=torch.bool)
    assert torch.equal(fill_unseen(colour, seen), colour)
    seen[:, 4:] = False
    colour[:, :4] = 0.25
    filled = fill_unseen(colour, seen)
    torch.testing.assert_close(filled, torch.full_like(filled, 0.25))


def test_nothing_seen_is_grey():
    filled = fill_unseen(torch.rand(4, 5, 3), torch.zeros(4, 5, dtype=torch.bool))
    assert (filled == 0.5).all()


def images(count: int = 3, height: int = 7, width: int = 9, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, 4, height, width, generator=generator, dtype=torch.float64)


def corners(count: int = 3) -> Tensor:
    return torch.tensor([[0.0, 0.0], [12.0, 5.0], [3.0, 8.0], [1.0, 0.0]])[:count]


def spots(images: Tensor, corner: Tensor, stride: int, count: int = 200, seed: int = 1) -> Tensor:
    """Pixels on and around each map, K P 2."""
    extent = torch.tensor(images.shape[:1:-1]) * stride
    drawn = torch.rand(len(images), count, 2, generator=torch.Generator().manual_seed(seed))
    return corner[:, None] + (drawn * 1.4 - 0.2) * extent


def naive(image: Tensor, corner: Tensor, stride: int, uv: Tensor) -> Tensor:
    """`grid_sample` on one map whose first texel is centred at the corner's first pixel, P C."""
    size = torch.tensor(image.shape[:0:-1])
    place = (uv - corner - 0.5) / stride
    grid = ((place + 0.5) / size * 2 - 1).to(image)
    return F.grid_sample(image[None], grid[None, None], padding_mode="border", align_corners=False)[0, :, 0].T


@pytest.mark.parametrize("stride", [1, 2, 4])
@pytest.mark.parametrize("size", [(7, 9), (1, 9), (7, 1), (1, 1)])
def test_feature_maps_are_read_as_grid_sample_reads_them(stride: int, size: tuple[int, int]):
    pictures, corner = images(3, *size), corners()
    uv = spots(pictures, corner, stride)
    values, inside = gather(maps_from_images(pictures, corner, stride), torch.tensor([[0, 1, 2]]), uv[None])
    extent = torch.tensor(size[::-1]) * stride
    first = corner + 0.5 - stride / 2
    expected_inside = ((uv >= first[:, None]) & (uv <= (first + extent)[:, None])).all(-1)
    assert torch.equal(inside[0], expected_inside)
    assert inside.any()
    assert not inside.all()
    for k in range(3):
        expected = naive(pictures[k], corner[k], stride, uv[k])
        torch.testing.assert_close(values[0, k][inside[0, k]], expected[inside[0, k]], atol=1e-5, rtol=1e-5)


def test_at_stride_one_pixel_centres_give_the_pixels():
    pictures = images(1)
    uv = torch.tensor([[0.5, 0.5], [8.5, 6.5], [3.5, 2.5]])
    values, inside = gather(maps_from_images(pictures, corners(1), 1), torch.tensor([[0]]), uv[None, None])
    assert inside.all()
    torch.testing.assert_close(values[0, 0], pictures[0][:, [0, 6, 2], [0, 8, 3]].T)


@pytest.mark.parametrize("kind", [torch.float16, torch.float32])
def test_padding_of_rows_is_not_read(kind: torch.dtype):
    maps = maps_from_images(images()[:, :3].to(kind), corners(), 1)
    padding = maps.rows.new_full((len(maps.rows), 1), torch.nan)
    padded = replace(maps, rows=torch.cat([maps.rows, padding], dim=1))
    uv = spots(images(), corners(), 1).float()
    (values, inside), (plain, plainly_inside) = (gather(m, torch.tensor([[0, 1, 2]]), uv[None]) for m in (padded, maps))
    assert torch.equal(inside, plainly_inside)
    torch.testing.assert_close(values[inside], plain[inside], atol=2e-3 if kind == torch.float16 else 1e-6, rtol=0)


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_maps_of_several_sizes_are_read_as_one_set(stride: int):
    groups = [images(2, 7, 9, seed=1), images(1, 4, 3, seed=2), images(1, 1, 5, seed=3)]
    corner = corners(4)
    parts = [maps_from_images(g, c, stride) for g, c in zip(groups, corner.split([2, 1, 1]), strict=True)]
    maps = concatenate(parts)
    every = [image for g in groups for image in g]
    which = torch.tensor([[3, 0], [1, 2], [2, 2]])
    uv = torch.stack([spots(every[k][None], corner[k][None], stride)[0] for k in which.reshape(-1)])
    values, inside = gather(maps, which, uv.unflatten(0, which.shape))
    for t, n in [(t, n) for t in range(3) for n in range(2)]:
        k = int(which[t, n])
        expected = naive(every[k], corner[k], stride, uv[2 * t + n])
        seen = inside[t, n]
        assert seen.any()
        torch.testing.assert_close(values[t, n][seen], expected[seen], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("size", [(7, 9), (1, 9), (7, 1)])
def test_gradients_of_reading_are_those_of_grid_sample(size: tuple[int, int]):
    ours, theirs = images(2, *size).requires_grad_(), images(2, *size).requires_grad_()
    corner, stride = corners(2), 2
    uv = spots(ours, corner, stride)
    weight = torch.randn(2, 200, 4, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    values, inside = gather(maps_from_images(ours, corner, stride), torch.tensor([[0, 1]]), uv[None])
    weight = weight * inside[0, ..., None]
    (values[0] * weight).sum().backward()
    sum((naive(theirs[k], corner[k], stride, uv[k]) * weight[k]).sum() for k in range(2)).backward()  # type: ignore[union-attr]
    assert ours.grad is not None
    assert theirs.grad is not None
    torch.testing.assert_close(ours.grad, theirs.grad, atol=1e-4, rtol=1e-4)


def test_reading_is_continuous_from_texel_to_texel():
    pictures = images(1)
    line = torch.stack([torch.linspace(0, 9, 3001), torch.full((3001,), 3.3)], -1)
    values, inside = gather(maps_from_images(pictures, corners(1), 1), torch.tensor([[0]]), line[None, None])
    assert inside.all()
    assert max((b - a).abs().max() for a, b in pairwise(values[0, 0])) < 0.02


def test_meaningless_pixels_are_off_the_map_and_give_finite_values():
    uv = torch.tensor([[torch.nan, 3.0], [torch.inf, 3.0], [-torch.inf, -torch.inf], [1e30, -1e30], [-1e9, 2.0]])
    values, inside = gather(maps_from_images(images(1), corners(1), 2), torch.tensor([[0]]), uv[None, None])
    assert not inside.any()
    assert values.isfinite().all()


def test_beyond_a_coarse_map_its_border_is_read():
    image = images(1)
    maps = maps_from_images(image, torch.zeros(1, 2), 4)
    # 36 x 28 pixels; the map of 9 x 7 texels ends half a texel beyond the last one's centre, at 34.5 and 26.5.
    beyond = torch.tensor([[[[35.5, 12.5], [16.5, 27.9], [35.9, 27.9], [1e30, -1e30]]]], dtype=torch.float64)
    values, inside = gather(maps, torch.zeros(1, 1, dtype=torch.long), beyond)
    assert not inside.any()
    expected = torch.stack([image[0, :, 3, 8], image[0, :, 6, 4], image[0, :, 6, 8], image[0, :, 0, 8]])
    torch.testing.assert_close(values[0, 0], expected)


def test_weighted_rows_are_sums_with_the_right_gradient():
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    index = torch.tensor([[0, 5, 5], [2, 1, 0]])
    share = torch.rand(2, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(weighted_rows(rows, index, share), (rows[index] * share[..., None]).sum(1))
    assert torch.autograd.gradcheck(lambda r: weighted_rows(r, index, share), rows.requires_grad_())


def test_doubling_keeps_the_pixels_and_is_exact_on_quadratics_between_them():
    """Keys' kernel with a = -1/2 reproduces polynomials of second degree; at the border texels are repeated."""
    v, u = torch.meshgrid(torch.arange(12.0).double() + 0.5, torch.arange(14.0).double() + 0.5, indexing="ij")

    def picture(u: Tensor, v: Tensor) -> Tensor:
        return torch.stack([0.3 * u * u - u * v, 2 * v * v - u + 1, u * v])

    twice = upsample_twice(picture(u, v)[None])
    assert twice.shape == (1, 3, 24, 28)
    torch.testing.assert_close(twice[0, :, ::2, ::2], picture(u, v))
    y, x = torch.meshgrid(0.5 + torch.arange(24.0).double() / 2, 0.5 + torch.arange(28.0).double() / 2, indexing="ij")
    torch.testing.assert_close(twice[0, :, 2:-4, 2:-4], picture(x, y)[:, 2:-4, 2:-4])


def test_means_over_pixels_lie_where_interpolated_pixels_lie():
    picture = torch.rand(1, 3, 12, 16, generator=torch.Generator().manual_seed(0))
    means = pixel_means(picture)
    assert means.shape == picture.shape
    torch.testing.assert_close(means[..., ::2, ::2], F.avg_pool2d(picture, 2))
    # Of a plane, the mean over a pixel is the value in its middle.
    v, u = torch.meshgrid(0.25 + torch.arange(12.0) / 2, 0.25 + torch.arange(16.0) / 2, indexing="ij")
    plane = (0.3 * u - 0.2 * v)[None, None]
    expected = upsample_twice(F.avg_pool2d(plane, 2))
    torch.testing.assert_close(pixel_means(plane)[..., 2:-4, 2:-4], expected[..., 2:-4, 2:-4])


@pytest.mark.parametrize("at", [(6.0, 7.5), (0.2, 0.5), (47.9, 35.8), (17.25, 20.25)])
def test_a_photograph_at_twice_the_size_is_read_as_the_network_reads_it(at: tuple[float, float]):
    scene = wall.scene(wall.with_gains(wall.cameras(2)))
    large = wall.scene(wall.with_gains(wall.cameras(2, 96, 72)))
    found = read_photograph(scene, 1, torch.tensor([at]), large)[0]
    means = pixel_means(large.photographs[1].permute(2, 0, 1)[None] / 255)
    maps = maps_from_images(means, torch.zeros(1, 2), 0.5)
    expected, _ = gather(maps, torch.tensor([[0]]), torch.tensor(at)[None, None, None])
    torch.testing.assert_close(found, expected[0, 0, 0] / scene.cameras.gain[1])


def test_a_doubled_picture_is_read_at_its_pixels_and_up_to_its_border():
    picture = torch.rand(1, 3, 6, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    maps = maps_from_images(upsample_twice(picture), torch.tensor([[10.0, 20.0]]), 0.5)
    corner = torch.tensor([10.0, 20.0]).double()
    uv = corner + torch.tensor([[0.5, 0.5], [7.5, 5.5], [3.5, 2.5], [0, 0], [8, 6]]).double()
    values, inside = gather(maps, torch.tensor([[0]]), uv[None, None])
    assert inside.all()
    x, y = torch.tensor([0, 7, 3, 0]), torch.tensor([0, 5, 2, 0])
    torch.testing.assert_close(values[0, 0, :4], picture[0, :, y, x].T)
    outside = corner + torch.tensor([[-0.1, 3], [8.1, 3], [4, -0.1], [4, 6.1]]).double()
    assert not gather(maps, torch.tensor([[0]]), outside[None, None])[1].any()


@pytest.mark.parametrize("width", [64, 65, 100])
def test_a_ramp_is_continued_at_its_place_whatever_the_size(width: int):
    ramp = torch.linspace(0, 1, width)[None, :, None].expand(width, width, 3)
    seen = torch.ones(width, width, dtype=torch.bool)
    seen[:, width // 2 - 6 : width // 2 + 6] = False
    assert (fill_unseen(ramp, seen) - ramp).abs().max() < 0.12


def test_the_depth_of_several_rays_is_that_of_those_that_meet_something():
    view = Rendering(torch.zeros(2, 2, 3), torch.tensor([[4.0, 50.0], [4.0, 50.0]]), torch.tensor([[1.0, 0], [1, 0]]))
    camera = wall.cameras(1, 1, 1)[0]
    pixel = render_with_rays(lambda camera: view, camera, 2)
    assert (pixel.depth.item(), pixel.opacity.item()) == pytest.approx((4.0, 0.5))
    nothing = replace(view, opacity=torch.zeros(2, 2))
    assert render_with_rays(lambda camera: nothing, camera, 2).depth.isfinite().all()
