"""The page of scales: every way at every width, once; and a detail of what it shows."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes_on_disk import PINHOLE, survey, write_colmap

from benchmarks.scales import METRICS, SCALES_FILE, SHOWN, WAYS, scales, write_page
from tidefield.compare.run import Usage
from tidefield.errors import RunError
from tidefield.files import read_json, write_json


def test_every_way_is_measured_once_at_every_width_and_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("benchmarks.scales.choose_device", lambda name: name)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    commands: list[list[str]] = []

    def run(command: Sequence[str], environment: Mapping[str, str]) -> Usage:
        words = list(command[3:])
        commands.append(words)
        out = Path(words[2])
        out.mkdir()
        mean = dict.fromkeys(METRICS, float(len(commands)))
        trained = {"trained_width": 400, "trained": {"steps": 1833, "seconds": 600.2}}
        found = {"mean": mean, "seconds_per_frame": 0.5, "protocol": "strict"}
        configuration = {} if "--zero-shot" in words else trained
        write_json(out / "evaluation.json", {**found, "configuration": configuration})
        return Usage(1.0, 1)

    sources, page = (tmp_path / "run", tmp_path / "scene"), tmp_path / "page.md"
    for _ in range(2):
        scales(sources, tmp_path, (100, 400), 400, "cpu", page, run=run)
    assert len(commands) == 2 * 2 * len(WAYS)
    assert ("--zero-shot" in commands[0], "--zero-shot" in commands[-1]) == (False, True)
    assert commands[1][-4:] == ["--rays-per-pixel", "4", "--device", "cpu"]
    for words, expected in (((200, "cpu"), "scene with opened_px 400: expected 200"), ((400, "cuda"), "device cpu")):
        with pytest.raises(RunError, match=expected):
            scales(sources[::-1], tmp_path, (100,), *words, page, run=run)
    record = read_json(tmp_path / SCALES_FILE)
    record["run"]["machine"]["processor"] = "another"
    write_json(tmp_path / SCALES_FILE, record)
    write_page(tmp_path, page)
    lines = page.read_text().splitlines()
    assert "Trained at 400 px for 10.0 minutes, 1,833 steps." in lines
    assert "Opened at 400 px, with trained weights as they are." in lines
    machines = [line for line in lines if line.startswith("- Machine: ")]
    assert [("another" in line, line.split(": ")[-1]) for line in machines] == [(True, "run."), (False, "scene.")]
    assert "| 100 | points | 1.00 | 1.00 | 1.0000 | 1.0000 | 0.5 |" in lines
    assert "| | as usual | 20.00 | 20.00 | 20.0000 | 20.0000 | 0.5 |" in [line.replace("|  |", "| |") for line in lines]


def test_a_detail_shows_the_photograph_beside_both_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_colmap(tmp_path / "flat", survey(PINHOLE))
    shades, ways = {"points": 100, "cones": 200}, list(WAYS)

    def run(command: Sequence[str], environment: Mapping[str, str]) -> Usage:
        made = Path(command[5])
        (made / "renderings").mkdir(parents=True)
        way = next(name for name in ways if all(option in command for option in WAYS[name]))
        grey = np.full((48, 64, 3), shades.get(way, 0), np.uint8)
        Image.fromarray(grey).save(made / "renderings" / "photo.png")
        found = {"mean": dict.fromkeys(METRICS, 1.0), "seconds_per_frame": 0.5, "protocol": "strict"}
        write_json(made / "evaluation.json", {**found, "configuration": {}})
        return Usage(1.0, 1)

    asked = (tmp_path / "flat",), tmp_path, (32, 64), 32, "cpu", tmp_path / "page.md"
    scales(*asked, run=run)
    assert not (tmp_path / "scales-flat.png").exists()
    scales(*asked, pictures=tmp_path, run=run)
    sheet = np.asarray(Image.open(tmp_path / "scales-flat.png"))
    thirds = np.array_split(sheet[-12:], len(SHOWN) + 1, axis=1)
    assert [int(np.median(third)) for third in thirds[1:]] == [100, 200]
    assert thirds[0].std() > 1
    assert "(scales-flat.png)" in (tmp_path / "page.md").read_text()
