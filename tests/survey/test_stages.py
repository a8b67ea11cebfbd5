"""Stages run once, run again with all that follow when something changes, and continue after an interruption."""

import json
import time
from pathlib import Path

import pytest

from tidefield.errors import RunError
from tidefield.survey.prepare import Facts, Stages
from tidefield.survey.sfm.matching import interruptible


class Pipeline:
    """Three stages that record when they run."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.ran = folder, []

    def run(self, source: str = "photographs", redo: str | None = None, **options: int) -> list[str]:
        self.ran = []
        stages = Stages(self.folder, source, redo)
        for name in ("one", "two", "three"):
            output = self.folder / f"{name}.txt"

            def job(resume: bool, name: str = name, output: Path = output) -> Facts:
                self.ran.append(name)
                output.write_text(name)
                return {"name": name, "resumed": resume}

            facts = stages.run(name, options.get(name, 0), [output], job)
            assert facts["name"] == name
        return self.ran


def test_keys_of_earlier_versions_stay_valid(tmp_path: Path):
    """A stage that an earlier version completed, by its key on disk, is not repeated."""
    record = {"key": "8e4aa3b88e3e5600", "done": True, "seconds": 2.5, "facts": {"a": 1}}
    (tmp_path / "stages.json").write_text(json.dumps({"quality": record}))
    stages = Stages(tmp_path, [["a.jpg", 1, 2, "None", "None"]])
    assert stages.run("quality", {}, [], lambda resume: {"a": 2}) == {"a": 1}
    assert stages.seconds == {"quality": 2.5}


@pytest.fixture
def pipeline(tmp_path: Path) -> Pipeline:
    made = Pipeline(tmp_path)
    assert made.run() == ["one", "two", "three"]
    return made


def test_complete_stages_are_not_repeated(pipeline: Pipeline):
    assert pipeline.run() == []


def test_a_changed_option_repeats_its_stage_and_all_that_follow(pipeline: Pipeline):
    assert pipeline.run(two=1) == ["two", "three"]
    assert pipeline.run(two=1) == []
    assert pipeline.run(two=1, three=5) == ["three"]


def test_other_photographs_repeat_all_stages(pipeline: Pipeline):
    assert pipeline.run("others") == ["one", "two", "three"]


def test_a_stage_can_be_repeated_on_request(pipeline: Pipeline):
    assert pipeline.run(redo="two") == ["two", "three"]


def test_a_removed_output_is_made_again(pipeline: Pipeline):
    (pipeline.folder / "two.txt").unlink()
    assert pipeline.run() == ["two"]


def test_an_interrupted_stage_continues_and_its_times_add_up(tmp_path: Path):
    def breaks(resume: bool) -> Facts:
        assert not resume
        time.sleep(0.05)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Stages(tmp_path, 0).run("long", 1, [], breaks)
    changed, same = Stages(tmp_path, 0), Stages(tmp_path, 0)
    assert same.run("long", 1, [], lambda resume: {"resumed": resume}) == {"resumed": True}
    assert same.seconds["long"] >= 0.05
    assert changed.run("long", 2, [], lambda resume: {"resumed": resume}) == {"resumed": False}


def test_a_damaged_record_is_an_error(tmp_path: Path):
    for text in ("{", "[]", json.dumps({"one": 3})):
        (tmp_path / "stages.json").write_text(text)
        with pytest.raises(RunError, match="remove"):
            Stages(tmp_path, 0)


def test_a_long_job_can_be_interrupted():
    def job(token: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interruptible(job)
    assert interruptible(lambda token: 3) == 3


def test_an_unwritable_folder_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "mkdir", refuse)
        with pytest.raises(RunError, match=r"scene cannot be written \(Permission denied\)"):
            Stages(tmp_path / "scene" / "prepare", "photographs")
    stages = Stages(tmp_path / "scene" / "prepare", "photographs")

    def fills_the_disk(resume: bool) -> Facts:
        raise OSError(28, "No space left on device")

    with pytest.raises(RunError, match=r"scene cannot be written \(No space left on device\)"):
        stages.run("one", 0, [], fills_the_disk)
