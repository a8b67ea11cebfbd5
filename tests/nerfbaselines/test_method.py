"""Tidefield inside NerfBaselines: its own test suite of methods, in nerfstudio's environment."""

import json
from pathlib import Path

from foreign_environment import run

from tidefield.synthetic import make_survey, write_survey


def test_the_suite_of_nerfbaselines_passes(tmp_path: Path):
    scene = tmp_path / "scene"
    write_survey(make_survey("river_mouths", seed=2, views=10, width=96), scene)
    # Without an id there are no published results to compare with.
    (scene / "nb-info.json").write_text(json.dumps({"loader": "colmap", "id": None, "scene": "river_mouths"}))
    words = "nerfbaselines test-method --method tidefield --backend python --steps 2 --data"
    printed = run(*words.split(), scene, needed=("nerfbaselines",))
    assert "All tests passed" in printed
    passed = [line for line in printed.splitlines() if "\N{CHECK MARK}" in line]
    assert len(passed) >= 18
    assert any("Restored model (without train dataset) matches original" in line for line in passed)
