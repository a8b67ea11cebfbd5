"""What the choice of outlines adds to the sums in them."""

import numpy as np
import pytest

from tidefield.change import choice
from tidefield.change.choice import Choice, repeat_choice
from tidefield.change.outlines import Outlines
from tidefield.change.variogram import Variogram

NOISE = Variogram((0.5,), (3.0,))
SIDE = 64


def heaps_and_pits(pits: int) -> tuple[np.ndarray, Outlines]:
    """dz of eight tiles in a row, the last four with a heap each and the first ones with a larger pit each."""
    dz = (0.03 * choice.simulate_noise((SIDE, 8 * SIDE), NOISE, 1.0, np.random.default_rng(1))).astype(np.float32)
    labels, boxes, signs = np.zeros(dz.shape, np.int32), [], []
    for tile in range(8):
        sign, half = (1, 8) if tile >= 4 else (-1, 20)
        if sign > 0 or tile < pits:
            box = (slice(32 - half, 32 + half), slice(SIDE * tile + 32 - half, SIDE * tile + 32 + half))
            boxes.append(box)
            signs.append(sign)
            labels[box] = len(boxes)
            dz[box] += np.float32(0.08 * sign)
    return dz, Outlines(labels, np.array(signs, np.int8), boxes, (5, 11, 21), 6, 3.0)


def choices(pits: int) -> tuple[Choice, Choice]:
    dz, outlines = heaps_and_pits(pits)
    return repeat_choice(dz, 0.03, 0.002, NOISE, 1.0, outlines)


def test_the_choice_of_fill_in_a_large_survey_does_not_depend_on_erosion_elsewhere(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(choice, "_TILE", SIDE)
    higher = choices(4)[1]
    assert higher == choices(0)[1]
    assert higher.deviation > 0.03 * np.sqrt(4 * 256 / 2), "as of the heaps' own nugget at least"


def test_a_large_survey_is_looked_at_in_tiles_that_stand_for_the_rest(monkeypatch: pytest.MonkeyPatch):
    whole = choices(4)
    monkeypatch.setattr(choice, "_TILE", SIDE)
    monkeypatch.setattr(choice, "_MOST_TILES", 2)
    for of_tiles, of_all in zip(choices(4), whole, strict=True):
        assert of_tiles.deviation == pytest.approx(of_all.deviation, rel=0.6)
