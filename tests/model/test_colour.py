import math
from dataclasses import replace

import pytest
import torch
from random_weights import randomise
from torch import Tensor
from torch.nn import functional as F

from tidefield.model.aggregate import Evidence
from tidefield.model.colour import AngularColourBlend, ColourBlend
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
    weight = valid / valid.sum(1, keepdim=True).clamp(min=1)
    evidence = Evidence(
        draw(T, P, H), draw(T, N, P, H), draw(T, N, P) * valid, weight.double(), draw(T, P, 4), valid.any(1)
    )
    there = torch.ones(T, N, P).double()
    return evidence, Gathered(draw(T, N, P, 3), draw(T, N, P, 4), theirs, cosine, valid, there, 0 * there), direction


BLENDS = [ColourBlend, AngularColourBlend]


def target_of(own: ColourBlend, evidence: Evidence, direction: Tensor, origin: Tensor | float = 0.5) -> Tensor:
    """The target candidate's colour."""
    return own.target_colour(evidence, direction, origin)[1]


def blend(degree: int = 3, kind: type[ColourBlend] = ColourBlend) -> ColourBlend:
    return randomise(kind(H, degree).double())


def shares(own: ColourBlend, evidence: Evidence, gathered: Gathered, direction: Tensor) -> Tensor:
    """What each view contributes, T N P: read off by painting one view white and the others black.

    In the printed blend the target candidate is the same either way, so the difference to all black is that view's
    alone; in that of `swift` it is an addition to the blended views.
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
    target = target_of(own, evidence, direction)
    share = shares(own, evidence, gathered, direction)
    rest = 1 - share.sum(1)
    expected = (share[..., None] * gathered.colours).sum(1) + rest[..., None] * target
    torch.testing.assert_close(own(evidence, gathered, direction), expected)


def test_the_colour_is_a_convex_combination_and_every_candidate_takes_part():
    own, (evidence, gathered, direction) = blend(), scene()
    share = shares(own, evidence, gathered, direction)
    assert (share[gathered.valid] > 0).all()
    assert (share.sum(1) < 1).all(), "the target candidate has no share"
    candidates = torch.cat([gathered.colours, target_of(own, evidence, direction)[:, None]], 1)
    visible = torch.cat([gathered.valid, torch.ones(T, 1, P, dtype=torch.bool)], 1)[..., None]
    colour = own(evidence, gathered, direction)
    assert (colour <= candidates.masked_fill(~visible, -torch.inf).amax(1) + 1e-12).all()
    assert (colour >= candidates.masked_fill(~visible, torch.inf).amin(1) - 1e-12).all()


@pytest.mark.parametrize("kind", BLENDS)
def test_shares_are_a_softmax_so_two_views_keep_their_ratio_when_a_third_is_hidden(kind: type[ColourBlend]):
    own, (evidence, gathered, direction) = blend(3, kind), scene()
    before = shares(own, evidence, gathered, direction)[:, :, 0]
    fewer = gathered.valid.clone()
    fewer[:, 1, 0] = False
    after = shares(own, evidence, replace(gathered, valid=fewer), direction)[:, :, 0]
    torch.testing.assert_close(after[:, 0] / after[:, 2], before[:, 0] / before[:, 2])
    assert (after[:, 1] == 0).all()


@pytest.mark.parametrize("kind", BLENDS)
def test_two_views_in_the_same_place_that_say_the_same_have_the_same_share(kind: type[ColourBlend]):
    own, (evidence, gathered, direction) = blend(3, kind), scene()
    twins = torch.tensor([0, 0, 2])
    evidence = replace(evidence, per_view=evidence.per_view[:, twins], view_weight=evidence.view_weight[:, twins])
    gathered = Gathered(**{k: v[:, twins] for k, v in vars(gathered).items()})
    share = shares(own, evidence, gathered, direction)
    torch.testing.assert_close(share[:, 0], share[:, 1])


@pytest.mark.parametrize("kind", BLENDS)
def test_invalid_views_have_no_share(kind: type[ColourBlend]):
    own, (evidence, gathered, direction) = blend(3, kind), scene()
    before = own(evidence, gathered, direction)
    other = gathered.colours.masked_fill(~gathered.valid[..., None], 1e3)
    torch.testing.assert_close(own(evidence, replace(gathered, colours=other), direction), before)


def test_a_sample_that_no_view_sees_takes_the_targets_colour():
    own, (evidence, gathered, direction) = blend(), scene()
    unseen = ~gathered.valid.any(1)
    assert unseen.any()
    target = target_of(own, evidence, direction)
    torch.testing.assert_close(own(evidence, gathered, direction)[unseen], target[unseen])


def test_the_target_is_an_expansion_around_grey():
    evidence, _, direction = scene()
    turned = direction.flip(-1)
    constant, varied = blend(0), blend(3)
    torch.testing.assert_close(target_of(constant, evidence, direction), target_of(constant, evidence, turned))
    assert (target_of(varied, evidence, direction) - target_of(varied, evidence, turned)).abs().min() > 1e-6
    for parameter in varied.target.parameters():
        torch.nn.init.zeros_(parameter)
    torch.testing.assert_close(target_of(varied, evidence, direction), torch.full((T, P, 3), 0.5).double())


def test_in_swift_the_harmonics_are_added_to_the_blended_views_with_the_targets_share():
    own, (evidence, gathered, direction) = blend(3, AngularColourBlend), scene()
    share, seen = shares(own, evidence, gathered, direction), gathered.valid.any(1)
    torch.testing.assert_close(share.sum(1)[seen], torch.ones(int(seen.sum())).double())
    blended = (share[..., None] * gathered.colours).sum(1)
    added = torch.sigmoid(own.target(evidence.density)[..., 0])[..., None] * target_of(own, evidence, direction, 0.0)
    torch.testing.assert_close(own(evidence, gathered, direction)[seen], (blended + added)[seen])
    unseen = target_of(own, evidence, direction, 0.5)[~seen]
    torch.testing.assert_close(own(evidence, gathered, direction)[~seen], unseen)


def test_in_swift_a_view_that_is_blurred_there_has_another_share():
    own, (evidence, gathered, direction) = blend(3, AngularColourBlend), scene()
    sharp = shares(own, evidence, gathered, direction)[:, :, 0]
    blurred = gathered.octaves_coarser.clone()
    blurred[:, 1, 0] = 2.0
    after = shares(own, evidence, replace(gathered, octaves_coarser=blurred), direction)[:, :, 0]
    assert ((after - sharp)[:, 1].abs() > 1e-3).all()


def test_the_printed_blend_is_eq_7_of_the_inputs_that_the_paper_names():
    """[F_N,i, d - d_i, d.d_i, w_n,i] through two layers, for one sample and view at a time."""
    own, (evidence, gathered, direction) = blend(3, ColourBlend), scene()
    colour = own(evidence, gathered, direction)
    target, logit = target_of(own, evidence, direction), own.target(evidence.density)[..., 0]
    for t, p in [(0, 0), (0, 1), (1, 0), (1, 2), (1, 4)]:
        total, mixed = torch.exp(logit[t, p]), torch.exp(logit[t, p]) * target[t, p]
        for i in range(N):
            if gathered.valid[t, i, p]:
                offset = 5 * (direction[t, p] - gathered.directions[t, i, p])
                numbers = torch.stack([*offset, -20 * (1 - gathered.cosine[t, i, p]), evidence.view_weight[t, i, p]])
                hidden = F.relu(own.view(evidence.per_view[t, i, p]) + own.direction.weight @ numbers)
                share = torch.exp(own.logit(hidden)[0])
                total, mixed = total + share, mixed + share * gathered.colours[t, i, p]
        torch.testing.assert_close(colour[t, p], mixed / total)


def test_swifts_blend_has_a_logarithm_of_the_angle_the_blur_and_the_fading_of_views_besides():
    """Shares exp(layers + angle * closeness) * blend_weight of one sample and view at a time, without a target's."""
    own, (evidence, gathered, direction) = blend(3, AngularColourBlend), scene()
    generator = torch.Generator().manual_seed(3)
    blur, fading = torch.rand(2, T, N, P, generator=generator, dtype=torch.float64)
    gathered = replace(gathered, octaves_coarser=blur - 0.5, blend_weight=0.1 + fading)
    colour, logit = own(evidence, gathered, direction), own.target(evidence.density)[..., 0]
    target = target_of(own, evidence, direction, 0.0)
    for t, p in [(0, 0), (0, 1), (1, 0), (1, 4)]:
        total, mixed = torch.zeros(1).double(), torch.zeros(3).double()
        for i in range(N):
            if gathered.valid[t, i, p]:
                apart = 1 - gathered.cosine[t, i, p]
                closeness = -torch.log(apart.clamp(min=0) + 1e-4)
                offset = 5 * (direction[t, p] - gathered.directions[t, i, p])
                angles = torch.stack([*offset, -20 * apart, evidence.view_weight[t, i, p], closeness / 4])
                numbers = torch.cat([angles, gathered.octaves_coarser[t, i, p][None]])
                hidden = F.relu(own.view(evidence.per_view[t, i, p]) + own.direction.weight @ numbers)
                share = torch.exp(own.logit(hidden)[0] + own.angle * closeness) * gathered.blend_weight[t, i, p]
                total, mixed = total + share, mixed + share * gathered.colours[t, i, p]
        torch.testing.assert_close(colour[t, p], mixed / total + torch.sigmoid(logit[t, p]) * target[t, p])


def test_in_swift_the_targets_share_starts_at_twelve_per_cent():
    own, (evidence, _, direction) = AngularColourBlend(H, 3).double(), scene()
    logit = own.target_colour(evidence, direction, 0.0)[0]
    torch.testing.assert_close(torch.sigmoid(logit), torch.full_like(logit, 1 / (1 + math.exp(2))))


@pytest.mark.parametrize("kind", BLENDS)
def test_the_order_of_the_views_does_not_matter(kind: type[ColourBlend]):
    own, (evidence, gathered, direction) = blend(3, kind), scene()
    order = torch.tensor([2, 0, 1])
    permuted = replace(evidence, per_view=evidence.per_view[:, order], view_weight=evidence.view_weight[:, order])
    views = Gathered(**{k: v[:, order] for k, v in vars(gathered).items()})
    torch.testing.assert_close(own(permuted, views, direction), own(evidence, gathered, direction))


@pytest.mark.thorough
@pytest.mark.parametrize("kind", BLENDS)
@pytest.mark.parametrize("seen", [True, False])
def test_gradients_are_right_whether_or_not_a_view_sees_the_sample(seen: bool, kind: type[ColourBlend]):
    own, (evidence, gathered, direction) = blend(3, kind), scene()
    gathered = replace(gathered, valid=torch.full_like(gathered.valid, seen))

    def colour(density: Tensor, per_view: Tensor, trust: Tensor, colours: Tensor) -> Tensor:
        changed = replace(evidence, density=density, per_view=per_view, view_weight=trust)
        return own(changed, replace(gathered, colours=colours), direction)

    inputs = (evidence.density, evidence.per_view, evidence.view_weight, gathered.colours)
    assert torch.autograd.gradcheck(colour, tuple(t.requires_grad_() for t in inputs))


@pytest.mark.parametrize("kind", BLENDS)
def test_views_straight_behind_the_target_stay_finite(kind: type[ColourBlend]):
    own, (evidence, gathered, direction) = blend(3, kind), scene()
    same = direction[:, None].expand_as(gathered.directions)
    straight = replace(gathered, directions=same, cosine=torch.full_like(gathered.cosine, 1 + 1e-7))
    assert own(evidence, straight, direction).isfinite().all()


@pytest.mark.parametrize("kind", BLENDS)
def test_without_a_target_the_neighbours_share_everything_and_what_none_sees_is_grey(kind: type[ColourBlend]):
    own, (evidence, gathered, direction) = randomise(kind(H, 3, neighbours_only=True).double()), scene()
    share, seen = shares(own, evidence, gathered, direction), gathered.valid.any(1)
    torch.testing.assert_close(share.sum(1)[seen], torch.ones(int(seen.sum())).double())
    blended = (share[..., None] * gathered.colours).sum(1)
    torch.testing.assert_close(own(evidence, gathered, direction)[seen], blended[seen])
    assert (own(evidence, gathered, direction)[~seen] == 0.5).all()
    own(evidence, gathered, direction).sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in own.parameters())
