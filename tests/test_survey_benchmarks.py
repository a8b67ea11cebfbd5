"""The benchmark of `prepare`: that its thousands of photographs are a survey, and that its page says what it stored."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from camera_files import exif, photograph, survey_folder

from benchmarks.many import APART_DEG, WIDTH, measure_many
from benchmarks.records import Took
from benchmarks.surveys import write_page
from tidefield.ingest.reading.photographs import read_survey
from tidefield.ingest.survey import Survey

STAGES = {"quality": 2.0, "features": 30.4}


def test_copies_of_a_survey_are_one_huge_survey(tmp_path: Path) -> None:
    survey_folder(tmp_path / "card", count=3)
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

    again = measure_many(tmp_path / "card", tmp_path / "runs", 50, prepare, print)
    assert again == record
    assert len(seen) == 1

    write_page(tmp_path / "runs", [], tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text()
    assert "50 small photographs" in page
    assert "| features, s | 30 |" in page
    assert "| peak memory, GB | 2.50 |" in page
