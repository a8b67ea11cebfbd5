"""The numbered examples run as they stand, and the site shows all of them."""

import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
RESULTS = {
    "01_zero_shot_view": ["view.png", "view_depth.npy"],
    "02_train_and_evaluate": ["run/checkpoint.safetensors", "run/evaluation.json"],
    "03_camera_path_video": ["orbit.mp4"],
    "04_depth_and_points": ["points.ply"],
    "05_own_method": ["nearest/evaluation.json"],
}


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.mark.thorough
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_writes_what_it_promises(
    example: Path, tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr(sys, "argv", [str(example), str(tmp_path)])
    runpy.run_path(str(example), run_name="__main__")
    missing = [name for name in RESULTS[example.stem] if not (tmp_path / name).is_file()]
    assert not missing
    assert capsys.readouterr().out


def test_examples_are_numbered_without_gaps() -> None:
    assert [int(path.stem.split("_")[0]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))


def test_the_site_shows_every_example() -> None:
    page = (ROOT / "docs" / "examples.md").read_text(encoding="utf-8")
    assert [path.name for path in EXAMPLES if f"../examples/{path.name}" not in page] == []
