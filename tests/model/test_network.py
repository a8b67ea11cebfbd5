"""The boxes together: a textured wall that untrained and randomly weighted networks look at."""

from dataclasses import replace

import pytest
import textured_wall as wall
import torch
from networks import CPU, NETWORKS, SMALL_PAPER, TARGET, looking, network, outputs, scene
from torch import Tensor, nn

from tidefield.config import PAPER, PARTS, SWIFT, Config, Part, Sampling, vary
from tidefield.data.neighbours import Neighbours
from tidefield.data.pyramid import Pyramid
from tidefield.data.scene import Scene
from tidefield.data.surface import in_frame
from tidefield.methods import make_trainer
from tidefield.model.cache import FeatureCache
from tidefield.model.network import Network, TileRendering
from tidefield.model.renderer import Renderer, in_turn
from tidefield.model.sampling import Intervals, Tiles, place_samples
from tidefield.parallel import interruptible
from tidefield.train import loop

PASSES = {"swift": "passes", "paper": "aggregate"}


def finite_forward_and_backward(own: Network, result: TileRendering) -> set[str]:
    """The boxes that learn from a rendering, all of whose values and gradients must be finite."""
    assert all(part.isfinite().all() for part in outputs(result))
    sum(part.square().mean() for part in outputs(result)).backward()  # type: ignore[union-attr]
    for name, parameter in own.named_parameters():
        assert parameter.grad is None or parameter.grad.isfinite().all(), name
    return {n.split(".")[0] for n, p in own.named_parameters() if p.grad is not None and p.grad.abs().max() > 0}


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("opaque", [True, False])
def test_every_kind_of_network_is_finite_forward_and_backward(name: str, opaque: bool):
    own = network(NETWORKS[name], stir=0.02)
    tiles, views, start = looking(own, scene())
    result = own(tiles, views, start, opaque, jitter=own.draw_jitter(2, 16, torch.Generator().manual_seed(0)))
    assert result.colour.shape == (2, 256, 3)
    assert result.depth.shape == result.opacity.shape == (2, 256)
    assert len(result.inverse_depths) == len(result.coarse_colours) + 1 == len(own.grids)
    assert (result.opacity <= 1 + 1e-5).all()
    assert ((result.depth > 3 - 1e-3) & (result.depth < 10 + 1e-2)).all()
    assert finite_forward_and_backward(own, result) >= {"encoder", "colour", PASSES[name]}


@pytest.mark.parametrize("name", NETWORKS)
def test_rays_that_no_view_sees_are_finite_and_empty(name: str):
    own, at = network(NETWORKS[name], stir=0.02), scene()
    pose = at.cameras.T_world_camera.clone()
    pose[TARGET, 0, 3] += 100
    at = replace(at, cameras=replace(at.cameras, T_world_camera=pose), points=None)
    tiles, views, start = looking(own, at)
    result = own(tiles, views, start, True)
    finite_forward_and_backward(own, result)
    assert not result.opacity.any()
    assert not result.colour.any()


@pytest.mark.parametrize("name", ["swift", "paper"])
def test_where_views_see_an_opaque_scene_all_light_is_stopped(name: str):
    own = network(NETWORKS[name], stir=0.02)
    result = own(*looking(own, scene()), True)
    torch.testing.assert_close(result.opacity, torch.ones(2, 256), atol=1e-4, rtol=0)


DRAWN = [part for part in PARTS["swift"] if SWIFT.network.has(part) and part != "doubled photographs"]


@pytest.mark.thorough
@pytest.mark.parametrize("part", DRAWN)
def test_without_a_part_the_network_is_finite_and_renders_something_else(part: Part):
    without = replace(SWIFT, network=replace(SWIFT.network, without=(*SWIFT.network.without, part)))
    own, whole, at = network(without.network, stir=0.02), network(SWIFT.network, stir=0.02), scene(width=96, height=72)
    # Of the parts that are learned, the rest keeps its random numbers.
    own.load_state_dict(whole.state_dict(), strict=False)
    result = own(*looking(own, at), True)
    assert finite_forward_and_backward(own, result) >= {"encoder", "colour", "passes"}
    with torch.inference_mode():
        camera = at.cameras[TARGET]
        one, other = (
            Renderer(each.eval(), at, config, CPU)(camera).colour for each, config in ((own, without), (whole, SWIFT))
        )
    assert (one - other).abs().max() > 1e-4


def test_without_doubled_photographs_none_is_read(monkeypatch: pytest.MonkeyPatch):
    def read(*_: object) -> None:
        raise AssertionError("photographs were read at twice the size")

    monkeypatch.setattr(Pyramid, "read_doubled", read)
    monkeypatch.setattr(loop, "at_twice_the_size", read)
    at, without = scene(), vary(SWIFT, "no-doubled-photographs")
    assert isinstance(without, Config)
    Renderer(network(without.network).eval(), at, without, CPU)(at.cameras[TARGET])
    make_trainer(without, at, 0, CPU).prepare()
    with pytest.raises(AssertionError, match="at twice the size"):
        Renderer(network(SWIFT.network).eval(), at, SWIFT, CPU)(at.cameras[TARGET])
    with pytest.raises(AssertionError, match="at twice the size"):
        make_trainer(SWIFT, at, 0, CPU).prepare()


def test_without_sparse_points_nothing_comes_from_them():
    at, config = scene(width=96, height=72), vary(SWIFT, "no-sparse-points")
    assert isinstance(config, Config)
    trainers = [make_trainer(config, each, 0, CPU) for each in (at, replace(at, points=None))]
    first, second = (trainer.renderer()(at.cameras[TARGET]) for trainer in trainers)
    torch.testing.assert_close(first.colour, second.colour, atol=0, rtol=0)
    torch.testing.assert_close(first.depth, second.depth, atol=0, rtol=0)


def test_a_scene_a_thousand_times_as_large_has_the_same_colours():
    own, at = network(SWIFT.network, stir=0.02).eval(), scene()
    pose = at.cameras.T_world_camera.clone()
    pose[:, :, 3] *= 1000
    assert at.points is not None
    larger = replace(
        at,
        cameras=replace(at.cameras, T_world_camera=pose, near_far=at.cameras.near_far * 1000),
        points=replace(at.points, xyz_world=at.points.xyz_world * 1000),
    )
    with torch.inference_mode():
        one, other = own(*looking(own, at), True), own(*looking(own, larger), True)
    torch.testing.assert_close(one.colour, other.colour, atol=2e-3, rtol=0)
    torch.testing.assert_close(one.depth * 1000, other.depth, atol=0, rtol=2e-3)


def depth_errors(config: Config, at: Scene) -> Tensor:
    """Relative depth errors of a view by an untrained network, where the neighbours see the wall well."""
    own = network(config.network).eval()
    rendering = Renderer(own, at, config, CPU)(at.cameras[TARGET])
    truth = wall.true_depth(at.cameras[TARGET])
    return ((rendering.depth - truth).abs() / truth)[4:-4, 8:-8]


def test_untrained_views_that_agree_find_the_wall_without_any_sparse_points():
    error = depth_errors(SWIFT, replace(scene(width=96, height=72), points=None))
    assert error.median() < 0.004
    assert error.mean() < 0.01


def test_an_untrained_network_finds_the_wall_where_sparse_points_tell_of_it():
    error = depth_errors(SWIFT, scene())
    # A pixel of parallax is 7% of the depth here.
    assert error.median() < 0.01
    assert error.max() < 0.03


def test_an_untrained_network_renders_the_wall_from_its_neighbours():
    at = scene(width=96, height=72)
    rendering = Renderer(network(SWIFT.network).eval(), at, SWIFT, CPU)(at.cameras[TARGET])
    truth = at.photographs[TARGET].float() / 255
    error = (rendering.colour - truth)[4:-4, 8:-8].square().mean()
    assert -10 * error.log10() > 25


def test_what_one_view_alone_sees_is_not_smeared_over_the_depths_it_might_have():
    at = wall.scene(wall.cameras(7, 96, 72, step=0.5), (TARGET,))
    own = network(SWIFT.network).eval()
    with torch.inference_mode():
        tiles, _, start = looking(own, at, 16, ((40, 28),))
        wide = replace(start, inv_near=start.inv_expected * 1.2, inv_far=start.inv_expected / 1.2)
        alone = Neighbours(torch.tensor([[0]]), torch.ones(1, 1, 4))
        views = FeatureCache(own, at, CPU).views(at.cameras[TARGET], alone, torch.zeros(1, 3))
        found = own(tiles, views, wide, True).colour.reshape(16, 16, 3)
    truth = at.photographs[TARGET][28:44, 40:56] / 255
    assert -10 * (found - truth).square().mean().log10() > 42


def test_a_surface_that_no_view_sees_is_not_sought_where_they_see():
    at = scene()
    pose = at.cameras.T_world_camera.clone()
    pose[TARGET, 0, 3] += 3.0  # the others see nothing of the wall, but what may lie behind it
    at = replace(at, cameras=replace(at.cameras, T_world_camera=pose))
    own = network(SWIFT.network).eval()
    with torch.inference_mode():
        tiles, views, start = looking(own, at, 16, ((40, 16),))
        deep = replace(start, inv_near=start.inv_expected * 1.2, inv_far=start.inv_expected / 3)
        found = own(tiles, views, deep, True)
        farther = own(tiles, views, replace(deep, inv_expected=deep.inv_far * 1.2), True)
    assert found.visibility.max() < 0.1
    # Two pixels lie within a ray of the first pass of what they see.
    assert (found.depth - wall.DEPTH).reshape(16, 16)[:, 2:].abs().max() < 0.1
    assert farther.visibility.reshape(16, 16)[:, :6].min() > 0.9, "there they see"


def test_what_no_neighbour_sees_is_continued_from_beside_it():
    at = scene()
    pose = at.cameras.T_world_camera.clone()
    pose[TARGET, 0, 3] += 3.0  # the others are all to the left
    at = replace(at, cameras=replace(at.cameras, T_world_camera=pose))
    own = network(SWIFT.network).eval()
    view = Renderer(own, at, SWIFT, CPU)(at.cameras[TARGET])
    uv = torch.stack(torch.meshgrid(torch.arange(48) + 0.5, torch.arange(36) + 0.5, indexing="xy"), -1).reshape(
        1, -1, 2
    )
    camera = at.cameras[TARGET]
    points = camera.position_world + camera.directions_world(uv)[0] * wall.DEPTH
    others = at.cameras[[i for i in range(len(at.cameras)) if i != TARGET]]
    seen = in_frame(others, *others.project(points)).any(0).reshape(36, 48)
    assert 0.2 < seen.float().mean() < 0.8
    edge = int(seen[18].nonzero().max())
    nearby = view.colour[:, edge - 6 : edge - 1].mean((0, 1))
    assert (view.colour[:, edge + 3 :].mean((0, 1)) - nearby).abs().max() < 0.15
    assert (view.depth[:, edge + 3 :] - wall.DEPTH).abs().max() < 0.2
    assert not Renderer(network(PAPER.network).eval(), at, PAPER, CPU).fills_unseen


@pytest.mark.parametrize("name", ["swift"])
def test_tiles_do_not_show(name: str):
    """Four small tiles are the large tile that they cover: margins are rendered, not guessed."""
    own, at = network(NETWORKS[name], stir=0.02).eval(), scene()
    with torch.inference_mode():
        whole = own(*looking(own, at, 16, ((16, 8),)), True).colour.reshape(16, 16, 3)
        parts = own(*looking(own, at, 8, ((16, 8), (24, 8), (16, 16), (24, 16))), True).colour.reshape(4, 8, 8, 3)
    upper, lower = torch.cat([parts[0], parts[1]], 1), torch.cat([parts[2], parts[3]], 1)
    torch.testing.assert_close(torch.cat([upper, lower]), whole, atol=1e-4, rtol=0)


def test_without_jitter_rendering_repeats_and_with_it_it_varies_with_the_seed():
    own = network(SWIFT.network).eval()
    given = looking(own, scene())
    with torch.inference_mode():
        first, again = own(*given, True), own(*given, True)
        seeds = (torch.Generator().manual_seed(s) for s in (1, 2))
        one, other = (own(*given, True, jitter=own.draw_jitter(2, 16, seed)) for seed in seeds)
    assert torch.equal(first.colour, again.colour)
    assert not torch.equal(one.colour, other.colour)


@pytest.mark.thorough
@pytest.mark.parametrize("side", [1, 2])
def test_views_in_turn_are_those_of_each_camera(side: int):
    at = scene()
    own = Renderer(network(SWIFT.network).eval(), at, SWIFT, CPU, Sampling(rays_per_side=side))
    flight = at.cameras[[TARGET, 0, 3]]
    for render in (own, lambda camera: own(camera)):
        for k, view in enumerate(in_turn(render, flight)):
            alone = own(flight[k])
            assert torch.equal(view.colour, alone.colour)
            assert torch.equal(view.depth, alone.depth)


def test_rays_go_through_the_centres_of_a_tiles_squares():
    tiles = Tiles(scene().cameras[[0]], torch.tensor([[10.0, 20.0]]), 4)
    assert tiles.rays_px(1, 0)[0, :5].tolist() == [[10.5, 20.5], [11.5, 20.5], [12.5, 20.5], [13.5, 20.5], [10.5, 21.5]]
    assert tiles.rays_px(2, 0)[0].tolist() == [[11, 21], [13, 21], [11, 23], [13, 23]]
    margin = tiles.rays_px(4, 1)[0]
    assert margin.shape == (9, 2)
    assert margin[[0, 4, 8]].tolist() == [[8, 18], [12, 22], [16, 26]]


def test_samples_lie_on_their_pixels_rays_at_their_depths_and_their_lengths_add_up():
    camera = scene().cameras[[0]]
    uv = torch.tensor([[[3.5, 40.0], [60.0, 7.5]]])
    intervals = Intervals(torch.tensor([[1 / 3, 1 / 4]]), torch.tensor([[1 / 9, 1 / 5]]), torch.full((1, 2), torch.nan))
    s = torch.tensor([0.0, 0.3, 0.8]).expand(1, 2, 3)
    samples = place_samples(camera, uv, intervals, s)
    pixels, z = camera.project(samples.points_world[0])
    torch.testing.assert_close(pixels[0], uv[0].repeat_interleave(3, 0), atol=1e-3, rtol=0)
    torch.testing.assert_close(z[0], 1 / samples.inverse_depth.flatten())
    torch.testing.assert_close(samples.inverse_depth, intervals.inverse_depth(s))
    offset = samples.points_world[0] - camera.position_world
    torch.testing.assert_close(samples.directions[0], offset / offset.norm(dim=-1, keepdim=True))
    reach = offset.norm(dim=-1).reshape(2, 3)
    ratio = reach[:, 0] / torch.tensor([3.0, 4.0])
    torch.testing.assert_close(samples.delta[0, :, :2], reach.diff(dim=-1))
    torch.testing.assert_close(reach[:, 0] + samples.delta[0].sum(-1), torch.tensor([9.0, 5.0]) * ratio)


def test_a_crop_is_read_as_its_photograph_is():
    own, at = network(SWIFT.network).eval(), scene()
    photograph = at.photographs[0].permute(2, 0, 1)[None] / 255
    with torch.inference_mode():
        whole = own.encode(photograph).photographs
        crop = own.encode(photograph[:, :, 7:39, 12:60], torch.tensor([[12.0, 7.0]])).photographs
    assert (crop.origin_px == torch.tensor([12.5, 7.5])).all()
    assert whole.stride == crop.stride == 0.5
    texels = [m.rows.reshape(*m.size[0].flip(0).tolist(), 3) for m in (whole, crop)]
    torch.testing.assert_close(texels[1][8:-8, 8:-8], texels[0][14:78, 24:120][8:-8, 8:-8])
    torch.testing.assert_close(texels[0][::2, ::2], photograph[0].permute(1, 2, 0))


def test_the_learned_sharpening_keeps_even_areas():
    own = network(SWIFT.network, stir=0.3)
    for level, tolerance in ((0.0, 1e-5), (0.7, 1e-5)):
        encoded = own.encode(torch.full((1, 3, 24, 24), level))
        for rows in (encoded.photographs.rows, encoded.features[4].rows[:, :3]):
            torch.testing.assert_close(rows, torch.full_like(rows, level), atol=tolerance, rtol=0)


def test_photographs_at_twice_the_size_are_sharpened_as_photographs_are():
    own = network(SWIFT.network, stir=0.3)
    photograph = torch.rand(1, 3, 24, 20, generator=torch.Generator().manual_seed(0))
    doubled = photograph.repeat_interleave(2, 2).repeat_interleave(2, 3)
    plain, twice = own.encode(photograph), own.encode(photograph, doubled=doubled)
    pixels, means = (one.photographs.rows.reshape(48, 40, 3)[::2, ::2] for one in (plain, twice))
    torch.testing.assert_close(means, pixels)
    assert (pixels - photograph[0].permute(1, 2, 0)).abs().max() > 0.1
    assert torch.equal(plain.features[1].rows, twice.features[1].rows)


def test_the_papers_network_has_nothing_that_the_paper_does_not_have():
    ours = ("descriptors", "sharpen", "prior", "agreement", "metric", "angle")
    assert not [n for n, _ in network(SMALL_PAPER).named_parameters() if any(part in n for part in ours)]
    found = [n for n, _ in network(SWIFT.network).named_parameters()]
    assert all(any(part in n for n in found) for part in ours)


def test_only_swifts_maps_are_returned_to_where_they_were_computed():
    assert [step.aligned for step in network(SMALL_PAPER).encoder.up] == [False, False]
    assert all(step.aligned for step in network(SWIFT.network).encoder.up)


def test_densities_come_from_each_sample_alone_without_the_ray_transformer():
    own = network(replace(SMALL_PAPER, without=("ray transformer",)), stir=0.05)
    assert not [name for name, _ in own.named_parameters() if "transformer" in name]
    result = own(*looking(own, scene()), opaque=True)
    assert finite_forward_and_backward(own, result) >= {"encoder", "aggregate", "density", "colour"}


def test_a_view_is_rendered_at_the_gain_of_its_camera():
    at = scene()
    own = Renderer(network(SWIFT.network).eval(), at, SWIFT, CPU)
    camera = at.cameras[TARGET]
    darker = replace(camera, gain=camera.gain * torch.tensor([[0.5, 0.75, 1.0]]))
    torch.testing.assert_close(
        own(darker).colour, own(camera).colour * torch.tensor([0.5, 0.75, 1.0]), atol=1e-5, rtol=0
    )


def test_what_lies_behind_empty_space_is_rendered_at_the_gain_of_the_camera():
    at = scene()
    pose = at.cameras.T_world_camera.clone()
    pose[TARGET, 0, 3] += 100  # nothing is seen there
    at = replace(at, cameras=replace(at.cameras, T_world_camera=pose), points=None)
    config = replace(PAPER, network=SMALL_PAPER)
    own = Renderer(network(SMALL_PAPER).eval(), at, config, CPU)
    gain = torch.tensor([[0.5, 0.75, 1.0]])
    view, darker = own(at.cameras[TARGET]), own(replace(at.cameras[TARGET], gain=gain))
    assert not view.opacity.any()
    assert view.colour.min() > 0.2
    torch.testing.assert_close(darker.colour, view.colour * gain[0], atol=1e-5, rtol=0)


def test_behind_empty_space_a_scene_has_its_background_at_every_gain():
    at, background = scene(), (1.0, 0.5, 0.25)
    pose = at.cameras.T_world_camera.clone()
    pose[TARGET, 0, 3] += 100  # nothing is seen there
    config = replace(PAPER, network=SMALL_PAPER)
    away = replace(at, cameras=replace(at.cameras, T_world_camera=pose), points=None, background_rgb=background)
    darker = replace(away.cameras[TARGET], gain=torch.tensor([[0.5, 0.75, 1.0]]))
    view = Renderer(network(SMALL_PAPER).eval(), away, config, CPU)(darker)
    assert not view.opacity.any()
    torch.testing.assert_close(view.colour, torch.tensor(background).expand(48, 64, 3))


@pytest.mark.parametrize(("background", "opaque"), [(None, True), ((1.0, 1.0, 1.0), False)])
def test_only_a_scene_with_a_background_lets_light_through(background: tuple[float, ...] | None, opaque: bool):
    at = replace(scene(), background_rgb=background)
    view = Renderer(network(SWIFT.network).eval(), at, SWIFT, CPU)(at.cameras[TARGET])
    assert (view.opacity.min() > 1 - 1e-3) == opaque


def test_the_papers_density_is_per_mean_interval_of_the_ray():
    """An untrained head of a constant density: softplus(b) in every mean interval, whatever the lengths."""
    own, at = network(SMALL_PAPER), scene()
    nn.init.zeros_(own.density.weight)  # type: ignore[arg-type]
    nn.init.constant_(own.density.bias, -1.0)  # type: ignore[arg-type]
    tiles, views, start = looking(own, at)
    with torch.inference_mode():
        opacity = own(tiles, views, start, False).opacity
    # All samples are seen; from the first sample, half an interval behind the near end, to the far end.
    uv = tiles.rays_px(1)
    s = (torch.arange(12) + 0.5) / 12
    delta = place_samples(tiles.cameras, uv, start, s.expand(2, 256, -1)).delta
    thickness = torch.nn.functional.softplus(torch.tensor(-1.0)) * delta.sum(-1) / delta.mean(-1)
    torch.testing.assert_close(opacity, 1 - torch.exp(-thickness), atol=1e-4, rtol=0)


def test_coarse_colours_are_the_neighbours_mean_colours_under_the_coarse_weights():
    own, at = network(SWIFT.network).eval(), scene()
    with torch.inference_mode():
        result = own(*looking(own, at), True)
        tiles = looking(own, at)[0]
    truth = at.photographs[TARGET].float() / 255
    uv = tiles.rays_px(*own.grids[0])[0].long()
    inside = (uv >= 2).all(-1) & (uv < torch.tensor([62, 46])).all(-1)
    means = torch.stack([truth[v - 2 : v + 2, u - 2 : u + 2].mean((0, 1)) for u, v in uv[inside].tolist()])
    error = (result.coarse_colours[0][0][inside] - means).mean().abs()
    assert error < 0.02, "mean colours are not those of the wall"


def test_a_view_whose_pieces_are_made_one_by_one_ends_at_the_next_when_it_is_not_wanted_any_more():
    at = scene()
    renderer = Renderer(network(SMALL_PAPER).eval(), at, replace(PAPER, network=SMALL_PAPER), CPU)
    renderer.tiles_in_parallel, renderer.tiles_at_once = False, 1
    compute, computed = renderer._compute, []

    def compute_one(*given) -> Tensor:
        computed.append(1)
        return compute(*given)

    def check() -> None:
        if computed:
            raise TimeoutError

    renderer._compute = compute_one
    with interruptible(check), pytest.raises(TimeoutError):
        renderer(at.cameras[TARGET])
    assert len(computed) == 1
