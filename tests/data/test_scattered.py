"""Interpolation between scattered points, compared with scipy's."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from tidefield.data import surface
from tidefield.data.surface import interpolate_on_pixels
from tidefield.geometry.cameras import pixel_grid


def around(width: int, height: int) -> np.ndarray:
    """Corners that hold the image."""
    return np.array([[-0.3, -0.3], [1.3, -0.3], [-0.3, 1.3], [1.3, 1.3]]) * [width, height]


@pytest.mark.parametrize("count", [0, 1, 5, 300, 20_000])
def test_equal_to_scipy(count: int) -> None:
    random = np.random.default_rng(count)
    width, height = 60, 40
    uv = np.concatenate([around(width, height), random.uniform(-0.2, 1.2, (count, 2)) * [width, height]])
    values = random.normal(size=len(uv))
    expected = LinearNDInterpolator(uv, values)(pixel_grid(width, height).double().numpy()).reshape(height, width)
    np.testing.assert_allclose(interpolate_on_pixels(uv, values, width, height), expected, atol=1e-6)


def test_points_and_edges_on_the_centres_of_pixels() -> None:
    width, height = 12, 9
    u, v = np.meshgrid(np.arange(-1.5, 14, 1.0), np.arange(-1.5, 12, 1.0))
    uv = np.column_stack([u.ravel(), v.ravel()])
    random = np.random.default_rng(0)
    for kept in (np.ones(len(uv), bool), (u.ravel() + 2 * v.ravel()) % 3 == 0.5, random.random(len(uv)) < 0.4):
        some = np.concatenate([around(width, height), uv[kept]])
        values = random.normal(size=len(some))
        found = interpolate_on_pixels(some, values, width, height)
        on = {tuple(at): value for at, value in zip(some, values, strict=True)}
        inside = [at for at in on if 0 < at[0] < width and 0 < at[1] < height]
        assert inside
        for at in inside:
            assert found[int(at[1]), int(at[0])] == pytest.approx(on[at], abs=1e-9)
        low, high = found.min(), found.max()
        assert values.min() - 1e-9 <= low <= high <= values.max() + 1e-9


def test_a_tall_grid_takes_little_more_memory_than_its_values(monkeypatch: pytest.MonkeyPatch):
    random, width, height = np.random.default_rng(0), 60, 2000
    corners = [[-1, -1], [-1, height + 1], [width + 1, -1], [width + 1, height + 1]]
    uv = np.concatenate([random.uniform(0, 1, (500, 2)) * [width, height], corners])
    values, found = random.normal(size=len(uv)), []
    for at_once in (10**6, 6000):
        monkeypatch.setattr(surface, "PIXELS_AT_ONCE", at_once)
        tracemalloc.start()
        found.append(interpolate_on_pixels(uv, values, width, height))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 20 * width * height
    np.testing.assert_array_equal(*found)
