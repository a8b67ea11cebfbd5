"""Plants gained and lost, on pictures and on a built-in flat whose plants are known."""

import cv2
import numpy as np
import pytest
import shapely

from tidefield.change.cover import compare_cover
from tidefield.change.light import light_gains, with_light
from tidefield.change.regions import Region
from tidefield.change.surfaces import Grid

MUD, PLANTS = np.array([125, 112, 92]), np.array([95, 110, 60])
GRID = Grid(None, 0.0, 30.0, 0.1, 400, 300)


def picture(
    rng: np.random.Generator,
    covered: np.ndarray,
    light: tuple[float, ...] = (1, 1, 1),
    rough: np.ndarray | None = None,
) -> np.ndarray:
    """Mud and plants; rough is where leaves, or stones, shade each other, by default where plants are."""
    colour = np.where(covered[..., None], PLANTS, MUD) * np.array(light)
    shade = 1 + 0.15 * np.sin(np.arange(400) / 40)[None, :, None]
    leaves = cv2.resize(rng.normal(0, 0.3, (150, 200)).astype(np.float32), (400, 300))
    shade = shade * (1 + np.where(covered if rough is None else rough, leaves, 0))[..., None]
    return (colour * shade + rng.normal(0, 5, (300, 400, 3))).clip(0, 255).astype(np.uint8)


def disc(east: float, north: float, radius: float) -> np.ndarray:
    x, y = (np.arange(400) + 0.5) * 0.1, 30 - (np.arange(300) + 0.5) * 0.1
    return np.hypot(x[None] - east, y[:, None] - north) < radius


def test_the_light_of_two_dates_is_evened_by_what_did_not_change():
    rng = np.random.default_rng(0)
    one = picture(rng, disc(10, 10, 3))
    two = picture(rng, disc(10, 10, 9), (0.7, 0.9, 1.2))
    gains = light_gains(one, two, np.ones(one.shape[:2], bool))
    assert gains == pytest.approx([1 / 0.7, 1 / 0.9, 1 / 1.2], rel=0.03)
    bare = ~disc(10, 10, 9.5)
    assert np.abs(with_light(two, gains)[bare].mean(0) - one[bare].mean(0)).max() < 2


def test_cover_that_was_gained_and_lost_is_found_under_another_light():
    rng = np.random.default_rng(1)
    before, after = disc(10, 20, 4) | disc(30, 10, 5), disc(10, 20, 7) | disc(30, 10, 3)
    found = compare_cover(
        picture(rng, before),
        picture(rng, after, (1.3, 1.1, 0.8)),
        np.ones((300, 400), bool),
        GRID,
        [Region("west", shapely.box(0, 0, 20, 30))],
    )
    gained, lost = np.pi * (49 - 16), np.pi * (25 - 9)
    every, west = found.areas["all"], found.areas["west"]
    assert every["gained"].value_m2 == pytest.approx(gained, rel=0.12)
    assert every["lost"].value_m2 == pytest.approx(lost, rel=0.12)
    assert every["gained"].low_m2 <= every["gained"].value_m2 <= every["gained"].high_m2
    assert west["gained"].value_m2 == pytest.approx(every["gained"].value_m2, rel=0.01)
    assert west["lost"].value_m2 == 0
    assert (found.classes[disc(10, 20, 3)] == 2).mean() > 0.95
    assert (found.classes[disc(10, 20, 6) & ~disc(10, 20, 5)] == 1).mean() > 0.95


def test_the_same_ground_in_another_light_gains_nothing():
    rng = np.random.default_rng(2)
    both = disc(20, 15, 6)
    found = compare_cover(
        picture(rng, both), picture(rng, both, (1.25, 1, 0.8)), np.ones((300, 400), bool), GRID
    ).areas["all"]
    assert found["gained"].value_m2 + found["lost"].value_m2 < 0.02 * found["earlier"].value_m2


def test_a_meadow_without_bare_ground_is_covered_at_both_dates():
    rng = np.random.default_rng(4)
    every = np.ones((300, 400), bool)
    lush = np.array([0.9, 1.1, 0.8])[None, None] ** disc(20, 15, 8)[..., None]
    one, two = (
        (picture(rng, every, light) * lush).clip(0, 255).astype(np.uint8) for light in ((1, 1, 1), (0.8, 0.75, 0.9))
    )
    found = compare_cover(one, two, every, GRID)
    areas = found.areas["all"]
    assert areas["earlier"].value_m2 == areas["later"].value_m2 == pytest.approx(1200)
    assert areas["gained"].high_m2 == areas["lost"].high_m2 == 0
    assert found.gains == pytest.approx((1 / 0.8, 1 / 0.75, 1 / 0.9), rel=0.02)


def test_a_green_film_is_no_plant_and_grass_beside_gravel_is_one():
    rng = np.random.default_rng(5)
    film, grass = disc(10, 15, 5), disc(30, 15, 5)
    for rough in (grass, ~film):
        shown = picture(rng, film | grass, rough=rough)
        classes = compare_cover(shown, shown, np.ones((300, 400), bool), GRID).classes
        assert (classes[disc(10, 15, 4)] == 0).all()
        assert (classes[disc(30, 15, 4)] == 2).all()


def test_ground_that_only_one_picture_shows_is_unknown():
    rng = np.random.default_rng(3)
    known = np.ones((300, 400), bool)
    known[:, :100] = False
    found = compare_cover(picture(rng, disc(5, 5, 3)), picture(rng, disc(30, 5, 3)), known, GRID)
    assert (found.classes[:, :100] == -128).all()
    assert found.known_m2 == pytest.approx(900.0)
    assert found.areas["all"]["lost"].value_m2 == 0


def test_the_marsh_of_a_built_in_flat_spreads_as_much_as_its_pictures_say():
    from tidefield.synthetic.grids import Extent
    from tidefield.synthetic.two_dates import Difference, make_pair

    pair = make_pair("vegetation", 8, Difference(), views=2, width=32)
    extent = Extent.around([-20.0, -15.0], [20.0, 15.0], 0.15)
    shape = (extent.rows, extent.columns)
    shown, marsh = [], []
    for survey, density in zip((pair.earlier, pair.later), pair.plants, strict=True):
        shown.append((survey.flat.map(extent)[0].numpy() * 255).astype(np.uint8))
        marsh.append(density.sample(extent.nodes())[0].reshape(shape).numpy()[::-1] > 0.25)
    grid = Grid(None, extent.west_m, extent.north_m, extent.cell_m, *shape[::-1])
    found = compare_cover(shown[0], shown[1], np.ones(shape, bool), grid)
    true = (marsh[1] & ~marsh[0]).sum() * grid.cell_area_m2
    assert true > 50
    assert found.areas["all"]["gained"].value_m2 == pytest.approx(true, rel=0.3)
