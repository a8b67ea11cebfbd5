"""Records of benchmarks: figures keep the circumstances that they were measured in, and tell sources apart."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import records
from benchmarks.depth import depth
from benchmarks.gaussians import gaussians
from benchmarks.parts import parts
from benchmarks.points import points
from benchmarks.records import network_of, require_same, store
from benchmarks.scales import scales
from tidefield.errors import RunError, SceneError
from tidefield.files import read_json, write_json
from tidefield.train.checkpoint import shipped_weights, weights_sha256


def test_a_new_figure_leaves_the_dates_of_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    older, newer = ({"date": date, "version": "1", "commit": date, "machine": {}} for date in ("2025", "2026"))
    record = {"figures": {"a": {"psnr": 1.0}}, **older, "command": "the first"}
    monkeypatch.setattr(records, "describe", lambda: newer)
    for name in ("b", "c"):
        new = record["figures"][name] = {"psnr": 2.0}
        store(tmp_path / "record.json", record, new, record["figures"].values(), "the second")
    found = read_json(tmp_path / "record.json")
    assert found["figures"]["a"] == {"psnr": 1.0, **older}
    assert found["figures"]["b"] == found["figures"]["c"] == {"psnr": 2.0, **newer}
    assert {**found, "figures": {}} == {"figures": {}, **newer, "command": "the second"}


def test_what_was_measured_before_is_not_dated_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("benchmarks.depth.load_scene", lambda folder: folder)
    monkeypatch.setattr("benchmarks.depth.compare_depths", lambda *_: dict.fromkeys(("all", "vegetation", "edges")))
    monkeypatch.setattr("benchmarks.depth.zero_shot", lambda *_: (None, ""))

    def measure(day: str, *categories: str) -> dict:
        monkeypatch.setattr(records, "describe", lambda: {"date": day})
        for category in categories:
            (tmp_path / f"{category}_160_8_3").mkdir(exist_ok=True)
        return depth(tmp_path, tmp_path, categories, 160, 8, 3, device="cpu")

    measure("monday", "vegetation")
    record = measure("tuesday", "vegetation", "deep_water")
    assert [figure["date"] for figure in record["figures"].values()] == ["monday", "tuesday"]
    assert measure("friday", "vegetation")["date"] == "tuesday", "nothing was measured"


def test_two_sources_of_one_name_are_refused(tmp_path: Path):
    both = tmp_path / "one" / "scene", tmp_path / "other" / "scene"
    asked = [
        lambda: points(both, tmp_path, tmp_path, (100,), "cpu"),
        lambda: parts((), both, tmp_path, 100, "cpu"),
        lambda: gaussians(both, tmp_path, (100,), "cpu"),
        lambda: scales(both, tmp_path, (100,), 400, "cpu"),
    ]
    for measure in asked:
        with pytest.raises(SceneError, match="two scenes are named scene: expected different names"):
            measure()


def test_the_network_is_that_of_the_run_or_the_trained_weights(tmp_path: Path):
    own = shipped_weights("swift")
    assert own is not None
    assert network_of(tmp_path) == weights_sha256(own)
    (tmp_path / "run.json").write_text("{}")
    other = network_of(tmp_path)
    (tmp_path / "checkpoint.safetensors").write_text("learned")
    assert len({network_of(tmp_path), other, weights_sha256(own)}) == 3


def test_figures_of_other_conditions_are_refused(tmp_path: Path):
    require_same(tmp_path, "scene", {"network": "a", "psnr": 1.0}, {"network": "a"})
    with pytest.raises(RunError, match=r"has scene with network a: expected b, .*delete it there"):
        require_same(tmp_path, "scene", {"network": "a"}, {"network": "b"})
    with pytest.raises(RunError, match="network not stored: expected b"):
        require_same(tmp_path, "scene", {}, {"network": "b"})


def test_gaussians_of_other_weights_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Of earlier versions, a scene's are those whose weights were stored; a run's are not identified."""
    monkeypatch.setattr("benchmarks.gaussians.network_of", lambda _: "new")

    def measure(method: dict) -> None:
        write_json(tmp_path / "gaussians.json", {"figures": {"scene, 48 px": {"ways": {}, "method": method}}})
        gaussians((tmp_path / "scene",), tmp_path, (48,), "cpu")

    for same in ({"weights": "new", "run": None}, {"weights": "started", "run": "id", "network": "new"}):
        measure(same)
    for other in ({"weights": "old", "run": None}, {"weights": "new", "run": "id"}):
        with pytest.raises(RunError, match=r"scene, 48 px with network .* expected new"):
            measure(other)
