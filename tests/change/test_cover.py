"""Plants gained and lost, on pictures and on a built-in flat whose plants are known."""

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from markupsafe import Markup
from pyproj import CRS
from surveys_of_two_dates import NORTH, WEST, write_surface

from tidefield.change import figures
from tidefield.change.cover import compare_cover, measure_cover
from tidefield.change.light import light_gains, with_light
from tidefield.change.measure import measure
from tidefield.change.page import write_page
from tidefield.change.regions import Region
from tidefield.change.surfaces import ChangeError, Grid, open_surface
from tidefield.change.write import summary

MUD, PLANTS = np.array([125, 112, 92]), np.array([95, 110, 60])
GRID = Grid(None, 0.0, 30.0, 0.1, 400, 300)


def picture(
    rng: np.random.Generator,
    covered: np.ndarray,
    light: tuple[float, ...] = (1, 1, 1),
    rough: np.ndarray | None = None,
    shown: np.ndarray | None = None,
) -> np.ndarray:
    """Mud and plants; rough is where leaves, or stones, shade each other, by default where plants are.

    Args:
        shown: how much of the plants' colour there is; by default all of it where they are.
    """
    colour = (MUD + (covered if shown is None else shown)[..., None] * (PLANTS - MUD)) * np.array(light)
    shade = 1 + 0.15 * np.sin(np.arange(400) / 40)[None, :, None]
    leaves = cv2.resize(rng.normal(0, 0.3, (150, 200)).astype(np.float32), (400, 300))
    shade = shade * (1 + np.where(covered if rough is None else rough, leaves, 0))[..., None]
    return (colour * shade + rng.normal(0, 5, (300, 400, 3))).clip(0, 255).astype(np.uint8)


def disc(east: float, north: float, radius: float) -> np.ndarray:
    x, y = (np.arange(400) + 0.5) * 0.1, 30 - (np.arange(300) + 0.5) * 0.1
    return np.hypot(x[None] - east, y[:, None] - north) < radius


def test_polygons_do_not_take_memory_all_at_once():
    rng, small = np.random.default_rng(0), Grid(None, 0.0, 60.0, 0.2, 300, 300)
    shown, known, peaks = rng.integers(80, 140, (300, 300, 3)).astype(np.uint8), np.ones((300, 300), bool), []
    for count in (1, 100):
        regions = [Region(str(k), shapely.box(k % 50, 10, k % 50 + 5, 20)) for k in range(count)]
        tracemalloc.start()
        compare_cover(shown, shown, known, small, regions)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


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


def test_patches_are_as_large_as_their_plants_and_small_gaps_are_of_them():
    rng = np.random.default_rng(1)
    crowns = np.any([disc(east, north, 1.5) for east in (5, 20, 35) for north in (5, 15, 25)], axis=0)
    x, y = (np.arange(400) + 0.5) * 0.1, 30 - (np.arange(300) + 0.5) * 0.1
    near, far = (
        ((x % apart < 0.4)[None] & (y % apart < 0.4)[:, None] & disc(east, 10, 6))
        for apart, east in ((0.9, 10), (2.5, 30))
    )
    found = []
    for true in (crowns, near, far):
        shown = picture(rng, true)
        found.append(compare_cover(shown, shown, np.ones((300, 400), bool), GRID).areas["all"]["earlier"].value_m2)
    assert found == pytest.approx([9 * np.pi * 1.5**2, np.pi * 6**2, far.sum() * 0.01], rel=0.25, abs=2)


def test_a_gain_ranges_from_what_every_margin_finds_to_what_any_does():
    """Pale plants come up in the west, which the highest margin misses; those in the east, which only the lowest finds
    before, turn green."""
    rng = np.random.default_rng(1)
    west, east = disc(10, 15, 6), disc(30, 15, 6)
    both = west | east
    one, two = (
        picture(rng, both, shown=(before * west + after * east)) for before, after in ((0.0, 0.165), (0.25, 1.0))
    )
    gained = compare_cover(one, two, np.ones((300, 400), bool), GRID).areas["all"]["gained"]
    assert gained.value_m2 == pytest.approx(2 * np.pi * 36, rel=0.1)
    assert gained.low_m2 < 20 < gained.value_m2 <= gained.high_m2


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
    assert areas["gained"].value_m2 == areas["lost"].value_m2 == 0
    assert max(areas["gained"].high_m2, areas["lost"].high_m2) < 0.02 * 1200
    assert found.gains == pytest.approx((1 / 0.8, 1 / 0.75, 1 / 0.9), rel=0.02)


def test_a_green_film_is_no_plant_and_grass_beside_gravel_is_one():
    rng = np.random.default_rng(5)
    film, grass = disc(10, 15, 5), disc(30, 15, 5)
    for rough in (grass, ~film):
        shown = picture(rng, film | grass, rough=rough)
        classes = compare_cover(shown, shown, np.ones((300, 400), bool), GRID).classes
        assert (classes[disc(10, 15, 4)] == 0).all()
        assert (classes[disc(30, 15, 4)] == 2).all()


def test_the_range_has_plants_that_touch_a_larger_film():
    rng = np.random.default_rng(5)
    every = np.ones((300, 400), bool)
    film, plants = disc(12, 15, 8), disc(22, 15, 3)
    shown = picture(rng, film | plants, rough=plants & ~film)
    area = compare_cover(shown, shown, every, GRID).areas["all"]["earlier"]
    assert area.value_m2 == area.low_m2 == 0
    assert (plants & ~film).sum() * 0.01 < area.high_m2 < (plants | film).sum() * 0.01
    # The plants stay while a film grows up to them.
    film, plants = disc(12, 15, 9.5), disc(24, 15, 3)
    one, two = picture(rng, plants, rough=plants), picture(rng, plants | film, rough=plants)
    areas = compare_cover(one, two, every, GRID).areas["all"]
    assert areas["lost"].low_m2 == 0
    assert areas["later"].low_m2 < np.pi * 9 < areas["later"].high_m2


def test_the_range_leaves_out_what_is_smooth_in_a_patch_of_plants():
    rng = np.random.default_rng(5)
    film, plants = disc(30, 15, 7), disc(15, 15, 10)
    shown = picture(rng, film | plants, rough=plants)
    area = compare_cover(shown, shown, np.ones((300, 400), bool), GRID).areas["all"]["earlier"]
    assert area.value_m2 > (film | plants).sum() * 0.01
    assert area.low_m2 < area.value_m2 - 0.5 * (film & ~plants).sum() * 0.01


def strip(rng: np.random.Generator, length_m: float, pixel_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture 20 m high of mud, 14 m wide films and plants in turns, and where these are."""
    east, north = (pixel_m * (np.arange(round(length / pixel_m)) + 0.5) for length in (length_m, 20.0))
    near = np.hypot((east % 40 - 20)[None], north[:, None] - 10) < 7
    film, plants = near & (east % 80 < 40), near & (east % 80 > 40)
    leaves = cv2.resize(rng.normal(0, 0.3, (100, round(length_m / 0.2))).astype(np.float32), near.shape[::-1])
    colour = np.where(near[..., None], PLANTS, MUD) * (1 + np.where(plants, leaves, 0))[..., None]
    shown = (colour + rng.normal(0, 3, (*near.shape, 3))).clip(0, 255).astype(np.uint8)
    return shown.transpose(2, 0, 1), film, plants


@pytest.mark.parametrize(("length_m", "pixel_m", "finds"), [(1040, 0.1, True), (80, 0.2002, True), (80, 0.4, False)])
def test_films_are_left_out_where_pixels_show_leaves_however_long_the_survey(
    tmp_path: Path, length_m: float, pixel_m: float, finds: bool
):
    rng = np.random.default_rng(0)
    shown, film, plants = strip(rng, length_m, pixel_m)
    path = write_surface(tmp_path / "a.tif", shown, pixel_m)
    grid = Grid(CRS("EPSG:32630").to_wkt(), WEST, NORTH, 1.0, int(length_m) - 1, 19)
    found = measure_cover(path, path, grid)
    assert found.leaves_out_films == found.to_json()["green_films_left_out"] == finds
    true = (plants.sum() + (0 if finds else film.sum())) * pixel_m**2
    assert found.areas["all"]["earlier"].value_m2 == pytest.approx(true, rel=0.2)


def test_the_page_states_whether_films_and_shallow_water_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(figures, "png", lambda *_: Markup("<img>"))
    rng = np.random.default_rng(0)
    paths = [write_surface(tmp_path / f"{k}.tif", rng.normal(0, 0.02, (60, 80)).astype(np.float32)) for k in (0, 1)]
    change = measure(open_surface(paths[0]), open_surface(paths[1]))
    shown = picture(rng, disc(30, 15, 5))
    for cell, finds in ((0.1, True), (0.4, False)):
        grid = Grid(change.grid.crs, WEST, NORTH, cell, 400, 300)
        cover = compare_cover(shown, shown, np.ones((300, 400), bool), grid)
        assert cover.leaves_out_films == finds
        write_page(change, summary(change, "tidefield change"), tmp_path / "change.html", cover)
        page = (tmp_path / "change.html").read_text()
        assert ("such as a film of algae or shallow water, is none of plants" in page) == finds
        assert ("Green water with waves counts as plants" in page) == finds
        assert ("Green films count as plants" in page) == (not finds)
        assert ("Shallow water, which is green, counts as plants" in page) == (not finds)


def test_ground_that_only_one_picture_shows_is_unknown():
    rng = np.random.default_rng(3)
    known = np.ones((300, 400), bool)
    known[:, :100] = False
    found = compare_cover(picture(rng, disc(5, 5, 3)), picture(rng, disc(30, 5, 3)), known, GRID)
    assert (found.classes[:, :100] == -128).all()
    assert found.known_m2 == pytest.approx(900.0)
    assert found.areas["all"]["lost"].value_m2 == 0


def test_orthophotos_of_another_place_are_refused(tmp_path: Path):
    colours = np.full((3, 60, 60), 120, np.uint8)
    here = write_surface(tmp_path / "here.tif", colours)
    there = write_surface(tmp_path / "there.tif", colours, west=WEST + 10_000)
    grid = Grid(CRS("EPSG:32630").to_wkt(), WEST, NORTH, 0.5, 60, 60)
    assert measure_cover(here, here, grid).known_m2 == pytest.approx(900)
    with pytest.raises(ChangeError, match=r"here\.tif and .*there\.tif show no ground in common"):
        measure_cover(here, there, grid)


@pytest.mark.thorough
def test_the_marsh_of_a_built_in_flat_spreads_as_much_as_its_pictures_say():
    from benchmarks.change_cover import covered
    from tidefield.synthetic.grids import Extent
    from tidefield.synthetic.two_dates import Difference, make_pair

    pair = make_pair("vegetation", 8, Difference(), views=2, width=32, supersample=1)
    extent = Extent.around([-20.0, -15.0], [20.0, 15.0], 0.15)
    shape = (extent.rows, extent.columns)
    shown, plants = [], []
    for survey in (pair.earlier, pair.later):
        colours, seen = survey.flat.map(extent)
        shown.append((colours.numpy() * 255).astype(np.uint8))
        plants.append(covered(survey.flat, seen.numpy(), extent))
    grid = Grid(None, extent.west_m, extent.north_m, extent.cell_m, *shape[::-1])
    found = compare_cover(shown[0], shown[1], np.ones(shape, bool), grid)
    true = (plants[1] & ~plants[0]).sum() * grid.cell_area_m2
    assert true > 50
    assert found.areas["all"]["gained"].value_m2 == pytest.approx(true, rel=0.3)
