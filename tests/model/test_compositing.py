import math

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from tidefield.model.compositing import composite, weights
from tidefield.model.swift import surface_logits, surface_shares, widths


def random_ray(rays: int = 20, samples: int = 9, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    sigma = 3 * torch.rand(rays, samples, generator=generator, dtype=torch.float64)
    return sigma, torch.rand(rays, samples, generator=generator, dtype=torch.float64)


def endless(delta: Tensor) -> Tensor:
    return torch.cat([delta[..., :-1], torch.full_like(delta[..., -1:], torch.inf)], -1)


@pytest.mark.parametrize("samples", [1, 2, 7, 64])
def test_a_slab_stops_what_beer_and_lambert_say_however_it_is_cut(samples: int):
    cuts = torch.rand(samples, generator=torch.Generator().manual_seed(samples), dtype=torch.float64)
    delta = 2.5 * cuts / cuts.sum()
    opacity = weights(torch.full_like(delta, 0.8), delta).sum()
    assert opacity.item() == pytest.approx(1 - math.exp(-0.8 * 2.5), abs=1e-12)


def test_two_slabs_blend_by_their_closed_form():
    sigma = torch.tensor([0.7] * 3 + [0.0] * 2 + [1.9] * 4)
    delta = torch.tensor([0.2] * 3 + [1.0] * 2 + [0.1] * 4)
    red, blue = torch.tensor([1.0, 0.1, 0.0]), torch.tensor([0.0, 0.2, 1.0])
    colours = torch.stack([red] * 3 + [torch.full((3,), 9.0)] * 2 + [blue] * 4)
    first, second = 1 - math.exp(-0.7 * 0.6), 1 - math.exp(-1.9 * 0.4)
    torch.testing.assert_close(composite(weights(sigma, delta), colours), first * red + (1 - first) * second * blue)


def test_the_mean_depth_in_a_deep_fog_is_one_over_its_density():
    edges = torch.linspace(0, 30, 6001, dtype=torch.float64)
    w = weights(torch.full((6000,), 1.3, dtype=torch.float64), edges.diff())
    depth = composite(w, (edges[:-1] + edges[1:])[:, None] / 2)
    assert depth.item() == pytest.approx(1 / 1.3, rel=1e-5)


def test_weights_are_those_of_eqs_3_and_4_sample_by_sample():
    sigma, delta = random_ray()
    got = weights(sigma, delta)
    for r in range(len(sigma)):
        light = 1.0
        for i in range(sigma.shape[1]):
            passes = math.exp(-float(sigma[r, i] * delta[r, i]))
            assert got[r, i].item() == pytest.approx(light * (1 - passes), abs=1e-12)
            light *= passes


def test_weights_are_shares_of_the_light():
    sigma, delta = random_ray()
    for thickness in (1e-6, 1.0, 1e6):
        w = weights((sigma * thickness).float(), delta.float())
        assert (w >= 0).all()
        assert (w.sum(-1) <= 1 + 1e-6).all()


def test_an_endless_last_interval_stops_the_rest_if_anything_is_there():
    sigma, delta = random_ray()
    torch.testing.assert_close(weights(sigma, endless(delta)).sum(-1), torch.ones(20, dtype=torch.float64))
    torch.testing.assert_close(weights(sigma, endless(delta))[:, :-1], weights(sigma, delta)[:, :-1])
    sigma[:, -1] = 0
    torch.testing.assert_close(weights(sigma, endless(delta)).sum(-1), weights(sigma, delta).sum(-1))


def test_thin_samples_keep_their_weight_in_single_precision():
    w = weights(torch.tensor([1e-6, 1e-6]), torch.tensor([1e-4, 3e-4]))
    torch.testing.assert_close(w, torch.tensor([1e-10, 3e-10]), rtol=1e-5, atol=0)


def test_gradients_are_right_also_before_an_endless_interval():
    sigma, delta = random_ray(3, 4)
    values = torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    sigma, delta, values = (t.requires_grad_() for t in (sigma, delta, values))
    assert torch.autograd.gradcheck(lambda s, d, c: composite(weights(s, d), c), (sigma, delta, values))
    last = endless(delta.detach())
    assert torch.autograd.gradcheck(lambda s, c: composite(weights(s, last), c), (sigma, values))


def test_opaque_and_empty_samples_have_finite_gradients():
    sigma = torch.tensor([0.0, 1e8, 0.0, 1e8], requires_grad=True)
    weights(sigma, endless(torch.ones(4))).square().sum().backward()
    assert sigma.grad is not None
    assert sigma.grad.isfinite().all()


@pytest.mark.parametrize("opaque", [True, False])
def test_surface_logits_weigh_samples_by_the_softmax_of_their_scores(opaque: bool):
    _, delta = random_ray()
    score = 3 * torch.randn(delta.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    empty = None if opaque else torch.tensor(-1.5, dtype=torch.float64)
    sigma = F.softplus(surface_logits(score, empty)) / delta
    # The score of an empty ray is against those of all 9 samples together.
    candidates = score if empty is None else torch.cat([score, (empty + math.log(9)).expand(20, 1)], -1)
    expected = torch.softmax(candidates, -1)[..., : score.shape[-1]]
    torch.testing.assert_close(surface_shares(score, empty), expected)
    torch.testing.assert_close(weights(sigma, endless(delta) if opaque else delta), expected, rtol=1e-4, atol=1e-6)


def test_surface_logits_and_their_gradients_are_finite_for_samples_that_cannot_be_told_apart_from_nothing():
    score = torch.tensor([[-30.0] * 5, [-30.0, 0.0, -30.0, 40.0, -30.0], [60.0, -30.0, -30.0, -30.0, 0.0]])
    for empty in (None, torch.tensor(-3.0)):
        given = score.clone().requires_grad_()
        logits = surface_logits(given, empty)
        logits.sum().backward()
        assert logits.isfinite().all()
        assert given.grad is not None
        assert given.grad.isfinite().all()


@pytest.mark.parametrize("where", ["evenly", "unevenly"])
def test_more_samples_of_one_density_stop_no_more_light(where: str):
    """The surface's distribution is a function of the place on the ray: sampling it densely changes nothing."""

    def opacity(samples: int, before: float) -> Tensor:
        s = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples
        if where == "unevenly":
            s = s**1.5
        score = (-2 * (s - 0.4) ** 2)[None] + widths(s[None]).log()
        sigma = F.softplus(surface_logits(score, torch.tensor(-0.7, dtype=torch.float64)))
        return weights(sigma, torch.ones_like(sigma))[s[None] < before].sum()

    for before in (0.5, 1.0):
        few, many = opacity(24, before), opacity(384, before)
        assert 0.1 < many < 0.9
        assert abs(few - many) < 0.03, "a sample's width is 0.04"
