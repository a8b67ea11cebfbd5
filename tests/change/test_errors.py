"""The error model against Anderson's printed figures, brute force over all pairs, and simulated fields."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import stdtrit

from tidefield.change.choice import _root_power, simulate_noise
from tidefield.change.errors import anderson_terms, degrees_of_freedom, region_error
from tidefield.change.outlines import window_z
from tidefield.change.registration import Registration, centre, covariance, offsets
from tidefield.change.statistics import deviation95, nmad, p_values
from tidefield.change.surfaces import Grid
from tidefield.change.variogram import UNCORRELATED, Variogram, _joined, _least_squares, fit_variogram
from tidefield.change.volumes import Volume

GRID = Grid(None, 100.0, 200.0, 0.5, 26, 20)


def test_andersons_terms_are_those_that_the_geological_survey_prints():
    """Whiskeytown: jlogan-usgs/whiskeytown-dem-differencing."""
    random, correlated, systematic = anderson_terms(
        682_640, 0.25, 0.11584754, 2.3546, math.sqrt(0.0071469), 0.104254974
    )
    assert 1.96 * random == pytest.approx(11.725, abs=5e-4)
    assert 1.96 * correlated == pytest.approx(63.664, abs=5e-3)
    assert systematic == pytest.approx(4448.04, abs=5e-3)


def correlated_field(rng: np.random.Generator, shape: tuple[int, int], radius: float) -> np.ndarray:
    """White noise smoothed over a disc, of unit variance: its correlation is nearly spherical with range 2 radius."""
    noise = rng.normal(size=shape)
    r, c = (np.fft.fftfreq(n, 1 / n) for n in shape)
    disc = (np.hypot(r[:, None], c[None]) <= radius).astype(float)
    field = np.fft.irfft2(np.fft.rfft2(noise) * np.fft.rfft2(disc), shape)
    return field / math.sqrt(disc.sum())


def test_the_variogram_of_a_simulated_field_is_found():
    rng = np.random.default_rng(0)
    field = 0.6 * rng.normal(size=(600, 700)) + 0.8 * correlated_field(rng, (600, 700), 10)
    found = fit_variogram((0.03 * field).astype(np.float32), 0.5)
    assert found.nugget == pytest.approx(0.36, abs=0.06)
    assert found.range_m == pytest.approx(10, rel=0.2)
    assert found.reached


@pytest.mark.parametrize("ranges", [(1.2,), (1.2, 9.0), (2.0, 3.1), (1.5, 25.0), (6.0, 14.0)])
def test_the_fit_finds_the_structures_that_semivariances_were_made_of(ranges: tuple[float, ...]):
    lags = np.geomspace(0.7, 20, 18)
    true = Variogram((0.5, 0.3)[: len(ranges)], ranges)
    gammas = 0.01 * (1 - true.correlation(lags))
    found, (nugget, *sills), left = _least_squares(lags, gammas, np.linspace(0.5, 1, 18), len(ranges))
    assert found == pytest.approx(ranges, rel=1e-3)
    assert [nugget, *sills] == pytest.approx([0.01 * true.nugget, *(0.01 * sill for sill in true.sills)], rel=1e-3)
    assert left < 1e-12


def test_white_noise_is_called_uncorrelated():
    noise = np.random.default_rng(1).normal(size=(300, 300)).astype(np.float32)
    assert fit_variogram(noise, 1.0).nugget > 0.97


def test_the_correlation_of_small_places_of_a_large_survey_is_found():
    rng = np.random.default_rng(0)
    residuals = np.full((3000, 3500), np.nan, np.float32)
    for row in (700, 1000, 2100):
        for column in (700, 1200, 2300, 2700):
            patch = correlated_field(rng, (200, 200), 4)[:60, :60]
            residuals[row : row + 60, column : column + 60] = 0.6 * rng.normal(size=patch.shape) + 0.8 * patch
    found = fit_variogram(residuals, 0.05)
    sill, reach = max(zip(found.sills, found.ranges_m, strict=True))
    assert sill == pytest.approx(0.64, abs=0.05)
    assert reach == pytest.approx(0.4, rel=0.1)
    assert sum(found.sills) - sill < 0.05


def test_outliers_do_not_hide_what_is_correlated_over_most_of_the_stable_ground():
    rng = np.random.default_rng(3)
    field = (rng.normal(size=(240, 240)) + 1.5 * correlated_field(rng, (480, 480), 60)[:240, :240]).astype(np.float32)
    field -= field.mean()
    spiked = field.copy()
    spiked[rng.random(field.shape) < 0.005] = 80.0
    clean, found = (fit_variogram(part, 0.5) for part in (field, spiked))
    far = [sum(s for s, reach in zip(v.sills, v.ranges_m, strict=True) if reach > 20) for v in (clean, found)]
    assert far[0] > 0.5
    assert far[1] == pytest.approx(far[0], rel=0.15)


def test_ground_that_is_too_small_to_show_a_correlation_says_so():
    residuals = np.full((3000, 3000), np.nan, np.float32)
    residuals[1000:3000:150, ::300] = np.random.default_rng(0).normal(size=(14, 10))
    found = fit_variogram(residuals, 0.05)
    assert (found.sills, found.reached) == ((), False)


@pytest.mark.parametrize("varying", [False, True])
def test_the_error_of_a_region_is_the_sum_over_all_pairs_of_its_cells(varying: bool):
    rng = np.random.default_rng(2)
    region = rng.random((20, 26)) < 0.6
    sigma = rng.uniform(0.5, 2, region.shape).astype(np.float32) if varying else np.full(region.shape, 1, np.float32)
    variogram = Variogram((0.5, 0.2), (6.0, 30.0))
    at = np.argwhere(region) * 0.5
    distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    s = sigma[region].astype(float)
    brute = math.sqrt((s[:, None] * s[None] * variogram.correlation(distance)).sum())
    found = region_error(sigma if varying else 1.0, region, variogram, 0.5)
    assert found.random == pytest.approx(math.sqrt(0.3 * (s**2).sum()), rel=1e-6)
    assert found.correlated == pytest.approx(brute, rel=1e-6)


def test_the_error_of_a_long_shore_is_as_large_for_each_cell_as_that_of_a_short_one():
    """Blocks of 59 rows: neither what few rows share nor that the shore is narrower than a block is lost."""
    variogram = Variogram((0.6, 0.2), (1.5, 20.0))
    short, long = (
        region_error(0.1, np.ones((n, 20), bool), variogram, 1.0).total / math.sqrt(n) for n in (2000, 30000)
    )
    assert long == pytest.approx(short, rel=0.01)
    lone = np.zeros((30_000, 600), bool)
    lone[::1000, ::300] = True
    assert region_error(0.1, lone, variogram, 1.0).correlated == pytest.approx(
        0.1 * math.sqrt(0.8 * lone.sum()), rel=0.01
    )


def test_the_error_of_a_region_that_is_reduced_to_blocks_is_andersons():
    region = np.ones((1400, 1500), bool)
    variogram = Variogram((0.7,), (4.0,))
    found = region_error(0.02, region, variogram, 0.25)
    random, correlated, _ = anderson_terms(
        int(region.sum()), 0.25, 0.02 * math.sqrt(0.3), 4.0, 0.02 * math.sqrt(0.7), 0.0
    )
    assert found.random * 0.25**2 == pytest.approx(random, rel=1e-6)
    # 0.79 is sqrt(pi / 5); and at the border a cell has fewer neighbours.
    assert found.correlated * 0.25**2 == pytest.approx(correlated, rel=0.02)


@pytest.mark.parametrize(
    "reach", [pytest.param(2.0, marks=pytest.mark.thorough), 6.0, pytest.param(20.0, marks=pytest.mark.thorough)]
)
def test_roads_and_roofs_of_a_large_survey_are_no_scattered_ground(reach: float):
    """Two roads one cell wide, and patches of 8 x 8, whose blocks of 8 x 8 are reduced to one number each."""
    n, variogram = 4096, Variogram((0.9,), (reach,))
    grid, roads, roofs = Grid(None, 0.0, float(n), 1.0, n, n), np.zeros((n, n), bool), np.zeros((n, n), bool)
    roads[:, n // 2] = roads[n // 2] = True
    h = np.arange(1, n)
    pairs = 2 * (n + 2 * float(((n - h) * variogram.correlation(h.astype(float))).sum()))
    for row in range(8):
        for column in range(8):
            roofs[5 + row :: 256, 5 + column :: 256] = True
    at = np.indices((8, 8)).reshape(2, -1)
    distance = np.hypot(*(at[:, :, None] - at[:, None]))
    of_roof = float((variogram.correlation(distance) + variogram.nugget * (distance == 0)).sum())
    for stable, whole in ((roads, pairs), (roofs, of_roof * (n // 256) ** 2)):
        shift = math.sqrt(covariance("vertical", stable, 0.03, variogram, grid, 0.0, None)[0, 0])
        assert shift * stable.sum() == pytest.approx(0.03 * math.sqrt(whole), rel=0.1)
        assert region_error(0.03, stable, variogram, 1.0).total == pytest.approx(0.03 * math.sqrt(whole), rel=0.1)


def test_nothing_summed_has_no_error():
    assert region_error(1.0, np.zeros((4, 4), bool), UNCORRELATED, 1.0).total == 0


def test_intervals_are_wider_where_the_errors_were_measured_on_few_pieces_of_ground():
    """Of 25 parts of the variance, 16 were measured: Satterthwaite's degrees of freedom are 4 (25 / 16)^2."""
    volume = Volume(10.0, 3.0, 4.0, 0.0, 1.0, degrees_of_freedom=4.0)
    assert volume.factor == pytest.approx(stdtrit(4 * (25 / 16) ** 2, 0.975))
    assert volume.factor > 2.2
    assert volume.interval_m3 == pytest.approx((10 - 5 * volume.factor, 10 + 5 * volume.factor))
    assert replace(volume, degrees_of_freedom=math.inf).factor == pytest.approx(1.959963984540054)
    assert replace(volume, correlated_m3=0.0).factor == pytest.approx(1.959963984540054)


def test_what_the_user_stated_of_the_errors_is_not_widened_for_little_stable_ground():
    volume = Volume(10.0, 0.0, 3.0, 4.0, 1.0, degrees_of_freedom=1.0, datum_m3=4.0)
    assert volume.factor == pytest.approx(stdtrit((25 / 9) ** 2, 0.975))
    assert replace(volume, correlated_m3=0.0).factor == pytest.approx(1.959963984540054)


def test_the_choice_of_outlines_adds_what_the_cells_own_errors_do_not_explain():
    volume = Volume(10.0, 3.0, 4.0, 0.0, 1.0)
    larger, smaller = volume.chosen(2.0, 13.0), volume.chosen(-2.0, 1.0)
    assert (larger.value_m3, larger.choice_m3, larger.sigma_m3) == pytest.approx((8, 12, 13))
    assert (smaller.value_m3, smaller.choice_m3, smaller.sigma_m3) == pytest.approx((12, 0, 5))


def test_scattered_stable_ground_does_not_make_neighbours_independent():
    """Points 20 m apart show nothing of what is shared by less, which volumes must not average out."""
    residuals = np.full((400, 400), np.nan, np.float32)
    residuals[10::20, 10::20] = np.random.default_rng(1).normal(0, 0.1, (20, 20))
    scattered = fit_variogram(residuals, 1.0)
    assert scattered.nugget == pytest.approx(0, abs=1e-9)
    assert scattered.ranges_m[0] == pytest.approx(20, rel=0.1)
    assert scattered.assumed_m == pytest.approx(20, rel=0.1)
    region = np.ones((60, 60), bool)
    whole = np.random.default_rng(1).normal(0, 0.1, (200, 200)).astype(np.float32)
    error = region_error(0.1, region, scattered, 1.0).total
    assert error > 5 * region_error(0.1, region, fit_variogram(whole, 1.0), 1.0).total
    freedom = degrees_of_freedom(scattered, np.isfinite(residuals), 1.0)
    assert freedom == pytest.approx(399, rel=0.1), "points 20 m apart are independent of each other"
    assert Volume(0.0, 0.0, 1.0, 0.0, 1.0, degrees_of_freedom=freedom).factor == pytest.approx(1.966, abs=0.002)


def test_a_row_of_stable_cells_shows_what_neighbours_share():
    """150 cells have 149 pairs of neighbours, fewer than a bin needs on more ground."""
    rng = np.random.default_rng(0)
    residuals = np.full((150, 60), np.nan, np.float32)
    residuals[:, 30] = rng.normal(0, 0.1, 150)
    road = fit_variogram(residuals, 1.0)
    assert (road.nugget > 0.8, road.assumed_m) == (True, 0.0)
    smooth = np.convolve(rng.normal(size=169), np.ones(20), "valid") / math.sqrt(20)
    residuals[:, 30] = 0.1 * smooth
    road = fit_variogram(residuals, 1.0)
    assert (road.nugget < 0.1, road.assumed_m) == (True, 0.0)


def test_nothing_is_assumed_of_neighbours_where_scattered_ground_shows_no_nugget():
    field = correlated_field(np.random.default_rng(2), (400, 400), 15).astype(np.float32)
    residuals = np.full((400, 400), np.nan, np.float32)
    residuals[2::5, 2::5] = field[2::5, 2::5]
    found = fit_variogram(residuals, 1.0)
    assert (len(found.sills), found.assumed_m) == (1, 0.0)
    assert found.range_m == pytest.approx(30, rel=0.2)


def test_structures_of_one_range_are_one():
    assert _joined((0.2, 0.3, 0.1), (30.0, 5.0, 5.01)) == (pytest.approx((0.4, 0.2)), (5.0, 30.0))


def test_degrees_of_freedom_are_the_independent_samples_among_stable_cells_less_one():
    """N^2 over the sum of all pairs' correlation; of two ranges, Satterthwaite's sum of sill r^2."""
    stable = np.random.default_rng(3).random((30, 40)) < 0.3
    at = np.argwhere(stable) * 0.5
    distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    short, long = (len(at) ** 2 / Variogram((1.0,), (reach,)).correlation(distance).sum() - 1 for reach in (4.0, 10.0))
    assert degrees_of_freedom(Variogram((0.5,), (10.0,)), stable, 0.5) == pytest.approx(long, rel=0.01)
    both = degrees_of_freedom(Variogram((0.6, 0.2), (4.0, 10.0)), stable, 0.5)
    assert both == pytest.approx((9.6 + 20) ** 2 / (9.6**2 / short + 20**2 / long), rel=0.01)
    assert degrees_of_freedom(Variogram((0.5,), (1000.0,)), stable, 0.5) == 1
    lone = np.zeros((1100, 1100), bool)
    lone[::100, ::100] = True
    assert degrees_of_freedom(Variogram((0.5,), (4.0,)), lone, 1.0) == 120
    shore = np.ones((36_000, 50), bool)
    assert degrees_of_freedom(Variogram((0.5,), (1.0,)), shore, 1.0) == pytest.approx(shore.sum() - 1)


def test_degrees_of_freedom_of_an_area_are_the_independent_pieces_of_it_less_one():
    """Of a range r, a piece has the area pi r^2 / 5; of two ranges, Satterthwaite's sum of sill r^2."""
    stable = np.ones((1100, 900), bool)
    long, short = (5 * 990_000 / (math.pi * reach**2) - 1 for reach in (20.0, 4.0))
    assert degrees_of_freedom(Variogram((0.5,), (20.0,)), stable, 1.0) == pytest.approx(long, rel=0.05)
    both = degrees_of_freedom(Variogram((0.6, 0.2), (4.0, 20.0)), stable, 1.0)
    assert both == pytest.approx((9.6 + 80) ** 2 / (9.6**2 / short + 80**2 / long), rel=0.05)


def test_the_covariance_of_a_registration_is_the_sum_over_all_pairs_of_stable_cells():
    rng = np.random.default_rng(2)
    stable = rng.random(GRID.shape) < 0.6
    stable[:8, :10] = False
    variogram = Variogram((0.5, 0.2), (6.0, 30.0))
    sigma = rng.uniform(0.5, 2, GRID.shape).astype(np.float32)
    x, y = offsets(GRID, centre(GRID), slice(0, GRID.rows))
    rows, columns = np.nonzero(stable)
    design = np.stack([np.ones(len(rows)), x[columns], y[rows]], axis=1)
    distance = np.hypot(x[columns][:, None] - x[columns], y[rows][:, None] - y[rows])
    own = sigma[stable].astype(float)
    pairs = own[:, None] * own * (variogram.correlation(distance) + variogram.nugget * (distance == 0))
    inverse = np.linalg.inv(design.T @ design)
    brute = inverse @ design.T @ pairs @ design @ inverse
    found = covariance("tilt", stable, sigma, variogram, GRID, 0.0, None)
    assert (np.abs(found - brute) < 0.02 * np.sqrt(np.outer(brute.diagonal(), brute.diagonal()))).all()
    shift = covariance("vertical", stable, sigma, variogram, GRID, 0.0, None)
    assert shift[0, 0] == pytest.approx(pairs.sum() / len(rows) ** 2, rel=0.01)
    with_datum = covariance("vertical", stable, sigma, variogram, GRID, 0.0, 0.3)
    assert with_datum[0, 0] - shift[0, 0] == pytest.approx(0.09)


def test_deviations_of_a_registration_are_those_of_its_whole_covariance():
    rng, none = np.random.default_rng(2), (0.0, 0.0, 0.0)
    region, factor = rng.random(GRID.shape) < 0.6, rng.normal(size=(3, 3))
    whole = factor @ factor.T
    own = Registration("tilt", none, whole, centre(GRID), 100, none, none)
    x, y = offsets(GRID, own.centre_m, slice(0, GRID.rows))
    design = np.stack(np.broadcast_arrays(np.ones(GRID.shape), x[None], y[:, None]), axis=-1)
    each = np.sqrt(np.einsum("rci,ij,rcj->rc", design, whole, design))
    np.testing.assert_allclose(own.deviation(GRID, slice(0, GRID.rows)), each, rtol=1e-4)
    summed = design[region].sum(0)
    assert own.deviation_of_sum(GRID, region) == pytest.approx(math.sqrt(summed @ whole @ summed))
    box = (slice(5, 15), slice(3, 20))
    summed = design[box][region[box]].sum(0)
    assert own.deviation_of_sum(GRID, region[box], box) == pytest.approx(math.sqrt(summed @ whole @ summed))


def test_simulated_noise_has_its_variogram():
    field = simulate_noise((300, 300), Variogram((0.6,), (5.0,)), 1.0, np.random.default_rng(0)).astype(float)
    assert field.var() == pytest.approx(1, rel=0.05)
    spherical = 1 - 1.5 * (2 / 5) + 0.5 * (2 / 5) ** 3
    assert (field[:, 2:] * field[:, :-2]).mean() == pytest.approx(0.6 * spherical, rel=0.15)
    assert (field[2:] * field[:-2]).mean() == pytest.approx(0.6 * spherical, rel=0.15)


def test_the_spectrum_of_simulated_noise_is_computed_once():
    _root_power.cache_clear()
    random = np.random.default_rng(0)
    first, second = (simulate_noise((40, 30), Variogram((0.6,), (5.0,)), 1.0, random) for _ in range(2))
    assert (first != second).all()
    assert _root_power.cache_info()[:2] == (1, 1)


def test_a_window_averages_the_cells_own_errors_and_not_the_systematic_one():
    change = np.full((40, 40), 0.1, np.float32)
    found = window_z(change, 0.01, 0.05, UNCORRELATED, 1.0, 5)
    assert found[20, 20] == pytest.approx(0.1 / math.sqrt(0.01**2 / 25 + 0.05**2), rel=1e-4)


def test_deviations_of_normal_values_are_their_standard_deviation():
    values = np.random.default_rng(3).normal(0, 0.04, 200_000)
    assert nmad(values) == pytest.approx(0.04, rel=0.01)
    assert deviation95(values) == pytest.approx(0.04, rel=0.01)


def test_p_values_are_two_sided():
    assert p_values(np.array([0, 1.959964, -1.959964], np.float32)) == pytest.approx([1, 0.05, 0.05], rel=1e-5)
