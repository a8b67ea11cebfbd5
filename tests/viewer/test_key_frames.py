"""Paths through key frames, and their files."""

import json
import math
import shlex
from pathlib import Path

import numpy as np
import pytest
import tyro
from scipy.spatial.transform import Rotation

from tidefield.commands.common import ZeroShot
from tidefield.commands.render import Render
from tidefield.errors import TidefieldError
from tidefield.render.nerfstudio_path import read_nerfstudio_path
from tidefield.viewer.key_frames import KeyFrame, interpolate, nerfstudio_path, render_command


def keys() -> list[KeyFrame]:
    turns = Rotation.from_euler("zyx", [[0, 0, 180], [20, 10, 175], [50, 0, 170], [90, -5, 180]], degrees=True)
    places = np.array([[0.0, 0, 10], [4, 1, 11], [7, 5, 9], [8, 9, 10]])
    return [
        KeyFrame(p, r, math.radians(f)) for p, r, f in zip(places, turns.as_matrix(), (50, 60, 55, 50), strict=True)
    ]


def test_a_path_passes_through_its_keys():
    given = keys()
    frames = interpolate(given, 31)
    for key, frame in zip(given, frames[::10], strict=True):
        assert np.allclose(key.position_world, frame.position_world)
        assert np.allclose(key.rotation, frame.rotation)
        assert frame.fov == pytest.approx(key.fov)


def test_a_closed_path_ends_next_to_where_it_began_and_is_smooth_there():
    frames = interpolate(keys(), 400, closed=True)
    steps = np.linalg.norm(np.diff([f.position_world for f in [*frames, frames[0], frames[1]]], axis=0), axis=1)
    assert steps[-1] == pytest.approx(steps[-2], rel=0.1)
    assert steps[-2] > 0


@pytest.mark.parametrize("count", [2, 3, 4])
def test_a_closed_path_turns_smoothly_where_it_began(count: int):
    frames = interpolate(keys()[:count], 1200, closed=True)
    turns = Rotation.from_matrix(np.stack([frame.rotation for frame in (*frames, *frames[:2])]))
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec()
    assert np.linalg.norm(steps[-1] - steps[-2]) < 0.02 * np.linalg.norm(steps, axis=1).max()
    assert np.allclose(frames[0].rotation, keys()[0].rotation)


def test_one_key_makes_no_path():
    with pytest.raises(TidefieldError, match="has 1 key frames: expected two or more"):
        interpolate(keys()[:1], 10)


def test_the_file_reads_back_as_the_path_in_the_files_coordinates(tmp_path: Path):
    frames, origin = interpolate(keys(), 7), [430_000.0, 6_100_000.0, 12.0]
    file = tmp_path / "camera_path.json"
    file.write_text(json.dumps(nerfstudio_path(frames, origin, 640, 360, 24.0)))
    found = read_nerfstudio_path(file, tmp_path)
    assert (found.width, found.height, found.frames_per_second) == (640, 360, 24)
    for k, frame in enumerate(frames):
        assert np.allclose(found.position[k] - origin, frame.position_world, atol=1e-6)
        assert np.allclose(found.rotation[k], frame.rotation, atol=1e-9)
        assert found.focal_px[k] == pytest.approx(180 / math.tan(frame.fov / 2))


def test_the_command_that_a_page_tells_renders_what_it_shows():
    zero = ZeroShot(zero_shot=True, preset="swift", weights=Path("my weights"))
    words = shlex.split(render_command(["flats 2024/scene", *zero.words]))
    assert words[:3] == ["tidefield", "render", "flats 2024/scene"]
    options = tyro.cli(Render, args=words[2:])
    assert (options.source, options.zero) == (Path("flats 2024/scene"), zero)
    assert render_command(["run"]) == "tidefield render run flight.mp4 --path camera_path.json"
