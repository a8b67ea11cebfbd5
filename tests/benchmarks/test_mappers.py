"""The benchmark of the mappers: each survey is prepared once with each, and the table shows what the reports say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from benchmarks.mappers import mappers, table
from tidefield.compare.run import Usage
from tidefield.errors import SurveyError
from tidefield.files import write_json


def test_each_mapper_prepares_each_survey_once(tmp_path: Path):
    asked: list[list[str]] = []

    def run(command: Sequence[str], environment: Mapping[str, str]) -> Usage:
        *_, scene, option, mapper = command
        asked.append([option, mapper])
        check = [{"kind": "check", "rms_horizontal": 0.09, "rms_vertical": 0.05}] if mapper == "global" else []
        write_json(
            Path(scene) / "report.json",
            {
                "reconstruction_statistics": {"reconstructed_shots_count": 78, "initial_shots_count": 79},
                "processing_statistics": {"steps_times": {"poses": 12.4}},
                "tidefield": {"reprojection": {"mean_px": 0.5821}, "residuals": check},
            },
        )
        return Usage(100.0, 1_300_000_000)

    (tmp_path / "creek").mkdir()
    for _ in range(2):
        record = mappers(tmp_path, tmp_path / "work", tmp_path, ("creek",), run)
    assert asked == [["--mapper", "incremental"], ["--mapper", "global"]]
    end = ["12", "100", "1.30"]
    assert table(record).rows == [
        ["creek", "incremental", "78 of 79", "0.582", "-", "-", *end],
        ["creek", "global", "78 of 79", "0.582", "-", "9.0 / 5.0", *end],
    ]
    with pytest.raises(SurveyError, match=r"elsewhere is missing: expected a folder of photographs; name others"):
        mappers(tmp_path, tmp_path / "work", tmp_path, ("elsewhere",), run)
