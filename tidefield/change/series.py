"""Volumes of more than two dates over time: each step, and each date since the first.

Steps add up to the change since the first date but for their errors: surveys are compared anew for both, so the
difference of the two (`closure`) shows what co-registration and different common ground leave.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from markupsafe import Markup

from tidefield.change.measure import Change
from tidefield.change.page import cubic
from tidefield.change.volumes import Volume
from tidefield.change.write import write_csv
from tidefield.files import write_json, write_text
from tidefield.maps.figures import RULE, SOFT, figure_of, png
from tidefield.maps.styles import HIGHER, INK, LOWER
from tidefield.pages import template_environment

_MOST_PLOTS = 12
_SAME_GROUND = 0.99
"""Areas of comparisons that are alike to this share are taken to be of the same ground."""
Since = Literal["step", "first"]


@dataclass(frozen=True)
class Entry:
    """A volume between two dates.

    Attributes:
        since: "step" from the date before, "first" from the first date.
        start, end: numbers of the surveys, from 0.
        region: "all", or the name of one of the user's polygons.
        what: net, cut or fill.
        compared: share of the polygon where both surveys have heights; None for all ground.
    """

    since: Since
    start: int
    end: int
    region: str
    what: str
    volume: Volume
    compared: float | None = None


def entries_of(change: Change, since: Since, start: int, end: int) -> list[Entry]:
    """The volumes of one comparison."""
    found = [("all", {"net": change.net, "cut": change.cut, "fill": change.fill}, None)]
    found += [(one.region.name, one.volumes, one.compared) for one in change.per_region]
    return [
        Entry(since, start, end, region, what, volume, compared)
        for region, volumes, compared in found
        for what, volume in volumes.items()
    ]


def series_rows(entries: Sequence[Entry], names: Sequence[str]) -> list[dict[str, Any]]:
    """A row for each volume."""
    return [
        {
            "region": entry.region,
            "volume": entry.what,
            "since": entry.since,
            "earlier": names[entry.start],
            "later": names[entry.end],
            **entry.volume.to_json(),
            "compared": entry.compared,
        }
        for entry in entries
    ]


def closure(entries: Sequence[Entry], region: str) -> list[dict[str, Any]]:
    """Net volumes since the first date beside the sums of the steps until then."""
    net = [entry for entry in entries if entry.region == region and entry.what == "net"]
    steps = {entry.end: entry.volume.value_m3 for entry in net if entry.since == "step"}
    first = {entry.end: entry.volume.value_m3 for entry in net if entry.since == "first"}
    found = []
    for end in sorted(first):
        if all(k in steps for k in range(1, end + 1)):
            total = sum(steps[k] for k in range(1, end + 1))
            found.append({"end": end, "since_first_m3": first[end], "steps_m3": total})
    return found


def areas_m2(entries: Sequence[Entry], region: str) -> tuple[float, float] | None:
    """Area of the ground that comparisons have in common at least, and at most; None where it is the same for all."""
    areas = [entry.volume.area_m2 for entry in entries if entry.region == region and entry.what == "net"]
    return None if min(areas) > _SAME_GROUND * max(areas) else (min(areas), max(areas))


def write_series(
    entries: Sequence[Entry],
    remarks: Mapping[tuple[int, int], Sequence[str]],
    names: Sequence[str],
    folder: Path,
    command: str,
) -> dict[str, Any]:
    """Write series.csv, series.json and series.html.

    Args:
        remarks: of each comparison, by the numbers of its surveys.
    """
    rows = series_rows(entries, names)
    remarked: dict[str, list[str]] = {}
    for (start, end), texts in remarks.items():
        for remark in texts:
            remarked.setdefault(remark, []).append(f"{names[start]} to {names[end]}")
    write_csv(folder / "series.csv", rows)
    regions = list(dict.fromkeys(entry.region for entry in entries))
    uneven = {region: areas for region in regions if (areas := areas_m2(entries, region))}
    numbers = {
        "command": command,
        "surveys": list(names),
        "volumes": rows,
        "closure": {region: closure(entries, region) for region in regions},
        "different_ground_m2": uneven,
        "remarks": remarked,
    }
    write_json(folder / "series.json", numbers)
    environment = template_environment("tidefield.change")
    environment.filters["cubic"] = cubic
    shown = regions[:_MOST_PLOTS]
    html = environment.get_template("series.html").render(
        names=names,
        remarks=remarked,
        comparisons=len(remarks),
        regions=[(name, draw_series(entries, names, name), _table(entries, name), uneven.get(name)) for name in shown],
        more=len(regions) - len(shown),
        steps=[(k, names[k - 1], names[k]) for k in range(1, len(names))],
        closure=closure(entries, "all"),
        command=command,
    )
    write_text(folder / "series.html", html)
    return numbers


def _table(entries: Sequence[Entry], region: str) -> list[dict[str, Any]]:
    """A row of net, cut and fill for each comparison."""
    rows: dict[tuple[str, int, int], dict[str, Any]] = {}
    for entry in entries:
        if entry.region == region:
            key = (entry.since, entry.start, entry.end)
            about = {"since": entry.since, "start": entry.start, "end": entry.end, "compared": entry.compared}
            row = rows.setdefault(key, about)
            row[entry.what] = entry.volume
    return list(rows.values())


def places(names: Sequence[str]) -> tuple[list[float], bool]:
    """Positions of the surveys along an axis: days since the first where all names are dates, else their numbers."""
    try:
        days = [float(date.fromisoformat(name).toordinal()) for name in names]
    except ValueError:
        return [float(k) for k in range(len(names))], False
    return [day - days[0] for day in days], True


def draw_series(entries: Sequence[Entry], names: Sequence[str], region: str) -> Markup:
    """Net volume since the first date with its interval, and cut and fill of each step."""
    at, dated = places(names)
    figure = figure_of(7.6, 3.6)
    above, below = figure.subplots(2, 1, sharex=True)
    figure.subplots_adjust(left=0.12, right=0.98, top=0.97, bottom=0.16, hspace=0.12)
    mine = [entry for entry in entries if entry.region == region]
    since = sorted((e for e in mine if e.since == "first" and e.what == "net"), key=lambda e: e.end)
    x = np.array([at[0], *(at[e.end] for e in since)])
    value = np.array([0.0, *(e.volume.value_m3 for e in since)])
    low = np.array([0.0, *(e.volume.interval_m3[0] for e in since)])
    high = np.array([0.0, *(e.volume.interval_m3[1] for e in since)])
    above.axhline(0, color=RULE, linewidth=0.8)
    above.errorbar(x, value, yerr=np.stack([value - low, high - value]), color=INK, marker="o", markersize=4, capsize=3)
    above.set_ylabel("net since the\nfirst date (m³)")
    below.axhline(0, color=RULE, linewidth=0.8)
    width = 0.3 * min(np.diff(at), default=1.0)
    for what, sign, colour in (("cut", -1, LOWER), ("fill", 1, HIGHER)):
        for entry in mine:
            if entry.since == "step" and entry.what == what and entry.volume.area_m2 > 0:
                middle = (at[entry.start] + at[entry.end]) / 2
                ends = sorted(sign * end for end in entry.volume.interval_m3)
                height = sign * entry.volume.value_m3
                below.bar(middle, height, width, color=colour, alpha=0.75)
                below.vlines(middle, *ends, color=INK, linewidth=1)
    below.set_ylabel("cut and fill\nof each step (m³)")
    below.set_xticks(at, names, rotation=20 if len(names) > 4 else 0, ha="right" if len(names) > 4 else "center")
    below.tick_params(axis="x", labelsize=8)
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
        axes.yaxis.label.set_color(SOFT)
    scale = "by days" if dated else "in their order"
    return png(figure, f"Volumes over time, {region}: net since the first date, cut and fill of each step ({scale})")


def in_order(dates: Sequence[str | None]) -> bool:
    """Whether known dates do not go backwards."""
    known = [value for value in dates if value]
    return all(one <= other for one, other in pairwise(known))
