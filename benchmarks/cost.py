"""What a survey costs in hours, memory and disk, stage by stage: a model fitted to what was measured.

CPU seconds of a stage are a constant and shares of the photographs, of their pixels or of the map's cells, none
negative, by least squares on relative errors; memory likewise (`_memory_terms`). More cores shorten what is not serial
(Amdahl, "Validity of the single processor approach to achieving large scale computing capabilities", 1967); how much of
a stage is serial follows from its seconds and CPU seconds. Each measurement is also predicted from the others.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image
from scipy.optimize import nnls
from tyro.conf import Positional

from benchmarks.large import LARGE_FILE, run_by_stage, total
from benchmarks.records import MEASURED, say, show
from tidefield.compare.run import tidefield
from tidefield.compare.tables import Table
from tidefield.errors import RunError
from tidefield.files import read_json, write_json, write_text
from tidefield.machine import cores, describe
from tidefield.survey.sfm.features import FeatureOptions

COST_FILE = "cost.json"
MAP = "map"
TRAIN = "train"
TRAINED_STEPS = 100
LARGE_MEGAPIXELS = 0.12
"""Of photographs of the flights of `python -m benchmarks large`."""
FULL_MEGAPIXELS = 25
"""Of all photographs together, from which on memory for their features is full (`model.cache.LEAST_BYTES`)."""
REDUCED_MEGAPIXELS = FeatureOptions().side_px ** 2 * 3 / 4 / 1e6
"""Of photographs of 4 : 3 as `prepare` looks for features in them."""
GROUND_SHARE = (1 - 0.8) * (1 - 0.7)
"""Of a photograph's ground that is its own, at the overlaps of 80% and 70% that surveys are flown with."""


@dataclass(frozen=True)
class Survey:
    """What is asked for.

    Attributes:
        photographs: their number.
        megapixels: of each.
        cells: of its map.
        minutes: of training; 0 for maps and views without.
    """

    photographs: int
    megapixels: float
    cells: float
    minutes: float = 0.0


def survey_of_area(square_km: float, megapixels: float, gsd_m: float, cell_m: float, minutes: float = 0.0) -> Survey:
    """A survey flown with overlaps of 80% and 70%: area, ground sampling of photographs and side of a map's cell."""
    area = square_km * 1e6
    own = megapixels * 1e6 * gsd_m**2 * GROUND_SHARE
    return Survey(max(round(area / own), 1), megapixels, area / cell_m**2, minutes)


@dataclass(frozen=True)
class Machines:
    """Machines that are alike: their number, cores and GPUs of each."""

    cores: int
    gpus: int = 0
    number: int = 1


@dataclass(frozen=True)
class Estimate:
    """Hours and bytes of memory of each stage, and bytes of disk."""

    hours: dict[str, float]
    memory_bytes: dict[str, float]
    disk_bytes: float


def cost(
    flights: Positional[tuple[Path, ...]] = (),
    work: Path = Path("runs/cost"),
    runs: Path = MEASURED,
    out: Path = Path("docs/cost.md"),
    photographs: int | None = None,
    megapixels: float = 20.0,
    cells: float = 0.0,
    minutes: float = 10.0,
    cores: int = 2,
    gpus: int = 0,
    machines: int = 1,
    device: Literal["cpu", "cuda"] = "cpu",
) -> None:
    """Measure flights, and write the page or answer for one survey.

    Args:
        flights: Folders of `python -m benchmarks flight` to prepare, train on and map first (minutes each).
        work: Folder for their scenes, runs and maps.
        runs: Store the figures in this folder's cost.json; what it holds is not measured again.
        out: The Markdown file to write; replaced if it is there.
        photographs: Answer for a survey of so many, and write no page.
        megapixels: Of each photograph.
        cells: Of its map.
        minutes: Of training.
        cores: Of each machine.
        gpus: Of each machine; expects measurements with --device cuda.
        machines: That make the map.
        device: Where flights are trained on and mapped.
    """
    record = measure_costs(flights, work, runs, device)
    if photographs is None:
        write_page(runs, out)
        say(out)
        return
    model = fit_model(list(record["measured"].values()), "cuda" if gpus else "cpu")
    asked = "the survey", Survey(photographs, megapixels, cells, minutes), Machines(cores, gpus, machines)
    show([estimate_table(model, [asked])])


def measure_costs(flights: Sequence[Path], work: Path, runs: Path, device: str) -> dict[str, Any]:
    """Prepare, train for some steps and map each flight; store seconds, memory and disk in RUNS/cost.json.

    A model needs at least five, of different numbers and sizes of photographs. Scenes, runs and maps of a flight that
    is measured are made anew.
    """
    record = read_json(runs / COST_FILE) or {"measured": {}}
    for flight in flights:
        name = f"{flight.resolve().name} {device}"
        if name in record["measured"]:
            continue
        photographs = sorted((flight / "photographs").iterdir())
        with Image.open(photographs[0]) as first:
            megapixels = first.width * first.height / 1e6
        scene, run, out = folders = [work / f"{name.replace(' ', '_')}_{kind}" for kind in ("scene", TRAIN, MAP)]
        for folder in folders:
            if folder.exists():
                # An interrupted measurement left it: a command that continues would be measured in part.
                shutil.rmtree(folder)
        say(f"{name}: prepare")
        stages = run_by_stage(tidefield("prepare", flight / "photographs", scene), cores())
        say(f"{name}: train")
        train = tidefield("train", scene, run, "--steps", TRAINED_STEPS, "--device", device)
        stages[TRAIN] = total(run_by_stage(train, cores()))
        say(f"{name}: map")
        stages[MAP] = total(run_by_stage(tidefield("map", run, out, "--device", device), cores()))
        record["measured"][name] = {
            "photographs": len(photographs),
            "megapixels": megapixels,
            "cells": read_json(out / "map.json")["cells"],
            "device": device,
            "stages": stages,
            "scene_bytes": _size(scene),
            "map_bytes": _size(out),
            **describe(),
        }
        write_json(runs / COST_FILE, record)
    return record


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _terms(stage: str, survey: Survey) -> list[float]:
    """What a stage may depend on.

    `prepare` reads photographs whole and looks for features in reduced ones: of those there are no more in larger ones.
    """
    if stage == MAP:
        return [1.0, survey.photographs, survey.cells / 1e6]
    reduced = min(survey.megapixels, REDUCED_MEGAPIXELS)
    return [1.0, survey.photographs, survey.photographs * survey.megapixels, survey.photographs * reduced]


def _memory_terms(stage: str, survey: Survey, more_cores: float = 1.0) -> list[float]:
    """What the memory of a stage may depend on.

    In `prepare` each core works on a photograph of its own, and something of each photograph is kept. Training and maps
    keep features of photographs, until their memory is full; what else they keep is that of an area or a tile.
    """
    if stage in (TRAIN, MAP):
        return [1.0, survey.megapixels, min(survey.photographs * survey.megapixels, FULL_MEGAPIXELS)]
    return [1.0, survey.megapixels * more_cores, survey.photographs]


def _fit(rows: Sequence[Sequence[float]], values: Sequence[float]) -> np.ndarray:
    """Factors of the terms that are not negative; each measurement counts by its relative error."""
    found = np.array(values)
    weight = 1 / np.maximum(found, 1e-3 * found.max() + 1e-12)
    return nnls(np.array(rows) * weight[:, None], found * weight)[0]


@dataclass(frozen=True)
class Model:
    """Costs of surveys on one kind of device.

    Attributes:
        seconds: factors of `_terms` of each stage, for CPU seconds, or for seconds of what a GPU does.
        serial: share of each stage that more cores do not shorten.
        memory: factors of `_memory_terms` of each stage, bytes.
        disk: bytes of each megapixel of photographs, and of each cell.
        cores: it was measured on.
        device: of training and maps.
        largest: photographs, megapixels of each and cells of the largest measurements.
    """

    seconds: dict[str, np.ndarray]
    serial: dict[str, float]
    memory: dict[str, np.ndarray]
    disk: tuple[float, float]
    cores: int
    device: str
    largest: tuple[int, float, float]

    def estimate(self, survey: Survey, machines: Machines) -> Estimate:
        """Hours, memory and disk of a survey; a map is shared among the machines, the rest is done by one."""
        hours, memory = {}, {}
        for stage, factors in self.seconds.items():
            terms = np.array(_terms(stage, survey))
            more_cores = max(machines.cores / self.cores, 1.0)
            memory[stage] = float(self.memory[stage] @ np.array(_memory_terms(stage, survey, more_cores)))
            if stage == TRAIN:
                hours[stage] = survey.minutes / 60
                memory[stage] = memory[stage] if survey.minutes else 0.0
                continue
            number = machines.number if stage == MAP else 1
            seconds = float(factors @ terms) / number
            if stage == MAP and self.device != "cpu":
                hours[stage] = seconds / machines.gpus / 3600
            else:
                serial = self.serial[stage]
                hours[stage] = seconds * (serial + (1 - serial) / machines.cores) / 3600
        photographs = self.disk[0] * survey.photographs * survey.megapixels
        return Estimate(hours, memory, photographs + self.disk[1] * survey.cells)


def fit_model(measured: Sequence[dict[str, Any]], device: str) -> Model:
    """Fit the model to the measurements of a device.

    Raises:
        RunError: there are fewer than five, as many as the terms and one.
    """
    measured = [of for of in measured if of["device"] == device]
    if len(measured) < 5:
        raise RunError(
            f"{len(measured)} measurements of costs on {device}: expected five or more; make flights with "
            f"`python -m benchmarks flight` and name them: python -m benchmarks cost FLIGHT... --device {device}"
        )
    return _fitted(measured, device)


def _fitted(measured: Sequence[dict[str, Any]], device: str) -> Model:
    surveys = [_survey(of) for of in measured]
    number = measured[0]["machine"]["cores"]
    seconds, serial, memory = {}, {}, {}
    for stage in measured[0]["stages"]:
        rows = [_terms(stage, survey) for survey in surveys]
        of_stage = [of["stages"].get(stage, {"seconds": 0.0, "cpu_seconds": 0.0, "peak_bytes": 0.0}) for of in measured]
        counted = "cpu_seconds" if device == "cpu" or stage != MAP else "seconds"
        seconds[stage] = _fit(rows, [of[counted] for of in of_stage])
        kept = [_memory_terms(stage, survey) for survey in surveys]
        memory[stage] = _fit(kept, [of["peak_bytes"] for of in of_stage])
        whole, cpu = (sum(of[key] for of in of_stage) for key in ("seconds", "cpu_seconds"))
        serial[stage] = float(np.clip((number * whole / cpu - 1) / (number - 1), 0, 1)) if cpu and number > 1 else 1.0
    pixels = sum(survey.photographs * survey.megapixels for survey in surveys)
    disk = (
        sum(of["scene_bytes"] for of in measured) / pixels,
        sum(of["map_bytes"] for of in measured) / sum(survey.cells for survey in surveys),
    )
    largest = max(s.photographs for s in surveys), max(s.megapixels for s in surveys), max(s.cells for s in surveys)
    return Model(seconds, serial, memory, disk, number, device, largest)


def _survey(of: dict[str, Any]) -> Survey:
    return Survey(of["photographs"], of["megapixels"], of["cells"])


@dataclass(frozen=True)
class Check:
    """A measurement of prepare and map without training, and what the model of all others says.

    Attributes:
        seconds, predicted_seconds: of all their stages.
        memory_bytes, predicted_bytes: of the stage that needs most, training included.
    """

    seconds: float
    predicted_seconds: float
    memory_bytes: float
    predicted_bytes: float


def predicted_from_others(measured: Sequence[dict[str, Any]], device: str) -> dict[str, Check]:
    """Each measurement, and what the model of all others says of it."""
    measured = [of for of in measured if of["device"] == device]
    found = {}
    for i, of in enumerate(measured):
        model = _fitted([*measured[:i], *measured[i + 1 :]], device)
        estimate = model.estimate(replace(_survey(of), minutes=1.0), Machines(model.cores, int(device != "cpu")))
        hours = sum(hours for stage, hours in estimate.hours.items() if stage != TRAIN)
        seconds = sum(stage["seconds"] for name, stage in of["stages"].items() if name != TRAIN)
        peak = max(stage["peak_bytes"] for stage in of["stages"].values())
        name = f"{of['photographs']:,} of {of['megapixels']:.2f} megapixels, {of['cells'] / 1e6:.1f} million cells"
        found[name] = Check(seconds, 3600 * hours, peak, max(estimate.memory_bytes.values()))
    return found


def estimate_table(model: Model, surveys: Sequence[tuple[str, Survey, Machines]]) -> Table:
    """Hours by stage, memory and disk; what is beyond the largest measurement by more than twice is marked."""
    names = ("prepare", TRAIN, MAP)
    rows = []
    for name, survey, machines in surveys:
        found = model.estimate(survey, machines)
        grouped = {key: found.hours.get(key, 0.0) for key in (TRAIN, MAP)}
        grouped["prepare"] = sum(found.hours.values()) - sum(grouped.values())
        whole = sum(grouped.values())
        sizes = survey.photographs, survey.megapixels, survey.cells
        beyond = any(size > 2 * most for size, most in zip(sizes, model.largest, strict=True))
        rows.append(
            [
                f"{name}{' *' if beyond else ''}",
                f"{survey.photographs:,}",
                f"{survey.megapixels:g}",
                f"{survey.cells / 1e6:,.0f}",
                _of_machines(machines),
                *(f"{grouped[key]:,.1f} ({grouped[key] / whole:.0%})" for key in names),
                f"{whole:,.1f}",
                f"{max(found.memory_bytes.values()) / 1e9:,.1f}",
                f"{found.disk_bytes / 1e9:,.1f}",
            ]
        )
    columns = ["survey", "photographs", "megapixels", "cells of the map, million", "on", *(f"{n}, h" for n in names)]
    return Table("", [*columns, "all, h", "memory of a machine, GB", "disk, GB"], rows)


def _of_machines(machines: Machines) -> str:
    each = f"{machines.cores} cores" + (f", {machines.gpus} GPUs" if machines.gpus else "")
    return each if machines.number == 1 else f"{machines.number} x {each}"


def stage_table(model: Model) -> Table:
    """What each stage costs."""
    rows = []
    for stage, factors in model.seconds.items():
        if stage == TRAIN:
            continue
        of_map = stage == MAP
        rows.append(
            [
                f"{stage}",
                f"{factors[0]:.1f}",
                f"{factors[1]:.3f}",
                *(["-", "-", f"{factors[2]:.1f}"] if of_map else [f"{factors[2]:.3f}", f"{factors[3]:.3f}", "-"]),
                f"{model.serial[stage]:.0%}",
            ]
        )
    columns = [
        "stage",
        "CPU s",
        "each photograph, CPU s",
        "each megapixel, CPU s",
        f"each megapixel up to {REDUCED_MEGAPIXELS:.2f} of a photograph, CPU s",
        "each million cells, CPU s",
        "serial",
    ]
    return Table("", columns, rows)


def write_page(runs: Path, out: Path) -> None:
    """Write the page from what was stored."""
    measured = list((read_json(runs / COST_FILE) or {"measured": {}})["measured"].values())
    model = fit_model(measured, "cpu")
    check = []
    for name, of in predicted_from_others(measured, "cpu").items():
        memory = (f"{size / 1e9:.1f}" for size in (of.memory_bytes, of.predicted_bytes))
        ratio = of.predicted_seconds / of.seconds
        check.append([name, f"{of.seconds:.0f}", f"{of.predicted_seconds:.0f}", f"{ratio:.2f}", *memory])
    two, many = Machines(2), Machines(16)
    surveys = [
        ("a creek", survey_of_area(0.05, 20, 0.03, 0.05, 10), two),
        ("a flat, 1 km2", survey_of_area(1, 20, 0.03, 0.05, 10), two),
        ("a flat, 1 km2", survey_of_area(1, 20, 0.03, 0.05, 10), many),
        ("5,000 photographs of 400 px", Survey(5000, 0.12, 1e6 / 0.15**2, 0), two),
        ("a coast, 10 km2", survey_of_area(10, 20, 0.03, 0.05, 60), Machines(16, number=10)),
        ("a coast, 1,000 km2", survey_of_area(1000, 20, 0.03, 0.1, 600), Machines(16, number=100)),
    ]
    machine, large = measured[0]["machine"], _large_surveys(model, runs)
    photographs, megapixels, cells = model.largest
    most = f"{photographs:,} photographs, {megapixels:.2f} megapixels, {cells / 1e6:.1f} million cells"
    parts = [
        "# What a survey costs",
        "`python -m benchmarks cost` wrote this page. A model of seconds, memory and disk is fitted to built-in "
        f"flights that were prepared, trained on and mapped on {machine['cores']} cores ({machine['processor']}). It "
        "answers for others:",
        "```sh\npython -m benchmarks cost --photographs 1200 --megapixels 20 --cells 400e6 --cores 16\n```",
        "## Estimates",
        estimate_table(model, surveys).markdown(),
        f"\\* Beyond twice the largest measurement ({most}): the model takes costs to go on growing in proportion"
        + ("; *Large surveys*, below, says how far that is off." if large else ", which nothing here has shown."),
        "Areas are flown with overlaps of 80% and 70% at a ground sampling of 3 cm, and mapped at 5 cm, the 1,000 km2 "
        "at 10 cm. `prepare` and training run on one machine; only maps are shared among several. Training takes the "
        "time it is given: 10 minutes, 1 and 10 hours for the coasts. Of memory, `prepare` needs that of a photograph "
        "for each core and something of every photograph; training and maps need that of a photograph, and keep "
        f"features of photographs, until their memory is full ({FULL_MEGAPIXELS} megapixels in all, on machines of "
        "more than 19 GB more). "
        "GPUs: " + _gpus(measured),
        "## The model",
        stage_table(model).markdown(),
        "## Each measurement, predicted from the others",
        Table(
            "", ["flight", "prepare and map, s", "by the model, s", "ratio", "memory, GB", "by the model, GB"], check
        ).markdown(),
        *large,
    ]
    write_text(out, "\n\n".join(parts) + "\n")


def _large_surveys(model: Model, runs: Path) -> list[str]:
    """What `python -m benchmarks large` measured of `prepare`, and what the model says of it; nothing if it did not."""
    rows = []
    for of in sorted((read_json(runs / LARGE_FILE) or {"measured": {}})["measured"].values(), key=_photographs):
        estimate = model.estimate(Survey(of["photographs"], LARGE_MEGAPIXELS, 0.0), Machines(model.cores))
        stages = of["stages"].values()
        seconds, memory = sum(stage["seconds"] for stage in stages), max(stage["peak_bytes"] for stage in stages)
        predicted = 3600 * sum(estimate.hours[stage] for stage in of["stages"])
        predicted_bytes = max(estimate.memory_bytes[stage] for stage in of["stages"])
        cells = [f"{seconds:,.0f}", f"{predicted:,.0f}", f"{predicted / seconds:.2f}"]
        rows.append([f"{_photographs(of):,}", *cells, f"{memory / 1e9:.1f}", f"{predicted_bytes / 1e9:.1f}"])
    if not rows:
        return []
    text = (
        f"`prepare` of flights of {LARGE_MEGAPIXELS:g} megapixels, as `python -m benchmarks large` measured it. None "
        "of these is among the measurements that the model is fitted to."
    )
    columns = ["photographs", "prepare, s", "by the model, s", "ratio", "memory, GB", "by the model, GB"]
    return ["## Large surveys", text, Table("", columns, rows).markdown()]


def _photographs(of: dict[str, Any]) -> int:
    return of["photographs"]


def _gpus(measured: Sequence[dict[str, Any]]) -> str:
    devices = {of["device"] for of in measured} - {"cpu"}
    return f"measured on {', '.join(sorted(devices))}." if devices else "not measured."
