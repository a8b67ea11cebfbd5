"""`tidefield change`: what changed between surveys."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import Device, Verbosity, ZeroShot, open_source
from tidefield.errors import RunError, list_names
from tidefield.files import completed_folder, refuse_existing, require_writable

if TYPE_CHECKING:
    from rich.console import Console

    from tidefield.change.cover import Cover
    from tidefield.change.inputs import Pair
    from tidefield.change.kinds import View
    from tidefield.change.measure import Change as Measured
    from tidefield.change.water import Water

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Change:
    """Measure what changed between two surveys: what was eroded, what grew, and how sure that is.

    OUT is a new folder: change.html (the report), change.tif (difference, its standard error, p-value and
    systematic error), significant.tif, change.gpkg (outlines, stable ground and more), volumes.csv, outlines.csv and
    change.json. All volumes have 95% intervals from the random, the spatially correlated and the systematic part of the
    error, which are measured over stable ground. Where both surveys have orthophotos, plants gained and lost are
    reported, too (cover.tif, cover.csv); with --scenes the same places then and now are in views, as pictures, a page
    that swipes and a video.
    """

    earlier: Annotated[Positional[Path], arg(metavar="EARLIER")]
    """The earlier survey: a surface (GeoTIFF of heights), a point cloud (LAS, LAZ), or a folder of `tidefield map` or
    ODM."""
    later: Annotated[Positional[Path], arg(metavar="LATER")]
    """The later survey, likewise."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """A new folder for the results."""
    series: tuple[Path, ...] = ()
    """Further surveys, in the order of time: OUT then has a folder for each step, and series.html, series.csv and
    series.json with the volumes over time."""
    stable: Path | None = None
    """Ground that did not change: polygons or lines (GeoJSON, GeoPackage, shapefile). If not given, it is what is left
    when everything that stands out is outlined, and is shown."""
    within: Path | None = None
    """Polygons to which the comparison is limited; stable ground may lie outside."""
    polygons: Path | None = None
    """Polygons whose volumes are given one by one."""
    register: Literal["auto", "none", "vertical", "tilt"] = "auto"
    """What is taken from the later survey over stable ground: nothing, which is right for surveys with the same ground
    control; a vertical shift; or a shift and a tilt, with stable ground on all sides. auto is vertical."""
    shift: Literal["auto", "none", "images"] = "auto"
    """Move the later survey horizontally by what the orthophotos tell: where they tell it; not at all; or refuse where
    they do not. Heights of flats do not tell it."""
    orthophotos: tuple[Path, Path] | None = None
    """Orthophotos of both surveys (GeoTIFF), if they are not in the folders."""
    datum_error: float | None = None
    """Standard error in metres that all heights of the difference share, as control gives it; added to what stable
    ground shows, or with --register none used instead."""
    shift_error: float | None = None
    """Standard error in metres, in each direction, of how the surveys lie next to one another, as control gives it;
    counts on slopes where the orthophotos tell no shift, or with --shift none."""
    cell: float | None = None
    """Side of the cells in metres; if not given, that of the coarser survey's pixels."""
    windows: tuple[int, ...] = (5, 11, 21)
    """Cells along each side of the windows in which change is tested, odd numbers; those wider than half of the
    surveys' shorter side are left out."""
    water: tuple[float, float] | None = None
    """Heights of the water at both dates, in the earlier survey's heights and their unit, for how far the waterline
    moved."""
    levels: tuple[float, ...] = ()
    """Heights, likewise, for the area of the ground below each at both dates."""
    m3c2: bool = False
    """Measure M3C2 distances between the clouds of two folders, too; between two clouds they are always measured."""
    scenes: tuple[Path, Path] | None = None
    """Scenes or trained runs of both surveys: the same places then and now are rendered into OUT/views (scenes by the
    trained weights that came with Tidefield)."""
    cameras: tuple[str, ...] = ()
    """Photographs of the earlier scene from whose cameras both are rendered; if not given, the one that looks at the
    largest change."""
    view_width: int = 960
    """Width of these views in pixels."""
    device: Device = "auto"
    """Where they are rendered."""
    dates: tuple[str, ...] | None = None
    """Dates of the surveys, if files and names do not tell: YYYY-MM-DD for each."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def change(options: Change, console: Console) -> None:
    """Run `tidefield change`."""
    refuse_existing(options.out, replaceable=False)
    require_writable(options.out)
    _check(options)
    if options.scenes is not None:
        _check_scenes(options.scenes, options.cameras, options.device)
    (_series if options.series else _compare)(options, console)


@dataclass(frozen=True)
class Found:
    """What a comparison of two surveys found."""

    pair: Pair
    change: Measured
    cover: Cover | None
    water: Water | None


def _compare(options: Change, console: Console) -> None:
    with TemporaryDirectory() as work:
        found = _measured(options, options.earlier, options.later, _dates(options, 2), Path(work), console)
        with completed_folder(options.out) as folder:
            _write(found, options, folder, console)
    _say(found, console)
    console.print(str(options.out), soft_wrap=True)


def _series(options: Change, console: Console) -> None:
    """Compare surveys step by step and each with the first."""
    from tidefield.change.inputs import look_at_series
    from tidefield.change.series import entries_of, write_series
    from tidefield.pages import command_line

    paths = (options.earlier, options.later, *options.series)
    dates = _dates(options, len(paths))
    registered = options.register != "none"
    names, stated = look_at_series(paths, dates, options.cell, options.m3c2, registered)
    _require_order(paths, stated)
    entries, remarks = [], {}
    with completed_folder(options.out) as folder:
        for end in range(1, len(paths)):
            for start in sorted({0, end - 1}):
                with TemporaryDirectory() as work:
                    ends = paths[start], paths[end], (dates[start], dates[end])
                    found = _measured(options, *ends, Path(work), console, (names[start], names[end]))
                    remarks[start, end] = found.change.remarks
                    if start == 0:
                        entries += entries_of(found.change, "first", start, end)
                    if start == end - 1:
                        entries += entries_of(found.change, "step", start, end)
                        (folder / f"step_{end}").mkdir()
                        _write(found, options, folder / f"step_{end}", console)
                        console.print(f"{names[start]} to {names[end]}", soft_wrap=True)
                        _say(found, console)
                    # Two comparisons of large surveys are more than fits into the memory.
                    del found
        numbers = write_series(entries, remarks, _distinct(names), folder, command_line())
        if uneven := numbers["different_ground_m2"]:
            log.warning(
                f"{list_names(list(uneven))}: not all surveys have heights everywhere, so that volumes are of "
                "different ground (series.html); a polygon that all surveys cover (--within) compares the same"
            )
    console.print(str(options.out), soft_wrap=True)


def _require_order(paths: Sequence[Path], dates: Sequence[str | None]) -> None:
    """Raises: RunError when a survey is of an earlier date than one that was named before it."""
    from tidefield.change.series import in_order

    for end in range(1, len(paths)):
        if not in_order(dates[: end + 1]):
            raise RunError(
                f"{paths[end]} is of {dates[end]}, before a survey that was named earlier: expected the order of time; "
                "exchange them, or state their --dates"
            )


def _distinct(names: list[str]) -> list[str]:
    """Names, numbered where two are the same but for upper and lower case."""
    found: list[str] = []
    for name in names:
        own, number, taken = name, 1, {other.casefold() for other in found}
        while own.casefold() in taken:
            number += 1
            own = f"{name} ({number})"
        found.append(own)
    return found


def _dates(options: Change, count: int) -> tuple[str | None, ...]:
    if options.dates is None:
        return (None,) * count
    if len(options.dates) != count:
        raise RunError(f"--dates has {len(options.dates)} dates: expected {count}, one for each survey; state them all")
    return options.dates


def _measured(
    options: Change,
    one: Path,
    other: Path,
    dates: tuple[str | None, ...],
    work: Path,
    console: Console,
    names: tuple[str, str] | None = None,
) -> Found:
    """Compare two surveys."""
    import numpy as np

    from tidefield.change.cover import measure_cover
    from tidefield.change.inputs import open_pair
    from tidefield.change.measure import Options, measure
    from tidefield.change.regions import read_regions
    from tidefield.change.shift import require_picture
    from tidefield.change.water import measure_water
    from tidefield.progress import ProgressBar

    registered = options.register != "none"
    pair = open_pair(one, other, work, (dates[0], dates[1]), options.cell, options.m3c2, registered, names)
    earlier, later = pair.earlier, pair.later
    for level in (*(options.water or ()), *options.levels):
        if not -12_000 < level * earlier.metres < 9_000:
            raise RunError(
                f"a level of {level:g} was asked for, {level * earlier.metres:,.0f} m: expected a height on the Earth, "
                f"in the unit of {earlier.file}; choose another"
            )
    if options.orthophotos is not None:
        for path in options.orthophotos:
            require_picture(path)
        earlier, later = (
            replace(surface, orthophoto=path)
            for surface, path in zip((earlier, later), options.orthophotos, strict=True)
        )
    if earlier.date and later.date and earlier.date > later.date:
        raise RunError(
            f"{one} is of {earlier.date}, {other} of {later.date}: expected the earlier survey first; exchange them, "
            "or state their --dates"
        )
    asked = Options(
        options.cell, options.register, options.shift, options.datum_error, options.shift_error, options.windows
    )
    reads = [
        None if path is None else (lambda grid, path=path: read_regions(path, grid))
        for path in (options.stable, options.within, options.polygons)
    ]
    with ProgressBar(console, "Reading surfaces") as bar:
        found = measure(earlier, later, asked, stable=reads[0], within=reads[1], regions=reads[2], tick=bar)
    water = measure_water(found, options.water, options.levels) if options.water or options.levels else None
    cover = None
    if earlier.orthophoto is not None and later.orthophoto is not None:
        regions = [region for region, *_ in found.per_region]
        shift, known = found.errors.registration.shift_m, np.isfinite(found.dz)
        if water is not None and water.waterline is not None:
            known &= ~water.waterline.wet
        cover = measure_cover(earlier.orthophoto, later.orthophoto, found.grid, shift, regions, known)
    for remark in found.remarks:
        log.warning(remark)
    return Found(pair, found, cover, water)


def _write(found: Found, options: Change, folder: Path, console: Console) -> None:
    """Write the files of one comparison."""
    from pyproj import CRS

    from tidefield.change.clouds import compare_clouds, in_system, write_distances
    from tidefield.change.page import write_page
    from tidefield.change.write import write_all
    from tidefield.pages import command_line
    from tidefield.progress import ProgressBar

    change, cover, water, clouds = found.change, found.cover, found.water, found.pair.clouds
    numbers = write_all(change, folder, command_line(), cover, water)
    views = [] if options.scenes is None else _views(options, change, cover, folder, console)
    write_page(change, numbers, folder / "change.html", cover, water, views)
    if clouds is not None:
        system = None if change.grid.crs is None else CRS.from_wkt(change.grid.crs)
        first, second = (in_system(cloud, system) for cloud in clouds)
        with ProgressBar(console, "Measuring M3C2 distances") as bar:
            difference = change.grid, change.with_water
            distances = compare_clouds(
                first, second, change.grid.cell_m, change.errors.registration, bar, difference=difference
            )
        write_distances(distances, first.crs, folder / "m3c2.laz")


def _say(found: Found, console: Console) -> None:
    from tidefield.change.page import cover_words, water_words

    change = found.change
    for name, volume in (("net", change.net), ("cut", change.cut), ("fill", change.fill)):
        low, high = volume.interval_m3
        console.print(
            f"{name}: {volume.value_m3:+,.1f} m3 (95%: {low:+,.1f} to {high:+,.1f}) on {volume.area_m2:,.0f} m2; "
            f"sigma: random {volume.random_m3:,.1f}, correlated {volume.correlated_m3:,.1f}, systematic "
            f"{volume.systematic_m3:,.1f}, choice {volume.choice_m3:,.1f}",
            soft_wrap=True,
        )
    console.print(
        f"a cell is significant beyond {change.detection_m[1]:.3f} m; {100 * change.false_alarms:.1f}% of stable cells "
        "are (5% expected)",
        soft_wrap=True,
    )
    for line in [*cover_words(found.cover), *water_words(found.water)]:
        console.print(line, soft_wrap=True)


def _views(options: Change, found: Measured, cover: Cover | None, folder: Path, console: Console) -> list[View]:
    """Render both surveys from the cameras that were asked for, and write the pictures."""
    from tidefield.change.pictures import write_views
    from tidefield.change.views import Site, choose_camera, make_view
    from tidefield.device import choose_device
    from tidefield.progress import ProgressBar
    from tidefield.train.checkpoint import RUN_FILE

    assert options.scenes is not None
    device, made = choose_device(options.device), []
    with ExitStack() as stack:
        sites = []
        for path in options.scenes:
            zero = ZeroShot(zero_shot=not (path / RUN_FILE).exists())
            opened = open_source(path, zero, device, False, console, hold_out=False)
            scene, render, _ = stack.enter_context(opened)
            sites.append(Site.of(scene, render))
        asked, earlier = options.cameras or (choose_camera(found, sites[0]),), sites[0].scene
        names = [earlier.names[earlier.index(name)] for name in asked]
        with ProgressBar(console, "Rendering views") as bar:
            for k, (name, own) in enumerate(zip(names, _view_folders(names, folder / "views"), strict=True)):
                view = make_view(found, cover, sites[0], sites[1], name, options.view_width)
                own.mkdir(parents=True)
                write_views(view, (found.earlier.name, found.later.name), own)
                made.append(view)
                bar(k + 1, len(names))
    return made


def _view_folders(names: list[str], folder: Path) -> list[Path]:
    """The folders of views from the cameras of these photographs."""
    stems = [Path(name).with_suffix("").as_posix().replace("/", "_") for name in names]
    return [folder / own for own in _distinct(stems)]


def _check_scenes(scenes: tuple[Path, Path], cameras: tuple[str, ...], device: str) -> None:
    """Find the mistakes that views would find only after everything is measured.

    Raises:
        TidefieldError: a scene cannot be read, has no such photographs, one is named twice, only one scene has a
            georeference, a run has not been trained, or there is no such device.
    """
    from tidefield.addresses import pull
    from tidefield.change.views import require_both_placed
    from tidefield.config import Config, NerfConfig
    from tidefield.data.georeference import find_georeference
    from tidefield.data.load import read_posed
    from tidefield.device import choose_device
    from tidefield.geometry.cameras import find_name
    from tidefield.train.checkpoint import RUN_FILE, read_run, require_checkpoint

    choose_device(device)
    roots = []
    for path in scenes:
        run = read_run(path) if (path / RUN_FILE).exists() else None
        # Runs of other methods keep what they trained in files of their own.
        if run is not None and isinstance(run.config, Config | NerfConfig):
            require_checkpoint(path)
        roots.append(path if run is None else run.scene)
    for root in roots:
        pull(root)
    posed = [read_posed(root, allow_missing=False) for root in roots]
    georeferences = [find_georeference(root, each.reference) for root, each in zip(roots, posed, strict=True)]
    require_both_placed(*(None if known is None else known.frame for known in georeferences))
    found = [find_name(name, posed[0].names, str(roots[0])) for name in cameras]
    if len(set(found)) < len(found):
        raise RunError("--cameras names a photograph twice: expected each once; leave one out")


def _check(options: Change) -> None:
    """Raises: RunError when an option has no meaning."""
    for name, error in (("--datum-error", options.datum_error), ("--shift-error", options.shift_error)):
        if error is not None and not 0 <= error < 100:
            raise RunError(f"{name} {error} was asked for: expected 0 to 100 metres; choose another")
    if options.cell is not None and not 0 < options.cell < math.inf:
        raise RunError(f"--cell {options.cell} was asked for: expected more than 0 metres; choose another")
    if not options.windows or any(window < 1 or window % 2 == 0 or window > 101 for window in options.windows):
        given = " ".join(map(str, options.windows))
        raise RunError(f"--windows {given} was asked for: expected odd numbers from 1 to 101; choose others")
    if options.cameras and options.scenes is None:
        raise RunError("--cameras was given without --scenes: expected the scenes of both surveys; name them")
    given = {"--water": options.water, "--scenes": options.scenes, "--orthophotos": options.orthophotos}
    for name, value in given.items():
        if options.series and value is not None:
            raise RunError(f"{name} was given with --series: it belongs to two surveys; leave it out")
    if not 64 <= options.view_width <= 8192:
        raise RunError(f"--view-width {options.view_width} was asked for: expected 64 to 8192 pixels; choose another")
    for given_date in options.dates or ():
        try:
            known = date.fromisoformat(given_date).isoformat() == given_date  # it reads other forms, too
        except ValueError:
            known = False
        if not known:
            raise RunError(f"--dates {given_date} was given: expected a day of the calendar as YYYY-MM-DD; write it so")
