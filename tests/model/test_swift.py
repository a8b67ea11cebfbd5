"""Scores of samples in `swift`: what is expected of them, and how well the views agree."""

import math

import pytest
import torch
from torch import Tensor

from tidefield.config import SWIFT
from tidefield.model.aggregate import Evidence
from tidefield.model.sampling import Intervals, Samples
from tidefield.model.swift import COLOUR_NOISE, LOWEST_PRIOR, Pass


def tensor(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def first_pass() -> Pass:
    return Pass(SWIFT.network, SWIFT.network.passes[0], first=True).double()


def inputs_of(layer: torch.nn.Module) -> list[Tensor]:
    """What a layer is given, once it has been called."""
    found: list[Tensor] = []
    layer.register_forward_pre_hook(lambda _, given: found.append(given[0]))
    return found


def test_the_prior_is_a_parabola_around_where_the_surface_is_expected_and_its_features_are_bells():
    """Two rays of four samples. On inverse depths from 1 to 0.5, 0.8 lies at s = 0.4; of the second, nothing is known.

    The samples lie 1.2 and 0.4 of their distances before it, and 0.4 and 1.2 behind it.
    """
    own = first_pass()
    priors, agreements = inputs_of(own.prior_features), inputs_of(own.agreement_features)
    place = tensor([[0.1, 0.3, 0.5, 0.7]] * 2)
    points = torch.zeros(1, 8, 3).double()
    samples = Samples(place, torch.zeros_like(place), points, points, torch.zeros_like(place))
    intervals = Intervals(tensor([1.0, 1.0]), tensor([0.5, 0.5]), tensor([0.8, math.nan]))
    degrees, agreement = tensor([[0.0, 1.0, 2.0, 3.0]] * 2), tensor([[-6.0, 0.0, 2.0, 8.0]] * 2)
    hidden = torch.zeros(1, 2, 4, own.prior_features.out_features).double()
    with_prior, score = own._prior(hidden, samples, intervals, degrees, agreement)
    offset, views = tensor(-1.2, -0.4, 0.4, 1.2), degrees[0, 0]
    bells = torch.exp(-((offset / 2) ** 2)), torch.exp(-((offset / 8) ** 2))
    torch.testing.assert_close(priors[0][0, 0], torch.stack([offset / 4, *bells], dim=-1))
    agreeing = torch.stack([torch.tanh(agreement[0, 0] / 4), torch.log1p(views)], dim=-1)
    torch.testing.assert_close(agreements[0][0, 0], agreeing)
    parabola = 2 - (0.3 + 10 * torch.exp(-views)) * offset.square()
    assert parabola.min() < LOWEST_PRIOR
    torch.testing.assert_close(score[0, 0], parabola.clamp(min=LOWEST_PRIOR), atol=1e-5, rtol=0)
    assert (score[0, 1] == 2).all()
    torch.testing.assert_close(with_prior[0, 1], own.agreement_features(agreeing))
    torch.testing.assert_close(with_prior[0, 0], own.agreement_features(agreeing) + own.prior_features(priors[0][0, 0]))


def test_agreement_is_the_likelihood_ratio_of_the_views_variance_at_a_sample_and_on_its_ray(
    monkeypatch: pytest.MonkeyPatch,
):
    own = first_pass()
    variance, degrees = tensor([0.01, 0.04, 0.02, 0.5]), tensor([[1.0, 2.0, 0.0, 1.0]])
    monkeypatch.setattr(own.aggregate, "disagreement", lambda evidence: variance)
    unused = torch.zeros(1, 4, 1).double()
    evidence = Evidence(unused, unused[:, None], unused.mT, unused.mT, unused, torch.ones(1, 4).bool())
    logarithm = torch.log(variance[0] + COLOUR_NOISE)
    usual = (logarithm[0] + 2 * logarithm[1] + logarithm[3]) / 4
    found = own._agreement_score(evidence, degrees)[0, 0]
    torch.testing.assert_close(found, 3 * degrees[0, 0] * (usual - logarithm))
    assert found[2] == 0, "a single view says nothing"
