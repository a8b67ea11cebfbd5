"""Camera paths of a scene: size, depth range and visible content; files of nerfstudio's viewer."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from captures import SCENES, TILT, UP, scene_of, survey
from rich.console import Console

from tidefield.commands.render import Render, render
from tidefield.data.scene import Scene
from tidefield.data.surface import doubly_seen
from tidefield.errors import TidefieldError
from tidefield.geometry.cameras import Cameras
from tidefield.render.camera_paths import (
    RANGE_POINTS,
    Trajectory,
    layout_of,
    make_trajectory,
    orbit,
    path_cameras,
    require_path,
    strip,
)

PATHS = ["cameras", "orbit", "strip"]


def path_of(path: str, scene: Scene, frames: int, width: int = 320, height: int = 240) -> Cameras:
    return make_trajectory(path, scene, frames=frames, width=width, height=height).cameras


def seen_shares(scene: Scene, cameras: Cameras) -> list[float]:
    """Of each frame, the share of pixels that two photographs see."""
    small = cameras.resized(32, 24)
    return [float(doubly_seen(scene, small[k]).float().mean()) for k in range(len(small))]


@pytest.mark.thorough
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("kind", SCENES)
def test_every_path_has_the_asked_size_and_the_photographs_view_range_and_exposure(kind: str, path: str):
    scene = SCENES[kind]()
    cameras = path_of(path, scene, 31, 320, 180)
    assert (cameras.width, cameras.height, len(cameras)) == (320, 180, 31)
    assert torch.equal(cameras.principal_px, torch.tensor([160.0, 90.0]).repeat(31, 1))
    # 16:9 out of 4:3: the width keeps its angle, so that nothing outside of the photographs comes into view.
    assert torch.allclose(cameras.focal_px, torch.full((31, 2), 240.0))
    assert (cameras.near_far[:, 0] > 0).all()
    assert (cameras.near_far[:, 1] > cameras.near_far[:, 0]).all()
    assert torch.equal(cameras.gain, torch.ones(31, 3))


@pytest.mark.parametrize(
    "azimuths", [(0.0, math.pi), tuple(0.5 * k for k in range(12))], ids=["opposite", "all around"]
)
@pytest.mark.parametrize("outwards", [True, False], ids=["outwards", "inwards"])
def test_among_cameras_that_look_outwards_or_at_each_other_frames_are_level(
    azimuths: tuple[float, ...], outwards: bool
):
    position = 2 * torch.tensor([[math.cos(a), math.sin(a), 0.0] for a in azimuths])
    scene = scene_of(position, position if outwards else -position, torch.tensor([0.0, 0.0, 1.0]))
    poses = path_of("orbit", scene, 8).T_world_camera
    assert torch.isfinite(poses).all()
    assert (poses[:, :, 1] @ UP < -0.9).all(), "the picture's down"
    ahead = poses[:, :, 2]
    assert (ahead @ ahead.T).min() < -0.5 or len(azimuths) == 2, "all around"


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("kind", ["survey", "facing", "around"])
def test_every_path_stays_among_the_photographs(kind: str, path: str):
    scene = SCENES[kind]()
    nearest = torch.cdist(path_of(path, scene, 60).position_world, scene.cameras.position_world).min(1).values
    assert nearest.max() < 0.5 * layout_of(scene).distance


@pytest.mark.thorough
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("every", [1, 5])
def test_frames_over_a_survey_are_nearly_full_of_what_two_photographs_see(path: str, every: int):
    scene = survey(every=every)
    assert min(seen_shares(scene, path_of(path, scene, 15))) > 0.9


def test_a_path_is_shortened_only_where_photographs_are_sparse():
    dense, thin = survey(), survey(every=7)
    for scene, whole in ((dense, True), (thin, False)):
        drawn = strip_length(path_of("strip", scene, 20))
        layout = layout_of(scene)
        longest = max(2 * layout.half_extent(axis) for axis in TILT.T.double().numpy())
        assert (drawn == pytest.approx(longest, rel=0.01)) is whole
        assert drawn > 0.2 * longest


def strip_length(cameras: Cameras) -> float:
    return float((cameras.position_world[-1] - cameras.position_world[0]).norm())


@pytest.mark.thorough
@pytest.mark.parametrize("path", PATHS)
def test_the_same_call_gives_the_same_path(path: str):
    first, second = path_of(path, survey(), 30), path_of(path, survey(), 30)
    assert torch.equal(first.T_world_camera, second.T_world_camera)
    assert torch.equal(first.near_far, second.near_far)


def test_the_far_of_oblique_frames_includes_what_they_see():
    scene = survey()
    aside, down = path_of("orbit", scene, 24), path_of("strip", scene, 24)
    assert aside.near_far[:, 1].mean() > 1.1 * down.near_far[:, 1].mean()
    assert down.near_far[:, 0].max() < 40 < down.near_far[:, 1].min()


@pytest.mark.parametrize("heights", [np.tile([8.0, 40.0], 5), 4 + 36 * np.abs(np.linspace(-1, 1, 48))])
def test_the_range_of_each_frame_contains_its_own(heights: np.ndarray):
    scene = survey()
    layout = layout_of(scene)
    assert scene.points is not None
    ground = scene.points.xyz_world.repeat(400, 1)
    ground = ground + 4 * torch.randn(ground.shape, generator=torch.Generator().manual_seed(0))
    ground = ground - (ground @ UP)[:, None] * UP
    scene = replace(scene, points=replace(scene.points, xyz_world=ground, error_px=torch.ones(len(ground))))
    position, rotation = strip(layout, len(heights), 0.3)
    position = position - ((position @ layout.up)[:, None] - heights[:, None]) * layout.up
    together = path_cameras(scene, position, rotation, 64, 48).near_far
    alone = [path_cameras(scene, p[None], r[None], 64, 48).near_far for p, r in zip(position, rotation, strict=True)]
    seen = torch.cat(alone)
    assert (together[:, 0] <= seen[:, 0]).all()
    assert (together[:, 1] >= seen[:, 1]).all()
    assert (together[:, 0] < torch.as_tensor(heights)).all(), "the ground is before near"


def test_an_unknown_path_is_one_clear_error():
    with pytest.raises(TidefieldError, match=r"'spiral'.*cameras, orbit, strip or a \.json"):
        make_trajectory("spiral", survey(), frames=10, width=64, height=48)


def test_frames_are_refused_with_a_path_that_has_its_own(tmp_path: Path):
    options = Render(tmp_path / "run", tmp_path / "out.mp4", path="flights/first.JSON", frames=9)
    with pytest.raises(TidefieldError, match=r"--frames was given, but first\.JSON has frames of its own"):
        render(options, Console(quiet=True))


def test_a_camera_reads_a_part_of_many_points_only():
    class Points(torch.Tensor):
        def double(self) -> torch.Tensor:
            assert len(self) <= RANGE_POINTS[0]
            return super().double()

    scene = SCENES["survey"]()
    assert scene.points is not None
    many = scene.points.xyz_world.repeat(100, 1).as_subclass(Points)
    assert len(many) > RANGE_POINTS[0]
    points = replace(scene.points, xyz_world=many, error_px=torch.zeros(len(many)))
    crowded = replace(scene, points=points)
    position, rotation = orbit(layout_of(scene), 1)
    plain, crowd = (path_cameras(each, position, rotation, 64, 48, np.array([60.0])) for each in (scene, crowded))
    assert torch.allclose(plain.near_far, crowd.near_far, rtol=0.02)


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
    position, rotation = strip(layout_of(survey()), 7)
    last = np.tile([[[0.0, 0.0, 0.0, 1.0]]], (7, 1, 1))
    return np.concatenate([np.concatenate([rotation, position[:, :, None]], 2), last], 1)


def load(tmp_path: Path, content: object, scene: Scene | None = None) -> Trajectory:
    file = tmp_path / "path.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return make_trajectory(str(file), scene or survey(), frames=1, width=1, height=1)


def test_an_exported_path_is_read_back_unchanged(tmp_path: Path, poses: np.ndarray):
    origin = torch.tensor([7.0, 8.0, 9.0], dtype=torch.float64)
    absolute = poses.copy()
    absolute[:, :3, 3] += origin.numpy()
    found = load(tmp_path, exported(absolute), replace(survey(), origin_world=origin))
    assert torch.allclose(found.cameras.T_world_camera.double(), torch.tensor(poses[:, :3]), atol=1e-4)
    assert found.frames_per_second == 25
    assert (found.cameras.width, found.cameras.height) == (160, 90)
    assert torch.allclose(found.cameras.focal_px, torch.full((7, 2), 45 / math.tan(math.radians(25))))
    assert torch.equal(found.cameras.principal_px[0], torch.tensor([80.0, 45.0]))


@pytest.mark.parametrize("shape", [(16,), (4, 4)], ids=["flat", "rows"])
@pytest.mark.parametrize("by_columns", [False, True])
def test_matrices_are_read_flat_or_as_rows_and_transposed_where_stored_by_columns(
    tmp_path: Path, poses: np.ndarray, shape: tuple[int, ...], by_columns: bool
):
    content = exported(poses)
    for frame in content["camera_path"]:
        matrix = np.array(frame["camera_to_world"]).reshape(4, 4)
        frame["camera_to_world"] = (matrix.T if by_columns else matrix).reshape(shape).tolist()
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


def test_the_normalisation_of_our_own_data_parser_starts_from_the_scene(tmp_path: Path, poses: np.ndarray):
    applied = np.eye(4)[[0, 2, 1, 3]]
    shift, scale = np.array([0.3, -2.0, 1.0]), 0.05
    mapping = {"transform": np.column_stack([np.eye(3), shift]).tolist(), "scale": scale, "georeference": None}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(mapping))
    (tmp_path / "transforms.json").write_text(json.dumps({"applied_transform": applied[:3].tolist(), "frames": []}))
    found = load(tmp_path, exported(normalise(poses, np.eye(3), shift, scale)), replace(survey(), root=tmp_path))
    assert torch.allclose(found.cameras.T_world_camera.double(), torch.tensor(poses[:, :3]), atol=1e-4)


def test_the_normalisation_starts_before_the_applied_transform(tmp_path: Path, poses: np.ndarray):
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
        (lambda c: c.update(render_width=-5), "render_width = -5"),
        (lambda c: c.update(render_height="tall"), "render_height = 'tall': expected a number from 1 to 16384"),
        (lambda c: c.update(fps=0), "fps = 0"),
        (lambda c: c["camera_path"][2].pop("camera_to_world"), "frame 2 has camera_to_world = None"),
        (lambda c: c["camera_path"][2].update(camera_to_world=[1.0] * 15), "frame 2 has camera_to_world .* 16 numbers"),
        (lambda c: c["camera_path"][2].update(camera_to_world=[math.nan] * 16), "frame 2 has camera_to_world = nan"),
        (lambda c: c["camera_path"][3].update(fov=180), "frame 3 has fov = 180"),
        (lambda c: c["camera_path"][3].pop("fov"), "frame 3 has fov = None"),
        (lambda c: c["camera_path"][2]["camera_to_world"].__setitem__(3, 1e299), "frame 2 has .* = 1e\\+299"),
        (lambda c: c["camera_path"][2]["camera_to_world"].__setitem__(3, 10**400), "frame 2 has .* = 1000"),
        (lambda c: c["camera_path"][2].update(camera_to_world=[[1.0, 2.0], [3.0]]), "frame 2 has .* 16 numbers"),
        (lambda c: c["camera_path"][2].update(camera_to_world=[[1.0] * 4] * 3 + [[]]), "frame 2 has .* 4 x 4 numbers"),
        (lambda c: c["camera_path"][3].update(fov=1e-300), "frame 3 has fov = 1e-300"),
        (lambda c: c.update(fps=None, seconds=1e-300), "seconds = 1e-300"),
        (broken_rotation, "frame 2: camera_to_world is no rotation"),
        (mirrored, "frame 2: camera_to_world is no rotation"),
    ],
)
def test_a_malformed_path_is_one_clear_error(tmp_path: Path, poses: np.ndarray, spoil, message: str):
    content = exported(poses)
    spoil(content)
    with pytest.raises(TidefieldError, match=message):
        load(tmp_path, content)


def test_a_path_of_another_camera_is_refused_before_a_scene_is_read(tmp_path: Path, poses: np.ndarray):
    file = tmp_path / "path.json"
    for changes, message in (
        ({"camera_type": "equirectangular"}, "expected perspective"),
        ({"camera_path": []}, "list"),
    ):
        file.write_text(json.dumps(exported(poses, **changes)))
        with pytest.raises(TidefieldError, match=message):
            require_path(str(file), 1)


def test_invalid_json_and_missing_files_are_one_clear_error(tmp_path: Path):
    with pytest.raises(TidefieldError, match="whole JSON"):
        load(tmp_path, '{"camera_path": [')
    with pytest.raises(TidefieldError, match=r"absent\.json"):
        make_trajectory(str(tmp_path / "absent.json"), survey(), frames=1, width=1, height=1)


def test_a_malformed_normalisation_is_one_clear_error(tmp_path: Path, poses: np.ndarray):
    mapping = tmp_path / "dataparser_transforms.json"
    mapping.write_text(json.dumps({"transform": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "scale": 1.0}))
    with pytest.raises(TidefieldError, match=r"transform = .* expected 3 x 4"):
        load(tmp_path, exported(poses))
    mapping.write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": -1.0}))
    with pytest.raises(TidefieldError, match=r"scale = -1\.0"):
        load(tmp_path, exported(poses))
    mapping.write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 10**400}))
    with pytest.raises(TidefieldError, match="scale = 1000"):
        load(tmp_path, exported(poses))
    (tmp_path / "transforms.json").write_text(json.dumps({"applied_transform": np.zeros((3, 4)).tolist()}))
    mapping.write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 1.0}))
    with pytest.raises(TidefieldError, match=r"transforms\.json is damaged .*Singular"):
        load(tmp_path, exported(poses), replace(survey(), root=tmp_path))
