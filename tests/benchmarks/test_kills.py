"""Commands that are killed complete their work when they are repeated, with the same result."""

import sys
from pathlib import Path

import pytest

from benchmarks.kills import kills
from tidefield.files import read_json


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_killed_commands_complete_the_same_result_and_leave_nothing(tmp_path: Path):
    record = kills(tmp_path, train=1, prepare=1, compare=1, seed=1)
    assert {name: (of["kills"], of["identical"], of["processes"], of["files"]) for name, of in record.items()} == {
        name: (1, 1, 0, 0) for name in ("train", "prepare", "compare")
    }
    assert read_json(tmp_path / "kills.json")["kills"] == record
