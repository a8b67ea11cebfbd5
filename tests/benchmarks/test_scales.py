"""The page of scales: every way at every width, once."""

from pathlib import Path

from benchmarks.scales import METRICS, WAYS, measure_scales, write_page
from tidefield.files import write_json


def test_every_way_is_measured_once_at_every_width_and_shown(tmp_path: Path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    commands: list[list[str]] = []

    def run(words: list[str]) -> None:
        commands.append(words)
        out = Path(words[2])
        out.mkdir()
        mean = dict.fromkeys(METRICS, float(len(commands)))
        trained = {"trained_width": 400, "trained": {"steps": 1833, "seconds": 600.2}}
        found = {"mean": mean, "seconds_per_frame": 0.5, "protocol": "strict"}
        configuration = {} if "--zero-shot" in words else trained
        write_json(out / "evaluation.json", {**found, "configuration": configuration})

    sources = [tmp_path / "run", tmp_path / "scene"]
    for _ in range(2):
        measure_scales(sources, tmp_path, (100, 400), 400, "cpu", run, lambda _: None)
    assert len(commands) == 2 * 2 * len(WAYS)
    assert ("--zero-shot" in commands[0], "--zero-shot" in commands[-1]) == (False, True)
    assert commands[1][-4:] == ["--rays-per-pixel", "4", "--device", "cpu"]
    write_page(tmp_path, tmp_path / "page.md")
    lines = (tmp_path / "page.md").read_text().splitlines()
    assert "Trained at 400 px for 10.0 minutes, 1,833 steps." in lines
    assert "Opened at 400 px, with trained weights as they are." in lines
    assert "| 100 | points | 1.00 | 1.00 | 1.0000 | 1.0000 | 0.5 |" in lines
    assert "| | as usual | 20.00 | 20.00 | 20.0000 | 20.0000 | 0.5 |" in [line.replace("|  |", "| |") for line in lines]
