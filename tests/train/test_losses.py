"""Eq. 5 and the further terms, against brute-force twins."""

from dataclasses import replace

import pytest
import textured_wall as wall
import torch
from networks import SMALL, SMALL_PAPER, network
from torch import Tensor

from tidefield.config import NetworkConfig
from tidefield.data.batches import Batch
from tidefield.data.depth_prior import DepthPriors
from tidefield.evaluation.lpips import prepare_torchvision
from tidefield.model.network import RayGrid, TileRendering
from tidefield.train.losses import COARSE_WEIGHT, DEPTH_SCALE, BatchLoss, Inputs, photometric, sparse_depth, structural

SIDE, TILES = 8, 2
STRIDE = 4
GRIDS = (RayGrid(STRIDE, 1), RayGrid(1, 0))
ROWS = SIDE // STRIDE


def made(seed: int = 0, weight: Tensor | None = None) -> tuple[TileRendering, Batch]:
    """Random renderings of random tiles; every eighth pixel has a sparse point."""
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=random)

    pixels, coarse = SIDE**2, (ROWS + 2) ** 2
    known = (uniform(TILES, pixels) < 1 / 8).float()
    batch = Batch(
        targets=torch.zeros(TILES, dtype=torch.long),
        corner_px=torch.zeros(TILES, 2),
        colours=uniform(TILES, pixels, 3),
        weight=torch.ones(TILES, pixels) if weight is None else weight,
        detail=torch.zeros(TILES, pixels),
        inverse_depth=known * (0.2 + 0.01 * uniform(TILES, pixels)),
        depth_weight=known * uniform(TILES, pixels),
        neighbours=torch.zeros(TILES, 0, dtype=torch.long),
        blend_weight=torch.zeros(TILES, 0, 4),
        which=torch.zeros(TILES, 0, dtype=torch.long),
    )
    rendering = TileRendering(
        colour=uniform(TILES, pixels, 3),
        depth=torch.ones(TILES, pixels),
        opacity=torch.ones(TILES, pixels),
        visibility=torch.ones(TILES, pixels),
        inverse_depths=(0.2 + 0.01 * uniform(TILES, coarse), 0.2 + 0.01 * uniform(TILES, pixels)),
        coarse_colours=(uniform(TILES, coarse, 3),),
    )
    return rendering, batch


def blocks() -> list[tuple[int, int, list[int]]]:
    """Every coarse ray of a tile: its index, the margin counted in, and the pixels that it stands for."""
    return [
        (
            (row + 1) * (ROWS + 2) + column + 1,
            row * ROWS + column,
            [(row * STRIDE + y) * SIDE + column * STRIDE + x for y in range(STRIDE) for x in range(STRIDE)],
        )
        for row in range(ROWS)
        for column in range(ROWS)
    ]


def test_the_loss_is_eq_5_and_the_coarse_rays_are_held_to_the_means_of_their_pixels():
    rendering, batch = made()
    loss, error = photometric(rendering, batch, GRIDS, SIDE)
    fine = sum(
        float((rendering.colour[t, r] - batch.colours[t, r]).square().sum()) for t in range(2) for r in range(64)
    )
    assert error.item() == pytest.approx(fine / (TILES * SIDE**2 * 3), rel=1e-5)
    coarse = torch.stack(
        [
            rendering.coarse_colours[0][t, ray] - batch.colours[t, pixels].mean(0)
            for t in range(2)
            for ray, _, pixels in blocks()
        ]
    )
    assert loss.item() == pytest.approx(error.item() + COARSE_WEIGHT * coarse.square().mean().item(), rel=1e-5)


def test_pixels_without_weight_change_nothing():
    weight = torch.ones(TILES, SIDE**2)
    weight[:, ::3] = 0
    rendering, batch = made(weight=weight)
    elsewhere = torch.where(weight[..., None] > 0, batch.colours, 1 - batch.colours)
    before, after = (photometric(rendering, replace(batch, colours=c), GRIDS, SIDE) for c in (batch.colours, elsewhere))
    assert before[0].item() == pytest.approx(after[0].item(), rel=1e-6)
    assert before[1].item() == pytest.approx(after[1].item(), rel=1e-6)


def test_the_photometric_terms_are_weighted_means_unless_hardly_a_pixel_has_weight():
    weight = torch.ones(TILES, SIDE**2)
    weight[:, ::2] = 0.2
    few = torch.zeros(TILES, SIDE**2)
    few[0, :3] = 1
    for given, divisor in ((weight, weight.sum()), (few, 0.1 * few.numel())):
        rendering, batch = made(weight=given)
        squares = (rendering.colour - batch.colours).square().mean(-1)
        _, error = photometric(rendering, batch, GRIDS, SIDE)
        assert error.item() == pytest.approx(float((squares * given).sum() / divisor), rel=1e-5)


def test_the_depth_term_is_hubers_penalty_of_the_relative_error_in_both_passes():
    rendering, batch = made()

    def penalty(found: Tensor, true: Tensor) -> float:
        miss = abs(float(found / true - 1)) / DEPTH_SCALE
        return miss**2 / 2 if miss < 1 else miss - 0.5

    terms = []
    for expected, groups in (
        (rendering.inverse_depths[0], [(ray, pixels) for ray, _, pixels in blocks()]),
        (rendering.inverse_depths[1], [(pixel, [pixel]) for pixel in range(SIDE**2)]),
    ):
        total = share = 0.0
        for t in range(TILES):
            for ray, pixels in groups:
                weight = batch.depth_weight[t, pixels]
                if weight.sum() > 0:
                    mean = (batch.inverse_depth[t, pixels] * weight).sum() / weight.sum()
                    total += penalty(expected[t, ray], mean) * float(weight.sum())
                    share += float(weight.sum())
        terms.append(total / share)
    assert sparse_depth(rendering, batch, GRIDS, SIDE).item() == pytest.approx(sum(terms) / 2, rel=1e-4)


def test_the_depth_term_is_nothing_without_points_and_at_the_points():
    rendering, batch = made()
    none = replace(batch, inverse_depth=torch.zeros(TILES, 64), depth_weight=torch.zeros(TILES, 64))
    assert sparse_depth(rendering, none, GRIDS, SIDE).item() == 0
    flat = replace(rendering, inverse_depths=tuple(torch.full_like(e, 0.2) for e in rendering.inverse_depths))
    met = replace(batch, inverse_depth=0.2 * (batch.depth_weight > 0))
    assert sparse_depth(flat, met, GRIDS, SIDE).item() == pytest.approx(0, abs=1e-6)


def test_the_structural_term_is_the_ssim_that_evaluation_measures():
    prepare_torchvision()  # torchmetrics imports it where it is installed
    from torchmetrics.functional.image import structural_similarity_index_measure

    rendering, batch = made()
    pictures = [x.unflatten(1, (SIDE, SIDE)).permute(0, 3, 1, 2) for x in (rendering.colour, batch.colours)]
    _, similarity = structural_similarity_index_measure(
        *pictures, sigma=1.5, kernel_size=11, data_range=1.0, return_full_image=True
    )
    assert structural(rendering, batch, SIDE).item() == pytest.approx(1 - similarity.mean().item(), rel=1e-5)


def test_the_structural_term_is_nothing_for_the_truth_and_leaves_out_what_has_no_weight():
    rendering, batch = made()
    assert structural(replace(rendering, colour=batch.colours), batch, SIDE).item() == pytest.approx(0, abs=1e-6)
    weight = torch.ones(TILES, SIDE**2)
    weight[1] = 0
    one = replace(batch, weight=weight)
    alone = replace(batch, colours=torch.cat([batch.colours[:1], rendering.colour[1:]]))
    assert structural(rendering, one, SIDE).item() == pytest.approx(
        2 * structural(rendering, alone, SIDE).item(), rel=1e-4
    )
    colour = rendering.colour.clone().requires_grad_()
    structural(replace(rendering, colour=colour), one, SIDE).backward()
    assert colour.grad is not None
    assert colour.grad.isfinite().all()
    assert (colour.grad[1] == 0).all()


@pytest.mark.parametrize("preset", [SMALL.network, SMALL_PAPER])
@pytest.mark.parametrize("everything", [False, True])
def test_a_scene_with_masks_is_learned_from_where_it_is_not_masked(preset: NetworkConfig, everything: bool):
    config = replace(SMALL.train, crop_px=None if preset is SMALL_PAPER else 48, tiles=4)
    own = wall.with_left_halves_masked(wall.scene(wall.cameras(6)), tuple(range(6)))
    if everything:
        masks = tuple(torch.zeros(36, 48, dtype=torch.bool) for _ in range(6))
        own = replace(own, photographs=replace(own.photographs, masks=masks))
    learner = BatchLoss(network(preset), config)
    random = torch.Generator().manual_seed(3)
    loss, error = learner(Inputs.draw(learner.network, config, own, DepthPriors(own), 3, random))
    loss.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in learner.parameters())
    assert (float(error.detach()) > 0) != everything


@pytest.mark.parametrize("gain", [1.0, 1.25])
def test_what_lies_behind_the_scene_is_not_learned_as_a_surface(gain: float):
    config = replace(SMALL.train, crop_px=48, tiles=4)
    cameras = wall.cameras(6)
    own = wall.scene(replace(cameras, gain=torch.full_like(cameras.gain, gain)))
    nothing = tuple(torch.full_like(colours, 255) for colours in own.photographs.colours)
    clear = tuple(torch.zeros(36, 48, dtype=torch.uint8) for _ in nothing)
    own = replace(own, photographs=replace(own.photographs, colours=nothing, alphas=clear))
    learner = BatchLoss(network(SMALL.network), config)
    inputs = Inputs.draw(learner.network, config, own, DepthPriors(own), 3, torch.Generator().manual_seed(3))
    loss, error = learner(inputs)
    # However much light the network lets through, white is behind it.
    assert float(error.detach()) < 1e-8
    loss.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in learner.parameters())
