import math

import pytest
import torch
from random_weights import randomise
from torch import Tensor

from tidefield.model.ray_transformer import RayTransformer, attend, attend_short, positional_encoding

R, M, H = 5, 8, 12


def rays() -> tuple[Tensor, Tensor, Tensor]:
    """Features, places and validity; the last ray has no valid sample."""
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(R, M, H, generator=generator, dtype=torch.float64)
    place = torch.rand(R, M, generator=generator, dtype=torch.float64).sort(-1).values
    valid = torch.rand(R, M, generator=generator) < 0.6
    valid[:, 0], valid[-1] = True, False
    return features, place, valid


def transformer() -> RayTransformer:
    return randomise(RayTransformer(H, 4).double())


def test_the_encoding_is_sines_and_cosines_of_octaves():
    code = positional_encoding(torch.tensor([0.0, 0.3, 1.0]))
    for row, place in zip(code, (0.0, 0.3, 1.0), strict=True):
        waves = [math.pi * 2**k * place for k in range(4)]
        expected = [math.sin(w) for w in waves] + [math.cos(w) for w in waves]
        assert row.tolist() == pytest.approx(expected, abs=1e-5)


def test_the_encoding_tells_any_two_places_apart():
    place = torch.linspace(0, 1, 65)
    assert torch.pdist(positional_encoding(place)).min() > 0.05


def test_what_invalid_samples_hold_changes_no_valid_output():
    own = transformer()
    features, place, valid = rays()
    before = own(features, place, valid)
    after = own(torch.where(valid[..., None], features, 1e3), torch.where(valid, place, 0.5), valid)
    torch.testing.assert_close(before[valid], after[valid])


def test_what_valid_samples_hold_changes_the_others():
    own = transformer()
    features, place, valid = rays()
    before = own(features, place, valid)
    # Not by a constant, which the layer norm before the attention takes away.
    features[:, 0] = features[:, 0].flip(-1)
    assert ((own(features, place, valid) - before)[:-1, 1:].abs().amax((1, 2)) > 1e-3).all()


def test_rays_do_not_know_of_each_other():
    own, order = transformer(), torch.tensor([3, 1, 4, 0, 2])
    before, after = own(*rays()), own(*(t[order] for t in rays()))
    torch.testing.assert_close(before[order], after)
    torch.testing.assert_close(before[2:3], own(*(t[2:3] for t in rays())))


def test_the_same_places_give_the_same_outputs_among_any_number_of_samples():
    """Three samples that nothing is known of are put between the others: their indices change, their places do not."""
    own = transformer()
    features, place, valid = rays()
    kept = torch.tensor([0, 1, 3, 4, 5, 7, 9, 10])
    longer = torch.randn(R, 11, H, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    places, known = torch.full((R, 11), 0.5, dtype=torch.float64), torch.zeros(R, 11, dtype=torch.bool)
    longer[:, kept], places[:, kept], known[:, kept] = features, place, valid
    some = valid.any(-1)
    torch.testing.assert_close(own(longer, places, known)[some][:, kept], own(features, place, valid)[some])


def test_the_order_in_which_samples_are_given_does_not_matter_only_their_places_do():
    own, order = transformer(), torch.tensor([7, 2, 0, 5, 1, 3, 6, 4])
    features, place, valid = rays()
    torch.testing.assert_close(
        own(features[:, order], place[:, order], valid[:, order]), own(features, place, valid)[:, order]
    )
    moved = own(features, place + 0.2, valid)
    assert (moved - own(features, place, valid)).abs().max() > 1e-3


def test_a_ray_that_nothing_is_known_of_stays_finite_in_value_and_gradient():
    own = transformer()
    features, place, valid = rays()
    result = own(features.requires_grad_(), place, valid)
    result.square().sum().backward()
    assert result.isfinite().all()
    assert features.grad is not None
    assert features.grad.isfinite().all()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in own.parameters())


def test_few_samples_attend_to_each_other_as_many_do():
    random = torch.Generator().manual_seed(5)
    qkv = torch.randn(40, 6, 3, 2, 4, generator=random, dtype=torch.float64)
    keys = torch.rand(40, 6, generator=random) < 0.6
    keys |= ~keys.any(-1, keepdim=True)
    whole, few = qkv.clone().requires_grad_(), qkv.clone().requires_grad_()
    expected, found = attend(whole, keys), attend_short(few, keys)
    torch.testing.assert_close(found, expected)
    for result in (expected, found):
        result.square().sum().backward()
    torch.testing.assert_close(few.grad, whole.grad)
