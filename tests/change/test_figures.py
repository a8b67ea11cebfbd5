"""Where the maps of a page lie."""

from pathlib import Path

import numpy as np
import pytest
from markupsafe import Markup
from matplotlib.figure import Figure
from surveys_of_two_dates import NORTH, WEST, pair

from tidefield.change import figures
from tidefield.change.cover import compare_cover
from tidefield.change.measure import measure
from tidefield.change.surfaces import Grid, open_surface


def middle(grid: Grid, row: int, column: int) -> tuple[float, float]:
    return grid.west_m + (column + 0.5) * grid.cell_m, grid.north_m - (row + 0.5) * grid.cell_m


@pytest.mark.parametrize("side", [100, 1400])
def test_cells_of_a_page_lie_where_those_of_the_survey_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, side: int):
    monkeypatch.setattr(figures, "_SIDE", side)
    change = measure(*(open_surface(path) for path in pair(tmp_path, 0, 0.10)[:2]))
    small = figures.thinned(change)
    step = 3 if side == 100 else 1
    assert small.grid.shape == small.dz.shape == small.heights.shape == (-(-200 // step), -(-240 // step))
    for row, column in ((0, 0), (20, 56)):
        place = middle(change.grid, step * row, step * column)
        assert middle(small.grid, row, column) == pytest.approx(place, rel=0, abs=1e-6)
        with change.earlier.on_grid(change.grid) as read:
            assert small.heights[row, column] == read(step * row, step * row + 1)[0, step * column]


def test_plants_of_a_page_lie_where_they_were_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    drawn: list[Figure] = []
    monkeypatch.setattr(figures, "_SIDE", 100)
    monkeypatch.setattr(figures, "png", lambda figure, _: drawn.append(figure) or Markup(""))
    change = measure(*(open_surface(path) for path in pair(tmp_path, 0, 0.10)[:2]))
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
