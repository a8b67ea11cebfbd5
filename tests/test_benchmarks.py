"""The benchmarks: that they count right, repeat nothing, and say what was stored."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import textured_wall as wall
import torch
from torch import nn

from benchmarks import bars, memory, quality, records, speed, stages, table
from benchmarks.__main__ import main
from benchmarks.records import Took
from tidefield import cli, commands
from tidefield.config import PAPER, SWIFT, Config, EncoderConfig
from tidefield.data.load import load_scene
from tidefield.errors import RunError, SceneError
from tidefield.geometry.cameras import pixel_grid
from tidefield.model.views import Views
from tidefield.train.loop import Trainer

CPU = torch.device("cpu")
SETTINGS = quality.Settings(minutes=10.0, width=400, device="cpu")


def tiny(preset: str) -> Config:
    config = {"paper": PAPER, "swift": SWIFT}[preset]
    stage = replace(config.network.stages[-1], stride=1, samples=4, feature_channels=8, hidden=8)
    encoder = EncoderConfig((8, 8, 8, 8), (1, 1, 1), instance_norm=False)
    network = replace(config.network, encoder=encoder, stages=(stage,), views=2)
    train = replace(config.train, tiles=1, tile_px=8, crop_px=config.train.crop_px and 32)
    return replace(config, network=network, train=train)


class Children:
    """Stands in for the processes: writes what they would leave, and remembers what they were asked."""

    def __init__(self) -> None:
        self.words: list[list[str]] = []

    def __call__(self, command: Sequence[str], environment: Mapping[str, str]) -> Took:
        words = list(command[3:])
        assert command[:3] == [sys.executable, "-m", "tidefield.cli"]
        self.words.append(words)
        folder = Path(words[2] if "--method" in words or words[0] == "train" else words[1])
        folder.mkdir(parents=True, exist_ok=True)
        name = "run.json" if words[0] == "train" else "evaluation.json"
        (folder / name).write_text("{}")
        return Took(12.5, 3_000_000_000)


def scenes(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).mkdir(parents=True)
    return folder


def test_a_childs_memory_and_its_failure_are_seen() -> None:
    took = records.run_measured(
        [sys.executable, "-c", "import os; b'x' * 600_000_000; assert os.environ['A'] == 'b'"], {"A": "b"}
    )
    assert took.peak_memory_bytes > 600_000_000
    assert took.seconds > 0
    with pytest.raises(RunError, match="status 3"):
        records.run_measured([sys.executable, "-c", "raise SystemExit(3)"], {})


def test_every_moment_is_charged_to_the_innermost_stage() -> None:
    moments = iter([0.0, 1.0, 3.0, 6.0, 10.0, 15.0])
    clock = stages.Clock(CPU, now=lambda: next(moments))
    clock.begin("colour")
    clock.begin("gathering")
    clock.end(torch.zeros(5))
    clock.end()
    clock.stop()
    assert clock.seconds == {"gathering": 3.0, "colour": 2.0 + 4.0, "rest": 1.0 + 5.0}
    assert clock.bytes == {"gathering": 20, "colour": 0}


def test_shared_memory_counts_once() -> None:
    values = torch.zeros(10, 7)
    assert stages.bytes_of((values[:, :3], {"rest": [values[:, 3:]]})) == values.nbytes
    assert stages.bytes_of(torch.zeros(1, 7).expand(10, 7)) == 28


def test_arithmetic_is_that_of_products_and_attention() -> None:
    a, b = torch.rand(4, 5), torch.rand(5, 6)
    assert stages.flops_of(lambda: a @ b) == 2 * 4 * 5 * 6
    query = torch.rand(3, 2, 7, 8)
    attention = nn.functional.scaled_dot_product_attention
    with torch.inference_mode():
        assert stages.flops_of(lambda: attention(query, query, query)) == 2 * 2 * (3 * 2 * 7 * 7 * 8)


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


def test_speed_is_measured_stage_by_stage_and_leaves_no_trace() -> None:
    scene = wall.scene(wall.cameras(4))
    before = Views.read, torch.Tensor.backward
    configs = {preset: tiny(preset) for preset in ("paper", "swift")}
    report = speed.measure_speed(scene, configs, CPU, speed.Effort(0.0, least=1), lambda line: None)
    assert (Views.read, torch.Tensor.backward) == before
    assert set(report["ratios"]) == {"training", "rendering"}
    for preset in ("paper", "swift"):
        training, rendering = (report["presets"][preset][kind] for kind in ("training", "rendering"))
        assert list(training["seconds_per_ray"]) == list(stages.STAGES)
        assert set(rendering["seconds_per_ray"]) == set(stages.STAGES) - {
            "batches", "encoding", "backward", "optimiser"
        }  # fmt: skip
        assert all(seconds > 0 for pace in (training, rendering) for seconds in pace["seconds_per_ray"].values())
        assert training["flops_per_ray"] > rendering["flops_per_ray"] > 0
        assert report["presets"][preset]["encoding_seconds"] > 0
        assert all(0 < share < 1 for share in report["presets"][preset]["shares"]["training"].values())
    text = "\n".join(part.markdown() for part in table.speed_tables(report))
    assert "| ray transformer |" in text


def test_copies_of_rendering_are_at_least_what_is_gathered() -> None:
    scene, config = wall.scene(wall.cameras(4)), tiny("paper")
    trainer = Trainer(config, scene, 0, CPU)
    pace, _ = speed.measure_rendering(trainer, speed.Effort(0.0, least=1))
    views, samples, channels = 2, 4, 8
    assert pace.bytes_per_ray > 2 * views * samples * (3 + channels) * 4


def test_what_is_finished_is_not_repeated(tmp_path: Path) -> None:
    data, runs, children = scenes(tmp_path / "data", "a", "b"), tmp_path / "runs", Children()
    methods = ["sparse-depth", "swift"]

    def again() -> list[list[str]]:
        children.words.clear()
        quality.measure_quality(data, runs, ["a", "b"], methods, SETTINGS, children, lambda line: None)
        return children.words

    assert [words[0] for words in again()] == ["evaluate", "train", "evaluate"] * 2
    record = json.loads((runs / "b" / "swift" / "process.json").read_text())
    assert record["train"]["peak_memory_bytes"] == 3_000_000_000
    assert record["train"]["command"].startswith("tidefield train DATA/b RUNS/b/swift --preset swift --minutes 10 ")
    assert again() == []
    (runs / "a" / "swift" / "evaluation.json").unlink()
    assert [words[:2] for words in again()] == [["evaluate", str(runs / "a" / "swift")]]


def test_a_training_that_was_broken_off_begins_anew(tmp_path: Path) -> None:
    data, runs, children = scenes(tmp_path / "data", "a"), tmp_path / "runs", Children()
    (runs / "a" / "paper").mkdir(parents=True)
    (runs / "a" / "paper" / "run.json").write_text("{}")
    quality.measure_quality(data, runs, ["a"], ["paper"], SETTINGS, children, lambda line: None)
    assert children.words[0][0] == "train"
    assert children.words[0][-1] == "--overwrite"


def test_results_of_other_settings_are_not_mixed_in(tmp_path: Path) -> None:
    data, runs, children = scenes(tmp_path / "data", "a"), tmp_path / "runs", Children()
    for methods, settings in (["plane-sweep"], SETTINGS), (["plane-sweep"], replace(SETTINGS, minutes=1.0)):
        quality.measure_quality(data, runs, ["a"], methods, settings, children, lambda line: None)
    with pytest.raises(RunError, match="--runs"):
        quality.measure_quality(data, runs, ["a"], ["plane-sweep"], replace(SETTINGS, width=200), children, print)
    with pytest.raises(SceneError, match=r"no c \(found: \['a'\]"):
        quality.measure_quality(data, runs, ["a", "c"], ["plane-sweep"], SETTINGS, children, print)
    assert len(children.words) == 1


def test_the_measuring_process_stays_small() -> None:
    code = "import sys, benchmarks.__main__, benchmarks.memory, benchmarks.quality, benchmarks.table; "
    code += "assert not {'torch', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[1], check=True)


@pytest.mark.parametrize("method", bars.METHODS)
def test_tidefield_understands_what_it_is_asked(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    called = []
    monkeypatch.setattr(cli, "_begin", lambda talk: None)
    for name, words in quality.steps(Path("data"), Path("runs"), "a", method, SETTINGS).items():
        monkeypatch.setattr(commands, name, lambda *args, name=name, **options: called.append(name))
        monkeypatch.setattr(sys, "argv", ["tidefield", *words])
        cli.main()
    assert called == list(quality.steps(Path("data"), Path("runs"), "a", method, SETTINGS))


def test_a_large_frame_is_rendered_from_large_photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(memory, "SURVEY_WIDTH", 32)
    monkeypatch.setattr(cli, "_begin", lambda talk: None)
    asked = []

    def run(command: Sequence[str], environment: Mapping[str, str]) -> Took:
        folder = Path(command[4])
        scene = load_scene(folder.parent / "scene")
        assert (scene.cameras.width, scene.cameras.height) == (96, 72)
        assert scene.names[scene.test[0]] == command[command.index("--camera") + 1]
        monkeypatch.setattr(commands, "render", lambda options, console: asked.append(options.camera))
        monkeypatch.setattr(sys, "argv", ["tidefield", *command[3:]])
        cli.main()
        assert folder.parent in Path(environment["XDG_CACHE_HOME"]).parents
        return Took(1.0, 5_000_000_000)

    memory.measure_memory(tmp_path, "swift", 96, 4, "cpu", run, memory.make_run)
    assert len(asked) == 1
    assert json.loads((tmp_path / "memory.json").read_text())["size_px"] == [96, 72]
    assert {path.name for path in tmp_path.iterdir()} == {"cache", "memory.json"}


def keep_result(runs: Path, scene: str, method: str, psnr: float, peak: float = 2e9, minutes: float = 10.0) -> None:
    mean = {"psnr_seen_cc": psnr, "ssim_seen_cc": psnr / 40, "flip_seen_cc": 0.1}
    mean |= {"lpips_alex_seen_cc": None, "lpips_vgg_seen_cc": None}
    reasons = {"lpips_alex_seen_cc": "no weights", "lpips_vgg_seen_cc": "no weights", "lpips_vgg": "no weights"}
    evaluation = {"mean": mean | {"reasons": reasons}, "seconds_per_frame": 2.0}
    evaluation |= {"rays_per_second": 5e4, "configuration": {}}
    step = {"command": f"tidefield evaluate RUNS/{scene}/{method}", "seconds": 1.0, "peak_memory_bytes": peak}
    process = {"settings": {"minutes": minutes, "width": 400, "device": "cpu"}, "evaluate": step | records.stamp()}
    if method in ("swift", "paper"):
        evaluation["configuration"] = {"trained": {"steps": 1234, "seconds": 600.0}}
        process["train"] = process["evaluate"]
    for name, data in (("evaluation.json", evaluation), ("process.json", process)):
        records.write_json(runs / scene / method / name, data)


def keep_four(runs: Path, gains: Sequence[float]) -> None:
    for scene, gain in zip(quality.SCENES, gains, strict=True):
        for method, psnr in {"plane-sweep": 20.0, "sparse-depth": 25.0, "swift": 25.0 + gain, "paper": 24.0}.items():
            keep_result(runs, scene, method, psnr)


def test_bars_are_met_or_not(tmp_path: Path) -> None:
    keep_four(tmp_path, [1.0, 2.0, 3.0, -0.5])
    psnr, ssim, mean, fast, loss, training, frame = bars.judge(bars.read_stored(tmp_path))
    assert (psnr.met, ssim.met, psnr.result) == (False, False, "least: -0.50 dB (brighton_beach)")
    assert (mean.met, mean.result) == (False, "+1.38 dB")
    assert (loss.met, loss.result) == (True, "least: +0.50 dB (brighton_beach)")
    assert (training.met, fast.met, frame.met) == (True, None, None)
    keep_result(tmp_path, "brighton_beach", "swift", 25.3, peak=4.1e9)
    psnr, _, mean, _, _, training, _ = bars.judge(bars.read_stored(tmp_path))
    assert (psnr.met, mean.met) == (True, True)
    assert (training.met, training.result) == (False, "most: 4.10 GB (swift on brighton_beach)")


def test_bars_need_all_four_scenes_at_the_right_settings(tmp_path: Path) -> None:
    keep_four(tmp_path, [1.0, 2.0, 3.0, 4.0])
    keep_result(tmp_path, "swindale", "swift", 30.0, minutes=2.0)
    judged = bars.judge(bars.read_stored(tmp_path))
    assert [bar.met for bar in judged] == [None] * len(judged)
    assert judged[0].result == "not measured on swindale"


def test_the_page_shows_what_was_stored_and_what_is_missing(tmp_path: Path) -> None:
    keep_four(tmp_path, [1.0, 2.0, 3.0, 4.0])
    keep_result(tmp_path, "another", "swift", 31.5)
    frame = {"preset": "swift", "size_px": [4000, 3000], "photographs": 12, "device": "cpu", "command": "memory"}
    records.write_json(
        tmp_path / "memory.json", {**frame, "seconds": 70, "peak_memory_bytes": 6.5e9, **records.stamp()}
    )
    table.write_page(tmp_path, tmp_path / "docs" / "results.md")
    text = (tmp_path / "docs" / "results.md").read_text()
    for line in (
        "| and in the mean by 1.5 dB of PSNR | +2.50 dB | met |",
        "| Rendering a frame of 4000 x 3000 px stays under 6 GB | 6.50 GB (swift) | not met |",
        "| swift renders 10 times as many rays per second as paper | not measured on a CPU | - |",
        "| swindale | 20.00 | 25.00 | 27.00 | 24.00 | +2.00 |",
        "| mean of these four | 20.00 | 25.00 | 27.50 | 24.00 | +2.50 |",
        "| another | - | - | 31.50 | - | - |",
        "| caliterra, swift | 10.0 | 1,234 | 2.00 GB | 2.00 | 50,000 | 2.00 GB |",
        "- 10 minutes of training at 400 px, on cpu.",
        "    tidefield evaluate RUNS/SCENE/swift",
    ):
        assert line in text.splitlines(), line
    assert "No lpips_alex, lpips_vgg: no weights." in text.splitlines()
    assert "### LPIPS" not in text
    assert "### FLIP" in text
    with pytest.raises(RunError, match="no results"):
        table.write_page(tmp_path / "docs", tmp_path / "other.md")


def test_without_a_name_speed_is_measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--quick", "--runs", str(tmp_path)])
    assert ended.value.code == 2
    assert "not worth keeping" in capsys.readouterr().err


@pytest.mark.parametrize("words", ["--help", "speed --help", "quality --help", "memory --help", "table --help"])
def test_help_is_given(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(shlex.split(words))
    assert ended.value.code == 0
    assert "usage: python -m benchmarks" in capsys.readouterr().out


def test_the_readme_names_every_file() -> None:
    root = Path(__file__).parents[1]
    (tree,) = re.findall(r"^benchmarks/\n(.*?)^```$", (root / "README.md").read_text(), flags=re.MULTILINE | re.DOTALL)
    named = {line.split()[0] for line in tree.splitlines()}
    assert named == {path.name for path in (root / "benchmarks").glob("*.py")} - {"__init__.py"}
