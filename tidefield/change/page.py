"""Write change.html: what changed in three sentences, maps, sections, and where the errors come from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tidefield.change.cover import Area, Cover
from tidefield.change.figures import (
    draw_change,
    draw_cover,
    draw_section,
    draw_stable,
    draw_stable_histogram,
    draw_variogram,
    draw_waterlines,
    thinned,
)
from tidefield.change.kinds import View
from tidefield.change.measure import Change
from tidefield.change.pictures import difference, jpeg, side_by_side
from tidefield.change.statistics import colour_limit
from tidefield.change.volumes import Volume
from tidefield.change.water import Water
from tidefield.change.write import outline_rows
from tidefield.files import write_text
from tidefield.maps.styles import HIGHER, LOWER
from tidefield.pages import template_environment

MINUS = "\u2212"
_SHOWN_OUTLINES = 12
_SECTIONS = 2
_SHOWN_VIEWS = 4


def write_page(
    change: Change,
    numbers: dict[str, Any],
    path: Path,
    cover: Cover | None = None,
    water: Water | None = None,
    views: Sequence[View] = (),
) -> None:
    """Write the page, which needs no other file."""
    environment = template_environment("tidefield.change")
    environment.filters |= {
        "metres": lambda value, digits=3: number(value, digits),
        "signed": lambda value, digits=3: signed(value, digits),
        "cubic": cubic,
        "percent": lambda value: f"{100 * value:.1f}%",
    }
    small = thinned(change)
    limit = colour_limit(np.abs(small.dz[np.isfinite(small.dz)]), change.detection_m[1])
    earlier, later = change.earlier.name, change.later.name
    named = f"between {earlier} and {later}"
    rows = outline_rows(change)
    html = environment.get_template("change.html").render(
        n=numbers,
        title=f"Change {named}",
        sentences=sentences(change),
        change_map=draw_change(small, limit, f"Map of the change of height {named}; red is lower, blue is higher"),
        stable_map=draw_stable(small, "Map of the stable ground"),
        histogram=draw_stable_histogram(change, "Histogram of dz over stable ground before and after co-registration"),
        variogram=draw_variogram(change, "Variogram of dz over stable ground, and its model"),
        sections=[
            (row, draw_section(change, row, f"Section from west to east, {_from_north(change, row)}"))
            for row in section_rows(change)
        ],
        from_north=lambda row: _from_north(change, row),
        volumes=[("Net", change.net), ("Cut", change.cut), ("Fill", change.fill), ("Net outside", change.outside)],
        outlines=rows[:_SHOWN_OUTLINES],
        more=len(rows) - _SHOWN_OUTLINES,
        colours={"lower": LOWER, "higher": HIGHER},
        regions=change.per_region,
        limits=limits(change, cover if change.water is None and (water is None or water.waterline is None) else None),
        cover=cover,
        views=[
            (view.name, jpeg(side_by_side(view, (earlier, later))), jpeg(difference(view)))
            for view in views[:_SHOWN_VIEWS]
        ],
        cover_map=None if cover is None else draw_cover(cover, small, f"Map of plants gained and lost {named}"),
        cover_words=cover_words(cover),
        water_words=water_words(water),
        water_map=None
        if water is None or water.waterline is None
        else draw_waterlines(water.waterline, small, (earlier, later), f"Map of the waterlines {named}"),
    )
    write_text(path, html)


def sentences(change: Change) -> list[str]:
    """What changed, in three sentences."""
    earlier, later = change.earlier.name, change.later.name
    net, gained = change.net, change.net.value_m3 > 0
    verb = ("gained" if gained else "lost") if net.significant else "changed by"
    first = (
        f"Between {earlier} and {later} the ground {verb} {_amount(net, net.significant and not gained)} in all on "
        f"{cubic(net.area_m2)} m²"
    )
    first += "." if net.significant else ", which is not distinguishable from no change."
    parts = [
        f"{_amount(volume)} {word} on {cubic(volume.area_m2)} m²"
        for word, volume in (("were cut", change.cut), ("were filled", change.fill))
        if volume.area_m2 > 0
    ]
    second = "Nothing stands out from the errors: no ground is outlined."
    if parts:
        second = f"In the outlines {' and '.join(parts)}."
    third = (
        f"A single cell shows a change from {number(change.detection_m[1], 3)} m on; of the stable ground "
        f"{100 * change.false_alarms:.1f}% does, where 5% are expected."
    )
    return [first, second, third]


def _amount(volume: Volume, lost: bool = False) -> str:
    """A volume with its interval; of what was lost both have the sign of the loss."""
    sign = -1 if lost else 1
    low, high = sorted(sign * end for end in volume.interval_m3)
    return f"{cubic(sign * volume.value_m3)} m³ (95%: {cubic(low)} to {cubic(high)} m³)"


def cover_words(cover: Cover | None) -> list[str]:
    """Plants gained and lost, in a sentence."""
    if cover is None:
        return []
    area = {what: _area(found) for what, found in cover.areas["all"].items()}
    return [
        f"Plants covered {area['earlier']} of {cubic(cover.known_m2)} m² at the earlier date and {area['later']} at "
        f"the later one; {area['gained']} were gained, {area['lost']} lost."
    ]


def _area(found: Area) -> str:
    return f"{cubic(found.value_m2)} m² ({cubic(found.low_m2)} to {cubic(found.high_m2)})"


def water_words(water: Water | None) -> list[str]:
    """The waterline's move and areas below levels, in sentences."""
    if water is None:
        return []
    words = []
    line = water.waterline
    if line is not None:
        changed = f"{_area(line.land_gained)} fell dry, {_area(line.land_lost)} came under water."
        if all(line.lines):
            move, low, high = line.move_m
            words.append(
                f"The waterline moved {number(abs(move), 1)} m {'seaward' if move > 0 else 'landward'} on average "
                f"(95%, seaward: {number(low, 1)} to {number(high, 1)} m): {changed}"
            )
        else:
            words.append(f"There is no waterline at these heights of the water at both dates: {changed}")
    for below in water.below:
        words.append(
            f"Below {number(below.level_m, 2)} m lay {cubic(below.earlier_m2)} m², then {cubic(below.later_m2)} m²: "
            f"{cubic(below.change_m2)} m² (95%: {cubic(below.low_m2)} to {cubic(below.high_m2)})."
        )
    return words


def section_rows(change: Change) -> list[int]:
    """Rows of the grid through the largest cut and the largest fill."""
    rows: list[int] = []
    for sign in (-1, 1):
        mine = [(volume.value_m3, k) for k, volume, _ in change.each if change.outlines.signs[k - 1] == sign]
        if mine:
            box = change.outlines.boxes[max(mine)[1] - 1]
            rows.append((box[0].start + box[0].stop) // 2)
    if not rows:
        rows = [int(np.isfinite(change.dz).sum(axis=1).argmax())]
    return sorted(set(rows))[:_SECTIONS]


def _from_north(change: Change, row: int) -> str:
    return f"{(row + 0.5) * change.grid.cell_m:.0f} m south of the northern edge"


def limits(change: Change, cover: Cover | None = None) -> list[str]:
    """What the page does not tell; cover is that of a survey in which water was not left out."""
    found = [
        "Cut and fill are of the outlines. Narrow changes near the level of detection are in the net volume only.",
        f"{'Plants and water' if change.water is None else 'Plants'} are part of the surfaces: where they changed, the "
        "change is not of the ground.",
    ]
    if cover is not None:
        green = "Green water with waves" if cover.leaves_out_films else "Shallow water, which is green,"
        found.append(f"{green} counts as plants, unless the water's heights are given (--water).")
    registration = change.errors.registration
    if registration.shift_error_m == 0:
        found.append("The surveys were compared where they lie: no horizontal shift was estimated.")
    elif registration.shift_stated:
        found.append(
            "The surveys were compared where they lie: no horizontal shift was estimated. Errors on slopes have the "
            f"standard error of {registration.shift_error_m:g} m that was stated."
        )
    if registration.model == "none":
        found.append("Heights were taken as they are: no vertical shift was estimated.")
    return found


def number(value: float, digits: int) -> str:
    """A number with a true minus."""
    return f"{value:.{digits}f}".replace("-", MINUS)


def signed(value: float, digits: int) -> str:
    """A number with its sign."""
    return f"{value:+.{digits}f}".replace("-", MINUS)


def cubic(value: float) -> str:
    """A volume or an area: whole, or with three digits where it is small."""
    text = f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
    return text.replace(",", "\u202f").replace("-", MINUS)
