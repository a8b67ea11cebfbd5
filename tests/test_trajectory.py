"""Camera paths: true rotations, steady speed, looking where they should, staying where the photographs were taken."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tidefield.data.images import Photographs
from tidefield.data.scene import Scene, SparsePoints
from tidefield.errors import TidefieldError
from tidefield.geometry.cameras import Cameras
from tidefield.products.layout import layout_of
from tidefield.products.trajectory import Trajectory, make_trajectory, orbit, strip, through_cameras

TILT = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
TILT = TILT * torch.linalg.det(TILT)
"""Structure-from-motion's arbitrary axes: every scene here is turned by this."""
UP = TILT[:, 2]


def scene_of(position: Tensor, forward: Tensor, image_up: Tensor, near_far=(2.0, 6.0), points=None) -> Scene:
    """A scene of N cameras, all of them training cameras, in turned coordinates."""
    count = len(position)
    ahead = torch.nn.functional.normalize(forward.expand(count, 3), dim=1)
    right = torch.nn.functional.normalize(torch.linalg.cross(ahead, image_up.expand(count, 3)), dim=1)
    rotation = torch.stack([right, torch.linalg.cross(ahead, right), ahead], 2)
    pose = TILT @ torch.cat([rotation, position[:, :, None]], 2)
    cameras = Cameras(
        pose,
        torch.full((count, 2), 300.0),
        torch.tensor([200.0, 150.0]).repeat(count, 1),
        torch.tensor([400, 300]).repeat(count, 1),
        torch.tensor(near_far).repeat(count, 1),
        torch.ones(count, 3),
    )
    blank = Photographs(tuple(torch.zeros(2, 2, 3, dtype=torch.uint8) for _ in range(count)))
    names = tuple(f"{i:03d}.jpg" for i in range(count))
    everyone = tuple(range(count))
    return Scene(Path("nowhere"), names, cameras, blank, points, everyone, (), torch.zeros(3, dtype=torch.float64))


def survey(rows: int = 3) -> Scene:
    """Boustrophedon nadir flight at 40 above a flat ground; the drone keeps its heading, one photograph every 5."""
    lines = [
        torch.stack([torch.arange(13) * 5.0, torch.full((13,), 12.0 * r), torch.full((13,), 40.0)], 1)
        for r in range(rows)
    ]
    position = torch.cat([line if r % 2 == 0 else line.flip(0) for r, line in enumerate(lines)])
    ground = torch.cat(
        [
            torch.rand(3000, 2, generator=torch.Generator().manual_seed(2)) * torch.tensor([60.0, 24.0]),
            torch.zeros(3000, 1),
        ],
        1,
    )
    scene = scene_of(position, torch.tensor([0.0, 0.0, -1.0]), torch.tensor([0.0, 1.0, 0.0]), (20.0, 56.0))
    xyz = ground @ TILT.T
    uv, z = scene.cameras.project(xyz)
    seen = (z > 0) & (uv > 0).all(-1) & (uv < torch.tensor([400.0, 300.0])).all(-1)
    camera, point = seen.nonzero(as_tuple=True)
    return replace(scene, points=SparsePoints(xyz, torch.ones(3000), point, camera, uv[seen]))


def motif() -> Scene:
    """A few steps before a wall, as for LLFF."""
    generator = torch.Generator().manual_seed(3)
    position = torch.rand(12, 3, generator=generator) * torch.tensor([4.0, 0.5, 2.0])
    return scene_of(position, torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]), (10.0, 40.0))


def object_scene() -> Scene:
    """Cameras on the upper half of a sphere of radius 4, looking at its middle, named in no order (Blender)."""
    generator = torch.Generator().manual_seed(4)
    azimuth = torch.rand(60, generator=generator) * 2 * math.pi
    height = 0.1 + 0.8 * torch.rand(60, generator=generator)
    level = (1 - height**2).sqrt()
    position = 4 * torch.stack([azimuth.cos() * level, azimuth.sin() * level, height], 1)
    return scene_of(position, -position, torch.tensor([0.0, 0.0, 1.0]))


SCENES = {"survey": survey, "facing": motif, "around": object_scene}
PATHS = {"cameras": through_cameras, "orbit": orbit, "strip": strip}


def angle(a: Tensor, b: Tensor) -> float:
    """Largest angle between unit vectors, degrees."""
    return float(torch.rad2deg(torch.acos((a * b).sum(-1).clamp(-1, 1))).max())


@pytest.mark.parametrize("kind", SCENES)
def test_the_kind_of_capture_and_its_up_are_found_whatever_the_axes(kind: str):
    layout = layout_of(SCENES[kind]())
    assert layout.kind == kind
    assert angle(torch.tensor(layout.up).float(), UP) < 2


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("kind", SCENES)
def test_every_path_is_made_of_rotations_with_the_asked_size(kind: str, path: str):
    scene = SCENES[kind]()
    cameras = PATHS[path](scene, 31, 320, 180)
    rotation = cameras.T_world_camera[:, :, :3]
    assert torch.allclose(rotation.transpose(1, 2) @ rotation, torch.eye(3).expand(31, 3, 3), atol=1e-5)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(31), atol=1e-5)
    assert (cameras.width, cameras.height, len(cameras)) == (320, 180, 31)
    assert torch.equal(cameras.principal_px, torch.tensor([160.0, 90.0]).repeat(31, 1))
    # 16:9 out of 4:3: the width keeps its angle, so that nothing outside of the photographs comes into view.
    assert torch.allclose(cameras.focal_px, torch.full((31, 2), 240.0))
    assert (cameras.near_far[:, 0] > 0).all()
    assert (cameras.near_far[:, 1] > cameras.near_far[:, 0]).all()
    assert torch.equal(cameras.gain, torch.ones(31, 3))


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("kind", SCENES)
def test_every_path_stays_among_the_photographs(kind: str, path: str):
    scene = SCENES[kind]()
    cameras = PATHS[path](scene, 60, 320, 240)
    nearest = torch.cdist(cameras.position_world, scene.cameras.position_world).min(1).values
    assert nearest.max() < 0.5 * layout_of(scene).distance


def test_the_tour_passes_through_the_cameras_in_order_at_constant_speed():
    scene = survey()
    cameras = through_cameras(scene, 400, 320, 240)
    apart = torch.cdist(scene.cameras.position_world, cameras.position_world).min(1)
    step = cameras.position_world.diff(dim=0).norm(dim=1)
    assert apart.values.max() <= step.max()
    assert (apart.indices.diff() > 0).all()
    assert step.std() / step.mean() < 0.02
    assert step.max() / step.mean() < 1.05


def test_the_tour_turns_no_faster_than_the_eye_follows():
    scene = survey()
    turned = scene.cameras.T_world_camera.clone()
    turned[13:26, :, :2] *= -1  # the second line is flown with the opposite heading
    cameras = through_cameras(replace(scene, cameras=replace(scene.cameras, T_world_camera=turned)), 400, 320, 240)
    rotation = cameras.T_world_camera[:, :, :3]
    change = rotation[:-1].transpose(1, 2) @ rotation[1:]
    turn = torch.acos(((change.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1))
    travel = cameras.position_world.diff(dim=0).norm(dim=1) / 40
    speed = (turn**2 + travel**2).sqrt()
    assert turn.sum() > 2 * math.pi * 0.95
    assert speed.max() / speed.mean() < 1.1


def test_cameras_named_in_no_order_are_toured_without_leaping():
    scene = object_scene()
    cameras = through_cameras(scene, 600, 320, 240)
    named = scene.cameras.position_world.diff(dim=0).norm(dim=1).sum()
    travelled = cameras.position_world.diff(dim=0).norm(dim=1).sum()
    assert travelled < 0.4 * named
    assert torch.cdist(scene.cameras.position_world, cameras.position_world).min(1).values.max() < 0.1


@pytest.mark.parametrize("kind", SCENES)
def test_an_orbit_looks_at_its_centre_and_closes(kind: str):
    scene = SCENES[kind]()
    centre = torch.tensor(layout_of(scene).centre).float()
    cameras = orbit(scene, 48, 320, 240)
    to_centre = torch.nn.functional.normalize(centre - cameras.position_world, dim=1)
    assert angle(cameras.forward_world, to_centre) < 0.1
    step = (cameras.position_world - cameras.position_world.roll(1, 0)).norm(dim=1)
    assert step[0] == pytest.approx(float(step[1:].mean()), rel=0.6)
    assert (cameras.T_world_camera[:, :, 1] @ UP).max() < 0, "up in the world must be up in the picture"


def test_an_orbit_around_an_object_seen_from_the_front_only_stays_in_front():
    scene = object_scene()
    front = [i for i in range(60) if float(scene.cameras.position_world[i] @ TILT[:, 0]) > 0]
    cameras = orbit(replace(scene, train=tuple(front)), 48, 320, 240)
    assert (cameras.position_world @ TILT[:, 0]).min() > -0.1


def test_an_orbit_over_a_survey_keeps_height_and_looks_at_most_thirty_degrees_aside():
    cameras = orbit(survey(), 48, 320, 240)
    assert torch.allclose(cameras.position_world @ UP, torch.full((48,), 40.0), atol=0.2)
    assert angle(cameras.forward_world, -UP) <= 30.1


def test_a_strip_looks_straight_down_along_the_long_axis():
    cameras = strip(survey(), 50, 320, 240)
    assert angle(cameras.forward_world, -UP) < 0.5
    travel = torch.nn.functional.normalize(cameras.position_world.diff(dim=0), dim=1)
    assert angle(travel, TILT[:, 0]) < 1 or angle(travel, -TILT[:, 0]) < 1
    assert angle(-cameras.T_world_camera[1:, :, 1], travel) < 0.5
    assert torch.allclose(cameras.position_world @ UP, torch.full((50,), 40.0), atol=0.2)
    assert torch.allclose(cameras.position_world @ TILT[:, 1], torch.full((50,), 12.0), atol=0.5)


def test_frames_that_look_aside_reach_as_far_as_they_see():
    scene = survey()
    aside, down = orbit(scene, 24, 320, 240), strip(scene, 24, 320, 240)
    assert aside.near_far[:, 1].mean() > 1.1 * down.near_far[:, 1].mean()
    assert down.near_far[:, 0].max() < 40 < down.near_far[:, 1].min()


def test_an_unknown_path_is_one_clear_error():
    with pytest.raises(TidefieldError, match=r"'spiral'.*cameras, orbit, strip or a \.json"):
        make_trajectory("spiral", survey(), frames=10, width=64, height=48)


def test_a_named_path_keeps_the_asked_speed():
    found = make_trajectory("strip", survey(), frames=10, width=64, height=48, frames_per_second=30.0)
    assert isinstance(found, Trajectory)
    assert (found.frames_per_second, len(found.cameras)) == (30.0, 10)


def exported(poses: np.ndarray, **changes: object) -> dict:
    """A camera path as the viewer writes it: OpenGL axes, 16 numbers row by row, vertical field of view."""
    gl = poses @ np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [{"camera_to_world": p.flatten().tolist(), "fov": 50.0, "aspect": 16 / 9} for p in gl]
    return {
        "default_fov": 50.0,
        "keyframes": [],
        "camera_type": "perspective",
        "render_height": 90,
        "render_width": 160,
        "fps": 25,
        "seconds": len(poses) / 25,
        "is_cycle": False,
        "smoothness_value": 0.0,
        "camera_path": frames,
        **changes,
    }


@pytest.fixture
def poses() -> np.ndarray:
    scene = survey()
    pose = strip(scene, 7, 160, 90).T_world_camera.double().numpy()
    return np.concatenate([pose, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (7, 1, 1))], 1)


def load(tmp_path: Path, content: object, scene: Scene | None = None) -> Trajectory:
    file = tmp_path / "path.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return make_trajectory(str(file), scene or survey(), frames=1, width=1, height=1)


def test_a_viewers_path_comes_back_as_it_was(tmp_path: Path, poses: np.ndarray):
    origin = torch.tensor([7.0, 8.0, 9.0], dtype=torch.float64)
    absolute = poses.copy()
    absolute[:, :3, 3] += origin.numpy()
    found = load(tmp_path, exported(absolute), replace(survey(), origin_world=origin))
    assert torch.allclose(found.cameras.T_world_camera.double(), torch.tensor(poses[:, :3]), atol=1e-4)
    assert found.frames_per_second == 25
    assert (found.cameras.width, found.cameras.height) == (160, 90)
    assert torch.allclose(found.cameras.focal_px, torch.full((7, 2), 45 / math.tan(math.radians(25))))
    assert torch.equal(found.cameras.principal_px[0], torch.tensor([80.0, 45.0]))


def test_matrices_stored_by_columns_are_understood(tmp_path: Path, poses: np.ndarray):
    content = exported(poses)
    for frame in content["camera_path"]:
        frame["camera_to_world"] = np.array(frame["camera_to_world"]).reshape(4, 4).T.flatten().tolist()
    found = load(tmp_path, content)
    assert torch.allclose(found.cameras.T_world_camera.double(), torch.tensor(poses[:, :3]), atol=1e-4)


def normalise(poses: np.ndarray, turn: np.ndarray, shift: np.ndarray, scale: float) -> np.ndarray:
    moved = poses.copy()
    moved[:, :3, :3] = turn @ poses[:, :3, :3]
    moved[:, :3, 3] = scale * (poses[:, :3, 3] @ turn.T + shift)
    return moved


def test_nerfstudios_normalisation_is_undone(tmp_path: Path, poses: np.ndarray):
    turn, shift, scale = TILT.double().numpy().T, np.array([0.3, -2.0, 1.0]), 0.05
    mapping = {"transform": np.column_stack([turn, shift]).tolist(), "scale": scale}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(mapping))
    found = load(tmp_path, exported(normalise(poses, turn, shift, scale)))
    assert torch.allclose(found.cameras.T_world_camera.double(), torch.tensor(poses[:, :3]), atol=1e-4)


def test_the_mapping_ends_in_the_coordinates_of_a_transforms_json(tmp_path: Path, poses: np.ndarray):
    # nerfstudio saves transform @ applied_transform: it starts from the coordinates before its own data preparation.
    applied = np.eye(4)[[0, 2, 1, 3]]
    applied[2] *= -1
    turn, shift, scale = TILT.double().numpy().T, np.array([0.3, -2.0, 1.0]), 0.05
    saved = np.column_stack([turn, shift]) @ applied
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": saved.tolist(), "scale": scale}))
    (tmp_path / "transforms.json").write_text(json.dumps({"applied_transform": applied[:3].tolist(), "frames": []}))
    found = load(tmp_path, exported(normalise(poses, turn, shift, scale)), replace(survey(), root=tmp_path))
    assert torch.allclose(found.cameras.T_world_camera.double(), torch.tensor(poses[:, :3]), atol=1e-4)


def broken_rotation(content: dict) -> None:
    content["camera_path"][2]["camera_to_world"][0] *= 3


def mirrored(content: dict) -> None:
    for k in (0, 4, 8):
        content["camera_path"][2]["camera_to_world"][k] *= -1


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: c.pop("camera_path"), "no list camera_path"),
        (lambda c: c.update(camera_path=[]), "no list camera_path"),
        (lambda c: c.update(camera_type="fisheye"), "'fisheye': expected perspective"),
        (lambda c: c.update(render_width=-5), "render_width is -5"),
        (lambda c: c.update(render_height="tall"), "render_height is missing or malformed"),
        (lambda c: c.update(fps=0), "fps is 0"),
        (lambda c: c["camera_path"][2].pop("camera_to_world"), "frame 2: camera_to_world is missing"),
        (lambda c: c["camera_path"][2].update(camera_to_world=[1.0] * 15), "frame 2: camera_to_world .* 16 finite"),
        (lambda c: c["camera_path"][2].update(camera_to_world=[math.nan] * 16), "frame 2: camera_to_world"),
        (lambda c: c["camera_path"][3].update(fov=180), "frame 3: fov is 180"),
        (lambda c: c["camera_path"][3].pop("fov"), "frame 3: fov is missing"),
        (broken_rotation, "frame 2: camera_to_world is no rotation"),
        (mirrored, "frame 2: camera_to_world is no rotation"),
    ],
)
def test_a_malformed_path_is_one_clear_error(tmp_path: Path, poses: np.ndarray, spoil, message: str):
    content = exported(poses)
    spoil(content)
    with pytest.raises(TidefieldError, match=message):
        load(tmp_path, content)


def test_files_that_are_no_json_or_not_there_are_one_clear_error(tmp_path: Path):
    with pytest.raises(TidefieldError, match="not whole JSON"):
        load(tmp_path, '{"camera_path": [')
    with pytest.raises(TidefieldError, match=r"absent\.json"):
        make_trajectory(str(tmp_path / "absent.json"), survey(), frames=1, width=1, height=1)


def test_a_malformed_mapping_is_one_clear_error(tmp_path: Path, poses: np.ndarray):
    mapping = tmp_path / "dataparser_transforms.json"
    mapping.write_text(json.dumps({"transform": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "scale": 1.0}))
    with pytest.raises(TidefieldError, match="transform is missing or malformed: expected 3 x 4"):
        load(tmp_path, exported(poses))
    mapping.write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": -1.0}))
    with pytest.raises(TidefieldError, match=r"scale -1\.0"):
        load(tmp_path, exported(poses))
