"""Make a map: measure and render its tiles one after the other, each kept on disk, then join them to files.

A map that was interrupted continues with the tiles that are missing. Memory is bounded by a row of tiles.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry

from tidefield.data.scene import Scene
from tidefield.errors import RunError, need
from tidefield.files import (
    completed_file,
    delete_files,
    delete_partials,
    is_partial,
    read_json,
    write_json,
    writing_to,
)
from tidefield.machine import cores, release_memory
from tidefield.maps.area import inside, touches
from tidefield.maps.check_points import CheckPoint, check, summary
from tidefield.maps.classes import GROUND, VEGETATION, WATER
from tidefield.maps.cloud import cloud_writer
from tidefield.maps.contours import contours, interval_of, read_reduced, write_contours
from tidefield.maps.grid import Grid, Tile, feather, ground_sampling_distance
from tidefield.maps.masks import Body, level_water, read_water, write_classes, write_masks
from tidefield.maps.orthophoto import render_tile
from tidefield.maps.rasters import BLOCK, NODATA, Raster, RasterWriter, raster_writer
from tidefield.maps.report import write_report
from tidefield.maps.sections import cut, write_sections
from tidefield.maps.styles import CLASSES_OF_GROUND
from tidefield.maps.surface import COARSEST, Matched, match, sparse_surface
from tidefield.maps.terrain import blocks, write_hillshade, write_terrain
from tidefield.maps.vectors import lost_in_geojson
from tidefield.maps.views import GreyPhotographs
from tidefield.model.rendering import Render
from tidefield.parallel import in_parallel

log = logging.getLogger(__name__)

MAP_FILE = "map.json"
TILES = "tiles"
ORTHOPHOTO = "odm_orthophoto/odm_orthophoto.tif"
VIEWS = "odm_orthophoto/views.tif"
MAIN = "odm_orthophoto/photograph.tif"
DSM, SIGMA, FILLED = "odm_dem/dsm.tif", "odm_dem/dsm_sigma.tif", "odm_dem/filled.tif"
DTM = "odm_dem/dtm.tif"
DSM_HILLSHADE, DTM_HILLSHADE = "odm_dem/dsm_hillshade.tif", "odm_dem/dtm_hillshade.tif"
CLASSES, AGREEMENT = "odm_dem/classes.tif", "odm_dem/agreement.tif"
CONTOURS, SECTIONS, MASKS = "contours", "sections", "masks"
"""Folders."""
CLOUD = "odm_georeferencing/odm_georeferenced_model.laz"
PRODUCTS = (
    *(ORTHOPHOTO, VIEWS, MAIN, DSM, SIGMA, FILLED, DTM, DSM_HILLSHADE, DTM_HILLSHADE, CLASSES, AGREEMENT, CLOUD),
    "odm_dem/classes.qml",
    *(f"{CONTOURS}/contours.{suffix}" for suffix in ("gpkg", "geojson", "dxf")),
    *(f"{SECTIONS}/sections.{suffix}" for suffix in ("csv", "svg")),
    *(f"{MASKS}/{name}" for name in ("masks.gpkg", "vegetation.geojson", "water.geojson", "waterline.geojson")),
    "odm_report/report.html",
)
"""All files of a map besides `MAP_FILE`."""
MARGIN = 16
"""Cells that a tile shares with each of its neighbours' margins, across which both fade."""
LARGEST_TILE, SMALLEST_TILE = 480, 96
FEWEST_VIEWS = 2
"""Photographs that must see a cell: what one alone shows has no height."""
CLOUD_ROWS = 64
"""Rows of which points are made at once."""
STRIP_CELLS = 1_000_000
"""Cells of a strip, about: what is made of them takes a hundred bytes of each."""
GDAL_CACHE_BYTES = 128_000_000
"""Memory of GDAL for blocks, beside those of a row of them in each raster, which would be written again and again
otherwise. By itself it takes a twentieth of the machine's."""
VERSION = 8
"""Of tiles; to be raised with what they hold."""


@dataclass(frozen=True)
class Job:
    """What a map is made of.

    Attributes:
        scene: all of its photographs are sources; opened at the size to match at.
        grid: the cells.
        area: outside of which nothing is mapped; None for no limit.
        fill: fill cells that fewer than two photographs see, and mark them.
        settings: what else the tiles depend on, for resuming.
        check_points: surveyed points that the map is compared with.
        interval: between contours, vertical units; a round one if None.
        sections: lines to cut the surface along, and their names.
    """

    scene: Scene
    grid: Grid
    area: BaseGeometry | None
    fill: bool
    settings: dict[str, Any]
    check_points: tuple[CheckPoint, ...] = ()
    interval: float | None = None
    sections: tuple[tuple[BaseGeometry, str], ...] = ()

    @cached_property
    def tile_side(self) -> int:
        """Cells along the side of a tile: photographs that see one of its corners should see most of it."""
        width = int(self.scene.cameras.size_px[:, 0].median())
        side = int(np.clip(width // 4 // 32 * 32, SMALLEST_TILE, LARGEST_TILE))
        # Each cell of a coarse map shows several pixels.
        pixels = max(1, round(self.grid.cell / (ground_sampling_distance(self.scene) * self.grid.frame.metre)))
        return max(32, side // pixels // 32 * 32)

    def tiles(self) -> list[Tile]:
        side = -(-(self.tile_side + 2 * MARGIN) // 32) * 32 - 2 * MARGIN
        return self.grid.tiles(side, MARGIN)

    def blocks(self, numbers: Sequence[int], workers: int) -> list[tuple[int, ...]]:
        """Group tiles, by their numbers, into square blocks, some for each worker.

        Neighbouring tiles show the same photographs, which every worker encodes for itself.
        """
        side = min(LARGEST_BLOCK, max(1, math.isqrt(len(numbers) // (BLOCKS_EACH * workers))))
        tiles, found = self.tiles(), dict[tuple[int, int], list[int]]()
        for number in numbers:
            tile = tiles[number]
            step = side * (tile.side - 2 * tile.margin)
            place = (tile.row + tile.margin) // step, (tile.column + tile.margin) // step
            found.setdefault(place, []).append(number)
        return [tuple(block) for block in found.values()]

    @property
    def key(self) -> str:
        """Identifies everything that the tiles depend on."""
        grid = self.grid
        about = [VERSION, grid.west, grid.north, grid.cell, grid.columns, grid.rows, grid.frame.wkt, self.settings]
        about += [str(self.area), self.fill, list(self.scene.names), self.scene.cameras.T_world_camera.tolist()]
        frame, origin = grid.frame.frame, self.scene.origin_world.double().numpy()
        about += [np.round(origin, 6).tolist(), grid.frame.heights, None if frame is None else frame.to_json()]
        about += [self.tile_side, self.scene.cameras.size_px.tolist()]
        # Of photographs, or masks, that were changed; copies of a scene have other dates and the same sizes.
        files = [(file.path, file.mask) for file in self.scene.photographs.files]
        about += [[path and path.stat().st_size for path in paths] for paths in files]
        return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


BLOCKS_EACH, LARGEST_BLOCK = 4, 8
"""Blocks of tiles for each worker, so that none waits long for the last, and the most tiles along the side of one."""
MakesTiles = Callable[[list[int]], Iterator[int]]
"""Makes tiles, given by their numbers among `Job.tiles`, here or elsewhere; yields the number of each that is done."""


def make_missing(job: Job, out: Path, progress: Callable[[int, int], None], makes: MakesTiles) -> None:
    """Measure and render all tiles that are not on disk yet.

    Raises:
        RunError: tiles were made, but are not in the folder.
    """
    files = {number: tile_file(out, tile) for number, tile in enumerate(job.tiles()) if touches(job.area, tile)}
    # A folder is listed once: a large map has tens of thousands of tiles.
    there = set((out / TILES).glob("*"))
    missing = [number for number, file in files.items() if file not in there]
    done = len(files) - len(missing)
    if done:
        log.info(f"{done} of {len(files)} tiles are there already")
    if not missing:
        return
    with writing_to(out / TILES):
        for file in filter(is_partial, there):
            file.unlink(missing_ok=True)
    for _ in makes(missing):
        done += 1
        progress(done, len(files))
    # In the joined map they would be holes, like what lies outside of the area.
    if lost := sum(not files[number].exists() for number in missing):
        raise RunError(
            f"{lost} of the {len(missing)} tiles that were made are not in {out / TILES}: expected a folder that all "
            "machines share under this name; choose one, or share it, and repeat the command"
        )


class TileMaker:
    """Measures and renders tiles of a map, and writes each to a file.

    Args:
        job: of the map.
        render: the method that renders the orthophoto.
        out: folder of the map.
    """

    def __init__(self, job: Job, render: Render, out: Path) -> None:
        self._job, self._render, self._out, self._tiles = job, render, out, job.tiles()
        self._start = sparse_surface(job.scene, job.grid.coarser(COARSEST))
        self._grey = GreyPhotographs(job.scene)
        self._gsd = ground_sampling_distance(job.scene) * job.grid.frame.metre

    def __call__(self, number: int) -> None:
        """Make one tile, by its number, on one core."""
        tile = self._tiles[number]
        self._write(tile, self._match(tile))

    def block(self, numbers: Sequence[int]) -> Iterator[int]:
        """Make tiles one by one; yields their numbers. Those that a worker has made before it died are there."""
        for number in numbers:
            if not tile_file(self._out, self._tiles[number]).exists():
                self(number)
            yield number

    def several(self, numbers: list[int]) -> Iterator[int]:
        """Make tiles, as many at a time as there are cores; yields their numbers."""
        together = cores()
        for first in range(0, len(numbers), together):
            part = numbers[first : first + together]
            found = in_parallel([partial(self._match, self._tiles[number]) for number in part], "cpu")
            for number, matched in zip(part, found, strict=True):
                self._write(self._tiles[number], matched)
                yield number

    def _match(self, tile: Tile) -> Matched:
        return match(tile, self._start, self._job.scene, self._grey, self._gsd)

    def _write(self, tile: Tile, matched: Matched) -> None:
        job = self._job
        values: dict[str, np.ndarray] = {}
        wanted = inside(job.area, tile)
        seen = (matched.count >= FEWEST_VIEWS) & wanted
        shown = wanted if job.fill else seen
        if shown.any():
            above = matched.height - np.float32(job.grid.height)
            colour = render_tile(self._render, tile, above, matched.sigma)
            values = {
                "height": matched.height,
                "sigma": matched.sigma,
                "score": matched.score.astype(np.float16),
                "count": np.minimum(matched.count, 65535).astype(np.uint16),
                "main": matched.main.astype(np.uint16),
                "seen": seen,
                "shown": shown,
                "colour": colour,
            }
        with (
            completed_file(tile_file(self._out, tile), overwrite=True) as partial_file,
            partial_file.open("wb") as file,
        ):
            np.savez(file, allow_pickle=False, **values)


def tile_file(out: Path, tile: Tile) -> Path:
    """Where a tile is kept until the map is finished."""
    return out / TILES / f"{tile.name}.npz"


@dataclass(frozen=True)
class Strip:
    """Some whole rows of a map, joined from tiles; NaN where nothing is shown.

    Attributes:
        row: the first one.
        height, sigma, score: of each cell.
        colour: 3 bands in [0, 1].
        count: photographs that see each cell.
        main: the photograph that contributes most, 0 for none, else its index plus 1.
        seen: at least two photographs see it.
        shown: it is part of the map.
    """

    row: int
    height: Float[np.ndarray, "h w"]
    sigma: Float[np.ndarray, "h w"]
    score: Float[np.ndarray, "h w"]
    colour: Float[np.ndarray, "3 h w"]
    count: np.ndarray
    main: np.ndarray
    seen: np.ndarray
    shown: np.ndarray


def strips(job: Job, out: Path) -> Iterator[Strip]:
    """Join tiles to strips of whole rows, from north to south; where tiles overlap they fade into each other."""
    tiles = job.tiles()
    grid, side = job.grid, tiles[0].side - 2 * MARGIN
    weight_of = feather(tiles[0].side, MARGIN)
    rows = sorted({tile.row for tile in tiles})
    high = tiles[0].side
    # Of 0 to 5: height, sigma, score and the colours, each times the weight; 6 is the weight.
    sums = np.zeros((7, high, grid.columns), np.float32)
    single = np.zeros((4, high, grid.columns), np.uint16)
    for row in rows:
        for tile in (t for t in tiles if t.row == row):
            path = tile_file(out, tile)
            if not path.exists():
                continue  # outside of the area
            with np.load(path, allow_pickle=False) as values:
                if not values.files:
                    continue
                _, columns_in, own_rows, own_columns = tile.window()
                at = (slice(own_rows.start, own_rows.stop), columns_in)
                weight = (weight_of * values["shown"])[own_rows, own_columns]
                # A tile at the map's edge has no neighbour to fade into.
                for k, name in enumerate(("height", "sigma", "score")):
                    sums[k][at] += (
                        np.nan_to_num(
                            values[name][own_rows, own_columns].astype(np.float32) - (grid.height if k == 0 else 0)
                        )
                        * weight
                    )
                sums[(slice(3, 6), *at)] += values["colour"][own_rows, own_columns].transpose(2, 0, 1) * weight
                sums[6][at] += weight
                core = slice(MARGIN, tile.side - MARGIN)
                mine = np.zeros((tile.side, tile.side), bool)
                mine[core, core] = True
                mine = mine[own_rows, own_columns]
                for k, name in enumerate(("count", "main", "seen", "shown")):
                    single[k][at][mine] = values[name][own_rows, own_columns][mine]
        last = min(row + side, grid.rows) if row != rows[-1] else grid.rows
        step = max(1, STRIP_CELLS // grid.columns)
        for first in range(max(row, 0), last, step):
            own = slice(first - row, min(first + step, last) - row)
            yield _strip(first, sums[:, own], single[:, own], grid)
        sums[:, : high - side], single[:, : high - side] = sums[:, side:].copy(), single[:, side:].copy()
        sums[:, high - side :], single[:, high - side :] = 0, 0


def _strip(row: int, sums: np.ndarray, single: np.ndarray, grid: Grid) -> Strip:
    weight = sums[6]
    shown = (single[3] > 0) & (weight > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(shown, sums[:6] / weight, np.nan)
    mean[0] += grid.height
    return Strip(
        row, mean[0], mean[1], mean[2], mean[3:6], single[0].copy(), single[1] * shown, (single[2] > 0) & shown, shown
    )


def join(job: Job, out: Path, progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Write the files of a map from its tiles; returns what they hold, in numbers."""
    grid, unit = job.grid, job.grid.frame.unit_up
    names = json.dumps([*job.scene.names])
    rasters = {
        "orthophoto": Raster(out / ORTHOPHOTO, ("red", "green", "blue", "alpha"), "uint8", None),
        "views": Raster(out / VIEWS, ("photographs that see the cell",), "uint16", 0.0, average=False),
        "main": Raster(
            out / MAIN, ("photograph that contributes most",), "uint16", 0.0,
            tags={"PHOTOGRAPHS": names, "VALUES": "1 is the first of PHOTOGRAPHS"}, average=False,
        ),
        "dsm": _surface(out, unit),
        "sigma": _errors(out, unit),
        "agreement": Raster(out / AGREEMENT, ("mean correlation of the photographs, per cent",), "uint8", 255.0),
    }  # fmt: skip
    if job.fill:
        rasters["filled"] = Raster(out / FILLED, ("1 where the map is filled",), "uint8", 255.0, average=False)
    totals = {"cells": 0, "seen": 0, "views": []}
    with ExitStack() as stack:
        writers: dict[str, RasterWriter] = {
            name: stack.enter_context(raster_writer(raster, grid)) for name, raster in rasters.items()
        }
        for strip in strips(job, out):
            bytes_ = np.round(np.nan_to_num(strip.colour).clip(0, 1) * 255).astype(np.uint8)
            alpha = (strip.shown * np.uint8(255))[None]
            bands = {
                "orthophoto": np.concatenate([bytes_ * strip.shown, alpha]),
                "views": (strip.count * strip.shown)[None],
                "main": strip.main[None],
                "dsm": np.where(strip.shown, strip.height, NODATA)[None],
                "sigma": np.where(strip.shown, strip.sigma, NODATA)[None],
                "agreement": np.where(strip.seen, np.round(100 * np.nan_to_num(strip.score).clip(0, 1)), 255)[None],
                "filled": np.where(strip.shown, ~strip.seen, 255)[None],
            }
            for name, writer in writers.items():
                writer.write(strip.row, bands[name])
            totals["cells"] += int(strip.shown.sum())
            totals["seen"] += int(strip.seen.sum())
            totals["views"].append(strip.count[strip.seen][::97])
            progress(strip.row + strip.height.shape[0], grid.rows)
    views = np.concatenate(totals["views"])
    return {
        "cells": totals["cells"],
        "cells_seen": totals["seen"],
        "area": totals["seen"] * grid.cell**2,
        "views_median": float(np.median(views)) if len(views) else None,
    }


def _surface(out: Path, unit: str) -> Raster:
    return Raster(out / DSM, ("height of the surface",), unit=unit)


def _errors(out: Path, unit: str) -> Raster:
    return Raster(out / SIGMA, ("standard error of the height",), unit=unit)


def derive(job: Job, out: Path, progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Level the water of the surface, and write what follows: terrain, hillshades, classes, points and lines.

    Returns:
        Figures of them.
    """
    grid, unit = job.grid, job.grid.frame.unit_up
    water = read_water(out / DSM, out / AGREEMENT, out / ORTHOPHOTO, grid)
    tags = {"VALUES": "2 ground, 3 vegetation, 9 water"}
    classes = Raster(out / CLASSES, ("class",), "uint8", 0.0, tags=tags, average=False, style=CLASSES_OF_GROUND)
    write_classes(classes, out / DSM, out / ORTHOPHOTO, water, grid)
    write_masks(out / CLASSES, out / AGREEMENT, water, grid, out / MASKS)
    if lost := lost_in_geojson(grid.frame):
        log.warning(lost)
    progress(1, 6)
    level_water(_surface(out, unit), _errors(out, unit), out / CLASSES, water, grid)
    progress(2, 6)
    write_terrain(out / DSM, out / SIGMA, Raster(out / DTM, ("height of the ground",), unit=unit), grid)
    for heights, shaded in ((DSM, DSM_HILLSHADE), (DTM, DTM_HILLSHADE)):
        write_hillshade(out / heights, Raster(out / shaded, ("hillshade",), "uint8", 0.0), grid)
    progress(3, 6)
    points, found = write_cloud(out, grid)
    progress(4, 6)
    height, coarse = read_reduced(out / DTM, grid)
    interval = job.interval or interval_of(height, grid.frame.metre_up)
    lines = contours(height, coarse, interval)
    write_contours(lines, grid.frame, out / CONTOURS)
    progress(5, 6)
    if job.sections:
        write_sections(cut(job.sections, out / DSM, out / SIGMA, grid), out / SECTIONS, grid.frame.unit, unit)
    progress(6, 6)
    return {
        **_typical_errors(out),
        "points": points,
        "classes": found,
        "water": [_described(body) for body in water[1]],
        "contours": {"interval": interval, "lines": len(lines)},
        "sections": len(job.sections),
    }


def _typical_errors(out: Path) -> dict[str, float]:
    """Median and 95th percentile of the standard errors, of a part of the cells that two photographs see."""
    parts = zip(blocks(out / SIGMA), blocks(out / VIEWS), strict=True)
    sigma = np.concatenate([error[views >= FEWEST_VIEWS][::97] for (_, _, error), (_, _, views) in parts])
    return {"sigma_median": float(np.median(sigma)), "sigma_95": float(np.percentile(sigma, 95))}


def _described(body: Body) -> dict[str, float]:
    return {"height": body.level, "sigma": body.sigma, "area": body.area}


def write_cloud(out: Path, grid: Grid) -> tuple[int, dict[str, float]]:
    """Write a point of each cell that two photographs see; returns their number, and the share of each class."""
    bands = [(ORTHOPHOTO, 1), (ORTHOPHOTO, 2), (ORTHOPHOTO, 3), (DSM, 1), (SIGMA, 1), (VIEWS, 1), (CLASSES, 1)]
    number = {GROUND: 0, VEGETATION: 0, WATER: 0}
    with cloud_writer(out / CLOUD, grid) as cloud:
        for rows in zip(*(blocks(out / name, 0, band) for name, band in bands), strict=True):
            red, green, blue, height, sigma, views, classes = (np.nan_to_num(part[2], nan=-1) for part in rows)
            seen = (views >= FEWEST_VIEWS) & (classes > 0)
            colour = np.stack([red, green, blue]).clip(0).astype(np.uint8)
            height = np.where(seen, height, np.nan)
            for first in range(0, len(height), CLOUD_ROWS):  # a point takes ten times a cell's memory
                part = slice(first, first + CLOUD_ROWS)
                row = rows[0][0] + first
                cloud.write(row, height[part], sigma[part], colour[:, part], views[part].clip(0), classes[part].clip(0))
            for value in number:
                number[value] += int((seen & (classes == value)).sum())
    names = {"ground": GROUND, "vegetation": VEGETATION, "water": WATER}
    return cloud.count, {name: number[value] / max(cloud.count, 1) for name, value in names.items()}


def make_tiles(job: Job, out: Path, overwrite: bool, bar: Callable[[str], Any], makes: MakesTiles) -> None:
    """Begin or continue a map in a folder, and make its tiles. They take hours; all that follows takes minutes.

    Args:
        job: what to make.
        out: the folder.
        overwrite: begin again where the folder holds another map.
        bar: returns a progress bar of a name, a context manager.
        makes: the tiles.

    Raises:
        RunError: the folder holds something else, cannot be written to, or lacks tiles that were made.
    """
    begin(out, job.key, overwrite)
    started, record = time.monotonic(), read_json(out / MAP_FILE) or {}
    try:
        with bar("Mapping") as meter:
            make_missing(job, out, meter, makes)
    finally:
        seconds = record.get("seconds", 0.0) + time.monotonic() - started
        write_json(out / MAP_FILE, {**record, "seconds": seconds})


def finish_map(job: Job, out: Path, record: dict[str, Any], bar: Callable[[str], Any]) -> dict[str, Any]:
    """Make the files of a map from its tiles. The method that rendered these may be forgotten before, for its memory.

    Args:
        job: what to make.
        out: the folder.
        record: stored in map.json.
        bar: returns a progress bar of a name, a context manager.

    Raises:
        RunError: the folder cannot be written to, or no two photographs see any of the area.
    """
    started, before = time.monotonic(), (read_json(out / MAP_FILE) or {}).get("seconds", 0.0)
    release_memory()
    cell_bytes = 20  # of a cell in all rasters that are written at once
    with need("rasterio").Env(GDAL_CACHEMAX=GDAL_CACHE_BYTES + BLOCK * job.grid.columns * cell_bytes):
        with bar("Writing") as meter:
            found = join(job, out, meter)
        if not found["cells_seen"]:
            raise RunError("no two photographs see any of the area: expected some overlap there; choose another area")
        with bar("Terrain") as meter:
            found |= derive(job, out, meter)
    grid = job.grid
    if job.check_points:
        found["check_points"] = summary(check(job.check_points, job.scene, grid, out / DSM, out / SIGMA))
    result = {
        **record,
        "key": job.key,
        "complete": True,
        "seconds": before + time.monotonic() - started,
        "coordinates": {
            "name": grid.frame.name, "wkt": grid.frame.wkt, "heights": grid.frame.heights, "unit": grid.frame.unit,
            "unit_up": grid.frame.unit_up,
        },
        "grid": {
            "west": grid.west, "north": grid.north, "cell": grid.cell, "columns": grid.columns, "rows": grid.rows,
        },
        **found,
    }  # fmt: skip
    shown = {
        "orthophoto": ORTHOPHOTO, "surface": DSM, "hillshade": DSM_HILLSHADE, "sigma": SIGMA, "views": VIEWS,
        "classes": CLASSES,
    }  # fmt: skip
    write_report(result, out, shown, job.fill)
    write_json(out / MAP_FILE, result)
    return result


def begin(out: Path, key: str, overwrite: bool) -> None:
    """Begin or continue a map in a folder, without what an earlier one left there.

    Raises:
        RunError: the folder holds a finished map, another one, or something else, or cannot be written to.
    """
    there = read_json(out / MAP_FILE) if out.is_dir() else None
    if there is None and out.is_dir() and any(path.name != ".lock" for path in out.iterdir()):
        raise RunError(f"{out} holds something else: expected a new folder, or one of `tidefield map`; choose another")
    other = there is None or there.get("key") != key or bool(there.get("complete"))
    if there is not None and other and not overwrite:
        if there.get("key") != key:
            raise RunError(
                f"{out} holds a map of another scene or with other options: expected a new folder; choose one, or pass "
                "--overwrite"
            )
        raise RunError(f"{out} holds this map already: expected a new folder; choose one, or pass --overwrite")
    if other:
        delete_tiles(out)
        write_json(out / MAP_FILE, {"key": key, "complete": False})
    delete_partials(*(out / name for name in (*PRODUCTS, MAP_FILE)))
    # What an earlier map has and this one lacks, such as FILLED, would be taken for this one's.
    delete_files(out, [out / name for name in PRODUCTS])


def delete_tiles(out: Path) -> None:
    """Delete the tiles of a map, which only an interrupted map needs."""
    for path in (out / TILES).glob("*.npz"):
        path.unlink()
    if (out / TILES).is_dir():
        with suppress(OSError):  # other programs keep notes in folders
            (out / TILES).rmdir()
