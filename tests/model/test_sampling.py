from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tidefield.data.depth_prior import read_prior
from tidefield.model.sampling import Intervals, histogram, intervals_from_prior, refine, sample

DENSITY = torch.tensor([0.5, 0.0, 2.0, 4.0, 0.1, 0.0, 1.0, 0.4])


def cumulative(density: Tensor, place: Tensor) -> np.ndarray:
    """Share of the density nearer than each place, by numpy, for one density."""
    below = np.concatenate([[0], np.cumsum(density.numpy())]) / float(density.sum())
    return np.interp(place.numpy(), np.linspace(0, 1, len(below)), below)


def spread(density: Tensor, rays: int) -> Tensor:
    return density.expand(1, rays, -1).contiguous()


@pytest.mark.parametrize("count", [1, 6, 100])
def test_samples_without_jitter_are_the_quantiles_of_the_density(count: int):
    place = sample(spread(DENSITY, 1), count, None)[0, 0]
    np.testing.assert_allclose(cumulative(DENSITY, place), (np.arange(count) + 0.5) / count, atol=1e-6)


def test_many_jittered_samples_reproduce_the_density():
    place = sample(spread(DENSITY, 4000), 6, torch.rand(1, 4000, 6, generator=torch.Generator().manual_seed(0)))
    counted = torch.histc(place, len(DENSITY), 0, 1) / place.numel()
    torch.testing.assert_close(counted, DENSITY / DENSITY.sum(), atol=5e-3, rtol=0)
    assert counted[1] == 0, "a sample where there is no density"


def test_each_sample_has_a_part_of_equal_probability_from_near_to_far():
    place = sample(spread(DENSITY, 500), 7, torch.rand(1, 500, 7, generator=torch.Generator().manual_seed(1)))[0]
    share = cumulative(DENSITY, place)
    assert (share >= np.arange(7) / 7 - 1e-6).all()
    assert (share <= np.arange(1, 8) / 7 + 1e-6).all()
    assert (place.diff(dim=-1) >= 0).all()
    assert ((place >= 0) & (place <= 1)).all()


@pytest.mark.parametrize("jittered", [False, True])
def test_the_densitys_scale_and_the_other_rays_do_not_matter(jittered: bool):
    jitter = torch.rand(2, 3, 5, generator=torch.Generator().manual_seed(2)) if jittered else None

    def drawn(density: Tensor) -> Tensor:
        return sample(density, 5, jitter)

    rays = torch.rand(2, 3, 8, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn(rays), drawn(rays * 37.0))
    torch.testing.assert_close(drawn(rays)[1:, 1:2], drawn(rays[[1, 1]])[1:, 1:2])


def test_intervals_of_tiles_are_those_of_their_own_priors_whatever_the_sizes():
    random = torch.Generator().manual_seed(0)
    priors = [torch.rand(3, *size, generator=random) for size in ((9, 12), (12, 9), (9, 12))]
    uv = 40 * torch.rand(3, 20, 2, generator=random)
    found = intervals_from_prior(priors, uv)
    for k, prior in enumerate(priors):
        values = read_prior(prior[None], uv[k : k + 1])
        alone = [found.inv_expected[k], found.inv_near[k], found.inv_far[k]]
        assert torch.equal(torch.stack(alone), torch.cat(values))
        shared = intervals_from_prior([prior], uv)
        assert torch.equal(shared.inv_far[k], found.inv_far[k])


def test_intervals_are_moved_as_asked_but_not_beyond_infinity():
    near, far = torch.tensor([[0.2, 0.2, 0.2]]), torch.tensor([[0.1, 0.1, 0.1]])
    found = Intervals(near, far, torch.tensor([[0.15, torch.nan, 0.15]])).moved(torch.tensor([[-0.05, -0.15, -0.5]]))
    torch.testing.assert_close(found.inv_near[0], torch.tensor([0.15, 0.05, 0.002]))
    torch.testing.assert_close(found.inv_far[0], torch.tensor([0.05, 0.001, 0.001]))
    torch.testing.assert_close(found.inv_expected[0], torch.tensor([0.1, torch.nan, 0.0015]), equal_nan=True)


def test_an_even_density_in_any_number_of_bins_gives_even_samples():
    for bins in (1, 2, 9):
        torch.testing.assert_close(sample(torch.full((1, 1, bins), 0.3), 4, None)[0, 0], (torch.arange(4) + 0.5) / 4)


def some_intervals() -> Intervals:
    generator = torch.Generator().manual_seed(0)
    far = 0.1 + torch.rand(2, 5, generator=generator)
    near = far + 0.1 + torch.rand(2, 5, generator=generator)
    return Intervals(near, far, (near + far) / 2)


def test_places_and_inverse_depths_are_each_others_inverse():
    intervals = some_intervals()
    place = torch.rand(2, 5, 3, generator=torch.Generator().manual_seed(1))
    for k in range(3):
        met = replace(intervals, inv_expected=intervals.inverse_depth(place)[..., k])
        torch.testing.assert_close(met.s_expected, place[..., k])
    ends = intervals.inverse_depth(torch.tensor([0.0, 1.0]).expand(2, 5, 2))
    torch.testing.assert_close(ends, torch.stack([intervals.inv_near, intervals.inv_far], -1))
    torch.testing.assert_close(intervals.s_expected, torch.full((2, 5), 0.5))


@pytest.mark.parametrize("bins", [1, 2, 6, 24])
@pytest.mark.parametrize("floor", [0.0, 0.05, 1.0])
def test_a_histogram_conserves_mass_and_has_its_floor(bins: int, floor: float):
    generator = torch.Generator().manual_seed(0)
    w, place = torch.rand(2, 9, 6, generator=generator), torch.rand(2, 9, 6, generator=generator)
    place[0, 0] = torch.tensor([0.0, 0.0, 1.0, 1.0, 0.5, 0.5])
    density = histogram(w, place, bins, floor)
    torch.testing.assert_close(density.sum(-1), (1 - floor) * w.sum(-1) + floor)
    assert (density >= floor / bins - 1e-7).all()


def test_a_histogram_shares_each_weight_between_the_two_bins_around_it():
    place = torch.tensor([[[0.125, 0.5, 0.9, 0.30]]])
    w = torch.tensor([[[1.0, 2.0, 4.0, 8.0]]])
    # Bins' middles: 0.125, 0.375, 0.625, 0.875; 0.30 is 0.7 of the way from the first to the second.
    expected = [1.0 + 0.3 * 8, 1.0 + 0.7 * 8, 1.0, 4.0]
    torch.testing.assert_close(histogram(w, place, 4, 0.0)[0, 0], torch.tensor(expected))


def test_a_histogram_keeps_the_mean_place():
    generator = torch.Generator().manual_seed(3)
    w, place = torch.rand(1, 4, 6, generator=generator), 0.2 + 0.6 * torch.rand(1, 4, 6, generator=generator)
    middles = (torch.arange(10) + 0.5) / 10
    torch.testing.assert_close((histogram(w, place, 10, 0.0) * middles).sum(-1), (w * place).sum(-1))


def test_no_weight_at_all_looks_everywhere():
    place = torch.rand(1, 3, 6, generator=torch.Generator().manual_seed(0))
    density = histogram(torch.zeros(1, 3, 6), place, 8, 0.05)
    torch.testing.assert_close(sample(density, 4, None), ((torch.arange(4) + 0.5) / 4).expand(1, 3, 4))


def grid(count: int, stride: int, margin: int) -> Tensor:
    """Centres of stride x stride squares of a tile at the origin, with a margin of so many squares, R x 2."""
    line = (torch.arange(-margin, count + margin) + 0.5) * stride
    v, u = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 2)


@pytest.mark.parametrize(("ratio", "margin"), [(4, 0), (2, 0), (2, 1), (4, 1), (1, 0)])
def test_refining_interpolates_planes_of_inverse_depths_exactly(ratio: int, margin: int):
    coarse, fine = grid(4, ratio, 1), grid(4 * ratio, 1, margin)

    def planes(uv: Tensor) -> Tensor:
        slopes = torch.tensor([[0.01, 0.02, 0.9], [-0.02, 0.01, 0.4], [0.005, -0.01, 0.6], [0.0, 0.03, 2.0]])
        return torch.stack([uv @ slopes[:, :2].T + slopes[:, 2], uv @ slopes[:, :2].flip(0).T + 1])[..., :4]

    near, far, expected, bin_ = planes(coarse).unbind(-1)
    density = torch.stack([bin_, torch.full_like(bin_, 0.7)], -1)
    result, looked = refine(Intervals(near, far, expected), density, ratio, margin)
    true = planes(fine)
    torch.testing.assert_close(result.inv_near, true[..., 0])
    torch.testing.assert_close(result.inv_far, true[..., 1])
    torch.testing.assert_close(result.inv_expected, true[..., 2])
    torch.testing.assert_close(looked[..., 0], true[..., 3])
    torch.testing.assert_close(looked[..., 1], torch.full_like(true[..., 3], 0.7))
