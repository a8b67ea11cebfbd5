"""Comparisons: what is run and what is not run again, tables in every form, figures and curves."""

import csv
import json
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import opensplat_program
import pytest
import textured_wall as wall
from comparisons import SETTINGS, Children, evaluation, quiet
from PIL import Image
from rich.console import Console
from scenes_on_disk import PINHOLE, survey, write_colmap

from tidefield import cli
from tidefield.commands.ablate import Ablate, ablate
from tidefield.commands.compare import Compare, _scenes, _with_failures, make_settings
from tidefield.commands.compare import compare as compare_command
from tidefield.commands.train import Train, train
from tidefield.compare.figures import most_different, side_by_side, write_curves
from tidefield.compare.results import Result, Results, figures_of, read_figures, read_results
from tidefield.compare.run import (
    MIPNERF360,
    Failure,
    Settings,
    Unfinished,
    Usage,
    commands,
    compare,
    mipnerf360,
    named,
    tidal_flats,
)
from tidefield.compare.sources import require_one_state
from tidefield.compare.tables import (
    TABLE_2,
    TABLE_3,
    Table,
    cost_table,
    learned_from,
    nerfacto_limits,
    opensplat_limits,
    paper_table,
    quality_tables,
    trainings,
    untrained_limits,
    widths,
    write_comparison,
)
from tidefield.config import PAPER, Budget
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.device import choose_device
from tidefield.errors import RunError, SceneError, TidefieldError
from tidefield.files import write_json
from tidefield.methods import METHODS, configuration


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    return tmp_path / "flats"


def test_every_method_is_trained_and_evaluated_once(disk: Path, tmp_path: Path):
    run = Children(load_scene(disk, width=48))
    methods, out = ("tidefield", "nerfacto", "nearest"), tmp_path / "out"
    compare({"flats": disk}, methods, SETTINGS, out, run, quiet)
    assert [words[0] for words in run.words] == ["train", "evaluate", "train", "evaluate", "evaluate"]
    own, other, untrained = run.words[0], run.words[2], run.words[4]
    assert own[3:5] == ["--preset", "swift"]
    assert other[3:5] == ["--method", "nerfacto"]
    assert untrained[3:5] == ["--method", "nearest"]
    for words in (own, other):
        assert words[5:8] == ["--minutes", "10", "--curve"]
        assert words[8:10] == ["--width", "48"]
    compare({"flats": disk}, (*methods, "nerf"), SETTINGS, out, run, quiet)
    assert [words[0] for words in run.words[5:]] == ["train", "evaluate"]
    record = json.loads((out / "runs" / "flats" / "nerf" / "process.json").read_text())
    assert record["train"]["seconds"] == 12.5
    assert record["settings"]["scene"] == str(disk.resolve())
    assert record["evaluate"]["command"] == "tidefield evaluate RUN --device cpu"


def test_a_comparison_goes_on_where_it_and_its_scenes_were_moved_to(disk: Path, tmp_path: Path):
    run, contents = Children(load_scene(disk, width=48)), {"flats": "those of its files"}
    compare({"flats": disk}, ("nearest",), SETTINGS, tmp_path / "out", run, quiet, contents)
    compare({"flats": disk}, ("nearest",), SETTINGS, tmp_path / "without", run, quiet)
    for folder in ("flats", "out", "without"):
        (tmp_path / folder).rename(tmp_path / f"moved-{folder}")
    done, moved = len(run.words), {"flats": tmp_path / "moved-flats"}
    compare(moved, ("nearest",), SETTINGS, tmp_path / "moved-out", run, quiet, contents)
    assert len(run.words) == done
    with pytest.raises(RunError, match=r"was made with .*'scene'"):  # nothing says that it is the same
        compare(moved, ("nearest",), SETTINGS, tmp_path / "moved-without", run, quiet)


def test_zero_shot_uses_the_weights_of_its_preset() -> None:
    for method, preset in (("zero-shot", "swift"), ("paper-zero-shot", "paper")):
        asked = commands(Path("data"), Path("run"), method, SETTINGS)
        assert list(asked) == ["evaluate"]
        assert asked["evaluate"][3:6] == ["--zero-shot", "--preset", preset]


def test_the_papers_network_can_choose_neighbours_by_what_they_see() -> None:
    plain, seen = (commands(Path("S"), Path("F"), name, SETTINGS)["train"] for name in ("paper", "paper-seen"))
    assert seen == [*plain[:5], "--variant", "neighbours-seen", *plain[5:]]
    assert configuration("paper-seen") == replace(PAPER, train=replace(PAPER.train, neighbours="seen"))


def test_an_interrupted_training_is_repeated_and_a_finished_one_is_not(disk: Path, tmp_path: Path):
    run = Children(load_scene(disk, width=48))
    run.fails_at = 2
    with pytest.raises(RunError, match="it broke"):
        compare({"flats": disk}, ("tidefield",), SETTINGS, tmp_path / "out", run, quiet)
    compare({"flats": disk}, ("tidefield",), SETTINGS, tmp_path / "out", run, quiet)
    assert [words[0] for words in run.words] == ["train", "evaluate", "evaluate"]
    broken = tmp_path / "out" / "runs" / "flats" / "nerf"
    broken.mkdir(parents=True)
    (broken / "run.json").write_text("{}")
    compare({"flats": disk}, ("nerf",), SETTINGS, tmp_path / "out", run, quiet)
    assert run.words[3][-1] == "--overwrite"


class Failing(Children):
    """Like it, but some trainings fail as a child does."""

    def __init__(self, scene: Scene, failing: str, status: int) -> None:
        super().__init__(scene)
        self.failing, self.status = failing, status

    def __call__(self, command: Sequence[str], environment: Mapping[str, str]) -> Usage:
        if command[3] == "train" and command[5].endswith(self.failing):
            raise SystemExit(self.status)
        return super().__call__(command, environment)


def test_other_methods_and_scenes_are_done_after_one_that_fails(disk: Path, tmp_path: Path):
    out, scenes = tmp_path / "out", {"a": disk, "b": disk}
    run = Failing(load_scene(disk, width=48), "a/nerfacto", 70)
    with pytest.raises(Unfinished) as raised:
        compare(scenes, ("nerfacto", "nearest"), SETTINGS, out, run, quiet)
    assert raised.value.failures == [Failure("a, nerfacto: train", "it ended with status 70", 70)]
    assert [words[0] for words in run.words] == ["evaluate", "train", "evaluate", "evaluate"]
    results = read_results(out, ["a", "b"], ["nerfacto", "nearest"])
    write_comparison(results, {}, SETTINGS, out)
    page = (out / "tables.md").read_text()
    assert "| a | - | 28.00 |" in page
    assert "Not complete: no results of nerfacto on a." in page.splitlines()
    write_comparison(replace(results, scenes=("b",)), {}, SETTINGS, out)
    assert "Not complete" not in (out / "tables.md").read_text()


def test_nothing_follows_a_child_that_a_signal_ended(disk: Path, tmp_path: Path):
    run = Failing(load_scene(disk, width=48), "a/nerfacto", 143)
    with pytest.raises(SystemExit, match="143"):
        compare({"a": disk, "b": disk}, ("nerfacto", "nearest"), SETTINGS, tmp_path / "out", run, quiet)
    assert run.words == []


def test_a_comparison_ends_with_the_first_status_after_its_tables(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    here = {"a": ("p", "c"), "b": ("p", "c")}
    monkeypatch.setattr("tidefield.commands.compare.worker_processes", lambda _: nullcontext(Inline(here)))
    run = Failing(load_scene(disk, width=48), "nerf", 70)
    monkeypatch.setattr("tidefield.compare.run.run_measured", lambda command, own: run(command[:-1], own))
    for name in here:
        (tmp_path / name).symlink_to(disk)
    options = Compare((tmp_path / "a", tmp_path / "b"), methods=("nerf", "nearest"), width=48, out=tmp_path / "out")
    with pytest.raises(SystemExit) as ended:
        compare_command(replace(options, device="cpu"), Console(quiet=True))
    assert ended.value.code == 70
    assert [record.message for record in caplog.records][-3:] == [
        "a, nerf: train: it ended with status 70",
        "b, nerf: train: it ended with status 70",
        "2 failed, the rest is done; the same command repeats what failed",
    ]
    assert "| b | - | 28.00 |" in (tmp_path / "out" / "tables.md").read_text()
    with pytest.raises(SystemExit, match="70"):
        compare_command(replace(options, methods=("nerf",), device="cpu", out=tmp_path / "none"), Console(quiet=True))
    assert not (tmp_path / "none" / "tables.md").exists(), "of what nobody has there is no table"


class Inline:
    """Stands in for a worker: `check_scene` finds what is given, and nothing has weights."""

    def __init__(self, scenes: Mapping[str, tuple[str, str]]) -> None:
        self.scenes, self.called = scenes, []

    def submit(self, function: Callable, *given: object) -> SimpleNamespace:
        self.called.append(function.__name__)
        found = self.scenes[given[0].name] if isinstance(given[0], Path) else {}
        return SimpleNamespace(result=lambda: found)


def test_a_worker_of_a_cluster_returns_what_failed():
    failure = Failure("a, nerfacto: train", "it broke", 2)

    def work(name: str) -> None:
        if name == "a":
            raise Unfinished("it broke", [failure])
        if name == "c":
            raise RunError("s3://flats did not answer")

    with _with_failures(lambda: nullcontext(work)) as tried:
        assert (tried("a"), tried("b")) == ([failure], ())
        assert tried("c") == [Failure("c", "s3://flats did not answer", 2)]


def test_flats_are_made_by_another_process_than_the_one_that_measures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    worker, made = Inline({}), {"vegetation": tmp_path}
    monkeypatch.setattr(worker, "scenes", {"scenes": made})
    monkeypatch.setattr("tidefield.commands.compare.worker_processes", lambda _: nullcontext(worker))
    assert _scenes(Compare(protocol="tidalflats", out=tmp_path)) == made
    assert worker.called == ["tidal_flats"]


def test_an_interrupted_training_of_a_comparison_names_its_command(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    found, again = {}, []
    run = Children(load_scene(disk, width=48))
    with monkeypatch.context() as patch:
        patch.setattr(Children, "__call__", lambda self, command, own: found.update(own) or Usage(1.0, 1))
        compare({"flats": disk}, ("tidefield",), SETTINGS, tmp_path / "out", run, quiet)
    monkeypatch.setattr("tidefield.commands.train._train", lambda options, console, text: again.append(text))
    train(Train(disk, tmp_path / "run"), Console(quiet=True))
    for name, value in found.items():
        monkeypatch.setenv(name, value)
    train(Train(disk, tmp_path / "run"), Console(quiet=True))
    assert again == ["the same command with --resume", "the same command"]


def test_results_of_other_settings_are_not_mixed_in(disk: Path, tmp_path: Path):
    run = Children(load_scene(disk, width=48))
    compare({"flats": disk}, ("tidefield", "nearest"), SETTINGS, tmp_path / "out", run, quiet)
    longer = Settings(minutes=20.0, steps=None, width=48, device="cpu", seed=1)
    compare({"flats": disk}, ("nearest",), longer, tmp_path / "out", run, quiet)  # is not trained
    with pytest.raises(RunError, match=r"was made with .*'minutes': 10.0.*'minutes': 20.0.*name another folder"):
        compare({"flats": disk}, ("tidefield",), longer, tmp_path / "out", run, quiet)


@pytest.mark.thorough
def test_results_on_a_scene_that_was_made_anew_are_not_mixed_in(disk: Path, tmp_path: Path):
    out, methods = tmp_path / "out", ("tidefield", "nearest", "nerf")
    compare({"flats": disk}, methods, SETTINGS, out, Children(load_scene(disk, width=48)), quiet)
    for method, poses in zip(methods, ("first", "second", None), strict=True):
        file = out / "runs" / "flats" / method / "evaluation.json"
        write_json(file, {**json.loads(file.read_text()), "poses": poses})
    require_one_state({"flats": "second"}, methods[1:], out)
    with pytest.raises(RunError, match="flats has results of nearest, on other poses or another split than the scene"):
        require_one_state({"flats": "third"}, methods[1:], out)
    write_json(out / "runs" / "flats" / "nerf" / "run.json", {"poses": "first"})  # trained, and not yet evaluated
    (out / "runs" / "flats" / "nerf" / "evaluation.json").unlink()
    process = (out / "runs" / "flats" / "nerf" / "process.json").read_text()
    (out / "runs" / "flats" / "nerf" / "process.json").unlink()  # the training was interrupted, and is started again
    require_one_state({"flats": "second"}, methods[1:], out)
    (out / "runs" / "flats" / "nerf" / "process.json").write_text(process)
    with pytest.raises(RunError, match="flats has results of nearest, and nerf, on different poses or splits"):
        require_one_state({"flats": "second"}, methods[1:], out)
    write_json(out / "runs" / "flats" / "nerf" / "run.json", {"poses": None})
    options = Compare((disk,), methods=methods, width=48, device="cpu", out=out)
    with pytest.raises(RunError, match="flats has results of tidefield, and nearest, on different poses or splits"):
        compare_command(options, Console(quiet=True))


def test_tables_figures_and_numbers_are_written(disk: Path, tmp_path: Path):
    scene, out = load_scene(disk, width=48), tmp_path / "out"
    compare({"flats": disk}, ("tidefield", "nearest"), SETTINGS, out, Children(scene), quiet)
    results = read_results(out, ["flats"], ["tidefield", "nerfacto", "nearest"])
    files = write_comparison(results, {"flats": disk}, SETTINGS, out)
    assert [file.relative_to(out).as_posix() for file in files] == [
        "tables.md",
        "tables.tex",
        "tables.csv",
        "comparison.json",
        "figures/flats.png",
        "curves.png",
    ]
    page = (out / "tables.md").read_text()
    assert "| flats | 20.00 | - | **28.00** |" in page
    assert "; photographs 48 px wide; " in page
    wider = replace(
        results.by["flats", "nearest"], evaluation={**results.by["flats", "nearest"].evaluation, "width": 40}
    )
    both = replace(results, scenes=("flats", "narrow"), by={**results.by, ("narrow", "nearest"): wider})
    assert widths(both) == "48 (flats), 40 (narrow)", "files of a scene may be narrower than what was asked for"
    assert "LPIPS, VGG" in page
    assert "LPIPS with alexnet-owt-7be5be79.pth, the published file (SHA-256 7be5be79" in page
    assert "LPIPS with vgg16-397923af.pth, which is another file than the published one (SHA-256 ffff" in page
    assert "LPIPS, AlexNet, all pixels (" not in page, "of what nobody has there is no table"
    assert "| flats, tidefield | 10.0 | 7 | 0.50 | 1,234 | 3.00 | 3.00 |" in page
    numbers = json.loads((out / "comparison.json").read_text())
    assert numbers["settings"]["minutes"] == 10
    assert numbers["results"][0]["curve"] == [[10.0, 20.5], [600.0, 25.0]]
    assert str(tmp_path) not in (out / "comparison.json").read_text(), "the paths of this machine are not published"
    again = read_figures([out / "comparison.json", tmp_path / "none.json"], ["other"], results.methods)
    assert quality_tables(again) == quality_tables(results)
    assert cost_table(again) == cost_table(results)
    with Image.open(out / "figures" / "flats.png") as figure:
        assert figure.width == 3 * 320 + 2 * 4


def test_tables_have_the_machines_that_measured_and_not_the_one_that_writes(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out = tmp_path / "out"
    machine = {
        "processor": "Fast",
        "cores": 16,
        "memory_bytes": 1 << 36,
        "system": "Linux",
        "python": "3",
        "torch": "2",
    }
    made = {"date": "2026-01-02", "version": "0.1", "machine": {**machine, "gpus": ["H200"]}}
    for name, gpu, date in (("a", "H200", "2026-01-02"), ("b", "H100", "2026-01-03")):
        on = {**made, "date": date, "machine": {**machine, "gpus": [gpu]}}
        monkeypatch.setattr("tidefield.compare.run.describe", lambda on=on: on)
        compare({name: disk}, ("nearest",), SETTINGS, out, Children(load_scene(disk, width=48)), quiet)
    results = read_results(out, ["a", "b"], ["nearest"])
    write_comparison(results, {}, SETTINGS, out)
    lines = (out / "tables.md").read_text().splitlines()
    assert "On cpu; photographs 48 px wide; measured 2026-01-02 to 2026-01-03 with Tidefield 0.1." in lines
    assert any(
        line.endswith(": Fast, 16 cores, H100 (nearest of b); Fast, 16 cores, H200 (nearest of a).") for line in lines
    )
    write_comparison(
        replace(results, scenes=("a",), by={("a", "nearest"): results.by["a", "nearest"]}), {}, SETTINGS, out
    )
    page = (out / "tables.md").read_text()
    assert "Machine: Fast, 16 cores, 64 GiB; Linux, Python 3, torch 2, H200." in page.splitlines()
    assert "different machines" not in page
    file = out / "runs" / "a" / "nearest" / "process.json"
    for damage in ({"cores": "many"}, {"gpus": [1]}, {"processor": None}):
        write_json(file, {"settings": {}, "evaluate": {**made, "machine": {**machine, **damage}}})
        with pytest.raises(RunError, match=r"process.json is damaged"):
            read_results(out, ["a"], ["nearest"])


def test_names_do_not_break_tables(disk: Path, tmp_path: Path):
    run, out = Children(load_scene(disk, width=48)), tmp_path / "out"
    names = ["mean", "a|b"]
    compare(dict.fromkeys(names, disk), ("tidefield",), SETTINGS, out, run, quiet)
    compare({"mean": disk}, ("nearest",), SETTINGS, out, run, quiet)
    results = read_results(out, names, ["tidefield", "nearest"])
    (table,) = (t for t in quality_tables(results) if t.title.startswith("PSNR, dB, all pixels ("))
    assert table.rows == [["mean", "20.00", "28.00"], ["a|b", "20.00", "-"], ["mean", "20.00", "-"]]
    assert r"| a\|b | 20.00 | - |" in table.markdown()
    assert r"\textbackslash{}x\textasciicircum{}\textasciitilde{} &" in Table("", ["", ""], [["\\x^~", "1"]]).latex()
    write_comparison(results, {}, SETTINGS, out)
    titles = [row for row in csv.reader((out / "tables.csv").read_text().splitlines()) if row and "dB" in row[0]]
    assert titles[0] == [table.title], "one cell, though it has commas"


def test_a_figure_of_what_has_no_results_any_more_is_deleted(disk: Path, tmp_path: Path):
    run, out = Children(load_scene(disk, width=48)), tmp_path / "out"
    compare({"a": disk}, ("nearest",), SETTINGS, out, run, quiet)
    results = read_results(out, ["a", "b"], ["nearest"])
    (out / "figures").mkdir()
    (out / "figures" / "b.png").touch()
    files = write_comparison(results, {"a": disk, "b": tmp_path / "none"}, SETTINGS, out)
    assert out / "figures" / "a.png" in files
    assert [file.name for file in (out / "figures").iterdir()] == ["a.png"]


def test_published_figures_need_the_protocol_and_weights_are_those_of_what_is_compared(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out, run, asked = tmp_path / "out", Children(load_scene(disk, width=48)), []
    compare({"room": disk}, ("paper", "zero-shot"), SETTINGS, out, run, quiet)
    results = read_results(out, ["room"], ["paper"])
    monkeypatch.setattr("tidefield.train.checkpoint.shipped_weights", asked.append)
    write_comparison(results, {}, SETTINGS, out)
    assert "As the paper's" not in (out / "tables.md").read_text(), "a scene may be called room"
    write_comparison(replace(results, methods=("zero-shot",)), {}, SETTINGS, out, "mipnerf360")
    assert "As the paper's Table 2" in (out / "tables.md").read_text()
    assert asked == ["paper", "swift"]


@pytest.mark.thorough
def test_tables_say_what_trained_weights_know_of_a_scene(disk: Path, tmp_path: Path):
    learned = learned_from()
    assert learned == ("brighton_beach", "turin_lot"), "what the file of the shipped weights says"
    out, names = tmp_path / "out", ("vegetation", "swindale", learned[1], "mine")
    scenes, run = dict.fromkeys(names, disk), Children(load_scene(disk, width=48))
    compare(scenes, ("tidefield", "nearest"), SETTINGS, out, run, quiet)
    results = read_results(out, names, ("tidefield", "nearest"))
    write_comparison(results, scenes, SETTINGS, out)
    page = (out / "tables.md").read_text()
    for line in (
        "- ¹ vegetation: a category of the synthetic generator; ",
        "- ² swindale: nothing was learned from this scene, but results on it chose the recipe",
        "- ³ turin_lot: the shipped weights learned from this scene's training photographs: ",
        "- without a mark (mine): no scene of this name taught the shipped weights or chose their recipe.",
        *("| vegetation ¹ | ", "| swindale ² | ", "| turin_lot ³ | ", "| mine | "),
        "The column `tidefield` began with random weights and was trained for 7 steps.",
    ):
        assert any(found.startswith(line) for found in page.splitlines()), line
    assert "\nturin_lot,20.00," in (out / "tables.csv").read_text(), "for programs, names stay as they are"
    untrained = replace(results, methods=("nearest",))
    write_comparison(untrained, scenes, SETTINGS, out)
    assert "³" not in (out / "tables.md").read_text(), "nothing was learned by what is compared"


def test_columns_of_presets_say_what_they_began_with(disk: Path):
    def column(*weights: str | None, steps: tuple[int, ...] = (404, 496)) -> str:
        found = {}
        for name, sha256, count in zip("ab", weights, steps, strict=True):
            one = evaluation(load_scene(disk, width=48), 20.0)
            one["configuration"] = {"weights": sha256, "trained": {"steps": count, "seconds": 600.0}}
            found[name, "paper"] = Result(one)
        (sentence,) = trainings(Results(("a", "b"), ("paper",), found))
        return sentence

    assert column(None, None) == "The column `paper` began with random weights and was trained for 404 to 496 steps."
    assert column("f00d", "f00d", steps=(7, 7)).endswith("began with trained weights and was trained for 7 steps.")
    assert "random or trained weights" in column(None, "f00d")


def test_tables_of_a_gpu_say_what_ran_on_the_processor_and_have_its_memory(disk: Path, tmp_path: Path):
    run = Children(load_scene(disk, width=48))
    compare({"a": disk}, ("tidefield", "nearest"), SETTINGS, tmp_path, run, quiet)
    results = read_results(tmp_path, ["a"], ["tidefield", "nearest"])
    assert untrained_limits(results, "cpu") == []
    assert untrained_limits(replace(results, methods=("tidefield",)), "cuda") == []
    (sentence,) = untrained_limits(results, "cuda")
    assert sentence == "Without training, on the processor: nearest. Their times are not those of cuda."
    assert "GPU memory, GB (evaluate)" not in cost_table(results).columns
    one = results.by["a", "tidefield"]
    on_gpu = replace(one, evaluation={**one.evaluation, "peak_cuda_memory_bytes": 2_500_000_000})
    table = cost_table(replace(results, by={**results.by, ("a", "tidefield"): on_gpu}))
    assert [row[-1] for row in table.rows] == ["2.50", "-"]
    assert table.columns[-1] == "GPU memory, GB (evaluate)"


def test_the_best_is_bold_and_means_need_every_scene(disk: Path, tmp_path: Path):
    out = tmp_path / "out"
    run = Children(load_scene(disk, width=48))
    compare({"a": disk, "b": disk}, ("tidefield",), SETTINGS, out, run, quiet)
    compare({"a": disk}, ("nearest",), SETTINGS, out, run, quiet)
    results = read_results(out, ["a", "b"], ["tidefield", "nearest"])
    (table,) = (t for t in quality_tables(results) if t.title.startswith("PSNR, dB, all pixels ("))
    assert table.rows == [["a", "20.00", "28.00"], ["b", "20.00", "-"], ["mean", "20.00", "-"]]
    assert table.bold == {(0, 2)}, "one alone is not the best of anything"
    (ssim,) = (t for t in quality_tables(results) if t.title.startswith("LPIPS, VGG, all pixels ("))
    assert "less is better" in ssim.title
    assert len(cost_table(results).rows) == 3


def test_the_least_is_bold_where_less_is_better():
    values = {"tidefield": (20.0, 0.3), "nearest": (18.0, 0.2)}
    by = {
        ("flats", name): Result({"mean": {"psnr": psnr, "lpips_vgg": lpips}}) for name, (psnr, lpips) in values.items()
    }
    tables = quality_tables(Results(("flats",), tuple(values), by))
    psnr, lpips = (
        next(table for table in tables if table.title.startswith(f"{metric}, all pixels ("))
        for metric in ("PSNR, dB", "LPIPS, VGG")
    )
    assert psnr.bold == {(0, 1), (1, 1)}
    assert lpips.bold == {(0, 2), (1, 2)}


def test_the_last_of_several_comparisons_counts(disk: Path, tmp_path: Path):
    run = Children(load_scene(disk, width=48))
    for out, methods in (("one", ("tidefield", "nearest")), ("two", ("tidefield",))):
        compare({"a": disk}, methods, SETTINGS, tmp_path / out, run, quiet)
        results = read_results(tmp_path / out, ["a"], methods)
        results.by["a", "tidefield"].evaluation["mean"]["psnr"] = {"one": 21.0, "two": 22.0}[out]
        write_json(tmp_path / f"{out}.json", {"results": figures_of(results)})
    found = read_figures([tmp_path / "one.json", tmp_path / "two.json"], ["b", "a"], ("tidefield", "nearest"))
    assert found.scenes == ("a",)
    assert found.metric("a", "tidefield", "psnr") == 22.0
    assert found.metric("a", "nearest", "psnr") == 28.0


def test_published_figures_stand_next_to_measured_ones(disk: Path, tmp_path: Path):
    out = tmp_path / "out"
    compare({"garden": disk}, ("tidefield",), SETTINGS, out, Children(load_scene(disk, width=48)), quiet)
    results = read_results(out, ["garden", "other"], ["tidefield"])
    table = paper_table(results, TABLE_2, "Table 2")
    assert table is not None
    assert table.rows[0][:4] == ["garden", "20.00", "25.01", "23.06"]
    assert table.rows[1][:4] == ["mean", "20.00", "25.01", "23.06"]
    assert paper_table(results, TABLE_3, "Table 3") is None
    assert np.mean([v["nerfacto"][0] for v in TABLE_2.values()]) == pytest.approx(21.77, abs=0.01)
    assert np.mean([v["tidefield"][0] for v in TABLE_2.values()]) == pytest.approx(24.43, abs=0.01)
    assert np.mean([v["tidefield"][0] for v in TABLE_3.values()]) == pytest.approx(22.49, abs=0.01)
    assert np.mean([v["nerfacto"][0] for v in TABLE_3.values()]) == pytest.approx(22.30, abs=0.01)


def test_the_limits_of_nerfacto_are_stated_where_it_ran_on_a_cpu(disk: Path, tmp_path: Path):
    out = tmp_path / "out"
    compare({"flats": disk}, ("nerfacto", "nearest"), SETTINGS, out, Children(load_scene(disk, width=48)), quiet)
    (sentence,) = nerfacto_limits(read_results(out, ["flats"], ["nerfacto", "nearest"]))
    assert "1,024 rays a batch instead of its default of 4,096" in sentence
    assert "7 steps, 0.0% of its default of 30,000" in sentence
    assert nerfacto_limits(read_results(out, ["flats"], ["nearest"])) == []
    on_a_gpu = Children(load_scene(disk, width=48))
    compare({"flats": disk}, ("nerfacto",), replace(SETTINGS, device="cuda:0"), tmp_path / "gpu", on_a_gpu, quiet)
    (sentence,) = nerfacto_limits(read_results(tmp_path / "gpu", ["flats"], ["nerfacto"]))
    assert sentence.startswith("Within the budget Nerfacto made 7 steps, 0.0% of its default of 30,000. Its memory is")


def test_the_limits_of_opensplat_are_stated(disk: Path, tmp_path: Path):
    out = tmp_path / "out"
    compare({"flats": disk}, ("opensplat", "nearest"), SETTINGS, out, Children(load_scene(disk, width=48)), quiet)
    (sentence,) = opensplat_limits(read_results(out, ["flats"], ["opensplat", "nearest"]))
    assert "7 steps, 0.0% of its default of 30,000" in sentence
    assert "the first 3,000 with photographs of a quarter of their size" in sentence
    assert opensplat_limits(read_results(out, ["flats"], ["nearest"])) == []


@pytest.mark.thorough
def test_opensplat_is_compared_with_the_program_that_is_named(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def run_here(command: list[str], environment: dict[str, str]) -> Usage:
        with monkeypatch.context() as context:
            for name, value in environment.items():
                context.setenv(name, value)
            context.setattr(sys, "argv", ["tidefield", *command[3:]])
            cli.main()
        return Usage(1.0, 1)

    monkeypatch.setattr("tidefield.compare.run.run_measured", run_here)
    out = tmp_path / "out"
    options = Compare(
        (disk,),
        methods=("opensplat", "nearest"),
        budget=Budget(steps=2),
        width=48,
        out=out,
        device="cpu",
        opensplat=opensplat_program.install(tmp_path),
    )
    compare_command(options, Console(quiet=True))
    page = (out / "tables.md").read_text()
    assert "| scene | opensplat | nearest |" in page
    assert "| flats, opensplat | 0.0 | 2 |" in page
    assert "Within the budget OpenSplat made 2 steps" in page
    run = json.loads((out / "runs" / "flats" / "opensplat" / "run.json").read_text())
    assert run["config"] == {"version": "1.1.4 (git commit 1234567)", "method": "opensplat"}
    assert str(tmp_path) not in (out / "comparison.json").read_text()
    process = (out / "runs" / "flats" / "opensplat" / "process.json").read_text()
    assert "tidefield train SCENE RUN --method opensplat --steps 2" in process


def test_a_table_in_every_form():
    table = Table("A & B", ["scene", "x_1"], [["a_b", "1%"], ["c, d", "-"]], frozenset({(0, 1)}))
    assert table.markdown().splitlines() == [
        "### A & B",
        "",
        "| scene | x_1 |",
        "| --- | ---: |",
        "| a_b | **1%** |",
        "| c, d | - |",
    ]
    assert r"a\_b & \textbf{1\%} \\" in table.latex()
    assert r"\caption{A \& B}" in table.latex()
    assert list(csv.reader(table.csv().splitlines())) == [["scene", "x_1"], ["a_b", "1%"], ["c, d", ""]]


def test_figures_of_a_csv_are_numbers():
    found = evaluation(wall.scene(wall.cameras(3), test=(1,)), 20.0) | {"rays_per_second": 1234567.0}
    peaks = {"train": {"peak_memory_bytes": 1_200_000_000}, "evaluate": {"peak_memory_bytes": 800_000_000}}
    table = cost_table(Results(("2,000 m",), ("nerf",), {("2,000 m", "nerf"): Result(found, peaks)}))
    assert "1,234,567" in table.markdown()
    head, (name, *cells) = csv.reader(table.csv().splitlines())
    assert name == "2,000 m, nerf"
    assert dict(zip(head[-3:], map(float, cells[-3:]), strict=True)) == {
        "rays/s": 1234567,
        "memory, GB (train)": 1.2,
        "memory, GB (evaluate)": 0.8,
    }


def test_the_legend_of_curves_has_the_methods_of_all_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    drawn = []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda figure, *_, **__: drawn.append(figure))
    by = {
        pair: Result({}, curve=[(10.0, 20.5), (600.0, 25.0)]) for pair in (("a", "nerf"), ("b", "nerf"), ("b", "paper"))
    }
    write_curves(Results(("a", "b"), ("paper", "nerfacto", "nerf"), by), tmp_path / "curves.png")
    (legend,) = drawn[0].legends
    assert [text.get_text() for text in legend.get_texts()] == ["paper", "nerf"]
    assert [line.get_color() for line in legend.get_lines()] == ["C0", "C2"]


def test_crops_show_where_methods_differ_and_do_not_overlap():
    truth = np.full((60, 80, 3), 100, np.uint8)
    one, other = truth.copy(), truth.copy()
    one[20:26, 50:56] = 200
    other[40:44, 12:16] = 160
    everywhere = np.ones((60, 80), bool)
    corners = most_different(truth, [one, other], everywhere, 16)
    middles = [(u + 8, v + 8) for u, v in corners]
    assert np.hypot(middles[0][0] - 53, middles[0][1] - 23) < 9
    assert np.hypot(middles[1][0] - 14, middles[1][1] - 42) < 9
    (u, v), _ = most_different(truth, [other], everywhere, 16)
    assert np.hypot(u + 8 - 14, v + 8 - 42) < 9
    left = everywhere & (np.arange(80) < 40)
    (u, v), _ = most_different(truth, [one, other], left, 16)
    assert np.hypot(u + 8 - 14, v + 8 - 42) < 9, "what does not count is not shown"


def test_nothing_is_drawn_of_nothing(tmp_path: Path):
    results = read_results(tmp_path, ["a"], ["tidefield"])
    assert side_by_side(results, "a", wall.scene(wall.cameras(3), test=(1,))) is None


def test_a_wholly_masked_photograph_is_left_out(disk: Path, tmp_path: Path):
    scene, out = load_scene(disk, width=48), tmp_path / "out"
    compare({"flats": disk}, ("tidefield",), SETTINGS, out, Children(scene), quiet)
    file = out / "runs" / "flats" / "tidefield" / "evaluation.json"
    data = json.loads(file.read_text())
    names = [scene.names[i] for i in scene.test]
    for count in (1, len(names)):
        data["per_photograph"] |= {name: {**data["per_photograph"][name], "psnr": None} for name in names[:count]}
        write_json(file, data)
        figure = side_by_side(read_results(out, ["flats"], ["tidefield"]), "flats", scene)
        assert (figure is None) == (count == len(names))


def test_the_public_scenes_are_read_at_their_published_sizes(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    data, out = tmp_path / "360_v2", tmp_path / "out"
    with pytest.raises(SceneError, match="none of bicycle"):
        mipnerf360(data, out)
    for name, size in (("garden", "images_4"), ("room", "images_2")):
        shutil.copytree(disk, data / name)
        for source in (disk / "images").rglob("*.*"):
            with Image.open(source) as picture:
                small = picture.resize((picture.width // int(size[-1]), picture.height // int(size[-1])))
            target = data / name / size / source.relative_to(disk / "images")
            target.parent.mkdir(parents=True, exist_ok=True)
            small.save(target)
    whole = load_scene(disk)
    for _ in range(2):  # the second time the links are there
        scenes = mipnerf360(data, out)
        assert list(scenes) == ["garden", "room"]
        for name, factor in (("garden", 4), ("room", 2)):
            scene = load_scene(scenes[name])
            assert scene.cameras[0].width == whole.cameras[0].width // factor
            assert scene.test == tuple(range(0, len(scene.names), 8))
    (out / "garden" / "images").unlink()
    (out / "garden" / "images").symlink_to(tmp_path / "gone")
    assert load_scene(mipnerf360(data, out)["garden"]).cameras[0].width == whole.cameras[0].width // 4
    with monkeypatch.context() as patch:

        def refused(*_: object, **__: object) -> None:
            raise OSError(22, "a required privilege is not held")

        patch.setattr(Path, "symlink_to", refused)
        with pytest.raises(RunError, match=r"images cannot be made \(a required privilege .*Developer Mode"):
            mipnerf360(data, tmp_path / "on-windows")
    shutil.copytree(data, tmp_path / "other")
    with pytest.raises(RunError, match=r"garden/images leads to .*360_v2/garden/images_4: expected .*other/garden"):
        mipnerf360(tmp_path / "other", out)
    shutil.rmtree(data / "room" / "images_2")
    with pytest.raises(SceneError, match="images_2 is not there"):
        mipnerf360(data, out)


def test_protocols_name_their_scenes(disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(SceneError, match="two scenes are named flats"):
        named([disk, tmp_path / "elsewhere" / "flats"])
    (tmp_path / "other").symlink_to(disk)
    assert named([disk, tmp_path / "other"]) == {"flats": disk, "other": tmp_path / "other"}
    assert set(MIPNERF360) == set(TABLE_2)
    made = []

    def write(survey: object, folder: Path) -> None:
        made.append(folder)

    monkeypatch.setattr("tidefield.synthetic.make_survey", lambda *_, **__: None)
    monkeypatch.setattr("tidefield.synthetic.write_survey", write)
    scenes = tidal_flats(tmp_path / "scenes", 100, [disk])
    assert set(scenes) == set(TABLE_3) | {"flats"}
    assert len(made) == 5
    tidal_flats(tmp_path / "scenes", 100, [])
    assert len(made) == 5
    with pytest.raises(SceneError, match="vegetation has the name of a scene of the protocol"):
        tidal_flats(tmp_path / "scenes", 100, [disk, tmp_path / "vegetation"])


@pytest.mark.parametrize("method", METHODS)
def test_tidefield_understands_what_it_is_asked(method: str, monkeypatch: pytest.MonkeyPatch):
    called, asked = [], commands(Path("data"), Path("run"), method, SETTINGS)
    monkeypatch.setattr(cli, "_set_up", lambda verbosity: None)
    for name, words in asked.items():
        module, _, function = cli.COMMANDS[name]
        monkeypatch.setattr(module, function, lambda *args, name=name, **options: called.append(name))
        monkeypatch.setattr(sys, "argv", ["tidefield", *words])
        cli.main()
    assert called == list(asked)


@pytest.mark.thorough
@pytest.mark.parametrize("is_quiet", [False, True])
def test_what_a_comparison_runs_is_as_quiet_as_itself(
    is_quiet: bool, disk: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    def stop(command: list[str], _: object) -> None:
        asked.append(command)
        raise KeyboardInterrupt

    asked: list[list[str]] = []
    monkeypatch.setattr("tidefield.compare.run.run_measured", stop)
    options = Compare((disk,), methods=("nearest",), out=tmp_path / "out", device="cpu")
    with pytest.raises(KeyboardInterrupt):
        compare_command(options, Console(quiet=is_quiet))
    assert [words[-1] == "--quiet" for words in asked] == [is_quiet]


def test_missing_software_is_reported_before_anything_is_trained(
    disk: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("tidefield.compare.run.run_measured", lambda *_: pytest.fail("something was run"))
    for method, message in (
        ("nerfacto", "run `tidefield baselines install nerfacto`"),
        ("splatfacto", "expected CUDA"),
        ("opensplat", "expected OpenSplat, which is not part of Tidefield"),
    ):
        options = Compare((disk,), methods=("tidefield", method), out=tmp_path / "out", device="cpu")
        with pytest.raises(RunError, match=message):
            compare_command(options, Console(quiet=True))


@pytest.mark.thorough
def test_mistakes_are_reported_before_anything_is_trained(disk: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr("tidefield.compare.run.run_measured", lambda *_: pytest.fail("something was run"))
    options = Compare((disk,), methods=("nearest",), out=tmp_path / "out", device="cpu")
    ablation = Ablate((disk,), out=tmp_path / "out", device="cpu")
    (tmp_path / "file").touch()
    for changed, message in (
        ({"scenes": (disk, tmp_path / "none")}, "none is missing"),
        ({"width": 3}, "the width is 3 pixels"),
        ({"out": tmp_path / "file"}, r"cannot be written \(Not a directory"),
        ({"scenes": ()}, "nothing to compare on"),
    ):
        with pytest.raises(TidefieldError, match=message):
            compare_command(replace(options, **changed), Console(quiet=True))
        with pytest.raises(TidefieldError, match=message):
            ablate(replace(ablation, **changed), Console(quiet=True))
    with pytest.raises(RunError, match="expected methods; name some"):
        compare_command(replace(options, methods=()), Console(quiet=True))
    assert not (tmp_path / "out").exists()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "damaged"),
    [
        ("evaluation.json", "{}"),
        ("evaluation.json", "[1]"),
        ("evaluation.json", lambda whole: whole.replace("1234.0", '"fast"')),
        ("evaluation.json", lambda whole: whole.replace('"psnr": 20.0', '"psnr": "good"')),
        ("process.json", "[1]"),
        ("process.json", '{"settings": "x"}'),
        ("process.json", '{"settings": {}, "train": {"peak_memory_bytes": "x"}}'),
        ("curve.json", "[[1]]"),
        ("curve.json", "7"),
        ("curve.json", f"[[1, 1{400 * '0'}]]"),
        ("curve.json", "[[1, NaN]]"),
        ("run.json", "[]"),
        ("evaluation.json", lambda whole: whole.replace("1234.0", "NaN")),
        ("evaluation.json", lambda whole: whole.replace("1234.0", f"1{400 * '0'}")),
        ("evaluation.json", lambda whole: json.dumps({**json.loads(whole), "per_photograph": {}})),
    ],
)
def test_a_damaged_result_is_named(name: str, damaged, disk: Path, tmp_path: Path):
    run, out = Children(load_scene(disk, width=48)), tmp_path / "out"
    compare({"flats": disk}, ("tidefield",), SETTINGS, out, run, quiet)
    file = out / "runs" / "flats" / "tidefield" / name
    file.write_text(damaged if isinstance(damaged, str) else damaged(file.read_text()))
    with pytest.raises(RunError, match=f"{name} is (damaged|not valid JSON)"):
        read_results(out, ["flats"], ["tidefield"])
    if name != "curve.json":
        with pytest.raises(RunError, match=f"{name} is (damaged|not valid JSON)"):
            compare({"flats": disk}, ("tidefield", "nearest"), SETTINGS, out, run, quiet)
        assert len(run.words) == 2, "before anything is trained"


@pytest.mark.parametrize("damage", [Path.unlink, lambda file: file.write_bytes(b"x"), lambda file: shrink(file)])
def test_a_rendering_that_cannot_be_shown_is_named(damage, disk: Path, tmp_path: Path):
    run, out = Children(load_scene(disk, width=48)), tmp_path / "out"
    compare({"flats": disk}, ("nearest",), SETTINGS, out, run, quiet)
    for file in (out / "runs" / "flats" / "nearest" / "renderings").rglob("*.png"):
        damage(file)
    with pytest.raises(RunError, match=r"png cannot be shown \(.*evaluation.json and repeat"):
        write_comparison(read_results(out, ["flats"], ["nearest"]), {"flats": disk}, SETTINGS, out)


def shrink(file: Path) -> None:
    with Image.open(file) as picture:
        picture.resize((20, 20)).save(file)


def test_an_evaluation_that_was_not_recorded_is_repeated(disk: Path, tmp_path: Path):
    run, out = Children(load_scene(disk, width=48)), tmp_path / "out"
    compare({"flats": disk}, ("nearest",), SETTINGS, out, run, quiet)
    (out / "runs" / "flats" / "nearest" / "process.json").unlink()  # ended before it was written
    compare({"flats": disk}, ("nearest",), SETTINGS, out, run, quiet)
    assert run.words[1] == [*run.words[0], "--overwrite"]


def test_the_record_says_which_device_auto_was() -> None:
    settings = make_settings(Budget(), None, "auto", 0, from_scratch=False)
    assert settings.device == str(choose_device("auto"))
