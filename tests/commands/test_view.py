"""`tidefield view`: what cannot be looked at is one clear error."""

import shutil
import sys
from pathlib import Path

import pytest
from rich.console import Console
from scenes_on_disk import PINHOLE, survey, write_colmap

from tidefield.commands import view as view_command
from tidefield.commands.common import ZeroShot
from tidefield.commands.view import View, view
from tidefield.config import PRESETS
from tidefield.errors import TidefieldError
from tidefield.files import LOCK_FILE, only_writer
from tidefield.train.checkpoint import Run, write_run

QUIET = Console(quiet=True)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    write_colmap(tmp_path / "scene", survey(PINHOLE))
    return tmp_path / "scene"


def refused(message: str, source: Path, **options) -> None:
    with pytest.raises(TidefieldError, match=message):
        view(View((source,), port=0, no_browser=True, device="cpu", **options), QUIET)


def test_a_scene_without_zero_shot_is_one_clear_error(scene: Path):
    pytest.importorskip("viser")
    refused("is a scene, not a run: .* add --zero-shot", scene)


def test_what_is_neither_run_nor_scene_nor_map_is_one_clear_error(tmp_path: Path):
    pytest.importorskip("viser")
    refused("gone does not exist: expected a run, a folder of `tidefield map`", tmp_path / "gone")
    refused(r" is no run or map: expected a run, a folder of `tidefield map`.* --zero-shot a scene", tmp_path)


def test_a_run_that_is_being_trained_and_has_saved_nothing_is_one_clear_error(scene: Path, tmp_path: Path):
    pytest.importorskip("viser")
    with only_writer(tmp_path / "run"):
        write_run(tmp_path / "run", Run(scene, None, 0, PRESETS["swift"]))
        refused("is being trained and has saved nothing yet: expected a first checkpoint", tmp_path / "run")


def test_a_run_whose_training_was_killed_before_it_saved_is_one_clear_error(scene: Path, tmp_path: Path):
    pytest.importorskip("viser")
    run = tmp_path / "run"
    run.mkdir()
    write_run(run, Run(scene, None, 0, PRESETS["swift"]))
    (run / LOCK_FILE).touch()
    refused(r"run has no checkpoint\S*: .* train it with --resume", run)


def test_a_scene_whose_photographs_went_is_one_clear_error(scene: Path):
    pytest.importorskip("viser")
    shutil.rmtree(scene / "images")
    refused("9 of the 9 photographs .* are missing", scene, zero=ZeroShot(zero_shot=True))


def test_options_of_scenes_are_refused_with_maps(tmp_path: Path):
    pytest.importorskip("rasterio")
    from map_folders import write_map

    folder = write_map(tmp_path / "map", (1, 2, 3))
    with pytest.raises(TidefieldError, match="--allow-missing was given with maps: it belongs to runs and scenes"):
        view(View((folder,), port=0, no_browser=True, allow_missing=True), QUIET)


def test_a_scene_among_maps_and_nothing_at_all_are_one_clear_error(scene: Path, tmp_path: Path):
    pytest.importorskip("rasterio")
    from map_folders import write_map

    folder = write_map(tmp_path / "map", (1, 2, 3))
    with pytest.raises(TidefieldError, match=r"scene is no folder of .* expected several of these, or one run or"):
        view(View((folder, scene), port=0, no_browser=True), QUIET)
    with pytest.raises(TidefieldError, match="nothing to look at was named"):
        view(View((), port=0, no_browser=True), QUIET)


def test_heights_over_other_datums_are_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("rasterio")
    import numpy as np
    from surveys_of_two_dates import write_surface

    systems = {"a": "EPSG:32630+5773", "b": "EPSG:32630+5773", "c": "EPSG:32630+3855"}
    for name, crs in systems.items():
        write_surface(tmp_path / name / "dsm.tif", np.ones((8, 8), np.float32), crs=crs)
    monkeypatch.setattr(view_command, "serve", lambda *_: None)
    with caplog.at_level("WARNING", logger="tidefield"):
        view(View(tuple(tmp_path / name for name in systems), port=0, no_browser=True), QUIET)
    found = [line for line in caplog.messages if "EGM" in line]
    assert [line.split(":")[0] for line in found] == ["a and c", "b and c"]
    assert "EGM96" in found[0]
    assert "EGM2008" in found[0]


def test_a_width_out_of_range_is_one_clear_error(scene: Path):
    refused("--width 9 was asked for: expected 64 to 4096", scene, width=9)


def test_a_missing_library_is_one_clear_error(scene: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    refused(r"needs viser, .*pip install 'tidefield\[view\]'", scene)


def test_without_a_browser_the_address_is_still_there(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    class Ended:
        def wait(self, seconds: float) -> None:  # without a timeout, Ctrl-C does nothing on Windows
            raise KeyboardInterrupt

    monkeypatch.setattr(view_command.threading, "Event", Ended)
    monkeypatch.setattr(view_command.webbrowser, "open", lambda address: False)
    with caplog.at_level("WARNING", logger="tidefield"):
        view_command.serve("http://localhost:8080", "0.0.0.0", False, QUIET)
    assert "no browser could be opened: open http://localhost:8080 in one" in caplog.text
    assert "listening on 0.0.0.0: whoever reaches this machine" in caplog.text
