"""Standard errors and smoothing of surfaces whose shapes are known."""

from __future__ import annotations

import numpy as np

from tidefield.maps.surface import SHARE_MATCHING, SHARE_SLOPE, _smoothed, standard_error

SIDE = 60


def test_slopes_add_to_the_error_of_matching_and_rims_their_height():
    x = np.broadcast_to(np.arange(SIDE, dtype=np.float32), (SIDE, SIDE))
    matching = np.full((SIDE, SIDE), 0.01, np.float32)
    middle = slice(20, 40), slice(20, 40)
    level = standard_error(np.zeros_like(matching), matching, 0.1)
    np.testing.assert_allclose(level[middle], SHARE_MATCHING * 0.01, rtol=1e-3)
    slope = standard_error(np.ascontiguousarray(0.02 * x), matching, 0.1)  # a fifth
    np.testing.assert_allclose(slope[middle], np.hypot(SHARE_MATCHING, SHARE_SLOPE * 0.2) * 0.01, rtol=0.05)
    crown = standard_error((x >= 30).astype(np.float32), matching, 0.1)
    assert (crown[middle][:, 9:11] > 0.5).all()  # a rim of 1 m, a cell to either side
    np.testing.assert_allclose(crown[20:40, 5:15], level[20:40, 5:15], rtol=0.05)


def test_noise_is_taken_off_slopes_and_rims_stay():
    random = np.random.default_rng(2)
    y, x = np.mgrid[:80, :120].astype(np.float32)
    slope, rim = 0.25 * x, np.where((x > 60) & (y > 40), 8.0, 0.0)
    noise = 0.25 * random.standard_normal(x.shape)
    error = np.full(x.shape, 0.25, np.float32)
    made = _smoothed((slope + noise).astype(np.float32), error, 1.0) - slope
    inner = np.s_[8:-8, 8:-8]
    assert made[inner].std() < 0.2 * noise[inner].std()
    high = _smoothed((rim + noise).astype(np.float32), error, 1.0)
    assert np.abs(high[45:, 56:60]).max() < 1.0
    assert np.abs(high[45:, 61:65] - 8).max() < 1.0
    assert (high - rim)[48:-8, 50:-8].std() < 0.8 * noise.std()
    bends = np.sin(x / 8)
    kept = _smoothed(bends.astype(np.float32), error, 1.0)
    assert np.abs(kept - bends)[inner].max() < 0.05
