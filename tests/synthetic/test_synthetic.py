"""Check synthetic surveys: reproducible from a seed, exact in depth and map, with overlap and contrast."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from tidefield.errors import SceneError
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.synthetic import CATEGORIES, Flight, Survey, make_survey
from tidefield.synthetic.flat import TidalFlat
from tidefield.synthetic.grids import Extent
from tidefield.synthetic.large import PHOTOGRAPHS, LargeFlight, make_large_flight, planned_flight
from tidefield.synthetic.rays import Pinhole
from tidefield.synthetic.survey import _near_far
from tidefield.synthetic.two_dates import Difference, make_pair

VIEWS = 16
LONG = Flight(focal_ratio=2.4)
"""A long lens shows little ground, so that the flat is small."""


@cache
def survey(category: str = "tidal_trees") -> Survey:
    return make_survey(category, seed=4, views=VIEWS, width=96, flight=replace(LONG, focal_ratio=1.6), supersample=1)


def points_of(survey: Survey, view: int) -> torch.Tensor:
    """Return the world points [P 3] of a view's pixels."""
    camera, depth = survey.cameras[view], survey.depth[view].reshape(-1, 1)
    return camera.position_world + camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0] * depth


def wetness_and_depth(survey: Survey, xy: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return wetness and water depth at ground points."""
    at = survey.flat.ground.sample(xy)
    return at.wetness, at.water_depth_m


def test_a_seed_gives_the_same_pixels_on_any_number_of_cores() -> None:
    before = torch.get_num_threads()
    made = []
    try:
        for cores in (1, 2):
            torch.set_num_threads(cores)
            made.append(make_survey("tidal_trees", seed=4, views=3, width=48, flight=LONG, supersample=1))
            assert torch.get_num_threads() == cores
    finally:
        torch.set_num_threads(before)
    assert torch.equal(made[0].photographs, made[1].photographs)
    assert torch.equal(made[0].depth, made[1].depth)
    assert torch.equal(made[0].points.uv_px, made[1].points.uv_px)
    other = make_survey("tidal_trees", seed=5, views=3, width=48, flight=LONG, supersample=1)
    assert (other.photographs.float() - made[0].photographs.float()).abs().mean() > 5


def test_error_for_an_unknown_category_lists_the_categories() -> None:
    with pytest.raises(SceneError, match=r"'lagoon'.*tidal_trees.*deep_water"):
        make_survey("lagoon", seed=0)


@pytest.mark.thorough
def test_depth_points_lie_on_the_ground_or_on_plants_above_it() -> None:
    points = torch.cat([points_of(survey("vegetation"), v) for v in range(0, VIEWS, 3)]).T
    above = points[2] - survey("vegetation").flat.surface.sample(points[:2])[0]
    assert above.min() > -3e-4
    on_ground = above < 3e-4
    assert 0.5 < on_ground.float().mean() < 0.98
    assert 0.5 < above.max() < 6.0


@pytest.mark.thorough
def test_depths_of_two_views_agree() -> None:
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


def test_dry_ground_has_the_same_colour_in_all_photographs() -> None:
    scene = survey("ground_textures")
    points = points_of(scene, 4)
    wet, deep = wetness_and_depth(scene, points.T[:2])
    on_ground = (points[:, 2] - scene.flat.surface.sample(points.T[:2])[0]).abs() < 1e-3
    uv, _ = scene.cameras[5].project(points)
    inside = ((uv[0] > 1) & (uv[0] < scene.cameras.size_px[0] - 1)).all(1) & (wet < 0.35) & (deep == 0) & on_ground
    image = scene.photographs[5].float().permute(2, 0, 1)[None] / 255
    at = (uv[0][inside] / scene.cameras.size_px[0] * 2 - 1)[None, None]
    there = torch.nn.functional.grid_sample(image, at, align_corners=False)[0, :, 0].T
    here = scene.photographs[4].reshape(-1, 3)[inside].float() / 255
    assert inside.sum() > 500
    assert (there - here).abs().mean() < 0.025


@pytest.mark.thorough
def test_only_wet_ground_and_water_are_specular() -> None:
    flat = survey().flat
    xy = flat.surface.extent.nodes()[:, ::37]
    wet, deep = wetness_and_depth(survey(), xy)
    footprint = torch.full_like(wet, 0.1)
    radiance = []
    for mirrors_the_sun in (True, False):
        eye = flat.light.sun * torch.tensor([-1.0, -1.0, 1.0]) if mirrors_the_sun else torch.tensor([0.0, 0.0, 1.0])
        to_eye = eye[:, None].expand(3, xy.shape[1])
        radiance.append(flat.ground.radiance(flat.light, xy, to_eye, footprint, 0.0))
    change = (radiance[0] - radiance[1]).abs().amax(0)
    dry, soaked, water = (wet < 0.35) & (deep == 0), (wet > 0.9) & (deep == 0), deep > 0.1
    assert min(int(dry.sum()), int(soaked.sum()), int(water.sum())) > 50
    assert change[dry].max() == 0
    assert change[soaked].median() > 0.02
    assert change[water].median() > 0.1


def test_orthophoto_matches_a_camera_far_above() -> None:
    scene, cell = survey("vegetation"), 0.25
    extent = Extent(-12.0, -9.0, 97, 73, cell)
    map_colour, map_height = scene.flat.map(extent)
    assert map_colour.shape == (73, 97, 3)
    far = 3000.0
    camera = Cameras(
        T_world_camera=torch.tensor([[[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, far]]]),
        focal_px=torch.full((1, 2), far / cell),
        principal_px=torch.tensor([[97 / 2, 73 / 2]]),
        size_px=torch.tensor([[97, 73]]),
        near_far=torch.tensor([[1.0, 2 * far]]),
        gain=torch.ones(1, 3),
    )
    colour, depth = scene.flat.photograph(camera)
    wet, deep = wetness_and_depth(scene, extent.nodes())
    dry = ((wet < 0.35) & (deep == 0)).reshape(73, 97).flip(0)
    assert dry.float().mean() > 0.2
    assert (colour - map_colour)[dry].abs().mean() < 0.01
    assert ((far - depth) - map_height).abs().median() < 2e-3


@pytest.mark.thorough
@pytest.mark.parametrize("category", list(CATEGORIES))
def test_every_category_has_overlap_contrast_and_sparse_points(category: str) -> None:
    scene = survey(category)
    assert scene.photographs.shape == (VIEWS, 72, 96, 3)
    assert torch.isfinite(scene.depth).all()
    near, far = scene.cameras.near_far.T
    assert (near < scene.depth.flatten(1).amin(1)).all()
    assert (far > scene.depth.flatten(1).amax(1)).all()
    points = torch.cat([points_of(scene, v)[::41] for v in range(VIEWS)])
    uv, z = scene.cameras.project(points)
    inside = ((uv > 0) & (uv < scene.cameras.size_px[:, None])).all(-1) & (z > 0)
    assert (inside.sum(0) >= 3).float().mean() > 0.9
    brightness = scene.photographs.float().mean() / 255
    assert 0.2 < brightness < 0.6
    assert scene.photographs.float().std(dim=(1, 2)).mean() > 8
    assert len(scene.points.xyz_world) > 300


@pytest.mark.thorough
def test_categories_differ_as_their_names_say() -> None:
    water, plants = {}, {}
    for category in CATEGORIES:
        flat = make_survey(category, seed=4, views=2, width=16, flight=LONG, supersample=1).flat
        water[category] = float((flat.ground.sample(flat.surface.extent.nodes()).water_depth_m > 0.02).float().mean())
        plants[category] = len(flat.plants.leaves) / flat.surface.extent.columns / flat.surface.extent.rows
    assert max(water, key=lambda c: water[c]) == "deep_water"
    assert water["deep_water"] > 0.35
    assert max(plants, key=lambda c: plants[c]) == "vegetation"


@pytest.mark.thorough
def test_gains_and_moving_water_are_optional() -> None:
    assert torch.equal(survey().cameras.gain, torch.ones(VIEWS, 3))
    flight = replace(LONG, exposure_spread=0.2, water_motion=1.5)
    scene = make_survey("tidal_trees", seed=4, views=3, width=96, flight=flight, supersample=1)
    gain = scene.cameras.gain
    assert gain.std() > 0.03
    plain = replace(scene.cameras, gain=torch.ones_like(gain))
    still, moved = (
        torch.stack([scene.flat.photograph(plain[i], 1, seconds=i * step)[0] for i in range(3)]) for step in (0.0, 1.5)
    )
    expected = (moved * gain[:, None, None]).clamp(0, 1)
    assert (scene.photographs.float() / 255 - expected).abs().max() < 0.51 / 255
    changed = (moved - still).abs().amax(-1) > 1e-6
    assert not changed[0].any()
    assert changed[2].any()
    points = points_of(scene, 2)
    above = points[:, 2] - scene.flat.surface.sample(points.T[:2])[0]
    _, deep = wetness_and_depth(scene, points.T[:2])
    assert not changed[2].reshape(-1)[(deep == 0) & (above < 1e-3)].any()


@pytest.mark.thorough
def test_a_small_photograph_averages_a_large_one() -> None:
    scene = survey("river_mouths")
    camera = scene.cameras[[5]]
    large, _ = scene.flat.photograph(camera.resized(384, 288), supersample=1)
    small, _ = scene.flat.photograph(camera.resized(96, 72), supersample=2)
    average = torch.nn.functional.avg_pool2d(large.permute(2, 0, 1), 4).permute(1, 2, 0)
    error = (average - small).abs()
    assert error.mean() < 0.02
    assert np.isclose(float(average.mean()), float(small.mean()), atol=0.01)


def test_oblique_photographs_may_contain_sky() -> None:
    scene = survey()
    pose = torch.tensor([[[1.0, 0, 0, 0], [0, -0.2588, 0.9659, -60.0], [0, -0.9659, -0.2588, 20.0]]])
    camera = replace(scene.cameras[[0]], T_world_camera=pose, focal_px=0.5 * scene.cameras.focal_px[[0]])
    colour, depth = scene.flat.photograph(camera, supersample=1)
    assert torch.isinf(depth[0]).all()
    assert torch.isfinite(depth[-1]).all()
    assert torch.isfinite(colour).all()
    assert (colour[0, :, 2] > colour[-1, :, 2]).float().mean() > 0.9


def test_near_and_far_ignore_the_sky() -> None:
    depth = torch.tensor([[[5.0, 8.0], [torch.inf, 6.0]]])
    assert torch.allclose(_near_far(depth), torch.tensor([[4.5, 8.8]]))


@pytest.mark.thorough
def test_flight_options_reach_the_flat_and_the_poses() -> None:
    def made(views: int = 2, **options: float) -> Survey:
        flight = replace(LONG, **options)  # type: ignore[arg-type]
        return make_survey("ground_textures", 4, views=views, width=16, flight=flight, supersample=1)

    assert float(made(sun_elevation_deg=12.0).flat.light.sun[2]) == pytest.approx(np.sin(np.radians(12.0)))
    wet, dry = (made(wetness=wetness).flat.ground for wetness in (1.0, 0.0))
    assert wet.maps.values[5].mean() > dry.maps.values[5].mean() + 0.2
    oblique = made(views=4, oblique_share=1.0)
    tilt_deg = torch.rad2deg(torch.arccos(-oblique.cameras.forward_world[:, 2]))
    assert tilt_deg.min() > 18
    assert tilt_deg.max() < 52
    assert torch.equal(survey().cameras.forward_world[:, 2] < -0.98, torch.ones(VIEWS, dtype=torch.bool))


@pytest.mark.thorough
def test_flight_options_reach_large_flights() -> None:
    def flat(**options: float) -> TidalFlat:
        flight = replace(LONG, **options)  # type: ignore[arg-type]
        return planned_flight(LargeFlight("ground_textures", 4, strips=1, each=2, width=16, flight=flight))[3]()

    wet, dry = flat(sun_elevation_deg=12.0, wetness=1.0), flat(wetness=0.0)
    assert float(wet.light.sun[2]) == pytest.approx(np.sin(np.radians(12.0)))
    assert wet.ground.maps.values[5].mean() > dry.ground.maps.values[5].mean() + 0.2


@pytest.mark.thorough
def test_water_moves_between_the_photographs_of_large_flights(tmp_path: Path) -> None:
    made = []
    for motion in (0.0, 1.5):
        flight = replace(LONG, water_motion=motion)
        plan = LargeFlight("deep_water", 4, strips=1, each=2, width=64, flight=flight)
        make_large_flight(plan, tmp_path / str(motion))
        made.append([file.read_bytes() for file in sorted((tmp_path / str(motion) / PHOTOGRAPHS).iterdir())])
    assert made[0][0] == made[1][0]
    assert made[0][1] != made[1][1]


@pytest.mark.thorough
def test_flight_options_reach_both_dates_of_a_pair() -> None:
    flights = (
        replace(LONG, sun_elevation_deg=12.0, wetness=0.0),
        replace(LONG, sun_elevation_deg=50.0, wetness=1.0, water_motion=1.5),
    )
    same = Difference(change_m=0.0, marsh_growth=1.0, tide_m=0.0)
    made = [
        make_pair("ground_textures", 4, same, views=2, width=32, flights=of, supersample=1)
        for of in (flights, (flights[0], LONG))
    ]
    elevations = [float(survey.flat.light.sun[2]) for pair in made for survey in (pair.earlier, pair.later)]
    assert elevations == pytest.approx(np.sin(np.radians([12.0, 50.0, 12.0, 12.0])))
    dry, wet = (survey.flat.ground.maps.values[5].mean() for survey in (made[0].earlier, made[0].later))
    assert wet > dry + 0.2
    later = made[0].later
    still, moved = (later.flat.photograph(later.cameras[1], 1, seconds)[0] for seconds in (0.0, 1.5))
    shown = later.photographs[1].float() / 255
    assert (shown - moved).abs().max() < 0.51 / 255
    assert (shown - still).abs().max() > 0.51 / 255


def test_plants_cast_shadows() -> None:
    flat = survey("vegetation").flat
    nodes, height = flat.surface.extent.nodes(), flat.surface.values.reshape(1, -1)
    assert 0.02 < float((flat.shadows.sunlit(torch.cat([nodes, height])) < 0.5).float().mean()) < 0.6
    assert flat.shadows.sunlit(torch.cat([nodes, torch.full_like(height, flat.highest_m + 1)])).min() == 1
