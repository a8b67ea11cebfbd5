"""Semi-global matching of pairs finds the surface of a built-in flat, whatever the headings of the photographs."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from tidefield.data.load import load_scene
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.geometry.geodesy import LocalFrame, parse_crs
from tidefield.maps import surface
from tidefield.maps.grid import Grid, MapFrame, Tile, map_frame
from tidefield.maps.orthophoto import prior_of
from tidefield.maps.stereo import Pairs, Rectified, choose_pairs, fill_gaps
from tidefield.maps.surface import COARSEST, choose_views, match, sparse_surface
from tidefield.maps.views import GreyPhotographs, View
from tidefield.synthetic import make_survey, write_survey

pytest.importorskip("rasterio")
CELL = 0.2


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("stereo")
    survey = make_survey("ground_textures", seed=4, views=9, width=320, supersample=1)
    write_survey(survey, folder / "scene", truth=False)
    return load_scene(folder / "scene", hold_out=False, cache=folder / "cache"), survey


def test_rows_of_both_pictures_show_the_same_points(scene):
    loaded, _ = scene
    grid = Grid(map_frame(loaded, None), -6.4, 6.4, CELL, 64, 64, 0.0)
    [tile] = grid.tiles(64, 0)
    choice = choose_views(tile, loaded, sparse_surface(loaded, grid.coarser(COARSEST)))
    headings = [loaded.cameras.T_world_camera[i, :, 0].numpy() for i in choice.indices]
    turned = [float(headings[i] @ headings[j]) for i, j in choice.pairs]
    assert len(choice.pairs) == 12
    assert min(turned) < -0.9 < 0.9 < max(turned)  # strips are flown to and fro
    points = np.array([[1.0, 2.0, 0.3], [-3.0, 4.0, -0.4], [5.0, -2.0, 0.0]])
    for i, j in choice.pairs:
        left, right = choice.views[i], choice.views[j]
        pair = Rectified(left, right, CELL, 64, -1.0, 1.0)
        local = (points - pair.centre) @ pair.rotation.T
        other = (points - right.position) @ pair.rotation.T
        np.testing.assert_allclose(local[:, 1] / local[:, 2], other[:, 1] / other[:, 2], atol=1e-9)
        disparity = pair.focal * (local[:, 0] / local[:, 2] - other[:, 0] / other[:, 2]) - pair.least
        assert ((disparity >= 0) & (disparity < pair.count)).all()
        # What the left picture has at a point is what the photograph has there.
        ramp = np.broadcast_to(np.arange(left.size[0], dtype=np.float32), (left.size[1], left.size[0])).copy()
        shown, inside = pair.resample(left, ramp, 0.0)
        uv = pair.focal * local[:, :2] / local[:, 2:] - pair.origin
        columns, rows = uv.T.astype(np.float32)[:, None] - 0.5
        seen = cv2.remap(shown, columns, rows, cv2.INTER_LINEAR)[0]
        true = left.pixels(*points.T.astype(np.float32))[0] - 0.5
        kept = cv2.remap(inside.astype(np.float32), columns, rows, cv2.INTER_LINEAR)[0] == 1
        np.testing.assert_allclose(seen[kept], true[kept], atol=0.05)


def test_heights_are_those_of_the_flat(scene):
    loaded, survey = scene
    grid = Grid(map_frame(loaded, None), -6.4, 6.4, CELL, 64, 64, 0.0)
    [tile] = grid.tiles(64, 0)
    choice = choose_views(tile, loaded, sparse_surface(loaded, grid.coarser(COARSEST)))
    grey = GreyPhotographs(loaded)
    found = Pairs(choice.pairs, choice.views, choice.indices, grey, 1, CELL, 64).heights(-2.0, 3.0)
    east, north = (part.ravel() for part in np.broadcast_arrays(*tile.offsets()))
    places = torch.from_numpy(np.stack([east + tile.centre[0], north + tile.centre[1]])).float()
    true = survey.flat.surface.sample(places)[0].reshape(64, 64).numpy()
    error = found - true
    assert np.isfinite(error).mean() > 0.95
    nmad = 1.4826 * np.nanmedian(np.abs(error - np.nanmedian(error)))
    assert nmad < 0.5 * CELL
    assert abs(np.nanmedian(error)) < 0.25 * CELL
    # A pair whose base rises too much, or is too long, is not matched.
    assert not choose_pairs(
        choice.views[:2], np.ones((2, 4), bool), np.zeros((2, 4)), choice.views[0].position[2] - 1e-3
    )


def test_what_is_masked_in_all_photographs_is_seen_by_none_and_matched_with_nothing(scene):
    loaded, _ = scene
    masks = []
    for camera in (loaded.cameras[i] for i in range(len(loaded.names))):
        to = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0]
        position = camera.position_world[0] + loaded.origin_world.float()
        east, north = (position - to * (position[2] / to[:, 2])[:, None])[:, :2].T
        masks.append(((east.abs() > 3) | (north.abs() > 3)).reshape(camera.height, camera.width))
    masked = replace(loaded, photographs=replace(loaded.photographs, masks=tuple(masks)))
    grid = Grid(map_frame(loaded, None), -6.4, 6.4, CELL, 64, 64, 0.0)
    [tile] = grid.tiles(64, 0)
    start, hole = sparse_surface(loaded, grid.coarser(COARSEST)), slice(24, 40)
    for one in (loaded, masked):
        grey, choice = GreyPhotographs(one), choose_views(tile, one, start)
        pairs = Pairs(choice.pairs, choice.views, choice.indices, grey, 1, CELL, 64)
        found = match(tile, start, one, grey, CELL)
        assert found.count[:10].min() >= 2
        assert np.isfinite(pairs.heights(-1.0, 1.0)[:10]).mean() > 0.8
        seen, paired = found.count[hole, hole], np.isfinite(pairs.heights(-1.0, 1.0)[hole, hole])
        assert (seen.max(), bool(paired.any())) == ((0, False) if one is masked else (9, True))


def test_photographs_and_pairs_are_the_same_where_the_plan_is_in_feet(scene):
    loaded, _ = scene
    world, chosen = loaded.origin_world.double().numpy(), []
    for system in ("EPSG:32118", "EPSG:2263"):  # New York's plane coordinates in metres, and in feet
        metre = 1 / parse_crs(system).axis_info[0].unit_conversion_factor
        frame = LocalFrame.at(system, (300_000.0 * metre, 60_000.0 * metre, 30.0))
        own = MapFrame(frame, world, np.eye(3), "", "", "", metre)
        west, north = own.to_map(np.array([[-6.4, 6.4, 0.0]]))[0, :2]
        grid = Grid(own, west, north, CELL * metre, 64, 64, 30.0)
        [tile] = grid.tiles(64, 0)
        chosen.append(choose_views(tile, loaded, sparse_surface(loaded, grid.coarser(COARSEST))))
    assert chosen[0].indices == chosen[1].indices
    assert chosen[0].pairs == chosen[1].pairs
    assert len(chosen[1].pairs) == 12


def test_cells_are_projected_into_the_photographs_above_them_only(scene, monkeypatch: pytest.MonkeyPatch):
    loaded, _ = scene
    grid = Grid(map_frame(loaded, None), -6.4, 6.4, CELL, 64, 64, 0.0)
    [tile] = grid.tiles(64, 0)
    start = sparse_surface(loaded, grid.coarser(COARSEST))
    before = choose_views(tile, loaded, start)
    pose = loaded.cameras.T_world_camera.clone()
    away = before.indices[::2]
    pose[away, 0, 3] += 1000.0
    moved = replace(loaded, cameras=replace(loaded.cameras, T_world_camera=pose))
    projected = []

    class Counted(View):
        def __init__(self, camera: Cameras, tile: Tile, used: np.ndarray | None = None) -> None:
            projected.append(camera)
            super().__init__(camera, tile, used)

    monkeypatch.setattr(surface, "View", Counted)
    assert choose_views(tile, moved, start).indices == before.indices[1::2]
    assert len(projected) == len(loaded.names) - len(away)


def test_heights_that_are_tried_do_not_depend_on_where_the_map_counts_heights_from(scene):
    loaded, _ = scene
    found = []
    for zero in (0.0, -15.0):
        grid = Grid(map_frame(loaded, None), -6.4, 6.4, CELL, 64, 64, zero)
        [tile] = grid.tiles(64, 0)
        start = sparse_surface(loaded, grid.coarser(COARSEST))
        choice = choose_views(tile, loaded, start)
        ground = float(np.median(start.on(tile, 0))) - zero
        found.append(surface._parallax(choice.views, choice.chosen, ground))
    assert found[0] == pytest.approx(found[1], rel=1e-3)


def test_parallax_is_the_same_where_lengths_and_heights_have_other_units():
    metre, foot = 1.0, 0.3048
    found = []
    for across, up in ((metre, metre), (foot, metre), (metre, foot), (foot, foot)):
        views = [object.__new__(View) for _ in range(3)]
        for view, x in zip(views, (-8.0, 0.0, 8.0), strict=True):
            view.position, view.up = np.array([x / across, 0, 40 / up]), up / across
        found.append(surface._parallax(views, range(3), 2.0 / up))
    assert found == pytest.approx([found[0]] * 4)
    assert 0.3 < found[0] < 16 / 38


def test_the_range_that_colours_are_looked_for_in_has_the_unit_of_heights(scene):
    loaded, _ = scene
    frame, found = map_frame(loaded, None), []
    flat, sigma = np.zeros((64, 64), np.float32), np.full((64, 64), 1e6, np.float32)
    for metre in (1.0, 1 / 0.3048):
        [tile] = Grid(replace(frame, metre=metre), -6.4, 6.4, CELL * metre, 64, 64, 0.0).tiles(64, 0)
        found.append(prior_of(flat, sigma, tile, 100.0).numpy())
    np.testing.assert_allclose(*found, rtol=1e-5)


def test_the_error_is_large_where_neither_pairs_nor_photographs_determine_the_height(
    scene, monkeypatch: pytest.MonkeyPatch
):
    loaded, _ = scene
    grid = Grid(map_frame(loaded, None), -6.4, 6.4, CELL, 64, 64, 0.0)
    [tile] = grid.tiles(64, 0)
    start = sparse_surface(loaded, grid.coarser(COARSEST))
    rough = start.on(tile, surface.PAD) + np.random.default_rng(0).normal(0, 0.5, (128, 128)).astype(np.float32)
    rough[:, 48:80] = np.nan
    monkeypatch.setattr(Pairs, "heights", lambda *_: rough)
    blank = GreyPhotographs(loaded)
    monkeypatch.setattr(blank, "read", lambda index, factor: np.full((240, 320), 100, np.uint8))
    matched = surface.match(tile, start, loaded, blank, CELL)
    assert np.median(matched.sigma[:, 24:40]) > 0.3  # metres, in the gap
    sharp = surface.match(tile, start, loaded, GreyPhotographs(loaded), CELL)
    assert np.median(sharp.sigma[:, 24:40]) < 0.5 * np.median(matched.sigma[:, 24:40])


def test_gaps_have_what_fits_the_photographs_of_the_matched_cells_around_and_of_the_sparse_points(
    scene, monkeypatch: pytest.MonkeyPatch
):
    loaded, _ = scene
    grid = Grid(map_frame(loaded, None), -6.4, 6.4, CELL, 64, 64, 0.0)
    [tile] = grid.tiles(64, 0)
    start, grey = sparse_surface(loaded, grid.coarser(COARSEST)), GreyPhotographs(loaded)
    true = surface.match(tile, start, loaded, grey, CELL)
    by_chance = np.full((128, 128), np.nan, np.float32)
    by_chance[40:50, 40:60] = start.on(tile, surface.PAD)[40:50, 40:60] - 2.0
    right = np.pad(true.height, surface.PAD, mode="edge")
    right[50:80, 50:80] = np.nan
    lowered = replace(start, height=start.height - np.float32(2.0))
    for heights, begin in ((by_chance, start), (right, lowered)):
        monkeypatch.setattr(Pairs, "heights", lambda *_, heights=heights: heights)
        found = surface.match(tile, begin, loaded, grey, CELL)
        assert np.median(np.abs(found.height - true.height)[20:44, 20:44]) < 0.1


def test_gaps_are_filled_smoothly_and_say_how_heights_around_them_are_spread():
    rng = np.random.default_rng(0)
    across = np.arange(90, dtype=np.float32)
    height = np.broadcast_to(300 + 0.02 * across, (75, 90)) + rng.normal(0, 0.01, (75, 90)).astype(np.float32)
    with_gaps = height.copy()
    with_gaps[20:50, 30:60] = np.nan
    with_gaps[60, 10] = np.nan
    gap = np.isnan(with_gaps)
    filled, spread = fill_gaps(with_gaps)
    assert (filled[~gap] == height[~gap]).all()
    assert (spread[~gap] == 0).all()
    error = filled - height
    assert np.abs(error[gap]).max() < 0.15  # nearest heights are off by 15 cells' rise, 30 cm, along two ridges
    steps = np.abs(np.diff(filled[21:49, 31:59], axis=1))
    assert steps.max() < 0.06
    assert (np.abs(error[gap]) < 1.96 * spread[gap]).mean() > 0.95
    assert spread[60, 10] < 0.05 < spread[35, 45]


def test_gaps_of_a_single_known_cell_have_its_height():
    height = np.full((5, 3), np.nan, np.float32)
    height[4, 0] = 7.0
    filled, spread = fill_gaps(height)
    assert filled == pytest.approx(7.0)
    assert spread == pytest.approx(0.0)
