"""Stages run once, run again with all that follow when something changes, and continue after an interruption."""

import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tidefield.errors import RunError
from tidefield.survey.sfm.mapping import interruptible
from tidefield.survey.stages import Facts, Stages


class Pipeline:
    """Three stages that record when they run."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.ran = folder, []
        self.before: Callable[[str], None] = lambda name: None

    def run(self, source: str = "photographs", redo: str | None = None, **options: int) -> list[str]:
        self.ran = []
        stages = Stages(self.folder, source, redo)
        for name in ("one", "two", "three"):
            output = self.folder / f"{name}.txt"

            def job(resume: bool, name: str = name, output: Path = output) -> Facts:
                self.before(name)
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


def test_a_removed_output_is_made_again_with_all_that_follows(pipeline: Pipeline):
    (pipeline.folder / "two.txt").unlink()
    assert pipeline.run() == ["two", "three"]


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


@pytest.mark.parametrize("at", ["job", "read"])
def test_stages_after_one_that_was_interrupted_are_repeated_and_not_continued(pipeline: Pipeline, at: str):
    class Interrupted(BaseException): ...

    def job(_: bool) -> Facts:
        if at == "job":
            raise Interrupted
        return {"name": "two", "resumed": False}

    def read(facts: Facts) -> Facts:
        raise Interrupted

    stages = Stages(pipeline.folder, "photographs", "two")
    one, two = (pipeline.folder / f"{name}.txt" for name in ("one", "two"))
    stages.run("one", 0, [one], lambda _: {"name": "one"})
    with pytest.raises(Interrupted):
        stages.run("two", 0, [two], job, read)
    assert pipeline.run() == (["two", "three"] if at == "job" else ["three"])
    assert json.loads((pipeline.folder / "stages.json").read_text())["three"]["facts"]["resumed"] is False
    assert pipeline.run() == []


def test_a_stage_with_the_same_inputs_continues_unless_it_is_repeated_on_request(tmp_path: Path):
    def run(source: int, inputs: int, redo: str | None = None) -> list[bool]:
        stages = Stages(tmp_path, source, redo)
        facts = [stages.run("features", 0, [], lambda resume: {"resumed": resume}, inputs=inputs)]
        facts.append(stages.run("matches", 0, [], lambda resume: {"resumed": resume}, inputs=inputs))
        facts.append(stages.run("poses", 0, [], lambda resume: {"resumed": resume}))
        return [fact["resumed"] for fact in facts]

    assert run(0, inputs=1) == [False, False, False]
    assert run(7, inputs=1) == [True, True, False]
    assert run(7, inputs=1, redo="matches") == [True, False, False]
    assert run(7, inputs=1, redo="features") == [False, False, False]
    assert run(8, inputs=2) == [False, False, False]


def test_a_repetition_on_request_that_was_interrupted_keeps_nothing(tmp_path: Path):
    def run(redo: str | None = None, breaks: bool = False) -> bool:
        def first(_: bool) -> Facts:
            if breaks:
                raise KeyboardInterrupt
            return {}

        stages = Stages(tmp_path, 0, redo)
        stages.run("pairs", 0, [], first)
        return stages.run("matches", 0, [], lambda resume: {"resumed": resume}, inputs=1)["resumed"]

    assert not run()
    with pytest.raises(KeyboardInterrupt):
        run("pairs", breaks=True)
    assert not run("pairs")


def test_inputs_of_stages_of_earlier_versions_are_added(tmp_path: Path):
    Stages(tmp_path, 0).run("features", 0, [], lambda _: {})
    Stages(tmp_path, 0).run("features", 0, [], lambda _: {}, inputs=1)
    facts = Stages(tmp_path, 7).run("features", 0, [], lambda resume: {"resumed": resume}, inputs=1)
    assert facts == {"resumed": True}


def test_a_stage_does_not_continue_from_what_is_damaged(tmp_path: Path):
    def damaged(_: Facts) -> Facts:
        raise ValueError("no database")

    def again(resume: bool) -> Facts:
        resumed.append(resume)
        return {}

    resumed: list[bool] = []
    Stages(tmp_path, 0).run("features", 0, [], lambda _: {}, inputs=1)
    with pytest.raises(ValueError, match="no database"):
        Stages(tmp_path, 0).run("features", 0, [], again, damaged, inputs=1)
    assert resumed == [False]


def test_a_damaged_record_is_an_error(tmp_path: Path):
    for text in ("{", "[]", "[" * 100_000):
        (tmp_path / "stages.json").write_text(text)
        with pytest.raises(RunError, match="remove"):
            Stages(tmp_path, 0)


@pytest.mark.parametrize(
    "record",
    [
        *(3, {"seconds": "x"}, {"seconds": 1e999}, {"facts": []}, {"facts": {"a": [math.nan]}}, {"done": 1}),
        *({"files": [1]}, {"files": None}),
    ],
)
def test_a_stage_whose_record_has_another_form_is_done_again_with_one_warning(
    record: object, pipeline: Pipeline, caplog: pytest.LogCaptureFixture
):
    records = json.loads((pipeline.folder / "stages.json").read_text())
    records["two"] = {**records["two"], **record} if isinstance(record, dict) else record
    (pipeline.folder / "stages.json").write_text(json.dumps(records))
    assert pipeline.run() == ["two", "three"]
    assert len(caplog.records) == 1


def test_a_stage_whose_result_cannot_be_read_is_done_again_with_one_warning(
    pipeline: Pipeline, caplog: pytest.LogCaptureFixture
):
    records = json.loads((pipeline.folder / "stages.json").read_text())
    records["one"]["facts"] = {"colour": 3}
    (pipeline.folder / "stages.json").write_text(json.dumps(records))
    resumed: list[bool] = []

    def job(resume: bool) -> Facts:
        resumed.append(resume)
        return {"name": "one"}

    stages = Stages(pipeline.folder, "photographs")
    assert stages.run("one", 0, [], job, lambda facts: facts["name"]) == "one"
    assert resumed == [False]
    assert len(caplog.records) == 1


def write_some(folder: Path, *names: str) -> None:
    """Run a stage of another key for other names, which writes files of these names."""

    def job(_: bool) -> Facts:
        for name in names:
            (folder.parent / name).parent.mkdir(parents=True, exist_ok=True)
            (folder.parent / name).write_text("ours")
        return {}

    Stages(folder, 0).run("one", names, [folder.parent / name for name in names], job)


def test_only_files_that_the_stage_wrote_before_are_removed(tmp_path: Path):
    write_some(tmp_path / "prepare", "images/a.jpg", "images/old/b.jpg")
    (tmp_path / "images" / "notes.txt").write_text("mine")
    write_some(tmp_path / "prepare", "images/a.jpg")
    assert sorted(path.name for path in (tmp_path / "images").iterdir()) == ["a.jpg", "notes.txt"]


@pytest.mark.parametrize("outside", ["../mine.txt", "{}/mine.txt", "link/mine.txt", "prepare/../../mine.txt", "."])
def test_nothing_outside_of_the_scene_is_removed_whatever_the_record_says(outside: str, tmp_path: Path):
    scene, mine = tmp_path / "scene", tmp_path / "mine.txt"
    write_some(scene / "prepare", "images/a.jpg")
    mine.write_text("mine")
    (scene / "link").symlink_to(tmp_path)
    file = scene / "prepare" / "stages.json"
    file.write_text(file.read_text().replace("images/a.jpg", outside.format(tmp_path.as_posix())))
    write_some(scene / "prepare", "images/b.jpg")
    assert mine.read_text() == "mine"
    assert (scene / "images" / "a.jpg").exists()


@pytest.mark.parametrize("link", ["images", "sparse", "prepare", "images/card", "sparse/0", "prepare/database.db"])
def test_a_link_among_the_folders_of_a_scene_is_refused(link: str, tmp_path: Path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "scene" / link).parent.mkdir(parents=True)
    (tmp_path / "scene" / link).symlink_to(tmp_path / "mine")
    with pytest.raises(RunError, match=r"is a link to .*: expected .*; remove the link"):
        Stages(tmp_path / "scene" / "prepare", 0)
    assert not any((tmp_path / "mine").iterdir())


def test_a_scene_may_lie_behind_a_link_itself(tmp_path: Path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "scene").symlink_to(tmp_path / "disk")
    write_some(tmp_path / "scene" / "prepare", "images/a.jpg")
    assert (tmp_path / "disk" / "images" / "a.jpg").exists()


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


@pytest.mark.parametrize("last", ["two", "three"])
def test_a_repetition_that_was_interrupted_goes_on_with_the_same_command(pipeline: Pipeline, last: str):
    def interrupt(name: str) -> None:
        if name == last:
            raise KeyboardInterrupt

    pipeline.before = interrupt
    with pytest.raises(KeyboardInterrupt):
        pipeline.run(redo="one")
    pipeline.before = lambda name: None
    assert pipeline.run(redo="one") == (["two", "three"] if last == "two" else ["three"])
    assert pipeline.run(redo="one") == ["one", "two", "three"], "the next one is another"
    assert pipeline.run() == []
