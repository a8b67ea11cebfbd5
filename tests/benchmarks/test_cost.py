from functools import partial
from pathlib import Path

import pytest
from PIL import Image

from benchmarks import cost
from benchmarks.cost import (
    Machines,
    Survey,
    fit_model,
    measure_costs,
    predicted_from_others,
    survey_of_area,
    write_page,
)
from tidefield.errors import RunError
from tidefield.files import write_json
from tidefield.machine import describe

MEASURED = ((40, 0.1, 1e6), (80, 0.1, 3e6), (200, 0.1, 5e6), (40, 0.5, 9e6), (60, 12.0, 2e6), (100, 0.2, 2e6))


def measurement(photographs: int, megapixels: float, cells: float) -> dict:
    """Of a machine with two cores: poses 2 s + 0.5 s each, all serial; images 3 s a megapixel, none; a map 7 s + 60 s
    a million cells, half of it serial."""
    total = photographs * megapixels
    poses, images, mapped = 2 + 0.5 * photographs, 3 * total, 7 + 60 * cells / 1e6
    return {
        "photographs": photographs, "megapixels": megapixels, "cells": cells, "device": "cpu",
        "stages": {
            "poses": {"seconds": poses, "cpu_seconds": poses, "peak_bytes": 1e8 + 1e6 * photographs + 2e8 * megapixels},
            "images": {"seconds": images / 2, "cpu_seconds": images, "peak_bytes": 1e8},
            "train": {"seconds": 100.0, "cpu_seconds": 200.0, "peak_bytes": 1e9 + 1e8 * min(total, 25)},
            "map": {"seconds": 0.75 * mapped, "cpu_seconds": mapped, "peak_bytes": 2e8},
        },
        "scene_bytes": 5e5 * total, "map_bytes": 40 * cells,
        **describe(), "machine": {**describe()["machine"], "cores": 2},
    }  # fmt: skip


def test_the_model_of_costs_finds_what_each_stage_depends_on_and_what_more_cores_bring():
    model = fit_model([measurement(*of) for of in MEASURED], "cpu")
    found = model.estimate(Survey(1000, 20.0, 1e8, minutes=30), Machines(16))
    assert found.hours == pytest.approx(
        {
            "poses": (2 + 0.5 * 1000) / 3600,
            "images": 3 * 1000 * 20 / 16 / 3600,
            "train": 0.5,
            "map": (7 + 60 * 100) * (0.5 + 0.5 / 16) / 3600,
        },
        rel=1e-3,
    )
    assert found.memory_bytes["poses"] == pytest.approx(1e8 + 1e6 * 1000 + 2e8 * 20 * 8, rel=1e-3), (
        "a photograph a core"
    )
    assert found.memory_bytes["train"] == pytest.approx(1e9 + 1e8 * 25, rel=1e-3), "full"
    assert found.disk_bytes == pytest.approx(5e5 * 1000 * 20 + 40 * 1e8, rel=1e-3)
    alone, shared = (model.estimate(Survey(1000, 20.0, 1e8), Machines(16, number=n)).hours for n in (1, 10))
    assert shared["map"] == pytest.approx(alone["map"] / 10)
    assert shared["poses"] == alone["poses"]


def test_each_measurement_of_costs_is_predicted_without_itself():
    odd = measurement(*MEASURED[0])
    odd["stages"]["poses"] = {"seconds": 500.0, "cpu_seconds": 500.0, "peak_bytes": 1e8}
    checks = predicted_from_others([odd, *(measurement(*of) for of in MEASURED[1:])], "cpu")
    check = next(iter(checks.values()))
    assert check.seconds > 500 > 3 * check.predicted_seconds
    assert (check.memory_bytes, check.predicted_bytes) == pytest.approx((1.4e9, 1.4e9), rel=1e-3)


def test_a_measurement_of_costs_that_was_interrupted_is_made_anew(tmp_path, monkeypatch):
    photographs, work = tmp_path / "flight" / "photographs", tmp_path / "work"
    photographs.mkdir(parents=True)
    work.mkdir()
    Image.new("RGB", (100, 80)).save(photographs / "0.png")
    fails, found_there = ["train"], []

    def run(command, threads):
        step = next(word for word in ("prepare", "train", "map") if word in command)
        out = command[command.index(step) + 2]
        if out.exists():
            found_there.append(out)
        out.mkdir()
        write_json(out / "map.json", {"cells": 10})
        if step in fails:
            raise RunError("killed")
        return {"start": {"seconds": 1.0, "cpu_seconds": 2.0, "peak_bytes": 3.0}}

    monkeypatch.setattr(cost, "run_by_stage", run)
    monkeypatch.setattr(cost, "tidefield", lambda *words: words)
    measure = partial(measure_costs, [tmp_path / "flight"], work, tmp_path, "cpu")
    with pytest.raises(RunError, match="killed"):
        measure()
    fails.clear()
    record = measure()
    assert not found_there
    assert record["measured"]["flight cpu"]["megapixels"] == 0.008


def test_an_area_has_the_photographs_that_its_overlaps_need():
    assert survey_of_area(1.0, 20.0, 0.03, 0.05) == Survey(926, 20.0, pytest.approx(4e8))  # type: ignore[arg-type]


def test_costs_on_a_gpu_that_nobody_measured_are_refused():
    with pytest.raises(RunError, match="0 measurements of costs on cuda"):
        fit_model([measurement(*of) for of in MEASURED], "cuda")


def test_the_page_of_costs_marks_what_was_not_measured(tmp_path: Path):
    write_json(tmp_path / "cost.json", {"measured": {str(of): measurement(*of) for of in MEASURED[:5]}})
    write_page(tmp_path, tmp_path / "cost.md")
    text = (tmp_path / "cost.md").read_text()
    assert "| a coast, 1,000 km2 * |" in text
    assert text.count("| a flat, 1 km2 * |") == 2
    assert "GPUs: not measured." in text
    assert "Large surveys" not in text


def test_the_page_of_costs_says_how_far_it_is_off_for_large_surveys(tmp_path: Path):
    of = [measurement(*of) for of in MEASURED[:5]]
    write_json(tmp_path / "cost.json", {"measured": {str(k): one for k, one in enumerate(of)}})
    prepared = {name: stage for name, stage in of[0]["stages"].items() if name not in ("map", "train")}
    large = {"f900": {"photographs": 900, "stages": prepared}, "f80": {"photographs": 80, "stages": prepared}}
    write_json(tmp_path / "large.json", {"measured": large})
    write_page(tmp_path, tmp_path / "cost.md")
    text = (tmp_path / "cost.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    small, big = (next(row for row in rows if row[:1] == [count]) for count in ("80", "900"))
    seconds = sum(stage["seconds"] for stage in prepared.values())
    assert small[1] == big[1] == f"{seconds:,.0f}"
    assert float(big[2].replace(",", "")) > float(small[2].replace(",", ""))
    assert float(big[3]) == pytest.approx(float(big[2].replace(",", "")) / seconds, abs=0.01)
