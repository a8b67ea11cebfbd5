"""Views of two dates from one camera: a built-in flat that is rendered exactly."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image
from pyproj import CRS

from tidefield.change.kinds import COLOUR, HIGHER, LIGHT, LOWER, SAME, UNKNOWN, View, colour_kinds
from tidefield.change.measure import Change, Options, measure
from tidefield.change.pictures import difference, side_by_side, swipe_page, write_views
from tidefield.change.surfaces import ChangeError, open_surface
from tidefield.change.views import Site, carried, choose_camera, make_view
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.geodesy import LocalFrame
from tidefield.maps.grid import MapFrame
from tidefield.model.rendering import Rendering
from tidefield.synthetic import write_survey
from tidefield.synthetic.flat import TidalFlat
from tidefield.synthetic.grids import Extent
from tidefield.synthetic.two_dates import Difference, Pair, SurveyErrors, make_pair, surveyed


@pytest.fixture(scope="module")
def pair() -> Pair:
    return make_pair(
        "ground_textures", 9, Difference(change_m=0.4, marsh_growth=1.0, tide_m=0.0), 6, 160, supersample=1
    )


@pytest.fixture(scope="module")
def scene(pair: Pair, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("views")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        write_survey(pair.earlier, folder / "scene")
        return load_scene(folder / "scene", hold_out=False)


def exact(flat: TidalFlat, scene: Scene, gain: float = 1.0):
    """The flat itself as a method."""

    def render(camera):
        moved = replace(camera, T_world_camera=camera.T_world_camera.clone())
        moved.T_world_camera[:, :, 3] += scene.origin_world.float()
        colour, depth = flat.photograph(moved, 1)
        return Rendering((colour * gain).clamp(0, 1), depth, torch.ones_like(depth))

    return render


@pytest.fixture(scope="module")
def change(pair: Pair, tmp_path_factory: pytest.TempPathFactory) -> Change:
    from benchmarks.change_pairs import write_surface

    folder, extent = tmp_path_factory.mktemp("surfaces"), Extent.around([-30.0, -25.0], [30.0, 25.0], 0.25)
    paths = []
    for k, survey in enumerate((pair.earlier, pair.later)):
        heights = surveyed(survey.flat.bed, extent, np.random.default_rng(k), SurveyErrors(datum_m=0.0))
        paths.append(write_surface(folder / f"{k}.tif", heights, extent))
    one, two = (replace(open_surface(path), crs=None) for path in paths)
    return measure(one, two, Options(register="none", datum_error_m=0.002))


def test_views_show_where_the_ground_rose_and_sank_and_where_only_the_light_changed(
    pair: Pair, scene: Scene, change: Change
):
    earlier = Site.of(scene, exact(pair.earlier.flat, scene))
    later = Site.of(scene, exact(pair.later.flat, scene, gain=0.8))
    name = choose_camera(change, earlier)
    view = make_view(change, None, earlier, later, name)
    camera = scene.cameras[scene.index(name)]
    from tidefield.geometry.cameras import pixel_grid

    rays = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0]
    depth = earlier.render(camera).depth.reshape(-1, 1)
    points = camera.position_world + rays * depth + scene.origin_world.float()
    true = pair.ground_change.sample(points[:, :2].T.contiguous())[0].reshape(view.kinds.shape).numpy()
    inside = ((points[:, 0].abs() < 29) & (points[:, 1].abs() < 24)).reshape(view.kinds.shape).numpy()
    assert (view.kinds[inside] != UNKNOWN).mean() > 0.99
    raised = (true > 0.3) & inside
    assert raised.sum() > 500
    assert (view.kinds[raised] == HIGHER).mean() > 0.9
    steady = (np.abs(true) < 1e-6) & inside
    assert (view.kinds[steady] == LOWER).mean() < 0.02
    assert np.isin(view.kinds[steady], (SAME, LIGHT)).mean() > 0.85
    # The later view has the earlier one's light: the gain is gone.
    same = view.kinds == SAME
    assert view.later[same].mean() == pytest.approx(view.earlier[same].mean(), rel=0.05)


def test_shade_is_light_and_another_material_is_none():
    rng = np.random.default_rng(0)
    one = (120 + rng.normal(0, 3, (80, 120, 3))).astype(np.uint8)
    two = one.astype(np.float64)
    two[:40, :40] *= (0.55, 0.58, 0.63)  # shade is bluer
    two[:40, 80:] *= (0.85, 1.1, 0.7)  # greener
    kinds = colour_kinds(one, two.clip(0, 255).astype(np.uint8), np.ones((80, 120), bool))
    assert (kinds[5:35, 5:35] == LIGHT).mean() > 0.95
    assert (kinds[5:35, 85:115] == COLOUR).mean() > 0.95
    assert (kinds[50:] == SAME).mean() > 0.98


def georeferenced(scene: Scene, east: float, crs: str = "EPSG:32631", up: float = 0.0) -> Site:
    frame = LocalFrame.at(crs, (500_000.0 + east, 5_800_000.0, up))
    wkt = CRS(crs).to_wkt()
    placed = MapFrame(frame, scene.origin_world.double().numpy(), np.eye(3), wkt, wkt, frame.vertical_datum)
    return Site(scene, exact, placed)  # type: ignore[arg-type]


def test_a_camera_is_carried_through_map_coordinates(scene: Scene):
    # The later scene's origin lies 30 m further east and 4 m lower; its survey is 0.2 m too high and 1 m too far west.
    earlier, later = georeferenced(scene, 0.0), georeferenced(scene, 30.0, up=-4.0)
    camera = scene.cameras[0]
    made = carried(camera, earlier, later, (1.0, 0.0), 0.2)
    moved = (made.position_world - camera.position_world)[0].tolist()
    assert moved == pytest.approx([-31.0, 0.0, 4.2], abs=0.02)
    assert torch.allclose(made.T_world_camera[..., :3], camera.T_world_camera[..., :3], atol=1e-4)
    assert made.names == ()


def test_a_camera_is_carried_into_another_system(scene: Scene):
    earlier, later = georeferenced(scene, 0.0), georeferenced(scene, 0.0, "EPSG:32631")
    other = LocalFrame.at("EPSG:32630", (914_000.0, 5_820_000.0, 0.0))
    wkt = CRS("EPSG:32630").to_wkt()
    later = replace(later, frame=replace(later.frame, frame=other, wkt=wkt, horizontal_wkt=wkt))
    point = torch.tensor([[3.0, 4.0, 0.5]])
    made = carried(scene.cameras[0], earlier, later)
    there = later.frame.to_scene(
        np.column_stack(
            [
                *_transform(earlier.frame.to_map(point.double().numpy())),
            ]
        )
    )
    expected, _ = scene.cameras[0].project(point)
    found, _ = made.project(torch.from_numpy(there).float())
    assert found[0, 0].tolist() == pytest.approx(expected[0, 0].tolist(), abs=0.5)


def test_a_camera_is_carried_between_heights_in_metres_and_in_feet(scene: Scene):
    earlier, foot = georeferenced(scene, 0.0), 1200 / 3937
    in_feet = LocalFrame.at("EPSG:32631+6360", (500_000.0, 5_800_000.0, -4.0 / foot))
    later = replace(earlier, frame=replace(earlier.frame, frame=in_feet, metre_up=1 / foot))
    camera = scene.cameras[0]
    made = carried(camera, earlier, later, lift_m=0.5)
    moved = (made.position_world - camera.position_world)[0].tolist()
    assert moved == pytest.approx([0.0, 0.0, 4.5], abs=0.02)


def test_the_later_camera_is_moved_by_the_tilt_at_what_it_shows(scene: Scene, change: Change):
    registration = replace(change.errors.registration, model="tilt", coefficients=(0.1, 0.01, 0.0))
    tilted = replace(change, errors=replace(change.errors, registration=registration))
    asked: list[torch.Tensor] = []

    def render(camera: Cameras) -> Rendering:
        asked.append(camera.position_world[0])
        depth = torch.full((camera.height, camera.width), float(camera.position_world[0, 2]))
        return Rendering(torch.zeros(camera.height, camera.width, 3), depth, torch.ones_like(depth))

    site = Site.of(scene, render)
    name = scene.names[0]
    make_view(tilted, None, site, site, name)
    east = float(asked[0][0] + scene.origin_world[0]) - registration.centre_m[0]
    assert abs(east) > 1
    assert float(asked[1][2] - asked[0][2]) == pytest.approx(0.1 + 0.01 * east, abs=0.02)


def _transform(points: np.ndarray) -> list[np.ndarray]:
    from pyproj import Transformer

    to = Transformer.from_crs("EPSG:32631", "EPSG:32630", always_xy=True)
    return [*to.transform(points[:, 0], points[:, 1]), points[:, 2]]


def test_a_local_scene_and_a_georeferenced_one_are_refused(scene: Scene):
    local = Site.of(scene, exact)  # type: ignore[arg-type]
    with pytest.raises(ChangeError, match="georeferenced"):
        carried(scene.cameras[0], local, georeferenced(scene, 0.0))


@pytest.mark.thorough
def test_pictures_are_written_and_need_nothing_else(tmp_path: Path):
    rng = np.random.default_rng(1)
    pictures = rng.integers(0, 255, (2, 61, 90, 3)).astype(np.uint8)
    kinds = np.full((61, 90), SAME, np.uint8)
    kinds[:20] = LOWER
    kinds[50:] = UNKNOWN
    view = View("DJI_1.JPG", pictures[0], pictures[1], kinds)
    names = ("2023 <May>", "2024")
    files = write_views(view, names, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in files)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "later.png")), pictures[1])
    assert side_by_side(view, names).shape[1] == 2 * 90 + 8
    shown = difference(view)[-61:, :90]
    assert shown[50:].mean() < 0.6 * shown[25:45].mean()
    assert shown[:20, :, 0].mean() > shown[:20, :, 2].mean() + 30
    assert view.share(LOWER) == pytest.approx(20 / 50)
    page = swipe_page(view, names)
    assert page.count("data:image/jpeg;base64,") == 2
    assert "2023 &lt;May&gt;" in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    with av.open(str(tmp_path / "fade.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == 144
    assert np.abs(frames[0][:61].astype(float) - frames[-1][:61]).mean() < 12
    assert np.abs(frames[80][:61].astype(float) - frames[0][:61]).mean() > 20
