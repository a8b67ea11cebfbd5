"""OpenSplat: the scene that it gets, its budget, what can go wrong with it, and the way back of what it trains."""

import json
import signal
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import opensplat_program
import pytest
import textured_wall as wall
import torch
from PIL import Image
from plyfile import PlyData

from tidefield.baselines import opensplat
from tidefield.baselines.export import at_common_exposure, exposure_factor, point_colours
from tidefield.config import Budget
from tidefield.data.scene import Scene
from tidefield.errors import RunError, SceneError
from tidefield.evaluation.curves import make_curve
from tidefield.geometry.cameras import pixel_grid

CPU = torch.device("cpu")
TEST = (0, 3)


@pytest.fixture
def scene() -> Scene:
    """Photographs of different exposure, with the principal point off their middle."""
    cameras = wall.with_gains(wall.cameras(6))
    return wall.scene(replace(cameras, principal_px=cameras.principal_px + torch.tensor([3.4, -2.1])), TEST)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


@pytest.fixture
def program(tmp_path: Path) -> Path:
    return opensplat_program.install(tmp_path)


def ignore(step: int, seconds: float) -> None:
    assert step > 0
    assert seconds >= 0


def test_no_held_out_photograph_is_exported(scene: Scene, tmp_path: Path):
    marked = list(scene.photographs.colours)
    for index in TEST:
        marked[index] = torch.zeros_like(marked[index])
    scene = replace(scene, photographs=replace(scene.photographs, colours=tuple(marked)))
    opensplat.export(scene, tmp_path)
    pictures = sorted((tmp_path / "images").iterdir())
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"images/{picture.name}" for picture in pictures]
    assert len(pictures) == len(scene.train)
    positions = [np.array(frame["transform_matrix"])[:3, 3] for frame in frames]
    expected = scene.cameras.position_world[list(scene.train)].double().numpy()
    np.testing.assert_allclose(positions, expected, atol=1e-6)
    assert all(np.asarray(Image.open(picture)).mean() > 20 for picture in pictures)


def test_exported_points_lie_where_the_exported_photographs_show_them(scene: Scene, tmp_path: Path):
    """With OpenGL's axes, and with the principal point in the middle, as OpenSplat has it on CPUs."""
    factor = opensplat.export(scene, tmp_path).numpy()
    top = json.loads((tmp_path / "transforms.json").read_text())
    assert "fl_x" not in top, "what is at the top is cut to whole numbers"
    vertex = PlyData.read(tmp_path / top["ply_file_path"])["vertex"].data
    xyz = np.stack([vertex[axis] for axis in "xyz"], axis=-1).astype(float)
    colour = wall.texture(torch.from_numpy(xyz[:, :2])).numpy() * factor
    errors = []
    for frame in top["frames"]:
        picture = np.asarray(Image.open(tmp_path / frame["file_path"])) / 255
        height, width = picture.shape[:2]
        assert (frame["w"], frame["h"], frame["cx"], frame["cy"]) == (width, height, width / 2, height / 2)
        pose = np.array(frame["transform_matrix"])
        x, y, z = ((xyz - pose[:3, 3]) @ pose[:3, :3]).T
        u = width / 2 + frame["fl_x"] * x / -z
        v = height / 2 - frame["fl_y"] * y / -z
        inside = (z < 0) & (u > 1) & (v > 1) & (u < width - 1) & (v < height - 1)
        assert inside.sum() > 50
        errors.append(bilinear(picture, u[inside], v[inside]) - colour[inside])
    assert np.sqrt(np.square(np.concatenate(errors)).mean()) < 0.03


def bilinear(picture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    left, top = np.floor(u - 0.5).astype(int), np.floor(v - 0.5).astype(int)
    right, down = (u - 0.5 - left)[:, None], (v - 0.5 - top)[:, None]
    upper = picture[top, left] * (1 - right) + picture[top, left + 1] * right
    lower = picture[top + 1, left] * (1 - right) + picture[top + 1, left + 1] * right
    return upper * (1 - down) + lower * down


def test_a_gaussian_lands_on_its_pixel_of_a_held_out_photograph_at_its_exposure(scene: Scene, program: Path, run: Path):
    opensplat.train(program, scene, run, Budget(steps=3), CPU, None, ignore)
    render = opensplat.renderer(run, CPU)
    factor = torch.tensor(json.loads((run / "opensplat" / "job.json").read_text())["factor"])
    assert factor.min() < 0.95, "a scene whose factor matters"
    assert scene.points is not None
    for index in TEST:
        camera = scene.cameras[index]
        view = render(camera)
        uv, z = camera.project(scene.points.xyz_world[:1])
        u, v = uv[0, 0].floor().int().tolist()
        assert 0 <= u < camera.width, "a point that is in the picture"
        assert 0 <= v < camera.height, "a point that is in the picture"
        bright = view.colour.sum(-1) == view.colour.sum(-1).max()
        assert bright[v, u]
        assert view.depth[v, u] == pytest.approx(float(z), abs=2), "that behind it is at 25"
        # Its middle is where the camera's rounded principal point has it, as that of the photographs it learned from.
        light = (view.colour - view.colour[0, 0]).sum(-1).clamp(min=0)
        middle = (pixel_grid(camera.width, camera.height) * light.reshape(-1, 1)).sum(0) / light.sum()
        rounded = replace(camera, principal_px=torch.tensor([[27.5, 16.0]]))
        torch.testing.assert_close(middle, rounded.project(scene.points.xyz_world[:1])[0][0, 0], atol=0.03, rtol=0)
        grey = (0.4 / factor * camera.gain[0]).clamp(0, 1)
        torch.testing.assert_close(view.colour[0, 0], grey, atol=2e-3, rtol=0)


def test_the_principal_point_is_shifted_as_in_training_at_any_size(
    scene: Scene, program: Path, run: Path, monkeypatch: pytest.MonkeyPatch
):
    shown, show = [], opensplat.render_splats
    monkeypatch.setattr(
        opensplat, "render_splats", lambda splats, camera, *more: shown.append(camera) or show(splats, camera, *more)
    )
    scene.cameras.principal_px[3:] += torch.tensor([3.7, -2.2])  # another lens
    curve = make_curve(scene)
    opensplat.train(program, scene, run, Budget(minutes=0.3 / 60), CPU, curve, ignore)
    shown[2:] = []
    render = opensplat.renderer(run, CPU)
    for index in TEST:
        for width, height in ((48, 36), (12, 9), (96, 72)):
            render(scene.cameras[index].resized(width, height))
    middles = [[27.5, 16.0], [31.0, 13.5]]
    expected = [np.multiply(middle, 1 / 4) for middle in middles]
    expected += [np.multiply(middle, scale) for middle in middles for scale in (1, 1 / 4, 2)]
    np.testing.assert_allclose([camera.principal_px[0].tolist() for camera in shown], expected, atol=1e-4)
    job = json.loads((run / "opensplat" / "job.json").read_text())
    assert len(job["shifts"]) == 2, "one of each lens"
    (run / "opensplat" / "job.json").write_text(json.dumps({**job, "shifts": [[0.5, 0.5, 1e99, 0.0]]}))
    with pytest.raises(RunError, match=r"job\.json: shifts.*expected -1 to 1"):
        opensplat.renderer(run, CPU)
    (run / "opensplat" / "job.json").write_text(json.dumps({key: job[key] for key in ("factor", "trained")}))
    opensplat.renderer(run, CPU)(scene.cameras[0])
    assert shown[-1].principal_px.tolist() == [middles[0]], "of an older version"


def test_steps_are_made_and_nothing_is_saved_on_the_way(scene: Scene, program: Path, run: Path):
    steps = []
    done = opensplat.train(program, scene, run, Budget(steps=12), CPU, None, lambda step, _: steps.append(step))
    assert done.step == 12
    assert sorted(set(steps)) == list(range(1, 13))
    words = (run / "opensplat" / "words").read_text().split()
    assert words[words.index("-n") + 1] == "12"
    assert {"--cpu", "--keep-crs"} <= set(words)
    assert "--save-every" not in words
    assert opensplat.progress_of(run).step == 12


@pytest.mark.thorough
def test_minutes_end_training_and_the_last_save_counts(
    scene: Scene, program: Path, run: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("STAND_IN", "slow to load")
    curve = make_curve(scene)
    steps = []
    budget = Budget(minutes=0.8 / 60)
    done = opensplat.train(program, scene, run, budget, CPU, curve, lambda step, seconds: steps.append(seconds))
    assert done.step % opensplat.SAVE_EVERY_CPU == 0
    assert 20 <= done.step <= 80, "loading is not counted"
    assert 0 < done.seconds <= 0.8
    points = json.loads((run / "curve.json").read_text())
    assert points[-1][0] == done.seconds
    assert 2 <= len(points) <= 7
    assert all(before < after for (before, _), (after, _) in pairwise(points))
    assert [file.name for file in (run / "opensplat").glob("*.ply")] == ["splat.ply"]
    words = (run / "opensplat" / "words").read_text().split()
    assert words[words.index("-n") + 1] == "30000", "its learning rate falls as by default"


def test_a_save_counts_once_a_later_step_is_reported(
    scene: Scene, program: Path, run: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("STAND_IN", "saves slowly")  # half a second, during which the time is not seen to be over
    done = opensplat.train(program, scene, run, Budget(minutes=0.5 / 60), CPU, None, ignore)
    assert (done.step, done.seconds) == (10, pytest.approx(0.1, abs=0.08))
    for name in ("splat_10.ply", "splat_20.ply", "splat_x.ply"):
        (run / name).touch()
    assert opensplat._complete(run, 20) == {10: run / "splat_10.ply"}


def test_training_that_is_done_before_the_minutes_are_over_is_done(
    scene: Scene, program: Path, run: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(opensplat, "STEPS", 15)
    done = opensplat.train(program, scene, run, Budget(minutes=1.0), CPU, None, ignore)
    assert done.step == 15
    assert [file.name for file in (run / "opensplat").glob("*.ply")] == ["splat.ply"]


@pytest.mark.parametrize(
    ("mishap", "budget", "message"),
    [
        ("fails", Budget(steps=3), r"ended before it was done \(it ran out of luck\).*opensplat/log"),
        ("fails", Budget(minutes=1.0), r"ended before it was done \(it ran out of luck\).*opensplat/log"),
        ("garbage", Budget(steps=3), r"splat\.ply is damaged .*train again"),
        ("garbage", Budget(minutes=0.3 / 60), r"splat_\d0\.ply is damaged .*train again"),
        ("saves nothing", Budget(minutes=0.2 / 60), r"saves after 10: expected .*--minutes"),
    ],
)
def test_what_goes_wrong_in_the_program_is_reported(
    mishap: str, budget: Budget, message: str, scene: Scene, program: Path, run: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("STAND_IN", mishap)
    with pytest.raises((RunError, SceneError), match=message):
        opensplat.train(program, scene, run, budget, CPU, None, lambda step, seconds: None)
    with pytest.raises(RunError, match="not been trained to its end"):
        opensplat.renderer(run, CPU)


def test_an_interruption_ends_the_program(scene: Scene, program: Path, run: Path, monkeypatch: pytest.MonkeyPatch):
    started = []
    start = opensplat.subprocess.Popen

    def remember(*words, **options):
        started.append(start(*words, **options))
        return started[-1]

    def interrupt(step: int, seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(opensplat.subprocess, "Popen", remember)
    with pytest.raises(KeyboardInterrupt):
        opensplat.train(program, scene, run, Budget(minutes=5.0), CPU, None, interrupt)
    assert started[0].returncode == -signal.SIGTERM


def test_a_program_without_gpu_is_not_taken_for_one_with(scene: Scene, program: Path, run: Path):
    with pytest.raises(RunError, match=r"does not find cuda:0.*--device cpu"):
        opensplat.train(program, scene, run, Budget(steps=3), torch.device("cuda:0"), None, ignore)


def test_the_program_is_the_named_one_or_that_of_the_environment_or_of_the_path(
    program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delenv(opensplat.VARIABLE, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path / "none"))
    with pytest.raises(RunError, match=r"no program opensplat on PATH: expected OpenSplat.*--opensplat"):
        opensplat.find(None)
    with pytest.raises(RunError, match=r"run/opensplat is no program"):
        opensplat.find(tmp_path / "run" / "opensplat")
    assert opensplat.find(program) == program
    monkeypatch.setenv("PATH", str(tmp_path))
    assert opensplat.find(None) == program
    monkeypatch.setenv(opensplat.VARIABLE, str(tmp_path / "other"))
    with pytest.raises(RunError, match="other is no program"):
        opensplat.find(None)


def test_the_version_is_recorded_and_an_old_one_refused(program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert opensplat.version(program) == "1.1.4 (git commit 1234567)"
    monkeypatch.setenv("STAND_IN", "old")
    with pytest.raises(RunError, match=r"says '0\.9\.2': expected 1\.1 or newer"):
        opensplat.version(program)
    program.write_text("no program of this system")
    with pytest.raises(RunError, match=r"Exec format error.*expected 1\.1 or newer"):
        opensplat.version(program)


def test_a_scene_without_points_is_refused(scene: Scene, tmp_path: Path):
    with pytest.raises(SceneError, match="too few sparse points for OpenSplat"):
        opensplat.export(replace(scene, points=None), tmp_path)


def test_a_principal_point_outside_of_the_photograph_is_refused(scene: Scene, tmp_path: Path):
    scene.cameras.principal_px[1, 0] = 48.2
    with pytest.raises(SceneError, match=r"01\.jpg has its principal point outside of it, at \[48\.0"):
        opensplat.export(scene, tmp_path)


def test_training_is_deleted_with_all_that_it_left(scene: Scene, program: Path, run: Path):
    (run / "opensplat").mkdir()
    (run / "opensplat" / "mine.txt").write_text("keep")
    opensplat.delete_training(run)
    opensplat.train(program, scene, run, Budget(steps=3), CPU, None, ignore)
    (run / "opensplat" / "words").unlink()
    opensplat.delete_training(run)
    assert [file.name for file in run.rglob("*") if file.is_file()] == ["mine.txt"]


@pytest.mark.parametrize("job", ["[1]", '{"trained": 7}', '{"trained": [3, 30.0]}'])
def test_a_damaged_job_is_named(job: str, run: Path):
    (run / "opensplat").mkdir()
    (run / "opensplat" / "job.json").write_text(job)
    with pytest.raises(RunError, match=r"job\.json.*expected"):
        opensplat.progress_of(run)


def test_points_have_the_exposure_of_the_photographs(scene: Scene):
    assert scene.points is not None
    factor, first = exposure_factor(scene.cameras[list(scene.train)]), scene.train[0]
    mine = scene.points.camera_index == first
    u, v = scene.points.uv_px[mine].floor().long().unbind(-1)
    inside = (u >= 0) & (v >= 0) & (u < 48) & (v < 36)
    found = point_colours(scene, factor)[scene.points.point_index[mine][inside].numpy()]
    assert (found == at_common_exposure(scene, first, factor)[v[inside], u[inside]]).all()
    assert (found != scene.photographs[first][v[inside], u[inside]].numpy()).mean() > 0.6
