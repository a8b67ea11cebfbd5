"""Which pairs are worth matching."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import torch
from located_surveys import unlocated_photograph
from torch import Tensor

from tidefield.survey.sfm.pairs import (
    BEST,
    FARTHEST_RAD,
    FEW,
    GLANCE,
    IN_SEQUENCE,
    MOST,
    NEARBY,
    RATIO,
    candidates,
    glances,
    matched,
    promising,
)
from tidefield.survey.survey import Photograph


def lawnmower(rows: int, columns: int) -> list[Photograph]:
    """Photographs 20 m apart along lines 30 m apart, flown back and forth."""
    made = []
    for row in range(rows):
        for column in range(columns) if row % 2 == 0 else reversed(range(columns)):
            made.append(unlocated_photograph(len(made), 54 + 30 * row / 111_000, 20 * column / 65_000))
    return made


def test_few_photographs_are_all_paired():
    assert candidates([unlocated_photograph(k, None) for k in range(FEW)]) == list(combinations(range(FEW), 2))


def test_with_positions_pairs_grow_with_the_photographs_not_with_their_square():
    small, large = lawnmower(8, 10), lawnmower(20, 100)
    assert len(candidates(large)) < 1.3 * len(candidates(small)) * len(large) / len(small)
    assert len(candidates(large)) <= len(large) * (NEARBY + IN_SEQUENCE)


def test_nearest_photographs_are_paired_and_far_ones_are_not():
    flight = lawnmower(20, 20)
    pairs = set(candidates(flight))
    position = np.array(
        [[p.position.latitude_deg * 111_000, p.position.longitude_deg * 65_000] for p in flight if p.position]
    )
    for i, j in combinations(range(len(flight)), 2):
        apart = np.linalg.norm(position[i] - position[j])
        if apart < 45:
            assert (i, j) in pairs
        if apart > 200 and j - i > IN_SEQUENCE:
            assert (i, j) not in pairs


def test_photographs_of_fields_far_apart_are_not_paired():
    here = lawnmower(4, 5)
    there = [
        replace(p, time_s=p.time_s + 1e6, position=replace(p.position, latitude_deg=55.0)) for p in here if p.position
    ]
    also = [
        replace(p, time_s=p.time_s + 2e6, position=replace(p.position, latitude_deg=56.0)) for p in here if p.position
    ]
    pairs = candidates([*here, *there, *also])
    assert not [pair for pair in pairs if pair[0] // 20 != pair[1] // 20]
    assert len([pair for pair in pairs if pair[1] < 20]) > 100


def test_a_photograph_without_position_is_paired_with_all():
    flight = lawnmower(10, 10)
    flight[37] = replace(flight[37], position=None)
    pairs = set(candidates(flight))
    assert all((min(37, k), max(37, k)) in pairs for k in range(100) if k != 37)


def test_photographs_taken_one_after_the_other_are_paired_wherever_they_claim_to_be():
    flight = lawnmower(10, 10)
    assert flight[50].position is not None
    flight[50] = replace(flight[50], position=replace(flight[50].position, latitude_deg=-10.0))
    pairs = set(candidates(flight))
    assert {(49, 50), (50, 51), (48, 50), (50, 52)} <= pairs


def test_flights_hours_apart_are_not_in_sequence():
    field = [unlocated_photograph(k, 54 + 20 * k / 111_000) for k in range(30)]
    later = [unlocated_photograph(30 + k, 54.5 + 20 * k / 111_000, time_s=3600.0 + k) for k in range(30)]
    assert not [pair for pair in candidates([*field, *later]) if pair[0] < 30 <= pair[1]]
    timeless = [replace(one, time_s=float("nan")) for one in (*field, *later)]
    assert {(28, 30), (29, 30), (29, 31)} <= set(candidates(timeless))


def test_pairs_whose_largest_features_match_are_promising_and_every_photograph_keeps_its_best():
    rng, count = np.random.default_rng(0), 40
    # Photograph k shares half of its features with k + 1.
    ground = rng.integers(0, 255, (count + 1, GLANCE // 2, 128))
    table = glances([np.concatenate([ground[k], ground[k + 1]]) for k in range(count)])
    kept = promising(list(combinations(range(count), 2)), table, lambda done, whole: None)
    assert {(k, k + 1) for k in range(count - 1)} <= set(kept)
    assert len(kept) <= count * MOST / 2
    partners = [sum(k in pair for pair in kept) for k in range(count)]
    assert min(partners) >= BEST


def test_photographs_with_few_features_are_filled_with_what_matches_nothing():
    table = glances([np.full((3, 128), 9), np.zeros((0, 128))])
    assert table.shape == (2, GLANCE, 128)
    assert table[0, :3].norm(dim=1).allclose(table.new_ones(3))
    assert (table[0, 3:] == 0).all()
    assert promising([(0, 1)], table, lambda done, whole: None) == [(0, 1)]


def unit(count: int, seed: int) -> Tensor:
    values = torch.rand(count, 128, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(values**4, dim=1)


def brute_force(ours: Tensor, theirs: Tensor) -> list[int]:
    angle = (ours @ theirs.T).clamp(-1, 1).acos()
    result = []
    for i, row in enumerate(angle):
        first, second = row.sort().values[:2].tolist()
        j = int(row.argmin())
        stands_out = first < RATIO * second and first < FARTHEST_RAD
        result.append(j if stands_out and int(angle[:, j].argmin()) == i else -1)
    return result


def test_matching_is_what_brute_force_finds():
    ours, strangers = unit(60, 0), unit(30, 1)
    noisy = torch.nn.functional.normalize(ours[10:50] + 0.03 * unit(40, 2), dim=1)
    theirs = torch.cat([strangers, noisy, ours[:1], ours[:1]])  # the last two are alike: nothing stands out
    found = matched(ours, theirs)
    assert found.tolist() == brute_force(ours, theirs)
    assert found[0] == -1
    assert (found[10:50] == torch.arange(30, 70)).float().mean() > 0.9


def test_batches_of_pairs_match_as_single_pairs_do():
    first, second = torch.stack([unit(20, 0), unit(20, 1)]), torch.stack([unit(25, 0), unit(25, 1)])
    together = matched(first, second)
    assert torch.equal(together, torch.stack([matched(a, b) for a, b in zip(first, second, strict=True)]))


def test_zeros_match_nothing():
    assert (matched(torch.zeros(4, 128), unit(6, 0)) == -1).all()
