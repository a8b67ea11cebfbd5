import math

import pytest
import torch
from random_weights import randomise
from torch import Tensor
from torch.nn import functional as F

from tidefield.model.aggregate import Aggregate, direction_weights, weighted_moments
from tidefield.model.swift import ComparingAggregate, degrees_of_freedom, mean_colours
from tidefield.model.views import Gathered

T, N, P, C, H = 2, 4, 20, 5, 6


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def some_valid(seed: int = 1) -> Tensor:
    """Views seen or not at random; the first sample is seen by all, the second by one, the third by none."""
    valid = torch.rand(T, N, P, generator=torch.Generator().manual_seed(seed)) < 0.6
    valid[:, :, 0] = True
    valid[:, :, 1] = torch.tensor([False, True, False, False])
    valid[:, :, 2] = False
    return valid


def cosines() -> Tensor:
    """Of angles up to half a radian; at the fourth sample all alike, at the fifth two views tie for the farthest."""
    cosine = torch.cos(0.5 * torch.rand(T, N, P, generator=torch.Generator().manual_seed(2), dtype=torch.float64))
    cosine[:, :, 3] = 0.95
    cosine[:, :2, 4] = 0.6
    return cosine


def brute_force_weights(cosine: list[float], valid: list[bool], s: float) -> list[float]:
    """Eq. 6 with its decisions, for one sample."""
    seen = [i for i in range(len(cosine)) if valid[i]]
    if not seen:
        return [0.0] * len(cosine)
    raw = {i: math.exp(s * (cosine[i] - 1)) for i in seen}
    least = min(raw.values())
    raw = {i: max(0.0, value - least) for i, value in raw.items()}
    total = sum(raw.values())
    return [(raw[i] / total if total > 1e-6 else 1 / len(seen)) if i in raw else 0.0 for i in range(len(cosine))]


@pytest.mark.parametrize("sharpness", [1.0, 20.0, 300.0])
def test_direction_weights_are_eq_6_at_every_sample(sharpness: float):
    cosine, valid = cosines(), some_valid()
    got = direction_weights(cosine, valid, torch.tensor(sharpness, dtype=torch.float64))
    for t in range(T):
        for p in range(P):
            expected = brute_force_weights(cosine[t, :, p].tolist(), valid[t, :, p].tolist(), sharpness)
            assert got[t, :, p].tolist() == pytest.approx(expected, abs=1e-9)


def test_direction_weights_share_one_wherever_any_view_sees():
    valid = some_valid()
    got = direction_weights(cosines(), valid, torch.tensor(20.0, dtype=torch.float64))
    torch.testing.assert_close(got.sum(1), valid.any(1).double())
    assert (got[~valid] == 0).all()


def test_one_view_takes_all_and_equal_views_share_in_single_precision():
    s = torch.tensor(20.0)
    assert direction_weights(torch.tensor([[[0.3]]]), torch.tensor([[[True]]]), s).item() == 1
    cosine = torch.full((1, 3, 1), 0.9)
    valid = torch.tensor([True, False, True])[None, :, None]
    assert direction_weights(cosine, valid, s).flatten().tolist() == [0.5, 0, 0.5]


def test_direction_weights_have_the_right_gradients_where_they_are_smooth():
    cosine = torch.cos(torch.tensor([0.1, 0.3, 0.2, 0.5], dtype=torch.float64)).reshape(1, 4, 1).requires_grad_()
    sharpness = torch.tensor(7.0, dtype=torch.float64, requires_grad=True)
    valid = torch.tensor([True, True, True, False])[None, :, None]
    assert torch.autograd.gradcheck(lambda c, s: direction_weights(c, valid, s), (cosine, sharpness))


def test_direction_weights_have_finite_gradients_at_ties_and_where_nothing_sees():
    cosine, sharpness = cosines().float().requires_grad_(), torch.tensor(20.0, requires_grad=True)
    (direction_weights(cosine, some_valid(), sharpness) * draw(T, N, P).float()).sum().backward()
    assert cosine.grad is not None
    assert cosine.grad.isfinite().all()
    assert sharpness.grad is not None
    assert sharpness.grad.isfinite()


def test_moments_with_equal_weights_are_the_usual_mean_and_variance():
    values = draw(T, N, P, C)
    mean, variance = weighted_moments(values, torch.full((T, N, P), 1 / N, dtype=torch.float64))
    torch.testing.assert_close(mean, values.mean(1))
    torch.testing.assert_close(variance, values.var(1, correction=0))


def test_moments_are_sums_over_views_and_zero_without_views():
    values, weight = draw(T, N, P, C), torch.rand(T, N, P, dtype=torch.float64, generator=torch.Generator())
    weight = weight / weight.sum(1, keepdim=True)
    weight[:, :, 2] = 0
    mean, variance = weighted_moments(values, weight)
    for p in range(P):
        expected = sum(weight[0, i, p] * values[0, i, p] for i in range(N))
        torch.testing.assert_close(mean[0, p], torch.as_tensor(expected))
        spread = sum(weight[0, i, p] * (values[0, i, p] - expected) ** 2 for i in range(N))
        torch.testing.assert_close(variance[0, p], torch.as_tensor(spread))
    assert not mean[:, 2].any()
    assert not variance[:, 2].any()
    assert torch.autograd.gradcheck(weighted_moments, (values[:1, :, :2].requires_grad_(), weight[:1, :, :2]))


def box(folded: bool = False) -> Aggregate:
    return randomise(Aggregate(H if folded else C, H, folded).double())


def inputs(channels: int = C) -> tuple[Tensor, Tensor, Tensor]:
    return draw(T, N, P, channels), cosines(), some_valid()


def test_a_view_counts_as_much_as_it_is_there():
    features, cosine, valid = inputs()
    blend_weight = torch.ones(T, N, P).double()
    own = box()
    same = own(features, cosine, valid, blend_weight)
    for name, value in vars(own(features, cosine, valid)).items():
        torch.testing.assert_close(getattr(same, name), value)
    blend_weight[:, 1] = 0
    without = valid.clone()
    without[:, 1] = False
    weight = direction_weights(cosine, valid, own.log_sharpness.exp(), blend_weight)
    assert not weight[:, 1].any()
    torch.testing.assert_close(weight.sum(1), without.any(1).double())
    assert not own(features, cosine, valid, blend_weight).view_weight[:, 1].any()


def test_the_box_is_figure_2_sample_by_sample():
    """[F_i, mu, v] through one layer after the other, for one sample and view at a time."""
    own = box()
    features, cosine, valid = inputs()
    evidence = own(features, cosine, valid)
    weight = direction_weights(cosine, valid, own.log_sharpness.exp())
    assert isinstance(own.own, torch.nn.Linear)
    first = torch.cat([own.own.weight, own.shared.weight], 1)
    for t, p in [(0, 0), (0, 1), (1, 4), (1, 5), (1, 6)]:
        seen = [i for i in range(N) if valid[t, i, p]]
        mean = sum(weight[t, i, p] * features[t, i, p] for i in seen)
        variance = sum(weight[t, i, p] * (features[t, i, p] - mean) ** 2 for i in seen)
        pooled = []
        for i in seen:
            triple = torch.cat([features[t, i, p], torch.as_tensor(mean), torch.as_tensor(variance)])
            hidden = F.relu(first @ triple + own.own.bias + own.shared.bias)
            hidden = F.relu(own.second(hidden))
            torch.testing.assert_close(evidence.per_view[t, i, p], hidden)
            trust = torch.sigmoid(own.view_weight(hidden))[0]
            torch.testing.assert_close(evidence.view_weight[t, i, p], trust)
            pooled.append((trust, hidden))
        total = sum(trust for trust, _ in pooled)
        centre = sum(trust / total * hidden for trust, hidden in pooled)
        spread = sum(trust / total * (hidden - centre) ** 2 for trust, hidden in pooled)
        both = torch.cat([torch.as_tensor(centre), torch.as_tensor(spread)])
        torch.testing.assert_close(evidence.density[t, p], own.density(both))


@pytest.mark.parametrize("folded", [False, True])
def test_what_invalid_views_hold_changes_nothing(folded: bool):
    own = box(folded)
    features, cosine, valid = inputs(H if folded else C)
    before = own(features, cosine, valid)
    hidden = ~valid
    after = own(features.masked_fill(hidden[..., None], 0.77), cosine.masked_fill(hidden, -1.0), valid)
    for name in ("density", "view_weight", "direction_weight", "variance", "valid"):
        torch.testing.assert_close(getattr(before, name), getattr(after, name))


def test_the_order_of_the_views_does_not_matter():
    own, order = box(), torch.tensor([2, 0, 3, 1])
    before, after = own(*inputs()), own(*(t[:, order] for t in inputs()))
    for name in ("density", "variance", "valid"):
        torch.testing.assert_close(getattr(before, name), getattr(after, name))
    torch.testing.assert_close(before.per_view[:, order], after.per_view)
    torch.testing.assert_close(before.view_weight[:, order], after.view_weight)


def comparing() -> ComparingAggregate:
    return randomise(ComparingAggregate(C, H, folded=False, uniform_weights=False).double())


def gathered(valid: Tensor) -> Gathered:
    """What the views show at the samples; of it, the tests need the colours."""
    colours = torch.sigmoid(draw(T, N, P, 3, seed=3))
    return Gathered(
        colours,
        draw(T, N, P, C),
        draw(T, N, P, 3),
        cosines(),
        valid,
        torch.ones(T, N, P).double(),
        torch.zeros(T, N, P).double(),
    )


def test_where_no_view_sees_the_colour_is_grey_and_nothing_is_known():
    evidence, valid = comparing()(*inputs()), some_valid()
    assert torch.equal(evidence.valid, valid.any(1))
    assert (mean_colours(evidence, gathered(valid))[:, 2] == 0.5).all()
    assert (evidence.view_weight[~valid] == 0).all()
    assert (evidence.view_weight[valid] > 0).all()
    assert evidence.density.isfinite().all()
    assert (degrees_of_freedom(evidence)[:, 1:3] == 0).all(), "one view or none says nothing"


def test_views_that_agree_have_no_disagreement_and_others_have():
    features, cosine, valid = inputs()
    own = comparing()
    same = features[:, :1].expand_as(features)
    assert own.disagreement(own(same, cosine, valid)).abs().max() < 1e-12
    assert (own.disagreement(own(features, cosine, valid))[:, 0] > 0).all()


def test_gradients_of_the_box_are_finite_where_nothing_sees():
    own = comparing()
    evidence = own(*inputs())
    colours = mean_colours(evidence, gathered(some_valid()))
    (evidence.density.sum() + colours.sum() + own.disagreement(evidence).sum()).backward()
    for name, parameter in own.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


def test_uniform_weights_average_the_views_whatever_their_directions():
    own = randomise(Aggregate(C, H, uniform_weights=True).double())
    features, cosine, valid = inputs()
    evidence = own(features, cosine, valid)
    torch.testing.assert_close(degrees_of_freedom(evidence), (valid.sum(1).double() - 1).clamp(min=0))
    seen, mean = gathered(valid), mean_colours(evidence, gathered(valid))
    for t, p in [(0, 0), (1, 4), (1, 5)]:
        expected = seen.colours[t, valid[t, :, p], p].mean(0) + 0.5 * (not valid[t, :, p].any())
        torch.testing.assert_close(mean[t, p], expected)
