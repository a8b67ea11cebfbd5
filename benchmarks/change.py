"""Measure `tidefield change`: against published figures, on pairs of known change, and its memory and time."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from benchmarks.change_pairs import measure_pairs, summarise
from benchmarks.records import MEASURED, say
from tidefield.change.errors import anderson_terms
from tidefield.change.m3c2 import m3c2
from tidefield.change.measure import measure
from tidefield.change.regions import Region, read_regions
from tidefield.change.statistics import nmad
from tidefield.change.surfaces import ChangeError, Grid, common_grid, open_surface
from tidefield.compare.tables import NOTHING, Table
from tidefield.files import read_json, write_json, write_text
from tidefield.machine import describe

CHANGE_FILE = "change.json"
FIRST_SEED = 100
"""The rules of outlines and intervals were chosen on pairs 0 to 19; others are measured."""
AMOUNTS_M = (0.0, 0.05, -0.05, 0.1, -0.1, 0.2, -0.2)
FOUND_AMOUNTS_M = (0.0, 0.1, -0.1)
"""With stable ground that is found instead of given."""
VOLUMES = ("net", "cut", "fill")
INTRODUCTION = """# Change: what was measured

`python -m benchmarks change --data DATA` measures this, and writes the page. The rules of outlines and intervals were
chosen on other pairs of built-in surveys than those that are measured here. Stable ground that is given is a frame
around the flat without what changed there.

`change_cover`, `change_chain`, `change_null` and `change_size` of the same program measure plants and waterlines, the
whole chain from photographs, two flights between which nothing changed, and a large survey. False alarms of the two
flights are counted on squares of dry ground that nothing was measured on."""
LEO = ("20180606", "20180713", "20180920", "20190211", "20190328", "20190731")
SANDPYPER_NMAD = (0.101219, 0.111155, 0.071532, 0.111180, 0.098167)
"""Of St Leonards' five steps (npucino/sandpyper, tests and notebook 3)."""
SANDPYPER_NET_M3 = (-228.33, 219.21, 146.64, 9.60, -421.58)
"""Of sand along transects, from the same notebook."""


def _dsm(folder: Path, date: str) -> Path:
    return folder / "st_leonards" / "dsm" / f"leo_{date}_dsm_resampled_1m.tif"


def published(folder: Path) -> dict[str, Any]:
    """Figures of others, and ours beside them.

    Args:
        folder: with bmx and st_leonards, as `shared/data/change` has them.

    Raises:
        ChangeError: they are not there.
    """
    for name in ("bmx", "st_leonards"):
        if not (folder / name).is_dir():
            raise ChangeError(f"{folder / name} is not there: expected the folder with bmx and st_leonards; name it")
    random, correlated, systematic = anderson_terms(
        682_640, 0.25, 0.11584754, 2.3546, math.sqrt(0.0071469), 0.104254974
    )
    return {
        "anderson_m3": [1.96 * random, 1.96 * correlated, systematic],
        "m3c2": _bmx(folder / "bmx"),
        "st_leonards": _st_leonards(folder),
    }


def _bmx(folder: Path) -> dict[str, float]:
    """Largest differences from CloudCompare's table."""
    import laspy

    table = np.genfromtxt(folder / "autzen-bmx-cc.txt", delimiter=",", names=True)
    assert table.dtype.names is not None
    columns = [np.asarray(table[name]) for name in table.dtype.names]
    cores, normals = np.stack(columns[:3], axis=1), np.stack(columns[-3:], axis=1)
    early, late = (np.asarray(laspy.read(folder / f"autzen-bmx-{y}.las").xyz, np.float64) for y in (2010, 2023))
    found = m3c2(early, late, cores, normals, 2.890432, 5.5)
    counts = np.stack([table["Npoints_cloud1"], table["Npoints_cloud2"]], axis=1)
    return {
        "core_points": len(cores),
        "equal_counts": int((found.counts == counts).all(axis=1).sum()),
        "distance_m": float(np.nanmax(np.abs(found.distance_m - table["M3C2_distance"]))),
        "detection_m": float(np.nanmax(np.abs(found.detection_m - table["distance_uncertainty"]))),
    }


def _beach(folder: Path, grid: Grid, dates: tuple[str, str]) -> list[Region]:
    """The beach without what was water at either date."""
    from pyogrio import raw

    vector = folder / "st_leonards" / "vector"
    beach = next(region for region in read_regions(vector / "shoremasks.gpkg", grid) if region.name == "leo").geometry
    meta, _, _, columns = raw.read(vector / "watermasks.gpkg")
    fields = dict(zip(meta["fields"].tolist(), columns, strict=True))
    water = read_regions(vector / "watermasks.gpkg", grid)
    wet = [
        region.geometry
        for region, place, date in zip(water, fields["location"], fields["raw_date"], strict=True)
        if place == "leo" and str(date) in dates
    ]
    return [Region("beach", beach.difference(shapely.union_all(wet)))]


def _st_leonards(folder: Path) -> list[dict[str, Any]]:
    """Five steps: deviations of stable ground by sandpyper's pixels and by ours, and volumes."""
    import rasterio

    lines = folder / "st_leonards" / "vector" / "leo_lod_transects.gpkg"
    grid = common_grid([open_surface(_dsm(folder, LEO[0]))])
    regions = read_regions(lines, grid)
    points = np.array(
        [
            shapely.get_coordinates(region.geometry.interpolate(s))[0]
            for region in regions
            for s in range(int(region.geometry.length))
        ]
    )

    def heights(date: str, whole: bool) -> np.ndarray:
        """Heights at the points: of the pixel whose corner is nearest (theirs), or of the one the point is in."""
        with rasterio.open(_dsm(folder, date)) as file:
            values, transform = file.read(1), file.transform
        column, row = ((points - [transform.c, transform.f]) / [transform.a, transform.e]).T
        column, row = ((np.round if whole else np.floor)(x).astype(int) for x in (column, row))
        inside = (column >= 0) & (row >= 0) & (column < values.shape[1]) & (row < values.shape[0])
        found = np.full(len(points), np.nan)
        found[inside] = values[row[inside], column[inside]]
        found[found < -9000] = np.nan
        return found

    steps = []
    for k, (one, other) in enumerate(pairwise(LEO)):
        dh = [heights(other, whole) - heights(one, whole) for whole in (True, False)]
        dh = [values[np.isfinite(values)] for values in dh]
        change = measure(
            open_surface(_dsm(folder, one)),
            open_surface(_dsm(folder, other)),
            stable=lambda grid: read_regions(lines, grid),
            within=lambda grid, dates=(one, other): _beach(folder, grid, dates),
        )
        steps.append(
            {
                "earlier": one,
                "later": other,
                "published_nmad_m": SANDPYPER_NMAD[k],
                "nmad_with_their_pixels_m": nmad(dh[0]),
                "nmad_m": nmad(dh[1]),
                "median_m": float(np.median(dh[1])),
                "points": len(dh[1]),
                "sum_abs_dh_with_their_pixels_m": float(np.abs(dh[0]).sum()),
                "published_net_m3": SANDPYPER_NET_M3[k],
                "detection_m": change.detection_m[1],
                "shift_m": change.errors.registration.vertical_m,
                **{what: getattr(change, what).to_json() for what in ("net", "cut", "fill")},
            }
        )
    return steps


def store(runs: Path, part: str, found: Any) -> None:
    """Keep what was measured of one part in RUNS/change.json."""
    record: dict[str, Any] = read_json(runs / CHANGE_FILE) or {}
    write_json(runs / CHANGE_FILE, {**record, part: {"found": found, **describe()}})


def change(
    data: Path | None = None,
    pairs: int = 20,
    runs: Path = MEASURED,
    out: Path = Path("docs/change-results.md"),
) -> None:
    """Measure what was published and built-in pairs, store each as it is done, and write the page.

    Args:
        data: Folder with bmx and st_leonards; without it, their figures stay as they are stored.
        pairs: Of built-in surveys for each amount of change; 0 leaves their figures as they are stored.
        runs: Store the figures in this folder's change.json.
        out: The Markdown file to write; replaced if it is there.
    """
    if data is not None:
        say("published figures")
        store(runs, "published", published(data))
    if pairs:
        say(f"{pairs} pairs of built-in surveys for each amount of change")
        seeds = range(FIRST_SEED, FIRST_SEED + pairs)
        measured = measure_pairs(seeds, AMOUNTS_M, given=True) + measure_pairs(seeds, FOUND_AMOUNTS_M, given=False)
        kept = ("change_m", "stable_ground")
        store(runs, "pairs", [{key: found[key] for key in kept} | summarise(found) for found in measured])
    write_page(runs, out)
    say(out)


def _published_tables(found: dict[str, Any]) -> list[Table]:
    random, correlated, systematic = found["anderson_m3"]
    m3c2_, steps = found["m3c2"], found["st_leonards"]
    compared = [
        ["random error (95%)", "11.725 m³", f"{random:.3f} m³"],
        ["correlated error (95%)", "63.664 m³", f"{correlated:.3f} m³"],
        ["systematic error", "4,448.04 m³", f"{systematic:,.2f} m³"],
    ]
    clouds = [
        ["core points with equal counts", f"{m3c2_['equal_counts']} of {m3c2_['core_points']}"],
        ["largest difference of a distance", f"{1000 * m3c2_['distance_m']:.2f} mm"],
        ["largest difference of a level of detection", f"{1000 * m3c2_['detection_m']:.2f} mm"],
    ]
    stable = [
        [
            _step(s),
            f"{s['published_nmad_m']:.6f}",
            f"{s['nmad_with_their_pixels_m']:.6f}",
            f"{s['sum_abs_dh_with_their_pixels_m']:.4f}",
            f"{s['nmad_m']:.3f}",
            f"{s['median_m']:+.3f}",
            f"{s['points']}",
        ]
        for s in steps
    ]
    volumes = [
        [
            _step(s),
            f"{s['published_net_m3']:+.0f}",
            *(_volume(s[w]) for w in VOLUMES),
            f"{s['net']['area_m2']:,.0f}",
            f"{s['detection_m']:.2f}",
        ]
        for s in steps
    ]
    return [
        Table("Anderson's terms, from the inputs of the U.S. Geological Survey", ["", "published", "ours"], compared),
        Table("M3C2 against CloudCompare's table", ["", ""], clouds),
        Table(
            "St Leonards: stable ground (m)",
            [
                "step",
                "NMAD, published",
                "with their pixels",
                "sum of absolute dz, likewise",
                "NMAD",
                "median",
                "points",
            ],
            stable,
        ),
        Table(
            "St Leonards: volumes of the beach (m³, with 95% intervals)",
            ["step", "net of sand on transects, published", "net", "cut", "fill", "area (m²)", "detected from (m)"],
            volumes,
        ),
    ]


def _pairs_tables(pairs: list[dict[str, Any]]) -> list[Table]:
    rows = []
    for of in pairs:
        n, nothing = of["pairs"], of["change_m"] == 0
        rows.append(
            [
                ("none" if nothing else f"{100 * of['change_m']:+.0f} cm") + f", {of['stable_ground']}",
                f"{100 * of['false_alarms']:.1f}%",
                f"{100 * of['detection_m']:.1f} cm",
                NOTHING if nothing else f"{100 * of['detected']:.0f}%",
                NOTHING if nothing else f"{100 * of['outlined']:.0f}%",
                f"{1000 * (of['bias_m'] if nothing else of['bias_where_changed_m']):+.1f} mm",
                *(f"{of[key]} of {n}" for key in ("net", "cut_inside", "fill_inside", "cut", "fill")),
            ]
        )
    header = ["change, stable ground", "false alarms", "detected from", "cells found", "outlined", "bias where changed"]
    header += ["net", "cut in outlines", "fill in outlines", "all cut", "all fill"]
    return [Table("Pairs of built-in surveys: 95% intervals that contain the truth", header, rows)]


def _cover_tables(pairs: list[dict[str, Any]]) -> list[Table]:
    """Plants and waterlines of built-in pairs."""
    plants, water = [], []
    for of in pairs:
        name = f"{of['category']} {of['seed']}"
        cells = []
        for what in ("earlier", "later", "gained", "lost"):
            area = of["cover"][what]
            cells.append(f"{_area(area)}; {area['true_m2']:.0f}")
        plants.append([name, *cells])
        line = of["water"]
        move, low, high = line["move_m"]
        water.append(
            [
                name,
                f"{_area(line['land_gained'])}; {line['true_gained_m2']:.0f}",
                f"{_area(line['land_lost'])}; {line['true_lost_m2']:.0f}",
                f"{move:+.2f} ({low:+.2f} to {high:+.2f})",
            ]
        )
    return [
        Table(
            "Plants of built-in pairs (m²; found and its range; true: what plants higher than 3 cm cover, seen from "
            "above, with the gaps between them closed by a window of 0.4 m)",
            ["pair", "earlier", "later", "gained", "lost"],
            plants,
        ),
        Table(
            "Waterlines of built-in pairs after the tide fell 10 cm (m² found and 95% interval; true)",
            ["pair", "fell dry", "came under water", "mean move seaward (m)"],
            water,
        ),
    ]


def _chain_tables(found: dict[str, Any]) -> list[Table]:
    """The whole chain, step by step."""
    surveys, changes = [], []
    for name, step in found["steps"].items():
        if "placed" in step:
            surveys.append(
                [
                    name,
                    f"{step['placed']} of {found['photographs']}",
                    f"{100 * step['positions_horizontal_rms_m']:.1f}",
                    f"{100 * step['positions_vertical_rms_m']:.1f}",
                    f"{100 * step['median_m']:+.1f}",
                    f"{100 * step['nmad_m']:.1f}",
                    f"{100 * step['within_95']:.0f}%",
                ]
            )
            continue
        cells = []
        for what in VOLUMES:
            volume = step[what]
            truth = volume["true_m3"] if what == "net" else volume["true_inside_m3"]
            cells.append(
                f"{volume['value_m3']:+.1f} ({volume['low_m3']:+.1f} to {volume['high_m3']:+.1f}); {truth:+.1f}"
            )
        changes.append(
            [
                name.removeprefix("change, "),
                f"{100 * step['shift_m']:+.1f}",
                f"{100 * step['false_alarms']:.1f}%",
                f"{100 * step['detection_m']:.1f}",
                f"{100 * step['detected']:.0f}%",
                f"{100 * step['outlined']:.0f}%",
                f"{100 * step['bias_where_changed_m']:+.1f}",
                *cells,
            ]
        )
    about = (
        f"{found['photographs']} photographs of {found['width_px']} px at each date, {100 * found['change_m']:.0f} cm"
    )
    return [
        Table(
            f"The whole chain: surveys ({about})",
            [
                "survey",
                "photographs placed",
                "positions, horizontal RMS (cm)",
                "vertical RMS (cm)",
                "heights of bare ground, median error (cm)",
                "NMAD (cm)",
                "within 1.96 of their standard errors",
            ],
            surveys,
        ),
        Table(
            "The whole chain: change of bare ground (m³ found, 95% interval; true)",
            [
                "",
                "shift taken off (cm)",
                "false alarms",
                "detected from (cm)",
                "cells found",
                "outlined",
                "bias where changed (cm)",
                *VOLUMES,
            ],
            changes,
        ),
    ]


def _null_tables(found: dict[str, Any]) -> list[Table]:
    """Two flights over the same ground."""
    rows = []
    for model in ("vertical", "tilt"):
        of = found[model]
        rows.append(
            [
                model,
                f"{100 * of['significant_share_of_other_half']:.1f}%",
                f"{100 * of['detection_m'][1]:.1f}",
                f"{100 * of['before'][0]:+.1f}",
                f"{100 * of['after'][1]:.1f}",
                _volume(of["net"]),
                _volume(of["other_net"]),
                f"{100 * of['outlined_share']:.1f}%",
            ]
        )
    return [
        Table(
            f"Nothing changed: swindale's first and third flights, {found['dry_m2']:,.0f} m² of dry ground",
            [
                "co-registration",
                "significant cells of the other half",
                "detected from (cm)",
                "median before (cm)",
                "NMAD after (cm)",
                "net (m³)",
                "net of the other half (m³)",
                "outlined",
            ],
            rows,
        )
    ]


def _size_tables(found: dict[str, Any]) -> list[Table]:
    rows = [
        ["time", f"{found['seconds'] / 60:.1f} minutes"],
        ["time of the processor", f"{found['processor_seconds'] / 60:.1f} minutes on {found['cores']} cores"],
        ["peak memory", f"{found['peak_memory_bytes'] / 1e9:.2f} GB"],
        ["files written", f"{found['written_bytes'] / 1e9:.2f} GB"],
    ]
    return [Table(f"`tidefield change` on {found['million_cells']:.0f} million cells", ["", ""], rows)]


def _area(area: dict[str, float]) -> str:
    return f"{area['value_m2']:.0f} ({area['low_m2']:.0f} to {area['high_m2']:.0f})"


def _volume(volume: dict[str, Any]) -> str:
    if volume["area_m2"] == 0:
        return "none outlined"
    return f"{volume['value_m3']:+.0f} ({volume['low_m3']:+.0f} to {volume['high_m3']:+.0f})"


def _step(step: dict[str, Any]) -> str:
    return " to ".join(f"{d[:4]}-{d[4:6]}-{d[6:]}" for d in (step["earlier"], step["later"]))


PARTS: dict[str, Callable[[Any], list[Table]]] = {
    "published": _published_tables,
    "pairs": _pairs_tables,
    "cover": _cover_tables,
    "chain": _chain_tables,
    "null": _null_tables,
    "size": _size_tables,
}
"""What is measured, in the order of the page."""


def write_page(runs: Path, out: Path) -> None:
    """Write the page from what is stored.

    Raises:
        ChangeError: nothing is, or only as earlier versions stored it.
    """
    record = read_json(runs / CHANGE_FILE)
    if record is None:
        raise ChangeError(
            f"{runs / CHANGE_FILE} is not there: expected figures; run `python -m benchmarks change` first"
        )
    former = [part for part in PARTS if part in record and "found" not in record[part]]
    if former:
        raise ChangeError(
            f"{runs / CHANGE_FILE} has {', '.join(former)} as earlier versions stored it: expected each part with its "
            "own date; measure again what is named, or take it out of the file"
        )
    parts = [INTRODUCTION]
    for part, tables in PARTS.items():
        if part in record:
            own = record[part]
            parts += [table.markdown() for table in tables(own["found"])]
            parts.append(f"Measured on {own['date']}, version {own['version']}, on {own['machine']['processor']}.")
    write_text(out, "\n\n".join(parts) + "\n")
