"""The benchmark of the viewer runs, and its figures belong together."""

import json
from pathlib import Path

import pytest
from scenes_on_disk import PINHOLE, survey, write_colmap

from benchmarks.view import lines, view


@pytest.mark.thorough
def test_moves_and_rests_are_measured_and_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("benchmarks.view.SIZE_PX", (64, 48))
    write_colmap(tmp_path / "scene", survey(PINHOLE))
    record = view(tmp_path / "scene", tmp_path / "runs", moves=4, rests=2)
    assert json.loads((tmp_path / "runs" / "view.json").read_text())["moves"] == 4
    assert len(record["after_a_move"]["sharp_s"]) == 2
    for coarse, sharp in zip(record["after_a_move"]["coarse_s"], record["after_a_move"]["sharp_s"], strict=True):
        assert 0 < coarse < sharp
    assert record["while_moving"]["largest_s"] >= record["while_moving"]["median_s"] > 0
    assert str(tmp_path) not in json.dumps(record)
    assert "frames per second" in "\n".join(lines(record))
