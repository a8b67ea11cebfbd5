"""Standard errors of surfaces whose shapes are known."""

from __future__ import annotations

import numpy as np

from tidefield.maps.surface import SHARE_MATCHING, standard_error

SIDE = 60


def test_slopes_add_little_to_the_error_and_rims_their_height():
    x = np.broadcast_to(np.arange(SIDE, dtype=np.float32), (SIDE, SIDE))
    matching = np.full((SIDE, SIDE), 0.01, np.float32)
    middle = slice(20, 40), slice(20, 40)
    level = standard_error(np.zeros_like(matching), matching)
    np.testing.assert_allclose(level[middle], SHARE_MATCHING * 0.01, rtol=1e-3)
    slope = standard_error(np.ascontiguousarray(0.02 * x), matching)
    np.testing.assert_allclose(slope[middle], level[middle], rtol=0.05)
    crown = standard_error((x >= 30).astype(np.float32), matching)
    assert (crown[middle][:, 9:11] > 0.5).all()  # a rim of 1 m, a cell to either side
    np.testing.assert_allclose(crown[20:40, 5:15], level[20:40, 5:15], rtol=0.05)
