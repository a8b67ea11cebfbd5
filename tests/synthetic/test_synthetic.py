"""The procedural tidal flat: the same from the same seed, exact in depth and map, and worth photographing."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from tidefield.errors import SceneError
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.synthetic import CATEGORIES, Flight, Survey, make_survey
from tidefield.synthetic.raster import Extent
from tidefield.synthetic.shading import ground_radiance
from tidefield.synthetic.views import Pinhole


@cache
def survey(category: str = "tidal_trees") -> Survey:
    return make_survey(category, seed=4, views=30, width=96, supersample=1)


def points_of(survey: Survey, view: int) -> torch.Tensor:
    """World points [P 3] of a view's pixels."""
    camera, depth = survey.cameras[view], survey.depth[view].reshape(-1, 1)
    return camera.position_world + camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0] * depth


def wet_and_deep(survey: Survey, xy: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Wetness and water depth at ground points."""
    maps = survey.flat.ground.maps.sample(xy)
    return maps[5], maps[6]


def test_the_same_seed_gives_the_same_pixels_on_any_number_of_cores() -> None:
    before = torch.get_num_threads()
    made = []
    try:
        for cores in (1, 2):
            torch.set_num_threads(cores)
            made.append(make_survey("tidal_trees", seed=4, views=3, width=96, supersample=1))
            assert torch.get_num_threads() == cores
    finally:
        torch.set_num_threads(before)
    assert torch.equal(made[0].photographs, made[1].photographs)
    assert torch.equal(made[0].depth, made[1].depth)
    assert torch.equal(made[0].points.uv_px, made[1].points.uv_px)
    other = make_survey("tidal_trees", seed=5, views=3, width=96, supersample=1)
    assert (other.photographs.float() - made[0].photographs.float()).abs().mean() > 5


def test_an_unknown_category_is_named_with_the_known_ones() -> None:
    with pytest.raises(SceneError, match=r"'lagoon'.*tidal_trees.*deep_water"):
        make_survey("lagoon", seed=0)


def test_points_of_the_depth_lie_on_the_ground_or_above_it_where_plants_are() -> None:
    points = torch.cat([points_of(survey("vegetation"), v) for v in range(0, 30, 6)]).T
    above = points[2] - survey("vegetation").flat.surface.sample(points[:2])[0]
    assert above.min() > -3e-4
    on_ground = above < 3e-4
    assert 0.5 < on_ground.float().mean() < 0.98
    assert 0.5 < above.max() < 6.0


def test_two_views_agree_exactly_on_what_they_both_see() -> None:
    scene = survey("vegetation")
    points = points_of(scene, 4)[::97]
    uv, z = scene.cameras[5].project(points)
    inside = ((uv[0] > 0) & (uv[0] < scene.cameras.size_px[0])).all(1)
    differences = []
    for at, expected in zip(uv[0][inside], z[0][inside], strict=True):
        # A camera of one pixel whose centre falls on the point.
        principal = scene.cameras.principal_px[[5]] - at + 0.5
        pixel = replace(scene.cameras[5], principal_px=principal, size_px=torch.tensor([[1, 1]]))
        differences.append(float(scene.flat.depth(Pinhole(pixel))[0] - expected))
    difference = torch.tensor(differences)
    assert len(difference) > 40
    # No surface lies behind a point of the surface, but for a ray that slips past the rim of a leaf.
    assert (difference < 1e-3).float().mean() > 0.97
    # Leaves hide some of the points from the other view.
    assert (difference.abs() < 1e-4).float().mean() > 0.7


def test_dry_ground_looks_the_same_from_everywhere_in_the_photographs() -> None:
    scene = survey("ground_textures")
    points = points_of(scene, 4)
    wet, deep = wet_and_deep(scene, points.T[:2])
    on_ground = (points[:, 2] - scene.flat.surface.sample(points.T[:2])[0]).abs() < 1e-3
    uv, _ = scene.cameras[5].project(points)
    inside = ((uv[0] > 1) & (uv[0] < scene.cameras.size_px[0] - 1)).all(1) & (wet < 0.35) & (deep == 0) & on_ground
    image = scene.photographs[5].float().permute(2, 0, 1)[None] / 255
    at = (uv[0][inside] / scene.cameras.size_px[0] * 2 - 1)[None, None]
    there = torch.nn.functional.grid_sample(image, at, align_corners=False)[0, :, 0].T
    here = scene.photographs[4].reshape(-1, 3)[inside].float() / 255
    assert inside.sum() > 500
    assert (there - here).abs().mean() < 0.025


def test_wet_places_shine_by_direction_and_dry_mud_does_not() -> None:
    flat = survey().flat
    xy = flat.extent.nodes()[:, ::37]
    wet, deep = wet_and_deep(survey(), xy)
    footprint = torch.full_like(wet, 0.1)
    seen = []
    for mirrors_the_sun in (True, False):
        eye = flat.light.sun * torch.tensor([-1.0, -1.0, 1.0]) if mirrors_the_sun else torch.tensor([0.0, 0.0, 1.0])
        to_eye = eye[:, None].expand(3, xy.shape[1])
        seen.append(ground_radiance(flat.ground, flat.light, flat.noise, xy, to_eye, footprint, 0.0))
    change = (seen[0] - seen[1]).abs().amax(0)
    dry, soaked, water = (wet < 0.35) & (deep == 0), (wet > 0.9) & (deep == 0), deep > 0.1
    assert min(int(dry.sum()), int(soaked.sum()), int(water.sum())) > 50
    assert change[dry].max() == 0
    assert change[soaked].median() > 0.02
    assert change[water].median() > 0.1


def test_the_map_is_what_a_camera_far_above_sees() -> None:
    scene, cell = survey("vegetation"), 0.25
    extent = Extent(-12.0, -9.0, 97, 73, cell)
    ortho = scene.flat.orthophoto(extent)
    assert (ortho.north_m, ortho.colour.shape) == (9.0, (73, 97, 3))
    far = 3000.0
    camera = Cameras(
        T_world_camera=torch.tensor([[[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, far]]]),
        focal_px=torch.full((1, 2), far / cell),
        principal_px=torch.tensor([[97 / 2, 73 / 2]]),
        size_px=torch.tensor([[97, 73]]),
        near_far=torch.tensor([[1.0, 2 * far]]),
        gain=torch.ones(1, 3),
    )
    colour, depth = scene.flat.render(camera)
    wet, deep = wet_and_deep(scene, extent.nodes())
    dry = ((wet < 0.35) & (deep == 0)).reshape(73, 97).flip(0)
    assert dry.float().mean() > 0.2
    assert (colour[0] - ortho.colour)[dry].abs().mean() < 0.01
    assert ((far - depth[0]) - ortho.height_m).abs().median() < 2e-3


@pytest.mark.parametrize("category", list(CATEGORIES))
def test_every_category_makes_a_survey_with_overlap(category: str) -> None:
    scene = survey(category)
    assert scene.photographs.shape == (30, 72, 96, 3)
    assert torch.isfinite(scene.depth).all()
    near, far = scene.cameras.near_far.T
    assert (near < scene.depth.flatten(1).amin(1)).all()
    assert (far > scene.depth.flatten(1).amax(1)).all()
    points = torch.cat([points_of(scene, v)[::41] for v in range(30)])
    uv, z = scene.cameras.project(points)
    inside = ((uv > 0) & (uv < scene.cameras.size_px[:, None])).all(-1) & (z > 0)
    assert (inside.sum(0) >= 3).float().mean() > 0.9
    brightness = scene.photographs.float().mean() / 255
    assert 0.2 < brightness < 0.6
    assert scene.photographs.float().std(dim=(1, 2)).mean() > 8
    # The sparse points leave no photograph of land without any.
    assert len(scene.points.xyz_world) > 300


def test_the_categories_are_what_they_are_called() -> None:
    water, plants = {}, {}
    for category in CATEGORIES:
        flat = survey(category).flat
        water[category] = float((flat.ground.maps.values[6] > 0.02).float().mean())
        plants[category] = len(flat.plants.leaves) / flat.extent.columns / flat.extent.rows
    assert max(water, key=lambda c: water[c]) == "deep_water"
    assert water["deep_water"] > 0.35
    assert max(plants, key=lambda c: plants[c]) == "vegetation"


def test_gains_and_moving_water_are_off_unless_asked_for() -> None:
    assert torch.equal(survey().cameras.gain, torch.ones(30, 3))
    flight = Flight(exposure_spread=0.2, water_motion=1.5)
    scene = make_survey("tidal_trees", seed=4, views=3, width=96, flight=flight, supersample=1)
    gain = scene.cameras.gain
    assert gain.std() > 0.03
    plain = replace(scene.cameras, gain=torch.ones_like(gain))
    still, _ = scene.flat.render(plain, supersample=1)
    moved, _ = scene.flat.render(plain, supersample=1, seconds=torch.tensor([0.0, 1.5, 3.0]))
    expected = (moved * gain[:, None, None]).clamp(0, 1)
    assert (scene.photographs.float() / 255 - expected).abs().max() < 0.51 / 255
    changed = (moved - still).abs().amax(-1) > 1e-6
    assert not changed[0].any()
    assert changed[2].any()
    points = points_of(scene, 2)
    above = points[:, 2] - scene.flat.surface.sample(points.T[:2])[0]
    _, deep = wet_and_deep(scene, points.T[:2])
    assert not changed[2].reshape(-1)[(deep == 0) & (above < 1e-3)].any()


def test_a_small_photograph_is_the_average_of_a_large_one() -> None:
    scene = survey("river_mouths")
    camera = scene.cameras[[5]]
    large, _ = scene.flat.render(camera.resized(384, 288), supersample=1)
    small, _ = scene.flat.render(camera.resized(96, 72), supersample=2)
    average = torch.nn.functional.avg_pool2d(large[0].permute(2, 0, 1), 4).permute(1, 2, 0)
    error = (average - small[0]).abs()
    assert error.mean() < 0.02
    assert np.isclose(float(average.mean()), float(small.mean()), atol=0.01)


def test_oblique_photographs_reach_the_sky_at_no_harm() -> None:
    scene = survey()
    pose = torch.tensor([[[1.0, 0, 0, 0], [0, -0.2588, 0.9659, -60.0], [0, -0.9659, -0.2588, 20.0]]])
    camera = replace(scene.cameras[[0]], T_world_camera=pose)
    colour, depth = scene.flat.render(camera, supersample=1)
    assert torch.isinf(depth[0, 0]).all()
    assert torch.isfinite(depth[0, -1]).all()
    assert torch.isfinite(colour).all()
    assert (colour[0, 0, :, 2] > colour[0, -1, :, 2]).float().mean() > 0.9
