"""Neighbouring views: which pixels they show of a sample, and that they may come in any order, come and go."""

from dataclasses import replace

import pytest
import textured_wall as wall
import torch
from networks import NETWORKS, SMALL_PAPER, looking, network, outputs, scene
from torch import nn

from tidefield.config import SWIFT, NetworkConfig
from tidefield.model.views import Views

MIDDLE = torch.full((2, 1, 2), 0.5)


@pytest.mark.parametrize("name", ["swift", "paper"])
def test_the_order_of_the_views_does_not_matter(name: str):
    own = network(NETWORKS[name], stir=0.05).eval()
    with torch.inference_mode():
        tiles, views, start = looking(own, scene())
        assert views is not None
        count = own.config.views
        order = torch.randperm(count, generator=torch.Generator().manual_seed(1))
        rows = (torch.arange(2)[:, None] * count + order).reshape(-1)
        shuffled = Views(views.cameras[rows], views.which[:, order], views.blend_weight[:, order], views.encoded)
        before, after = own(tiles, views, start, True), own(tiles, shuffled, start, True)
    for one, other in zip(outputs(before), outputs(after), strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-3)


def swift_with(samples: tuple[int, int]) -> NetworkConfig:
    config = NETWORKS["swift"]
    passes = (replace(one, samples=count) for one, count in zip(config.passes, samples, strict=True))
    return replace(config, passes=tuple(passes))


@pytest.mark.parametrize(("samples", "bound"), [((12, 6), 0.1), ((8, 4), 0.2)])
def test_a_view_that_is_hardly_there_may_be_any_other(samples: tuple[int, int], bound: float):
    """Neighbours change from tile to tile and from frame to frame: where they do, nothing may jump. Fewer samples place
    the surface less finely."""
    own = network(swift_with(samples), stir=0.05).eval()
    with torch.inference_mode():
        tiles, views, start = looking(own, scene())
        assert views is not None
        blend_weight = views.blend_weight.clone()
        blend_weight[:, 0] = 0
        rows, which = torch.arange(len(views.cameras)).reshape(views.which.shape), views.which.clone()
        rows[:, 0], which[:, 0] = rows[:, 3], which[:, 3]
        another = Views(views.cameras[rows.reshape(-1)], which, blend_weight, views.encoded)
        one, other = (own(tiles, v, start, True).colour for v in (replace(views, blend_weight=blend_weight), another))
        there, not_there = (
            own(tiles, replace(v, blend_weight=views.blend_weight), start, True).colour for v in (views, another)
        )
    assert (one - other).abs().mean() < 0.01 * (there - not_there).abs().mean()
    assert (one - other).abs().max() < bound * (there - not_there).abs().max()


@pytest.mark.parametrize(("samples", "bound"), [((12, 6), 0.2), ((8, 4), 0.3)])
def test_views_fade_within_a_tile(samples: tuple[int, int], bound: float):
    own = network(swift_with(samples), stir=0.05).eval()
    with torch.inference_mode():
        tiles, views, start = looking(own, scene())
        assert views is not None
        here, gone, fading = (views.blend_weight.clone() for _ in range(3))
        gone[:, 0] = 0
        fading[:, 0] = torch.tensor([1.0, 0.0, 1.0, 0.0])
        full, none, between = (
            own(tiles, replace(views, blend_weight=p), start, True).colour for p in (here, gone, fading)
        )
    middles = (torch.arange(16) + 0.5) / 16
    corner = replace(views, blend_weight=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(2, 5, 4))
    rays = torch.stack([middles, middles**2], -1).expand(2, -1, -1)
    shown = corner._blend_weight(rays, 32, torch.full((2, 5, 32), 0.5))
    torch.testing.assert_close(shown[1, 2], (0.5 * (1 - middles) * (1 - middles**2)).repeat_interleave(2))
    full, none, between = (x.reshape(2, 16, 16, 3) for x in (full, none, between))
    left, right = ((full - between).abs().mean((0, 1, 3)), (none - between).abs().mean((0, 1, 3)))
    assert left[0] < 0.2 * left[-1]
    assert right[-1] < bound * right[0]


def test_views_read_each_sample_where_it_projects():
    own, at = network(SWIFT.network).eval(), scene()
    with torch.inference_mode():
        tiles, views, _ = looking(own, at)
        assert views is not None
        xy = torch.tensor([[0.1, -0.2], [0.7, 0.3], [-2.4, 0.0], [0.0, 40.0]])
        points = torch.cat([xy, torch.full((4, 1), wall.DEPTH)], -1)
        points = torch.cat([points, torch.tensor([[0.0, 0.0, -wall.DEPTH]])]).expand(2, 5, 3)
        towards = nn.functional.normalize(points - tiles.cameras.position_world[:, None], dim=-1)
        gathered = views.read(1, points, towards, MIDDLE, torch.ones(points.shape[:2]))
    for n, index in enumerate([2, 4, 1, 5, 0]):
        camera = at.cameras[index]
        uv, z = camera.project(points[0])
        inside = (z > 0) & (uv >= 0).all(-1) & (uv <= camera.size_px[0]).all(-1)
        assert torch.equal(gathered.valid[0, n], inside[0])
        offset = nn.functional.normalize(points[0] - camera.position_world, dim=-1)
        torch.testing.assert_close(gathered.directions[0, n], offset)
        torch.testing.assert_close(gathered.cosine[0, n], (offset * towards[0]).sum(-1))
        seen = inside[0]
        # Half a level of rounding, and what a cubic reading loses of a texture with waves a few pixels long.
        assert (gathered.colours[0, n] - wall.texture(points[0, :, :2]))[seen].abs().max() < 0.05
    assert gathered.valid[0, :, :2].all()
    assert not gathered.valid[0, :, 3:].any()


def test_what_lies_behind_a_view_is_not_seen_by_it_wherever_its_pixels_would_be():
    own, at = network(SWIFT.network).eval(), scene()
    spread = torch.rand(2, 500, 3, generator=torch.Generator().manual_seed(0))
    behind = spread * torch.tensor([8.0, 8.0, -6.0]) - torch.tensor([4.0, 4.0, 0.1])
    with torch.inference_mode():
        _, views, _ = looking(own, at)
        assert views is not None
        gathered = [
            views.read(s, behind, nn.functional.normalize(behind, dim=-1), MIDDLE, torch.ones(2, 500)) for s in (1, 4)
        ]
    for each in gathered:
        assert not each.valid.any()
        assert each.features.isfinite().all()


def test_colours_come_from_the_photographs_at_full_resolution_whatever_the_features_stride():
    own, at = network(SMALL_PAPER), scene()
    photograph = at.photographs[0].permute(2, 0, 1)[None] / 255
    encoded = own.encode(photograph)
    assert set(encoded.features) == {4}
    torch.testing.assert_close(encoded.photographs.rows, photograph[0].flatten(1).T)
    tiles, views, _ = looking(own, at)
    assert views is not None
    points = torch.tensor([[0.1, -0.2, wall.DEPTH], [0.7, 0.3, wall.DEPTH]]).expand(2, 2, 3)
    towards = nn.functional.normalize(points - tiles.cameras.position_world[:, None], dim=-1)
    colours = views.read(4, points, towards, MIDDLE, torch.ones(points.shape[:2])).colours
    assert (colours - wall.texture(points[:, None, :, :2])).abs().max() < 0.08


def test_a_view_of_half_the_size_is_an_octave_coarser():
    own, at = network(SWIFT.network).eval(), scene()
    with torch.inference_mode():
        tiles, views, _ = looking(own, at)
        points = torch.tensor([[0.1, -0.2, wall.DEPTH], [0.7, 0.3, wall.DEPTH]]).expand(2, 2, 3)
        towards = nn.functional.normalize(points - tiles.cameras.position_world[:, None], dim=-1)
        scale = tiles.pixels_per_unit(torch.full((2, 1, 2), 1 / wall.DEPTH))
        same = views.read(1, points, towards, MIDDLE, scale).octaves_coarser
        larger = views.read(1, points, towards, MIDDLE, 2 * scale).octaves_coarser
        far_larger = views.read(1, points, towards, MIDDLE, 100 * scale).octaves_coarser
    torch.testing.assert_close(same, torch.zeros_like(same), atol=1e-5, rtol=0)
    torch.testing.assert_close(larger, torch.ones_like(same))
    torch.testing.assert_close(far_larger, torch.full_like(same, 2.0))
