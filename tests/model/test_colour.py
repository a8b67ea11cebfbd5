from dataclasses import replace

import pytest
import torch
from random_weights import randomise
from torch import Tensor
from torch.nn import functional as F

from tidefield.model.aggregate import Evidence
from tidefield.model.colour import ColourBlend
from tidefield.model.views import Gathered

T, N, P, H = 2, 3, 6, 8


def unit(generator: torch.Generator, *shape: int) -> Tensor:
    return F.normalize(torch.randn(*shape, 3, generator=generator, dtype=torch.float64), dim=-1)


def scene() -> tuple[Evidence, Gathered, Tensor]:
    """Samples of which the first is seen by every view, the second by two and the third by none."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    valid = draw(T, N, P) < 0.7
    valid[:, :, 0], valid[:, :, 2] = True, False
    valid[:, :, 1] = torch.tensor([True, False, True])
    direction = unit(generator, T, P)
    theirs = F.normalize(direction[:, None] + 0.3 * unit(generator, T, N, P), dim=-1)
    cosine = (theirs * direction[:, None]).sum(-1)
    agreement = draw(T, P), valid.sum(1).double()
    evidence = Evidence(draw(T, P, H), draw(T, N, P, H), draw(T, N, P) * valid, draw(T, P, 3), *agreement, valid.any(1))
    there = torch.ones(T, N, P).double()
    return evidence, Gathered(draw(T, N, P, 3), draw(T, N, P, 4), theirs, cosine, valid, there), direction


def blend(degree: int = 3) -> ColourBlend:
    return randomise(ColourBlend(H, degree).double())


def shares(own: ColourBlend, evidence: Evidence, gathered: Gathered, direction: Tensor) -> Tensor:
    """What each view contributes, T N P: read off by painting one view white and the others black.

    The target candidate is the same either way, so the difference to all black is that view's alone.
    """
    black = replace(gathered, colours=torch.zeros_like(gathered.colours))
    nothing = own(evidence, black, direction)
    result = []
    for i in range(gathered.valid.shape[1]):
        painted = black.colours.clone()
        painted[:, i] = 1
        result.append((own(evidence, replace(black, colours=painted), direction) - nothing)[..., 0])
    return torch.stack(result, 1)


def test_the_colour_is_the_weighted_sum_of_the_candidates():
    own, (evidence, gathered, direction) = blend(), scene()
    target = own(evidence, None, direction)
    share = shares(own, evidence, gathered, direction)
    rest = 1 - share.sum(1)
    expected = (share[..., None] * gathered.colours).sum(1) + rest[..., None] * target
    torch.testing.assert_close(own(evidence, gathered, direction), expected)


def test_the_colour_is_a_convex_combination_and_every_candidate_takes_part():
    own, (evidence, gathered, direction) = blend(), scene()
    share = shares(own, evidence, gathered, direction)
    assert (share[gathered.valid] > 0).all()
    assert (share.sum(1) < 1).all(), "the target candidate has no share"
    candidates = torch.cat([gathered.colours, own(evidence, None, direction)[:, None]], 1)
    visible = torch.cat([gathered.valid, torch.ones(T, 1, P, dtype=torch.bool)], 1)[..., None]
    colour = own(evidence, gathered, direction)
    assert (colour <= candidates.masked_fill(~visible, -torch.inf).amax(1) + 1e-12).all()
    assert (colour >= candidates.masked_fill(~visible, torch.inf).amin(1) - 1e-12).all()


def test_shares_are_a_softmax_so_two_views_keep_their_ratio_when_a_third_is_hidden():
    own, (evidence, gathered, direction) = blend(), scene()
    before = shares(own, evidence, gathered, direction)[:, :, 0]
    fewer = gathered.valid.clone()
    fewer[:, 1, 0] = False
    after = shares(own, evidence, replace(gathered, valid=fewer), direction)[:, :, 0]
    torch.testing.assert_close(after[:, 0] / after[:, 2], before[:, 0] / before[:, 2])
    assert (after[:, 1] == 0).all()
    torch.testing.assert_close(
        after.sum(1), before.sum(1), msg="the target's share depends on how many views there are"
    )


def test_two_views_in_the_same_place_that_say_the_same_have_the_same_share():
    own, (evidence, gathered, direction) = blend(), scene()
    twins = torch.tensor([0, 0, 2])
    evidence = replace(evidence, per_view=evidence.per_view[:, twins], view_weight=evidence.view_weight[:, twins])
    gathered = Gathered(**{k: v[:, twins] for k, v in vars(gathered).items()})
    share = shares(own, evidence, gathered, direction)
    torch.testing.assert_close(share[:, 0], share[:, 1])


def test_invalid_views_have_no_share():
    own, (evidence, gathered, direction) = blend(), scene()
    before = own(evidence, gathered, direction)
    other = gathered.colours.masked_fill(~gathered.valid[..., None], 1e3)
    torch.testing.assert_close(own(evidence, replace(gathered, colours=other), direction), before)


def test_a_sample_that_no_view_sees_takes_the_targets_colour():
    own, (evidence, gathered, direction) = blend(), scene()
    unseen = ~gathered.valid.any(1)
    assert unseen.any()
    target = own(evidence, None, direction)
    torch.testing.assert_close(own(evidence, gathered, direction)[unseen], target[unseen])


def test_without_neighbours_the_colour_is_the_expansion_around_the_mean():
    evidence, _, direction = scene()
    turned = direction.flip(-1)
    constant, varied = blend(0), blend(3)
    torch.testing.assert_close(constant(evidence, None, direction), constant(evidence, None, turned))
    assert (varied(evidence, None, direction) - varied(evidence, None, turned)).abs().min() > 1e-6
    lighter = replace(evidence, mean_colour=evidence.mean_colour + 0.25)
    torch.testing.assert_close(varied(lighter, None, direction), varied(evidence, None, direction) + 0.25)


def test_the_order_of_the_views_does_not_matter():
    own, (evidence, gathered, direction) = blend(), scene()
    order = torch.tensor([2, 0, 1])
    permuted = replace(evidence, per_view=evidence.per_view[:, order], view_weight=evidence.view_weight[:, order])
    views = Gathered(**{k: v[:, order] for k, v in vars(gathered).items()})
    torch.testing.assert_close(own(permuted, views, direction), own(evidence, gathered, direction))


@pytest.mark.parametrize("seen", [True, False])
def test_gradients_are_right_whether_or_not_a_view_sees_the_sample(seen: bool):
    own, (evidence, gathered, direction) = blend(), scene()
    gathered = replace(gathered, valid=torch.full_like(gathered.valid, seen))

    def colour(density: Tensor, per_view: Tensor, trust: Tensor, colours: Tensor) -> Tensor:
        changed = replace(evidence, density=density, per_view=per_view, view_weight=trust)
        return own(changed, replace(gathered, colours=colours), direction)

    inputs = (evidence.density, evidence.per_view, evidence.view_weight, gathered.colours)
    assert torch.autograd.gradcheck(colour, tuple(t.requires_grad_() for t in inputs))


def test_views_straight_behind_the_target_stay_finite():
    own, (evidence, gathered, direction) = blend(), scene()
    same = direction[:, None].expand_as(gathered.directions)
    straight = replace(gathered, directions=same, cosine=torch.full_like(gathered.cosine, 1 + 1e-7))
    assert own(evidence, straight, direction).isfinite().all()


def test_alone_the_neighbours_share_everything_that_one_of_them_sees():
    own, (evidence, gathered, direction) = randomise(ColourBlend(H, 3, alone=True).double()), scene()
    share, seen = shares(own, evidence, gathered, direction).sum(1), gathered.valid.any(1)
    torch.testing.assert_close(share[seen], torch.ones_like(share[seen]))
    assert (share[~seen] == 0).all()
    own(evidence, gathered, direction).sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in own.parameters())
