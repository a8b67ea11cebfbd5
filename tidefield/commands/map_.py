"""`tidefield map`: orthophoto, surface model and point cloud."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import AllowMissing, Cluster, Device, Verbosity, ZeroShot, open_source
from tidefield.errors import RunError, need

if TYPE_CHECKING:
    from rich.console import Console

    from tidefield.cluster import Share
    from tidefield.maps.make import Job
    from tidefield.model.rendering import Render

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Map:
    """Map a survey: true orthophoto, surface model with its standard error, and point cloud, in ODM's folders.

    All photographs of the scene are sources, held-out ones too. The orthophoto is rendered straight down by parallel
    rays; heights are matched at the photographs' own resolution, or at that of --gsd if it is coarser. Cells that fewer
    than two photographs see are empty. Ctrl-C loses at most the running tiles; the same command continues.
    """

    source: Annotated[Positional[Path], arg(metavar="RUN|SCENE")]
    """A trained run, or with --zero-shot a scene."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder for the map: a new one, or one to continue."""
    zero: OmitArgPrefixes[ZeroShot] = ZeroShot()
    gsd: float | None = None
    """Ground sampling distance, the side of a cell, in metres; that of the photographs if not given."""
    area: Path | None = None
    """Map only the polygons of this file (GeoJSON, GeoPackage, shapefile)."""
    heights: str | None = None
    """Vertical system of the scene's heights, such as EPSG:5701, where the scene does not state it."""
    check: Path | None = None
    """Check points, besides those of the scene: a file like gcp_list.txt, or with lines `x y z name`."""
    contours: float | None = None
    """Interval of the contours, in metres; a round one for about 20 contours if not given."""
    sections: Path | None = None
    """Cut cross-sections along the lines of this file (GeoJSON, GeoPackage, shapefile)."""
    fill: bool = False
    """Fill cells that fewer than two photographs see, and mark them in odm_dem/filled.tif."""
    device: Device = "auto"
    cluster: Cluster = None
    overwrite: bool = False
    """Replace an existing map."""
    allow_missing: AllowMissing = False
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def map_(options: Map, console: Console) -> dict[str, Any]:
    """Run `tidefield map`."""
    from tidefield.cluster import absolute, connected, share_of
    from tidefield.files import only_writer
    from tidefield.maps.make import TileMaker, delete_tiles, finish_map, make_tiles
    from tidefield.progress import ProgressBar

    for library in ("rasterio", "laspy", "pyogrio"):
        need(library)
    if options.contours is not None and not 0.001 <= options.contours < math.inf:
        raise RunError(f"--contours {options.contours:g} was asked for: expected 0.001 or more metres; choose another")
    # Before photographs are read, which may take minutes.
    if options.gsd is not None and options.gsd <= 0:
        raise RunError(f"--gsd {options.gsd:g} was asked for: expected the side of a cell, above 0; choose another")
    with ExitStack() as stack:
        stack.enter_context(only_writer(options.out))
        opened = stack.enter_context(ExitStack())
        job, render, about = opened.enter_context(open_job(options, console))
        grid, frame = job.grid, job.grid.frame
        console.print(
            f"{grid.columns} x {grid.rows} cells of {grid.cell:.4g} {frame.unit}, {frame.name}; "
            f"heights: {frame.heights}",
            highlight=False,
            soft_wrap=True,
        )
        if frame.frame is None:
            log.warning("the scene is not georeferenced: its unit counts as a metre in looking for plants and water")
        if options.cluster is None:
            makes = TileMaker(job, render, options.out).several
        else:
            ray = opened.enter_context(connected(options.cluster))
            open_maker = partial(_tile_maker, absolute(options), job.key)
            share = share_of(ray, options.device, "core")
            makes = partial(_in_blocks, ray, job, options.out, open_maker, share)
        make_tiles(job, options.out, options.overwrite, partial(ProgressBar, console), makes)
        del render, makes
        opened.close()
        result = finish_map(job, options.out, about, partial(ProgressBar, console))
        delete_tiles(options.out)
    console.print(
        f"{options.out}: {result['area']:,.0f} square {frame.unit}, {result['points']:,} points",
        highlight=False,
        soft_wrap=True,
    )
    if "check_points" in result:
        found = result["check_points"]
        console.print(f"{found['remark']}: {_describe(found['vertical'], frame.unit_up)}", soft_wrap=True)
    return result


def _in_blocks(
    ray: Any, job: Job, out: Path, opened: Callable[..., Any], share: Share, numbers: list[int]
) -> Iterator[int]:
    """Make tiles on a cluster, some neighbours in a task; yields their numbers."""
    from tidefield.addresses import pull, push
    from tidefield.cluster import cores_of, each_on_cluster
    from tidefield.maps.make import tile_file

    push(out)  # otherwise machines with a copy of their own would take tiles of an earlier map for those of this one
    tiles = job.tiles()
    for number in each_on_cluster(ray, job.key, opened, job.blocks(numbers, cores_of(ray)), share):
        pull(tile_file(out, tiles[number]))
        yield number


@contextmanager
def open_job(options: Map, console: Console) -> Iterator[tuple[Job, Render, dict[str, Any]]]:
    """What a map is made of, the method while the block lasts, and the record of its source."""
    from pyproj import CRS
    from shapely import union_all

    from tidefield.data.georeference import find_georeference
    from tidefield.data.load import at_width
    from tidefield.device import choose_device
    from tidefield.geometry.drawn import read_drawn
    from tidefield.maps.check_points import all_check_points
    from tidefield.maps.grid import make_grid, map_frame
    from tidefield.maps.make import Job

    device = choose_device(options.device)
    # Before photographs are read, which may take minutes.
    drawn = options.area and read_drawn(options.area).of_kind("Polygon")
    cuts = options.sections and read_drawn(options.sections).of_kind("LineString")
    with open_source(options.source, options.zero, device, options.allow_missing, console, hold_out=False) as (
        scene,
        render,
        record,
    ):
        georeference = find_georeference(scene.root, scene.reference)
        frame = map_frame(scene, georeference, options.heights)
        system, interval = CRS.from_wkt(frame.horizontal_wkt), options.contours and options.contours * frame.metre_up
        area = drawn and union_all(drawn.placed(system).of_kind("Polygon").geometries)
        widest = max(file.lens.width for file in scene.photographs.files)
        full = scene if scene.cameras.width >= widest else at_width(scene, widest)
        grid = make_grid(frame, full, options.gsd, None if area is None else area.bounds)
        cuts = cuts and cuts.placed(system).of_kind("LineString")
        lines = tuple(zip(cuts.geometries, cuts.names, strict=True)) if cuts else ()
        points = all_check_points(full, frame, options.check, georeference)
        job = Job(full, grid, area, options.fill, {"method": record}, tuple(points), interval, lines)
        yield job, render, {"scene": scene.root.resolve().name, "method": record}


@contextmanager
def _tile_maker(options: Map, key: str) -> Iterator[Callable[[Sequence[int]], Iterator[int]]]:
    """Open a map in a worker of a cluster."""
    import torch

    from tidefield.addresses import pull_all, push
    from tidefield.cluster import require_same
    from tidefield.maps.make import TileMaker, tile_file
    from tidefield.progress import make_console

    torch.set_num_threads(1)  # a task has one core
    pull_all(options)
    with open_job(options, make_console(quiet=True)) as (job, render, _):
        require_same(options.source, key, job.key)
        maker, tiles = TileMaker(job, render, options.out), job.tiles()

        def made(numbers: Sequence[int]) -> Iterator[int]:
            for number in maker.block(numbers):
                push(tile_file(options.out, tiles[number]))
                yield number

        yield made


def _describe(found: dict[str, Any], unit: str) -> str:
    """The statistics of heights at check points, in one line."""
    if not found["n"]:
        return "none of them is on the map"
    return (
        f"heights: RMSE {found['rmse']:.3f}, mean {found['mean']:+.3f}, NMAD {found['nmad']:.3f} {unit}, n {found['n']}"
    )
