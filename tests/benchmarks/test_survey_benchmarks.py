"""The benchmark of `prepare`: what it runs, and that its page shows what was stored."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from benchmarks.surveys import measure_surveys, write_page
from tidefield.compare.run import Usage
from tidefield.errors import SurveyError
from tidefield.files import read_json, write_json

STAGES = {"quality": 2.0, "features": 30.4}


def test_every_survey_is_prepared_and_reconstructed_once(tmp_path: Path) -> None:
    asked: list[list[str]] = []

    def run(command: Sequence[str], environment: Mapping[str, str]) -> Usage:
        asked.append(list(command))
        if "benchmarks.surveys" in command:
            write_json(Path(command[-1]) / "exhaustive.json", {"photographs": 3})
        return Usage(100.0, 2_500_000_000)

    (tmp_path / "creek").mkdir()
    for _ in range(2):
        measure_surveys(tmp_path, tmp_path / "runs", ["creek"], run)
    prepare, exhaustive = asked
    folder = tmp_path / "runs" / "creek"
    assert prepare[-3:] == ["prepare", str(tmp_path / "creek"), str(folder / "scene")]
    assert exhaustive == [
        sys.executable,
        "-m",
        "benchmarks.surveys",
        str(tmp_path / "creek"),
        str(folder / "exhaustive"),
    ]
    assert read_json(folder / "prepare.json")["seconds"] == 100.0
    with pytest.raises(SurveyError, match="elsewhere is missing"):
        measure_surveys(tmp_path, tmp_path / "runs", ["elsewhere"], run)


def test_the_page_shows_model_training_and_time(tmp_path: Path) -> None:
    check = {"kind": "check", "rms_horizontal": 0.09, "rms_vertical": 0.05}
    report = {
        "reconstruction_statistics": {"reconstructed_shots_count": 74, "initial_shots_count": 79},
        "processing_statistics": {"steps_times": STAGES},
        "tidefield": {
            "reprojection": {"mean_px": 0.58},
            "resolution": {"height_above_ground": {"mean": 74.0}, "gsd": {"mean": 0.06}},
            "cameras": [{"focal_px": 1119.0}],
            "residuals": [check],
            "colour": None,
        },
    }
    runs = tmp_path / "runs"
    write_json(runs / "swindale" / "scene" / "report.json", report)
    write_json(runs / "swindale" / "prepare.json", {"seconds": 150.0, "peak_memory_bytes": 10**9})
    whole = {"seconds": {"features": 100.0, "matches": 300.0}, "pairs": 3, "photographs": 79}
    write_json(runs / "swindale" / "exhaustive" / "exhaustive.json", whole)
    for folder, scene, psnr in ("a", "swindale", 27.0), ("a", "swindale_uneven", 26.0), ("b", "swindale", 26.5):
        mean = {"psnr_seen": psnr - 1, "psnr_seen_cc": psnr, "ssim_seen_cc": 0.7}
        trained = {"trained": {"steps": 1500, "seconds": 600.0}}
        evaluation = tmp_path / folder / "runs" / scene / "tidefield" / "evaluation.json"
        speed = {"width": 400, "rays_per_second": 1.0, "seconds_per_frame": 1.0}
        write_json(
            evaluation, {"mean": mean, "configuration": trained, "per_photograph": {"a.jpg": {"psnr": psnr}}, **speed}
        )
    write_page(runs, ["swindale"], tmp_path / "a", tmp_path / "b", tmp_path / "page.md")
    lines = (tmp_path / "page.md").read_text().splitlines()
    for line in (
        "| mean reprojection error, px | 0.58 |",
        "| control points left out in turn, RMS horizontal, cm | 9.0 |",
        "| prepare: features, s | 30 |",
        "| swindale: PSNR after the colour fit, dB | 27.00 | 26.00 | 26.50 |",
        "| swindale: steps of training | 1,500 | 1,500 | 1,500 |",
        "| exhaustive / prepare | 2.7 |",
    ):
        assert line in lines, line
