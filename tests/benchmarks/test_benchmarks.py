"""The benchmarks: that they count right, repeat nothing, and leave no trace."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import textured_wall as wall
import torch
from scenes_on_disk import PINHOLE, survey, write_colmap
from torch import nn

from benchmarks import frames, memory, speed
from benchmarks.__main__ import COMMANDS, main
from tidefield import cli
from tidefield.commands import render
from tidefield.compare.run import Usage, run_measured
from tidefield.config import PAPER, SWIFT, Config, EncoderConfig
from tidefield.data.load import load_scene
from tidefield.errors import RunError
from tidefield.geometry.cameras import pixel_grid
from tidefield.model.network import make_network
from tidefield.parallel import in_parallel, sequential
from tidefield.train.checkpoint import write_weights

CPU = torch.device("cpu")


def tiny(preset: str) -> Config:
    config = {"paper": PAPER, "swift": SWIFT}[preset]
    one = replace(config.network.passes[-1], stride=1, samples=4, feature_channels=8, hidden=8)
    encoder = EncoderConfig((8, 8, 8, 8), (1, 1, 1), instance_norm=False)
    network = replace(config.network, encoder=encoder, passes=(one,), views=2)
    train = replace(config.train, tiles=1, tile_px=8, crop_px=config.train.crop_px and 32)
    return replace(config, network=network, train=train)


def test_memory_and_failure_of_a_process_are_reported() -> None:
    usage = run_measured(
        [sys.executable, "-c", "import os; b'x' * 600_000_000; assert os.environ['A'] == 'b'"], {"A": "b"}
    )
    assert usage.peak_memory_bytes > 600_000_000
    assert usage.seconds > 0
    with pytest.raises(SystemExit, match="3"):  # without a second message
        run_measured([sys.executable, "-c", "raise SystemExit(3)"], {})
    with pytest.raises(RunError, match="SIGKILL ended"):
        run_measured([sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"], {})


def test_time_is_charged_to_the_innermost_stage() -> None:
    moments = iter([0.0, 1.0, 3.0, 6.0, 10.0, 15.0])
    clock = speed.Clock(CPU, now=lambda: next(moments))
    clock.begin("colour")
    clock.begin("encoding")
    clock.end()
    clock.end()
    clock.stop()
    assert clock.seconds == {"encoding": 3.0, "colour": 2.0 + 4.0, "rest": 1.0 + 5.0}


def test_products_and_attention_are_counted() -> None:
    a, b = torch.rand(4, 5), torch.rand(5, 6)
    assert speed.flops_of(lambda: a @ b) == 2 * 4 * 5 * 6
    query = torch.rand(3, 2, 7, 8)
    attention = nn.functional.scaled_dot_product_attention
    with torch.inference_mode():
        assert speed.flops_of(lambda: attention(query, query, query)) == 2 * 2 * (3 * 2 * 7 * 7 * 8)


@pytest.mark.parametrize("rays", [1, 1024, 5000, 10**9])
def test_a_window_holds_rays_of_its_camera(rays: int) -> None:
    camera = wall.cameras(1, width=100, height=75)
    part = speed.window(camera, rays)
    assert part.width % 32 == part.height % 32 == 0
    assert part.width * part.height <= max(rays, 1024)
    corner = (camera.principal_px - part.principal_px)[None]
    inside = pixel_grid(part.width, part.height)[None]
    torch.testing.assert_close(part.directions_world(inside), camera.directions_world(inside + corner))
    assert (corner >= 0).all()
    assert (corner[0] + part.size_px <= camera.size_px).all()


@pytest.mark.thorough
def test_speed_is_measured_stage_by_stage_and_leaves_no_trace() -> None:
    scene = wall.scene(wall.cameras(4))
    before = torch.Tensor.backward
    configs = {preset: tiny(preset) for preset in ("paper", "swift")}
    report = speed.measure_speed(scene, configs, CPU, speed.Effort(0.0, least=1))
    assert torch.Tensor.backward is before
    assert set(report["ratios"]) == {"training", "rendering"}
    for preset in ("paper", "swift"):
        training, rendering = (report["presets"][preset][kind] for kind in ("training", "rendering"))
        missing = {"ray transformer"} if preset == "swift" else set()
        assert list(training["seconds_per_ray"]) == [stage for stage in speed.STAGES if stage not in missing]
        backwards = {"encoding", "backward", "optimiser"}
        assert set(rendering["seconds_per_ray"]) == set(speed.STAGES) - backwards - missing
        assert all(seconds > 0 for pace in (training, rendering) for seconds in pace["seconds_per_ray"].values())
        assert training["flops_per_ray"] > rendering["flops_per_ray"] > 0
        assert report["presets"][preset]["encoding_seconds"] > 0
        assert all(0 < share < 1 for share in report["presets"][preset]["shares"]["training"].values())
    text = "\n".join(part.markdown() for part in speed.speed_tables(report))
    assert "| ray transformer |" in text


def test_tasks_run_in_the_calling_thread_while_they_are_profiled() -> None:
    tasks = [threading.get_ident] * 3
    with sequential():
        assert set(in_parallel(tasks, "cpu")) == {threading.get_ident()}
    assert threading.get_ident() not in in_parallel(tasks, "cpu")


def test_the_measuring_process_stays_small() -> None:
    code = "import sys, benchmarks.__main__, benchmarks.memory; "
    code += "assert not {'torch', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], check=True)


@pytest.mark.thorough
def test_a_large_frame_is_rendered_from_large_photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(memory, "SURVEY_WIDTH", 32)
    monkeypatch.setattr(memory, "ProcessPoolExecutor", lambda workers, mp_context: ThreadPoolExecutor(workers))
    monkeypatch.setattr(cli, "_set_up", lambda verbosity: None)
    asked = []

    def run(command: Sequence[str], environment: Mapping[str, str]) -> Usage:
        folder = Path(command[4])
        scene = load_scene(folder.parent / "scene")
        assert (scene.cameras.width, scene.cameras.height) == (96, 72)
        assert scene.names[scene.test[0]] == command[command.index("--camera") + 1]
        monkeypatch.setattr(render, "render", lambda options, console: asked.append(options.camera))
        monkeypatch.setattr(sys, "argv", ["tidefield", *command[3:]])
        cli.main()
        assert folder.parent in Path(environment["XDG_CACHE_HOME"]).parents
        return Usage(1.0, 5_000_000_000)

    memory.memory(tmp_path, "swift", 96, 4, "cpu", run)
    assert len(asked) == 1
    assert json.loads((tmp_path / "memory.json").read_text())["size_px"] == [96, 72]
    assert {path.name for path in tmp_path.iterdir()} == {"cache", "memory.json"}


def test_copies_of_a_survey_lie_apart() -> None:
    own = wall.scene(wall.cameras(6, step=0.3), (0,))
    many = frames.among_copies(own, 15)
    assert (len(many.names), len(set(many.names)), len(many.cameras)) == (15, 15, 15)
    assert many.train == (1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 13, 14)
    assert torch.equal(many.photographs[14], own.photographs[2])
    assert many.points is not None
    assert own.points is not None
    uv, _ = many.cameras[14].project(many.points.xyz_world)
    mine = many.points.camera_index == 14
    torch.testing.assert_close(uv[0, many.points.point_index[mine]], many.points.uv_px[mine], atol=1e-2, rtol=0)
    copies = many.cameras.position_world[[0, 6, 12]]
    assert torch.cdist(copies, copies).fill_diagonal_(torch.inf).min() > 3


@pytest.mark.thorough
def test_frames_are_measured_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, small = tmp_path / "scene", tiny("swift")
    write_colmap(scene, survey(PINHOLE))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(frames, "PRESETS", {"swift": small})
    monkeypatch.setattr(frames, "COUNTS", (12,))
    write_weights(tmp_path / "w.safetensors", make_network(small.network), small, {})
    asked = []

    def run(command: Sequence[str], environment: Mapping[str, str]) -> Usage:
        asked.extend(command)
        assert not Path(environment["XDG_CACHE_HOME"]).exists(), "nothing is decoded before"
        return Usage(12.5, 1)

    record = frames.frames(scene, tmp_path, "swift", tmp_path / "w.safetensors", 32, None, "cpu", run)
    camera = load_scene(scene).cameras[0]
    assert record["size_px"] == [32, round(32 * camera.height / camera.width)]
    assert asked[asked.index("--height") + 1] == str(record["size_px"][1])
    assert record == json.loads((tmp_path / "frames.json").read_text())
    assert "--zero-shot" in asked
    assert record["first"]["seconds"] == 12.5
    assert list(record["by_photographs"]) == ["9", "12"]
    assert all(len(made.rows) > 1 for made in frames.frame_tables(record))


@pytest.fixture
def untuned(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process of all tests stays as it is."""
    monkeypatch.setattr("benchmarks.__main__.tune_process", lambda: None)


@pytest.mark.usefixtures("untuned")
def test_without_a_name_speed_is_measured(tmp_path: Path, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--quick", "--runs", str(tmp_path)])
    assert ended.value.code == 2
    assert "not worth storing" in capsys.readouterr().err


@pytest.mark.usefixtures("untuned")
@pytest.mark.parametrize("words", ["--help", *(f"{name} --help" for name in COMMANDS)])
def test_help_is_given(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(shlex.split(words))
    assert ended.value.code == 0
    assert "usage: python -m benchmarks" in capsys.readouterr().out
