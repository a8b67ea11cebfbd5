from dataclasses import replace
from functools import cache

import pytest
import textured_wall as wall
import torch
from torch import Tensor

from tidefield.config import PAPER, SWIFT, TrainConfig
from tidefield.data.batches import Batch, draw_batch
from tidefield.data.depth_prior import DepthPriors, unproject_to_surface
from tidefield.data.exposure import to_common_exposure
from tidefield.data.neighbours import EXTRA_VIEWS, Neighbours, choose_neighbours
from tidefield.data.scene import Scene
from tidefield.errors import SceneError
from tidefield.recording import tensors_of

CROPS = replace(SWIFT.train, tile_px=8, tiles=6, crop_px=20)
WHOLE = replace(PAPER.train, tile_px=8, tiles=6)
TEST = (1, 4)


@cache
def scene() -> Scene:
    return wall.scene(wall.with_gains(wall.cameras(7)), TEST)


@cache
def surfaces() -> DepthPriors:
    return DepthPriors(scene())


def priors_of(own: Scene) -> DepthPriors:
    return surfaces() if own is scene() else DepthPriors(own)


def batch(own: Scene, config: TrainConfig, seed: int = 0) -> Batch:
    return draw_batch(own, priors_of(own), config, 3, torch.Generator().manual_seed(seed))


def seeds(own: Scene, config: TrainConfig, count: int = 8) -> list[Batch]:
    priors = priors_of(own)
    return [draw_batch(own, priors, config, 3, torch.Generator().manual_seed(seed)) for seed in range(count)]


@pytest.mark.parametrize("config", [CROPS, WHOLE, replace(CROPS, neighbours="direction")])
def test_targets_and_test_photographs_are_no_neighbours(config: TrainConfig):
    for drawn in seeds(scene(), config):
        assert not (drawn.neighbours == drawn.targets[:, None]).any()
        assert not torch.isin(torch.cat([drawn.targets, drawn.neighbours.flatten()]), torch.tensor(TEST)).any()
        count = 3 if config.neighbours == "direction" else 3 + EXTRA_VIEWS
        assert all(len(set(row.tolist())) == len(row) == count for row in drawn.neighbours)


@pytest.mark.parametrize("config", [CROPS, WHOLE])
def test_the_same_seed_draws_the_same_batch_and_another_seed_another(config: TrainConfig):
    first, again, other = batch(scene(), config), batch(scene(), config), batch(scene(), config, seed=1)
    for one, same in zip(tensors_of(first), tensors_of(again), strict=True):
        torch.testing.assert_close(one, same, rtol=0, atol=0)
    assert not torch.equal(first.corner_px, other.corner_px)


@pytest.mark.parametrize("config", [CROPS, WHOLE])
def test_tiles_hold_the_pixels_they_claim_at_the_common_exposure(config: TrainConfig):
    own = scene()
    for drawn in seeds(own, config, 3):
        assert (drawn.weight > 0).all()
        for t, (target, (u, v)) in enumerate(zip(drawn.targets.tolist(), drawn.corner_px.long().tolist(), strict=True)):
            pixels = own.photographs[target][v : v + 8, u : u + 8].float() / 255 / own.cameras.gain[target]
            torch.testing.assert_close(drawn.colours[t].reshape(8, 8, 3), pixels)


def images(drawn: Batch) -> list[tuple[Tensor, Tensor]]:
    """Every image with its corner, in the order that `which` counts in."""
    groups = [(drawn.colours_of_images(k), drawn.image_corner_px[k]) for k in range(len(drawn.images))]
    return [pair for group, corner in groups for pair in zip(group, corner, strict=True)]


@pytest.mark.parametrize("config", [CROPS, WHOLE])
@pytest.mark.parametrize("mixed", [False, True])
def test_images_hold_the_neighbours_pixels_they_claim(config: TrainConfig, mixed: bool):
    own = wall.mixed_scene() if mixed else scene()
    for drawn in seeds(own, config, 4):
        every = images(drawn)
        for neighbour, which in zip(drawn.neighbours.flatten().tolist(), drawn.which.flatten().tolist(), strict=True):
            image, corner = every[which]
            u, v = corner.tolist()
            height, width = image.shape[1:]
            part = to_common_exposure(own, neighbour)[v : v + height, u : u + width]
            torch.testing.assert_close(image, part.permute(2, 0, 1))


def test_whole_photographs_are_encoded_once_each():
    for drawn in seeds(wall.mixed_scene(), WHOLE, 4):
        assert sum(len(group) for group in drawn.images) == len(drawn.neighbours.unique())
        assert not any(corner.any() for corner in drawn.image_corner_px)


def test_crops_show_what_the_tile_shows():
    own = scene()
    for drawn in seeds(own, CROPS, 4):
        camera = own.cameras[drawn.targets]
        middle = camera.directions_world(drawn.corner_px[:, None] + 4)[:, 0] * wall.DEPTH + camera.position_world
        for t in range(6):
            for n in range(3):
                uv, _ = own.cameras[int(drawn.neighbours[t, n])].project(middle[t : t + 1])
                image, corner = images(drawn)[drawn.which[t, n]]
                assert image.shape[1:] == (20, 20)
                wanted = (uv[0, 0] - 10).clamp(min=0).minimum(torch.tensor([28.0, 16.0]))
                assert (corner - wanted).abs().max() <= 0.51


def test_tiles_cover_all_training_photographs():
    drawn = seeds(scene(), CROPS, 16)
    corners = torch.cat([d.corner_px for d in drawn])
    assert corners.amin(0).tolist() == [0, 0]
    assert corners.amax(0).tolist() == [40, 28]
    assert torch.cat([d.targets for d in drawn]).unique().tolist() == [0, 2, 3, 5, 6]


def test_pixels_outside_a_photograph_smaller_than_a_tile_have_weight_zero():
    drawn = [b for b in seeds(wall.mixed_scene(), CROPS) if (b.targets % 2 == 1).any()]
    assert drawn
    for b in drawn:
        for t in (b.targets % 2 == 1).nonzero()[:, 0].tolist():
            inside = b.weight[t].reshape(8, 8) > 0
            assert inside[:6].all()
            assert not inside[6:].any()
            assert not b.colours[t].reshape(8, 8, 3)[6:].any()


def test_whole_photographs_serve_all_tiles_of_one_target():
    for drawn in seeds(scene(), WHOLE):
        assert len(drawn.targets.unique()) == 1
        assert len(drawn.targets) == 6


def test_photographs_at_the_common_exposure():
    own = scene()
    reference = wall.scene(wall.cameras(7), TEST)
    unclipped = (own.photographs[2] < 255).all(-1) & (reference.photographs[2] < 255).all(-1)
    difference = (to_common_exposure(own, 2) - to_common_exposure(reference, 2)).abs()[unclipped]
    assert difference.max() < 0.5 / 255 * (1 + 1 / own.cameras.gain[2].min()) + 1e-6
    torch.testing.assert_close(
        to_common_exposure(own, 2, slice(3, 9), slice(5, 6)), to_common_exposure(own, 2)[3:9, 5:6]
    )


def test_unprojected_pixels_lie_on_the_wall():
    own = scene()
    camera, asked = own.cameras[2], torch.tensor([[4.0, 4.0], [44.0, 32.0], [50.0, -3.0]])
    points = unproject_to_surface(camera, DepthPriors(own)[2].cells, asked)
    torch.testing.assert_close(points[:, 2], torch.full((3,), wall.DEPTH), rtol=1e-3, atol=0)
    uv = camera.project(points)[0][0]
    torch.testing.assert_close(uv[:2], asked[:2], atol=1e-3, rtol=0)
    torch.testing.assert_close(uv[2], torch.tensor([48.0, 0.0]), atol=1e-3, rtol=0)


def test_without_points_the_surface_is_between_near_and_far():
    own = replace(scene(), points=None)
    points = unproject_to_surface(own.cameras[0], DepthPriors(own)[0].cells, torch.full((1, 2), 4.0))
    torch.testing.assert_close(points[:, 2], torch.full((1,), 2 / (1 / 3 + 1 / 10)))


@pytest.mark.parametrize("strategy", ["seen", "direction"])
def test_neighbours_of_a_view_are_training_photographs(strategy: str):
    own = scene()

    def neighbours(target: int, count: int) -> Neighbours:
        prior = DepthPriors(own)[target].cells
        return choose_neighbours(own.cameras[target], prior, torch.zeros(2), (3, 2), 16, own, count, strategy)

    every = neighbours(1, 100)
    assert every.index.shape == (6, 5)
    assert all(sorted(chosen) == list(own.train) for chosen in every.index.tolist())
    assert sorted(neighbours(2, 100).index[0].tolist()) == [0, 3, 5, 6]
    if strategy == "seen":
        assert set(neighbours(1, 2).index[0, :2].tolist()) == {0, 2}


def test_adjacent_tiles_share_the_blend_weights_of_their_common_corners():
    at = wall.scene(wall.cameras(12, 96, 72, step=0.2), (6,))
    found = choose_neighbours(at.cameras[6], DepthPriors(at)[6].cells, torch.zeros(2), (6, 4), 16, at, 4, "seen")
    table = torch.zeros(6 * 4, 12, 4).scatter_(1, found.index[..., None].expand(-1, -1, 4), found.blend_weight)
    grid = table.reshape(4, 6, 12, 4)
    across = (grid[:, :-1, :, [1, 3]] - grid[:, 1:, :, [0, 2]]).abs()
    down = (grid[:-1, :, :, [2, 3]] - grid[1:, :, :, [0, 1]]).abs()
    assert len({tuple(sorted(index)) for index in found.index.tolist()}) > 2, "neighbours change"
    assert max(across.max(), down.max()) < 0.1, "and have hardly any weight where they change"


@pytest.mark.parametrize("config", [CROPS, WHOLE, replace(CROPS, neighbours="direction")])
def test_a_single_training_photograph_has_no_neighbours_to_learn_from(config: TrainConfig):
    own = wall.scene(wall.cameras(3), test=(0, 2))
    with pytest.raises(SceneError, match="no training photograph besides the target's own: expected another"):
        batch(own, config)
    assert len(draw_batch(own, DepthPriors(own), config, 0, torch.Generator()).targets) == 6


def test_a_batch_for_a_network_without_views_has_nothing_to_encode():
    own = scene()
    drawn = draw_batch(own, DepthPriors(own), CROPS, 0, torch.Generator().manual_seed(0))
    assert drawn.neighbours.shape == (6, 0)
    assert drawn.images == ()
    assert drawn.colours.shape == (6, 64, 3)


def test_pixels_seen_by_fewer_than_two_others_have_the_unseen_weight():
    """Three cameras in a row: the outer ones' outer edges are seen by themselves alone."""
    own = wall.scene(wall.cameras(3, step=1.5), ())
    config = replace(CROPS, tile_px=8, unseen_weight=0.25)
    weights = set()
    for drawn in (draw_batch(own, DepthPriors(own), config, 2, torch.Generator().manual_seed(k)) for k in range(6)):
        for t, target in enumerate(drawn.targets.tolist()):
            tile = own.cameras[target]
            u, v = (drawn.corner_px[t] + 0.5).tolist()
            pixels = torch.tensor([[u + x, v + y] for y in range(8) for x in range(8)])
            surface = tile.directions_world(pixels[None])[0] * wall.DEPTH + tile.position_world
            others = own.cameras[[i for i in range(3) if i != target]]
            seen = (
                ((others.project(surface)[0] > 0) & (others.project(surface)[0] < others.size_px[:, None]))
                .all(-1)
                .sum(0)
            )
            # Decided on cells of four pixels, so it may differ at the border between seen and unseen.
            agree = torch.where(seen >= 2, 1.0, 0.25) == drawn.weight[t]
            assert agree.float().mean() >= 0.75
            weights |= set(drawn.weight[t].tolist())
    assert weights == {0.25, 1.0}


@pytest.mark.parametrize("config", [CROPS, WHOLE])
def test_sparse_points_give_their_pixels_the_depth_of_the_wall(config: TrainConfig):
    own, found = scene(), 0
    points = own.points
    assert points is not None
    for drawn in seeds(own, config, 4):
        for t, target in enumerate(drawn.targets.tolist()):
            uv = points.uv_px[points.camera_index == target] - drawn.corner_px[t]
            inside = uv[((uv >= 0) & (uv < 8)).all(-1)].long()
            observed = torch.zeros(64, dtype=torch.bool)
            observed[inside[:, 1] * 8 + inside[:, 0]] = True
            assert torch.equal(drawn.depth_weight[t] > 0, observed)
            torch.testing.assert_close(drawn.inverse_depth[t], observed / wall.DEPTH)
            found += int(observed.sum())
    assert found > 20


def test_points_of_large_reprojection_error_have_less_weight():
    own = scene()
    assert own.points is not None
    error = torch.ones(len(own.points.xyz_world))
    error[::2] = 3
    own = replace(own, points=replace(own.points, error_px=error))
    expected = torch.where(torch.arange(len(error)) % 2 == 0, 1 / 10, 1 / 2)
    torch.testing.assert_close(DepthPriors(own).observed(0).weight, expected)


def test_without_sparse_points_no_depth_is_supervised():
    drawn = batch(replace(scene(), points=None), CROPS)
    assert drawn.depth_weight.abs().max() == 0
    assert drawn.inverse_depth.abs().max() == 0
