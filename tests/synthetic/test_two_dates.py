"""One flat at two dates: the change is what was asked for, and known exactly."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from tidefield.geometry.geodesy import LocalFrame
from tidefield.synthetic import Flight
from tidefield.synthetic.flights import write_flights
from tidefield.synthetic.grids import Extent, Raster
from tidefield.synthetic.two_dates import Difference, Pair, SurveyErrors, ground_pair, make_pair, surveyed


@pytest.fixture(scope="module")
def pair() -> Pair:
    return make_pair("river_mouths", 3, Difference(change_m=0.3, tide_m=0.0), views=4, width=64, supersample=1)


def test_the_creek_cuts_and_fills_and_the_bar_grows_by_what_was_asked_for():
    earlier, later = ground_pair("river_mouths", 1, 0.1, side_m=100.0, cell_m=0.4)
    change = (later.values - earlier.values)[0]
    assert float(change.max()) == float(-change.min()) or abs(float(change.max() + change.min())) < 1e-3
    assert abs(float(change.max()) - 0.1) < 1e-3
    assert 0.01 < float((change < -0.09).float().mean()) < 0.2
    assert 0.01 < float((change > 0.09).float().mean()) < 0.3
    assert float((change.abs() < 1e-6).float().mean()) > 0.5


def test_no_change_is_no_change():
    earlier, later = ground_pair("tidal_trees", 2, 0.0, side_m=60.0, cell_m=0.5)
    assert torch.equal(earlier.values, later.values)


def test_surveys_have_the_errors_that_were_asked_for():
    extent = Extent(0.0, 0.0, 200, 220, 0.25)
    flat = Raster(extent, torch.zeros(1, 220, 200))
    quiet = SurveyErrors(white_m=0.02, smooth_m=0.0, long_m=0.0, datum_m=0.0, outliers=0.0)
    found = surveyed(flat, extent, np.random.default_rng(0), quiet)
    assert abs(found.std() - 0.02) < 0.001
    smooth = SurveyErrors(white_m=0.0, smooth_m=0.02, long_m=0.0, datum_m=0.0, outliers=0.0)
    found = surveyed(flat, extent, np.random.default_rng(0), smooth)
    assert abs(found.std() - 0.02) < 0.005
    # Five per cent of the correlation are left at the range of 3 m.
    assert abs(np.corrcoef(found[:-12].ravel(), found[12:].ravel())[0, 1]) < 0.2
    assert np.corrcoef(found[:-1].ravel(), found[1:].ravel())[0, 1] > 0.95


@pytest.mark.thorough
def test_photographs_of_both_dates_show_the_flat_that_changed(pair: Pair):
    change = pair.ground_change.values
    assert float(change.abs().max()) > 0.25
    same = pair.earlier.flat.bed.values + change
    assert torch.allclose(same, pair.later.flat.bed.values)
    assert pair.plants[1].values.mean() > pair.plants[0].values.mean()
    assert pair.earlier.photographs.shape == (4, 48, 64, 3)
    assert float(pair.later.cameras.position_world[:, 2].mean()) > float(
        pair.earlier.cameras.position_world[:, 2].mean()
    )


@pytest.mark.thorough
def test_only_what_changed_differs_between_the_dates():
    difference = Difference(change_m=0.0, marsh_growth=1.2, tide_m=0.0)
    flights = (Flight(focal_ratio=1.2), Flight(altitude_m=49.5, focal_ratio=1.2))  # little ground: the flat is small
    pair = make_pair("tidal_trees", 200, difference, views=2, width=32, flights=flights, supersample=1)
    flats = pair.earlier.flat, pair.later.flat
    for kind, names in (("leaves", ("centre", "u", "v", "albedo")), ("stems", ("start", "end", "albedo"))):
        earlier, later = (
            set(map(tuple, torch.cat([getattr(getattr(flat.plants, kind), name) for name in names]).T.tolist()))
            for flat in flats
        )
        assert earlier < later
    maps = torch.stack([flat.ground.maps.values for flat in flats])
    bare = (maps[:, 6] == 0).all(0) & (pair.plants[1].values[0] == 0)
    assert bare.float().mean() > 0.3
    albedo_wetness_silt_ripple = maps[:, [2, 3, 4, 5, 7, 9]]
    assert torch.equal(albedo_wetness_silt_ripple[0, :, bare], albedo_wetness_silt_ripple[1, :, bare])
    assert flats[0].ground.ripple_heading == flats[1].ground.ripple_heading
    assert torch.equal(flats[0].ground.noise.table, flats[1].ground.noise.table)
    assert torch.equal(flats[0].light.noise.table, flats[1].light.noise.table)


@pytest.mark.thorough
def test_plants_stand_on_the_ground_of_their_date():
    """A bar of 1 m lifts the tufts on it by as much."""
    pair = make_pair("vegetation", 3, Difference(1.0, marsh_growth=1.0, tide_m=0.0), views=2, width=32, supersample=1)
    above = []
    for flat in (pair.earlier.flat, pair.later.flat):
        leaves = flat.plants.leaves
        risen = pair.ground_change.sample(leaves.centre[:2])[0] > 0.99
        above.append((leaves.centre[2] - flat.bed.sample(leaves.centre[:2])[0])[risen])
    assert min(map(len, above)) > 300
    assert float(above[0].median()) == pytest.approx(float(above[1].median()), abs=0.05)


@pytest.mark.thorough
def test_flights_can_be_written_where_opencv_cannot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pair: Pair):
    """Its `imwrite` takes no other names than ASCII on Windows."""
    monkeypatch.setattr(cv2, "imwrite", lambda *_: False)
    dates = ("2023-05-01", "2024-05-01")
    write_flights(pair, tmp_path / "Süßwasserwatt", LocalFrame.at("EPSG:32631", (5e5, 5.8e6, 0.0)), dates, 11)
    for k, survey in enumerate((pair.earlier, pair.later)):
        shown = Image.open(tmp_path / "Süßwasserwatt" / dates[k] / "photographs" / f"IMG_{k}003.jpg")
        error = np.asarray(shown).astype(int) - survey.photographs[3].numpy()
        assert np.abs(error).mean() < 4
