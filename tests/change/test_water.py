"""The waterline and areas under levels on a plane whose every contour is known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from surveys_of_two_dates import NORTH, WEST, noise, write_surface

from tidefield.change.measure import Change, Options, measure
from tidefield.change.page import water_words
from tidefield.change.regions import Region
from tidefield.change.surfaces import open_surface
from tidefield.change.water import measure_water

SLOPE = 0.02
SHAPE, CELL = (160, 400), 0.5


def surveyed(folder: Path, levels: tuple[float, float], lift: float = 0.0, seed: int = 0) -> Change:
    """A plane that rises to the east, under water to a level at each date; stable ground is the high east."""
    rng = np.random.default_rng(seed)
    ground = np.broadcast_to(SLOPE * CELL * (np.arange(SHAPE[1]) + 0.5), SHAPE)
    paths = []
    for k, level in enumerate(levels):
        heights = np.maximum(ground, level) + noise(rng, SHAPE, 0.012, 0.008, 4)
        if k:
            heights[:, :300] += lift
        paths.append(write_surface(folder / f"{k}.tif", heights.astype(np.float32)))
    east = Region("east", shapely.box(WEST + 150, NORTH - 80, WEST + 200, NORTH))
    one, two = (open_surface(path) for path in paths)
    return measure(one, two, Options(windows=(5,)), stable=lambda grid: [east])


@pytest.fixture(scope="module")
def dry(tmp_path_factory: pytest.TempPathFactory) -> Change:
    return surveyed(tmp_path_factory.mktemp("dry"), (0.0, 0.0))


def test_the_waterline_moves_as_far_as_the_tide_fell_over_the_slope(tmp_path: Path):
    levels = (1.5, 1.3)
    line = measure_water(surveyed(tmp_path, levels), levels, ()).waterline
    assert line is not None
    move, low, high = line.move_m
    # Waterlines wind with the errors of heights, which makes them longer and the mean move shorter.
    assert move == pytest.approx(0.2 / SLOPE, rel=0.1)
    assert low < 0.2 / SLOPE < high
    assert line.quantiles_m[1] == pytest.approx(0.2 / SLOPE, abs=0.7)
    assert line.land_lost.value_m2 < 0.05 * line.land_gained.value_m2
    assert line.land_gained.low_m2 < 80 * 0.2 / SLOPE < line.land_gained.high_m2
    assert shapely.union_all(line.lines[0]).length == pytest.approx(80, rel=0.2)


def test_where_the_ground_sank_the_waterline_comes_landward(tmp_path: Path):
    line = measure_water(surveyed(tmp_path, (1.5, 1.5), lift=-0.1), (1.5, 1.4), ()).waterline
    assert line is not None
    # The water was lowered with the ground: the line is where it was.
    assert abs(line.move_m[0]) < 0.5
    line = measure_water(surveyed(tmp_path, (0.0, 0.0), lift=-0.1), (1.5, 1.5), ()).waterline
    assert line is not None
    assert line.move_m[0] == pytest.approx(-0.1 / SLOPE, abs=0.5)
    assert line.quantiles_m[1] == pytest.approx(-0.1 / SLOPE, abs=0.7)


@pytest.mark.thorough
def test_areas_under_levels_have_intervals_that_contain_the_truth(tmp_path: Path):
    inside = 0
    for seed in range(6):
        found = measure_water(surveyed(tmp_path, (0.0, 0.0), lift=0.1, seed=seed), None, (1.0, 2.0))
        assert found.waterline is None
        for below, level in zip(found.below, (1.0, 2.0), strict=True):
            assert below.earlier_m2 == pytest.approx(level / SLOPE * 80, rel=0.02)
            inside += below.low_m2 < -0.1 / SLOPE * 80 < below.high_m2
            assert below.later_m2 - below.earlier_m2 == pytest.approx(below.change_m2)
    assert inside >= 10


def test_levels_are_in_the_unit_of_the_surveys_heights(dry: Change):
    foot = 0.3048
    metres = measure_water(dry, (1.5, 1.4), (1.0,))
    feet = measure_water(
        replace(dry, earlier=replace(dry.earlier, metres=foot, scale=1 / foot)),
        (1.5 / foot, 1.4 / foot),
        (1 / foot,),
    )
    assert metres.waterline is not None
    assert feet.waterline is not None
    assert feet.waterline.levels_m == pytest.approx((1.5, 1.4))
    assert feet.waterline.land_gained.value_m2 == pytest.approx(metres.waterline.land_gained.value_m2, rel=0.01)
    assert feet.below[0].earlier_m2 == pytest.approx(metres.below[0].earlier_m2, rel=0.01)


def test_dry_ground_has_no_waterline(dry: Change):
    found = measure_water(dry, (-3.0, -3.0), (-3.0,))
    line = found.waterline
    assert line is not None
    assert line.lines == ([], [])
    assert json.loads(json.dumps(found.to_json(), allow_nan=False))["waterline"]["move_m"] is None
    assert np.isnan(line.move_m).all()


def test_a_waterline_at_one_date_only_has_not_moved_by_any_length(dry: Change):
    line = measure_water(dry, (1.5, -3.0), ()).waterline
    assert line is not None
    assert line.lines[0]
    assert not line.lines[1]
    assert np.isnan([*line.move_m, *line.quantiles_m]).all()
    assert line.land_gained.value_m2 == pytest.approx(75 * 80, rel=0.03)
    [words] = water_words(replace(measure_water(dry, (1.5, -3.0), ()), waterline=line))
    assert "no waterline" in words
    assert "fell dry, 0.00 m² (0.00 to 0.00) came under water" in words
