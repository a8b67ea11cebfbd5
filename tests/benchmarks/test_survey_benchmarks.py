"""The benchmark of `prepare`: that its thousands of photographs are a survey, and that its page says what it stored."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from camera_files import exif, photograph
from PIL.ExifTags import Base

from benchmarks.many import APART_DEG, WIDTH, measure_many
from benchmarks.surveys import write_page
from tidefield.compare.record import Took
from tidefield.files import write_json
from tidefield.survey.io.photographs import read_survey
from tidefield.survey.survey import Survey

STAGES = {"quality": 2.0, "features": 30.4}


def test_copies_of_a_survey_are_one_huge_survey(tmp_path: Path) -> None:
    for index, place in enumerate([(46.84, -91.99), (46.8401, -91.99), (46.8402, -91.99)]):
        table = exif({Base.DateTimeOriginal: f"2024:05:01 10:00:{index:02d}"}, place=place, height_m=200)
        photograph(tmp_path / "card" / f"DJI_{index}.JPG", table=table)
    photograph(tmp_path / "card" / "nowhere.jpg", table=exif())
    seen: list[Survey] = []

    def prepare(command: Sequence[str], environment: Mapping[str, str]) -> Took:
        card, scene = map(Path, command[-2:])
        seen.append(read_survey(card))
        scene.mkdir()
        (scene / "report.json").write_text(json.dumps({"processing_statistics": {"steps_times": STAGES}}))
        return Took(100.0, 2_500_000_000)

    record = measure_many(tmp_path / "card", tmp_path / "runs", 50, prepare, print)
    (survey,) = seen
    places = [one.position for one in survey.photographs if one.position is not None]
    degrees = np.array([(place.latitude_deg, place.longitude_deg) for place in places])
    apart = np.abs(degrees[:, None] - degrees[None]).max(-1)
    assert len(places) == 50
    assert {one.width for one in survey.photographs} == {WIDTH}
    assert ((apart < 3e-4) | (apart > 0.9 * APART_DEG)).all()
    assert (apart[0] < 3e-4).sum() == 3
    hours = np.array([one.time_s for one in survey.photographs]) / 3600
    assert set(np.round(hours - hours.min()).astype(int)) == set(range(0, 3 * 17, 3))

    again = measure_many(tmp_path / "card", tmp_path / "runs", 50, prepare, print)
    assert again == record
    assert len(seen) == 1

    write_page(tmp_path / "runs", [], None, None, tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text()
    assert "50 small photographs" in page
    assert "| features, s | 30 |" in page
    assert "| peak memory, GB | 2.50 |" in page


def test_the_page_says_what_was_aimed_at_and_what_came_of_training(tmp_path: Path) -> None:
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
    whole = {"seconds": {"features": 100.0, "matches": 300.0}, "pairs_matched": 3, "pairs": 3, "photographs": 79}
    write_json(runs / "swindale" / "exhaustive" / "exhaustive.json", whole)
    for folder, scene, psnr in ("a", "swindale", 27.0), ("a", "swindale_uneven", 26.0), ("b", "swindale", 26.5):
        mean = {"psnr_seen": psnr - 1, "psnr_seen_cc": psnr, "ssim_seen_cc": 0.7}
        trained = {"trained": {"steps": 1500, "seconds": 600.0}}
        evaluation = tmp_path / folder / "runs" / scene / "tidefield" / "evaluation.json"
        write_json(evaluation, {"mean": mean, "configuration": trained})
    write_page(runs, ["swindale"], tmp_path / "a", tmp_path / "b", tmp_path / "page.md")
    lines = (tmp_path / "page.md").read_text().splitlines()
    for line in (
        "| swindale: 75 photographs placed or more | 74 | not met |",
        "| swindale: mean reprojection error of 0.6 px or less | 0.58 px | met |",
        "| swindale: control points left out in turn met within 5 cm, horizontal RMS "
        "| 9.0 cm, 1.5 pixels on the ground | not met |",
        "| swindale: control points left out in turn met within 10 cm, vertical RMS "
        "| 5.0 cm, 0.8 pixels on the ground | met |",
        "| swindale: 3 times as fast as exhaustive or more | 2.7 times | not met |",
        "| swindale: trained, PSNR not under the ready-made scene's | +0.50 dB, with --colour off -0.50 dB | met |",
        "| swindale: PSNR after the colour fit, dB | 27.00 | 26.00 | 26.50 |",
        "| swindale: steps of training | 1,500 | 1,500 | 1,500 |",
        "| exhaustive / prepare | 2.7 |",
    ):
        assert line in lines, line
