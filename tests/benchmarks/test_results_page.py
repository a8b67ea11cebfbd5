"""What is made of stored measurements: bars, the page of results, and the card beside shipped weights."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
import torch
from tidefield.train.weights import sha256, write_weights

from benchmarks import bars, card, table
from benchmarks.begun import by_length, length_tables
from tidefield import machine as this_machine
from tidefield.compare.results import read_figures
from tidefield.compare.run import METHODS
from tidefield.config import PAPER, SWIFT
from tidefield.errors import RunError
from tidefield.evaluation.evaluate import NAMES
from tidefield.evaluation.metrics import SUFFIXES
from tidefield.files import read_json, write_json
from tidefield.model.network import Network


def keep_result(
    file: Path,
    scene: str,
    method: str,
    psnr: float,
    peak: int = 2_000_000_000,
    minutes: float | None = 10,
    from_scratch: bool = False,
    steps: int | None = None,
) -> None:
    """Add one to what is in the file, in place of an older one."""
    mean: dict = dict.fromkeys(NAMES, 0.1)
    mean |= {"psnr" + suffix: psnr for suffix in SUFFIXES} | {"ssim" + suffix: psnr / 40 for suffix in SUFFIXES}
    mean |= {name: None for name in NAMES if name.startswith("lpips_alex")}
    evaluation = {"mean": mean | {"reasons": {"lpips_alex": "no weights"}}, "seconds_per_frame": 2.0}
    evaluation |= {"rays_per_second": 5e4, "configuration": {}}
    step = {"command": f"tidefield evaluate RUN {method}", "seconds": 1.0, "peak_memory_bytes": peak}
    process = {
        "settings": {"minutes": minutes, "steps": steps, "width": 400, "device": "cpu", "from_scratch": from_scratch},
        "evaluate": step | this_machine.describe(),
    }
    if method not in bars.UNTRAINED:
        evaluation["configuration"] = {"trained": {"steps": 1234, "seconds": 600.0}}
        process["train"] = process["evaluate"]
    kept = [r for r in (read_json(file) or {"results": []})["results"] if (r["scene"], r["method"]) != (scene, method)]
    added = {"scene": scene, "method": method, "evaluation": evaluation, "process": process, "curve": []}
    write_json(file, {"results": [*kept, added]})


def keep_all(file: Path, psnr: Mapping[str, float], others: Mapping[str, float] | None = None) -> None:
    others = others or {"plane-sweep": 20.0, "sparse-depth": 25.0, "nerfacto": 22.0, "paper": 24.0, "zero-shot": 23.0}
    for scene in bars.SCENES:
        for method, value in {"tidefield": psnr.get(scene, 27.0), **others}.items():
            keep_result(file, scene, method, value)


def move_to_another_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    here = this_machine.describe()
    other = here | {"machine": here["machine"] | {"processor": "Another"}}
    monkeypatch.setattr(this_machine, "describe", lambda: other)


def judged(file: Path) -> dict[str, bars.Bar]:
    results = read_figures([file], bars.SCENES, METHODS)
    return {bar.aim: bar for bar in bars.judge(results, bars.Kept(), by_length(results, []))}


def test_bars_are_met_or_not(tmp_path: Path) -> None:
    file = tmp_path / "comparison.json"
    keep_all(file, {"caliterra": 26.0, "turin_lot": 28.0, "brighton_beach": 24.5, "fern": 21.9})
    found = judged(file)
    assert {aim: (bar.met, bar.result) for aim, bar in found.items()} == {
        "PSNR above the better floor on each survey": (False, "least: -0.50 dB (brighton_beach)"),
        "SSIM above the better floor on each survey": (False, "least: -0.0125 (brighton_beach)"),
        "PSNR above the better floor, by 1.5 dB in the mean": (False, "+1.38 dB"),
        "PSNR not below the preset paper's on any survey": (True, "least: +0.50 dB (brighton_beach)"),
        "PSNR above Nerfacto's on each scene": (False, "least: -0.10 dB (fern)"),
        "SSIM above Nerfacto's on each scene": (False, "least: -0.0025 (fern)"),
        "LPIPS (VGG) below Nerfacto's on each scene": (False, "least: +0.0000 (brighton_beach)"),
        "PSNR above Nerfacto's, doubly seen pixels, by 3.0 dB in the mean": (True, "+4.31 dB"),
        "Zero-shot, PSNR above Nerfacto's where nothing was learned": (True, "least: +1.00 dB (caliterra)"),
        "Zero-shot, SSIM above Nerfacto's where nothing was learned": (True, "least: +0.0250 (caliterra)"),
        "Zero-shot, LPIPS (VGG) below Nerfacto's where nothing was learned": (False, "least: +0.0000 (caliterra)"),
        "Zero-shot, PSNR above the better floor on each scene": (False, "least: -2.00 dB (brighton_beach)"),
        "Zero-shot, SSIM above the better floor on each scene": (False, "least: -0.0500 (brighton_beach)"),
        "Zero-shot, LPIPS (VGG) below the better floor on each scene": (False, "least: +0.0000 (brighton_beach)"),
        **{
            aim: (None, "not measured on caliterra, swindale, turin_lot, fern")
            for metric in ("PSNR", "SSIM", "LPIPS (VGG)")
            for aim in (
                f"Ten seconds of training, {metric} not worse than zero-shot's",
                f"One minute of training, {metric} better than after ten from scratch",
            )
        },
        "swift renders 10 times as many rays per second as nerfacto": (False, "least: 1.0 times (brighton_beach)"),
        "swift renders 20 times as many rays per second as paper": (None, "not measured on a CPU"),
        "From a scene on disk to the first 800 x 600 view, zero-shot, in 30 s": (None, "not measured on a CPU"),
        "Every further view in 10 s": (None, "not measured on a CPU"),
        "A view takes at most 110% of the time however many photographs there are": (None, "not measured on a CPU"),
        "Training at 400 px stays under 4 GB": (True, "most: 2.00 GB (tidefield on turin_lot)"),
        "Rendering a frame of 4000 x 3000 px stays under 6 GB": (None, "not measured at this size on a CPU"),
    }
    keep_result(file, "brighton_beach", "tidefield", 25.3, peak=4_100_000_000)
    again = judged(file)
    assert again["PSNR above the better floor on each survey"].met
    memory = again["Training at 400 px stays under 4 GB"]
    assert (memory.met, memory.result) == (False, "most: 4.10 GB (tidefield on brighton_beach)")


def test_bars_need_all_scenes_at_the_right_settings(tmp_path: Path) -> None:
    file = tmp_path / "comparison.json"
    keep_all(file, {})
    keep_result(file, "swindale", "tidefield", 30.0, minutes=2.0)
    found = judged(file)
    assert not any(bar.met is not None for aim, bar in found.items() if not aim.startswith("Zero-shot"))
    assert found["SSIM above Nerfacto's on each scene"].result == "not measured on swindale"


def test_lengths_of_training_are_compared(tmp_path: Path) -> None:
    found = []
    for name, minutes, scratch, psnr in (
        ("seconds", 1 / 6, False, 23.996),
        ("minute", 1.0, False, 24.5),
        ("scratch", 10.0, True, 24.25),
    ):
        for scene in bars.BEGUN:
            keep_result(tmp_path / f"{name}.json", scene, "tidefield", psnr, minutes=minutes, from_scratch=scratch)
        found.append(read_figures([tmp_path / f"{name}.json"], (), METHODS))
    for scene in ("fern", "swindale", "caliterra", "turin_lot", "lego"):
        keep_result(tmp_path / "comparison.json", scene, "zero-shot", 24.0)
    compared = read_figures([tmp_path / "comparison.json"], bars.SCENES, METHODS)
    lengths = by_length(compared, found)
    assert list(lengths) == ["zero-shot", "10 s", "1 min", "10 min from scratch"]
    made = length_tables(lengths)[0]
    assert list(made.rows[0]) == ["caliterra", "24.00", "24.00", "24.50", "24.25"]
    assert {row[0] for row in made.rows} == set(bars.BEGUN), "lego was only looked at"
    judged = {bar.aim: bar for bar in bars.judge(compared, bars.Kept(), lengths)}
    assert judged["Ten seconds of training, PSNR not worse than zero-shot's"].met
    assert judged["One minute of training, PSNR better than after ten from scratch"].result.startswith("least: +0.25")
    keep_result(tmp_path / "seconds.json", "fern", "tidefield", 23.9, minutes=1 / 6)
    worse = by_length(compared, [read_figures([tmp_path / "seconds.json"], (), METHODS), *found[1:]])
    bar = {bar.aim: bar for bar in bars.judge(compared, bars.Kept(), worse)}
    assert not bar["Ten seconds of training, PSNR not worse than zero-shot's"].met


def test_the_page_shows_what_was_stored_and_what_is_missing(tmp_path: Path) -> None:
    comparison, ablation = tmp_path / "comparison.json", tmp_path / "ablation.json"
    runs, out, begun = tmp_path / "runs", tmp_path / "docs" / "results.md", []
    keep_all(comparison, {"brighton_beach": 29.0})
    keep_result(comparison, "another", "tidefield", 31.5)
    keep_result(ablation, "swindale", "tidefield", 27.0)
    keep_result(ablation, "swindale", "no-ray-transformer", 26.0)
    frame = {"preset": "swift", "size_px": [4000, 3000], "photographs": 12, "device": "cpu", "command": "memory"}
    write_json(runs / "memory.json", {**frame, "seconds": 70, "peak_memory_bytes": 6.5e9, **this_machine.describe()})
    kept = {"first": {"seconds": 25.0}, "further_seconds": 9.5, "by_photographs": {"18": 8.0, "200": 8.4}}
    steady = {"with fading": {"mean_levels": 1.0, "greatest_levels": 2.0, "greatest_of_a_tile_levels": 3.0}}
    steady |= {"without": {"mean_levels": 1.5, "greatest_levels": 4.0, "greatest_of_a_tile_levels": 5.0}}
    views = {"preset": "swift", "size_px": [800, 600], "device": "cpu", "command": "frames", "steadiness": steady}
    write_json(runs / "frames.json", {**views, **kept, **this_machine.describe()})
    table.write_page([comparison], [ablation], begun, runs, out)
    text = out.read_text()
    for line in (
        "| PSNR above the better floor, by 1.5 dB in the mean | +2.50 dB | met |",
        "| Rendering a frame of 4000 x 3000 px stays under 6 GB | 6.50 GB (swift) | not met |",
        "| swift renders 20 times as many rays per second as paper | not measured on a CPU | - |",
        "| Every further view in 10 s | 9.5 s | met |",
        "| one view again and again, of 200 photographs | 8.40 |",
        "| without | 1.50 | 4.00 | 5.00 |",
        "| swindale | **27.00** | 23.00 | 24.00 | 22.00 | 20.00 | 25.00 |",
        "| another | 31.50 | - | - | - | - | - |",
        "| caliterra, tidefield | 10.0 | 1,234 | 2.00 | 50,000 | 2.00, 2.00 |",
        "    tidefield evaluate RUN tidefield",
        "No lpips_alex: no weights.",
        "| no-ray-transformer | 26.00 | 26.00 | 0.6500 | 0.1000 | 50,000 | -1.00 |",
    ):
        assert line in text.splitlines(), line
    assert "### LPIPS, AlexNet" not in text
    assert "### FLIP" in text
    with pytest.raises(RunError, match="no results"):
        table.write_page([], [ablation.with_name("none.json")], [], tmp_path / "docs", tmp_path / "other.md")


def test_of_several_machines_the_page_says_what_each_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, file, minute = this_machine.describe(), tmp_path / "comparison.json", tmp_path / "minute.json"
    keep_result(file, "swindale", "tidefield", 24.0)
    keep_result(file, "swindale", "nerfacto", 21.0)
    out = tmp_path / "results.md"
    table.write_page([file], [], [minute], tmp_path, out)
    machine = next(line for line in out.read_text().splitlines() if line.startswith("- Machine: "))
    assert machine.endswith(f"torch {torch.__version__}.")
    move_to_another_machine(monkeypatch)
    keep_result(minute, "swindale", "tidefield", 23.5, minutes=1)
    table.write_page([file], [], [minute], tmp_path, out)
    machines = [line for line in out.read_text().splitlines() if line.startswith("- Machine: ")]
    assert machines == [
        machine.removesuffix(".") + ": tidefield, nerfacto.",
        machine.removesuffix(".").replace(here["machine"]["processor"], "Another") + ": 1 min.",
    ]


def test_a_shorter_comparison_may_count_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, steps = tmp_path / "comparison.json", tmp_path / "steps.json"
    keep_result(file, "swindale", "tidefield", 24.0)
    move_to_another_machine(monkeypatch)
    keep_result(steps, "swindale", "tidefield", 23.5, minutes=None, steps=2000)
    table.write_page([file], [], [steps], tmp_path, tmp_path / "results.md")
    assert ": 2000 steps." in (tmp_path / "results.md").read_text()


def test_the_card_tells_what_the_weights_are(tmp_path: Path) -> None:
    file = tmp_path / "swift.safetensors"
    points = [{"step": 1000, "seconds": 60.0, "psnr": {"vegetation": 25.5, "brighton_beach": 20.25}}]
    told = {
        "steps": 1000,
        "seconds": 7200.0,
        "seed": 3,
        "processes": 2,
        "real": ["brighton_beach"],
        "validation": points,
    }
    write_weights(file, Network(SWIFT.network), SWIFT, {**told, **this_machine.describe()})
    with pytest.raises(RunError, match="no zero-shot results"):
        card.write_card(file, [tmp_path / "comparison.json"])
    keep_result(tmp_path / "comparison.json", "swindale", "zero-shot", 24.5)
    keep_result(tmp_path / "comparison.json", "swindale", "nerfacto", 21.25)
    text = card.write_card(file, [tmp_path / "comparison.json"]).read_text()
    for line in (
        "    torchrun --nproc-per-node 2 -m tidefield.cli pretrain OUT --real brighton_beach --preset swift "
        "--steps 1000 --seed 3",
        "- brighton_beach: the training photographs (BSD-2-Clause, (c) 2017 Piero Toffanin)",
        "| 1,000 | 25.50 | 20.25 |",
        "| swindale | 24.50 | 21.25 | - | - | - |",
    ):
        assert line in text.splitlines(), line
    assert f"SHA-256 `{sha256(file)}`" in text
    assert "in 2.0 hours" in text
    assert card.BY_DIRECTION not in text
    write_weights(file, Network(SWIFT.network), SWIFT, {**told, "real": ["elsewhere"], **this_machine.describe()})
    with pytest.raises(RunError, match="learned from elsewhere"):
        card.write_card(file, [tmp_path / "comparison.json"])


def test_the_card_of_paper_warns_of_its_neighbours(tmp_path: Path) -> None:
    file = tmp_path / "paper.safetensors"
    told = {"steps": 10, "seconds": 60.0, "seed": 0, "processes": 1, "real": [], "validation": []}
    write_weights(file, Network(PAPER.network), PAPER, {**told, **this_machine.describe()})
    keep_result(tmp_path / "comparison.json", "swindale", "paper-zero-shot", 20.5)
    keep_result(tmp_path / "comparison.json", "swindale", "zero-shot", 24.5)
    text = card.write_card(file, [tmp_path / "comparison.json"]).read_text()
    assert card.BY_DIRECTION in text
    assert "| swindale | 20.50 | - | - | - | - |" in text.splitlines()
