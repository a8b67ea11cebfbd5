"""Where the maps of a page lie."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from markupsafe import Markup
from matplotlib.figure import Figure
from surveys_of_two_dates import NORTH, WEST, pair, write_surface

from tidefield.change import figures
from tidefield.change.cover import compare_cover
from tidefield.change.measure import Change, measure
from tidefield.change.page import sentences
from tidefield.change.surfaces import Grid, open_surface
from tidefield.change.volumes import Volume


@pytest.fixture(scope="module")
def change(tmp_path_factory: pytest.TempPathFactory) -> Change:
    return measure(*(open_surface(path) for path in pair(tmp_path_factory.mktemp("pair"), 0, 0.1)[:2]))


def middle(grid: Grid, row: int, column: int) -> tuple[float, float]:
    return grid.west_m + (column + 0.5) * grid.cell_m, grid.north_m - (row + 0.5) * grid.cell_m


@pytest.mark.parametrize("side", [100, 1400])
def test_cells_of_a_page_lie_where_those_of_the_survey_do(change: Change, monkeypatch: pytest.MonkeyPatch, side: int):
    monkeypatch.setattr(figures, "_SIDE", side)
    small = figures.thinned(change)
    step = 3 if side == 100 else 1
    assert small.grid.shape == small.dz.shape == small.heights.shape == (-(-200 // step), -(-240 // step))
    for row, column in ((0, 0), (20, 56)):
        place = middle(change.grid, step * row, step * column)
        assert middle(small.grid, row, column) == pytest.approx(place, rel=0, abs=1e-6)
        with change.earlier.on_grid(change.grid) as read:
            assert small.heights[row, column] == read(step * row, step * row + 1)[0, step * column]


def test_what_takes_long_is_named_before_it_is_done(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    rng = np.random.default_rng(0)
    paths = [write_surface(tmp_path / f"{k}.tif", rng.normal(0, 0.02, (30, 40)).astype(np.float32)) for k in (0, 1)]
    with caplog.at_level("INFO", "tidefield"):
        measure(*map(open_surface, paths))
    for step in ("comparing 30 x 40 cells of 0.5 m", "finding stable ground", "outlining change"):
        assert step in caplog.text


def test_a_narrow_strip_keeps_two_rows_to_be_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(figures, "_SIDE", 40)
    rng = np.random.default_rng(0)
    paths = [write_surface(tmp_path / f"{k}.tif", rng.normal(0, 0.02, (8, 400)).astype(np.float32)) for k in (0, 1)]
    small = figures.thinned(measure(*(open_surface(path) for path in paths)))
    assert small.grid.shape == (2, 100)
    assert "<img" in figures.draw_stable(small, "stable ground")


@pytest.mark.parametrize(
    ("value_m3", "sigma_m3", "words"),
    [
        (-100.0, 10.0, "the ground lost 100 m³ (95%: 80.4 to 120 m³) in all on 400 m²."),
        (100.0, 10.0, "the ground gained 100 m³ (95%: 80.4 to 120 m³) in all on 400 m²."),
        (-100.0, 100.0, "the ground changed by \u2212100 m³ (95%: \u2212296 to 96.0 m³) in all on 400 m², which"),
    ],
)
def test_a_volume_in_words_has_the_sign_of_its_interval(value_m3: float, sigma_m3: float, words: str, change: Change):
    net = Volume(value_m3, sigma_m3, 0.0, 0.0, 400.0)
    assert words in sentences(replace(change, net=net))[0]


def test_names_of_surveys_are_no_formulas(change: Change):
    one, other = (replace(survey, source="a$\\x$.tif") for survey in (change.earlier, change.later))
    assert "<img" in figures.draw_section(replace(change, earlier=one, later=other), 60, "a section")


def test_plants_of_a_page_lie_where_they_were_found(change: Change, monkeypatch: pytest.MonkeyPatch):
    drawn: list[Figure] = []
    monkeypatch.setattr(figures, "_SIDE", 100)
    monkeypatch.setattr(figures, "png", lambda figure, _: drawn.append(figure) or Markup(""))
    picture = np.full((300, 400, 3), 120, np.uint8)
    fine = Grid(change.grid.crs, WEST, NORTH, 0.1, 400, 300)
    cover = compare_cover(picture, picture, np.ones(fine.shape, bool), fine)
    figures.draw_cover(cover, figures.thinned(change), "plants")
    [*_, image] = drawn[0].axes[0].images
    west, east, south, north = image.get_extent()
    assert image.get_array().shape == (75, 100)
    # Every fourth cell, each in the middle of one that is four times as large.
    place = WEST - 0.15, WEST + 39.85, NORTH - 29.85, NORTH + 0.15
    assert (west, east, south, north) == pytest.approx(place, rel=0, abs=1e-6)
