"""What is made of stored measurements: the page of results, and the cards of the shipped weights."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
import torch

from benchmarks import card, table
from benchmarks.table import by_length, length_tables
from tidefield import machine as this_machine
from tidefield.compare.circumstances import code_and_machines
from tidefield.compare.results import read_figures
from tidefield.config import PAPER, SWIFT
from tidefield.errors import RunError
from tidefield.evaluation.evaluate import NAMES
from tidefield.evaluation.lpips import BACKBONES
from tidefield.evaluation.metrics import SUFFIXES
from tidefield.files import read_json, write_json
from tidefield.methods import names
from tidefield.model.network import make_network
from tidefield.train.checkpoint import weights_sha256, write_weights

FOUR = ("caliterra", "swindale", "turin_lot", "fern")


def keep_result(
    file: Path,
    scene: str,
    method: str,
    psnr: float,
    peak: int = 2_000_000_000,
    minutes: float | None = 10,
    from_scratch: bool = False,
    steps: int | None = None,
    device: str = "cpu",
) -> None:
    """Add one to what is in the file, in place of an older one."""
    mean: dict = dict.fromkeys(NAMES, 0.1)
    mean |= {"psnr" + suffix: psnr for suffix in SUFFIXES} | {"ssim" + suffix: psnr / 40 for suffix in SUFFIXES}
    mean |= {name: None for name in NAMES if name.startswith("lpips_alex")}
    evaluation = {"mean": mean | {"reasons": {"lpips_alex": "no weights"}}, "seconds_per_frame": 2.0}
    evaluation |= {"rays_per_second": 5e4, "configuration": {}}
    step = {"command": f"tidefield evaluate RUN {method}", "seconds": 1.0, "peak_memory_bytes": peak}
    process = {
        "settings": {"minutes": minutes, "steps": steps, "width": 400, "device": device, "from_scratch": from_scratch},
        "evaluate": step | this_machine.describe() | {"commit": None},
    }
    if method not in (*names("untrained"), *names("zero-shot")):
        evaluation["configuration"] = {"trained": {"steps": 1234, "seconds": 600.0}}
        process["train"] = process["evaluate"]
    kept = [r for r in (read_json(file) or {"results": []})["results"] if (r["scene"], r["method"]) != (scene, method)]
    added = {"scene": scene, "method": method, "evaluation": evaluation, "process": process, "curve": []}
    write_json(file, {"results": [*kept, added]})


def keep_all(file: Path, psnr: Mapping[str, float], others: Mapping[str, float] | None = None) -> None:
    others = others or {"plane-sweep": 20.0, "sparse-depth": 25.0, "nerfacto": 22.0, "paper": 24.0, "zero-shot": 23.0}
    for scene in table.SCENES:
        for method, value in {"tidefield": psnr.get(scene, 27.0), **others}.items():
            keep_result(file, scene, method, value)


def move_to_another_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    here = this_machine.describe()
    other = here | {"machine": here["machine"] | {"processor": "Another"}}
    monkeypatch.setattr(this_machine, "describe", lambda: other)


def test_lengths_of_training_are_compared(tmp_path: Path) -> None:
    found = []
    for name, minutes, scratch, psnr in (
        ("seconds", 1 / 6, False, 23.996),
        ("minute", 1.0, False, 24.5),
        ("scratch", 10.0, True, 24.25),
    ):
        for scene in FOUR:
            keep_result(tmp_path / f"{name}.json", scene, "tidefield", psnr, minutes=minutes, from_scratch=scratch)
        found.append(read_figures([tmp_path / f"{name}.json"], (), names()))
    for scene in ("fern", "swindale", "caliterra", "turin_lot", "lego"):
        keep_result(tmp_path / "comparison.json", scene, "zero-shot", 24.0)
    compared = read_figures([tmp_path / "comparison.json"], table.SCENES, names())
    lengths = by_length([compared, *found])
    assert list(lengths) == ["zero-shot", "10 s", "1 min", "10 min from scratch"]
    made = length_tables(lengths)[0]
    assert list(made.rows[0]) == ["caliterra", "24.00", "24.00", "24.50", "24.25"]
    assert {row[0] for row in made.rows} == set(FOUR), "lego has no other length of training"


def test_the_page_shows_what_was_stored_and_what_is_missing(tmp_path: Path) -> None:
    comparison, ablation = tmp_path / "comparison.json", tmp_path / "ablation.json"
    runs, out, lengths = tmp_path / "runs", tmp_path / "docs" / "results.md", []
    keep_all(comparison, {"brighton_beach": 29.0})
    keep_result(comparison, "another", "tidefield", 31.5)
    keep_result(ablation, "swindale", "tidefield", 27.0)
    keep_result(ablation, "swindale", "no-ray-transformer", 26.0)
    frame = {"preset": "swift", "size_px": [4000, 3000], "photographs": 12, "device": "cpu", "command": "memory"}
    write_json(runs / "memory.json", {**frame, "seconds": 70, "peak_memory_bytes": 6.5e9, **this_machine.describe()})
    kept = {"first": {"seconds": 25.0}, "further_seconds": 9.5, "by_photographs": {"18": 8.0, "200": 8.4}}
    views = {"preset": "swift", "size_px": [800, 600], "device": "cpu", "command": "frames"}
    write_json(runs / "frames.json", {**views, **kept, **this_machine.describe()})
    card_views = {**views, **kept, "size_px": [1920, 1080], "device": "cuda:0", "command": "large frames"}
    write_json(runs / "gpu" / "frames_1920.json", {**card_views, **this_machine.describe()})
    keep_result(runs / "gpu" / "strict_800.json", "caliterra", "tidefield", 36.0, device="cuda:0")
    keep_result(runs / "gpu" / "strict_800.json", "caliterra", "nerfacto", 33.0, device="cuda:0")
    compared = read_json(runs / "gpu" / "strict_800.json")
    remarked = {"remark": "On one card.", "settings": {"width": 640}, **compared}
    write_json(runs / "gpu" / "strict_800.json", remarked)
    table.table([comparison], [ablation], lengths, [], runs, out)
    text = out.read_text()
    for line in (
        "A frame of 4000 x 3000 px from 12 photographs of that size, decoding and encoding included (swift, cpu): "
        "6.50 GB, 70 s.",
        "Photographs of 640 px. On one card.",
        "Within the budget Nerfacto made 1,234 steps, 4.1% of its default of 30,000. "
        "Its memory is that of the larger of two processes, its own and Tidefield's.",
        "| caliterra ² | **36.00** | 33.00 |",
        "### On a GPU: Zero-shot views of 1920 x 1080 px, swift, cuda:0",
        "    large frames",
        "| each further view along a flight, median | 9.50 |",
        "| the same view repeatedly, of a survey of 200 photographs | 8.40 |",
        "| swindale ² | **27.00** | 23.00 | 24.00 | 22.00 | 20.00 | 25.00 |",
        "| another | 31.50 | - | - | - | - | - |",
        "| caliterra, tidefield | 10.0 | 1,234 | 2.00 | 50,000 | 2.00 | 2.00 |",
        "    tidefield evaluate RUN tidefield",
        "No lpips_alex: no weights.",
        "| no-ray-transformer | 1 | -1.00 | -1.00 | -0.0250 | +0.0000 | 1.00 | 1.00 |",
        "- The column `paper` began with random weights and was trained for 1,234 steps.",
        "- The column `zero-shot` has trained weights as they are, without a step on the scene.",
        "| IBRNet (Wang et al., CVPR 2021) | LLFF | 25.13 | 26.73 | 1.60 |",
        "- without a mark (another): no scene of this name taught the shipped weights or chose their recipe.",
    ):
        assert line in text.splitlines(), line
    assert "### LPIPS, AlexNet" not in text
    assert text.index("## Quality") < text.index("| swindale") < text.index("- Machine: ")
    for mark, scenes in (("²", "caliterra, swindale, fern"), ("³", "turin_lot, brighton_beach"), ("⁴", "lego")):
        assert f"- {mark} {scenes}: " in text
    assert "1,024 rays a batch instead of its default of 4,096" in text
    assert "### FLIP" in text
    with pytest.raises(RunError, match="no results"):
        table.table([], [ablation.with_name("none.json")], [], [], tmp_path / "docs", tmp_path / "other.md")


def test_widths_stand_one_after_another_each_with_all_its_files(tmp_path: Path) -> None:
    files, out = [tmp_path / f"{name}.json" for name in ("wide", "narrow", "others")], tmp_path / "page.md"
    kinds = ((800, "swindale", 24.0), (400, "swindale", 26.0), (400, "fern", 23.0))
    for file, (width, scene, psnr) in zip(files, kinds, strict=True):
        keep_result(file, scene, "tidefield", psnr)
        keep_result(file, scene, "sparse-depth", psnr - 1)
        record = {"settings": {"width": width}, **(read_json(file) or {})}
        for result in record["results"]:
            result["evaluation"] |= {"held_out_of_poses": width == 800, "commit": f"{width}abcdef"}
        write_json(file, record)
    table.table([], [], [], [*files, tmp_path / "none.json"], tmp_path, out)
    text = out.read_text()
    narrow, wide = text.index("### 400 px\n"), text.index("### 800 px\n")
    assert (
        narrow < text.index("| swindale ² | **26.00** | 25.00 |") < text.index("| fern ² | **23.00** | 22.00 |") < wide
    )
    assert wide < text.index("| swindale ² | **24.00** | 23.00 |")
    assert text.count("| fern ² |") == 4, "PSNR, SSIM, LPIPS and FLIP of one width"
    assert "### 800 px: Time and memory" in text
    assert narrow < text.index("commit 400abcd.") < wide < text.index("commit 800abcd.")
    assert narrow < text.index(f"{table.PLACED_TOGETHER}swindale, fern.\n") < wide
    assert wide < text.index(f"{table.PLACED_AFTERWARDS}swindale.\n")
    assert (text.count(table.PLACED_AFTERWARDS), text.count(table.PLACED_TOGETHER)) == (1, 1)


def test_columns_of_different_commits_are_told_apart(tmp_path: Path) -> None:
    file, out = tmp_path / "a.json", tmp_path / "results.md"

    def page(new: str, value: str) -> str:
        """The page when results whose scene or method (`new`) is this one are of another commit than the rest."""
        record = {"settings": {"width": 400}, **(read_json(file) or {})}
        for result in record["results"]:
            result["evaluation"]["commit"] = "1234567890" if result[new] == value else "abcdefabcd"
        write_json(file, record)
        table.table([], [], [], [file], tmp_path, out)
        return out.read_text()

    keep_result(file, "fern", "tidefield", 24.0)
    keep_result(file, "fern", "sparse-depth", 23.0)
    assert "code and settings differ: 1234567 (tidefield); abcdefa (sparse-depth).\n" in page("method", "tidefield")
    keep_result(file, "lego", "tidefield", 25.0)
    found = "differ: 1234567 (tidefield of lego); abcdefa (sparse-depth; tidefield of fern).\n"
    text = page("scene", "lego")
    assert found in text, "the scenes, where a column is of two commits"
    assert "different machines" not in text
    record = read_json(file) or {}
    record["results"][0]["process"]["evaluate"]["machine"]["processor"] = "A Slow One"
    write_json(file, record)
    machine = this_machine.describe()["machine"]
    count = f"{machine['cores']} core{'s' * (machine['cores'] > 1)}"
    own = ", ".join([machine["processor"], count, *machine["gpus"]])
    both = f"{own} for training and A Slow One, {own.partition(', ')[2]} for evaluation (tidefield of fern)"
    slower = "; ".join(sorted([f"{own} (sparse-depth; tidefield of lego)", both]))
    rest = " on which a minute does not bring the same: "
    assert f"{rest}{slower}.\n" in page("scene", "lego")


def test_machines_differ_by_cores_and_gpus_and_changed_sources_keep_their_mark(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    for scene in ("fern", "lego", "swindale"):
        keep_result(file, scene, "tidefield", 24.0)
    record = read_json(file) or {}
    machine = {**this_machine.describe()["machine"], "processor": "P", "cores": 16, "gpus": ["H200"]}
    others = ({}, {"gpus": ["H100"]}, {"cores": 2})
    for result, evaluated in zip(record["results"], others, strict=True):
        result["evaluation"]["commit"] = "1234567890+"
        result["process"]["train"]["machine"] = machine
        result["process"]["evaluate"]["machine"] = machine | evaluated
    write_json(file, record)
    commits, machines = code_and_machines(read_figures([file], table.SCENES, names()))
    assert commits == "Measured at commit 1234567+."
    assert machines.partition("the same: ")[2].split("; ") == [
        "P, 16 cores, H200 (tidefield of fern)",
        "P, 16 cores, H200 for training and P, 16 cores, H100 for evaluation (tidefield of lego)",
        "P, 16 cores, H200 for training and P, 2 cores, H200 for evaluation (tidefield of swindale).",
    ]


def test_commits_are_those_of_training_and_of_evaluation(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    for scene in ("fern", "lego", "swindale"):
        keep_result(file, scene, "tidefield", 24.0)
    record = read_json(file) or {}
    for result, trained in zip(record["results"], ("1234567890", "abcdefabcd", None), strict=True):
        result["evaluation"]["commit"], result["process"]["train"]["commit"] = "1234567890", trained
    write_json(file, record)
    (commits,) = code_and_machines(read_figures([file], table.SCENES, names()))
    assert commits == (
        "Measured at different commits, whose code and settings differ: 1234567 (tidefield of fern, swindale); "
        "abcdefa for training and 1234567 for evaluation (tidefield of lego)."
    )


def test_results_of_installed_packages_are_named_next_to_those_of_sources(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    for scene in ("fern", "lego"):
        keep_result(file, scene, "tidefield", 24.0)
    record = read_json(file) or {}
    for result, commit in zip(record["results"], ("1234567890", None), strict=True):
        result["evaluation"]["commit"] = result["process"]["train"]["commit"] = commit
    write_json(file, record)
    (commits,) = code_and_machines(read_figures([file], table.SCENES, names()))
    assert commits.endswith("1234567 (tidefield of fern); an installed package (tidefield of lego).")
    former = record["results"][1]
    del former["evaluation"]["commit"], former["process"]["train"]["commit"]  # earlier versions recorded none
    write_json(file, record)
    assert code_and_machines(read_figures([file], table.SCENES, names())) == ["Measured at commit 1234567."]
    former["evaluation"]["commit"] = None
    record["results"][0]["evaluation"]["commit"] = record["results"][0]["process"]["train"]["commit"] = None
    write_json(file, record)
    assert code_and_machines(read_figures([file], table.SCENES, names())) == []


def test_a_page_of_a_gpu_says_what_ran_on_the_processor(tmp_path: Path) -> None:
    for device, expected in (("cpu", False), ("cuda:0", True)):
        file = tmp_path / f"{device}.json"
        for method in ("tidefield", "sparse-depth"):
            keep_result(file, "fern", method, 24.0, device=device)
        found = table.notes(table.without_empty_columns(read_figures([file], table.SCENES, names())), ())
        sentence = "Without training, on the processor: sparse-depth. Their times are not those of cuda:0."
        assert (sentence in found) == expected


def test_the_page_tells_figures_that_are_older_than_the_strict_protocol(tmp_path: Path) -> None:
    file, out = tmp_path / "comparison.json", tmp_path / "page.md"
    keep_result(file, "swindale", "tidefield", 24.0)
    table.table([file], [], [], [], tmp_path, out)
    older = f"Measured with Tidefield {this_machine.describe()['version']}, with the networks and weights of that time"
    assert older in out.read_text()
    record = read_json(file)
    assert record is not None
    record["results"][0]["evaluation"]["protocol"] = "strict"
    write_json(file, record)
    table.table([file], [], [], [], tmp_path, out)
    assert older not in out.read_text()


def test_the_page_names_what_each_machine_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, file, minute = this_machine.describe(), tmp_path / "comparison.json", tmp_path / "minute.json"
    keep_result(file, "swindale", "tidefield", 24.0)
    keep_result(file, "swindale", "nerfacto", 21.0)
    out = tmp_path / "results.md"
    table.table([file], [], [minute], [], tmp_path, out)
    machine = next(line for line in out.read_text().splitlines() if line.startswith("- Machine: "))
    assert machine.endswith(f"torch {torch.__version__}.")
    move_to_another_machine(monkeypatch)
    keep_result(minute, "swindale", "tidefield", 23.5, minutes=1)
    table.table([file], [], [minute], [], tmp_path, out)
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
    table.table([file], [], [steps], [], tmp_path, tmp_path / "results.md")
    assert ": 2000 steps." in (tmp_path / "results.md").read_text()


def test_the_card_describes_the_weights(tmp_path: Path) -> None:
    file = tmp_path / "swift.safetensors"
    points = [{"step": 1000, "seconds": 60.0, "psnr": {"vegetation": 25.5, "brighton_beach": 20.25}}]
    recorded = {
        "steps": 1000,
        "seconds": 7200.0,
        "seed": 3,
        "processes": 2,
        "real": ["brighton_beach"],
        "validation": points,
    }
    write_weights(file, make_network(SWIFT.network), SWIFT, {**recorded, **this_machine.describe()})
    with pytest.raises(RunError, match="no zero-shot results"):
        card.card(file, [tmp_path / "comparison.json"])
    keep_result(tmp_path / "comparison.json", "swindale", "zero-shot", 24.5)
    keep_result(tmp_path / "comparison.json", "swindale", "nerfacto", 21.25)
    text = card.card(file, [tmp_path / "comparison.json"]).read_text()
    for line in (
        "    torchrun --nproc-per-node 2 -m tidefield.cli pretrain OUT --real brighton_beach --preset swift "
        "--steps 1000 --seed 3",
        "- brighton_beach: the training photographs (BSD-2-Clause, (c) 2017 Piero Toffanin)",
        "| 1,000 | 25.50 | 20.25 |",
        "| swindale ² | 24.50 | 21.25 |",
    ):
        assert line in text.splitlines(), line
    assert f"SHA-256 `{weights_sha256(file)}`" in text
    assert "before the strict protocol" in text
    assert "in 2.0 hours" in text
    assert card.BY_DIRECTION not in text
    write_weights(
        file, make_network(SWIFT.network), SWIFT, {**recorded, "real": ["elsewhere"], **this_machine.describe()}
    )
    with pytest.raises(RunError, match="learned from elsewhere"):
        card.card(file, [tmp_path / "comparison.json"])


def test_the_card_of_paper_warns_of_its_neighbours(tmp_path: Path) -> None:
    file = tmp_path / "paper.safetensors"
    recorded = {"steps": 10, "seconds": 60.0, "seed": 0, "processes": 1, "real": [], "validation": []}
    write_weights(file, make_network(PAPER.network), PAPER, {**recorded, **this_machine.describe()})
    keep_result(tmp_path / "comparison.json", "swindale", "paper-zero-shot", 20.5)
    keep_result(tmp_path / "comparison.json", "swindale", "zero-shot", 24.5)
    text = card.card(file, [tmp_path / "comparison.json"]).read_text()
    assert card.BY_DIRECTION in text
    assert "| swindale ² | 20.50 |" in text.splitlines()


def test_without_lpips_the_page_says_how_to_get_it(tmp_path: Path) -> None:
    file, out = tmp_path / "comparison.json", tmp_path / "results.md"
    keep_result(file, "swindale", "tidefield", 24.0)
    stored = read_json(file)
    mean = stored["results"][0]["evaluation"]["mean"]
    for name in [name for name in mean if name.startswith("lpips")]:
        del mean[name]
    mean["reasons"] = {}
    write_json(file, stored)
    table.table([file], [file], [], [], tmp_path, out)
    assert table.NO_LPIPS in out.read_text()
    assert "LPIPS, VGG" not in out.read_text()


def test_the_stored_results_have_no_unpublished_lpips() -> None:
    root = Path(__file__).parents[2] / "docs"
    for file in (root / "measured").glob("*.json"):
        for one in read_json(file).get("results", []):
            weights = one["evaluation"].get("lpips_weights", {})
            assert all(digest.startswith(BACKBONES[metric][1][-12:-4]) for metric, digest in weights.items()), file
            mean = one["evaluation"]["mean"].items()
            assert weights or not any("lpips" in name and value is not None for name, value in mean), file
