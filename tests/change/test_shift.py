"""The horizontal shift between surveys, from pictures with other light."""

import math
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer
from surveys_of_two_dates import NORTH, WEST, noise, pair, write_surface

from tidefield.change.measure import Options, measure
from tidefield.change.shift import correlate, find_shift, picture_grid
from tidefield.change.surfaces import ChangeError, Grid, open_surface


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A texture that can be sampled anywhere, in [0, 1]."""
    rng = np.random.default_rng(0)
    total = np.zeros(x.shape)
    for _ in range(60):
        kx, ky, phase = *rng.normal(0, 0.9, 2), rng.uniform(0, 2 * np.pi)
        total += np.cos(kx * x + ky * y + phase)
    return 0.5 + total / 40


def pictures(east: float, north: float, cell: float = 0.25) -> tuple[np.ndarray, np.ndarray]:
    """The same ground twice; in the second picture it lies further to the east and north, with another light."""
    rows, columns = np.indices((400, 480))
    x, y = columns * cell, -rows * cell
    light = 0.6 + 0.3 * columns / 480
    one = 200 * ground(x, y).clip(0, 1)
    other = 30 + 140 * light * ground(x - east, y - north).clip(0, 1)
    rng = np.random.default_rng(1)
    return tuple((p + rng.normal(0, 4, p.shape)).clip(1, 254).astype(np.float32) for p in (one, other))  # type: ignore


def test_a_shift_is_found_to_a_tenth_of_a_pixel_under_another_light():
    one, other = pictures(0.40, -0.65)
    found = correlate(one, other, np.ones(one.shape, bool), 0.25)
    assert found.known
    assert found.east_m == pytest.approx(-0.40, abs=0.025)
    assert found.north_m == pytest.approx(0.65, abs=0.025)
    assert found.error_m < 0.05
    assert abs(found.east_m + 0.40) < 3 * found.error_m + 0.01


@pytest.mark.thorough
@pytest.mark.parametrize("apart_m", [1.0, 8.0])
def test_surveys_that_are_metres_apart_are_brought_together(tmp_path: Path, apart_m: float):
    rows, columns = np.indices((1000, 1100))
    x, y = columns * 0.12, -rows * 0.12
    for name, east in (("early", 0.0), ("late", apart_m)):
        grey = (200 * ground(x - east, y).clip(0, 1)).astype(np.uint8)
        write_surface(tmp_path / f"{name}.tif", np.stack([grey] * 3), cell=0.12)
    grid = Grid(CRS("EPSG:32630").to_wkt(), WEST, NORTH, 0.5, 264, 240)
    found = find_shift(tmp_path / "early.tif", tmp_path / "late.tif", grid)
    assert (found.east_m, found.north_m) == (pytest.approx(-apart_m, abs=0.03), pytest.approx(0, abs=0.03))
    assert found.pixel_m == pytest.approx(0.12)


def test_the_error_of_a_shift_has_what_a_turned_survey_adds():
    rows, columns = np.indices((400, 480))
    x, y, errors = columns * 0.25, -rows * 0.25, []
    rng = np.random.default_rng(5)
    for turn in (0.0, 0.006):
        one, other = (
            200 * ground(x + at * (y + 50), y - at * (x - 60)).clip(0, 1) + rng.normal(0, 4, x.shape)
            for at in (0.0, turn)
        )
        found = correlate(one.astype(np.float32), other.astype(np.float32), np.ones(x.shape, bool), 0.25)
        assert found.known
        errors.append(found.error_m)
    true = 0.006 * 50 / math.sqrt(3)  # what a turn moves the windows by, one sigma, without their border
    assert errors[0] < 0.05 < 0.5 * true < errors[1] < 1.2 * true


def test_unrelated_pictures_do_not_tell_a_shift():
    rng = np.random.default_rng(2)
    one, other = (128 + 40 * noise(rng, (400, 480), 0.5, 1, 3) for _ in range(2))
    found = correlate(one, other, np.ones(one.shape, bool), 0.25)
    assert not found.known
    assert "do not tell" in found.words()


def test_bland_ground_does_not_tell_a_shift():
    bland = np.full((400, 480), 120, np.float32)
    assert correlate(bland, bland, np.ones(bland.shape, bool), 0.25).windows == 0


@pytest.mark.parametrize(("system", "size"), [("EPSG:2229", (0.5, 0.5)), ("EPSG:3857", (0.2, 0.3))])
def test_pixels_of_orthophotos_are_measured_on_the_ground(tmp_path: Path, system: str, size: tuple[float, float]):
    x, y = Transformer.from_crs("EPSG:4326", system, always_xy=True).transform(-118.4, 33.8)
    path = write_surface(
        tmp_path / "ortho.tif", np.full((3, 40, 60), 100, np.uint8), west=x, north=y, crs=system, size=size
    )
    east, north = Transformer.from_crs("EPSG:4326", "EPSG:32611", always_xy=True).transform(-118.4, 33.8)
    grid = Grid(CRS("EPSG:32611").to_wkt(), east, north, 0.05, 200, 200)
    expected = {"EPSG:2229": 0.5 * 0.3048, "EPSG:3857": 0.3 * math.cos(math.radians(33.8))}
    assert picture_grid((path, path), grid).cell_m == pytest.approx(expected[system], rel=0.01)


@pytest.mark.thorough
def test_the_later_survey_is_moved_and_its_error_enters_on_slopes(tmp_path: Path):
    east, north = 0.6, -0.45
    rows, columns = np.indices((200, 240))
    x, y = columns * 0.5, -rows * 0.5
    rng = np.random.default_rng(3)

    def heights(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        steep = (0.4 * np.sin(x / 4) * (x > 60) + 2 * ground(x / 6, y / 6)).astype(np.float32)
        return steep + noise(rng, x.shape, 0.01, 0.005, 4)

    write_surface(tmp_path / "early.tif", heights(x, y))
    write_surface(tmp_path / "late.tif", heights(x - east, y - north))
    for name, picture in zip(("early", "late"), pictures(east, north), strict=True):
        write_surface(tmp_path / f"{name}_ortho.tif", np.stack([picture.astype(np.uint8)] * 3), 0.25)
    from dataclasses import replace

    surveys = [
        replace(open_surface(tmp_path / f"{n}.tif"), orthophoto=tmp_path / f"{n}_ortho.tif") for n in ("early", "late")
    ]
    moved = measure(*surveys)
    left = measure(*surveys, Options(shift="none"))
    assert moved.errors.registration.shift_m == pytest.approx((-east, -north), abs=0.04)
    assert np.nanstd(moved.dz) < 0.5 * np.nanstd(left.dz)
    sigma = moved.errors.cell_sigma(slice(0, moved.grid.rows))
    assert sigma[:, 130:].mean() > sigma[:, :110].mean()
    # Stable ground is of all slopes: what the error of the shift does to their mean was subtracted with it.
    assert moved.errors.slopes is not None
    assert np.abs([part[moved.stable].mean() for part in moved.errors.slopes]).max() < 1e-3
    plain = replace(moved.errors, slopes=None)
    assert moved.net.systematic_m3 == pytest.approx(plain.systematic_of_sum(np.isfinite(moved.dz)) * 0.25, rel=0.05)


def test_a_shift_that_must_be_known_is_refused_where_pictures_do_not_tell(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 0, 0.0)
    with pytest.raises(ChangeError, match="no orthophoto"):
        measure(open_surface(earlier), open_surface(later), Options(shift="images"))
