"""`python -m benchmarks NAME`, as `python -m benchmarks --help` lists them; without a name, speed.

torch and the rest are imported inside the commands.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import tyro

from tidefield.errors import RunError, TidefieldError
from tidefield.machine import tune_process

MEASURED = Path("docs/measured")
COMPARISON = tuple(MEASURED / f"{name}.json" for name in ("comparison", "nerf", "paper", "paper_zero_shot"))
ABLATION = tuple(MEASURED / f"{name}.json" for name in ("ablation", "ablation_water"))
STRICT_400 = tuple(MEASURED / f"strict_400{rest}.json" for rest in ("", "_scenes"))
WIDTHS = (*STRICT_400, *(MEASURED / f"strict_{width}.json" for width in (800, 1600)))
LENGTHS = tuple(MEASURED / f"{name}.json" for name in ("minute", "scratch"))
DESCRIPTION = """Measure speed, views, memory, surveys and robustness, and write the pages of results. Without a name,
it is speed. `tidefield compare` and `tidefield ablate` measure quality.

Measure on a machine that does nothing else. The page is made of the files of `tidefield compare`, `tidefield ablate`,
speed, frames and memory."""


def speed(
    runs: Path | None = None,
    scene: Path | None = None,
    width: int | None = None,
    device: str = "cpu",
    quick: bool = False,
) -> None:
    """Rays per second of paper and swift, by stage, and their share of the machine's peak arithmetic (2-3 minutes).

    Args:
        runs: Store the figures in this folder's speed.json.
        scene: Measure on this scene instead of the built-in one.
        width: Width of its photographs in pixels.
        device: auto, cpu, cuda, cuda:N or mps.
        quick: A few seconds, to check that it works; the figures are not meaningful.
    """
    if quick and runs is not None:
        raise RunError("--quick was given with --runs: such figures are not worth storing; leave one of them out")
    tune_process()
    from rich.console import Console

    from benchmarks.speed import QUICK, Effort, measure_speed
    from benchmarks.table import speed_tables
    from tidefield.config import PRESETS
    from tidefield.device import choose_device
    from tidefield.files import write_json
    from tidefield.machine import describe

    where, console = choose_device(device), Console()
    effort = QUICK if quick else Effort()
    with tempfile.TemporaryDirectory() as folder:
        loaded = _scene(scene, width, quick, Path(folder))
        configs = {name: PRESETS[name] for name in ("paper", "swift")}
        report = measure_speed(loaded, configs, where, effort, console.print)
    options = [] if scene is None else ["--scene SCENE", *([] if width is None else [f"--width {width}"])]
    command = " ".join(["python -m benchmarks speed --runs RUNS", *options, f"--device {device}"])
    report |= {"command": command, **describe()}
    for table in speed_tables(report):
        print(table.markdown(), end="\n\n")
    if runs is not None:
        write_json(runs / "speed.json", report)


def _scene(folder: Path | None, width: int | None, quick: bool, work: Path) -> Any:
    """The scene that is asked for, or the built-in one, made small."""
    from tidefield.data.load import load_scene

    if folder is not None:
        return load_scene(folder, width=width)
    if width is not None:
        raise RunError(
            "--width was given without --scene: the built-in scene has its size; name a scene, or leave it out"
        )
    from tidefield.synthetic import make_survey, write_survey

    os.environ["XDG_CACHE_HOME"] = str(work / "cache")
    survey = make_survey("river_mouths", seed=7, views=9 if quick else 16, width=64 if quick else 256)
    write_survey(survey, work / "scene")
    return load_scene(work / "scene")


def frames(
    scene: tyro.conf.Positional[Path],
    runs: Path,
    preset: Literal["swift", "paper"] = "swift",
    weights: Path | None = None,
    width: int = 800,
    height: int = 600,
    device: str = "cpu",
) -> None:
    """Time of zero-shot views: the first, further ones, and among many photographs (minutes).

    Args:
        scene: The scene, a survey.
        runs: Store the figures in this folder's frames.json.
        preset: Which network.
        weights: Its weights, of `tidefield pretrain`; those that came with Tidefield if not given.
        width, height: Of the views, in pixels.
        device: auto, cpu, cuda, cuda:N or mps.
    """
    tune_process()
    from benchmarks.frames import measure_frames
    from benchmarks.table import frame_tables
    from tidefield.device import choose_device

    record = measure_frames(scene, runs, preset, weights, str(choose_device(device)), (width, height))
    for table in frame_tables(record):
        print(table.markdown(), end="\n\n")


def memory(
    runs: Path,
    preset: Literal["swift", "paper"] = "swift",
    width: int = 4000,
    photographs: int = 12,
    device: str = "cpu",
) -> None:
    """Peak memory of rendering one frame of 4000 x 3000 pixels from photographs of that size (minutes, 1 GB of disk).

    Args:
        runs: Store the figures in this folder's memory.json.
        preset: Which network.
        width: Width of photographs and frame in pixels; the height is three quarters of it.
        photographs: How many the scene has.
        device: auto, cpu, cuda, cuda:N or mps; the figure is of main memory in any case.
    """
    from benchmarks.memory import measure_memory

    record = measure_memory(runs, preset, width, photographs, device)
    print(f"{record['peak_memory_bytes'] / 1e9:.2f} GB, {record['seconds']:.0f} s")


def surveys(
    photographs: Path,
    runs: Path,
    names: tuple[str, ...] = ("brighton_beach", "turin_lot", "swindale"),
    prepared: Path | None = None,
    ready: Path | None = None,
    out: Path = Path("docs/surveys.md"),
) -> None:
    """Prepare surveys and compare with exhaustive structure from motion; write the page (hours).

    Args:
        photographs: Folder with the surveys' folders.
        runs: Folder for the results, as RUNS/SURVEY.
        names: Of the surveys.
        prepared: Folder of a `tidefield compare` on the prepared scenes, by the surveys' names, for the page.
        ready: Folder of a `tidefield compare` on ready-made scenes of these names, for the page.
        out: The Markdown file to write; replaced if it is there.
    """
    from benchmarks.surveys import measure_surveys, write_page
    from tidefield.compare.run import run_measured

    measure_surveys(photographs, runs, names, run_measured, partial(print, flush=True))
    write_page(runs, names, prepared, ready, out)
    print(out)


def mappers(
    photographs: Path,
    work: Path,
    runs: Path = MEASURED,
    names: tuple[str, ...] = ("brighton_beach", "turin_lot", "swindale"),
) -> None:
    """Prepare surveys with the incremental and with the global mapper (a quarter of an hour).

    Args:
        photographs: Folder with the surveys' folders.
        work: Folder for the prepared scenes.
        runs: Store the figures in this folder's mappers.json; what it holds is not measured again.
        names: Of the surveys.
    """
    from benchmarks.mappers import measure_mappers, table
    from tidefield.compare.run import run_measured

    print(table(measure_mappers(photographs, work, runs, names, run_measured, partial(print, flush=True))).markdown())


def flight(
    out: tyro.conf.Positional[Path],
    category: str = "ground_textures",
    strips: int = 50,
    each: int = 100,
    width: int = 400,
    altitude: float = 60.0,
    forward_overlap: float = 0.8,
    side_overlap: float = 0.7,
    gps: float = 1.5,
    seed: int = 0,
    scene: Path | None = None,
) -> None:
    """Make the photographs of a large flight over a built-in flat, as a drone writes them (minutes; continues).

    `tidefield prepare OUT/photographs SCENE` reads them, and OUT/truth.json has the true positions. The same command
    completes what was interrupted.

    Args:
        out: Folder for `photographs/` and `truth.json`: a new one, or one of the same flight.
        category: Kind of flat: tidal_trees, river_mouths, ground_textures, vegetation or deep_water.
        strips: Number of strips.
        each: Photographs of each strip.
        width: Of a photograph, in pixels.
        altitude: Height above the mud, in metres.
        forward_overlap: Share of a photograph that the next one shows again.
        side_overlap: Share of a strip that the next one shows again.
        gps: Standard deviation of the stated positions in each horizontal direction, in metres; twice that vertically.
        seed: Of everything random.
        scene: Also write this folder: the scene that a perfect `tidefield prepare` would make, with the true poses.
    """
    tune_process()
    from tidefield.progress import ProgressBar, make_console
    from tidefield.synthetic import Flight
    from tidefield.synthetic.large import LargeFlight, make_large_flight, write_large_scene

    own = Flight(altitude_m=altitude, forward_overlap=forward_overlap, side_overlap=side_overlap)
    plan = LargeFlight(category, seed, strips, each, width, gps_m=gps, flight=own)
    with ProgressBar(make_console(quiet=False), "Photographing") as bar:
        make_large_flight(plan, out, bar)
    if scene is not None:
        write_large_scene(plan, out, scene)


def large(
    flights: tyro.conf.Positional[tuple[Path, ...]],
    work: Path,
    runs: Path = MEASURED,
    options: tuple[str, ...] = (),
    threads: int = 1,
) -> None:
    """Time, memory and errors of `tidefield prepare` on flights of `python -m benchmarks flight`, by stage (minutes).

    Args:
        flights: Their folders.
        work: Folder for the scenes.
        runs: Store the figures in this folder's large.json; what is measured is not measured again.
        options: Of `tidefield prepare`, without their dashes, such as mapper=global.
        threads: Of each process.
    """
    from benchmarks.large import lines, measure_flight

    words = [word for option in options for word in f"--{option}".split("=", 1)]
    for folder in flights:
        name = " ".join([folder.resolve().name, *options])
        found = measure_flight(folder, work / name.replace(" ", "_"), runs, name, words, threads)
        print("\n".join([name, *lines(found)]), flush=True)


def cost(
    flights: tyro.conf.Positional[tuple[Path, ...]] = (),
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
    """Hours, memory and disk of a survey, by a model fitted to flights that are measured; writes the page on costs.

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
    tune_process()
    from benchmarks.cost import Machines, Survey, estimate_table, fit_model, measure_costs, write_page

    record = measure_costs(flights, work, runs, device, partial(print, flush=True))
    if photographs is None:
        write_page(runs, out)
        print(out)
        return
    model = fit_model(list(record["measured"].values()), "cuda" if gpus else "cpu")
    asked = "the survey", Survey(photographs, megapixels, cells, minutes), Machines(cores, gpus, machines)
    print(estimate_table(model, [asked]).markdown())


def areas(
    work: Path,
    runs: Path = MEASURED,
    counts: tuple[int, ...] = (500, 1000, 2000),
    width: int = 160,
    steps: int = 600,
    compared_steps: int = 1600,
) -> None:
    """Training by areas: memory against the number of photographs, quality, and seams (an hour).

    Args:
        work: Folder for flights, scenes and runs; what is there is not made again.
        runs: Store the figures in this folder's areas.json; what it holds is not measured again.
        counts: Photographs of the flights, multiples of 50.
        width: Of a photograph, in pixels.
        steps: Of the trainings whose memory is measured.
        compared_steps: Of the trainings at once and by areas that are compared.
    """
    tune_process()
    from benchmarks.areas import measure_areas, tables

    record = measure_areas(work, runs, counts, width, steps, compared_steps, partial(print, flush=True))
    for table in tables(record):
        print(table.markdown(), end="\n\n")


def kills(runs: Path = MEASURED, train: int = 20, prepare: int = 10, compare: int = 10, seed: int = 0) -> None:
    """Kill commands at random moments, complete their work, and compare it with that of uninterrupted ones (minutes).

    Args:
        runs: Store the counts in this folder's kills.json.
        train: How often `tidefield train` is killed.
        prepare: How often `tidefield prepare`.
        compare: How often `tidefield compare`.
        seed: Of the moments.
    """
    from benchmarks.kills import measure_kills

    counts = {"train": train, "prepare": prepare, "compare": compare}
    for name, of in measure_kills(runs, counts, seed, partial(print, flush=True)).items():
        print(f"{name}: {of['identical']} of {of['kills']} identical")


def fuzz(
    minutes: float = 10.0,
    runs: Path | None = None,
    kept: Path = Path("runs/fuzz"),
    readers: tuple[str, ...] = (),
    seed: int = 0,
) -> None:
    """Give damaged files to everything that reads files, and keep those that are not properly refused (minutes).

    Args:
        minutes: For all readers together, each for the same time.
        runs: Store the counts in this folder's fuzz.json.
        kept: Folder for the findings: the files and their tracebacks.
        readers: Names of readers, as the table shows them; all if not given.
        seed: Of the damage.
    """
    if readers and runs is not None:
        raise RunError("--readers was given with --runs: the record is of all readers; leave one of them out")
    from benchmarks.fuzz import measure_fuzz
    from benchmarks.readers import READERS
    from benchmarks.robustness import fuzz_table

    names = [reader.name for reader in READERS]
    unknown = next((name for name in readers if name not in names), None)
    if unknown is not None:
        raise RunError(f"there is no reader {unknown!r}: expected one of {'; '.join(names)}; choose one of these")
    chosen = [reader for reader in READERS if not readers or reader.name in readers]
    counts = measure_fuzz(chosen, minutes, seed, kept, runs, partial(print, flush=True))
    print(fuzz_table({name: vars(count) for name, count in counts.items()}).markdown())
    if any(count.findings for count in counts.values()):
        raise RunError(f"there are findings: expected none; their files and tracebacks are in {kept}")


def scales(
    sources: tyro.conf.Positional[tuple[Path, ...]],
    runs: Path = MEASURED,
    widths: tuple[int, ...] = (100, 200, 400, 800, 1600),
    width: int = 400,
    device: str = "auto",
    out: Path = Path("docs/scales.md"),
    pictures: Path | None = None,
) -> None:
    """Quality and time at several widths: read at points, by cones, and with several rays (hours); write the page.

    Args:
        sources: Runs, or scenes for the trained weights, such as those of `python -m benchmarks flight --scene`.
        runs: Store the figures in this folder's scales.json, after each; a repeated command continues.
        widths: Of the pictures in pixels.
        width: That scenes are opened at; a run has its own.
        device: auto, cpu, cuda, cuda:N or mps.
        out: The Markdown file to write; replaced if it is there.
        pictures: Folder for a detail of each source's first held-out photograph at the largest width, beside renderings
            by points and by cones; the page shows those that lie beside it.
    """
    from benchmarks.scales import measure_scales, write_page
    from tidefield.compare.run import run_measured, tidefield

    def run(words: list[str]) -> None:
        run_measured(tidefield(*words), {})

    measure_scales(sources, runs, widths, width, device, run, partial(print, flush=True), pictures)
    write_page(runs, out)
    print(out)


def maps(
    runs: Path = Path("runs/maps"),
    categories: tuple[str, ...] = ("tidal_trees", "river_mouths", "ground_textures", "vegetation", "deep_water"),
    width: int = 2000,
    views: int = 20,
    half: float = 12.0,
) -> None:
    """Maps of built-in flats against the exact truth, and two baselines: sparse points, semi-global matching (an hour).

    Args:
        runs: Folder for flats, maps and maps.json; what it holds is not measured again.
        categories: Of flats.
        width: Of the photographs in pixels.
        views: Photographs of each survey.
        half: Half the side of the square that is mapped, metres.
    """
    tune_process()
    from benchmarks.maps import measure_maps, tables

    for table in tables(measure_maps(runs, categories, width, views, half, partial(print, flush=True))):
        print(table.markdown(), end="\n\n")


def points(
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    work: Path = Path("runs/points"),
    runs: Path = MEASURED,
    widths: tuple[int, ...] = (400,),
    device: str = "auto",
) -> None:
    """Zero-shot views of scenes with COLMAP's points, and of the same without any (minutes for each scene).

    Args:
        scenes: With COLMAP models, or posed photographs only, which get COLMAP's points first.
        work: Folder for the scenes without points.
        runs: Store the figures in this folder's points.json; what it holds is not measured again.
        widths: Of the pictures in pixels.
        device: auto, cpu, cuda, cuda:N or mps.
    """
    from benchmarks.points import measure_points, tables
    from tidefield.compare.run import run_measured, tidefield

    def run(words: list[str]) -> None:
        run_measured(tidefield(*words), {})

    for table in tables(measure_points(scenes, work, runs, widths, device, run, partial(print, flush=True))):
        print(table.markdown(), end="\n\n")


def parts(
    weights: tyro.conf.Positional[tuple[Path, ...]],
    scenes: tuple[Path, ...] = (),
    runs: Path = MEASURED,
    width: int = 400,
    device: str = "auto",
) -> None:
    """Zero-shot views with weights that were trained with and without parts of the network (minutes for each scene).

    Args:
        weights: Files of `tidefield pretrain`, trained alike but for their parts.
        scenes: Folders.
        runs: Store the figures in this folder's parts.json; what it holds is not measured again.
        width: Of the pictures in pixels.
        device: auto, cpu, cuda, cuda:N or mps.
    """
    tune_process()
    from benchmarks.parts import measure_parts, tables
    from tidefield.device import choose_device

    record = measure_parts(weights, scenes, runs, width, choose_device(device), partial(print, flush=True))
    for table in tables(record):
        print(table.markdown(), end="\n\n")


def depth(
    work: Path = Path("runs/depth"),
    runs: Path = MEASURED,
    categories: tuple[str, ...] = ("tidal_trees", "river_mouths", "ground_textures", "vegetation", "deep_water"),
    width: int = 800,
    views: int = 24,
    seed: int = 61,
    weights: Path | None = None,
    device: str = "auto",
) -> None:
    """Depths of held-out views of built-in flats against the exact truth and the triangulated points (minutes).

    Args:
        work: Folder for the flats.
        runs: Store the figures in this folder's depth.json; what it holds is not measured again.
        categories: Of flats.
        width: Of the photographs in pixels.
        views: Photographs of each survey.
        seed: Of the flats.
        weights: Of `tidefield pretrain`; those that came with Tidefield if not given.
        device: auto, cpu, cuda, cuda:N or mps.
    """
    tune_process()
    from benchmarks.depth import measure_depth, tables
    from tidefield.config import PRESETS
    from tidefield.device import choose_device
    from tidefield.methods import zero_shot
    from tidefield.train.checkpoint import given_or_shipped, weights_sha256

    where, file = choose_device(device), given_or_shipped(weights, "swift")
    record = measure_depth(
        work,
        runs,
        categories,
        width,
        views,
        seed,
        lambda scene: zero_shot(PRESETS["swift"], file, scene, where)[0],
        {"preset": "swift", "weights": weights_sha256(file)},
        partial(print, flush=True),
    )
    for table in tables(record):
        print(table.markdown(), end="\n\n")


def map_control(
    scene: tyro.conf.Positional[Path], control: tyro.conf.Positional[Path], runs: Path = Path("runs/maps")
) -> None:
    """Heights of a map's surface at ground control that is left out in turn (minutes).

    Args:
        scene: A scene that was prepared with ground control.
        control: Its gcp_list.txt.
        runs: Folder for map_control.json.
    """
    tune_process()
    from benchmarks.map_control import measure_control, tables
    from tidefield.files import write_json

    record = measure_control(scene, control)
    for table in tables(record):
        print(table.markdown(), end="\n\n")
    write_json(runs / "map_control.json", record)


def map_views(scene: tyro.conf.Positional[Path], runs: Path = Path("runs/map_views"), half: float = 6.0) -> None:
    """A photograph of a built-in flat that took no part in its map, against the orthophoto warped into it (minutes).

    Args:
        scene: A built-in flat, such as one of those that maps makes.
        runs: Folder for the map and map_views.json.
        half: Half the side of the square that is mapped, metres.
    """
    tune_process()
    from benchmarks.map_views import measure_views, table

    print(table(measure_views(scene, runs, half, partial(print, flush=True))).markdown())


def map_surveys(scenes: tyro.conf.Positional[tuple[Path, ...]], runs: Path = Path("runs/map_surveys")) -> None:
    """Maps of real surveys and the time they take, beside what users of ODM published (minutes each).

    Args:
        scenes: Scenes of tidefield prepare; times are those of the same machine if it was prepared there.
        runs: Folder for the maps and map_surveys.json.
    """
    tune_process()
    from benchmarks.map_surveys import measure_surveys, table

    print(table(measure_surveys(scenes, runs, partial(print, flush=True))).markdown())


def map_memory(
    scene: tyro.conf.Positional[Path], runs: Path = Path("runs/maps"), metres: float = 1000.0, cell: float = 0.05
) -> None:
    """Peak memory of a map of a square kilometre, simulated by repeating a scene (an hour, 20 GB of disk).

    Args:
        scene: A scene in metres, such as one of those that maps makes.
        runs: Folder for the map, which is deleted afterwards, and for map_memory.json.
        metres: Side of the square.
        cell: Side of a cell, metres.
    """
    tune_process()
    from benchmarks.map_memory import measure_memory

    found = measure_memory(scene, runs, metres, cell, partial(print, flush=True))
    print(
        f"{found['square_metres']:,.0f} m2, {found['cells']:,} cells of {100 * cell:g} cm, {found['points']:,} points: "
        f"peak memory {found['peak_memory_bytes'] / 1e9:.2f} GB, {found['seconds']:.0f} s after the tiles, "
        f"{found['tile_seconds']:.0f} s a tile, {found['disk_bytes'] / 1e9:.1f} GB of files"
    )


def cluster(
    scene: tyro.conf.Positional[Path],
    work: tyro.conf.Positional[Path],
    runs: Path = MEASURED,
    metres: float = 1000.0,
    cell: float = 0.2,
    kills: int = 10,
    seed: int = 0,
) -> None:
    """A map on a cluster of this machine: speed of one and two workers, and what killed workers cost (an hour).

    Args:
        scene: A survey that is larger than the square.
        work: Folder for the maps; those that the record has are not made again.
        runs: Store the figures in this folder's cluster.json.
        metres: Side of the square in the survey's middle that is mapped.
        cell: Side of a cell, metres.
        kills: How often a worker is killed.
        seed: Of the moments.
    """
    from benchmarks.cluster import measure_cluster, tables

    record = measure_cluster(scene, work, runs, metres, cell, kills, seed, partial(print, flush=True))
    for table in tables(record):
        print(table.markdown(), end="\n\n")
    print(f"{record['files']} files are the same in all maps")


def robustness(runs: Path = MEASURED, out: Path = Path("docs/robustness.md")) -> None:
    """Write the page on damaged files and killed commands from stored counts.

    Args:
        runs: Folder of fuzz.json and kills.json.
        out: The Markdown file to write; replaced if it is there.
    """
    from benchmarks.robustness import write_robustness

    write_robustness(runs, out)
    print(out)


def change(
    data: Path | None = None,
    pairs: int = 20,
    runs: Path = MEASURED,
    out: Path = Path("docs/change-results.md"),
) -> None:
    """Measure `tidefield change` against published figures and on pairs of known change (10 minutes); write the page.

    Args:
        data: Folder with bmx and st_leonards; without it, their figures stay as they are stored.
        pairs: Of built-in surveys for each amount of change; 0 leaves their figures as they are stored.
        runs: Store the figures in this folder's change.json.
        out: The Markdown file to write; replaced if it is there.
    """
    from benchmarks.change import measure_change, write_page

    measure_change(data, runs, pairs, partial(print, flush=True))
    write_page(runs, out)
    print(out)


def change_size(million: float = 100, runs: Path = MEASURED) -> None:
    """Time and peak memory of `tidefield change` on surfaces of many cells (10 minutes, 2 GB of disk).

    Args:
        million: Cells of each surface, in millions.
        runs: Store the figures in this folder's change.json.
    """
    from benchmarks.change import store
    from benchmarks.change_size import measure_size

    found = measure_size(million, partial(print, flush=True))
    print(
        f"{found['million_cells']:.0f} million cells: {found['seconds']:.0f} s, {found['processor_seconds']:.0f} s of "
        f"the processor, {found['peak_memory_bytes'] / 1e9:.2f} GB"
    )
    store(runs, "size", found)


def change_cover(seeds: int = 4, runs: Path = MEASURED) -> None:
    """Plants and waterlines of built-in pairs of dates against the truth (3 minutes).

    Args:
        seeds: Pairs of each category.
        runs: Store the figures in this folder's change.json.
    """
    tune_process()
    from benchmarks.change import store
    from benchmarks.change_cover import FIRST_SEED, measure_covers

    store(runs, "cover", measure_covers(range(FIRST_SEED, FIRST_SEED + seeds), partial(print, flush=True)))


def change_null(photographs: Path, work: Path, runs: Path = MEASURED) -> None:
    """Two flights over swindale, 27 minutes apart, as two surveys: nothing dry changed (30 minutes).

    Args:
        photographs: Folder with swindale's photographs, gps.csv and gcp_list.txt.
        work: Folder for scenes and maps; what is there is not made again.
        runs: Store the figures in this folder's change.json.
    """
    tune_process()
    from benchmarks.change import store
    from benchmarks.change_null import measure_null

    store(runs, "null", measure_null(photographs, work, partial(print, flush=True)))


def change_chain(work: Path, views: int = 16, width: int = 800, runs: Path = MEASURED) -> None:
    """Photographs of a built-in flat at two dates -> prepare -> map -> change, each against the truth (20-30 minutes).

    Args:
        work: Folder for photographs, scenes and maps; what is there is not made again.
        views: Photographs of each survey.
        width: Of the photographs in pixels.
        runs: Store the figures in this folder's change.json.
    """
    tune_process()
    from benchmarks.change import store
    from benchmarks.change_chain import run_chain

    store(runs, "chain", run_chain(work, views, width, partial(print, flush=True)))


def view(scene: Path, runs: Path | None = None, moves: int = 100, rests: int = 5) -> None:
    """How soon `tidefield view` shows pictures after moves of the camera, and what memory they take (minutes).

    Args:
        scene: Measure on this scene, with the installed weights of swift.
        runs: Store the figures in this folder's view.json.
        moves: Without rest, one after another.
        rests: Moves after which the sharp picture is waited for.
    """
    tune_process()
    from benchmarks.view import lines, measure_view

    print("\n".join(lines(measure_view(scene, runs, moves=moves, rests=rests))))


def gaussians(
    sources: tyro.conf.Positional[tuple[Path, ...]],
    runs: Path = MEASURED,
    widths: tuple[int, ...] = (400,),
    device: str = "auto",
) -> None:
    """What `tidefield export` loses against held-out photographs, with points chosen in several ways (minutes).

    Args:
        sources: Runs, or scenes for the trained weights.
        runs: Store the figures in this folder's gaussians.json, after each; what it holds is not measured again.
        widths: Of the views that are exported and of the photographs, in pixels.
        device: auto, cpu, cuda, cuda:N or mps.
    """
    tune_process()
    from benchmarks.gaussians import measure_gaussians, tables
    from tidefield.device import choose_device

    record = measure_gaussians(sources, runs, widths, choose_device(device), partial(print, flush=True))
    for made in tables(record):
        print(made.markdown(), end="\n\n")


def table(
    comparison: tuple[Path, ...] = COMPARISON,
    ablation: tuple[Path, ...] = ABLATION,
    lengths: tuple[Path, ...] = LENGTHS,
    widths: tuple[Path, ...] = WIDTHS,
    runs: Path = MEASURED,
    out: Path = Path("docs/results.md"),
) -> None:
    """Write the page of results from stored measurements; it marks what is missing.

    Args:
        comparison: Files of `tidefield compare`; of a result in several files the last one counts.
        ablation: Files of `tidefield ablate`, likewise.
        lengths: Files of `tidefield compare` at 400 px with other lengths of training, and from scratch.
        widths: Files of `tidefield compare` with the scenes at several widths.
        runs: Folder of speed, frames, memory, depth, points and parts.
        out: The Markdown file to write; replaced if it is there.
    """
    from benchmarks.table import write_page

    write_page(comparison, ablation, lengths, widths, runs, out)
    print(out)


def card(weights: Path, comparison: tuple[Path, ...] = STRICT_400) -> None:
    """Write the card of weights, from the file itself and from stored measurements.

    Args:
        weights: Of `tidefield pretrain`.
        comparison: Files of `tidefield compare` with the method zero-shot, or paper-zero-shot for those of paper.
    """
    from benchmarks.card import write_card

    print(write_card(weights, comparison))


def main(words: Sequence[str] | None = None) -> None:
    """Entry point: exit status 2 for a user's mistake, 130 after an interruption."""
    words = list(sys.argv[1:] if words is None else words)
    if not words or (words[0].startswith("-") and words[0] not in ("-h", "--help")):
        words = ["speed", *words]
    mapped = (maps, map_control, map_views, map_surveys, map_memory, cluster)
    changes = (change, change_size, change_cover, change_chain, change_null)
    quality = (points, parts, depth)
    surveyed = (surveys, mappers, flight, large, cost, areas)
    measured = (speed, frames, memory, scales, *surveyed, *mapped, *quality, *changes, view, gaussians, kills, fuzz)
    functions = (*measured, table, robustness, card)
    commands = {function.__name__: function for function in functions}
    try:
        tyro.extras.subcommand_cli_from_dict(commands, prog="python -m benchmarks", description=DESCRIPTION, args=words)
    except TidefieldError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("benchmarks: interrupted; repeat the command to continue", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
